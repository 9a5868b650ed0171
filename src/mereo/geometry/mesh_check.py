"""What is wrong with a user's meshes: each segment by itself, and the volume that segments share."""

from collections.abc import Collection, Sequence
from functools import cached_property
from itertools import combinations
from math import inf
from typing import NamedTuple

import igl
import manifold3d
import numpy as np
from jaxtyping import Bool, Float, Int
from manifold3d import Manifold
from numpy import ndarray
from numpy.linalg import norm, svd

from mereo.geometry.brief import counted
from mereo.geometry.conventions import Names, Pair
from mereo.geometry.labels import VoxelMask
from mereo.geometry.mesh import (
    AnyFaces,
    AnyMesh,
    Segment,
    SegmentedMesh,
    area_vectors,
    connected,
    directed_edges,
    edge_imbalance,
    edge_uses,
    face_corners,
    three_cornered,
)
from mereo.geometry.solids import label_grid
from mereo.geometry.transforms import AnyPoints, Corners, Vector, box_of, longest_side

MOST_BURIED, MOST_BACKWARDS, MOST_UNDECIDED = 5e-3, 0.05, 0.5
"""Shares of a surface that may lie within the segment, as lips and eyelids do (two rays are compared anyway), face
inwards before the winding number has no meaning, and have as much inside before as behind: of open ones it is all."""


CROSSED = "intersects itself"
"""Beginning of the fault of a mesh of which some surface lies within it, as where shells overlap."""

MOST_DIRTY = 300_000
"""Faces of a mesh that is no solid: the winding number takes as long for every place that is asked for."""

FLAT = 1e-6
"""Extent in its shortest direction, in that of its longest, at which a mesh is a plane or a line."""


class Health(NamedTuple):
    """Faults of one segment, as parts of a sentence that starts with its name.

    The winding number copes with ``dirty`` ones; ``hopeless`` ones leave no inside, and a repair may help where they
    are ``mendable``. ``notes`` do no harm, but change in a repair: fragments, faces without area.
    """

    dirty: Names = ()
    hopeless: Names = ()
    mendable: bool = True
    notes: Names = ()

    @property
    def sound(self) -> bool:
        """Whether the segment has no fault."""
        return not (self.dirty or self.hopeless)

    def refusal(self, faces: int) -> str:
        """Why a mesh of so many faces cannot be used even with winding numbers; empty where it can."""
        if self.dirty and not self.hopeless and faces > MOST_DIRTY:
            return f"{self.dirty[0]} and {faces:,} faces, of which what is no solid may have {MOST_DIRTY:,}"
        return self.hopeless[0] if self.hopeless else ""


def examine(segment: Segment, unit: str = "") -> Health:
    """All faults of a mesh: missing or broken data, wrong edges and faces, faces that face inwards or are buried.

    Each fault has its number, and a place where it is. Faces without vertices are named, and left out of what follows.

    Across a face the winding number rises by one from its front to its back. In front of it, it is 0 on a solid's
    surface, 1 where the face lies within the mesh itself (a self-intersection), and -1 where it faces inwards. On both
    sides of an open surface that encloses nothing it is about a half. ``unit``, such as "mm", stands behind each place.
    """
    vertices, faces = segment.vertices, segment.faces
    if len(faces) == 0:
        return Health(hopeless=("has no faces",), mendable=False)
    hopeless, usable = _broken_data(vertices, faces)
    faces = faces[usable]
    if len(faces) == 0:
        return Health(hopeless=tuple(hopeless), mendable=False)
    corners = vertices[np.unique(faces)] if hopeless else vertices
    extent = svd(corners - corners.mean(axis=0), compute_uv=False)
    if len(corners) < 4 or not extent[2] > FLAT * extent[0]:  # in any direction: of float32, a plane is this rough
        return Health(hopeless=(*hopeless, "is flat, without any volume"), mendable=False)
    collapsed = ~three_cornered(faces)
    dirty = []
    if collapsed.any():
        where = near(vertices[faces[collapsed][0]].mean(axis=0), unit)
        dirty.append(f"has {counted(int(collapsed.sum()), 'degenerate face')} with one vertex twice, {where}")
    faces = faces[~collapsed]
    if len(faces) == 0:
        return Health(tuple(dirty), (*hopeless, "has no faces with three vertices"), mendable=False)
    surface = _front_winding(vertices, faces)
    opened, edges = _wrong_edges(vertices, faces, unit)
    undecided = (surface.winding > -0.75) & (surface.winding < -0.25)
    if opened and surface.share_where(undecided) > MOST_UNDECIDED:
        hopeless.append(f"is an open surface ({opened} open edges) that encloses no volume")
        loose = opened > 2 * len(faces)  # triangles that do not hang together
        return Health((*dirty, *edges[1:]), tuple(hopeless), not loose, _notes(vertices, faces, surface, unit))
    dirty += edges
    if not opened and _encloses_nothing(vertices, faces):
        hopeless.append("encloses no volume")
    backwards, buried = surface.winding < -0.5, surface.winding > 0.5
    turned = surface.share_where(backwards)
    if turned > MOST_BACKWARDS:
        place = f", {surface.place(backwards, unit)}" if turned < 0.995 else ""
        hopeless.append(f"has {turned:.0%} of its surface facing inwards{place}")
        buried |= surface.winding < -1.5  # inside out, what lies within the mesh has twice the winding number before it
    if surface.share_where(buried) > MOST_BURIED:
        share = f"{surface.share_where(buried):.1%} of its surface lies within it"
        dirty.append(f"{CROSSED} ({share}, {surface.place(buried, unit)})")
    notes = _notes(vertices, faces, surface, unit)
    if 1e-5 < turned <= MOST_BACKWARDS:
        notes += (f"has {100 * turned:.2g} % of its surface facing inwards, {surface.place(backwards, unit)}",)
    return Health(tuple(dirty), tuple(hopeless), notes=notes)


