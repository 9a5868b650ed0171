"""Can an answer be trusted: whether it is the object, how far off it may be, how reliable probabilities are.

    python benchmarks/recognition.py [OBJECT ...] [--views N] [--strangers N] [--own] [--seed S]
                                     [--calibration-views N] [--method modes|auto] [--output FOLDER]

For each object, with its shipped weights, a file of weights, or none (a scene file, meshes): the area under the
receiver operating characteristic (AUROC) by which ``Signs.nats`` tells N clean views of the object from N
views of every other shipped object, from planes and heaps, from balls and random points as large as it is, from two of
it side by side, from the half of its points on one side, from clouds in another unit than is stated, from states with
all draws 1.5 times as far (and of those that are believed, how many have an IoU below .7) and, with weights, from its
own views as a network of the preset `tiny` understands them after ten steps; the shares of clean views, of those of
which a tool hides 30 %, and of simulated cameras' views that are "unsure" and refused; the shares of their true
material points, seen and hidden, within the 95 % radii; and the expected calibration error of the network's
probabilities as they are and calibrated. ``--own`` measures the object's own views alone. Weights without a calibration
are calibrated here, on training seeds, and not written. Test seeds begin at 1,000,000: tune on others.

With `--output` each object's row is kept in FOLDER/OBJECT.json as soon as it is measured and FOLDER/table.md has those
of the objects named, so that a run that was cut off goes on where it was: rows of the same settings are not measured
again, and those of others are refused.
"""

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from occluded_views import occlude
from scipy.spatial.transform import Rotation

from mereo.api.generate import generate
from mereo.api.objects import load_object
from mereo.deformation.maps import Deformation
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.recognition import Recognition
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import Camera, PointCloud
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.metrics import grid_confusion, intersection_over_union, labels_on, truth_grid
from mereo.geometry.solids import Solids
from mereo.io.atomic_files import atomic_file
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation, find_object, observe
from mereo.scenes.draw_recorder import OutOfDraws, Recorder
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, AssetUnavailable, Scene, SourceFrame
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig
from mereo.synthesis.depth_sensor import observe as observe_scene
from mereo.synthesis.examples import View, sample_view
from mereo_learning.calibrate import VIEWS, calibrate, ece_of
from mereo_learning.cases import RegistrationErrors, nearest_truth, sample_cells, seen_points
from mereo_learning.config import PRESETS
from mereo_learning.scoring import trained_scene, true_material
from mereo_learning.trainer import train

FACTORS = (25.4, 0.1, 1000.0, 0.0254, 10.0, 1 / 25.4, 0.001, 2.54)
"""Units that are mistaken for each other: inches, millimetres, centimetres, metres."""

KINDS = (
    *("other object", "plane or clutter", "ball or noise", "two of it", "half of it"),
    *("wrong unit", "state beyond", "ten steps"),
)

STEPS, EXAMPLES = 10, 40

CELLS = 100
"""Cells of the paper's grid along each axis."""

WRONG = 0.7
"""IoU below which a registration is wrong."""


OWN = ("clean", "occluded", "cameras")
"""Views of the object itself: by the paper's camera, with 30 % behind a tool, and by simulated cameras."""


