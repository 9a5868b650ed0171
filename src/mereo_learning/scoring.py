"""Scores on test sets (paper, appendix B): synthetic views of a scene, and real scans.

The joint box of all true segments is divided into 100^3 cells; their centres are labelled by the truth and by the
model, and those outside every segment's enlarged box are dropped. One confusion matrix is summed over the whole set;
IoU and mIoU come from it, and the mean over single examples is reported as well.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from mereo.fitting.config import AnswerMethod
from mereo.fitting.registration.register import CURE, Registrar, other_mesh, registrar_for
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import Scores, TruthGrid, grid_confusion, intersection_over_union, truth_grid
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.io.progress import progress as stage
from mereo.models.model import Model
from mereo.models.trained import Trained
from mereo.models.weights import to_cpu
from mereo.reconstruction.pipeline import segment_names
from mereo.scenes.random_states import state_points
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, Scene, State
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import View, sample_view
from mereo.workers.spread import Cluster, spread
from mereo_learning.cases import Evaluation, ScoredCase, Scoring, TestCase, evaluation_of, network_labels
from mereo_learning.scans import SCANS, PosedScan, bunny_posed, read_truth

CELLS = 100
"""Cells of the paper's grid along each axis."""


@dataclass(frozen=True)
class EvaluationConfig:
    """What a model is scored on: synthetic views of a scene, seen as in training through a noisy depth image, or scans.

    Attributes:
        scene: a scene, its name or its file; by default the built-in one that the model was trained on, of scans each
            truth file's own, which must be built in or YAML: a data file never has a Python scene run.
        examples: number of views; example i is made from (seed, i) alone.
        seed: at least ``TEST_SEED_START``: smaller ones are for training.
        scans: truth files, or their folders, of ``mereo align``; none of them means the four range scans of the bunny;
            None scores views.
        settings: the camera of the views (image size, noise, sensor); by default the paper's.
        method: whose answer is scored, and the network's with it: by default the one that a user gets.
        cells: cells of the grid along each axis.
    """

    scene: Scene | str | None = None
    examples: int = 128
    seed: int = TEST_SEED_START
    scans: Sequence[str | Path] | None = None
    settings: GenerateConfig = field(default_factory=GenerateConfig)
    method: AnswerMethod = "auto"
    cells: int = CELLS

    def __post_init__(self) -> None:
        if self.scans is not None and self.settings != GenerateConfig():
            raise ValueError(
                "--scans are real and take no simulated camera: leave out --sensor, --image-size, --noise-std and "
                "--workspace"
            )


# --- one cloud -------------------------------------------------------------------------------------------------------


def predict_grid(model: Trained, cloud: PointCloud, truth: TruthGrid) -> UInt8[np.ndarray, "x y z"]:
    """Labels by the network on the grid of ``truth``."""
    return network_labels(model, model.encode(cloud), truth.grid)


def grid_scores(model: Model, cloud: PointCloud, truth: SegmentedMesh, cells: int = CELLS) -> Scores:
    """Scores of the network on one cloud, as in the paper; ``truth`` is in the cloud's frame and units.

    Raises ``ValueError`` where the model knows other segments than the truth has.
    """
    check_names(model, truth.names)
    grid = truth_grid(truth, cells)
    segments = len(segment_names(model)[0])
    return intersection_over_union(grid_confusion(grid, predict_grid(model, cloud, grid), segments), model.segmented)


def check_names(model: Trained, names: Sequence[str]) -> None:
    """Raise ``ValueError`` unless the model's labels mean the same as the truth's."""
    if tuple(names) != model.names:
        raise ValueError(
            f"the weights know the segments {', '.join(model.names)} but the truth has {', '.join(names)}; they must "
            "be the same in the same order: use the weights that belong to this object"
        )


# --- test sets -------------------------------------------------------------------------------------------------------


