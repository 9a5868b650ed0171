"""A scene's own draws that explain a frame: Gauss and Newton's method on states that the scene really has.

Around a state the scene is linear in its draws (``draws_problem``); it is played with the draws that fit best there,
and so on, from several starts.
"""

from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.draws_problem import DrawsFit, DrawsProblem, between, draws_prior, jacobian, linear_step, played
from mereo.fitting.gauss_newton import Posed
from mereo.fitting.hypotheses import ALIKE, robust_poses
from mereo.fitting.modes_fit import fit_network
from mereo.fitting.playback import Drawn, material_moved
from mereo.fitting.residuals import NetworkTerm, robust_square
from mereo.geometry.transforms import fit_rigid

MOST_DRAWS = 120
"""Scenes with more free numbers are left to the modes."""

TOWARDS_MIDDLE = (1.0, 0.8, 0.6, 0.4)
"""Shares of guessed draws that are tried, until the scene takes them."""

SHARES = (1.0, 0.5, 0.2)
"""Shares of a step that are tried until the scene takes one."""


def fit_draws(problem: DrawsProblem, modes: Posed) -> DrawsFit | None:
    """The best of several starts; None where the scene has too many draws or plays none of them back."""
    config = problem.config
    if problem.states.z.shape[1] > MOST_DRAWS:
        return None
    starts = [fit for fit in (started(problem, *start) for start in choose_starts(problem, modes)) if fit is not None]
    guess = guessed(problem, modes)
    starts = [approach(problem, fit, modes) for fit in [*starts, *([] if guess is None else [guess])]]
    for rounds, keep in ((config.first_rounds, config.starts), (config.last_rounds, config.kept)):
        starts = sorted(starts, key=lambda fit: wide_misfit(problem, fit))[:keep]
        starts = [descend(problem, fit, rounds) for fit in starts]
    best = min(starts, key=lambda fit: fit.misfit, default=None)
    return None if best is None else jump(problem, best)


def guessed(problem: DrawsProblem, modes: Posed) -> DrawsFit | None:
    """The state whose draws the fit of the modes suggests, or one towards the middle where the scene refuses it."""
    model, drawn = problem.model, problem.states.guess(modes.z, problem.model.motion, problem.config.near)
    for share in TOWARDS_MIDDLE:
        z = np.where(drawn.smooth, share * drawn.z, drawn.z)
        deformations = drawn.deformations(problem.scene, z)
        if deformations is not None:
            T = fit_rigid(material_moved(problem.scene, model, deformations), modes.place(model.material(modes.z)))
            return played(problem, drawn, z, Posed(T[:3, :3], T[:3, 3], np.empty(0)))
    return None


def wide_misfit(problem: DrawsProblem, fit: DrawsFit) -> float:
    """Misfit by the cloud's first sigma."""
    seen = played(problem, fit.drawn, fit.z, fit.posed, wide=True)
    return np.inf if seen is None else seen.misfit


def approach(problem: DrawsProblem, fit: DrawsFit, modes: Posed) -> DrawsFit:
    """Towards the fit of the modes, which is dense and smooth where the frame is neither."""
    model, config = problem.model, problem.config
    target = modes.place(model.material(modes.z))[model.sparse]
    sigma, best, least = problem.base.network_sigma, fit, np.inf
    for number in range(config.approaches + 1):
        apart = robust_square(np.linalg.norm(fit.placed()[model.sparse] - target, axis=1), sigma).mean()
        if apart >= least:
            break
        best, least = fit, apart
        if number == config.approaches:
            break
        motion = jacobian(problem, fit)
        network = NetworkTerm(target, fit.material[model.sparse], motion[model.sparse], np.ones(len(target)))
        linear = replace(problem.around(fit.material, motion), network=network)
        start = replace(fit.posed, z=np.zeros(len(fit.z)))
        found = fit_network(linear, start, draws_prior(fit, motion, config.trust))
        tried = (
            played(problem, fit.drawn, fit.z + share * found.z, between(fit.posed, found, share)) for share in SHARES
        )
        fit = next((nearer for nearer in tried if nearer is not None), fit)
    return best


def jump(problem: DrawsProblem, fit: DrawsFit) -> DrawsFit:
    """One draw anywhere in its range, where that explains the frame better: a wheel by half a turn.

    Only while the cloud is not explained.
    """
    config, base = problem.config, problem.base
    for _ in range(config.jumps):
        if problem.rigid(fit.material).misfit(fit.posed).cloud < base.config.explained:
            break
        others = []
        for number in np.flatnonzero(fit.drawn.smooth):
            for value in ndtri((np.arange(config.places) + 0.5) / config.places):
                z = fit.z.copy()
                z[number] = value
                others.append(played(problem, fit.drawn, z, fit.posed, wide=True))
        likely = sorted((other for other in others if other is not None), key=lambda other: other.misfit)
        found = [descend(problem, other, config.first_rounds) for other in likely[: config.kept + 1]]
        best = min(found, key=lambda other: other.misfit, default=fit)
        if best.misfit >= fit.misfit:
            break
        fit = descend(problem, best, config.first_rounds)
    return fit


def choose_starts(problem: DrawsProblem, modes: Posed) -> list[tuple[int, Posed]]:
    """Seeds and poses: states like the fit of the modes, and states like the network's answer."""
    model, library = problem.model, problem.states.material
    each = problem.config.starts // 2
    sigma = ALIKE * model.half
    goal = modes.place(model.material(modes.z))[model.sparse].astype(np.float32)
    like_modes = robust_poses(library[:, model.sparse], goal, np.ones(len(goal), dtype=np.float32), sigma)
    few = slice(0, None, max(1, len(problem.found.labels) // 64))
    weights = PointWeights(problem.weights.index[few], problem.weights.weight[few])
    states = np.stack([weights(material) for material in library]).astype(np.float32)
    target, weight = problem.found.points[few], problem.found.confidence[few]
    like_network = robust_poses(
        states, target.astype(np.float32), weight.astype(np.float32), problem.base.network_sigma
    )
    result = []
    for cost, rotation, translation in (like_modes, like_network):
        best = np.argsort(cost)[:each]
        result += [(problem.states.seeds[i], Posed(rotation[i], translation[i], np.empty(0))) for i in best]
    return list({seed: (seed, pose) for seed, pose in result}.values())


def started(problem: DrawsProblem, seed: int, posed: Posed) -> DrawsFit | None:
    """A random state in its pose; None where it cannot be played back."""
    drawn = Drawn.of(problem.scene, seed)
    return played(problem, drawn, drawn.z, posed)


def descend(problem: DrawsProblem, fit: DrawsFit, rounds: int) -> DrawsFit:
    """Linearize, fit, play; a step that does not lower the misfit is halved, then given up.

    Half of the rounds judge by the wide misfit: far from the answer the narrow one is flat.
    """
    trust, sigma = problem.config.trust, problem.config.start_sigma
    for number in range(rounds):
        wide = 2 * number < rounds
        before = played(problem, fit.drawn, fit.z, fit.posed, wide)
        assert before is not None
        fit = before
        step, posed = linear_step(problem, fit, trust, sigma)
        for share in SHARES:
            tried = played(problem, fit.drawn, fit.z + share * step, between(fit.posed, posed, share), wide)
            if tried is not None and tried.misfit < fit.misfit:
                fit = tried
                break
        else:
            trust *= 0.3
        sigma *= 0.6
    return played(problem, fit.drawn, fit.z, fit.posed) or fit
