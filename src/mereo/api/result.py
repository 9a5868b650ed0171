"""The result of one frame: every segment with its figures, to be looked at, carried along, saved and shown.

Result[name] -> SegmentResult
-save-> a folder as of ``mereo reconstruct``, or one file
-show-> a page in the browser
-carry-> what is defined in the object's own files, in the frame's axes and unit
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, reduce
from html import escape
from importlib import import_module
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from mereo.api.objects import Object, Source, object_of
from mereo.api.words import python_words
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import Names, WholeNumbers
from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import EMPTY_MESH, Segment, SegmentedMesh
from mereo.geometry.transforms import Vector, checked_pose, inverse_rigid, rigid, transform_points
from mereo.io.atomic_files import JsonObject, atomic_file, new_directory, to_json
from mereo.io.attachments import Attachment, Content, PoseTable, Positions, Surfaces, read_attachments, write_attachment
from mereo.io.bounds import Port, check_value
from mereo.io.config import DEFAULT_FILES, CarryFrame, FilesConfig, Format
from mereo.io.errors import AnyPath, checked_path, readable, value_text
from mereo.io.mesh_formats import read_glb
from mereo.io.point_arrays import mesh_of, model_points, parts_of_scene
from mereo.io.readers import read_arrays
from mereo.io.ros_recordings import is_recording
from mereo.io.sensor_frame import SensorFrame
from mereo.io.writers.formats import WRITERS, Results, chosen_formats, write_formats, write_single
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION
from mereo.io.writers.volumes import MM_PER_M
from mereo.reconstruction.pipeline import Reconstruction, along_axes, described
from mereo.results.carry import carry, place
from mereo.results.joints import JointValues, measure_joints, pose_covariance, segment_poses
from mereo.results.state import STATE, RegistrationState, read_state, restored, save_state
from mereo.visualization.reconstruction_report import result_html, stated_joints
from mereo.visualization.result_files import (
    INSTANCE,
    summary_of,
    to_viewer_of,
    write_answer,
    write_answer_file,
)
from mereo.visualization.units import Unit

if TYPE_CHECKING:
    import trimesh

    from mereo_viewer.server import OpenPage

Pose = Float[ndarray, "4 4"]


Entry = TypeVar("Entry")


def _by_name(segments: Mapping[str, Entry], name: str) -> Entry:
    if name not in segments:
        raise KeyError(f"there is no segment {name!r}; the segments are {', '.join(segments)}")
    return segments[name]


@dataclass(frozen=True, eq=False)
class SegmentResult:
    """One segment of a result, in the frame's axes and unit.

    Attributes:
        name: of the segment.
        label: its number in label grids, 1 or more.
        mesh: its closed surface; without faces where it was not found.
        centroid: of its volume, NaN where it was not found.
        volume: inside its surface, less what is nested in it; 0 where it was not found.
        confidence: mean probability that the network gives it over its volume, NaN where it was not found, and
            without a network.
        error_radius: radius around the centroid that holds the true one with probability 0.95; None where the answer
            is the network's.
        expected_iou: intersection over union of its volume with the true one, as it may be expected; None likewise.
        pose: best rigid motion from the object's own files to the frame, as ``Result.pose``; of a link of a robot's
            file, the pose of its frame there; None likewise.
        poses: of all segments, by their names; empty where the answer is the network's.
    """

    name: str
    label: int
    mesh: Segment
    centroid: Vector
    volume: float
    confidence: float
    error_radius: float | None
    expected_iou: float | None
    pose: Pose | None
    poses: Mapping[str, Pose] = field(default_factory=dict)

    def pose_in(self, name: str) -> Pose:
        """Pose of this segment in the frame of another one.

        4 x 4, ``T_other_this``, in the frame's unit. Links of a robot's file have their frames there; other segments
        have the axes and the origin of the object's own files, so that it is the unit matrix at rest. Raises
        ``KeyError`` for a name of no segment, and ``ValueError`` where the answer is the network's, which has no poses.
        """
        if self.pose is None:
            raise ValueError(NO_REGISTRATION)
        return inverse_rigid(_by_name(self.poses, name)) @ self.pose

    @property
    def is_present(self) -> bool:
        """Whether the frame shows it, or the registered model has it."""
        return len(self.mesh.faces) > 0

    def to_trimesh(self) -> "trimesh.Trimesh":
        """Surface as a mesh of trimesh, in the segment's colour."""
        import trimesh

        color = [*self.mesh.color, 255]
        return trimesh.Trimesh(self.mesh.vertices, self.mesh.faces, face_colors=color, process=False)

    def to_open3d(self) -> Any:
        """Surface as a ``TriangleMesh`` of Open3D, in the segment's colour; ``ImportError`` without Open3D."""
        mesh = _open3d_mesh(self.mesh)
        mesh.paint_uniform_color([channel / 255 for channel in self.mesh.color])
        mesh.compute_vertex_normals()
        return mesh

    def __repr__(self) -> str:
        return described(self, self.is_present)


