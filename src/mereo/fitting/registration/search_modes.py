"""Pose and state without a network: poses and states are tried, and the fit's own evidence chooses.

Evenly spread rotations of the mean state and of a few of the library are put on the cloud, judged by few points, and
the best of them refined in ever fewer and longer fits.
"""

import time

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.fitting.config import FitConfig
from mereo.fitting.modes.fit import Judged, explored, fit_cloud, refine
from mereo.fitting.modes.rest import fit_rest, is_at_rest
from mereo.fitting.problem.correspondences import nothing
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.priors import Prior
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import NetworkTerm
from mereo.fitting.registration.fit import KNOWN_SCALE_STD, ModesFit
from mereo.geometry.sight_lines import SightLines
from mereo.io.cores import one_blas_thread
from mereo.scenes.statistical_model import StatisticalModel

ROTATIONS, STATES, UNSURE = 150, 1, 0.2


def search_modes(
    points: Float[np.ndarray, "n 3"],
    model: StatisticalModel,
    scene_unit: float | None = None,
    config: FitConfig = FitConfig(),  # noqa: B008 (frozen)
    doubtful: Float[np.ndarray, "d 3"] | None = None,
    lines: SightLines | None = None,
) -> ModesFit:
    """Fit of the modes to a cloud in the camera frame, in its unit; the unit is found where it is None."""
    started = time.perf_counter()
    unit = float(np.ptp(points, axis=0).max()) / (1.8 * model.half) if scene_unit is None else scene_unit
    none, whole = nothing(), Prior.whole(model)
    with one_blas_thread():
        evidence = Evidence.of(points / unit, None if doubtful is None else doubtful / unit)
        std = UNSURE if scene_unit is None else KNOWN_SCALE_STD
        problem = Problem(model, NetworkTerm.none(model), evidence, std, config)
        coarse = problem.coarse
        tried = sorted(starts(problem), key=lambda posed: coarse.screen(posed, 0.15 * model.half).total)[:40]
        wide = [fit_cloud(coarse, posed, whole, 0.12, 5, 0.05) for posed in tried]
        wide.sort(key=lambda posed: coarse.screen(posed, 0.05 * model.half).total)
        narrow = [fit_cloud(coarse, posed, whole, 0.05, 8, 0.05) for posed in wide[:10]]
        narrow.sort(key=lambda posed: coarse.screen(posed, 0.02 * model.half).total)
        fine = [fit_cloud(problem, p, whole, config.start_sigma, config.last_steps, 0.05) for p in narrow[:3]]
        judged = [Judged.of(problem, posed).better(problem, refine(problem, posed)) for posed in fine]
        best = explored(problem, min(judged, key=lambda one: one.misfit.total))
        noisy = problem.as_noisy_as(best.surface)
        if noisy is not None:
            refit = Judged.of(noisy, refine(noisy, best.posed))
            if noisy.leaves_noise(refit.surface):
                problem, best = noisy, refit
        rest = fit_rest(problem, none, best.posed)
        at_rest = is_at_rest(problem, best, rest)
    return ModesFit(problem, none, unit, best.posed, time.perf_counter() - started, rest if at_rest else None)


def starts(problem: Problem) -> list[Posed]:
    """Rotations times states, the middle of the faces that look at the camera on the middle of the cloud."""
    model, center = problem.model, problem.evidence.points.mean(axis=0)
    toward, found = center / np.linalg.norm(center), []
    for z in [np.zeros(model.count), *model.library[:STATES].astype(np.float64)]:
        corners = model.material(z)[model.faces]
        across, middle = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners.mean(axis=1)
        for rotation in Rotation.random(ROTATIONS, random_state=0).as_matrix():
            weight = np.maximum(-(across @ rotation.T) @ toward, 0.0)
            found.append(Posed(rotation, center - rotation @ (weight @ middle / weight.sum()), z))
    return found
