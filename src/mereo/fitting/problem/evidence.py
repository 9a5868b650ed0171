"""The evidence of a frame: observed points, and what silhouette and free space rule out. The camera is at the origin.

Of a surface that no single camera saw there are points and normals alone (``SurfaceEvidence``).

A vertex of a fitted model may lie neither on a line of sight that went past the object, before what that met (outside
the silhouette), nor in front of the observed points around its line of sight (free space). Nothing is ruled out along
lines of sight on which nothing is known. Lines of sight are compared by their angles, so a depth image and a cloud are
the same.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from mereo.deformation.moving_least_squares import spread
from mereo.geometry.camera import NOT_KNOWN, SharedNoise, SightKind, SightLines
from mereo.geometry.downsampling import means_along_sight, thin_to_grid
from mereo.geometry.surface_patches import roughness
from mereo.geometry.transforms import Points, Values, rotation_along, unit_rows

MOST_POINTS = 6000
"""Denser clouds are averaged to so many points, which have less noise."""

OBSERVED_SAMPLES = 500
"""Observed points, evenly spread, that are compared with the model's surface."""

MORE_SAMPLES = 4000
"""The same of a noisy frame, whose noise averages out over more of them."""

FEWER_SAMPLES = MORE_SAMPLES // 3
"""The same where what neighbours share is an unknown of the fit: with more, errors are the same."""

SILHOUETTE_PITCHES = 1.2
"""Farther from the nearest line of sight than this many pixels is outside."""

AROUND_PITCHES = 1.6
"""Lines of sight nearer than this are a pixel's 3 x 3 neighbours: the nearest depth among them bounds free space.

With a pixel's own depth alone, 6 to 13 % of the true surface counted as in front of what was seen."""

AROUND = 9

UNSEEN_PITCHES = 2.0
"""Farther from the nearest line of sight that met the object, nothing of it was seen: noise and small gaps stay out. By
so much are edges off where a camera's neighbours share all noise."""

NORMAL_POINTS = 12
"""Points by which the surface's direction at an observed one is estimated."""

NOISE_SHARE = 0.01
"""Largest noise of a depth camera, as a share of its distance: two to five times that of the usual ones."""

ROUGHER = 1.4
"""Largest noise of points alone, in the roughness of the cloud's calmest part: right fits leave 0.3 to 1.4
(docs/experiments/085.md), fits to another object up to 4.6 (docs/experiments/072.md)."""

NOISIER = 2.0
"""Largest noise that neighbours share on the object, in that around it: dark and slanted surfaces have more."""

WAVES = 120
"""Waves over the picture by which noise that neighbours share is described, the strongest of as many along each side:
97 % of it in most views, 88 % in two of 17 (docs/experiments/088.md)."""

RIM_PITCHES, EDGE_PITCHES, EDGE_DIRECTIONS = 2.5, 3.5, 8
"""Angles from the observed points, in pixels, between which lines of sight around the object are sampled, and in how
many directions: nearer lies the rim, of which nothing is known in any case (``lines_of_sight.RIM``)."""


UNDECIDED = SightLines.of_cloud()
"""Lines of sight of a bare cloud, of which nothing is stated."""


@dataclass(frozen=True, eq=False)
class PastLines:
    """Lines of sight that went past the object, each to something behind it.

    Attributes:
        sight: search tree over their unit vectors.
        ranges: distance from the camera of what each met.
        reach: angle from each up to which a line of sight without a measurement of its own is taken to be like it.
    """

    sight: cKDTree
    ranges: Float[np.ndarray, " p"]
    reach: Float[np.ndarray, " p"]

    @classmethod
    def of(cls, points: Float[np.ndarray, "p 3"], pitch: float) -> "PastLines | None":
        """Lines of sight to points behind an object whose own are ``pitch`` apart; None without any."""
        if not len(points):
            return None
        ranges = np.linalg.norm(points, axis=1)
        sight = cKDTree(points / ranges[:, None])
        angle = sight.query(sight.data, k=[min(AROUND, len(points))])[0][:, 0]
        return cls(sight, ranges, AROUND_PITCHES * np.maximum(pitch, angle))


