"""The answer to one frame: the one way that every command and every public function goes.

    Observation -hypotheses-> which points belong to the object -encode, fit modes-> Candidate of each hypothesis
        -choose-> the best candidate -fit draws-> Registration -recognize-> Recognition -> Answer

Outliers move the box that the network's frame is made from, thin parts of the object look like outliers, and geometry
alone cannot tell them apart (``reconstruction.strays``). A model that explains the points can: each hypothesis is
fitted, and the fits decide.
"""

import time
from dataclasses import replace

from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.recognition import Recognition, recognize
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.transforms import transform_points
from mereo.io.progress import stage
from mereo.models.model import Model
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.pipeline import EncodedFrame, encode_frame
from mereo.reconstruction.strays import Reading, readings

CLEARLY = 0.05
"""Share of all points that the hypothesis with every point must explain beyond the others: outliers pull its fit
towards them, so it explains a few more of them even where it is wrong."""

GIVEN_BACK = 0.8
"""Share of the dropped points that, once explained by the fit to the others, or by that to all, were none: then every
point is kept. The fit to all explains .86 and more of them on clean views, and at most .44 where they are outliers."""

AS_WELL = 0.01
"""Share of all points that a fit with points given back may explain less."""


def answer_frame(
    seen: Observation,
    model: Model,
    registrar: Registrar | None,
    *,
    keep_all: bool = False,
    scene_unit: float | None = None,
    resolution: int = 128,
    label_points: bool = False,
) -> Answer:
    """Answer to a frame, wherever it comes from.

    Args:
        seen: the object in the frame, outliers among its points.
        model: the weights.
        registrar: of the same object, set up once for many frames; None leaves the network alone. With "auto" a
            registration that does not explain the frame leaves the answer to the network, with other choices it is
            taken all the same.
        keep_all: take every point for the object's.
        scene_unit: length of a scene unit in the frame's unit, where it is known for certain. Otherwise it follows
            from the frame's unit where the network's estimate agrees, or is found together with the pose.
        resolution: cells along the longest side of the object's box in ``Answer.reconstruction``.
        label_points: let ``Answer.reconstruction`` also say on which segment each observed point lies.

    Raises ``ValueError`` for unusable clouds.
    """
    started = time.perf_counter()
    with stage("register the model"):
        candidate, likelier = fit_hypotheses(seen, model, registrar, keep_all, scene_unit)
    registration = None
    if registrar is not None and candidate.modes is not None:
        with stage("fit the parameters of the scene"):
            registration = registrar.finish(candidate.modes)
    answer = answer_of(seen, model, registrar, candidate, likelier, registration)
    seconds = time.perf_counter() - started
    return replace(answer, resolution=resolution, label_points=label_points, seconds=seconds)


def answer_of(
    seen: Observation,
    model: Model,
    registrar: Registrar | None,
    candidate: Candidate,
    likelier: EncodedFrame,
    registration: Registration | None,
) -> Answer:
    """Answer from the best candidate and its registration: recognize the object, and choose who answers."""
    displaced = None if registration is None else candidate.displaced(registration)
    stated = None if registrar is None else registrar.stated_scene_unit(seen.frame.unit_m)
    refusal = None if candidate.error is None else str(candidate.error)
    recognition = recognize(registration, model.calibration, displaced, stated, refusal)
    taken = registrar is not None and registration is not None and registrar.takes(registration)
    hypothesis = candidate.hypothesis if taken else likelier.reading
    if taken and registrar is not None and registration is not None:
        seen = in_found_unit(seen, registrar, registration, recognition)
    return Answer(
        seen=seen.read_as(hypothesis),
        model=model,
        registrar=registrar,
        hypothesis=hypothesis,
        T_camera_input=candidate.encoded.T_camera_input if taken else likelier.T_camera_input,
        candidate=candidate,
        registration=registration,
        taken=taken,
        recognition=recognition,
        likelier=likelier,
    )


def in_found_unit(
    seen: Observation, registrar: Registrar, registration: Registration, recognition: Recognition
) -> Observation:
    """Observation in the unit that a registration finds, where the frame knows none; another object's says nothing."""
    return seen if recognition.known is False else seen.in_unit(registrar.unit_of(registration))


# --- which points belong to the object --------------------------------------------------------------------------------


def fit_hypotheses(
    seen: Observation, model: Model, registrar: Registrar | None, keep_all: bool, scene_unit: float | None
) -> tuple[Candidate, EncodedFrame]:
    """Fit the modes to each hypothesis, and return the best candidate and the encoding of the likelier hypothesis.

    Takes the arguments of ``answer_frame`` and raises as it does; a fit that finds too little is in
    ``Candidate.error``.
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
            modes = patience.fit_modes(encoded.seen, encoded.code, scene_unit, is_certain, doubtful)
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
    if best.modes is not None and not best.modes.registration().accepted:  # then it is not for outliers alone
        best = _better(best, fit(best.encoded, registrar.at_last))
    if best.modes is not None:
        spent = time.perf_counter() - started - best.encoded.timings_s["encode"]
        best = replace(best, modes=replace(best.modes, seconds=spent))
    return best, likelier


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


def _better(first: Candidate, second: Candidate) -> Candidate:
    """Choose the fit that explains the greater share of all points; the first where both do."""
    if first.modes is None or second.modes is None:
        return first if second.modes is None else second
    tolerance = min(first.modes.tolerance, second.modes.tolerance)
    return first if first.explained(tolerance) >= second.explained(tolerance) else second
