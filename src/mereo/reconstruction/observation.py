"""The object in one frame of a sensor: what a reconstruction starts from.

SensorFrame -find_object-> Observation (the object's points, and what each step left out)
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import pi
from pathlib import Path

import numpy as np
from numpy.linalg import inv, lstsq, norm, svd
from numpy.random import default_rng
from scipy import ndimage
from scipy.spatial import cKDTree

from mereo.geometry.brief import counted
from mereo.geometry.camera import (
    NOT_KNOWN,
    DepthImage,
    PixelMask,
    PixelValues,
    PointCloud,
    SharedNoise,
    SightKind,
    SightLines,
    into_camera,
)
from mereo.geometry.conventions import MIN_POINTS, CloudAxes, Pair, Triple
from mereo.geometry.downsampling import MAX_POINTS, STEEPEST, random_subset
from mereo.geometry.surface_patches import noise_of_differences, second_differences
from mereo.geometry.transforms import Flags, Indices, Points, Transform, Values, longest_side, transform_points
from mereo.io.atomic_files import JsonObject
from mereo.io.sensor_frame import SensorFrame
from mereo.reconstruction.config import Extent, IsolationConfig
from mereo.reconstruction.isolation import (
    IsolationStep,
    Reading,
    Selection,
    clusters,
    largest_plane,
    readings,
    select_object,
)

SIZE_FACTOR = 2.0
"""Times that a visible part may be smaller or larger than any in training; beyond, it is another object or unit."""

CLOUD = Path("cloud")
"""Name of a frame that comes from no file."""

STRAIGHT = 1e-6
"""Spread of points across a line, in that along it, up to which they say nothing of a surface; fits take minutes to."""

LIKE_SIZE, APART = 0.4, 0.25
"""Points of a second cluster, in those of the largest, and its distance from that, in its own size, from which on both
may be objects."""


HOLE_PX = 5
"""Pixels from a point that is stated up to which the object is measured: cameras leave holes, and hands are unsure."""


class FrameWarning(UserWarning):
    """Warning that what is seen may not be the object, or not the object alone."""


class ClustersWarning(FrameWarning):
    """Warning that two separate things of like size are seen."""


class SizeWarning(FrameWarning):
    """Warning that what is seen is not as large as the object that a model was trained on."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Object in a frame of a sensor: its points, and what isolation left out.

    Attributes:
        frame: everything that the sensor measured.
        cloud: the object's points, in the frame's axes and unit.
        steps: what isolation left out.
        selection: points of the frame that isolation took for the object's; None means all.
        extent: how much of the object's outline the frame shows, see ``IsolationConfig``; of ``find_object``, "surface"
            where "auto" has found one.
        initial_pose: rough ``T_camera_model`` from which a fit starts, as ``Result.pose``; None where a search or a
            network finds the object.
        point: column and row of a pixel that shows the object; None where nothing says so.
    """

    frame: SensorFrame
    cloud: PointCloud
    steps: tuple[IsolationStep, ...] = ()
    selection: Selection | None = None
    extent: Extent = "auto"
    initial_pose: Transform | None = None
    point: Pair | None = None

    @cached_property
    def lines(self) -> SightLines:
        """Lines of sight around the object, in the frame's axes and unit; strays count as the object's points."""
        return lines_of_frame(self.frame, self.selection, self.extent)

    @cached_property
    def main_length(self) -> float:
        """``main_length`` of the object's points, which takes long to find for a whole image."""
        return main_length(self.cloud.points)

    @property
    def where(self) -> str:
        """Phrase for where the object is looked for."""
        return "in this frame" if self.point is None else "at the point {} {}".format(*self.point)

    def kept_pixels(self) -> PixelMask:
        """Measured pixels of the depth image that isolation keeps."""
        assert self.frame.depth is not None
        kept = self.frame.depth.valid.copy()
        kept[kept] = self.selection is None or self.selection.of_object(self.frame.cloud.points)
        return kept

    def at_measurement(self) -> "Observation":
        """The object whose point, if it has one, is the nearest measured pixel.

        Raises ``ValueError`` for a frame without pixels, a point outside of them, and one ``HOLE_PX`` away from all.
        """
        if self.point is None:
            return self
        if self.frame.depth is None or not len(self.cloud):
            raise ValueError(f"{self.frame.source} has no pixels with a depth, of which a point is: crop with --box")
        (column, row), kept = self.point, self.kept_pixels()
        rows, columns = np.nonzero(kept)
        distance = np.hypot(columns - column, rows - row)
        nearest = int(distance.argmin())
        if distance[nearest] > HOLE_PX or row >= len(kept) or column >= len(kept[0]):
            raise ValueError(
                f"the point {column} {row} lies outside the {len(kept[0])} x {len(kept)} pixels of {self.frame.source} "
                f"or more than {HOLE_PX} pixels from any that is measured and kept (the nearest is {columns[nearest]} "
                f"{rows[nearest]}): give column and row, from 0 at the upper left, of a pixel on the object"
            )
        return replace(self, point=(int(columns[nearest]), int(rows[nearest])))

    @cached_property
    def self_hidden(self) -> float:
        """Share of the points that others would hide from the camera (``hidden_share``); 0 of an image or a surface."""
        if self.frame.depth is not None or self.extent == "surface":
            return 0.0
        points = self.cloud.points
        return hidden_share(transform_points(into_camera(points, self.frame.axes), points))

    @property
    def doubt(self) -> str | None:
        """Sentence why no answer to the frame can be believed, as it cannot be one view; None where it can be."""
        if self.self_hidden <= MOST_HIDDEN:
            return None
        return (
            f"{self.self_hidden:.0%} of the points lie behind others, so the cloud holds surfaces that hide each other "
            "from the camera, as merged views do: give one view, as its camera saw it"
        )

    def readings(self, keep_all: bool = False) -> tuple[Reading, ...]:
        """Readings of ``cloud``; one of a surface, of which no line of sight says what is off it."""
        return readings(self.cloud, self.frame.axes, keep_all or self.extent == "surface")

    def read_as(self, reading: Reading) -> "Observation":
        """The object as a reading of ``cloud`` has it: what was dropped as strays is a step of its own."""
        steps = self.steps if reading.step is None else (*self.steps, reading.step)
        return replace(self, cloud=reading.cloud, steps=steps)

    def in_unit(self, unit_m: float | None) -> "Observation":
        """The object with the frame's unit, where the frame does not know it."""
        if unit_m is None or self.frame.unit_m is not None:
            return self
        return replace(self, frame=replace(self.frame, unit_m=unit_m))

    def __repr__(self) -> str:
        size = " x ".join(f"{side:.3g}" for side in self.size_m)
        points = counted(len(self.cloud), "point")
        return f"Observation({self.frame.source!r}, {points}, {size} {self.frame.length_name})"

    @property
    def depth_m(self) -> Triple:
        """Nearest, middle and farthest depth of the object in metres, or in the frame's unit where it is not known."""
        return depths(self.cloud, self.frame.metres)

    @property
    def size_m(self) -> Triple:
        """Sides of the visible part's box in metres, or in the frame's unit where it is not known."""
        x, y, z = (np.ptp(self.cloud.points, axis=0) * self.frame.metres).tolist()
        return x, y, z

    def facts(self) -> JsonObject:
        """Source, unit, depth, size and steps, dropped strays among them, for a result's summary.

        What is in metres is None where the unit is not known.
        """
        known = self.frame.unit_m is not None
        frame = self.frame
        along_z = known and frame.axes == "camera" and frame.T_result_seen is None
        return {
            "source": self.frame.source,
            "unit_m": self.frame.unit_m,
            "depth_m": self.depth_m if along_z else None,
            "visible_size_m": self.size_m if known else None,
            "invalid_points": self.frame.invalid,
            "T_input_result": None if self.frame.T_input_result is None else self.frame.T_input_result.tolist(),
            "extent": self.extent,
            "isolation": [asdict(step) for step in self.steps],
        }

    def __str__(self) -> str:
        """One line for the frame, one for each step, one for what is left."""
        lines = [self._line("the frame has", self.frame.cloud)] if self.steps else []
        if self.frame.invalid:
            lines.append(f"{counted(self.frame.invalid, 'point')} without a measurement left out")
        lines += [f"  {step}" for step in self.steps]
        lines.append(self._line("the object has", self.cloud))
        if self.extent == "surface":
            lines.append("it is a surface that no single camera saw (--extent partial takes it for a camera's cloud)")
        size = " x ".join(f"{side:.3g}" for side in self.size_m)
        return "\n".join([*lines, f"its visible part is {size} {self.frame.length_name}"])

    def _line(self, start: str, cloud: PointCloud) -> str:
        near, middle, far = depths(cloud, self.frame.metres)
        unit = self.frame.length_name
        points = f"{start} {len(cloud)} points"
        if self.frame.axes == "scanner":
            return points
        return f"{points}, depth {near:.3g} to {far:.3g} {unit} (middle {middle:.3g} {unit})"


