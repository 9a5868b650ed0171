"""Find an object in frames: what ``mereo reconstruct`` does with files.

frame -load_frame-> SensorFrame -find_object-> Observation -answer_frame-> Answer -> Result
"""

import warnings
from functools import partial
from typing import Any, overload

from mereo.api.frames import load_frame
from mereo.api.objects import Object, Source, object_of
from mereo.api.result import Result
from mereo.api.words import SPEAKS_OPTIONS, in_python, python_words
from mereo.fitting.config import AnswerMethod
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.io.point_arrays import is_frame_list
from mereo.io.sensor_frame import SensorFrame
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import (
    ClustersWarning,
    Observation,
    SizeWarning,
    clusters_warning,
    find_object,
    size_warning,
)


@overload
def reconstruct(
    frame: list[Any] | tuple[Any, ...],
    object: Object | Source,
    method: AnswerMethod = ...,
    *,
    resolution: int = ...,
    isolation: IsolationConfig | None = ...,
    label_points: bool = ...,
    **reading: Any,
) -> list[Result]: ...


@overload
def reconstruct(
    frame: Any,
    object: Object | Source,
    method: AnswerMethod = ...,
    *,
    resolution: int = ...,
    isolation: IsolationConfig | None = ...,
    label_points: bool = ...,
    **reading: Any,
) -> Result: ...


def reconstruct(
    frame: Any,
    object: Object | Source,
    method: AnswerMethod = "auto",
    *,
    resolution: int = 128,
    isolation: IsolationConfig | None = None,
    label_points: bool = False,
    **reading: Any,
) -> Result | list[Result]:
    """Find all segments of an object in a frame, hidden side included: what ``mereo reconstruct`` does.

    Args:
        frame: whatever ``load_frame`` takes, or what it has returned; a list of frames is answered as a list.
        object: from ``load_object``, or whatever that takes.
        method: "auto" takes the registered model where it explains the frame, else the network's surfaces; "network"
            leaves the network alone; "search" leaves it out; "modes" and "full" take the registered model in any case,
            "full" by fitting the parameters of its scene as well. Without weights, "auto" is "search".
        resolution: cells along the longest side of the object's box.
        isolation: what of the frame is left out; lengths in metres, or in the frame's unit where that is not known.
        label_points: also say on which segment each observed point lies (``Result.reconstruction.observed``).
        reading: arguments of ``load_frame``: ``axes``, ``unit_m``, ``intrinsics``, ``drop_invalid`` and others.

    Warns with ``SizeWarning`` where the visible part cannot be the object of the weights, and without weights with
    ``ClustersWarning`` where the cloud may be two objects. Raises ``ValueError`` for unusable frames,
    where nothing is found, and for methods other than "auto" where the model cannot be registered.
    """
    isolation = isolation or IsolationConfig()
    with python_words():
        answer = partial(
            reconstruct_observation,
            object=object_of(object),
            method=method,
            resolution=resolution,
            isolation=isolation,
            label_points=label_points,
        )
        if not _are_many(frame):
            return answer(observation_of(frame, isolation, reading))
        seen = (observation_of(one, isolation, reading) for one in frame)
        return list(map(answer, seen))  # not a comprehension: a warning names the caller's line


def reconstruct_observation(
    seen: Observation,
    object: Object,
    method: AnswerMethod = "auto",
    *,
    resolution: int = 128,
    isolation: IsolationConfig = IsolationConfig(),  # noqa: B008 (frozen)
    label_points: bool = False,
) -> Result:
    """Find all segments of an object that was observed: ``reconstruct`` once the frame is read and isolated.

    Takes its arguments, raises and warns as it does. Of ``isolation`` it matters whether every point is kept.
    """
    if object.network is None and (warning := clusters_warning(seen)) is not None:
        warnings.warn(_said(warning), ClustersWarning, stacklevel=3)
    answer = answer_frame(
        seen,
        object.network,
        object.registrar(method),
        keep_all=isolation.keep_all,
        resolution=resolution,
        label_points=label_points,
    )
    if answer.error is not None and method != "auto":
        raise answer.error
    result = Result.of(answer)
    _ = result.reconstruction  # raises where nothing is found
    if object.network is not None:
        warning = size_warning(seen.read_as(answer.hypothesis), object.network.provenance)
        if warning is not None:
            warnings.warn(_said(warning), SizeWarning, stacklevel=3)
    return result


def _said(text: str) -> str:
    """A warning in the words of whoever called."""
    return text if SPEAKS_OPTIONS.get() else in_python(text)


def _are_many(frame: Any) -> bool:
    """Whether this is a list of frames; those that are read already count as such."""
    read = SensorFrame | Observation
    return is_frame_list(frame) or (isinstance(frame, list | tuple) and any(isinstance(one, read) for one in frame))


def observation_of(frame: Any, isolation: IsolationConfig, reading: dict[str, Any]) -> Observation:
    """Object in a frame, whatever holds it."""
    if isinstance(frame, SensorFrame | Observation):
        if reading:
            raise ValueError(
                f"{', '.join(reading)} is given for a frame that is read already: give it where the frame is read, "
                "load_frame(..., axes='scanner', unit_m=0.001)"
            )
        return frame if isinstance(frame, Observation) else find_object(frame, isolation)
    return find_object(load_frame(frame, **reading), isolation)
