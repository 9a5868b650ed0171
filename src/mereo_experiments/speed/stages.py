"""Stages of an answer, each timed against its floor and, where there is one, the straightforward implementation."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from torch import Tensor

from mereo.evaluation.sample_views import SampleView
from mereo.geometry.camera import Camera
from mereo.geometry.downsampling import farthest_point_order
from mereo.geometry.transforms import Normalizer
from mereo.models.config import MOST_ORDERED
from mereo.models.decoder import Code
from mereo.models.model import Model
from mereo.models.ops.neighbors import gpu_kernels
from mereo.models.trained import EncodedCloud, check_enough
from mereo.reconstruction.isosurfaces import (
    changing_cells,
    extract,
    extract_whole,
    locate,
    over_corners,
    sample_coarse_to_fine,
    sample_dense,
)
from mereo.reconstruction.pipeline import SEARCH_BOX
from mereo_experiments.speed.baseline import Rival
from mereo_experiments.speed.roofline import Machine, Work, count_operations, seconds


@dataclass(frozen=True)
class Stage:
    """Times of one stage in seconds.

    Attributes:
        name: what is done.
        median: median of our repetitions.
        slowest: their 99th percentile.
        floor: the least that this machine could take.
        rival: the straightforward implementation's median; None where it was not run.
        differing: share of a grid's nodes that it labels otherwise; None where there is none to compare.
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
        view: what it is asked about.
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
        """Times of all stages, in the order of an answer. Raises ``RuntimeError`` where the rival's labels differ."""
        self._warm_up()
        return [self.prepare(), self.encode(), self.queries(40_000), self.whole_frame(), self.labels(), self.surfaces()]

    def prepare(self) -> Stage:
        """Times from depth image to normalized points in farthest-point order."""
        cloud = self.view.depth.to_points()
        points, kept = len(cloud), self.model.network.config.points
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
        points, ours = random_points(self.view, count), self.ask(count)
        rival = partial(self._rival().logits, points) if self.rival else None
        if rival is not None:  # which is exact; what a lower precision changes is told apart
            exact = replace(self.model, precision="float32")
            self._compare(exact.logits(exact.encode(self.view.depth.to_points()), points), rival())
        return self._network_stage(f"{count // 1000}k queries", ours, rival)

    def ask(self, count: int) -> Callable[[], Float[np.ndarray, "n c"]]:
        """What ``queries`` times."""
        return partial(self.model.logits, self._code, random_points(self.view, count))

    def whole_frame(self) -> Stage:
        """Times from depth image to labels of 10,000 and then 40,000 points, as in the authors' follow-up.

        On CUDA by graphs of fixed shapes, which an autodecoder does not have.
        """
        coarse, fine = random_points(self.view, 10_000), random_points(self.view, 40_000)

        def plain() -> None:
            code = self.model.encode(self.view.depth.to_points())
            self.model.logits(code, coarse)
            self.model.logits(code, fine)

        ours = plain if self.model.device.type == "cpu" else self._by_graphs(coarse, fine)

        def straightforward() -> None:
            rival = self._rival()
            rival.logits(coarse)
            rival.logits(fine)

        name = "a frame: 10k + 40k queries"
        return self._network_stage(name, ours, straightforward if self.rival else None, counted=plain)

    def labels(self) -> Stage:
        """Times of the labels of the evaluation's grid, 100^3 cells."""
        grid = self.view.truth.grid
        x, y, z = grid.labels.shape
        field = partial(self.model.logits, self._code)

        def ours() -> UInt8[np.ndarray, "x y z"]:
            return sample_coarse_to_fine(field, grid.origin, grid.spacing, (x, y, z)).labels

        work = self._grid_work(ours())

        def straightforward() -> UInt8[np.ndarray, "x y z"]:
            return sample_dense(self._rival().logits, grid.origin, grid.spacing, (x, y, z)).labels

        return self._grid_stage(f"labels, {x} x {y} x {z}", work, ours, straightforward)

    def surfaces(self) -> Stage:
        """Times of closed meshes of all segments, 128 cells along the longest side, the search for the box included."""
        model = self.model
        field, search = partial(model.logits, self._code), self._code.normalizer.invert(SEARCH_BOX)

        def ours() -> UInt8[np.ndarray, "x y z"]:
            output = extract_whole(field, locate(field, search), 128, model.names, model.colors, model.nested)
            return output.grid.labels

        box = locate(field, search)

        def straightforward() -> UInt8[np.ndarray, "x y z"]:
            return extract(
                self._rival().logits, box, 128, model.names, model.colors, model.nested, dense=True
            ).grid.labels

        return self._grid_stage("surfaces of all segments, 128", self._grid_work(ours()), ours, straightforward)

    # --- parts ---------------------------------------------------------------------------------------------------

    @cached_property
    def _code(self) -> EncodedCloud:
        return self.model.encode(self.view.depth.to_points())

    def _by_graphs(
        self, coarse: Float[np.ndarray, "n 3"], fine: Float[np.ndarray, "m 3"]
    ) -> Callable[[], UInt8[np.ndarray, " m"]]:
        frames = StaticFrames(self.model, self.view.depth.camera, (len(coarse), len(fine)))

        def answer() -> UInt8[np.ndarray, " m"]:
            frames.see(self.view.depth.depth)
            frames.ask(coarse)
            return frames.ask(fine)[0]

        answer()  # records the graphs
        return answer

    def _warm_up(self) -> None:
        self.model.logits(self._code, random_points(self.view, 8192))

    def _input(self) -> tuple[torch.Tensor, Normalizer]:
        cloud, normalizer = self.model.normalized_cloud(self.view.depth.to_points())
        return cloud.to(self.model.device), normalizer

    def _rival(self) -> Rival:
        return Rival(self.model, *self._input())

    def _grid_work(self, labels: UInt8[np.ndarray, "x y z"]) -> Work:
        """Asking the corners of every cell that holds a change of label, and nothing else."""
        points = random_points(self.view, 4096)
        each = count_operations(lambda: self.model.logits(self._code, points)) / len(points)
        return Work(each * int(needed_nodes(labels).sum()), float(labels.nbytes))

    def _network_stage(
        self,
        name: str,
        ours: Callable[[], object],
        rival: Callable[[], object] | None = None,
        counted: Callable[[], object] | None = None,
    ) -> Stage:
        """``counted`` does the same operations in a way that can be counted; by default ``ours`` does."""
        weights = sum(parameter.nbytes for parameter in self.model.inference.parameters())
        return self._stage(name, Work(count_operations(counted or ours), float(weights)), ours, rival)

    def _grid_stage(
        self,
        name: str,
        work: Work,
        ours: Callable[[], UInt8[np.ndarray, "x y z"]],
        straightforward: Callable[[], UInt8[np.ndarray, "x y z"]],
    ) -> Stage:
        """Stage that labels a grid; the rival does so once, and its labels are compared."""
        if not self.rival:
            return self._stage(name, work, ours)
        theirs: list[UInt8[np.ndarray, "x y z"]] = []
        stage = self._stage(name, work, ours, lambda: theirs.append(straightforward()), once=True)
        return replace(stage, differing=_differing(ours(), theirs[0]))

    def _stage(
        self,
        name: str,
        work: Work,
        ours: Callable[[], object],
        rival: Callable[[], object] | None = None,
        once: bool = False,
    ) -> Stage:
        """Ours and the rival's take turns, so that a busy machine slows both."""
        mine, theirs, device = [], [], self.model.device
        for repeat in range(self.repeats):
            mine.append(seconds(ours, device))
            if rival is not None and not (once and repeat):
                theirs.append(seconds(rival, device))
        slowest = float(np.quantile(mine, 0.99))
        return Stage(
            name,
            statistics.median(mine),
            slowest,
            work.seconds(self.machine),
            statistics.median(theirs) if theirs else None,
        )

    @staticmethod
    def _compare(ours: Float[np.ndarray, "n c"], theirs: Float[np.ndarray, "n c"]) -> None:
        """Labels must agree wherever the leading class leads by more than rounding."""
        best = np.sort(theirs, axis=1)
        clear = best[:, -1] - best[:, -2] > 1e-3 * np.abs(theirs).max()
        wrong = int((ours.argmax(axis=1) != theirs.argmax(axis=1))[clear].sum())
        if wrong:
            raise RuntimeError(f"{wrong} of {len(ours)} labels differ between the model and the rival; they must agree")


