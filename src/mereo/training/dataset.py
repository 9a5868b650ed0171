"""Generated examples in memory, and the training batches drawn from them.

Notation: e examples, b of them in a batch, p stored points, n points that the network sees, q queries, k observations.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Float16, Int, UInt8
from torch import Tensor

from mereo.geometry.conventions import MIN_POINTS
from mereo.io.places import Place
from mereo.scenes.statistical_model import StatisticalModel
from mereo.scenes.statistical_model_file import load_statistical_model
from mereo.synthesis.config import STATISTICAL_MODEL, TEMPLATE
from mereo.synthesis.dataset_files import (
    OBSERVED,
    dataset_key,
    list_shards,
    read_manifest,
    read_shard,
    read_template,
    recorded_files,
)
from mereo.training.config import AugmentConfig


@dataclass(frozen=True, eq=False)
class Batch:
    """Examples that one training step reads, normalized by the (augmented) cloud.

    ``index`` says which of the dataset's examples they are; ``rest`` are rest coordinates
    (``synthesis.examples.LabelledPoints``), NaN outside.
    """

    index: Int[Tensor, " b"]
    cloud: Float[Tensor, "b n 3"]
    viewpoint: Float[Tensor, "b 3"]
    positions: Float[Tensor, "b q 3"]
    labels: Int[Tensor, "b q"]
    distances: Float[Tensor, "b q"]
    directions: Float[Tensor, "b q 3"]
    rest: Float[Tensor, "b q 3"]


@dataclass(frozen=True, eq=False)
class Dataset:
    """Examples of a directory written by ``mereo generate``, all of them in memory.

    Attributes:
        cloud: observed points in farthest-point order; only the first ``count`` of each are real.
        viewpoint: the camera's position in normalized coordinates.
        manifest: how the dataset was made.
        template: signed distances to the segments at rest (``scenes.rest_pose``); None in older datasets.
        statistical_model: of the object's states, which goes into the weights; None in older datasets.
        visible_m: least and greatest longest side of the visible part's box in metres; None where the unit is unknown.
        seen: further observations of the same states by other sensors, normalized as ``cloud``; None without any.
        seen_count: how many points of each are real.
    """

    cloud: Float[Tensor, "e p 3"]
    count: Int[Tensor, " e"]
    viewpoint: Float[Tensor, "e 3"]
    positions: Float[Tensor, "e q 3"]
    labels: UInt8[Tensor, "e q"]
    distances: Float[Tensor, "e q"]
    directions: Float[Tensor, "e q 3"]
    rest: Float[Tensor, "e q 3"]
    manifest: dict[str, Any]
    template: Float[Tensor, "s n n n"] | None = None
    visible_m: tuple[float, float] | None = None
    statistical_model: StatisticalModel | None = None
    seen: Float16[Tensor, "e k p 3"] | None = None
    seen_count: Int[Tensor, "e k"] | None = None

    def __len__(self) -> int:
        return len(self.cloud)

    @classmethod
    def load(cls, directory: Place, device: torch.device | str = "cpu") -> "Dataset":
        """Dataset of a directory; ``ValueError`` or ``FileNotFoundError`` when that is not a whole dataset."""
        manifest = read_manifest(directory)
        key, recorded = dataset_key(manifest), recorded_files(manifest)
        parts = [
            _read_part(path, key, manifest.get("shard_size"), recorded.get(path.name))
            for path in list_shards(directory)
        ]
        have = sum(len(part["cloud"]) for part in parts)
        if have != manifest["examples"]:
            raise ValueError(
                f"{directory} holds {have} of {manifest['examples']} examples; training needs all of them: "
                "finish it with mereo generate ... --resume"
            )
        queries = ("positions", "labels", "distances", "directions", "rest")
        observed = OBSERVED if all(OBSERVED.keys() <= part.keys() for part in parts) else ()
        joined = {}
        for name in ("cloud", "cloud_count", "center", "scale", *queries, *observed):
            joined[name] = torch.cat([part.pop(name) for part in parts]).to(device)
        viewpoint = (-joined["center"] * joined["scale"][:, None]).float()
        return cls(
            cloud=joined["cloud"],
            count=joined["cloud_count"].long(),
            viewpoint=viewpoint,
            **{name: joined[name] for name in queries},
            manifest=manifest,
            template=_read_template(directory / TEMPLATE, key, len(manifest["segments"]), recorded.get(TEMPLATE)),
            visible_m=_visible_m(joined["scale"], manifest.get("unit_m")),
            statistical_model=_read_statistical_model(
                directory / STATISTICAL_MODEL, key, recorded.get(STATISTICAL_MODEL)
            ),
            seen=joined.get("seen"),
            seen_count=joined["seen_count"].long() if observed else None,
        )

    @property
    def further(self) -> int:
        """Number of further observations."""
        return 0 if self.seen is None else self.seen.shape[1]

    @property
    def uniform_queries(self) -> int:
        """Number of queries of an example, its last ones, that are uniform in the joint box."""
        near: int = self.manifest["settings"]["sampling"]["per_segment"] * len(self.manifest["segments"])
        return self.positions.shape[1] - near

    def domain(self, margin: float = 0.15) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Lower and upper corner of where segments occur in the normalized training data, widened on each side.

        Beyond it the network has hardly been told anything, so a model answers "empty" there.
        """
        occupied = self.positions[self.labels > 0]
        low, high = occupied.amin(dim=0), occupied.amax(dim=0)
        widen = margin * (high - low)
        (x0, y0, z0), (x1, y1, z1) = (low - widen).tolist(), (high + widen).tolist()
        return (x0, y0, z0), (x1, y1, z1)

    def batch(
        self,
        index: Int[Tensor, " b"],
        points: int,
        queries: int,
        augment: AugmentConfig,
        rng: torch.Generator,
        observation: Int[Tensor, " b"] | None = None,
    ) -> Batch:
        """Batch of the examples ``index``: ``points`` cloud points, a random ``queries`` of their queries (0: all).

        The random numbers come from ``rng`` (on the CPU), so a batch depends on nothing else. ``observation`` says
        which one of each example is seen, 0 its own cloud; by default it is drawn.
        """
        device = self.cloud.device
        index = index.to(device)
        total = self.positions.shape[1]
        rows = index[:, None]
        chosen: Tensor | slice = slice(None)
        if 0 < queries < total:
            order = torch.rand(len(index), total, generator=rng).topk(queries, dim=1).indices
            chosen = order.to(device)
        else:
            rows = index
        if observation is None:
            observation = draw_observations(len(index), self.further, augment.observations, rng)
        cloud, count = self._observed(index, observation.to(device))
        cloud = choose_points(cloud, count, points, augment, rng)
        batch = Batch(
            index=index,
            cloud=cloud,
            viewpoint=self.viewpoint[index],
            positions=self.positions[rows, chosen],
            labels=self.labels[rows, chosen].long(),
            distances=self.distances[rows, chosen],
            directions=self.directions[rows, chosen].float(),
            rest=self.rest[rows, chosen].float(),
        )
        return augment_batch(batch, augment, rng)

    def _observed(
        self, index: Int[Tensor, " b"], observation: Int[Tensor, " b"]
    ) -> tuple[Float[Tensor, "b p 3"], Int[Tensor, " b"]]:
        """Chosen cloud of each example, and its count."""
        cloud, count = self.cloud[index], self.count[index]
        if self.seen is None or self.seen_count is None:
            return cloud, count
        further, number = observation > 0, (observation - 1).clamp(min=0)
        cloud = torch.where(further[:, None, None], self.seen[index, number].float(), cloud)
        return cloud, torch.where(further, self.seen_count[index, number], count)


