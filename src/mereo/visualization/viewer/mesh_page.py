"""Pages of surfaces alone: any GLB file, and results without a registered model, whose weights are not asked again."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mereo.geometry.brief import counted
from mereo.geometry.camera import PointCloud
from mereo.io.glb_scene import GlbScene, read_glb
from mereo.visualization.units import UNKNOWN, Unit, rounded
from mereo.visualization.vertex_colors import radius_scale
from mereo.visualization.viewer import html
from mereo.visualization.viewer.display import Display, SegmentControls, SegmentLayer, import_viser, start_server
from mereo.visualization.viewer.frame_page import SURE
from mereo.visualization.viewer.guard import Entry
from mereo.visualization.viewer.kept_result import KeptResult
from mereo.visualization.viewer.open_page import OpenPage
from mereo.visualization.viewer.panels import add_cloud, add_depth, add_views
from mereo.visualization.viewer.tab_title import tab_title

OWN = "own"
"""Colouring by the colours of the file's vertices."""


def view_glb(path: Path, port: int, host: str) -> OpenPage:
    """Show the meshes of a GLB file.

    Raises ``ImportError`` without the extra `view`, ``OSError`` for a port that is taken, and as ``read_glb`` does.
    """
    import_viser()
    scene = read_glb(path)
    # glTF's metres; a file of ours has the same number where the unit of its input was not known
    unit = UNKNOWN if scene.is_own and scene.unit_m == 1.0 else Unit(scene.unit_m)
    return _open(scene, path.name, KeptResult(), unit, port, host)


def view_kept(path: Path, port: int, host: str) -> OpenPage:
    """Show a folder of results by its files alone: surfaces, observed points, depth image and verdict.

    Raises as ``view_glb``.
    """
    import_viser()
    kept = KeptResult.of(path)
    assert kept.scene is not None
    return _open(kept.scene, kept.title or path.name, kept, kept.unit or UNKNOWN, port, host)


def _open(scene: GlbScene, title: str, kept: KeptResult, unit: Unit, port: int, host: str) -> OpenPage:
    entry = Entry.of(host)
    server = start_server(port, tab_title(title), entry)
    MeshPage(server, scene, title, kept, unit)
    return OpenPage(server, entry)


class MeshPage:
    """Page that shows surfaces, answers check boxes and sliders, and knows no model; until its server stops."""

    def __init__(self, server: Any, scene: GlbScene, title: str, kept: KeptResult, unit: Unit = UNKNOWN) -> None:
        self.server, self.scene, self.unit, self.kept = server, scene, unit, kept
        self.mesh = scene.mesh
        self._drawing = threading.Lock()
        up, self.toward = (scene.rotation.T @ axis for axis in (np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])))
        self.stage = Display(server, self._bounds(), up)
        self.layer = SegmentLayer(self.stage, "/segments")
        self._build(title)
        self._draw()
        right = np.cross(up, self.toward)
        self.stage.look_from(self.toward + 0.28 * (right + up), self._bounds())

    def _bounds(self) -> Float[np.ndarray, "2 3"]:
        cloud = self.kept.cloud
        joint = np.concatenate([*([] if cloud is None else [cloud.points]), *(s.vertices for s in self.mesh.segments)])
        return np.stack([joint.min(axis=0), joint.max(axis=0)])

    def _build(self, title: str) -> None:
        gui, cloud = self.server.gui, self.kept.cloud
        gui.add_html(html.heading(title, self._facts(cloud)))
        if self.kept.verdict:
            gui.add_html(html.message(self.kept.verdict, bad=self.kept.level == "no"))
        gui.add_html(html.chips(self.mesh.names, self.mesh.colors))
        colorings = self._colorings()
        self.coloring = gui.add_dropdown("Colour", colorings, initial_value=colorings[0], visible=len(colorings) > 1)
        self.legend = gui.add_html("", visible=False)
        self.coloring.on_update(lambda _: self._draw())
        self.controls = SegmentControls(gui, self.mesh, self._draw)
        if cloud is not None:
            add_cloud(gui, self.stage, cloud, self.coloring)
        add_views(gui, self.stage, self.toward, self._bounds, "camera" if self.scene.is_own else "front")
        add_depth(gui, self.kept.depth)

    def _facts(self, cloud: PointCloud | None) -> str:
        sides = np.ptp(self.mesh.bounds, axis=0) * self.unit.length_factor
        faces = sum(len(segment.faces) for segment in self.mesh.segments)
        size = f"{' x '.join(rounded(float(side)) for side in sides)} {self.unit.length_name}"
        parts = counted(len(self.mesh.segments), "segment" if self.scene.is_own else "part")
        return " · ".join(
            [*([] if cloud is None else [f"{self.kept.count:,} points"]), parts, f"{faces:,} faces", size]
        )

    def _colorings(self) -> tuple[str, ...]:
        """The file's own colours first, where it has any."""
        own = [OWN] if any(colors is not None for colors in self.scene.colors) else []
        return (*own, "segment", *([SURE] if self.scene.radii is not None else []))

    def _draw(self) -> None:
        """Callbacks run in several threads; one of them draws at a time."""
        with self._drawing, self.server.atomic():
            mode = self.coloring.value
            self.legend.visible = mode == SURE
            if mode == "segment":
                self.layer.show(self.mesh, self.controls)
                return
            self.layer.show(self.mesh, self.controls, self._radii() if mode == SURE else self._own())

    def _own(self) -> list[UInt8[np.ndarray, "_ 3"]]:
        found = zip(self.mesh.segments, self.scene.colors, strict=True)
        return [np.tile(np.array(s.color, dtype=np.uint8), (len(s.vertices), 1)) if c is None else c for s, c in found]

    def _radii(self) -> list[UInt8[np.ndarray, "_ 3"]]:
        assert self.scene.radii is not None
        radii = self.scene.radii.scaled(self.unit.length_factor)
        scale = radius_scale(radii, f" {self.unit.length_name}")
        self.legend.content = html.color_bar(scale)
        return [scale.colors(values) for values in radii.vertices]
