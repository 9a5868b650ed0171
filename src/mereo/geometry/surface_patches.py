"""Surface patches of a point cloud: what hangs together as seen from the camera, and what is too thin to be a surface.

Where a mask is wrong by a pixel or two, it lets in a rim of whatever is behind the object, and cameras add points
between both. They are few, but they lie far off. Such a rim is one to three pixels wide, a surface is wider: so a patch
counts where some point of it has nearly all of the 24 neighbours that it would have inside an image, and what lies
right at it in space, where it turns away from the camera, is its own. Measured in docs/design/0006-sensors.md.
Notation: n points, k neighbours.
"""

from math import nan

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.linalg import norm, solve
from scipy.spatial import cKDTree
from scipy.stats import median_abs_deviation

from mereo.geometry.camera import PixelValues
from mereo.geometry.downsampling import MAX_POINTS, thin_to_grid
from mereo.geometry.mesh import connected
from mereo.geometry.transforms import Flags, Indices, Points, Values, longest_side

NEIGHBORS = 24
"""Neighbours that are looked at: in an image, the 5 x 5 pixels around one."""

ADJACENT, AROUND = 1.6, 3.0
"""Angles in pitches within which points are adjacent (diagonals are), and within which neighbours count."""

JUMP = 4.0
"""Largest step in range between adjacent points, in widths of a pixel there: a surface seen at 76 degrees."""

NOISE = 2.5
"""The same in median steps between nearest neighbours, where that is more: closer points differ by noise alone."""

GRID = 0.8
"""Nearest neighbour's angle over the fourth's from which on lines of sight are a grid of pixels; random ones have 0.5.

On a grid the pitch is the same everywhere: points that cameras add before edges would otherwise join to patches."""

INNER = 20
"""Neighbours of the same patch, of the 24, that make a point an inner one; a strip of three pixels has 14."""

STRETCH = 1.03
"""Times by which points off all surfaces must lengthen the cloud's box, by which a network is normalized, to matter."""


def surface_points(points: Points) -> Flags:
    """Whether each point belongs to a patch of surface, as in ``surface_patches``."""
    return surface_patches(points)[1]


def surface_patches(points: Points) -> tuple[Indices, Flags]:
    """Number of each point's patch, and whether it belongs to one that is a surface; all do where too few can tell.

    Points are seen from the origin (camera frame), in any unit and density. Of more than ``MAX_POINTS``, points evenly
    in space are looked at, and the others go with the nearest of these.
    """
    rows = thin_to_grid(points, MAX_POINTS)
    places, place = np.unique(points[rows], axis=0, return_inverse=True)
    if len(places) <= NEIGHBORS + 1:
        return np.zeros(len(points), np.int64), np.ones(len(points), bool)
    patch, inner, tall = _patches(places)
    surface = np.bincount(patch, inner)[patch] > 0
    if not surface.any():
        surface[:] = True
    elif not surface.all():
        surface[~surface] = cKDTree(places[surface]).query(places[~surface])[0] <= tall[~surface]
    nearest = place.reshape(-1) if len(rows) == len(points) else cKDTree(places).query(points)[1]
    return patch[nearest], surface[nearest]


def _patches(
    points: Points,
) -> tuple[Indices, Flags, Values]:
    """Number of the patch of each of many different points, whether it is an inner one, and its largest step."""
    distance = norm(points, axis=1)
    sight = points / np.maximum(distance, np.finfo(float).tiny)[:, None]
    angle, neighbor = cKDTree(sight).query(sight, k=NEIGHBORS + 1)
    angle, neighbor = angle[:, 1:], neighbor[:, 1:]
    fourth = angle[:, 3]
    everywhere = float(np.median(fourth))
    around = np.maximum(everywhere, np.median(fourth[neighbor], axis=1))
    on_grid = float(np.median(angle[:, 0])) > GRID * everywhere
    pitch = np.full(len(points), everywhere) if on_grid else around
    step = np.abs(distance[neighbor] - distance[:, None])
    tall = np.maximum(JUMP * pitch * distance, NOISE * float(np.median(step[:, :4])))
    row, column = np.nonzero((angle <= ADJACENT * pitch[:, None]) & (step <= tall[:, None]))
    patch = connected(np.stack([row, neighbor[row, column]], axis=1), len(points))
    same = (angle <= AROUND * around[:, None]) & (patch[neighbor] == patch[:, None])
    return patch, same.sum(axis=1) >= INNER, tall


