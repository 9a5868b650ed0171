"""A scene's own draws that explain a frame: Gauss and Newton's method on states that the scene really has.

Around a state the scene is linear in its draws (``draws_problem``); it is played with the draws that fit best there,
and so on, from several starts.
"""

import numpy as np
from scipy.special import ndtri

from mereo.deformation.moving_least_squares import spread
from mereo.fitting.draws_approach import Near, Shape, approach, derivatives, near, secant
from mereo.fitting.draws_problem import DrawsFit, DrawsProblem, misfit, normal_equations, played
from mereo.fitting.gauss_newton import POSE, Posed
from mereo.fitting.hypotheses import robust_poses
from mereo.fitting.playback import Drawn

MOST_DRAWS = 120
"""Scenes with more free numbers are left to the modes."""

RANKED_BY = 150
"""Points by which random states are compared with a shape."""

SHARES = (1.0, 0.5, 0.2)
"""Shares of a step that are tried until the scene takes one."""


def fit_draws(problem: DrawsProblem, modes: Posed) -> DrawsFit | None:
    """The best of several starts; None where the scene has too many draws or plays none of them back."""
    config = problem.config
    if problem.states.z.shape[1] > MOST_DRAWS:
        return None
    starts = [played(problem, here.drawn, here.z, posed_on(modes, here)) for here in approached(problem, modes)]
    starts = sorted((fit for fit in starts if fit is not None), key=lambda fit: fit.misfit)[: config.kept]
    starts = [descend(problem, fit, config.last_rounds) for fit in starts]
    best = min(starts, key=lambda fit: fit.misfit, default=None)
    return None if best is None else jump(problem, best)


def approached(problem: DrawsProblem, modes: Posed) -> list[Near]:
    """States shaped like the fit of the modes, the most alike first."""
    config, states, scene = problem.config, problem.states, problem.scene
    few, model = states.played, problem.model
    std = config.shape_std * model.half
    shape = Shape(model.material(modes.z)[few.index], np.full(len(few.index), std), config.shape_worth)
    drawn = [Drawn.of(scene, seed) for seed in alike(problem, shape)]
    drawn.append(states.guess(modes.z, model.motion, config.near))
    found = [near(scene, few, shape, one, one.z) for one in drawn]
    here = [one for one in found if one is not None]
    for fresh, keep in config.sieve:
        here = sorted(here, key=lambda one: one.misfit)[:keep]
        here = [approach(scene, few, shape, one, fresh) for one in here]
    return sorted(here, key=lambda one: one.misfit)


def alike(problem: DrawsProblem, shape: Shape) -> list[int]:
    """Seeds of the random states most like a shape."""
    states = problem.states
    some = spread(shape.points, RANKED_BY)
    library, goal = states.material[:, states.played.index[some]], shape.points[some].astype(np.float32)
    sigma = problem.base.network_sigma
    cost = robust_poses(library, goal, np.ones(len(some), dtype=np.float32), sigma)[0]
    return [states.seeds[row] for row in np.argsort(cost)[: problem.config.starts]]


def posed_on(modes: Posed, here: Near) -> Posed:
    """Pose in the camera frame of a state that lies on the fit of the modes."""
    rotation = modes.rotation @ here.rotation
    return Posed(rotation, modes.place(here.translation[None])[0], np.empty(0), modes.log_scale)


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
                others.append(played(problem, fit.drawn, z, fit.posed))
        likely = sorted((other for other in others if other is not None), key=lambda other: other.misfit)
        found = [descend(problem, other, config.first_rounds) for other in likely[: config.kept + 1]]
        best = min(found, key=lambda other: other.misfit, default=fit)
        if best.misfit >= fit.misfit:
            break
        fit = descend(problem, best, config.first_rounds)
    return fit


def descend(problem: DrawsProblem, fit: DrawsFit, fresh: int) -> DrawsFit:
    """Levenberg and Marquardt's method on played states; ``fresh`` sets of differences, each for some steps."""
    config, least = problem.config, problem.base.config.cloud_sigma
    few, sigma, damping = problem.states.played, max(config.start_sigma * problem.model.half, least), config.damping
    for number in range(fresh):
        here = Near(fit.drawn, fit.z, fit.material[few.index], np.eye(3), np.zeros(3), 0.0, 0.0)
        motion = derivatives(problem.scene, few, here, 0.02)
        for _ in range(config.steps):
            before = misfit(problem, fit, sigma)
            better = None
            for _ in range(config.tries):
                step = normal_equations(problem, fit, motion, sigma).step(damping)
                tried = played(problem, fit.drawn, fit.z + step[POSE:], moved(fit.posed, step))
                if tried is not None:
                    motion = secant(motion, step[POSE:], (tried.material - fit.material)[few.index])
                if TRACE: STAT.append((damping, tried is None, tried is not None and misfit(problem, tried, sigma) < before))
                if tried is not None and misfit(problem, tried, sigma) < before:
                    better = tried
                    break
                damping *= 6.0
            if better is None:
                break
            gain = before - misfit(problem, better, sigma)
            fit, damping = better, max(damping / 6.0, 1e-3)
            if gain < config.gain * before and sigma <= least:
                break
            sigma = max(sigma * config.cooling, least)
        if TRACE: LOG.append((number, time.process_time(), fit.misfit))
        damping = min(damping, 1.0)
    return fit


import time
TRACE, LOG, STAT = 0, [], []


def moved(posed, step):
    """Pose after a step."""
    return posed.moved(step[:POSE])
