"""One test case scored by itself, wherever that is done, and the set of them put together.

    case(i) -Scoring-> ScoredCase -evaluation_of-> Evaluation

What a case leaves is small, so cases may be scored anywhere; they are put together in their order, so that sums are the
same bits wherever each one comes from.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.recognition import Known
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.uncertainty import LEVEL, RadiusParts
from mereo.geometry.brief import counted, listed
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import NoFit
from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import Color
from mereo.geometry.metrics import (
    Scores,
    TruthGrid,
    grid_confusion,
    intersection_over_union,
    with_segments_exchanged,
)
from mereo.geometry.solids import label_grid
from mereo.geometry.symmetry import STEP, Symmetry
from mereo.geometry.transforms import Points, Transform, Vector, transform_points
from mereo.models.trained import EncodedCloud, Trained
from mereo.reconstruction.isosurfaces import sample_coarse_to_fine
from mereo.reconstruction.observation import observe
from mereo.reconstruction.pipeline import segment_names
from mereo.scenes.statistical_model import StatisticalModel

# --- errors of a registration, and their radii ------------------------------------------------------------------------


def nearest_truth(model: StatisticalModel, answer: Float[np.ndarray, "m 3"], truth: Points) -> Points:
    """Choose the true positions of material points that an answer is nearest to, of those that no frame tells apart.

    Of an object that looks the same turned, a place of the answer is as right where the true object has its turned
    place; where any angle looks the same, by that which brings it nearest to the answer. Turns about any axis are not
    tried, and of a part of the material points the positions are those given.
    """
    if len(truth) < len(model.rest_points):
        return truth
    truths = [truth]
    for symmetry in model.symmetries:
        if symmetry.axis is not None and None not in symmetry.lands_on:
            turn = symmetry.turn if symmetry.angle is not None else _nearest_turn(model, symmetry, answer, truth)
            truths.append(_turned(model, symmetry, turn, truth))
    return min(truths, key=lambda each: float(np.median(np.linalg.norm(answer - each, axis=1))))


def _turned(
    model: StatisticalModel,
    symmetry: Symmetry,
    turn: Transform,
    truth: Float[np.ndarray, "m 3"],
    rows: slice | Int[np.ndarray, " n"] = slice(None),
) -> Points:
    """Places in the true object to which a turn at rest brings material points."""
    landing = np.array([index for index in symmetry.lands_on if index is not None])
    labels = (landing[model.labels[rows] - 1] + 1).astype(np.uint8)
    return model.weights(transform_points(turn, model.rest_points[rows]), labels)(truth)


def _nearest_turn(
    model: StatisticalModel, symmetry: Symmetry, answer: Float[np.ndarray, "m 3"], truth: Float[np.ndarray, "m 3"]
) -> Transform:
    """The turn about the axis of a symmetry by any angle that brings the true places nearest to an answer."""
    axis = symmetry.axis
    assert axis is not None
    middle = np.linalg.lstsq(np.eye(3) - symmetry.turn[:3, :3], symmetry.turn[:3, 3], rcond=1e-6)[0]

    def turn(angle: float) -> Transform:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
        T[:3, 3] = middle - T[:3, :3] @ middle
        return T

    def off(angle: float) -> float:
        places = _turned(model, symmetry, turn(angle), truth, model.sparse)
        return float(np.median(np.linalg.norm(answer[model.sparse] - places, axis=1)))

    start = min(np.arange(0.0, 2 * np.pi, STEP), key=off)
    return turn(minimize_scalar(off, bounds=(start - STEP, start + STEP), method="bounded").x)


def seen_points(truth: Float[np.ndarray, "m 3"], cloud: PointCloud, scene_unit: float) -> Bool[np.ndarray, " m"]:
    """Which material points a cloud shows: those whose true positions are within 1.5 scene units of an observed one."""
    near: Bool[np.ndarray, " m"] = cKDTree(cloud.points).query(truth)[0] <= 1.5 * scene_unit
    return near


@dataclass(frozen=True, eq=False)
class RegistrationErrors:
    """Distances of registered material points from their true positions, and the radii that they have.

    Attributes:
        distances: scene units.
        ratios: factor of the posterior's Gaussian radius with which the true position lies on the rim of the whole one;
            0 where it lies within in any case.
        gaussian: these radii, scene units.
        open: ``RadiusParts.open``, whose squares are added.
        reach: ``RadiusParts.reach``, which is added to all.
        seen: which of the points the cloud shows.
        calibrated: whether the radii are.
    """

    distances: Float[np.ndarray, " n"]
    ratios: Float[np.ndarray, " n"]
    gaussian: Float[np.ndarray, " n"]
    open: Float[np.ndarray, " n"]
    reach: Float[np.ndarray, " n"]
    seen: Bool[np.ndarray, " n"]
    calibrated: bool = False

    @classmethod
    def of(
        cls,
        registration: Registration,
        truth: Float[np.ndarray, "m 3"],
        seen: Bool[np.ndarray, " m"],
        scene_unit: float,
    ) -> "RegistrationErrors":
        """Errors of one view, with the radii that its registration has, calibrated if the weights are.

        Args:
            registration: fitted, not read from a file.
            truth: true positions of its material points, vertices and interior ones, or of the first of them, in its
                frame and unit.
            seen: which of these the cloud shows (``seen_points``).
            scene_unit: true length of a scene unit in that unit, which the registration may have estimated.

        Raises ``ValueError`` for a registration without an optimum.
        """
        sure = registration.uncertainty
        if sure is None:
            raise ValueError("the registration was read from a file, which has no posterior: fit its frame again")
        count = len(truth)
        unit = sure.optimum.unit / registration.scene_unit
        distances = np.linalg.norm(registration.material[:count] - truth, axis=1)
        off = distances / registration.scene_unit
        gaussian, open, reach = (
            unit * part[:count] for part in (sure.parts.gaussian, sure.parts.open, sure.parts.reach)
        )
        ratios = np.sqrt(np.maximum(np.maximum(off - reach, 0.0) ** 2 - open**2, 0.0)) / gaussian
        errors = cls(distances / scene_unit, ratios, gaussian, open, reach, seen, registration.radius_scale is not None)
        return errors.scaled(sure.factor)

    @classmethod
    def together(cls, each: Sequence["RegistrationErrors"]) -> "RegistrationErrors":
        """Errors of several views, every point counted once; calibrated where all of them are."""
        names = ("distances", "ratios", "gaussian", "open", "reach", "seen")
        columns = {name: np.concatenate([getattr(view, name) for view in each]) for name in names}
        return cls(**columns, calibrated=all(view.calibrated for view in each))

    @property
    def radii(self) -> Float[np.ndarray, " n"]:
        """Radii of all points, scene units."""
        return RadiusParts(self.gaussian, self.open, self.reach).radii()

    def scale(self) -> float:
        """Factor of the Gaussian's radii that holds 95 % of the true positions: ``Calibration.radius_scale``."""
        return float(np.quantile(self.ratios, LEVEL))

    def scaled(self, scale: float | None) -> "RegistrationErrors":
        """The same with the Gaussian's radii times a scale, where there is one."""
        return self if scale is None else replace(self, ratios=self.ratios / scale, gaussian=self.gaussian * scale)

    def summary(self, unit_mm: float | None) -> dict[str, dict[str, float | None]]:
        """Median and 95 % quantile of seen and of hidden points' distances, in scene units, and in mm where known."""
        return {
            name: {
                "median": _quantile(self.distances[rows], 0.5),
                "p95": _quantile(self.distances[rows], 0.95),
                "median_mm": _quantile(self.distances[rows], 0.5, unit_mm),
                "p95_mm": _quantile(self.distances[rows], 0.95, unit_mm),
            }
            for name, rows in (("seen", self.seen), ("hidden", ~self.seen))
        }

    def coverage(self, unit_mm: float | None = None) -> dict[str, float | bool | None]:
        """Share of the true positions within the radii, and how large these are.

        Of ``all``, ``seen`` and ``hidden`` points (None where there are none), with the medians of the radii in scene
        units, and in mm where ``unit_mm``, millimetres per scene unit, is known; and whether they are calibrated.
        """
        parts = {"all": np.ones(len(self.seen), dtype=bool), "seen": self.seen, "hidden": ~self.seen}
        result: dict[str, float | bool | None] = {
            name: float((self.ratios[rows] <= 1.0).mean()) if rows.any() else None for name, rows in parts.items()
        }
        for name in ("seen", "hidden"):
            median = float(np.median(self.radii[parts[name]])) if parts[name].any() else None
            result[f"radius_{name}"] = median
            result[f"radius_{name}_mm"] = None if median is None or unit_mm is None else median * unit_mm
        return {**result, "calibrated": self.calibrated}


