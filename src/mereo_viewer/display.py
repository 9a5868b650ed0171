"""Parts that the pages share: the stage, layer and controls of segments, observed points, views, pieces of HTML.

Everything is shown in stage coordinates: the object's middle is the origin and half its longest side is 1, whatever
the input's unit, so that sizes of points, gizmos and clipping distances fit.
"""

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import Color, Segment, SegmentedMesh, vertex_normals
from mereo.geometry.metrics import Scores, format_score
from mereo.geometry.subdivision import split_at_creases
from mereo.visualization.color_scales import ColorScale
from mereo.visualization.contact_sheets import Picture, enlarge

CLOUD_COLOR = (244, 246, 250)
CLOUD_SIZES = (0.001, 0.012)
"""Smallest and largest size at which points start: what still shows, and what would be blobs in a sparse cloud."""

POINT_SHARE = 0.2
"""Share of the spacing of points that one takes, so that the surface is seen between them."""

FOV_RAD = float(np.deg2rad(40.0))
"""Angle of view of the page's own camera."""

PICTURE_PX = 320
"""Width of a picture in the panel, to which small ones are enlarged: a browser would blur their pixels."""


def point_size(points: Float[np.ndarray, "n 3"]) -> float:
    """Size of points on the stage, from their median distance to the nearest neighbour, within ``CLOUD_SIZES``."""
    some = points[:: max(1, len(points) // 1000)]
    apart = cKDTree(points).query(some, k=2)[0][:, 1] if len(points) > 1 else np.zeros(0)
    apart = apart[np.isfinite(apart) & (apart > 0)]  # repeated points have no spacing
    smallest, largest = CLOUD_SIZES
    return float(np.clip(POINT_SHARE * np.median(apart), smallest, largest)) if len(apart) else largest


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

    def look_from(self, direction: Float[np.ndarray, "3"], bounds: Float[np.ndarray, "2 3"]) -> None:
        """Turn every open page, and those to come, to what lies within ``bounds``, from this direction."""
        low, high = self.place(bounds)
        target = (low + high) / 2
        distance = 1.35 * float(np.linalg.norm(high - low)) / 2 / np.sin(FOV_RAD / 2)
        position = tuple(target + distance * direction / np.linalg.norm(direction))
        first = self.server.initial_camera
        first.position, first.look_at, first.up, first.fov = position, tuple(target), tuple(self.up), FOV_RAD
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.position, client.camera.look_at = position, tuple(target)
                client.camera.up_direction = tuple(self.up)

    def add_views(
        self,
        toward: Callable[[], Float[np.ndarray, "3"]],
        bounds: Callable[[], Float[np.ndarray, "2 3"]],
        first: str = "camera",
    ) -> Callable[[str], None]:
        """Add buttons that turn the page to ``bounds`` as seen from ``toward`` (``first``), its side and its back.

        The page is turned to the first view at once. All are a little from above and from the side. Returns what turns
        the page to a view by its name.
        """

        def look(name: str) -> None:
            ahead = toward()
            side = np.cross(self.up, ahead)
            direction = {first: ahead, "side": side, "behind": -ahead}[name]
            self.look_from(direction + 0.28 * (np.cross(self.up, direction) + self.up), bounds())

        view = self.server.gui.add_button_group("View", (first, "side", "behind"))
        view.on_click(lambda _: look(view.value))
        look(first)
        return look


class SegmentControls:
    """Controls with a check box and an opacity slider for each segment."""

    def __init__(self, gui: Any, mesh: SegmentedMesh, changed: Callable[[], None]) -> None:
        with gui.add_folder("Segments", expand_by_default=len(mesh.segments) <= 6):  # or all would be boxes
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


class SegmentLayer:
    """Surfaces of an object on the stage, in the segments' colours or coloured vertex by vertex."""

    def __init__(self, stage: Display, name: str) -> None:
        self.stage, self.name = stage, name
        self.handles: list[Any] = []

    def show(
        self,
        mesh: SegmentedMesh,
        controls: SegmentControls,
        colors: Sequence[UInt8[np.ndarray, "_ 3"]] | None = None,
        shift: Float[np.ndarray, "3"] | None = None,
    ) -> None:
        """Replace the surfaces that are shown.

        ``colors`` holds one colour per vertex for each segment; ``shift`` is on the stage. Surfaces keep their creases.
        """
        visible, opacity = controls.visible(), controls.opacity()
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


class PointLayer:
    """Observed points on the stage, with a check box and a slider of their size; none are shown at first."""

    def __init__(self, stage: Display) -> None:
        self.stage = stage
        gui = stage.server.gui
        with gui.add_folder("Observed points"):
            self.box = gui.add_checkbox("show", True)
            self._size = gui.add_slider("size (%)", 0.05, 4.0, 0.05, 100 * CLOUD_SIZES[0])
        self._cloud: Any = None
        self.box.on_update(lambda _: self._update())
        self._size.on_update(lambda _: self._update())

    def show(self, cloud: PointCloud, shift: Float[np.ndarray, "3"] | None = None) -> None:
        """Replace the points; the first ones set the size. ``shift`` is on the stage."""
        points = self.stage.place(cloud.points) + (np.zeros(3) if shift is None else shift)
        if self._cloud is None:
            self._size.value = round(100 * point_size(points), 2)
        self._cloud = self.stage.server.scene.add_point_cloud(
            "/cloud", points, CLOUD_COLOR, point_size=0.01, point_shape="circle", precision="float32"
        )
        self._update()

    def _update(self) -> None:
        if self._cloud is not None:
            self._cloud.visible, self._cloud.point_size = bool(self.box.value), self._size.value / 100


def enlarged(picture: Picture) -> Picture:
    """Picture for the panel, of ``PICTURE_PX`` pixels across at least."""
    return picture if picture.shape[1] >= PICTURE_PX else enlarge(picture, PICTURE_PX)


# --- pieces of HTML ---------------------------------------------------------------------------------------------------

# Every text from outside is escaped.

SOFT = "opacity:.62"

BOX = "padding:2px 0.9em 6px;font-size:0.82em;line-height:1.5"


def css(color: Color) -> str:
    """Colour as CSS writes it."""
    return "rgb({},{},{})".format(*color)


def heading(title: str, text: str) -> str:
    """Heading of a panel: what the page is about."""
    return (
        f'<div style="padding:6px 0.75em 4px"><div style="font-weight:650;font-size:1.05em">{escape(title)}</div>'
        f'<div style="font-size:0.8em;{SOFT}">{escape(text)}</div></div>'
    )


def message(text: str, bad: bool = False) -> str:
    """Line on what is going on; "" is an empty line, so that nothing jumps."""
    color = "color:#e5484d" if bad else SOFT
    return f'<div style="{BOX};min-height:1.9em;{color}">{escape(text) or "&nbsp;"}</div>'


def chips(names: Sequence[str], colors: Sequence[Color]) -> str:
    """Chips that name the segments' colours."""
    each = "".join(
        f'<span style="white-space:nowrap;margin-right:11px"><span style="display:inline-block;width:10px;height:10px;'
        f'border-radius:3px;background:{css(color)};margin-right:5px"></span>{escape(name)}</span> '
        for name, color in zip(names, colors, strict=True)
    )
    return f'<div style="{BOX}">{each}</div>'


def color_bar(scale: ColorScale) -> str:
    """Bar with all colours of a scale, and what its ends mean."""
    stops = ",".join(css(color) for color in scale.stops)
    return (
        f'<div style="{BOX}"><div>{escape(scale.title)}</div><div style="height:9px;border-radius:5px;margin:3px 0;'
        f'background:linear-gradient(90deg,{stops})"></div><div style="display:flex;justify-content:space-between;'
        f'{SOFT}"><span>{escape(scale.words[0])}</span><span>{escape(scale.words[1])}</span></div></div>'
    )


def bars(rows: Sequence[tuple[str, Color, float]]) -> str:
    """Bars that show named numbers from 0 to 1; NaN is a dash."""
    cells = "".join(
        f"<div>{escape(name)}</div>"
        f'<div style="background:rgba(128,128,128,.22);border-radius:4px;height:7px;align-self:center"><div style="'
        f"width:{0 if np.isnan(value) else 100 * min(max(value, 0.0), 1.0):.1f}%;height:7px;border-radius:4px;"
        f'background:{css(color)}"></div></div>'
        f'<div style="text-align:right">{"–" if np.isnan(value) else f"{value:.2f}"}</div>'
        for name, color, value in rows
    )
    grid = "display:grid;grid-template-columns:minmax(4.5em,auto) 1fr 2.4em;gap:1px 9px"
    return f'<div style="{BOX};font-variant-numeric:tabular-nums;{grid}">{cells}</div>'


def score_table(scores: Scores, names: Sequence[str], colors: Sequence[Color]) -> str:
    """Scores: IoU and mIoU large, each segment below."""
    big = "".join(
        f'<div><div style="font-size:2.1em;font-weight:650;line-height:1.15">{format_score(value, "–")}</div>'
        f'<div style="{SOFT}">{label}</div></div>'
        for label, value in (("IoU, whole object", scores.iou), ("mIoU, segments", scores.miou))
    )
    head = f'<div style="{BOX};display:flex;gap:2em;font-variant-numeric:tabular-nums">{big}</div>'
    rows = [(name, color, float(value)) for name, color, value in zip(names, colors, scores.per_segment, strict=True)]
    return head + bars(rows)
