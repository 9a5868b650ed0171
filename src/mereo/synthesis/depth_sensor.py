"""Simulated depth cameras: the paper's Gaussian noise, and errors that real ones add (off by default).

Order of a measurement: what each pixel's ray meets, along a direction that is slightly off (lateral noise); mixed
pixels at depth edges; noise in depth; quantization; missing pixels; and the mask that cuts out the object.
docs/design/0006-sensors.md has the sources and figures. Notation: h x w pixels, z_m depth in metres, angle_rad between
ray and surface normal.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import pi, radians

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator
from scipy import ndimage

from mereo.geometry.camera import Camera, DepthImage, PixelMask, PixelValues
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Hits, Solids
from mereo.geometry.transforms import Labels, Points, Values, unit_rows
from mereo.synthesis.clutter import NOTHING, OBJECT, Surroundings, sample_surroundings
from mereo.synthesis.config import SENSOR_TERMS, SensorConfig, SensorModel

Numbers = Float[ndarray, "*n"]
"""Numbers in any shape, which the whole signature has."""

STEEPEST_RAD = radians(80.0)
"""Largest angle of the noise formulas, which have a pole at 90 degrees: steeper surfaces count as seen at this one."""

GRAZING_RAD = radians(60.0)
"""Angle from which on axial noise rises steeply and pixels go missing."""

KINECT_FOCAL_PX, KINECT_DISPARITY_M = 585.0, 351.3
"""Focal length of the pixels in which lateral noise is stated; depth in metres times disparity in steps."""


@dataclass(frozen=True, eq=False)
class SimulatedView:
    """Measurement of a simulated camera, and the truth about it.

    Attributes:
        whole: everything that was measured.
        mask: the object's pixels, according to the segmentation.
        source: what each pixel's ray met first, ``clutter.OBJECT`` and so on.
    """

    whole: DepthImage
    mask: PixelMask
    source: UInt8[ndarray, "h w"]

    @property
    def image(self) -> DepthImage:
        """Depth image cut out by the mask."""
        return DepthImage(np.where(self.mask, self.whole.depth, 0.0), self.whole.camera)

    @property
    def object_points(self) -> int:
        """Number of pixels of ``image`` that show the object."""
        return int((self.mask & self.whole.valid & (self.source == OBJECT)).sum())


def observe(
    solids: Solids,
    camera: Camera,
    noise_std: float,
    sensor: SensorConfig,
    rng: Generator,
    *,
    around: Surroundings | None = None,
) -> SimulatedView:
    """Measurement of an object in the camera frame by a simulated sensor.

    The Gaussian noise of ``noise_std`` is drawn from ``rng`` itself, every other term from a stream of its own that is
    spawned from it. So whatever is drawn from ``rng`` afterwards is the same with any sensor, and switching one term on
    or off leaves the others as they were. Where ``around`` is given, it is what stands around the object, and no
    surroundings are drawn.
    """
    if not sensor.on and around is None:
        image = add_depth_noise(render_depth(solids, camera), noise_std, rng)
        return SimulatedView(image, image.valid, np.where(image.valid, OBJECT, NOTHING).astype(np.uint8))
    streams = dict(zip(SENSOR_TERMS, rng.spawn(len(SENSOR_TERMS)), strict=True))
    hits, source = _look(solids, camera, sensor, streams, around)
    shape = (camera.height, camera.width)
    depth = np.where(np.isfinite(hits.distance), hits.distance, 0.0).reshape(shape)
    angle_rad = _incidence(hits, camera.directions().reshape(-1, 3)).reshape(shape)
    source = source.reshape(shape)
    seen = source == OBJECT
    depth = mix_edges(depth, camera.focal_x_px, sensor.flying, streams["flying"])
    depth = add_axial_noise(depth, angle_rad, sensor, streams["axial"])
    depth = add_depth_noise(DepthImage(depth, camera), noise_std, rng).depth
    if sensor.quantization > 0:
        depth = quantize(depth * sensor.metres_per_unit, sensor.quantization) / sensor.metres_per_unit
    missing = streams["dropout"].random(shape) < dropout_probability(angle_rad, sensor.dropout)
    missing |= sample_holes(depth, seen, camera.focal_x_px, sensor, streams["holes"])
    return SimulatedView(DepthImage(np.where(missing, 0.0, depth), camera), sample_mask(seen, sensor, streams), source)


# --- where rays go ----------------------------------------------------------------------------------------------------


def _look(
    solids: Solids,
    camera: Camera,
    sensor: SensorConfig,
    streams: dict[str, Generator],
    around: Surroundings | None,
) -> tuple[Hits, Labels]:
    """What each pixel's ray meets, with the surroundings and lateral noise."""
    directions = camera.directions().reshape(-1, 3)
    hits = solids.first_hit(directions)
    visible = np.isfinite(hits.distance)
    if visible.sum() < MIN_POINTS:
        return hits, np.where(visible, OBJECT, NOTHING).astype(np.uint8)
    seen = directions[visible] * hits.distance[visible, None]
    reach = float(norm(directions[:, :2], axis=1).max())
    around = sample_surroundings(sensor, solids, seen, reach, streams) if around is None else around
    hits, source = around.join(hits, directions)
    if sensor.lateral == 0:
        return hits, source
    depth = np.where(np.isfinite(hits.distance), hits.distance, np.median(seen[:, 2]))
    std = lateral_std(depth * sensor.metres_per_unit, _incidence(hits, directions), sensor.model)
    moved = directions.copy()
    moved[:, :2] += sensor.lateral * std[:, None] * streams["lateral"].normal(size=(len(directions), 2))
    return around.join(solids.first_hit(moved), moved)