def _broken_data(vertices: AnyPoints, faces: AnyFaces) -> tuple[list[str], Bool[ndarray, " f"]]:
    """Faults of the arrays, and which faces can be used all the same."""
    faults = []
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        faults.append(f"has NaN or infinite vertices ({np.count_nonzero(~finite):,} of {len(vertices):,})")
    outside = (faces < 0) | (faces >= len(vertices))
    usable = np.asarray(~outside.any(axis=1))
    if not usable.all():
        text = f"has a face that refers to vertex {int(faces[outside].max())} of {len(vertices)}"
        more = int(np.count_nonzero(~usable)) - 1
        faults.append(text + (f", and {counted(more, 'face')} more like it" if more else ""))
    usable[usable] = finite[faces[usable]].all(axis=1)
    return faults, usable


def _encloses_nothing(vertices: AnyPoints, faces: AnyFaces) -> bool:
    """Whether a closed mesh has hardly any volume: far less than the thinnest sheet or wire of its size."""
    middle = vertices[faces].mean(axis=(0, 1))
    volume = abs(Segment("", (0, 0, 0), vertices - middle, faces).volume)
    area = norm(area_vectors(vertices, faces), axis=1).sum()
    return not volume > 1e-9 * area * float(norm(np.ptp(vertices[np.unique(faces)], axis=0)))


def _wrong_edges(vertices: AnyPoints, faces: AnyFaces, unit: str) -> tuple[int, list[str]]:
    """Number of open edges, and phrases on them and on edges of too many faces or of faces that disagree."""
    ends, uses, unbalanced = edge_uses(faces)
    faults = []
    rim = ends[uses == 1]
    if len(rim):
        _, loop = np.unique(connected(rim, len(vertices))[rim[:, 0]], return_inverse=True)
        longest = rim[loop == np.bincount(loop).argmax()]
        holes = f"{counted(int(loop.max()) + 1, 'hole')}, the largest" if loop.max() else "1 hole,"
        where = near(vertices[longest].mean(axis=(0, 1)), unit)
        faults.append(f"has {counted(len(rim), 'open edge')} ({holes} {where})")
    for wrong, what in (
        (unbalanced & (uses > 2), "with more than two faces"),
        (unbalanced & (uses == 2), "at which faces disagree in orientation"),
    ):
        if wrong.any():
            where = near(vertices[ends[wrong][0]].mean(axis=0), unit)
            faults.append(f"has {counted(int(wrong.sum()), 'edge')} {what}, {where}")
    return len(rim), faults


def _notes(vertices: AnyPoints, faces: AnyFaces, surface: "_FrontWinding", unit: str) -> Names:
    notes = []
    stray, what = fragments(vertices, faces, unit)
    if stray.any():
        notes.append(f"has {what}: a repair merges or drops them")
    flat = np.flatnonzero(~surface.proper)
    if len(flat):
        where = near(vertices[faces[flat[0]]].mean(axis=0), unit)
        notes.append(f"has {counted(len(flat), 'face')} without area, {where}: they do no harm")
    return tuple(notes)


