"""``mereo view``: load what is to be shown, and open its page."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mereo.evaluation.sample_views import shipped_frame, shipped_views
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.register import registrar_for, statistical_model_of
from mereo.fitting.registration.state import RegistrationState, is_state, played_state, read_state, restored
from mereo.io.config import InputConfig
from mereo.io.glb_scene import is_glb
from mereo.io.progress import shown_stages
from mereo.io.sensor_frame import read_frame
from mereo.models.config import InferenceConfig
from mereo.models.trained import Trained
from mereo.models.weights_place import find_weights, load_weights, shipped_names
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation, find_object
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, Scene
from mereo.synthesis.recording import is_recording_folder, read_recording
from mereo.visualization.result_scene import scene_of_result
from mereo.visualization.units import Unit
from mereo.visualization.viewer.display import import_viser, start_server
from mereo.visualization.viewer.frame_page import FramePage
from mereo.visualization.viewer.freedom import DrawnShapes, Freedom, ModeShapes
from mereo.visualization.viewer.guard import LOOPBACK, Entry
from mereo.visualization.viewer.kept_result import KeptResult, is_kept
from mereo.visualization.viewer.mesh_page import view_glb, view_kept
from mereo.visualization.viewer.open_page import OpenPage, is_interactive
from mereo.visualization.viewer.panels import DepthPicture
from mereo.visualization.viewer.probe import Inspection
from mereo.visualization.viewer.result_page import open_answer
from mereo.visualization.viewer.sequence_page import view_recording
from mereo.visualization.viewer.tab_title import tab_title

PORT = 8080
"""Port of the page where none is chosen."""


def view(
    input: str | Path | Answer | None = None,
    weights: str | Path | None = None,
    *,
    scene: str | None = None,
    state: str | Path | None = None,
    port: int | None = None,
    host: str = LOOPBACK,
    resolution: int = 128,
    reading: InputConfig | None = None,
    isolation: IsolationConfig | None = None,
    inference: InferenceConfig | None = None,
    block: bool | None = None,
) -> OpenPage:
    """Look at a frame and its reconstruction in a browser, or move a scene by hand: ``mereo view``.

    Args:
        input: a point cloud or depth image; a folder of `mereo scene record`, which is played; a result of
            `mereo reconstruct` (the folder, or its state.json), by the scene file that its summary names; a GLB file,
            whose meshes are shown; a ``Result``; without it (and ``scene``) a shipped frame.
        weights: a shipped name or a file; by default those of the state, or those shipped for the frame or the scene.
        scene: open the laboratory of this scene: its name, or a scene file.
        state: a result with a registered model: shown on the frame, or where the laboratory's sliders start.
        port: where the page is; by default ``PORT`` where this waits, else any that is free.
        host: address of this machine that the page is at; only this machine reaches the default.
        resolution: grid cells along the longest side.
        reading: how the frame is read.
        isolation: what of the frame is left out.
        inference: where and how exactly the network computes.
        block: wait until Ctrl-C; by default everywhere but in a notebook or an interactive session.

    Returns what closes the page; a notebook shows it as a frame with the page. Raises ``ImportError`` without the extra
    `view`, ``ValueError`` for both a frame and a scene, and as what is shown cannot be read.
    """
    block = not is_interactive() if block is None else block
    place = (PORT if block else 0) if port is None else port
    if isinstance(input, Answer):
        return open_answer(input, port=place, host=host).stay(block)
    path, known = (None if value is None else Path(value) for value in (input, state))
    named = None if weights is None else str(weights)
    if known is None and is_state(path) and not (named is None and path is not None and is_kept(path)):
        path, known = None, path
    if path is not None and scene is None and is_recording_folder(path):
        return view_recording(read_recording(path), named, place, host, inference).stay(block)
    if path is not None and scene is None and known is None and (is_glb(path) or is_kept(path)):
        if named is not None:
            raise ValueError(f"{path} is shown as it is, and --weights {named} are not asked: leave them out")
        return (view_glb if is_glb(path) else view_kept)(path, place, host).stay(block)
    if scene is not None:
        if path is not None:
            raise ValueError(f"both {path} and --scene {scene} are given; one can be shown: drop one")
        return view_scene(scene, named, state=known, port=place, host=host, inference=inference).stay(block)
    show = partial(view_frame, resolution=resolution) if known is None else partial(view_state, known)
    page = show(path, named, port=place, host=host, reading=reading, isolation=isolation, inference=inference)
    return page.stay(block)


def view_frame(
    input: Path | None,
    weights: str | None,
    *,
    port: int = PORT,
    host: str = LOOPBACK,
    resolution: int = 128,
    reading: InputConfig | None = None,
    isolation: IsolationConfig | None = None,
    inference: InferenceConfig | None = None,
) -> OpenPage:
    """Show a frame and the default answer to it; without ``input`` the shipped frame of the weights."""
    import_viser()
    if input is None:
        name = weights or shipped_views()[0]
        if name not in shipped_views():
            raise ValueError(
                f"there is no frame to show and none is shipped for {name!r}; name a depth image or a point cloud, or "
                f"take the weights of a shipped frame: {', '.join(shipped_views())}"
            )
        frame, weights = shipped_frame(name), name
    elif weights is None:
        raise ValueError(
            f"{input} is given without weights; the model of its object is needed: give --weights, a file or one of "
            f"{', '.join(shipped_names())}"
        )
    else:
        frame = read_frame(input, reading or InputConfig())
    model = load_weights(weights, inference or InferenceConfig())
    isolation = isolation or IsolationConfig()
    seen = find_object(frame, isolation)
    registrar = registrar_for(model, "auto")
    with shown_stages():
        answer = answer_frame(seen, model, registrar, keep_all=isolation.keep_all, resolution=resolution)
        return open_answer(answer, port=port, host=host)


def view_state(
    path: Path,
    input: Path | None,
    weights: str | None,
    *,
    port: int = PORT,
    host: str = LOOPBACK,
    reading: InputConfig | None = None,
    isolation: IsolationConfig | None = None,
    inference: InferenceConfig | None = None,
) -> OpenPage:
    """Show a registration by its state (a file, or a folder of results), with its frame where ``input`` names it."""
    import_viser()
    state = read_state(path)
    seen = None if input is None else _seen(input, reading, isolation)
    frame = None if seen is None else seen.frame
    if frame is not None and (frame.axes != state.frame or frame.unit_m not in (None, state.unit_m)):
        raise ValueError(
            f"{input} is read with {frame.axes} axes and {frame.metres:g} m per unit, but the state has {state.frame} "
            f"axes and {state.unit_m or 1.0:g} m; they must be of one frame: give the same --frame and --unit-m as "
            "before"
        )
    weights = weights_of(state, weights)
    model = load_weights(weights, inference or InferenceConfig())
    plays = state.draws is not None and state.scene not in SCENES
    registration = restored(state, statistical_model_of(model), scene_of_result(path) if plays else None)
    cloud = None if seen is None else seen.cloud
    kept = KeptResult() if seen is not None else KeptResult.of(path)
    T_camera_input = np.array(state.T_camera_input)
    inspection = Inspection.of_registration(registration, model, T_camera_input, kept.cloud if cloud is None else cloud)
    inspection = replace(inspection, radii=kept.radii(inspection.surfaces), source=kept.verdict or inspection.source)
    title = (kept.title or str(path)) if frame is None else frame.source
    facts, unit = f"{state.scene} · weights {weights}", kept.unit or Unit(state.unit_m)
    depth = kept.depth if frame is None else DepthPicture.of(frame.depth, unit)
    entry = Entry.of(host)
    server = start_server(port, tab_title(title), entry)
    FramePage(server, inspection, title, facts, unit, depth)
    return OpenPage(server, entry)


def _seen(path: Path, reading: InputConfig | None, isolation: IsolationConfig | None) -> Observation:
    """The object in a file's frame."""
    return find_object(read_frame(path, reading or InputConfig()), isolation or IsolationConfig())


