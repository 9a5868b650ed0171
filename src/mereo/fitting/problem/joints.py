"""States that differ from a fit in one joint alone: what a library of random states hardly ever holds.

Segments that touch form a tree. One branch of it is moved as the library moves it there, and the rest stays: a hand
half a turn round, with the arm as it is. The tree and its motions are learned from the states, without code of a scene.

Notation: s segments, c corners of each (a few anchors), n states, k modes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree

from mereo.fitting.problem.gauss_newton import Posed
from mereo.geometry.transforms import best_rotations
from mereo.scenes.statistical_model import StatisticalModel

CORNERS = 12
"""Anchors of each segment that tell its place."""

STATES = 60
"""States of the library whose joints are tried."""

RIDGE = 1e-3
"""Weight of the prior where coefficients are found from the corners, relative to the modes' mean square."""

ROUNDS = 3
"""Rounds of alignment and least squares that express a state in modes."""


@dataclass(frozen=True, eq=False)
class Joints:
    """Joints of an object: which segments hang on which, and how states move them.

    Attributes:
        model: the statistical model.
        corners: material points, ``c`` of each segment.
        branches: pairs of a segment, the one that hangs on it, and which segments go along with that.
        rotation, translation: of each segment in some states, from the mean: ``y = R x + t``.
    """

    model: StatisticalModel
    corners: Int[np.ndarray, "s c"]
    branches: tuple[tuple[int, int, Bool[np.ndarray, " s"]], ...]
    rotation: Float[np.ndarray, "n s 3 3"]
    translation: Float[np.ndarray, "n s 3"]

    @classmethod
    def of(cls, model: StatisticalModel) -> "Joints":
        """Joints of a model's library."""
        corners = corners_of(model)
        states = positions(model, corners, model.library[:: max(1, len(model.library) // STATES)])
        rotation, translation = segment_poses(model.mean[corners], states)
        return cls(model, corners, branches(model), rotation, translation)

    def others(self, posed: Posed, each: int) -> list[Posed]:
        """States in which one joint is elsewhere, ``each`` of every joint, as different as there are."""
        corners = positions(self.model, self.corners, posed.z[None].astype(np.float32))
        rotation, translation = segment_poses(self.model.mean[self.corners], corners)
        shapes_of_branches = []
        for fixed, hanging, moving in self.branches:
            # the hanging segment's pose in the fixed one's frame, in each state of the library and here
            inverse = self.rotation[:, fixed].transpose(0, 2, 1)
            turn = rotation[0, fixed] @ inverse @ self.rotation[:, hanging] @ rotation[0, hanging].T
            offset = self.translation[:, hanging] - self.translation[:, fixed]
            shift = (rotation[0, fixed] @ inverse @ offset[..., None])[..., 0] + translation[0, fixed]
            shift = shift - (turn @ translation[0, hanging])
            shapes = np.broadcast_to(corners, (len(turn), *corners.shape[1:])).copy()
            branch = corners[0, moving].reshape(-1, 3)
            moved = branch @ turn.transpose(0, 2, 1) + shift[:, None]
            shapes[:, moving] = moved.reshape(len(turn), -1, *corners.shape[2:])
            apart = different(moved.reshape(len(turn), -1), branch.ravel(), each)
            shapes_of_branches.append(shapes[apart])
        return (
            self._expressed(np.concatenate(shapes_of_branches).reshape(-1, self.corners.size, 3), posed)
            if shapes_of_branches
            else []
        )

    def _expressed(self, shapes: Float[np.ndarray, "n p 3"], posed: Posed) -> list[Posed]:
        """States nearest to shapes of the corners that are given in the frame of ``posed``'s modes."""
        flat = self.model.modes[self.corners.ravel()].reshape(-1, self.model.count).astype(np.float64)
        normal = flat.T @ flat
        normal += RIDGE * np.trace(normal) / max(1, len(normal)) * np.eye(len(normal))
        solve = np.linalg.solve(normal, flat.T)
        mean = self.model.mean[self.corners.ravel()]
        fitted = np.broadcast_to(mean, shapes.shape)
        goal = shapes.mean(axis=1, keepdims=True)
        for _ in range(ROUNDS):
            middle = fitted.mean(axis=1, keepdims=True)
            rotation = best_rotations(np.matmul((fitted - middle).transpose(0, 2, 1), shapes - goal))
            unposed = np.matmul(shapes - goal, rotation) + middle
            z = (unposed - mean).reshape(len(shapes), -1) @ solve.T
            fitted = mean + (z @ flat.T).reshape(shapes.shape)
        translation = (goal - middle @ rotation.transpose(0, 2, 1))[:, 0]
        shift = posed.place(translation)
        return [Posed(posed.rotation @ rotation[i], shift[i], z[i], posed.log_scale) for i in range(len(z))]


def corners_of(model: StatisticalModel) -> Int[np.ndarray, "s c"]:
    """A few anchors of each segment, as many of each."""
    least = min(len(anchors) for anchors in model.anchors)
    return np.stack([anchors[: min(CORNERS, least)] for anchors in model.anchors])


def positions(
    model: StatisticalModel, corners: Int[np.ndarray, "s c"], z: Float32[np.ndarray, "n k"]
) -> Float[np.ndarray, "n s c 3"]:
    """Positions of the corners in states."""
    motion = z @ model.modes[corners.ravel()].reshape(-1, model.count).T
    return model.mean[corners] + motion.reshape(len(z), *corners.shape, 3).astype(np.float64)


def corner_positions(model: StatisticalModel, states: list[Posed]) -> Float[np.ndarray, "n p 3"]:
    """Places of the corners of all segments in states, by which these are told apart."""
    z = np.stack([posed.z for posed in states]).astype(np.float32)
    unposed = positions(model, corners_of(model), z).reshape(len(z), -1, 3)
    return np.stack([posed.place(points) for posed, points in zip(states, unposed, strict=True)])


def segment_poses(
    mean: Float[np.ndarray, "s c 3"], states: Float[np.ndarray, "n s c 3"]
) -> tuple[Float[np.ndarray, "n s 3 3"], Float[np.ndarray, "n s 3"]]:
    """Rigid motion of each segment from the mean to each state."""
    middle, goal = mean.mean(axis=1, keepdims=True), states.mean(axis=2, keepdims=True)
    covariance = np.matmul((mean - middle).transpose(0, 2, 1), states - goal)
    rotation = best_rotations(covariance)
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


def different(shapes: Float[np.ndarray, "n q"], first: Float[np.ndarray, " q"], count: int) -> Int[np.ndarray, " m"]:
    """Rows farthest from ``first``, then each time the one farthest from all before it."""
    distance, chosen = ((shapes - first) ** 2).sum(axis=1), []
    for _ in range(min(count, len(shapes))):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((shapes - shapes[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen, dtype=np.int64)
