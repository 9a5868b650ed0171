"""Find an object in frames, each by itself or one after the other: ``mereo reconstruct`` and ``mereo stream``.

    source -load_frame-> SensorFrame -find_object-> Observation -answer_observation-> Result
    frame, time -Tracker.follow-> Result (found, followed or lost)

A source is whatever holds a frame: a file, a shipped name, arrays, the clouds and messages of other libraries.
"""

import warnings
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

from numpy.typing import ArrayLike

from mereo.api.objects import OPTIONS, Object, Source, object_of
from mereo.api.result import Result
from mereo.api.words import check_names, in_callers_words, names_of, python_words, with_changes
from mereo.fitting.config import AnswerMethod
from mereo.geometry.camera import DepthImage
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.transforms import checked_pose
from mereo.io.atomic_files import JsonObject
from mereo.io.bounds import Instances
from mereo.io.config import InputConfig
from mereo.io.errors import AnyPath, value_text
from mereo.io.point_arrays import depth_values, is_frame_list, mask_image, points_of
from mereo.io.readers import mask_of_image, masked_depth, read_pose
from mereo.io.ros_recordings import is_recording
from mereo.io.sensor_frame import SensorFrame, along_z, depth_frame, in_camera, read_frame
from mereo.locating import following
from mereo.locating.whole_frame import answer_observation, at_point, is_whole
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import (
    CLOUD,
    ClustersWarning,
    Observation,
    SizeWarning,
    clusters_warning,
    find_object,
    size_warning,
)
from mereo.scenes.parameters import with_frame_joints
from mereo.synthesis.sample_views import shipped_frame, shipped_frames

Isolation = IsolationConfig | Mapping[str, Any] | None
"""What of a frame is left out: settings, or a dict of some of their fields."""

# --- frames -----------------------------------------------------------------------------------------------------------

FRAME_OPTIONS = {*names_of(InputConfig), "axes"} - {"frame"}
"""Options of ``load_frame``."""

RECONSTRUCT_OPTIONS = {
    *("method", "resolution", "isolation", "label_points", "initial_pose", "instances", "joints"),
    *(*FRAME_OPTIONS, *names_of(IsolationConfig), *OPTIONS),
}
"""Options of ``reconstruct``."""

PLACES = {
    "frame": "axes='scanner' states the axes",
    **dict.fromkeys(("K", "camera"), "intrinsics=K has it"),
    **dict.fromkeys(
        ("output", "formats", "millimetres", "force"), "result.save(path, formats=..., overwrite=True) has it"
    ),
    **dict.fromkeys(("carry", "carry_frame"), "result.carry(what, files=...) has it"),
    **dict.fromkeys(
        ("json", "threads", "ray", "cpus_per_task", "gpus_per_task", "options_from"), "the command alone has it"
    ),
}
"""Where options of `mereo reconstruct` are in Python that are none of ``reconstruct``."""