def main_length(points: Points) -> float:
    """Length of the box of some points, without the outermost hundredths."""
    return longest_side(np.quantile(points, (0.01, 0.99), axis=0))


def depths(cloud: PointCloud, factor: float) -> Triple:
    """Nearest, middle and farthest z of a cloud, times a factor."""
    near, middle, far = (np.quantile(cloud.points[:, 2], [0.0, 0.5, 1.0]) * factor).tolist()
    return near, middle, far


def find_object(
    frame: SensorFrame,
    isolation: IsolationConfig = IsolationConfig(),  # noqa: B008 (frozen)
) -> Observation:
    """Object in a frame: everything that the steps of ``isolation`` keep, whose lengths are all in metres.

    A frame whose unit is not known is taken to be in metres.

    Raises ``ValueError`` where too little is left, and for a range of depths in a scanner's axes.
    """
    if isolation.depth_range is not None and frame.axes == "scanner":
        raise ValueError(
            f"{frame.path} is in a scanner's frame, in which depth is not known: leave out --depth-range and crop with "
            "--box"
        )
    selection = select_object(frame.cloud, isolation, frame.metres, frame.axes)
    cloud = frame.cloud.rows(selection.keep)
    if _is_straight(cloud.points):
        raise ValueError(
            f"the {len(cloud)} points of {frame.source} lie on a line or at one place; the object's surface must be "
            "seen: check the columns of the file, and what is cropped"
        )
    extent = "surface" if isolation.extent == "auto" and is_surface(frame, cloud) else isolation.extent
    if extent == "surface":
        if frame.depth is not None:
            raise ValueError(
                f"the extent is a surface without a camera, but {frame.source} is a depth image, which a camera saw: "
                "leave out --extent surface"
            )
        frame = replace(frame, axes="scanner")  # in which nobody knows where a camera was
    point = None if isolation.point is None else (int(isolation.point[0]), int(isolation.point[1]))
    return Observation(frame, cloud, selection.steps, selection, extent, point=point)


