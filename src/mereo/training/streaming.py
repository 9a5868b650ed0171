"""Generated examples that stay on disk: a few shards are in memory at a time, and the next ones are read ahead.

Notation: e examples, b of them in a batch, s shards, q queries.
"""

from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, Int64, UInt8
from torch import Tensor

from mereo.io.object_storage import Place
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.dataset_contents import dataset_key, list_shards, read_manifest, recorded_files
from mereo.training.batches import Batch, Draws
from mereo.training.config import AugmentConfig
from mereo.training.dataset import (
    Box,
    Dataset,
    as_fields,
    check_whole,
    count_uniform,
    load_modes,
    load_template,
    read_part,
    visible_m,
    widened,
)
from mereo.training.orders import Order, StreamedOrder
from mereo.training.processes import Process, together, told
from mereo.training.read_ahead import ReadAhead
from mereo.training.survey import Survey, make_survey, read_survey, write_survey

Fields = dict[str, Tensor]
"""Examples by the names of a shard's tensors, or of a ``Dataset``."""

KEPT = 2
"""Shards kept of those that are asked for by their examples: neighbours are asked for together."""


@dataclass(frozen=True, eq=False)
class StreamingDataset:
    """Examples of a directory written by ``mereo generate``, read while they are learnt from.

    What the trainer asks of a ``Dataset`` has the same names and the same values here.

    Attributes:
        directory: where they are.
        names: of its shards, in the order of their examples.
        key: of the dataset.
        device: where batches are wanted.
        manifest: how the dataset was made.
        points: stored points of an example's cloud.
        queries: of an example.
        further: number of further observations.
        template: as a ``Dataset`` has it.
        statistical_model: as a ``Dataset`` has it.
        survey: what is only known once all shards were read; None before.
        recent: latest shards that were asked for by their examples.
    """

    directory: Place
    names: tuple[str, ...]
    key: str
    device: torch.device
    manifest: dict[str, Any]
    points: int
    queries: int
    further: int
    template: Float[Tensor, "s n n n"] | None = None
    statistical_model: StatisticalModel | None = None
    survey: Survey | None = None
    recent: dict[int, Fields] = field(default_factory=dict)

    def __len__(self) -> int:
        count: int = self.manifest["examples"]
        return count

    @classmethod
    def open(cls, directory: Place, device: torch.device | str = "cpu") -> "StreamingDataset":
        """Dataset of a directory, of which one shard is read; raises as ``Dataset.load`` does for what that shows."""
        manifest = read_manifest(directory)
        key, size = dataset_key(manifest), manifest.get("shard_size")
        names = tuple(path.name for path in list_shards(directory))
        whole = -(-manifest["examples"] // size) if size else len(names)
        if len(names) < max(whole, 1):
            check_whole(directory, manifest, min(len(names) * (size or 0), manifest["examples"] - 1))
        first = read_part(directory / names[0], key, size, recorded_files(manifest).get(names[0]))
        return cls(
            directory=directory,
            names=names,
            key=key,
            device=torch.device(device),
            manifest=manifest,
            points=first["cloud"].shape[1],
            queries=first["positions"].shape[1],
            further=first["seen"].shape[1] if "seen" in first else 0,
            template=load_template(directory, key, manifest),
            statistical_model=load_modes(directory, key, manifest),
        )

    @property
    def found(self) -> Survey:
        """Survey of the dataset, which there must be by now."""
        assert self.survey is not None, "a streaming dataset is surveyed before it is learnt from"
        return self.survey

    @property
    def visible_m(self) -> tuple[float, float] | None:
        """Least and greatest visible size, as a ``Dataset`` has it."""
        return visible_m(*self.found.scale, self.manifest.get("unit_m"))

    @property
    def uniform_queries(self) -> int:
        """Number of queries of an example, its last ones, that are uniform in the joint box."""
        return count_uniform(self.manifest, self.queries)

    def domain(self, margin: float = 0.15) -> Box:
        """Box in which segments occur, widened, as a ``Dataset`` has it."""
        return widened(torch.tensor(self.found.low), torch.tensor(self.found.high), margin)

    def surveyed(self, run_dir: Path, process: Process) -> "StreamingDataset":
        """The dataset with its survey, from the run's directory or made and kept there by process 0.

        Raises ``ValueError`` for a damaged shard, and where there are not as many examples as there should be.
        """
        kept = told(process, lambda: read_survey(run_dir, self.key, len(self.names)))
        if kept is None:
            kept = make_survey(self.read, len(self.names), process)
            with together(process):
                check_whole(self.directory, self.manifest, int(kept.sizes.sum()))
                if process.is_main:
                    write_survey(run_dir, self.key, kept)
        return replace(self, survey=kept)

    def read(self, number: int) -> Fields:
        """Tensors of a shard; ``ValueError`` where it is damaged or does not fit the first one."""
        name = self.names[number]
        path, recorded = self.directory / name, recorded_files(self.manifest).get(name)
        tensors = read_part(path, self.key, self.manifest.get("shard_size"), recorded)
        further = tensors["seen"].shape[1] if "seen" in tensors else 0
        shape = tensors["cloud"].shape[1], tensors["positions"].shape[1], further
        if shape != (self.points, self.queries, self.further):
            raise ValueError(
                f"{path} has {shape[0]} points, {shape[1]} queries and {shape[2]} further observations an example, the "
                f"first shard {self.points}, {self.queries} and {self.further}; they must be equal: delete it and "
                "run mereo generate ... --resume"
            )
        return tensors

    def first_queries(self, count: int) -> tuple[UInt8[np.ndarray, "e q"], Float32[np.ndarray, "e q"]]:
        """Labels and distances at all queries of the first ``count`` examples."""
        return self._at(np.arange(min(count, len(self)))).first_queries(count)

    def batch(
        self,
        index: Int[Tensor, " b"],
        points: int,
        queries: int,
        augment: AugmentConfig,
        draws: Draws,
        observation: Int[Tensor, " b"] | None = None,
    ) -> Batch:
        """Batch of the examples ``index`` as a ``Dataset`` makes it; fast for neighbours only."""
        return self._at(index.cpu().numpy()).batch(
            torch.arange(len(index)), points, queries, augment, draws, observation
        )

    def order(self, examples: int, batch: int, seed: int, world: int) -> StreamedOrder:
        """Order in which its first ``examples`` are learnt from, in batches that so many processes share."""
        return StreamedOrder(np.clip(examples - self.found.starts, 0, self.found.sizes), batch, seed, world)

    def pieces(self, order: Order, steps: range, rows: slice) -> Iterator[tuple[Dataset, Int[Tensor, " b"]]]:
        """For each step, a dataset of the examples that are read, ``rows`` of its batch, and their positions in it.

        ``order`` is this dataset's, and ``rows`` are whole lanes of it.
        """
        assert isinstance(order, StreamedOrder)
        lanes = range(rows.start // order.draws, rows.stop // order.draws)
        with closing(ReadAhead(order.blocks(lanes, steps), self.gather, lanes)) as ahead:
            for step in steps:
                parts = [ahead.take(lane, step * order.draws, order.draws) for lane in lanes]
                index = np.concatenate([numbers for numbers, _ in parts])
                fields = {name: torch.cat([part[name] for _, part in parts]) for name in parts[0][1]}
                yield self._piece(index, fields), torch.arange(len(index))

    def gather(self, index: Int64[np.ndarray, " b"], kept: Mapping[int, Fields] | None = None) -> Fields:
        """Examples of these numbers, in this order, from their shards: ``kept`` ones, or each read once."""
        shards = self._shards(index)
        gathered: Fields = {}
        for shard in np.unique(shards).tolist():
            rows = torch.from_numpy(np.flatnonzero(shards == shard))
            places = torch.from_numpy(index - self.found.starts[shard])[rows]
            for name, values in (kept[shard] if kept else as_fields(self.read(shard))).items():
                if name not in gathered:
                    gathered[name] = values.new_empty(len(index), *values.shape[1:])
                gathered[name][rows] = values[places]
        return gathered

    def _shards(self, index: Int64[np.ndarray, " b"]) -> Int64[np.ndarray, " b"]:
        """Shard of each example."""
        return np.searchsorted(self.found.starts, index, "right") - 1

    def _at(self, index: Int64[np.ndarray, " b"]) -> Dataset:
        """Dataset of a few examples, whose shards are kept for their neighbours."""
        for number in np.unique(self._shards(index)).tolist():
            self.recent[number] = self.recent.pop(number) if number in self.recent else as_fields(self.read(number))
        piece = self._piece(index, self.gather(index, self.recent))
        for number in list(self.recent)[:-KEPT]:
            del self.recent[number]
        return piece

    def _piece(self, index: Int64[np.ndarray, " b"], fields: Fields) -> Dataset:
        placed: dict[str, Any] = {name: values.to(self.device) for name, values in fields.items()}
        return Dataset(**placed, manifest=self.manifest, numbers=torch.from_numpy(index).to(self.device))