def near(point: Vector, unit: str) -> str:
    """Phrase for a place, such as "near [1.5, 0, -2] mm"."""
    digits = 4 - int(np.floor(np.log10(max(float(np.abs(point).max()), 1e-300))))  # of the largest coordinate, for all
    return f"near [{', '.join(f'{round(float(value), digits) + 0.0:.4g}' for value in point)}]{unit and f' {unit}'}"


def faces_astray(vertices: AnyPoints, faces: AnyFaces) -> bool:
    """Whether neighbouring faces disagree in orientation, or some face inwards."""
    surface = _front_winding(vertices, faces)
    disagree = edge_imbalance(faces)[1] > 0
    return disagree or surface.share_where(surface.winding < -0.5) > 1e-3


class _FrontWinding(NamedTuple):
    """Winding number before each face that has an area (``proper``), its share of the surface, and its middle."""

    winding: Float[ndarray, " p"]
    share: Float[ndarray, " p"]
    middle: Float[ndarray, "p 3"]
    proper: Bool[ndarray, " f"]

    def share_where(self, chosen: Bool[ndarray, " p"]) -> float:
        return float(self.share[chosen].sum())

    def place(self, chosen: Bool[ndarray, " p"], unit: str) -> str:
        """Place of the largest of some faces."""
        return near(self.middle[np.where(chosen, self.share, -1.0).argmax()], unit)


def _front_winding(vertices: AnyPoints, faces: AnyFaces) -> _FrontWinding:
    corners = vertices[np.unique(faces)]
    low, high = box_of(corners)
    vertices = (np.where(np.isfinite(vertices), vertices, low) - (low + high) / 2) / float(norm(high - low))
    normal = area_vectors(vertices, faces)
    area = norm(normal, axis=1)
    proper = area > 1e-12
    a, b, c = face_corners(vertices, faces[proper])
    middle = (a + b + c) / 3
    # a ten-thousandth of the box's diagonal before each face; libigl's winding number is in single precision
    front = middle + 1e-4 * normal[proper] / area[proper, None]
    winding = igl.fast_winding_number(vertices, faces.astype(np.int64), front)
    middle = middle * float(norm(high - low)) + (low + high) / 2
    return _FrontWinding(winding, area[proper] / max(area.sum(), 1e-300), middle, proper)


