"""Find an object in a whole depth image, in which everything else is seen as well.

DepthImage -regions-> masks -quick look-> places, the most evident first -choose points again, answer-> Answer
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull

from mereo.fitting.modes import bend_by_few
from mereo.fitting.problem.correspondences import NoFit
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import NetworkTerm
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame, cloud_to_fit, scene_unit_of
from mereo.fitting.registration.recognition import Recognition
from mereo.fitting.registration.register import Registrar
from mereo.fitting.search import SearchRound, screen_poses
from mereo.geometry.camera import DepthImage
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.io.bounds import Cells, check_value
from mereo.io.cores import limit_blas_threads
from mereo.io.progress import stage
from mereo.locating.outline import Jumps, Outline, compare_outline, rendered_depth
from mereo.locating.regions import SIZES, extent, regions, steepest, thinned
from mereo.models.trained import Trained
from mereo.reconstruction.isolation import IsolationStep, Reading
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.pipeline import encode_frame

QUICK = SearchRound(0, 400, 6, 3)
"""Round of the search by which a region is looked at."""

LOOKS, ANSWERS = 12, 3
"""Regions that are looked at, and of these how many are answered, at most."""

NEAR = 0.1
"""Distance in half lengths from the state of a quick look up to which pixels are taken for the object's."""


@dataclass(frozen=True, eq=False)
class Place:
    """Place in an image where the object may be.

    Attributes:
        mask: pixels of a region, in the thinned image.
        triangles: of the state that a quick look has found there, camera frame, the image's unit.
        outline: of that state.
    """

    mask: Bool[np.ndarray, "h w"]
    triangles: Float[np.ndarray, "f 3 3"]
    outline: Outline


