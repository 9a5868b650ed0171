"""Answer one frame: the one way that every command and every public function goes.

Observation -find-> Candidate (by network, by search, or the better of both) -fit draws-> Registration
-recognize-> Recognition -> Answer
"""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mereo.fitting.config import FitConfig, LocatedBy
from mereo.fitting.modes import resting
from mereo.fitting.problem.correspondences import NoFit, nothing
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.problem import GivenPose, Problem
from mereo.fitting.problem.residuals import NetworkTerm
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.recognition import FEATURELESS, Recognition, recognize
from mereo.fitting.registration.register import CloudToFit, ModesFit, Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.search import ROUNDS, WHOLE, Screen, SearchRound, rotations, search, tables_of
from mereo.geometry.camera import SightLines
from mereo.geometry.transforms import fit_rigid, transform_points
from mereo.io.bounds import Cells, PositiveOrUnknown, check_value
from mereo.io.cores import limit_blas_threads
from mereo.io.progress import stage
from mereo.models.trained import Trained
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.observation import Observation, main_length
from mereo.reconstruction.pipeline import EncodedFrame, encode_frame
from mereo.scenes.statistical_model import StatisticalModel

FORCED = 350.0
"""Misfit of prior and ruled-out surface together from which a search follows: whole views have at most 150, those of
which half is hidden and that are taken for whole ones 400 and more."""

ASTRAY = 0.25
"""Distance between network and fit, in half lengths, from which a search follows, as the network is no start there:
right ones are at most .1 apart, those after 40 seconds of training .3 to .5."""

HIDDEN = 0.12
"""Share of the silhouette next to which nothing is known from which a search follows, as a part is hidden: whole views
have at most .03, those that are cut .15 to .57."""


def answer_frame(
    seen: Observation,
    model: Trained | None,
    registrar: Registrar | None,
    *,
    keep_all: bool = False,
    scene_unit: float | None = None,
    resolution: int = 128,
    label_points: bool = False,
) -> Answer:
    """Answer a frame, wherever it comes from.

    Args:
        seen: the object in the frame, outliers among its points.
        model: the weights; None of an object without.
        registrar: of the same object, set up once for many frames; None leaves the network alone. With "auto" a
            registration that does not explain the frame leaves the answer to the network, with other choices, and
            without a network, it is taken all the same.
        keep_all: take every point for the object's.
        scene_unit: length of a scene unit in the frame's unit, where it is known for certain. Otherwise it follows
            from the frame's unit (where a network's estimate agrees), or is found together with the pose.
        resolution: cells along the longest side of the object's box in ``Answer.reconstruction``.
        label_points: let ``Answer.reconstruction`` also label the observed points by segment.

    Raises ``ValueError`` for unusable clouds, and where nothing is found and no network can answer.
    """
    check_value("resolution", resolution, Cells, 128)
    check_value("scene_unit", scene_unit, PositiveOrUnknown, None)
    started = time.perf_counter()
    with stage("register the model"):
        candidate, likelier = find(seen, model, registrar, keep_all, scene_unit)
    answer = answer_candidate(seen, model, registrar, candidate, likelier)
    return replace(answer, resolution=resolution, label_points=label_points, seconds=time.perf_counter() - started)


def answer_candidate(
    seen: Observation, model: Trained | None, registrar: Registrar | None, candidate: Candidate, likelier: EncodedFrame
) -> Answer:
    """Answer a frame by what ``find`` or ``fit_states`` has found, with the parameters of the object's scene.

    Takes the arguments of ``answer_frame``, and raises ``NoFit`` where nothing is found and no network can answer.
    """
    if model is not None and candidate.modes is not None and candidate.located_by != "network":
        candidate = replace(candidate, modes=replace(candidate.modes, calibration=model.calibration))
    if candidate.error is not None and model is None:
        raise candidate.error
    modes = candidate.modes
    answer = answer_of(seen, model, registrar, candidate, likelier, None if modes is None else modes.registration)
    if registrar is not None and modes is not None:
        with stage("fit the parameters of the scene"):
            registration = registrar.finish(modes)
        if registration is not modes.registration:
            answer = answer_of(seen, model, registrar, candidate, likelier, registration)
    return answer


