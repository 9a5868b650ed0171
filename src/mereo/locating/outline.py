"""Evidence of a posed object in a depth image against something else that stands there.

    DepthImage -Jumps.of-> Jumps; depth of a posed object -compare_outline-> Outline (counts of pixels, and nats)

A smooth thing explains the points of a smooth surface as well as the object does, so agreement inside says little. What
the object alone predicts is where the surface ends: along its outline, and where it folds over itself, the image has a
jump in depth; and no pixel has seen past it.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from mereo.geometry.camera import DepthImage, PixelMask, PixelValues
from mereo.geometry.surface_patches import noise_of_differences, second_differences
from mereo.locating.regions import off_planes, steepest

EDGE_OFF = 3
"""Pixels by which a camera's edges may be off; what so many pixels say is not independent."""

GAP = 30
"""Pixels without a measurement across which a jump is looked for: stereo cameras miss what is beside an edge."""

NOISE_STD = 5.0
"""Standard deviations of a camera's noise from which on a gap between neighbours is a jump."""

HIT, CREASE, MISS, PAST, SEEN = 0.28, -0.26, -1.2, -3.3, 2.0
"""Nats of independent pixels: of the outline with a jump, with a crease alone, and without either. Of the root of the
number of those inside that have seen past the object, which lie together; and of the logarithm of the share that
nothing hides. By a logistic regression of training desks, but for the last (docs/experiments/091.md)."""

CREASE_STD = 6.0
"""Standard deviations of their noise from which on second differences show a crease, as where a thing stands."""


class Jumps(NamedTuple):
    """Jumps in depth between measured pixels that follow each other along rows or columns of an image.

    Attributes:
        image: the depth image.
        step: gap from which on there is a jump, in the image's unit, at each pixel.
        nearer: pixels on the nearer side of a jump.
        known: pixels where a jump would have been seen.
        creased: pixels beside a large plane where there is a crease, or where none could be told from noise.
    """

    image: DepthImage
    step: PixelValues
    nearer: PixelMask
    known: PixelMask
    creased: PixelMask

    @classmethod
    def of(cls, image: DepthImage, length: float) -> "Jumps":
        """Jumps of an image, by more than a slope or noise explains; an object of this ``length`` stands on planes."""
        depth = image.depth
        noise = noise_of_differences(second_differences(depth, 1), second_differences(depth.T, 1))
        step = np.maximum(steepest(image) * depth, NOISE_STD * noise * depth**2)
        rows = _along_rows(depth, step)
        columns = _along_rows(np.ascontiguousarray(depth.T), np.ascontiguousarray(step.T))
        nearer, known = (first | second.T for first, second in zip(rows, columns, strict=True))
        lag = EDGE_OFF + 1
        second = second_differences(depth, lag), second_differences(depth.T, lag).T
        least = CREASE_STD * np.sqrt(6.0) * noise_of_differences(*second)
        sharpest = np.fmax(*(np.abs(part) for part in second))
        # a crease of a right angle changes inverse depth by so much
        creased = (np.nan_to_num(sharpest) > least) | (lag / image.camera.focal_px < least * depth)
        planes = image.valid & ~off_planes(image, length)
        creased, planes = (
            ndimage.maximum_filter(each, 2 * reach + 1) for each, reach in ((creased, EDGE_OFF), (planes, lag))
        )
        return cls(image, step, nearer, known, creased & planes)


def _along_rows(depth: PixelValues, step: PixelValues) -> tuple[PixelMask, PixelMask]:
    """``Jumps.nearer`` and ``Jumps.known`` by the rows alone."""
    width = depth.shape[1]
    measured = np.flatnonzero(depth)
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
        hits, creases, misses: of the outline, folds included, with a jump of the image beside them; with a crease
            alone, as where the object stands on something; and without either.
        past: inside, that saw something behind the object.
        hidden: inside, that saw something before the object.
        shown: all that the object would cover.
    """

    hits: int = 0
    creases: int = 0
    misses: int = 0
    past: int = 0
    hidden: int = 0
    shown: int = 0

    @property
    def nats(self) -> float:
        """Logarithm of how much likelier that is of the object than of something else that was taken for it.

        An object that would cover nothing in the picture is not what was seen.
        """
        if not self.shown:
            return -np.inf
        independent = EDGE_OFF + 1
        edge = (HIT * self.hits + CREASE * self.creases + MISS * self.misses) / independent
        seen = SEEN * np.log1p(-self.hidden / (self.shown + 1))
        return float(edge + PAST * np.sqrt(self.past) / independent + seen)


def compare_outline(jumps: Jumps, depth: PixelValues) -> Outline:
    """Compare the rendered ``depth`` of a posed object, 0 where it is not, with an image's."""
    measured, (height, width) = jumps.image.depth, depth.shape
    shown = depth > 0
    step = np.maximum(jumps.step, steepest(jumps.image) * depth)
    edge = shown & ~ndimage.binary_erosion(shown)
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        near, far = depth[first], depth[second]
        folds = shown[first] & shown[second] & (np.abs(far - near) > 2 * step[first])
        edge[first] |= folds & (near < far)
        edge[second] |= folds & (far < near)
    v, u = np.nonzero(edge)
    hit = np.zeros(len(v), dtype=bool)
    covered = np.zeros(len(v), dtype=bool)
    off = (EDGE_OFF + 1) * step[v, u]
    for down in range(-EDGE_OFF - 1, EDGE_OFF + 2):
        for right in range(-EDGE_OFF - 1, EDGE_OFF + 2):
            at = np.clip(v + down, 0, height - 1), np.clip(u + right, 0, width - 1)
            covered |= (measured[at] > 0) & (measured[at] < depth[v, u] - off)
            if max(abs(down), abs(right)) <= EDGE_OFF:
                hit |= jumps.nearer[at] & (np.abs(measured[at] - depth[v, u]) < off)
    known = ndimage.uniform_filter(jumps.known.astype(np.float64), 2 * EDGE_OFF + 1)[v, u] > 0.5
    creased = jumps.creased[v, u]
    in_picture = (u >= EDGE_OFF) & (v >= EDGE_OFF) & (u < width - EDGE_OFF) & (v < height - EDGE_OFF)
    counts = known & in_picture & ~covered
    core = ndimage.binary_erosion(shown, iterations=EDGE_OFF) & (measured > 0)
    behind = measured - depth
    return Outline(
        hits=int((counts & hit).sum()),
        creases=int((counts & ~hit & creased).sum()),
        misses=int((counts & ~hit & ~creased).sum()),
        past=int((core & (behind > 1.5 * step)).sum()),
        hidden=int((core & (behind < -1.5 * step)).sum()),
        shown=int(shown.sum()),
    )
