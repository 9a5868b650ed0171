"""The object's own deformation model, registered to frames: set up once for an object, asked for every frame.

EncodedFrame -Registrar-> Registration
"""

import warnings
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

from mereo.fitting.config import AnswerMethod, FitConfig
from mereo.fitting.draws.playback import MOST_DRAWS, DrawnStates, number_of_draws
from mereo.fitting.registration.fit import CloudToFit, ModesFit, fit_frame
from mereo.fitting.registration.registration import Registration
from mereo.geometry.brief import listed
from mereo.io.progress import stage
from mereo.models.trained import EncodedCloud, Trained
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, AssetUnavailable, Scene
from mereo.scenes.statistical_model import StatisticalModel

ROUNDING = 1e-6
"""Relative difference up to which a unit that was known is exactly the metre."""


class ChangedSceneWarning(UserWarning):
    """Scene with other meshes than when the weights were trained on it: its draws are not fitted."""


@dataclass(frozen=True, eq=False)
class Registrar:
    """Registers one object's deformation model to frames.

    Attributes:
        network: the weights, from whose correspondences a fit starts; None of an object without, which is searched.
        model: statistical model of the same object.
        method: "modes" fits the modes; "full" the draws of the object's scene as well, and takes what has the lower
            misfit; "auto" does the same where the scene is at hand, and else fits the modes; "search" is "auto"
            without the network.
        given: the object's scene, where it is not the built-in one that the weights were trained on.
        config: constants of the fit of the modes.
    """

    network: Trained | None
    model: StatisticalModel
    method: AnswerMethod = "auto"
    given: Scene | None = None
    config: FitConfig = FitConfig()  # noqa: RUF009 (frozen)

    @classmethod
    def of(cls, network: Trained, method: AnswerMethod = "auto", scene: Scene | str | None = None) -> "Registrar":
        """Registrar of the model that the weights carry.

        Args:
            network: the weights.
            method: which description of the states is fitted.
            scene: the object's scene, its name or its file, where it is not the built-in one of the weights.

        Raises ``ValueError`` where the weights carry no statistical model, and where ``method`` is "full" without a
        scene or with one of another object.
        """
        given = load_scene(scene) if isinstance(scene, str) else scene
        return cls(network, statistical_model_of(network), method, given).checked()

    def checked(self) -> "Registrar":
        """Itself; raises ``ValueError`` where ``method`` is "full" without a scene or with one of another object."""
        if self.method == "full" and self.scene is None:
            raise ValueError(
                f"the weights were trained on {self.trained_scene!r}, which is no built-in scene; the fit "
                "of a scene's draws plays it: name its file with --scene, or use --method modes"
            )
        return self

    @property
    def trained_scene(self) -> str:
        """Name of the scene that the weights were trained on, or else of the object's own; "" where there is none."""
        if self.network is not None:
            return str(self.network.provenance.get("scene"))
        return "" if self.given is None else self.given.name

    @property
    def asks_network(self) -> bool:
        """Whether a fit starts from the network's correspondences, and not by a search."""
        return self.network is not None and self.method != "search"

    @cached_property
    def scene(self) -> Scene | None:
        """Scene whose draws can be played: the given one, or the built-in one of the weights; None where neither is.

        Also None, with a ``ChangedSceneWarning``, where the scene that the weights were trained on has other meshes
        since, unless ``method`` is "full". Raises ``ValueError`` for such a scene with "full" and for a given scene
        of another object, and ``AssetUnavailable`` where its mesh cannot be had.
        """
        name = self.trained_scene
        scene = self.given if self.given is not None else load_scene(name) if name in SCENES else None
        fault = None if scene is None else other_mesh(scene, self.model)
        if scene is None or fault is None:
            return scene
        if self.method != "full" and scene.name == name:
            warnings.warn(
                f"{fault}: it has changed since they were trained, so only the modes of that model are fitted; train "
                "them again for the fit of its draws",
                ChangedSceneWarning,
                stacklevel=2,
            )
            return None
        raise ValueError(f"{fault}, so its draws move other points: {CURE}, or use --method modes")

    @cached_property
    def states(self) -> DrawnStates | None:
        """Random states of the scene, among which a fit of its draws starts; they take seconds once.

        None without a scene, and for one with more than ``MOST_DRAWS``, which is left to the modes.
        """
        if self.scene is None or number_of_draws(self.scene) > MOST_DRAWS:
            return None
        with stage("simulate random states of the scene, once for an object"):
            return DrawnStates.of(self.scene, self.model)

    @property
    def asks_search(self) -> bool:
        """Whether a search is asked too where the network's fit does not explain the frame: seconds a frame."""
        is_same_object = self.network is not None and self.network.names == self.model.rest.names
        return self.method == "auto" and self.config.turned and is_same_object

    @property
    def fits_draws(self) -> bool:
        """Whether the scene's draws are fitted too, for which its states are simulated once, in seconds."""
        return self.method != "modes"

    def prepare(self) -> None:
        """Do once what all frames need: simulate the states in which a fit of draws begins, where draws are fitted.

        Raises as ``states_or_none`` does.
        """
        if self.fits_draws:
            _ = self.states_or_none

    @property
    def without_retries(self) -> "Registrar":
        """The same without the patience to ask about a frame again with the camera turned."""
        return replace(self, config=replace(self.config, turned=False))

    @property
    def with_retries(self) -> "Registrar":
        """The same, which asks about a frame with the camera turned however noisy it may be."""
        return replace(self, config=replace(self.config, turned_anyway=True))

    def asking(self, network: Trained | None) -> "Registrar":
        """The same, asking the same weights on another device; scene and states that are known stay so."""
        if network is self.network:
            return self
        moved = copy(self)
        object.__setattr__(moved, "network", network)  # `replace` would forget what is cached
        return moved

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
        return 1.0 if registration.unit_known and abs(unit_m - 1.0) < ROUNDING else unit_m

    def fit_modes(self, cloud: CloudToFit, code: EncodedCloud | None = None) -> ModesFit:
        """Fit of the modes from the network, with ``fit_frame``'s arguments; raises ``ValueError`` as that does."""
        assert self.network is not None
        return fit_frame(cloud, self.network, self.model, self.config, code)

    def register(self, cloud: CloudToFit, code: EncodedCloud | None = None) -> Registration:
        """Registration of the model to a cloud, as ``method`` says; ``code`` is what ``network`` made of it, if known.

        Raises ``ValueError`` as ``fit_frame`` does.
        """
        return self.finish(self.fit_modes(cloud, code))

    def finish(self, fitted: ModesFit) -> Registration:
        """The answer from a fit of the modes: the draws too where ``method`` asks for them.

        Unless that is "full", not where the modes do not explain the frame: the draws, which begin there and take
        longest on such frames, did not explain one of them either (experiments, entry 62).
        """
        modes = fitted.registration()
        hopeless = self.method != "full" and not modes.accepted
        states = None if not self.fits_draws or hopeless or not fitted.may_take_draws else self.states_or_none
        return modes if states is None else fitted.with_draws(states)

    def takes(self, registration: Registration) -> bool:
        """Whether a registration is the answer: one that explains its frame; any where nobody else can answer."""
        return registration.accepted or self.method != "auto" or self.network is None

    @cached_property
    def states_or_none(self) -> DrawnStates | None:
        """``states``, but None where the scene's mesh cannot be had: the weights carry all that the modes need.

        With "full" that raises ``AssetUnavailable``.
        """
        try:
            return self.states
        except AssetUnavailable:
            if self.method != "full":
                return None
            raise


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
        for count, before, what in (
            (len(now.vertices), len(then.vertices), "vertices"),
            (len(now.faces), len(then.faces), "faces"),
        ):
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
        "ruled_out": registration.ruled_out,
        "beyond_states": registration.beyond_states,
        "alike": registration.alike,
        "scene_unit": registration.scene_unit,
        "unit": "known" if registration.unit_known else "found",
        "coefficients": registration.z.tolist(),
        "seconds": registration.seconds,
    }
