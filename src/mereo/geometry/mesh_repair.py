"""Meshes made fit: pieces, holes, orientation, self-intersections, overlaps.

``repaired`` does only what a segment needs, in the order of least change, and says what it did. The surface itself is
moved by the last resort alone, a new surface from the winding number, with finer cells where parts are thin. Everything
is deterministic.
"""

from dataclasses import replace
from typing import NamedTuple

import igl
import numpy as np
from jaxtyping import Bool, Int
from manifold3d import Manifold, OpType
from numpy import ndarray
from numpy.linalg import norm
from scipy.spatial import cKDTree

from mereo.geometry.brief import counted
from mereo.geometry.conventions import Names
from mereo.geometry.marching_cubes import CORNERS, changing_cells, nodes_of, zero_surface
from mereo.geometry.mesh import (
    AnyFaces,
    AnyMesh,
    Segment,
    SegmentedMesh,
    area_vectors,
    connected,
    directed_edges,
    edge_imbalance,
    face_corners,
    surface_points,
    three_cornered,
    with_used_vertices,
)
from mereo.geometry.mesh_check import (
    examine,
    faces_astray,
    fragments,
    mesh_of,
    near,
    overlaps,
    pieces,
    solid_of,
)
from mereo.geometry.solids import search_tree
from mereo.geometry.transforms import AnyPoints, Flags, Indices, Subset, Values, Vector, longest_side, unit_rows

MERGED_WITHIN = (1e-6, 1e-4)
"""Vertices of open edges this near to each other, in diagonals of the box, count as one; the less, where it helps."""


class Repair(NamedTuple):
    """Mended mesh and what was done to it, each as a phrase; none where it was sound.

    ``kept`` is the mesh before, without the faces and fragments that were dropped.
    """

    segment: Segment
    changes: Names
    kept: Segment


def repaired(segment: Segment, unit: str = "") -> Repair:
    """Segment mended to a closed solid that faces outwards and does not intersect itself; ``unit`` is for the phrases.

    Raises ``ValueError`` where nothing is left to work with.
    """
    health = examine(segment)
    lost = f"segment {segment.name!r} has no surface that could be repaired: export it again"
    if health.sound:
        return Repair(segment, (), segment)
    if not health.mendable:
        raise ValueError(lost)
    changes = list[str]()
    vertices, faces = kept = segment.vertices, segment.faces
    for step in (_drop_unusable, _merge_near, _drop_fragments, _orient, _fill_holes, _unite, _remesh):
        if changes and len(faces) and examine(replace(segment, vertices=vertices, faces=faces)).sound:
            break
        vertices, faces, change = step(vertices, faces, unit)
        changes += [change] if change else []
        if len(faces) == 0:
            raise ValueError(lost)
        if step in (_drop_unusable, _drop_fragments):
            kept = vertices, faces
    whole = replace(segment, vertices=kept[0], faces=kept[1])
    return Repair(replace(segment, vertices=vertices, faces=faces, solid=True), tuple(changes), whole)


Step = tuple[AnyPoints, AnyFaces, str]


def _drop_unusable(vertices: AnyPoints, faces: AnyFaces, unit: str) -> Step:
    """Faces without place or area, and repeated ones."""
    usable = np.all((faces >= 0) & (faces < len(vertices)), axis=1)
    usable[usable] = np.isfinite(vertices[faces[usable]]).all(axis=(1, 2))
    usable &= three_cornered(faces)
    kept = faces[usable]
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    kept = kept[np.sort(first)]
    dropped = len(faces) - len(kept)
    change = f"dropped {counted(dropped, 'unusable or repeated face')}" if dropped else ""
    return *with_used_vertices(vertices, kept), change


def _merge_near(vertices: AnyPoints, faces: AnyFaces, unit: str) -> Step:
    """Vertices of open edges that are nearly the same, where that closes edges."""
    diagonal = float(norm(np.ptp(vertices, axis=0)))
    best = (vertices, faces)
    fewest = len(open_edges(vertices, faces))
    change = ""
    for distance in (share * diagonal for share in MERGED_WITHIN):
        if fewest:
            merged = _merged(vertices, faces, distance)
            left = len(open_edges(*merged))
            if left < fewest:
                best, fewest = merged, left
                change = f"merged {len(vertices) - len(merged[0])} vertices within {distance:.2g}{unit and f' {unit}'}"
    return *best, change


