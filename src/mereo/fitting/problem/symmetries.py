"""Turns of single segments that nothing in a frame tells apart: where the material may be while the surface stays.

    rest shapes, the library's joints -find_symmetries-> Symmetry -left_open-> how unsure they leave each material point

A forearm that looks the same from both sides may be half a turn round, with the wrist bent the other way; a smooth ring
may be anywhere round its post. Each such turn is another optimum of the fit, far from the first, of which the Gaussian
around that one knows nothing. A turn counts by how often the object's states turn the segment so against a neighbour,
and by how well the observed points still lie on the turned segment. Lengths are scene units.

Notation: m material points, a angles.
"""

from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache

import igl
import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mereo.deformation.moving_least_squares import spread
from mereo.fitting.problem.joints import STATES, branches, corners_of, positions, segment_poses
from mereo.fitting.problem.residuals import robust_square
from mereo.geometry.mesh import Segment
from mereo.geometry.transforms import fit_rigid
from mereo.scenes.statistical_model import StatisticalModel

ANGLES = np.deg2rad(np.arange(30, 331, 10))
"""Turns that are asked about; of smaller ones the Gaussian around an optimum knows."""

ALIKE = 0.06
"""Root mean square distance of a turned segment from itself up to which it looks the same, in mean distances from the
axis. Of the robot's segments, which a view cannot tell half a turn round, .04 is the largest; its base has .08."""

COMPARED = 150
"""Vertices by which a segment is compared with itself."""

BINS = 36
"""Bins of the angle by which states turn a segment against its neighbour."""

SELDOM = 0.02
"""Plausibility up to which a turn is left out."""

LEANS = 0.2
"""Angle up to which a segment leans alike against its neighbour in two states, rad."""

LEAST_PAIRS = 30
"""Pairs of states that are turned alike, at least, in the share that is turned otherwise."""


COUNTED = 0.03
"""Share of the loss of a turned segment that counts: it is turned stiffly here, and a fit from there takes most of that
back. On training views of the shapes 78 % of the places lay within the radii with all of it, 91 % with a tenth, 96 %
with this."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Turns of a segment about an axis of its own which hardly change its shape.

    Attributes:
        label: of the segment.
        center, axis: at rest.
        angles: of the turns, rad.
        plausible: how often states are so far apart in this turn, in how often they are alike.
    """

    label: int
    center: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    angles: Float[np.ndarray, " a"]
    plausible: Float[np.ndarray, " a"]


