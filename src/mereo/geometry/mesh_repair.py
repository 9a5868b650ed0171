"""Meshes made fit: pieces, holes, orientation, self-intersections, overlaps.

``repaired`` does only what a segment needs, in the order of least change, and says what it did. The surface itself is
moved by the last resort alone, a new surface from the winding number. Everything is deterministic.
"""

from dataclasses import dataclass, replace

import igl
import manifold3d
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.mesh_check import Faces, Vertices, examine, faces_astray, mesh_of, overlaps, solid_of

MERGED_WITHIN = (1e-6, 1e-4)
"""Vertices of open edges this near to each other, in diagonals of the box, count as one; the less, where it helps."""


@dataclass(frozen=True, eq=False)
class Repair:
    """Mended mesh and what was done to it, each as a phrase; none where it was sound."""

    segment: Segment
    changes: tuple[str, ...]


def repaired(segment: Segment) -> Repair:
    """Segment mended to a closed solid that faces outwards and does not intersect itself.

    Raises ``ValueError`` where nothing is left to work with.
    """
    if examine(segment).sound:
        return Repair(segment, ())
    changes: list[str] = []
    vertices, faces = segment.vertices, segment.faces
    for step in (_drop_unusable, _merge_near, _drop_fragments, _orient, _fill_holes, _unite, _remesh):
        if changes and len(faces) and examine(replace(segment, vertices=vertices, faces=faces)).sound:
            break
        vertices, faces, change = step(vertices, faces)
        changes += [change] if change else []
        if len(faces) == 0:
            raise ValueError(f"segment {segment.name!r} has no surface that could be repaired: export it again")
    return Repair(replace(segment, vertices=vertices, faces=faces, solid=True), tuple(changes))


Step = tuple[Vertices, Faces, str]


def _drop_unusable(vertices: Vertices, faces: Faces) -> Step:
    """Faces without place or area, and repeated ones."""
    usable = np.all((faces >= 0) & (faces < len(vertices)), axis=1)
    usable[usable] = np.isfinite(vertices[faces[usable]]).all(axis=(1, 2))
    usable &= (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    kept = faces[usable]
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    kept = kept[np.sort(first)]
    dropped = len(faces) - len(kept)
    used, kept = np.unique(kept, return_inverse=True)  # flat before numpy 2
    return vertices[used], kept.reshape(-1, 3), f"dropped {dropped} unusable or repeated faces" if dropped else ""


def _merge_near(vertices: Vertices, faces: Faces) -> Step:
    """Vertices of open edges that are nearly the same, where that closes edges."""
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    best, fewest, change = (vertices, faces), len(open_edges(vertices, faces)), ""
    for distance in (share * diagonal for share in MERGED_WITHIN):
        if fewest:
            merged = _merged(vertices, faces, distance)
            left = len(open_edges(*merged))
            if left < fewest:
                best, fewest = merged, left
                change = f"merged {len(vertices) - len(merged[0])} vertices within {distance:.2g}"
    return *best, change


def _merged(vertices: Vertices, faces: Faces, distance: float) -> tuple[Vertices, Faces]:
    rim = np.unique(open_edges(vertices, faces))
    pairs = rim[cKDTree(vertices[rim]).query_pairs(distance, output_type="ndarray")].reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(vertices),) * 2)
    _, group = connected_components(graph, directed=False)
    _, first = np.unique(group, return_index=True)
    merged = group.astype(np.int64)[faces]
    return vertices[first], merged[(merged != np.roll(merged, 1, axis=1)).all(axis=1)]


def _drop_fragments(vertices: Vertices, faces: Faces) -> Step:
    piece = pieces(faces, len(vertices))
    corners = vertices[faces]
    low, high = np.full((piece.max() + 1, 3), np.inf), np.full((piece.max() + 1, 3), -np.inf)
    np.minimum.at(low, piece, corners.min(axis=1))
    np.maximum.at(high, piece, corners.max(axis=1))
    whole = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    stray = np.linalg.norm(high - low, axis=1) < 0.02 * whole
    if not stray.any() or stray.all():
        return vertices, faces, ""
    used, kept = np.unique(faces[~stray[piece]], return_inverse=True)
    lost = int(stray[piece].sum())
    return vertices[used], kept.reshape(-1, 3), f"removed {int(stray.sum())} fragments ({lost} faces)"