SegmentResults = dict[str, SegmentResult]
"""Segments of a result by their names."""


def _open3d_mesh(mesh: Segment) -> Any:
    try:
        open3d = import_module("open3d")
    except ImportError:
        raise ImportError("Open3D is not installed: pip install open3d, or take to_trimesh()") from None
    vertices = open3d.utility.Vector3dVector(mesh.vertices)
    return open3d.geometry.TriangleMesh(vertices, open3d.utility.Vector3iVector(mesh.faces))


class SegmentedResult(ABC):
    """Object in a frame, its segments by their names; what a ``Result`` and a ``StoredResult`` have in common."""

    @property
    @abstractmethod
    def _segments(self) -> SegmentResults:
        """All segments by their names."""

    @property
    def names(self) -> Names:
        """Names of the segments, in the order of their labels; none where the object is lost without an answer."""
        return tuple(self._segments)

    def __getitem__(self, name: str) -> SegmentResult:
        """Segment of a name; raises ``KeyError`` for a name of no segment, ``ValueError`` where the object is lost."""
        return _by_name(self._segments, name)

    def __contains__(self, name: object) -> bool:
        """Whether there is a segment of this name."""
        return name in self.names

    def __iter__(self) -> Iterator[SegmentResult]:
        """All segments, in the order of their labels."""
        return iter(self._segments.values() if self.names else ())

    def __len__(self) -> int:
        """Number of segments."""
        return len(self.names)

    def to_trimesh(self) -> "trimesh.Scene":
        """Scene of trimesh with a mesh for each segment that was found, by its name and in its colour."""
        import trimesh

        scene = trimesh.Scene()
        for segment in self:
            if segment.is_present:
                scene.add_geometry(segment.to_trimesh(), node_name=segment.name, geom_name=segment.name)
        return scene

    def to_open3d(self) -> dict[str, Any]:
        """Mesh of Open3D for each segment that was found, by its name and in its colour.

        Raises ``ImportError`` without Open3D.
        """
        return {segment.name: segment.to_open3d() for segment in self if segment.is_present}

    @python_words()
    def carry(self, what: Any, files: CarryFrame = "source") -> Any:
        """Carry points, poses, a mesh or a file of the object's own frame and unit to where it is now.

        Args:
            what: points (whatever ``load_frame`` takes of points), which come back as an array [n, 3], of one point
                [3]; rigid poses 4 x 4 or n x 4 x 4, which turn as their surroundings; a mesh of trimesh or Open3D,
                ``Segment``, ``SegmentedMesh`` or (vertices, faces), which comes back as its kind, with edges short
                enough to bend; a dict of these, or a scene of trimesh, as a dict; or the path of a file as of
                ``--carry``, a volume included, which comes back as a ``CarriedFile``.
            files: frame and unit of it: "source" is that of the object's own files, "scene" that of its scene; "RAS"
                and "LPS" state the space of the object's own files, where these do not name it.

        Raises ``ValueError`` where the answer is the network's, where the frame of the object's files is not known, and
        for what lies too far from the object to belong to it.
        """
        check_value("files", files, CarryFrame, "source")
        what = parts_of_scene(what)
        if isinstance(what, Mapping):
            return {name: self.carry(each, files) for name, each in what.items()}
        registrar, registered, frame = self._carrier()
        (placed,) = place([_attachment(what)], registrar, files)
        carried = carry(placed, registered)
        content = carried.content
        if isinstance(what, AnyPath):
            return CarriedFile(carried.name, content, carried.inside, carried.farthest, frame)
        if isinstance(content, PoseTable):
            assert content.rotations is not None
            poses = np.stack([rigid(*each) for each in zip(content.rotations, content.points, strict=True)])
            return poses.reshape(_shape(what))
        if isinstance(content, Positions):
            return content.points[0] if _shape(what) == (3,) else content.points
        assert isinstance(content, Surfaces)
        return _as_kind_of(what, content.mesh)

    @python_words()
    def save(
        self,
        path: str | Path | None = None,
        *,
        formats: Sequence[Format] | None = None,
        millimetres: bool = False,
        overwrite: bool = False,
    ) -> Path:
        """Write a folder of results as ``mereo reconstruct`` does, or one file; returns its path.

        Args:
            path: a folder to create, by default result, result2, ...; or a file whose suffix says what it is: .glb,
                .ply (surfaces), .npz, .vti, .nii.gz, .seg.nrrd (labels), .json (the figures), .html (the report), .png
                (the preview).
            formats: files of a folder besides report and preview, as ``--formats``; "points" needs
                ``reconstruct(..., label_points=True)``.
            millimetres: write .ply, .vti and other files that have no unit in millimetres, not in the frame's unit.
            overwrite: replace a folder that mereo wrote, and nothing else is in, or a file that no input is.

        Raises ``FileExistsError`` for what exists, unless ``overwrite`` may replace it; ``ValueError`` for a suffix or
        a format that there is none of, and ``ImportError`` where a format's extra is missing.
        """
        path = free_folder() if path is None else checked_path(path, "path")
        suffix = file_suffix(path)
        if suffix == "":
            _check_list(formats)
            wanted = chosen_formats(DEFAULT_FILES.formats if formats is None else formats)
            with new_directory(path, overwrite, self._read()) as directory:
                self._write_folder(directory, FilesConfig(wanted, millimetres))
        elif formats is not None:
            raise ValueError(f"{path} is one file, whose suffix says its format: leave out formats")
        else:
            with atomic_file(path, force=overwrite, inputs=self._read()) as partial:
                self._write_file(partial, suffix, FilesConfig((), millimetres))
        return path

    @abstractmethod
    def _carrier(self) -> tuple[Registrar, Registration, SensorFrame]:
        """Registrar of the object, its registration, and the frame whose axes that is in."""

    @abstractmethod
    def _write_folder(self, directory: Path, files: FilesConfig) -> None:
        """Write what a folder of results has."""

    @abstractmethod
    def _write_file(self, path: Path, suffix: str, files: FilesConfig) -> None:
        """Write one file."""

    def _read(self) -> list[Path]:
        """Files that this was made from."""
        return []