def _incidence(hits: Hits, directions: Points) -> Values:
    """Angle between ray and surface normal in radians, from 0 to pi / 2; 0 where nothing is hit."""
    along = np.abs(np.einsum("ij,ij->i", hits.normal, directions))
    squared = np.einsum("ij,ij->i", hits.normal, hits.normal) * np.einsum("ij,ij->i", directions, directions)
    cosine = along / np.sqrt(np.where(squared > 0, squared, 1.0))
    return np.arccos(np.where(squared > 0, np.minimum(cosine, 1.0), 1.0))


def lateral_std(z_m: Numbers, angle_rad: Numbers, model: SensorModel = "structured-light") -> Numbers:
    """Standard deviation of where a pixel looks, as a slope x/z.

    Structured light: 0.8 + 0.035 a / (pi/2 - a) pixels of the Kinect. Time of flight: 1.6 mm at any depth.
    """
    if model == "time-of-flight":
        return 0.0016 / z_m
    angle = np.minimum(angle_rad, STEEPEST_RAD)
    return (0.8 + 0.035 * angle / (pi / 2 - angle)) / KINECT_FOCAL_PX


# --- depth ------------------------------------------------------------------------------------------------------------


def axial_std_m(z_m: Numbers, angle_rad: Numbers, model: SensorModel = "structured-light") -> Numbers:
    """Standard deviation of the depth in metres, at distance z and angle a.

    Structured light: 0.0012 + 0.0019 (z - 0.4)^2 + 0.0001 z^-1/2 a^2 / (pi/2 - a)^2; its source adds the last term
    beyond 60 degrees only, and here there is no jump. Time of flight: 1.5 - 0.5 z + 0.3 z^2 +
    0.1 z^3/2 a^2 / (pi/2 - a)^2 millimetres.
    """
    angle = np.minimum(angle_rad, STEEPEST_RAD)
    slant = (angle / (pi / 2 - angle)) ** 2
    if model == "time-of-flight":
        return 0.001 * (1.5 - 0.5 * z_m + 0.3 * z_m**2 + 0.1 * z_m**1.5 * slant)
    return 0.0012 + 0.0019 * (z_m - 0.4) ** 2 + 0.0001 * slant / np.sqrt(z_m)


def add_axial_noise(depth: PixelValues, angle_rad: PixelValues, sensor: SensorConfig, rng: Generator) -> PixelValues:
    """Depth with Gaussian noise of ``axial_std_m`` on every measured pixel; misses (0) stay misses."""
    if sensor.axial == 0:
        return depth
    measured = depth > 0
    z_m = depth[measured] * sensor.metres_per_unit
    std_m = sensor.axial * axial_std_m(z_m, angle_rad[measured], sensor.model)
    noisy = depth.copy()
    noise_m = std_m * rng.normal(size=depth.shape)[measured]
    noisy[measured] = np.maximum(z_m + noise_m, np.finfo(np.float32).tiny) / sensor.metres_per_unit
    return noisy


def quantize(z_m: Numbers, strength: float) -> Numbers:
    """Depth of the nearest whole disparity: z -> D / round(D / z), D = 351.3 m / ``strength``; 0 stays 0.

    A triangulating camera measures disparity in steps (an eighth of a pixel in the Kinect), so depth has steps of about
    z^2 / D: 0.7 mm at 0.5 m, 2.8 mm at 1 m. The noise before rounding is left to the axial noise.
    """
    disparity = KINECT_DISPARITY_M / strength
    steps = np.maximum(np.rint(disparity / np.where(z_m > 0, z_m, 1.0)), 1.0)
    return np.where(z_m > 0, disparity / steps, 0.0)