def _orient(vertices: Vertices, faces: Faces) -> Step:
    """Neighbours agree, and each patch faces outwards; nothing where that is so, for a cavity's wall faces inwards."""
    if not faces_astray(vertices, faces):
        return vertices, faces, ""
    turned, patch = igl.bfs_orient(faces.astype(np.int64))
    turned = turned.astype(np.int64)  # C's long long, which numpy tells apart
    for index in range(int(patch.max()) + 1):
        members = patch == index
        if _signed_volume(vertices, turned[members]) < 0:
            turned[members] = turned[members][:, ::-1]
    same = np.any([(np.roll(turned, k, axis=1) == faces).all(axis=1) for k in range(3)], axis=0)
    changed = int((~same).sum())
    return vertices, turned, f"turned {changed} faces around" if changed else ""


def _signed_volume(vertices: Vertices, faces: Faces) -> float:
    """Volume about the middle of the patch, so that holes matter little."""
    a, b, c = (vertices[faces[:, k]] - vertices[faces].mean(axis=(0, 1)) for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)))


def _fill_holes(vertices: Vertices, faces: Faces) -> Step:
    closed = close_holes(vertices, faces)
    holes = len(closed[0]) - len(vertices)
    added = len(closed[1]) - len(faces)
    return *closed, f"filled {holes} {'hole' if holes == 1 else 'holes'} with {added} faces" if holes else ""


def _unite(vertices: Vertices, faces: Faces) -> Step:
    """Closed shells that reach into each other become one; shells that face inwards are cavities, and are cut out."""
    try:
        solid = solid_of(vertices, faces)
    except ValueError:
        return vertices, faces, ""
    shells = solid.decompose()
    if not 1 < len(shells) <= 300:  # more are debris, and their union would take minutes
        return vertices, faces, ""
    filled = [shell for shell in shells if shell.volume() > 0]
    hollow = [solid_of(v, f[:, ::-1]) for v, f in (mesh_of(shell) for shell in shells if shell.volume() < 0)]
    united = manifold3d.Manifold.batch_boolean(filled, manifold3d.OpType.Add)
    united -= manifold3d.Manifold.batch_boolean(hollow, manifold3d.OpType.Add)
    return *mesh_of(united), f"united {len(shells)} shells that overlap"


