"""Find an object in a whole depth image, in which everything else is seen as well.

DepthImage -regions-> masks -quick look-> places, the most evident first -choose points again, answer-> Answer
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from mereo.fitting.modes import bend_by_few, fit_from_far
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.problem import Problem
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.answer_frame import (
    answer_candidate,
    answer_frame,
    answer_of,
    cloud_to_fit,
    fit_states,
    scene_unit_of,
)
from mereo.fitting.registration.recognition import FIT, REFUSED, Signs, known_by
from mereo.fitting.registration.register import Registrar
from mereo.fitting.search import FITTED, Screening, screen_poses
from mereo.geometry.camera import DepthImage, PixelMask
from mereo.geometry.conventions import MIN_POINTS, NoFit
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.bounds import Cells, Instances, check_value
from mereo.io.cores import limit_blas_threads
from mereo.io.progress import stage
from mereo.locating.outline import Jumps, Outline, compare_outline
from mereo.locating.regions import FOLD, SIZES, connected_pixels, regions, steepest, thinned
from mereo.models.trained import Trained
from mereo.reconstruction.isolation import IsolationStep, Reading, Selection
from mereo.reconstruction.observation import HOLE_PX, Observation
from mereo.reconstruction.pipeline import encode_frame
from mereo.synthesis.depth_sensor import render_depth

QUICK = Screening(6, 40, 6)
"""That by which a region is looked at."""

LOOKS, ANSWERS = 12, 3
"""Regions that are looked at, and of these how many are answered, at most."""

CHANCE = -6.5
"""Nats of an object at a place of a frame where nobody says that it is there, to which those of outline and fit are
added: by a logistic regression of training desks, which gives these a weight of one (docs/experiments/098.md)."""

WORTH = 2.5
"""Nats that a better state must win at a place to be searched for."""

EVIDENT = WORTH - FIT - CHANCE
"""Nats of an outline from which on a place is evident, if its fit leaves no more to be won."""

NOWHERE = (
    "nothing {} is of the object's size and shape: check both units (--depth-scale, --units), or say "
    "where it is (--point, --mask, --box)"
)
"""Sentence about a frame without any place, which has a word for where."""

CROPS = ("depth range", "box")
"""Steps of isolation that leave a part of the image, in which the object is one thing among others."""

NEAR, REGION_NEAR = 0.1, 3.0
"""Distance along a ray from a state, in half lengths, up to which pixels are taken for the object's, and in that the
distance from its surface up to which those of its region are."""


def part_of(
    seen: Observation,
    mask: PixelMask,
    name: str = "whole frame",
    detail: str = "where the object is likeliest",
) -> Observation:
    """The object in a frame as a mask of its image has it, by a step of this name."""
    assert seen.frame.depth is not None
    keep = (mask & seen.kept_pixels())[seen.frame.depth.valid]
    steps = (*seen.steps, IsolationStep(name, len(seen.cloud), int(keep.sum()), detail))
    selection = Selection(keep, np.ones_like(keep), np.zeros_like(keep), steps)
    return replace(seen, cloud=seen.frame.cloud.rows(keep), selection=selection, steps=steps)


def pixels_near(image: DepthImage, mesh: SegmentedMesh, reach: float) -> PixelMask:
    """Pixels that see what lies as far away as a mesh does there, up to a ``reach`` in the image's unit."""
    depth = render_depth(mesh, image.camera).depth
    return image.valid & (depth > 0) & (np.abs(image.depth - depth) < reach)


@dataclass(frozen=True, eq=False)
class Place:
    """Place in an image where the object may be.

    Attributes:
        mask: pixels of a region, in the thinned image.
        states: of the object there, scene units, the most evident first.
        mesh: of that state, in the image's unit.
        outline: of that state.
    """

    mask: PixelMask
    states: tuple[Posed, ...]
    mesh: SegmentedMesh
    outline: Outline


