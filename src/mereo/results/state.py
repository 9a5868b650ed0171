"""Store a registration as a small state file, and restore the same material points from it.

    Registration -state_of-> RegistrationState -save_state, load_state-> Registration

A state holds coefficients or draws, and the pose; neither meshes nor anything of the frame. It needs the weights and,
for draws, the scene. A digest tells statistical models apart, a few witness points a scene that has changed since.
"""

import hashlib
import json
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Int
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from mereo.fitting.draws.playback import Drawn, material_moved, shares_of
from mereo.fitting.problem.problem import ACCEPTED
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import CURE, other_mesh
from mereo.fitting.registration.registration import BELIEVED, Method, Registration
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.transforms import Rows, Transform, fit_rigid, is_rigid, transform_points
from mereo.io.atomic_files import write_json
from mereo.io.errors import AnyPath, first_problem
from mereo.scenes.draw_recorder import SMOOTH
from mereo.scenes.parameters import draw_names, played_back
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, Scene
from mereo.scenes.statistical_model import StatisticalModel

# --- the file ---------------------------------------------------------------------------------------------------------

STATE = "state.json"
"""Name of the file in a folder of results."""

FORMAT = 1
"""Version of the file's format; others are not read."""

MOST_BYTES = 2**20  # 160 coefficients take 4 kB
MOST_NUMBERS = 100_000
WITNESSES = 8
"""Number of material points whose positions are in the file."""


Rounded = tuple[tuple[float, ...], ...]
"""Rows of numbers as a file has them."""


def _rigid(rows: Rounded) -> Rounded:
    if not is_rigid(np.array(rows)):
        raise ValueError("must be a rigid transform: a rotation, a translation, and 0 0 0 1 below")
    return rows


Coefficient = Annotated[FiniteFloat, Field(ge=-1e3, le=1e3)]
Coordinate = Annotated[FiniteFloat, Field(ge=-1e12, le=1e12)]
Scale = Annotated[FiniteFloat, Field(ge=1e-9, le=1e9)]
Text = Annotated[str, Field(max_length=500)]
Point = Annotated[tuple[Coordinate, ...], Field(min_length=3, max_length=3)]
Row = Annotated[tuple[Coordinate, ...], Field(min_length=4, max_length=4)]
Pose = Annotated[tuple[Row, ...], Field(min_length=4, max_length=4), AfterValidator(_rigid)]