SINGLE = (".glb", ".ply", ".npz", ".vti", ".nii.gz", ".seg.nrrd", ".json", ".html", ".png")
"""Suffixes of the files that ``Result.save`` writes alone."""


@dataclass(frozen=True, eq=False, repr=False)
class Result(Answer, SegmentedResult):
    """Answer to one frame, its segments by their names; all lengths in the frame's axes and unit.

    What it was made from and who answers is as in ``Answer``. It never changes, so that its copies are itself; pickled
    it is a ``StoredResult``, without the object's model.

    Attributes:
        original: the result in the frame's own axes, where this one was brought into others by ``transformed``.
    """

    original: "Result | None" = None

    @classmethod
    def of(cls, answer: Answer) -> "Result":
        """Result of an answer."""
        if isinstance(answer, cls):
            return answer
        return cls(**{item.name: getattr(answer, item.name) for item in fields(Answer)})

    @cached_property
    def instances(self) -> "tuple[Result, ...]":
        """This result, and those of further instances of the object in the same frame, the most evident first."""
        return self, *map(Result.of, self.further)

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """Surfaces, label grid and figures of all segments; raises as ``Answer.reconstruction``."""
        if self.original is None:
            return super().reconstruction
        T_result_original = inverse_rigid(self.T_camera_input) @ self.original.T_camera_input
        return self.original.reconstruction.transformed(T_result_original)

    @python_words()
    def transformed(self, T_new_frame: ArrayLike) -> "Result":
        """Result in another frame, such as a robot's base: poses, surfaces, labels, covariance and what is carried.

        Args:
            T_new_frame: 4 x 4, the rigid transform from the result's axes to the new ones, in the frame's unit;
                ``T_base_camera`` of a calibrated camera.

        Voxels of labels lie along the new axes. Files are in the new frame, pictures are as the camera saw the object.
        Raises ``ValueError`` for what is no rigid transform.
        """
        T = checked_pose(T_new_frame)
        return replace(
            self,
            seen=replace(self.seen, frame=self.seen.frame.transformed(T), cloud=self.seen.cloud.transformed(T)),
            T_camera_input=self.T_camera_input @ inverse_rigid(T),
            further=tuple(each.transformed(T) for each in self.instances[1:]),
            original=self,
        )

    @property
    def names(self) -> Names:  # noqa: D102 (SegmentedResult)
        return () if self.is_missing else self.surfaces.names

    @property
    def labels(self) -> LabelGrid:
        """Label grid along the frame's axes; raises as ``reconstruction`` does."""
        return self.reconstruction.labels

    @property
    def unit_m(self) -> float | None:
        """Metres per unit: as the frame states it, or by the true size of the registered object; None if unknown."""
        return self.seen.frame.unit_m

    @property
    def known(self) -> bool | str:
        """Whether the frame shows the object in a state that was learned: True, False or "unsure"."""
        return self.recognition.known

    @cached_property
    def pose(self) -> Pose | None:
        """``T_camera_model``: best rigid motion of the whole object from rest to the frame; None without a fit.

        It moves points of the object's own files, once these are in the frame's unit (``model_scale`` times their
        coordinates), to the frame's axes: those of the camera, but for frames in a scanner's. Points of the scene where
        the weights do not know the files.
        """
        return None if self.registered is None else self.registered.pose()

    @cached_property
    def covariance(self) -> Float[ndarray, "6 6"] | None:
        """Covariance of ``pose``: a turn in radians, then a shift in the frame's unit; None without a fit.

        Both in the frame's axes: the true pose is ``[exp(turn) R, p + shift]`` where ``pose`` is ``[R, p]``; p is where
        the origin of the object's own files lies, about which it turns. (ROS puts the shift first.) It holds what the
        error radii hold and is calibrated as they are; how the object is bent is integrated out.
        """
        return None if self.registered is None else pose_covariance(self.registered)

    @property
    def explained(self) -> float | None:
        """Share of the observed points that the registered model explains, from 0 to 1; None without a fit."""
        return None if self.registered is None else self.registered.explained

    @property
    def residual(self) -> float | None:
        """Root mean square distance of the observed points from it, in the frame's unit; None without a fit."""
        return None if self.registered is None else self.registered.residual

    @property
    def expected_iou(self) -> float | None:
        """Intersection over union of its volume with the true one, as it may be expected; None without a fit."""
        return None if self.registered is None else self.registered.expected_iou

    @property
    def joints(self) -> JointValues:
        """Value of each joint that the object's definition has by name, as a robot's file has; empty without a fit."""
        return measure_joints(self)

    @property
    def model_scale(self) -> float | None:
        """Length of a unit of the object's own files, or of its scene, in the frame's unit; None without a fit."""
        return None if self.registered is None else self.registered.model_scale

    @cached_property
    def _segments(self) -> SegmentResults:
        fit, parts = self.registered, self.reconstruction.segments
        sure = None if fit is None else fit.uncertainty
        of_segments = {} if sure is None else {segment.name: segment for segment in sure.segments}
        return _segment_results(parts, self.surfaces, of_segments, {} if fit is None else segment_poses(fit))

    def to_dict(self) -> JsonObject:
        """Figures as in ``summary.json``, in plain types: numbers, texts, lists, None for NaN.

        Of a lost object without an answer they have no segments, and ``recognition`` says why.
        """
        return to_json(summary_of(self))

    def __reduce__(self) -> Any:
        """Values of the result, without what computes further ones."""
        parts = (None, None) if self.is_missing else (self.surfaces, self.labels)
        frame = replace(self.seen.frame, cloud=NOTHING, depth=None, whole=None)
        return StoredResult, (self.to_dict(), *parts, frame, self.instances[1:])

    def __copy__(self) -> "Result":
        return self

    def __deepcopy__(self, memo: Any) -> "Result":
        return self

    def _carrier(self) -> tuple[Registrar, Registration, SensorFrame]:
        registered = registration_of(self)
        assert self.registrar is not None
        return self.registrar, registered, self.seen.frame

    def _write_folder(self, directory: Path, files: FilesConfig) -> None:
        write_answer(directory, self, files)

    def _write_file(self, path: Path, suffix: str, files: FilesConfig) -> None:
        write_answer_file(path, suffix, self, files)

    @python_words()
    def show(self, *, port: int | None = None, block: bool | None = None) -> "OpenPage":
        """Open the viewer on this result, as `mereo view` does, and print its address, which only this machine reaches.

        Args:
            port: where the page is; by default any that is free.
            block: wait until Ctrl-C; by default everywhere but in a notebook or an interactive session, where the page
                stays open until ``close()`` of what is returned, which a notebook shows as a frame.

        Raises ``ImportError`` without the extra `view`, and ``OSError`` for a port that is taken.
        """
        from mereo_viewer.result_page import open_answer

        if port is not None:
            check_value("port", port, Port, 8080)
        return open_answer(self, port or 0).stay(block)

    def _read(self) -> list[Path]:
        paths = [self.seen.frame.path, *([] if self.model is None else [Path(self.model.name)])]
        return [path for path in paths if path.is_file() or is_recording(path)]

    def __repr__(self) -> str:
        if self.is_missing:
            return f"Result({self.seen.frame.source!r}: {self.recognition.reason})"
        present = sum(len(segment.faces) > 0 for segment in self.surfaces.segments)
        segments = f"{present} of {len(self)} segments"
        return f"Result({self.seen.frame.source!r}: {segments}; {self.source}; {self.seconds:.1f} s)"

    def _repr_html_(self) -> str:
        """What a notebook shows: the points seen on what was found, from two sides, and the segments in figures."""
        if self.is_missing:
            return f"<p>{escape(repr(self))}</p>"
        to_camera = self.seen.frame.T_camera_result
        points = transform_points(to_camera, self.seen.cloud.points)
        surfaces = self.reconstruction.surfaces.transformed(to_camera)
        doubt = None if self.registrar is None else self.recognition.description
        lines = [self.source, *([] if doubt is None else [doubt])]
        return result_html(summary_of(self), lines, points, surfaces, Unit(self.unit_m))


