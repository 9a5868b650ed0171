"""One test case scored by itself, wherever that is done, and the set of them put together.

    case(i) -Scoring-> ScoredCase -EvaluationTally-> Evaluation

What a case leaves is small, so cases may be scored anywhere; they are put together in their order, so that sums are the
same bits wherever each one comes from.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from mereo.evaluation.ground_truth import TruthGrid
from mereo.evaluation.metrics import Scores, confusion_matrix, intersection_over_union
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.recognition import Known
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.uncertainty import LEVEL
from mereo.geometry.brief import counted, listed
from mereo.geometry.camera import PointCloud
from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import Color, SegmentedMesh
from mereo.geometry.solids import label_grid
from mereo.models.trained import EncodedCloud, Trained
from mereo.reconstruction.isosurfaces import sample_coarse_to_fine
from mereo.reconstruction.observation import observe
from mereo.reconstruction.pipeline import segment_names
from mereo.scenes.statistical_model import StatisticalModel

# --- coverage of radii ------------------------------------------------------------------------------------------------

# Coverage: how often true places lie within the radii of a registration, and the factor with which 95 % of them do.
#
# Registration, truth -RadiusRatios.of-> ratios of each view -together, scale-> Calibration.radius_scale

SEEN_WITHIN = 1.5
"""Distance in scene units up to which a material point counts as seen: that of the nearest observed point."""


def seen_points(truth: Float[np.ndarray, "m 3"], cloud: PointCloud, scene_unit: float) -> Bool[np.ndarray, " m"]:
    """Which material points a cloud shows, by their true places in its frame and unit."""
    near: Bool[np.ndarray, " m"] = cKDTree(cloud.points).query(truth)[0] <= SEEN_WITHIN * scene_unit
    return near


@dataclass(frozen=True, eq=False)
class RadiusRatios:
    """Distances of registered material points from their true places, in the radii that they have.

    Attributes:
        ratios: factor of the posterior's Gaussian radius with which the true place lies on the rim of the whole one; 0
            where it lies within in any case.
        gaussian: these radii, scene units.
        beside: radii of the other parts, whose squares add to theirs (``RadiusParts.open`` and ``Uncertainty.beside``).
        seen: which of the points the cloud shows.
    """

    ratios: Float[np.ndarray, " n"]
    gaussian: Float[np.ndarray, " n"]
    beside: Float[np.ndarray, " n"]
    seen: Bool[np.ndarray, " n"]

    @classmethod
    def of(
        cls, registration: Registration, truth: Float[np.ndarray, "m 3"], seen: Bool[np.ndarray, " m"]
    ) -> "RadiusRatios":
        """Ratios of one view, to the radii that its registration has, with the weights' calibration if there is one.

        Args:
            registration: fitted, not read from a file.
            truth: true places of its material points, vertices and interior ones, or of the first of them, in its frame
                and unit.
            seen: which of these the cloud shows (``seen_points``).

        Raises ``ValueError`` for a registration without an optimum.
        """
        found = registration.uncertainty
        if found is None:
            raise ValueError("the registration was read from a file, which has no posterior: fit its frame again")
        count, own = len(truth), found.optimum.unit / registration.scene_unit
        off = np.linalg.norm(registration.material[:count] - truth, axis=1) / registration.scene_unit
        gaussian, beside = own * found.parts.gaussian[:count], own * np.hypot(found.parts.open[:count], found.beside)
        ratios = np.sqrt(np.maximum(off**2 - beside**2, 0.0)) / gaussian
        return cls(ratios, gaussian, beside, seen).by(found.scale)

    @classmethod
    def together(cls, each: Sequence["RadiusRatios"]) -> "RadiusRatios":
        """Ratios of several views, every point counted once."""
        columns = zip(*((one.ratios, one.gaussian, one.beside, one.seen) for one in each), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    @property
    def radii(self) -> Float[np.ndarray, " n"]:
        """Radii of all points, scene units."""
        return np.hypot(self.gaussian, self.beside)

    def scale(self) -> float:
        """Factor of the Gaussian's radii that holds 95 % of the true places: ``Calibration.radius_scale``."""
        return float(np.quantile(self.ratios, LEVEL))

    def by(self, scale: float | None) -> "RadiusRatios":
        """The same with the Gaussian's radii times a scale, where there is one."""
        if scale is None:
            return self
        return RadiusRatios(self.ratios / scale, self.gaussian * scale, self.beside, self.seen)

    def with_extra_radius(self, radius: float) -> "RadiusRatios":
        """The same with a radius, in scene units, that every point has beside the others."""
        off = np.maximum((self.ratios * self.gaussian) ** 2 - radius**2, 0.0)
        return RadiusRatios(np.sqrt(off) / self.gaussian, self.gaussian, np.hypot(self.beside, radius), self.seen)

    def summary(self, unit_mm: float | None = None) -> dict[str, float | None]:
        """Share of the true places within the radii, and how large these are.

        Of ``all``, ``seen`` and ``hidden`` points (None where there are none), with the medians of the radii in scene
        units, and in mm where ``unit_mm``, millimetres per scene unit, is known.
        """
        named = {"all": np.ones(len(self.seen), dtype=bool), "seen": self.seen, "hidden": ~self.seen}
        result = {
            name: float((self.ratios[rows] <= 1.0).mean()) if rows.any() else None for name, rows in named.items()
        }
        for name in ("seen", "hidden"):
            median = float(np.median(self.radii[named[name]])) if named[name].any() else None
            result[f"radius_{name}"] = median
            result[f"radius_{name}_mm"] = None if median is None or unit_mm is None else median * unit_mm
        return result