@python_words()
def load_frame(
    source: object,
    *,
    axes: CloudAxes | None = None,
    intrinsics: Any = None,
    mask: Any = None,
    mask_value: int | tuple[int, ...] = (),
    camera_pose: ArrayLike | str | Path | None = None,
    **options: Any,
) -> SensorFrame:
    """Load one frame of a depth camera or scanner.

    Args:
        source: a file (depth image, cloud, mesh, ROS recording) or the name of a shipped frame (``shipped_frames``);
            or points as n x 3 numbers, as a cloud of Open3D or trimesh, as a structured array or a ROS ``PointCloud2``;
            or a depth image, as ``DepthImage``, or as an array of h x w pixels, an image of Pillow or Open3D or a ROS
            ``Image`` with ``intrinsics``. Of n x 6 numbers the last three are normals, or colours, which are left out.
        axes: of points: "camera" (default) is x right, y down, z forward; "scanner" is y up, z toward the scanner.
        intrinsics: of a depth image: a file; or 3 x 3 numbers, (fx, fy, cx, cy), a dict of these, a ROS ``CameraInfo``,
            the intrinsics of Open3D or RealSense, all of which count pixels from 0 at the centre of the first; or a
            ``Camera``. Lens distortion is refused, of a file it is warned of.
        mask: file of an image that is not 0 where the object is; or that image, of Pillow or an array of h x w (or
            1 x h x w) truth values, whole numbers, logits or probabilities, as segmentation networks return them.
        mask_value: of the object in a mask that holds ids of several things, or its values.
        camera_pose: of points in another frame, such as a robot's base: 4 x 4 numbers, or a file of them, that take
            camera coordinates to theirs. The points are moved, and results come out in the camera's axes.
        options: the other fields of ``InputConfig``: ``unit_m``, metres per unit of points (0.001 for millimetres;
            without it the fit finds the unit); ``depth_scale``, stored values per metre of a depth image;
            ``depth_along="ray"``, where these are distances along its rays;
            ``drop_invalid``, to leave out points without a measurement, which are refused otherwise; ``topic`` of a
            recording; ``frame_index`` of a recording's frames, or of an entry of the intrinsics.

    Raises ``FileNotFoundError`` where there is no such file or name; ``ValueError`` for what is damaged or no frame,
    and for options that do not belong to this kind of frame; ``TypeError`` for an option that there is none of.
    """
    check_names(options, FRAME_OPTIONS, PLACES)
    values = (mask_value,) if isinstance(mask_value, int) else mask_value
    if mask is not None and not isinstance(mask, AnyPath):
        image = mask_image(mask)
        frame = load_frame(source, axes=axes, intrinsics=intrinsics, camera_pose=camera_pose, **options)
        if frame.whole is None:
            raise ValueError(f"a mask is given, but {frame.path} is a point cloud, which has no pixels: leave it out")
        size = frame.whole.camera.width, frame.whole.camera.height
        depth = masked_depth(frame.whole, frame.path, mask_of_image(image, size, values))
        return replace(frame, depth=depth, cloud=depth.to_points())
    mask, axes_or_camera = None if mask is None else Path(mask), "camera" if axes is None else axes
    is_file = isinstance(intrinsics, AnyPath)
    options |= {"frame": axes_or_camera, "mask": mask, "mask_value": values}
    reading = InputConfig(intrinsics=Path(intrinsics) if is_file else None, **options)
    pose = None
    if camera_pose is not None:
        pose = read_pose(Path(camera_pose)) if isinstance(camera_pose, AnyPath) else checked_pose(camera_pose)
    if not isinstance(source, AnyPath):
        frame = _frame_in_memory(source, axes, intrinsics, reading)
        return in_camera(frame, reading, pose)
    path = Path(source)
    if str(source) in shipped_frames() and not (path.is_file() or is_recording(path)):
        stated = axes is not None or intrinsics is not None or pose is not None
        if stated or replace(reading, drop_invalid=False) != InputConfig():
            raise ValueError(f"the shipped frame {str(source)!r} is in metres and needs no options: leave them out")
        return shipped_frame(str(source))
    if not path.exists() and path.suffix == "":
        known = ", ".join(shipped_frames())
        raise FileNotFoundError(f"there is no frame {str(source)!r}; give a file or one of the shipped: {known}")
    return read_frame(source, reading, pose, None if is_file else intrinsics)


def _frame_in_memory(source: object, axes: CloudAxes | None, intrinsics: Any, reading: InputConfig) -> SensorFrame:
    for name in ("mask", "mask_value", "topic", "frame_index"):
        if getattr(reading, name) not in (None, ()) and not (name.startswith("mask") and intrinsics is not None):
            raise ValueError(f"{name} is given for a frame that is no file's: leave it out, or name the file")
    unit_m = reading.unit_m
    if intrinsics is not None:
        if axes == "scanner" or unit_m is not None:
            raise ValueError("a depth image is in metres and in the camera's axes: leave out axes and unit_m")
        return depth_frame(Path("depth image"), depth_values(source), reading, intrinsics)
    if reading.depth_scale is not None:
        raise ValueError("depth_scale is given without intrinsics; a depth image needs both: give intrinsics=...")
    observed, invalid = points_of(source, reading.drop_invalid)
    if isinstance(observed, DepthImage):
        if axes == "scanner":
            raise ValueError("a depth image is in the camera's axes: leave out axes")
        image = along_z(observed, reading)
        return SensorFrame(CLOUD, image.to_points(), unit_m, "camera", image, whole=image)
    if reading.depth_along == "ray":
        raise ValueError("depth_along is given for points, whose distance is known in any case: leave it out")
    return SensorFrame(CLOUD, observed, unit_m, reading.frame, invalid=invalid)


def split_options(isolation: Any, options: JsonObject) -> tuple[IsolationConfig, JsonObject]:
    """Settings of isolation, with what of ``options`` is a field of them, and the other options."""
    if not isinstance(isolation, IsolationConfig | Mapping | None):
        raise ValueError(
            f"isolation is {value_text(isolation)}; it must be an IsolationConfig or a dict of its fields: give for "
            "example largest_cluster=True by itself"
        )
    check_names(options, RECONSTRUCT_OPTIONS, PLACES)
    stated = isolation if isinstance(isolation, IsolationConfig) else with_changes(IsolationConfig(), isolation or {})
    changes = {name: options.pop(name) for name in names_of(IsolationConfig) if name in options}
    return replace(stated, **changes), options


