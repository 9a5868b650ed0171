"""Depth image of a frame as a page shows it: a small picture in the page itself, and what its ends mean."""

from typing import Any

import numpy as np

from mereo.geometry.camera import DepthImage
from mereo.visualization.contact_sheets import Picture, depth_to_rgb
from mereo.visualization.result_html import data_url
from mereo.visualization.units import Unit, rounded

MARGIN = 0.08
"""Share of the measured part's longer side that is shown around it; where little was measured, the rest is empty."""

MOST_SIDE = 480
"""Pixels of the longer side that a page shows at most; larger images are thinned, pixel by pixel."""


def depth_data(depth: DepthImage, unit: Unit) -> dict[str, Any]:
    """What a page needs to show a depth image.

    Args:
        depth: the image.
        unit: of its depths.

    Returns ``url`` (a PNG in an address), ``width`` and ``height`` in pixels, and ``ends``, the nearest and farthest
    depth in words; of an image without measurements none.
    """
    picture, seen = depth_picture(depth), depth.depth[depth.valid]
    ends = (float(seen.min()), float(seen.max())) if len(seen) else ()
    told = [f"{rounded(end * unit.length_factor)} {unit.length_name}" for end in ends]
    return {"url": data_url(picture), "width": picture.shape[1], "height": picture.shape[0], "ends": told}


def depth_picture(depth: DepthImage) -> Picture:
    """Picture of what was measured, near is bright, of ``MOST_SIDE`` pixels at most."""
    rows, columns = (np.flatnonzero(depth.valid.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        rows, columns = np.arange(depth.depth.shape[0]), np.arange(depth.depth.shape[1])
    room = 1 + int(MARGIN * max(np.ptp(rows), np.ptp(columns)))
    window = tuple(slice(max(int(part[0]) - room, 0), int(part[-1]) + 1 + room) for part in (rows, columns))
    shown = depth_to_rgb(depth)[window]
    step = -(-max(shown.shape) // MOST_SIDE)
    return np.ascontiguousarray(shown[::step, ::step])
