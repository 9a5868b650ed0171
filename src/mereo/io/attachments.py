"""Attachments: files of what is defined with an object's rest model (vessels, a resection plane, a grasp).

Meshes (STL, PLY, OBJ, GLB), point clouds (PLY, XYZ, NPY), tables of points or poses (CSV), volumes (NIfTI, NRRD). They
are read whole, moved with the object, and written in their own format again.
"""

import csv
import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.linalg import norm
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mereo.geometry.conventions import Names
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import Matrices, Matrix, Points, longest_side
from mereo.io.atomic_files import atomic_file, write_file
from mereo.io.config import CarryFrame, Space
from mereo.io.errors import AnyPath, check_suffix, readable
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.readers import check_ply, read_points
from mereo.io.volume_files import VOLUME_SUFFIXES, Volume, file_space, is_volume, read_scalar_volume
from mereo.io.writers.glb import write_segments_glb
from mereo.io.writers.meshes import write_positions_ply, write_segments_obj, write_segments_ply, write_surface_stl
from mereo.io.writers.volumes import write_volume

MESHES = (".stl", ".ply", ".obj", ".glb")
CLOUDS = (".ply", ".xyz", ".txt", ".pts", ".asc", ".npy")

POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
"""Names of a table's columns, in any order and case; others are kept."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Surfaces of one or more named parts, closed or not."""

    mesh: SegmentedMesh
    rotations = None

    @property
    def points(self) -> Points:
        """All vertices."""
        return np.concatenate([part.vertices for part in self.mesh.segments])

    def at(self, points: Points, rotations: Matrices | None) -> "Surfaces":
        """The surfaces with other vertices."""
        ends = np.cumsum([len(part.vertices) for part in self.mesh.segments])[:-1]
        return Surfaces(self.mesh.with_vertices(np.split(points, ends)))


@dataclass(frozen=True, eq=False)
class Positions:
    """Points of a cloud, without anything else that its file may say about them."""

    points: Points
    rotations = None

    def at(self, points: Points, rotations: Matrices | None) -> "Positions":
        """Other points."""
        return replace(self, points=points)


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Table of positions, or of poses.

    Attributes:
        header: names of all columns.
        rows: their texts.
        delimiter: between them.
        points: position of each row.
        rotations: orientation of each row, the pose's axes as columns; None where the table has none.
    """

    header: Names
    rows: tuple[Names, ...]
    delimiter: str
    points: Points
    rotations: Matrices | None

    def at(self, points: Points, rotations: Matrices | None) -> "PoseTable":
        """The table with other positions and orientations."""
        return replace(self, points=points, rotations=rotations)

    def text(self, factor: float = 1.0) -> str:
        """Content of a file: positions times ``factor``, and orientations; what other columns say stays."""
        columns = _columns(self.header)
        changed = dict(zip(POSITION, (factor * self.points).T, strict=True))
        if self.rotations is not None:
            changed |= dict(zip(QUATERNION, Rotation.from_matrix(self.rotations).as_quat().T, strict=True))
        cells = np.array(self.rows, object).reshape(-1, len(self.header))
        for name, values in changed.items():
            cells[:, columns[name]] = [f"{value:.10g}" for value in values]
        file = io.StringIO()
        writer = csv.writer(file, delimiter=self.delimiter, lineterminator="\n")
        writer.writerow(self.header)
        writer.writerows(cells.tolist())
        return file.getvalue()


Placeable = Surfaces | Positions | PoseTable
"""Content that is moved point by point: all have ``points``, ``rotations`` and ``at``."""

Content = Placeable | Volume
"""Content of an attachment. A volume is not moved but resampled."""


@dataclass(frozen=True, eq=False)
class Attachment:
    """File that belongs to an object's rest model: its name without the folder, and what it holds, in any frame.

    ``space`` is the anatomical frame that the file names, if any, and ``note`` says what was done about it.
    """

    name: str
    content: Content
    space: Space | None = None
    note: str = ""


class SpaceWarning(UserWarning):
    """Warning that one of two files names its anatomical frame, and the other is taken to be in the same."""


RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Half a turn about the third axis, which is its inverse."""