def _check_list(formats: object) -> None:
    if isinstance(formats, str) or not isinstance(formats, Iterable | None):
        raise ValueError(
            f"formats is {value_text(formats)}; it must be a list of names: give for example ('glb', 'json')"
        )


def free_folder() -> Path:
    """Path of the first of result, result2, result3, ... that is not there."""
    numbers = count(2)
    path = Path("result")
    while path.exists() or path.is_symlink():
        path = Path(f"result{next(numbers)}")
    return path


def file_suffix(path: Path) -> str:
    """Suffix of ``SINGLE`` that a path has, "" for a folder; raises ``ValueError`` for what looks like another file."""
    for suffix in SINGLE:
        if path.name.lower().endswith(suffix):
            return suffix
    if path.suffix[1:2].isalpha() and not path.is_dir():
        raise ValueError(
            f"{path} has the suffix {path.suffix!r}; one file is {', '.join(SINGLE)}: choose one of these, or name a "
            "folder without a suffix, which takes all formats"
        )
    return ""


# --- carried files ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class CarriedFile:
    """Content of a file where the object is.

    Attributes:
        name: of the file, without its folder.
        content: surfaces, points, poses or a volume, in the frame's axes and unit.
        inside: number of its points, or voxels, that lie inside a segment.
        farthest: largest distance of a point from the nearest segment at rest, in the frame's unit.
        frame: in which it is.
    """

    name: str
    content: Content
    inside: int
    farthest: float
    frame: SensorFrame

    def __repr__(self) -> str:
        return f"CarriedFile({self.name!r}, {type(self.content).__name__}, {self.inside} inside)"

    def save(self, path: str | Path | None = None, *, millimetres: bool = False, overwrite: bool = False) -> Path:
        """Write it in its file's format, by default under its own name in this folder; returns the path.

        Args:
            path: the suffix is that of ``name``.
            millimetres: write files that have no unit in millimetres, not in the frame's unit.
            overwrite: replace a file.

        Raises ``FileExistsError`` for what exists, unless ``overwrite``, and ``ValueError`` for another suffix.
        """
        path = Path(self.name) if path is None else checked_path(path, "path")
        if path.suffixes[-1:] != Path(self.name).suffixes[-1:]:
            raise ValueError(f"{path} has another suffix than {self.name}, in whose format it is written: use that one")
        factor = MM_PER_M * self.frame.metres if millimetres else 1.0
        with atomic_file(path, force=overwrite) as partial:
            write_attachment(partial, self.content, factor, to_viewer_of(self.frame), self.frame.metres)
        return path