def _quantile(values: Float[np.ndarray, " n"], share: float, factor: float | None = 1.0) -> float | None:
    """Quantile of values times a factor; None without values, and without a factor."""
    return None if len(values) == 0 or factor is None else float(np.quantile(values, share)) * factor


# --- reliability of probabilities -------------------------------------------------------------------------------------

# The expected calibration error (Naeini et al., AAAI 2015; Guo et al., ICML 2017) is the mean distance of the share of
# right answers from their confidence, over bins of equal width, weighed by how many answers fall into each. Confidence
# is the probability of the answered label, over the cells of the paper's metric (``geometry.metrics``).

BINS = 15
"""Bins of equal width, as in the papers."""

SAMPLED_CELLS = 20_000
"""Cells of a view at which the network is evaluated, evenly drawn: all would take longer than the evaluation."""


def sample_cells(truth: TruthGrid, count: int = SAMPLED_CELLS) -> tuple[Points, UInt8[np.ndarray, " n"]]:
    """Centres and true labels of at most ``count`` of the cells that count, the same ones every time."""
    kept = np.argwhere(truth.kept)
    if len(kept) > count:
        kept = kept[np.sort(np.random.default_rng(0).choice(len(kept), count, replace=False))]
    return truth.grid.positions(kept), truth.grid.labels[tuple(kept.T)]


