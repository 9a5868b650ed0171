"""States of the library from which a fit may start: those that the network's answer resembles, or another fit does."""

import numpy as np
from jaxtyping import Float, Float32, Int

from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.problem import Problem
from mereo.geometry.procrustes import best_rotations

ROUNDS = 4
"""Rounds of robust reweighting."""

RANKED_BY = 64
"""Correspondences that rank the library."""

POOL = 80
"""States most alike, among which different ones are chosen."""

SEARCHED = 700
"""States of the library among which they are searched."""

FEWER = 64
"""Material points that find this pool."""

ALIKE = 0.03
"""Tolerance, of half the rest box's longest side: points nearer than this agree."""


def robust_poses(
    states: Float32[np.ndarray, "n p 3"],
    target: Float32[np.ndarray, "p 3"],
    weight: Float32[np.ndarray, " p"],
    sigma: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Robust rigid poses of many shapes at once on the same points: cost in 0..1, rotations, translations."""
    share = np.broadcast_to(weight / weight.sum(), states.shape[:2])
    for _ in range(ROUNDS):
        center, goal = np.matmul(share[:, None], states), (share @ target)[:, None]
        covariance = np.matmul((states - center).transpose(0, 2, 1) * share[:, None], target - goal)
        rotation = best_rotations(covariance)
        squared = ((np.matmul(states - center, rotation.transpose(0, 2, 1)) + goal - target) ** 2).sum(axis=2)
        scale = np.maximum(np.median(squared, axis=1, keepdims=True), sigma**2)
        share = weight / (1.0 + squared / scale)
        share = share / share.sum(axis=1, keepdims=True)
    cost = squared / (sigma**2 + squared) @ (weight / weight.sum())
    translation = goal - np.matmul(center, rotation.transpose(0, 2, 1))
    return cost, rotation.astype(np.float64), translation[:, 0].astype(np.float64)


def by_network(problem: Problem, count: int) -> list[Posed]:
    """The states of the library that explain the correspondences best, posed on them."""
    network, library = problem.network, problem.model.library
    if len(network.target) == 0:
        return []
    few = np.arange(0, len(network.target), max(1, len(network.target) // RANKED_BY))
    library = library[:: max(1, len(library) // SEARCHED)]
    motion = library @ network.modes[few].reshape(-1, library.shape[1]).T
    states = network.mean[few].astype(np.float32) + motion.reshape(len(library), -1, 3)
    target, weight = network.target[few].astype(np.float32), network.confidence[few].astype(np.float32)
    cost, rotation, translation = robust_poses(states, target, weight, problem.network_sigma)
    best = np.argsort(cost)[:count]
    return [Posed(rotation[i], translation[i], library[i].astype(np.float64)) for i in best]


def by_likeness(problem: Problem, posed: Posed, count: int) -> list[Posed]:
    """States of the library that agree with a fit in most points but differ in others, as different as there are.

    A wheel that is seen on one side only may be half a turn off, or a finger taken for the other: everything else is
    right already.
    """
    model = problem.model
    goal = model.material(posed.z)[model.sparse].astype(np.float32)
    equal = np.ones(len(goal), dtype=np.float32)
    step = max(1, len(model.library) // SEARCHED)
    few = model.sparse_library[::step, :FEWER]
    alike = step * np.argsort(robust_poses(few, goal[:FEWER], equal[:FEWER], ALIKE * model.half)[0])[:POOL]
    _, rotation, translation = robust_poses(model.sparse_library[alike], goal, equal, ALIKE * model.half)
    shapes = np.matmul(model.sparse_library[alike], rotation.transpose(0, 2, 1)) + translation[:, None]
    place, z = posed.place(translation), model.library[alike].astype(np.float64)
    return [
        Posed(posed.rotation @ rotation[i], place[i], z[i], posed.log_scale)
        for i in _different(shapes.reshape(len(alike), -1), count)
    ]


def _different(shapes: Float[np.ndarray, "n c"], count: int) -> Int[np.ndarray, " m"]:
    """The first, then each time the one farthest from all before it."""
    chosen, distance = [0], ((shapes - shapes[0]) ** 2).sum(axis=1)
    while len(chosen) < min(count, len(shapes)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((shapes - shapes[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)
