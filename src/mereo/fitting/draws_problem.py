"""States of a scene as explanations of a frame: playing them, judging them, and their linear neighbourhood.

Around a state the material points are linear in the draws, so its neighbourhood is a linear model like that of the
modes, fitted by the same code.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.config import MANY_DRAWS, DrawsConfig
from mereo.fitting.correspondences import Correspondences
from mereo.fitting.gauss_newton import Posed
from mereo.fitting.modes_fit import fit_cloud
from mereo.fitting.playback import Drawn, DrawnStates, material_moved
from mereo.fitting.priors import Prior
from mereo.fitting.problem import Problem
from mereo.fitting.residuals import NetworkTerm
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel

DIFFERENCE = 0.02
"""Step of finite differences, in standard deviations of a draw."""

HELD = 1e6
"""Precision of draws that move nothing here: they stay."""


@dataclass(frozen=True, eq=False)
class DrawsProblem:
    """A frame to be explained by the states of a scene.

    Attributes:
        base: the same frame, explained by modes.
        states: random states of the scene.
        found: correspondences, scene units.
        weights: how their rest positions follow the material points.
    """

    base: Problem
    states: DrawnStates
    found: Correspondences
    weights: PointWeights
    config: DrawsConfig

    @property
    def model(self) -> StatisticalModel:
        """Statistical model of the object."""
        return self.base.model

    @property
    def scene(self) -> Scene:
        """Scene whose draws are played."""
        return self.states.scene

    @classmethod
    def of(
        cls, base: Problem, states: DrawnStates, found: Correspondences, config: DrawsConfig | None = None
    ) -> "DrawsProblem":
        """Problem with the constants for as many draws as the scene has, where none are given."""
        model = base.model
        if config is None:
            config = DrawsConfig() if states.z.shape[1] <= DrawsConfig().few else MANY_DRAWS
        return cls(base, states, found, model.weights(found.rest, found.labels), config)

    def around(self, mean: Float[np.ndarray, "m 3"], modes: Float32[np.ndarray, "m 3 d"]) -> Problem:
        """The problem in the linear neighbourhood of a state."""
        model = self.model.around(mean, modes)
        network = NetworkTerm(self.found.points, self.weights(mean), self.weights(modes), self.found.confidence)
        return Problem(model, network, self.base.evidence, self.base.scale_std, self.base.config)

    def rigid(self, material: Float[np.ndarray, "m 3"]) -> Problem:
        """Problem of one state's pose alone."""
        return self.around(material, np.zeros((len(material), 3, 0), dtype=np.float32))


@dataclass(frozen=True, eq=False)
class DrawsFit:
    """A played state, posed: draws, rigid pose (its ``z`` is empty), material points unposed, misfit with its prior."""

    drawn: Drawn
    z: Float[np.ndarray, " d"]
    posed: Posed
    material: Float[np.ndarray, "m 3"]
    misfit: float

    def placed(self) -> Float[np.ndarray, "m 3"]:
        """Material points in the camera frame."""
        return self.posed.place(self.material)


def played(
    problem: DrawsProblem, drawn: Drawn, z: Float[np.ndarray, " d"], posed: Posed, wide: bool = False
) -> DrawsFit | None:
    """The state of these draws and how badly it explains the frame; None where the scene refuses it.

    ``wide`` takes the cloud's first sigma, which tells how far off a state is that is not yet right.
    """
    deformations = drawn.deformations(problem.scene, z)
    if deformations is None:
        return None
    material = material_moved(problem.scene, problem.model, deformations)
    rigid = replace(posed, z=np.empty(0))
    sigma = problem.config.start_sigma * problem.model.half if wide else None
    misfit = problem.rigid(material).misfit(rigid, sigma).total + float(z @ z)
    return DrawsFit(drawn, z, rigid, material, misfit)


def draws_prior(fit: DrawsFit, motion: Float32[np.ndarray, "m 3 d"], trust: float) -> Prior:
    """Prior of a change of the draws: N(0, 1) of the draws themselves; those that move nothing stay."""
    moving = np.abs(motion).max(axis=(0, 1)) > 1e-9
    precision = 1.0 + 1.0 / trust**2
    return Prior(np.where(moving, -fit.z / precision, 0.0), np.diag(np.where(moving, precision, HELD)))


def between(one: Posed, other: Posed, share: float) -> Posed:
    """A share of the way, for a share of a step."""
    turn = Rotation.from_matrix(other.rotation @ one.rotation.T).as_rotvec()
    return Posed(
        Rotation.from_rotvec(share * turn).as_matrix() @ one.rotation,
        one.translation + share * (other.translation - one.translation),
        one.z,
        one.log_scale + share * (other.log_scale - one.log_scale),
    )


def linear_step(
    problem: DrawsProblem, fit: DrawsFit, trust: float, sigma: float
) -> tuple[Float[np.ndarray, " d"], Posed]:
    """Change of the draws, and the pose, that explain the frame best in the linear neighbourhood."""
    modes = jacobian(problem, fit)
    linear = problem.around(fit.material, modes)
    prior = draws_prior(fit, modes, trust)
    start = replace(fit.posed, z=np.zeros(len(fit.z)))
    found = fit_cloud(linear, start, prior, sigma, problem.config.steps, 0.0)
    return found.z, found


def jacobian(problem: DrawsProblem, fit: DrawsFit) -> Float32[np.ndarray, "m 3 d"]:
    """Motion of all material points for a standard deviation of each draw: at few points, which the others follow."""
    few = problem.states.played
    change = np.zeros((len(few.index), 3, len(fit.z)), dtype=np.float32)
    here = fit.material[few.index]
    for number in np.flatnonzero(fit.drawn.smooth):
        step = DIFFERENCE * (-1.0 if fit.z[number] > 0 else 1.0)
        z = fit.z.copy()
        z[number] += step
        moved = fit.drawn.deformations(problem.scene, z)
        if moved is not None:
            change[:, :, number] = (few.moved(moved) - here) / step
    spread: np.ndarray = few.spread @ change.reshape(len(change), -1)
    return spread.reshape(-1, *change.shape[1:])
