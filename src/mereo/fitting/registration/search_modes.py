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
from mereo.fitting.problem.problem import KNOWN_SCALE_STD, Problem
from mereo.fitting.problem.residuals import NetworkTerm
from mereo.fitting.registration.fit import ModesFit
from mereo.fitting.search.screening import Screen
from mereo.fitting.search.search import rotations, search
from mereo.fitting.search.shape_tables import tables_of
from mereo.geometry.sight_lines import SightLines
from mereo.io.cores import one_blas_thread
from mereo.scenes.statistical_model import StatisticalModel

ROTATIONS = 200
"""Rotations by which the size of an object is guessed from its cloud."""


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
    with one_blas_thread():
        unit = size_of(points, model) if scene_unit is None else scene_unit
        lines = SightLines.of_cloud() if lines is None else lines
        outliers = None if doubtful is None else doubtful / unit
        evidence = Evidence.of(points / unit, outliers, lines=lines.scaled(1 / unit))
        scale_std = config.scale_std if scene_unit is None else KNOWN_SCALE_STD
        whole = Problem(model, NetworkTerm.none(model), evidence, scale_std, config)
        is_open = lines.elsewhere is None
        partial = replace(whole, evidence=replace(evidence, elsewhere="unknown")) if is_open else None
        found = search(whole, partial)
        problem, modes = found.problem, found.best
        rest = fit_rest(problem, nothing(), modes.posed)
        at_rest = is_at_rest(problem, modes, rest)
    seconds = time.perf_counter() - started
    return ModesFit(problem, nothing(), unit, modes.posed, seconds, rest if at_rest else None, alike=found.alike)


def size_of(points: Float[np.ndarray, "n 3"], model: StatisticalModel) -> float:
    """Length of a scene unit by the cloud's extent: the median over all rotations of the mean state.

    Args:
        points: the cloud, seen from the origin, any unit.
        model: the statistical model.
    """
    evidence = Evidence.of(points)
    poses = Screen.of(tables_of(model, 0), evidence, model.half, scaled=True).starts(rotations(ROTATIONS))
    return float(np.exp(np.median(poses.log_scale)))