def answer_of(
    seen: Observation,
    model: Trained | None,
    registrar: Registrar | None,
    candidate: Candidate,
    likelier: EncodedFrame,
    registration: Registration | None,
) -> Answer:
    """Make the answer of the best candidate: recognize the object, and choose between registration and network."""
    displaced = None if registration is None else candidate.displaced(registration)
    stated = None if registrar is None else registrar.stated_scene_unit(seen.frame.unit_m)
    refusal = None if candidate.error is None else str(candidate.error)
    calibration = None if model is None else model.calibration
    unseen = None if registration is None or seen.lines.other_lines is not None else candidate.unseen(registration)
    doubt = seen.doubt or (candidate.is_featureless and FEATURELESS) or None
    recognition = recognize(registration, calibration, displaced, stated, refusal, unseen).doubted(doubt)
    taken = registrar is not None and registration is not None and registrar.takes(registration)
    used = candidate.encoded if taken else likelier
    if taken and registrar is not None and registration is not None:
        seen = in_registered_unit(seen, registrar, registration, recognition)
    return Answer(
        seen=seen.read_as(used.reading),
        model=model,
        registrar=registrar,
        hypothesis=used.reading,
        T_camera_input=used.T_camera_input,
        candidate=candidate,
        registration=registration,
        taken=taken,
        recognition=recognition,
        likelier=likelier,
        located_by=candidate.located_by if taken else "network",
    )


def in_registered_unit(
    seen: Observation, registrar: Registrar, registration: Registration, recognition: Recognition
) -> Observation:
    """Observation in the unit that a registration finds, where the frame knows none; another object's says nothing."""
    return seen if recognition.known is False else seen.in_unit(registrar.unit_of(registration))


# --- who finds the object ---------------------------------------------------------------------------------------------


def find(
    seen: Observation, model: Trained | None, registrar: Registrar | None, keep_all: bool, scene_unit: float | None
) -> tuple[Candidate, EncodedFrame]:
    """Find the best fit to a frame by itself, and the hypothesis on its points that is likelier without a fit.

    A network starts the fit where there is one, in tenths of a second; where that is doubtful (``is_doubtful``), a
    search follows, and the fit with the greater evidence is taken.

    Takes the arguments of ``answer_frame``, and raises as it does for unusable clouds.
    """
    if seen.initial_pose is not None and (registrar is None or scene_unit_of(seen, registrar, scene_unit) is None):
        raise ValueError(
            "an initial pose is given, and the length of the frame's or of the object's unit is not known, or there is "
            "no model to place: state the unit of both (--unit-m, --units), and leave the method auto"
        )
    is_searched = seen.initial_pose is not None or seen.extent == "surface"  # a network knows what one camera sees
    if registrar is not None and (not registrar.asks_network or is_searched):
        return search_hypotheses(seen, registrar, keep_all, scene_unit)
    assert model is not None
    candidate, likelier = fit_hypotheses(seen, model, registrar, keep_all, scene_unit)
    if registrar is None or not registrar.asks_search or not is_doubtful(seen, candidate):
        return candidate, likelier
    searched, _ = search_hypotheses(seen, registrar, keep_all, scene_unit)
    return more_evident(candidate, searched), likelier


def is_doubtful(seen: Observation, candidate: Candidate) -> bool:
    """Whether a search may find the object where the network's fit has not."""
    return (
        not candidate.is_accepted or is_forced(candidate) or is_astray(candidate) or is_hidden_in_part(seen, candidate)
    )


def is_forced(candidate: Candidate) -> bool:
    """Whether a fit explains the points only by a state that is far from usual, or lies where nothing was seen."""
    modes = candidate.modes
    assert modes is not None
    surface = modes.surface if modes.rest is None else modes.problem.surface(modes.posed)
    return modes.problem.silhouette_misfit(surface) + float(modes.posed.z @ modes.posed.z) > FORCED


