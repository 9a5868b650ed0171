"""The sheet at rest: one triangulated plan, thickened by height profiles and cut into patches along its seams.

All patches come from one triangulation of the plan, so neighbours share the vertices and the triangles of their common
wall exactly. Lengths are scene units; the plan lies in z = 0, the studs are on the +z side.
"""

from functools import cache
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay, cKDTree

from mereo.deformation.maps import smooth_step
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh, with_used_vertices
from mereo.geometry.read_only import read_only

LENGTH, WIDTH = 52.0, 38.0
COLUMNS, ROWS = 3, 2
HALF = read_only(np.array([LENGTH / 2, WIDTH / 2]))
CORNER = 4.0
"""Radius of the rounded corners."""

THICKNESS = 1.7
HEM_WIDTH, HEM_RISE = 2.6, 0.4
SEAM_WIDTH, SEAM_DEPTH = 0.9, 0.45
STUD_RISE = 0.65
LARGEST_OFFSET = THICKNESS / 2 + max(HEM_RISE, STUD_RISE)
"""No point of the sheet is farther from its middle surface."""

SPACING = 1.9
"""Of the plan's points, where no detail asks for more."""

TAB_LENGTH = 7.0
TAB_ROWS = (4.0, 12.6)
"""How far the tab reaches out of the sheet's +x edge, and the range of y whose rows of points it takes up."""

DETAIL_RADIUS = 1.4
DETAIL_SIDES = 10
STUD_TOP = 0.55
"""Share of a stud's radius that is flat."""

COLUMN_LENGTH, ROW_WIDTH = LENGTH / COLUMNS, WIDTH / ROWS


def _detail_centers(column: int, row: int) -> Float[np.ndarray, "k 2"]:
    """Three by three places in a patch, clear of its seams and of the hem."""
    low = np.array([column * COLUMN_LENGTH, row * ROW_WIDTH]) - HALF
    grid = np.stack(np.meshgrid([0.24, 0.5, 0.76], [0.26, 0.5, 0.74], indexing="ij"), axis=-1).reshape(-1, 2)
    middle = low + grid * np.array([COLUMN_LENGTH, ROW_WIDTH])
    # towards the sheet's middle by half of the hem, which the outer patches carry on one or two sides
    border = np.array([(column == 0) - float(column == COLUMNS - 1), (row == 0) - float(row == ROWS - 1)])
    return middle + 0.4 * HEM_WIDTH * border


def _centers(remainder: int) -> Float[np.ndarray, "k 2"]:
    """Centres of the details in every second patch, like the fields of a chessboard."""
    fields = [(c, r) for c in range(COLUMNS) for r in range(ROWS) if (c + r) % 2 == remainder]
    return np.concatenate([_detail_centers(column, row) for column, row in fields])


COLORS = (*PALETTE[: COLUMNS * ROWS], PALETTE[7])
STUDS, HOLES = _centers(0), _centers(1)


def _ring(center: Float[np.ndarray, "2"], radius: float) -> Float[np.ndarray, "k 2"]:
    angle = 2 * np.pi * (np.arange(DETAIL_SIDES) + 0.5) / DETAIL_SIDES
    return center + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _ticks(half: float, parts: int) -> Float[np.ndarray, " n"]:
    """Coordinates along one side: close together at hems and seams, about ``SPACING`` apart between them."""
    hem = half - np.array([0.0, 0.5, 1.6, HEM_WIDTH])
    seams = np.linspace(-half, half, parts + 1)[1:-1]
    fixed = np.concatenate([-hem, hem, *([seam - SEAM_WIDTH, seam, seam + SEAM_WIDTH] for seam in seams)])
    fixed = np.sort(fixed)
    gaps = [np.linspace(a, b, int(np.ceil((b - a) / SPACING)) + 1)[1:] for a, b in pairwise(fixed)]
    return np.concatenate([fixed[:1], *gaps])