# --- reliability of probabilities -------------------------------------------------------------------------------------

# Reliability of probabilities: how often answers that are given with so much confidence are right.
#
# The expected calibration error (Naeini et al., AAAI 2015; Guo et al., ICML 2017) is the mean distance of the share of
# right answers from their confidence, over bins of equal width, weighed by how many answers fall into each. Confidence
# is the probability of the answered label, over the cells of the paper's metric (``evaluation.ground_truth``).

BINS = 15
"""Bins of equal width, as in the papers."""

ASKED = 20_000
"""Cells of a view that are asked for, at most, evenly drawn: all of them would take longer than the evaluation."""


@dataclass(frozen=True, eq=False)
class AskedCells:
    """What a network says at some of the cells that count, and what is true there.

    Attributes:
        points: the cells' centres, in the cloud's frame and unit.
        truth: their labels.
    """

    points: Float[np.ndarray, "n 3"]
    truth: UInt8[np.ndarray, " n"]

    @classmethod
    def of(cls, truth: TruthGrid, count: int = ASKED) -> "AskedCells":
        """Cells that count, the same ones every time."""
        kept = np.argwhere(truth.kept)
        if len(kept) > count:
            kept = kept[np.sort(np.random.default_rng(0).choice(len(kept), count, replace=False))]
        return cls(truth.grid.positions(kept), truth.grid.labels[tuple(kept.T)])


