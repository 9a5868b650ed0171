"""Pose and coefficients of the statistical model that explain a frame.

1. From the mean state, the network's correspondences alone, from wide to narrow.
2. Cloud, silhouette, free space, and less and less the correspondences.
3. The same again under the Gaussian of the library's states near the answer: states lie on curved sets, of which it is
   the tangent.
4. While the cloud is not explained, other states of the library, where the states lie on a curved set at all.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial.transform import Rotation

from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.problem.evidence import MOST_POINTS
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.problem import UNEXPLAINED, Misfit, Problem
from mereo.fitting.problem.residuals import NetworkTerm, Prior, Surface
from mereo.fitting.problem.segments import corner_positions
from mereo.geometry.downsampling import means_along_sight
from mereo.geometry.surface_patches import smoothed
from mereo.geometry.transforms import best_rotations, fit_rigid, robust_rigid, rotation_along


def fit_modes(problem: Problem) -> "ScoredFit":
    """The whole fit, and how well it explains the frame."""
    return explored(problem, refined(problem, fit_whole(problem)))


def refined(problem: Problem, posed: Posed) -> "ScoredFit":
    """The better of a state and of what its refinement makes of it."""
    return ScoredFit.of(problem, posed).better(problem, refine(problem, posed))


def explored(problem: Problem, best: "ScoredFit") -> "ScoredFit":
    """The best of a state and, while that does not explain the cloud, of others that agree with it or the network."""
    config = problem.config
    for number in range(config.rounds if len(problem.model.pairs) >= config.curved else 0):
        if problem.explained(best.misfit.cloud, best.surface, config.explained):
            break
        before = best
        for other in find_candidates(problem, best.posed, number):
            best = best.better(problem, refine(problem, other, config.last_widening, config.last_refine))
        if best is before:
            break
    return best


@dataclass(frozen=True, eq=False)
class ScoredFit:
    """A state, its misfit, and the surface that was judged."""

    posed: Posed
    misfit: Misfit
    surface: Surface

    @classmethod
    def of(cls, problem: Problem, posed: Posed) -> "ScoredFit":
        """Judge a state."""
        surface = Surface.of(problem.model, posed)
        return cls(posed, problem.misfit(posed, surface), surface)

    def better(self, problem: Problem, other: Posed) -> "ScoredFit":
        """This, or the other where its misfit is lower."""
        scored = ScoredFit.of(problem, other)
        return scored if scored.misfit.total < self.misfit.total else self


def find_candidates(problem: Problem, best: Posed, number: int) -> list[Posed]:
    """Other states that may explain the frame: chosen by few points, drawn towards the frame, chosen again."""
    config, coarse = problem.config, problem.coarse
    library = similar_states(problem, best, config.tries) + (
        states_like_network(problem, config.refined) if number == 0 else []
    )
    groups = (library, problem.joints.others(best, config.per_joint))
    sigma = config.refine_sigma * problem.model.half
    screened = [
        group[index]
        for group in groups
        for index in np.argsort([coarse.screen(other, sigma).total for other in group])[: config.screened]
    ]
    drawn = keep_diverse(problem, best, [refine(coarse, other, 2.0, config.screen_steps) for other in screened])
    order = np.argsort([problem.screen(other, sigma).total for other in drawn])
    return [drawn[index] for index in order[: config.refined]]


def keep_diverse(problem: Problem, best: Posed, others: list[Posed]) -> list[Posed]:
    """Those that differ from ``best`` and from all before them: from alike starts a fit ends alike."""
    model = problem.model
    positions = corner_positions(model, [best, *others])
    kept = [0]
    for index in range(1, len(positions)):
        apart = [np.linalg.norm(positions[index] - positions[other], axis=1).max() for other in kept]
        if min(apart) > ALIKE * model.half:
            kept.append(index)
    return [others[index - 1] for index in kept[1:]]


def fit_whole(problem: Problem) -> Posed:
    """Stages 1 and 2 from the mean state, under the prior of all states."""
    prior = Prior.whole(problem.model)
    z = np.zeros(problem.model.count)
    T = robust_rigid(problem.unposed(z), problem.network.target, problem.network.confidence, problem.network_sigma)
    return fit_wide(problem, fit_network(problem, Posed(T[:3, :3], T[:3, 3], z), prior))


def fit_wide(problem: Problem, posed: Posed) -> Posed:
    """Stage 2 from a state that may be far off, under the prior of all states."""
    config = problem.config
    prior = Prior.whole(problem.model)
    return fit_cloud(problem, posed, prior, config.start_sigma, config.last_steps, config.pair_slack)


def refine(problem: Problem, posed: Posed, widening: float = 1.0, steps: int | None = None) -> Posed:
    """Refined state, from nearby, under the prior of the library's states around ``posed``."""
    config = problem.config
    steps = config.refine_steps if steps is None else steps
    prior = Prior.near(problem.model, posed.z, config.neighbors, config.neighbor_std)
    return fit_cloud(problem, posed, prior, widening * config.refine_sigma, steps, 0.0)


