"""``mereo view FRAME --object ...``: the frame is answered, and the page of the answer opened."""

from typing import TYPE_CHECKING

from mereo.api.reconstruct import reconstruct
from mereo.cli.object_option import loaded_object
from mereo.evaluation.sample_views import shipped_frame, shipped_frames
from mereo.io.progress import shown_stages
from mereo.io.sensor_frame import read_frame
from mereo.visualization.viewer.display import import_viser
from mereo.visualization.viewer.result_page import open_answer

if TYPE_CHECKING:
    from mereo.cli.tool_commands import ViewCommand


def view_object(command: "ViewCommand") -> None:
    """Find an object in a frame, and keep the page of the answer open until Ctrl-C.

    Raises ``ValueError`` without a frame, and for options that belong to a scene or a result.
    """
    if command.input is None:
        raise ValueError("no frame is given; --object is looked for in one: mereo view FRAME --object PART.stl")
    if command.state is not None:
        raise ValueError(f"--state is {command.state}, which has its own object: leave out --object")
    import_viser()
    with shown_stages():
        known = str(command.input) in shipped_frames() and not command.input.exists()
        frame = shipped_frame(str(command.input)) if known else read_frame(command.input, command.reading)
        found = loaded_object(command.object, command.weights, command.scene, command.units, command.inference)
        result = reconstruct(frame, found, resolution=command.resolution, isolation=command.isolation)
        page = open_answer(result, port=command.port, host=command.host)
    page.stay(True)