class Block(BaseModel):
    """Block of keys: all of its fields, none but them, and nothing is converted."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class StateDraws(Block):
    """What plays the draws: seed, how many numbers each call draws, and what each is called, "" where it is not."""

    seed: Annotated[int, Field(ge=0, lt=2**63)]
    sizes: Annotated[tuple[Annotated[int, Field(ge=0, le=MOST_NUMBERS)], ...], Field(max_length=MOST_NUMBERS)]
    names: tuple[Text, ...]


class RegistrationState(Block):
    """State of a registration: content of ``state.json``, whose keys docs/conventions.md explains."""

    format: int
    mereo: Text
    scene: Text
    segments: tuple[Text, ...]
    weights: Text
    model: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    method: Method
    z: Annotated[tuple[Coefficient, ...], Field(max_length=MOST_NUMBERS)]
    draws: StateDraws | None
    T_camera_model: Pose
    scene_unit: Scale
    unit_m: Scale | None
    frame: CloudAxes
    T_camera_input: Pose
    explained: Annotated[FiniteFloat, Field(ge=0, le=1)]
    unit_known: bool
    accepted: bool
    seconds: Annotated[FiniteFloat, Field(ge=0)]
    witness: Annotated[tuple[Point, ...], Field(min_length=WITNESSES, max_length=WITNESSES)]

    def seen_from(self, T_camera_input: Transform) -> "RegistrationState":
        """The same of an input in other coordinates."""
        return self.model_copy(update={"T_camera_input": _rows(T_camera_input)})

    @model_validator(mode="after")
    def _fits(self) -> "RegistrationState":
        if self.format != FORMAT:
            raise ValueError(f"its format is {self.format}; this mereo reads format {FORMAT}")
        if (self.method == "draws") != (self.draws is not None):
            raise ValueError(f"its method is {self.method!r}; the block `draws` belongs to the method 'draws' alone")
        if self.draws is not None and not sum(self.draws.sizes) == len(self.draws.names) == len(self.z):
            raise ValueError("`z`, `draws.names` and the sum of `draws.sizes` must be of one length")
        return self


def save_state(path: AnyPath, state: RegistrationState) -> None:
    """Write a state, whole or not at all."""
    write_json(path, state.model_dump())


def read_state(path: AnyPath) -> RegistrationState:
    """Read a state from its file, or from a folder of results that has one.

    Raises ``FileNotFoundError`` where there is none, and ``ValueError`` where it is no such state.
    """
    path = Path(path)
    path = path / STATE if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; `mereo reconstruct` writes it where the answer is a registered model: check the "
            "path, or reconstruct with --method modes"
        )
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    try:
        if len(content) > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES // 1024} kB")
        return RegistrationState.model_validate_json(content)
    except ValueError as error:
        fault = first_problem(error) if isinstance(error, ValidationError) else error
        raise ValueError(
            f"{path} is no state of a registration: {fault}: give the state.json of a `mereo reconstruct`"
        ) from None


# --- state ------------------------------------------------------------------------------------------------------------


def model_digest(model: StatisticalModel) -> str:
    """SHA-256 of what the numbers of a state mean: the rest mesh, the mean and the modes."""
    digest = hashlib.sha256(json.dumps(list(model.rest.names)).encode())
    vertices, faces, _ = model.rest.merged()
    for values in (vertices, faces, model.nodes, model.node_labels, model.mean, model.modes):
        digest.update(f"{values.shape}".encode())
        digest.update(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def state_of(
    registration: Registration,
    scene: Scene | str,
    *,
    weights: str = "",
    frame: CloudAxes = "camera",
    unit_m: float | None = None,
    T_camera_input: Transform | None = None,
) -> RegistrationState:
    """Make the state of a registration.

    Args:
        registration: in the camera frame and the input's unit.
        scene: of the object; for modes its name is enough.
        weights: how they were named, so that the viewer finds them.
        frame: axes of the input.
        unit_m: metres in the input's unit; None where that is not known.
        T_camera_input: from the input's frame to the camera frame; by default they are the same.

    Raises ``ValueError`` for draws without their scene.
    """
    model = registration.model
    drawn = registration.drawn
    draws = None
    if drawn is None:
        unposed = model.material(registration.z)
    elif isinstance(scene, str):
        raise ValueError(
            f"the registration is one of draws; the scene that is played is needed, not its name {scene!r}"
        )
    else:
        played = played_back(scene, drawn.seed, shares_of(drawn.z, drawn.sizes))
        unposed = material_moved(scene, model, played.deformations)
        draws = StateDraws(seed=drawn.seed, sizes=drawn.sizes, names=draw_names(played))
    return RegistrationState(
        format=FORMAT,
        mereo=version("mereo"),
        scene=scene if isinstance(scene, str) else scene.name,
        segments=model.rest.names,
        weights=weights,
        model=model_digest(model),
        method=registration.method,
        z=tuple(registration.z.tolist()),
        draws=draws,
        T_camera_model=_rows(fit_rigid(registration.scene_unit * unposed, registration.material)),
        scene_unit=registration.scene_unit,
        unit_m=unit_m,
        frame=frame,
        T_camera_input=_rows(np.eye(4) if T_camera_input is None else T_camera_input),
        explained=registration.explained,
        unit_known=registration.unit_known,
        accepted=registration.accepted,
        seconds=registration.seconds,
        witness=_rows(registration.material[_witnesses(model)]),
    )


def write_state(directory: Path, answer: Answer) -> None:
    """Write the state of an answer into a folder of results, where the answer is a registered model."""
    registrar = answer.registrar
    if registrar is None or answer.registration is None:
        return
    known = registrar.given.name if registrar.given is not None else registrar.trained_scene
    scene = registrar.scene if answer.registration.method == "draws" else None
    state = state_of(
        answer.registration,
        known if scene is None else scene,
        weights="" if answer.model is None else answer.model.name,
        frame=answer.seen.frame.axes,
        unit_m=answer.seen.frame.unit_m,
        T_camera_input=answer.T_camera_input,
    )
    save_state(directory / STATE, state)


def load_state(path: AnyPath, model: StatisticalModel, scene: Scene | None = None) -> Registration:
    """Load a registration from its state, in the camera frame and the input's unit.

    Args:
        path: the file, or the folder of results that has it.
        model: statistical model of the weights that it was made with.
        scene: of a state of draws, where it is not a built-in one.

    Raises as ``read_state`` does, and ``ValueError`` for another model, and where the scene is another or has changed.
    """
    state = read_state(path)
    try:
        return restored(state, model, scene)
    except ValueError as error:
        raise ValueError(f"{path} does not lead to a registration: {error}") from None


def restored(state: RegistrationState, model: StatisticalModel, scene: Scene | None = None) -> Registration:
    """Restore a registration, with arguments and errors of ``load_state``."""
    if model_digest(model) != state.model:
        raise ValueError(
            f"the state belongs to the statistical model of other weights (scene {state.scene!r}, weights "
            f"{state.weights!r}); its numbers mean nothing here: give the model of those weights, or without any the "
            "object as it was looked for, with the joints that were known"
        )
    z = np.array(state.z, float)
    drawn = None
    if state.draws is None:
        if len(z) != model.count:
            raise ValueError(
                f"the state has {len(z)} coefficients, but the model has {model.count} modes; the file is damaged: "
                "register the frame again"
            )
        unposed = model.rest_points if state.method == "rest" else model.material(z)
    else:
        if scene is None and state.scene not in SCENES:  # a name from a file never runs another one
            raise ValueError(f"the state belongs to the scene {state.scene!r}, which is not built in: give the scene")
        scene = load_scene(state.scene) if scene is None else scene
        if scene.name != state.scene:
            raise ValueError(f"the state is one of the scene {state.scene!r}, not of {scene.name!r}: give that scene")
        played = played_back(scene, state.draws.seed, shares_of(z, state.draws.sizes))
        if (fault := other_mesh(scene, model)) is not None:
            raise ValueError(f"{fault}: {CURE}")
        smooth = np.concatenate([np.full(len(call.shares), call.kind in SMOOTH) for call in played.calls])
        unposed = material_moved(scene, model, played.deformations)
        drawn = Drawn(state.draws.seed, z, state.draws.sizes, smooth)
    material = transform_points(np.array(state.T_camera_model), state.scene_unit * unposed)
    off = float(np.abs(material[_witnesses(model)] - np.array(state.witness)).max()) / state.scene_unit
    if off > 1e-3 * model.half:
        raise ValueError(
            f"the state leads {off:.2g} scene units away from where mereo {state.mereo} found it: the scene "
            f"{state.scene!r} has changed since, or the file: register the frame again"
        )
    return Registration(
        model=model,
        material=material,
        method=state.method,
        z=z,
        scene_unit=state.scene_unit,
        explained=state.explained,
        unit_known=state.unit_known,
        accepted=state.accepted,
        seconds=state.seconds,
        drawn=drawn,
        # the file does not say it; what is believed with less than a clean frame needs is noisy, or agrees otherwise
        needed=ACCEPTED if state.accepted and state.explained < BELIEVED else BELIEVED,
    )


def _witnesses(model: StatisticalModel) -> Int[np.ndarray, " w"]:
    return np.linspace(0, len(model.mean) - 1, WITNESSES).astype(np.int64)


def _rows(values: Rows) -> Rounded:
    return tuple(map(tuple, values.tolist()))
