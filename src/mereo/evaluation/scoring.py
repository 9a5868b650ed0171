"""Scores on test sets (paper, appendix B), and on synthetic views of a scene; for real scans see ``scan_scoring``.

The joint box of all true segments is divided into 100^3 cells; their centres are labelled by the truth and by the
model, and those outside every segment's enlarged box are dropped. One confusion matrix is summed over the whole set;
IoU and mIoU come from it, and the mean over single examples is reported beside it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, UInt8

from mereo.evaluation.candidates import Candidates, RegistrationErrors, find_candidates, names_for, network_labels
from mereo.evaluation.coverage import RadiusRatios, seen_points
from mereo.evaluation.ground_truth import TruthGrid, truth_grid
from mereo.evaluation.metrics import Scores, intersection_over_union
from mereo.evaluation.reliability import Reliability
from mereo.evaluation.results import EvaluatedView, Evaluation, Tally, grid_confusion
from mereo.fitting.config import FitChoice
from mereo.fitting.register import CURE, Registrar, other_mesh, registrar_for
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import Color, SegmentedMesh
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.io.progress import tracked
from mereo.models.model import EncodedCloud, Model
from mereo.reconstruction.pipeline import segment_names
from mereo.scenes.random_states import state_points
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, Scene, State
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import View, sample_view

KEPT_VIEWS = 4
"""Number of examples, the first ones, that keep their labels and are drawn with their errors."""

PICTURE_MARGIN = 12
"""Cells drawn around the truth's box: what a model puts there does not count, but belongs into a picture of it."""

CELLS = 100
"""Cells of the paper's grid along each axis."""


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


# --- one cloud -------------------------------------------------------------------------------------------------------


def predict_grid(model: Model, seen: PointCloud | EncodedCloud, truth: TruthGrid) -> UInt8[np.ndarray, "x y z"]:
    """Labels by the network on the grid of ``truth``; ``seen`` is a cloud, or its code."""
    code = seen if isinstance(seen, EncodedCloud) else model.encode(seen)
    return network_labels(model, code, truth.grid)


def grid_scores(model: Model, seen: PointCloud | EncodedCloud, truth: SegmentedMesh, cells: int = CELLS) -> Scores:
    """Scores of one cloud, or its code, as in the paper; ``truth`` is in the cloud's frame and units.

    Raises ``ValueError`` where the model knows other segments than the truth has.
    """
    check_names(model, truth.names)
    grid = truth_grid(truth, cells)
    segments = len(segment_names(model)[0])
    return intersection_over_union(grid_confusion(grid, predict_grid(model, seen, grid), segments), model.segmented)


def check_names(model: Model, names: Sequence[str]) -> None:
    """Raise ``ValueError`` unless the model's labels mean the same as the truth's."""
    if tuple(names) != model.names:
        raise ValueError(
            f"the weights know the segments {', '.join(model.names)} but the truth has {', '.join(names)}; they must "
            "be the same in the same order: use the weights that belong to this object"
        )


# --- test sets -------------------------------------------------------------------------------------------------------


def evaluate(
    model: Model,
    scene: Scene | str | None = None,
    *,
    examples: int = 128,
    seed: int = TEST_SEED_START,
    cells: int = CELLS,
    progress: bool = False,
    settings: GenerateConfig | None = None,
    choice: FitChoice = "auto",
) -> Evaluation:
    """Scores of a model on synthetic views of a scene, seen as in training: through a noisy depth image.

    Args:
        model: the trained model.
        scene: a scene, its name or its file; by default the built-in one that the model was trained on.
        examples: number of views; example i is made from (seed, i) alone.
        seed: at least ``TEST_SEED_START``: smaller ones are for training.
        cells: cells of the grid along each axis.
        progress: whether to show a bar with the time left.
        settings: the camera (image size, noise, sensor); by default the paper's.
        choice: which answer is scored: by default what a user gets, and beside it all others that can be had.

    Raises ``ValueError`` for a training seed, no examples, another object than the model's, and, where a registration
    is asked for, other meshes than those of the model's own statistical model.
    """
    if seed < TEST_SEED_START:
        raise ValueError(f"the seed is {seed}; training may have seen it: take a test seed, {TEST_SEED_START} or more")
    if examples < 1:
        raise ValueError(f"{examples} examples are asked for; at least 1 is needed: the paper takes 128")
    if scene is None or isinstance(scene, str):
        scene = load_scene(scene or trained_scene(model))
    check_names(model, scene.rest.names)
    if choice != "off" and model.statistical_model is not None:
        fault = other_mesh(scene, model.statistical_model)
        if fault is not None:
            raise ValueError(f"{fault}, so places cannot be compared: {CURE}, or score the network with --fit off")
    case = partial(_scene_case, scene, settings or GenerateConfig(), seed, cells)
    unit_mm = None if scene.unit_m is None else 1000 * scene.unit_m
    return replace(score_cases(model, case, examples, progress, registrar_for(model, choice, scene)), unit_mm=unit_mm)


