"""Solid queries on closed meshes: which segment holds a point, how far is its surface, which way.

Inside tests cast one ray and ask whether the first face hit is seen from behind. Two rays in unrelated directions are
compared; where they disagree (a ray through an edge, an imperfect mesh) the generalized winding number decides
(Jacobson et al., SIGGRAPH 2013; Barill et al., SIGGRAPH 2018).
"""

from functools import cached_property

import igl
import numpy as np
from embreex import rtcore
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Int, UInt8

from mereo.mesh import Segment, SegmentedMesh

_DIRECTIONS = np.array([[0.4637, 0.5718, 0.6767], [-0.7301, 0.3469, -0.5887]], dtype=np.float32)
"""Two generic directions: not along any axis, face diagonal or each other."""

_DEVICE = rtcore.EmbreeDevice()


def ray_scene(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> EmbreeScene:
    """An Embree scene of one triangle mesh."""
    scene = EmbreeScene(_DEVICE)
    TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
    return scene


class _Solid:
    """One closed segment with its search structures, built on first use."""

    def __init__(self, segment: Segment) -> None:
        self.vertices = np.ascontiguousarray(segment.vertices, dtype=np.float64)
        self.faces = np.ascontiguousarray(segment.faces, dtype=np.int64)
        self.low, self.high = segment.bounds

    @cached_property
    def rays(self) -> EmbreeScene:
        return ray_scene(self.vertices, self.faces)

    @cached_property
    def tree(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(self.vertices, self.faces)
        return tree

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        result = np.zeros(len(points), dtype=bool)
        candidates = np.flatnonzero(((points > self.low) & (points < self.high)).all(axis=1))
        if len(candidates) == 0:
            return result
        near = np.ascontiguousarray(points[candidates])
        first, second = (self._behind_first_hit(near, direction) for direction in _DIRECTIONS)
        doubtful = first != second
        if doubtful.any():
            winding = igl.fast_winding_number(self.vertices, self.faces, near[doubtful])
            first[doubtful] = winding > 0.5
        result[candidates] = first
        return result

    def _behind_first_hit(
        self, points: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "3"]
    ) -> Bool[np.ndarray, " n"]:
        origins = points.astype(np.float32)
        hits = self.rays.run(origins, np.broadcast_to(direction, origins.shape).copy(), output=True)
        return (hits["primID"] >= 0) & (hits["Ng"] @ direction > 0)

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        squared, _, _ = self.tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(points))
        return np.sqrt(squared)


