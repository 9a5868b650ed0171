"""Sliders for degrees of freedom, kept in step with the state, and for the camera."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mereo.scenes.draw_recorder import Key
from mereo.scenes.parameters import Freedom
from mereo.visualization.viewer.laboratory import CameraPlace, Laboratory

Moved = Callable[[Freedom, float], None]


class FreedomSliders:
    """One slider for each degree of freedom, in a folder for each group, all in ``folder``.

    Sliders that a new state still has stay as they are, also while they are being dragged; others come and go.
    """

    def __init__(self, gui: Any, folder: Any, moved: Moved) -> None:
        self._gui, self._folder, self._moved = gui, folder, moved
        self._folders: dict[str, Any] = {}
        self._handles: dict[tuple[Key, int | None], Any] = {}
        self._freedoms: dict[tuple[Key, int | None], Freedom] = {}

    def show(self, freedoms: Sequence[Freedom]) -> None:
        """Bring the sliders to a state."""
        wanted = {(freedom.key, freedom.index): freedom for freedom in freedoms}
        for gone in self._handles.keys() - wanted.keys():
            self._handles.pop(gone).remove()
        groups = {freedom.group for freedom in freedoms}
        for group in self._folders.keys() - groups:
            self._folders.pop(group).remove()
        for place, freedom in wanted.items():
            if place in self._handles:
                self._update(place, freedom)
            else:
                self._handles[place] = self._add(place, freedom)
        self._freedoms = wanted

    def _update(self, place: tuple[Key, int | None], freedom: Freedom) -> None:
        """Bounds may depend on other draws; values change when a state is refused or drawn anew."""
        handle, before = self._handles[place], self._freedoms[place]
        if (before.low, before.high) != (freedom.low, freedom.high):
            handle.min, handle.max, handle.step = _range(freedom)
        handle.value = _on_range(freedom)

    def _add(self, place: tuple[Key, int | None], freedom: Freedom) -> Any:
        if freedom.group not in self._folders:
            with self._folder:
                self._folders[freedom.group] = self._gui.add_folder(freedom.group, expand_by_default=not self._folders)
        with self._folders[freedom.group]:
            unit = f" ({freedom.unit.strip()})" if freedom.unit else ""
            handle = self._gui.add_slider(f"{freedom.name}{unit}", *_range(freedom), _on_range(freedom))
        handle.on_update(lambda event: self._told(event, place))
        return handle

    def _told(self, event: Any, place: tuple[Key, int | None]) -> None:
        """A person's hand has a client, our own ``show`` has none."""
        if event.client is not None and place in self._handles:
            self._moved(self._freedoms[place], float(self._handles[place].value))


def _range(freedom: Freedom) -> tuple[float, float, float]:
    """Ends and step of a slider, in numbers with few digits: a step of 0.01, 0.1, ... that divides it into 100 or more.

    Ends move outward by less than a step; ``set_value`` keeps to the true ones.
    """
    if freedom.whole:
        return freedom.low, freedom.high, 1.0
    digits = _digits(freedom)
    step = 10.0**-digits
    low, high = np.floor(freedom.low / step + 1e-6) * step, np.ceil(freedom.high / step - 1e-6) * step
    return round(float(low), digits), round(float(high), digits), step


def _digits(freedom: Freedom) -> int:
    return int(np.ceil(2 - np.log10(freedom.high - freedom.low) - 1e-9))


def _on_range(freedom: Freedom) -> float:
    low, high, _ = _range(freedom)
    value = freedom.value if freedom.whole else round(freedom.value, _digits(freedom))
    return min(max(value, low), high)


class CameraSliders:
    """Where the virtual camera is, within the scene's workspace."""

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
        return CameraPlace(
            float(np.deg2rad(self._tilt.value)),
            float(np.deg2rad(self._azimuth.value)),
            float(self._distance.value),
            float(np.deg2rad(self._roll.value)),
        )