@dataclass(frozen=True, eq=False)
class WholeFrame:
    """Whole depth image, in which an object of a known size is looked for.

    Attributes:
        seen: all of the frame.
        registrar: of the object.
        unit: length of a scene unit in the frame's unit.
        jumps: of the thinned image.
        every: of so many pixels along each side it has one.
    """

    seen: Observation
    registrar: Registrar
    unit: float
    jumps: Jumps
    every: int

    @classmethod
    def of(cls, seen: Observation, registrar: Registrar, scene_unit: float | None = None) -> "WholeFrame":
        """The image of a frame that has one, where a scene unit has this length, or as both state their units."""
        unit = scene_unit_of(seen, registrar, scene_unit)
        assert seen.frame.whole is not None and unit is not None
        thin, every = thinned(seen.frame.whole, 2 * registrar.model.half * unit)
        return cls(seen, registrar, unit, Jumps.of(thin), every)

    @property
    def whole(self) -> DepthImage:
        """Image with all that was measured."""
        assert self.seen.frame.whole is not None
        return self.seen.frame.whole

    def observed(self, image: DepthImage, mask: Bool[np.ndarray, "h w"], whole: DepthImage) -> Observation:
        """The object as a mask has it."""
        depth = DepthImage(np.where(mask, image.depth, 0.0), image.camera)
        cloud = depth.to_points()
        step = IsolationStep("whole frame", int(whole.valid.sum()), len(cloud), "a region that may be the object")
        frame = replace(self.seen.frame, cloud=cloud, depth=depth, whole=whole)
        return replace(self.seen, frame=frame, cloud=cloud, selection=None, steps=(*self.seen.steps, step))

    def look(self, mask: Bool[np.ndarray, "h w"]) -> Place:
        """Place of a region: the most evident of some states, quickly fitted to it.

        Raises ``NoFit`` and ``ValueError`` where the region is none that a fit can start from.
        """
        registrar, image = self.registrar, self.jumps.image
        model, seen = registrar.model, self.observed(image, mask, image)
        frame = encode_frame(Reading.of_all(seen.cloud), None, seen.frame.axes)
        cloud = cloud_to_fit(frame, seen.lines, self.unit)
        places = list[Place]()
        with limit_blas_threads():
            evidence = cloud.evidence(self.unit)
            problem = Problem(model, NetworkTerm.none(model), evidence, cloud.scale_std, registrar.config)
            for _, posed in bend_by_few(problem, screen_poses(problem, QUICK), QUICK.fitted):
                material = self.unit * posed.place(model.material(posed.z))
                places.append(self.place(mask, transform_points(inverse_rigid(frame.T_camera_input), material)))
        return max(places, key=lambda place: place.outline.nats)

    def place(self, mask: Bool[np.ndarray, "h w"], material: Float[np.ndarray, "m 3"]) -> Place:
        """Place of a state, given by its material points."""
        triangles = material[self.registrar.model.faces]
        outline = compare_outline(self.jumps, rendered_depth(self.jumps.image.camera, triangles))
        return Place(mask, triangles, outline)

    def places(self) -> list[Place]:
        """Places where the object may be, the most evident first."""
        model, places = self.registrar.model, list[Place]()
        area = self.unit**2 * ConvexHull(model.rest_points).area / 4  # of its shadow, over all directions
        for mask in regions(self.jumps.image, 2 * model.half * self.unit, area)[:LOOKS]:
            try:
                places.append(self.look(mask))
            except ValueError:
                continue
        return sorted(places, key=lambda place: -place.outline.nats)

    def chosen(self, place: Place) -> Observation:
        """The object with the pixels of the whole image that a place explains, or its region has."""
        image, mask = self.whole, place.mask
        depth = rendered_depth(image.camera, place.triangles)
        explained = (depth > 0) & (np.abs(image.depth - depth) < NEAR * self.registrar.model.half * self.unit)
        # pixels between those of the thinned image are the region's where they go on with its surface
        height, width = image.depth.shape
        rows, columns = (
            np.minimum(np.arange(size) // self.every, most - 1)
            for size, most in zip((height, width), mask.shape, strict=True)
        )
        thin = np.where(mask, self.jumps.image.depth, 0.0)[np.ix_(rows, columns)]
        goes_on = (thin > 0) & (np.abs(image.depth - thin) <= steepest(self.jumps.image) * thin)
        return self.observed(image, image.valid & (explained | goes_on), image)


def is_whole(seen: Observation, registrar: Registrar) -> bool:
    """Whether a frame is a depth image that plainly shows more than the object, whose size is known."""
    frame, unit = seen.frame, scene_unit_of(seen, registrar, None)
    if unit is None or seen.initial_pose is not None or frame.whole is None or frame.depth is None:
        return False
    is_all = len(seen.cloud) == int(frame.whole.valid.sum()) >= 4 * MIN_POINTS
    return is_all and extent(seen.cloud.points) > SIZES[1] * 2 * registrar.model.half * unit


@dataclass(frozen=True, eq=False)
class PlacedAnswer:
    """Answer at one place, and the logarithm of how much likelier it is than something else that was taken for it."""

    answer: Answer
    outline: Outline

    @property
    def nats(self) -> float:
        """By the outline, and by how strange the state and what is left over are."""
        return self.outline.nats - 0.5 * self.answer.recognition.strangeness**2


def answers_in(
    frame: WholeFrame, model: Trained | None, keep_all: bool = False, scene_unit: float | None = None
) -> Iterator[PlacedAnswer]:
    """Answers at the most evident places of a whole frame, without those where a fit finds nothing."""
    for place in frame.places()[:ANSWERS]:
        try:
            seen = frame.chosen(place)
            answer = answer_frame(seen, model, frame.registrar, keep_all=keep_all, scene_unit=scene_unit)
        except ValueError:
            continue
        if answer.registration is not None:
            material = transform_points(inverse_rigid(answer.T_camera_input), answer.registration.material)
            yield PlacedAnswer(answer, frame.place(place.mask, material).outline)


def answer_observation(
    seen: Observation,
    model: Trained | None,
    registrar: Registrar | None,
    *,
    keep_all: bool = False,
    resolution: int = 128,
    label_points: bool = False,
) -> Answer:
    """Answer a frame that shows the object alone, or a whole depth image in which it is one thing among others.

    Takes the arguments of ``answer_frame`` and raises as it does. Of a whole image that is the answer at the most
    evident place; where something else is likelier there, it is not known.
    """
    if registrar is None or not is_whole(seen, registrar):
        return answer_frame(seen, model, registrar, keep_all=keep_all, resolution=resolution, label_points=label_points)
    check_value("resolution", resolution, Cells, 128)
    started, best = time.perf_counter(), None
    with stage("look through the whole frame"):
        for placed in answers_in(WholeFrame.of(seen, registrar), model, keep_all):
            best = placed if best is None or placed.nats > best.nats else best
            if best.nats > 0:
                break
    if best is None:
        raise NoFit(
            "nothing in the whole frame is of the object's size and shape: check both units (--depth-scale, --units), "
            "or say where it is (--mask, --box)"
        )
    answer, seconds = best.answer, time.perf_counter() - started
    recognition = answer.recognition if best.nats > 0 else absent(best)
    return replace(answer, recognition=recognition, resolution=resolution, label_points=label_points, seconds=seconds)


def absent(best: PlacedAnswer) -> Recognition:
    """Recognition of a frame in which nothing is likelier to be the object than something else."""
    answer = best.answer
    x, y, z = answer.seen.cloud.points.mean(axis=0) * answer.seen.frame.metres
    reason = (
        f"the object is not in this frame; what is most like it, at {x:.3g} {y:.3g} {z:.3g} "
        f"{answer.seen.frame.length_name}, has another outline or shape: take a frame that shows more of it, or say "
        "where it is (--mask, --box)"
    )
    return replace(answer.recognition, known=False, reason=reason)