def _attachment(what: Any) -> Attachment:
    if isinstance(what, AnyPath):
        return read_attachments([what])[0]
    if (mesh := mesh_of(what)) is not None:
        return Attachment("the mesh", Surfaces(mesh))
    if _shape(what)[-2:] == (4, 4):
        poses = np.stack([checked_pose(pose) for pose in np.reshape(what, (-1, 4, 4))])
        return Attachment("the poses", PoseTable((), (), "", poses[:, :3, 3], poses[:, :3, :3]))
    return Attachment("the points", Positions(model_points([what] if _shape(what) == (3,) else what)))


def _shape(what: Any) -> WholeNumbers:
    """Shape of an array or list; empty of what is none."""
    with suppress(ValueError):  # of rows that differ in length
        return np.shape(what) if hasattr(what, "ndim") or isinstance(what, list | tuple) else ()
    return ()


def _as_kind_of(what: Any, mesh: SegmentedMesh) -> Any:
    """Mesh as the kind of what it was made from; several are a ``SegmentedMesh``."""
    if isinstance(what, SegmentedMesh | list) or len(mesh.segments) > 1:
        return mesh
    (segment,) = mesh.segments
    if isinstance(what, Segment):
        return segment
    if isinstance(what, tuple):
        return segment.vertices, segment.faces
    if not hasattr(what, "faces"):
        return _open3d_mesh(segment)
    return type(what)(segment.vertices, segment.faces, process=False)