def _is_straight(points: Points) -> bool:
    """Whether enough points lie on a line or at one place; fewer are refused by that."""
    if len(points) < MIN_POINTS:
        return False
    along, across, _ = svd(points - points.mean(axis=0), compute_uv=False)
    return bool(across <= STRAIGHT * along)


def observe(
    cloud: PointCloud, axes: CloudAxes = "camera", unit_m: float | None = None, extent: Extent = "auto"
) -> Observation:
    """Observation of points that are all the object's, in ``unit_m`` metres or an unknown unit.

    ``extent`` is how much of the object's outline they show, see ``IsolationConfig``.
    """
    return Observation(SensorFrame(CLOUD, cloud, unit_m, axes), cloud, extent=extent)


def size_warning(observation: Observation, provenance: Mapping[str, object]) -> str | None:
    """Sentence where the visible part cannot be the object that a model was trained on; None where it can.

    None also for a frame whose unit is not known, which may be of any size.

    ``provenance["visible_m"]`` is the least and greatest longest side of the visible part in training, in metres;
    models of objects whose true size is not known have none.
    """
    seen = provenance.get("visible_m")
    if not isinstance(seen, list | tuple) or observation.frame.unit_m is None:
        return None
    least, greatest = (float(value) for value in seen)
    longest = max(observation.size_m)
    if least / SIZE_FACTOR <= longest <= greatest * SIZE_FACTOR:
        return None
    return (
        f"the visible part is {longest:.3g} m long, but {least:.3g} to {greatest:.3g} m in training: other things are "
        "in the cloud (crop with --box or --depth-range), or its unit is wrong (--unit-m 0.001 for clouds in "
        "millimetres, --depth-scale for images); results are in the cloud's unit all the same"
    )


