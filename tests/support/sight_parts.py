"""A small scene for lines of sight, and the pixels that points are seen in."""

import numpy as np

from mereo.geometry.camera import Camera

CAMERA = Camera(60, 50, 80.0, 80.0, 30.0, 25.0)
SHOWN = np.zeros((50, 60), dtype=bool)
SHOWN[15:35, 20:40] = True


def scene() -> np.ndarray:
    """A square at 1 m before a wall at 2 m; a strip at 0.8 m left of it, nothing measured above row 10."""
    depth = np.where(SHOWN, 1.0, 2.0)
    depth[:, :19] = 0.8
    depth[:10] = 0.0
    return depth


def pixels(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that points are seen in."""
    columns, rows = np.floor(camera.project(points)).astype(int).T
    return rows, columns
