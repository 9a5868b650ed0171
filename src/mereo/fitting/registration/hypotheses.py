"""Which of a frame's points belong to the object: each hypothesis is fitted, and the fits decide.

    Observation -hypotheses-> which points belong to the object -encode, fit modes-> Candidate of each hypothesis
        -choose-> the best candidate

Outliers move the box that the network's frame is made from, thin parts of the object look like outliers, and geometry
alone cannot tell them apart (``reconstruction.strays``). A model that explains the points can. A network is quick, and
is asked about every hypothesis; a search takes seconds, and goes on to the next where the first explains too little.
"""

import time
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mereo.fitting.config import FitConfig
from mereo.fitting.modes.fit import fit_rest, is_at_rest
from mereo.fitting.problem.correspondences import nothing
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.problem import KNOWN_SCALE_STD, Problem
from mereo.fitting.problem.residuals import NetworkTerm
from mereo.fitting.registration.answer import Candidate
from mereo.fitting.registration.fit import ModesFit
from mereo.fitting.registration.register import Registrar
from mereo.fitting.search.screening import Screen, tables_of
from mereo.fitting.search.search import rotations, search
from mereo.geometry.sight_lines import SightLines
from mereo.geometry.transforms import transform_points
from mereo.io.cores import one_blas_thread
from mereo.models.trained import Trained
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.pipeline import EncodedFrame, encode_frame
from mereo.reconstruction.strays import Reading, readings
from mereo.scenes.statistical_model import StatisticalModel

CLEARLY = 0.05
"""Share of all points that the hypothesis with every point must explain beyond the others: outliers pull its fit
towards them, so it explains a few more of them even where it is wrong."""

GIVEN_BACK = 0.8
"""Share of the dropped points that, once explained by the fit to the others, or by that to all, were none: then every
point is kept. The fit to all explains .86 and more of them on clean views, and at most .44 where they are outliers."""

SMALLEST, LARGEST = 0.05, 3.0
"""Longest side of a view, in those of the object at rest, beyond which a unit is wrong or the cloud another thing's."""

AS_WELL = 0.01
"""Share of all points that a fit with points given back may explain less."""


def fit_hypotheses(
    seen: Observation, model: Trained, registrar: Registrar | None, keep_all: bool, scene_unit: float | None
) -> tuple[Candidate, EncodedFrame]:
    """Fit the modes from the network's correspondences to each hypothesis.

    Takes the arguments of ``answer_frame`` and raises as it does; a fit that finds too little is in
    ``Candidate.error``. Returns the best candidate and the encoding of the likelier hypothesis.
    """
    started = time.perf_counter()
    axes = seen.frame.axes
    is_certain = scene_unit is not None
    if scene_unit is None and registrar is not None:
        scene_unit = registrar.stated_scene_unit(seen.frame.metres)
    hypotheses = readings(seen.cloud, axes, keep_all)
    likelier = encode_frame(hypotheses[0], model, axes)
    if registrar is None:
        return Candidate(likelier), likelier

    def fit(encoded: EncodedFrame, patience: Registrar) -> Candidate:
        dropped = encoded.reading.whole.points[~encoded.reading.keep]
        doubtful = transform_points(encoded.T_camera_input, dropped)
        try:
            lines = seen.lines.transformed(encoded.T_camera_input)
            modes = patience.fit_modes(encoded.seen, encoded.code, scene_unit, is_certain, doubtful, lines)
        except ValueError as error:
            return Candidate(encoded, error=error)
        return Candidate(encoded, modes)

    if len(hypotheses) == 1:
        return fit(likelier, registrar), likelier
    # beside outliers much stays unexplained in any case, which is no reason to ask again
    quick = registrar.at_once
    pair = fit(likelier, quick), fit(encode_frame(hypotheses[1], model, axes), quick)
    everything, surfaces = sorted(pair, key=lambda candidate: candidate.hypothesis.dropped)
    best = everything if surfaces.modes is None else surfaces
    if everything.modes is not None and surfaces.modes is not None:
        best = everything
        if not _are_object(everything, surfaces):
            given_back = _with_explained_given_back(surfaces)
            again = surfaces if given_back is None else fit(encode_frame(given_back, model, axes), quick)
            best = _most_explained(everything, surfaces, surfaces if again.modes is None else again)
    if best.modes is not None and not best.is_accepted:  # then it is not for outliers alone
        best = better(best, fit(best.encoded, registrar.at_last))
    if best.modes is not None:
        spent = time.perf_counter() - started - best.encoded.timings_s["encode"]
        best = replace(best, modes=replace(best.modes, seconds=spent))
    return best, likelier