def clusters_warning(observation: Observation) -> str | None:
    """Sentence where the cloud is two separate clusters of like size, of which one may be another object; else None."""
    points = random_subset(observation.cloud.points, MAX_POINTS)
    label = clusters(points)
    first, second = points[label == 0], points[label == 1]
    if len(second) < max(MIN_POINTS, LIKE_SIZE * len(first)):
        return None
    gap = cKDTree(first).query(second)[0].min()
    size = norm(np.ptp(second, axis=0))
    if gap < APART * size:
        return None
    metres, name = observation.frame.metres, observation.frame.length_name
    return (
        f"the cloud has two separate clusters of like size ({len(first)} and {len(second)} of {len(points)} points, "
        f"{gap * metres:.3g} {name} apart), and one object is looked for in all of it: if they are two, crop to one "
        "with --box, or take the larger one with --largest-cluster"
    )


# --- merged views -----------------------------------------------------------------------------------------------------

# A camera measures one depth along each line of sight. In a cloud of several views, or of a whole surface, points lie
# behind a closed ring of nearer ones, by more than a slope or noise explains.

RING, PROBES = 12, 2000
"""Neighbours in the picture around a line of sight, and the number of points that are looked at."""

STEP = 3.0
"""Gap in distance between the nearer and the farther of these neighbours, in standard deviations within either, from
which on they are two surfaces. Noise alone, however strong, heavy-tailed or stepped, does it at 1 % of the points."""

MOST_HIDDEN = 0.1
"""Share of points behind others from which on a cloud is no single view.

Of 684 simulated views of eleven objects (three kinds of noise, hands and tools in front, wrong masks; 64 to 192 pixels)
none has more than .091, of real frames and scans none more than .033. Liver, skull, bunny and tumor have .39 to .53
from front and back, .29 to .39 from all sides, .11 to .28 in two views at a right angle. What is thinner than four
pixels has less, and bars or holes of one or two pixels have more."""


def hidden_share(points: Points) -> float:
    """Share of points that other points hide from a camera at the origin, by the pitch of the points in the picture.

    0 for fewer than ``RING`` points; ``points`` are in the camera frame, in any unit.
    """
    points = random_subset(points, MAX_POINTS)
    if len(points) <= RING:
        return 0.0
    distance = norm(points, axis=1)
    sight = points / np.maximum(distance, 1e-300)[:, None]
    flat = sight @ svd(sight.mean(axis=0)[None])[2][1:].T
    probes = random_subset(np.arange(len(points)), PROBES)
    angle, ring = cKDTree(flat).query(flat[probes], k=RING + 1)
    ordered = np.sort(distance[ring], axis=1)
    gaps = np.diff(ordered, axis=1)
    last = gaps.argmax(axis=1)[:, None]
    gap, edge = (np.take_along_axis(values, last, axis=1) for values in (gaps, ordered))
    is_near = np.arange(RING + 1) <= last
    near, far = (np.average(ordered, axis=1, weights=each)[:, None] for each in (is_near, ~is_near))
    spread = (ordered - np.where(is_near, near, far)).std(axis=1, keepdims=True)
    pitch = np.median(angle[:, 4])  # the fourth neighbour of a pixel is one pitch away, as the first is
    is_behind = (distance[probes, None] > edge) & (gap > STEEPEST * pitch * edge) & (gap > STEP * spread)
    turns = np.linspace(0, 2 * pi, RING, endpoint=False)
    ahead = (flat[ring] - flat[probes, None]) @ np.stack([np.cos(turns), np.sin(turns)]) > 0
    is_closed = (ahead & (distance[ring] <= edge)[..., None]).any(axis=1).all(axis=1)
    return float((is_behind[:, 0] & is_closed).mean())


