"""What a fit of the object's own deformation model is worth: network alone, modes, the scene's own draws.

    python benchmarks/fitting.py [OBJECT ...] [--seed S] [--views N] [--first I] [--cells C] [--draws] [--scans]

For each object, with its shipped weights: mean IoU / mIoU of single views on a grid of C^3 cells, median seconds of a
fit, the share of views where a fit was accepted and where the draws were chosen, and of what was chosen the
registration error at the material points (median / 95 %, scene units), near observed points (within 1.5 units) and
elsewhere. ``--scans`` scores the bunny's real scans instead. Tune on seeds below 1,000,000 only.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mereo.fitting.draws.playback import DrawnStates
from mereo.fitting.registration.answer_frame import search_modes
from mereo.fitting.registration.register import CloudToFit
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import TruthGrid, confusion_matrix, grid_confusion, intersection_over_union, truth_grid
from mereo.geometry.solids import label_grid
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.scenes.random_states import scene_model, state_points
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene, State
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo_learning.scans import SCANS, scan_in_camera
from mereo_learning.scoring import predict_grid

NEAR = 1.5


@dataclass(frozen=True, eq=False)
class Case:
    """A cloud, its truth, the true material points where they are known, and the length of a scene unit."""

    name: str
    cloud: PointCloud
    truth: SegmentedMesh
    material: np.ndarray | None
    unit: float


def views(scene: Scene, model: StatisticalModel, seed: int, first: int, count: int) -> Iterator[Case]:
    scene = scene.for_seed(seed)
    for index in range(first, first + count):
        view = sample_view(scene, GenerateConfig(), example_rng(seed, index))
        state = State(view.mesh.transformed(view.T_world_camera), view.deformations)
        material = state_points(state, model.nodes, model.node_labels)
        material = transform_points(inverse_rigid(view.T_world_camera), material)
        yield Case(f"{scene.name} {index}", view.depth.to_points(), view.mesh, material, 1.0)


def scans(scene: Scene) -> Iterator[Case]:
    for name in SCANS:
        cloud, truth, _ = scan_in_camera(name)
        assert scene.unit_m is not None
        yield Case(name, cloud, truth, None, scene.unit_m)


def score(labels: np.ndarray, truth: TruthGrid, segments: int) -> tuple[float, float]:
    confusion = confusion_matrix(truth.grid.labels[truth.kept], labels[truth.kept], segments + 1)
    found = intersection_over_union(confusion, True)
    return found.iou, found.miou


def fitted(registration: Registration, truth: TruthGrid) -> tuple[float, float]:
    labels = label_grid(registration.mesh, *truth.grid.axes())
    return score(labels, truth, len(registration.model.rest.names))


def errors(registration: Registration, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """At material points near what was seen, and elsewhere."""
    if case.material is None:
        return np.empty(0), np.empty(0)
    error = np.linalg.norm(registration.material - case.material, axis=1)
    near = cKDTree(case.cloud.points).query(case.material)[0] < NEAR
    return error[near], error[~near]


def row(
    name: str, network: Model, model: StatisticalModel, cases: Iterator[Case], states: DrawnStates | None, cells: int
) -> str:
    table, seen, hidden = [], [], []
    for case in cases:
        grid = truth_grid(case.truth, cells)
        confusion = grid_confusion(grid, predict_grid(network, case.cloud, grid), len(network.names))
        alone = intersection_over_union(confusion, True)
        modes = search_modes(CloudToFit(case.cloud.points, case.unit), model)
        best = modes.registration if states is None else modes.with_draws(states)
        near, far = errors(best, case)
        seen.append(near)
        hidden.append(far)
        values = (alone.iou, alone.miou, *fitted(modes.registration, grid), *fitted(best, grid))
        table.append((*values, modes.seconds, best.seconds, best.accepted, best.method == "draws", best.explained))
        print(f"  {case.name}: " + " ".join(f"{float(value):.3f}" for value in table[-1]), flush=True)
    mean = np.mean(table, axis=0)
    middle = np.median(table, axis=0)
    ends = []
    for parts in (np.concatenate(seen), np.concatenate(hidden)):
        ends.append("{:.2f} / {:.2f}".format(*np.quantile(parts, [0.5, 0.95])) if len(parts) else "-")
    scores = " | ".join(f"{mean[i]:.3f} / {mean[i + 1]:.3f}" for i in (0, 2, 4))
    rates = f"{middle[6]:.2f} / {middle[7]:.2f} | {mean[8]:.2f} | {mean[9]:.2f}"
    return f"| {name} | {scores} | {rates} | {' | '.join(ends)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="*", default=["bunny", "engine", "rope", "liver"])
    for name, value in (("seed", 700_000), ("views", 5), ("first", 0), ("cells", 50)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--draws", action="store_true")
    parser.add_argument("--scans", action="store_true")
    options = parser.parse_args()
    rows = []
    for name in ["bunny"] if options.scans else options.objects:
        network = load_model(name)
        scene = load_scene(name)
        model = scene_model(scene)
        states = DrawnStates.of(scene, model) if options.draws else None
        cases = scans(scene) if options.scans else views(scene, model, options.seed, options.first, options.views)
        rows.append(row(name, network, model, cases, states, options.cells))
        print(rows[-1], flush=True)
    print("| object | network | modes | chosen | seconds | accepted | draws | seen | hidden |")
    print("|---|---|---|---|---|---|---|---|---|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
