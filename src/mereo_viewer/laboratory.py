"""Laboratory of an object: any state of its scene before a simulated camera, and what is found in the frame.

    Played, CameraPlace, sensor -look-> View -answer-> Trial (surfaces, scores, seconds)

``LabPage`` puts sliders and buttons to it.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import Camera, PointCloud
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import Scores, grid_confusion, intersection_over_union, labels_on, truth_grid
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.io.errors import words_of
from mereo.models.trained import Trained
from mereo.reconstruction.observation import observe as observe_cloud
from mereo.scenes.draw_recorder import Key
from mereo.scenes.parameters import Parameter, Played, Refused, parameters, random_state, set_value
from mereo.scenes.scene import Scene
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.depth_sensor import observe
from mereo.synthesis.examples import View
from mereo.visualization.contact_sheets import depth_picture
from mereo_viewer.display import (
    Display,
    PointLayer,
    SegmentControls,
    SegmentLayer,
    enlarged,
    heading,
    message,
    score_table,
)
from mereo_viewer.result_page import source_of
from mereo_viewer.server import OpenPage, start_server

CELLS = 64
"""Cells a side on which an answer is scored; the paper takes 100, fewer are faster and a little off."""

GAP = 0.15
"""Room next to and below truth and reconstruction, side by side, in stage units."""


# --- without a page ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CameraPlace:
    """Place of the camera in the terms of the scene's ``Workspace``.

    Attributes:
        tilt_rad: away from the workspace's axis, 0 to half its aperture.
        azimuth_rad: around the axis.
        distance: from the object's middle, in scene units.
    """

    tilt_rad: float
    azimuth_rad: float
    distance: float


@dataclass(frozen=True, eq=False)
class Trial:
    """Answer to a view, and how good it is.

    Attributes:
        surfaces: segments that were found, in the camera frame.
        source: where they come from, in a phrase.
        scores: against the truth, on ``CELLS`` ** 3 cells.
        seconds: that the answer took.
    """

    surfaces: SegmentedMesh
    source: str
    scores: Scores
    seconds: float


@dataclass(frozen=True, eq=False)
class Laboratory:
    """Object whose states are shown to a simulated camera, and what answers its frames.

    Attributes:
        scene: states of the object, and where its camera may be.
        network: the weights; None of an object without, which is searched.
        registrar: of its deformation model; None where the network alone answers.

    Raises ``ValueError`` for weights of another object.
    """

    scene: Scene
    network: Trained | None
    registrar: Registrar | None

    def __post_init__(self) -> None:
        names = self.scene.rest.names
        if self.network is not None and self.network.names != names:
            raise ValueError(
                f"the weights know {', '.join(self.network.names)}, the object has {', '.join(names)}: "
                "name the weights of this object, or leave them out"
            )

    @property
    def first_place(self) -> CameraPlace:
        """First place of the camera: oblique, in the middle of the allowed distances."""
        tilt = min(np.deg2rad(35.0), self.most_tilt_rad)
        return CameraPlace(float(tilt), float(np.deg2rad(40.0)), sum(self.scene.workspace.distance) / 2)

    @property
    def most_tilt_rad(self) -> float:
        """Largest angle between the camera's direction and the workspace's axis."""
        return float(min(self.scene.workspace.aperture_rad / 2, np.pi))

    def look(self, shape: Played, place: CameraPlace, sensor: Sensor = "paper") -> View:
        """See a state with a camera at this place; its noise is the same every time, so that pictures do not flicker.

        Raises ``ValueError`` where fewer than ``MIN_POINTS`` points of the object are seen.
        """
        state = self.scene.deform(shape.deformations)
        workspace = self.scene.workspace
        center = state.mesh.bounds.mean(axis=0)
        cosine = float(np.cos(place.tilt_rad))
        T_world_camera = workspace.pose(center, cosine, place.azimuth_rad, place.distance)
        mesh = state.mesh.transformed(inverse_rigid(T_world_camera))
        camera = Camera.from_fov(64, 64, workspace.fov_rad)
        seen = observe(Solids(mesh), camera, GenerateConfig().noise_std, SENSORS[sensor], np.random.default_rng(0))
        if seen.object_points < MIN_POINTS:
            raise ValueError(
                f"the camera sees {seen.object_points} points of the object; at least {MIN_POINTS} are needed: move "
                "the camera"
            )
        return View(mesh, seen.image, T_world_camera, state.deformations)

    def answer(self, view: View) -> Trial:
        """Find the object in a view, as `mereo reconstruct` does, and score what is found.

        Raises ``ValueError`` where nothing is found.
        """
        started = time.perf_counter()
        seen = observe_cloud(view.depth.to_points(), unit_m=self.scene.unit_m)
        answer = answer_frame(seen, self.network, self.registrar, resolution=96)
        surfaces = answer.surfaces
        seconds = time.perf_counter() - started
        truth = truth_grid(view.mesh, CELLS)
        confusion = grid_confusion(truth, labels_on(surfaces, truth.grid), len(surfaces.segments))
        scores = intersection_over_union(confusion, len(surfaces.segments) == len(view.mesh.segments))
        return Trial(surfaces, source_of(answer), scores, seconds)


# --- sliders ----------------------------------------------------------------------------------------------------------

Slot = tuple[Key, int | None]
"""Which number of a scene's draws a slider moves."""