@dataclass
class Measured:
    """What was said of the frames of one object.

    Attributes:
        own: of views of the object, by their kind in ``OWN``.
        errors, iou: of the registrations of those of these views that are said to show the object.
        strange: of everything else, by its kind.
        beyond_iou: of the registrations of states beyond the object's that are said to show it.
        ece: expected calibration error as the network gives probabilities, and calibrated.
    """

    own: dict[str, list[Recognition]] = field(default_factory=lambda: {kind: [] for kind in OWN})
    errors: dict[str, list[RegistrationErrors]] = field(default_factory=lambda: {kind: [] for kind in OWN})
    iou: dict[str, list[float]] = field(default_factory=lambda: {kind: [] for kind in OWN})
    strange: dict[str, list[Recognition]] = field(default_factory=lambda: defaultdict(list))
    beyond_iou: list[float] = field(default_factory=list)
    ece: tuple[float, float] = (float("nan"), float("nan"))

    def add(self, kind: str, answer: Answer | Recognition, view: View, seen: PointCloud) -> None:
        """Take in what was said of a view of the object, in scene units."""
        self.own[kind].append(recognition_of(answer))
        fit = believed(answer)
        if fit is None:
            return
        positions = nearest_truth(fit.model, fit.material, true_material(view, fit.model))
        self.errors[kind].append(RegistrationErrors.of(fit, positions, seen_points(positions, seen, 1.0), 1.0))
        self.iou[kind].append(iou_of(fit, view))

    def add_beyond(self, answer: Answer | Recognition, view: View) -> None:
        """Take in what was said of a state beyond the object's."""
        self.strange["state beyond"].append(recognition_of(answer))
        fit = believed(answer)
        if fit is not None:
            self.beyond_iou.append(iou_of(fit, view))


def recognition_of(answer: Answer | Recognition) -> Recognition:
    """What was said of a frame (``answered``)."""
    return answer if isinstance(answer, Recognition) else answer.recognition


def believed(answer: Answer | Recognition) -> Registration | None:
    """The registration of a frame that is said to show the object; None where it is not, or there is none."""
    if isinstance(answer, Recognition) or answer.recognition.known is not True:
        return None
    return answer.registration


def iou_of(fit: Registration, view: View) -> float:
    """IoU of a registration with a view's truth."""
    truth = truth_grid(view.mesh, CELLS)
    labels = labels_on(fit.mesh, truth.grid)
    return intersection_over_union(grid_confusion(truth, labels, len(view.mesh.names))).iou


def auroc(own: Sequence[float], strange: Sequence[float]) -> float:
    """Probability that a strange frame is stranger than one of the object's, where equal ones count half."""
    if not len(own) or not len(strange):
        return float("nan")
    ahead, same = (compare.outer(np.asarray(strange), np.asarray(own)) for compare in (np.greater, np.equal))
    return float(ahead.mean() + 0.5 * same.mean())


def answered(seen: Observation, model: Model | None, registrar: Registrar) -> Answer | Recognition:
    """What `mereo.reconstruct` says of a frame; a scene unit is a metre (``sized``)."""
    try:
        return answer_frame(seen, model, registrar)
    except ValueError as error:  # nothing is found, and no network answers
        return Recognition(False, str(error))


def recognized(cloud: PointCloud, model: Model | None, registrar: Registrar, unit_m: float | None = 1.0) -> Recognition:
    """Whether it says that a cloud of this unit shows the object."""
    return recognition_of(answered(observe(cloud, unit_m=unit_m), model, registrar))


def sized(registrar: Registrar) -> Registrar:
    """Registrar of an object whose scene unit is said to be a metre, so that the unit of its views is known."""
    return replace(registrar, model=replace(registrar.model, source_frame=SourceFrame(np.eye(4), 1.0)))


def clouds_like(own: Sequence[PointCloud], seed: int) -> Iterator[tuple[str, PointCloud]]:
    """Clouds made of views of the object, or as large as them, that do not show it whole and alone."""
    for index, cloud in enumerate(own):
        rng = example_rng(seed + 5, index)
        points = cloud.points
        middle = points.mean(axis=0)
        size = float(np.ptp(points, axis=0).max())
        across = int(np.ptp(points, axis=0)[:2].argmax())  # of the picture, not along the rays
        ball = rng.normal(size=points.shape)
        ball *= size / 2 / np.linalg.norm(ball, axis=1, keepdims=True)
        noise = rng.uniform(-size / 2, size / 2, points.shape)
        beside = points + 1.1 * size * np.eye(3)[across]
        yield "ball or noise", PointCloud(middle + (ball[ball[:, 2] < 0] if index % 2 else noise))
        yield "two of it", PointCloud(np.concatenate([points, beside]))
        yield "half of it", PointCloud(points[points[:, across] < np.median(points[:, across])])


ATTEMPTS = 50
"""States that are drawn before giving up on a scene that refuses what is beyond its bounds."""