def fit_network(problem: Problem, posed: Posed, prior: Prior) -> Posed:
    """The correspondences alone; robust from a third of the steps on."""
    config = problem.config
    for step in range(config.first_steps):
        share = step / max(1, config.first_steps - 1)
        sigma = problem.network_sigma * config.first_widening ** (1.0 - share)
        normal = problem.known(posed, prior, config.pair_slack * problem.model.half)
        robust = 3 * step >= config.first_steps
        normal = problem.network.add_to(normal, posed, sigma, config.first_weight, robust)
        posed = posed.moved(normal.step(config.damping))
    return posed


def fit_cloud(problem: Problem, posed: Posed, prior: Prior, start: float, steps: int, slack: float) -> Posed:
    """Everything that the frame shows; ``start`` (the cloud's first sigma) and ``slack`` are shares of ``half``."""
    config, half = problem.config, problem.model.half
    for step in range(steps):
        share = step / max(1, steps - 1)
        sigma = max(start * half * config.cooling**step, config.cloud_sigma)
        weight = config.network_weight[0] * (1 - share) + config.network_weight[1] * share
        normal = problem.known(posed, prior, slack * half * config.pair_cooling**step)
        exact = steps - step <= config.exact_steps and sigma <= 2 * config.cloud_sigma
        posed = posed.moved(problem.seen(normal, posed, sigma, weight, exact).step(config.damping))
    return posed


# --- states of the library from which a fit may start -----------------------------------------------------------------

# States of the library from which a fit may start: those that the network's answer resembles, or another fit does.

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


def states_like_network(problem: Problem, count: int) -> list[Posed]:
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


def similar_states(problem: Problem, posed: Posed, count: int) -> list[Posed]:
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


# --- the object at rest -----------------------------------------------------------------------------------------------

# The object at rest: the hypothesis that nothing is bent, judged against the modes by its evidence.
#
# Modes can imitate noise, so their misfit is always lower; a hypothesis with fewer free numbers is right when the
# difference is smaller than what that freedom buys. By Laplace's approximation (MacKay, Neural Computation 1992) that
# is the logarithm of how much the frame narrows the coefficients, ``log det`` of their posterior precision, as the
# prior is N(0, 1) each.


def fit_rest(problem: Problem, correspondences: Correspondences, modes: Posed) -> ScoredFit:
    """Fit of the rest model's pose, from that of the modes; its ``posed.z`` is empty."""
    model, config, rest = problem.model, problem.config, of_rest(problem, correspondences)
    T = fit_rigid(model.rest_points, modes.place(model.material(modes.z)))
    start = Posed(T[:3, :3], T[:3, 3], np.empty(0), modes.log_scale)
    prior = Prior(np.empty(0), np.empty((0, 0)))
    posed = fit_cloud(rest, start, prior, config.refine_sigma, config.refine_steps, 0.0)
    return ScoredFit.of(rest, posed)


def of_rest(problem: Problem, correspondences: Correspondences) -> Problem:
    """The problem of the rest model's pose alone."""
    model = problem.model
    rigid = model.around(model.rest_points, np.zeros((len(model.rest_points), 3, 0), dtype=np.float32))
    return replace(problem, model=rigid, network=NetworkTerm.of(rigid, correspondences))


def is_at_rest(problem: Problem, modes: ScoredFit, rest: ScoredFit) -> bool:
    """Whether the evidence of the rest model is greater than that of the modes."""
    return rest.misfit.total - modes.misfit.total < narrowing(problem, modes.posed)


def narrowing(problem: Problem, modes: Posed) -> float:
    """``NormalEquations.narrowing`` of the modes at a state."""
    config = problem.config
    known = problem.known(modes, Prior.whole(problem.model), 0.0)
    return problem.seen(known, modes, config.cloud_sigma, config.network_weight[1], True).narrowing()


# --- noisy frames -----------------------------------------------------------------------------------------------------

# A frame as it is understood: what the network states of it, and the fit to both; a noisy one is fitted once more.

PredictCorrespondences = Callable[[Float[np.ndarray, "n 3"]], Correspondences]
"""What the network states about points of the camera frame, in their unit."""

