"""Losses of the paper (section 3.1, equation 1) and their ablations."""

from dataclasses import replace

import torch
import torch.distributed as dist
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from mereo.models.config import Supervision
from mereo.models.decoder import Prediction
from mereo.models.network import ALIGNED_QUERIES
from mereo_learning.config import TrainConfig
from mereo_learning.dataset import Batch
from mereo_learning.processes import Process


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


def rest_loss(
    predicted: Float[Tensor, "b q 3"], rest: Float[Tensor, "b q 3"], count: Float[Tensor, ""] | None = None
) -> Float[Tensor, ""]:
    """Mean distance between predicted and true rest coordinates; rows that are NaN (outside) are left out.

    The distance, not its square, so that the ends of wide bends do not outweigh the rest. ``count`` is the number by
    which the sum is divided, where it is not that of the rows.
    """
    known = ~rest.isnan().any(dim=-1)
    offset = torch.where(known[..., None], predicted - rest, torch.zeros_like(rest))
    distance = (offset.square().sum(dim=-1) + 1e-8).sqrt()
    return (distance * known).sum() / (known.sum().clamp(min=1) if count is None else count)


def supervised_loss(
    prediction: Prediction, coarse: Float[Tensor, "b p 3"] | None, batch: Batch, config: TrainConfig
) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]]]:
    """Loss of a batch: the paper's, that of rest coordinates and that of the alignment; also each term by name.

    ``coarse`` are the rest coordinates by which a network aligns its first points, None for one that does not.
    """
    loss, terms = occupancy_loss(
        prediction, batch.labels, batch.distances, batch.directions, config.supervision, config.l1_weight
    )
    aligned, everywhere = (None, None) if batch.known is None else batch.known
    if coarse is not None:
        terms["align"] = rest_loss(coarse, batch.rest[:, : coarse.shape[1]], aligned)
        loss = loss + terms["align"]
    if prediction.rest is not None:
        terms["rest"] = rest_loss(prediction.rest, batch.rest, everywhere)
        loss = loss + REST_WEIGHT * terms["rest"]
    return loss, terms


def with_known(batch: Batch, process: Process) -> Batch:
    """Share of ``process`` with the numbers of queries by which sums over the shares become means of the whole batch.

    The mean of shares with their own numbers would be another: they have more or fewer queries inside.
    """
    if process.world == 1:
        return batch
    inside = ~batch.rest.isnan().any(dim=-1)
    known = torch.stack([inside[:, :ALIGNED_QUERIES].sum(), inside.sum()])
    dist.all_reduce(known)
    return replace(batch, known=known.clamp(min=1) / process.world)