def stretch(points: Points, keep: Flags) -> float:
    """Times that the longest side of the points' box is as long as that of those that are kept, from 1 up."""
    return longest_side(points) / max(longest_side(points[keep]), np.finfo(float).tiny)


def without_strays(points: Points) -> Flags:
    """Whether each point is left where strays are removed: all are, unless strays make the box ``STRETCH`` longer."""
    keep = surface_points(points)
    if keep.all() or stretch(points, keep) <= STRETCH:
        return np.ones(len(points), bool)
    return keep


# --- noise of a cloud -------------------------------------------------------------------------------------------------

# Local polynomial regression: what is left over of a quadratic patch. Of a camera's points the inverse of the range is
# fitted, which for a plane is linear in the direction. Notation: n points, k neighbours.

TERMS = 6
"""Coefficients of a patch: those of (1, u, v, u^2, uv, v^2)."""

ROUGH_NEIGHBORS, CALM = 12, 0.1
"""Points of each local patch, itself among them, and the share of a cloud that is its calmest part."""


def roughness(points: Points, normals: Points | None = None) -> float:
    """Bound on the noise of a cloud along its lines of sight, in its unit: how rough its calmest part is.

    With ``normals`` it is that along them, of a surface that has no lines of sight. The ``CALM`` quantile of the
    standard deviation from a quadratic patch of each point and its neighbours, which edges and fine relief raise.
    Infinite for fewer points than say anything.
    """
    count = min(ROUGH_NEIGHBORS, len(points))
    free = count - TERMS
    if free < 1:
        return float("inf")
    distance = norm(points, axis=1)
    sight = points / distance[:, None]
    places, axis = (sight, sight) if normals is None else (points, normals)
    apart, neighbor = cKDTree(places).query(places, k=count)
    radius = max(float(np.median(apart[:, -1])), np.finfo(float).tiny)
    value, unit = 1.0 / distance[neighbor], distance**2
    if normals is not None:
        value = np.einsum("nki,ni->nk", points[neighbor] - points[:, None], normals)
        unit = np.ones(len(points))
    terms = _quadratic(places, axis, neighbor, radius)
    normal = np.einsum("nki,nkj->nij", terms, terms) + 1e-6 * np.eye(TERMS)  # rows of points leave it open
    patch = solve(normal, np.einsum("nki,nk->ni", terms, value)[..., None])
    away = norm(value - np.matmul(terms, patch)[..., 0], axis=1) * unit
    return float(np.quantile(away, CALM)) / float(np.sqrt(free))


def _quadratic(places: Points, axis: Points, neighbor: Int[ndarray, "n k"], radius: float) -> Float[ndarray, "n k 6"]:
    """Terms (1, u, v, u^2, uv, v^2) of each neighbour's place (or direction), u and v across the axis, in radii."""
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)])
    across /= np.maximum(norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    apart = (places[neighbor] - places[:, None]) / radius
    u = np.einsum("nkj,nj->nk", apart, across)
    v = np.einsum("nkj,nj->nk", apart, np.cross(axis, across))
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


# --- noise of depth images --------------------------------------------------------------------------------------------


def second_differences(depth: PixelValues, lag: int) -> PixelValues:
    """Second differences of inverse depth over so many pixels of each row; NaN where one is not measured.

    Along planes inverse depth is linear in the picture, so that they are 0 but for noise.
    """
    inverse, second = np.full(depth.shape, nan), np.full(depth.shape, nan)
    np.divide(1.0, depth, out=inverse, where=depth > 0)
    second[:, lag:-lag] = inverse[:, : -2 * lag] - 2 * inverse[:, lag:-lag] + inverse[:, 2 * lag :]
    return second


def noise_of_differences(*second: Float[ndarray, "_ _"]) -> float:
    """Standard deviation of a camera's noise in inverse depth, by second differences of which most are of planes."""
    every = np.concatenate([part[np.isfinite(part)] for part in second])
    return float(median_abs_deviation(every, scale="normal")) / np.sqrt(6.0) if len(every) else 0.0