class ParameterSliders:
    """Sliders for what a scene draws, in a folder for each group.

    While a state has the same draws its sliders stay as they are, also while they are being dragged.
    """

    def __init__(self, gui: Any, moved: Callable[[Slot, float], None]) -> None:
        self._gui, self._moved = gui, moved
        self._folder = gui.add_folder("Deformation")
        self._groups: dict[str, Any] = {}
        self._handles: dict[Slot, Any] = {}

    def show(self, shown: Sequence[Parameter]) -> None:
        """Bring the sliders to a state."""
        slots = [(parameter.key, parameter.index) for parameter in shown]
        if slots != list(self._handles):
            self._build(shown)
        for slot, parameter in zip(slots, shown, strict=True):
            handle = self._handles[slot]
            low, high, step = slider_range(parameter)
            if (handle.min, handle.max) != (low, high):  # ends may depend on other draws
                handle.min, handle.max, handle.step = low, high, step
            handle.value = min(max(round(parameter.value / step) * step, low), high)

    def _build(self, shown: Sequence[Parameter]) -> None:
        for group in self._groups.values():
            group.remove()
        self._groups, self._handles = {}, {}
        for parameter in shown:
            group = parameter.group
            if group not in self._groups:
                with self._folder:
                    self._groups[group] = self._gui.add_folder(group, expand_by_default=not self._groups)
            with self._groups[group]:
                self._handles[parameter.key, parameter.index] = self._add(parameter)

    def _add(self, parameter: Parameter) -> Any:
        low, high, step = slider_range(parameter)
        unit = f" ({parameter.unit})" if parameter.unit else ""
        handle = self._gui.add_slider(f"{parameter.name}{unit}", low, high, step, low)
        slot = (parameter.key, parameter.index)
        on_hand(handle, lambda: self._moved(slot, float(handle.value)))
        return handle


def slider_range(parameter: Parameter) -> tuple[float, float, float]:
    """Ends and step of a slider, in numbers with few digits: a step of 0.01, 0.1, ... that divides it into 100 or more.

    Ends move outward by less than a step; ``set_value`` keeps to the true ones.
    """
    if parameter.whole:
        return parameter.low, parameter.high, 1.0
    digits = int(np.ceil(2 - np.log10(parameter.high - parameter.low) - 1e-9))
    step = 10.0**-digits
    low, high = np.floor(parameter.low / step + 1e-6) * step, np.ceil(parameter.high / step - 1e-6) * step
    return round(float(low), digits), round(float(high), digits), step


def on_hand(handle: Any, act: Callable[[], None]) -> None:
    """Act when a person has moved a control, which has a client then; our own changes of its value have none."""
    handle.on_update(lambda event: act() if event.client is not None else None)


# --- page -------------------------------------------------------------------------------------------------------------


