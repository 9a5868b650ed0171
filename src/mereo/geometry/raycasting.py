"""Where rays from the camera first meet a surface, by Embree.

Notation: n rays are ``t * direction``, t > 0, from the origin of the camera frame. Directions have z = 1, so that t is
the depth and a direction's x and y are its slopes.
"""

from typing import NamedTuple

import numpy as np
from embreex import rtcore
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float32, Int

_DEVICE = rtcore.EmbreeDevice()

_MARGIN = 1e-4
"""Tolerance of slopes: a hundredth of a pixel of the paper's camera, a thousand times single precision's rounding."""


class Hits(NamedTuple):
    """First meetings of rays with a surface.

    Attributes:
        distance: t; infinite where nothing is hit.
        normal: of the surface there, of any length, on either side; zero where nothing is hit.
    """

    distance: Float[np.ndarray, " n"]
    normal: Float[np.ndarray, "n 3"]

    @classmethod
    def none(cls, count: int) -> "Hits":
        """Hits of rays that meet nothing (yet)."""
        return cls(np.full(count, np.inf), np.zeros((count, 3)))

    def nearer(self, rows: Int[np.ndarray, " m"], others: "Hits") -> Int[np.ndarray, " k"]:
        """Rows of ``rows`` on which the ``others`` meet something nearer, which these hits take over, in place."""
        better = others.distance < self.distance[rows]
        kept = rows[better]
        self.distance[kept], self.normal[kept] = others.distance[better], others.normal[better]
        return kept


def ray_scene(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> EmbreeScene:
    """Embree scene of one triangle mesh. It works in single precision: keep coordinates near the origin."""
    scene = EmbreeScene(_DEVICE)
    TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
    return scene


def first_hits(
    scene: EmbreeScene, center: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, " m"], Hits]:
    """Rays that hit a scene whose coordinates are relative to ``center``, and their hits."""
    found = scene.run(*_rays(center, directions), output=True)
    rows = np.flatnonzero(found["primID"] >= 0)
    return rows, Hits(found["tfar"][rows].astype(np.float64), found["Ng"][rows].astype(np.float64))


def first_faces(
    scene: EmbreeScene, center: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Rays that hit a scene whose coordinates are relative to ``center``, and the face that each hits first."""
    face = scene.run(*_rays(center, directions))
    rows = np.flatnonzero(face >= 0)
    return rows, face[rows].astype(np.int64)


def _rays(
    center: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Origins and directions in the single precision that Embree wants."""
    single = np.ascontiguousarray(directions, dtype=np.float32)
    return np.broadcast_to(-center.astype(np.float32), single.shape).copy(), single


def toward(
    directions: Float[np.ndarray, "n 3"], low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> Int[np.ndarray, " m"]:
    """Rays that may hit the box from ``low`` to ``high``: all of them where it is not wholly in front of the camera.

    A segment covers a small part of an image, and a ray that misses costs as much as one that hits.
    """
    if low[2] <= 0:
        return np.arange(len(directions))
    x, y = directions[:, 0], directions[:, 1]
    least, most = (np.stack([corner[:2] / low[2], corner[:2] / high[2]]) for corner in (low, high))
    (x0, y0), (x1, y1) = least.min(axis=0) - _MARGIN, most.max(axis=0) + _MARGIN
    return np.flatnonzero((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))
