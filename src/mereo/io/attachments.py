"""Attachments: files of what is defined beside an object's rest model (vessels, a resection plane, a grasp).

Meshes (STL, PLY, OBJ, GLB, glTF), point clouds (PLY, PCD, XYZ, NPY), tables of points or poses (CSV), volumes (NIfTI,
NRRD). They are read whole, moved elsewhere, and written in their own format again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mereo.geometry.mesh import SegmentedMesh
from mereo.io.atomic_files import atomic_file
from mereo.io.errors import readable
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.point_cloud_formats import CLOUD_READERS, ply_counts
from mereo.io.pose_tables import PoseTable, read_pose_table
from mereo.io.volume_files import VOLUME_SUFFIXES, Volume, is_volume, read_scalar_volume
from mereo.io.writers.glb import write_segments_glb, write_segments_gltf
from mereo.io.writers.obj import write_segments_obj
from mereo.io.writers.ply import write_positions_ply, write_segments_ply
from mereo.io.writers.scalar_volumes import write_volume
from mereo.io.writers.stl import write_surface_stl

MESHES = (".stl", ".ply", ".obj", ".glb", ".gltf")
CLOUDS = (".ply", ".pcd", ".xyz", ".txt", ".pts", ".asc", ".npy")
TABLES = (".csv",)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Surfaces of one or more named parts, closed or not."""

    mesh: SegmentedMesh

    @property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """All vertices."""
        return np.concatenate([part.vertices for part in self.mesh.segments])

    @property
    def rotations(self) -> None:
        """A surface has no orientations."""
        return None

    def at(self, points: Float[np.ndarray, "n 3"], rotations: Float[np.ndarray, "n 3 3"] | None) -> "Surfaces":
        """The surfaces with their vertices elsewhere."""
        ends = np.cumsum([len(part.vertices) for part in self.mesh.segments])[:-1]
        return Surfaces(self.mesh.with_vertices(np.split(points, ends)))


@dataclass(frozen=True, eq=False)
class Positions:
    """Points of a cloud, without anything else that its file may say about them."""

    points: Float[np.ndarray, "n 3"]

    @property
    def rotations(self) -> None:
        """A point has no orientation."""
        return None

    def at(self, points: Float[np.ndarray, "n 3"], rotations: Float[np.ndarray, "n 3 3"] | None) -> "Positions":
        """Other points."""
        return replace(self, points=points)


Placeable = Surfaces | Positions | PoseTable
"""Content that is moved point by point: all have ``points``, ``rotations`` and ``at``."""

Content = Placeable | Volume
"""Content of an attachment. A volume is not moved but resampled: each voxel elsewhere asks what was there."""


@dataclass(frozen=True, eq=False)
class Attachment:
    """File that belongs to an object's rest model.

    Attributes:
        name: of the file, without its folder.
        content: what it holds, in any frame and unit.
    """

    name: str
    content: Content


def read_attachments(paths: Sequence[str | Path]) -> tuple[Attachment, ...]:
    """Attachments of files, whose names must differ.

    Raises ``FileNotFoundError``, ``ValueError`` for files that are empty, damaged, without points or of another format,
    and ``ImportError`` for volumes without the extra `medical`.
    """
    files = [Path(path) for path in paths]
    names = [file.name.lower() for file in files]
    if repeated := [file for file, name in zip(files, names, strict=True) if names.count(name) > 1]:
        raise ValueError(
            f"two files to carry are called {repeated[0].name!r}; results have the names of their files: rename one"
        )
    return tuple(Attachment(file.name, _read(file)) for file in files)


def _read(path: Path) -> Content:
    if is_volume(path):
        return read_scalar_volume(path)
    suffix = path.suffix.lower()
    known = dict.fromkeys((*MESHES, *CLOUDS, *TABLES, *VOLUME_SUFFIXES))
    if path.exists() and suffix not in known:
        raise ValueError(
            f"{path} has the suffix {path.suffix!r}; what is carried is one of {', '.join(known)}: convert it"
        )
    if suffix in TABLES:
        return read_pose_table(path)
    content = _mesh_or_cloud(path)
    if not np.isfinite(content.points).all():
        raise ValueError(f"{path} has NaN or infinite positions; all must be finite: export it again")
    return content


def _mesh_or_cloud(path: Path) -> Surfaces | Positions:
    suffix = path.suffix.lower()
    if suffix == ".ply":
        with readable(path, "mesh or point cloud"):
            faces = ply_counts(path).get("face", 0)
        return Surfaces(read_segmented_mesh(path)) if faces else _cloud(path)
    return Surfaces(read_segmented_mesh(path)) if suffix in MESHES else _cloud(path)


def _cloud(path: Path) -> Positions:
    with readable(path, "point cloud"):
        points = np.asarray(CLOUD_READERS[path.suffix.lower()](path), dtype=np.float64).reshape(-1, 3)
        if not len(points):
            raise ValueError("it holds 0 points")
    return Positions(points)


def write_attachment(
    path: Path, content: Content, factor: float, frame_rotation: Float[np.ndarray, "3 3"], unit_m: float
) -> None:
    """Write an attachment in the format of its name.

    Args:
        path: the file.
        content: in the input's frame and unit.
        factor: of positions in files that have no unit of their own.
        frame_rotation: from the input's frame to glTF's (y up), for the root node of glTF.
        unit_m: metres per unit of the input, for the same and for volumes, which are in millimetres.
    """
    suffix = path.suffix.lower()
    if isinstance(content, Volume):
        write_volume(path, content, unit_m)
    elif isinstance(content, PoseTable):
        with atomic_file(path) as partial:
            partial.write_text(content.text(factor), encoding="utf-8")
    elif isinstance(content, Positions):
        _write_cloud(path, factor * content.points)
    elif suffix in (".glb", ".gltf"):
        with_unit = write_segments_glb if suffix == ".glb" else write_segments_gltf
        with_unit(path, content.mesh, frame_rotation, unit_m)
    else:
        plain = {".ply": write_segments_ply, ".obj": write_segments_obj, ".stl": write_surface_stl}[suffix]
        plain(path, content.mesh.transformed(np.diag([factor] * 3 + [1.0])))


def _write_cloud(path: Path, points: Float[np.ndarray, "n 3"]) -> None:
    suffix = path.suffix.lower()
    if suffix == ".ply":
        write_positions_ply(path, points)
        return
    with atomic_file(path) as partial:
        if suffix == ".npy":
            np.save(partial, points)
        elif suffix == ".pcd":
            partial.write_bytes(_pcd(points))
        else:
            np.savetxt(partial, points, fmt="%.10g")


def _pcd(points: Float[np.ndarray, "n 3"]) -> bytes:
    """Content of a binary PCD file (pointclouds.org/documentation/tutorials/pcd_file_format.html)."""
    count = len(points)
    lines = ["VERSION .7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F", "COUNT 1 1 1", f"WIDTH {count}", "HEIGHT 1"]
    lines += ["VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}", "DATA binary", ""]
    return "\n".join(lines).encode("ascii") + points.astype("<f4").tobytes()
