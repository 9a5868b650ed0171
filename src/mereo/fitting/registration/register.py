"""The object's own deformation model, fitted to frames: set up once for an object, then used for every frame.

CloudToFit -search_modes-> ModesFit -Registrar.finish-> Registration
"""

import time
import warnings
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from mereo.fitting.config import ELASTIC, AnswerMethod, FitConfig
from mereo.fitting.draws.fit import DrawsFit, DrawsProblem, fit_draws
from mereo.fitting.draws.fit import narrowing as draws_narrowing
from mereo.fitting.draws.fit import settled as settled_draws
from mereo.fitting.draws.playback import MOST_DRAWS, STATES_SEED, Drawn, DrawnStates
from mereo.fitting.modes import ScoredFit, of_rest, resting, settled
from mereo.fitting.modes import narrowing as modes_narrowing
from mereo.fitting.problem.correspondences import Correspondences, find_correspondences
from mereo.fitting.problem.evidence import (
    MOST_POINTS,
    OBSERVED_SAMPLES,
    UNDECIDED,
    Evidence,
    Observed,
    SurfaceEvidence,
)
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.problem import KNOWN_SCALE_STD, OPEN_SCALE_STD, Problem
from mereo.fitting.problem.residuals import Surface
from mereo.fitting.registration.registration import Method, Registration
from mereo.fitting.uncertainty import DrawsOptimum, ModesOptimum, Optimum
from mereo.geometry.brief import listed
from mereo.geometry.camera import SightLines
from mereo.geometry.symmetry import describe_symmetries
from mereo.geometry.transforms import Points
from mereo.io.cores import limit_blas_threads
from mereo.io.progress import stage
from mereo.models.calibration import Calibration, RadiusFactors
from mereo.models.trained import EncodedCloud, Trained
from mereo.scenes.mechanism import Mechanism
from mereo.scenes.parameters import narrowed_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, AssetUnavailable, Scene
from mereo.scenes.statistical_model import StatisticalModel

# --- the fit to one frame ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CloudToFit:
    """Cloud to which a model is fitted, seen from the origin of the camera frame, in any unit.

    Attributes:
        points: observed points of the object.
        scene_unit: length of a scene unit in the cloud's unit; found together with the pose where None.
        lines: what is known of the lines of sight around the cloud.
        normals: out of the surface, of a surface that no single camera saw, as ``lines`` say; None where unknown.
    """

    points: Points
    scene_unit: float | None = None
    lines: SightLines = UNDECIDED
    normals: Points | None = None

    @property
    def kind(self) -> type[Observed]:
        """Kind of evidence that the lines of sight make of the points."""
        return SurfaceEvidence if self.lines.other_lines == "none" else Evidence

    def evidence(self, unit: float, observed_samples: int = OBSERVED_SAMPLES, most: int = MOST_POINTS) -> Observed:
        """Evidence in scene units, of which one has this length in the cloud's unit; the numbers are its most."""
        return self.kind.of(self.points / unit, observed_samples, self.lines.scaled(1 / unit), self.normals, most)

    @property
    def scale_std(self) -> float:
        """``Problem.scale_std``."""
        return OPEN_SCALE_STD if self.scene_unit is None else KNOWN_SCALE_STD


