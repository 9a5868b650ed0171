"""Segmented meshes: an object as named, coloured, closed triangle meshes.

Label ``0`` is empty space everywhere in the package; label ``i + 1`` is ``mesh.segments[i]``. Names and colours are
part of the data: they travel through datasets, weights and every export, so a label never changes its meaning.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mereo.geometry.brief import counted, listed, sides
from mereo.geometry.conventions import Names, Pair
from mereo.geometry.read_only import read_only_view
from mereo.geometry.transforms import (
    AnyPoints,
    Corners,
    Indices,
    Matrices,
    Points,
    Transform,
    transform_points,
    unit_rows,
)

Vertices = Float[ndarray, "v 3"]
"""Positions or vectors in rows: one for each vertex of a mesh."""

Faces = Int[ndarray, "f 3"]
"""Three indices of vertices in each row, counter-clockwise seen from outside."""

AnyFaces = Int[ndarray, "_ 3"]
"""The same, as many as there are: of a mesh that is changed, with ``AnyPoints``."""

EMPTY_MESH = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
"""That of a segment which was not found."""

ChangedMesh = tuple[Float[ndarray, "w 3"], Int[ndarray, "g 3"]]
"""Vertices and faces of a mesh that comes of another one, in numbers of their own."""

Elements = Int[ndarray, "m 4"]
"""Four indices of nodes in each row, a tetrahedron."""

Color = tuple[int, int, int]
"""Red, green, blue in 0..255."""

SegmentColors = tuple[Color, ...]
"""Colour of each segment, in label order."""

Nested = tuple[tuple[str, str], ...]
"""Pairs of names of segments, the inner one first."""

AnyMesh = tuple[AnyPoints, AnyFaces]
"""Vertices and faces."""

Colors = UInt8[ndarray, "n 3"]
"""A colour for each row of the axis ``n``."""

PALETTE: SegmentColors = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (240, 228, 66),
    (213, 94, 0),
    (204, 121, 167),
    (0, 114, 178),
    (150, 150, 150),
    (148, 103, 189),
    (140, 86, 75),
    (23, 190, 207),
    (188, 189, 34),
)
"""Okabe and Ito's colours first: distinguishable with colour-vision deficiency."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Closed part of an object, as a named and coloured triangle mesh.

    Attributes:
        name: stable identifier, unique in its mesh.
        color: red, green, blue in 0..255.
        vertices: positions, any unit.
        faces: vertex indices, counter-clockwise seen from outside.
        solid: whether the faces bound a solid, closed and free of self-intersections. Of a mesh that does not, the
            generalized winding number decides what is inside, which is slower.
    """

    name: str
    color: Color
    vertices: Vertices
    faces: Faces
    solid: bool = True

    def __post_init__(self) -> None:
        # segments are shared by scenes, states and results: a change of one would be a change of all
        for name in ("vertices", "faces"):
            object.__setattr__(self, name, read_only_view(getattr(self, name)))

    def __repr__(self) -> str:
        size = f"{len(self.vertices):,} vertices, {counted(len(self.faces), 'face')}"
        return f"Segment({self.name!r}, {size}, {sides(self.vertices)})"

    @property
    def bounds(self) -> Corners:
        """Lower and upper corner of the axis-aligned box; infinite, upside down, without vertices."""
        return np.stack([self.vertices.min(axis=0, initial=inf), self.vertices.max(axis=0, initial=-inf)])

    @property
    def volume(self) -> float:
        """Signed volume (divergence theorem); negative when the faces are inside out."""
        a, b, c = face_corners(self.vertices, self.faces)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    def edge_imbalance(self) -> Pair:
        """Numbers of open and of misoriented edges: both zero exactly when the mesh is closed and oriented alike."""
        return edge_imbalance(self.faces)


@dataclass(frozen=True, eq=False)
class SegmentedMesh:
    """Object as closed segments that touch but do not overlap, except that one may lie inside another.

    Attributes:
        segments: in label order.
        nested: pairs of names (inner, outer): ``outer``'s mesh is its outer surface alone, and the volume inside
            ``inner`` belongs to ``inner``. The inner segment comes first in ``segments``, so that "the first segment
            wins" decides everywhere. See docs/method.md.
    """

    segments: tuple[Segment, ...]
    nested: Nested = ()

    def __post_init__(self) -> None:
        names = [segment.name for segment in self.segments]
        if not names:
            raise ValueError("a segmented mesh has 0 segments; it needs at least one: pass the parts of the object")
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"segment name {repeated[0]!r} is used twice; names must be unique: rename one of them")
        if len(names) > 254:
            raise ValueError(f"a segmented mesh has {len(names)} segments; labels hold at most 254: merge some")
        for inner, outer in self.nested:
            if missing := [name for name in (inner, outer) if name not in names]:
                raise ValueError(
                    f"{inner!r} is declared nested in {outer!r}, but no segment is called {missing[0]!r}; the segments "
                    f"are {', '.join(names)}: correct the name"
                )
            if names.index(inner) >= names.index(outer):
                raise ValueError(
                    f"segment {inner!r} is declared nested in {outer!r} but does not come before it; the first of two "
                    f"segments owns what both hold: put {inner!r} first"
                )

    def __repr__(self) -> str:
        faces = counted(sum(len(segment.faces) for segment in self.segments), "face")
        size = sides(np.concatenate([segment.vertices for segment in self.segments]))
        return f"SegmentedMesh({counted(len(self.segments), 'segment')}: {listed(self.names)}; {faces}, {size})"

    @property
    def names(self) -> Names:
        """Names of the segments, in label order."""
        return tuple(segment.name for segment in self.segments)

    @property
    def colors(self) -> SegmentColors:
        """Colours of the segments, in label order."""
        return tuple(segment.color for segment in self.segments)

    @property
    def bounds(self) -> Corners:
        """Joint axis-aligned box of all segments."""
        boxes = np.stack([segment.bounds for segment in self.segments])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

    @property
    def nesting(self) -> tuple[Pair, ...]:
        """Pairs (inner, outer) of segments' indices, with what follows: a in b and b in c puts a in c."""
        index = {name: i for i, name in enumerate(self.names)}
        pairs = {(index[inner], index[outer]) for inner, outer in self.nested}
        while more := {(a, d) for a, b in pairs for c, d in pairs if b == c} - pairs:
            pairs |= more
        return tuple(sorted(pairs))

    @property
    def opaque(self) -> tuple[bool, ...]:
        """Whether to draw each segment opaque: it hides no segment that has faces."""
        hiding = {outer for inner, outer in self.nesting if len(self.segments[inner].faces)}
        return tuple(index not in hiding for index in range(len(self.segments)))

    @property
    def owned_volumes(self) -> Float[ndarray, " s"]:
        """Volume that belongs to each segment: its mesh's without that of the segments nested in it."""
        volumes = np.array([segment.volume for segment in self.segments])
        for outer in (i for i, s in enumerate(self.segments) if len(s.faces)):  # the inner ones come first and are done
            volumes[outer] -= sum(volumes[inner] for inner, other in self.nesting if other == outer)
        return volumes

    def with_vertices(self, vertices: Sequence[AnyPoints]) -> "SegmentedMesh":
        """Mesh of the same segments at other positions; ``vertices[i]`` belongs to ``segments[i]``."""
        moved = tuple(replace(s, vertices=v) for s, v in zip(self.segments, vertices, strict=True))
        return replace(self, segments=moved)

    def transformed(self, transform: Transform) -> "SegmentedMesh":
        """Mesh with all vertices mapped by a homogeneous transform."""
        return self.with_vertices([transform_points(transform, segment.vertices) for segment in self.segments])

    def merged(self) -> tuple[Vertices, Faces, Int[ndarray, " f"]]:
        """All segments in one array: vertices, faces, and for each face the index of its segment."""
        offsets = np.cumsum([0] + [len(s.vertices) for s in self.segments])
        vertices = np.concatenate([s.vertices for s in self.segments])
        faces = np.concatenate([s.faces + o for s, o in zip(self.segments, offsets, strict=False)])
        owner = np.repeat(np.arange(len(self.segments)), [len(s.faces) for s in self.segments])
        return vertices, faces, owner

    def check(self) -> None:
        """Raise ``ValueError`` unless every segment is finite, closed, outward oriented and of positive volume.

        Of a segment that is marked as no solid, only finite vertices and existing indices are required.
        """
        for segment in self.segments:
            check_segment(segment)