@dataclass(frozen=True, eq=False)
class Directions:
    """Normals of points, to be compared with those of a surface.

    Attributes:
        lift: makes vectors of normals, which are the same for normals that count as the same.
        lifted: those of the points.
        length: what a difference of 1 between two of them is worth, scene units.
    """

    lift: Callable[[np.ndarray], np.ndarray]
    lifted: Float[np.ndarray, "p d"]
    length: float

    def nearest(
        self,
        points: Float[np.ndarray, "p 3"],
        places: Float[np.ndarray, "s 3"],
        normals: Float[np.ndarray, "s 3"],
    ) -> tuple[Float[np.ndarray, " p"], Int[np.ndarray, " p"]]:
        """Distance and row of the place that is nearest to each point in position and direction."""
        places = np.concatenate([places, self.length * self.lift(normals)], axis=1)
        tree = cKDTree(places, balanced_tree=False, compact_nodes=False)
        distance, near = tree.query(np.concatenate([points, self.length * self.lifted], axis=1))
        return distance, near

    def rows(self, rows: Int[np.ndarray, " r"]) -> "Directions":
        """Those of some of the points."""
        return replace(self, lifted=self.lifted[rows])

    def agreement(self, normals: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
        """How well normals of a surface, one for each point, agree with the points': 1 where they are the same."""
        return np.clip(np.einsum("pi,pi->p", self.lift(normals), self.lifted), 0.0, 1.0)


def signed(normals: np.ndarray) -> np.ndarray:
    """Normals as they are."""
    return normals


def without_sign(normals: np.ndarray) -> np.ndarray:
    """Vectors (... 9) that are the same for a normal and its reverse; their product is the square of the normals'."""
    return (normals[..., :, None] * normals[..., None, :]).reshape(*normals.shape[:-1], 9)


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """What neighbours share of a camera's noise, taken out of points.

    Attributes:
        measured: the points as they were measured.
        axes: vectors, in rows, by which each of them is off where an amplitude is 1.
        waves: value of each wave at each point.
        amplitudes: of each wave along each axis, N(0, 1) before the frame was seen.
    """

    measured: Points
    axes: Float32[np.ndarray, "n 3 3"]
    waves: Float32[np.ndarray, "n w"]
    amplitudes: Float[np.ndarray, "a"]

    @classmethod
    def none(cls, points: Points) -> "SharedErrors":
        """Nothing, of points of which nothing is known."""
        axes = np.zeros((len(points), 3, 3), dtype=np.float32)
        return cls(points, axes, np.zeros((len(points), 0), dtype=np.float32), np.zeros(0))

    @property
    def square(self) -> float:
        """Misfit of the amplitudes."""
        return float(self.amplitudes @ self.amplitudes)

    @property
    def offsets(self) -> Float32[np.ndarray, "n 3"]:
        """By how much each point is off."""
        along = self.waves @ self.amplitudes.reshape(3, -1).T.astype(np.float32)
        return np.einsum("na,nai->ni", along, self.axes)

    def along(self, normals: Points) -> Float32[np.ndarray, "n a"]:
        """How much each point is off along a normal where an amplitude is 1."""
        across = np.einsum("nai,ni->na", self.axes, normals.astype(np.float32))
        return (across[:, :, None] * self.waves[:, None]).reshape(len(normals), -1)

    def rows(self, rows: Int[np.ndarray, " r"]) -> "SharedErrors":
        """Those of some of the points."""
        return replace(self, measured=self.measured[rows], axes=self.axes[rows], waves=self.waves[rows])


Kind = TypeVar("Kind", bound="ObservedPoints")


@dataclass(frozen=True, eq=False)
class ObservedPoints(ABC):
    """Observed points, prepared for comparison with surfaces; lengths in scene units.

    Attributes:
        points: observed, camera frame.
        chosen: rows of some of them, evenly spread: the observed samples.
        around: indices of each point's neighbours, up to 8.
    """

    points: Points
    chosen: Int[np.ndarray, " p"]
    around: Int[np.ndarray, "n k"]

    @cached_property
    def observed_samples(self) -> Float[np.ndarray, "p 3"]:
        """Points that are compared with the model's surface."""
        return self.points[self.chosen]

    @cached_property
    def shared_errors(self) -> SharedErrors:
        """What was taken out of the points."""
        return SharedErrors.none(self.points)

    @cached_property
    def sample_errors(self) -> SharedErrors:
        """The same of the observed samples."""
        return self.shared_errors.rows(self.chosen)

    @property
    def with_more_samples(self: Kind) -> Kind:
        """The same with as many observed samples as a noisy frame needs."""
        return replace(self, chosen=spread(self.points, MORE_SAMPLES))

    def few(self: Kind, count: int) -> Kind:
        """The same with so many observed samples at most."""
        return replace(self, chosen=self.chosen[:count])

    def patch_share(self, tolerance: float) -> float:
        """Share of the points within a tolerance of one smooth patch: a quadratic function over their best plane."""
        centered = self.points - self.points.mean(axis=0)
        x, y, height = (centered @ np.linalg.svd(centered, full_matrices=False)[2].T).T
        terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)

        def away(patch: Float[np.ndarray, "6"]) -> Values:
            slope = np.hypot(patch[1] + 2 * patch[3] * x + patch[4] * y, patch[2] + patch[4] * x + 2 * patch[5] * y)
            distance: np.ndarray = (height - terms @ patch) / np.hypot(1.0, slope)
            return distance

        start = np.linalg.lstsq(terms, height, rcond=None)[0]
        patch = least_squares(away, start, loss="cauchy", f_scale=tolerance, x_scale="jac").x
        return float((np.abs(away(patch)) <= tolerance).mean())

    @property
    def distance(self) -> float:
        """Distance of the camera, scene units; of a surface without one, as that of the nearest that scenes have."""
        return 100.0

    @property
    def largest_noise(self) -> float:
        """Largest standard deviation of a camera's noise."""
        return NOISE_SHARE * self.distance

    @property
    def expected_noise(self) -> float:
        """Standard deviation of the noise that neighbours are known to share; 0 where none is known."""
        return 0.0

    @property
    def with_errors(self: Kind) -> Kind:
        """The same with what is known of the errors that neighbours share, none of which are taken out yet."""
        return self

    @property
    def seen_again(self: Kind) -> Kind:
        """The same with what is ruled out by the points as they are now."""
        return self

    def without(self: Kind, amplitudes: Float[np.ndarray, " a"]) -> Kind:
        """The same without errors of these amplitudes, which are all that was taken out of the points as measured."""
        return self

    @property
    @abstractmethod
    def roughness(self) -> float:
        """Noise that points alone have at most (``surface_patches.roughness``)."""

    @property
    def noise(self) -> float:
        """Noise of the frame at most, as it shows before any fit."""
        roughness = np.nan_to_num(self.roughness, posinf=0.0)  # of a few points
        return float(np.hypot(ROUGHER * roughness, self.expected_noise))

    @cached_property
    def nested(self) -> Int[np.ndarray, " m"]:
        """Points, as many as a power of two, in an order in which each aligned run of a power of two is a patch."""
        levels = int(np.log2(len(self.points)))
        rows = np.linspace(0, len(self.points) - 1, 2**levels).astype(int)
        order = np.arange(len(rows))[None]
        for _ in range(levels):  # halve every patch across its longest side
            places = self.points[rows[order]]
            longest = np.ptp(places, axis=1).argmax(axis=1)[:, None, None]
            rank = np.take_along_axis(places, longest, axis=2)[:, :, 0].argsort(axis=1, kind="stable")
            order = np.take_along_axis(order, rank, axis=1).reshape(2 * len(order), -1)
        return rows[order[:, 0]]