@dataclass(frozen=True, eq=False)
class ModesFit:
    """Frame to which the modes are fitted, and to which the scene's own draws can be fitted as well.

    Attributes:
        problem: everything the fit works on, scene units.
        unit: length of a scene unit in the cloud's unit, before the fit's own scale.
        posed: coefficients and pose.
        seconds: that it took.
        rest: pose of the rest model, where the frame speaks for an object at rest; then that is the answer.
        calibration: of the object's weights, by which radii are scaled.
        others: positions of the material points in other states that a search found to explain the frame alike.
    """

    problem: Problem
    unit: float
    posed: Posed
    seconds: float
    rest: ScoredFit | None = None
    calibration: Calibration | None = None
    others: tuple[Float[np.ndarray, "m 3"], ...] = ()

    @property
    def may_take_draws(self) -> bool:
        """Whether draws may be the answer: besides the rest model only under noise, where modes may miss what moved."""
        return self.rest is None or self.problem.is_noisy

    @property
    def tolerance(self) -> float:
        """Distance in scene units up to which an observed point lies on the surface, by the frame's noise."""
        return self.problem.tolerance

    @cached_property
    def surface(self) -> Surface:
        """The posed model in scene units: by its modes, or at rest where the frame speaks for that."""
        model = self.problem.model
        if self.rest is None:
            return self.problem.surface(self.posed)
        return Surface.through(model, self.rest.posed.place(model.rest_points), self.problem.evidence.shows)

    @cached_property
    def registration(self) -> Registration:
        """Registration of the modes, or of the rest model where the frame speaks for that."""
        if self.rest is not None:
            problem = of_rest(self.problem)
            posed = self.rest.posed
            bent = self.posed.place(self.problem.model.material(self.posed.z))
            end = ModesOptimum(problem, posed, self.unit, self.others, bent)
            return self._registration("rest", self.problem.model.rest_z, end, posed, self.surface)
        end = ModesOptimum(self.problem, self.posed, self.unit, self.others)
        return self._registration("modes", self.posed.z, end, self.posed, self.surface)

    def settled(self) -> "ModesFit":
        """The same with as many independent points as the cloud of a noisy frame is worth."""
        if not self.problem.shares_noise:
            return self
        with limit_blas_threads():
            modes = settled(self.problem, self.posed)
            rest = resting(modes.problem, modes)
        # the errors that neighbours share are those by the answer; few samples are edges more often than points are
        problem = modes.problem.changed(evidence=(rest or modes).problem.evidence.with_more_samples)
        return replace(self, problem=problem, posed=modes.posed, rest=rest)

    def with_draws(self, states: DrawnStates) -> Registration:
        """Fit the scene's draws too, and return them where their misfit is lower or their evidence greater.

        Modes can imitate what they do not hold, with more of them than a scene has draws; the evidence counts that.
        It does not speak against draws, which have the states that there really are.
        """
        started = time.perf_counter()
        with limit_blas_threads():
            problem = DrawsProblem.of(self.problem, states)
            drawn = fit_draws(problem, self.posed)
            taken = drawn is not None and is_drawn(problem, drawn, self.posed, self.rest)
        seconds = self.seconds + time.perf_counter() - started
        if drawn is None or not taken:
            return replace(self.settled().registration, seconds=seconds)
        with limit_blas_threads():
            problem, drawn = settled_draws(problem, drawn)
        end = DrawsOptimum(problem, drawn, self.unit, self.others)
        registration = self._registration("draws", drawn.z, end, drawn.posed, drawn.surface)
        return replace(registration, drawn=replace(drawn.drawn, z=drawn.z), seconds=seconds)

    def _registration(
        self, method: Method, z: Float[np.ndarray, " k"], optimum: Optimum, posed: Posed, surface: Surface
    ) -> Registration:
        distance = self.problem.nearest(surface)[0]
        explained = float((distance <= self.tolerance).mean())
        model = self.problem.model
        drawn = None
        factors = RadiusFactors()
        if isinstance(model, Mechanism):  # whose numbers are the scene's draws
            method = "draws"
            z = model.draws(z)
            drawn = Drawn(STATES_SEED, z, model.sizes, np.ones(len(z), dtype=bool))
            model = model.registered
        if self.calibration is not None:
            factors = self.calibration.radii(draws=method == "draws", noisy=self.problem.is_noisy)
        misfit = 0.0 if factors.misfit is None else self.problem.cloud_misfit(surface)
        return Registration(
            model=model,
            material=surface.material * self.unit,
            method=method,
            z=z,
            scene_unit=self.unit * float(np.exp(posed.log_scale)),
            unit_known=not self.problem.is_scale_open,
            explained=explained,
            accepted=explained >= self.problem.accepted,
            seconds=self.seconds,
            drawn=drawn,
            residual=float(np.sqrt((distance**2).mean())) * self.unit,
            ruled_out=self.problem.ruled_out(surface),
            needed=self.problem.accepted,
            optimum=optimum,
            radius_scale=factors.scale_at(misfit),
            alike=1 + len(self.others),
        )


def is_drawn(problem: DrawsProblem, drawn: DrawsFit, modes: Posed, rest: ScoredFit | None = None) -> bool:
    """Whether a state of the draws is to be preferred to the modes, or to the rest model, where that is given.

    By the points that the answer was fitted to.
    """
    if rest is not None:
        unbent = of_rest(problem.last).misfit(rest.posed).total
        return drawn.misfit + draws_narrowing(problem, drawn) < unbent
    gain = drawn.misfit - problem.last.misfit(modes).total
    return gain < 0 or gain < modes_narrowing(problem.base, modes) - draws_narrowing(problem, drawn)


