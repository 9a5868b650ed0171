"""Segments of an object: the joints between them, and their turns that a frame cannot tell apart.

Both are learned from the states of the statistical model. Lengths are scene units.

Notation: s segments, c corners of each (a few anchors), n states, k modes, m material points, a angles.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import lru_cache

import igl
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mereo.deformation.moving_least_squares import spread
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.residuals import robust_square
from mereo.geometry.mesh import Segment, area_vectors
from mereo.geometry.transforms import Points, Vector, best_rotations, fit_rigid
from mereo.scenes.statistical_model import StatisticalModel

# --- corners, and segments that touch ---------------------------------------------------------------------------------


def corners_of(model: StatisticalModel) -> Int[np.ndarray, "s c"]:
    """A few anchors of each segment, as many of each."""
    least = min(len(anchors) for anchors in model.anchors)
    return np.stack([anchors[: min(12, least)] for anchors in model.anchors])


def corner_positions(model: StatisticalModel, states: list[Posed]) -> Float[np.ndarray, "n p 3"]:
    """Positions of the corners of all segments in the camera frame, by which states are compared."""
    z = np.stack([posed.z for posed in states]).astype(np.float32)
    unposed = model.positions(z, corners_of(model).ravel())
    return np.stack([posed.place(points) for posed, points in zip(states, unposed, strict=True)])


def segment_poses(
    mean: Float[np.ndarray, "s c 3"], states: Float[np.ndarray, "n s c 3"]
) -> tuple[Float[np.ndarray, "n s 3 3"], Float[np.ndarray, "n s 3"]]:
    """Rigid motion of each segment from the mean to each state."""
    middle = mean.mean(axis=1, keepdims=True)
    goal = states.mean(axis=2, keepdims=True)
    rotation = best_rotations(np.matmul((mean - middle).transpose(0, 2, 1), states - goal))
    return rotation, (goal[:, :, 0] - np.matmul(rotation, middle[:, 0, :, None])[..., 0])


def branches(model: StatisticalModel) -> tuple[tuple[int, int, Bool[np.ndarray, " s"]], ...]:
    """Every joint: the larger side, the segment that hangs on it, and all segments on the smaller side."""
    count = len(model.anchors)
    if count < 2:
        return ()
    trees = [cKDTree(model.rest_points[anchors]) for anchors in model.anchors]
    distance = np.zeros((count, count))
    for a in range(count):
        for b in range(a + 1, count):
            distance[a, b] = trees[a].query(model.rest_points[model.anchors[b]])[0].min() + 1e-6
    tree = minimum_spanning_tree(distance).toarray()
    result = []
    for a, b in zip(*np.nonzero(tree), strict=True):
        cut = tree.copy()
        cut[a, b] = 0.0
        beyond = np.zeros(count, dtype=bool)
        beyond[breadth_first_order(cut, b, directed=False, return_predecessors=False)] = True
        volume = [sum(model.vertex_counts[i] for i in np.flatnonzero(side)) for side in (beyond, ~beyond)]
        result.append((int(a), int(b), beyond) if volume[0] <= volume[1] else (int(b), int(a), ~beyond))
    return tuple(result)


def diverse_rows(
    positions: Float[np.ndarray, "n p 3"], apart: float, measure: Callable[[Float[np.ndarray, "m p 3"]], np.ndarray]
) -> list[int]:
    """Rows of which each is farther than ``apart`` from all before it, by a measure of the points' offsets."""
    kept: list[int] = []
    for row, points in enumerate(positions):
        if not kept or measure(positions[kept] - points).min() > apart:
            kept.append(row)
    return kept


def rms_distance(offset: Float[np.ndarray, "m p 3"]) -> Float[np.ndarray, " m"]:
    """Root mean square length of the offsets of each row."""
    return np.sqrt((offset**2).sum(axis=2).mean(axis=1))


# --- symmetries -------------------------------------------------------------------------------------------------------

ANGLES = np.deg2rad(np.arange(30, 331, 10))
"""Turns that are compared; smaller ones belong to the Gaussian around an optimum."""

ALIKE = 0.06
"""Root mean square distance of a turned segment from itself up to which it looks the same, in mean distances from the
axis; the robot's segments, which a view cannot tell half a turn round, have .04, its base has .08."""

BINS = 36
"""Bins of the angle by which states turn a segment against its neighbour."""

COUNTED = 0.03
"""Share of the loss of a turned segment that counts: it is turned stiffly, and a fit would take most of it back."""


@dataclass(frozen=True, eq=False)
class SegmentTurns:
    """Turns of a segment about an axis, which hardly change its shape.

    Attributes:
        center, axis: at rest.
        angles: of the turns, rad.
        plausible: how often states are so far apart in this turn, in how often they are alike.
    """

    label: int
    center: Vector
    axis: Vector
    angles: Float[np.ndarray, " a"]
    plausible: Float[np.ndarray, " a"]

    def posed(
        self, model: StatisticalModel, material: Float[np.ndarray, "m 3"]
    ) -> tuple[Int[np.ndarray, " v"], Vector, Vector]:
        """Rows of the segment's material points, and the centre and the axis of its turns in a state."""
        rows = np.flatnonzero(model.labels == self.label)
        T = fit_rigid(model.rest_points[rows], material[rows])
        return rows, T[:3, :3] @ self.center + T[:3, 3], T[:3, :3] @ self.axis


