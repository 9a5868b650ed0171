"""Page of one frame: what was observed, its reconstruction, and a probe."""

import threading
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mereo.visualization.units import UNKNOWN, Unit
from mereo.visualization.vertex_colors import (
    CONFIDENCE,
    ColorScale,
    confidence,
    distance_scale,
    observed_distance,
    radius_scale,
)
from mereo.visualization.viewer import html
from mereo.visualization.viewer.display import Display, SegmentControls, SegmentLayer
from mereo.visualization.viewer.panels import DepthPicture, add_cloud, add_depth, add_views
from mereo.visualization.viewer.probe import Inspection, first_hit
from mereo.visualization.viewer.why import WhyLayer

EMPTY_COLOR = (150, 156, 168)
SURE = "how sure"
"""Colouring by the radius within which the true place of each vertex lies."""


class FramePage:
    """Page that shows an ``Inspection`` and answers clicks, check boxes and sliders until its server stops."""

    def __init__(
        self,
        server: Any,
        inspection: Inspection,
        title: str,
        facts: str,
        unit: Unit = UNKNOWN,
        depth: DepthPicture | None = None,
    ) -> None:
        self.server, self.inspection, self.unit = server, inspection, unit
        self.mesh = inspection.surfaces
        self._drawing = threading.Lock()
        scanner = not np.allclose(inspection.T_camera_input, np.eye(4))
        y, self.toward = (1.0, np.array([0.0, 0.0, 1.0])) if scanner else (-1.0, np.array([0.0, 0.0, -1.0]))
        self.stage = Display(server, self._bounds(), np.array([0.0, y, 0.0]))
        self.layer = SegmentLayer(self.stage, "/segments")
        self._painted: dict[str, tuple[list[UInt8[np.ndarray, "_ 3"]], str]] = {}
        self._build(title, facts, depth)
        self._draw()
        self.stage.look_from(self.toward + 0.28 * np.array([1.0, y, 0.0]), self._bounds())

    def _bounds(self) -> Float[np.ndarray, "2 3"]:
        corners = [s.vertices for s in self.mesh.segments if len(s.vertices)]
        cloud = self.inspection.cloud
        joint = np.concatenate([*([] if cloud is None else [cloud.points]), *corners])
        return np.stack([joint.min(axis=0), joint.max(axis=0)])

    def _build(self, title: str, facts: str, depth: DepthPicture | None) -> None:
        gui = self.server.gui
        gui.add_html(html.heading(title, facts))
        gui.add_html(html.message(self.inspection.source))
        gui.add_html(html.chips(self.mesh.names, self.mesh.colors))
        colorings = self._colorings()
        self.coloring = gui.add_dropdown("Colour", colorings, initial_value="segment", visible=len(colorings) > 1)
        self.legend = gui.add_html("", visible=False)
        self.coloring.on_update(lambda _: self._draw())
        self.controls = SegmentControls(gui, self.mesh, self._draw)
        if self.inspection.cloud is not None:
            add_cloud(gui, self.stage, self.inspection.cloud, self.coloring)
        add_views(gui, self.stage, self.toward, self._bounds)
        self._build_probe()
        add_depth(gui, depth)

    def _colorings(self) -> tuple[str, ...]:
        """What surfaces can be coloured by: confidence is the network's, distance needs what was seen."""
        has_code, has_cloud = self.inspection.code is not None, self.inspection.cloud is not None
        sure = [SURE] if self.inspection.sure is not None else []
        return ("segment", *(["confidence"] if has_code else []), *(["distance"] if has_cloud else []), *sure)

    def _build_probe(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Probe"):
            self.probing = gui.add_checkbox("ask at a point", False)
            self.told = gui.add_html(html.message("Click a surface, or drag the arrows of the probe."))
            self.why = WhyLayer.of(gui, self.stage, self.inspection)
        self.gizmo = self.server.scene.add_transform_controls(
            "/probe", scale=0.35, disable_rotations=True, depth_test=False, visible=False
        )
        self.gizmo.on_update(lambda _: self.probe(self.stage.back(np.array(self.gizmo.position))))
        self.probing.on_update(lambda _: self._switch_probe())
        self.server.scene.on_click()(self._clicked)
        self._arrow: Any = None

    # --- drawing ------------------------------------------------------------------------------------------------------

    def _draw(self) -> None:
        """Callbacks run in several threads; one of them draws at a time."""
        with self._drawing, self.server.atomic():
            mode = self.coloring.value
            if mode == "segment":
                self.legend.visible = False
                self.layer.show(self.mesh, self.controls)
                return
            colors, self.legend.content = self._colors(mode)
            self.legend.visible = True
            self.layer.show(self.mesh, self.controls, colors)

    def _colors(self, mode: str) -> tuple[list[UInt8[np.ndarray, "_ 3"]], str]:
        """Computed when first asked for."""
        if mode not in self._painted:
            if mode == "confidence":
                values, scale = confidence(self.mesh, self.inspection.network), CONFIDENCE
            elif mode == SURE:
                values, scale = self._radii()
            else:
                assert self.inspection.cloud is not None
                found = observed_distance(self.mesh, self.inspection.cloud.points)
                values = [value * self.unit.length_factor for value in found]
                scale = distance_scale(values, f" {self.unit.length_name}")
            self._painted[mode] = [scale.colors(value) for value in values], html.color_bar(scale)
        return self._painted[mode]

    def _radii(self) -> tuple[list[Float[np.ndarray, " _"]], ColorScale]:
        """Radius of 95 % at each vertex, in the unit of the page, and its scale."""
        found = self.inspection.sure
        assert found is not None
        radii = found.scaled(self.unit.length_factor)
        return list(radii.vertices), radius_scale(radii, f" {self.unit.length_name}")

    # --- probing ------------------------------------------------------------------------------------------------------

    def _clicked(self, event: Any) -> None:
        origin, direction = (np.array(ray, dtype=float) for ray in (event.ray_origin, event.ray_direction))
        place = first_hit(self.mesh, self.stage.back(origin), direction, self.controls.visible())
        if place is not None:
            self._move_probe(place)
            self.probing.value = True

    def _switch_probe(self) -> None:
        if self.probing.value and self._arrow is None:
            self._move_probe(self.stage.center)
        self._show_probe(bool(self.probing.value))

    def _show_probe(self, shown: bool) -> None:
        self.gizmo.visible = shown
        if self._arrow is not None:
            self._arrow.visible = shown

    def _move_probe(self, place: Float[np.ndarray, "3"]) -> None:
        self.gizmo.position = tuple(self.stage.place(place))
        self._show_probe(True)
        self.probe(place)

    def probe(self, place: Float[np.ndarray, "3"]) -> None:
        """Say what is known of a place of the input's frame, and draw the way to the nearest surface."""
        answer = self.inspection.ask(place[None])
        colors = (EMPTY_COLOR, *self.inspection.colors)
        self.told.content = html.answer(answer, self.inspection.names, colors, place, self.unit)
        if self.why is not None:
            self.why.show(place)
        distance, direction = float(answer.distance[0]), answer.direction[0]
        if np.isnan(distance) or np.isnan(direction).any():
            return
        start = self.stage.place(place)
        end = start + max(abs(distance) * self.stage.scale, 0.03) * direction
        self._arrow = self.server.scene.add_arrows(
            "/arrow",
            np.stack([start, end])[None].astype(np.float32),
            colors[int(answer.label[0])],
            shaft_radius=0.008,
            head_radius=0.022,
            head_length=min(0.06, 0.5 * float(np.linalg.norm(end - start))),
        )
