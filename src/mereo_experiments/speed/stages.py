"""Stages of an answer, each timed against its floor and, where there is one, the straightforward implementation.

The floor (roofline) is the least time that a stage can take here, by the measured rates of large products and of
copies. The straightforward implementation of the same network is what one writes first: float32, eager; the code is
concatenated to every query instead of being multiplied once per cloud; normalization is a layer of its own; farthest
points are sampled inside the network, and the encoder is run again for every chunk of queries. It takes its weights
from a model and gives its labels. Nearest neighbours, which only local features need, are found as in the model itself.
"""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from mereo.geometry.marching_cubes import changing_cells, over_corners
from mereo.geometry.transforms import Normalizer
from mereo.models.decoder import Code, Decoder, Prediction, line_of_sight
from mereo.models.device import linear
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.trained import EncodedCloud
from mereo.reconstruction.isosurfaces import (
    extract,
    extract_whole,
    locate,
    sample_coarse_to_fine,
    sample_dense,
)
from mereo.reconstruction.pipeline import SEARCH_BOX
from mereo.synthesis.sample_views import SampleView

# --- the floor --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Machine:
    """Measured rates of a machine.

    Attributes:
        operations: floating-point operations per second.
        bandwidth: bytes per second.
    """

    operations: float
    bandwidth: float


@dataclass(frozen=True)
class Work:
    """Work that a stage must do at least.

    Attributes:
        operations: floating-point operations of matrix products, two for a multiplication with addition.
        bytes: bytes that are read and written at least once.
    """

    operations: float
    bytes: float

    def seconds(self, machine: Machine) -> float:
        """Least time on a machine that does both at once: the longer of the two."""
        return max(self.operations / machine.operations, self.bytes / machine.bandwidth)


def _operations_of_linear(rows: Sequence[int], weight: Sequence[int], *_: object, **__: object) -> int:
    """Floating-point operations of a product of these shapes."""
    return 2 * math.prod(rows) * weight[0]


ONEDNN = {torch.ops.mkldnn._linear_pointwise: _operations_of_linear}
"""Products of ``mereo.models.device`` that torch's counter does not know."""


def timed(work: Callable[[], Any], device: torch.device) -> tuple[float, Any]:
    """Seconds that ``work`` takes, until the device is done, and its result."""
    start = time.perf_counter()
    result = work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start, result


def measure_machine(device: torch.device, dtype: torch.dtype = torch.float32) -> Machine:
    """Rates of a machine: of a product of 4096 x 512 by 512 x 512 and of copying 256 MB, each the median of 15."""
    left, right = torch.ones(4096, 512, device=device, dtype=dtype), torch.ones(512, 512, device=device, dtype=dtype)
    source = torch.ones(64 * 2**20, device=device)
    target = torch.empty_like(source)
    with torch.inference_mode():
        product = _median(lambda: linear(left, right), device)
    copied = _median(lambda: target.copy_(source), device)
    return Machine(2 * left.numel() * right.shape[0] / product, 2 * source.nbytes / copied)


def _median(work: Callable[[], object], device: torch.device, repeats: int = 15) -> float:
    return statistics.median([timed(work, device)[0] for _ in range(repeats + 2)][2:])


def count_operations(work: Callable[[], object]) -> int:
    """Number of floating-point operations in the matrix products that ``work`` asks torch for."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the counter sees what its own thread asks for
    try:
        with FlopCounterMode(display=False, custom_mapping=ONEDNN) as counter:
            work()
    finally:
        torch.set_num_threads(threads)
    return counter.get_total_flops()


# --- the straightforward implementation -------------------------------------------------------------------------------

CHUNK = 50_000
"""Number of queries that are answered at once."""


class Rival:
    """Straightforward implementation of a model's answers about one cloud.

    Attributes:
        model: the model whose weights are taken.
        cloud: normalized points of the cloud, in any order.
        normalizer: the way from the user's frame to normalized coordinates.
        viewpoint: the normalized place of the camera.
    """

    def __init__(self, model: Model, cloud: Float[Tensor, "1 n 3"], normalizer: Normalizer) -> None:
        self.model, self.cloud, self.normalizer = model, cloud, normalizer
        self.viewpoint = torch.from_numpy(normalizer.viewpoint[None].astype(np.float32)).to(cloud.device)

    @torch.inference_mode()
    def logits(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n c"]:
        """Class logits at points in the user's frame, chunk by chunk."""
        normalized = self.normalizer.apply(points).astype(np.float32)
        chunks = []
        for start in range(0, len(normalized), CHUNK):
            queries = torch.from_numpy(normalized[start : start + CHUNK])[None].to(self.cloud.device)
            spread = self.model.class_logits(self._predict(self.model.network, queries), queries)
            chunks.append(spread[0].cpu())
        return torch.cat(chunks).numpy()

    def _predict(self, network: Network, queries: Float[Tensor, "1 q 3"]) -> Prediction:
        count = int(self.cloud.shape[1] * network.config.pointnet2.ratio1)
        first = farthest_points(self.cloud[0], count)
        rest = torch.ones(self.cloud.shape[1], dtype=torch.bool, device=first.device)
        rest[first] = False
        ordered = torch.cat([self.cloud[:, first], self.cloud[:, rest]], dim=1)
        alignment = None if network.aligner is None else network.aligner(ordered).alignment
        encoding = network.encoder(ordered if alignment is None else alignment.apply(ordered))
        code = network.decoder.prepare(encoding, ordered, self.viewpoint, alignment)
        return decode(network.decoder, code, encoding.latent, queries)