def _product(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"]) -> Float[np.ndarray, "k 2"]:
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


@cache
def _tab_rows() -> Float[np.ndarray, " r"]:
    """The rows of the sheet's edge from which the tab goes on."""
    y = _ticks(HALF[1], ROWS)
    return read_only(y[(y > TAB_ROWS[0]) & (y < TAB_ROWS[1])])


def _tab_box() -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Middle of its root, and its length and half width."""
    low, high = _tab_rows()[[0, -1]]
    return np.array([HALF[0], (low + high) / 2]), np.array([TAB_LENGTH, (high - low) / 2])


def _hole_centers() -> Float[np.ndarray, "k 2"]:
    """The patches' holes and the tab's eyelet."""
    root, size = _tab_box()
    return np.concatenate([HOLES, (root + np.array([0.52 * size[0], 0.0]))[None]])


def _grid() -> Float[np.ndarray, "n 2"]:
    """Product grids over the square-cornered sheet and tab, which meet in common points."""
    sheet = _product(_ticks(HALF[0], COLUMNS), _ticks(HALF[1], ROWS))
    return np.concatenate([sheet, _product(np.linspace(HALF[0], HALF[0] + TAB_LENGTH, 6)[1:], _tab_rows())])


def _plan_points() -> Float[np.ndarray, "n 2"]:
    """The grid with rings set into it."""
    grid = _grid()
    holes = _hole_centers()
    clear = cKDTree(STUDS).query(grid)[0] > 1.3 * DETAIL_RADIUS + 0.3
    kept = clear & (cKDTree(holes).query(grid)[0] > DETAIL_RADIUS + 0.4)
    studs = [_ring(center, share * DETAIL_RADIUS) for center in STUDS for share in (STUD_TOP, 1.0, 1.3)]
    return np.concatenate([grid[kept], *studs, *(_ring(center, DETAIL_RADIUS) for center in holes)])


def middle_points() -> Float[np.ndarray, "n 3"]:
    """Points of the flat sheet's middle surface, holes filled, at most ``SPACING`` apart."""
    plan = _rounded(_grid())
    return np.column_stack([plan, np.zeros(len(plan))])


def _rounded(plan: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Squares at the corners of sheet and tab become quarter discs; nothing else moves."""
    root, size = _tab_box()
    on_tab = (plan[:, 0] > HALF[0])[:, None]
    local = plan - np.where(on_tab, root, 0.0)
    half = np.where(on_tab, size, HALF)
    radius = np.minimum(CORNER, half.min(axis=1, keepdims=True))
    beyond = np.maximum(np.abs(local) - (half - radius), 0.0) / radius
    drawn = beyond * np.sqrt(1.0 - beyond[:, ::-1] ** 2 / 2)
    return plan + np.sign(local) * (drawn - beyond) * radius


def _is_solid(corners: Float[np.ndarray, "f 3 2"]) -> Bool[np.ndarray, " f"]:
    """Whether triangles belong to the plan: not in a hole, nor beside the tab."""
    in_hole = cKDTree(_hole_centers()).query(corners.mean(axis=1))[0] < 0.9 * DETAIL_RADIUS
    x = corners[..., 0].max(axis=1)
    y = corners[..., 1]
    low, high = _tab_rows()[[0, -1]]
    return ~in_hole & ((x <= HALF[0]) | ((y >= low) & (y <= high)).all(axis=1))


def _owner(middle: Float[np.ndarray, "f 2"]) -> Int[np.ndarray, " f"]:
    """Number of the segment of each triangle: patches column by column, then the tab."""
    cell = ((middle + HALF) // np.array([COLUMN_LENGTH, ROW_WIDTH])).astype(np.int64)
    return np.where(middle[:, 0] > HALF[0], COLUMNS * ROWS, cell[:, 0] * ROWS + cell[:, 1])


def _heights(plan: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Upper and lower surface over points of the square-cornered plan."""
    edge = np.maximum((HALF - np.abs(plan)).min(axis=1), 0.0)
    hem = HEM_RISE * smooth_step((edge + 0.5) / 1.0) * (1.0 - smooth_step((edge - 1.6) / (HEM_WIDTH - 1.6)))
    rim = -0.25 * (1.0 - smooth_step(edge / 0.5))  # the outer border is rounded off
    across = (plan + HALF) / np.array([COLUMN_LENGTH, ROW_WIDTH])
    whole = np.round(across)
    inner = (whole > 0) & (whole < np.array([COLUMNS, ROWS]))
    off_seam = np.where(inner, np.abs(across - whole) * np.array([COLUMN_LENGTH, ROW_WIDTH]), np.inf).min(axis=1)
    seam = SEAM_DEPTH * (1.0 - smooth_step(off_seam / SEAM_WIDTH))
    stud = STUD_RISE * (
        1.0 - smooth_step((cKDTree(STUDS).query(plan)[0] / DETAIL_RADIUS - STUD_TOP) / (1.0 - STUD_TOP))
    )
    both = THICKNESS / 2 + np.where(plan[:, 0] > HALF[0], 0.0, hem + rim)
    return both - seam + stud, -both


@cache
def rest_mesh() -> SegmentedMesh:
    """The flat sheet: `patch_a1` to `patch_b3` and `tab`."""
    plan = _plan_points()
    triangles = Delaunay(plan).simplices.astype(np.int64)
    triangles = triangles[_is_solid(plan[triangles])]
    corners = plan[triangles]
    owner = _owner(corners.mean(axis=1))
    placed, (top, bottom) = _rounded(plan), _heights(plan)
    vertices = np.concatenate([np.column_stack([placed, top]), np.column_stack([placed, bottom])])
    names = [f"patch_{'ba'[row]}{column + 1}" for column in range(COLUMNS) for row in range(ROWS)]
    segments = [
        _thickened(name, color, vertices, triangles[owner == number])
        for number, (name, color) in enumerate(zip([*names, "tab"], COLORS, strict=True))
    ]
    return SegmentedMesh(tuple(segments))


def _thickened(
    name: str, color: tuple[int, int, int], vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "f 3"]
) -> Segment:
    """The part of the sheet over some triangles of its plan: upper side, lower side and the walls between them."""
    points = len(vertices) // 2
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key, back = edges[:, 0] * points + edges[:, 1], edges[:, 1] * points + edges[:, 0]
    start, end = edges[~np.isin(key, back)].T
    # both neighbours of a wall draw its diagonal from the upper end with the lower number: the same triangles
    upwards = (start < end)[:, None]
    first = np.where(
        upwards, np.stack([start, start + points, end + points], 1), np.stack([start, start + points, end], 1)
    )
    second = np.where(
        upwards, np.stack([start, end + points, end], 1), np.stack([start + points, end + points, end], 1)
    )
    faces = np.concatenate([triangles, triangles[:, ::-1] + points, first, second])
    return Segment(name, color, *with_used_vertices(vertices, faces))