@dataclass
class Reliability:
    """Answers counted by their confidence.

    Attributes:
        bins: of each bin how many answers it has, the sum of their confidence, and how many are right.
    """

    bins: Float[np.ndarray, "3 b"] = field(default_factory=lambda: np.zeros((3, BINS)))

    @classmethod
    def of_view(cls, model: Trained, code: EncodedCloud, truth: TruthGrid) -> "Reliability":
        """Answers of a network about a view; one that tells no segments apart is scored for the whole."""
        points, labels = sample_cells(truth)
        answer = model.query(code, points)
        result = cls()
        right = answer.label == np.minimum(labels, answer.probability.shape[1] - 1)
        result.add(answer.probability[np.arange(len(right)), answer.label].astype(np.float64), right)
        return result

    def add(self, confidence: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> None:
        """Count further answers, by the probability of what was answered and whether that is right."""
        index = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
        weights = (np.ones(len(index)), confidence, right)
        self.bins += [np.bincount(index, weights=each, minlength=BINS) for each in weights]

    @property
    def ece(self) -> float:
        """Expected calibration error, 0 to 1; NaN without answers."""
        count, confidence, right = self.bins
        total = count.sum()
        return float(np.abs(right - confidence).sum() / total) if total else float("nan")

    def facts(self) -> list[dict[str, Any]]:
        """Bins that have answers: their share of all, mean confidence and share of right ones."""
        total = self.bins[0].sum()
        filled = self.bins[:, self.bins[0] > 0]
        names = ("share", "confidence", "right")
        return [
            dict(zip(names, map(float, row), strict=True))
            for row in zip(filled[0] / total, filled[1] / filled[0], filled[2] / filled[0], strict=True)
        ]


# --- answers to a test case -------------------------------------------------------------------------------------------


def network_labels(model: Trained, code: EncodedCloud, grid: LabelGrid) -> UInt8[np.ndarray, "x y z"]:
    """Labels by the network at the voxels of a grid, evaluated coarse to fine."""
    x, y, z = grid.labels.shape

    def logits(points: Points) -> Float[np.ndarray, "n c"]:
        return model.logits(code, points)

    return sample_coarse_to_fine(logits, grid.origin, grid.spacing, (x, y, z)).labels


# --- results of a test set --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class EvaluatedView:
    """View with its true and its predicted labels: a row of the paper's figure of reconstructions.

    Attributes:
        name: label at the left of the row.
        cloud: what the model was given.
        reference: true labels; 0 is empty space.
        predicted: labels by the model, on the same grid.
        origin: centre of voxel [0, 0, 0] in the cloud's frame; that of [i, j, k] is ``origin + [i, j, k] * spacing``.
        spacing: distances of the voxels' centres along each axis.
        colors: colours of the segments; label k has ``colors[k - 1]``.
    """

    name: str
    cloud: PointCloud
    reference: UInt8[np.ndarray, "x y z"]
    predicted: UInt8[np.ndarray, "x y z"]
    origin: Vector
    spacing: Vector
    colors: Sequence[Color]


TimedConfusion = tuple[Int[np.ndarray, "c c"], float]
"""Confusion matrix of a test case, and the seconds from the cloud to the answer."""


@dataclass(frozen=True, eq=False)
class AnswerScores:
    """Scores of one of the answers over a test set.

    Attributes:
        confusion: points by true (row) and predicted (column) label, summed over the set.
        examples: scores of each test case, in order.
        seconds: of each, from the cloud to the answer.
        miou_up_to_symmetry: mIoU of the set with segments exchanged that no frame tells apart, in each case as it suits
            the answer; where there are none such, the mIoU.
    """

    confusion: Int[np.ndarray, "c c"]
    examples: tuple[Scores, ...]
    seconds: tuple[float, ...]
    miou_up_to_symmetry: float

    @classmethod
    def of(cls, cases: Sequence[TimedConfusion], segmented: bool, swaps: Sequence[Sequence[int]]) -> "AnswerScores":
        """Scores of a set by each case's confusion matrix and seconds; swaps are those of ``StatisticalModel``."""
        each = tuple(intersection_over_union(confusion, segmented) for confusion, _ in cases)
        exchanged = sum(with_segments_exchanged(confusion, swaps) for confusion, _ in cases)
        return cls(
            np.sum([confusion for confusion, _ in cases], axis=0),
            each,
            tuple(seconds for _, seconds in cases),
            intersection_over_union(np.asarray(exchanged), segmented).miou,
        )


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of a test set: its confusion matrix, from which its scores come, and the scores of each example.

    Attributes:
        names: names of the segments.
        confusion: points by true (row) and predicted (column) label, summed over the set; 0 is empty space.
        examples: scores of each test case by its name.
        views: the first few with their labels, for pictures.
        segmented: whether the model tells segments apart; without, there is no mIoU (NaN).
        network: the same of the network alone; ``confusion`` and ``examples`` are of what a user gets.
        sources: where that answer came from, in each example: network, rest, modes or draws.
        known: whether each example was said to show the object, where a registration was asked for.
        errors: distances of registered points from their true positions, where a registration was taken.
        unit_mm: millimetres per scene unit, where they are known.
        reliability: of the network's probabilities.
        calibrated: whether these are.
        seconds: of each example, from the cloud to the answer that a user gets.
        miou_up_to_symmetry: as in ``AnswerScores``.
    """

    names: tuple[str, ...]
    confusion: Int[np.ndarray, "c c"]
    examples: dict[str, Scores]
    views: tuple[EvaluatedView, ...] = field(default=())
    segmented: bool = True
    network: AnswerScores | None = None
    sources: tuple[str, ...] = ()
    known: tuple[Known, ...] = ()
    errors: RegistrationErrors | None = None
    unit_mm: float | None = None
    reliability: Reliability = field(default_factory=Reliability)
    calibrated: bool = False
    seconds: tuple[float, ...] = ()
    miou_up_to_symmetry: float = float("nan")

    def __repr__(self) -> str:
        scores = self.scores
        count = counted(len(self.examples), "example")
        miou = "" if np.isnan(scores.miou) else f", mIoU {scores.miou:.3f}"
        return f"Evaluation({count}: IoU {scores.iou:.3f}{miou}; {listed(self.names)})"

    @property
    def scores(self) -> Scores:
        """Scores over the whole set, from its one confusion matrix."""
        return intersection_over_union(self.confusion, self.segmented)

    @property
    def example_mean(self) -> tuple[float, float]:
        """Mean IoU and mean mIoU over the examples; NaN where no example has a mIoU."""
        each = self.examples.values()
        mious = [s.miou for s in each if not np.isnan(s.miou)]
        return float(np.mean([s.iou for s in each])), float(np.mean(mious)) if mious else float("nan")


# --- test cases -------------------------------------------------------------------------------------------------------

PICTURE_MARGIN = 12
"""Cells drawn around the truth's box: what a model puts there does not count, but belongs into a picture of it."""


@dataclass(frozen=True, eq=False)
class TestCase:
    """Cloud to be reconstructed and the truth to score it by, both in the same camera frame.

    Attributes:
        name: name in tables, different from other cases' of the set.
        cloud: what the model is given.
        truth: true labels on a grid.
        scene_unit: length of a scene unit in the cloud's unit, where it is known.
        material: true positions of a statistical model's material points, or of the first of them, in the cloud's frame
            and unit; None where no correspondence is known.
    """

    __test__ = False  # not a test, whatever pytest thinks of the name

    name: str
    cloud: PointCloud
    truth: TruthGrid
    scene_unit: float | None = None
    material: Callable[[StatisticalModel], Float[np.ndarray, "m 3"]] | None = None


@dataclass(frozen=True, eq=False)
class ScoredCase:
    """What is kept of one test case.

    Attributes:
        name: its own.
        answer: confusion matrix of the answer that a user gets, and seconds from the cloud to it.
        network: the same of the network alone.
        source: where the answer comes from: network, rest, modes or draws.
        reliability: of the network's probabilities on this case.
        errors: of the registration behind the answer; None without one, or without known true positions.
        view: labels for a picture; None where none is wanted.
        known: whether the frame is said to show the object; None where no registration was asked for.
    """

    name: str
    answer: TimedConfusion
    network: TimedConfusion
    source: str
    reliability: Reliability
    errors: RegistrationErrors | None
    view: EvaluatedView | None
    known: Known | None = None


@dataclass(frozen=True, eq=False)
class Scoring:
    """Scores test cases by their number; cases and what they are scored with can be sent to where that is done.

    Attributes:
        model: the trained model.
        registrar: of the model's object; None scores the network alone.
        case: test case by its number.
        kept: how many cases, the first ones, keep their labels for pictures.
        gpu: whether whoever scores moves the model to a GPU of its own first.
    """

    model: Trained
    registrar: Registrar | None
    case: Callable[[int], TestCase]
    kept: int
    gpu: bool = False

    @cached_property
    def moved(self) -> tuple[Trained, Registrar | None]:
        """Model and registrar on the device of whoever scores, moved there once."""
        if not self.gpu:
            return self.model, self.registrar
        from mereo.models.weights import to_gpu  # needs torch, and results do not

        model = to_gpu(self.model)
        return model, None if self.registrar is None else self.registrar.asking(model)

    def __call__(self, index: int) -> ScoredCase:
        """Score a case."""
        case, (model, registrar) = self.case(index), self.moved
        names = segment_names(model)[0]
        grid = case.truth.grid
        errors = None
        try:
            answer = answer_frame(observe(case.cloud), model, registrar, scene_unit=case.scene_unit)
        except NoFit:  # it shows too little of the object
            answer = answer_frame(observe(case.cloud), model, None)
        code = answer.encoded.code
        seconds = answer.encoded.timings_s["encode"]
        assert code is not None
        started = time.perf_counter()
        labels = network_labels(model, code, grid)
        network = grid_confusion(case.truth, labels, len(names)), seconds + time.perf_counter() - started
        confusion = network[0]
        registration = answer.registration
        if registration is not None:
            confusion = grid_confusion(case.truth, label_grid(registration.mesh, *grid.axes()), len(names))
            if case.material is not None and case.scene_unit is not None:
                truth = nearest_truth(registration.model, registration.material, case.material(registration.model))
                seen = seen_points(truth, case.cloud, case.scene_unit)
                errors = RegistrationErrors.of(registration, truth, seen, case.scene_unit)
        return ScoredCase(
            name=case.name,
            answer=network if registrar is None else (confusion, answer.seconds),
            network=network,
            source="network" if registration is None else registration.method,
            reliability=Reliability.of_view(model, code, case.truth),
            errors=errors,
            view=_evaluated_view(case, model, code, registration) if index < self.kept else None,
            known=None if registrar is None else answer.recognition.known,
        )


def _evaluated_view(
    case: TestCase, model: Trained, code: EncodedCloud, registration: Registration | None
) -> EvaluatedView:
    """Truth and answer on the truth's grid and ``PICTURE_MARGIN`` cells around it, which are empty in truth."""
    grid = case.truth.grid
    colors = segment_names(model)[1]
    labels = np.pad(grid.labels, PICTURE_MARGIN)
    wide = replace(grid, labels=labels, origin=grid.origin - PICTURE_MARGIN * grid.spacing)
    if registration is None:
        predicted = network_labels(model, code, wide)
    else:
        predicted = label_grid(registration.mesh, *wide.axes())
    reference = np.minimum(labels, np.uint8(len(colors)))
    return EvaluatedView(case.name, case.cloud, reference, predicted, wide.origin, wide.spacing, colors)


def evaluation_of(model: Trained, cases: Sequence[ScoredCase]) -> Evaluation:
    """Result of a test set from its cases, in order."""
    swaps = () if model.statistical_model is None else model.statistical_model.swaps
    scores, network = (
        AnswerScores.of(each, model.segmented, swaps)
        for each in ([case.answer for case in cases], [case.network for case in cases])
    )
    errors = [case.errors for case in cases if case.errors is not None]
    return Evaluation(
        names=segment_names(model)[0],
        confusion=scores.confusion,
        examples={case.name: example for case, example in zip(cases, scores.examples, strict=True)},
        views=tuple(case.view for case in cases if case.view is not None),
        segmented=model.segmented,
        network=network,
        sources=tuple(case.source for case in cases),
        known=tuple(case.known for case in cases if case.known is not None),
        errors=RegistrationErrors.together(errors) if errors else None,
        reliability=Reliability(np.sum([case.reliability.bins for case in cases], axis=0)),
        calibrated=model.calibrates,
        seconds=scores.seconds,
        miou_up_to_symmetry=scores.miou_up_to_symmetry,
    )