def open_laboratory(scene: Scene, network: Trained | None, registrar: Registrar | None, port: int) -> OpenPage:
    """Open the laboratory of an object.

    Raises ``ImportError`` without the extra `view`, and ``OSError`` for a port that is taken.
    """
    laboratory = Laboratory(scene, network, registrar)
    server = start_server(port)
    LabPage(server, laboratory).update()
    return OpenPage(server)


class LabPage:
    """Page of a ``Laboratory``, until its server stops.

    Attributes:
        shape: state that is shown.
        view: it as the camera sees it.
        trial: what was found in the view; None until that is wanted.
    """

    def __init__(self, server: Any, laboratory: Laboratory, seed: int = 0) -> None:
        self.server, self.laboratory = server, laboratory
        self.shape = random_state(laboratory.scene, seed)
        self.view: View | None = None
        self.trial: Trial | None = None
        self._working, self._drawing = threading.Lock(), threading.Lock()
        self._changes: dict[Any, Callable[[Played], Played]] = {}
        self._seeds = np.random.default_rng(seed)
        rest = laboratory.scene.rest
        self.stage = Display(server, rest.bounds, np.asarray(laboratory.scene.workspace.axis, dtype=float))
        self.truth, self.answer = SegmentLayer(self.stage, "/true"), SegmentLayer(self.stage, "/found")
        self._names: list[Any] = []
        self._build()

    def _build(self) -> None:
        gui, rest = self.server.gui, self.laboratory.scene.rest
        network = self.laboratory.network
        facts = "no weights: a search finds the object" if network is None else f"weights {network.name}"
        gui.add_html(heading(f"Laboratory: {self.laboratory.scene.name}", facts))
        panel = gui.add_panel()
        panel.dock_left()
        panel.set_width(300)
        with panel.add_tab("Frame"):
            self.picture = gui.add_image(np.zeros((320, 320, 3), dtype=np.uint8), format="png")
            self.scores = gui.add_html("")
            self.status = gui.add_html(message("starting"))
        with self.stage.add_panel("Controls"):
            gui.add_button("Random state").on_click(lambda _: self.randomize())
            gui.add_button("Reconstruct").on_click(lambda _: self.reconstruct())
            self._build_camera()
            self.sliders = ParameterSliders(gui, self.move)
            self.points = PointLayer(self.stage)
            self.controls = SegmentControls(gui, rest, self._draw)
            self._look = self.stage.add_views(self._toward, self._bounds)

    def _build_camera(self) -> None:
        gui, first, laboratory = self.server.gui, self.laboratory.first_place, self.laboratory
        near, far = laboratory.scene.workspace.distance
        with gui.add_folder("Camera"):
            most_tilt = float(np.rad2deg(laboratory.most_tilt_rad))
            self._tilt = gui.add_slider("tilt (°)", 0.0, most_tilt, 0.5, float(np.rad2deg(first.tilt_rad)))
            self._around = gui.add_slider("around (°)", -180.0, 180.0, 1.0, float(np.rad2deg(first.azimuth_rad)))
            self._distance = gui.add_slider("distance", near, far, max((far - near) / 200, 1e-9), first.distance)
            self.sensor = gui.add_dropdown("sensor", tuple(SENSORS), initial_value="paper")
        for handle in (self._tilt, self._around, self._distance, self.sensor):
            on_hand(handle, self.update)

    # --- changes ------------------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Render the state again, after the camera has moved."""
        self._change("camera", lambda shape: shape)

    def randomize(self) -> None:
        """Show a random state."""
        self._change("state", lambda _: random_state(self.laboratory.scene, int(self._seeds.integers(2**31))))

    def move(self, slot: Slot, value: float) -> None:
        """Set one number of the state; a draw that has just gone has nothing left to set."""

        def changed(shape: Played) -> Played:
            matches = [known for known in parameters(shape) if (known.key, known.index) == slot]
            return set_value(self.laboratory.scene, shape, matches[0], value) if matches else shape

        self._change(slot, changed)

    def _change(self, control: Any, change: Callable[[Played], Played]) -> None:
        """Change the state and show it: the newest change of each control, whichever thread comes to it first."""
        self._changes[control] = change
        with self._working:
            if not self._changes:
                return
            refusal = ""
            try:
                while self._changes:
                    try:
                        self.shape = self._changes.popitem()[1](self.shape)
                    except Refused as error:
                        refusal = words_of(error)
                self._show()
                if refusal:
                    self._say(refusal, bad=True)
            except Exception as error:  # whatever it is, the page must live on and say it
                self._say(words_of(error), bad=True)

    def reconstruct(self) -> None:
        """Find the object in what the camera sees; changes wait meanwhile."""
        with self._working:
            if self.view is None:
                return
            self._say("reconstructing; the first time takes longest")
            try:
                self.trial = self.laboratory.answer(self.view)
            except Exception as error:  # as above
                self._say(words_of(error), bad=True)
                return
            surfaces = self.trial.surfaces
            self.scores.content = score_table(self.trial.scores, surfaces.names, surfaces.colors)
            self._say(f"{self.trial.source}; {self.trial.seconds:.1f} s; scored on {CELLS}³ points")
            self._draw()
            self._look("front")

    # --- what is shown ------------------------------------------------------------------------------------------------

    def _show(self) -> None:
        place = CameraPlace(
            float(np.deg2rad(self._tilt.value)), float(np.deg2rad(self._around.value)), float(self._distance.value)
        )
        self.sliders.show(parameters(self.shape))
        is_first = self.view is None
        self.view, self.trial = self.laboratory.look(self.shape, place, self.sensor.value), None
        self.picture.image = enlarged(depth_picture(self.view.depth))
        self.scores.content = ""
        self._say(f"{len(self.view.depth.to_points()):,} points seen")
        self._draw()
        if is_first:
            self._look("front")

    def _say(self, text: str, bad: bool = False) -> None:
        self.status.content = message(text, bad)

    def _toward(self) -> Float[np.ndarray, "3"]:
        """Direction from the object to the camera."""
        return np.array([0.0, 0.0, 1.0]) if self.view is None else -self.view.T_world_camera[:3, 2]

    def _bounds(self) -> Float[np.ndarray, "2 3"]:
        """Box around the object, or around truth and reconstruction side by side, in the scene's frame."""
        if self.view is None:
            return self.laboratory.scene.rest.bounds
        low, high = self.view.mesh.transformed(self.view.T_world_camera).bounds
        aside = np.abs(self._aside(self.view)) / self.stage.scale
        return np.stack([low - aside, high + aside])

    def _aside(self, view: View) -> Float[np.ndarray, "3"]:
        """Shift on the stage of the truth to the right, and of what is found to the left, once it is there."""
        width = float(np.ptp(view.mesh.bounds[:, 0])) * self.stage.scale
        return (0.0 if self.trial is None else 0.5 * width + GAP) * view.T_world_camera[:3, 0]

    def _draw(self) -> None:
        """Callbacks of several threads draw; one at a time."""
        with self._drawing, self.server.atomic():
            view, trial = self.view, self.trial
            if view is None:
                return
            T_world_camera = view.T_world_camera
            aside = self._aside(view)
            self.truth.show(view.mesh.transformed(T_world_camera), self.controls, shift=aside)
            self.points.show(PointCloud(transform_points(T_world_camera, view.depth.to_points().points)), -aside)
            while self._names:
                self._names.pop().remove()
            if trial is None:
                self.answer.clear_from()
                return
            self.answer.show(trial.surfaces.transformed(T_world_camera), self.controls, shift=-aside)
            low, high = view.mesh.bounds  # of the camera frame, where y is down
            foot = np.array([(low[0] + high[0]) / 2, high[1] + GAP / self.stage.scale, (low[2] + high[2]) / 2])
            place = self.stage.place(transform_points(T_world_camera, foot))
            for text, shift in (("reconstruction", -aside), ("truth", aside)):
                at = tuple(place + shift)
                self._names.append(
                    self.server.scene.add_label(f"/names/{text}", text, position=at, anchor="top-center")
                )
