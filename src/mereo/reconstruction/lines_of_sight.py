"""Lines of sight beside the object in one frame: which went past it, and along which nothing is known.

    SensorFrame, Selection -lines_of_frame-> SightLines

Depths beside the object are compared with those of the object's pixels nearest in the picture
(docs/design/0028-sight-lines.md). A depth image states a line of sight for each pixel, a point cloud for each point
that isolation left out.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mereo.geometry.camera import DepthImage, into_camera
from mereo.geometry.downsampling import STEEPEST
from mereo.geometry.sight_lines import SightLines
from mereo.geometry.transforms import transform_points
from mereo.io.sensor_frame import SensorFrame
from mereo.reconstruction.config import Extent
from mereo.reconstruction.isolation import Selection

MOST_LINES = 10_000
"""Number of lines of sight that are kept, at most, unless the outline alone has more."""

RIM = 1.5
"""Pixels from the object within which a line of sight is unknown: masks are wrong by one, and cameras mix both sides of
an edge."""

AROUND = 49
"""Object points nearest to a line of sight, with whose median depth its own is compared; a mask that is too wide leaves
a rim of background among them, which are the fewer."""

ALIKE, AGREEING = 0.25, 3
"""Pixels that went past are a surface's: of the 8 around each, so many agree in how far behind the object they are, to
this share. A pixel at an edge that mixes two depths has neighbours at either."""

SILENT = 0.02
"""Share of the pixels beside the object below which those that went past are too few: then a depth of zero may as well
mean that the image was cut out or rendered."""

DENSE = 3.0
"""Pixels from the object within which no line of sight is left out."""


def lines_of_frame(frame: SensorFrame, selection: Selection | None, extent: Extent = "auto") -> SightLines:
    """Lines of sight beside the object of a frame, in the frame's axes and unit.

    Args:
        frame: everything that was measured.
        selection: points of ``frame.cloud`` that are the object's; None means all.
        extent: how much of the object's outline the frame shows, see ``IsolationConfig``.
    """
    if extent == "partial":
        return SightLines.of_cloud("unknown")
    points = frame.cloud.points
    is_object = np.ones(len(points), dtype=bool) if selection is None else selection.of_object(points)
    if frame.depth is not None and frame.depth.valid.sum() == len(points):
        shown = np.zeros(frame.depth.depth.shape, dtype=bool)
        shown[frame.depth.valid] = is_object
        lines = lines_of_image(frame.depth if frame.whole is None else frame.whole, shown)
    else:
        T_camera_input = into_camera(points[is_object], frame.axes)
        lines = lines_of_points(transform_points(T_camera_input, points), is_object)
        lines = lines.transformed(np.linalg.inv(T_camera_input))
    return SightLines(lines.past, np.empty((0, 3)), "past") if extent == "whole" else lines


# --- depth images ----------------------------------------------------------------------------------------------------


def lines_of_image(whole: DepthImage, shown: Bool[np.ndarray, "h w"]) -> SightLines:
    """Lines of sight beside the object in a depth image, in the camera frame and the image's unit.

    They are those of pixels within one size of the object around its box. Where hardly any of them went past, zeros do
    not say that nothing was measured, and what is elsewhere is left open.

    Args:
        whole: the depth image with all that was measured.
        shown: pixels that show the object.
    """
    rows, columns = np.flatnonzero(shown.any(axis=1)).tolist(), np.flatnonzero(shown.any(axis=0)).tolist()
    height, width = rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1
    reach = max(height, width)
    # the window may reach beyond the picture
    top, left = rows[0] - reach, columns[0] - reach
    shape = height + 2 * reach, width + 2 * reach
    depth, is_object = _window(whole.depth, top, left, shape), _window(shown, top, left, shape)
    inside = _window(np.ones_like(shown), top, left, shape)
    # nothing of the object lies outside the picture unless it reaches the edge
    cut = min(rows[0], columns[0], shown.shape[0] - 1 - rows[-1], shown.shape[1] - 1 - columns[-1]) < RIM
    distance, nearest = ndimage.distance_transform_edt(~is_object, return_indices=True)
    near = _outline_depth(depth, is_object)[nearest[0], nearest[1]]
    step = STEEPEST / min(whole.camera.focal_x_px, whole.camera.focal_y_px)
    past = (depth - near > step * near) & (distance > RIM)
    past &= _agrees(np.where(past, depth - near, 0.0))
    hides = (depth > 0) & ~is_object & (distance <= RIM) & (near - depth > step * near)
    past &= (depth > (1 + step) * near.max()) | ~_surfaces_with(hides, np.where(is_object, 0.0, depth), step)
    beside = inside & (distance > RIM)
    silent = past.sum() < max(SILENT * beside.sum(), 1)
    unknown = ~is_object & ~past & ((inside & ((depth > 0) | (not silent))) | (~inside & cut))
    v, u = np.nonzero(past | unknown)
    kept = _evenly(u, v, distance[v, u], MOST_LINES)
    u, v = u[kept], v[kept]
    went = past[v, u]
    places = whole.camera.unproject(
        np.stack([u + left + 0.5, v + top + 0.5], axis=1), np.where(went, depth[v, u], near[v, u])
    )
    return SightLines(places[went], places[~went], None if silent else "unknown")


def _window(
    image: Float[np.ndarray, "h w"] | Bool[np.ndarray, "h w"], top: int, left: int, shape: tuple[int, int]
) -> Float[np.ndarray, "a b"] | Bool[np.ndarray, "a b"]:
    """Part of an image from a pixel on, with zeros where it reaches out of the image."""
    cut = np.zeros(shape, dtype=image.dtype)
    low = np.maximum([top, left], 0)
    high = np.minimum([top + shape[0], left + shape[1]], image.shape)
    inside = image[low[0] : high[0], low[1] : high[1]]
    cut[low[0] - top : high[0] - top, low[1] - left : high[1] - left] = inside
    return cut


def _outline_depth(depth: Float[np.ndarray, "h w"], is_object: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Median depth of the object around each pixel of its outline, 0 elsewhere."""
    pixels = np.argwhere(is_object)
    outline = np.argwhere(is_object & ~ndimage.binary_erosion(is_object))
    nearest = cKDTree(pixels).query(outline, k=range(1, min(AROUND, len(pixels)) + 1))[1]
    around = np.zeros(depth.shape)
    around[tuple(outline.T)] = np.median(depth[tuple(pixels.T)][nearest], axis=1)
    return around


