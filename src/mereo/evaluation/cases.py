"""One test case scored by itself, wherever that is done, and the set of them put together.

    case(i) -Scoring-> ScoredCase -EvaluationTally-> Evaluation

What a case leaves is small, so cases may be scored anywhere; they are put together in their order, so that sums are the
same bits wherever each one comes from.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from mereo.evaluation.candidates import (
    AnswerName,
    Candidate,
    Candidates,
    RegistrationErrors,
    find_candidates,
    names_for,
)
from mereo.evaluation.coverage import RadiusRatios, seen_points
from mereo.evaluation.ground_truth import TruthGrid
from mereo.evaluation.reliability import Reliability
from mereo.evaluation.results import EvaluatedView, Evaluation, Tally, grid_confusion
from mereo.fitting.registration.recognition import Known
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import Color
from mereo.models.elsewhere import arrived
from mereo.models.model import Model
from mereo.reconstruction.pipeline import segment_names
from mereo.scenes.statistical_model import StatisticalModel

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

    model: Model
    registrar: Registrar | None
    case: Callable[[int], TestCase]
    kept: int
    gpu: bool = False

    @cached_property
    def here(self) -> tuple[Model, Registrar | None]:
        """Model and registrar where this is called, moved there once."""
        model = arrived(self.model, self.gpu)
        return model, None if self.registrar is None else self.registrar.asking(model)

    def __call__(self, index: int, cancelled: Callable[[], bool]) -> ScoredCase:
        """Score a case; as one takes seconds, nothing asks whether to give up."""
        one, (model, registrar) = self.case(index), self.here
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


def _evaluated_view(one: TestCase, model: Model, found: Candidates, colors: Sequence[Color]) -> EvaluatedView:
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

    def __init__(self, model: Model, answers: Sequence[AnswerName]) -> None:
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