def observation_of(frame: Any, isolation: IsolationConfig, reading: JsonObject) -> Observation:
    """Object in a frame, whatever holds it."""
    if isinstance(frame, Observation) and replace(isolation, keep_all=False) != IsolationConfig():
        raise ValueError("isolation is given for an object that is isolated already: give it to find_object")
    if not isinstance(frame, SensorFrame | Observation):
        frame = load_frame(frame, **reading)
    elif reading:
        raise ValueError(
            f"{', '.join(reading)} is given for a frame that is read already: give it where the frame is read, "
            "load_frame(..., axes='scanner', unit_m=0.001)"
        )
    return frame if isinstance(frame, Observation) else find_object(frame, isolation)


# --- single frames ----------------------------------------------------------------------------------------------------


@overload
def reconstruct(
    frame: list[Any] | tuple[Any, ...], object: Source, method: AnswerMethod = ..., **options: Any
) -> list[Result]: ...


@overload
def reconstruct(frame: Any, object: Source, method: AnswerMethod = ..., **options: Any) -> Result: ...


def reconstruct(
    frame: Any,
    object: Source,
    method: AnswerMethod = "auto",
    *,
    resolution: int = 128,
    isolation: Isolation = None,
    label_points: bool = False,
    initial_pose: ArrayLike | None = None,
    **options: Any,
) -> Result | list[Result]:
    """Find all segments of an object in a frame, hidden side included: what ``mereo reconstruct`` does.

    Args:
        frame: whatever ``load_frame`` takes, or what it has returned; a list of frames is answered as a list. In a
            whole depth image, which plainly shows more than an object of this size, the object is looked for.
        object: from ``load_object``, or whatever that takes.
        method: "auto" registers the model by a search that begins at a network's guess, where there are weights;
            "search" leaves the network out; "network" takes its surfaces alone; "modes" leaves the parameters of the
            object's scene out.
        resolution: cells along the longest side of the object's box.
        isolation: what of the frame is left out, or a dict of its fields; lengths in metres, or in the frame's unit
            where that is not known.
        label_points: also say on which segment each observed point lies (``Result.reconstruction.observed``).
        initial_pose: rough pose of the object, as ``Result.pose``, from which the fit starts instead of a search or a
            network; what the scene holds (``held``) stays there. Both units must be known.
        options: ``joints``, values of joints that are known, as by encoders: by name a number, or a dict of ``value``
            and ``within``, the largest error (radians, or metres of joints that slide), or a ``JointState`` of ROS, or
            a YAML or JSON file of either; only the others are looked for. ``instances``, how many of the object are
            looked for in a whole depth image, or "all", of which the result is the most evident one's, and its
            ``instances`` are those of all that are known; fields of ``isolation`` by themselves, ``extent="partial"``
            where a part of the object is hidden or cut off, ``point=(u, v)``, the column and row of a pixel of the
            object, ``box`` and others; arguments of ``load_frame``, ``axes``, ``unit_m``, ``intrinsics``, ``mask`` and
            others; and those of ``load_object``, ``units``, ``deformations`` and others, where ``object`` is not
            loaded yet.

    Warns with ``SizeWarning`` where the visible part cannot be the object of the weights, and without weights with
    ``ClustersWarning`` where the cloud may be two objects. Raises ``ValueError`` for unusable frames,
    and where no fit can start; ``TypeError`` for an option that there is none of.
    """
    results = list[Result]()
    are_many = is_frame_list(frame) or (
        isinstance(frame, list | tuple) and any(isinstance(each, SensorFrame | Observation) for each in frame)
    )
    instances = options.pop("instances", 1)
    with python_words():
        isolation, reading = split_options(isolation, options)
        known = object_of(object, **{name: reading.pop(name) for name in ("joints", *OPTIONS) if name in reading})
        for each in frame if are_many else [frame]:  # not a comprehension: a warning names the caller's line
            observation = observation_of(each, isolation, reading)
            if initial_pose is not None:
                observation = replace(observation, initial_pose=checked_pose(initial_pose))
            results.append(
                reconstruct_observation(
                    observation,
                    known,
                    method,
                    resolution=resolution,
                    isolation=isolation,
                    label_points=label_points,
                    instances=instances,
                )
            )
    return results if are_many else results[0]


