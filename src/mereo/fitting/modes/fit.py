"""Pose and coefficients of the statistical model that explain a frame.

1. From the mean state, the network's correspondences alone, from wide to narrow.
2. Cloud, silhouette, free space, and less and less the correspondences.
3. The same again under the Gaussian of the library's states near the answer: states lie on curved sets, of which it is
   the tangent.
4. While the cloud is not explained, other states of the library, where the states lie on a curved set at all.
"""

from dataclasses import dataclass

import numpy as np

from mereo.fitting.modes.hypotheses import ALIKE, by_likeness, by_network
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.joints import corner_places
from mereo.fitting.problem.priors import Prior
from mereo.fitting.problem.problem import Misfit, Problem
from mereo.fitting.problem.residuals import Surface
from mereo.geometry.procrustes import robust_rigid


def fit_modes(problem: Problem) -> "Judged":
    """The whole fit, and how well it explains the frame."""
    return explored(problem, refined(problem, fit_whole(problem)))


def refined(problem: Problem, posed: Posed) -> "Judged":
    """The better of a state and of what its refinement makes of it."""
    return Judged.of(problem, posed).better(problem, refine(problem, posed))


def explored(problem: Problem, best: "Judged") -> "Judged":
    """The best of a state and, while that does not explain the cloud, of others that agree with it or the network."""
    config = problem.config
    for number in range(config.rounds if len(problem.model.pairs) >= config.curved else 0):
        if problem.explained(best.misfit.cloud, best.surface, config.explained):
            break
        before = best
        for other in likely(problem, best.posed, number):
            best = best.better(problem, refine(problem, other, config.last_widening, config.last_refine))
        if best is before:
            break
    return best


@dataclass(frozen=True, eq=False)
class Judged:
    """A state, its misfit, and the surface that was judged."""

    posed: Posed
    misfit: Misfit
    surface: Surface

    @classmethod
    def of(cls, problem: Problem, posed: Posed) -> "Judged":
        """Judge a state."""
        surface = Surface.of(problem.model, posed)
        return cls(posed, problem.misfit(posed, surface), surface)

    def better(self, problem: Problem, other: Posed) -> "Judged":
        """This, or the other where its misfit is lower."""
        judged = Judged.of(problem, other)
        return judged if judged.misfit.total < self.misfit.total else self


def likely(problem: Problem, best: Posed, number: int) -> list[Posed]:
    """Other states that may explain the frame: chosen by few points, drawn towards the frame, chosen again."""
    config, coarse = problem.config, problem.coarse
    library = by_likeness(problem, best, config.tries) + (by_network(problem, config.refined) if number == 0 else [])
    groups = (library, problem.joints.others(best, config.places))
    sigma = config.refine_sigma * problem.model.half
    screened = [
        group[index]
        for group in groups
        for index in np.argsort([coarse.screen(other, sigma).total for other in group])[: config.screened]
    ]
    drawn = distinct(problem, best, [refine(coarse, other, 2.0, config.screen_steps) for other in screened])
    order = np.argsort([problem.screen(other, sigma).total for other in drawn])
    return [drawn[index] for index in order[: config.refined]]


def distinct(problem: Problem, best: Posed, others: list[Posed]) -> list[Posed]:
    """Those that differ from ``best`` and from all before them: from alike starts a fit ends alike."""
    model = problem.model
    places = corner_places(model, [best, *others])
    kept = [0]
    for index in range(1, len(places)):
        apart = [np.linalg.norm(places[index] - places[other], axis=1).max() for other in kept]
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
