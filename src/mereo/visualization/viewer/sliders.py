"""Sliders for degrees of freedom, kept in step with the state, for the camera's place, and for its sensor."""

from collections.abc import Callable, Sequence
from typing import Any, get_args

import numpy as np

from mereo.scenes.draw_recorder import Key
from mereo.scenes.parameters import Parameter
from mereo.synthesis.config import SENSORS, Occluder
from mereo.visualization.viewer import html
from mereo.visualization.viewer.laboratory import CameraPlace, Laboratory
from mereo.visualization.viewer.sight import Sensing

Moved = Callable[[Parameter, float], None]

SIZES = (32, 256)
"""Fewest and most pixels of the virtual camera's image, a side."""

MOST_NOISE = 1.0
"""Largest Gaussian noise, in scene units: ten times the paper's."""

MOST_HIDDEN = 70
"""Largest share of the object, in per cent, that something in front can be asked to hide."""


class ParameterSliders:
    """Sliders for the degrees of freedom, one for each, in a folder for each group, all in ``folder``.

    Sliders that a new state still has stay as they are, also while they are being dragged; others come and go.
    """

    def __init__(self, gui: Any, folder: Any, moved: Moved) -> None:
        self._gui, self._folder, self._moved = gui, folder, moved
        self._folders: dict[str, Any] = {}
        self._handles: dict[tuple[Key, int | None], Any] = {}
        self._parameters: dict[tuple[Key, int | None], Parameter] = {}

    def show(self, parameters: Sequence[Parameter]) -> None:
        """Bring the sliders to a state."""
        wanted = {(parameter.key, parameter.index): parameter for parameter in parameters}
        for gone in self._handles.keys() - wanted.keys():
            self._handles.pop(gone).remove()
        groups = {parameter.group for parameter in parameters}
        for group in self._folders.keys() - groups:
            self._folders.pop(group).remove()
        for place, parameter in wanted.items():
            if place in self._handles:
                self._update(place, parameter)
            else:
                self._handles[place] = self._add(place, parameter)
        self._parameters = wanted

    def _update(self, place: tuple[Key, int | None], parameter: Parameter) -> None:
        """Bounds may depend on other draws; values change when a state is refused or drawn anew."""
        handle, before = self._handles[place], self._parameters[place]
        if (before.low, before.high) != (parameter.low, parameter.high):
            handle.min, handle.max, handle.step = _range(parameter)
        handle.value = _on_range(parameter)

    def _add(self, place: tuple[Key, int | None], parameter: Parameter) -> Any:
        if parameter.group not in self._folders:
            with self._folder:
                self._folders[parameter.group] = self._gui.add_folder(
                    parameter.group, expand_by_default=not self._folders
                )
        with self._folders[parameter.group]:
            unit = f" ({parameter.unit})" if parameter.unit else ""
            handle = self._gui.add_slider(f"{parameter.name}{unit}", *_range(parameter), _on_range(parameter))
        handle.on_update(lambda event: self._told(event, place))
        return handle

    def _told(self, event: Any, place: tuple[Key, int | None]) -> None:
        """A person's hand has a client, our own ``show`` has none."""
        if event.client is not None and place in self._handles:
            self._moved(self._parameters[place], float(self._handles[place].value))


def _range(parameter: Parameter) -> tuple[float, float, float]:
    """Ends and step of a slider, in numbers with few digits: a step of 0.01, 0.1, ... that divides it into 100 or more.

    Ends move outward by less than a step; ``set_value`` keeps to the true ones.
    """
    if parameter.whole:
        return parameter.low, parameter.high, 1.0
    digits = _digits(parameter)
    step = 10.0**-digits
    low, high = np.floor(parameter.low / step + 1e-6) * step, np.ceil(parameter.high / step - 1e-6) * step
    return round(float(low), digits), round(float(high), digits), step


def _digits(parameter: Parameter) -> int:
    return int(np.ceil(2 - np.log10(parameter.high - parameter.low) - 1e-9))


def _on_range(parameter: Parameter) -> float:
    low, high, _ = _range(parameter)
    value = parameter.value if parameter.whole else round(parameter.value, _digits(parameter))
    return min(max(value, low), high)


class CameraSliders:
    """Sliders for the place of the virtual camera, within the scene's workspace."""

    def __init__(self, gui: Any, laboratory: Laboratory, moved: Callable[[], None]) -> None:
        place, workspace = laboratory.first_place(), laboratory.scene.workspace
        tilt = float(np.rad2deg(laboratory.most_tilt_rad))
        near, far = workspace.distance
        self._tilt = gui.add_slider("tilt (°)", 0.0, tilt, 0.5, float(np.rad2deg(place.tilt_rad)))
        self._azimuth = gui.add_slider("around (°)", -180.0, 180.0, 1.0, float(np.rad2deg(place.azimuth_rad)))
        self._distance = gui.add_slider("distance", near, far, max((far - near) / 200, 1e-9), place.distance)
        self._roll = gui.add_slider("roll (°)", -180.0, 180.0, 1.0, 0.0, visible=workspace.any_roll)
        for handle in (self._tilt, self._azimuth, self._distance, self._roll):
            handle.on_update(lambda event: moved() if event.client is not None else None)

    def place(self) -> CameraPlace:
        """Place of the camera that the sliders say."""
        return CameraPlace(
            float(np.deg2rad(self._tilt.value)),
            float(np.deg2rad(self._azimuth.value)),
            float(self._distance.value),
            float(np.deg2rad(self._roll.value)),
        )


class SensorControls:
    """Controls of the virtual camera's sensor, and of what stands in front of the object."""

    def __init__(self, gui: Any, changed: Callable[[], None]) -> None:
        plain = Sensing()
        self._sensor = gui.add_dropdown("sensor", tuple(SENSORS), initial_value=plain.sensor)
        self._size = gui.add_slider("pixels", *SIZES, 16, plain.image_size)
        self._noise = gui.add_slider("noise (units)", 0.0, MOST_NOISE, 0.02, plain.noise_std)
        self._front = gui.add_dropdown("in front", get_args(Occluder), initial_value=plain.front)
        self._hidden = gui.add_slider("hides (%)", 1, MOST_HIDDEN, 1, round(100 * plain.hidden), visible=False)
        self._told = gui.add_html("", visible=False)
        for handle in (self._sensor, self._size, self._noise, self._front, self._hidden):
            handle.on_update(lambda event: changed() if event.client is not None else None)
        self._front.on_update(lambda _: self._fold())

    def _fold(self) -> None:
        self._hidden.visible = self._told.visible = self._front.value != "none"

    def sensing(self) -> Sensing:
        """Camera that the controls say."""
        return Sensing(
            self._sensor.value,
            int(self._size.value),
            float(self._noise.value),
            self._front.value,
            float(self._hidden.value) / 100,
        )

    def tell(self, hidden: float) -> None:
        """Say how much of the object is hidden: tools are thin, and not every share can be had."""
        self._told.content = html.message(f"the {self._front.value} hides {hidden:.0%} of the object")