NetworkFit = tuple[Problem, Correspondences, ScoredFit]
"""A frame with what the network states of it, and the fit to both."""


def as_noisy(start: NetworkFit, points: Float[np.ndarray, "n 3"], predict: PredictCorrespondences | None) -> NetworkFit:
    """The fit to a noisy frame where what a fit leaves over is noise, else that one.

    Whether that is so is asked of the second fit: noise throws the first off by more than it is itself.

    Args:
        start: the frame, taken for a clean one.
        points: its cloud, scene units.
        predict: the network, which is also asked about the smoothed cloud.
    """
    problem, correspondences, modes = start
    noisy = problem.as_noisy_as(modes.surface)
    if noisy is None:
        return start
    others = [] if predict is None else [predict(smoothed(means_along_sight(points, MOST_POINTS)))]
    candidates = [(noisy, correspondences), *((noisy.with_network(other), other) for other in others)]
    fits = [(*candidate, fit_modes(candidate[0])) for candidate in candidates]
    best = min(fits, key=lambda fit: fit[2].misfit.without_network)
    return best if best[0].leaves_noise(best[2].surface) else start


# --- the network's answers with the camera turned ---------------------------------------------------------------------

# The network asked again with the camera turned, where a fit does not explain what is seen.
#
# A camera that turns about its own centre sees the same points along the same lines of sight, so the answer may only
# turn along with it. A network's does so where it understands what it sees; where it does not, each turn is another
# guess, and the fit tells which is right.

ROLL = np.pi / 4
"""Between one turn and the next about the line of sight to the object, rad."""

TILTS = np.deg2rad([0.0, 15.0, 15.0, 25.0])
"""Of the camera away from the object, one after the other for all rolls, rad."""

TILTED = 2.0
"""Angle between the directions of one tilt and the next."""

ROUND = 8
"""Turns that are tried at once; the best of them are fitted."""

FITTED = 2
"""How many."""


def turns(axis: Float[np.ndarray, "3"]) -> Iterator[Float[np.ndarray, "3 3"]]:
    """Rotations of the camera frame: rolls about a line of sight, without and with tilts away from it."""
    axis = axis / np.linalg.norm(axis)
    across = rotation_along(axis)[:, :2]
    count = round(2 * np.pi / ROLL)
    for number in range(1, count * len(TILTS)):
        toward = TILTED * number
        tilt = across @ np.array([np.cos(toward), np.sin(toward)]) * TILTS[number // count]
        yield (Rotation.from_rotvec(tilt) * Rotation.from_rotvec(number * ROLL * axis)).as_matrix()


def with_turned_camera(start: NetworkFit, predict: PredictCorrespondences | None) -> NetworkFit:
    """A fit as it is, or where much is unexplained the best of it and of those with the camera turned.

    Args:
        start: the frame as it is.
        predict: the network, in scene units.
    """
    problem, _, modes = start
    if predict is None or not problem.config.turned or not problem.wants_turns(modes.misfit.cloud, modes.surface):
        return start
    points, anyway = problem.evidence.points, problem.config.turned_anyway
    best, waiting = start, turns(points.mean(axis=0))
    while rounds := list(islice(waiting, ROUND)):
        for problem, correspondences in keep_best_turned(
            [predict_turned(start[0], points, turn, predict) for turn in rounds]
        ):
            modes = ScoredFit.of(problem, refine(problem, fit_whole(problem)))
            if modes.misfit.without_network < best[2].misfit.without_network:
                best = problem, correspondences, modes
        if best[2].misfit.cloud < UNEXPLAINED or (anyway and best[0].leaves_noise(best[2].surface)):
            break
    return best if best is start else (best[0], best[1], explored(best[0], best[2]))


def predict_turned(
    problem: Problem, points: Float[np.ndarray, "n 3"], turn: Float[np.ndarray, "3 3"], predict: PredictCorrespondences
) -> tuple[Problem, Correspondences]:
    """The frame with what the network states when the camera is turned, turned back."""
    correspondences = predict(points @ turn.T).turned(turn.T)
    return problem.with_network(correspondences), correspondences


def keep_best_turned(frames: list[tuple[Problem, Correspondences]]) -> list[tuple[Problem, Correspondences]]:
    """Those whose fit by few points explains the frame best."""
    costs = []
    for problem, _ in frames:
        coarse = problem.coarse
        posed = refine(coarse, fit_whole(coarse), 2.0, problem.config.screen_steps)
        costs.append(problem.screen(posed, problem.config.cloud_sigma).without_network)
    return [frames[index] for index in np.argsort(costs)[:FITTED]]