def plane_normals(points: Points, places: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
    """Unit normals, of either sign, of the planes through the points around each place."""
    near = cKDTree(points).query(places, k=min(NORMAL_POINTS, len(points)))[1]
    patches = points[near] - points[near].mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("pki,pkj->pij", patches, patches))[1][:, :, 0]


def lines_along(points: Points, unknown: Float[np.ndarray, "u 3"], pitch: float | None = None) -> dict[str, Any]:
    """What ``Evidence`` says of the lines of sight to points, and along ``unknown`` ones, of which nothing is known."""
    ranges = np.linalg.norm(points, axis=1)
    sight = cKDTree(unit_rows(points))
    angle, near = sight.query(sight.data, k=range(1, min(AROUND, len(points)) + 1))
    # the fourth neighbour of a pixel is one pitch away, as the first is; irregular clouds are not so lucky
    pitch = pitch or float(np.median(angle[:, min(4, len(points)) - 1]))
    front = np.where(angle <= AROUND_PITCHES * pitch, ranges[near], np.inf).min(axis=1)
    return {
        "around": near[:, 1:],
        "sight": cKDTree(np.concatenate([sight.data, unknown])),
        "ranges": ranges,
        "front": np.concatenate([front, np.zeros(len(unknown))]),
        "pitch": pitch,
    }


