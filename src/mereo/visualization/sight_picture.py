"""Picture of a depth image in which each line of sight near the object has the colour of its kind."""

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import Camera, DepthImage
from mereo.reconstruction.observation import Observation
from mereo.visualization.contact_sheets import Picture

OBJECT_COLOR, PAST_COLOR, UNKNOWN_COLOR = (255, 170, 40), (60, 130, 255), (225, 60, 60)
"""Colours of lines of sight that met the object (orange), went past it (blue), and are unknown (red)."""

OPACITY = 0.75
"""Share of the colour of a kind; the rest is the depth's."""


NEAREST = 0.01
"""Share of the measured pixels that are shown in white: they are the nearest."""


def sight_picture(seen: Observation) -> Picture:
    """Depth image with the kinds of its lines of sight, of the image's size.

    Raises ``ValueError`` for a frame without a depth image.
    """
    depth = seen.frame.depth if seen.frame.whole is None else seen.frame.whole
    if depth is None:
        raise ValueError(f"{seen.frame.source} has no depth image; lines of sight are drawn in one: give such a frame")
    picture = np.repeat(_gray(depth)[:, :, None], 3, axis=2)
    for points, color in (
        (seen.lines.past, PAST_COLOR),
        (seen.lines.unknown, UNKNOWN_COLOR),
        (seen.cloud.points, OBJECT_COLOR),
    ):
        rows, columns = _pixels(points, depth.camera)
        picture[rows, columns] = OPACITY * np.array(color) + (1 - OPACITY) * picture[rows, columns]
    return picture.astype(np.uint8)


def _gray(depth: DepthImage) -> Float[np.ndarray, "h w"]:
    """Brightness of each pixel, 0 to 255: the nearest depth by its own, 0 where nothing was measured."""
    measured = depth.depth[depth.valid]
    near = float(np.quantile(measured, NEAREST)) if len(measured) else 1.0
    gray = np.zeros(depth.depth.shape)
    gray[depth.valid] = 255 * np.minimum(near / measured, 1.0)
    return gray


def _pixels(points: Float[np.ndarray, "n 3"], camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels in the picture that points are seen in."""
    columns, rows = np.floor(camera.project(points)).astype(np.int64).T
    inside = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    return rows[inside], columns[inside]
