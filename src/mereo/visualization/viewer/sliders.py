"""Sliders for degrees of freedom, kept in step with the state, and for the camera."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mereo.scenes.draw_recorder import Key
from mereo.scenes.parameters import Parameter
from mereo.visualization.viewer.laboratory import CameraPlace, Laboratory

Moved = Callable[[Parameter, float], None]


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