def _remesh(vertices: Vertices, faces: Faces) -> Step:
    """A new surface where the winding number is one half, smooth because it is found by distances near the old one."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = float((high - low).max()) / 128
    axes = [np.arange(low[k] - 2.5 * step, high[k] + 2.5 * step, step) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = igl.fast_winding_number(vertices, faces.astype(np.int64), nodes) > 0.5
    squared = _near_squared(vertices, faces, nodes, inside.reshape([len(axis) for axis in axes]), step)
    field = np.clip(np.sqrt(squared), 1e-3 * step, step) * np.where(inside, 1.0, -1.0)
    shape = [len(axis) for axis in axes]
    corners, triangles, _, _ = marching_cubes(field.reshape(shape), 0.0, gradient_direction="ascent")
    solid = solid_of(corners.astype(np.float64) * step + [axis[0] for axis in axes], triangles.astype(np.int64))
    solid = solid.simplify(0.2 * step)
    return *mesh_of(solid), f"made a new surface from the winding number; details below {2 * step:.2g} are lost"


def _near_squared(
    vertices: Vertices, faces: Faces, nodes: Vertices, inside: Bool[np.ndarray, "a b c"], step: float
) -> Float[np.ndarray, " n"]:
    """Squared distances of the nodes at which ``inside`` changes; elsewhere they do not matter."""
    near = np.zeros_like(inside)
    for axis in range(3):
        change = np.diff(inside, axis=axis)
        for side in (slice(None, -1), slice(1, None)):
            index = tuple(side if k == axis else slice(None) for k in range(3))
            near[index] |= change
    squared = np.full(len(nodes), step**2)
    tree = igl.AABB()
    tree.init(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, dtype=np.int64))
    rows = np.flatnonzero(near)
    squared[rows] = tree.squared_distance(vertices, faces.astype(np.int64), nodes[rows])[0]
    return squared


# --- segments together ------------------------------------------------------------------------------------------------


def without_overlaps(mesh: SegmentedMesh) -> tuple[SegmentedMesh, dict[str, list[str]]]:
    """Mesh with each overlap cut from the larger segment, and what was done to which segment.

    What sticks out of a segment that it is nested in is cut off. All segments must be solids.
    """
    segments = {segment.name: segment for segment in mesh.segments}
    changes: dict[str, list[str]] = {}
    for overlap in overlaps(mesh):
        small, large = (
            solid_of(segments[name].vertices, segments[name].faces) for name in (overlap.small, overlap.large)
        )
        changed = overlap.small if overlap.nested else overlap.large
        cut = small ^ large if overlap.nested else large - small
        if cut.is_empty():
            raise ValueError(
                f"segment {changed!r} lies within {overlap.small!r}; nothing of it would be left: remove one"
            )
        vertices, faces = _without_flecks(*mesh_of(cut))
        segments[changed] = replace(segments[changed], vertices=vertices, faces=faces)
        what = f"cut off what reached out of {overlap.large!r}" if overlap.nested else f"cut out {overlap.small!r}"
        changes.setdefault(changed, []).append(what)
    return replace(mesh, segments=tuple(segments.values())), changes


def _without_flecks(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Mesh without pieces of hardly any volume: Booleans of meshes that nearly touch leave them."""
    piece = pieces(faces, len(vertices))
    a, b, c = (vertices[faces[:, k]] - vertices.mean(axis=0) for k in range(3))
    volume = np.abs(np.bincount(piece, weights=np.einsum("ij,ij->i", a, np.cross(b, c))))
    used, kept = np.unique(faces[(volume > 1e-5 * volume.max())[piece]], return_inverse=True)
    return vertices[used], kept.reshape(-1, 3)


# --- pieces and holes -------------------------------------------------------------------------------------------------


def pieces(faces: Faces, vertices: int) -> Int[np.ndarray, " f"]:
    """Number of the piece of each face; a piece is connected over edges which exactly two of its faces share."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1) @ [vertices, 1]
    order = np.argsort(edges, kind="stable")
    _, first, uses = np.unique(edges[order], return_index=True, return_counts=True)
    pair = np.stack([order[first[uses == 2]], order[first[uses == 2] + 1]]) // 3
    graph = coo_array((np.ones(pair.shape[1]), pair), shape=(len(faces), len(faces)))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def largest_piece(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Piece of the most faces; unused vertices are left out."""
    piece = pieces(faces, len(vertices))
    used, kept = np.unique(faces[piece == np.bincount(piece).argmax()], return_inverse=True)
    return vertices[used], kept.reshape(-1, 3)


def open_edges(vertices: Vertices, faces: Faces) -> Int[np.ndarray, "_ 2"]:
    """Directed edges that no face takes the other way, in the order of faces."""
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forth, back = directed @ [len(vertices), 1], directed @ [1, len(vertices)]
    return directed[~np.isin(forth, back)]


def close_holes(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Mesh whose open loops are closed by fans around the mean of their vertices; a closed mesh stays as it is."""
    rim = open_edges(vertices, faces)
    graph = coo_array((np.ones(len(rim)), rim.reshape(-1, 2).T), shape=(len(vertices),) * 2)
    _, group = connected_components(graph, directed=False)
    for index in np.unique(group[rim[:, 0]]):
        loop = rim[group[rim[:, 0]] == index]
        fan = np.stack([loop[:, 1], loop[:, 0], np.full(len(loop), len(vertices))], axis=1)
        vertices = np.concatenate([vertices, vertices[loop[:, :1]].mean(axis=0)])
        faces = np.concatenate([faces, fan])
    return vertices, faces
