"""Page of the laboratory: sliders for a scene and its camera, what the camera sees, what is made of it, and how good.

Hands only leave wishes; one thread (``LatestWins``) fulfils them, so that the page never waits and never lags behind.
"""

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from mereo.geometry.mesh import SegmentedMesh
from mereo.io.foreseen import words_of
from mereo.visualization.viewer import html
from mereo.visualization.viewer.display import SegmentControls
from mereo.visualization.viewer.film import Film, picture
from mereo.visualization.viewer.lab_stage import COLORINGS, SHOWN, LabStage, Moment
from mereo.visualization.viewer.lab_tools import LabTools, Ties
from mereo.visualization.viewer.laboratory import Laboratory, Trial, depth_picture
from mereo.visualization.viewer.latest_request import LatestWins
from mereo.visualization.viewer.sliders import CameraSliders, ParameterSliders, SensorControls
from mereo.visualization.viewer.wishes import Wishes

PICTURE = 288
"""Width of the depth image on the page in pixels, at least."""

QUICK, FINE = (32, 24), (96, 64)
"""Resolution of surfaces and cells of the score, while a slider moves and when it rests."""

HISTORY = 60
"""Scores that the curve remembers."""


class LabPage:
    """Page that shows a ``Laboratory`` on a server until ``close``."""

    def __init__(self, server: Any, laboratory: Laboratory, title: str, facts: str, seed: int = 0) -> None:
        self.server, self.laboratory = server, laboratory
        self._drawing = threading.Lock()
        self.wishes: Wishes[Any] = Wishes(laboratory.freedom, seed)
        self._scores: list[tuple[float, float]] = []
        self.moment: Moment | None = None
        rest = laboratory.scene.rest
        self.stage = LabStage(server, laboratory)
        self._build_results(title, facts)
        self._build_controls(rest)
        self._look()
        self.worker = LatestWins(self._quick, self._fine, self._failed)
        self.worker.submit(None)

    def close(self) -> None:
        """Stop the page's thread; what it is doing is finished."""
        self.worker.stop()

    # --- panels -------------------------------------------------------------------------------------------------------

    def _build_results(self, title: str, facts: str) -> None:
        gui, panel = self.server.gui, self.server.gui.add_panel()
        panel.dock_left()
        panel.set_width(300)
        with panel.add_tab("What the camera sees"):
            gui.add_html(html.heading(title, facts))
            self._picture = gui.add_image(np.zeros((PICTURE, PICTURE, 3), dtype=np.uint8), format="png")
            self._source = gui.add_html("")
            self._score = gui.add_html("")
            axes = ({"show": False}, {"stroke": "#9aa3b2", "grid": {"stroke": "rgba(150,160,175,.18)"}, "size": 34})
            self._curve = gui.add_uplot(
                (np.arange(2.0), np.zeros(2), np.zeros(2)),
                (
                    {"label": "trial"},
                    {"label": "IoU", "stroke": "#56b4e9", "width": 2},
                    {"label": "mIoU", "stroke": "#e69f00", "width": 2},
                ),
                axes=axes,
                scales={"x": {"time": False}, "y": {"range": (0.0, 1.0)}},
                legend={"show": True, "live": False},
                height=150,
                visible=False,
            )
            self._status = gui.add_html(html.message("starting"))

    def _build_controls(self, rest: SegmentedMesh) -> None:
        gui = self.server.gui
        gui.add_html(html.chips(rest.names, rest.colors))
        has_model = self.laboratory.model is not None
        self._shown = gui.add_dropdown("Show", SHOWN, initial_value=SHOWN[0 if has_model else 1], visible=has_model)
        self._coloring = gui.add_dropdown("Colour", COLORINGS, initial_value="segment", visible=has_model)
        self._legend = gui.add_html("", visible=False)
        self._points = gui.add_checkbox("observed points", True)
        view = gui.add_button_group("View", ("camera", "side", "behind"))
        view.on_click(lambda _: self._look(view.value))
        for handle in (self._shown, self._coloring, self._points):
            handle.on_update(lambda _: self._draw())
        # white points would hide the colours that are looked at
        self._coloring.on_update(lambda _: setattr(self._points, "value", self._coloring.value == "segment"))
        self._shown.on_update(lambda _: self._look())
        gui.add_button("Random state").on_click(lambda _: self.wish(self.wishes.anew))
        hint = "The object undeformed. Where no draws lead there, sliders stay, and the next move goes on from them."
        gui.add_button("Rest state", hint=hint).on_click(lambda _: self.wish(self.wishes.rest))
        self._undo = gui.add_button("Undo", disabled=True)
        self._undo.on_click(lambda _: self.wish(self.wishes.back))
        with gui.add_folder("Camera"):
            self._camera = CameraSliders(gui, self.laboratory, self.wish)
        with gui.add_folder("Sensor", expand_by_default=False):
            self.sensor = SensorControls(gui, self.wish)
        move = self.wishes.move
        self._sliders = ParameterSliders(gui, gui.add_folder("Deformation"), lambda *to: self.wish(lambda: move(*to)))
        ties = Ties(self._say, lambda: self.moment, self.take, lambda: self.wish(self.wishes.walk))
        self.tools = LabTools(self.server, self.laboratory, ties)
        self.controls = SegmentControls(gui, rest, self._draw)

    def _look(self, name: str = "camera") -> None:
        """The depth camera's own direction, a little from the side, or another one."""
        bounds, place = self.laboratory.scene.rest.bounds, self._camera.place()
        T_world_camera = self.laboratory.pose(bounds.mean(axis=0), place)
        if self.moment is not None:
            T_world_camera = self.moment.view.T_world_camera
            bounds = self.moment.view.mesh.transformed(T_world_camera).bounds
        toward, right = -T_world_camera[:3, 2], T_world_camera[:3, 0]
        direction = {"camera": toward + 0.2 * right, "side": right, "behind": -toward}[name]
        room = 1.35 if self._shown.value != "side by side" else 2.4
        # up is where the depth image has it, so that a rolled camera's view looks like its image
        self.stage.stage.look_from(direction, bounds, room, -T_world_camera[:3, 1])

    # --- wishes -------------------------------------------------------------------------------------------------------

    def wish(self, ask: Callable[[], None] = lambda: None) -> None:
        """Ask for something, and have the worker see to it."""
        ask()
        self.worker.submit(None)

    def take(self, text: str) -> None:
        """Show the state that a text says; raises ``ValueError`` where it says none."""
        self.wish(lambda: self.wishes.take(text))

    # --- the worker's thread ------------------------------------------------------------------------------------------

    def _quick(self, _: None) -> None:
        try:
            self._show()
        finally:  # the way goes on after a state that the camera cannot see
            if self.wishes.is_walking:
                self.worker.submit(None)

    def _show(self) -> None:
        refusal = self.wishes.fulfil()
        shape, freedom = self.wishes.shape, self.laboratory.freedom
        self._undo.disabled = not self.wishes.can_go_back
        self._sliders.show(freedom.parameters(shape))
        self.tools.show_text(freedom.text(shape))
        view, is_first = self.laboratory.look(shape, self._camera.place(), self.sensor.sensing()), self.moment is None
        self.sensor.tell(view.hidden)
        self.moment = Moment(view)
        if is_first:
            self._look()
        self._picture.image = depth_picture(view.depth, max(1, PICTURE // view.depth.camera.width))
        self._rebuild(*QUICK, quick=True)
        self.tools.shoot(self._shoot)
        if refusal is not None:
            raise refusal

    def _fine(self, _: None) -> None:
        if self.laboratory.model is not None:
            self._rebuild(*FINE)

    def _rebuild(self, resolution: int, cells: int, quick: bool = False) -> None:
        assert self.moment is not None
        if self.laboratory.model is None:
            self._say(f"{len(self.moment.view.depth.to_points())} points seen; no weights, no reconstruction")
        else:
            trial = self.laboratory.rebuild(self.moment.view, resolution, cells, quick)
            self.moment = replace(self.moment, trial=trial)
            self._tell(trial)
        self._draw()

    def _shoot(self, film: Film) -> None:
        assert self.moment is not None
        meshes, points = self.stage.shown(self.moment, self._shown.value, self.controls)
        seen = points if self._points.value else points[:0]
        film.add(picture(film.view, meshes, seen, depth_picture(self.moment.view.depth)))

    def _failed(self, error: Exception) -> None:
        self._say(words_of(error), bad=True)
        self._draw()

    # --- results ------------------------------------------------------------------------------------------------------

    def _say(self, text: str, bad: bool = False) -> None:
        self._status.content = html.message(text, bad)

    def _tell(self, trial: Trial) -> None:
        surfaces = trial.reconstruction.surfaces
        self._score.content = html.scores(trial.scores, surfaces.names, surfaces.colors)
        self._scores = [*self._scores, (trial.scores.iou, trial.scores.miou)][-HISTORY:]
        if len(self._scores) > 1:
            columns = np.array(self._scores).T
            self._curve.data = (np.arange(len(self._scores), dtype=float), columns[0], columns[1])
            self._curve.visible = True
        resolution = int(max(trial.reconstruction.labels.labels.shape)) - 1
        self._source.content = html.message(trial.source)
        self._say(f"{resolution} cells in {trial.seconds:.2f} s; scored on {trial.cells}³ points")

    def _draw(self) -> None:
        """Callbacks and the worker draw; one at a time."""
        moment = self.moment
        if moment is None:
            return
        with self._drawing, self.server.atomic():
            mode, coloring, points = self._shown.value, self._coloring.value, bool(self._points.value)
            scale = self.stage.draw(moment, mode, coloring, self.controls, points)
            self._legend.content, self._legend.visible = (
                "" if scale is None else html.color_bar(scale),
                scale is not None,
            )
