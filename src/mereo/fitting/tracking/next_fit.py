"""One frame's fit of the modes, from the state of the frame before.

    Track (state, time), cloud -next_fit-> ModesFit, another Track

Against a fit of a frame by itself: no network, no wide start, no other states. What takes the network's place is the
expectation that material points are where they were (or where they were going), up to a speed; as hidden ones hardly
have any other evidence, they come to rest.
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mereo.fitting.config import FitConfig
from mereo.fitting.problem.correspondences import nothing
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed, in_space
from mereo.fitting.problem.problem import KNOWN_SCALE_STD, Problem, constants_for
from mereo.fitting.problem.residuals import NetworkTerm, Prior
from mereo.fitting.registration.fit import ModesFit
from mereo.fitting.search.search import WHOLE
from mereo.fitting.tracking.config import TrackConfig
from mereo.geometry.downsampling import means_along_sight
from mereo.geometry.sight_lines import SightKind, SightLines
from mereo.io.cores import one_blas_thread
from mereo.models.calibration import Calibration


@dataclass(frozen=True, eq=False)
class Track:
    """State of an object at a time, from which the next frame is fitted.

    Attributes:
        problem: of that frame, without correspondences: the model, and constants by the frame's noise.
        unit: length of a scene unit in the clouds' unit.
        posed: the state, scene units, without a scale.
        time_s: of the frame.
        velocity: of the parameters, in the order of ``gauss_newton``, a second.
        unsure: how far the velocity may be off because little is known yet, scene units per second.
        noise: of the frames, smoothed, scene units.
        clean: constants of frames without noise; ``problem`` has those for ``noise``.
        other_lines: kind of the lines of sight of which a frame says nothing, as it was when the track began.
        area: greatest area of the object that was seen (``seen_area``).
        calibration: as ``ModesFit`` has it.
    """

    problem: Problem
    unit: float
    posed: Posed
    time_s: float
    velocity: Float[np.ndarray, " p"]
    unsure: float
    noise: float
    clean: FitConfig
    other_lines: SightKind
    area: float
    calibration: Calibration | None = None

    @classmethod
    def of(
        cls,
        fitted: ModesFit,
        time_s: float,
        config: TrackConfig,
        clean: FitConfig = FitConfig(),  # noqa: B008 (frozen)
    ) -> "Track":
        """Track that begins with a frame's own fit."""
        posed, scale = without_scale(fitted.posed)
        base, model = fitted.problem, fitted.problem.model
        scale_std = config.scale_std if base.is_scale_open else KNOWN_SCALE_STD
        problem = replace(base, network=NetworkTerm.none(model), scale_std=scale_std)
        share_surfaces(base, problem)
        still, noise = np.zeros(POSE + model.count), fitted.problem.residual_noise(fitted.surface)
        unit, unsure, seen = fitted.unit * scale, config.first_speed, base.evidence
        area, kind = seen_area(seen), seen.other_lines
        return cls(problem, unit, posed, time_s, still, unsure, noise, clean, kind, area, fitted.calibration)

    def expected(self, time_s: float, config: TrackConfig) -> Posed:
        """State that is expected at a time."""
        if config.motion == "pose":
            return self.posed
        # James and Stein's estimate of a mean, positive part: small motion may be noise alone, large motion is not
        counted = max(1.0 - (config.dead / max(self.speed, 1e-9)) ** 2, 0.0)
        return self.posed.moved(counted * self.velocity * (time_s - self.time_s))

    @cached_property
    def squared(self) -> Float[np.ndarray, "p p"]:
        """Mean square of a material point's way, as a form of the parameters' step."""
        model = self.problem.model
        rows = model.sparse
        modes = model.modes[rows]
        place = self.posed.place(model.mean[rows] + modes @ self.posed.z.astype(np.float32))
        jacobian = in_space(self.posed, place, modes).astype(np.float64)
        form: Float[np.ndarray, "p p"] = jacobian.T @ jacobian / len(rows)
        return form

    @property
    def speed(self) -> float:
        """Speed that the object seems to have: root mean square of its points, scene units per second."""
        return float(np.sqrt(self.velocity @ self.squared @ self.velocity))


def without_scale(posed: Posed) -> tuple[Posed, float]:
    """A state in the unit that its own scale makes of the scene's, and that scale."""
    scale = float(np.exp(posed.log_scale))
    return replace(posed, translation=posed.translation / scale, log_scale=0.0), scale


def share_surfaces(base: Problem, other: Problem) -> None:
    """Give a problem of the same model what another has prepared of the model's surface."""
    vars(other).update({"pairs": base.pairs, "samples": base.samples})


def gated(track: Track, points: Float[np.ndarray, "n 3"], time_s: float, config: TrackConfig) -> Bool[np.ndarray, " n"]:
    """Which points, in the cloud's unit, lie near the expected surface; others are strays, or the object is lost."""
    samples = track.problem.samples.every(2)
    place = samples.posed(track.expected(time_s, config)).place
    most = config.gate * track.problem.model.half + samples.spacing
    distance = cKDTree(place).query(points / track.unit, distance_upper_bound=most)[0]
    return np.isfinite(distance)