def mix_edges(depth: PixelValues, focal_px: float, probability: float, rng: Generator) -> PixelValues:
    """Depth with flying pixels: at edges, with this probability, a depth between the pixel's own and its neighbour's.

    A pixel whose footprint covers both sides of an edge returns a mixture. How much of each depends on both surfaces'
    brightness, which is unknown: the share is uniform. The neighbour is the one of four that differs most; an edge is
    where it differs by more than one surface seen at 80 degrees would. An edge before nothing at all stays sharp.
    """
    if probability == 0:
        return depth
    padded = np.pad(depth, 1)
    neighbors = np.stack([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
    step = np.where((neighbors > 0) & (depth > 0), neighbors - depth, 0.0)
    largest = np.take_along_axis(step, np.abs(step).argmax(axis=0)[None], axis=0)[0]
    mixed = np.abs(largest) > depth * np.tan(STEEPEST_RAD) / focal_px
    mixed &= rng.random(depth.shape) < probability
    return depth + np.where(mixed, rng.random(depth.shape) * largest, 0.0)


# --- missing pixels, mask ---------------------------------------------------------------------------------------------


def dropout_probability(angle_rad: Numbers, strength: float) -> Numbers:
    """Probability that a pixel is missing: 0 up to 60 degrees of slant, then rising to ``strength`` at 90.

    Light from a matt surface falls with the cosine of the angle, and cameras give up on weak returns. The probability
    is what the cosine lacks of its value at 60 degrees.
    """
    return strength * np.maximum(0.0, 1.0 - np.cos(angle_rad) / np.cos(GRAZING_RAD))


def sample_holes(
    depth: PixelValues,
    seen: PixelMask,
    focal_px: float,
    sensor: SensorConfig,
    rng: Generator,
) -> PixelMask:
    """Pixels in missing blobs, as mirroring and absorbing spots leave them.

    A Poisson number of ellipses at object pixels with gamma-distributed radii (shape 5).
    """
    holes = np.zeros(depth.shape, bool)
    rows, columns = np.nonzero(seen)
    if len(rows) == 0 or sensor.holes == 0:
        return holes
    v, u = np.ogrid[: depth.shape[0], : depth.shape[1]]
    for chosen in rng.integers(len(rows), size=rng.poisson(sensor.holes)):
        row, column = rows[chosen], columns[chosen]
        radii_m = rng.gamma(5.0, sensor.hole_radius_m / 5.0, size=2)
        angle = rng.uniform(0, pi)
        a, b = radii_m * focal_px / (depth[row, column] * sensor.metres_per_unit)
        along = (u - column) * np.cos(angle) + (v - row) * np.sin(angle)
        across = (v - row) * np.cos(angle) - (u - column) * np.sin(angle)
        holes |= (along / a) ** 2 + (across / b) ** 2 <= 1
    return holes


def sample_mask(seen: PixelMask, sensor: SensorConfig, streams: dict[str, Generator]) -> PixelMask:
    """Mask of the object as a segmentation gives it: shifted, its edge too far out here and too far in there.

    The signed distance to the true edge is compared with a smooth random offset, so that neighbouring parts of the edge
    are wrong alike.
    """
    if (sensor.mask_offset_px == 0 and sensor.mask_shift_px == 0) or not seen.any() or seen.all():
        return seen
    outward = ndimage.distance_transform_edt(~seen) - ndimage.distance_transform_edt(seen)
    outward -= 0.5 * np.sign(outward)
    shift = sensor.mask_shift_px * streams["mask_shift_px"].normal(size=2)
    outward = ndimage.shift(outward, shift, order=1, mode="nearest")
    rows, columns = (_bumps(size, 7) for size in seen.shape)  # so many hills along each axis
    field = rows @ streams["mask_offset_px"].normal(size=(7, 7)) @ columns.T  # mean 0 and variance 1
    return outward < sensor.mask_offset_px * field


@lru_cache(maxsize=8)
def _bumps(size: int, nodes: int) -> Float[ndarray, "s n"]:
    """Weights of the nodes at each pixel; their squares sum to 1."""
    pixels = np.arange(size)[:, None] / max(size - 1, 1)
    centers = np.linspace(0, 1, nodes)
    weights = np.exp(-0.5 * ((pixels - centers) * (nodes - 1) / 0.7) ** 2)
    return unit_rows(weights)


# --- rendering (paper, appendix B) ------------------------------------------------------------------------------------


def render_depth(mesh: SegmentedMesh | Solids, camera: Camera) -> DepthImage:
    """Noise-free depth (z, not ray length) of a mesh given in the camera frame; 0 where no surface is hit.

    One ray goes through each pixel's centre. Depth is in the mesh's units, with the relative precision of single
    precision (about 1e-7). Both sides of a face are seen, so a camera inside a segment sees its inner wall. Pass the
    mesh's ``Solids`` where they are needed anyway: their search structures are used.
    """
    solids = mesh if isinstance(mesh, Solids) else Solids(mesh)
    depth = solids.first_hit(camera.directions().reshape(-1, 3)).distance
    return DepthImage(np.where(np.isfinite(depth), depth, 0.0).reshape(camera.height, camera.width), camera)


def add_depth_noise(image: DepthImage, std: float, rng: Generator) -> DepthImage:
    """Depth image with Gaussian noise of standard deviation ``std`` (the depth's unit) on every measured pixel.

    ``rng`` advances by one number per pixel, measured or not. Raises ``ValueError`` when ``std`` is not finite and at
    least 0.
    """
    if not 0 <= std < np.inf:
        raise ValueError(f"the depth noise is {std}; it is a standard deviation, finite and at least 0: correct it")
    noisy = image.depth + rng.normal(0.0, std, size=image.depth.shape)
    # noise cannot turn a hit into a miss, which is what a depth of 0 would mean
    return DepthImage(np.where(image.valid, np.maximum(noisy, np.finfo(np.float32).tiny), 0.0), image.camera)
