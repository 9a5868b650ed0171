"""Pages of the viewer, from Python: a result, a frame with its answer, or the laboratory of an object."""

from dataclasses import replace
from pathlib import Path

from mereo.api.objects import Source, object_of
from mereo.api.reconstruct import Isolation, reconstruct_observation, split_options
from mereo.api.words import python_words
from mereo.fitting.registration.answer import Answer
from mereo.geometry.transforms import Vector
from mereo.io.bounds import Port, check_value
from mereo.io.config import InputConfig
from mereo.io.errors import checked_path
from mereo.io.progress import shown_stages
from mereo.io.sensor_frame import read_frame
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import find_object
from mereo.scenes.registry import load_scene
from mereo.synthesis.sample_views import shipped_frame, shipped_frames, shipped_views
from mereo_viewer.laboratory import open_laboratory
from mereo_viewer.result_page import are_files, open_answer, open_files
from mereo_viewer.server import PORT, OpenPage, import_viser, is_interactive


@python_words()
def view(
    input: str | Path | Answer | None = None,
    object: Source = None,
    *,
    reading: InputConfig | None = None,
    isolation: Isolation = None,
    resolution: int = 128,
    port: int | None = None,
    block: bool | None = None,
) -> OpenPage:
    """Look at a result, at a frame and what is found in it, or at the laboratory of an object: ``mereo view``.

    On the page of a depth image a click on what the camera saw says where the object is, and it is answered there.

    Args:
        input: a point cloud or depth image; a result of `mereo reconstruct` (its folder); a GLB file, whose meshes are
            shown; a ``Result``; the name of a shipped frame. Without it the laboratory of ``object``, else a shipped
            frame.
        object: from ``load_object``, or whatever that takes: what is looked for in the frame.
        reading: how the frame is read.
        isolation: what of the frame is left out.
        resolution: grid cells along the longest side.
        port: where the page is; by default 8080 where this waits, else any that is free.
        block: wait until Ctrl-C; by default everywhere but in a notebook or an interactive session.

    Returns what closes the page; a notebook shows it as a frame with the page. Only this machine reaches it. Raises
    ``ImportError`` without the extra `view`, ``ValueError`` for a frame without its object, and as what is shown cannot
    be read.
    """
    import_viser()
    block = not is_interactive() if block is None else block
    port = (PORT if block else 0) if port is None else port
    check_value("port", port, Port, PORT)
    if isinstance(input, Answer):
        return open_answer(input, port).stay(block)
    if input is None and object is None:
        input = object = shipped_views()[0]
    path = None if input is None else checked_path(input, "input")
    if path is not None and are_files(path):
        if object is not None:
            raise ValueError(f"{path} is shown as it is, and no object is looked for: leave out --object and --weights")
        return open_files(path, port).stay(block)
    if object is None:
        raise ValueError(
            f"{path} is given without its object: name the object's meshes or scene with --object, or its --weights"
        )
    with shown_stages():
        known = object_of(object)
        if path is None:
            scene = known.scene
            if scene is None:
                scene = load_scene(known.name if known.network is None else str(known.network.provenance.get("scene")))
            page = open_laboratory(scene, known.network, known.registrar(), port)
        else:
            is_shipped = str(path) in shipped_frames() and not path.exists()
            frame = shipped_frame(str(path)) if is_shipped else read_frame(path, reading or InputConfig())
            (stated, _), image = split_options(isolation, {}), frame.depth

            def answer(isolation: IsolationConfig) -> Answer:
                seen = find_object(frame, isolation)
                return reconstruct_observation(seen, known, resolution=resolution, isolation=isolation)

            def answer_at(place: Vector) -> Answer:
                assert image is not None
                column, row = image.camera.project(place[None])[0].tolist()
                return answer(replace(stated, point=(column, row)))

            picks = None if image is None else (frame.cloud, answer_at)
            page = open_answer(answer(stated), port, picks)
    return page.stay(block)
