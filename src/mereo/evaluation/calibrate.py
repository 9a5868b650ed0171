"""Calibration of weights on views of training seeds: what they say of these is compared with what is true.

    Model, Scene -own_views, strange_frames-> Answer -gauges-> Calibration

Each gauge measures one part. It is given every view of the object, with its fit of the modes and its truth, and every
strange frame, and says its fields of the ``Calibration`` at the end.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import log_softmax, softmax

from mereo.evaluation.cases import AskedCells, RadiusRatios, Reliability, seen_points
from mereo.evaluation.ground_truth import truth_grid
from mereo.evaluation.scoring import check_names, trained_scene, true_material
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.recognition import CONSERVATIVE, Signs, is_noisy, strangeness
from mereo.fitting.registration.recognition import LEAST as LEAST_SIGNS
from mereo.fitting.registration.register import Registrar, registrar_for
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import Camera, PointCloud
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.io.progress import progress
from mereo.models.calibration import Calibration, RadiusFactors, Recognizing, Scaling, SignName, Usual
from mereo.models.model import Model, scaled_array
from mereo.reconstruction.observation import observe
from mereo.scenes.draw_recorder import with_farther_states
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, AssetUnavailable, Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.depth_sensor import observe as observe_scene
from mereo.synthesis.examples import sample_view

# --- views ------------------------------------------------------------------------------------------------------------

# Views that weights are calibrated with: the object as cameras see it, and what is not it.
#
# scene -own_views-> CalibrationView (the object in states that were learned, clean and noisy)
#       -strange_frames-> StrangeFrame (other objects, planes and heaps; frames_beyond: states beyond the scene's)

CAMERAS: tuple[Sensor, ...] = ("paper", "structured-light", "paper", "time-of-flight")
"""Cameras of the views, in turn: half of them clean."""

FARTHER = 1.5
"""Factor of the draws of states that were not learned, in their bounds."""

LIVERS = ("liver", "tumor", "liver-simulated")
"""Scenes of one liver, of which one is as good as another to be told from other objects."""

OF_OTHERS, OF_PLANES, OF_HEAPS, OF_FARTHER = range(1, 5)
"""Seeds of what is strange, beyond that of the views; each has a stream of its own."""


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The object in a random state, with its truth, as a camera sees it.

    Attributes:
        mesh: the true segments, camera frame, scene units.
        seen: the cloud, in the same.
        camera: whose errors it has.
        scene_unit: length of a scene unit in the cloud's unit, 1; None in every other pair of views, which have to
            find it.
        material: true places of a statistical model's material points, or of the first of them.
    """

    mesh: SegmentedMesh
    seen: PointCloud
    camera: Sensor
    scene_unit: float | None
    material: Callable[[StatisticalModel], Float[np.ndarray, "m 3"]]

    @property
    def clean(self) -> bool:
        """Whether the camera is the paper's."""
        return self.camera == "paper"


@dataclass(frozen=True, eq=False)
class StrangeFrame:
    """A frame that does not show the object in a state that was learned.

    Attributes:
        kind: "other object", "plane or clutter", or "state beyond".
        cloud: what is seen, about as large as the object.
        name: of what is seen.
    """

    kind: str
    cloud: PointCloud
    name: str = ""


def own_views(scene: Scene, count: int, seed: int) -> Iterator[CalibrationView]:
    """Views of a scene; view i is made from (seed, i) alone."""
    for index in range(count):
        scene_unit = 1.0 if index // len(CAMERAS) % 2 == 0 else None
        yield _own_view(scene, seed, index, CAMERAS[index % len(CAMERAS)], scene_unit)


def clean_views(scene: Scene, count: int, seed: int, first: int) -> Iterator[CalibrationView]:
    """Views of a scene by the paper's camera, with the unit known, from view ``first`` on."""
    for index in range(first, first + count):
        yield _own_view(scene, seed, index, "paper", 1.0)


