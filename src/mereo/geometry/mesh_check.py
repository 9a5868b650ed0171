"""What is wrong with a user's meshes: each segment by itself, and the volume that segments share."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import igl
import manifold3d
import numpy as np
from jaxtyping import Bool, Float, Int

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import label_grid

MOST_BURIED = 5e-3
"""Share of a segment's surface that may lie within itself, as lips and eyelids do: two rays are compared anyway."""

MOST_BACKWARDS = 0.05
"""Share of the surface that may face inwards before the winding number has no meaning."""

MOST_UNDECIDED = 0.5
"""Share of the surface that may have as much of an inside before it as behind it: of open surfaces it is all."""


@dataclass(frozen=True)
class Health:
    """Faults of one segment, as parts of a sentence that starts with its name.

    Attributes:
        dirty: faults that the winding number copes with.
        hopeless: faults that leave no inside.
        mendable: whether a repair may help.
    """

    dirty: tuple[str, ...] = ()
    hopeless: tuple[str, ...] = ()
    mendable: bool = True

    @property
    def sound(self) -> bool:
        """Whether the segment has no fault."""
        return not (self.dirty or self.hopeless)


def examine(segment: Segment) -> Health:
    """Faults of a mesh: missing or broken data, open edges, faces that disagree, face inwards or are buried.

    Across a face the winding number rises by one from its front to its back. In front of it, it is 0 on a solid's
    surface, 1 where the face lies within the mesh itself (a self-intersection), and -1 where it faces inwards. On both
    sides of an open surface that encloses nothing it is about a half.
    """
    vertices, faces = segment.vertices, segment.faces
    if len(faces) == 0:
        return Health(hopeless=("has no faces",), mendable=False)
    if not np.isfinite(vertices).all():
        return Health(hopeless=("has NaN or infinite vertices",))
    if faces.min() < 0 or faces.max() >= len(vertices):
        return Health(hopeless=(f"has a face that refers to vertex {int(faces.max())} of {len(vertices)}",))
    if not (segment.bounds[1] > segment.bounds[0]).all():
        return Health(hopeless=("is flat, without any volume",), mendable=False)
    dirty = []
    open_edges, misoriented = segment.edge_imbalance()
    if open_edges:
        dirty.append(f"has {open_edges} open edges (holes)")
    buried, backwards, undecided = _wrong_shares(segment)
    if open_edges and undecided > MOST_UNDECIDED:
        return Health(hopeless=(f"is an open surface ({open_edges} open edges) that encloses no volume",))
    if backwards > MOST_BACKWARDS:
        return Health(tuple(dirty), (f"has {backwards:.0%} of its surface facing inwards",))
    if misoriented:
        dirty.append(f"has {misoriented} edges at which faces disagree in orientation")
    if buried > MOST_BURIED:
        dirty.append(f"intersects itself ({buried:.1%} of its surface lies within it)")
    return Health(tuple(dirty))


