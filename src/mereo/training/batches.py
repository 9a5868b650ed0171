"""Batches: what a training step reads of its examples, and the random changes that it makes to them.

All random numbers of a batch are drawn for the whole of it, whoever reads a part of it: so examples meet the same
changes whatever the number of processes.

Notation: e examples, b of them in a batch, p stored points, n points that the network sees, q queries.
"""

from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mereo.geometry.conventions import MIN_POINTS
from mereo.training.config import AugmentConfig


def seed_of(*numbers: int) -> int:
    """One 63-bit seed from several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))


@dataclass(frozen=True)
class Draws:
    """Random numbers of a batch, drawn on the CPU, of which a process takes those of its examples.

    Attributes:
        rng: where they come from; nothing else decides them.
        batch: examples of the whole batch; None where all of it is read here.
        rows: those that are read here, as many as each call asks for.
    """

    rng: torch.Generator
    batch: int | None = None
    rows: slice = field(default_factory=lambda: slice(None))

    @classmethod
    def of(cls, seed: int, batch: int | None = None, rows: slice | None = None) -> "Draws":
        """Numbers of a seed, for these ``rows`` of a ``batch`` or for a whole one."""
        return cls(torch.Generator().manual_seed(seed), batch, slice(None) if rows is None else rows)

    def rand(self, count: int, *shape: int) -> Float[Tensor, "b *s"]:
        """Uniform numbers in [0, 1), so many for each example."""
        return torch.rand(self.batch or count, *shape, generator=self.rng)[self.rows]

    def randn(self, count: int, *shape: int) -> Float[Tensor, "b *s"]:
        """Standard normal numbers, so many for each example."""
        return torch.randn(self.batch or count, *shape, generator=self.rng)[self.rows]

    def randint(self, low: int, high: int, count: int) -> Int[Tensor, " b"]:
        """Whole number from ``low`` to below ``high`` for each example."""
        return torch.randint(low, high, (self.batch or count,), generator=self.rng)[self.rows]


@dataclass(frozen=True, eq=False)
class Batch:
    """Examples that one training step reads, normalized by the (augmented) cloud.

    ``index`` says which of the dataset's examples they are; ``rest`` are rest coordinates
    (``synthesis.examples.LabelledPoints``), NaN outside. ``known`` are the numbers of queries with rest coordinates by
    which sums over those of the first ``ALIGNED_QUERIES`` and over those of all become means; None where they are this
    batch's own, others where it is a part of one.
    """

    index: Int[Tensor, " b"]
    cloud: Float[Tensor, "b n 3"]
    viewpoint: Float[Tensor, "b 3"]
    positions: Float[Tensor, "b q 3"]
    labels: Int[Tensor, "b q"]
    distances: Float[Tensor, "b q"]
    directions: Float[Tensor, "b q 3"]
    rest: Float[Tensor, "b q 3"]
    known: Float[Tensor, "2"] | None = None

    def parts(self, count: int) -> "list[Batch]":
        """So many batches, each with every ``count``-th example, and with the same ``known``."""
        if count == 1:
            return [self]
        rows = [item.name for item in fields(self) if item.name != "known"]
        return [replace(self, **{name: getattr(self, name)[first::count] for name in rows}) for first in range(count)]


def draw_observations(count: int, further: int, probability: float, draws: Draws) -> Int[Tensor, " b"]:
    """Number of the observation seen of each of ``count`` examples: 0 its own, or one of so many further ones."""
    if further == 0 or probability == 0:  # nothing is drawn, so that runs without observations stay what they were
        return torch.zeros(count, dtype=torch.long)
    chosen = draws.rand(count) < probability
    return chosen * draws.randint(1, further + 1, count)


def choose_points(
    cloud: Float[Tensor, "b p 3"],
    count: Int[Tensor, " b"],
    points: int,
    augment: AugmentConfig,
    draws: Draws,
) -> Float[Tensor, "b n 3"]:
    """First ``points`` real points of each cloud that survive dropping, repeated from the front where too few.

    What remains of a farthest-point order is still in order, and nearly a farthest-point order of what remains.
    """
    batch, stored, _ = cloud.shape
    device = cloud.device
    low, high = augment.keep_points
    keep = low + (high - low) * draws.rand(batch, 1)
    dropped = (draws.rand(batch, stored) >= keep).to(device)
    hole = (draws.rand(batch) < augment.hole_probability).to(device)
    radius = (augment.hole_radius * draws.rand(batch, 1)).to(device)
    center_index = (draws.rand(batch).to(device) * count).long()
    center = cloud[torch.arange(batch, device=device), center_index]
    dropped |= hole[:, None] & ((cloud - center[:, None]).norm(dim=-1) < radius)
    position = torch.arange(stored, device=device)
    padding = position >= count[:, None]
    # a cloud that loses nearly everything is left as it is: there would be nothing to reconstruct from
    dropped &= (~dropped & ~padding).sum(dim=1, keepdim=True) >= MIN_POINTS
    unwanted = dropped | padding
    order = (position + stored * unwanted).argsort(dim=1)
    left = (~unwanted).sum(dim=1, keepdim=True)
    slot = torch.arange(points, device=device) % left.clamp(max=points)
    return cloud.gather(1, order.gather(1, slot)[..., None].expand(-1, -1, 3))


def augment_batch(batch: Batch, augment: AugmentConfig, draws: Draws) -> Batch:
    """Batch with jitter along the view and a roll about the optical axis, normalized again by the changed cloud.

    The optical axis passes through the viewpoint, so rolling about it is a rotation about z around the viewpoint.
    """
    count, device = len(batch.cloud), batch.cloud.device
    jitter = augment.jitter_std * draws.rand(count, 1) * draws.randn(*batch.cloud.shape[:2])
    angle = 2 * torch.pi * draws.rand(count) if augment.roll else torch.zeros(count)
    cosine, sine = angle.cos().to(device), angle.sin().to(device)
    zero, one = torch.zeros_like(cosine), torch.ones_like(cosine)
    roll = torch.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one], dim=-1).view(count, 3, 3)
    origin = batch.viewpoint[:, None]
    # depth noise moves a point along its ray: p = v + (p - v) * (z + noise) / z
    rays = batch.cloud - origin
    rays = rays * (1 + jitter.to(device) / rays[..., 2])[..., None]
    cloud = rays @ roll.transpose(1, 2)
    positions = (batch.positions - origin) @ roll.transpose(1, 2)
    low, high = cloud.amin(dim=1), cloud.amax(dim=1)
    center, scale = (low + high) / 2, 2 / (high - low).amax(dim=1)
    return Batch(
        index=batch.index,
        cloud=(cloud - center[:, None]) * scale[:, None, None],
        viewpoint=-center * scale[:, None],
        positions=(positions - center[:, None]) * scale[:, None, None],
        labels=batch.labels,
        distances=batch.distances * scale[:, None],
        directions=batch.directions @ roll.transpose(1, 2),
        rest=batch.rest,
    )