def _own_view(scene: Scene, seed: int, index: int, camera: Sensor, scene_unit: float | None) -> CalibrationView:
    view = sample_view(scene.for_seed(seed), GenerateConfig(sensor=SENSORS[camera]), example_rng(seed, index))
    return CalibrationView(view.mesh, view.depth.to_points(), camera, scene_unit, partial(true_material, view))


def strange_frames(scene: Scene, others: Sequence[Scene], each: int, seed: int) -> Iterator[StrangeFrame]:
    """Frames of every other object (``other_objects``), and ``4 * each`` of planes and of heaps."""
    for other in others:
        for index in range(each):
            yield StrangeFrame("other object", _seen(other, seed + OF_OTHERS, index), other.name)
    settings = GenerateConfig()
    for index in range(4 * each):
        plane, heap = (example_rng(seed + offset, index) for offset in (OF_PLANES, OF_HEAPS))
        yield StrangeFrame("plane or clutter", stranger_cloud(scene, "plane", settings, plane))
        yield StrangeFrame("plane or clutter", stranger_cloud(scene, "clutter", settings, heap))


def frames_beyond(scene: Scene, count: int, seed: int, factor: float = FARTHER) -> Iterator[StrangeFrame]:
    """Frames of the object in states whose draws are all ``factor`` times as far from their middle as their bounds.

    None of a scene that refuses such states.
    """
    with suppress(ValueError):
        for index in range(count):
            yield StrangeFrame("state beyond", _seen(with_farther_states(scene, factor), seed + OF_FARTHER, index))


def other_objects(scene: Scene) -> list[Scene]:
    """Built-in scenes of other objects than this one, whose meshes are here."""
    same = LIVERS if scene.name in LIVERS else (scene.name,)
    found = []
    for name in SCENES:
        with suppress(AssetUnavailable):
            if name not in (*same, *LIVERS[1:]):
                found.append(load_scene(name))
    return found


def _seen(scene: Scene, seed: int, index: int) -> PointCloud:
    return sample_view(scene, GenerateConfig(), example_rng(seed, index)).depth.to_points()


# --- calibrate --------------------------------------------------------------------------------------------------------

SEED = 900_000
"""A training seed, whose examples no shipped weights were trained on."""

VIEWS = 48

LEAST_VIEWS = 8


class Gauge(Protocol):
    """Measurement of one part of a calibration."""

    def add(self, view: CalibrationView, answer: Answer) -> None:
        """Take in a view of the object, answered by its modes."""

    def add_strange(self, answer: Answer) -> None:
        """Take in a frame that shows another thing than the object."""

    def fields(self) -> dict[str, Any]:
        """Fields of the ``Calibration`` that were measured."""


