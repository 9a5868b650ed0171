"""Simulated states: an object's deformations taken from a simulator's recorded frames instead of drawn by formula.

A random state is one recorded frame, drawn at random. Frames are finitely many, so some are kept for testing: training
and test seeds never share one. See docs/scene-file.md for formats.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator
from scipy.spatial import cKDTree

from mereo.deformation.draw_names import named
from mereo.deformation.maps import Deformations
from mereo.deformation.tetrahedral import Surface, SurfaceMap, Tetrahedra, TetrahedralMap
from mereo.geometry.conventions import Triple
from mereo.geometry.mesh import Elements, Segment, SegmentedMesh, Vertices
from mereo.geometry.transforms import AnyPoints, Points, Vector, longest_side
from mereo.io.simulation_states import SurfaceRecord, TetrahedralRecord, read_states
from mereo.io.vtk_frames import FramePoints
from mereo.scenes.scene import Scene, Workspace

HELD_OUT = 0.1
"""The share of frames, the last ones, that is kept for testing."""


@dataclass(frozen=True, eq=False)
class States:
    """Recorded frames from ``first`` to before ``end``, to draw from."""

    frames: "TetrahedralFrames | SurfaceFrames"
    first: int
    end: int

    def sample(self, rng: Generator) -> Deformations:
        """Deformations of one random frame, each as likely as the other."""
        return self.frames.deformations(int(named(rng, "frame").integers(self.first, self.end)))


@dataclass(frozen=True, eq=False)
class SplitStates:
    """Recorded states in two parts that share no frame; the last ones are for testing, None where none are held out."""

    training: States
    testing: States | None

    def scene(self, name: str, rest: SegmentedMesh, workspace: Workspace, source: str) -> Scene:
        """Scene in these states; its ``held_out`` draws from ``testing``."""
        held_out = None if self.testing is None else Scene(name, rest, self.testing.sample, workspace, source)
        return Scene(name, rest, self.training.sample, workspace, source, held_out)


def load_states(
    path: Path,
    rest: SegmentedMesh,
    *,
    mesh: Path | None = None,
    scale: float = 1.0,
    shift: Triple = (0.0, 0.0, 0.0),
    held_out: float = HELD_OUT,
) -> SplitStates:
    """Recorded states of an object; ``scene = file * scale + shift`` takes the file's coordinates to those of ``rest``.

    Args:
        path: a file, a directory or a pattern of files, see docs/scene-file.md.
        rest: the object at rest, in scene units.
        mesh: file of the states' own nodes at rest, and of their tetrahedra, where the frames do not have them.
        scale: above 0.
        shift: in scene units.
        held_out: the share of frames, the last ones, kept for testing: from 0 to less than 1.

    Raises ``FileNotFoundError`` for nothing at ``path``, ``ImportError`` for a format of VTK without the extra
    `simulation`, ``ValueError`` for damaged files, frames that do not fit ``rest``, or turn something inside out.
    """
    offset = np.asarray(shift, float)
    if not (np.isfinite(scale) and scale > 0 and offset.shape == (3,) and np.isfinite(offset).all()):
        raise ValueError(f"scale is {scale} and shift {shift}; they must be finite, scale above 0, shift of 3 numbers")
    record = read_states(Path(path), rest.names, mesh)
    frames = (
        _tetrahedral_frames(path, record, rest, scale, offset)
        if isinstance(record, TetrahedralRecord)
        else _surface_frames(path, record, rest, scale, offset)
    )
    if not 0 <= held_out < 1:
        raise ValueError(f"held_out is {held_out}; the share of frames for testing is from 0 to less than 1: take 0.1")
    count = frames.count
    kept = max(1, round(count * held_out)) if held_out else 0
    if kept >= count:
        raise ValueError(
            f"{path} has {count} frames, of which {kept} would be held out for testing; at least one must be left for "
            "training: record more, or set held_out to 0"
        )
    testing = States(frames, count - kept, count) if kept else None
    return SplitStates(States(frames, 0, count - kept), testing)


# --- recorded frames: each is a map of space, by tetrahedra or by surfaces --------------------------------------------

MATCHED = 1e-4
"""How near a vertex of the states must be to the mesh's, of the segment's longest side: what single precision and a
few printed digits leave."""

DOUBTFUL_STRETCH = 2.0
"""Edges that the first frame makes longer or shorter by this factor, in the median, are hardly those of one mesh."""

FAR = 0.1
"""A surface that lies mostly farther from the tetrahedra than this, of their longest side, is not theirs."""


@dataclass(frozen=True, eq=False)
class TetrahedralFrames:
    """States of one tetrahedral mesh, at rest in scene units, that moves all segments.

    ``displacements`` of its nodes are in the file's unit and precision, ``scale`` is scene units per unit of the file.
    """

    mesh: Tetrahedra
    displacements: FramePoints
    scale: float
    segments: int

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.displacements)

    def nodes(self, frame: int) -> Points:
        """Node positions in scene units."""
        return self.mesh.nodes + self.scale * self.displacements[frame].astype(float)

    def deformations(self, frame: int) -> Deformations:
        """Deformations of the segments in one frame: one map for all of them."""
        return (TetrahedralMap(self.mesh, self.nodes(frame)),) * self.segments


def tetrahedra_around(path: Path, nodes: Points, elements: Elements, rest: SegmentedMesh) -> Tetrahedra:
    """Tetrahedra of a file around an object, both in scene units.

    Raises ``ValueError`` naming the file for tetrahedra that are none, and for a mesh far from ``rest``.
    """
    try:
        mesh = Tetrahedra(nodes, elements)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    size = longest_side(mesh.nodes)
    for segment in rest.segments:
        away = segment.vertices[mesh.locate(segment.vertices) < 0]
        distance = norm(away - mesh.closest(away)[2], axis=1) if len(away) else np.zeros(0)
        if (distance > FAR * size).sum() > len(segment.vertices) / 2:
            raise ValueError(
                f"segment {segment.name!r} lies {np.median(distance):.3g} outside of the tetrahedra in {path}, whose "
                f"longest side is {size:.3g}; they must hold the surface: check the unit, scale and shift"
            )
    return mesh


def _tetrahedral_frames(
    path: Path, record: TetrahedralRecord, rest: SegmentedMesh, scale: float, shift: Vector
) -> TetrahedralFrames:
    """Frames; ``ValueError`` for a mesh far from ``rest`` and for the first frame that inverts a tetrahedron."""
    mesh = tetrahedra_around(path, record.rest_nodes * scale + shift, record.tetrahedra, rest)
    frames = TetrahedralFrames(mesh, record.displacements, scale, len(rest.segments))
    for frame in range(frames.count):
        ratios = mesh.volume_ratios(frames.nodes(frame))
        worst = int(np.argmin(ratios))
        if not ratios[worst] > 0:
            raise ValueError(
                f"{path}: {record.frames[frame]} inverts tetrahedron {worst} (its volume is {ratios[worst]:.3g} times "
                "that at rest); all must stay above 0: leave the frame out, or simulate with smaller steps or forces"
            )
    return frames


@dataclass(frozen=True, eq=False)
class SurfaceFrames:
    """States of surfaces, each segment moved by a map of its own.

    ``surfaces`` are at rest, in scene units; ``vertices`` of each in all frames, in the file's unit.
    """

    surfaces: tuple[Surface, ...]
    vertices: tuple[Float[ndarray, "f _ 3"], ...]
    scale: float
    shift: Vector

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.vertices[0])

    def positions(self, segment: int, frame: int) -> AnyPoints:
        """Vertices of one segment in scene units."""
        return self.vertices[segment][frame].astype(float) * self.scale + self.shift

    def deformations(self, frame: int) -> Deformations:
        """Deformations of the segments in one frame, a map of its own for each."""
        return tuple(SurfaceMap(s, self.positions(index, frame)) for index, s in enumerate(self.surfaces))


def _surface_frames(
    path: Path, record: SurfaceRecord, rest: SegmentedMesh, scale: float, shift: Vector
) -> SurfaceFrames:
    """Frames; ``ValueError`` for vertices that do not match ``rest`` and for the first frame that is inside out."""
    ordered = []
    for segment in rest.segments:
        states = record.vertices[segment.name]
        known = record.rest.get(segment.name)
        known = None if known is None else known * scale + shift
        ordered.append(states[:, _order(path, segment, states.shape[1], known)])
    surfaces = tuple(Surface(segment.vertices, segment.faces) for segment in rest.segments)
    frames = SurfaceFrames(surfaces, tuple(ordered), scale, shift)
    for index, segment in enumerate(rest.segments):
        if segment.name not in record.rest:
            _check_order(path, segment, frames.positions(index, 0))
        for frame, name in enumerate(record.frames):
            volume = replace(segment, vertices=frames.positions(index, frame)).volume / segment.volume
            if not volume > 0:
                raise ValueError(
                    f"{path}: {name} turns {segment.name!r} inside out (its volume is {volume:.3g} times that at "
                    "rest); it must stay above 0: leave the frame out"
                )
    return frames


def _order(path: Path, segment: Segment, count: int, known: Float[ndarray, "w 3"] | None) -> slice | Int[ndarray, " v"]:
    """Which vertex of the states is each of the mesh's: by rest position where the file has it, else one to one."""
    cure = f"name the states' own mesh at rest by the key mesh (in an NPZ file '{segment.name}.rest')"
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
    size = longest_side(segment.vertices)
    if distance.max() > MATCHED * size:
        raise ValueError(
            f"{path}: the rest positions of {segment.name!r} miss a vertex of its mesh by {distance.max():.3g}, of "
            f"{size:.3g} across; without tetrahedra they must be the same vertices in the same pose: check the unit, "
            "scale and shift, or name a mesh with tetrahedra"
        )
    return np.asarray(nearest, np.int64)


def _check_order(path: Path, segment: Segment, vertices: Vertices) -> None:
    """Refuse vertices whose neighbours are far apart: the order is another mesh's, or the unit another one."""
    edges = segment.faces[:, [0, 1]]
    before, after = (norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (segment.vertices, vertices))
    stretch = float(np.exp(np.median(np.abs(np.log(np.maximum(after, 1e-300) / np.maximum(before, 1e-300))))))
    if stretch > DOUBTFUL_STRETCH:
        raise ValueError(
            f"{path} makes the edges of {segment.name!r} longer or shorter by a factor of {stretch:.3g}; its vertices "
            f"seem to be in another order or unit than the mesh's: check scale, or name their own mesh by the key "
            f"mesh (in an NPZ file '{segment.name}.rest')"
        )