def _merged(vertices: AnyPoints, faces: AnyFaces, distance: float) -> AnyMesh:
    rim = np.unique(open_edges(vertices, faces))
    pairs = rim[cKDTree(vertices[rim]).query_pairs(distance, output_type="ndarray")].reshape(-1, 2)
    group = connected(pairs, len(vertices))
    _, first = np.unique(group, return_index=True)
    merged = group[faces]
    return vertices[first], merged[three_cornered(merged)]


def _drop_fragments(vertices: AnyPoints, faces: AnyFaces, unit: str) -> Step:
    stray, what = fragments(vertices, faces, unit)
    if not stray.any():
        return vertices, faces, ""
    return *with_used_vertices(vertices, faces[~stray]), f"removed {what}"


def _orient(vertices: AnyPoints, faces: AnyFaces, unit: str) -> Step:
    """Neighbours agree, and each patch faces outwards; nothing where that is so, for a cavity's wall faces inwards."""
    if not faces_astray(vertices, faces):
        return vertices, faces, ""
    turned, patch = igl.bfs_orient(faces.astype(np.int64))
    turned = turned.astype(np.int64)  # C's long long, which numpy tells apart
    corners = vertices[turned]
    count = np.bincount(patch)
    middle = np.stack([np.bincount(patch, corners[:, :, k].mean(axis=1)) for k in range(3)], axis=1) / count[:, None]
    a, b, c = np.moveaxis(corners - middle[patch, None], 1, 0)  # about its middle, so that holes matter little
    inwards = (np.bincount(patch, np.einsum("ij,ij->i", a, np.cross(b, c))) < 0)[patch]
    turned[inwards] = turned[inwards, ::-1]
    same = np.any([(np.roll(turned, k, axis=1) == faces).all(axis=1) for k in range(3)], axis=0)
    changed = int((~same).sum())
    return vertices, turned, f"turned {changed} faces around" if changed else ""


def _fill_holes(vertices: AnyPoints, faces: AnyFaces, unit: str) -> Step:
    closed = close_holes(vertices, faces)
    holes = len(closed[0]) - len(vertices)
    added = len(closed[1]) - len(faces)
    return *closed, f"filled {holes} {'hole' if holes == 1 else 'holes'} with {added} faces" if holes else ""


def _unite(vertices: AnyPoints, faces: AnyFaces, unit: str) -> Step:
    """Closed shells that reach into each other become one; shells that face inwards in others are cut out as cavities.

    Those that face inwards and lie outside are turned around.
    """
    try:
        solid = solid_of(vertices, faces)
    except ValueError:
        return vertices, faces, ""
    area = float(norm(area_vectors(vertices, faces), axis=1).sum()) / 2
    if solid.surface_area() < 0.99 * area:  # manifold3d leaves out what has no volume
        return vertices, faces, ""
    shells = solid.decompose()
    if not 1 < len(shells) <= 300:  # more are debris, and their union would take minutes
        return vertices, faces, ""
    filled = [shell for shell in shells if shell.volume() > 0]
    hollow = [solid_of(v, f[:, ::-1]) for v, f in (mesh_of(shell) for shell in shells if shell.volume() < 0)]
    united = Manifold.batch_boolean(filled, OpType.Add)
    outside = [shell for shell in hollow if (shell ^ united).volume() < 0.5 * shell.volume()]
    for shell in hollow:
        united = united + shell if shell in outside else united - shell
    turned = f", of which {len(outside)} outside the others faced inwards" if outside else ""
    return *mesh_of(united), f"united {len(shells)} shells that overlap{turned}"


# --- a new surface ----------------------------------------------------------------------------------------------------

# In cells: one is 1 / CELLS of the longest side. Places of finer cells are multiples of powers of two, so that Booleans
# along them are exact.

CELLS, FINER, LEVELS = 128, 4, 3
"""Cells along the longest side, those of each level along one of the level before, and levels of finer ones."""

MOST_BLOCKS = 300
"""Blocks of 16 x 16 x 16 finer cells in a level, for time and memory."""

FAR = 1.0
"""Distance that the old surface may reach out of the new one, in cells: sharp edges are rounded by up to this."""

MOST_SAMPLES = 100_000


