"""Generated examples as training reads them, batches of them, and the random changes that it makes to these.

Shards are checked once, then memory-mapped, so that they may be more than fits; those of an object storage cannot be
mapped and are held in memory. All random numbers of a batch are drawn for the whole of it, whoever reads a part of it:
so examples meet the same changes whatever the number of processes.

Notation: e examples, b of them in a batch, p stored points, n points that the network sees, q queries, k observations.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from safetensors.torch import load_file
from torch import Tensor

from mereo.geometry.conventions import MIN_POINTS
from mereo.io.object_storage import Place
from mereo.scenes.statistical_model import StatisticalModel, load_statistical_model
from mereo.synthesis.config import STATISTICAL_MODEL, TEMPLATE
from mereo_learning.config import AugmentConfig
from mereo_learning.shards import OBSERVED, SHARD, dataset_key, read_manifest, read_shard, read_template, shard_names

# --- batches ----------------------------------------------------------------------------------------------------------


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
    batch: int | None
    rows: slice

    @classmethod
    def of(cls, seed: int, batch: int | None = None, rows: slice = slice(None)) -> "Draws":
        """Numbers of a seed, for these ``rows`` of a ``batch`` or for a whole one."""
        return cls(torch.Generator().manual_seed(seed), batch, rows)

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
    batch's, others where it is the share of one of several processes.
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
    count = len(batch.cloud)
    device = batch.cloud.device
    jitter = augment.jitter_std * draws.rand(count, 1) * draws.randn(*batch.cloud.shape[:2])
    angle = 2 * torch.pi * draws.rand(count) if augment.roll else torch.zeros(count)
    cosine = angle.cos().to(device)
    sine = angle.sin().to(device)
    zero = torch.zeros_like(cosine)
    unit = torch.ones_like(cosine)
    roll = torch.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, unit], dim=-1).view(count, 3, 3)
    origin = batch.viewpoint[:, None]
    # depth noise moves a point along its ray: p = v + (p - v) * (z + noise) / z
    rays = batch.cloud - origin
    rays = rays * (1 + jitter.to(device) / rays[..., 2])[..., None]
    cloud = rays @ roll.transpose(1, 2)
    positions = (batch.positions - origin) @ roll.transpose(1, 2)
    low = cloud.amin(dim=1)
    high = cloud.amax(dim=1)
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


# --- datasets ---------------------------------------------------------------------------------------------------------

PASS = 1 << 20
"""Last number of the seeds from which passes are shuffled, by which they differ from those of steps."""

MARGIN = 0.15
"""Share of its sides by which the box of what was learnt is wider, in each direction."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner."""