MOST_AVERTED = 0.1
"""Share of the points whose normals point away from a camera from which on no camera saw them, as of ``MOST_HIDDEN``;
fewer lie at edges, and where nearly all do, the normals point inwards."""

MOST_TORN = 0.25
"""Share of the points whose neighbour's normal points the other way up to which normals are consistent: of stitched
views of thin objects it is .16 at most, of random signs a half."""


def is_surface(frame: SensorFrame, cloud: PointCloud) -> bool:
    """Whether a cloud has consistent normals, and no camera at the frame's origin can have seen all of it."""
    if frame.depth is not None or cloud.normals is None or len(cloud) < MIN_POINTS:
        return False
    T = into_camera(cloud.points, frame.axes)
    some = random_subset(np.arange(len(cloud)), MAX_POINTS)
    seen = PointCloud(cloud.points[some], cloud.normals[some]).transformed(T)
    points, normals = seen.points, seen.normals
    assert normals is not None
    near = cKDTree(points).query(points, k=[2])[1][:, 0]
    if (np.einsum("ni,ni->n", normals, normals[near]) < 0).mean() > MOST_TORN:
        return False
    averted = float((np.einsum("ni,ni->n", normals, points) > 0).mean())
    is_inward = averted > 1 - MOST_AVERTED and bool((points[:, 2] > 0).all())
    return (averted > MOST_AVERTED and not is_inward) or hidden_share(points) > MOST_HIDDEN


# --- lines of sight ---------------------------------------------------------------------------------------------------

# Each that met something beside the object is free up to there, whatever that is; along the others nothing is known
# (docs/registration.md). A depth image states a line of sight for each pixel, a point cloud for each point that
# isolation left out.

MOST_LINES = 10_000
"""Number of lines of sight that are kept, at most, unless the outline alone has more."""

RIM = 1.5
"""Pixels from the object within which a line of sight is unknown: masks are wrong by one, and cameras mix both sides of
an edge."""

SILENT = 0.02
"""Share of the pixels around the object below which those that met something are too few: then a depth of zero may as
well mean that the image was cut out or rendered."""

FEWEST, ENOUGH = 4000, 20_000
"""Pixels of a plane around the object that show a camera's noise; and pixels by which the plane is found."""

ALIKE = 0.1
"""Correlation of two pixels' noise, in that of neighbours, up to which it is told from chance."""

ON_PLANE, FITS = 3.0, 8
"""Standard deviations from a plane up to which a pixel is on it, and fits to those that are."""

DENSE = 3.0
"""Pixels from the object within which no line of sight is left out."""


OTHER_LINES: Mapping[Extent, SightKind] = {"partial": "unknown", "surface": "none"}
"""Kind of all lines of sight around the object where the extent alone says it."""


def lines_of_frame(frame: SensorFrame, selection: Selection | None, extent: Extent = "auto") -> SightLines:
    """Lines of sight around the object of a frame, in the frame's axes and unit.

    Args:
        frame: everything that was measured.
        selection: points of ``frame.cloud`` that are the object's; None means all.
        extent: how much of the object's outline the frame shows, see ``IsolationConfig``.
    """
    if extent in OTHER_LINES:
        return SightLines.of_cloud(OTHER_LINES[extent])
    points = frame.cloud.points
    is_object = np.ones(len(points), bool) if selection is None else selection.of_object(points)
    if frame.depth is not None and frame.depth.valid.sum() == len(points):
        shown = np.zeros(frame.depth.depth.shape, bool)
        shown[frame.depth.valid] = is_object
        lines = lines_of_image(frame.depth if frame.whole is None else frame.whole, shown)
    else:
        T_camera_input = into_camera(points[is_object], frame.axes)
        lines = lines_of_points(transform_points(T_camera_input, points), is_object)
        lines = lines.transformed(inv(T_camera_input))
    return replace(lines, unknown=np.empty((0, 3)), other_lines="past") if extent == "whole" else lines


# --- depth images ----------------------------------------------------------------------------------------------------