def is_astray(candidate: Candidate) -> bool:
    """Whether a fit has ended far from where the network has the object, which then is no better start than chance."""
    assert candidate.modes is not None
    displaced = candidate.displaced(candidate.modes.registration)
    return displaced is not None and displaced > ASTRAY


def is_hidden_in_part(seen: Observation, candidate: Candidate) -> bool:
    """Whether an occluder or the picture's edge cuts the object: networks are trained on whole ones."""
    frame = candidate.encoded
    lines = seen.lines.transformed(frame.T_camera_input)
    if len(lines.unknown) == 0 and lines.other_lines != "unknown":
        return False
    return Evidence.of(frame.seen.points, lines=lines).hidden_edge > HIDDEN


def more_evident(first: Candidate, second: Candidate) -> Candidate:
    """The candidate whose state has the lower misfit in the problem of the first; the first where both do.

    The second where it alone explains the frame: of a noisy one the first knows no noise. Where they differ in the
    length of a scene unit, or in whether the object is seen whole, each in its own, as two hypotheses of a search.
    """
    if first.modes is None or second.modes is None:
        return first if second.modes is None else second
    if second.is_accepted and not first.is_accepted:
        return second
    fits = first.modes, second.modes
    if len({(each.unit, each.problem.evidence.other_lines) for each in fits}) == 1:
        return second if misfit_in(first.modes, second.modes) < misfit_in(first.modes, first.modes) else first
    cost = [misfit_in(each, each) + (WHOLE if each.problem.evidence.other_lines == "unknown" else 0.0) for each in fits]
    return second if cost[1] < cost[0] else first


def misfit_in(frame: ModesFit, fitted: ModesFit) -> float:
    """Misfit of a fit's state in the problem of another fit in the same unit, without the network's term."""
    z = fitted.posed.z if fitted.rest is None else frame.problem.model.rest_z
    return frame.problem.misfit(replace(fitted.posed, z=z), fitted.surface).without_network


# --- outlier hypotheses -----------------------------------------------------------------------------------------------

# Outliers move the box that the network's frame is made from, thin parts of the object look like outliers, and geometry
# alone cannot tell them apart (``reconstruction.isolation``), so a fit to each hypothesis decides. A network is quick,
# and starts a fit to each; a search takes seconds, and goes on to the next where the first explains too little.

CLEARLY = 0.05
"""Share of all points that the hypothesis with every point must explain beyond the others: outliers pull its fit
towards them, so it explains a few more of them even where it is wrong."""

GIVEN_BACK = 0.8
"""Share of the dropped points that, once explained by the fit to the others, or by that to all, were none: then every
point is kept. The fit to all explains .86 and more of them on clean views, and at most .44 where they are outliers."""

SMALLEST, LARGEST = 0.05, 3.0
"""Longest side of a view, in those of the object at rest, beyond which a unit is wrong or the cloud another thing's."""


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
    hypotheses = seen.readings(keep_all)[:2]
    likelier = encode_frame(hypotheses[0], model, axes)
    if registrar is None:
        return Candidate(likelier), likelier

    def fit(encoded: EncodedFrame) -> Candidate:
        try:
            modes = registrar.fit_modes(cloud_to_fit(encoded, seen.lines, scene_unit, is_certain), encoded.code)
        except NoFit as error:
            return Candidate(encoded, error=error)
        return Candidate(encoded, modes)

    if len(hypotheses) == 1:
        return fit(likelier), likelier
    pair = fit(likelier), fit(encode_frame(hypotheses[1], model, axes))
    everything, surfaces = sorted(pair, key=lambda candidate: candidate.hypothesis.dropped)
    best = everything if surfaces.modes is None else surfaces
    if everything.modes is not None and surfaces.modes is not None:
        best = everything
        if not _are_object(everything, surfaces):
            given_back = _with_explained_given_back(surfaces)
            again = surfaces if given_back is None else fit(encode_frame(given_back, model, axes))
            best = _most_explained(everything, surfaces, surfaces if again.modes is None else again)
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
    unit, axes = scene_unit_of(seen, registrar, scene_unit), seen.frame.axes
    likelier, *others = (encode_frame(reading, None, axes) for reading in seen.readings(keep_all))
    best = _searched(likelier, registrar, unit, seen)
    for other in others:
        if best.is_accepted:
            break
        best = better(best, _searched(other, registrar, unit, seen))
    return best, likelier