Tensors = dict[str, Tensor]
"""Examples by the names of a shard's tensors (``shards.SHARD`` and ``OBSERVED``)."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Examples of a directory written by ``mereo generate``.

    Attributes:
        shards: tensors of each shard.
        manifest: how the dataset was made.
        device: where batches are wanted.
        template: signed distances to the segments at rest (``scenes.rest_pose``).
        statistical_model: of the object's states, which goes into the weights; None in a test set.
    """

    shards: tuple[Tensors, ...]
    manifest: dict[str, Any]
    device: torch.device
    template: Float[Tensor, "s n n n"]
    statistical_model: StatisticalModel | None = None

    def __len__(self) -> int:
        count: int = self.manifest["examples"]
        return count

    @classmethod
    def load(cls, directory: Place, device: torch.device | str = "cpu") -> "Dataset":
        """Dataset of a directory, of which every byte is read and checked.

        Raises ``ValueError`` or ``FileNotFoundError`` when that is not a whole dataset.
        """
        manifest = read_manifest(directory)
        paths = [directory / name for name in shard_names(manifest)]
        shards = {path: _open_shard(path, manifest) for path in paths if path.is_file()}
        have = sum(len(tensors["cloud"]) for tensors in shards.values())
        if have != manifest["examples"]:
            raise ValueError(
                f"{directory} holds {have} of {manifest['examples']} examples; training needs all of them: "
                "finish it with mereo generate ... --resume"
            )
        with _part_of_dataset(directory / TEMPLATE):
            template = torch.from_numpy(read_template(directory / TEMPLATE, manifest)).float()
        model = directory / STATISTICAL_MODEL
        return cls(
            shards=tuple(shards.values()),
            manifest=manifest,
            device=torch.device(device),
            template=template,
            statistical_model=load_statistical_model(model, dataset_key(manifest)) if model.is_file() else None,
        )

    @property
    def further(self) -> int:
        """Number of further observations of each example by other sensors."""
        return self.shards[0]["seen"].shape[1] if "seen" in self.shards[0] else 0

    @property
    def uniform_queries(self) -> int:
        """Number of queries of an example, its last ones, that are uniform in the joint box."""
        near: int = self.manifest["settings"]["sampling"]["per_segment"] * len(self.manifest["segments"])
        return self.shards[0]["positions"].shape[1] - near

    @cached_property
    def _starts(self) -> Int64[np.ndarray, " s"]:
        """First example of each shard."""
        sizes = np.array([len(shard["cloud"]) for shard in self.shards])
        return np.cumsum(sizes) - sizes

    @cached_property
    def visible_m(self) -> tuple[float, float] | None:
        """Least and greatest longest side of the visible part's box in metres; None where the unit is unknown."""
        unit_m = self.manifest.get("unit_m")
        if unit_m is None:
            return None
        # a normalizer's scale is one over half the longest side
        least = min(float(shard["scale"].min()) for shard in self.shards)
        most = max(float(shard["scale"].max()) for shard in self.shards)
        return 2 * unit_m / most, 2 * unit_m / least

    @cached_property
    def domain(self) -> Box:
        """Lower and upper corner of where segments occur in the normalized training data, widened on each side.

        Beyond it the network has hardly been trained, so a model answers "empty" there.
        """
        low, high = torch.full((3,), torch.inf), torch.full((3,), -torch.inf)
        for shard in self.shards:
            outside = (shard["labels"] == 0)[..., None]
            low = torch.minimum(low, shard["positions"].masked_fill(outside, torch.inf).amin(dim=(0, 1)))
            high = torch.maximum(high, shard["positions"].masked_fill(outside, -torch.inf).amax(dim=(0, 1)))
        widen = MARGIN * (high - low)
        (x0, y0, z0), (x1, y1, z1) = (low - widen).tolist(), (high + widen).tolist()
        return (x0, y0, z0), (x1, y1, z1)

    def read(self, index: Int[Tensor, " b"]) -> Tensors:
        """Tensors of the examples ``index``, in this order, on the CPU."""
        numbers = index.cpu().numpy()
        shards = np.searchsorted(self._starts, numbers, "right") - 1
        rows = [(self.shards[shard], row) for shard, row in zip(shards, numbers - self._starts[shards], strict=True)]
        return {name: torch.stack([shard[name][row] for shard, row in rows]) for name in self.shards[0]}

    def batch(
        self,
        index: Int[Tensor, " b"],
        points: int,
        queries: int,
        augment: AugmentConfig,
        draws: Draws,
        observation: Int[Tensor, " b"] | None = None,
    ) -> Batch:
        """Batch of the examples ``index``: ``points`` cloud points, a random ``queries`` of their queries (0: all).

        The random numbers come from ``draws``, so a batch depends on nothing else. ``observation`` says which one of
        each example is seen, 0 its own cloud; by default it is drawn.
        """
        device = self.device
        count = len(index)
        stored = {name: values.to(device) for name, values in self.read(index).items()}
        total = stored["positions"].shape[1]
        rows, chosen = torch.arange(count, device=device)[:, None], torch.arange(total, device=device)[None]
        if 0 < queries < total:
            chosen = draws.rand(count, total).topk(queries, dim=1).indices.to(device)
        if observation is None:
            observation = draw_observations(count, self.further, augment.observations, draws)
        cloud = choose_points(*_observed_clouds(stored, observation.to(device)), points, augment, draws)
        batch = Batch(
            index=index.to(device),
            cloud=cloud,
            viewpoint=(-stored["center"] * stored["scale"][:, None]).float(),
            positions=stored["positions"][rows, chosen],
            labels=stored["labels"][rows, chosen].long(),
            distances=stored["distances"][rows, chosen],
            directions=stored["directions"][rows, chosen].float(),
            rest=stored["rest"][rows, chosen].float(),
        )
        return augment_batch(batch, augment, draws)


def shuffled_index(step: int, examples: int, batch: int, seed: int) -> Int[Tensor, " b"]:
    """Numbers of the examples in the batch of a step: by a permutation for each pass, by its seed and number alone.

    So resuming needs no state. A batch may straddle two passes.
    """
    positions = range(step * batch, (step + 1) * batch)
    return torch.stack([_shuffled(p // examples, examples, seed)[p % examples] for p in positions])


@lru_cache(maxsize=4)
def _shuffled(number: int, examples: int, seed: int) -> Int[Tensor, " e"]:
    return torch.randperm(examples, generator=torch.Generator().manual_seed(seed_of(seed, number, PASS)))


def _observed_clouds(
    stored: Tensors, observation: Int[Tensor, " b"]
) -> tuple[Float[Tensor, "b p 3"], Int[Tensor, " b"]]:
    """Chosen cloud of each example, and how many of its points are real: the first ones."""
    cloud = stored["cloud"]
    count = stored["cloud_count"].long()
    if "seen" not in stored:
        return cloud, count
    rows = torch.arange(len(cloud))
    further = observation > 0
    number = (observation - 1).clamp(min=0)
    cloud = torch.where(further[:, None, None], stored["seen"][rows, number].float(), cloud)
    return cloud, torch.where(further, stored["seen_count"][rows, number].long(), count)


def _open_shard(path: Place, manifest: Mapping[str, Any]) -> Tensors:
    """Tensors of a shard, memory-mapped where it is a local file."""
    with _part_of_dataset(path):
        checked = read_shard(path, manifest)
    names = SHARD | (OBSERVED if OBSERVED.keys() <= checked.keys() else {})
    tensors = load_file(path) if isinstance(path, Path) else {n: torch.from_numpy(v) for n, v in checked.items()}
    return {name: tensors[name] for name in names}


@contextmanager
def _part_of_dataset(path: Place) -> Iterator[None]:
    try:
        yield
    except (FileNotFoundError, ValueError) as error:
        raise ValueError(f"{path} cannot be read ({error}); delete it and run mereo generate ... --resume") from None