def lines_of_image(whole: DepthImage, shown: PixelMask) -> SightLines:
    """Lines of sight around the object in a depth image, in the camera frame and the image's unit.

    They are those of pixels within one size of the object around its box. Where hardly any of them met something, zeros
    do not say that nothing was measured, and the rest is left open.

    Args:
        whole: the depth image with all that was measured.
        shown: pixels that show the object.
    """
    rows = np.flatnonzero(shown.any(axis=1)).tolist()
    columns = np.flatnonzero(shown.any(axis=0)).tolist()
    height, width = rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1
    reach = max(height, width)
    # the window may reach beyond the picture
    top, left = rows[0] - reach, columns[0] - reach
    part = np.s_[rows[0] : rows[-1] + 1 + 2 * reach, columns[0] : columns[-1] + 1 + 2 * reach]
    depth, is_object, inside = (np.pad(image, reach)[part] for image in (whole.depth, shown, np.ones_like(shown)))
    # nothing of the object lies outside the picture unless it reaches the edge
    cut = min(rows[0], columns[0], shown.shape[0] - 1 - rows[-1], shown.shape[1] - 1 - columns[-1]) < RIM
    distance = ndimage.distance_transform_edt(~is_object)
    past = (depth > 0) & (distance > RIM)
    silent = past.sum() < max(SILENT * (inside & (distance > RIM)).sum(), 1)
    unknown = ~is_object & ~past & ((inside & ((depth > 0) | (not silent))) | (~inside & cut))
    v, u = np.nonzero(past | unknown)
    kept = _evenly(u, v, distance[v, u], MOST_LINES)
    u, v = u[kept], v[kept]
    met = past[v, u]
    places = whole.camera.unproject(np.stack([u + left + 0.5, v + top + 0.5], axis=1), np.where(met, depth[v, u], 1.0))
    return SightLines(places[met], places[~met], None if silent else "unknown", shared_noise(whole, shown))