def trained_scene(model: Model) -> str:
    """Name of the built-in scene that a model was trained on; raises ``ValueError`` where its provenance says none."""
    scene = model.provenance.get("scene")
    if not isinstance(scene, str):
        raise ValueError("the weights do not say which scene they were trained on; name it with --scene")
    if scene not in SCENES:
        raise ValueError(
            f"the weights were trained on the scene {scene!r}, which is not built in; its file is needed: name it with "
            "--scene FILE.yaml"
        )
    return scene


def _scene_case(scene: Scene, settings: GenerateConfig, seed: int, cells: int, index: int) -> TestCase:
    view = sample_view(scene.for_seed(seed), settings, example_rng(seed, index))
    name = f"{scene.name} {index}"
    return TestCase(name, view.depth.to_points(), truth_grid(view.mesh, cells), 1.0, partial(true_material, view))


def true_material(view: View, model: StatisticalModel) -> Float[np.ndarray, "m 3"]:
    """Where a view's state has moved the material points of its object, camera frame."""
    state = State(view.mesh.transformed(view.T_world_camera), view.deformations)
    return transform_points(inverse_rigid(view.T_world_camera), state_points(state, model.nodes, model.node_labels))


def score_cases(
    model: Model,
    case: Callable[[int], TestCase],
    count: int,
    progress: bool,
    registrar: Registrar | None = None,
    kept: int = KEPT_VIEWS,
) -> Evaluation:
    """Scores on ``case(0) ... case(count - 1)``, which are made one at a time, as they may be large.

    Args:
        model: the trained model.
        case: test case by its number.
        count: how many.
        progress: whether to show a bar with the time left.
        registrar: of the model's object; None scores the network alone.
        kept: how many cases, the first ones, keep their labels for pictures.
    """
    names, colors = segment_names(model)
    examples: dict[str, Scores] = {}
    views: list[EvaluatedView] = []
    tallies = {name: Tally() for name in names_for(registrar)}
    answer, sources, errors, reliability = Tally(), [], [], Reliability()
    ratios, calibrated = list[RadiusRatios](), list[bool]()
    for index in tracked("evaluate", count, "views", quiet=not progress):
        one = case(index)
        found = find_candidates(model, one.cloud, one.truth.grid, registrar, one.scene_unit)
        for name, tally in tallies.items():
            tally.add(one.truth, found.each[name], len(names), model.segmented)
        answer.add(one.truth, found.answer, len(names), model.segmented)
        reliability.add_view(model, found.code, one.truth)
        examples[one.name] = answer.examples[-1]
        sources.append(found.source)
        registration = found.answer.registration
        if registration is not None and one.material is not None and one.scene_unit is not None:
            truth = one.material(registration.model)
            errors.append(RegistrationErrors.of(registration, truth, one.cloud, one.scene_unit))
            ratio = RadiusRatios.of(registration, truth, seen_points(truth, one.cloud, one.scene_unit))
            ratios.append(ratio.by(registration.radius_scale))
            calibrated.append(registration.radius_scale is not None)
        if len(views) < kept:
            views.append(_evaluated_view(one, model, found, colors))
    return Evaluation(
        names=names,
        confusion=answer.confusion,
        examples=examples,
        views=tuple(views),
        segmented=model.segmented,
        answers={name: tally.scores for name, tally in tallies.items()},
        sources=tuple(sources),
        errors=RegistrationErrors.together(errors) if errors else None,
        coverage=RadiusRatios.together(ratios) if ratios else None,
        radii_calibrated=bool(calibrated) and all(calibrated),
        reliability=reliability,
        calibrated=model.calibrates,
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
