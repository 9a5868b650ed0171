"""What readers use today, on the frames of benchmarks/fitting.py: ICP, and coherent point drift (CPD) in all its forms.

    python benchmarks/registration_rivals.py [OBJECT ...] [--seed S] [--views N] [--first I] [--cells C]
        [--scans] [--search RIVAL ...]

Each rival gets the observed cloud and the model's visible surface, in the best pose for the true material points, with
its documented settings and with those that a search found; our fit searches. The answer is where all material points
are, as a fit's is, and it is scored alike: mean IoU / mIoU of single views on C^3 cells, error of material points
(median / 95 %, scene units) near observed points and elsewhere, median seconds.

``--search`` tries settings, one setting after the other, by the mean error of
all material points in half longest sides of the rest box. Search on seeds below 1,000,000 only; what it found on views
0 to 4 of seed 700,000 (Bayesian CPD, and the atlas a second time, on view 0) is in rivals/settings.py.

Rivals, none of which mereo needs; without one its rows are left out, with a sentence that says so:

    pip install small_gicp pycpd rustcpd

- small_gicp 1.0.1 (MIT; wheels for Python 3.11 to 3.13; also ``mereo[align]``): ICP, its point-to-plane form and
  generalized ICP.
- pycpd 2.0.0 (MIT, pure Python): CPD, rigid with scale, affine, deformable (Myronenko and Song, TPAMI 2010).
- rustcpd 4.0.0 (BSD-2, wheels for Python 3.9 and later): rigid CPD without scale, and CPD of a statistical shape model
  ("atlas"), which here is mereo's own. Its deformable CPD gives pycpd's points to 1e-12.
- probreg 0.3.8 (MIT): Bayesian CPD (Hirose, TPAMI 2021), which its authors call experimental. It has no wheel and
  compiles for minutes; it asks for open3d 0.18.0, whose wheels (0.4 GB) end at Python 3.11. The reference program of
  Bayesian CPD is in C and on no package registry.
"""

import argparse
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from fitting import Case, errors, fitted, score, views
from rivals.frames import Frame, surface_points, thinned_cloud
from rivals.methods import Registered, Settings
from rivals.settings import RIVALS, Rival

from mereo.fitting.registration.answer_frame import search_modes
from mereo.fitting.registration.register import CloudToFit
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import TruthGrid, truth_grid
from mereo.geometry.transforms import fit_rigid, transform_points
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel
from mereo_learning.scans import SCANS, scan_in_camera
from mereo_learning.scoring import predict_grid

Row = tuple[float, float, float, bool, np.ndarray, np.ndarray]
"""IoU, mIoU, seconds, finished, errors near observed points and elsewhere."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A view, and the frames that rivals start from: in the rest state, and in the mean one."""

    case: Case
    rest: Frame
    mean: Frame


# --- frames -----------------------------------------------------------------------------------------------------------


def scans(scene: Scene, model: StatisticalModel) -> Iterator[Case]:
    """The bunny's real scans in scene units, with the material points of its rest state as truth."""
    assert scene.unit_m is not None
    for name in SCANS:
        cloud, truth, _ = scan_in_camera(name)
        truth = truth.with_vertices([segment.vertices / scene.unit_m for segment in truth.segments])
        material = transform_points(fit_rigid(vertices(model.rest), vertices(truth)), model.rest_points)
        yield Case(name, PointCloud(cloud.points / scene.unit_m), truth, material, 1.0)


def vertices(mesh: SegmentedMesh) -> np.ndarray:
    return np.concatenate([segment.vertices for segment in mesh.segments])


def prepare(case: Case, model: StatisticalModel, surface: np.ndarray) -> Prepared:
    """Both frames in their best poses."""
    assert case.material is not None
    empty = Frame(model, thinned_cloud(case.cloud.points), model.rest_points, np.eye(3), surface)
    shapes = (model.rest_points, model.mean)
    return Prepared(case, *(empty.started(shape, fit_rigid(shape, case.material)) for shape in shapes))


# --- scores -----------------------------------------------------------------------------------------------------------


def attempt(rival: Rival, settings: Settings, view: Prepared) -> tuple[Registered, float]:
    """Answer and seconds; the start pose where a rival ends in an error."""
    frame = replace(view.mean if rival.mean else view.rest)  # without what an earlier rival computed
    started = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = rival.run(frame, settings)
    except np.linalg.LinAlgError:
        found = Registered(frame.posed, False)
    if not np.isfinite(found.material).all():
        found = Registered(frame.posed, False)
    return found, time.perf_counter() - started


def scored(registration: Registration, case: Case, grid: TruthGrid, finished: bool = True) -> Row:
    iou, miou = fitted(registration, grid)
    return iou, miou, registration.seconds, finished, *errors(registration, case)