def shared_noise(whole: DepthImage, shown: PixelMask) -> SharedNoise:
    """Measure the noise of a camera that neighbours share, at the distance of ``shown`` pixels.

    What the largest plane around them leaves over beyond the noise of single pixels, where it is about as far away;
    Unknown without such a plane. Noise is taken to grow as the square of the distance, and to fall as the distance: up
    close something else than disparity limits a camera. It is shared over a square, whose side is an angle.
    """
    (height, width), depth = shown.shape, whole.depth
    others = np.flatnonzero(np.where(shown, 0.0, depth))
    if len(others) < FEWEST or not (shown & whole.valid).any():
        return NOT_KNOWN
    distance = float(np.median(depth[shown & whole.valid]))

    def terms(pixels: Indices) -> Points:
        """What inverse depth is linear in along a plane."""
        return np.stack([pixels % width, pixels // width, np.full(len(pixels), width)], axis=1) / width

    some = others[:: 1 + len(others) // ENOUGH]
    places = terms(some)
    inverse = 1.0 / depth.ravel()[some]
    points = whole.camera.unproject(width * places[:, :2] + 0.5, 1.0 / inverse)
    focal_px = whole.camera.focal_px
    pixel = points[:, 2] / focal_px
    plane = largest_plane(points, pixel, default_rng(0))
    if plane is None:
        return NOT_KNOWN
    is_on = plane.distance(points) <= pixel
    for _ in range(FITS):
        linear = lstsq(places[is_on], inverse[is_on])[0]
        off = inverse - places @ linear
        noise = float(np.sqrt(np.mean(off[is_on] ** 2)))
        is_on = np.abs(off) <= ON_PLANE * noise
    expected = terms(others) @ linear
    off = 1.0 / depth.ravel()[others] - expected
    rows = np.flatnonzero(np.abs(off) <= ON_PLANE * noise)
    if len(rows) < FEWEST:
        return NOT_KNOWN
    field = np.full(depth.size, np.nan)
    field[others[rows]] = off[rows]
    near = np.argpartition(np.abs(np.log(expected[rows] * distance)), FEWEST - 1)[:FEWEST]
    rows = others[rows[near]]
    flat = np.zeros(depth.size)
    flat[rows] = depth.ravel()[rows]
    left = flat.reshape(height, width)
    alone = noise_of_differences(second_differences(left, 1), second_differences(left.T, 1))
    places = terms(rows)
    inverse = 1.0 / flat[rows]
    off = inverse - places @ lstsq(places, inverse)[0]
    shared = float(np.sqrt(max(np.mean(off**2) - alone**2, 0.0)))
    side = shared_side(field.reshape(height, width)) / focal_px
    return SharedNoise(shared * distance * max(distance, float(np.median(flat[rows]))), side, 1.0 / focal_px)


def shared_side(noise: PixelValues) -> float:
    """Side, in pixels, of a square of as many pixels as share an error; NaN is where none is known.

    That is the integral of the correlation, by its course along rows and columns, as far as it is not noise.
    """
    known = np.isfinite(noise)
    padded = [2 * side for side in noise.shape]
    products, pairs = (
        np.fft.irfft2(np.abs(np.fft.rfft2(image, padded)) ** 2, padded)
        for image in (np.where(known, noise, 0.0), known.astype(float))
    )
    most = min(noise.shape) // 2
    alike = [(products[line] / np.maximum(pairs[line], 1.0))[1:most] for line in (np.s_[0], np.s_[:, 0])]
    together = np.mean(alike, axis=0)
    along = np.arange(1, 1 + int(np.argmax(np.append(together, -np.inf) < ALIKE * together[0])))
    return float(np.sqrt(2 * pi * along @ together[: len(along)] / together[0]))


def _evenly(u: Indices, v: Indices, distance: Values, limit: int) -> Flags:
    """At most ``limit`` of some pixels: all near the object, farther off those of ever coarser grids.

    The pitch of the grid grows with the distance from the object, in pixels, but it is 1 up to ``DENSE``, even where
    more than ``limit`` pixels are so near.
    """
    octaves = np.log2(np.maximum(distance / DENSE, 1.0))
    low = 0.0
    high = float(octaves.max(initial=0.0))  # how many of them are dense
    kept = _on_grids(u, v, octaves)
    if len(u) <= limit or kept.sum() > limit:
        return kept if len(u) > limit else np.ones(len(u), bool)
    while high - low > 0.1:
        middle = 0.5 * (low + high)
        more = _on_grids(u, v, octaves - middle)
        if more.sum() > limit:
            high = middle
        else:
            low, kept = middle, more
    return kept


def _on_grids(u: Indices, v: Indices, octaves: Values) -> Flags:
    """Pixels of which both coordinates are multiples of 2^k, where k is ``octaves`` rounded up, and 0 at least."""
    between = (1 << np.maximum(np.ceil(octaves), 0.0).astype(np.int64)) - 1
    return (u | v) & between == 0


# --- clouds ----------------------------------------------------------------------------------------------------------


def lines_of_points(points: Points, is_object: Flags) -> SightLines:
    """Lines of sight to the points of a cloud that are not the object's; the rest is left open.

    Args:
        points: camera frame.
        is_object: which are the object's.
    """
    ranges = norm(points, axis=1)
    sight = points / np.maximum(ranges, 1e-300)[:, None]
    others = np.flatnonzero(~is_object & (points[:, 2] > 0))
    if len(others) == 0 or not is_object.any():
        return SightLines.of_cloud()
    tree = cKDTree(sight[is_object])
    # the fourth neighbour of a pixel is one pitch away, as the first is
    pitch = float(np.median(tree.query(tree.data, k=[min(len(tree.data), 5)])[0]))
    size = longest_side(tree.data)
    angle = tree.query(sight[others], distance_upper_bound=max(size, pitch))[0]
    # along a line that met the object, nothing else is said
    is_free = (angle > 0.5 * pitch) & np.isfinite(angle)
    others, angle = others[is_free], angle[is_free]
    past = angle > RIM * pitch
    ahead = tree.data.mean(axis=0)
    across = svd(ahead[None])[2][1:]
    u, v = np.floor((sight[others] - ahead) @ across.T / max(pitch, 1e-12)).astype(np.int64).T
    kept = _evenly(u, v, angle / max(pitch, 1e-12), MOST_LINES)
    return SightLines(points[others[past & kept]], points[others[~past & kept]])
