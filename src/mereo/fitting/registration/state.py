"""Registrations and their states: the same material points again, from the weights and, for draws, the scene.

    Registration -state_of-> RegistrationState -save_state, load_state-> Registration

A state holds coefficients or draws, and the pose; neither meshes nor anything of the frame. A digest of the statistical
model tells weights apart, and a few witnesses tell a scene that has changed since.
"""

import hashlib
import json
from importlib.metadata import version
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mereo.fitting.draws.playback import Drawn, material_moved, shares_of
from mereo.fitting.problem.noise import ACCEPTED
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import CURE, other_mesh
from mereo.fitting.registration.registration import BELIEVED, Registration
from mereo.fitting.registration.state_file import (
    FORMAT,
    STATE,
    WITNESSES,
    RegistrationState,
    StateDraws,
    read_state,
    save_state,
)
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.transforms import fit_rigid, transform_points
from mereo.scenes.draw_recorder import SMOOTH
from mereo.scenes.given_draws import draw_names, played_back
from mereo.scenes.parameters import Played
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, Scene
from mereo.scenes.statistical_model import StatisticalModel

AGREE = 1e-3
"""Distance, of half the rest box's longest side, up to which a state that is played again is the same."""

Rows = tuple[tuple[float, ...], ...]


def model_digest(model: StatisticalModel) -> str:
    """SHA-256 of what the numbers of a state mean: the rest mesh, the mean and the modes."""
    digest = hashlib.sha256(json.dumps(list(model.rest.names)).encode())
    vertices, faces, _ = model.rest.merged()
    for values in (vertices, faces, model.nodes, model.node_labels, model.mean, model.modes):
        digest.update(f"{values.shape}".encode())
        digest.update(np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def state_of(
    registration: Registration,
    scene: Scene | str,
    *,
    weights: str = "",
    frame: CloudAxes = "camera",
    unit_m: float | None = None,
    T_camera_input: Float[np.ndarray, "4 4"] | None = None,
) -> RegistrationState:
    """State of a registration.

    Args:
        registration: in the camera frame and the input's unit.
        scene: of the object; for modes its name is enough.
        weights: how they were named, so that the viewer finds them.
        frame: axes of the input.
        unit_m: metres in the input's unit; None where that is not known.
        T_camera_input: from the input's frame to the camera frame; by default they are the same.

    Raises ``ValueError`` for draws without their scene.
    """
    model, drawn, draws = registration.model, registration.drawn, None
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
        T_camera_model=rows(fit_rigid(registration.scene_unit * unposed, registration.material)),
        scene_unit=registration.scene_unit,
        unit_m=unit_m,
        frame=frame,
        T_camera_input=rows(np.eye(4) if T_camera_input is None else T_camera_input),
        explained=registration.explained,
        unit_known=registration.unit_known,
        accepted=registration.accepted,
        seconds=registration.seconds,
        witness=rows(registration.material[witnesses(model)]),
    )


def write_state(directory: Path, answer: Answer) -> None:
    """Write the state of an answer into a folder of results, where the answer is a registered model."""
    registrar = answer.registrar
    if registrar is None or answer.registration is None or not answer.taken:
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


def load_state(path: str | Path, model: StatisticalModel, scene: Scene | None = None) -> Registration:
    """Registration from its state, in the camera frame and the input's unit.

    Args:
        path: the file, or the folder of results that has it.
        model: statistical model of the weights that it was made with.
        scene: of a state of draws, where it is not a built-in one.

    Raises as ``read_state`` and ``restored`` do.
    """
    state = read_state(path)
    try:
        return restored(state, model, scene)
    except ValueError as error:
        raise ValueError(f"{path} does not lead to a registration: {error}") from None


def restored(state: RegistrationState, model: StatisticalModel, scene: Scene | None = None) -> Registration:
    """Registration of a state; raises ``ValueError`` for another model, and for draws as ``played_state`` does."""
    if model_digest(model) != state.model:
        raise ValueError(
            f"the state belongs to the statistical model of other weights (scene {state.scene!r}, weights "
            f"{state.weights!r}); its numbers mean nothing here: name those weights with --weights"
        )
    unposed, drawn = _unposed(state, model, scene)
    material = transform_points(np.array(state.T_camera_model), state.scene_unit * unposed)
    off = float(np.abs(material[witnesses(model)] - np.array(state.witness)).max()) / state.scene_unit
    if off > AGREE * model.half:
        raise ValueError(
            f"the state leads {off:.2g} scene units away from where mereo {state.mereo} found it: the scene "
            f"{state.scene!r} has changed since, or the file: register the frame again"
        )
    return Registration(
        model=model,
        material=material,
        method=state.method,
        z=np.array(state.z, dtype=np.float64),
        scene_unit=state.scene_unit,
        explained=state.explained,
        unit_known=state.unit_known,
        accepted=state.accepted,
        seconds=state.seconds,
        drawn=drawn,
        # the file does not say it; what is believed with less than a clean frame needs is noisy, or agrees otherwise
        needed=ACCEPTED if state.accepted and state.explained < BELIEVED else BELIEVED,
    )


def played_state(state: RegistrationState, scene: Scene) -> Played:
    """State of the scene that the draws lead to.

    Raises ``ValueError`` for a state of modes, for another scene, and where the scene does not take the draws.
    """
    if state.draws is None:
        raise ValueError(f"the state of {state.scene!r} is one of modes; it has no draws that a scene could play")
    if scene.name != state.scene:
        raise ValueError(f"the state is one of the scene {state.scene!r}, not of {scene.name!r}: name that scene")
    return played_back(scene, state.draws.seed, shares_of(np.array(state.z), state.draws.sizes))


def scene_of(state: RegistrationState) -> Scene:
    """Scene of a state where it is built in; ``ValueError`` for others: a name from a file never runs another one."""
    if state.scene not in SCENES:
        raise ValueError(
            f"the state belongs to the scene {state.scene!r}, which is not built in: name its file with --scene"
        )
    return load_scene(state.scene)


def _unposed(
    state: RegistrationState, model: StatisticalModel, scene: Scene | None
) -> tuple[Float[np.ndarray, "m 3"], Drawn | None]:
    """Material points in scene units, before the pose, and the draws that lead there."""
    z = np.array(state.z, dtype=np.float64)
    if state.draws is None:
        if len(z) != model.count:
            raise ValueError(
                f"the state has {len(z)} coefficients, but the model has {model.count} modes; the file is damaged: "
                "register the frame again"
            )
        return (model.rest_points if state.method == "rest" else model.material(z)), None
    scene = scene_of(state) if scene is None else scene
    played = played_state(state, scene)
    fault = other_mesh(scene, model)
    if fault is not None:
        raise ValueError(f"{fault}: {CURE}")
    smooth = np.concatenate([np.full(len(call.shares), call.kind in SMOOTH) for call in played.calls])
    return material_moved(scene, model, played.deformations), Drawn(state.draws.seed, z, state.draws.sizes, smooth)


def witnesses(model: StatisticalModel) -> Int[np.ndarray, " w"]:
    """A few material points of all segments."""
    return np.linspace(0, len(model.mean) - 1, WITNESSES).astype(np.int64)


def rows(values: Float[np.ndarray, "n c"]) -> Rows:
    """Rows of a matrix as JSON has them."""
    return tuple(tuple(float(value) for value in row) for row in values)