def farthest_points(points: Float[Tensor, "n 3"], count: int) -> Int[Tensor, " m"]:
    """Rows of points by greedy farthest-point sampling from the first one on; repeated points come last."""
    distance = torch.full((len(points),), torch.inf, device=points.device)
    chosen = [torch.zeros((), dtype=torch.long, device=points.device)]
    while len(chosen) < count:
        distance = torch.minimum(distance, (points - points[chosen[-1]]).square().sum(dim=-1))
        distance[chosen[-1]] = -1.0  # where points are repeated, each is still taken once
        chosen.append(distance.argmax())
    return torch.stack(chosen)


def decode(decoder: Decoder, code: Code, latent: Float[Tensor, "1 z"], queries: Float[Tensor, "1 q 3"]) -> Prediction:
    """Prediction as of ``Decoder.forward``, with the latent vector at every query; the layers are the decoder's own."""
    layers, added = decoder.config.decoder, decoder.config.additions
    everywhere = latent[:, None].expand(-1, queries.shape[1], -1)
    placed = queries if code.alignment is None else code.alignment.apply(queries)
    encoded = decoder.encode(placed) if layers.encode_positions else placed
    rows = [everywhere, encoded]
    if added.local_neighbors:
        rows += [layer(level, placed) for layer, level in zip(decoder.local, code.levels, strict=True)]
    if added.sight_neighbors:
        rows.append(line_of_sight(queries, code.cloud, code.viewpoint, added.sight_neighbors))
    hidden = encoded
    for number, norm in enumerate(decoder.norms):
        if number > 0:
            rows = [hidden]
        if number == layers.skip_after:
            rows += [everywhere, encoded]
            if decoder.lookup is not None:
                rows.append(decoder.lookup(hidden, placed)[1])
        local_layers = decoder.summands(number)
        weight = torch.cat([layer.weight for layer in local_layers], dim=1)
        hidden = nn.functional.linear(torch.cat(rows, dim=-1), weight, local_layers[0].bias)
        hidden = torch.relu(norm(hidden.flatten(0, 1))).unflatten(0, hidden.shape[:2])
    logits, distance, direction = decoder.head(hidden).split([decoder.classes, 1, 3], dim=-1)
    return Prediction(logits, distance[..., 0], direction)


# --- stages -----------------------------------------------------------------------------------------------------------


Labels = UInt8[np.ndarray, "x y z"]


@dataclass(frozen=True)
class Stage:
    """Times of one stage in seconds.

    Attributes:
        name: what is done.
        median: median of our repetitions.
        slowest: their 99th percentile.
        floor: the least that this machine could take.
        rival: the straightforward implementation's median; None where it was not run.
        differing: share of points that it labels otherwise; None where there is none to compare.
    """

    name: str
    median: float
    slowest: float
    floor: float
    rival: float | None = None
    differing: float | None = None

    @property
    def ratio(self) -> float | None:
        """Ratio of the rival's time to ours: how many times faster we are; None where it was not run."""
        return None if self.rival is None else self.rival / self.median


