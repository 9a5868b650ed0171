"""Recorded frames fitted to an object at rest: each one is a map of space, by tetrahedra or by surfaces."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from mereo.deformation.maps import Deformation
from mereo.deformation.surface_driven import Surface, SurfaceMap
from mereo.deformation.tetrahedral import Tetrahedra, TetrahedralMap
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.io.simulation_states import SurfaceRecord, TetrahedralRecord

MATCHED = 1e-4
"""How near a vertex of the states must be to the mesh's, of the segment's longest side: what single precision and a
few printed digits leave."""

DOUBTFUL_STRETCH = 2.0
"""Edges that the first frame makes longer or shorter by this factor, in the median, are hardly those of one mesh."""


# --- tetrahedra -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TetrahedralFrames:
    """States of one tetrahedral mesh that moves all segments.

    Attributes:
        mesh: at rest, in scene units.
        displacements: of its nodes, in the file's unit and precision.
        scale: scene units per unit of the file.
        segments: how many there are.
    """

    mesh: Tetrahedra
    displacements: Float[np.ndarray, "f n 3"]
    scale: float
    segments: int

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.displacements)

    def nodes(self, frame: int) -> Float[np.ndarray, "n 3"]:
        """Node positions in scene units."""
        return self.mesh.nodes + self.scale * self.displacements[frame].astype(np.float64)

    def deformations(self, frame: int) -> tuple[Deformation, ...]:
        """Deformations of the segments in one frame: one map for all of them."""
        return (TetrahedralMap(self.mesh, self.nodes(frame)),) * self.segments


FAR = 0.1
"""A surface that lies mostly farther from the tetrahedra than this, of their longest side, is not theirs."""


def tetrahedral_frames(
    path: Path, record: TetrahedralRecord, rest: SegmentedMesh, scale: float, shift: Float[np.ndarray, "3"]
) -> TetrahedralFrames:
    """Frames of a record of tetrahedra, in scene units.

    Raises ``ValueError`` for a mesh elsewhere than ``rest`` and for the first frame that inverts a tetrahedron.
    """
    try:
        mesh = Tetrahedra(record.rest_nodes * scale + shift, record.tetrahedra)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    frames = TetrahedralFrames(mesh, record.displacements, scale, len(rest.segments))
    size = float(np.ptp(mesh.nodes, axis=0).max())
    for segment in rest.segments:
        away = segment.vertices[mesh.locate(segment.vertices) < 0]
        distance = np.linalg.norm(away - mesh.closest(away)[2], axis=1) if len(away) else np.zeros(0)
        if (distance > FAR * size).sum() > len(segment.vertices) / 2:
            raise ValueError(
                f"segment {segment.name!r} lies {np.median(distance):.3g} outside of the tetrahedra in {path}, whose "
                f"longest side is {size:.3g}; they must hold the surface: check the unit, scale and shift"
            )
    for frame in range(frames.count):
        ratios = mesh.volume_ratios(frames.nodes(frame))
        worst = int(np.argmin(ratios))
        if not ratios[worst] > 0:
            raise ValueError(
                f"{path}: {record.frames[frame]} inverts tetrahedron {worst} (its volume is {ratios[worst]:.3g} times "
                "that at rest); all must stay above 0: leave the frame out, or simulate with smaller steps or forces"
            )
    return frames


# --- surfaces ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SurfaceFrames:
    """States of surfaces, each segment moved by a map of its own.

    Attributes:
        surfaces: the segments at rest, in scene units.
        vertices: for each of them its positions in all frames, in the file's unit and the mesh's order.
        scale, shift: from the file's coordinates to the scene's.
    """

    surfaces: tuple[Surface, ...]
    vertices: tuple[Float[np.ndarray, "f _ 3"], ...]
    scale: float
    shift: Float[np.ndarray, "3"]

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.vertices[0])

    def positions(self, segment: int, frame: int) -> Float[np.ndarray, "_ 3"]:
        """Vertices of one segment in scene units."""
        return self.vertices[segment][frame].astype(np.float64) * self.scale + self.shift

    def deformations(self, frame: int) -> tuple[Deformation, ...]:
        """Deformations of the segments in one frame, a map of its own for each."""
        return tuple(SurfaceMap(s, self.positions(index, frame)) for index, s in enumerate(self.surfaces))


def surface_frames(
    path: Path, record: SurfaceRecord, rest: SegmentedMesh, scale: float, shift: Float[np.ndarray, "3"]
) -> SurfaceFrames:
    """Frames of a record of surfaces, their vertices in the order of the meshes.

    Raises ``ValueError`` for vertices that do not match ``rest`` and for the first frame that is inside out.
    """
    ordered = []
    for segment in rest.segments:
        states = record.vertices[segment.name]
        known = record.rest.get(segment.name)
        ordered.append(
            states[:, _order(path, segment, states.shape[1], None if known is None else known * scale + shift)]
        )
    surfaces = tuple(Surface(segment.vertices, segment.faces) for segment in rest.segments)
    frames = SurfaceFrames(surfaces, tuple(ordered), scale, shift)
    for index, segment in enumerate(rest.segments):
        if segment.name not in record.rest:
            _check_order(path, segment, frames.positions(index, 0))
        for frame, name in enumerate(record.frames):
            _check_volume(path, name, segment, frames.positions(index, frame))
    return frames


def _order(
    path: Path, segment: Segment, count: int, known: Float[np.ndarray, "w 3"] | None
) -> slice | Int[np.ndarray, " v"]:
    """Which vertex of the states is each of the mesh's: by rest position where the file has it, else one to one."""
    cure = f"add the rest positions of the states' vertices as '{segment.name}.rest' (in a directory, a file rest.*)"
    if known is None:
        if count != len(segment.vertices):
            raise ValueError(
                f"{path} has {count} vertices of {segment.name!r}, but its mesh has {len(segment.vertices)} (vertices "
                f"at equal positions are merged on reading); they must correspond: {cure}"
            )
        return slice(None)
    if len(known) != count:
        raise ValueError(
            f"{path} has {len(known)} rest positions of {segment.name!r} but {count} vertices in its states; they must "
            "be the same vertices: export both from the same mesh"
        )
    distance, nearest = cKDTree(known).query(segment.vertices)
    size = float(np.ptp(segment.vertices, axis=0).max())
    if distance.max() > MATCHED * size:
        raise ValueError(
            f"{path}: the rest positions of {segment.name!r} miss a vertex of its mesh by {distance.max():.3g}, of "
            f"{size:.3g} across; they must be the same pose: check the unit, scale and shift"
        )
    return np.asarray(nearest, dtype=np.int64)


def _check_order(path: Path, segment: Segment, vertices: Float[np.ndarray, "v 3"]) -> None:
    """Refuse vertices whose neighbours are far apart: the order is another mesh's, or the unit another one."""
    edges = segment.faces[:, [0, 1]]
    before, after = (np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (segment.vertices, vertices))
    stretch = float(np.exp(np.median(np.abs(np.log(np.maximum(after, 1e-300) / np.maximum(before, 1e-300))))))
    if stretch > DOUBTFUL_STRETCH:
        raise ValueError(
            f"{path} makes the edges of {segment.name!r} longer or shorter by a factor of {stretch:.3g}; its vertices "
            f"seem to be in another order or unit than the mesh's: check scale, or add '{segment.name}.rest'"
        )


def _check_volume(path: Path, frame: str, segment: Segment, vertices: Float[np.ndarray, "v 3"]) -> None:
    volume = replace(segment, vertices=vertices).volume / segment.volume
    if not volume > 0:
        raise ValueError(
            f"{path}: {frame} turns {segment.name!r} inside out (its volume is {volume:.3g} times that at rest); it "
            "must stay above 0: leave the frame out"
        )
