"""Calibration of weights: what was measured, on training seeds, of how far their answers can be trusted."""

from typing import Annotated

from pydantic import BaseModel, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Calibration(BaseModel, frozen=True):
    """What views of training seeds showed about the answers of these weights; parts that were not measured are None.

    Attributes:
        seed: of the views.
        views: how many of them.
        radius_scale: factor between the radius that a fit's posterior gives for 95 % and the one that held 95 % of the
            true positions.
    """

    seed: Annotated[int, Field(ge=0)]
    views: Annotated[int, Field(ge=1)]
    radius_scale: Positive | None = None