def calibrate(
    model: Model,
    scene: Scene | str | None = None,
    *,
    views: int = VIEWS,
    seed: int = SEED,
    strangers: bool = True,
    radius_views: int = 0,
    quiet: bool = True,
) -> Calibration:
    """Calibration of a model by views of its scene: clean ones, noisy ones, and frames of what is not its object.

    Args:
        model: the weights; of such without a statistical model only the probabilities are calibrated.
        scene: their scene, its name or its file; by default the built-in one that they were trained on.
        views: of the object, half of them clean; at least ``LEAST_VIEWS``. About as many strange frames come on top.
        seed: a training seed other than that of the weights' examples.
        strangers: take in frames of other things too, which place the second limit of recognition.
        radius_views: further clean views for the radii alone, with the scene unit known: of a fit that ends in a wrong
            state once in twenty, a few views tell nothing.
        quiet: show no progress.

    Raises ``ValueError`` for a test seed, too few views, and another object than the model's.
    """
    if seed >= TEST_SEED_START:
        raise ValueError(f"the seed is {seed}; calibration is part of training: take one below {TEST_SEED_START}")
    if views < LEAST_VIEWS:
        raise ValueError(f"{views} views are asked for; at least {LEAST_VIEWS} tell anything: 48 are usual")
    if scene is None or isinstance(scene, str):
        scene = load_scene(scene or trained_scene(model))
    check_names(model, scene.rest.names)
    bare = replace(model, calibration=None)
    registrar = None if model.statistical_model is None else registrar_for(bare, "modes", scene)
    gauges: tuple[Gauge, ...] = (ProbabilityGauge(bare),)
    radii = None if registrar is None else RadiusGauge(replace(registrar, method="auto"))
    if radii is not None:
        gauges = (*gauges, RecognitionGauge(), radii)
    more = radius_views if radii is not None else 0
    each = max(1, round(views / 24)) if strangers and registrar is not None else 0
    others = other_objects(scene) if each else []
    with progress("calibrate", views + more + each * (len(others) + 8), "views", quiet=quiet) as shown:
        for view in own_views(scene, views, seed):
            answer = answer_frame(observe(view.seen), bare, registrar, scene_unit=view.scene_unit)
            for gauge in gauges:
                gauge.add(view, answer)
            shown.advance()
        for view in clean_views(scene, more, seed, first=views):
            assert radii is not None
            radii.add(view, answer_frame(observe(view.seen), bare, registrar, scene_unit=view.scene_unit))
            shown.advance()
        for strange in strange_frames(scene, others, each, seed):
            answer = answer_frame(observe(strange.cloud), bare, registrar)
            for gauge in gauges:
                gauge.add_strange(answer)
            shown.advance()
    fields: dict[str, Any] = {}
    for gauge in gauges:
        fields |= gauge.fields()
    return Calibration(seed=seed, views=views, **fields)


# --- probabilities ----------------------------------------------------------------------------------------------------

# Gauge of the network's probabilities: temperature and biases, by the cells of the paper's metric of clean views.

CELLS = 60
"""Cells of the grid along each axis: which of them are asked is random anyway."""

ASKED = 6000
"""Cells of a view."""


class ProbabilityGauge:
    """Measurement of how probabilities must be scaled. Satisfies ``Gauge``.

    Noisy views are left out: their network sees less, and a temperature that covered it would make all others vague.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.logits: list[Float[np.ndarray, "_ c"]] = []
        self.truth: list[UInt8[np.ndarray, " _"]] = []

    def add(self, view: CalibrationView, answer: Answer) -> None:
        """Ask the network at some of a clean view's cells."""
        if not view.clean:
            return
        cells = AskedCells.of(truth_grid(view.mesh, CELLS), ASKED)
        assert answer.likelier is not None and answer.likelier.code is not None
        logits = self.model.logits(answer.likelier.code, cells.points)
        self.logits.append(logits)
        self.truth.append(np.minimum(cells.truth, logits.shape[1] - 1).astype(np.uint8))

    def add_strange(self, answer: Answer) -> None:
        """Nothing: what is not the object has no labels."""

    def fields(self) -> dict[str, Any]:
        """Temperature, biases, and the expected calibration error without and with them."""
        logits, truth = np.concatenate(self.logits), np.concatenate(self.truth)
        scaling = fit_scaling(logits, truth)
        return {
            "temperature": scaling.temperature,
            "biases": scaling.biases,
            "ece": (ece_of(logits, truth), ece_of(logits, truth, scaling)),
        }


# --- temperature and biases -------------------------------------------------------------------------------------------

# Temperature and biases that make probabilities of logits: chosen so that what happens is as likely as is said.
#
# Temperature scaling divides all logits by one number (Guo et al., ICML 2017). Training queries are not spread as space
# is, so frequencies of classes differ as well: then one bias for each class is added, which makes up for the average of
# it. Both are found by the likelihood of the true labels, whose maximum is unique. Labels are not touched.
#
# Notation: n points, c classes.

GOOD_ENOUGH = 0.02
"""Expected calibration error up to which the temperature does alone: two thirds of what is wanted of unseen views."""


def ece_of(
    logits: Float[np.ndarray, "n c"],
    truth: UInt8[np.ndarray, " n"],
    scaling: Scaling = Scaling(),  # noqa: B008 (frozen)
) -> float:
    """Expected calibration error of the scaled probability of the most likely class by the logits as they are."""
    labels, rows = logits.argmax(axis=1), np.arange(len(logits))
    counted = Reliability()
    counted.add(softmax(scaled_array(scaling, logits).astype(np.float64), axis=1)[rows, labels], labels == truth)
    return counted.ece