def _remesh(vertices: AnyPoints, faces: AnyFaces, unit: str) -> Step:
    """A new surface where the winding number is one half, smooth because it is found by distances near the old one."""
    low = vertices.min(axis=0)
    step = longest_side(vertices) / CELLS
    body = _Body((vertices - low) / step + 2.5, faces)
    solid, cell, lost = _with_thin_parts(body, _even_surface(body))
    behind = unit and f" {unit}"
    change = f"made a new surface from the winding number; details below {2 * step:.2g}{behind} are lost"
    if cell < 1:
        change += f", in thin places those below {2 * cell * step:.2g}{behind}"
    if lost:
        where = f"{near((lost[1] - 2.5) * step + low, unit)}, {lost[0] * step:.2g}{behind} from it"
        places, face = surface_points(body.vertices, body.faces, MOST_SAMPLES)
        normals = unit_rows(area_vectors(body.vertices, body.faces))
        share = 100 * _cut_off(body, solid, places, normals[face])[1].mean()
        change += f"; also lost is {share:.2g} % of the surface, which lies {where}, too thin or inside out: thicken "
        change += "it, turn its faces around, or make it a segment of its own, which has finer cells"
    corners, triangles = mesh_of(solid)
    return (corners - 2.5) * step + low, triangles, change


