"""Parts that both pages share: the server, its looks, and the layer that shows segments.

Everything is shown in stage coordinates: the object's middle is the origin and half its longest side is 1, whatever
the input's unit, so that sizes of points, gizmos and clipping distances fit.
"""

import contextlib
import io
import logging
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from mereo.geometry.creases import split_at_creases
from mereo.geometry.mesh import Segment, SegmentedMesh, vertex_normals
from mereo.visualization.viewer.guard import Entry, bound_socket, guarded_servers
from mereo.visualization.viewer.tab_title import PROGRAM, titling

BACKDROP = ((58, 65, 78), (22, 25, 32))
"""Top and bottom of the background, neutral and dark: the palette's yellow is hard to see on white."""

ENVIRONMENT = 0.45
"""Share of viser's surrounding light; with all of it the palette's colours fade to white."""

CLOUD_COLOR = (244, 246, 250)
CLOUD_SIZES = (0.001, 0.012)
"""Smallest and largest size at which points start: what still shows, and what would be blobs in a sparse cloud."""

POINT_SHARE = 0.2
"""Share of the spacing of points that one takes, so that the surface is seen between them."""

SAMPLED = 1000
"""Points whose neighbours are measured."""

FOV_RAD = float(np.deg2rad(40.0))
"""Of the page's own camera."""

FEW = 6
"""More segments than this have their check boxes in a closed folder, or the panel would be all boxes."""


def import_viser() -> Any:
    """Module of viser; raises ``ImportError`` with a sentence on how to get it."""
    try:
        import viser
    except ImportError:
        raise ImportError("viser is not installed; `mereo view` needs it: run pip install 'mereo[view]'") from None
    return viser


def start_server(port: int, title: str, entry: Entry | None = None) -> Any:
    """Server of viser that answers its own page only (``guard``), by default on 127.0.0.1; port 0 means any.

    ``title`` is that of the browser's tab.

    Raises ``OSError`` where the port is taken, or the host no address of this machine, and ``ImportError`` for a viser
    that the guard does not know.
    """
    viser = import_viser()
    entry = entry or Entry()
    with bound_socket(entry.host, port) as probe:  # viser would silently take another port
        port = probe.getsockname()[1]
    # browsers open connections ahead and drop them, which websockets reports with a traceback each
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with (
        contextlib.redirect_stdout(io.StringIO()),
        guarded_servers(entry, titling(title)) as guards,
    ):  # without its own banner
        server = viser.ViserServer(host=entry.host, port=port, label=PROGRAM, verbose=False)
    if not guards:
        stop_server(server)
        raise ImportError(
            f"viser {viser.__version__} starts its server in a way that mereo cannot guard against other pages: run "
            "pip install 'viser==1.1.1'"
        )
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, control_width="medium", brand_color=(86, 180, 233)
    )
    server.gui.main_panel.dock_right()
    share = np.linspace(0.0, 1.0, 256)[:, None, None]
    backdrop = np.array(BACKDROP[0]) * (1 - share) + np.array(BACKDROP[1]) * share
    server.scene.set_background_image(np.broadcast_to(backdrop, (256, 8, 3)).astype(np.uint8), format="png")
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(environment_intensity=ENVIRONMENT)
    return server


