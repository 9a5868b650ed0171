"""The result of one frame: every segment with its figures, to be looked at, carried along, saved and shown.

Result[name] -> SegmentResult
-save-> a folder as of ``mereo reconstruct``, or one file
-show-> a page in the browser
-carry-> what is defined in the object's own files, in the frame's axes and unit
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from html import escape
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mereo.api.words import python_words
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import camera_axes
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.transforms import transform_points
from mereo.io.atomic_files import atomic_file, new_directory
from mereo.io.attachments import Attachment, Content, Positions, Surfaces, read_attachments, write_attachment
from mereo.io.bounds import Port, check_value
from mereo.io.config import DEFAULT_FILES, CarryFrame, FilesConfig, Format
from mereo.io.errors import checked_path
from mereo.io.point_arrays import model_points
from mereo.io.ros_recordings import is_recording
from mereo.io.sensor_frame import SensorFrame
from mereo.io.writers.formats import chosen_formats
from mereo.io.writers.glb import viewer_rotation
from mereo.io.writers.volumes import MM_PER_M
from mereo.results.carry import carry, place
from mereo.visualization.joints import JointValue, measure_joints
from mereo.visualization.reconstruction_report import result_html
from mereo.visualization.result_files import write_answer, write_answer_file
from mereo.visualization.units import Unit

if TYPE_CHECKING:
    import trimesh

    from mereo_viewer.server import OpenPage

Pose = Float[np.ndarray, "4 4"]


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
        pose: best rigid motion from the object's own files to the frame, as ``Result.pose``; None likewise.
    """

    name: str
    label: int
    mesh: Segment
    centroid: Float[np.ndarray, "3"]
    volume: float
    confidence: float
    error_radius: float | None
    pose: Pose | None

    @property
    def is_present(self) -> bool:
        """Whether the frame shows it, or the registered model has it."""
        return len(self.mesh.faces) > 0

    def to_trimesh(self) -> "trimesh.Trimesh":
        """Surface as a mesh of trimesh, in the segment's colour."""
        import trimesh

        vertices, faces = self.mesh.vertices, self.mesh.faces
        colors = np.tile(np.array([*self.mesh.color, 255], dtype=np.uint8), (len(faces), 1))
        return trimesh.Trimesh(vertices, faces, face_colors=colors, process=False)

    def to_open3d(self) -> Any:
        """Surface as a ``TriangleMesh`` of Open3D, in the segment's colour; ``ImportError`` without Open3D."""
        try:
            open3d = import_module("open3d")
        except ImportError:
            raise ImportError("Open3D is not installed: pip install open3d, or take to_trimesh()") from None
        vertices = open3d.utility.Vector3dVector(self.mesh.vertices)
        mesh = open3d.geometry.TriangleMesh(vertices, open3d.utility.Vector3iVector(self.mesh.faces))
        mesh.paint_uniform_color([channel / 255 for channel in self.mesh.color])
        mesh.compute_vertex_normals()
        return mesh

    def __repr__(self) -> str:
        sure = "" if np.isnan(self.confidence) else f", confidence {self.confidence:.2f}"
        figures = f"volume {self.volume:.3g}{sure}" if self.is_present else "not found"
        return f"SegmentResult({self.name!r}, {figures})"


SINGLE = (".glb", ".ply", ".npz", ".vti", ".nii.gz", ".seg.nrrd", ".json", ".html", ".png")
"""Suffixes of the files that ``Result.save`` writes alone."""


