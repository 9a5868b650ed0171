"""Stages of an answer, each timed against its floor and, where there is one, the straightforward implementation."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from mereo.geometry.transforms import Normalizer
from mereo.models.model import Model
from mereo.models.trained import EncodedCloud
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
from mereo.synthesis.sample_views import SampleView
from mereo_experiments.speed.baseline import Rival
from mereo_experiments.speed.roofline import Machine, Work, count_operations, timed

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
        """Times of all stages, in the order of an answer."""
        self.model.logits(self._code, random_points(self.view, 8192))  # the first one prepares
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
        field, search = partial(model.logits, self._code), self._code.normalizer.invert(SEARCH_BOX)
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
        labels, points = ours(), random_points(self.view, 4096)
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
        mine, theirs, device = [], [], self.model.device
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


def _differing(ours: np.ndarray | None, theirs: np.ndarray | None) -> float | None:
    """Share of other labels, of logits too; None for grids of other sizes, as where a box has grown."""
    if ours is None or theirs is None or ours.shape != theirs.shape:
        return None
    if ours.dtype.kind == "f":
        ours, theirs = ours.argmax(axis=1), theirs.argmax(axis=1)
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