@dataclass(frozen=True, eq=False)
class Evidence(ObservedPoints):
    """What one camera saw: points along lines of sight.

    Attributes:
        sight: search tree over the unit vectors towards ``points``, and along lines of sight on which nothing is known.
        ranges: distance of each point from the camera.
        front: nearest of these among each line of sight and those around it; 0 where nothing is known.
        pitch: angle between neighbouring lines of sight.
        past: lines of sight that went past the object to something that was measured; None without any.
        other_lines: kind of the lines of sight that are near none of all these.
        shared_noise: of ``SightLines``.
        errors: that were taken out of the points, where the frame says what neighbours share.
    """

    sight: cKDTree
    ranges: Values
    front: Float[np.ndarray, " s"]
    pitch: float
    past: PastLines | None = None
    other_lines: SightKind = "past"
    shared_noise: SharedNoise = NOT_KNOWN
    errors: SharedErrors | None = None

    @classmethod
    def of(
        cls,
        points: Points,
        observed_samples: int = OBSERVED_SAMPLES,
        lines: SightLines = UNDECIDED,
        normals: Points | None = None,
        most: int = MOST_POINTS,
    ) -> "Evidence":
        """Prepare a cloud, with so many ``observed_samples`` at most; its lines of sight start at the origin.

        ``lines`` says what is known around the cloud; where it leaves that open, all lines of sight around the cloud
        went past the object. Denser clouds are averaged to ``most`` points; ``normals`` are not looked at: a camera's
        points have those of their neighbours.
        """
        points = means_along_sight(points, most)
        along = lines_along(points, unit_rows(lines.unknown))
        past = PastLines.of(lines.past, along["pitch"])
        other_lines = lines.other_lines or "past"
        chosen = spread(points, observed_samples)
        return cls(points, chosen, past=past, other_lines=other_lines, shared_noise=lines.shared_noise, **along)

    @property
    def distance(self) -> float:
        """Distance of the camera, scene units."""
        return float(np.median(self.ranges))

    @property
    def largest_noise(self) -> float:
        """Largest standard deviation of the camera's noise: that of points alone, and what neighbours share."""
        shared = NOISIER * self.shared_noise.std
        return min(NOISE_SHARE * self.distance, float(np.hypot(ROUGHER * self.roughness, shared)))

    @property
    def expected_noise(self) -> float:
        """As of ``ObservedPoints``."""
        return float(np.nan_to_num(self.shared_noise.std, posinf=0.0))

    @cached_property
    def shared_errors(self) -> SharedErrors:
        """As of ``ObservedPoints``."""
        return self.errors or SharedErrors.none(self.points)

    @property
    def with_errors(self) -> "Evidence":
        """As of ``ObservedPoints``, by fewer of the observed samples."""
        if self.shared_noise.side * self.expected_noise == 0.0 or self.errors is not None:
            return self
        return replace(self.few(FEWER_SAMPLES), errors=self.errors_of(self.shared_noise))

    def without(self, amplitudes: Float[np.ndarray, " a"]) -> "Evidence":
        """As of ``ObservedPoints``; what is ruled out stays as it was (``seen_again``)."""
        errors = replace(self.shared_errors, amplitudes=amplitudes)
        return replace(self, points=errors.measured - errors.offsets, errors=errors)

    @property
    def seen_again(self) -> "Evidence":
        """As of ``ObservedPoints``."""
        return replace(self, **lines_along(self.points, self.sight.data[len(self.points) :], self.pitch))

    def errors_of(self, noise: SharedNoise) -> SharedErrors:
        """Errors of the points by a noise that neighbours share, of which nothing is taken out yet.

        By waves over the picture, so that errors correlate as a normal bell (Solin and Saerkkae, Statistics and
        Computing 2020). A camera that shares errors looks at windows of pixels, so that edges are off as well, across
        the line of sight.
        """
        std, side, pixel = noise
        slopes = self.points[:, :2] / self.points[:, 2:]
        low, high = slopes.min(axis=0) - side, slopes.max(axis=0) + side
        number = np.arange(WAVES)
        length = (high - low)[:, None]
        waves = np.pi * number / length
        power = np.where(number == 0, 1.0, 2.0) * np.exp(-((side * waves) ** 2) / (4 * np.pi)) * side / length
        strongest = np.argsort(-np.outer(*power), axis=None, kind="stable")[:WAVES]
        rows = np.divmod(strongest, WAVES)
        x, y = (
            np.cos(np.outer(slope, wave[row])) * np.sqrt(size[row])
            for slope, wave, size, row in zip((slopes - low).T, waves, power, rows, strict=True)
        )
        ranges = np.linalg.norm(self.points, axis=1)[:, None]
        aside = UNSEEN_PITCHES * pixel * ranges * std / np.hypot(std, self.roughness)
        sight = self.points / ranges
        first = unit_rows(np.cross(sight, [0.0, 1.0, 0.0]))
        axes = np.stack([sight * std, first * aside, np.cross(sight, first) * aside], axis=1)
        return SharedErrors(
            self.points, axes.astype(np.float32), (x * y).astype(np.float32), np.zeros(3 * len(strongest))
        )

    def directions(self, length: float, wanted: bool) -> Directions | None:
        """Normals of the observed samples where they are ``wanted``, for the weight of each."""
        return Directions(signed, self.normals, length) if wanted else None

    def alike(self, length: float) -> Directions | None:
        """Normals by which the place is chosen that a sample is compared with: None, as lines of sight do."""
        return None

    def all_alike(self, length: float) -> Directions | None:
        """The same of all points."""
        return None

    @staticmethod
    def shows(normals: Float[np.ndarray, "f 3"], places: Float[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
        """Which faces with these outward normals, of any length, can be compared: those that face the camera."""
        return np.einsum("fi,fi->f", normals, places) < 0

    @property
    def area(self) -> float:
        """Area of the surface that was seen, across the lines of sight: that of a pixel for each point."""
        return float(((self.pitch * self.ranges) ** 2).sum())

    @cached_property
    def normals(self) -> Float[np.ndarray, "p 3"]:
        """Unit normals at the observed samples, toward the camera: of the planes through the points around them."""
        normals = plane_normals(self.points, self.observed_samples)
        away = np.einsum("pi,pi->p", normals, self.observed_samples) > 0
        return np.where(away[:, None], -normals, normals)

    @cached_property
    def roughness(self) -> float:
        """Noise that the cloud has at most (``surface_patches.roughness``)."""
        return roughness(self.points)

    @property
    def is_open(self) -> bool:
        """Whether there are lines of sight on which nothing is known."""
        return self.other_lines == "unknown" or len(self.sight.data) > len(self.points)

    @property
    def hidden_edge(self) -> float:
        """Share of the silhouette next to which nothing is known: where an occluder or the picture's edge cuts it."""
        if not self.is_open:
            return 0.0
        toward = unit_rows(self.points)
        across = rotation_along(toward.mean(axis=0))[:, :2].T
        turns = np.arange(EDGE_DIRECTIONS) * (2 * np.pi / EDGE_DIRECTIONS)
        steps = EDGE_PITCHES * self.pitch * np.stack([np.cos(turns), np.sin(turns)], axis=1) @ across
        around = unit_rows((toward[:, None] + steps).reshape(-1, 3))
        is_around = cKDTree(toward).query(around)[0] > RIM_PITCHES * self.pitch
        _, front, free = self.along(around[is_around])
        nearest = (1 - self.pitch) * np.repeat(self.ranges, EDGE_DIRECTIONS)[is_around]
        is_hidden = np.where(free < 0, front == 0, free < nearest)
        return float(is_hidden.mean()) if len(is_hidden) else 0.0

    def unseen(self, triangles: Float[np.ndarray, "f 3 3"]) -> float:
        """Share of what a surface shows the camera that lies where nothing was seen, and nothing says what is there.

        ``triangles`` are wound outwards. What they hide of each other counts too.
        """
        if self.other_lines == "past":
            return 0.0
        center = triangles.mean(axis=1)
        distance = np.linalg.norm(center, axis=1)
        across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        shown = np.maximum(-np.einsum("fi,fi->f", across, center), 0.0) / distance**3
        toward = unit_rows(center)
        angle, near = self.sight.query(toward)
        is_open = self._free(toward, np.full(len(toward), np.inf)) == 0.0
        is_unseen = is_open & (near < len(self.points)) & (angle > UNSEEN_PITCHES * self.pitch)
        return float(shown[is_unseen].sum() / max(shown.sum(), np.finfo(float).tiny))

    def violations(self, vertices: Points, slack: float) -> tuple[Points, Values]:
        """Unit direction in which each vertex must move to be allowed, and how far; 0 where it is allowed.

        ``slack`` is how far in front of observed points a vertex may be.
        """
        distance = np.linalg.norm(vertices, axis=1)
        toward = vertices / distance[:, None]
        angle, near = self.sight.query(toward)
        is_past = angle > SILHOUETTE_PITCHES * self.pitch
        ahead = self.front[near] - slack - distance
        # edges of masks and of stereo cameras are off by some pixels, and let in what is far behind: a line of sight
        # that allows the vertex, among 9 x 9 pixels, is nearer then
        rows = np.flatnonzero(~is_past & (ahead > AROUND * self.pitch * distance))
        lines = self.sight.query(toward[rows], range(1, min(AROUND**2, len(self.sight.data)) + 1))[1]
        allows = distance[rows, None] >= self.front[lines] - slack
        aside = is_past.copy()
        near[rows], aside[rows] = lines[np.arange(len(rows)), allows.argmax(axis=1)], allows.any(axis=1)
        sideways = self.sight.data[near] * distance[:, None] - vertices
        length = np.sqrt(np.einsum("ni,ni->n", sideways, sideways))
        direction = np.where(aside[:, None], sideways / np.maximum(length, 1e-12)[:, None], toward)
        amount = np.maximum(np.where(aside, length - self.pitch * distance, ahead), 0.0)
        if self.past is not None or self.other_lines == "unknown":
            rows = np.flatnonzero(is_past)
            nearest = np.where(near[rows] < len(self.points), np.inf, angle[rows])
            amount[rows[distance[rows] > self._free(toward[rows], nearest) - slack]] = 0.0
        return direction, amount

    def along(self, toward: Points) -> tuple[Points, Values, Values]:
        """Look up lines of sight, as ``violations`` takes them.

        Returns the unit vector of the nearest one that met the object or of which nothing is known, the distance before
        which that is free, and the distance up to which a line of sight around it is free; -1 where it is not around.
        """
        angle, near = self.sight.query(toward)
        nearest = np.where(near < len(self.points), np.inf, angle)
        free = np.where(angle > SILHOUETTE_PITCHES * self.pitch, self._free(toward, nearest), -1.0)
        return self.sight.data[near], self.front[near], free

    def _free(self, toward: Points, unknown: Values) -> Values:
        """Distance up to which lines of sight around the object are free: infinite where nothing ends them.

        ``unknown`` is the angle to the nearest line of sight on which nothing is known, infinite where one that met the
        object is nearer; one that went past the object counts where it is nearer than that.
        """
        other_lines = np.inf if self.other_lines == "past" else 0.0
        if self.past is None:
            return np.full(len(toward), other_lines)
        angle, near = self.past.sight.query(toward)
        free = np.where(angle <= self.past.reach[near], self.past.ranges[near], other_lines)
        return np.where(unknown < angle, 0.0, free)


@dataclass(frozen=True, eq=False)
class SurfaceEvidence(ObservedPoints):
    """A surface that no single camera saw: points and normals, no lines of sight, and nothing that is ruled out.

    Attributes:
        normals: of all points, out of the surface, or of either sign.
        lift: of ``Directions``: whether the sign counts.
        other_lines: kind of all lines of sight.
    """

    normals: Points
    lift: Callable[[np.ndarray], np.ndarray]
    other_lines: SightKind = "none"

    @classmethod
    def of(
        cls,
        points: Points,
        observed_samples: int = OBSERVED_SAMPLES,
        lines: SightLines = UNDECIDED,
        normals: Points | None = None,
        most: int = MOST_POINTS,
    ) -> "SurfaceEvidence":
        """Prepare a surface, of which some ``most`` points are kept; ``lines`` say nothing of it.

        Without ``normals`` these are estimated from the points, and their signs do not count.
        """
        known = (plane_normals(points, points), without_sign) if normals is None else (normals, signed)
        (normals, lift), rows = known, thin_to_grid(points, most)
        points, normals = points[rows], normals[rows]
        around = cKDTree(points).query(points, k=range(1, min(AROUND, len(points)) + 1))[1][:, 1:]
        return cls(points, spread(points, observed_samples), around, normals, lift)

    @property
    def sample_normals(self) -> Float[np.ndarray, "p 3"]:
        """Normals of the observed samples."""
        return self.normals[self.chosen]

    def alike(self, length: float) -> Directions:
        """Normals by which the place is chosen that a sample is compared with."""
        return Directions(self.lift, self.lift(self.sample_normals), length)

    def all_alike(self, length: float) -> Directions:
        """The same of all points."""
        return Directions(self.lift, self.lift(self.normals), length)

    def directions(self, length: float, wanted: bool) -> Directions:
        """The same as ``alike``, for the weight of each sample: normals always count."""
        return self.alike(length)

    @staticmethod
    def shows(normals: Float[np.ndarray, "f 3"], places: Float[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
        """All faces can be compared."""
        return np.ones(len(normals), dtype=bool)

    @property
    def area(self) -> float:
        """Area of the surface that was seen: that between neighbours for each point."""
        gap = np.linalg.norm(self.points[self.around[:, :4]] - self.points[:, None], axis=2)
        return float((np.median(gap, axis=1) ** 2).sum())

    @cached_property
    def roughness(self) -> float:
        """Noise that the surface has at most."""
        return roughness(self.points, self.normals)

    @property
    def is_open(self) -> bool:
        """Nothing is known around the points."""
        return True

    @property
    def hidden_edge(self) -> float:
        """All of the silhouette: there is none."""
        return 1.0

    def unseen(self, triangles: Float[np.ndarray, "f 3 3"]) -> float:
        """Nothing that a camera should have seen."""
        return 0.0

    def violations(self, vertices: Points, slack: float) -> tuple[Points, Values]:
        """Nothing is ruled out."""
        return np.zeros_like(vertices), np.zeros(len(vertices))


Observed = Evidence | SurfaceEvidence
"""What a frame shows: by one camera, or a surface without any."""