@dataclass(frozen=True, eq=False)
class WholeFrame:
    """Whole depth image, in which an object of a known size is looked for.

    Attributes:
        seen: all of the frame, or what is in a box.
        thin: all of it with the thinned image.
        registrar: of the object.
        unit: length of a scene unit in the frame's unit.
        jumps: of the thinned image.
        every: of so many pixels along each side it has one.
    """

    seen: Observation
    thin: Observation
    registrar: Registrar
    unit: float
    jumps: Jumps
    every: int

    @classmethod
    def of(cls, seen: Observation, registrar: Registrar, scene_unit: float | None = None) -> "WholeFrame":
        """The image of a frame that has one, where a scene unit has this length, or as both state their units."""
        unit = scene_unit_of(seen, registrar, scene_unit)
        assert seen.frame.whole is not None and unit is not None
        length = 2 * registrar.model.half * unit
        image, every = thinned(seen.frame.whole, length)
        cloud = image.to_points()
        frame = replace(seen.frame, cloud=cloud, depth=image, whole=image)
        thin = replace(seen, frame=frame, cloud=cloud, selection=None)
        return cls(seen, thin, registrar, unit, Jumps.of(image, length), every)

    @property
    def whole(self) -> DepthImage:
        """Image with all that was measured."""
        assert self.seen.frame.whole is not None
        return self.seen.frame.whole

    @property
    def reach(self) -> float:
        """``NEAR`` in the image's unit."""
        return NEAR * self.registrar.model.half * self.unit

    def is_at_point(self, pixels: PixelMask) -> bool:
        """Whether some pixels of the thinned image are at the frame's point; any are where it has none."""
        column, row = self.seen.point or (0, 0)
        rows, columns = np.nonzero(pixels)
        distance = np.hypot(columns - column // self.every, rows - row // self.every)
        return self.seen.point is None or bool(distance.min(initial=np.inf) <= HOLE_PX)

    def explained(self, mesh: SegmentedMesh) -> PixelMask:
        """Pixels of the thinned image that see what lies as far away as a mesh does there."""
        return pixels_near(self.jumps.image, mesh, self.reach)

    def is_among(self, taken: PixelMask, mesh: SegmentedMesh) -> bool:
        """Whether most of the pixels that a mesh explains are taken."""
        return bool(taken.any()) and 2 * int((each := taken[self.explained(mesh)]).sum()) > len(each)

    def problem(self, seen: Observation) -> Problem:
        """What a fit to the object in the frame works on; raises ``NoFit`` where that is too little."""
        frame = encode_frame(Reading.of_all(seen.cloud), None, seen.frame.axes)
        cloud = cloud_to_fit(frame, seen.lines, self.unit)
        registrar = self.registrar
        return Problem(registrar.states, cloud.evidence(self.unit), cloud.scale_std, registrar.config)

    def place(self, mask: PixelMask, states: Sequence[Posed]) -> Place:
        """Place of some states."""
        model, (posed, *_) = self.registrar.states, states
        mesh = model.mesh(self.unit * posed.place(model.material(posed.z)))
        return Place(mask, tuple(states), mesh, self.outline(mesh))

    def outline(self, mesh: SegmentedMesh) -> Outline:
        """What the thinned image says of a mesh's outline."""
        return compare_outline(self.jumps, render_depth(mesh, self.jumps.image.camera).depth)

    def look(self, mask: PixelMask) -> Place:
        """Place of a region, with some states that are quickly fitted to it."""
        problem = self.problem(part_of(self.thin, mask))
        states = bend_by_few(problem, screen_poses(problem, QUICK), FITTED)
        ranked = sorted((self.place(mask, [posed]) for _, posed in states), key=lambda place: -place.outline.nats)
        return replace(ranked[0], states=tuple(place.states[0] for place in ranked))

    def places(self) -> Iterator[Place]:
        """Places where the object may be, at least one: such as may be evident at once, then others, ranked."""
        model = self.registrar.model
        area = self.unit**2 * ConvexHull(model.rest_points).area / 4  # of its shadow, over all directions
        image = self.jumps.image
        first = self.every // 2
        kept = self.seen.kept_pixels()[first :: self.every, first :: self.every]
        part = DepthImage(np.where(kept, image.depth, 0.0), image.camera)
        masks = islice(filter(self.is_at_point, regions(part, 2 * model.half * self.unit, area)), LOOKS)
        others = list[Place]()
        for place in map(self.look, masks):
            if place.outline.nats > EVIDENT:
                yield place
            else:
                others.append(place)
        others.sort(key=lambda place: -place.outline.nats)
        yield from (place for row, place in enumerate(others) if row == 0 or place.outline.nats > 0)

    def chosen(self, place: Place) -> Observation:
        """The object with the pixels of the whole image that a place explains, and those of its region near it."""
        image, mask, reach = self.whole, place.mask, self.reach
        # pixels between those of the thinned image are the region's where they go on with its surface
        rows, columns = (
            np.minimum(np.arange(size) // self.every, most - 1)
            for size, most in zip(image.depth.shape, mask.shape, strict=True)
        )
        thin = np.where(mask, self.jumps.image.depth, 0.0)[np.ix_(rows, columns)]
        region = (thin > 0) & (np.abs(image.depth - thin) <= steepest(self.jumps.image) * thin)
        points = image.camera.directions()[region] * image.depth[region][:, None]
        distance = cKDTree(np.concatenate([part.vertices for part in place.mesh.segments])).query(points)[0]
        region[region] = distance < REGION_NEAR * reach
        return part_of(self.seen, pixels_near(image, place.mesh, reach) | (image.valid & region))

    def sharpened(self, place: Place) -> Place:
        """The same by a fit of its first state to the pixels that are chosen by it, if a fit can start from these."""
        first, *others = place.states
        try:
            problem = self.problem(self.chosen(place))
        except NoFit:
            return place
        return self.place(place.mask, [fit_from_far(problem, first).posed, *others])

    def answered(self, place: Place, model: Trained | None, keep_all: bool, everywhere: bool) -> "PlacedAnswer | None":
        """Answer to the pixels of a place, by a search ``everywhere``, or by a fit from the place's states.

        Both begin at the network's guess as well, where there is a network. None where that finds nothing, or something
        that is not at the frame's point.
        """
        registrar = self.registrar
        try:
            seen = self.chosen(place)
            encoded = encode_frame(seen.readings(keep_all)[0], registrar.starting_network, seen.frame.axes)
            states = () if everywhere else place.states
            matches = registrar.correspondences(encoded.code)
            candidate = fit_states(encoded, registrar, self.unit, seen, states, everywhere, matches)
        except NoFit:
            return None
        assert candidate.modes is not None
        registration = candidate.modes.registration
        if not self.is_at_point(self.explained(registration.mesh)):
            return None
        answer = answer_of(seen, model, registrar, candidate, registration)
        return PlacedAnswer(place, seen, candidate, answer, self.outline(registration.mesh))

    def finished(self, placed: "PlacedAnswer", keep_all: bool) -> "PlacedAnswer":
        """The same where it may be the object: by pixels that are chosen once more, and with the scene's parameters."""
        modes, model = placed.candidate.modes, placed.answer.model
        if modes is None or placed.nats < REFUSED or placed.is_finished:
            return placed
        again = self.answered(self.place(placed.place.mask, [modes.posed]), model, keep_all, False)
        best = placed if again is None else max(placed, again, key=lambda each: each.score)
        answer = answer_candidate(best.seen, model, self.registrar, best.candidate)
        assert answer.registration is not None
        return replace(best, answer=answer, outline=self.outline(answer.registration.mesh), is_finished=True)


def locate_object(
    seen: Observation, registrar: Registrar, keep_all: bool, scene_unit: float | None
) -> tuple[Observation, Candidate]:
    """The object at the most evident place of a frame, by its modes; no fit where the outline is another thing's.

    Raises ``NoFit`` where nothing in the frame may be it.
    """
    frame = WholeFrame.of(seen, replace(registrar, method="modes"), scene_unit)
    best, *_ = instances_in(frame, answers_in(frame, registrar.network, keep_all), keep_all)
    return best.seen, best.candidate if best.nats > 0 else replace(best.candidate, modes=None)


def is_whole(seen: Observation, registrar: Registrar) -> bool:
    """Whether a frame is a depth image that plainly shows more than the object, whose size is known.

    So may be a part of the image in a box, or a range of depths. A mask is of the object alone.
    """
    frame = seen.frame
    unit = scene_unit_of(seen, registrar, None)
    if unit is None or seen.initial_pose is not None or frame.whole is None or frame.depth is None:
        return False
    is_part = len(frame.cloud) == int(frame.whole.valid.sum()) and all(step.name in CROPS for step in seen.steps)
    is_all = is_part and len(seen.cloud) == int(seen.kept_pixels().sum()) >= 4 * MIN_POINTS
    return is_all and seen.main_length > SIZES[1] * 2 * registrar.model.half * unit


def at_point(seen: Observation, registrar: Registrar | None) -> Observation:
    """The object at its point, if it has one: where the frame is not looked through, the connected surface.

    Raises ``ValueError`` where nothing is measured at it.
    """
    seen = seen.at_measurement()
    if seen.point is None or seen.frame.depth is None or (registrar is not None and is_whole(seen, registrar)):
        return seen
    image, (column, row) = seen.frame.depth, seen.point
    label = connected_pixels(np.where(seen.kept_pixels(), image.depth, 0.0), FOLD * steepest(image))
    return replace(part_of(seen, label == label[row, column], "point", "the connected surface at it"), point=None)


def evidence_of(answer: Answer, outline: Outline, stated: float = 0.0) -> float:
    """Nats by which an answer is likelier than something else that was taken for the object; some may be ``stated``."""
    return CHANCE + stated + signs_of(answer).nats + outline.nats


def signs_of(answer: Answer) -> Signs:
    """Signs of a registered answer."""
    assert answer.recognition.signs is not None
    return answer.recognition.signs


@dataclass(frozen=True, eq=False)
class PlacedAnswer:
    """Answer at one place, and the logarithm of how much likelier it is than something else that was taken for it.

    Attributes:
        place: whose pixels were chosen.
        seen: these pixels.
        candidate: the fit to them.
        answer: of that.
        outline: of that.
        is_finished: whether ``WholeFrame.finished`` has made it.
    """

    place: Place
    seen: Observation
    candidate: Candidate
    answer: Answer
    outline: Outline
    is_finished: bool = False

    @property
    def nats(self) -> float:
        """By the outline, and by what the fit leaves over."""
        return evidence_of(self.answer, self.outline)

    @property
    def score(self) -> float:
        """Nats of the answer as it is, by which answers are compared."""
        return self.nats - self.lost

    @property
    def mesh(self) -> SegmentedMesh:
        """Registered mesh, in the image's unit."""
        assert self.answer.registration is not None
        return self.answer.registration.mesh

    @property
    def lost(self) -> float:
        """Nats that a better state may win: those that the signs take off."""
        return FIT - signs_of(self.answer).nats

    @property
    def is_believed(self) -> bool:
        """Whether the object is known there."""
        return judged(self.answer, self.outline).recognition.known is True

    @property
    def is_evident(self) -> bool:
        """Whether it is believed, and no state is much better."""
        return self.is_believed and self.lost < WORTH


def answers_in(
    frame: WholeFrame, model: Trained | None, keep_all: bool = False, most: int = 1
) -> Iterator[PlacedAnswer]:
    """Answers at the most evident places of a whole frame, until so many at ``most`` are evident themselves.

    First from the states of the quick looks and a network's guess, then, where a better state may win more than the
    best has, by a search, which takes longer. Places where an evident answer explains most of the pixels
    are left out, and so are those where a fit finds nothing. Parameters of the object's scene are fitted where it is
    evident (``WholeFrame.finished``).
    """
    places = islice(frame.places(), ANSWERS + most - 1)
    waiting: Iterable[Place] = map(frame.sharpened, places)  # each once it is its turn
    taken = np.zeros_like(frame.jumps.image.valid)
    for everywhere in (False, True):
        answers = list[PlacedAnswer]()
        for place in waiting:
            if frame.is_among(taken, place.mesh) or not (placed := frame.answered(place, model, keep_all, everywhere)):
                continue
            placed = frame.finished(placed, keep_all) if placed.is_evident else placed
            yield placed
            taken |= placed.is_evident & frame.explained(placed.mesh)
            most -= placed.is_evident
            if most == 0:
                return
            answers.append(placed)
        least = min(0.0, max((placed.score for placed in answers), default=0.0))
        waiting = [
            each.place for each in answers if each.place.outline.nats > 0 and each.lost >= WORTH and each.nats > least
        ]


def answer_observation(
    seen: Observation,
    model: Trained | None,
    registrar: Registrar | None,
    *,
    keep_all: bool = False,
    resolution: int = 128,
    label_points: bool = False,
    instances: Instances = 1,
) -> Answer:
    """Answer a frame that shows the object alone, or a whole depth image in which it is one thing among others.

    Takes the arguments of ``answer_frame`` and raises as it does. Of a whole image that is the answer at the most
    evident place, with further ones where several ``instances`` are looked for. It is not known where something else is
    likelier there, as the image's jumps say, mask or none.
    """
    check_value("instances", instances, Instances, 1)
    most = LOOKS if instances == "all" else instances
    if registrar is None or not is_whole(seen, registrar):
        if instances != 1:
            raise ValueError(
                f"instances is {instances!r}, which a whole depth image alone may show of an object of a known size: "
                "state both units, leave mask and --remove-plane out, or leave it 1"
            )
        answer = answer_frame(
            seen, model, registrar, keep_all=keep_all, resolution=resolution, label_points=label_points
        )
        return judged(answer, outline_of(answer), -CHANCE)
    check_value("resolution", resolution, Cells, 128)
    started = time.perf_counter()
    with stage("look through the whole frame"), limit_blas_threads():
        frame = WholeFrame.of(seen, registrar)
        best, *others = instances_in(frame, answers_in(frame, model, keep_all, most), keep_all, most)
    answer = absent(best) if best.nats < REFUSED else judged(best.answer, best.outline)
    stated: dict[str, Any] = {"resolution": resolution, "label_points": label_points}
    further = tuple(replace(each.answer, **stated) for each in others if best.nats >= REFUSED)
    return replace(answer, **stated, further=further, seconds=time.perf_counter() - started)


def instances_in(
    frame: WholeFrame, answers: Iterable[PlacedAnswer], keep_all: bool, most: int = 1
) -> list[PlacedAnswer]:
    """The most evident answer, and those that are believed where no better one explains the same pixels.

    Raises ``NoFit`` where there are none.
    """
    instances = list[PlacedAnswer]()
    taken = np.zeros_like(frame.jumps.image.valid)
    for placed in sorted(answers, key=lambda placed: -placed.score):
        is_further = len(instances) < most and placed.is_believed and not frame.is_among(taken, placed.mesh)
        if is_further or not instances:
            instances.append(frame.finished(placed, keep_all))
            taken |= frame.explained(instances[-1].mesh)
    if not instances:
        raise NoFit(NOWHERE.format(frame.seen.where))
    return instances


def outline_of(answer: Answer) -> Outline | None:
    """What a depth image says of the outline of an answer in a part of it; None where nothing is around that part."""
    seen, registration = answer.seen, answer.registration
    whole = seen.frame.whole
    if registration is None or whole is None or seen.initial_pose is not None or seen.lines.other_lines is None:
        return None
    length = 2 * registration.model.half * registration.scene_unit
    jumps = Jumps.of(thinned(whole, length)[0], length)
    return compare_outline(jumps, render_depth(registration.mesh, jumps.image.camera).depth)


def judged(answer: Answer, outline: Outline | None, stated: float = 0.0) -> Answer:
    """The same, unsure or not known where its evidence speaks against it; ``stated`` are the nats of who says where."""
    if outline is None or answer.registration is None or answer.recognition.known is False:
        return answer
    known = known_by(evidence_of(answer, outline, stated))
    if known is True:
        return answer
    reason = (
        f"its outline is not clearly that of what was seen ({outline.hits} of {outline.hits + outline.misses} pixels "
        f"of it have an edge, {outline.past} inside have seen past it): look at the result before you rely on it, or "
        "take a frame that shows more of its outline"
    )
    return replace(answer, recognition=replace(answer.recognition, known=known, reason=reason))


def absent(best: PlacedAnswer) -> Answer:
    """Answer to a frame in which nothing is likelier to be the object than something else."""
    answer = best.answer
    x, y, z = answer.seen.cloud.points.mean(axis=0) * answer.seen.frame.metres
    reason = (
        f"the object is not {answer.seen.where}; what is most like it, at {x:.3g} {y:.3g} {z:.3g} "
        f"{answer.seen.frame.length_name}, has another outline or shape: take a frame that shows more of it, or say "
        "where it is (--point, --mask, --box)"
    )
    return replace(answer, recognition=replace(answer.recognition, known=False, reason=reason))