@lru_cache(maxsize=8)
def find_symmetries(model: StatisticalModel) -> tuple[Symmetry, ...]:
    """All such turns of an object that its states make, none of one without states; found once for a model."""
    if model.count == 0:
        return ()
    corners, symmetries = corners_of(model), list[Symmetry]()
    # from the rest pose, not from the mean, in which a part that spins is crushed
    states = positions(model, corners, model.library[:: max(1, len(model.library) // STATES)])
    rotation, joints = segment_poses(model.rest_points[corners], states)[0], branches(model)
    for index, segment in enumerate(model.rest.segments):
        center, axes = principal_axes(segment)
        for axis in axes:
            alike = ANGLES[self_distances(segment, center, axis) <= ALIKE]
            neighbors = {b if a == index else a for a, b, _ in joints if index in (a, b)}
            plausible = plausibility(rotation, index, neighbors, axis, alike)
            kept = plausible > SELDOM
            if kept.any():
                symmetries.append(Symmetry(index + 1, center, axis, alike[kept], plausible[kept]))
    return tuple(symmetries)


def principal_axes(segment: Segment) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Centroid of a segment's surface, and its principal axes as rows."""
    corners = segment.vertices[segment.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middle = corners.mean(axis=1)
    center = area @ middle / area.sum()
    covariance = ((middle - center) * area[:, None]).T @ (middle - center)
    return center, np.linalg.eigh(covariance)[1].T


def self_distances(
    segment: Segment, center: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " a"]:
    """Distance of a segment, turned by each of ``ANGLES``, from itself, in mean distances from the axis."""
    arm = segment.vertices[spread(segment.vertices, COMPARED)] - center
    turned = Rotation.from_rotvec(ANGLES[:, None] * axis).as_matrix()
    points = (arm @ turned.transpose(0, 2, 1)).reshape(-1, 3) + center
    squared = igl.point_mesh_squared_distance(points, segment.vertices, segment.faces)[0]
    mean_arm = float(np.linalg.norm(np.cross(arm, axis), axis=1).mean())
    off: np.ndarray = np.sqrt(squared.reshape(len(ANGLES), -1).mean(axis=1)) / mean_arm
    return off


def plausibility(
    rotation: Float[np.ndarray, "n s 3 3"],
    index: int,
    neighbors: Collection[int],
    axis: Float[np.ndarray, "3"],
    angles: Float[np.ndarray, " a"],
) -> Float[np.ndarray, " a"]:
    """``Symmetry.plausible`` against that neighbour of a segment against which it turns most; 1 for all without any.

    Of pairs of states in which the segment leans alike against the neighbour, so that the turn is a freedom of its own:
    a rope that bends twists too, but never by itself.

    Args:
        rotation: of each segment in some states, from rest.
        index: the segment.
        neighbors: the segments that hang on it, or it on them.
        axis: of the turn, at rest.
        angles: of the turn.
    """
    plausible = np.zeros(len(angles)) if neighbors else np.ones(len(angles))
    for other in neighbors:
        relative = Rotation.from_matrix(rotation[:, other].transpose(0, 2, 1) @ rotation[:, index])
        turn = relative.as_quat()
        roll = 2.0 * np.arctan2(turn[:, :3] @ axis, turn[:, 3])  # the twist of a swing and a twist
        lean = (relative * Rotation.from_rotvec(-roll[:, None] * axis)).as_rotvec()
        first, second = np.nonzero(np.linalg.norm(lean[:, None] - lean, axis=2) + np.eye(len(lean)) < LEANS)
        apart = np.rint(np.mod(roll[second] - roll[first], 2 * np.pi) * BINS / (2 * np.pi)).astype(int) % BINS
        count = np.bincount(apart, minlength=BINS)
        steps = np.rint(angles * BINS / (2 * np.pi)).astype(int) % BINS
        plausible = np.maximum(plausible, np.minimum(count[steps] / max(LEAST_PAIRS, count[0]), 1.0))
    return plausible


def left_open(
    model: StatisticalModel,
    material: Float[np.ndarray, "m 3"],
    observed_samples: Float[np.ndarray, "n 3"],
    sigma: float,
    total_weight: float,
) -> Float32[np.ndarray, "m 3 e"]:
    """Motion of each material point with e independent standard normal numbers, of the second moments of its turns.

    Args:
        model: the statistical model.
        material: registered material points.
        observed_samples: observed points, in the same frame.
        sigma: the cloud's, scene units.
        total_weight: how many independent points all observed samples are worth.
    """
    turns = find_symmetries(model)
    motion = np.zeros((len(material), 3, 2 * len(turns)), dtype=np.float32)
    if not turns:
        return motion
    vertices = sum(model.vertex_counts)
    owner = model.labels[cKDTree(material[:vertices]).query(observed_samples)[1]]
    segments = model.mesh(material).segments
    for number, turn in enumerate(turns):
        rows = np.flatnonzero(model.labels == turn.label)
        T = fit_rigid(model.rest_points[rows], material[rows])
        center, axis = T[:3, :3] @ turn.center + T[:3, 3], T[:3, :3] @ turn.axis
        seen = observed_samples[owner == turn.label]
        worse = (
            _worse(segments[turn.label - 1], turn.angles, seen, center, axis, sigma)
            * total_weight
            / len(observed_samples)
        )
        weight = np.append(turn.plausible * np.exp(-0.5 * COUNTED * np.maximum(worse, 0.0)), 1.0)
        angle = np.append(turn.angles, 0.0)
        steps = np.stack([np.sin(angle), 1.0 - np.cos(angle)])
        second = (steps * (weight / weight.sum())) @ steps.T
        values, vectors = np.linalg.eigh(second)
        across = np.cross(axis, material[rows] - center)
        directions = np.stack([across, np.cross(axis, across)], axis=2)
        motion[rows, :, 2 * number : 2 * number + 2] = directions @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return motion


def _worse(
    segment: Segment,
    angles: Float[np.ndarray, " a"],
    seen: Float[np.ndarray, "n 3"],
    center: Float[np.ndarray, "3"],
    axis: Float[np.ndarray, "3"],
    sigma: float,
) -> Float[np.ndarray, " a"]:
    """By how much more the points seen on a segment are off where it is turned, in the loss of a fit."""
    if len(seen) == 0:
        return np.zeros(len(angles))
    back = Rotation.from_rotvec(-np.append(0.0, angles)[:, None] * axis).as_matrix()
    points = ((seen - center) @ back.transpose(0, 2, 1)).reshape(-1, 3) + center
    squared = igl.point_mesh_squared_distance(points, segment.vertices, segment.faces)[0]
    loss = robust_square(np.sqrt(squared), sigma).reshape(len(back), -1).sum(axis=1)
    worse: np.ndarray = loss[1:] - loss[0]
    return worse