def scene_unit_of(seen: Observation, registrar: Registrar, certain: float | None) -> float | None:
    """Length of a scene unit in the frame's unit: what is ``certain``, or as both state theirs; None where unknown."""
    return registrar.stated_scene_unit(seen.frame.unit_m) if certain is None else certain


def _searched(frame: EncodedFrame, registrar: Registrar, scene_unit: float | None, seen: Observation) -> Candidate:
    """Candidate of one hypothesis by a search, or from the initial pose that is given."""
    by: LocatedBy = "search" if seen.initial_pose is None else "pose"
    starts = list[Posed]()
    if seen.initial_pose is not None and scene_unit is not None:
        starts.append(initial_state(frame.T_camera_input @ seen.initial_pose, registrar.model, scene_unit))
    return replace(fit_states(frame, registrar, scene_unit, seen, starts), located_by=by)


def fit_states(
    frame: EncodedFrame,
    registrar: Registrar,
    scene_unit: float | None,
    seen: Observation,
    states: Sequence[Posed],
    rounds: Sequence[SearchRound] = ROUNDS,
) -> Candidate:
    """Candidate of one hypothesis by a fit that begins at some states, or where there are none, by a search."""
    cloud = cloud_to_fit(frame, seen.lines, scene_unit)
    try:
        check_size(frame, registrar.model, scene_unit)
        modes = search_modes(cloud, registrar.model, registrar.config, states, rounds)
    except NoFit as error:
        return Candidate(frame, error=error, located_by="search")
    return Candidate(frame, modes, located_by="search")


def initial_state(T_camera_model: Float[np.ndarray, "4 4"], model: StatisticalModel, scene_unit: float) -> Posed:
    """State of the model at rest with a pose as ``Result.pose``, in scene units."""
    placed = transform_points(T_camera_model, model.source_points(scene_unit)) / scene_unit
    T = fit_rigid(model.material(model.rest_z), placed)
    return Posed(T[:3, :3], T[:3, 3], model.rest_z)


def cloud_to_fit(
    frame: EncodedFrame, lines: SightLines, scene_unit: float | None, is_unit_certain: bool = True
) -> CloudToFit:
    """Cloud that one hypothesis takes for the object's; ``lines`` are those around it, in the frame's axes."""
    dropped = frame.reading.whole.points[~frame.reading.keep]
    outliers = transform_points(frame.T_camera_input, dropped) if len(dropped) else None
    lines, seen = lines.transformed(frame.T_camera_input), frame.seen
    return CloudToFit(seen.points, scene_unit, is_unit_certain, outliers, lines, seen.normals)


def check_size(frame: EncodedFrame, model: StatisticalModel, scene_unit: float | None) -> None:
    """Raise ``NoFit`` for a cloud that is no view of an object of this size, where the size is known."""
    if scene_unit is None:
        return
    seen, whole = float(np.ptp(frame.points, axis=0).max()), 2 * model.half * scene_unit
    if SMALLEST <= seen / whole <= LARGEST:
        return
    most = main_length(frame.points)
    unit = (
        "correct the unit of the frame (--unit-m 0.001 for millimetres, --depth-scale for images) or that of the "
        "object's files (--units)"
    )
    crop = (
        "leave out of the cloud what is not the object (--remove-outliers, --depth-range, --box; most points span "
        f"{most:.3g})"
    )
    # where most points fit, others are stray, and the unit is right
    first, second = sorted((unit, crop), key=lambda cure: (cure == unit) == (SMALLEST <= most / whole <= LARGEST))
    raise NoFit(
        f"what was seen is {seen:.3g} long in the frame's unit and the object {whole:.3g}, a factor of "
        f"{max(seen / whole, whole / seen):.3g}; a view shows from {SMALLEST:.0%} to {LARGEST:.0%} of it: {first}, or "
        f"{second}"
    )


