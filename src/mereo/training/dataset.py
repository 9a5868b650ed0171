"""Generated examples as training reads them: checked once, then memory-mapped, so that they may be more than fits.

Shards of an object storage cannot be mapped; they are held in memory.

Notation: e examples, b of them in a batch, p stored points, n points that the network sees, q queries, k observations.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from safetensors.torch import load_file
from torch import Tensor

from mereo.io.object_storage import Place
from mereo.scenes.statistical_model import StatisticalModel, load_statistical_model
from mereo.synthesis.config import STATISTICAL_MODEL, TEMPLATE
from mereo.synthesis.dataset_contents import (
    OBSERVED,
    SHARD,
    dataset_key,
    list_shards,
    read_manifest,
    read_shard,
    read_template,
    recorded_files,
)
from mereo.training.batches import Batch, Draws, augment_batch, choose_points, draw_observations, seed_of
from mereo.training.config import AugmentConfig

PASS = 1 << 20
"""Last number of the seeds from which passes are shuffled, by which they differ from those of steps."""

MARGIN = 0.15
"""Share of its sides by which the box of what was learnt is wider, in each direction."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner."""

Tensors = dict[str, Tensor]
"""Examples by the names of a shard's tensors (``dataset_contents.SHARD`` and ``OBSERVED``)."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Examples of a directory written by ``mereo generate``.

    Attributes:
        shards: tensors of each shard.
        manifest: how the dataset was made.
        device: where batches are wanted.
        template: signed distances to the segments at rest (``scenes.rest_pose``); None in older datasets.
        statistical_model: of the object's states, which goes into the weights; None in older datasets.
    """

    shards: tuple[Tensors, ...]
    manifest: dict[str, Any]
    device: torch.device
    template: Float[Tensor, "s n n n"] | None = None
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
        key, recorded = dataset_key(manifest), recorded_files(manifest)
        shards = {
            path: _open_shard(path, key, manifest.get("shard_size"), recorded.get(path.name))
            for path in list_shards(directory)
        }
        have = sum(len(tensors["cloud"]) for tensors in shards.values())
        if have != manifest["examples"]:
            raise ValueError(
                f"{directory} holds {have} of {manifest['examples']} examples; training needs all of them: "
                "finish it with mereo generate ... --resume"
            )
        _check_alike(shards)
        return cls(
            shards=tuple(shards.values()),
            manifest=manifest,
            device=torch.device(device),
            template=_load_template(directory, key, manifest),
            statistical_model=_load_modes(directory, key, manifest),
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
        device, count = self.device, len(index)
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


class ShuffledOrder:
    """Order in which examples are learnt from: a permutation for each pass, by its seed and number alone.

    So resuming needs no state. A batch may straddle two passes.
    """

    def __init__(self, examples: int, batch: int, seed: int) -> None:
        self.examples, self.batch, self.seed = examples, batch, seed
        self.passes: dict[int, Tensor] = {}

    def index(self, step: int) -> Int[Tensor, " b"]:
        """Numbers of the examples in the batch of a step."""
        positions = range(step * self.batch, (step + 1) * self.batch)
        return torch.stack([self._pass(p // self.examples)[p % self.examples] for p in positions])

    def _pass(self, number: int) -> Tensor:
        """The shuffled examples of a pass; the two latest are kept."""
        if number not in self.passes:
            rng = torch.Generator().manual_seed(seed_of(self.seed, number, PASS))
            kept = {n: order for n, order in self.passes.items() if n == number - 1}
            self.passes = kept | {number: torch.randperm(self.examples, generator=rng)}
        return self.passes[number]


def _observed_clouds(
    stored: Tensors, observation: Int[Tensor, " b"]
) -> tuple[Float[Tensor, "b p 3"], Int[Tensor, " b"]]:
    """Chosen cloud of each example, and how many of its points are real: the first ones."""
    cloud, count = stored["cloud"], stored["cloud_count"].long()
    if "seen" not in stored:
        return cloud, count
    rows, further, number = torch.arange(len(cloud)), observation > 0, (observation - 1).clamp(min=0)
    cloud = torch.where(further[:, None, None], stored["seen"][rows, number].float(), cloud)
    return cloud, torch.where(further, stored["seen_count"][rows, number].long(), count)


def _open_shard(path: Place, key: str, size: int | None, recorded: str | None) -> Tensors:
    """Tensors of the shard that ``path`` names; ``size`` is the number of examples of a whole one, if known.

    ``recorded`` is its SHA-256 in the manifest if it has one. Raises ``ValueError`` where it is damaged, or another's.
    """
    number = path.stem.partition("-")[2]
    first = int(number) * size if size is not None and number.isdecimal() else None
    with _part_of_dataset(path):
        checked = read_shard(path, key, first, None, recorded)
    names = SHARD | (OBSERVED if OBSERVED.keys() <= checked.keys() else {})
    tensors = load_file(path) if isinstance(path, Path) else {n: torch.from_numpy(v) for n, v in checked.items()}
    return {name: tensors[name] for name in names}


def _check_alike(shards: Mapping[Place, Tensors]) -> None:
    """Raise ``ValueError`` where examples of different shards cannot be in one batch."""
    shapes = {path: {name: tuple(v.shape[1:]) for name, v in tensors.items()} for path, tensors in shards.items()}
    first = next(iter(shapes.values()))
    for path, found in shapes.items():
        for name in first.keys() | found.keys():
            if found.get(name) != first.get(name):
                raise ValueError(
                    f"{path} has the shape {found.get(name)} of {name!r} in an example, the first shard "
                    f"{first.get(name)}; they must be equal: delete it and run mereo generate ... --resume"
                )


def _load_modes(directory: Place, key: str, manifest: Mapping[str, Any]) -> StatisticalModel | None:
    """Statistical model of a dataset's object; None in older datasets."""
    path, recorded = directory / STATISTICAL_MODEL, recorded_files(manifest).get(STATISTICAL_MODEL)
    return load_statistical_model(path, key, recorded) if path.exists() else None


def _load_template(directory: Place, key: str, manifest: Mapping[str, Any]) -> Tensor | None:
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