def check_segment(segment: Segment) -> None:
    """Raise ``ValueError`` naming the segment, the rule it breaks and the cure."""
    faces = segment.faces
    count = len(segment.vertices)
    fault = ""
    if len(faces) == 0:
        fault = "no faces; it must be a closed mesh: check the exported part"
    elif not np.isfinite(segment.vertices).all():
        fault = "NaN or infinite vertices; all must be finite: export the part again"
    elif faces.min() < 0 or faces.max() >= count:
        fault = f"a face that refers to vertex {int(faces.max())} of {count}; indices must exist: export the part again"
    elif segment.solid:
        open_edges, misoriented = segment.edge_imbalance()
        if open_edges:
            fault = f"{open_edges} open edges; it must be closed: fill its holes (for example "
            fault += "trimesh.repair.fill_holes or MeshLab's 'Close Holes')"
        elif misoriented:
            fault = f"{misoriented} edges whose faces disagree in orientation; all faces must be counter-clockwise "
            fault += "from outside: fix the winding (for example trimesh.repair.fix_winding)"
        elif segment.volume <= 0:
            fault = f"volume {segment.volume:.4g}; it must be positive: its faces point inwards, so reverse them "
            fault += "(for example trimesh.repair.fix_inversion)"
    if fault:
        raise ValueError(f"segment {segment.name!r} has {fault}")