@dataclass(frozen=True)
class Bench:
    """Timing of all stages of one model's answer about one view.

    Attributes:
        model: the model.
        view: where it is queried.
        machine: measured rates, from which floors follow.
        repeats: repetitions of each stage; the rival's grids run once.
        rival: whether to time the straightforward implementation too, and to compare its labels.
    """

    model: Model
    view: SampleView
    machine: Machine
    repeats: int = 7
    rival: bool = False

    def run(self) -> list[Stage]:
        """Times of all stages, in the order of an answer."""
        self.model.logits(self._code, random_points(self.view, 8192))  # the first one prepares
        return [self.prepare(), self.encode(), self.queries(40_000), self.whole_frame(), self.labels(), self.surfaces()]

    def prepare(self) -> Stage:
        """Times from depth image to normalized points in farthest-point order."""
        cloud = self.view.depth.to_points()
        points = len(cloud)
        kept = self.model.network.config.points
        # each chosen point is compared with all: differences, squares, sums and the smaller distance
        work = Work(operations=9.0 * points * min(points, kept), bytes=float(self.view.depth.depth.nbytes))
        return self._stage("preprocessing", work, lambda: self.model.normalized_cloud(self.view.depth.to_points()))

    def encode(self) -> Stage:
        """Times of the network's encoder, without preprocessing."""
        cloud, normalizer = self._input()
        viewpoint = torch.from_numpy(normalizer.viewpoint[None].astype(np.float32)).to(self.model.device)
        with torch.inference_mode():
            return self._network_stage("encoder", lambda: self.model.inference.encode(cloud, viewpoint))

    def queries(self, count: int) -> Stage:
        """Times of class logits at random points of the object's box."""
        points = random_points(self.view, count)
        rival = partial(self._rival().logits, points) if self.rival else None
        return self._network_stage(f"{count // 1000}k queries", partial(self.model.logits, self._code, points), rival)

    def whole_frame(self) -> Stage:
        """Times from depth image to labels of 10,000 and then 40,000 points, as in the authors' follow-up."""
        coarse, fine = random_points(self.view, 10_000), random_points(self.view, 40_000)

        def ours() -> None:
            code = self.model.encode(self.view.depth.to_points())
            self.model.logits(code, coarse)
            self.model.logits(code, fine)

        def straightforward() -> None:
            rival = self._rival()
            rival.logits(coarse)
            rival.logits(fine)

        name = "a frame: 10k + 40k queries"
        return self._network_stage(name, ours, straightforward if self.rival else None)

    def labels(self) -> Stage:
        """Times of the labels of the evaluation's grid, 100^3 cells."""
        grid = self.view.truth.grid
        x, y, z = grid.labels.shape
        field = partial(self.model.logits, self._code)

        def ours() -> Labels:
            return sample_coarse_to_fine(field, grid.origin, grid.spacing, (x, y, z)).labels

        def straightforward() -> Labels:
            return sample_dense(self._rival().logits, grid.origin, grid.spacing, (x, y, z)).labels

        return self._grid_stage(f"labels, {x} x {y} x {z}", ours, straightforward)

    def surfaces(self) -> Stage:
        """Times of closed meshes of all segments, 128 cells along the longest side, the search for the box included."""
        model = self.model
        field = partial(model.logits, self._code)
        search = self._code.normalizer.invert(SEARCH_BOX)
        parts = model.names, model.colors, model.nested
        box = locate(field, search)

        def ours() -> Labels:
            return extract_whole(field, locate(field, search), 128, *parts).grid.labels

        def straightforward() -> Labels:
            return extract(self._rival().logits, box, 128, *parts, dense=True).grid.labels

        return self._grid_stage("surfaces of all segments, 128", ours, straightforward)

    # --- parts ---------------------------------------------------------------------------------------------------

    @cached_property
    def _code(self) -> EncodedCloud:
        return self.model.encode(self.view.depth.to_points())

    def _input(self) -> tuple[torch.Tensor, Normalizer]:
        cloud, normalizer = self.model.normalized_cloud(self.view.depth.to_points())
        return cloud.to(self.model.device), normalizer

    def _rival(self) -> Rival:
        return Rival(self.model, *self._input())

    def _network_stage(self, name: str, ours: Callable[[], Any], rival: Callable[[], Any] | None = None) -> Stage:
        """Stage of operations that the network's products can be counted for."""
        weights = sum(parameter.nbytes for parameter in self.model.inference.parameters())
        return self._stage(name, Work(count_operations(ours), float(weights)), ours, rival)

    def _grid_stage(self, name: str, ours: Callable[[], Labels], straightforward: Callable[[], Labels]) -> Stage:
        """Stage that labels a grid: its floor asks the corners of every cell that holds a change, and nothing else."""
        labels = ours()
        points = random_points(self.view, 4096)
        each = count_operations(lambda: self.model.logits(self._code, points)) / len(points)
        work = Work(each * int(needed_nodes(labels).sum()), float(labels.nbytes))
        return self._stage(name, work, ours, straightforward if self.rival else None, once=True)

    def _stage(
        self,
        name: str,
        work: Work,
        ours: Callable[[], Any],
        rival: Callable[[], Any] | None = None,
        once: bool = False,
    ) -> Stage:
        """Ours and the rival's take turns, so that a busy machine slows both; with ``once`` the rival has one."""
        mine = []
        theirs = []
        device = self.model.device
        answer = other = None
        for repeat in range(self.repeats):
            spent, answer = timed(ours, device)
            mine.append(spent)
            if rival is not None and not (once and repeat):
                spent, other = timed(rival, device)
                theirs.append(spent)
        slowest = float(np.quantile(mine, 0.99))
        median = statistics.median(theirs) if theirs else None
        floor = work.seconds(self.machine)
        return Stage(name, statistics.median(mine), slowest, floor, median, _differing(answer, other))


def _differing(ours: Any, theirs: Any) -> float | None:
    """Share of other labels, of logits too; None for grids of other sizes, as where a box has grown."""
    if ours is None or theirs is None or ours.shape != theirs.shape:
        return None
    if ours.dtype.kind == "f":
        ours = ours.argmax(axis=1)
        theirs = theirs.argmax(axis=1)
    return float((ours != theirs).mean())


def random_points(view: SampleView, count: int, seed: int = 0) -> Float[np.ndarray, "n 3"]:
    """Random points in the box of the object in a view."""
    grid = view.truth.grid
    return grid.origin + np.random.default_rng(seed).random((count, 3)) * grid.spacing * grid.labels.shape


def needed_nodes(labels: UInt8[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Whether each node is a corner of a cell whose corners do not all have one label."""
    around = np.pad(changing_cells(labels), 1)  # cells beyond the grid change nothing
    needed: np.ndarray = over_corners(around, np.logical_or)
    return needed
