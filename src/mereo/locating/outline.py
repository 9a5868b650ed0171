"""Evidence of a posed object in a depth image against something else that stands there.

    DepthImage -Jumps.of-> Jumps; depth of a posed object -compare_outline-> Outline (counts of pixels, and nats)

A smooth thing explains the points of a smooth surface as well as the object does, so agreement inside says little. What
the object alone predicts is where the surface ends: along its outline, and where it folds over itself, the image has a
jump in depth, and inside it has none; and no pixel has seen past it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.downsampling import STEEPEST
from mereo.geometry.solids import first_faces, ray_scene, toward

EDGE_OFF = 3
"""Pixels by which a camera's edges may be off; what so many pixels say is not independent."""

GAP = 30
"""Pixels without a measurement across which a jump is looked for: stereo cameras miss what is beside an edge."""

NOISE_STD = 5.0
"""Standard deviations of a camera's noise from which on a gap between neighbours is a jump."""

HIT, MISS, EXTRA, PAST, HIDDEN = 0.39, -2.17, -0.5, -1.0, -0.2
"""Nats of independent pixels: of the outline with a jump, and without; inside with one; seen past, and covered."""


def rendered_depth(camera: Camera, triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "h w"]:
    """Depth of the nearest of some triangles along the ray of each pixel, 0 where there is none; any unit."""
    rays, vertices = camera.directions().reshape(-1, 3), triangles.reshape(-1, 3)
    depth, center = np.zeros(len(rays)), vertices.mean(axis=0)
    near = toward(rays, vertices.min(axis=0), vertices.max(axis=0))
    if len(near):
        scene = ray_scene(vertices - center, np.arange(len(vertices)).reshape(-1, 3))
        rows, face = first_faces(scene, center, rays[near])
        corner, ray = triangles[face], rays[near[rows]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        along, ahead = (np.einsum("ni,ni->n", normal, each) for each in (ray, corner[:, 0]))
        depth[near[rows]] = np.divide(ahead, along, out=np.zeros_like(ahead), where=along * ahead > 0)
    return depth.reshape(camera.height, camera.width)


def noise_share(image: DepthImage) -> float:
    """Standard deviation of a depth image's noise over the square of the depth, as it grows: by second differences."""
    parts = list[np.ndarray]()
    for depth in (image.depth, image.depth.T):
        first, middle, last = depth[:, :-2], depth[:, 1:-1], depth[:, 2:]
        known = (first > 0) & (middle > 0) & (last > 0)
        parts.append((first - 2 * middle + last)[known] / middle[known] ** 2)
    every = np.concatenate(parts)
    return 1.4826 * float(np.median(np.abs(every))) / np.sqrt(6) if len(every) else 0.0


class Jumps(NamedTuple):
    """Jumps in depth between measured pixels that follow each other along rows or columns of an image.

    Attributes:
        image: the depth image.
        step: gap from which on there is a jump, in the image's unit, at each pixel.
        nearer: pixels on the nearer side of a jump.
        known: pixels where a jump would have been seen.
    """

    image: DepthImage
    step: Float[np.ndarray, "h w"]
    nearer: Bool[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]

    @classmethod
    def of(cls, image: DepthImage) -> "Jumps":
        """Jumps of an image, by more than a slope or noise explains."""
        depth = image.depth
        slope = STEEPEST / min(image.camera.focal_x_px, image.camera.focal_y_px)
        step = np.maximum(slope * depth, NOISE_STD * noise_share(image) * depth**2)
        rows = _along_rows(depth, step)
        columns = _along_rows(np.ascontiguousarray(depth.T), np.ascontiguousarray(step.T))
        return cls(image, step, *(first | second.T for first, second in zip(rows, columns, strict=True)))


def _along_rows(
    depth: Float[np.ndarray, "h w"], step: Float[np.ndarray, "h w"]
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """``Jumps.nearer`` and ``Jumps.known`` by the rows alone."""
    width, measured = depth.shape[1], np.flatnonzero(depth)
    first, last = measured[:-1], measured[1:]
    together = (first // width == last // width) & (last - first <= GAP)
    first, last = first[together], last[together]
    before, after = depth.ravel()[first], depth.ravel()[last]
    allowed = np.minimum(step.ravel()[first], step.ravel()[last]) * np.sqrt(np.minimum(last - first, 9))
    nearer = np.zeros(depth.size, dtype=bool)
    nearer[np.where(before < after, first, last)[np.abs(after - before) > allowed]] = True
    starts = np.zeros(depth.size + 1, dtype=np.int32)
    np.add.at(starts, first, 1)
    np.add.at(starts, last + 1, -1)
    return nearer.reshape(depth.shape), (np.cumsum(starts)[:-1] > 0).reshape(depth.shape)


class Outline(NamedTuple):
    """What a depth image says of a posed object's outline, in pixels.

    Attributes:
        hits, misses: of the outline, folds included, with a jump of the image beside them, and without one.
        extra: inside, with a jump where the object has none.
        past: inside, that saw something behind the object.
        hidden: inside, that saw something before the object.
        shown: all that the object would cover.
    """

    hits: int = 0
    misses: int = 0
    extra: int = 0
    past: int = 0
    hidden: int = 0
    shown: int = 0

    @property
    def nats(self) -> float:
        """Logarithm of how much likelier that is of the object than of something else that was taken for it."""
        weights = (HIT, MISS, EXTRA, PAST / (EDGE_OFF + 1), HIDDEN / (EDGE_OFF + 1))
        return sum(weight * count for weight, count in zip(weights, self, strict=False)) / (EDGE_OFF + 1)


def compare_outline(jumps: Jumps, depth: Float[np.ndarray, "h w"]) -> Outline:
    """Compare the rendered ``depth`` of a posed object, 0 where it is not, with an image's."""
    measured, (height, width) = jumps.image.depth, depth.shape
    shown = depth > 0
    if not shown.any():
        return Outline()
    step = np.maximum(jumps.step, STEEPEST / jumps.image.camera.focal_x_px * depth)
    edge = shown & ~ndimage.binary_erosion(shown)
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        near, far = depth[first], depth[second]
        folds = shown[first] & shown[second] & (np.abs(far - near) > 2 * step[first])
        edge[first] |= folds & (near < far)
        edge[second] |= folds & (far < near)
    v, u = np.nonzero(edge)
    hit, covered, off = np.zeros(len(v), dtype=bool), np.zeros(len(v), dtype=bool), (EDGE_OFF + 1) * step[v, u]
    for down in range(-EDGE_OFF - 1, EDGE_OFF + 2):
        for right in range(-EDGE_OFF - 1, EDGE_OFF + 2):
            at = np.clip(v + down, 0, height - 1), np.clip(u + right, 0, width - 1)
            covered |= (measured[at] > 0) & (measured[at] < depth[v, u] - off)
            if max(abs(down), abs(right)) <= EDGE_OFF:
                hit |= jumps.nearer[at] & (np.abs(measured[at] - depth[v, u]) < off)
    known = ndimage.uniform_filter(jumps.known.astype(np.float64), 2 * EDGE_OFF + 1)[v, u] > 0.5
    in_picture = (u >= EDGE_OFF) & (v >= EDGE_OFF) & (u < width - EDGE_OFF) & (v < height - EDGE_OFF)
    counts = known & in_picture & ~covered
    flat = ndimage.binary_erosion(shown, iterations=EDGE_OFF + 1) & ~ndimage.binary_dilation(
        edge, iterations=EDGE_OFF + 1
    )
    core = ndimage.binary_erosion(shown, iterations=EDGE_OFF) & (measured > 0)
    behind = measured - depth
    return Outline(
        hits=int((counts & hit).sum()),
        misses=int((counts & ~hit).sum()),
        extra=int((flat & jumps.nearer).sum()),
        past=int((core & (behind > 1.5 * step)).sum()),
        hidden=int((core & (behind < -1.5 * step)).sum()),
        shown=int(shown.sum()),
    )