def directed_edges(faces: AnyFaces) -> Int[ndarray, "_ 2"]:
    """The three edges of each face in turn, from corner to corner."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)


def edge_uses(
    faces: Faces,
) -> tuple[Int[ndarray, "e 2"], Int[ndarray, " e"], Bool[ndarray, " e"]]:
    """Edges with their lower end first, how many faces each has, and whether these do not go there and back alike."""
    directed = directed_edges(faces)
    size = int(directed.max(initial=0)) + 1
    keys, edge, uses = np.unique(np.sort(directed, axis=1) @ [size, 1], return_inverse=True, return_counts=True)
    forth = np.where(directed[:, 0] < directed[:, 1], 1, -1)
    unbalanced = np.bincount(edge.ravel(), weights=forth, minlength=len(keys)) != 0
    return np.stack(np.divmod(keys, size), axis=1), uses, unbalanced


def edge_imbalance(faces: Faces) -> Pair:
    """Numbers of open and of misoriented edges: both zero exactly when a mesh is closed and oriented alike."""
    _, uses, unbalanced = edge_uses(faces)
    return int((uses % 2 == 1).sum()), int((unbalanced & (uses % 2 == 0)).sum())


def three_cornered(faces: Faces) -> Bool[ndarray, " f"]:
    """Which faces have three different vertices."""
    return (faces != np.roll(faces, 1, axis=1)).all(axis=1)


def with_used_vertices(
    vertices: Vertices, faces: Int[ndarray, "f k"]
) -> tuple[Float[ndarray, "w 3"], Int[ndarray, "f k"]]:
    """Mesh without the vertices that no face has; the others stay in their order."""
    used, kept = np.unique(faces, return_inverse=True)  # flat before numpy 2
    return vertices[used], kept.reshape(faces.shape)


def palette_color(index: int) -> Color:
    """Colour of the palette, which starts again after its last."""
    return PALETTE[index % len(PALETTE)]


def face_corners(vertices: AnyPoints, faces: AnyFaces) -> tuple[AnyPoints, ...]:
    """First, second and third corner of each face."""
    return tuple(vertices[faces[:, k]] for k in range(3))


def area_vectors(vertices: Vertices, faces: Faces) -> Float[ndarray, "f 3"]:
    """Normals of faces, each as long as twice the face's area."""
    a, b, c = face_corners(vertices, faces)
    return np.cross(b - a, c - a)


def connected(pairs: Int[ndarray, "p 2"], count: int) -> Indices:
    """Number of the group of each of ``count`` things, of which pairs hang together."""
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def surface_points(vertices: Vertices, faces: Faces, count: int) -> tuple[Points, Indices]:
    """Points evenly spread over a surface, the same in every call, and the face of each.

    Vertices are not: a CAD program's are where a surface is round, none where it is flat.
    """
    a, b, c = face_corners(vertices, faces)
    area = np.cumsum(norm(area_vectors(vertices, faces), axis=1))
    face = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1])
    u, v = default_rng(0).random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face], face


FEW_VERTICES = 2500
"""Vertices below which places on the faces stand for a surface: corners of few large triangles do not show it."""


def with_normals(vertices: Vertices, faces: Faces) -> Float[ndarray, "v 6"]:
    """Vertices and their normals, outward as the faces are wound; those of vertices that no face has are 0."""
    return np.hstack([vertices, vertex_normals(Segment("", PALETTE[0], vertices, faces))])


def oriented_points(vertices: Vertices, faces: Faces) -> Float[ndarray, "n 6"]:
    """Points that stand for a surface: all vertices, or where these are few, points on the faces; with normals."""
    if len(vertices) >= FEW_VERTICES:
        return with_normals(vertices, faces)
    points, face = surface_points(vertices, faces, FEW_VERTICES)
    return np.hstack([points, area_vectors(vertices, faces)[face]])


def barycentric(triangles: Matrices, points: Points) -> Points:
    """Barycentric coordinates of points in the planes of their triangles."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    size = np.maximum(np.einsum("ni,ni->n", normal, normal), 1e-30)
    v = np.einsum("ni,ni->n", np.cross(points - a, c - a), normal) / size
    w = np.einsum("ni,ni->n", np.cross(b - a, points - a), normal) / size
    return np.stack([1 - v - w, v, w], axis=1)


def vertex_normals(segment: Segment) -> Vertices:
    """Unit normals of a segment's vertices, outward, weighted by the area of the faces around."""
    normals = np.zeros_like(segment.vertices)
    for k in range(3):
        np.add.at(normals, segment.faces[:, k], area_vectors(segment.vertices, segment.faces))
    return unit_rows(normals)
