"""Frames of which it is open what belongs to the object: each reading is fitted, and the fits tell which is right.

    cloud -readings-> -encode, fit the modes-> FittedFrame of each -chosen-> FittedFrame

Strays move the box that the network's frame is made from, thin parts of the object look like strays, and geometry alone
cannot tell them apart (``reconstruction.strays``). A model that explains the points can. Where the strays are right but
for some points that the fit explains as well, these are given back, and the frame is fitted once more.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from mereo.fitting.registration.fit import ModesFit
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.transforms import transform_points
from mereo.models.model import Model
from mereo.reconstruction.pipeline import EncodedFrame, encode_frame
from mereo.reconstruction.strays import Reading, readings

CLEARLY = 0.05
"""Share of all points that the reading with every point must explain beyond the others: strays pull its fit towards
them, so it explains a few more of them even where it is wrong."""

GIVEN_BACK = 0.8
"""Share of the dropped points that, once explained by the fit to the others, or by that to all, were none: then every
point is kept. The fit to all explains .86 and more of them on clean views, and at most .44 where they are strays."""

AS_WELL = 0.01
"""Share of all points that a fit with points given back may explain less."""


@dataclass(frozen=True, eq=False)
class FittedFrame:
    """A frame in the reading that is taken, as a model has understood it, with the modes fitted to it.

    Attributes:
        seen: the reading, and what the model made of it.
        unaided: the same of the reading that is taken without a fit: what the network alone answers from.
        modes: the fit; None where none was asked for or none was found.
        error: why none was found.
    """

    seen: EncodedFrame
    unaided: EncodedFrame
    modes: ModesFit | None = None
    error: ValueError | None = None

    @property
    def reading(self) -> Reading:
        """Which of the points are taken for the object's."""
        return self.seen.reading

    @cached_property
    def off_surface(self) -> Float[np.ndarray, " n"]:
        """Distance of each of all points from the facing surface, scene units."""
        assert self.modes is not None
        return self.modes.off_surface(transform_points(self.seen.T_camera_input, self.reading.whole.points))


def fitted_frame(
    cloud: PointCloud | Float[np.ndarray, "n 3"],
    model: Model,
    registrar: Registrar | None,
    axes: CloudAxes = "camera",
    scene_unit: float | None = None,
    stated_unit: float | None = None,
    keep_all: bool = False,
    encoded: EncodedFrame | None = None,
) -> FittedFrame:
    """The frame in the reading that its fit explains best; without a registrar in the one that is likely by itself.

    Args:
        cloud: points on the object and strays, any unit and density.
        model: the weights.
        registrar: of the same object; None fits nothing.
        axes: of the cloud.
        scene_unit: length of a scene unit in the cloud's unit, where it is known.
        stated_unit: the same as the input states it, believed only where the network's own estimate agrees.
        keep_all: take every point for the object's.
        encoded: the likelier reading as the model has understood it, where that is known already (``encode_frames``).

    Raises ``ValueError`` for unusable clouds. Where a fit finds too little, ``FittedFrame.error`` says so.
    """
    started = time.perf_counter()
    found = readings(cloud, axes, keep_all)
    # beside strays much stays unexplained in any case, which is no reason to ask again
    fitting = registrar if registrar is None or len(found) == 1 else registrar.at_once

    def fitted(reading: Reading) -> FittedFrame:
        seen = encoded if encoded is not None and reading is found[0] else encode_frame(reading, model, axes)
        return FittedFrame(seen, seen) if fitting is None else fitted_by(fitting, seen)

    def fitted_by(one: Registrar, seen: EncodedFrame) -> FittedFrame:
        reading = seen.reading
        doubtful = transform_points(seen.T_camera_input, reading.whole.points[~reading.keep])
        try:
            modes = one.fit_modes(seen.seen, seen.code, scene_unit, stated_unit, doubtful)
        except ValueError as error:
            return FittedFrame(seen, seen, error=error)
        return FittedFrame(seen, seen, modes)

    first = fitted(found[0])
    if registrar is None or len(found) == 1:
        return first
    everything, surfaces = sorted((first, fitted(found[1])), key=lambda one: one.reading.dropped)
    taken = chosen(everything, surfaces, fitted)
    if taken.modes is not None and not taken.modes.registration().accepted:  # then it is not for strays alone
        taken = more_explained(taken, fitted_by(registrar.at_last, taken.seen))
    if taken.modes is not None:
        spent = time.perf_counter() - started - taken.seen.timings_s["encode"]
        taken = replace(taken, modes=replace(taken.modes, seconds=spent))
    return replace(taken, unaided=first.seen)


def more_explained(one: FittedFrame, other: FittedFrame) -> FittedFrame:
    """That of two fits to one reading which explains the greater share of all points; the first where both do."""
    if one.modes is None or other.modes is None:
        return one if other.modes is None else other
    tolerance = min(one.modes.tolerance, other.modes.tolerance)
    return one if (one.off_surface <= tolerance).mean() >= (other.off_surface <= tolerance).mean() else other


def chosen(everything: FittedFrame, surfaces: FittedFrame, fitted: Callable[[Reading], FittedFrame]) -> FittedFrame:
    """The better of two readings, or a third one: the second with the points that its fit explains given back."""
    if everything.modes is None or surfaces.modes is None:
        return everything if surfaces.modes is None else surfaces
    explained, keep = surfaces.off_surface <= surfaces.modes.tolerance, surfaces.reading.keep
    by_themselves = everything.off_surface <= everything.modes.tolerance
    if max(explained[~keep].mean(), by_themselves[~keep].mean()) > GIVEN_BACK:
        return everything
    again = fitted(replace(surfaces.reading, keep=keep | explained)) if explained[~keep].any() else surfaces
    again = surfaces if again.modes is None else again
    tried = (everything, surfaces, again)
    tolerance = min(one.modes.tolerance for one in tried if one.modes is not None)
    by_all, by_surfaces, by_again = (float((one.off_surface <= tolerance).mean()) for one in tried)
    if by_all >= max(by_surfaces, by_again) + CLEARLY:
        return everything
    return again if by_again >= by_surfaces - AS_WELL else surfaces