def draw_observations(count: int, further: int, probability: float, rng: torch.Generator) -> Int[Tensor, " b"]:
    """Number of the observation seen of each of ``count`` examples: 0 its own, or one of so many further ones."""
    if further == 0 or probability == 0:  # nothing is drawn, so that runs without observations stay what they were
        return torch.zeros(count, dtype=torch.long)
    chosen = torch.rand(count, generator=rng) < probability
    return chosen * torch.randint(1, further + 1, (count,), generator=rng)


def _read_part(path: Place, key: str, size: int | None, recorded: str | None) -> dict[str, Tensor]:
    """Tensors of the shard that ``path`` names; ``size`` is the number of examples of a whole one, if known."""
    number = path.stem.partition("-")[2]
    first = int(number) * size if size is not None and number.isdecimal() else None
    with _part_of_dataset(path):
        return {name: torch.from_numpy(value) for name, value in read_shard(path, key, first, None, recorded).items()}


@contextmanager
def _part_of_dataset(path: Place) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path} cannot be read ({error}); delete it and run mereo generate ... --resume") from None


def _visible_m(scale: Float[Tensor, " e"], unit_m: float | None) -> tuple[float, float] | None:
    """Least and greatest visible size, from the normalizers' scales, which are one over half the longest side."""
    return None if unit_m is None else (2 * unit_m / float(scale.max()), 2 * unit_m / float(scale.min()))


def _read_statistical_model(path: Place, key: str, recorded: str | None) -> StatisticalModel | None:
    return load_statistical_model(path, key, recorded) if path.exists() else None


def _read_template(path: Place, key: str, segments: int, recorded: str | None) -> Tensor | None:
    if not path.is_file():
        return None
    with _part_of_dataset(path):
        return torch.from_numpy(read_template(path, key, segments, recorded)).float()


def choose_points(
    cloud: Float[Tensor, "b p 3"],
    count: Int[Tensor, " b"],
    points: int,
    augment: AugmentConfig,
    rng: torch.Generator,
) -> Float[Tensor, "b n 3"]:
    """First ``points`` real points of each cloud that survive dropping, repeated from the front where too few.

    What remains of a farthest-point order is still in order, and nearly a farthest-point order of what remains.
    """
    batch, stored, _ = cloud.shape
    device = cloud.device
    low, high = augment.keep_points
    keep = low + (high - low) * torch.rand(batch, 1, generator=rng)
    dropped = (torch.rand(batch, stored, generator=rng) >= keep).to(device)
    hole = (torch.rand(batch, generator=rng) < augment.hole_probability).to(device)
    radius = (augment.hole_radius * torch.rand(batch, 1, generator=rng)).to(device)
    center_index = (torch.rand(batch, generator=rng).to(device) * count).long()
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


def augment_batch(batch: Batch, augment: AugmentConfig, rng: torch.Generator) -> Batch:
    """Batch with jitter along the view and a roll about the optical axis, normalized again by the changed cloud.

    The optical axis passes through the viewpoint, so rolling about it is a rotation about z around the viewpoint.
    """
    count, device = len(batch.cloud), batch.cloud.device
    jitter = (
        augment.jitter_std * torch.rand(count, 1, generator=rng) * torch.randn(batch.cloud.shape[:2], generator=rng)
    )
    angle = 2 * torch.pi * torch.rand(count, generator=rng) if augment.roll else torch.zeros(count)
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