def evaluate(
    model: Model, config: EvaluationConfig, *, progress: bool = False, workers: int | Cluster = 1
) -> Evaluation:
    """Scores of a model on synthetic views of a scene, or on real scans.

    Args:
        model: the trained model.
        config: what it is scored on.
        progress: whether to show a bar with the time left.
        workers: a cluster, where each view is a task; with 1 they are scored here, in order.

    Raises ``ValueError`` for a training seed, no examples, another object than the model's, where a registration is
    wanted for other meshes than those of the model's own statistical model, and for two scans of one name;
    ``FileNotFoundError`` for a missing file, and ``AssetUnavailable`` where a scan of the bunny cannot be had.
    """
    if config.scans is not None:
        if isinstance(workers, Cluster):
            raise ValueError("--scans are few and are scored here: leave out --ray")
        return _evaluate_scans(model, config, config.scans, progress)
    seed, method = config.seed, config.method
    if seed < TEST_SEED_START:
        raise ValueError(f"the seed is {seed}; training may have seen it: take a test seed, {TEST_SEED_START} or more")
    if config.examples < 1:
        raise ValueError(f"{config.examples} examples are asked for; at least 1 is needed: the paper takes 128")
    if isinstance(workers, Cluster):
        model = to_cpu(model, workers)
    scene = config.scene if isinstance(config.scene, Scene) else load_scene(config.scene or trained_scene(model))
    check_names(model, scene.rest.names)
    if method != "network" and model.statistical_model is not None:
        fault = other_mesh(scene, model.statistical_model)
        if fault is not None:
            raise ValueError(
                f"{fault}, so places cannot be compared: {CURE}, or score the network with --method network"
            )
    case = partial(scene_case, scene, config.settings, seed, config.cells)
    unit_mm = None if scene.unit_m is None else 1000 * scene.unit_m
    registrar = registrar_for(model, method, scene)
    return replace(score_cases(model, case, config.examples, progress, registrar, workers=workers), unit_mm=unit_mm)


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


def scene_case(scene: Scene, settings: GenerateConfig, seed: int, cells: int, index: int) -> TestCase:
    """Make a test case of a scene: view ``index`` of a seed, as a cloud in scene units, with its truth."""
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
    kept: int = 4,
    workers: int | Cluster = 1,
) -> Evaluation:
    """Scores on ``case(0) ... case(count - 1)``, which are made one at a time, as they may be large.

    Args:
        model: the trained model.
        case: test case by its number.
        count: how many.
        progress: whether to show a bar with the time left.
        registrar: of the model's object; None scores the network alone.
        kept: how many cases, the first ones, keep their labels for pictures.
        workers: a cluster, where each case is a task; with 1 they are scored here, in order.
    """
    gpu = isinstance(workers, Cluster) and workers.gpus > 0
    if registrar is not None:
        registrar.prepare()  # once, here, and not in every task
    scoring = Scoring(model, registrar, case, kept, gpu)
    scored: dict[int, ScoredCase] = {}
    with (
        closing(spread(scoring, range(count), workers)) as results,
        stage("evaluate", count, "views", quiet=not progress) as shown,
    ):
        for number, result in results:
            scored[number] = result
            shown.advance()
    return evaluation_of(model, [scored[number] for number in range(count)])


# --- real scans -------------------------------------------------------------------------------------------------------


def _evaluate_scans(model: Model, config: EvaluationConfig, truths: Sequence[str | Path], progress: bool) -> Evaluation:
    scene = load_scene(config.scene) if isinstance(config.scene, str) else config.scene
    if scene is not None and not truths:
        raise ValueError(
            f"the scene {scene.name!r} is given without truth files; the bunny's own scans have their scene: name "
            "truth files with --scans, or leave out --scene"
        )
    scans = [read_truth(path, scene) for path in truths] if truths else [bunny_posed(name) for name in SCANS]
    names = [scan.name for scan in scans]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            f"two truths are called {repeated[0]!r}; results are listed by name: rename one of the folders"
        )
    for scan in scans:
        check_names(model, scan.truth.names)
    registrar = registrar_for(model, config.method, scene)
    # every scan keeps its labels: there are few, and the paper shows all of its own (appendix D)
    return score_cases(
        model, lambda index: _case(scans[index], config.cells), len(scans), progress, registrar, kept=len(scans)
    )


def _case(scan: PosedScan, cells: int) -> TestCase:
    cloud, truth, _ = scan.in_camera()
    vertices = np.concatenate([segment.vertices for segment in truth.segments])

    def material(model: StatisticalModel) -> Float[np.ndarray, "m 3"]:
        """The vertices, which come first among the material points of a model of the same meshes."""
        return vertices if sum(model.vertex_counts) == len(vertices) else np.empty((0, 3))

    return TestCase(scan.name, cloud, truth_grid(truth, cells), scan.scene_unit, material)
