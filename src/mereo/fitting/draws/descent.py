"""Levenberg and Marquardt's method on played states: from a start to the nearest state that explains the frame.

DrawsFit -derivatives-> motion of the played points -normal_equations-> a step of pose and draws -played-> DrawsFit
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from mereo.fitting.draws.approach import derivatives, secant
from mereo.fitting.draws.problem import DrawsFit, DrawsProblem, misfit, normal_equations, played
from mereo.fitting.problem.gauss_newton import POSE


def first_sigma(problem: DrawsProblem) -> float:
    """The cloud's first standard deviation, scene units."""
    return max(problem.config.start_sigma * problem.model.half, problem.base.config.cloud_sigma)


def descend(
    problem: DrawsProblem, fit: DrawsFit, fresh: int, motion: Float32[np.ndarray, "a 3 d"] | None = None
) -> DrawsFit:
    """Levenberg and Marquardt's method on played states, by ``fresh`` sets of differences after the given one."""
    config, least = problem.config, problem.base.config.cloud_sigma
    index, sigma, damping = problem.states.played.index, first_sigma(problem), config.damping
    for number in range(fresh + (motion is not None)):
        if number or motion is None:
            motion = derivatives(problem.states, fit.drawn, fit.z, fit.material[index])
        start = fit.misfit
        for _ in range(config.steps):
            before = misfit(problem, fit, sigma)
            fit, motion, damping = lower(problem, fit, motion, sigma, damping)
            gain = before - misfit(problem, fit, sigma)
            if gain == 0 or (gain < config.gain * before and sigma <= least):
                break
            sigma = max(sigma * config.cooling, least)
        if sigma <= least and start - fit.misfit < config.gain * start:
            break
        damping = min(damping, 1.0)
    return replace(fit, motion=motion)


def lower(
    problem: DrawsProblem, fit: DrawsFit, motion: Float32[np.ndarray, "a 3 d"], sigma: float, damping: float
) -> tuple[DrawsFit, Float32[np.ndarray, "a 3 d"], float]:
    """A state of lower misfit, or the same; what was learnt of the motion; the next damping."""
    index, least = problem.states.played.index, misfit(problem, fit, sigma)
    for _ in range(problem.config.tries):
        step = normal_equations(problem, fit, motion, sigma).step(damping)
        tried = played(problem, fit.drawn, fit.z + step[POSE:], fit.posed.moved(step[:POSE]))
        if tried is not None:
            motion = secant(motion, step[POSE:], (tried.material - fit.material)[index])
            if misfit(problem, tried, sigma) < least:
                return tried, motion, max(damping / 6.0, 1e-3)
        damping *= 6.0
    return fit, motion, damping