def ours(view: Prepared, network: Model, grid: TruthGrid) -> dict[str, Row]:
    """Scores of the network alone and of the fit of the modes."""
    case, model = view.case, view.rest.model
    alone = score(predict_grid(network, case.cloud, grid), grid, len(network.names))
    modes = scored(search_modes(CloudToFit(case.cloud.points, case.unit), model).registration, case, grid)
    return {"network": (*alone, np.nan, True, np.empty(0), np.empty(0)), "modes (ours)": modes}


def theirs(view: Prepared, rivals: dict[str, Rival], grid: TruthGrid) -> dict[str, Row]:
    """Scores of all rivals."""
    table = {}
    for name, rival in rivals.items():
        variants = {"": rival.default} | ({", tuned": rival.default | rival.tuned} if rival.tuned else {})
        for suffix, settings in variants.items():
            found, seconds = attempt(rival, settings, view)
            model = view.rest.model
            answer = Registration(model, found.material, "modes", np.empty(0), 1.0, True, np.nan, True, seconds)
            table[f"{name}{suffix}"] = scored(answer, view.case, grid, found.finished)
    return table


def line(name: str, found: list[Row]) -> str:
    """One row of the table."""
    iou, miou = (np.mean([row[i] for row in found]) for i in (0, 1))
    seconds = np.median([row[2] for row in found])
    failed = sum(not row[3] for row in found)
    ends = []
    for part in (4, 5):
        values = np.concatenate([row[part] for row in found])
        ends.append("{:.2f} / {:.2f}".format(*np.quantile(values, [0.5, 0.95])) if len(values) else "-")
    took = "-" if np.isnan(seconds) else f"{seconds:.2f}"
    return f"| {name} | {iou:.3f} / {miou:.3f} | {ends[0]} | {ends[1]} | {took} | {failed or '-'} |"


def report(found: dict[str, dict[str, list[Row]]]) -> None:
    """Tables over all views, and of mIoU by object; ``found`` by rival and object."""
    print("| | IoU / mIoU | error seen | hidden | seconds | not finished |\n|---|---|---|---|---|---|")
    for name, objects in found.items():
        print(line(name, [row for part in objects.values() for row in part]))
    names = list(next(iter(found.values())))
    print(f"\n| mIoU | {' | '.join(names)} |\n|---|{'---|' * len(names)}")
    for name, objects in found.items():
        print(f"| {name} | {' | '.join(f'{np.mean([row[1] for row in part]):.3f}' for part in objects.values())} |")


# --- search -----------------------------------------------------------------------------------------------------------


def mean_error(rival: Rival, settings: Settings, prepared: list[Prepared]) -> float:
    """Of all material points, in half longest sides of the rest box."""
    values = []
    for view in prepared:
        found = attempt(rival, settings, view)[0].material
        values.append(np.linalg.norm(found - view.case.material, axis=1).mean() / view.rest.model.half)
    return float(np.mean(values))


def search(name: str, rival: Rival, prepared: list[Prepared]) -> None:
    """Best value of one setting after the other, from what an earlier search found."""
    tuned = dict(rival.tuned)
    least = mean_error(rival, rival.default | tuned, prepared)
    print(f"{name}: {least:.4f} with {tuned}", flush=True)
    for key, values in rival.search.items():
        for value in values:
            error = mean_error(rival, rival.default | tuned | {key: value}, prepared)
            print(f"  {key}={value}: {error:.4f}", flush=True)
            if error < least:
                least = error
                tuned = tuned | {key: value}
    print(f"{name}: {least:.4f} with {tuned}", flush=True)


def available(rivals: dict[str, Rival], view: Prepared) -> dict[str, Rival]:
    """Rivals that are installed; says which are not."""
    found = {}
    for name, rival in rivals.items():
        try:
            attempt(rival, rival.default, view)
            attempt(rival, rival.default | rival.tuned, view)
            found[name] = rival
        except ImportError as error:
            print(f"left out: {error}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="*", default=["bunny", "liver", "rope", "engine", "human", "lizard"])
    for name, value in (("seed", 700_000), ("views", 5), ("first", 0), ("cells", 50)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--scans", action="store_true")
    parser.add_argument("--search", nargs="*", choices=list(RIVALS))
    options = parser.parse_args()
    found: dict[str, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    everything: list[Prepared] = []
    rivals: dict[str, Rival] = {}
    for name in ["bunny"] if options.scans else options.objects:
        network = load_model(name)
        scene = load_scene(name)
        model = scene_model(scene)
        surface = surface_points(model)
        cases = (
            scans(scene, model) if options.scans else views(scene, model, options.seed, options.first, options.views)
        )
        for case in cases:
            view = prepare(case, model, surface)
            everything.append(view)
            if options.search is not None:
                continue
            rivals = rivals or available(RIVALS, view)
            grid = truth_grid(case.truth, options.cells)
            table = ours(view, network, grid) | theirs(view, rivals, grid)
            for rival, row in table.items():
                found[rival][name].append(row)
                print(line(f"{case.name} {rival}", [row]), flush=True)
    if options.search is None:
        report(found)
    for name in options.search or []:
        search(name, RIVALS[name], everything)


if __name__ == "__main__":
    main()
