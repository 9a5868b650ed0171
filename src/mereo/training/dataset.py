"""Generated examples in memory, and the training batches made of them.

Notation: e examples, b of them in a batch, p stored points, n points that the network sees, q queries, k observations.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float16, Float32, Int, UInt8
from torch import Tensor

from mereo.io.object_storage import Place
from mereo.scenes.statistical_model import StatisticalModel, load_statistical_model
from mereo.synthesis.config import STATISTICAL_MODEL, TEMPLATE
from mereo.synthesis.dataset_contents import (
    OBSERVED,
    dataset_key,
    list_shards,
    read_manifest,
    read_shard,
    read_template,
    recorded_files,
)
from mereo.training.batches import Batch, Draws, augment_batch, choose_points, draw_observations
from mereo.training.config import AugmentConfig
from mereo.training.orders import Order, ShuffledOrder

QUERIES = ("positions", "labels", "distances", "directions", "rest")
"""Tensors of a shard about its queries, which a dataset has under the same names."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner."""


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
        numbers: of these examples in the dataset that they are a part of; None where they are all of it.
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
    numbers: Int[Tensor, " e"] | None = None

    def __len__(self) -> int:
        return len(self.cloud)

    @classmethod
    def load(cls, directory: Place, device: torch.device | str = "cpu") -> "Dataset":
        """Dataset of a directory; ``ValueError`` or ``FileNotFoundError`` when that is not a whole dataset."""
        manifest = read_manifest(directory)
        key, recorded = dataset_key(manifest), recorded_files(manifest)
        parts = [
            read_part(path, key, manifest.get("shard_size"), recorded.get(path.name)) for path in list_shards(directory)
        ]
        check_whole(directory, manifest, sum(len(part["cloud"]) for part in parts))
        observed = tuple(OBSERVED) if all(OBSERVED.keys() <= part.keys() for part in parts) else ()
        joined = {}
        for name in ("cloud", "cloud_count", "center", "scale", *QUERIES, *observed):
            joined[name] = torch.cat([part.pop(name) for part in parts]).to(device)
        return cls(
            **as_fields(joined),
            manifest=manifest,
            template=load_template(directory, key, manifest),
            visible_m=visible_m(joined["scale"].min(), joined["scale"].max(), manifest.get("unit_m")),
            statistical_model=load_modes(directory, key, manifest),
        )

    @property
    def device(self) -> torch.device:
        """Device on which the examples are."""
        return self.cloud.device

    @property
    def further(self) -> int:
        """Number of further observations."""
        return 0 if self.seen is None else self.seen.shape[1]

    @property
    def uniform_queries(self) -> int:
        """Number of queries of an example, its last ones, that are uniform in the joint box."""
        return count_uniform(self.manifest, self.positions.shape[1])

    def first_queries(self, count: int) -> tuple[UInt8[np.ndarray, "e q"], Float32[np.ndarray, "e q"]]:
        """Labels and distances at all queries of the first ``count`` examples."""
        return self.labels[:count].cpu().numpy(), self.distances[:count].cpu().numpy()

    def domain(self, margin: float = 0.15) -> Box:
        """Lower and upper corner of where segments occur in the normalized training data, widened on each side.

        Beyond it the network has hardly been told anything, so a model answers "empty" there.
        """
        return widened(*occupied_box(self.positions, self.labels), margin)

    def order(self, examples: int, batch: int, seed: int, world: int) -> Order:
        """Order in which its first ``examples`` are learnt from, in batches that so many processes share."""
        return ShuffledOrder(examples, batch, seed)

    def pieces(self, order: Order, steps: range, rows: slice) -> "Iterator[tuple[Dataset, Int[Tensor, ' b']]]":
        """For each step, a dataset and the positions in it of the examples that are read: ``rows`` of its batch."""
        for step in steps:
            yield self, order.index(step)[rows]

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
        device = self.cloud.device
        index = index.to(device)
        total = self.positions.shape[1]
        rows = index[:, None]
        chosen: Tensor | slice = slice(None)
        if 0 < queries < total:
            chosen = draws.rand(len(index), total).topk(queries, dim=1).indices.to(device)
        else:
            rows = index
        if observation is None:
            observation = draw_observations(len(index), self.further, augment.observations, draws)
        cloud, count = self._observed(index, observation.to(device))
        cloud = choose_points(cloud, count, points, augment, draws)
        batch = Batch(
            index=index if self.numbers is None else self.numbers[index],
            cloud=cloud,
            viewpoint=self.viewpoint[index],
            positions=self.positions[rows, chosen],
            labels=self.labels[rows, chosen].long(),
            distances=self.distances[rows, chosen],
            directions=self.directions[rows, chosen].float(),
            rest=self.rest[rows, chosen].float(),
        )
        return augment_batch(batch, augment, draws)

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