NO_MODEL = (
    "a stored result holds no model of its object, along which things move: give it where the folder is loaded, "
    "load_result(folder, object)"
)

NOTHING = PointCloud(np.zeros((0, 3)))
"""Points of a stored result."""

DRAWN = (".html", ".png")
"""Suffixes of files that show the observed points."""

NO_REGISTRATION = (
    "the network alone answers, and --carry needs a registration, along which things move: take it with --method auto"
)


def registration_of(answer: Answer) -> Registration:
    """Registration along which things are carried, in the frame's axes; ``ValueError`` where the network answers."""
    if answer.registered is None:
        raise ValueError(NO_REGISTRATION)
    return answer.registered


def _segment_results(
    parts: Iterable[Any], surfaces: SegmentedMesh, sure: Mapping[str, Any], poses: Mapping[str, Pose]
) -> SegmentResults:
    """Segments by their names, of figures as ``SegmentFacts`` has them; radii and IoUs by ``sure``, where known."""
    return {
        part.name: SegmentResult(
            part.name,
            part.label,
            mesh,
            _numbers(part.centroid),
            part.volume,
            float(_numbers([part.confidence])[0]),
            getattr(sure.get(part.name), "centroid_radius95", None),
            getattr(sure.get(part.name), "expected_iou", None),
            poses.get(part.name),
            poses,
        )
        for part, mesh in zip(parts, surfaces.segments, strict=True)
    }


# --- results from files and pickles -----------------------------------------------------------------------------------