def fit_scaling(logits: Float[np.ndarray, "n c"], truth: UInt8[np.ndarray, " n"]) -> Scaling:
    """The simplest scaling that is good enough: a temperature, or also a bias for each class."""
    alone = _most_likely(logits, truth, biased=False)
    return alone if ece_of(logits, truth, alone) <= GOOD_ENOUGH else _most_likely(logits, truth, biased=True)


def _most_likely(logits: Float[np.ndarray, "n c"], truth: UInt8[np.ndarray, " n"], biased: bool) -> Scaling:
    """Scaling under which the true labels are most likely; its logarithm is concave in 1 / temperature and biases."""
    values = logits.astype(np.float64)
    count, classes = values.shape
    hot = np.eye(classes)[truth]

    def loss(parameters: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
        scale = np.exp(parameters[0])
        biases = np.concatenate([[0.0], parameters[1:]]) if biased else np.zeros(classes)
        likelihood = log_softmax(values * scale + biases, axis=1)
        residual = (np.exp(likelihood) - hot) / count
        gradient = [(residual * values).sum() * scale, *(residual.sum(axis=0)[1:] if biased else ())]
        return -float((likelihood * hot).sum()) / count, np.array(gradient)

    found = minimize(loss, np.zeros(classes if biased else 1), jac=True, method="L-BFGS-B").x
    return Scaling(float(np.exp(-found[0])), (0.0, *map(float, found[1:])) if biased else None)


# --- radii ------------------------------------------------------------------------------------------------------------

# Gauge of radii: the factors with which 95 % of the true places lie within what the posterior of a fit says.

KINDS = ("", "draws_")
"""Beginnings of the fields of ``Calibration`` that are of fits of the modes, and of draws."""

LEAST = 4
"""Views without which nothing is said."""

NOISY = 16
"""Noisy views that are enough: their draws take longest."""

ELSEWHERE = 5.0
"""Radii by which half of a noisy view's points are off where its fit has ended in a wrong state. One such view in
twenty would be all that the scale is made of, and of a camera's views there are more; recognition is to tell them."""

USUALLY = 0.9
"""Share of the views in which network and registered model are no farther apart than usual. A few views may hold none
that ended elsewhere, so that it cannot be measured from where on they do."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Radii of one view, and what of it may make them wider.

    Attributes:
        ratios: to the posterior's own radii.
        misfit: ``Problem.cloud_misfit``.
        displaced: ``Correspondences.displaced``.
        half: of the object's length, scene units.
    """

    ratios: RadiusRatios
    misfit: float
    displaced: float
    half: float

    @classmethod
    def of(cls, view: CalibrationView, candidate: Candidate, registration: Registration) -> "Measured":
        """Measurement of a registration that was made of a candidate, by weights that are not calibrated."""
        truth = view.material(registration.model)
        ratios = RadiusRatios.of(registration, truth, seen_points(truth, view.seen, 1.0))
        assert registration.optimum is not None and candidate.modes is not None
        misfit = candidate.modes.problem.cloud_misfit(registration.optimum.surface)
        return cls(ratios, misfit, candidate.displaced(registration) or 0.0, registration.model.half)

    def widened(self, factors: RadiusFactors) -> RadiusRatios:
        """Ratios to the radii that a calibration makes wider; its scale is left out."""
        return self.ratios.by(factors.widening(self.misfit)).with_extra_radius(
            self.half * factors.beside(self.displaced)
        )


class RadiusGauge:
    """Measurement of all that scales ``Calibration``'s radii. Satisfies ``Gauge``.

    Attributes:
        full: registrar that fits the scene's draws to what the modes were fitted to; None where no scene is at hand.
        clean, noisy: views whose registration is believed, of the modes and of draws.
    """

    def __init__(self, full: Registrar | None = None) -> None:
        self.full = None if full is None or full.states_or_none is None else full
        self.clean: tuple[list[Measured], list[Measured]] = [], []
        self.noisy: tuple[list[Measured], list[Measured]] = [], []
        self.asked = 0

    def add(self, view: CalibrationView, answer: Answer) -> None:
        """Take in a view of the object where its registration is believed: of others users get no radii."""
        candidate, registration = answer.candidate, answer.registration
        self.asked += not view.clean
        if candidate is None or candidate.modes is None or registration is None:
            return
        if not (view.clean or self.asked <= NOISY):
            return
        full = None if self.full is None else self.full.finish(candidate.modes)
        for number, one in enumerate((registration, full)):
            if one is None or not one.accepted or (number == 1 and one.method != "draws"):
                continue
            (self.noisy if is_noisy(one) else self.clean)[number].append(Measured.of(view, candidate, one))

    def add_strange(self, answer: Answer) -> None:
        """Leave out what is not the object: there are no true places."""

    def fields(self) -> dict[str, Any]:
        """Factors of both kinds of fits; none where their views are too few."""
        fields: dict[str, Any] = {}
        for kind, clean, noisy in zip(KINDS, self.clean, self.noisy, strict=True):
            if len(clean) >= LEAST:
                found = factors_of(clean)
                fields[f"{kind}radius_scale"] = found.scale
                fields[f"{kind}usual_misfit"], fields[f"{kind}usual_displaced"] = found.misfit, found.displaced
            right = [one.ratios for one in noisy if np.median(one.ratios.ratios) <= ELSEWHERE]
            if len(right) >= LEAST:
                fields[f"noisy_{kind}radius_scale"] = RadiusRatios.together(right).scale()
        return fields


def factors_of(views: Sequence[Measured]) -> RadiusFactors:
    """Factors by clean views, those that ended in a wrong state included: users meet them."""
    misfit = float(np.median([one.misfit for one in views]))
    displaced = float(np.quantile([one.displaced for one in views], USUALLY))
    factors = RadiusFactors(None, misfit or None, displaced or None)
    scale = RadiusRatios.together([one.widened(factors) for one in views]).scale()
    return replace(factors, scale=scale)


# --- recognition ------------------------------------------------------------------------------------------------------

# Gauge of recognition: what is usual of the object's views, and how strange a frame may be.

MEASURED: tuple[SignName, ...] = tuple(name for name in LEAST_SIGNS if name != "size")
"""Signs that are measured; what is usual of the size follows from how far units are apart."""

SMALLEST_STD: dict[SignName, float] = {
    "unexplained": 0.5,
    "ruled_out": 0.5,
    "beyond": 0.5,
    "unusual": 0.2,
    "displaced": 0.1,
}
"""Least standard deviations of the signs' logarithms: a few views may be more alike than others will be.

The first three are 0 in most views, where what is added to them alone is left."""

TRUSTED = 4
"""Views from which on their mean and standard deviation are taken; from fewer, the conservative ones."""

MOSTLY, ABOVE = 0.95, 1.25
"""The first limit: that quantile of the strangeness of the object's views, times this: there are few of these.

Not their largest: a camera's view that was not understood may well be called strange."""

LEAST_UNSURE = 3.0
"""Smallest first limit, standard deviations."""

APART = 1.6
"""The second limit at least, in the first."""

STRANGE = 0.1
"""Quantile of the strangeness of other things: the second limit is in the middle between it and the first, by ratio."""


class RecognitionGauge:
    """Measurement of what is usual and of both limits. Satisfies ``Gauge``."""

    def __init__(self) -> None:
        self.clean: list[Signs] = []
        self.noisy: list[Signs] = []
        self.strange: list[tuple[Signs, bool]] = []

    def add(self, view: CalibrationView, answer: Answer) -> None:
        """Take in the signs of a view of the object; one that was not registered has none."""
        if answer.registration is not None and answer.recognition.signs is not None:
            noisy = is_noisy(answer.registration)
            (self.noisy if noisy else self.clean).append(answer.recognition.signs)

    def add_strange(self, answer: Answer) -> None:
        """Take in the signs of a frame that shows something else."""
        if answer.registration is not None and answer.recognition.signs is not None:
            self.strange.append((answer.recognition.signs, is_noisy(answer.registration)))

    def fields(self) -> dict[str, Any]:
        """What is usual, and both limits; nothing where too few views were registered."""
        if len(self.clean) < TRUSTED:
            return {}
        clean = usual_of(self.clean)
        noisy = usual_of(self.noisy) if len(self.noisy) >= TRUSTED else dict(CONSERVATIVE.noisy)
        own = [strangeness(one.strange(clean)) for one in self.clean]
        own += [strangeness(one.strange(noisy)) for one in self.noisy]
        unsure = max(ABOVE * float(np.quantile(own, MOSTLY)), LEAST_UNSURE)
        others = [strangeness(one.strange(noisy if is_noise else clean)) for one, is_noise in self.strange]
        lowest = float(np.quantile(others, STRANGE)) if others else unsure * APART**2
        refused = max(float(np.sqrt(unsure * lowest)), APART * unsure)
        return {"recognizing": Recognizing(clean=clean, noisy=noisy, unsure=unsure, refused=refused)}


def usual_of(signs: Sequence[Signs]) -> dict[SignName, Usual]:
    """What is usual of each sign, from views of the object; robust against a view that was not understood."""
    result: dict[SignName, Usual] = {}
    for name in MEASURED:
        values = [one.logarithms[name] for one in signs if name in one.logarithms]
        if values:
            low, middle, high = np.quantile(values, [0.16, 0.5, 0.84])
            result[name] = Usual(mean=float(middle), std=max(float(high - low) / 2, SMALLEST_STD[name]))
    return result


# --- distractors ------------------------------------------------------------------------------------------------------

# Clouds of what no scene shows: planes, and heaps of boxes, balls and cylinders.
#
# For trials of what is said of a frame that does not show the object. They are as large as the object and seen by the
# same camera, so that size and noise tell nothing.

Stranger = Literal["plane", "clutter"]

FEWEST, MOST = 3, 8
"""Bodies in a heap."""

STEEPEST_RAD = 1.2
"""Largest angle between a plane's normal and the line of sight."""


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
    """Flat box, turned by up to ``STEEPEST_RAD`` from the line of sight."""
    plate = trimesh.creation.box([*(rng.uniform(0.5, 1.0, size=2) * size), 0.01 * size])
    roll = Rotation.from_euler("z", rng.uniform(0.0, 2 * np.pi))
    tilt = Rotation.from_euler("zx", [rng.uniform(0.0, 2 * np.pi), rng.uniform(0.0, STEEPEST_RAD)])
    return _placed(plate, tilt * roll, np.zeros(3))


def _heap(size: float, rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Boxes, balls and cylinders of a tenth to a half of ``size``, anywhere within it, any way up."""
    makers: tuple[Callable[[Float[np.ndarray, "3"]], trimesh.Trimesh], ...] = (
        lambda sides: trimesh.creation.box(sides),
        lambda sides: trimesh.creation.icosphere(subdivisions=2, radius=sides[0] / 2),
        lambda sides: trimesh.creation.cylinder(radius=sides[0] / 3, height=1.5 * sides[1], sections=24),
    )
    bodies = []
    for _ in range(int(rng.integers(FEWEST, MOST + 1))):
        body = makers[int(rng.integers(len(makers)))](rng.uniform(0.1, 0.5, size=3) * size)
        turned = Rotation.from_quat(rng.normal(size=4))
        bodies.append(_placed(body, turned, rng.uniform(-0.35, 0.35, size=3) * size))
    return bodies


def _placed(body: trimesh.Trimesh, turned: Rotation, place: Float[np.ndarray, "3"]) -> trimesh.Trimesh:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turned.as_matrix(), place
    body.apply_transform(T)
    return body
