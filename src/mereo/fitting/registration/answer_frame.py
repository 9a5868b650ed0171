"""The answer to one frame: the one way that every command and every public function goes.

Observation -find-> Candidate (by network, by search, or the better of both) -fit draws-> Registration
-recognize-> Recognition -> Answer
"""

import time
from dataclasses import replace

from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.residuals import Surface
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.fit import ModesFit
from mereo.fitting.registration.hypotheses import fit_hypotheses, search_hypotheses
from mereo.fitting.registration.recognition import Recognition, recognize
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.search.search import WHOLE
from mereo.io.progress import stage
from mereo.models.trained import Trained
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.pipeline import EncodedFrame

FORCED = 350.0
"""Misfit of prior and ruled-out surface together from which a search is asked too.

Fits to whole clean training views have at most 150; fits that take a view whose half is hidden for a whole one have 400
and more, although they explain its points."""

ASTRAY = 0.25
"""Distance between network and fit, in half lengths, from which a search is asked too: the network is no start there.

Of 48 clean training views of six shipped objects none has more than .1, under a camera's noise one in six has; weights
after 40 seconds of training have .3 to .5 in each view, where their fits explain the points by chance at most."""

HIDDEN = 0.12
"""Share of the silhouette beside which nothing is known from which a search is asked too, as a part is hidden.

Whole clean views have at most .03, those of which a tool hides 30 % .01 to .32, others that are cut .15 to .57."""


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
    """Answer to a frame, wherever it comes from.

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
        label_points: let ``Answer.reconstruction`` also say on which segment each observed point lies.

    Raises ``ValueError`` for unusable clouds, and where nothing is found and no network can answer.
    """
    started = time.perf_counter()
    with stage("register the model"):
        candidate, likelier = find(seen, model, registrar, keep_all, scene_unit)
    if candidate.error is not None and model is None:
        raise candidate.error
    registration = None
    if registrar is not None and candidate.modes is not None:
        with stage("fit the parameters of the scene"):
            registration = registrar.finish(candidate.modes)
    answer = answer_of(seen, model, registrar, candidate, likelier, registration)
    seconds = time.perf_counter() - started
    return replace(answer, resolution=resolution, label_points=label_points, seconds=seconds)


def answer_of(
    seen: Observation,
    model: Trained | None,
    registrar: Registrar | None,
    candidate: Candidate,
    likelier: EncodedFrame,
    registration: Registration | None,
) -> Answer:
    """Answer from the best candidate and its registration: recognize the object, and choose who answers."""
    displaced = None if registration is None else candidate.displaced(registration)
    stated = None if registrar is None else registrar.stated_scene_unit(seen.frame.unit_m)
    refusal = None if candidate.error is None else str(candidate.error)
    recognition = recognize(registration, None if model is None else model.calibration, displaced, stated, refusal)
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
        found_by=candidate.found_by if taken else "network",
    )


def in_found_unit(
    seen: Observation, registrar: Registrar, registration: Registration, recognition: Recognition
) -> Observation:
    """Observation in the unit that a registration finds, where the frame knows none; another object's says nothing."""
    return seen if recognition.known is False else seen.in_unit(registrar.unit_of(registration))


# --- who finds the object ---------------------------------------------------------------------------------------------


def find(
    seen: Observation, model: Trained | None, registrar: Registrar | None, keep_all: bool, scene_unit: float | None
) -> tuple[Candidate, EncodedFrame]:
    """Best fit to a frame by itself, and the hypothesis on its points that is likelier without a fit.

    A network starts the fit where there is one, in tenths of a second; where that does not explain the frame, or only
    with an unlikely state, or far from where the network has the object, and where a part of the object is hidden, a
    search is asked too, and the fit with the greater evidence is taken. Takes the arguments of ``answer_frame``, and
    raises as it does for unusable clouds.
    """
    if registrar is not None and not registrar.asks_network:
        return search_hypotheses(seen, registrar, keep_all, scene_unit)
    assert model is not None
    found, likelier = fit_hypotheses(seen, model, registrar, keep_all, scene_unit)
    if registrar is None or not registrar.asks_search or not is_doubtful(seen, found):
        return found, likelier
    searched, _ = search_hypotheses(seen, registrar, keep_all, scene_unit)
    return more_evident(found, searched), likelier


def is_doubtful(seen: Observation, found: Candidate) -> bool:
    """Whether a search may find the object where the network's fit has not."""
    return not found.is_accepted or is_forced(found) or is_astray(found) or is_hidden_in_part(seen, found)


def is_forced(candidate: Candidate) -> bool:
    """Whether a fit explains the points only by a state that is far from usual, or lies where nothing was seen."""
    modes = candidate.modes
    assert modes is not None
    surface = modes.surface if modes.rest is None else Surface.of(modes.problem.model, modes.posed)
    return modes.problem.witness_misfit(surface) + float(modes.posed.z @ modes.posed.z) > FORCED


def is_astray(candidate: Candidate) -> bool:
    """Whether a fit has ended far from where the network has the object, which then is no better start than chance."""
    assert candidate.modes is not None
    displaced = candidate.displaced(candidate.modes.registration())
    return displaced is not None and displaced > ASTRAY


def is_hidden_in_part(seen: Observation, candidate: Candidate) -> bool:
    """Whether an occluder or the picture's edge cuts the object: networks are trained on whole ones."""
    frame = candidate.encoded
    lines = seen.lines.transformed(frame.T_camera_input)
    if len(lines.unknown) == 0 and lines.elsewhere != "unknown":
        return False
    return Evidence.of(frame.seen.points, lines=lines).hidden_edge > HIDDEN


def more_evident(first: Candidate, second: Candidate) -> Candidate:
    """The candidate whose state has the lower misfit in the problem of the first; the first where both do.

    The second where it alone explains the frame: of a noisy one the first knows no noise. Where they differ in whether
    the object is seen whole, each in its own, as two hypotheses of a search.
    """
    if first.modes is None or second.modes is None:
        return first if second.modes is None else second
    if second.is_accepted and not first.is_accepted:
        return second
    one, other = first.modes.problem.evidence.elsewhere, second.modes.problem.evidence.elsewhere
    if one == other:
        return second if misfit_in(first.modes, second.modes) < misfit_in(first.modes, first.modes) else first
    cost = [
        misfit_in(each, each) + (WHOLE if each.problem.evidence.elsewhere == "unknown" else 0.0)
        for each in (first.modes, second.modes)
    ]
    return second if cost[1] < cost[0] else first


def misfit_in(frame: ModesFit, fitted: ModesFit) -> float:
    """Misfit of a fit's state in the problem of another fit to the frame, without the network's term."""
    model, surface = frame.problem.model, fitted.surface
    if fitted.unit != frame.unit:
        surface = Surface.through(model, surface.material * (fitted.unit / frame.unit))
    z = fitted.posed.z if fitted.rest is None else model.rest_z
    return frame.problem.misfit(replace(fitted.posed, z=z), surface).without_network
