"""Losses of the paper (section 3.1, equation 1) and their ablations."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from mereo.models.config import Supervision
from mereo.models.decoder import Prediction


def occupancy_loss(
    prediction: Prediction,
    labels: Int[Tensor, "b q"],
    distances: Float[Tensor, "b q"],
    directions: Float[Tensor, "b q 3"],
    supervision: Supervision,
    l1_weight: float,
) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]]]:
    """Loss ``CE + l1_weight * L1 - mean cosine`` of the terms that ``supervision`` asks for; also each term by name.

    Distances are signed and normalized, directions unit vectors to the nearest surface in the camera frame.
    """
    terms: dict[str, Float[Tensor, ""]] = {}
    if supervision.labels:
        terms["ce"] = F.cross_entropy(prediction.logits.flatten(0, 1), labels.flatten())
    if supervision.distances:
        terms["l1"] = F.l1_loss(prediction.distance, distances)
    if supervision.directions:
        terms["cd"] = -F.cosine_similarity(prediction.direction, directions, dim=-1).mean()
    weights = {"ce": 1.0, "l1": l1_weight, "cd": 1.0}
    total = torch.stack([weights[name] * value for name, value in terms.items()]).sum()
    return total, terms


REST_WEIGHT = 3.0
"""Weight of the rest coordinates by which the decoder looks queries up in the rest pose."""


def rest_loss(predicted: Float[Tensor, "b q 3"], rest: Float[Tensor, "b q 3"]) -> Float[Tensor, ""]:
    """Mean distance between predicted and true rest coordinates; rows that are NaN (outside) are left out.

    The distance, not its square, so that the ends of wide bends do not outweigh the rest.
    """
    known = ~rest.isnan().any(dim=-1)
    offset = torch.where(known[..., None], predicted - rest, torch.zeros_like(rest))
    distance = (offset.square().sum(dim=-1) + 1e-8).sqrt()
    return (distance * known).sum() / known.sum().clamp(min=1)