def read_part(path: Place, key: str, size: int | None, recorded: str | None) -> dict[str, Tensor]:
    """Tensors of the shard that ``path`` names; ``size`` is the number of examples of a whole one, if known.

    ``recorded`` is its SHA-256 in the manifest if it has one. Raises ``ValueError`` where it is damaged, or another's.
    """
    number = path.stem.partition("-")[2]
    first = int(number) * size if size is not None and number.isdecimal() else None
    with _part_of_dataset(path):
        return {name: torch.from_numpy(value) for name, value in read_shard(path, key, first, None, recorded).items()}


def as_fields(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of shards under the names that a dataset gives them."""
    viewpoint = (-tensors["center"] * tensors["scale"][:, None]).float()
    fields = {"cloud": tensors["cloud"], "count": tensors["cloud_count"].long(), "viewpoint": viewpoint}
    fields |= {name: tensors[name] for name in QUERIES}
    if OBSERVED.keys() <= tensors.keys():
        fields |= {"seen": tensors["seen"], "seen_count": tensors["seen_count"].long()}
    return fields


def check_whole(directory: Place, manifest: Mapping[str, Any], have: int) -> None:
    """Raise ``ValueError`` where a dataset has another number of examples than it should."""
    if have != manifest["examples"]:
        raise ValueError(
            f"{directory} holds {have} of {manifest['examples']} examples; training needs all of them: "
            "finish it with mereo generate ... --resume"
        )


def count_uniform(manifest: Mapping[str, Any], queries: int) -> int:
    """Number of an example's ``queries`` that are uniform in the joint box."""
    near: int = manifest["settings"]["sampling"]["per_segment"] * len(manifest["segments"])
    return queries - near


def occupied_box(
    positions: Float[Tensor, "e q 3"], labels: UInt8[Tensor, "e q"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Lower and upper corner of the queries that are in a segment."""
    occupied = positions[labels > 0]
    return occupied.amin(dim=0), occupied.amax(dim=0)


def widened(low: Float[Tensor, "3"], high: Float[Tensor, "3"], margin: float) -> Box:
    """Box that is wider by this share of its sides in each direction."""
    widen = margin * (high - low)
    (x0, y0, z0), (x1, y1, z1) = (low - widen).tolist(), (high + widen).tolist()
    return (x0, y0, z0), (x1, y1, z1)


def visible_m(least: float | Tensor, most: float | Tensor, unit_m: float | None) -> tuple[float, float] | None:
    """Least and greatest visible size, from the normalizers' scales, which are one over half the longest side."""
    return None if unit_m is None else (2 * unit_m / float(most), 2 * unit_m / float(least))


def load_modes(directory: Place, key: str, manifest: Mapping[str, Any]) -> StatisticalModel | None:
    """Statistical model of a dataset's object; None in older datasets."""
    path, recorded = directory / STATISTICAL_MODEL, recorded_files(manifest).get(STATISTICAL_MODEL)
    return load_statistical_model(path, key, recorded) if path.exists() else None


def load_template(directory: Place, key: str, manifest: Mapping[str, Any]) -> Tensor | None:
    """Template of a dataset; None in older ones, ``ValueError`` where it is damaged."""
    path, recorded = directory / TEMPLATE, recorded_files(manifest).get(TEMPLATE)
    if not path.is_file():
        return None
    with _part_of_dataset(path):
        return torch.from_numpy(read_template(path, key, len(manifest["segments"]), recorded)).float()


@contextmanager
def _part_of_dataset(path: Place) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path} cannot be read ({error}); delete it and run mereo generate ... --resume") from None
