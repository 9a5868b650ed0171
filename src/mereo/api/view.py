"""Pages of the viewer, from Python: a result, a frame with its answer, or the laboratory of an object."""

from pathlib import Path

from mereo.api.objects import Object, Source, load_object
from mereo.api.reconstruct import reconstruct_observation
from mereo.api.words import python_words
from mereo.evaluation.sample_views import shipped_frame, shipped_frames, shipped_views
from mereo.fitting.registration.answer import Answer
from mereo.io.config import InputConfig
from mereo.io.progress import shown_stages
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.models.config import InferenceConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import find_object
from mereo.scenes.registry import load_scene
from mereo.visualization.viewer.laboratory import open_laboratory
from mereo.visualization.viewer.result_page import are_files, open_answer, open_files
from mereo.visualization.viewer.server import PORT, OpenPage, import_viser, is_interactive


@python_words()
def view(
    input: str | Path | Answer | None = None,
    weights: str | Path | None = None,
    *,
    object: Object | Source | None = None,
    scene: str | Path | None = None,
    units: str | None = None,
    port: int | None = None,
    resolution: int = 128,
    reading: InputConfig | None = None,
    isolation: IsolationConfig | None = None,
    inference: InferenceConfig | None = None,
    block: bool | None = None,
) -> OpenPage:
    """Look at a result, at a frame and what is found in it, or at the laboratory of an object: ``mereo view``.

    Args:
        input: a point cloud or depth image; a result of `mereo reconstruct` (its folder); a GLB file, whose meshes are
            shown; a ``Result``; the name of a shipped frame. Without it the laboratory of ``object`` or ``scene``, else
            a shipped frame.
        weights: a shipped name or a file; those of a shipped frame by default.
        object: what is looked for in the frame, as for ``reconstruct``.
        scene: open the laboratory of this scene: its name, or a scene file.
        units: of the object's meshes: "mm", "cm", "m" or "in"; guessed where not given.
        port: where the page is; by default 8080 where this waits, else any that is free.
        resolution: grid cells along the longest side.
        reading: how the frame is read.
        isolation: what of the frame is left out.
        inference: where and how exactly the network computes.
        block: wait until Ctrl-C; by default everywhere but in a notebook or an interactive session.

    Returns what closes the page; a notebook shows it as a frame with the page. Only this machine reaches it. Raises
    ``ImportError`` without the extra `view`, ``ValueError`` for both a frame and a scene, and as what is shown cannot
    be read.
    """
    import_viser()
    block = not is_interactive() if block is None else block
    port = (PORT if block else 0) if port is None else port
    if isinstance(input, Answer):
        return open_answer(input, port).stay(block)
    path = None if input is None else Path(input)
    if scene is not None:
        if path is not None or object is not None:
            other = "--object" if path is None else path
            raise ValueError(f"both {other} and --scene {scene} are given; one can be shown: drop one")
        object = load_scene(scene)
    if path is not None and are_files(path):
        if weights is not None or object is not None:
            given = "--object" if weights is None else f"--weights {weights}"
            raise ValueError(f"{path} is shown as it is, and {given} is not asked: leave it out")
        return open_files(path, port).stay(block)
    with shown_stages():
        if path is None and object is not None:
            page = _open_laboratory(_loaded(object, weights, units, inference), port)
        else:
            frame, weights = _frame(path, weights, object is not None, reading or InputConfig())
            known, isolation = _loaded(object, weights, units, inference), isolation or IsolationConfig()
            seen = find_object(frame, isolation)
            page = open_answer(reconstruct_observation(seen, known, resolution=resolution, isolation=isolation), port)
    return page.stay(block)


def _frame(
    path: Path | None, weights: str | Path | None, has_object: bool, reading: InputConfig
) -> tuple[SensorFrame, str | Path | None]:
    """Frame of a path, or the shipped one of weights, and the weights of its object; ``ValueError`` without either."""
    if path is None:
        name = str(weights or shipped_views()[0])
        if name not in shipped_views():
            raise ValueError(
                f"there is no frame to show and none is shipped for {name!r}; name a depth image or a point cloud, or "
                f"take the weights of a shipped frame: {', '.join(shipped_views())}"
            )
        return shipped_frame(name), name
    if weights is None and not has_object:
        raise ValueError(
            f"{path} is given without its object: name the object's meshes or scene with --object, or its --weights"
        )
    is_shipped = str(path) in shipped_frames() and not path.exists()
    return shipped_frame(str(path)) if is_shipped else read_frame(path, reading), weights


def _loaded(
    object: Object | Source | None, weights: str | Path | None, units: str | None, inference: InferenceConfig | None
) -> Object:
    """Object that is given, by its weights alone where there is none; raises as ``load_object`` does."""
    if isinstance(object, Object):
        return object
    inference = inference or InferenceConfig()
    return load_object(object, weights=weights, units=units, device=inference.device, precision=inference.precision)


def _open_laboratory(object: Object, port: int) -> OpenPage:
    """Open the laboratory of an object; raises ``ValueError`` where weights know no scene."""
    scene = object.scene
    if scene is None and object.network is not None:
        scene = load_scene(str(object.network.provenance.get("scene")))
    assert scene is not None  # what has no weights has a scene
    return open_laboratory(scene, object.network, object.registrar(), port)
