"""Pose and coefficients of the statistical model that explain a frame: the network's answer first, then the cloud."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mereo.fitting.correspondences import Correspondences
from mereo.fitting.evidence import Evidence
from mereo.fitting.gauss_newton import NormalEquations, Posed
from mereo.fitting.residuals import NetworkTerm, Surface, add_witnesses, witness_vertices
from mereo.geometry.procrustes import robust_rigid
from mereo.scenes.statistical_model import StatisticalModel


@dataclass(frozen=True)
class FitConfig:
    """Constants of the fit; lengths as shares of half the rest box's longest side where not said otherwise.

    Attributes:
        start_sigma: standard deviation of the network's correspondences.
        first_steps: steps on the correspondences alone, their sigma falling from ``first_widening`` times to once.
        first_worth: how many independent points the correspondences are worth in these.
        last_steps: steps on cloud, witnesses and correspondences; the cloud's sigma falls by ``cooling`` in each.
        cloud_sigma: last standard deviation of the cloud, in scene units.
        cloud_worth: how many independent points the cloud is worth.
        network_worth: the same of the correspondences, at the first and at the last of these steps.
        damping: of every step, relative to the diagonal.
        scale_std: how far the scale is unsure, where it is free.
    """

    start_sigma: float = 0.06
    first_steps: int = 8
    first_widening: float = 2.5
    first_worth: float = 500.0
    last_steps: int = 15
    cooling: float = 0.75
    cloud_sigma: float = 0.2
    cloud_worth: float = 1500.0
    network_worth: tuple[float, float] = (100.0, 30.0)
    damping: float = 1e-3
    scale_std: float = 1e-6


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian of the coefficients."""

    center: Float[np.ndarray, " k"]
    precision: Float[np.ndarray, "k k"]

    @classmethod
    def whole(cls, count: int) -> "Prior":
        """Of all states."""
        return cls(np.zeros(count), np.eye(count))


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything a fit of one frame works on.

    Attributes:
        model: the statistical model.
        network: correspondences.
        evidence: the frame.
        witnesses: vertices that are compared with silhouette and free space.
        config: constants.
    """

    model: StatisticalModel
    network: NetworkTerm
    evidence: Evidence
    witnesses: Int[np.ndarray, " w"]
    config: FitConfig

    @classmethod
    def of(
        cls, model: StatisticalModel, found: Correspondences, evidence: Evidence, config: FitConfig
    ) -> "Problem":
        return cls(model, NetworkTerm.of(model, found), evidence, witness_vertices(model), config)


def start_pose(problem: Problem, z: Float[np.ndarray, " k"]) -> Posed:
    """The robust rigid pose of one state on the correspondences."""
    network = problem.network
    sigma = problem.config.start_sigma * problem.model.half
    unposed = network.mean + network.modes @ z.astype(np.float32)
    T = robust_rigid(unposed, network.target, network.confidence, sigma)
    return Posed(T[:3, :3], T[:3, 3], z)


def fit_network(problem: Problem, posed: Posed, prior: Prior) -> Posed:
    """First stage: the correspondences alone, from wide to narrow, robust from a third of the steps on."""
    config, half = problem.config, problem.model.half
    for step in range(config.first_steps):
        share = step / max(1, config.first_steps - 1)
        sigma = config.start_sigma * half * config.first_widening ** (1.0 - share)
        normal = _prior_term(posed, prior, config)
        robust = 3 * step >= config.first_steps
        normal = problem.network.add_to(normal, posed, sigma, config.first_worth, robust)
        posed = posed.moved(normal.step(config.damping))
    return posed


def fit_cloud(problem: Problem, posed: Posed, prior: Prior, start: float | None = None, steps: int | None = None) -> Posed:
    """Second stage: observed points, witnesses and, less and less, the correspondences.

    ``start`` is the cloud's first sigma as a share of half the longest side.
    """
    config, half = problem.config, problem.model.half
    steps = config.last_steps if steps is None else steps
    first = (config.start_sigma if start is None else start) * half
    for step in range(steps):
        share = step / max(1, steps - 1)
        sigma = max(first * config.cooling**step, config.cloud_sigma)
        worth = config.network_worth[0] * (1 - share) + config.network_worth[1] * share
        surface = Surface.of(problem.model, posed)
        normal = _prior_term(posed, prior, config)
        normal = problem.network.add_to(normal, posed, config.start_sigma * half, worth, robust=True)
        normal = normal.add(*surface.cloud_term(posed, problem.evidence.partners, sigma, config.cloud_worth))
        normal = add_witnesses(normal, surface, posed, problem.evidence, problem.witnesses, sigma)
        posed = posed.moved(normal.step(config.damping))
    return posed


def _prior_term(posed: Posed, prior: Prior, config: FitConfig) -> NormalEquations:
    return NormalEquations.prior(posed.z, prior.center, prior.precision, posed.log_scale, config.scale_std)


def fit_modes(problem: Problem) -> Posed:
    """The whole fit from the mean state."""
    prior = Prior.whole(problem.model.count)
    posed = start_pose(problem, np.zeros(problem.model.count))
    return fit_cloud(problem, fit_network(problem, posed, prior), prior)