def reconstruct_observation(
    seen: Observation,
    object: Object,
    method: AnswerMethod = "auto",
    *,
    resolution: int = 128,
    isolation: IsolationConfig = IsolationConfig(),  # noqa: B008 (frozen)
    label_points: bool = False,
    instances: Instances = 1,
) -> Result:
    """Find all segments of an object that was observed: ``reconstruct`` once the frame is read and isolated.

    Takes its arguments, raises and warns as it does. Of ``isolation`` it matters whether every point is kept.
    """
    registrar = object.registrar(method)
    seen = at_point(seen, registrar)
    is_alone = registrar is None or not is_whole(seen, registrar)
    if object.network is None and is_alone and (warning := clusters_warning(seen)) is not None:
        warnings.warn(in_callers_words(warning), ClustersWarning, stacklevel=3)
    answer = answer_observation(
        seen,
        object.network,
        registrar,
        keep_all=isolation.keep_all,
        resolution=resolution,
        label_points=label_points,
        instances=instances,
    )
    result = Result.of(answer)
    _ = result.reconstruction  # raises where nothing is found
    if object.network is not None:
        warning = size_warning(seen.read_as(answer.hypothesis), object.network.provenance)
        if warning is not None:
            warnings.warn(in_callers_words(warning), SizeWarning, stacklevel=3)
    return result


# --- sequences of frames ----------------------------------------------------------------------------------------------


class Tracker:
    """Follow one object through a sequence of frames; not safe for use by several threads at once.

    Each frame is fitted from the last one's state, in milliseconds, also where a hand or a tool hides a part of the
    object. ``Result.tracking`` says how it went:

    - "found": the frame was fitted by itself, as the first one is, for which it waits a second or some; or it was found
      again by a search in the background.
    - "followed": the last frame's state led to it.
    - "lost": the object has left the view, is covered, or has moved too far; ``known`` is False and
      ``recognition.reason`` says why; ``surfaces`` raise ``ValueError``. A search goes on in a thread of its own,
      while frames are answered in milliseconds, until the object is found.

    ``close``, or leaving a ``with`` block, ends that thread.
    """

    @python_words()
    def __init__(
        self,
        object: Source,
        method: AnswerMethod = "auto",
        *,
        executor: Executor | None = None,
        isolation: Isolation = None,
        initial_pose: ArrayLike | None = None,
        joints: object = None,
    ) -> None:
        """Follow an object.

        Args:
            object: from ``load_object``, or whatever that takes.
            method: "auto", or "search" to leave out the network.
            executor: what searches for a lost object; by default a thread of the tracker's own.
            isolation: what of each frame is left out, as in ``reconstruct``.
            initial_pose: rough pose of the object in the first frame, as in ``reconstruct``.
            joints: values that are known and stay as they are, as in ``reconstruct``; ``follow`` takes others of each
                frame, which may narrow these but not contradict them.

        Raises ``ValueError`` for other methods and poses, and for weights without a deformation model.
        """
        self._isolation, _ = split_options(isolation, {})
        self._initial_pose = None if initial_pose is None else checked_pose(initial_pose)
        known = object_of(object, joints)
        registrar, self._scene = None if method == "network" else known.registrar(method), known.scene
        if registrar is None:
            raise ValueError(
                f'the method is {method!r}, and only the modes of a deformation model can be followed: take "auto" '
                "with weights that carry one"
            )
        self._tracker = following.Tracker(registrar, executor=executor)

    def follow(
        self,
        frame: Any,
        time_s: float,
        *,
        isolation: Isolation = None,
        joints: object = None,
        **options: Any,
    ) -> Result:
        """Find the object in the next frame.

        Args:
            frame: whatever ``load_frame`` takes, or what it has returned; in one unit throughout the sequence.
            time_s: of the frame, seconds from any zero, later than the last one's.
            isolation: what of the frame is left out, where that is not as of the tracker.
            joints: values that are known at that time, as in ``reconstruct``, besides those of the tracker.
            options: as in ``reconstruct``: fields of ``isolation`` by themselves, and arguments of ``load_frame``.

        Raises ``ValueError`` for unusable frames, after which the sequence may go on. Surfaces, labels and figures are
        made on first use.
        """
        with python_words():
            isolation, reading = split_options(self._isolation if isolation is None else isolation, options)
            seen = observation_of(frame, isolation, reading)
            if self._initial_pose is not None:
                seen = replace(seen, initial_pose=self._initial_pose)
            scene = None if joints is None else with_frame_joints(self._scene, joints)
            answer = self._tracker.follow(seen, time_s, keep_all=isolation.keep_all, scene=scene)
        self._initial_pose = None
        return Result.of(answer)

    def forget(self) -> None:
        """Start again: the next frame is fitted by itself; a search that goes on is given up."""
        self._tracker.forget()

    def close(self) -> None:
        """Give up a search that goes on, and wait until its thread has ended, for seconds at most."""
        self._tracker.close()

    def __enter__(self) -> "Tracker":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