def _differing(ours: UInt8[np.ndarray, "x y z"], theirs: UInt8[np.ndarray, "u v w"]) -> float | None:
    """Share of nodes with other labels; None for grids of other sizes, as where a box has grown."""
    return float((ours != theirs).mean()) if ours.shape == theirs.shape else None


def random_points(view: SampleView, count: int, seed: int = 0) -> Float[np.ndarray, "n 3"]:
    """Random points in the box of the object in a view."""
    grid = view.truth.grid
    return grid.origin + np.random.default_rng(seed).random((count, 3)) * grid.spacing * grid.labels.shape


def needed_nodes(labels: UInt8[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Whether each node is a corner of a cell whose corners do not all have one label."""
    around = np.pad(changing_cells(labels), 1)  # cells beyond the grid change nothing
    needed: np.ndarray = over_corners(around, np.logical_or)
    return needed


# --- CUDA graphs ------------------------------------------------------------------------------------------------------

# Answers to the depth images of one camera with shapes that never change, so that a GPU runs them as CUDA graphs.
#
# Launching the network's few hundred kernels one by one takes longer than running them. With fixed shapes the launches
# are recorded once and replayed: an image goes up, the labels come down, and nothing in between waits for the host. On
# a CPU the same steps run one by one, which is how they are tested.
#
# Notation: h x w pixels, n = h w, q queries.

SIZES = (4096, 10_000, 40_000)
"""Numbers of queries at once; what is asked is padded to the next of them."""

WARM_UPS = 3
"""Number of runs before recording, as PyTorch asks for: libraries set themselves up in the first ones."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Seen:
    """Encoded depth image, ready to be queried.

    Attributes:
        code: the network's side.
        center, scale: to normalized coordinates, ``(point - center) * scale``.
        count: of measured pixels.
    """

    code: Code
    center: Float[Tensor, "3"]
    scale: Float[Tensor, ""]
    count: Int[Tensor, ""]


class StaticFrames:
    """Answers of a model to the depth images of one camera, as CUDA graphs on a GPU.

    Args:
        model: any but an autodecoder, whose search needs gradients.
        camera: of all images, at most ``MOST_ORDERED`` pixels: crop a larger one around the object.
        sizes: numbers of queries that are prepared.

    Raises ``ValueError`` for other models and cameras, ``ImportError`` on CUDA without Triton.
    """

    def __init__(self, model: Model, camera: Camera, sizes: tuple[int, ...] = SIZES) -> None:
        pixels = camera.width * camera.height
        if pixels > MOST_ORDERED:
            raise ValueError(
                f"the image has {camera.width} x {camera.height} pixels; at most {MOST_ORDERED} fit into one program: "
                "crop it around the object, or use Model.encode"
            )
        if not sizes or min(sizes) < 1:
            raise ValueError(
                f"the sizes are {sizes}; at least one number of queries must be prepared: give for example 4096"
            )
        if model.network.config.encoder == "autodecoder":
            raise ValueError("an autodecoder searches for its code, which has no fixed shape: use Model.encode")
        if model.device.type == "cuda" and gpu_kernels() is None:
            raise ImportError("fixed frames on CUDA need triton, which PyTorch's builds for Linux bring: install it")
        self.model, self.camera, self.sizes = model, camera, tuple(sorted(sizes))
        self._rays = torch.from_numpy(camera.directions().reshape(-1, 3).astype(np.float32)).to(model.device)
        self._depth = _Buffer((pixels,), model.device)
        self._points = {size: _Buffer((size, 3), model.device) for size in self.sizes}
        self._steps: dict[int, Callable[[], tuple[Tensor, Tensor]]] = {}
        self._see: Callable[[], Seen] | None = None
        self._seen: Seen | None = None

    def see(self, depth: Float[np.ndarray, "h w"]) -> None:
        """Take the next image: depth in any unit, 0 where nothing was measured; does not wait for the device."""
        expected = (self.camera.height, self.camera.width)
        if depth.shape != expected:
            raise ValueError(f"the image is {depth.shape}; the camera's are {expected} (rows, columns): use its camera")
        self._depth.put(depth.reshape(-1))
        if self._see is None:
            self._see = self._prepared(lambda: self._observe(self._depth.on_device))
        self._seen = self._see()

    def ask(self, points: Float[np.ndarray, "q 3"]) -> tuple[UInt8[np.ndarray, " q"], Float32[np.ndarray, " q"]]:
        """Label and signed distance at each point, camera frame, the images' unit; waits for the device.

        Raises ``ValueError`` before the first image and where the object has too few pixels.
        """
        if self._seen is None:
            raise ValueError("there is no image to ask about: call see first")
        labels, distances = [], []
        largest = self.sizes[-1]
        for start in range(0, max(len(points), 1), largest):
            part = points[start : start + largest]
            output = self._ask(part, next(size for size in self.sizes if size >= len(part)))
            labels.append(output[0])
            distances.append(output[1])
        count = int(self._seen.count)
        check_enough(count, f"the object has {count} pixels")
        return np.concatenate(labels), np.concatenate(distances)

    # --- steps ---------------------------------------------------------------------------------------------------

    def _ask(self, points: Float[np.ndarray, "q 3"], size: int) -> tuple[np.ndarray, np.ndarray]:
        buffer = self._points[size]
        buffer.put(points)
        if size not in self._steps:
            self._steps[size] = self._prepared(lambda: self._query(buffer.on_device))
        labels, distances = self._steps[size]()
        return labels[: len(points)].cpu().numpy(), distances[: len(points)].cpu().numpy()

    def _observe(self, depth: Float[Tensor, " n"]) -> Seen:
        """What ``Model.encode`` does, without its loops and checks on the host."""
        valid = depth > 0
        points = self._rays * depth[:, None]
        low = points.masked_fill(~valid[:, None], torch.inf).amin(dim=0)
        high = points.masked_fill(~valid[:, None], -torch.inf).amax(dim=0)
        # without a pixel the box is inside out; numbers must stay numbers until the host has seen the count
        center, extent = ((low + high) / 2).nan_to_num(), (high - low).amax()
        scale = 2 / torch.where(extent > 0, extent, 2.0)
        normalized = ((points - center) * scale).masked_fill(~valid[:, None], 0.0)
        count, limit = valid.sum(), self.model.network.config.points
        order = _farthest(normalized, valid, limit)
        # fewer points than the network takes are repeated
        cloud = normalized[order[torch.arange(limit, device=depth.device) % count.clamp(1, limit)]]
        code = self.model.inference.encode(cloud[None], (-center * scale)[None])
        return Seen(code, center, scale, count)

    def _query(self, points: Float[Tensor, "q 3"]) -> tuple[UInt8[Tensor, " q"], Float[Tensor, " q"]]:
        assert self._seen is not None
        seen = self._seen
        queries = ((points - seen.center) * seen.scale)[None]
        logits, distance, _ = self.model.respond(self.model.inference.query(seen.code, queries), queries)
        return logits[0].argmax(dim=-1).to(torch.uint8), distance[0].float() / seen.scale

    def _prepared(self, work: Callable[[], T]) -> Callable[[], T]:
        """The work as one CUDA graph, whose results are always the same tensors; on a CPU the work itself."""

        def run() -> T:
            with self.model.answering():
                return work()

        if self.model.device.type != "cuda":
            return run
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(WARM_UPS):
                run()
        torch.cuda.current_stream().wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = run()

        def replay() -> T:
            graph.replay()
            return result

        return replay


class _Buffer:
    """A tensor on the device that is filled from the host without waiting: by way of page-locked memory."""

    def __init__(self, shape: tuple[int, ...], device: torch.device) -> None:
        self.on_device = torch.zeros(shape, device=device)
        self._staged = torch.zeros(shape, pin_memory=device.type == "cuda")
        self._copied = torch.cuda.Event() if device.type == "cuda" else None

    def put(self, values: Float[np.ndarray, "..."]) -> None:
        """The first rows; what was in the others stays."""
        if self._copied is not None:
            self._copied.synchronize()  # the copy before may still be reading
        self._staged[: len(values)].numpy()[...] = values
        self.on_device.copy_(self._staged, non_blocking=True)
        if self._copied is not None:
            self._copied.record()


def _farthest(points: Float[Tensor, "n 3"], valid: Bool[Tensor, " n"], count: int) -> Int[Tensor, " m"]:
    """Rows of valid points in farthest-point order; ties to the earlier pixel on CUDA, and by place on a CPU."""
    if points.is_cuda:
        kernels = gpu_kernels()
        assert kernels is not None
        order: Tensor = kernels.farthest_points(points[None], valid[None], count)[0]
        return order
    rows = np.flatnonzero(valid.numpy())
    output = rows[farthest_point_order(points.numpy()[rows], count)]
    return torch.from_numpy(np.resize(output, count) if len(output) else np.zeros(count, np.int64))