@dataclass(frozen=True, eq=False, repr=False)
class Result(Answer):
    """Answer to one frame, its segments by their names; all lengths in the frame's axes and unit.

    What it was made from and who answers is as in ``Answer``.
    """

    @classmethod
    def of(cls, answer: Answer) -> "Result":
        """Result of an answer."""
        return cls(**{item.name: getattr(answer, item.name) for item in fields(Answer)})

    @cached_property
    def instances(self) -> "tuple[Result, ...]":
        """This result, and those of further instances of the object in the same frame, the most evident first."""
        return self, *map(Result.of, self.further)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the segments, in the order of their labels."""
        return self.surfaces.names

    @property
    def unit_m(self) -> float | None:
        """Metres per unit: as the frame states it, or by the true size of the registered object; None if unknown."""
        return self.seen.frame.unit_m

    @property
    def known(self) -> bool | str:
        """Whether the frame shows the object in a state that was learned: True, False or "unsure"."""
        return self.recognition.known

    def __getitem__(self, name: str) -> SegmentResult:
        """Segment of a name; raises ``KeyError`` for a name of no segment."""
        if name not in self._segments:
            raise KeyError(f"there is no segment {name!r}; the segments are {', '.join(self.names)}")
        return self._segments[name]

    def __iter__(self) -> Iterator[SegmentResult]:
        """All segments, in the order of their labels."""
        return iter(self._segments.values())

    def __len__(self) -> int:
        """Number of segments."""
        return len(self.names)

    @cached_property
    def pose(self) -> Pose | None:
        """``T_camera_model``: best rigid motion of the whole object from rest to the frame; None without a fit.

        It moves points of the object's own files, once these are in the frame's unit (``model_scale`` times their
        coordinates), to the frame's axes: those of the camera, but for frames in a scanner's. Points of the scene where
        the weights do not know the files.
        """
        return None if self.registered is None else self.registered.pose()

    @cached_property
    def joints(self) -> dict[str, JointValue]:
        """Value of each joint that the object's definition has by name, as a robot's file has; empty without a fit."""
        return measure_joints(self)

    @property
    def model_scale(self) -> float | None:
        """Length of a unit of the object's own files, or of its scene, in the frame's unit; None without a fit."""
        return None if self.registered is None else self.registered.model_scale

    @python_words()
    def carry(self, what: Any, files: CarryFrame = "source") -> Any:
        """Carry points, a mesh or a file of the object's own frame and unit to where it is now.

        Args:
            what: points (whatever ``load_frame`` takes of points), which come back as an array [n, 3]; a mesh of
                trimesh, ``Segment`` or ``SegmentedMesh``, which comes back as its kind, with edges short enough to
                bend; or the path of a file as of ``--carry``, a volume included, which comes back as a ``CarriedFile``.
            files: frame and unit of it: "source" is that of the object's own files, "scene" that of its scene; "RAS"
                and "LPS" state the space of the object's own files, where these do not name it.

        Raises ``ValueError`` where the answer is the network's, where the frame of the object's files is not known, and
        for what lies too far from the object to belong to it.
        """
        check_value("files", files, CarryFrame, "source")
        attachment, registered = _attachment(what), registration_of(self)
        assert self.registrar is not None
        (placed,) = place([attachment], self.registrar, files)
        carried = carry(placed, registered)
        if isinstance(what, str | Path):
            return CarriedFile(carried.name, carried.content, carried.inside, carried.farthest, self.seen.frame)
        if isinstance(carried.content, Positions):
            return carried.content.points
        assert isinstance(carried.content, Surfaces)
        if isinstance(what, SegmentedMesh):
            return carried.content.mesh
        (segment,) = carried.content.mesh.segments
        return segment if isinstance(what, Segment) else type(what)(segment.vertices, segment.faces, process=False)

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

    @cached_property
    def _segments(self) -> dict[str, SegmentResult]:
        sure = None if self.registered is None else self.registered.uncertainty
        radii = {} if sure is None else {segment.name: segment.centroid_radius95 for segment in sure.segments}
        return {
            figures.name: SegmentResult(
                name=figures.name,
                label=figures.label,
                mesh=mesh,
                centroid=figures.centroid,
                volume=figures.volume,
                confidence=figures.confidence,
                error_radius=radii.get(figures.name),
                pose=None
                if self.registered is None
                else self.registered.pose(self.registered.model.labels == figures.label),
            )
            for figures, mesh in zip(self.reconstruction.segments, self.surfaces.segments, strict=True)
        }

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
        with python_words():
            path = free_folder() if path is None else checked_path(path, "path")
            suffix = file_suffix(path)
            if suffix == "":
                _check_list(formats)
                wanted = chosen_formats(DEFAULT_FILES.formats if formats is None else formats)
                with new_directory(path, overwrite, self._read()) as directory:
                    write_answer(directory, self, FilesConfig(wanted, millimetres))
            elif formats is not None:
                raise ValueError(f"{path} is one file, whose suffix says its format: leave out formats")
            else:
                with atomic_file(path, force=overwrite, inputs=self._read()) as partial:
                    write_answer_file(partial, suffix, self, FilesConfig((), millimetres))
        return path

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
        """Files that this was made from."""
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
        to_camera = camera_axes(self.seen.frame.axes)
        points = transform_points(to_camera, self.seen.cloud.points)
        surfaces = self.reconstruction.surfaces.transformed(to_camera)
        doubt = None if self.registrar is None else self.recognition.description
        lines = [self.source, *([] if doubt is None else [doubt])]
        segments, calibrated = self.reconstruction.segments, self.reconstruction.calibrated
        return result_html(self.seen.frame.source, lines, points, surfaces, segments, Unit(self.unit_m), calibrated)


def _check_list(formats: object) -> None:
    if isinstance(formats, str) or not isinstance(formats, Iterable | None):
        raise ValueError(f"formats is {formats!r}; it must be a list of names: give for example ('glb', 'json')")


def free_folder(name: str = "result") -> Path:
    """Path of the first of NAME, NAME2, NAME3, ... that is not there."""
    numbers = count(2)
    path = Path(name)
    while path.exists() or path.is_symlink():
        path = Path(f"{name}{next(numbers)}")
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
            write_attachment(partial, self.content, factor, viewer_rotation(self.frame.axes), self.frame.metres)
        return path


def _attachment(what: Any) -> Attachment:
    if isinstance(what, str | Path):
        return read_attachments([what])[0]
    if isinstance(what, SegmentedMesh | Segment) or (hasattr(what, "vertices") and hasattr(what, "faces")):
        return Attachment("the mesh", Surfaces(_segmented(what)))
    return Attachment("the points", Positions(model_points(what)))


def _segmented(mesh: Any) -> SegmentedMesh:
    """A mesh of any of these kinds as one of segments."""
    if isinstance(mesh, SegmentedMesh):
        return mesh
    if not isinstance(mesh, Segment):
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
        mesh = Segment("mesh", PALETTE[0], vertices, faces, solid=False)
    return SegmentedMesh((mesh,))


def registration_of(answer: Answer) -> Registration:
    """Registration along which things are carried, in the frame's axes; ``ValueError`` where the network answers."""
    if answer.registered is None:
        raise ValueError(
            "the network's answer is kept, but --carry needs a registration, along which things move: leave out of the "
            "cloud what is not the object, or take the registered model in any case with --method modes"
        )
    return answer.registered
