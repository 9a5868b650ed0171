"""``mereo view``: load what is to be shown, start the page, keep it until Ctrl-C."""

import threading
from pathlib import Path
from typing import Any

from mereo.evaluation.sample_views import load_view, shipped_views
from mereo.geometry.conventions import CloudAxes
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import read_frame
from mereo.models.config import InferenceConfig
from mereo.models.weights import load_for, shipped_names
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import find_object
from mereo.scenes.registry import load_scene
from mereo.visualization.viewer.display import import_viser, start_server, stop_server
from mereo.visualization.viewer.frame_page import FramePage
from mereo.visualization.viewer.lab_page import LabPage
from mereo.visualization.viewer.laboratory import Laboratory
from mereo.visualization.viewer.probe import Inspection

PORT = 8080
"""Port of the page where none is chosen."""


def view_frame(
    input: Path | None,
    weights: str | None,
    *,
    port: int = PORT,
    resolution: int = 128,
    reading: InputConfig | None = None,
    isolation: IsolationConfig | None = None,
    inference: InferenceConfig | None = None,
) -> None:
    """Show a frame and its reconstruction; without ``input`` the shipped frame of the weights."""
    import_viser()
    frame: CloudAxes
    if input is None:
        name = weights or shipped_views()[0]
        if name not in shipped_views():
            raise ValueError(
                f"there is no frame to show and none is shipped for {name!r}; name a depth image or a point cloud, or "
                f"take the weights of a shipped frame: {', '.join(shipped_views())}"
            )
        cloud, title, weights = load_view(name).depth.to_points(), f"{name}, shipped frame", name
        frame, unit = "camera", ""
    elif weights is None:
        raise ValueError(
            f"{input} is given without weights; the model of its object is needed: give --weights, a file or one of "
            f"{', '.join(shipped_names())}"
        )
    else:
        read = read_frame(input, reading or InputConfig())
        cloud = find_object(read, isolation or IsolationConfig()).cloud
        title, frame, unit = read.source, read.axes, "m" if read.unit_m == 1.0 else ""
    inspection = Inspection.of(cloud, load_for(weights, inference or InferenceConfig()), resolution, frame)
    server = start_server(port, "mereo")
    FramePage(server, inspection, title, f"{len(cloud):,} points · weights {weights}", unit)
    _serve(server)


def view_scene(name: str, weights: str | None, *, port: int = PORT, inference: InferenceConfig | None = None) -> None:
    """Show the laboratory of a scene; without ``weights`` the shipped ones, where there are any."""
    import_viser()
    scene = load_scene(name)
    known = weights or (scene.name if scene.name in shipped_names() else None)
    laboratory = Laboratory(scene, None if known is None else load_for(known, inference or InferenceConfig()))
    facts = f"weights {known}" if known else "no weights: states and depth images only"
    server = start_server(port, "mereo")
    page = LabPage(server, laboratory, f"Laboratory: {scene.name}", facts)
    _serve(server, page)


def _serve(server: Any, page: LabPage | None = None) -> None:
    print(f"open http://127.0.0.1:{server.get_port()} in a browser; Ctrl-C ends", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print("closed")
    finally:
        if page is not None:
            page.close()
        stop_server(server)
