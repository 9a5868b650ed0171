"""Answer one frame: the one way that every command and every public function goes.

Observation -find-> Candidate (by a search, or from a given pose) -fit draws-> Registration -recognize-> Recognition
-> Answer
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
from jaxtyping import Float

from mereo.fitting.config import FitConfig
from mereo.fitting.modes import resting
from mereo.fitting.problem.correspondences import Correspondences, fit_correspondences
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.problem import GivenPose, Problem
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.recognition import FEATURELESS, Recognition, recognize
from mereo.fitting.registration.register import CloudToFit, ModesFit, Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.search import SCREENING, Screen, rotations, search, tables_of
from mereo.geometry.camera import SightLines
from mereo.geometry.conventions import NoFit
from mereo.geometry.transforms import fit_rigid, transform_points
from mereo.io.bounds import Cells, PositiveOrUnknown, check_value
from mereo.io.cores import limit_blas_threads
from mereo.io.progress import stage
from mereo.models.trained import Trained
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.observation import Observation, main_length
from mereo.reconstruction.pipeline import EncodedFrame, encode_frame
from mereo.scenes.mechanism import Mechanism
from mereo.scenes.statistical_model import StatisticalModel


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
        registrar: of the same object, set up once for many frames; None leaves the network alone.
        keep_all: take every point for the object's.
        scene_unit: length of a scene unit in the frame's unit, where it is known for certain. Otherwise it follows
            from the frame's unit, or is found together with the pose.
        resolution: cells along the longest side of the object's box in ``Answer.reconstruction``.
        label_points: let ``Answer.reconstruction`` also label the observed points by segment.

    Raises ``ValueError`` for unusable clouds, and ``NoFit`` where no fit can start.
    """
    check_value("resolution", resolution, Cells, 128)
    check_value("scene_unit", scene_unit, PositiveOrUnknown, None)
    started = time.perf_counter()
    with stage("register the model"):
        candidate = find(seen, model, registrar, keep_all, scene_unit)
    answer = answer_candidate(seen, model, registrar, candidate)
    return replace(answer, resolution=resolution, label_points=label_points, seconds=time.perf_counter() - started)


def answer_candidate(
    seen: Observation, model: Trained | None, registrar: Registrar | None, candidate: Candidate
) -> Answer:
    """Answer a frame by what ``find`` or ``fit_states`` has found, with the parameters of the object's scene.

    Takes the arguments of ``answer_frame``.
    """
    registration = None
    if registrar is not None and candidate.modes is not None:
        with stage("fit the parameters of the scene"):
            registration = registrar.finish(candidate.modes)
    return answer_of(seen, model, registrar, candidate, registration)


def answer_of(
    seen: Observation,
    model: Trained | None,
    registrar: Registrar | None,
    candidate: Candidate,
    registration: Registration | None,
) -> Answer:
    """Make the answer of a candidate, and recognize the object in it."""
    stated = None if registrar is None else registrar.stated_scene_unit(seen.frame.unit_m)
    unseen = None if registration is None or seen.lines.other_lines is not None else candidate.unseen(registration)
    doubt = seen.doubt or (candidate.is_featureless and FEATURELESS) or (registration and registration.doubt) or None
    recognition = recognize(registration, stated, unseen, model is not None).doubted(doubt)
    used = candidate.encoded
    if registrar is not None and registration is not None:
        seen = in_registered_unit(seen, registrar, registration, recognition)
    return Answer(
        seen=seen.read_as(used.reading),
        model=model,
        registrar=registrar,
        hypothesis=used.reading,
        T_camera_input=used.T_camera_input,
        candidate=candidate,
        registration=registration,
        recognition=recognition,
        located_by=candidate.located_by,
    )


def in_registered_unit(
    seen: Observation, registrar: Registrar, registration: Registration, recognition: Recognition
) -> Observation:
    """Observation in the unit that a registration finds, where the frame knows none; another object's says nothing."""
    return seen if recognition.known is False else seen.in_unit(registrar.unit_of(registration))


# --- who finds the object ---------------------------------------------------------------------------------------------


def find(
    seen: Observation, model: Trained | None, registrar: Registrar | None, keep_all: bool, scene_unit: float | None
) -> Candidate:
    """Find the best fit to a frame by itself, or what the network alone answers.

    Takes the arguments of ``answer_frame``, and raises as it does.
    """
    if seen.initial_pose is not None and (registrar is None or scene_unit_of(seen, registrar, scene_unit) is None):
        raise ValueError(
            "an initial pose is given, and the length of the frame's or of the object's unit is not known, or there is "
            "no model to place: state the unit of both (--unit-m, --units), and leave the method auto"
        )
    if registrar is not None:
        return search_hypotheses(seen, registrar, keep_all, scene_unit)
    return Candidate(encode_frame(seen.readings(keep_all)[0], model, seen.frame.axes), located_by="network")


# --- outlier hypotheses -----------------------------------------------------------------------------------------------

# Thin parts of the object look like outliers, and geometry alone cannot tell them apart (``reconstruction.isolation``),
# so a fit decides: where that to the likelier hypothesis explains too little, the next is searched too.

SMALLEST, LARGEST = 0.05, 3.0
"""Longest side of a view, in those of the object at rest, beyond which a unit is wrong or the cloud another thing's."""