MOST_CALLS = 20_000
"""Calls of the generator after which a scene that draws again and again has refused."""


FULL_TURN = 2 * np.pi
"""Width of an interval of angles that has no end."""


class FartherDraws(Recorder):
    """Generator whose numbers lie beyond what they are drawn from.

    A uniform or triangular number lies farther from the middle (the mode) than its bound does, by a factor: on the side
    on which it was drawn, or, of an interval on one side of zero, on that which is away from zero. A normal one is the
    factor times as far from the mean. Directions of a full turn stay.
    """

    def __init__(self, seed: int, factor: float) -> None:
        super().__init__(seed, {}, MOST_CALLS)
        self.factor = factor

    def _beyond(self, values: Any, low: Any, middle: Any, high: Any) -> Any:
        drawn, low, middle, high = (np.asarray(value, dtype=float) for value in (values, low, middle, high))
        upwards = np.where(low >= 0, True, np.where(high <= 0, False, drawn >= middle))
        return middle + self.factor * (np.where(upwards, high, low) - middle)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Numbers beyond an interval."""
        drawn = super().uniform(low, high, size)
        low, high = np.minimum(low, high), np.maximum(low, high)
        beyond = self._beyond(drawn, low, (low + high) / 2, high)
        return _plain_value(np.where(np.isclose(high - low, FULL_TURN), drawn, beyond))

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Normal numbers of a greater standard deviation."""
        middle = np.asarray(loc, dtype=float)
        return _plain_value(middle + self.factor * (np.asarray(super().normal(loc, scale, size)) - middle))

    def standard_normal(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Normal numbers of mean 0 and the factor as their standard deviation."""
        return _plain_value(self.factor * np.asarray(super().standard_normal(size, dtype, out)))

    def triangular(self, left: Any, mode: Any, right: Any, size: Any = None) -> Any:
        """Numbers beyond the bounds of a triangular distribution."""
        return _plain_value(self._beyond(super().triangular(left, mode, right, size), left, mode, right))


def _plain_value(values: Any) -> Any:
    """A single number as numpy's generators return it."""
    return values if np.ndim(values) else float(values)


def with_farther_states(scene: Scene, factor: float) -> Scene:
    """The scene with all its draws ``factor`` times as far from their middle as their bounds.

    Its ``sample_deformations`` raises ``ValueError`` where the scene refuses ``ATTEMPTS`` such states.
    """
    return replace(scene, sample_deformations=_farther_sampler(scene, factor))


def _farther_sampler(scene: Scene, factor: float) -> Callable[[np.random.Generator], tuple[Deformation, ...]]:
    def sample(rng: np.random.Generator) -> tuple[Deformation, ...]:
        for _ in range(ATTEMPTS):
            try:
                return scene.sample_deformations(FartherDraws(int(rng.integers(2**31)), factor))
            except (OutOfDraws, ValueError):
                continue
        raise ValueError(
            f"the scene {scene.name!r} allows no state with its draws {factor:g} times as far from their middle as "
            "their bounds: take a smaller factor"
        )

    return sample


def views_beyond(scene: Scene, count: int, seed: int) -> Iterator[View]:
    """Views of the object in states whose draws are all 1.5 times as far out; none of a scene that refuses them."""
    with suppress(ValueError):
        for index in range(count):
            rng = example_rng(seed + 4, index)  # beyond the seeds of other strange frames
            yield sample_view(with_farther_states(scene, 1.5), GenerateConfig(), rng)


def barely_trained(scene: Scene, folder: Path) -> Model:
    """Weights of the preset `tiny` after ten steps."""
    generate(scene, folder / "data", GenerateConfig(), examples=EXAMPLES, seed=3, workers=1)
    tiny = PRESETS["tiny"]
    config = replace(tiny, holdout=8, offset_examples=8, epochs=STEPS * tiny.batch / (EXAMPLES - 8))
    return load_model(train(folder / "data", folder / "run", config, device="cpu"))


def own_views(scene: Scene, count: int, seed: int) -> Iterator[tuple[str, View, Observation]]:
    """Views of the object of each kind in ``OWN``, in scene units, which are metres."""
    scene = scene.for_seed(seed)
    for index in range(count):
        view = sample_view(scene, GenerateConfig(), example_rng(seed, index))
        yield "clean", view, observe(view.depth.to_points(), unit_m=1.0)
        hidden = occlude(view, "tool", 0.3, np.random.default_rng([seed, index]))
        yield "occluded", view, find_object(hidden.frame(1.0), IsolationConfig())
        sensor = SENSORS["time-of-flight" if index % 2 else "structured-light"]
        view = sample_view(scene, GenerateConfig(sensor=sensor), example_rng(seed + 6, index))
        yield "cameras", view, observe(view.depth.to_points(), unit_m=1.0)


def measured(name: str, arguments: argparse.Namespace) -> Measured:
    """All frames of one object."""
    thing = load_object(name)
    model = thing.network
    assert model is None or isinstance(model, Model)
    if model is None:
        assert thing.scene is not None and thing.model is not None
        scene = thing.scene
        unsized = thing.registrar()
        assert unsized is not None
    else:
        scene = load_scene(arguments.scene or trained_scene(model))
        if model.calibration is None:
            model = replace(model, calibration=calibrate(model, scene, views=arguments.calibration_views, quiet=False))
        unsized = Registrar.of(model, arguments.method, scene)
    registrar = sized(unsized)
    result = Measured()
    seed = arguments.seed
    clean = []
    for kind, view, seen in own_views(scene, arguments.views, seed):
        result.add(kind, answered(seen, model, registrar), view, seen.cloud)
        clean += [(view, seen.cloud)] if kind == "clean" else []
    if arguments.own:
        return result
    clouds = [cloud for _, cloud in clean]
    for index, cloud in enumerate(clouds):
        wrong = PointCloud(cloud.points * FACTORS[index % len(FACTORS)])
        result.strange["wrong unit"].append(recognized(wrong, model, registrar))
    for kind, cloud in strange_frames(scene, other_objects(scene), arguments.strangers, seed):
        result.strange[kind].append(recognized(cloud, model, unsized, unit_m=None))
    for kind, cloud in clouds_like(clouds, seed):
        result.strange[kind].append(recognized(cloud, model, registrar))
    for view in views_beyond(scene, arguments.views, seed):
        result.add_beyond(answered(observe(view.depth.to_points(), unit_m=1.0), model, registrar), view)
    if model is None:
        return result
    with TemporaryDirectory() as folder:
        poor = barely_trained(scene, Path(folder))
        of_poor = sized(Registrar.of(poor, "modes", scene))
        result.strange["ten steps"] = [recognized(cloud, poor, of_poor) for cloud in clouds]
    result.ece = calibration_error(model, clean)
    return result


def calibration_error(model: Model, views: Sequence[tuple[View, PointCloud]]) -> tuple[float, float]:
    """Expected calibration error of the probabilities as they are and calibrated, over cells of the paper's metric."""
    logits, truth = [], []
    for view, cloud in views:
        points, labels = sample_cells(truth_grid(view.mesh, CELLS))
        logits.append(model.logits(model.encode(cloud), points))
        truth.append(labels)
    calibration = model.calibration
    assert calibration is not None and calibration.temperature is not None
    every = np.concatenate(logits), np.concatenate(truth)
    return ece_of(*every), ece_of(*every, calibration.scaling)


def nats_against(said: Recognition) -> float:
    """Nats that speak against the object: all of them, where nothing was fitted."""
    return np.inf if said.signs is None else -said.signs.nats


def row(name: str, result: Measured, seconds: float) -> dict[str, Any]:
    """Row of the table: what was measured, in numbers."""
    own = list(map(nats_against, result.own["clean"]))
    return {
        "object": Path(name).stem,
        "auroc": [auroc(own, list(map(nats_against, result.strange[kind]))) for kind in KINDS],
        "passed": [share(result.strange[kind], True) for kind in KINDS],
        "frames": [len(result.strange[kind]) for kind in KINDS],
        "beyond_wrong": sum(iou < WRONG for iou in result.beyond_iou),
        "own": {kind: own_row(result, kind) for kind in OWN},
        "ece": list(result.ece),
        "seconds": round(seconds),
    }


def own_row(result: Measured, kind: str) -> dict[str, Any]:
    """What was measured of one kind of the object's own views."""
    errors = result.errors[kind]
    return {
        "views": len(result.own[kind]),
        **{name: share(result.own[kind], known) for name, known in (("unsure", "unsure"), ("refused", False))},
        "wrong": sum(iou < WRONG for iou in result.iou[kind]),
        "iou": result.iou[kind],
        "radii": RegistrationErrors.together(errors).coverage() if errors else None,
    }


def line(numbers: dict[str, Any]) -> str:
    """Row as a line of the table."""
    strangers = zip(numbers["auroc"], numbers["passed"], numbers["frames"], strict=True)
    cells = [f"{area:.3f} ({rate:.0%} of {count})" for area, rate, count in strangers]
    cells[KINDS.index("state beyond")] += f", {numbers['beyond_wrong']} wrong"
    for own in numbers["own"].values():
        radii = own["radii"] or {}
        covered = (radii.get(part) for part in ("seen", "hidden"))
        within = " / ".join("-" if share is None else f"{share:.3f}" for share in covered)
        cells.append(f"{own['unsure']:.0%}, {own['refused']:.0%}, {own['wrong']} of {own['views']}; {within}")
    cells += [f"{error:.3f}" for error in numbers["ece"]] + [str(numbers["seconds"])]
    return f"| {numbers['object']} | {' | '.join(cells)} |"


def share(recognitions: Sequence[Recognition], known: object) -> float:
    """Share of frames of which this was said."""
    return sum(each.known == known for each in recognitions) / len(recognitions) if recognitions else float("nan")


def kept_row(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """The object's row: that in the folder, where one is, or else measured and kept there."""
    place = None if arguments.output is None else arguments.output / f"{Path(name).stem}.json"
    settings = {key: str(value) for key, value in vars(arguments).items() if key not in ("objects", "output")}
    if place is not None and place.is_file():
        kept: dict[str, Any] = json.loads(place.read_text(encoding="utf-8"))
        if kept["settings"] != settings:
            raise SystemExit(f"{place} has a row of other settings ({kept['settings']}): name another folder")
        return kept
    started = time.perf_counter()
    numbers = {**row(name, measured(name, arguments), time.perf_counter() - started), "settings": settings}
    if place is not None:
        with atomic_file(place) as partial:
            partial.write_text(json.dumps(numbers, indent=1), encoding="utf-8")
    return numbers


# --- frames of something else -----------------------------------------------------------------------------------------

# Clouds of what no scene shows: planes, and heaps of boxes, balls and cylinders.
#
# For trials of what is said of a frame that does not show the object. They are as large as the object and seen by the
# same camera, so that size and noise tell nothing.

Stranger = Literal["plane", "clutter"]


def stranger_cloud(scene: Scene, kind: Stranger, settings: GenerateConfig, rng: np.random.Generator) -> PointCloud:
    """Cloud of a plane or a heap, about as large as a scene's object, by a camera as far away as the scene's."""
    workspace = scene.workspace_named(settings.workspace)
    camera = Camera.from_fov(settings.image_size, settings.image_size, workspace.fov_rad)
    low, high = scene.rest.bounds
    size = float((high - low).max())
    while True:
        middle = np.array([0.0, 0.0, rng.uniform(*workspace.distance)])
        bodies = [_plate(size, rng)] if kind == "plane" else _heap(size, rng)
        parts = tuple(
            Segment(
                f"body {i + 1}", PALETTE[i % len(PALETTE)], np.asarray(body.vertices) + middle, np.asarray(body.faces)
            )
            for i, body in enumerate(bodies)
        )
        seen = observe_scene(Solids(SegmentedMesh(parts)), camera, settings.noise_std, settings.sensor, rng)
        if seen.object_points >= 4 * MIN_POINTS:
            return seen.image.to_points()


def _plate(size: float, rng: np.random.Generator) -> trimesh.Trimesh:
    """Flat box, whose normal is turned by up to 1.2 rad from the line of sight."""
    plate = trimesh.creation.box([*(rng.uniform(0.5, 1.0, size=2) * size), 0.01 * size])
    roll = Rotation.from_euler("z", rng.uniform(0.0, 2 * np.pi))
    tilt = Rotation.from_euler("zx", [rng.uniform(0.0, 2 * np.pi), rng.uniform(0.0, 1.2)])
    return _placed(plate, tilt * roll, np.zeros(3))


def _heap(size: float, rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Three to eight boxes, balls and cylinders of a tenth to a half of ``size``, anywhere within it, any way up."""
    makers: tuple[Callable[[Float[np.ndarray, "3"]], trimesh.Trimesh], ...] = (
        lambda sides: trimesh.creation.box(sides),
        lambda sides: trimesh.creation.icosphere(subdivisions=2, radius=sides[0] / 2),
        lambda sides: trimesh.creation.cylinder(radius=sides[0] / 3, height=1.5 * sides[1], sections=24),
    )
    bodies = []
    for _ in range(int(rng.integers(3, 9))):
        body = makers[int(rng.integers(len(makers)))](rng.uniform(0.1, 0.5, size=3) * size)
        turned = Rotation.from_quat(rng.normal(size=4))
        bodies.append(_placed(body, turned, rng.uniform(-0.35, 0.35, size=3) * size))
    return bodies


def _placed(body: trimesh.Trimesh, turned: Rotation, place: Float[np.ndarray, "3"]) -> trimesh.Trimesh:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turned.as_matrix(), place
    body.apply_transform(T)
    return body


def strange_frames(
    scene: Scene, others: Sequence[Scene], each: int, seed: int
) -> Iterator[tuple[Literal["other object", "plane or clutter"], PointCloud]]:
    """Frames that do not show the object: of every other one (``other_objects``), and ``4 * each`` planes and heaps."""
    settings = GenerateConfig()
    for other in others:
        for index in range(each):
            view = sample_view(other, settings, example_rng(seed + 1, index))
            yield "other object", view.depth.to_points()
    for index in range(4 * each):
        plane, heap = example_rng(seed + 2, index), example_rng(seed + 3, index)
        yield "plane or clutter", stranger_cloud(scene, "plane", settings, plane)
        yield "plane or clutter", stranger_cloud(scene, "clutter", settings, heap)


def other_objects(scene: Scene) -> list[Scene]:
    """Built-in scenes of other objects than this one, whose meshes are here."""
    livers = ("liver", "tumor", "liver-simulated")  # of one liver: one is as good as another to be told from the rest
    same = livers if scene.name in livers else (scene.name,)
    others = []
    for name in SCENES:
        with suppress(AssetUnavailable):
            if name not in (*same, *livers[1:]):
                others.append(load_scene(name))
    return others


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="*", default=["bunny", "liver", "rope", "robot"])
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--strangers", type=int, default=2)
    parser.add_argument("--own", action="store_true", help="measure the object's own views alone")
    parser.add_argument("--seed", type=int, default=TEST_SEED_START)
    parser.add_argument("--calibration-views", type=int, default=VIEWS)
    parser.add_argument("--scene", default=None)
    parser.add_argument("--method", default="modes", choices=("modes", "auto"))
    parser.add_argument("--output", type=Path, default=None)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    heads = [f"{kind} (known)" for kind in KINDS]  # of states beyond the object's, also how many of these are wrong
    heads += [f"{kind}: unsure, refused, wrong and known; within radii, seen / hidden" for kind in OWN]
    heads += ["ECE", "calibrated", "seconds"]
    lines = [f"| AUROC against | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    print("\n".join(lines), flush=True)
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)
    for name in arguments.objects:
        lines.append(line(kept_row(name, arguments)))
        print(lines[-1], flush=True)
        if arguments.output is not None:
            (arguments.output / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
