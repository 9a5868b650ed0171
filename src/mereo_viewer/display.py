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
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import Color, Segment, SegmentedMesh, vertex_normals
from mereo.geometry.metrics import Scores, format_score
from mereo.geometry.subdivision import split_at_creases
from mereo.visualization.color_scales import ColorScale
from mereo.visualization.contact_sheets import Picture, enlarge
from mereo.visualization.renderer import opacities

CLOUD_COLOR = (244, 246, 250)
MOST_SIZE = 0.012
"""Largest size at which points start on the stage: sparse ones would be blobs."""

FOV_RAD = float(np.deg2rad(40.0))
"""Angle of view of the page's own camera."""

AXIS_COLORS: tuple[Color, ...] = ((229, 72, 77), (70, 167, 88), (76, 141, 245))
"""Of x, y, z."""

MOST_BUTTONS = 12
"""Segments from which on their folder is folded at first: it would fill the panel."""

EYES = "eye-off", "eye"
"""Icons of segments that are hidden and shown."""

PICTURE_PX = 320
"""Width of a picture in the panel, to which small ones are enlarged: a browser would blur their pixels."""


def point_size(count: int) -> float:
    """Size on the stage of so many points: a tenth of their spacing, so that the surface is seen between them."""
    return min(0.2 / max(count, 1) ** 0.5, MOST_SIZE)


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
        server.on_client_connect(lambda client: self._turn(client.camera, client.camera.aspect))

    def place(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the input's frame in stage coordinates."""
        return (points - self.center) * self.scale

    def back(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the stage in the input's frame."""
        return points / self.scale + self.center

    def add_panel(self, title: str) -> Any:
        """Add a panel at the right and return its tab, a context; pages below 600 pixels show it folded.

        Of several pages the one that was opened last decides: viser folds a panel for all. A phone folds it by itself.
        """
        panel = self.server.gui.add_panel()
        panel.dock_right()
        self.server.on_client_connect(
            lambda client: (panel.minimize if client.camera.image_width < 600 else panel.expand)()
        )
        return panel.add_tab(title)

    def add_axes(self, corner: Float[np.ndarray, "3"], length: float, text: str) -> None:
        """Draw the axes of the input's frame from a corner, each as long as ``length``, for which ``text`` stands."""
        ends = self.place(corner + length * np.eye(3))
        lines = np.stack([np.broadcast_to(self.place(corner), (3, 3)), ends], axis=1)
        scene = self.server.scene
        colors = np.repeat(np.array(AXIS_COLORS)[:, None], 2, axis=1)
        scene.add_line_segments("/axes", lines, colors, thickness=3.0, thickness_units="screen")
        for name, end in zip("xyz", ends, strict=True):
            scene.add_label(f"/axes/{name}", f"{name} {text}", position=tuple(end), anchor="center-center")

    def look_from(self, direction: Float[np.ndarray, "3"], bounds: Float[np.ndarray, "2 3"]) -> None:
        """Turn every open page, and those to come, to what lies within ``bounds``, from this direction."""
        low, high = self.place(bounds)
        self._view = direction / np.linalg.norm(direction), (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        first = self.server.initial_camera
        first.up, first.fov = tuple(self.up), FOV_RAD
        self._turn(first, 1.0)
        for client in self.server.get_clients().values():
            with client.atomic():
                self._turn(client.camera, client.camera.aspect)

    def _turn(self, camera: Any, aspect: float) -> None:
        """Turn the camera of a page of this width by height, which is narrow on a phone, to what is looked at."""
        ahead, target, radius = self._view
        half_angle = np.arctan(min(aspect, 1.0) * np.tan(FOV_RAD / 2))
        camera.position, camera.look_at = tuple(target + radius / np.sin(half_angle) * ahead), tuple(target)

    def add_views(
        self,
        toward: Callable[[], Float[np.ndarray, "3"]],
        bounds: Callable[[], Float[np.ndarray, "2 3"]],
    ) -> Callable[[str], None]:
        """Add buttons that turn the page to ``bounds`` as seen from ``toward``, its side and its back.

        The page is turned to the first view at once. All are a little from above and from the side. Returns what turns
        the page to a view by its name.
        """

        def look(name: str) -> None:
            ahead = toward()
            side = np.cross(self.up, ahead)
            direction = {"front": ahead, "side": side, "behind": -ahead}[name]
            self.look_from(direction + 0.28 * (np.cross(self.up, direction) + self.up), bounds())

        view = self.server.gui.add_button_group("View", ("front", "side", "behind"))
        view.on_click(lambda _: look(view.value))
        look("front")
        return look


class SegmentControls:
    """Controls with a button in each segment's colour, which is the legend and shows or hides it, and its opacity."""

    def __init__(self, gui: Any, mesh: SegmentedMesh, changed: Callable[[], None]) -> None:
        self._colors, self._shown, self._changed = mesh.colors, [True] * len(mesh.segments), changed
        with gui.add_folder("Segments", expand_by_default=len(mesh.segments) <= MOST_BUTTONS):
            self._buttons = [gui.add_button(s.name, color=s.color, icon=EYES[1]) for s in mesh.segments]
        with gui.add_folder("Opacity", expand_by_default=False):
            # what is around others is see-through, or they would never be seen
            self._sliders = [
                gui.add_slider(segment.name, 0.0, 1.0, 0.05, value)
                for segment, value in zip(mesh.segments, opacities(mesh), strict=True)
            ]
        for index, button in enumerate(self._buttons):
            button.on_click(lambda _, index=index: self.switch(index))
        for slider in self._sliders:
            slider.on_update(lambda _: changed())

    def switch(self, index: int) -> None:
        """Hide a segment that is shown, and show one that is not."""
        self._shown[index] = not self._shown[index]
        self._buttons[index].icon = EYES[self._shown[index]]
        self._changed()

    def name_colors(self, are_shown: bool) -> None:
        """Let the buttons have the segments' colours or none: where colours are numbers, these have the only legend."""
        for button, color in zip(self._buttons, self._colors, strict=True):
            button.color = color if are_shown else "gray"

    def visible(self) -> list[bool]:
        """Whether each segment is shown, and not wholly transparent."""
        return [shown and value > 0 for shown, value in zip(self._shown, self.opacity(), strict=True)]

    def opacity(self) -> list[float]:
        """Opacity of each segment, 0 to 1."""
        return [float(slider.value) for slider in self._sliders]


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
        visible = controls.visible()
        opacity = controls.opacity()
        offset = np.zeros(3) if shift is None else shift
        self.clear_from(len(mesh.segments))
        handles = []
        for k, whole in enumerate(mesh.segments):
            segment, source = split_at_creases(whole)
            name = f"{self.name}/{k}"
            is_on = visible[k] and len(segment.faces) > 0
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
    # without a material it would shine as metal does, whose colours are none of a legend's
    visual = TextureVisuals(material=PBRMaterial(metallicFactor=0.0))
    visual.vertex_attributes["color"] = np.rint(255 * rgba).astype(np.uint8)
    return trimesh.Trimesh(
        vertices, segment.faces, vertex_normals=vertex_normals(segment), visual=visual, process=False
    )


class PointLayer:
    """Observed points on the stage, with a check box and a slider of their size; none are shown at first."""

    def __init__(self, stage: Display) -> None:
        self.stage = stage
        gui = stage.server.gui
        with gui.add_folder("Observed points"):
            self.box = gui.add_checkbox("show", True)
            self._size = gui.add_slider("size (%)", 0.05, 4.0, 0.05, 100 * MOST_SIZE)
        self._cloud: Any = None
        self.box.on_update(lambda _: self._update())
        self._size.on_update(lambda _: self._update())

    def show(self, cloud: PointCloud, shift: Float[np.ndarray, "3"] | None = None) -> None:
        """Replace the points; the first ones set the size. ``shift`` is on the stage."""
        points = self.stage.place(cloud.points) + (np.zeros(3) if shift is None else shift)
        if self._cloud is None:
            self._size.value = round(100 * point_size(len(points)), 2)
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


def hint(text: str) -> str:
    """How to turn a page, by mouse or by hand, and a line below."""
    return (
        "<style>@media(pointer:coarse){.mouse{display:none}}@media not (pointer:coarse){.fingers{display:none}}</style>"
        f'<div style="{BOX};{SOFT}">drag to turn · <span class="mouse">scroll to zoom · right-drag to move</span>'
        f'<span class="fingers">pinch to zoom · two fingers to move</span><br>{escape(text)}</div>'
    )


def message(text: str, bad: bool = False) -> str:
    """Line on what is going on; "" is an empty line, so that nothing jumps."""
    return f'<div style="{BOX};min-height:1.9em;{"color:#e5484d" if bad else SOFT}">{escape(text) or "&nbsp;"}</div>'


def color_bar(scale: ColorScale) -> str:
    """Bar with all colours of a scale, and what stands below it."""
    stops = ",".join(map(css, scale.stops))
    words = "".join(f"<span>{escape(w)}</span>" for w in scale.words)
    return (
        f'<div style="{BOX}"><div>{escape(scale.title)}</div><div style="height:9px;border-radius:5px;margin:3px 0;'
        f'background:linear-gradient(90deg,{stops})"></div><div style="display:flex;justify-content:space-between;'
        f'{SOFT}">{words}</div></div>'
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
