"""Calibration of weights: what was measured, on training seeds, of how far their answers can be trusted."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, Field, FiniteFloat, model_validator
from torch import Tensor

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]


SignName = Literal["size", "unexplained", "ruled_out", "beyond", "unusual", "displaced"]
"""Signs that a frame does not show the object in a state that was learned; ``fitting.registration`` tells them."""


class Usual(BaseModel, frozen=True):
    """Usual logarithm of a sign in views of the object: its mean and its standard deviation."""

    mean: FiniteFloat
    std: Positive


class Recognizing(BaseModel, frozen=True):
    """What tells the object in learned states from other things and states (``fitting.registration.recognition``).

    Attributes:
        clean: usual signs of views without noise beyond the paper's.
        noisy: the same of simulated depth cameras' views.
        unsure: strangeness up to which the object is known.
        refused: strangeness from which on it is not.
    """

    clean: dict[SignName, Usual]
    noisy: dict[SignName, Usual]
    unsure: Positive
    refused: Positive

    @model_validator(mode="after")
    def _ordered(self) -> "Recognizing":
        if self.unsure >= self.refused:
            raise ValueError(f"the limits are {self.unsure:g} and {self.refused:g}; the first must be the smaller")
        return self


@dataclass(frozen=True)
class Scaling:
    """Scaling of logits before they become probabilities.

    Only probabilities are made of scaled logits. Labels are decided by the logits as they are, whose class offsets
    (logit adjustment, ``training.logit_adjustment``) serve the mIoU.

    Attributes:
        temperature: divides them.
        biases: are added then, one for each class, that of empty space 0; None where the temperature does alone.
    """

    temperature: float = 1.0
    biases: tuple[float, ...] | None = None

    def scaled(self, logits: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        """Logits in single precision, divided and with their biases; as they are where neither changes anything."""
        if self == Scaling():
            return logits
        divided = logits.float() / self.temperature
        return divided if self.biases is None else divided + _on_device(self.biases, logits.device)

    def scaled_array(self, logits: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """``scaled`` of logits that have left their device."""
        return self.scaled(torch.from_numpy(logits)).numpy()


RADIUS_FIELDS = {
    ("modes", False): "radius_scale",
    ("modes", True): "noisy_radius_scale",
    ("draws", False): "draws_radius_scale",
    ("draws", True): "noisy_draws_radius_scale",
}
"""Field of a ``Calibration`` that scales the radii of fits of the modes or of a scene's draws, by whether the frame is
noisy."""


class Calibration(BaseModel, frozen=True):
    """What views of training seeds showed about the answers of these weights; parts that were not measured are None.

    Attributes:
        seed: of the views.
        views: how many of them.
        radius_scale: factor between the radius that a fit's posterior gives for 95 % and the one that held 95 % of the
            true positions, in frames without noise beyond the paper's.
        noisy_radius_scale: the same of simulated depth cameras' frames.
        draws_radius_scale, noisy_draws_radius_scale: both, of fits of a scene's own draws instead of the modes.
        temperature: by which logits are divided before they become probabilities (temperature scaling; Guo et al.,
            ICML 2017).
        biases: added to the divided logits of empty space and each segment (with the temperature: vector scaling, but
            for one temperature of all classes); None where the temperature does alone. Labels do not depend on either.
        ece: expected calibration error of the probabilities as the network gives them, and as they are calibrated.
        recognizing: what tells the object in learned states from other things and states.
    """

    seed: Annotated[int, Field(ge=0)]
    views: Annotated[int, Field(ge=1)]
    radius_scale: Positive | None = None
    noisy_radius_scale: Positive | None = None
    draws_radius_scale: Positive | None = None
    noisy_draws_radius_scale: Positive | None = None
    temperature: Positive | None = None
    biases: tuple[FiniteFloat, ...] | None = None
    ece: tuple[Share, Share] | None = None
    recognizing: Recognizing | None = None

    def radius_scales(self, noisy: bool) -> tuple[float | None, float | None]:
        """Factors of the radii of a fit of the modes and of one of draws, to a clean or a camera's noisy frame."""
        modes, draws = (getattr(self, RADIUS_FIELDS[method, noisy]) for method in ("modes", "draws"))
        return modes, draws

    @property
    def scaling(self) -> Scaling:
        """Scaling of logits; one that changes nothing where there is no temperature."""
        return Scaling() if self.temperature is None else Scaling(self.temperature, self.biases)


@lru_cache(maxsize=16)
def _on_device(biases: tuple[float, ...], device: torch.device) -> Float[Tensor, " c"]:
    """Biases, made once: an upload for every chunk of queries would wait for the device."""
    return torch.tensor(biases, device=device)


def calibration_rows(found: Calibration | None) -> list[tuple[str, str]]:
    """Calibration in words, each with its title."""
    if found is None:
        return [("calibration", "none: confidences are not calibrated, recognition has conservative limits")]
    rows = [("calibration", f"{found.views} views of the training seed {found.seed}")]
    if found.temperature is not None:
        kind = "a temperature" if found.biases is None else "a temperature and a bias for each class"
        error = "" if found.ece is None else f"; calibration error {found.ece[0]:.3f}, with it {found.ece[1]:.3f}"
        rows.append(("probabilities", f"{kind} ({found.temperature:.2f}){error}"))
    for what, noisy in (("radii", False), ("radii of noisy frames", True)):
        modes, draws = found.radius_scales(noisy)
        if modes is not None:
            of_draws = "" if draws is None else f", {draws:.2f} of fits of the scene's draws"
            rows.append((what, f"the posterior's times {modes:.2f} of fits of the modes{of_draws}"))
    if found.recognizing is not None:
        limits = found.recognizing
        rows.append(("recognition", f"unsure above a strangeness of {limits.unsure:.2g}, no from {limits.refused:.2g}"))
    return rows
