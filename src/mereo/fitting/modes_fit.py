"""Pose and coefficients of the statistical model that explain a frame.

1. From the mean state, the network's correspondences alone, from wide to narrow.
2. Cloud, silhouette, free space, and less and less the correspondences.
3. The same again under the Gaussian of the library's states near the answer: states lie on curved sets, of which it is
   the tangent.
4. While the cloud is not explained, other states of the library, where the states lie on a curved set at all.
"""

import numpy as np

from mereo.fitting.gauss_newton import Posed
from mereo.fitting.hypotheses import by_likeness, by_network
from mereo.fitting.priors import Prior
from mereo.fitting.problem import Problem
from mereo.geometry.procrustes import robust_rigid


def fit_modes(problem: Problem) -> Posed:
    """The whole fit."""
    first = fit_whole(problem)
    best = better(problem, first, refine(problem, first))
    config = problem.config
    curved = len(problem.model.pairs) >= config.curved
    for number in range(config.rounds if curved else 0):
        if problem.misfit(best).cloud < config.explained:
            break
        others = by_likeness(problem, best, config.tries) + (by_network(problem, config.refined) if number == 0 else [])
        sigma = config.refine_sigma * problem.model.half
        likely = np.argsort([problem.misfit(other, sigma).total for other in others])
        for index in likely[: config.refined]:
            best = better(problem, best, refine(problem, others[index], widening=2.0))
    return best


def better(problem: Problem, one: Posed, other: Posed) -> Posed:
    """The one with the lower misfit."""
    return one if problem.misfit(one).total <= problem.misfit(other).total else other


def fit_whole(problem: Problem) -> Posed:
    """Stages 1 and 2 from the mean state, under the prior of all states."""
    prior = Prior.whole(problem.model)
    z = np.zeros(problem.model.count)
    T = robust_rigid(problem.unposed(z), problem.network.target, problem.network.confidence, problem.network_sigma)
    posed = fit_network(problem, Posed(T[:3, :3], T[:3, 3], z), prior)
    config = problem.config
    return fit_cloud(problem, posed, prior, config.start_sigma, config.last_steps, config.pair_slack)


def refine(problem: Problem, posed: Posed, widening: float = 1.0) -> Posed:
    """Refined state, from nearby, under the prior of the library's states around ``posed``."""
    config = problem.config
    prior = Prior.near(problem.model, posed.z, config.neighbors, config.neighbor_std)
    return fit_cloud(problem, posed, prior, widening * config.refine_sigma, config.refine_steps, 0.0)


def fit_network(problem: Problem, posed: Posed, prior: Prior) -> Posed:
    """The correspondences alone; robust from a third of the steps on."""
    config = problem.config
    for step in range(config.first_steps):
        share = step / max(1, config.first_steps - 1)
        sigma = problem.network_sigma * config.first_widening ** (1.0 - share)
        normal = problem.known(posed, prior, config.pair_slack * problem.model.half)
        robust = 3 * step >= config.first_steps
        normal = problem.network.add_to(normal, posed, sigma, config.first_worth, robust)
        posed = posed.moved(normal.step(config.damping))
    return posed


def fit_cloud(problem: Problem, posed: Posed, prior: Prior, start: float, steps: int, slack: float) -> Posed:
    """Everything that the frame shows; ``start`` (the cloud's first sigma) and ``slack`` are shares of ``half``."""
    config, half = problem.config, problem.model.half
    for step in range(steps):
        share = step / max(1, steps - 1)
        sigma = max(start * half * config.cooling**step, config.cloud_sigma)
        worth = config.network_worth[0] * (1 - share) + config.network_worth[1] * share
        normal = problem.known(posed, prior, slack * half * config.pair_cooling**step)
        exact = steps - step <= config.exact_steps and sigma <= 2 * config.cloud_sigma
        posed = posed.moved(problem.seen(normal, posed, sigma, worth, exact).step(config.damping))
    return posed