def _numbers(values: Any) -> Any:
    return None if values is None else np.array(values, float)


def _fact(*keys: str, read: Callable[[Any], Any] = lambda value: value) -> Any:
    """Property with an entry of the facts; None where they have none, and of a registration that is not the answer."""
    of_fit = "registration" in keys
    return property(
        lambda self: read(None if of_fit and self.facts["pose"] is None else reduce(dict.get, keys, self.facts))
    )


@dataclass(frozen=True, eq=False, repr=False)
class StoredResult(SegmentedResult):
    """Result as a folder or a pickle has it: values in the axes and unit that it was in, and nothing that computes.

    ``unit_m``, ``known``, ``explained``, ``residual``, ``expected_iou``, ``model_scale``, ``pose``, ``covariance`` and
    ``joints`` are as of ``Result``, and so are ``transformed``, ``save``, without what needs the observed points or the
    radii of single ones, and ``carry``, where ``load_result`` was given the object.

    Attributes:
        facts: content of ``summary.json``.
        surfaces: of all segments; None where the object was lost without an answer.
        labels: label grid; None likewise.
        frame: its coordinates, without points.
        further: results of further instances of the object in the same frame.
        state: of the registration; None of a pickle, and where the network answered.
        object: what was looked for, where that is known.
    """

    facts: JsonObject
    surfaces: SegmentedMesh | None
    labels: LabelGrid | None
    frame: SensorFrame
    further: "tuple[StoredResult, ...]" = ()
    state: RegistrationState | None = None
    object: Object | None = None

    unit_m, known, model_scale = _fact("unit_m"), _fact("recognition", "known"), _fact("model_scale")
    explained, residual = _fact("registration", "explained"), _fact("registration", "residual")
    expected_iou = _fact("registration", "expected_iou")
    pose, covariance = _fact("pose", read=_numbers), _fact("pose_covariance", read=_numbers)

    @property
    def instances(self) -> "tuple[StoredResult, ...]":
        """This result, and those of further instances, the most evident first."""
        return self, *self.further

    @property
    def joints(self) -> JointValues:
        """As ``Result.joints``."""
        return stated_joints(self.facts)

    @cached_property
    def _segments(self) -> SegmentResults:
        rows = self.facts["segments"]
        parts = {row["name"]: SimpleNamespace(**row) for row in rows}
        poses = {row["name"]: np.array(row["pose"]) for row in rows if "pose" in row}
        if self.surfaces is None:
            return {}
        return _segment_results(parts.values(), self.surfaces, parts, poses)

    def to_dict(self) -> JsonObject:
        """As ``Result.to_dict``."""
        return deepcopy(self.facts)

    @python_words()
    def transformed(self, T_new_frame: ArrayLike) -> "StoredResult":
        """As ``Result.transformed``."""
        T = checked_pose(T_new_frame)
        facts = self.to_dict()
        surfaces = self.surfaces
        labels = self.labels
        state = self.state
        further = tuple(each.transformed(T) for each in self.further)
        frame = self.frame.transformed(T)
        facts |= {"frame": "other", "depth_m": None, "T_input_result": frame.T_input_result}
        if surfaces is not None and labels is not None:
            surfaces = surfaces.transformed(T)
            labels = along_axes(surfaces, labels)
            for row, part in zip(facts["segments"], surfaces.segments, strict=True):
                row["centroid"] = transform_points(T, _numbers(row["centroid"]))
                row["box"] = part.bounds if len(part.faces) else row["box"]
                row["voxels"] = (labels.labels == row["label"]).sum()
        if self.pose is not None:
            for each in (facts, *facts["segments"]):
                each["pose"] = T @ each["pose"]
        if self.covariance is not None:
            turn = np.kron(np.eye(2), T[:3, :3])
            facts["pose_covariance"] = turn @ self.covariance @ turn.T
        if further:
            facts["further_instances"] = [each.facts for each in further]
        if state is not None:
            state = state.seen_from(np.array(state.T_camera_input) @ inverse_rigid(T))
        return StoredResult(to_json(facts), surfaces, labels, frame, further, state, self.object)

    def _carrier(self) -> tuple[Registrar, Registration, SensorFrame]:
        if self.object is None or self.state is None:
            raise ValueError(NO_MODEL)
        registrar = self.object.registrar("modes")
        assert registrar is not None
        registration = restored(self.state, registrar.model.registered, self.object.scene)
        return registrar, registration.moved(inverse_rigid(np.array(self.state.T_camera_input))), self.frame

    def _results(self, files: FilesConfig) -> Results:
        if self.surfaces is None or self.labels is None:
            raise ValueError(self.facts["recognition"]["reason"])
        to_viewer = to_viewer_of(self.frame)
        unit_m = self.frame.metres
        return Results(self.surfaces, self.labels, None, to_viewer, unit_m, files.millimetres, self.facts)

    def _write_folder(self, directory: Path, files: FilesConfig) -> None:
        write_formats(directory, chosen_formats(files.formats), self._results(files))
        if self.state is not None:
            save_state(directory / STATE, self.state)
        for number, each in enumerate(self.further, start=2):
            (directory / INSTANCE.format(number)).mkdir()
            each._write_folder(directory / INSTANCE.format(number), files)

    def _write_file(self, path: Path, suffix: str, files: FilesConfig) -> None:
        if suffix in DRAWN:
            raise ValueError(
                f"{path.name} shows the observed points, which a stored result does not have: copy that of its folder, "
                "or reconstruct the frame again"
            )
        write_single(path, suffix, self._results(files))

    def __repr__(self) -> str:
        present = sum(segment.is_present for segment in self)
        return f"StoredResult({self.facts['title']!r}: {present} of {len(self)} segments; known: {self.known})"