def search_hypotheses(
    seen: Observation, registrar: Registrar, keep_all: bool, scene_unit: float | None
) -> tuple[Candidate, EncodedFrame]:
    """Search the object without a network, in the likelier hypothesis, and in the other where that explains too little.

    Takes the arguments of ``answer_frame``, and raises as it does for unusable clouds. Returns the best candidate and
    the likelier hypothesis.
    """
    unit, axes = registrar.stated_scene_unit(seen.frame.unit_m) if scene_unit is None else scene_unit, seen.frame.axes
    likelier, *others = (encode_frame(one, None, axes) for one in readings(seen.cloud, axes, keep_all))
    best = _searched(likelier, registrar, unit, seen.lines)
    for other in others:
        if best.is_accepted:
            break
        best = better(best, _searched(other, registrar, unit, seen.lines))
    return best, likelier


def _searched(frame: EncodedFrame, registrar: Registrar, scene_unit: float | None, beside: SightLines) -> Candidate:
    """Candidate of one hypothesis by a search; ``beside`` are the lines of sight beside the object."""
    dropped = frame.reading.whole.points[~frame.reading.keep]
    doubtful = transform_points(frame.T_camera_input, dropped) if len(dropped) else None
    try:
        check_size(frame, registrar.model, scene_unit)
        lines = beside.transformed(frame.T_camera_input)
        modes = search_modes(frame.seen.points, registrar.model, scene_unit, registrar.config, doubtful, lines)
    except ValueError as error:
        return Candidate(frame, error=error, found_by="search")
    return Candidate(frame, modes, found_by="search")


def check_size(frame: EncodedFrame, model: StatisticalModel, scene_unit: float | None) -> None:
    """Raise ``ValueError`` for a cloud that is no view of an object of this size, where the size is known."""
    if scene_unit is None:
        return
    seen, whole = float(np.ptp(frame.points, axis=0).max()), 2 * model.half * scene_unit
    if SMALLEST <= seen / whole <= LARGEST:
        return
    raise ValueError(
        f"what was seen is {seen:.3g} long in the frame's unit and the object {whole:.3g}, a factor of "
        f"{max(seen / whole, whole / seen):.3g}; a view shows from {SMALLEST:.0%} to {LARGEST:.0%} of it: correct the "
        "unit of the frame (--unit-m 0.001 for millimetres, --depth-scale for images) or that of the object's files "
        "(--units), or leave out of the cloud what is not the object"
    )


def _are_object(everything: Candidate, surfaces: Candidate) -> bool:
    """Whether the points that one hypothesis drops are the object's: either fit explains them."""
    dropped = ~surfaces.hypothesis.keep
    fits = [(one, one.modes) for one in (everything, surfaces) if one.modes is not None]
    return bool(max((one.off_surface[dropped] <= modes.tolerance).mean() for one, modes in fits) > GIVEN_BACK)


def _with_explained_given_back(surfaces: Candidate) -> Reading | None:
    """Hypothesis that also keeps the dropped points that its fit explains; None where it explains none of them."""
    assert surfaces.modes is not None
    explained, keep = surfaces.off_surface <= surfaces.modes.tolerance, surfaces.hypothesis.keep
    return replace(surfaces.hypothesis, keep=keep | explained) if explained[~keep].any() else None


def _most_explained(everything: Candidate, surfaces: Candidate, again: Candidate) -> Candidate:
    """Choose among every point, the points on surfaces, and these with explained points given back."""
    candidates = everything, surfaces, again
    tolerance = min(one.modes.tolerance for one in candidates if one.modes is not None)
    by_all, by_surfaces, by_again = (one.explained(tolerance) for one in candidates)
    if by_all >= max(by_surfaces, by_again) + CLEARLY:
        return everything
    return again if by_again >= by_surfaces - AS_WELL else surfaces


def better(first: Candidate, second: Candidate) -> Candidate:
    """Choose the fit that explains the greater share of all points; the first where both do."""
    if first.modes is None or second.modes is None:
        return first if second.modes is None else second
    tolerance = min(first.modes.tolerance, second.modes.tolerance)
    return first if first.explained(tolerance) >= second.explained(tolerance) else second


# --- the search -------------------------------------------------------------------------------------------------------

# Fit of the modes to a frame, found by search instead of from a network's correspondences.
#
# cloud, lines of sight, statistical model -search-> ModesFit

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