def search_hypotheses(seen: Observation, registrar: Registrar, keep_all: bool, scene_unit: float | None) -> Candidate:
    """Search the object in the likelier hypothesis, and in the other where that explains too little.

    Takes the arguments of ``answer_frame``, and raises as it does.
    """
    unit = scene_unit_of(seen, registrar, scene_unit)
    candidates = list[Candidate]()
    refusals = list[NoFit]()
    for reading in seen.readings(keep_all):
        try:
            candidates.append(_searched(reading, registrar, unit, seen))
        except NoFit as error:
            refusals.append(error)
        if candidates and candidates[-1].is_accepted:
            break
    if not candidates:
        raise refusals[0]
    return reduce(better, candidates)


def scene_unit_of(seen: Observation, registrar: Registrar, certain: float | None) -> float | None:
    """Length of a scene unit in the frame's unit: what is ``certain``, or as both state theirs; None where unknown."""
    return registrar.stated_scene_unit(seen.frame.unit_m) if certain is None else certain


def _searched(reading: Reading, registrar: Registrar, scene_unit: float | None, seen: Observation) -> Candidate:
    """Candidate of one hypothesis by a search, or from the initial pose that is given."""
    frame = encode_frame(reading, registrar.starting_network, seen.frame.axes)
    if seen.initial_pose is None or scene_unit is None:
        return fit_states(frame, registrar, scene_unit, seen, matches=registrar.correspondences(frame.code))
    starts = initial_states(frame.T_camera_input @ seen.initial_pose, registrar.states, scene_unit)
    return replace(fit_states(frame, registrar, scene_unit, seen, starts, everywhere=False), located_by="pose")


def fit_states(
    frame: EncodedFrame,
    registrar: Registrar,
    scene_unit: float | None,
    seen: Observation,
    states: Sequence[Posed] = (),
    everywhere: bool = True,
    matches: Correspondences | None = None,
) -> Candidate:
    """Candidate of one hypothesis by ``search_modes``; raises ``NoFit`` where that cannot start."""
    cloud = cloud_to_fit(frame, seen.lines, scene_unit)
    check_size(frame, registrar.model, scene_unit)
    modes = search_modes(cloud, registrar.states, registrar.config, states, everywhere, matches)
    return Candidate(frame, replace(modes, calibration=registrar.calibration))


def initial_states(T_camera_model: Float[np.ndarray, "4 4"], model: StatisticalModel, scene_unit: float) -> list[Posed]:
    """States of the model with a pose as ``Result.pose``, in scene units: at rest, and those of a mechanism."""
    placed = transform_points(T_camera_model, model.source_points(scene_unit)) / scene_unit
    states = [model.rest_z, *(tables_of(model, SCREENING.states).z if isinstance(model, Mechanism) else ())]
    poses = [fit_rigid(model.material(z), placed) for z in states]
    return [Posed(T[:3, :3], T[:3, 3], z.astype(float)) for T, z in zip(poses, states, strict=True)]


def cloud_to_fit(frame: EncodedFrame, lines: SightLines, scene_unit: float | None) -> CloudToFit:
    """Cloud that one hypothesis takes for the object's; ``lines`` are those around it, in the frame's axes."""
    reading, seen = frame.reading, frame.seen
    lines = lines.with_unknown(reading.whole.points[~reading.keep]).transformed(frame.T_camera_input)
    return CloudToFit(seen.points, scene_unit, lines, seen.normals)


def check_size(frame: EncodedFrame, model: StatisticalModel, scene_unit: float | None) -> None:
    """Raise ``NoFit`` for a cloud that is no view of an object of this size, where the size is known."""
    if scene_unit is None:
        return
    seen = float(np.ptp(frame.points, axis=0).max())
    whole = 2 * model.half * scene_unit
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


def better(first: Candidate, second: Candidate) -> Candidate:
    """Choose the fit that explains the greater share of all points; the first where both do."""
    assert first.modes is not None and second.modes is not None
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
    everywhere: bool = True,
    matches: Correspondences | None = None,
) -> ModesFit:
    """Fit the modes to a cloud by a search; where it leaves open what lies around it, the fits decide.

    It begins at ``starts`` that are known roughly, and where a network has the object (``matches``, in the cloud's
    unit), and goes on ``everywhere``. Where the object is held, it keeps the first start's pose.
    """
    started = time.perf_counter()
    with limit_blas_threads():
        unit = size_of(cloud, model) if cloud.scene_unit is None else cloud.scene_unit
        is_open = cloud.lines.other_lines is None
        evidence = cloud.evidence(unit)
        given = GivenPose(starts[0], HELD_STD * model.half) if starts and model.is_held else None
        whole = Problem(model, evidence, cloud.scale_std, config, given=given)
        whole = whole.with_noise(evidence.noise)
        if matches is not None:
            whole, guess = fit_correspondences(whole, matches, unit)
            starts = (*starts, guess)
        partial = replace(whole, evidence=replace(evidence, other_lines="unknown")) if is_open else None
        trail = search(whole, partial, starts, everywhere)
        problem, modes = trail.problem, trail.best
        rest = resting(problem, modes)
    seconds = time.perf_counter() - started
    return ModesFit(problem, unit, modes.posed, seconds, rest, others=trail.others)


def size_of(cloud: CloudToFit, model: StatisticalModel) -> float:
    """Guess a scene unit's length from a cloud alone: the median over rotations of the mean state."""
    evidence = cloud.kind.of(cloud.points, normals=cloud.normals)
    poses = Screen.of(tables_of(model, 0), evidence, model.half, scaled=True).starts(rotations(200))
    return float(np.exp(np.median(poses.log_scale)))