def pieces(faces: AnyFaces, vertices: int) -> Int[ndarray, " f"]:
    """Number of the piece of each face; a piece is connected over edges which exactly two of its faces share."""
    edges = np.sort(directed_edges(faces), axis=1) @ [vertices, 1]
    order = np.argsort(edges, kind="stable")
    _, first, uses = np.unique(edges[order], return_index=True, return_counts=True)
    return connected(np.stack([order[first[uses == 2]], order[first[uses == 2] + 1]], axis=1) // 3, len(faces))


FRAGMENT = 0.02
"""Diagonal of a fragment's box at most, in those of the whole."""


def fragments(vertices: AnyPoints, faces: AnyFaces, unit: str = "") -> tuple[Bool[ndarray, " f"], str]:
    """Faces of pieces that are tiny compared with the whole, and a phrase with their number, share, size and place."""
    piece = pieces(faces, len(vertices))
    corners = vertices[faces]
    low, high = (np.full((piece.max() + 1, 3), end) for end in (inf, -inf))
    np.minimum.at(low, piece, corners.min(axis=1))
    np.maximum.at(high, piece, corners.max(axis=1))
    size = norm(high - low, axis=1)
    tiny = size < FRAGMENT * float(norm(high.max(axis=0) - low.min(axis=0)))
    if not tiny.any() or tiny.all():
        return np.zeros(len(faces), bool), ""
    stray = tiny[piece]
    largest = int(np.where(tiny, size, -1.0).argmax())
    length = f"{np.ptp([low[largest], high[largest]], axis=0).max():.2g}{unit and f' {unit}'}"
    which = f"the largest {length} long" if tiny.sum() > 1 else f"{length} long"
    where = near((low[largest] + high[largest]) / 2, unit)
    area = norm(area_vectors(vertices, faces), axis=1)
    share = f"{100 * area[stray].sum() / max(area.sum(), 1e-300):.2g} % of its surface"
    count = f"{counted(int(tiny.sum()), 'fragment')} ({counted(int(stray.sum()), 'face')}, {share})"
    return stray, f"{count}, {which}, {where}"


def likely_unit(bounds: Corners) -> str:
    """Guess of a mesh's unit from its longest side: CAD and scanners write millimetres, robots and glTF metres."""
    longest = longest_side(bounds)
    return "m" if longest < 3 else "mm"


PLAUSIBLE_M = (0.005, 5.0)
"""Longest side of what a depth camera looks at: from 5 mm to 5 m."""


def solid_of(vertices: AnyPoints, faces: AnyFaces) -> Manifold:
    """Solid of a closed mesh; raises ``ValueError`` where manifold3d does not accept it."""
    # copies, because manifold3d takes no array that is read-only
    mesh = manifold3d.Mesh64(np.array(vertices, np.float64, order="C"), np.array(faces, np.uint64, order="C"))
    solid = Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError:
        raise ValueError(f"a mesh of {len(faces)} faces is no solid ({solid.status().name}); it must be closed")
    return solid


def mesh_of(solid: Manifold) -> AnyMesh:
    """Vertices and faces of a solid."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, np.int64)


def united(pieces: Sequence[Segment]) -> AnyMesh:
    """Union of pieces, as vertices and faces, where each is a solid that faces outwards; else all of their faces."""
    if len(pieces) == 1:
        return pieces[0].vertices, pieces[0].faces
    try:
        solids = [solid_of(piece.vertices, piece.faces) for piece in pieces]
        if min(solid.volume() for solid in solids) <= 0:
            raise ValueError("a piece is inside out, and would be cut off the others")
        return mesh_of(Manifold.batch_boolean(solids, manifold3d.OpType.Add))
    except ValueError:
        return SegmentedMesh(tuple(pieces)).merged()[:2]


# --- segments with each other -----------------------------------------------------------------------------------------

TOLERANCE = 1e-3
"""Share of a segment's volume that may lie in another one, or of a nested one's outside of its outer one."""

CELLS = 40
"""Along each side of a segment's box, for meshes that are no solids: fast also where they have holes."""


class Overlap(NamedTuple):
    """Share of the volume of the ``small`` segment, or the inner one, in the ``large`` one, or outside if nested."""

    small: str
    large: str
    share: float
    nested: bool = False

    def __str__(self) -> str:
        if self.nested:
            return f"{self.small} is nested in {self.large}, but {self.share:.2%} of it lies outside"
        return f"{self.small} and {self.large} overlap in {self.share:.2%} of {self.small}"


def overlaps(
    mesh: SegmentedMesh, tolerance: float = TOLERANCE, among: Collection[Pair] | None = None
) -> tuple[Overlap, ...]:
    """Pairs of segments that share more than ``tolerance`` of the smaller one, or nest with as much outside.

    Exact for solids, however thin what they share; within a percent or so where one of two is no solid. Segments that
    touch share no volume. Segments may be no solids, so their boxes say which of two is smaller. The test is limited to
    the pairs of indices ``among``, the lower one first.
    """
    bodies = [_Body(segment) for segment in mesh.segments]
    nesting = set(mesh.nesting)
    names = mesh.names
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
    def solid(self) -> Manifold | None:
        """The solid; None where the mesh is none, or none for manifold3d."""
        if not self.segment.solid:
            return None
        try:
            return solid_of(self.segment.vertices, self.segment.faces)
        except ValueError:
            return None

    def held_by(self, segment: Segment) -> VoxelMask:
        """Whether the centre of each cell lies in a segment."""
        return label_grid(SegmentedMesh((segment,)), *self.axes) > 0

    @cached_property
    def filled(self) -> VoxelMask:
        return self.held_by(self.segment)

    def share_in(self, other: "_Body") -> float:
        """How much of the volume lies in another segment, from 0 to 1."""
        box, around = self.bounds, other.bounds
        if (around[1] <= box[0]).any() or (around[0] >= box[1]).any():
            return 0.0
        if self.solid is None or other.solid is None:
            both = self.filled & self.held_by(other.segment)
            return float(both.sum() / max(int(self.filled.sum()), 1))
        return float(np.clip((self.solid ^ other.solid).volume() / self.solid.volume(), 0.0, 1.0))
