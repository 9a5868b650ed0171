"""Fit of the modes to a frame, found by search instead of from a network's correspondences.

cloud, lines of sight, statistical model -search-> ModesFit
"""

import time
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mereo.fitting.config import FitConfig
from mereo.fitting.modes.rest import fit_rest, is_at_rest
from mereo.fitting.problem.correspondences import nothing
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import NetworkTerm
from mereo.fitting.registration.fit import KNOWN_SCALE_STD, ModesFit
from mereo.fitting.search.search import search
from mereo.geometry.sight_lines import SightLines
from mereo.io.cores import one_blas_thread
from mereo.scenes.statistical_model import StatisticalModel


def search_modes(
    points: Float[np.ndarray, "n 3"],
    model: StatisticalModel,
    scene_unit: float | None = None,
    config: FitConfig = FitConfig(),  # noqa: B008 (frozen)
    doubtful: Float[np.ndarray, "d 3"] | None = None,
    lines: SightLines | None = None,
) -> ModesFit:
    """Fit of the modes to a cloud, seen from the origin, found by search.

    Args:
        points: the cloud, any unit.
        model: the statistical model.
        scene_unit: length of a scene unit in the cloud's unit; found together with the pose where None.
        config: constants.
        doubtful: points that are none of the cloud: along their lines of sight nothing is known (``Evidence.of``).
        lines: what is known of the lines of sight beside the cloud; where they leave it open, the fits decide.
    """
    started = time.perf_counter()
    if scene_unit is None:
        raise NotImplementedError
    unit, scale_std = scene_unit, KNOWN_SCALE_STD
    with one_blas_thread():
        def problem_of(lines: SightLines | None) -> Problem:
            seen, outliers = points / unit, None if doubtful is None else doubtful / unit
            evidence = Evidence.of(seen, outliers, lines=None if lines is None else lines.scaled(1 / unit))
            return Problem(model, NetworkTerm.none(model), evidence, scale_std, config)

        is_open = lines is None or lines.elsewhere is None
        partial = replace(lines or SightLines.of_cloud(), elsewhere="unknown")
        found = search(problem_of(lines), problem_of(partial) if is_open else None)
        problem, modes = found.problem, found.best
        rest = fit_rest(problem, nothing(), modes.posed)
        at_rest = is_at_rest(problem, modes, rest)
    return ModesFit(problem, nothing(), unit, modes.posed, time.perf_counter() - started, rest if at_rest else None)
