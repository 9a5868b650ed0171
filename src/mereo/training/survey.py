"""Survey of a dataset that is not in memory: what only all of its shards can tell, found in one pass over them.

It is kept in the run's directory, so that a run that is continued reads shards for learning only. Every byte is read
for it: a damaged shard is found before the first step. Processes share the pass.

Notation: s shards.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from jaxtyping import Float64, Int64
from torch import Tensor

from mereo.io.atomic_files import write_json
from mereo.io.progress import progress
from mereo.training.dataset import occupied_box
from mereo.training.processes import Process, collective_device, together

FILE = "survey.json"

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Survey:
    """What all shards together tell.

    Attributes:
        runs: numbers of examples of the shards in their order, as (so many shards, examples of each).
        low: lower corner of the box of all queries that are in a segment, normalized.
        high: its upper corner.
        scale: least and greatest scale of the normalizers, one over half the longest visible side.
    """

    runs: tuple[tuple[int, int], ...]
    low: Corner
    high: Corner
    scale: tuple[float, float]

    @cached_property
    def sizes(self) -> Int64[np.ndarray, " s"]:
        """Number of examples of each shard."""
        counts, sizes = np.array(self.runs, dtype=np.int64).T
        return np.repeat(sizes, counts)

    @cached_property
    def starts(self) -> Int64[np.ndarray, " s"]:
        """First example of each shard."""
        return np.cumsum(self.sizes) - self.sizes


def make_survey(read: Callable[[int], dict[str, Tensor]], shards: int, process: Process) -> Survey:
    """Survey of so many shards, of which each process reads its part.

    Args:
        read: the tensors of a shard by its number, checked.
        shards: how many there are.
        process: this one.

    Raises what ``read`` does, in the process that met it; the others end without a word.
    """
    device = collective_device(process)
    sizes = torch.zeros(shards, dtype=torch.int64, device=device)
    # the least of all of: lower corner, minus the upper corner, scale, minus scale
    least = torch.full((8,), torch.inf, dtype=torch.float64, device=device)
    mine = range(process.rank, shards, process.world)
    with together(process), progress("survey", len(mine), "shards", quiet=not process.is_main) as shown:
        for number in mine:
            tensors = read(number)
            sizes[number] = len(tensors["cloud"])
            least = torch.minimum(least, _least(tensors).to(device))
            shown.advance()
    if process.world > 1:
        dist.all_reduce(sizes)
        dist.all_reduce(least, dist.ReduceOp.MIN)
    low, high, (small, large) = least[:3].tolist(), (-least[3:6]).tolist(), (least[6].item(), -least[7].item())
    runs = tuple((len(list(group)), size) for size, group in groupby(sizes.tolist()))
    return Survey(runs, (low[0], low[1], low[2]), (high[0], high[1], high[2]), (small, large))


def _least(tensors: dict[str, Tensor]) -> Float64[Tensor, "8"]:
    """What of one shard is compared with the others."""
    scale = tensors["scale"]
    ends = torch.stack([scale.min(), -scale.max()]).double()
    if not (tensors["labels"] > 0).any():
        return torch.cat([torch.full((6,), torch.inf, dtype=torch.float64), ends])
    low, high = occupied_box(tensors["positions"], tensors["labels"])
    return torch.cat([low.double(), -high.double(), ends])


def read_survey(run_dir: Path, dataset: str, shards: int) -> Survey | None:
    """Survey that a run's directory holds of the dataset with this key; None where there is none that fits."""
    try:
        found = json.loads((run_dir / FILE).read_text("utf-8"))
        if found.pop("dataset") != dataset:
            return None
        (x0, y0, z0), (x1, y1, z1), (least, most) = (map(float, found[name]) for name in ("low", "high", "scale"))
        runs = tuple((int(count), int(size)) for count, size in found["runs"])
        survey = Survey(runs, (x0, y0, z0), (x1, y1, z1), (least, most))
        return survey if len(survey.sizes) == shards else None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError):
        return None  # it is made again


def write_survey(run_dir: Path, dataset: str, survey: Survey) -> None:
    """Keep a survey of the dataset with this key in a run's directory."""
    write_json(run_dir / FILE, {"dataset": dataset, **asdict(survey)})
