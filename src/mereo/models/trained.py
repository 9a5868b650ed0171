"""Trained networks as callers see them: without torch, which only their own code needs.

cloud -Trained.encode-> EncodedCloud -query, logits, correspond-> answers at points

``models.model.Model`` is the one that there is. An object without weights has none, and nothing here is loaded for it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from mereo.geometry.brief import counted
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import MIN_POINTS, Names, NoFit
from mereo.geometry.mesh import Nested, SegmentColors
from mereo.geometry.transforms import Labels, Normalizer, Points, Rows, Values
from mereo.models.calibration import Calibration
from mereo.scenes.statistical_model import StatisticalModel


@dataclass(frozen=True, eq=False)
class EncodedCloud:
    """Observed cloud, encoded and ready to be queried.

    Attributes:
        code: the network's side, tensors.
        normalizer: between the user's frame and the network's.
        cloud: the points the network saw, in the user's frame and units.
    """

    code: Any
    normalizer: Normalizer
    cloud: Points

    def __repr__(self) -> str:
        return f"EncodedCloud({counted(len(self.cloud), 'point')})"


@dataclass(frozen=True, eq=False)
class Answer:
    """Answers of a model at points, in the user's frame and units.

    Attributes:
        label: 0 for empty space, i + 1 for the model's segment i.
        probability: of empty space and each segment; rows sum to one. Calibrated where ``Model.calibrates``: another
            class than the label, which is decided without that, may then have a greater one.
        distance: to the nearest segment surface, negative inside; NaN from a model that was not trained on distances.
        direction: unit vector towards it; NaN from a model that was not trained on directions.
    """

    label: Labels
    probability: Rows
    distance: Values
    direction: Points

    def __repr__(self) -> str:
        return f"Answer({counted(len(self.label), 'point')}, {int((self.label > 0).sum()):,} in a segment)"


@runtime_checkable
class Trained(Protocol):
    """Trained network: its facts and its answers. ``Model`` describes each attribute."""

    @property
    def name(self) -> str:
        """How the weights were named when they were loaded."""

    @property
    def names(self) -> Names:
        """Names of the segments."""

    @property
    def colors(self) -> SegmentColors:
        """Colours of the segments."""

    @property
    def nested(self) -> Nested:
        """Pairs of names (inner, outer)."""

    @property
    def segmented(self) -> bool:
        """Whether it tells segments apart."""

    @property
    def provenance(self) -> Mapping[str, object]:
        """How it was trained."""

    @property
    def statistical_model(self) -> StatisticalModel | None:
        """Statistical model of the object's states; None without."""

    @property
    def calibration(self) -> Calibration | None:
        """How far its answers can be trusted; None where that was not measured."""

    @property
    def calibrates(self) -> bool:
        """Whether its probabilities are calibrated."""

    @property
    def device_type(self) -> str:
        """Kind of the device that it computes on."""

    @property
    def working_precision(self) -> str:
        """Name of the type of its products."""

    def encode(self, cloud: PointCloud) -> EncodedCloud:
        """Encoded cloud of points in a camera frame; ``ValueError`` for unusable ones."""

    def query(self, code: EncodedCloud, points: Points) -> Answer:
        """Segment, probabilities, signed distance and direction at each point."""

    def logits(self, code: EncodedCloud, points: Points) -> Rows:
        """Class logits at each point."""

    def correspond(self, code: EncodedCloud, points: Points) -> tuple[Rows, Points] | None:
        """Class probabilities and rest coordinates of points; None from a network without them."""


def check_enough(count: int, message: str) -> None:
    """Raise ``NoFit``, beginning with ``message``, where a reconstruction needs more points than ``count``."""
    if count < MIN_POINTS:
        raise NoFit(
            f"{message}; a reconstruction needs at least {MIN_POINTS}: move closer, or check the mask and the depth "
            "range"
        )


def checked_points(cloud: PointCloud) -> Points:
    """Points of a cloud as float64, or ``ValueError`` with one sentence on why they cannot be used."""
    points = np.asarray(cloud.points, float)
    check_enough(len(points), f"the cloud has {len(points)} points")
    if (points[:, 2] <= 0).any():
        raise ValueError(
            f"{int((points[:, 2] <= 0).sum())} of {len(points)} points have z <= 0, behind the camera; the cloud must "
            f"be in a camera frame (x right, y down, z forward): {_cure_of_axes(points)}"
        )
    return points


FORWARD = {
    "x forward, y left, z up": ((1, 0, 0), "0 0 1 0, -1 0 0 0, 0 -1 0 0"),
    "x right, y forward, z up": ((0, 1, 0), "1 0 0 0, 0 0 1 0, 0 -1 0 0"),
    "x right, y up, z backward": ((0, 0, -1), "1 0 0 0, 0 -1 0 0, 0 0 -1 0"),
}
"""Direction in which a camera looks along other usual axes, and its pose in them (the first three rows)."""


def _cure_of_axes(points: Points) -> str:
    """Advice for a cloud that is not in front of a camera, by the axes in which it is in front of the origin."""
    ahead = points.mean(axis=0)
    axes = max(FORWARD, key=lambda name: ahead @ FORWARD[name][0])
    direction, rows = FORWARD[axes]
    if (points @ direction > 0).all():
        return (
            f"it looks like {axes} from the origin, which --camera-pose FILE turns: write the rows {rows} and 0 0 0 1 "
            "into the file, or the camera's pose where that is not the origin"
        )
    return (
        "name the file of the camera's pose in the cloud's frame (--camera-pose FILE) for a cloud in a robot's base or "
        "a map, or pass --frame scanner for a range scan with y up and z toward the scanner"
    )