@lru_cache(maxsize=8)
def find_segment_turns(model: StatisticalModel) -> tuple[SegmentTurns, ...]:
    """Find all such turns of an object that its states make, once for a model; none without states."""
    if model.count == 0:
        return ()
    corners = corners_of(model)
    symmetries = list[SegmentTurns]()
    # from the rest pose, not from the mean, in which a part that spins is crushed
    library = model.library[:: max(1, len(model.library) // 60)]
    states = model.positions(library, corners.ravel()).reshape(len(library), *corners.shape, 3)
    rotation = segment_poses(model.rest_points[corners], states)[0]
    joints = branches(model)
    for index, segment in enumerate(model.rest.segments):
        center, axes = principal_axes(segment.vertices, segment.faces)
        for axis in axes:
            alike = ANGLES[self_distances(segment, center, axis) <= ALIKE]
            neighbors = {b if a == index else a for a, b, _ in joints if index in (a, b)}
            plausible = plausibility(rotation, index, neighbors, axis, alike)
            kept = plausible > 0.02
            if kept.any():
                symmetries.append(SegmentTurns(index + 1, center, axis, alike[kept], plausible[kept]))
    return tuple(symmetries)


def principal_axes(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Vector, Float[np.ndarray, "3 3"]]:
    """Centroid of a surface, and its principal axes as rows."""
    area = np.linalg.norm(area_vectors(vertices, faces), axis=1)
    middle = vertices[faces].mean(axis=1)
    center = area @ middle / area.sum()
    covariance = ((middle - center) * area[:, None]).T @ (middle - center)
    return center, np.linalg.eigh(covariance)[1].T


def self_distances(segment: Segment, center: Vector, axis: Vector) -> Float[np.ndarray, " a"]:
    """Distance of a segment, turned by each of ``ANGLES``, from itself, in mean distances from the axis."""
    arm = segment.vertices[spread(segment.vertices, 150)] - center
    turned = Rotation.from_rotvec(ANGLES[:, None] * axis).as_matrix()
    points = (arm @ turned.transpose(0, 2, 1)).reshape(-1, 3) + center
    squared = igl.point_mesh_squared_distance(points, segment.vertices, segment.faces)[0]
    mean_arm = float(np.linalg.norm(np.cross(arm, axis), axis=1).mean())
    return np.asarray(np.sqrt(squared.reshape(len(ANGLES), -1).mean(axis=1)) / mean_arm)


def plausibility(
    rotation: Float[np.ndarray, "n s 3 3"],
    index: int,
    neighbors: Collection[int],
    axis: Vector,
    angles: Float[np.ndarray, " a"],
) -> Float[np.ndarray, " a"]:
    """``SegmentTurns.plausible`` against that neighbour of a segment against which it turns most; 1 for all if alone.

    It counts pairs of states in which the segment leans alike against the neighbour (.2 rad): a rope that bends twists
    too, but never by itself. ``rotation`` is that of each segment in some states, from rest.
    """
    plausible = np.zeros(len(angles)) if neighbors else np.ones(len(angles))
    for other in neighbors:
        relative = Rotation.from_matrix(rotation[:, other].transpose(0, 2, 1) @ rotation[:, index])
        turn = relative.as_quat()
        roll = 2.0 * np.arctan2(turn[:, :3] @ axis, turn[:, 3])  # the twist of a swing and a twist
        lean = (relative * Rotation.from_rotvec(-roll[:, None] * axis)).as_rotvec()
        first, second = np.nonzero(np.linalg.norm(lean[:, None] - lean, axis=2) + np.eye(len(lean)) < 0.2)
        apart = np.rint(np.mod(roll[second] - roll[first], 2 * np.pi) * BINS / (2 * np.pi)).astype(int) % BINS
        count = np.bincount(apart, minlength=BINS)
        steps = np.rint(angles * BINS / (2 * np.pi)).astype(int) % BINS
        plausible = np.maximum(plausible, np.minimum(count[steps] / max(30, count[0]), 1.0))
    return plausible


def left_open(
    model: StatisticalModel,
    material: Float[np.ndarray, "m 3"],
    observed_samples: Points,
    sigma: float,
    total_weight: float,
) -> Float32[np.ndarray, "m 3 e"]:
    """Motion of each material point with e independent standard normal numbers, of the second moments of its turns.

    ``observed_samples`` are in the frame of the registered material, together worth ``total_weight`` points.
    """
    turns = find_segment_turns(model)
    motion = np.zeros((len(material), 3, 2 * len(turns)), dtype=np.float32)
    if not turns:
        return motion
    vertices = sum(model.vertex_counts)
    owner = model.labels[cKDTree(material[:vertices]).query(observed_samples)[1]]
    segments = model.mesh(material).segments
    for number, turn in enumerate(turns):
        rows, center, axis = turn.posed(model, material)
        seen, segment = observed_samples[owner == turn.label], segments[turn.label - 1]
        worse = _worse(segment, turn.angles, seen, center, axis, sigma) * total_weight / len(observed_samples)
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
    seen: Points,
    center: Vector,
    axis: Vector,
    sigma: float,
) -> Float[np.ndarray, " a"]:
    """By how much more the points seen on a segment are off where it is turned, in the loss of a fit."""
    if len(seen) == 0:
        return np.zeros(len(angles))
    back = Rotation.from_rotvec(-np.append(0.0, angles)[:, None] * axis).as_matrix()
    points = ((seen - center) @ back.transpose(0, 2, 1)).reshape(-1, 3) + center
    squared = igl.point_mesh_squared_distance(points, segment.vertices, segment.faces)[0]
    loss = robust_square(np.sqrt(squared), sigma).reshape(len(back), -1).sum(axis=1)
    return np.asarray(loss[1:] - loss[0])