def _surfaces_with(
    marked: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"], step: float
) -> Bool[np.ndarray, "h w"]:
    """Pixels of all surfaces that have ``AGREEING`` marked pixels or more; a depth of 0 is no surface.

    A surface goes on from pixel to pixel as long as depth changes by less than ``step`` times itself.
    """
    if marked.sum() < AGREEING:
        return np.zeros(depth.shape, dtype=bool)
    number = np.arange(depth.size).reshape(depth.shape)
    pairs = []
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        one, other = depth[first], depth[second]
        joined = (one > 0) & (other > 0) & (np.abs(one - other) < step * np.minimum(one, other))
        pairs.append(np.stack([number[first][joined], number[second][joined]]))
    row, column = np.concatenate(pairs, axis=1)
    edges = coo_matrix((np.ones(len(row), dtype=np.int8), (row, column)), shape=(depth.size, depth.size))
    label = connected_components(edges, directed=False)[1].reshape(depth.shape)
    return np.asarray(np.bincount(label[marked], minlength=label.max() + 1)[label] >= AGREEING)


def _agrees(behind: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels with enough neighbours that are as far behind the object, see ``ALIKE``; 0 is not behind."""
    padded = np.pad(behind, 1)
    height, width = behind.shape
    count = np.zeros(behind.shape, dtype=np.int8)
    for row in range(3):
        for column in range(3):
            if (row, column) != (1, 1):
                around = padded[row : row + height, column : column + width]
                count += np.abs(around - behind) <= ALIKE * behind
    return (count >= AGREEING) & (behind > 0)


def _evenly(
    u: Int[np.ndarray, " n"], v: Int[np.ndarray, " n"], distance: Float[np.ndarray, " n"], limit: int
) -> Bool[np.ndarray, " n"]:
    """At most ``limit`` of some pixels: all near the object, farther off those of ever coarser grids.

    The pitch of the grid grows with the distance from the object, in pixels, but it is 1 up to ``DENSE``, even where
    more than ``limit`` pixels are so near.
    """
    octaves = np.log2(np.maximum(distance / DENSE, 1.0))
    low, high = 0.0, float(octaves.max(initial=0.0))  # how many of them are dense
    kept = _on_grids(u, v, octaves)
    if len(u) <= limit or kept.sum() > limit:
        return kept if len(u) > limit else np.ones(len(u), dtype=bool)
    while high - low > 0.1:
        middle = 0.5 * (low + high)
        more = _on_grids(u, v, octaves - middle)
        if more.sum() > limit:
            high = middle
        else:
            low, kept = middle, more
    return kept


def _on_grids(
    u: Int[np.ndarray, " n"], v: Int[np.ndarray, " n"], octaves: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Pixels of which both coordinates are multiples of 2^k, where k is ``octaves`` rounded up, and 0 at least."""
    between = (1 << np.maximum(np.ceil(octaves), 0.0).astype(np.int64)) - 1
    return (u | v) & between == 0


# --- clouds ----------------------------------------------------------------------------------------------------------


def lines_of_points(points: Float[np.ndarray, "n 3"], is_object: Bool[np.ndarray, " n"]) -> SightLines:
    """Lines of sight to the points of a cloud that are not the object's; what is elsewhere is left open.

    Args:
        points: camera frame.
        is_object: which are the object's.
    """
    ranges = np.linalg.norm(points, axis=1)
    sight = points / np.maximum(ranges, 1e-300)[:, None]
    others = np.flatnonzero(~is_object & (points[:, 2] > 0))
    if len(others) == 0 or not is_object.any():
        return SightLines.of_cloud()
    tree, own = cKDTree(sight[is_object]), points[is_object, 2]
    # the fourth neighbour of a pixel is one pitch away, as the first is
    pitch = float(np.median(tree.query(tree.data, k=[min(len(own), 5)])[0]))
    size = float(np.ptp(tree.data, axis=0).max())
    angle = tree.query(sight[others], distance_upper_bound=max(size, pitch))[0]
    # along a line that met the object, nothing else is said
    there = (angle > 0.5 * pitch) & np.isfinite(angle)
    others, angle = others[there], angle[there]
    nearest = tree.query(sight[others], k=range(1, min(len(own), AROUND) + 1))[1]
    near = np.median(own[nearest], axis=1)
    past = (points[others, 2] - near > STEEPEST * pitch * near) & (angle > RIM * pitch)
    ahead = tree.data.mean(axis=0)
    across = np.linalg.svd(ahead[None])[2][1:]
    u, v = np.floor((sight[others] - ahead) @ across.T / max(pitch, 1e-12)).astype(np.int64).T
    kept = _evenly(u, v, angle / max(pitch, 1e-12), MOST_LINES)
    return SightLines(points[others[past & kept]], points[others[~past & kept]])
