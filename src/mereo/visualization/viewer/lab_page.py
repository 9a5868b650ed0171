"""Page of the laboratory: sliders for a scene and its camera, what the camera sees, what is made of it, and how good.

Hands only leave wishes; one thread (``LatestWins``) fulfils them, so that the page never waits and never lags behind.
"""

import threading
from dataclasses import replace
from typing import Any

import numpy as np

from mereo.geometry.mesh import SegmentedMesh
from mereo.scenes.parameters import Parameter, Refused
from mereo.visualization.viewer import html
from mereo.visualization.viewer.display import SegmentControls
from mereo.visualization.viewer.lab_stage import COLORINGS, SHOWN, LabStage, Moment
from mereo.visualization.viewer.laboratory import Laboratory, Trial, depth_picture
from mereo.visualization.viewer.latest_request import LatestWins
from mereo.visualization.viewer.sliders import CameraSliders, ParameterSliders

QUICK, FINE = (32, 24), (96, 64)
"""Resolution of surfaces and cells of the score, while a slider moves and when it rests."""

HISTORY = 60
"""Scores that the curve, and changes that "Undo" remembers."""


class LabPage:
    """Page that shows a ``Laboratory`` on a server until ``close``."""

    def __init__(self, server: Any, laboratory: Laboratory, title: str, facts: str, seed: int = 0) -> None:
        self.server, self.laboratory = server, laboratory
        self._drawing, self._wishing = threading.Lock(), threading.Lock()
        self._seeds = np.random.default_rng(seed)
        self._wishes: dict[tuple[Any, int | None], tuple[Parameter, float]] = {}
        self._first_seed = seed
        self._new_seed: int | None = None
        self._back = False
        self._past: list[Any] = []
        self._hand: frozenset[Any] = frozenset()
        self._scores: list[tuple[float, float]] = []
        self.shape: Any = None
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
            self._picture = gui.add_image(np.zeros((288, 288, 3), dtype=np.uint8), format="png")
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
        gui.add_button("Random state").on_click(lambda _: self._wish_anew())
        self._undo = gui.add_button("Undo", disabled=True)
        self._undo.on_click(lambda _: self._wish_back())
        with gui.add_folder("Camera"):
            self._camera = CameraSliders(gui, self.laboratory, lambda: self.worker.submit(None))
        self._sliders = ParameterSliders(gui, gui.add_folder("Deformation"), self._wish)
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

    def _wish(self, parameter: Parameter, value: float) -> None:
        with self._wishing:
            self._wishes[parameter.key, parameter.index] = (parameter, value)
        self.worker.submit(None)

    def _wish_anew(self) -> None:
        with self._wishing:
            self._new_seed = int(self._seeds.integers(2**31))
        self.worker.submit(None)

    def _wish_back(self) -> None:
        with self._wishing:
            self._wishes, self._new_seed, self._back = {}, None, True
        self.worker.submit(None)

    def _remember(self, hand: frozenset[Any]) -> None:
        """Keep the shape that is about to change; what one slider does until another hand moves is one change."""
        if self.shape is not None and (hand != self._hand or not hand):
            self._past = [*self._past, self.shape][-HISTORY:]
        self._hand = hand

    def _fulfil(self) -> tuple[Any, Refused | None]:
        """The shape that is wished for. Values that are refused are left out, and the last of them is told."""
        with self._wishing:
            wishes, hand, seed, back = list(self._wishes.values()), frozenset(self._wishes), self._new_seed, self._back
            self._wishes, self._new_seed, self._back = {}, None, False
        freedom, refusal = self.laboratory.freedom, None
        if back and self._past:
            *self._past, shape = self._past
            self._hand = frozenset()
            return shape, None
        if seed is not None:
            self._remember(frozenset())
            return freedom.random(seed), None
        shape = freedom.first(self._first_seed) if self.shape is None else self.shape
        for parameter, value in wishes:
            try:
                shape = freedom.moved(shape, parameter, value)
            except Refused as error:
                refusal = error
        if shape is not self.shape and wishes:
            self._remember(hand)
        return shape, refusal

    # --- the worker's thread ------------------------------------------------------------------------------------------

    def _quick(self, _: None) -> None:
        self.shape, refusal = self._fulfil()
        self._undo.disabled = not self._past
        self._sliders.show(self.laboratory.freedom.parameters(self.shape))
        view, is_first = self.laboratory.look(self.shape, self._camera.place()), self.moment is None
        self.moment = Moment(view)
        if is_first:
            self._look()
        self._picture.image = depth_picture(view.depth, 3)
        self._rebuild(*QUICK, quick=True)
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

    def _failed(self, error: Exception) -> None:
        self._say(" ".join(str(error).split()) or type(error).__name__, bad=True)
        self._draw()

    # --- results ------------------------------------------------------------------------------------------------------

    def _say(self, text: str, bad: bool = False) -> None:
        self._status.content = html.message(text, bad)

    def _tell(self, trial: Trial) -> None:
        surfaces = trial.result.surfaces
        self._score.content = html.scores(trial.scores, surfaces.names, surfaces.colors)
        self._scores = [*self._scores, (trial.scores.iou, trial.scores.miou)][-HISTORY:]
        if len(self._scores) > 1:
            columns = np.array(self._scores).T
            self._curve.data = (np.arange(len(self._scores), dtype=float), columns[0], columns[1])
            self._curve.visible = True
        resolution = int(max(trial.result.labels.labels.shape)) - 1
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