def view_scene(
    name: str,
    weights: str | None,
    *,
    state: Path | None = None,
    port: int = PORT,
    host: str = LOOPBACK,
    inference: InferenceConfig | None = None,
) -> OpenPage:
    """Show the laboratory of a scene, in a state where one is given.

    Without ``weights`` it takes those of the state, or the shipped ones where there are any.
    """
    import_viser()
    from mereo.visualization.viewer.lab_page import LabPage  # these score, for which they load torch
    from mereo.visualization.viewer.laboratory import Laboratory

    scene = load_scene(name)
    chosen = None if state is None else read_state(state)
    known = weights_of(chosen, weights) if chosen is not None else weights
    known = known or (scene.name if scene.name in shipped_names() else None)
    model = None if known is None else load_weights(known, inference or InferenceConfig())
    laboratory = Laboratory(scene, model, shapes=None if chosen is None else shapes_of(chosen, scene, model))
    facts = f"weights {known}" if known else "no weights: states and depth images only"
    entry = Entry.of(host)
    title = f"Laboratory: {scene.name}"
    server = start_server(port, tab_title(title), entry)
    page = LabPage(server, laboratory, title, facts)
    return OpenPage(server, entry, page)


def shapes_of(state: RegistrationState, scene: Scene, model: Trained | None) -> Freedom[Any]:
    """What the sliders of a state move: the scene's draws, or the modes of the weights' statistical model.

    Raises ``ValueError`` as ``played_state`` does, and for the modes of other weights.
    """
    if state.draws is not None:
        return DrawnShapes(scene, played_state(state, scene))
    if model is None:
        raise ValueError(
            f"the state is one of the modes of weights {state.weights!r}, which are needed: name them with --weights"
        )
    registration = restored(state, statistical_model_of(model))
    return ModeShapes(scene.name, registration.model, registration.z)


def weights_of(state: RegistrationState, weights: str | None) -> str:
    """Weights to be loaded for a state: the given ones, else those that it names, else those shipped for its scene."""
    if weights is not None:
        return weights
    known = state.weights or state.scene
    try:
        find_weights(known)
    except FileNotFoundError:
        raise FileNotFoundError(
            f"the state was made with the weights {known!r}, which are not here: name them with --weights"
        ) from None
    return known