def faces_astray(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> bool:
    """Whether neighbouring faces disagree in orientation, or some face inwards."""
    segment = Segment("", (0, 0, 0), vertices, faces)
    return segment.edge_imbalance()[1] > 0 or _wrong_shares(segment)[1] > 1e-3


def _wrong_shares(segment: Segment) -> tuple[float, float, float]:
    """Shares of the surface that lie within the mesh itself, that face inwards, and that have an inside nowhere."""
    low, high = segment.bounds
    vertices = (segment.vertices - (low + high) / 2) / float(np.linalg.norm(high - low))
    a, b, c = (vertices[segment.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    proper = area > 1e-12
    # a ten-thousandth of the box's diagonal before each face; libigl's winding number is in single precision
    front = ((a + b + c) / 3)[proper] + 1e-4 * normal[proper] / area[proper, None]
    winding = igl.fast_winding_number(vertices, segment.faces.astype(np.int64), front)
    share = area[proper] / area.sum()
    undecided = (winding > -0.75) & (winding < -0.25)
    return float(share[winding > 0.5].sum()), float(share[winding < -0.5].sum()), float(share[undecided].sum())


# --- units ------------------------------------------------------------------------------------------------------------


def likely_unit(bounds: Float[np.ndarray, "2 3"]) -> str:
    """Guess of a mesh's unit from its longest side: CAD and scanners write millimetres, robots and glTF metres."""
    longest = float((bounds[1] - bounds[0]).max())
    return "m" if longest < 3 else "mm"


PLAUSIBLE_M = (0.005, 5.0)
"""Longest side of what a depth camera looks at: from 5 mm to 5 m."""


# --- solids of manifold3d ---------------------------------------------------------------------------------------------

Vertices = Float[np.ndarray, "_ 3"]
Faces = Int[np.ndarray, "_ 3"]


def solid_of(vertices: Vertices, faces: Faces) -> manifold3d.Manifold:
    """Solid of a closed mesh; raises ``ValueError`` where manifold3d does not accept it."""
    # copies, because manifold3d takes no array that is read-only
    mesh = manifold3d.Mesh64(np.array(vertices, np.float64, order="C"), np.array(faces, np.uint64, order="C"))
    solid = manifold3d.Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError:
        raise ValueError(f"a mesh of {len(faces)} faces is no solid ({solid.status().name}); it must be closed")
    return solid


def mesh_of(solid: manifold3d.Manifold) -> tuple[Vertices, Faces]:
    """Vertices and faces of a solid."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int64)


# --- segments with each other -----------------------------------------------------------------------------------------

TOLERANCE = 1e-3
"""Share of a segment's volume that may lie in another one, or of a nested one's outside of its outer one."""

CELLS = 40
"""Along each side of a segment's box, for meshes that are no solids: fast also where they have holes."""


@dataclass(frozen=True)
class Overlap:
    """Volume that two segments share without being declared nested, or that a nested one has outside.

    Attributes:
        small, large: names; the smaller one, or the inner one, first.
        share: of the smaller segment's volume.
        nested: whether the pair is declared nested; then ``share`` lies outside of the outer one.
    """

    small: str
    large: str
    share: float
    nested: bool = False

    def __str__(self) -> str:
        if self.nested:
            return f"{self.small} is nested in {self.large}, but {self.share:.2%} of it lies outside"
        return f"{self.small} and {self.large} overlap in {self.share:.2%} of {self.small}"


def overlaps(
    mesh: SegmentedMesh, tolerance: float = TOLERANCE, among: Collection[tuple[int, int]] | None = None
) -> tuple[Overlap, ...]:
    """Pairs of segments that share more than ``tolerance`` of the smaller one, or nest with as much outside.

    Exact for solids, however thin what they share; within a percent or so where one of two is no solid. Segments that
    touch share no volume. Segments may be no solids, so their boxes say which of two is smaller.

    Args:
        mesh: any unit.
        tolerance: share of a segment's volume, from 0 to 1.
        among: pairs of indices, the lower one first, to which the test is limited.
    """
    bodies, nesting, names = [_Body(segment) for segment in mesh.segments], set(mesh.nesting), mesh.names
    order = sorted(range(len(bodies)), key=lambda index: bodies[index].box_volume)
    chosen = combinations(order, 2) if among is None else (sorted(pair, key=order.index) for pair in sorted(among))
    pairs = []
    for small, large in chosen:
        nested = (min(small, large), max(small, large)) in nesting
        inner, outer = sorted((small, large)) if nested else (small, large)
        share = bodies[inner].share_in(bodies[outer])
        pairs.append(Overlap(names[inner], names[outer], 1.0 - share if nested else share, nested))
    return tuple(pair for pair in pairs if pair.share > tolerance)


def grid_volume(segment: Segment) -> float:
    """Volume inside a mesh, also of one with holes, measured on a grid: within a percent or so."""
    body = _Body(segment)
    return int(body.filled.sum()) * float(np.prod((segment.bounds[1] - segment.bounds[0]) / CELLS))


class _Body:
    """A segment as a solid, and as the filled cells of a grid over its box; each is made on first use."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        self.bounds = low, high = segment.bounds
        self.box_volume = float(np.prod(high - low))
        self.axes = [low[k] + (np.arange(CELLS) + 0.5) * (high[k] - low[k]) / CELLS for k in range(3)]

    @cached_property
    def solid(self) -> manifold3d.Manifold | None:
        """The solid; None where the mesh is none, or none for manifold3d."""
        if not self.segment.solid:
            return None
        try:
            return solid_of(self.segment.vertices, self.segment.faces)
        except ValueError:
            return None

    @cached_property
    def filled(self) -> Bool[np.ndarray, "x y z"]:
        """Whether the centre of each cell lies in the segment."""
        return label_grid(SegmentedMesh((self.segment,)), *self.axes) > 0

    def share_in(self, other: "_Body") -> float:
        """How much of the volume lies in another segment, from 0 to 1."""
        box, around = self.bounds, other.bounds
        if (around[1] <= box[0]).any() or (around[0] >= box[1]).any():
            return 0.0
        if self.solid is None or other.solid is None:
            both = self.filled & (label_grid(SegmentedMesh((other.segment,)), *self.axes) > 0)
            return float(both.sum() / max(int(self.filled.sum()), 1))
        return float(np.clip((self.solid ^ other.solid).volume() / self.solid.volume(), 0.0, 1.0))
