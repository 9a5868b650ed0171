"""The problem of explaining one frame by one object: all terms of the fit, and the misfit of a state."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import isotonic_regression
from scipy.stats import median_abs_deviation, norm

from mereo.fitting.config import FitConfig
from mereo.fitting.problem.evidence import (
    MORE_SAMPLES,
    OBSERVED_SAMPLES,
    Directions,
    Observed,
    ObservedPoints,
)
from mereo.fitting.problem.gauss_newton import (
    POSE,
    NormalEquations,
    Posed,
    Rows,
    amplitudes,
    geman_mcclure,
    rigid_motion,
)
from mereo.fitting.problem.residuals import (
    ROBUST,
    Met,
    PairTerm,
    PlacesTerm,
    PosedSamples,
    Prior,
    SampledSurface,
    Surface,
    add_silhouette,
    cloud_rows,
    robust_square,
    silhouette_losses,
)
from mereo.geometry.transforms import Values
from mereo.scenes.statistical_model import SILHOUETTE_VERTICES, StatisticalModel

COARSE = 3
"""How many times fewer observed samples a choice among many states needs."""

PAIR_WEIGHT, NETWORK_WEIGHT = 100.0, 10.0
"""How many independent points the distances that the states keep are worth, and what a network says."""

KNOWN_SCALE_STD, OPEN_SCALE_STD = 1e-6, 0.1
"""``Problem.scale_std`` of a frame whose unit is known, and of one whose unit is not."""


@dataclass(frozen=True)
class Misfit:
    """Misfit: how badly a state explains a frame, as squared standard deviations.

    Attributes:
        cloud: of one observed sample on average.
        total: of cloud, network, silhouette, prior and kept distances, as much as they are worth.
    """

    cloud: float
    total: float


@dataclass(frozen=True, eq=False)
class GivenPose:
    """Pose of the object that is known up to an error, as of one that is held.

    Attributes:
        posed: its rest pose in the camera frame, scene units.
        std: root mean square error of a material point, scene units.
    """

    posed: Posed
    std: float

    def add_to(self, normal: NormalEquations, model: StatisticalModel, posed: Posed) -> NormalEquations:
        """Sum with the squared distance of the rest pose, turned and shifted as a state is, from the given one."""
        rest = model.rest_points[model.sparse]
        place = posed.place(rest)
        jacobian = np.zeros((3 * len(rest), POSE + len(posed.z)))
        jacobian[:, :POSE] = rigid_motion(place - posed.translation).reshape(-1, POSE)
        weight = np.full(3 * len(rest), 1.0 / (len(rest) * self.std**2))
        return normal.add(jacobian, (place - self.posed.place(rest)).ravel(), weight)


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything a fit of one frame works on; scene units, camera frame.

    Attributes:
        scale_std: standard deviation of the scale's logarithm.
        config: constants, as a clean frame has them.
        noise: standard deviation of the observed points from the surface (``with_noise``).
        given: pose that is known; None where the frame alone says it.
        network: what a network says; it tells states that look alike apart, and no fit descends by it.
    """

    model: StatisticalModel
    evidence: Observed
    scale_std: float
    config: FitConfig
    noise: float = 0.0
    given: GivenPose | None = None
    network: PlacesTerm | None = None

    @property
    def is_scale_open(self) -> bool:
        """Whether the length of a scene unit is not known."""
        return self.scale_std > KNOWN_SCALE_STD

    @cached_property
    def pairs(self) -> PairTerm:
        """Term of the distances that the states keep."""
        return PairTerm.of(self.model)

    @property
    def first_sigma(self) -> float:
        """The cloud's first standard deviation in a fit from far away, scene units."""
        return self.config.start_sigma * self.model.half

    def known(self, posed: Posed, prior: Prior, slack: float) -> NormalEquations:
        """Normal equations of what is known without the frame: prior, scale, pose, kept distances up to ``slack``."""
        normal = NormalEquations.prior(posed.z, prior.center, prior.precision, posed.log_scale, self.scale_std)
        if self.given is not None:
            normal = self.given.add_to(normal, self.model, posed)
        return self.pairs.add_to(normal, posed.z, PAIR_WEIGHT, slack)

    def changed(self, **changes: Any) -> "Problem":
        """A problem of the same model, with what this one has prepared of the model's surface."""
        other = replace(self, **changes)
        vars(other).update({name: vars(self)[name] for name in ("pairs", "samples") if name in vars(self)})
        return other

    # what depends on the noise

    def with_noise(self, noise: float) -> "Problem":
        """The problem of a frame of this noise, in scene units, or of the largest that its camera may have."""
        return self.changed(noise=min(noise, self.evidence.largest_noise))

    @property
    def is_noisy(self) -> bool:
        """Whether a fit would bend to the noise under a clean frame's constants."""
        return self.noise > CLEAN

    @property
    def shares_noise(self) -> bool:
        """Whether a camera's noise is in the frame, be it that a fit has bent to it."""
        return max(self.noise, self.evidence.expected_noise) > CLEAN

    @property
    def cloud_sigma(self) -> float:
        """Last standard deviation of the cloud, scene units."""
        return max(SIGMAS * self.noise * self.is_noisy, self.config.cloud_sigma)

    @property
    def tolerance(self) -> float:
        """Distance, in scene units, up to which an observed point lies on a surface."""
        return max(NOISES * self.noise * self.is_noisy, self.config.tolerance)

    @property
    def accepted(self) -> float:
        """Share of the observed points that must lie there for a fit to be believed."""
        return min(self.config.accepted, ACCEPTED) if self.shares_noise else self.config.accepted

    def left_noise(self, surface: Surface) -> float:
        """Noise of the frame as a fit leaves it over: of that neighbours may share as much as around the object."""
        offset = self.offsets(surface)
        alone = noise_of(offset, self.evidence.around)
        return min(max(noise_of(offset), alone), float(np.hypot(alone, self.evidence.expected_noise)))

    def worth(self, surface: Surface) -> "Problem":
        """The problem with as many independent points as what a fit leaves over shows that the cloud is worth.

        What neighbours are known to share is an unknown from then on, and the noise is what is left without it.
        """
        problem = self.changed(evidence=self.evidence.with_errors).cleared(surface)
        problem = problem.with_noise(problem.left_noise(surface)).cleared(surface)
        offset = problem.offsets(surface)
        alone = (problem.cloud_sigma / SIGMAS) ** 2  # variance of a point of which neighbours share nothing
        share = min(alone / shared_variance(offset, problem.evidence, POSE + problem.model.count), 1.0)
        share /= max(problem.cloud_misfit(surface) / USUAL, 1.0)  # of slanted surfaces and edges is more left over
        weight = SIGMAS**2 * share * len(offset)
        outside = FitConfig.silhouette_weight * min(weight / FitConfig.cloud_weight, 1.0)
        config = replace(problem.config, cloud_weight=weight, silhouette_weight=outside, accepted=self.accepted)
        return problem.changed(config=config, evidence=problem.evidence.seen_again)

    def cleared(self, surface: Surface) -> "Problem":
        """The problem without the errors that neighbours most likely share, were this the surface.

        They are estimated from the points as measured, so that a state has one misfit whatever was tried before it:
        with wide robust weights first.
        """
        errors, sigma = self.evidence.sample_errors, self.cloud_sigma
        if len(errors.amplitudes) == 0:
            return self
        problem = self.changed(evidence=self.evidence.without(np.zeros(len(errors.amplitudes))))
        wide = np.hypot(sigma, SIGMAS * self.evidence.expected_noise)
        each = len(errors.measured) * sigma**2
        for narrower in np.geomspace(wide, sigma, CLEARINGS):
            _, face, place = problem.met(surface)
            normal = surface.normals[face]
            left, measured = (
                np.einsum("pi,pi->p", normal, points - place)
                for points in (problem.evidence.observed_samples, errors.measured)
            )
            weight = geman_mcclure(left, ROBUST * narrower) * self.config.cloud_weight / each
            likeliest = amplitudes(measured, weight, errors.along(normal))
            problem = problem.changed(evidence=problem.evidence.without(likeliest))
        return problem

    def quieted(self, noise: float) -> "Problem":
        """The problem with no more than a noise, and by every point where that is still a camera's."""
        quiet = self.with_noise(min(self.noise, noise))
        return quiet.by_every_point if quiet.is_noisy else quiet

    @property
    def by_every_point(self) -> "Problem":
        """The problem with as many observed samples as a noisy frame has; the same where it has them already."""
        evidence = self.evidence
        if len(evidence.observed_samples) >= min(len(evidence.points), MORE_SAMPLES):
            return self
        return self.changed(evidence=evidence.with_more_samples)

    def explained(self, surface: Surface) -> bool:
        """Whether a surface explains the cloud: whether it leaves no more over than noise does.

        As many points as are to be accepted must lie on the surface; few samples say whether they do.
        """
        return bool(
            (self.nearest(surface)[0] <= self.tolerance).mean() >= self.config.accepted
            and self.excess(surface).mean() < EXCESS
        )

    def excess(self, surface: Surface) -> Values:
        """Misfit of each point beyond that of noise, which in a clean frame ends at the tolerance."""
        offset = self.offsets(surface, self.far)
        most = np.inf if self.shares_noise else self.tolerance
        noise = np.hypot(np.clip(unshared(offset, self.evidence.around), -most, most), self.evidence.expected_noise)
        return robust_square(offset, self.cloud_sigma) - robust_square(noise, self.cloud_sigma)

    @property
    def far(self) -> float:
        """Distance, in scene units, beyond which a point along a line of sight is of another surface than was seen."""
        return ROBUST * self.cloud_sigma

    def met(self, surface: Surface) -> Met:
        """What of a surface each observed sample is compared with: ``Surface.compared``."""
        return surface.compared(self.evidence.observed_samples, self.far, self.alike)

    def nearest(self, surface: Surface) -> Met:
        """The same, without lines of sight."""
        return surface.compared(self.evidence.observed_samples, None, self.alike)

    def offsets(self, surface: Surface, far: float | None = None) -> Values:
        """``Surface.offsets`` of all observed points."""
        return surface.offsets(self.evidence.points, far, self.evidence.all_alike(self.normal_length))

    @property
    def normal_length(self) -> float:
        """``FitConfig.normal_length`` in scene units."""
        return self.config.normal_length * self.model.half

    @property
    def alike(self) -> Directions | None:
        """``alike`` of the evidence."""
        return self.evidence.alike(self.normal_length)

    def surface(self, posed: Posed) -> Surface:
        """Surface of a state, of the faces that can be compared."""
        return Surface.of(self.model, posed, self.evidence.shows)

    def cloud_misfit(self, surface: Surface) -> float:
        """Misfit of the cloud, in squared standard deviations of an observed sample."""
        return float(robust_square(self.met(surface)[0], self.cloud_sigma).mean())

    @cached_property
    def samples(self) -> SampledSurface:
        """Samples of the model's surface."""
        return SampledSurface.of(self.model, self.config.samples)

    @cached_property
    def coarse(self) -> "Problem":
        """Problem with fewer points, for the choice among many states."""
        few = self.config.silhouette_vertices // COARSE
        config = replace(self.config, samples=1000, silhouette_vertices=few, exact_steps=0)
        some = slice(None, None, COARSE)
        coarse = replace(self, evidence=self.evidence.few(OBSERVED_SAMPLES // COARSE), config=config)
        vars(coarse)["pairs"] = PairTerm(*(part[some] for part in vars(self.pairs).values()))
        return coarse

    def screen(self, posed: Posed, sigma: float) -> Misfit:
        """Misfit by the samples alone: good enough to choose among states, and ten times as fast."""
        samples = self.samples.posed(posed)
        position, normal, _ = samples.planes(self.evidence.observed_samples, self.alike)
        offset = self.evidence.observed_samples - position
        across = np.einsum("pi,pi->p", offset, normal)
        tangential = np.sqrt(np.maximum((offset**2).sum(axis=1) - across**2, 0.0))
        # an observed sample up to one spacing from a sample is still on its plane
        distance = np.hypot(across, np.maximum(tangential - self.samples.spacing, 0.0))
        few = samples.few(self.config.silhouette_vertices).position
        return self.total(
            float(robust_square(distance, sigma).mean()),
            float(silhouette_losses(few, self.evidence, sigma).mean()),
            posed.z,
        )

    def seen(
        self,
        normal: NormalEquations,
        posed: Posed,
        sigma: float,
        exact: bool,
        surface: Surface | None = None,
    ) -> NormalEquations:
        """Sum with cloud and silhouette; ``exact`` uses the faces and not the samples.

        The state's ``surface`` may be there already.
        """
        samples = self.samples.posed(posed)
        observed = self.evidence.observed_samples
        directions = self.directions
        if exact:
            planes = (surface or self.surface(posed)).planes(observed, self.far, self.alike)
        else:
            planes = samples.planes(observed, directions)
        weight, errors = self.config.cloud_weight, self.evidence.sample_errors
        normal = normal.add(*cloud_rows(posed, observed, planes, sigma, weight, errors, directions))
        return self.add_silhouette(normal, posed, samples, sigma)

    def add_silhouette(
        self, normal: NormalEquations, posed: Posed, samples: PosedSamples, sigma: float
    ) -> NormalEquations:
        """Sum with the samples of a state's surface that the frame rules out."""
        few = samples.few(self.config.silhouette_vertices)
        points = few.position.astype(np.float64)
        weight = self.config.silhouette_weight
        return add_silhouette(normal, posed, points, few.tangent, self.evidence, sigma, weight)

    def cloud_rows(self, posed: Posed) -> Rows:
        """Residuals of the observed samples from the faces, as the last steps of a fit have them."""
        observed, weight = self.evidence.observed_samples, self.config.cloud_weight
        planes = self.surface(posed).planes(observed, self.far, self.alike)
        errors = self.evidence.sample_errors
        return cloud_rows(posed, observed, planes, self.cloud_sigma, weight, errors, self.directions)

    @property
    def directions(self) -> Directions | None:
        """Normals of the observed samples; None where places alone are compared."""
        return self.evidence.directions(self.normal_length, self.config.by_normals)

    def misfit(self, posed: Posed, surface: Surface | None = None) -> Misfit:
        """Misfit of a state, whose ``surface`` may be there already."""
        surface = surface or self.surface(posed)
        shown = self.total(self.cloud_misfit(surface), self._silhouette_square(surface), posed.z)
        return replace(shown, total=shown.total + self.network_misfit(surface))

    def network_misfit(self, surface: Surface) -> float:
        """Misfit of what a network says; 0 without one."""
        if self.network is None:
            return 0.0
        return NETWORK_WEIGHT * self.network.energy(surface.material, self.first_sigma)

    def silhouette_misfit(self, surface: Surface) -> float:
        """Misfit of all vertices that the frame rules out."""
        return self._silhouette_square(surface) * self.config.silhouette_weight * SILHOUETTE_VERTICES

    def _silhouette_square(self, surface: Surface) -> float:
        """Mean square of how far a vertex is ruled out, in standard deviations."""
        vertices = surface.material[self.model.silhouette_vertices]
        return float(silhouette_losses(vertices, self.evidence, self.cloud_sigma).mean())

    def ruled_out(self, surface: Surface) -> float:
        """Share of a surface's vertices that the frame rules out by more than a scene unit beyond the tolerance."""
        amount = self.evidence.violations(surface.material[self.model.silhouette_vertices], self.tolerance)[1]
        return float((amount > 1.0).mean())

    def total(self, cloud: float, silhouette: float, z: Float[np.ndarray, " k"]) -> Misfit:
        """Misfit from the mean squares of one observed sample and one silhouette vertex."""
        silhouette = silhouette * self.config.silhouette_weight * SILHOUETTE_VERTICES
        prior = float(z @ z)
        pairs = PAIR_WEIGHT * self.pairs.energy(z)
        shared = self.evidence.shared_errors.square
        return Misfit(cloud, self.config.cloud_weight * cloud + silhouette + prior + pairs + shared)


# --- noise of a frame -------------------------------------------------------------------------------------------------

# Differences between neighbouring pixels only bound a camera's noise, as edges and curvature look like noise too; a
# fitted model takes these away. What it leaves over is noise where every pixel differs; where neighbours share it, or
# it is more than the calmest part of the cloud has, the model is wrong.

CLEAN = 0.15
"""Noise, in scene units, up to which the constants are as they are; more is a camera's. Clean frames have 0.05 to 0.1,
and a clean frame's fit that is not quite right leaves less over, too."""

NORMAL = 4.3
"""The 95 % quantile of what a fit leaves over, in its median, up to which it looks like normal numbers, with 2.9."""

SIGMAS = 1.5
"""Standard deviation that the cloud gets, in noises: mixed pixels are far beyond ``residuals.ROBUST`` of these."""

NOISES = 3.0
"""Distance, in noises, up to which a point of a noisy frame lies on the surface where a fit is to be believed."""

USUAL = float(norm.expect(lambda offset: robust_square(np.atleast_1d(offset), SIGMAS).item()))
"""Misfit of a cloud of which normal numbers are left over."""

CLEARINGS = 6
"""Steps in which the errors that neighbours share are taken out."""

EXCESS = 0.015
"""Misfit of a cloud beyond that of noise up to which nothing more is to be explained: that of true states of 143 clean
frames is up to .015, nine in ten of noisy ones' up to .025 (docs/experiments/106.md)."""

ACCEPTED = 0.85
"""Share of a camera's points that a fit must explain to be believed: of 209 right fits 95 % explain .94, and none that
was believed less than .88; wrong ones of thin objects .76 to .81 (docs/experiments/085.md)."""


def shared_variance(offset: Values, observed: ObservedPoints, freedom: int) -> float:
    """Variance of a point, were all independent, that leaves a fit as unsure as what it leaves over.

    Differences between neighbouring patches of the picture, from single points to halves of the cloud, all have the
    variance of a point where noise is white; what neighbours share adds to that of larger patches. A fit with so much
    ``freedom``, its number of parameters, bends to what as many patches share: theirs is no less than that of smaller
    ones, to which it cannot, and as many times what it leaves of it as the whole noise is that of points alone.
    """
    most = 2 * ROBUST * noise_of(offset)
    offset = np.where(np.abs(offset) > ROBUST * SIGMAS * observed.largest_noise, 0.0, np.clip(offset, -most, most))
    means = offset[observed.nested]
    variance = list[float]()
    while len(means) > 1:
        first, second = means[::2], means[1::2]
        variance.append(noise_of(first - second) ** 2 / 2)
        means = (first + second) / np.sqrt(2)
    patches = 0.5 ** np.arange(len(variance)) * len(observed.nested) / 2
    rising = np.maximum(isotonic_regression(variance, weights=patches).x, CLEAN**2)
    whole, left = np.average(rising, weights=patches), np.average(rising, weights=patches * (patches <= freedom))
    return float(left * whole / rising[0])


def unshared(offset: Values, around: Int[np.ndarray, "n k"]) -> Values:
    """What each point's offset does not share with those around it, as large as its noise alone would be."""
    # the median of k neighbours is itself off by pi / 2k of their variance
    return (offset - np.median(offset[around], axis=1)) / np.sqrt(1.0 + np.pi / (2 * around.shape[1]))


def noise_of(offset: Values, around: Int[np.ndarray, "n k"] | None = None) -> float:
    """Standard deviation of offsets, robust: of all that a fit leaves over, or of what neighbours do not share.

    Args:
        offset: signed distance of each observed point from a fitted surface.
        around: indices of each point's neighbours.
    """
    left = offset if around is None else unshared(offset, around)
    return float(median_abs_deviation(left, center=lambda _, axis: 0.0, scale="normal"))


def is_normal(offset: Values) -> bool:
    """Whether offsets are spread as normal numbers are; those of a wrong fit are small in most places, or large."""
    return float(np.quantile(np.abs(offset), 0.95)) <= NORMAL * float(np.median(np.abs(offset)))