# --- the registrar of an object ---------------------------------------------------------------------------------------


class ChangedSceneWarning(UserWarning):
    """Scene with other meshes than when the weights were trained on it: its draws are not fitted."""


@dataclass(frozen=True, eq=False)
class Registrar:
    """Registers one object's deformation model to frames.

    Attributes:
        network: the weights, from whose guess a search begins; None of an object without.
        model: statistical model of the same object.
        method: "auto" fits the modes, from a network's guess where there is one, and the draws of the object's scene,
            where that is at hand; "search" is "auto" without the network; "modes" leaves the draws out.
        given: the object's scene, where it is not the built-in one that the weights were trained on.
        constants: of the fit of the modes; None for those that suit the kind of model.
    """

    network: Trained | None
    model: StatisticalModel
    method: AnswerMethod = "auto"
    given: Scene | None = None
    constants: FitConfig | None = None

    @property
    def config(self) -> FitConfig:
        """Constants of the fit of the modes."""
        return self.constants or (ELASTIC if self.model.is_normal else FitConfig())

    @classmethod
    def of(cls, network: Trained, method: AnswerMethod = "auto", scene: Scene | str | None = None) -> "Registrar":
        """Make the registrar of the model that the weights carry.

        ``scene`` is the object's scene, its name or its file, where it is not the built-in one of the weights. Raises
        ``ValueError`` where the weights carry no statistical model.
        """
        given = load_scene(scene) if isinstance(scene, str) else scene
        return cls(network, statistical_model_of(network), method, given)

    @property
    def starting_network(self) -> Trained | None:
        """The network from whose guess a search begins; None without one, and where it is left out."""
        return None if self.method == "search" else self.network

    def correspondences(self, code: EncodedCloud | None) -> Correspondences | None:
        """What the network says of a cloud that it has encoded; None where it has not."""
        if self.network is None or code is None:
            return None
        return find_correspondences(self.network, code, self.model)

    @property
    def calibration(self) -> Calibration | None:
        """Of the weights."""
        return None if self.network is None else self.network.calibration

    @property
    def trained_scene(self) -> str:
        """Name of the scene that the weights were trained on, or else of the object's own; "" where there is none."""
        if self.network is not None:
            return str(self.network.provenance.get("scene"))
        return "" if self.given is None else self.given.name

    @cached_property
    def scene(self) -> Scene | None:
        """Scene whose draws can be played: the given one, or the built-in one of the weights; None where neither is.

        Where the weights' own scene has other meshes since, it is None with a ``ChangedSceneWarning``. Raises
        ``ValueError`` for a given scene of another object, and ``AssetUnavailable`` where its mesh is missing.
        """
        name = self.trained_scene
        scene = self.given if self.given is not None else load_scene(name) if name in SCENES else None
        fault = None if scene is None else other_mesh(scene, self.model)
        if scene is None or fault is None:
            return scene
        if scene.name == name:
            warnings.warn(
                f"{fault}: it has changed since they were trained, so only the modes of that model are fitted; train "
                "them again for the fit of its draws",
                ChangedSceneWarning,
                stacklevel=2,
            )
            return None
        raise ValueError(f"{fault}, so its draws move other points: {CURE}, or use --method modes")

    @cached_property
    def states(self) -> StatisticalModel:
        """Model whose states are fitted: a mechanism's, where its scene is known."""
        with suppress(AssetUnavailable):
            return Mechanism.of(self.scene, self.model)
        return self.model

    @property
    def fits_draws(self) -> bool:
        """Whether the scene's draws are fitted too, for which its states are simulated once, in seconds."""
        return self.method != "modes"

    def prepare(self) -> None:
        """Simulate once the states in which a fit of draws begins, where draws are fitted; raises as that does."""
        if self.fits_draws:
            _ = self.states_or_none

    def asking(self, network: Trained | None) -> "Registrar":
        """The same with the same weights on another device; scene and states that are known stay so."""
        if network is self.network:
            return self
        moved = copy(self)
        object.__setattr__(moved, "network", network)  # `replace` would forget what is cached
        return moved

    def in_scene(self, scene: Scene | None) -> "Registrar":
        """The same where the joints lie as in this scene; None where nothing is known of them."""
        return self if scene is None else replace(self, given=scene)

    def narrowed(self, scene: Scene | None) -> "Registrar":
        """The same with the statistical model of that scene's states alone, which is made in seconds."""
        return self if scene is None else replace(self, given=scene, model=narrowed_model(scene, self.model))

    def stated_scene_unit(self, unit_m: float | None) -> float | None:
        """Length of a scene unit in a frame's unit of ``unit_m`` metres; None where that or the object's is unknown."""
        frame = self.model.source_frame
        return None if unit_m is None or frame is None or frame.unit_m is None else frame.unit_m / unit_m

    def unit_of(self, registration: Registration) -> float | None:
        """Metres per unit of a registered frame, by the object's true size; None where that is not known."""
        frame = self.model.source_frame
        if frame is None or frame.unit_m is None:
            return None
        unit_m = frame.unit_m / registration.scene_unit
        return 1.0 if registration.unit_known and abs(unit_m - 1.0) < 1e-6 else unit_m

    def finish(self, fitted: ModesFit) -> Registration:
        """Return the registration from a fit of the modes, with the draws too where ``method`` wants them.

        Not where the modes do not explain the frame: the draws, which begin there and take longest on such frames, did
        not explain one of them either (experiments, entry 62).
        """
        is_drawn_too = self.fits_draws and fitted.registration.accepted and fitted.may_take_draws
        states = self.states_or_none if is_drawn_too else None
        return fitted.settled().registration if states is None else fitted.with_draws(states)

    @cached_property
    def states_or_none(self) -> DrawnStates | None:
        """Random states of the scene, among which a fit of its draws starts; they take seconds once.

        None without a scene, for a rigid object, for an elastic solid, whose modes are its draws, for more than
        ``MOST_DRAWS`` draws, and where the scene's mesh cannot be had: the weights carry all that the modes need.
        """
        model = self.states
        try:
            if (
                self.scene is None
                or model.is_normal
                or not model.count
                or len(Drawn.of(self.scene, STATES_SEED).z) > MOST_DRAWS
            ):
                return None
            with stage("simulate random states of the scene, once for an object"):
                return DrawnStates.of(self.scene, model)
        except AssetUnavailable:
            return None


