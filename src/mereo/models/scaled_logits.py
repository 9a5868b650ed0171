"""Logits before they become probabilities, by the scaling of a calibration."""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mereo.models.calibration import Scaling


def scaled_logits(scaling: Scaling, logits: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    """Logits in single precision, divided and with their biases; as they are where neither changes anything."""
    if scaling == Scaling():
        return logits
    divided = logits.float() / scaling.temperature
    return divided if scaling.biases is None else divided + _on_device(scaling.biases, logits.device)


def scaled_array(scaling: Scaling, logits: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
    """``scaled_logits`` of logits that have left their device."""
    return scaled_logits(scaling, torch.from_numpy(logits)).numpy()


@lru_cache(maxsize=16)
def _on_device(biases: tuple[float, ...], device: torch.device) -> Float[Tensor, " c"]:
    """Biases, made once: an upload for every chunk of queries would wait for the device."""
    return torch.tensor(biases, device=device)