class _Body:
    """A mesh in cells: which places it encloses, and how far they are from it."""

    def __init__(self, vertices: AnyPoints, faces: AnyFaces) -> None:
        self.vertices, self.faces = np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64)
        self._closed = edge_imbalance(faces) == (0, 0)
        self._tree = search_tree(self.vertices, self.faces)

    def inside(self, places: AnyPoints) -> Flags:
        """Whether the mesh winds around each place."""
        return igl.fast_winding_number(self.vertices, self.faces, places) > 0.5

    def distance(self, places: AnyPoints) -> Values:
        """Distance from the surface."""
        return np.sqrt(self._tree.squared_distance(self.vertices, self.faces, places)[0])

    def inside_blocks(self, first: Int[ndarray, "b 3"], cell: float) -> Bool[ndarray, "b 64"]:
        """The same for 4 x 4 x 4 nodes from ``first`` on, in cells of a size: far blocks are all in or all out."""
        middle = (first + 1.5) * cell
        winding = igl.fast_winding_number(self.vertices, self.faces, middle)
        # of a mesh with holes the winding number is one half away from the surface, too
        close = (self.distance(middle) < 1.51 * np.sqrt(3) * cell) | (np.abs(winding - 0.5) < 0.3)
        inside = np.repeat(winding[:, None] > 0.5, 64, axis=1)
        places = ((first[close, None] + NODES) * cell).reshape(-1, 3)
        inside[close] = (self._inside_parts(places, cell) if self._closed else self.inside(places)).reshape(-1, 64)
        return inside

    def _inside_parts(self, nodes: AnyPoints, cell: float) -> Flags:
        """The same for nodes of whole blocks: one winding number, which is slow, for all nodes that none parts.

        No surface lies between neighbours if the sum of their distances from it is more than their distance.
        """
        distance = self.distance(nodes)
        pairs = (64 * np.arange(len(nodes) // 64)[:, None, None] + NEIGHBOURS).reshape(-1, 2)
        pairs = pairs[distance[pairs].sum(axis=1) > 1.001 * cell]
        part = connected(pairs, len(nodes))
        order = np.argsort(-distance, kind="stable")
        _, first = np.unique(part[order], return_index=True)
        return self.inside(nodes[order[first]])[part]

    def samples(
        self, faces: Subset, spacing: float, around: AnyPoints | None = None
    ) -> tuple[AnyPoints, AnyPoints, Indices]:
        """Corners of some faces and places about ``spacing`` apart, the normal there, and the face of each.

        Where ``around`` is given, only those within four cells of it.
        """
        chosen = self.faces[faces]
        corners = self.vertices[chosen]
        normal = area_vectors(self.vertices, chosen)
        area = norm(normal, axis=1)
        normal /= np.maximum(area, 1e-300)[:, None]
        most = int(np.clip(area.sum() / 2 / spacing**2, 1000, MOST_SAMPLES))
        spread, face = surface_points(self.vertices, chosen, most)
        _, first = np.unique(chosen, return_index=True)
        edges = np.roll(corners, -1, axis=1) - corners  # along which a thin part has places, however small its area is
        count = np.ceil(norm(edges, axis=2) / spacing).astype(int).ravel()
        row = np.repeat(np.arange(len(count)), np.where(count > 1, np.minimum(count, 1000), 0))
        share = (np.arange(len(row)) - np.searchsorted(row, row)) / np.minimum(count, 1000)[row]
        along = corners.reshape(-1, 3)[row] + share[:, None] * edges.reshape(-1, 3)[row]
        places = np.concatenate([corners.reshape(-1, 3)[first], along, spread])
        face = np.concatenate([first // 3, row // 3, face])
        kept = np.arange(len(face)) if around is None else np.flatnonzero(_within(places, around, 4.0))
        kept = kept[:: 1 + len(kept) // MOST_SAMPLES]
        return places[kept], normal[face[kept]], faces[face[kept]]


NODES = np.indices((4, 4, 4)).reshape(3, -1).T

NEIGHBOURS = np.argwhere(np.triu(np.abs(NODES[:, None] - NODES).sum(axis=2) == 1))
"""Pairs of nodes of a block."""


def _even_surface(body: _Body) -> Manifold:
    """Surface from cells of one size."""
    shape = np.ceil(body.vertices.max(axis=0) + 2.5 - 1e-9).astype(int)
    blocks = -(-shape // 4)
    first = 4 * np.indices(blocks).reshape(3, -1).T
    inside = body.inside_blocks(first, 1.0).reshape(*blocks, 4, 4, 4).transpose(0, 3, 1, 4, 2, 5)
    inside = inside.reshape(4 * blocks)[: shape[0], : shape[1], : shape[2]]
    if not inside.any():
        return Manifold()
    nodes = np.argwhere(nodes_of(changing_cells(inside)))
    field = np.where(inside, 1.0, -1.0)
    field[tuple(nodes.T)] *= np.clip(body.distance(nodes.astype(float)), 1e-3, 1)
    return solid_of(*zero_surface(field)).simplify(0.2)


def _with_thin_parts(body: _Body, solid: Manifold) -> tuple[Manifold, float, tuple[float, Vector] | None]:
    """Solid with finer cells where the old surface is far from it; the least cell; the most still lost, and where.

    What is thin breaks into dashes before it vanishes. They are near it, so shells of few cells do not count.
    """
    cell = 1.0
    faces = np.arange(len(body.faces))
    centres = None
    last = LEVELS
    for level in range(LEVELS + 1):
        places, normals, face = body.samples(faces, 2.0 * FINER**-level, centres)
        whole = _without_specks(solid, 8.0 * FINER**-level)
        way, seeds = _cut_off(body, whole, places, normals)
        if level == last or not seeds.any():
            break
        finer = FINER ** -(level + 1.0)
        # a tube of this diameter stays whole
        resolved = np.flatnonzero(seeds)[body.inside(places[seeds] - 2 * finer * normals[seeds])]
        centres = places[seeds]
        faces = np.unique(face[_within(places, centres, 4.0)])
        if len(resolved):
            chosen = np.flatnonzero(_within(places, places[resolved], 2.0) & (way > 0.5 * FINER * finer))
            blocks = _blocks(places[chosen], way[chosen], 16 * finer, FINER * finer)
            if len(blocks) > MOST_BLOCKS:  # of finer cells there would be even more
                blocks = blocks[:MOST_BLOCKS]
                last = level + 1
            cube = Manifold.cube((16 * finer,) * 3)
            corners = (blocks * 16 * finer).tolist()
            region = Manifold.batch_boolean([cube.translate(c) for c in corners], OpType.Add)
            solid = (whole - region) + (_fine_surface(body, blocks, finer) ^ region)
            cell = finer
    worst = int(np.where(seeds, way, -1.0).argmax())
    lost = (float(way[worst]), places[worst]) if seeds.any() else None
    return whole.simplify(0.01 * cell) if cell < 1 else solid, cell, lost


def _within(places: AnyPoints, of: AnyPoints, distance: float) -> Flags:
    """Whether a place lies as near to any of the others."""
    return cKDTree(of).query(places, distance_upper_bound=distance)[0] < distance


def _without_specks(solid: Manifold, side: float) -> Manifold:
    """Solid without shells and cavities of less volume than a cube of a side."""
    shells = solid.decompose()
    kept = [shell for shell in shells if abs(shell.volume()) > side**3]
    return solid if len(kept) == len(shells) else Manifold.compose(kept)


def _blocks(places: AnyPoints, way: Values, side: float, margin: float) -> Int[ndarray, "b 3"]:
    """Blocks of a lattice with a margin around places, those around the largest ``way`` first."""
    shifts = margin * (np.indices((3, 3, 3)).reshape(3, -1).T - 1)
    order = np.argsort(-way, kind="stable")
    touched = np.floor((places[order, None] + shifts) / side).astype(np.int64).reshape(-1, 3)
    blocks, first = np.unique(touched, axis=0, return_index=True)
    return blocks[np.argsort(first)]


def _fine_surface(body: _Body, blocks: Int[ndarray, "b 3"], cell: float) -> Manifold:
    """Surface within blocks of 16 x 16 x 16 cells and one cell around; it is closed along their outside."""
    parts = (4 * blocks[:, None] + np.indices((5, 5, 5)).reshape(3, -1).T).reshape(-1, 3)
    first = 4 * np.unique(parts, axis=0) - 1
    nodes = (first[:, None] + NODES).reshape(-1, 3)
    inside = body.inside_blocks(first, cell).reshape(-1)
    width = np.array([1 << 42, 1 << 21, 1])
    keys = (nodes + (1 << 19)) @ width
    order = np.argsort(keys)
    place = np.minimum(np.searchsorted(keys, keys[:, None] + CORNERS @ width, sorter=order), len(keys) - 1)
    corners = order[place]
    whole = (keys[corners] == keys[:, None] + CORNERS @ width).all(axis=1)
    corners = corners[whole]
    inside &= np.bincount(corners.ravel(), minlength=len(nodes)) == 8
    count = inside[corners].sum(axis=1)
    corners = corners[(count > 0) & (count < 8)]
    used, corners = np.unique(corners, return_inverse=True)
    if len(used) == 0:
        return Manifold()
    places = nodes[used] * cell
    field = np.clip(body.distance(places), 1e-3 * cell, cell) * np.where(inside[used], 1.0, -1.0)
    vertices, faces = igl.marching_cubes(field, places, corners.reshape(-1, 8).astype(np.int64), 0.0)[:2]
    return solid_of(vertices, faces.astype(np.int64)).simplify(0.2 * cell)


def _cut_off(body: _Body, solid: Manifold, places: AnyPoints, normals: AnyPoints) -> tuple[Values, Flags]:
    """Distances from a new solid, and whether a place lies far out of it; a narrow gap that it closes is no loss."""
    if solid.is_empty():
        return np.full(len(places), np.inf), np.ones(len(places), bool)
    made = _Body(*mesh_of(solid))
    way = made.distance(places)
    far = np.flatnonzero(way > FAR)
    far = far[~made.inside(places[far])]
    far = far[~body.inside(places[far] + 1e-3 * normals[far])]  # a union has nothing of what lies within
    return way, np.isin(np.arange(len(places)), far)


# --- fewer faces ------------------------------------------------------------------------------------------------------

MOST_FACES = 100_000
WITHIN = (2.5e-4, 5e-4, 1e-3)
"""Faces of a solid that all later work takes as they are; how far simpler ones may be, in longest sides: the first that
leaves few enough, else the last."""


def simplified(segment: Segment) -> tuple[Segment, float]:
    """Solid of fewer faces, and how far the given surface is from it at most; itself and 0 where ``MOST_FACES`` do.

    What is no solid stays as it is.
    """
    if len(segment.faces) <= MOST_FACES:
        return segment, 0.0
    try:
        solid = solid_of(segment.vertices, segment.faces)
    except ValueError:
        return segment, 0.0
    for share in WITHIN:
        vertices, faces = mesh_of(solid.simplify(share * longest_side(segment.vertices)))
        if len(faces) <= MOST_FACES:
            break
    fewer = replace(segment, vertices=vertices, faces=faces)
    return fewer, max(way for way, _ in farthest(segment, fewer))


# --- what a repair moved ----------------------------------------------------------------------------------------------

Reach = tuple[float, Vector]
"""A distance, and the place where it is."""


def farthest(before: Segment, after: Segment) -> tuple[Reach, Reach]:
    """Largest distance of a surface from another one, where it lies out of that, and where it lies within.

    Parts of the first surface that lie within the first mesh itself do not count. Measured at the corners and at up to
    100,000 places between.
    """
    body, other = _Body(before.vertices, before.faces), _Body(after.vertices, after.faces)
    length = float(norm(np.ptp(before.vertices, axis=0)))
    places, normals, _ = body.samples(np.arange(len(before.faces)), length / 300)
    way = other.distance(places)
    reach = dict[bool, Reach]()
    # the farthest first, for winding numbers of all places would take longer than their distances
    for rows in np.array_split(np.argsort(-way, kind="stable"), 64):
        outer = rows[~body.inside(places[rows] + 1e-4 * length * normals[rows])]
        for row, within in zip(outer.tolist(), other.inside(places[outer]).tolist(), strict=True):
            reach.setdefault(within, (float(way[row]), places[row]))
        if len(reach) == 2 or (len(rows) and way[rows[-1]] < 1e-4 * length):
            break
    return reach.get(False, (0.0, places[0])), reach.get(True, (0.0, places[0]))


# --- segments together ------------------------------------------------------------------------------------------------


def without_overlaps(mesh: SegmentedMesh) -> tuple[SegmentedMesh, dict[str, list[str]]]:
    """Mesh with each overlap cut from the larger segment, and what was done to which segment.

    What sticks out of a segment that it is nested in is cut off. All segments must be solids.
    """
    segments = {segment.name: segment for segment in mesh.segments}
    changes = dict[str, list[str]]()
    for overlap in overlaps(mesh):
        pair = segments[overlap.small], segments[overlap.large]
        small, large = (solid_of(segment.vertices, segment.faces) for segment in pair)
        changed = overlap.small if overlap.nested else overlap.large
        cut = small ^ large if overlap.nested else large - small
        if cut.is_empty():
            raise ValueError(
                f"segment {changed!r} lies within {overlap.small!r}; nothing of it would be left: remove one"
            )
        vertices, faces, flecks = _without_flecks(*mesh_of(cut))
        segments[changed] = replace(segments[changed], vertices=vertices, faces=faces)
        what = f"cut off what reached out of {overlap.large!r}" if overlap.nested else f"cut out {overlap.small!r}"
        changes.setdefault(changed, []).append(what + flecks)
    return replace(mesh, segments=tuple(segments.values())), changes


def _without_flecks(vertices: AnyPoints, faces: AnyFaces) -> Step:
    """Mesh without pieces of hardly any volume: Booleans of meshes that nearly touch leave them."""
    piece = pieces(faces, len(vertices))
    a, b, c = face_corners(vertices - vertices.mean(axis=0), faces)
    volume = np.abs(np.bincount(piece, weights=np.einsum("ij,ij->i", a, np.cross(b, c))))
    kept = volume > 1e-5 * volume.max()
    share = 100 * volume[~kept].sum() / volume.sum()
    dropped = f" and dropped {counted(int((~kept).sum()), 'fleck')}, {share:.2g} % of it" if not kept.all() else ""
    return *with_used_vertices(vertices, faces[kept[piece]]), dropped


# --- the largest piece, and holes -------------------------------------------------------------------------------------


def largest_piece(vertices: AnyPoints, faces: AnyFaces) -> AnyMesh:
    """Piece of the most faces; unused vertices are left out."""
    piece = pieces(faces, len(vertices))
    return with_used_vertices(vertices, faces[piece == np.bincount(piece).argmax()])


def open_edges(vertices: AnyPoints, faces: AnyFaces) -> Int[ndarray, "_ 2"]:
    """Directed edges that no face takes the other way, in the order of faces."""
    directed = directed_edges(faces)
    forth, back = directed @ [len(vertices), 1], directed @ [1, len(vertices)]
    return directed[~np.isin(forth, back)]


def close_holes(vertices: AnyPoints, faces: AnyFaces) -> AnyMesh:
    """Mesh whose open loops are closed by fans around the mean of their vertices; a closed mesh stays as it is."""
    rim = open_edges(vertices, faces)
    if len(rim) == 0:
        return vertices, faces
    owner = connected(rim.reshape(-1, 2), len(vertices))[rim[:, 0]]
    order = np.argsort(owner, kind="stable")
    loops = np.split(rim[order], np.flatnonzero(np.diff(owner[order])) + 1)
    middles = [vertices[loop[:, :1]].mean(axis=0) for loop in loops]
    tips = np.repeat(len(vertices) + np.arange(len(loops)), list(map(len, loops)))
    fans = np.stack([rim[order, 1], rim[order, 0], tips], axis=1)
    return np.concatenate([vertices, *middles]), np.concatenate([faces, fans])