def registrar_for(model: Trained, method: AnswerMethod, scene: Scene | str | None = None) -> Registrar | None:
    """Registrar for a method; None where the network alone answers: "auto" needs weights that carry a model."""
    if method == "network" or (method == "auto" and model.statistical_model is None):
        return None
    return Registrar.of(model, method, scene)


CURE = "name the scene that the weights were trained on, train them again if it has changed since"
"""What to do about a scene of other meshes."""


def other_mesh(scene: Scene, model: StatisticalModel) -> str | None:
    """How a scene's segments differ from a model's, in names or in numbers of vertices or faces; None where they agree.

    Places of a statistical model mean nothing on another mesh.
    """
    difference = f"the scene {scene.name!r} has other segments or meshes than the weights' own model"
    if scene.rest.names != model.rest.names:
        return f"{difference} ({listed(scene.rest.names)}; theirs: {listed(model.rest.names)})"
    for now, then in zip(scene.rest.segments, model.rest.segments, strict=True):
        for what in ("vertices", "faces"):
            count, before = len(getattr(now, what)), len(getattr(then, what))
            if count != before:
                return f"{difference} (its segment {now.name!r} has {count} {what}, theirs {before})"
    return None


def statistical_model_of(model: Trained) -> StatisticalModel:
    """Statistical model that the weights carry."""
    if model.statistical_model is None:
        raise ValueError(
            f"the weights of {', '.join(model.names)} carry no statistical model of their object's states; a "
            "registration needs one: finish the dataset with `mereo generate ... --resume` and train again, or use "
            "--method network"
        )
    return model.statistical_model


def describe(registration: Registration) -> dict[str, object]:
    """Facts of a registration for a result's summary."""
    return {
        "method": registration.method,
        "explained": registration.explained,
        "accepted": registration.accepted,
        "residual": registration.residual,
        "expected_iou": registration.expected_iou,
        "ruled_out": registration.ruled_out,
        "beyond_states": registration.beyond_states,
        "alike": registration.alike,
        "symmetries": describe_symmetries(registration.model.symmetries, registration.model.rest.names),
        "scene_unit": registration.scene_unit,
        "unit": "known" if registration.unit_known else "found",
        "seconds": registration.seconds,
        "coefficients": registration.z.tolist(),
    }