NEAR, FARTHER, SHARE, MORE = 0.15, 3.0, 0.6, 0.3
"""Distance from an object, in its longest sides, that is no sign of another frame, and how many times nearer a point
then lies in the other one; share of an object in a volume's tissue that is no sign either, and how much more is one."""


def turned_attachment(attachment: Attachment, frame: CarryFrame, named: Space | None, inside: Points) -> Attachment:
    """Attachment in the space of an object's own files, turned where it names the other one.

    Args:
        attachment: in the frame of those files, or in the space that it names.
        frame: a space states that of those files, and of an attachment that names none.
        named: space that those files name themselves.
        inside: points spread inside the object, in the frame of its files.

    Where one of the two spaces is not known, they are taken to be the same, with a ``SpaceWarning`` where the other is.
    Raises ``ValueError`` where the attachment would then fit far better turned, and for two spaces of the object.
    """
    stated = frame if frame == "RAS" or frame == "LPS" else None
    if stated is not None and named not in (None, stated):
        raise ValueError(
            f"--carry-frame is {stated}, but the object's own files name {named}: leave it out, or export them again"
        )
    space = stated or named
    given = attachment.space or stated
    name = attachment.name
    if space is not None and space == given:
        return attachment
    content = attachment.content
    if isinstance(content, Volume):
        turned: Content = replace(content, T_world_index=RAS_FROM_LPS @ content.T_world_index)
    else:
        turn = RAS_FROM_LPS[:3, :3]
        turned = content.at(content.points @ turn, None if content.rotations is None else turn @ content.rotations)
    if space is not None and given is not None:
        return replace(attachment, content=turned, space=space, note=f" (turned from {given} to {space})")
    if _fits_better(turned, content, inside):
        raise ValueError(
            f"{name} does not fit the object, and would with x and y negated, as between RAS and LPS: state the space "
            "of the object's own files with --carry-frame RAS or --carry-frame LPS, or export both in one"
        )
    if given is not None:
        warnings.warn(
            f"{name} is in {given}, and the object's own files are taken to be in it too, for they name no space; "
            "state theirs with --carry-frame RAS or --carry-frame LPS",
            SpaceWarning,
            stacklevel=2,
        )
    return attachment


def _fits_better(turned: Content, content: Content, inside: Points) -> bool:
    """Whether content fits an object far better when it is turned."""
    if isinstance(turned, Volume) and isinstance(content, Volume):
        share = content.tissue_share(inside)
        return share < SHARE and turned.tissue_share(inside) > share + MORE
    assert not isinstance(turned, Volume) and not isinstance(content, Volume)
    tree = cKDTree(inside)
    size = longest_side(inside)
    away, other = (float(np.median(tree.query(each.points)[0])) for each in (content, turned))
    return away > NEAR * size and away > FARTHER * other


def read_attachments(paths: Sequence[AnyPath]) -> tuple[Attachment, ...]:
    """Attachments of files, whose names must differ; raises as their readers."""
    files = [Path(path) for path in paths]
    names = [file.name.lower() for file in files]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise ValueError(
            f"two files to carry are called {repeated[0]!r}; results have the names of their files: rename one"
        )
    return tuple(Attachment(file.name, _read(file), file_space(file)) for file in files)