def _are_object(everything: Candidate, surfaces: Candidate) -> bool:
    """Whether the points that one hypothesis drops are the object's: either fit explains them."""
    dropped = ~surfaces.hypothesis.keep
    fits = [(candidate, candidate.modes) for candidate in (everything, surfaces) if candidate.modes is not None]
    return bool(
        max((candidate.off_surface[dropped] <= modes.tolerance).mean() for candidate, modes in fits) > GIVEN_BACK
    )


def _with_explained_given_back(surfaces: Candidate) -> Reading | None:
    """Hypothesis that also keeps the dropped points that its fit explains; None where it explains none of them."""
    assert surfaces.modes is not None
    explained, keep = surfaces.off_surface <= surfaces.modes.tolerance, surfaces.hypothesis.keep
    return replace(surfaces.hypothesis, keep=keep | explained) if explained[~keep].any() else None


def _most_explained(everything: Candidate, surfaces: Candidate, again: Candidate) -> Candidate:
    """Choose among every point, the points on surfaces, and these with explained points given back."""
    candidates = everything, surfaces, again
    tolerance = min(candidate.modes.tolerance for candidate in candidates if candidate.modes is not None)
    by_all, by_surfaces, by_again = (candidate.explained(tolerance) for candidate in candidates)
    if by_all >= max(by_surfaces, by_again) + CLEARLY:
        return everything
    return again if by_again >= by_surfaces - 0.01 else surfaces


def better(first: Candidate, second: Candidate) -> Candidate:
    """Choose the fit that explains the greater share of all points; the first where both do."""
    if first.modes is None or second.modes is None:
        return first if second.modes is None else second
    tolerance = min(first.modes.tolerance, second.modes.tolerance)
    return first if first.explained(tolerance) >= second.explained(tolerance) else second


# --- the search -------------------------------------------------------------------------------------------------------


HELD_STD = 0.01
"""Error of the pose of an object that is held, as a share of half the rest box's longest side."""


def search_modes(
    cloud: CloudToFit,
    model: StatisticalModel,
    config: FitConfig = FitConfig(),  # noqa: B008 (frozen)
    starts: Sequence[Posed] = (),
    rounds: Sequence[SearchRound] = ROUNDS,
) -> ModesFit:
    """Fit the modes to a cloud by a search of some rounds; where it leaves open what lies around it, the fits decide.

    With ``starts`` that are known roughly, the fit begins there, and keeps the first one's pose where the object is
    held.
    """
    started = time.perf_counter()
    with limit_blas_threads():
        unit = size_of(cloud, model) if cloud.scene_unit is None else cloud.scene_unit
        is_open = cloud.lines.other_lines is None
        evidence = cloud.evidence(unit)
        given = GivenPose(starts[0], HELD_STD * model.half) if starts and model.is_held else None
        whole = Problem(model, NetworkTerm.none(model), evidence, cloud.scale_std, config, given=given)
        whole = whole.with_noise(evidence.noise)
        partial = replace(whole, evidence=replace(evidence, other_lines="unknown")) if is_open else None
        trail = search(whole, partial, starts, rounds)
        problem, modes = trail.problem, trail.best
        rest = resting(problem, nothing(), modes)
    seconds = time.perf_counter() - started
    return ModesFit(problem, nothing(), unit, modes.posed, seconds, rest, others=trail.others)


def size_of(cloud: CloudToFit, model: StatisticalModel) -> float:
    """Guess a scene unit's length from a cloud alone: the median over rotations of the mean state."""
    evidence = cloud.kind.of(cloud.points, normals=cloud.normals)
    poses = Screen.of(tables_of(model, 0), evidence, model.half, scaled=True).starts(rotations(200))
    return float(np.exp(np.median(poses.log_scale)))
