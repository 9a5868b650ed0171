"""Smoothing of a point cloud along its lines of sight, for noisy depth cameras.

Local polynomial regression: what neighbours on the same surface have in common, evaluated at each point's own line of
sight. The inverse of the range is fitted, which for a plane is linear in the direction, so that slanted planes stay as
they are; squares follow the curvature. Notation: n points, k neighbours.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from mereo.geometry.surface_patches import JUMP, NOISE

NEIGHBORS = 36
"""Neighbours that are looked at: in an image nearly the 7 x 7 pixels around one, without its corners."""

RADIUS = 3.2
"""How far neighbours may be, in pitches of the lines of sight."""

WIDTH = 0.6
"""Standard deviation of their weights, in radii."""

RIDGE = (0.0, 0.02, 0.02, 0.1, 0.1, 0.1)
"""Pull of the coefficients of (1, u, v, u^2, uv, v^2) towards 0, in neighbours: few of them carry no curvature."""

FEWEST = 4
"""A point with fewer neighbours on its surface, itself among them, stays where it is."""


def smoothed(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Points moved along their lines of sight to where their neighbours on the same surface say that it is.

    Args:
        points: seen from the origin (camera frame), any unit, all different from it.
    """
    if len(points) < FEWEST:
        return points
    distance = np.linalg.norm(points, axis=1)
    sight = points / distance[:, None]
    angle, neighbor = cKDTree(sight).query(sight, k=min(NEIGHBORS + 1, len(points)))
    radius = RADIUS * float(np.median(angle[:, FEWEST]))
    if radius == 0:
        return points
    near = (angle <= radius) & _on_one_surface(distance, angle, neighbor)
    weight = near * np.exp(-0.5 * (angle / (WIDTH * radius)) ** 2)
    terms = _quadratic(sight, neighbor, radius)
    normal = np.einsum("nki,nk,nkj->nij", terms, weight, terms) + np.diag(RIDGE)
    right = np.einsum("nki,nk->ni", terms, weight / distance[neighbor])
    inverse = np.linalg.solve(normal, right[..., None])[:, 0, 0]
    moved = np.where((near.sum(axis=1) >= FEWEST) & (inverse > 0), 1.0 / inverse, distance)
    return sight * moved[:, None]


def _on_one_surface(
    distance: Float[np.ndarray, " n"], angle: Float[np.ndarray, "n k"], neighbor: Int[np.ndarray, "n k"]
) -> Bool[np.ndarray, "n k"]:
    """Whether the step in range to each neighbour is no larger than slant or noise make it."""
    step = np.abs(distance[neighbor] - distance[:, None])
    noise = NOISE * float(np.median(step[:, 1 : FEWEST + 1]))
    return step <= np.maximum(JUMP * angle * distance[:, None], noise)


def _quadratic(
    sight: Float[np.ndarray, "n 3"], neighbor: Int[np.ndarray, "n k"], radius: float
) -> Float[np.ndarray, "n k 6"]:
    """Terms (1, u, v, u^2, uv, v^2) of each neighbour's direction, u and v across the point's own, in radii."""
    across = np.cross(sight, np.eye(3)[np.abs(sight).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    apart = (sight[neighbor] - sight[:, None]) / radius
    u = np.einsum("nkj,nj->nk", apart, across)
    v = np.einsum("nkj,nj->nk", apart, np.cross(sight, across))
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
