"""The largest plane of a cloud, by random sample consensus (Fischler, Bolles, CACM 1981) and least squares."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

TRIALS = 600
"""Planes tried; one that holds a fifth of the points is missed once in a hundred clouds, one with a third never."""

JUDGES = 3000
"""Points that a tried plane is judged by."""

BATCH = 100
"""Planes judged at once, so that the table of distances stays in cache."""

REFINEMENTS = 3


@dataclass(frozen=True, eq=False)
class Plane:
    """Plane of points x with ``normal @ x == offset``.

    Attributes:
        normal: unit length.
        offset: in the points' unit.
    """

    normal: Float[np.ndarray, "3"]
    offset: float

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance of points from the plane, without sign."""
        return np.abs(points @ self.normal - self.offset)


def largest_plane(
    points: Float[np.ndarray, "n 3"], tolerance: Float[np.ndarray, " n"], rng: np.random.Generator
) -> Plane | None:
    """Plane with the most points within ``tolerance``; None where no three points span one.

    Args:
        points: any unit.
        tolerance: how far from the plane each point may be to count, in that unit.
        rng: draws the planes that are tried and the points that judge them.
    """
    if len(points) < 3:
        return None
    judges = rng.permutation(len(points))[:JUDGES]
    judging, allowed = points[judges], tolerance[judges, None]
    normals, offsets = _through(points[rng.integers(0, len(points), (TRIALS, 3))])
    if len(normals) == 0:
        return None
    counts = np.concatenate(
        [
            (np.abs(judging @ normals[i : i + BATCH].T - offsets[i : i + BATCH]) <= allowed).sum(axis=0)
            for i in range(0, len(normals), BATCH)
        ]
    )
    best = int(counts.argmax())
    plane = Plane(normals[best], float(offsets[best]))
    for _ in range(REFINEMENTS):
        near = plane.distance(points) <= tolerance
        plane = _fit(points, near, plane)
    return plane


def _through(triples: Float[np.ndarray, "t 3 3"]) -> tuple[Float[np.ndarray, "u 3"], Float[np.ndarray, " u"]]:
    """Planes through three points each; triples on a line are left out."""
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    proper = lengths > 1e-12 * np.ptp(triples.reshape(-1, 3), axis=0).max() ** 2
    normals = normals[proper] / lengths[proper, None]
    return normals, np.einsum("ti,ti->t", normals, triples[proper, 0])


def _fit(points: Float[np.ndarray, "n 3"], near: Bool[np.ndarray, " n"], plane: Plane) -> Plane:
    """Least squares through the points near ``plane``."""
    if near.sum() < 3:
        return plane
    center = points[near].mean(axis=0)
    normal = np.linalg.eigh(np.cov((points[near] - center).T))[1][:, 0]
    return Plane(normal, float(normal @ center))