class Solids:
    """Queries on all segments of an object. Satisfies ``query_sampling.Shape``.

    Points are [n, 3] in the mesh's frame; distances are in its units.
    """

    def __init__(self, mesh: SegmentedMesh) -> None:
        self.mesh = mesh
        self.count = len(mesh.segments)
        self._solids = [_Solid(segment) for segment in mesh.segments]

    @cached_property
    def _surface(self) -> tuple[igl.AABB, np.ndarray, np.ndarray, np.ndarray]:
        vertices, faces, owner = self.mesh.merged()
        vertices, faces = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
        tree = igl.AABB()
        tree.init(vertices, faces)
        return tree, vertices, faces, owner

    def boxes(self) -> Float[np.ndarray, "s 2 3"]:
        """Axis-aligned box of each segment."""
        return np.stack([[solid.low, solid.high] for solid in self._solids])

    def inside(self, index: int, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether each point lies in segment ``index``."""
        return self._solids[index].inside(points)

    def label(self, points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
        """0 in empty space, else index + 1; where segments overlap the first one owns the point."""
        labels = np.zeros(len(points), dtype=np.uint8)
        for index, solid in enumerate(self._solids):
            free = np.flatnonzero(labels == 0)
            labels[free[solid.inside(points[free])]] = index + 1
        return labels

    def segment_distance(self, index: int, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Unsigned distance to segment ``index``'s surface."""
        return self._solids[index].distance(points)

    def nearest(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Over all surfaces: unsigned distance, closest point, its face in ``mesh.merged()``, that face's segment."""
        tree, vertices, faces, owner = self._surface
        squared, face, closest = tree.squared_distance(vertices, faces, np.ascontiguousarray(points))
        return np.sqrt(squared), closest, face, owner[face]

    def nearest_segment(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """The segment whose surface is nearest."""
        return self.nearest(points)[3]

    def face_normals(self, face: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Unit normals of faces of ``mesh.merged()``."""
        _, vertices, faces, _ = self._surface
        a, b, c = (vertices[faces[face, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


def signed_distance_and_direction(
    solids: Solids, points: Float[np.ndarray, "n 3"], labels: UInt8[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Distance (negative where ``labels`` is not 0) and unit direction to the closest surface point.

    A point on the surface has no direction of its own and takes the face's normal.
    """
    distance, closest, face, _ = solids.nearest(points)
    offset = closest - points
    on_surface = distance < 1e-9 * np.abs(solids.mesh.bounds).max()
    direction = np.where(on_surface[:, None], solids.face_normals(face), offset / np.maximum(distance, 1e-30)[:, None])
    return np.where(labels > 0, -distance, distance), direction


def label_grid(
    mesh: SegmentedMesh, x: Float[np.ndarray, " nx"], y: Float[np.ndarray, " ny"], z: Float[np.ndarray, " nz"]
) -> UInt8[np.ndarray, "nx ny nz"]:
    """Exact labels on the product grid of three ascending coordinate arrays; the first segment wins an overlap.

    Instead of a test per node, every triangle is projected onto the (x, y) columns it covers; along each column the
    signed crossings below a node add up to the winding number there. Parallel to z it is exact for closed meshes.
    """
    labels = np.zeros((len(x), len(y), len(z)), dtype=np.uint8)
    for index, segment in enumerate(mesh.segments):
        lows = [int(np.searchsorted(axis, low)) for axis, low in zip((x, y, z), segment.bounds[0], strict=True)]
        highs = [
            int(np.searchsorted(axis, high, "right")) for axis, high in zip((x, y, z), segment.bounds[1], strict=True)
        ]
        if any(low >= high for low, high in zip(lows, highs, strict=True)):
            continue
        box = tuple(slice(low, high) for low, high in zip(lows, highs, strict=True))
        block = labels[box]
        block[(block == 0) & _winding_grid(segment, x[box[0]], y[box[1]], z[box[2]])] = index + 1
    return labels


def _winding_grid(
    segment: Segment, x: Float[np.ndarray, " nx"], y: Float[np.ndarray, " ny"], z: Float[np.ndarray, " nz"]
) -> Bool[np.ndarray, "nx ny nz"]:
    corners = segment.vertices[segment.faces]
    triangle, i, j = _covered_columns(corners[..., :2], x, y)
    ids, corner = segment.faces[triangle], corners[triangle]
    px, py = x[i], y[j]
    hit = np.ones(len(triangle), dtype=bool)
    weights = np.empty((len(triangle), 3))
    area = _cross2(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        # both triangles of an edge evaluate it from its lower vertex, so that a column is on exactly one side
        swap = ids[:, a] > ids[:, b]
        start = np.where(swap[:, None], corner[:, b], corner[:, a])
        end = np.where(swap[:, None], corner[:, a], corner[:, b])
        value = (end[:, 0] - start[:, 0]) * (py - start[:, 1]) - (end[:, 1] - start[:, 1]) * (px - start[:, 0])
        hit &= ((value >= 0) ^ swap) == (area > 0)
        weights[:, k] = np.where(swap, -value, value)
    hit &= area != 0
    height = (weights[hit] * corner[hit][..., 2]).sum(axis=1) / area[hit]
    crossings = np.zeros((len(x), len(y), len(z) + 1), dtype=np.int32)
    # a face that looks up (positive projected area) is left on the way up
    np.add.at(crossings, (i[hit], j[hit], np.searchsorted(z, height)), np.where(area[hit] > 0, -1, 1))
    return crossings.cumsum(axis=2)[..., :-1] > 0


def _cross2(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _covered_columns(
    corners: Float[np.ndarray, "f 3 2"], x: Float[np.ndarray, " nx"], y: Float[np.ndarray, " ny"]
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Pairs (triangle, column i, column j) whose column lies in the triangle's projected box."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    first_i, first_j = np.searchsorted(x, low[:, 0]), np.searchsorted(y, low[:, 1])
    count_i = np.searchsorted(x, high[:, 0], "right") - first_i
    count_j = np.searchsorted(y, high[:, 1], "right") - first_j
    pairs = count_i * count_j
    triangle = np.repeat(np.arange(len(corners)), pairs)
    number = np.arange(len(triangle)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    return triangle, first_i[triangle] + number // count_j[triangle], first_j[triangle] + number % count_j[triangle]


def check_overlap(mesh: SegmentedMesh, tolerance: float = 1e-3, cells: int = 64) -> None:
    """Raise ``ValueError`` naming two segments whose common volume exceeds ``tolerance`` of the smaller one.

    The common volume is measured on a grid of ``cells`` per axis over the smaller segment's box.
    """
    order = sorted(mesh.segments, key=lambda segment: abs(segment.volume))
    for number, small in enumerate(order):
        low, high = small.bounds
        axes = [low[k] + (np.arange(cells) + 0.5) * (high[k] - low[k]) / cells for k in range(3)]
        alone = label_grid(SegmentedMesh((small,)), *axes) > 0
        for large in order[number + 1 :]:
            if (large.bounds[1] <= low).any() or (large.bounds[0] >= high).any():
                continue
            shared = (alone & (label_grid(SegmentedMesh((large,)), *axes) > 0)).sum() / max(int(alone.sum()), 1)
            if shared > tolerance:
                raise ValueError(
                    f"segments {small.name!r} and {large.name!r} overlap in {100 * shared:.2g} % of {small.name!r}; "
                    f"at most {100 * tolerance:.2g} % is allowed: subtract one from the other "
                    "(for example trimesh.boolean.difference)"
                )
