"""The object at rest: the hypothesis that nothing is bent, judged against the modes by its evidence.

Modes can imitate noise, so their misfit is always lower; a hypothesis with fewer free numbers is right when the
difference is smaller than what that freedom buys. By Laplace's approximation (MacKay, Neural Computation 1992) that is
the logarithm of how much the frame narrows the coefficients, ``log det`` of their posterior precision, as the prior is
N(0, 1) each.
"""

from dataclasses import replace

import numpy as np

from mereo.fitting.modes.fit import Judged, fit_cloud
from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.priors import Prior
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import NetworkTerm
from mereo.geometry.transforms import fit_rigid


def fit_rest(problem: Problem, found: Correspondences, modes: Posed) -> Judged:
    """Fit of the rest model's pose, from that of the modes; its ``posed.z`` is empty."""
    model, config, rest = problem.model, problem.config, of_rest(problem, found)
    T = fit_rigid(model.rest_points, modes.place(model.material(modes.z)))
    start = Posed(T[:3, :3], T[:3, 3], np.empty(0), modes.log_scale)
    prior = Prior(np.empty(0), np.empty((0, 0)))
    posed = fit_cloud(rest, start, prior, config.refine_sigma, config.refine_steps, 0.0)
    return Judged.of(rest, posed)


def of_rest(problem: Problem, found: Correspondences) -> Problem:
    """The problem of the rest model's pose alone."""
    model = problem.model
    rigid = model.around(model.rest_points, np.zeros((len(model.rest_points), 3, 0), dtype=np.float32))
    return replace(problem, model=rigid, network=NetworkTerm.of(rigid, found))


def is_at_rest(problem: Problem, modes: Judged, rest: Judged) -> bool:
    """Whether the evidence of the rest model is greater than that of the modes."""
    return rest.misfit.total - modes.misfit.total < narrowing(problem, modes.posed)


def narrowing(problem: Problem, modes: Posed) -> float:
    """``NormalEquations.narrowing`` of the modes at a state."""
    config = problem.config
    known = problem.known(modes, Prior.whole(problem.model), 0.0)
    return problem.seen(known, modes, config.cloud_sigma, config.network_worth[1], True).narrowing()
