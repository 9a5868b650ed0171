"""Regions of a depth image that may be an object: connected surfaces off all flat ones that are longer than it.

DepthImage, length of the object -thinned-> DepthImage -regions-> masks, the likeliest first
"""

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mereo.geometry.camera import Camera, DepthImage, PixelMask
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.downsampling import STEEPEST
from mereo.reconstruction.isolation import largest_plane
from mereo.reconstruction.observation import main_length

ACROSS = 60
"""Pixels along an object at the middle distance in a thinned image, in which blurred edges are a pixel wide."""

PLANES, PLANE_SHARE = 6, 0.03
"""Planes at most, and the share of the points that each must hold: a table, walls, a floor."""

PLANE_STD = 6.0
"""Deviations from a plane, in the median one, up to which a point is on it."""

SIZES = 0.1, 1.3
"""Length of a region, in those of the object: a part of the object, or the object and a rim."""

FOLD = 4.0
"""Gap, in that of ``steepest``, up to which a surface that folds over itself goes on."""

GAPS = 16.0, FOLD, 1.0
"""Gaps at which surfaces are parted, in the same: the first leaves together what hides parts of itself
(docs/experiments/102.md)."""

SAME = 0.9
"""Share of a region that a part of it is the same from."""


def thinned(image: DepthImage, length: float) -> tuple[DepthImage, int]:
    """Every so many pixels of an image, where an object of this ``length`` has more than ``ACROSS``; and how many."""
    camera = image.camera
    every = max(1, round(length * camera.focal_px / float(np.median(image.depth[image.valid])) / ACROSS))
    if every == 1:
        return image, 1
    first = every // 2
    depth = image.depth[first::every, first::every]
    center = ((each - first - 0.5) / every + 0.5 for each in (camera.center_x_px, camera.center_y_px))
    height, width = depth.shape
    thin = Camera(width, height, camera.focal_x_px / every, camera.focal_y_px / every, *center)
    return DepthImage(depth, thin), every


def steepest(image: DepthImage) -> float:
    """Gap in depth between neighbouring pixels, as a share of it, from which on there are two surfaces."""
    return STEEPEST / image.camera.focal_px


def off_planes(image: DepthImage, length: float) -> PixelMask:
    """Pixels that are measured, and of no connected part of a plane that is longer than an object of this ``length``.

    So a face of the object stays, and so does what the plane of a table cuts elsewhere.
    """
    points = image.camera.directions() * image.depth[..., None]
    pixel = image.depth / image.camera.focal_px
    off = image.valid.copy()
    left = off.copy()
    rng = np.random.default_rng(0)
    for _ in range(PLANES):
        plane = largest_plane(points[left], pixel[left], rng)
        if plane is None:
            break
        distance = plane.distance(points.reshape(-1, 3)).reshape(pixel.shape)
        near = left & (distance <= pixel)
        if near.sum() < PLANE_SHARE * image.valid.sum():
            break
        most = PLANE_STD * np.median(distance[near] / pixel[near] ** 2)
        on = left & (distance <= most * pixel**2)  # as the noise of depth cameras grows
        left &= ~on
        for mask in parted(on, ndimage.label(on | ~image.valid)[0]):  # what is not measured does not part a plane
            off &= ~mask | (main_length(points[mask]) < SIZES[1] * length)
    return off


def parted(pixels: PixelMask, label: Int[np.ndarray, "h w"]) -> list[PixelMask]:
    """Parts of some pixels by their numbers, but for those that are too small for a fit."""
    return [pixels & (label == number) for number in np.flatnonzero(np.bincount(label[pixels]) >= MIN_POINTS)]


def connected_pixels(depth: Float[np.ndarray, "h w"], step: float) -> Int[np.ndarray, "h w"]:
    """Number of the surface of each pixel, which goes on where depth changes by less than ``step`` times itself.

    A depth of 0 is no surface: such pixels have numbers of their own.
    """
    number = np.arange(depth.size).reshape(depth.shape)
    pairs = []
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        near, far = depth[first], depth[second]
        joined = (near > 0) & (far > 0) & (np.abs(near - far) < step * np.minimum(near, far))
        pairs.append(np.stack([number[first][joined], number[second][joined]]))
    row, column = np.concatenate(pairs, axis=1)
    edges = coo_matrix((np.ones(len(row), dtype=np.int8), (row, column)), shape=(depth.size, depth.size))
    return np.asarray(connected_components(edges, directed=False)[1].reshape(depth.shape))


def regions(image: DepthImage, length: float, area: float) -> list[PixelMask]:
    """Connected surfaces of an image that may be an object of this ``length``, the nearest in ``area`` first.

    ``length`` is in the image's unit, and ``area``, which a whole object covers, in its square.
    """
    points = image.camera.directions() * image.depth[..., None]
    pixel = image.depth**2 / (image.camera.focal_x_px * image.camera.focal_y_px)
    masks = list[PixelMask]()
    parts = [(off_planes(image, length), np.inf)]
    for gap in GAPS:
        wholes = parts
        parts = []
        for whole, size in wholes:
            for mask in parted(whole, connected_pixels(np.where(whole, image.depth, 0.0), gap * steepest(image))):
                count = mask.sum()
                fits = SIZES[0] * length <= main_length(points[mask]) <= SIZES[1] * length
                if fits and count < SAME * size:
                    masks.append(mask)
                parts.append((mask, count if fits else np.inf))
    return sorted(masks, key=lambda mask: abs(np.log(pixel[mask].sum() / area)))