def next_fit(
    track: Track,
    points: Float[np.ndarray, "n 3"],
    outliers: Float[np.ndarray, "d 3"],
    time_s: float,
    config: TrackConfig,
    lines: SightLines,
) -> tuple[ModesFit, Track]:
    """Fit of the modes to a frame, and the track that ends with it.

    Args:
        track: up to the frame before.
        points: of the object, camera frame, the clouds' unit.
        outliers: points that are none of it (``Evidence.of``).
        time_s: of the frame.
        config: constants.
        lines: what is known of the lines of sight beside the points, in the same frame and unit. Where they leave it
            open, the object is seen whole or in part as it was when the track began; where it was seen whole and the
            frame rules that out by more than ``WHOLE``, it is fitted as seen in part too, and the better fit is taken.
    """
    started = time.perf_counter()
    with one_blas_thread():
        few = means_along_sight(points / track.unit, config.points)
        start = track.expected(time_s, config)
        expectation = Expectation.of(track, start, max(time_s - track.time_s, 0.0), config)

        def fit(other_lines: SightKind) -> ModesFit:
            sight_lines = replace(lines.scaled(1 / track.unit), other_lines=other_lines)
            problem = replace(
                track.problem, evidence=Evidence.of(few, outliers / track.unit, config.observed_samples, sight_lines)
            )
            share_surfaces(track.problem, problem)
            posed = descend(problem, start, expectation, config)
            return ModesFit(problem, nothing(), track.unit, posed, 0.0, calibration=track.calibration)

        fitted = fit(lines.other_lines or track.other_lines)
        if lines.other_lines is None and is_ruled_out(fitted):
            fitted = less_ruled_out(fitted, fit("unknown"))
    fitted = replace(fitted, seconds=time.perf_counter() - started)
    return fitted, followed(track, fitted, time_s, config)


def is_ruled_out(fitted: ModesFit) -> bool:
    """Whether a frame rules out so much of a state that something may hide the object in part."""
    return fitted.problem.silhouette_misfit(fitted.surface) > WHOLE


def less_ruled_out(whole: ModesFit, partial: ModesFit) -> ModesFit:
    """The second fit, to an object of which a part is hidden, where it is better by as much as a search demands."""
    misfits = [fitted.problem.misfit(fitted.posed, fitted.surface).total for fitted in (whole, partial)]
    return partial if misfits[1] + WHOLE < misfits[0] else whole


def followed(track: Track, fitted: ModesFit, time_s: float, config: TrackConfig) -> Track:
    """Track with a further frame."""
    posed, scale = without_scale(fitted.posed)
    passed = max(time_s - track.time_s, 1e-3)
    velocity = track.velocity + config.smoothing * (between(track.posed, posed) / passed - track.velocity)
    unsure = track.unsure * (1 - config.smoothing)
    noise = track.noise + config.smoothing * (fitted.problem.residual_noise(fitted.surface) - track.noise)
    problem = replace(fitted.problem, config=constants_for(noise, track.clean))
    share_surfaces(fitted.problem, problem)
    return replace(
        track,
        problem=problem,
        unit=track.unit * scale,
        posed=posed,
        time_s=time_s,
        velocity=velocity,
        unsure=unsure,
        noise=noise,
        area=max(track.area, seen_area(problem.evidence)),
    )


def seen_area(evidence: Evidence) -> float:
    """Area of the surface that was seen, across the lines of sight: that of a pixel for each point, scene units."""
    return float(((evidence.pitch * evidence.ranges) ** 2).sum())


def between(first: Posed, second: Posed) -> Float[np.ndarray, " p"]:
    """Step of the parameters from one state to another: ``first.moved(step)`` is ``second``."""
    turn = Rotation.from_matrix(second.rotation @ first.rotation.T).as_rotvec()
    scale = [second.log_scale - first.log_scale]
    return np.concatenate([turn, second.translation - first.translation, scale, second.z - first.z])


@dataclass(frozen=True, eq=False)
class Expectation:
    """Expectation of where material points are: a Gaussian of the parameters around a state.

    Attributes:
        state: the expected one.
        precision: of the step from it.
    """

    state: Posed
    precision: Float[np.ndarray, "p p"]

    @classmethod
    def of(cls, track: Track, state: Posed, passed_s: float, config: TrackConfig) -> "Expectation":
        """Expectation after a time: each point is where ``state`` has it, up to its speeds times that."""
        speed = config.speed + max(config.gain * max(track.speed - config.dead, 0.0), track.unsure)
        # noisy frames weigh less, and a moving object must not lag behind for that
        coarser = track.problem.config.cloud_sigma / track.clean.cloud_sigma
        sigma = coarser * (speed * passed_s + config.least)
        return cls(state, track.squared * (config.motion_weight / sigma**2))

    def add_to(self, normal: NormalEquations, posed: Posed) -> NormalEquations:
        """Sum with the squared distance from the expectation."""
        gradient = self.precision @ between(self.state, posed)
        return NormalEquations(normal.matrix + self.precision, normal.gradient + gradient)


def descend(problem: Problem, start: Posed, expectation: Expectation, config: TrackConfig) -> Posed:
    """State that explains cloud, silhouette, prior and expectation, from nearby."""
    constants, half = problem.config, problem.model.half
    prior = Prior.whole(problem.model)
    posed, steps = start, config.steps + config.exact_steps
    for step in range(steps):
        sigma = max(config.first_sigma * half * config.cooling**step, constants.cloud_sigma)
        normal = expectation.add_to(problem.known(posed, prior, 0.0), posed)
        normal = problem.seen(normal, posed, sigma, 0.0, exact=step >= config.steps)
        posed = posed.moved(normal.step(constants.damping))
    return posed