@dataclass
class Reliability:
    """Answers counted by their confidence.

    Attributes:
        count: of answers in each bin.
        confidence: sum of theirs.
        right: how many are right.
    """

    count: Float[np.ndarray, " b"] = field(default_factory=lambda: np.zeros(BINS))
    confidence: Float[np.ndarray, " b"] = field(default_factory=lambda: np.zeros(BINS))
    right: Float[np.ndarray, " b"] = field(default_factory=lambda: np.zeros(BINS))

    def add(self, confidence: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> None:
        """Count further answers, by the probability of what was answered and whether that is right."""
        index = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
        self.count += np.bincount(index, minlength=BINS)
        self.confidence += np.bincount(index, weights=confidence, minlength=BINS)
        self.right += np.bincount(index, weights=right, minlength=BINS)

    def add_view(self, model: Trained, code: EncodedCloud, truth: TruthGrid) -> None:
        """Count what a network answers about a view; one that tells no segments apart is asked for the whole."""
        cells = AskedCells.of(truth)
        found = model.query(code, cells.points)
        true = np.minimum(cells.truth, found.probability.shape[1] - 1)
        rows = np.arange(len(true))
        self.add(found.probability[rows, found.label].astype(np.float64), found.label == true)

    def add_all(self, other: "Reliability") -> None:
        """Count what another one has counted."""
        self.count += other.count
        self.confidence += other.confidence
        self.right += other.right

    @property
    def ece(self) -> float:
        """Expected calibration error, 0 to 1; NaN without answers."""
        total = self.count.sum()
        return float(np.abs(self.right - self.confidence).sum() / total) if total else float("nan")

    def facts(self) -> list[dict[str, Any]]:
        """Bins that have answers: their share of all, mean confidence and share of right ones."""
        filled = np.flatnonzero(self.count)
        return [
            {
                "share": float(self.count[i] / self.count.sum()),
                "confidence": float(self.confidence[i] / self.count[i]),
                "right": float(self.right[i] / self.count[i]),
            }
            for i in filled
        ]


# --- answers to a test case -------------------------------------------------------------------------------------------

# Answers to one test case: the network's, that of the modes, that of the scene's own draws, and which a user gets.

AnswerName = Literal["network", "modes", "full"]
"""Who answers: the network alone, the registered modes, the better of these and the scene's own draws."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One answer to a frame.

    Attributes:
        labels: on the grid of the truth.
        seconds: from the cloud to the answer.
        registration: behind it; None for the network's.
    """

    labels: UInt8[np.ndarray, "x y z"]
    seconds: float
    registration: Registration | None = None

    def labels_on(self, grid: LabelGrid, model: Trained, code: EncodedCloud) -> UInt8[np.ndarray, "x y z"]:
        """Labels on another grid."""
        if self.registration is None:
            return network_labels(model, code, grid)
        return label_grid(self.registration.mesh, *grid.axes())


@dataclass(frozen=True, eq=False)
class Candidates:
    """All answers to a frame.

    Attributes:
        code: what the network made of the cloud.
        each: answers by who gives them.
        default: whose answer a user gets.
        known: whether the frame is said to show the object; None where no registration was asked for.
        seconds: from the cloud to the answer that a user gets, all that led to it included.
    """

    code: EncodedCloud
    each: dict[AnswerName, Candidate]
    default: AnswerName
    known: Known | None = None
    seconds: float = 0.0

    @property
    def answer(self) -> Candidate:
        """The answer that a user gets."""
        return self.each[self.default]

    @property
    def source(self) -> str:
        """Where that answer comes from: network, rest, modes or draws."""
        found = self.answer.registration
        return "network" if found is None else found.method


def network_labels(model: Trained, code: EncodedCloud, grid: LabelGrid) -> UInt8[np.ndarray, "x y z"]:
    """Labels by the network at the voxels of a grid, evaluated coarse to fine."""
    x, y, z = grid.labels.shape

    def logits(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n c"]:
        return model.logits(code, points)

    return sample_coarse_to_fine(logits, grid.origin, grid.spacing, (x, y, z)).labels


def find_candidates(
    model: Trained, cloud: PointCloud, grid: LabelGrid, registrar: Registrar | None, scene_unit: float | None
) -> Candidates:
    """Answers to a frame, scored on a grid: the one that a user gets, and all others that led to it."""
    answer = answer_frame(observe(cloud), model, registrar, scene_unit=scene_unit)
    assert answer.likelier is not None and answer.candidate is not None and answer.likelier.code is not None
    started = time.perf_counter()
    code, encoding = answer.likelier.code, answer.likelier.timings_s["encode"]
    labels = network_labels(model, code, grid)
    each: dict[AnswerName, Candidate] = {"network": Candidate(labels, encoding + time.perf_counter() - started)}
    if registrar is None:
        return Candidates(code, each, "network", seconds=each["network"].seconds)
    known, names = answer.recognition.known, names_for(registrar)
    if answer.candidate.modes is None or answer.registration is None:  # too little is found, whoever is scored
        return Candidates(code, dict.fromkeys(names, each["network"]), "network", known, answer.seconds)
    each["modes"] = _registered(answer.candidate.modes.registration(), grid, encoding)
    if "full" in names:
        each["full"] = _registered(answer.registration, grid, encoding)
    return Candidates(code, each, names[-1] if answer.taken else "network", known, answer.seconds)


def names_for(registrar: Registrar | None) -> tuple[AnswerName, ...]:
    """Names of the answers that can be had: the draws only of an object whose scene is at hand."""
    if registrar is None:
        return ("network",)
    if registrar.method == "modes" or registrar.states_or_none is None:
        return ("network", "modes")
    return ("network", "modes", "full")


def _registered(registration: Registration, grid: LabelGrid, encoding: float) -> Candidate:
    labels = label_grid(registration.mesh, *grid.axes())
    return Candidate(labels, encoding + registration.seconds, registration)


@dataclass(frozen=True, eq=False)
class RegistrationErrors:
    """Distances of registered material points from where they truly are, scene units.

    Attributes:
        seen: of those near an observed point.
        hidden: of all others.
    """

    seen: Float[np.ndarray, " n"]
    hidden: Float[np.ndarray, " m"]

    @classmethod
    def of(
        cls,
        registration: Registration,
        truth: Float[np.ndarray, "m 3"],
        seen: Bool[np.ndarray, " m"],
        scene_unit: float,
    ) -> "RegistrationErrors":
        """Errors at the material points whose true places are given, the first ones, in the registration's unit.

        ``seen`` says which of these the cloud shows (``coverage.seen_points``).
        """
        error = np.linalg.norm(registration.material[: len(truth)] - truth, axis=1) / scene_unit
        return cls(error[seen], error[~seen])

    @classmethod
    def together(cls, each: list["RegistrationErrors"]) -> "RegistrationErrors":
        """Errors of several frames as one set."""
        nothing = [np.empty(0)]
        return cls(
            np.concatenate([*nothing, *(one.seen for one in each)]),
            np.concatenate([*nothing, *(one.hidden for one in each)]),
        )

    def summary(self, unit_mm: float | None) -> dict[str, dict[str, float | None]]:
        """Median and 95 % quantile of the seen and of the hidden points, in scene units, and in mm where known."""
        return {"seen": _quantiles(self.seen, unit_mm), "hidden": _quantiles(self.hidden, unit_mm)}


def _quantiles(errors: Float[np.ndarray, " n"], unit_mm: float | None) -> dict[str, float | None]:
    if len(errors) == 0:
        return {"median": None, "p95": None, "median_mm": None, "p95_mm": None}
    median, p95 = (float(value) for value in np.quantile(errors, [0.5, 0.95]))
    millimetres = [None if unit_mm is None else value * unit_mm for value in (median, p95)]
    return {"median": median, "p95": p95, "median_mm": millimetres[0], "p95_mm": millimetres[1]}


# --- results of a test set --------------------------------------------------------------------------------------------

# Result of a test set: scores of the answer that a user gets, and of each that could have answered.


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
    origin: Float[np.ndarray, "3"]
    spacing: Float[np.ndarray, "3"]
    colors: Sequence[Color]


@dataclass(frozen=True, eq=False)
class AnswerScores:
    """Scores of one of the answers over a test set.

    Attributes:
        confusion: points by true (row) and predicted (column) label, summed over the set.
        examples: scores of each test case, in order.
        seconds: of each, from the cloud to the answer.
    """

    confusion: Int[np.ndarray, "c c"]
    examples: tuple[Scores, ...]
    seconds: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of a test set: its confusion matrix, from which its scores come, and the scores of each example.

    Attributes:
        names: names of the segments.
        confusion: points by true (row) and predicted (column) label, summed over the set; 0 is empty space.
        examples: scores of each test case by its name.
        views: the first few with their labels, for pictures.
        segmented: whether the model tells segments apart; without, there is no mIoU (NaN).
        answers: the same of each that could have answered; ``confusion`` and ``examples`` are of what a user gets.
        sources: where that answer came from, in each example: network, modes or draws.
        known: whether each example was said to show the object, where a registration was asked for.
        errors: distances of registered points from their true places, where a registration was taken.
        unit_mm: millimetres per scene unit, where they are known.
        coverage: distances of the same points over the radii that are told of them.
        radii_calibrated: whether all of these are.
        reliability: of the network's probabilities.
        calibrated: whether these are.
        seconds: of each example, from the cloud to the answer that a user gets.
    """

    names: tuple[str, ...]
    confusion: Int[np.ndarray, "c c"]
    examples: dict[str, Scores]
    views: tuple[EvaluatedView, ...] = field(default=())
    segmented: bool = True
    answers: dict[AnswerName, AnswerScores] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    known: tuple[Known, ...] = ()
    errors: RegistrationErrors | None = None
    unit_mm: float | None = None
    coverage: RadiusRatios | None = None
    radii_calibrated: bool = False
    reliability: Reliability = field(default_factory=Reliability)
    calibrated: bool = False
    seconds: tuple[float, ...] = ()

    def __repr__(self) -> str:
        scores, count = self.scores, counted(len(self.examples), "example")
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


def grid_confusion(truth: TruthGrid, predicted: UInt8[np.ndarray, "x y z"], segments: int) -> Int[np.ndarray, "c c"]:
    """Confusion matrix of the points that count; where the model knows one segment, all true ones are taken as one."""
    labels = np.minimum(truth.grid.labels[truth.kept], segments)
    return confusion_matrix(labels, np.minimum(predicted[truth.kept], segments), segments + 1)


def labels_on(surfaces: SegmentedMesh, grid: LabelGrid) -> UInt8[np.ndarray, "x y z"]:
    """Labels of surfaces on a grid in their axes and unit; segments without faces are nowhere."""
    present = [number for number, segment in enumerate(surfaces.segments) if len(segment.faces)]
    if not present:
        return np.zeros_like(grid.labels)
    labels = label_grid(SegmentedMesh(tuple(surfaces.segments[number] for number in present)), *grid.axes())
    return np.array([0, *(number + 1 for number in present)], dtype=np.uint8)[labels]


@dataclass
class Tally:
    """Running sum of the scores of one of the answers."""

    confusion: Int[np.ndarray, "c c"] = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int64))
    examples: list[Scores] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, confusion: Int[np.ndarray, "c c"], seconds: float, segmented: bool) -> None:
        """Count one more example."""
        self.confusion = confusion if len(self.examples) == 0 else self.confusion + confusion
        self.examples.append(intersection_over_union(confusion, segmented))
        self.seconds.append(seconds)

    @property
    def scores(self) -> AnswerScores:
        """Scores of the set."""
        return AnswerScores(self.confusion, tuple(self.examples), tuple(self.seconds))


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
        material: true places of a statistical model's material points, or of the first of them, in the cloud's frame
            and unit; None where no correspondence is known.
    """

    __test__ = False  # not a test, whatever pytest thinks of the name

    name: str
    cloud: PointCloud
    truth: TruthGrid
    scene_unit: float | None = None
    material: Callable[[StatisticalModel], Float[np.ndarray, "m 3"]] | None = None


@dataclass(frozen=True, eq=False)
class RegisteredPlaces:
    """How well an answer's registration places the object's points.

    Attributes:
        errors: their distances from where they truly are.
        ratios: these over the radii that are told.
        calibrated: whether the radii are.
    """

    errors: RegistrationErrors
    ratios: RadiusRatios
    calibrated: bool


@dataclass(frozen=True, eq=False)
class ScoredCase:
    """What is kept of one test case.

    Attributes:
        name: its own.
        each: confusion matrix and seconds of each answer, by who gives it.
        default: whose answer a user gets.
        source: where that comes from.
        reliability: of the network's probabilities on this case.
        places: of the registration behind the answer; None without one, or without known places.
        view: labels for a picture; None where none is wanted.
        known: as ``Candidates`` has it.
        seconds: as ``Candidates`` has them.
    """

    name: str
    each: dict[AnswerName, tuple[Int[np.ndarray, "c c"], float]]
    default: AnswerName
    source: str
    reliability: Reliability
    places: RegisteredPlaces | None
    view: EvaluatedView | None
    known: Known | None = None
    seconds: float = 0.0


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
        from mereo.models.remote import to_gpu  # needs torch, and results do not

        model = to_gpu(self.model)
        return model, None if self.registrar is None else self.registrar.asking(model)

    def __call__(self, index: int) -> ScoredCase:
        """Score a case."""
        one, (model, registrar) = self.case(index), self.moved
        found = find_candidates(model, one.cloud, one.truth.grid, registrar, one.scene_unit)
        names, colors = segment_names(model)
        reliability = Reliability()
        reliability.add_view(model, found.code, one.truth)
        return ScoredCase(
            name=one.name,
            each={
                name: (grid_confusion(one.truth, found.each[name].labels, len(names)), found.each[name].seconds)
                for name in names_for(registrar)
            },
            default=found.default,
            source=found.source,
            reliability=reliability,
            places=_places(one, found.answer),
            view=_evaluated_view(one, model, found, colors) if index < self.kept else None,
            known=found.known,
            seconds=found.seconds,
        )


def _places(one: TestCase, answer: Candidate) -> RegisteredPlaces | None:
    registration = answer.registration
    if registration is None or one.material is None or one.scene_unit is None:
        return None
    truth = one.material(registration.model)
    seen = seen_points(truth, one.cloud, one.scene_unit)
    return RegisteredPlaces(
        RegistrationErrors.of(registration, truth, seen, one.scene_unit),
        RadiusRatios.of(registration, truth, seen),
        registration.radius_scale is not None,
    )


def _evaluated_view(one: TestCase, model: Trained, found: Candidates, colors: Sequence[Color]) -> EvaluatedView:
    """Truth and answer on the truth's grid and ``PICTURE_MARGIN`` cells around it."""
    wide = _widened(one.truth)
    reference = np.minimum(wide.grid.labels, np.uint8(len(colors)))
    predicted = found.answer.labels_on(wide.grid, model, found.code)
    return EvaluatedView(one.name, one.cloud, reference, predicted, wide.grid.origin, wide.grid.spacing, colors)


def _widened(truth: TruthGrid) -> TruthGrid:
    """The same cells and ``PICTURE_MARGIN`` more on each side, which are empty, since the box holds every segment."""
    grid = truth.grid
    labels, kept = (np.pad(values, PICTURE_MARGIN) for values in (grid.labels, truth.kept))
    return TruthGrid(replace(grid, labels=labels, origin=grid.origin - PICTURE_MARGIN * grid.spacing), kept)


class EvaluationTally:
    """Running sums over a test set, whose cases are added in order."""

    def __init__(self, model: Trained, answers: Sequence[AnswerName]) -> None:
        self.model = model
        self.answer, self.tallies = Tally(), {name: Tally() for name in answers}
        self.cases: list[ScoredCase] = []
        self.reliability = Reliability()

    def add(self, one: ScoredCase) -> None:
        """Count one more case."""
        for name, tally in self.tallies.items():
            tally.add(*one.each[name], self.model.segmented)
        self.answer.add(*one.each[one.default], self.model.segmented)
        self.reliability.add_all(one.reliability)
        self.cases.append(one)

    def evaluation(self) -> Evaluation:
        """Result of the set."""
        places = [one.places for one in self.cases if one.places is not None]
        return Evaluation(
            names=segment_names(self.model)[0],
            confusion=self.answer.confusion,
            examples={one.name: scores for one, scores in zip(self.cases, self.answer.examples, strict=True)},
            views=tuple(one.view for one in self.cases if one.view is not None),
            segmented=self.model.segmented,
            answers={name: tally.scores for name, tally in self.tallies.items()},
            sources=tuple(one.source for one in self.cases),
            known=tuple(one.known for one in self.cases if one.known is not None),
            errors=RegistrationErrors.together([one.errors for one in places]) if places else None,
            coverage=RadiusRatios.together([one.ratios for one in places]) if places else None,
            radii_calibrated=bool(places) and all(one.calibrated for one in places),
            reliability=self.reliability,
            calibrated=self.model.calibrates,
            seconds=tuple(one.seconds for one in self.cases),
        )