@python_words()
def load_result(folder: str | Path, object: Source = None) -> StoredResult:
    """Load a result from the folder that ``Result.save`` or ``mereo reconstruct`` has written.

    Args:
        folder: it needs summary.json, segments.glb and labels.npz, which are written by default; surfaces have the 7
            digits of their file. Nothing in it is run.
        object: what was looked for, from ``load_object``, or whatever that takes; only ``carry`` needs it.

    Raises ``FileNotFoundError`` where a file is missing, and ``ValueError`` where one is damaged, they do not belong
    together, or the object is another one.
    """
    folder = checked_path(folder, "folder")
    summary, surfaces, labels = (folder / WRITERS[name].file for name in ("json", "glb", "npz"))
    glb = read_glb(surfaces)
    known = None if object is None else object_of(object)
    meshes = {segment.name: segment for segment in glb.mesh.segments}
    with readable(labels, "label grid"):
        values, origin, spacing, names = map(read_arrays(labels).__getitem__, ("labels", "origin", "spacing", "names"))
        grid = LabelGrid(values, origin, spacing, tuple(names.tolist()))
        grid.axes()  # raises where they are not those of a grid
    with readable(summary, "summary of a result"):
        facts = json.loads(summary.read_text("utf-8"))
        if grid.names != tuple(row["name"] for row in facts["segments"]) or not meshes.keys() <= set(grid.names):
            raise ValueError(f"its segments are not those of {surfaces.name} and {labels.name}")
        parts = (
            meshes.get(row["name"], Segment(row["name"], tuple(row["color"]), *EMPTY_MESH)) for row in facts["segments"]
        )
        mesh = SegmentedMesh(tuple(parts), tuple(map(tuple, facts["nested"])))
        turn = rigid(glb.rotation.T @ GLTF_CAMERA_ROTATION, np.zeros(3))
        coordinates = SensorFrame(Path(facts["source"]), NOTHING, facts["unit_m"], "camera", T_result_seen=turn)
        frame = replace(coordinates, T_input_result=_numbers(facts["T_input_result"]))
        result = StoredResult(facts, mesh, grid, frame, object=known)
        _ = result.pose, result.covariance, result.joints, result.explained, repr(result)
    numbers = range(2, 2 + len(facts.get("further_instances", ())))
    further = tuple(load_result(folder / INSTANCE.format(number), known) for number in numbers)
    state = read_state(folder) if known is not None or (folder / STATE).is_file() else None
    result = replace(result, further=further, state=state)
    if known is not None:
        result._carrier()  # raises where the object is another one
    return result