def _read(path: Path) -> Content:
    if is_volume(path):
        return read_scalar_volume(path)
    suffix = path.suffix.lower()
    check_suffix(path, dict.fromkeys((*MESHES, *CLOUDS, ".csv", *VOLUME_SUFFIXES)), "file to carry")
    if suffix == ".csv":
        return read_pose_table(path)
    is_mesh = suffix in MESHES
    if suffix == ".ply":
        with readable(path, "mesh or point cloud"):
            is_mesh = check_ply(path).get("face", 0) > 0
    content = Surfaces(read_segmented_mesh(path)) if is_mesh else Positions(read_points(path)[:, :3])
    if not len(content.points) or not np.isfinite(content.points).all():
        raise ValueError(f"{path} has no positions, or NaN or infinite ones; all must be finite: export it again")
    return content


def write_attachment(path: Path, content: Content, factor: float, frame_rotation: Matrix, unit_m: float) -> None:
    """Write an attachment, which is in the input's frame and unit, in the format of its name.

    Args:
        path: the file.
        content: of it.
        factor: of positions in files that have no unit of their own.
        frame_rotation: from the input's frame to glTF's (y up), for the root node of glTF.
        unit_m: metres per unit of the input, for the same and for volumes, which are in millimetres.
    """
    suffix = path.suffix.lower()
    if isinstance(content, Volume):
        write_volume(path, content, unit_m)
    elif isinstance(content, PoseTable):
        write_file(path, content.text(factor))
    elif isinstance(content, Positions) and suffix == ".ply":
        write_positions_ply(path, factor * content.points)
    elif isinstance(content, Positions):
        with atomic_file(path) as partial:
            if suffix == ".npy":
                np.save(partial, factor * content.points)
            else:
                np.savetxt(partial, factor * content.points, fmt="%.10g")
    elif suffix == ".glb":
        write_segments_glb(path, content.mesh, frame_rotation, unit_m)
    else:
        plain = {".ply": write_segments_ply, ".obj": write_segments_obj, ".stl": write_surface_stl}[suffix]
        plain(path, content.mesh.transformed(np.diag([factor] * 3 + [1.0])))


def read_pose_table(path: Path) -> PoseTable:
    """Table of a CSV file, separated by commas, semicolons or tabs: ``POSITION``, with ``QUATERNION`` where it has any.

    Raises ``FileNotFoundError`` and ``ValueError``: columns are missing, a cell is no number, a row is too short or
    its orientation is none.
    """
    with readable(path, "table of points"):
        text = path.read_text(encoding="utf-8-sig")
        first = next((line for line in text.splitlines() if line.strip()), "")
        delimiter = max(",;\t", key=first.count)
        reader = csv.reader(io.StringIO(text), delimiter=delimiter)
        lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
        (_, header), *body = lines
        columns = _columns(header)
        names = POSITION + QUATERNION if columns.keys() & set(QUATERNION) else POSITION
        if not set(names) <= columns.keys():
            raise ValueError(f"its columns are {', '.join(columns)}; it needs {', '.join(names)}")
        if not body:
            raise ValueError("it has a header and no row")
        for line, row in body:
            if len(row) != len(header):
                raise ValueError(f"line {line} has {len(row)} cells and the header {len(header)}")
        values = np.array([[_number(line, row[columns[name]], name) for name in names] for line, row in body])
        points, quaternions = values[:, :3], values[:, 3:]
        off = np.abs(norm(quaternions, axis=1) - 1) >= 1e-3
        if len(names) > 3 and off.any():
            raise ValueError(f"line {body[int(np.argmax(off))][0]} has an orientation that is no rotation")
        rotations = Rotation.from_quat(quaternions).as_matrix() if len(names) > 3 else None
    return PoseTable(tuple(header), tuple(tuple(row) for _, row in body), delimiter, points, rotations)


def _columns(header: Sequence[str]) -> dict[str, int]:
    names = [name.strip().lower() for name in header]
    if twice := [name for name in (*POSITION, *QUATERNION) if names.count(name) > 1]:
        raise ValueError(f"it has several columns {twice[0]!r}, of which one alone can be meant")
    return {name: index for index, name in enumerate(names)}


def _number(line: int, cell: str, name: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"line {line} has {cell!r} in the column {name}, which is no finite number")
    return value
