"""Calibration of weights: what was measured, on training seeds, of how far their answers can be trusted."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import BaseModel, Field, FiniteFloat

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]


MISFITTING = 2.0
"""Power of a frame's misfit, over the usual one, by which its radii are wider.

Chosen on 47 views of the rope: of five at 1.2 to 1.7 times the usual misfit, 95 % of the places were within .9 to 2.7
radii, of nearly all others within 1.2."""


@dataclass(frozen=True)
class RadiusFactors:
    """What makes radii of the parts that a fit's posterior gives, in frames of one kind.

    Attributes:
        scale: factor of the Gaussian's radii; None where it was not measured.
        misfit: usual misfit of the cloud (``Problem.cloud_misfit``), above which they are wider; None without one.
    """

    scale: float | None = None
    misfit: float | None = None

    def scale_at(self, misfit: float) -> float | None:
        """Scale in a frame of this misfit: wider where that is more than usual."""
        if self.scale is None or self.misfit is None:
            return self.scale
        return self.scale * max(misfit / self.misfit, 1.0) ** MISFITTING


@dataclass(frozen=True)
class Scaling:
    """Scaling of logits before they become probabilities.

    Only probabilities are made of scaled logits. Labels are decided by the logits as they are, whose class offsets
    (logit adjustment, ``mereo_learning.validation``) serve the mIoU.

    Attributes:
        temperature: divides them.
        biases: are added then, one for each class, that of empty space 0; None where the temperature does alone.
    """

    temperature: float = 1.0
    biases: tuple[float, ...] | None = None


class Calibration(BaseModel, frozen=True):
    """What views of training seeds showed about the answers of these weights; parts that were not measured are None.

    Attributes:
        seed: of the views.
        views: how many of them.
        radius_scale: factor between the radius that a fit's posterior gives for 95 % and the one that held 95 % of the
            true positions, in frames without noise beyond the paper's.
        draws_radius_scale: the same of fits of a scene's own draws instead of the modes.
        usual_misfit, draws_usual_misfit: ``RadiusFactors.misfit`` of these scales.
        temperature: by which logits are divided before they become probabilities (temperature scaling; Guo et al.,
            ICML 2017).
        biases: added to the divided logits of empty space and each segment (with the temperature: vector scaling, but
            for one temperature of all classes); None where the temperature does alone. Labels do not depend on either.
        ece: expected calibration error of the probabilities as the network gives them, and as they are calibrated.
    """

    seed: Annotated[int, Field(ge=0)]
    views: Annotated[int, Field(ge=1)]
    radius_scale: Positive | None = None
    draws_radius_scale: Positive | None = None
    usual_misfit: Positive | None = None
    draws_usual_misfit: Positive | None = None
    temperature: Positive | None = None
    biases: tuple[FiniteFloat, ...] | None = None
    ece: tuple[Share, Share] | None = None

    def radii(self, *, draws: bool, noisy: bool) -> RadiusFactors:
        """What makes the radii of a fit of draws, or of the modes, to a frame; none makes them shorter.

        A calibration has seen whole objects alone, whose fits may be surer than the fixed weights of a clean frame say.
        """
        scale, misfit = self.radius_scale, self.usual_misfit
        if draws:
            scale, misfit = self.draws_radius_scale, self.draws_usual_misfit
        return RadiusFactors(scale and max(scale, 1.0), None if noisy else misfit)

    @property
    def scaling(self) -> Scaling:
        """Scaling of logits; one that changes nothing where there is no temperature."""
        return Scaling() if self.temperature is None else Scaling(self.temperature, self.biases)


def calibration_rows(calibration: Calibration | None) -> list[tuple[str, str]]:
    """Calibration in words, each with its title."""
    if calibration is None:
        return [("calibration", "none: confidences are not calibrated")]
    rows = [("calibration", f"{calibration.views} views of the training seed {calibration.seed}")]
    if calibration.temperature is not None:
        kind = "a temperature" if calibration.biases is None else "a temperature and a bias for each class"
        ece = calibration.ece
        error = "" if ece is None else f"; calibration error {ece[0]:.3f}, with it {ece[1]:.3f}"
        rows.append(("probabilities", f"{kind} ({calibration.temperature:.2f}){error}"))
    if calibration.radius_scale is not None:
        draws = calibration.draws_radius_scale
        of_draws = "" if draws is None else f", {draws:.2f} of fits of the scene's draws"
        rows.append(("radii", f"the posterior's times {calibration.radius_scale:.2f} of fits of the modes{of_draws}"))
    return rows