def stop_server(server: Any) -> None:
    """Close all pages; without the line that viser prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def point_size(points: Float[np.ndarray, "n 3"]) -> float:
    """Size of points on the stage, from their median distance to the nearest neighbour, within ``CLOUD_SIZES``."""
    some = points[:: max(1, len(points) // SAMPLED)]
    apart = cKDTree(points).query(some, k=2)[0][:, 1] if len(points) > 1 else np.zeros(0)
    apart = apart[np.isfinite(apart) & (apart > 0)]  # repeated points have no spacing
    smallest, largest = CLOUD_SIZES
    return float(np.clip(POINT_SHARE * np.median(apart), smallest, largest)) if len(apart) else largest


@runtime_checkable
class Shown(Protocol):
    """Choice of the segments that are shown, and how opaque each is."""

    def visible(self) -> list[bool]:
        """Whether each segment is shown."""

    def opacity(self) -> list[float]:
        """Opacity of each segment, 0 to 1."""


class Display:
    """Stage of a page, on which things of the input's frame are placed.

    Attributes:
        server: server of viser.
        center: middle of the object in the input's frame.
        scale: stage units per unit of the input: ``stage = (input - center) * scale``.
        up: unit vector that is upwards on the page.
    """

    def __init__(self, server: Any, bounds: Float[np.ndarray, "2 3"], up: Float[np.ndarray, "3"]) -> None:
        self.server = server
        self.center = bounds.mean(axis=0)
        self.scale = 2.0 / max(float((bounds[1] - bounds[0]).max()), 1e-12)
        self.up = up / np.linalg.norm(up)
        server.scene.set_up_direction(tuple(self.up))

    def place(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the input's frame in stage coordinates."""
        return (points - self.center) * self.scale

    def back(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the stage in the input's frame."""
        return points / self.scale + self.center

    def show_points(self, name: str, points: Float[np.ndarray, "n 3"], visible: bool) -> None:
        """Show observed points, at places of the stage."""
        self.server.scene.add_point_cloud(
            name,
            points,
            CLOUD_COLOR,
            point_size=point_size(points),
            point_shape="circle",
            precision="float32",
            visible=visible,
        )

    def look_from(
        self,
        direction: Float[np.ndarray, "3"],
        bounds: Float[np.ndarray, "2 3"],
        room: float = 1.35,
        up: Float[np.ndarray, "3"] | None = None,
    ) -> None:
        """Turn every open page, and those to come, to what lies within ``bounds``, from this direction."""
        up = self.up if up is None else up
        low, high = self.place(bounds)
        target = (low + high) / 2
        distance = room * float(np.linalg.norm(high - low)) / 2 / np.sin(FOV_RAD / 2)
        position = tuple(target + distance * direction / np.linalg.norm(direction))
        first = self.server.initial_camera
        first.position, first.look_at, first.up = position, tuple(target), tuple(up)
        first.fov = FOV_RAD
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.position, client.camera.look_at = position, tuple(target)
                client.camera.up_direction = tuple(up)


class SegmentLayer:
    """Surfaces of an object on the stage, in the segments' colours or coloured vertex by vertex."""

    def __init__(self, stage: Display, name: str) -> None:
        self.stage, self.name = stage, name
        self.handles: list[Any] = []

    def show(
        self,
        mesh: SegmentedMesh,
        shown: Shown,
        colors: Sequence[UInt8[np.ndarray, "_ 3"]] | None = None,
        shift: Float[np.ndarray, "3"] | None = None,
    ) -> None:
        """Replace the surfaces that are shown.

        ``colors`` holds one colour per vertex for each segment; ``shift`` is on the stage. Surfaces keep their creases.
        """
        visible, opacity = shown.visible(), shown.opacity()
        offset = np.zeros(3) if shift is None else shift
        self.clear_from(len(mesh.segments))
        handles = []
        for k, whole in enumerate(mesh.segments):
            segment, source = split_at_creases(whole)
            name, is_on = f"{self.name}/{k}", visible[k] and len(segment.faces) > 0
            vertices = self.stage.place(segment.vertices) + offset if len(segment.vertices) else np.zeros((3, 3))
            faces = segment.faces if len(segment.faces) else np.array([[0, 1, 2]])
            add = self.stage.server.scene
            if colors is None or not len(segment.vertices):
                handles.append(
                    add.add_mesh_simple(
                        name,
                        vertices,
                        faces,
                        color=segment.color,
                        opacity=None if opacity[k] >= 1 else opacity[k],
                        side="double",
                        visible=is_on,
                    )
                )
            else:
                painted = _painted(segment, vertices, colors[k][source], opacity[k])
                handles.append(add.add_mesh_trimesh(name, painted, visible=is_on))
        self.handles = handles

    def clear_from(self, count: int = 0) -> None:
        """Take away the segments from this number on."""
        for handle in self.handles[count:]:
            handle.remove()
        self.handles = self.handles[:count]


def _painted(
    segment: Segment, vertices: Float[np.ndarray, "v 3"], colors: UInt8[np.ndarray, "v 3"], opacity: float
) -> trimesh.Trimesh:
    """A mesh with a colour at each vertex. glTF takes them as linear light, the screen's are sRGB."""
    screen = colors / 255.0
    linear = np.where(screen <= 0.04045, screen / 12.92, ((screen + 0.055) / 1.055) ** 2.4)
    rgba = np.column_stack([linear, np.full(len(linear), opacity)])
    return trimesh.Trimesh(
        vertices, segment.faces, vertex_normals=vertex_normals(segment), vertex_colors=rgba, process=False
    )


class SegmentControls:
    """Controls with a check box and an opacity slider for each segment."""

    def __init__(self, gui: Any, mesh: SegmentedMesh, changed: Any) -> None:
        with gui.add_folder("Segments", expand_by_default=len(mesh.segments) <= FEW):
            self._boxes = [gui.add_checkbox(segment.name, True) for segment in mesh.segments]
        with gui.add_folder("Opacity", expand_by_default=False):
            self._all = gui.add_slider("all", 0.0, 1.0, 0.05, 1.0)
            # what holds nested segments is see-through, or they would never be seen
            start = [1.0 if opaque else 0.35 for opaque in mesh.opaque]
            self._sliders = [
                gui.add_slider(segment.name, 0.0, 1.0, 0.05, value)
                for segment, value in zip(mesh.segments, start, strict=True)
            ]
        for handle in (*self._boxes, self._all, *self._sliders):
            handle.on_update(lambda _: changed())

    def visible(self) -> list[bool]:
        """Whether each segment is shown: its box is checked, and it is not wholly transparent."""
        return [bool(box.value) and value > 0 for box, value in zip(self._boxes, self.opacity(), strict=True)]

    def opacity(self) -> list[float]:
        """Opacity of each segment, 0 to 1: its own slider's times that of all."""
        return [float(self._all.value * slider.value) for slider in self._sliders]
