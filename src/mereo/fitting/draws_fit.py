"""A scene's own draws that explain a frame: Gauss and Newton's method on states that the scene really has.

Around a state the material points are linear in the draws, so its neighbourhood is a linear model like that of the
modes, fitted by the same code; then the scene is played with the draws that were found, and so on.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.correspondences import Correspondences
from mereo.fitting.gauss_newton import Posed
from mereo.fitting.hypotheses import ALIKE, robust_poses
from mereo.fitting.modes_fit import fit_cloud
from mereo.fitting.playback import Drawn, DrawnStates, anchors_moved, material_moved
from mereo.fitting.priors import Prior
from mereo.fitting.problem import Problem
from mereo.fitting.residuals import NetworkTerm
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel

MOST_DRAWS = 120
"""Scenes with more free numbers are left to the modes."""

DIFFERENCE = 0.02
"""Step of finite differences, in standard deviations of a draw."""

HELD = 1e6
"""Precision of draws that move nothing here: they stay."""


@dataclass(frozen=True)
class DrawsConfig:
    """Constants of the fit of draws.

    Attributes:
        starts: random states that are tried, half of them like the fit of the modes, half like the network's answer.
        kept: how many of them are followed to the end.
        first_rounds, last_rounds: linearizations of all and of those that are kept.
        steps: of the linear fit in each.
        trust: standard deviation of a draw's change in one linearization.
        start_sigma: the cloud's first sigma, as a share of half the rest box's longest side.
        states, seed: how many random states starts are chosen from.
    """

    starts: int = 6
    kept: int = 2
    first_rounds: int = 2
    last_rounds: int = 5
    steps: int = 4
    trust: float = 0.7
    start_sigma: float = 0.03
    states: int = 600
    seed: int = 400_000


@dataclass(frozen=True, eq=False)
class DrawsProblem:
    """A frame to be explained by the states of a scene.

    Attributes:
        base: the same frame, explained by modes.
        states: random states of the scene.
        found: correspondences, scene units.
        weights: how their rest positions follow the material points.
        spread: how all material points follow the anchors.
    """

    base: Problem
    states: DrawnStates
    found: Correspondences
    weights: PointWeights
    spread: PointWeights
    config: DrawsConfig

    @property
    def model(self) -> StatisticalModel:
        return self.base.model

    @property
    def scene(self) -> Scene:
        return self.states.scene

    def around(self, mean: Float[np.ndarray, "m 3"], modes: Float32[np.ndarray, "m 3 d"]) -> Problem:
        """The problem in the linear neighbourhood of a state."""
        model = self.model.around(mean, modes)
        network = NetworkTerm(self.found.points, self.weights(mean), self.weights(modes), self.found.confidence)
        return Problem(model, network, self.base.evidence, self.base.scale_std, self.base.config)


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


def fit_draws(problem: DrawsProblem, modes: Posed) -> DrawsFit | None:
    """The best of several starts; None where the scene has too many draws or plays none of them back."""
    config = problem.config
    starts = [fit for fit in (started(problem, *start) for start in choose_starts(problem, modes)) if fit is not None]
    starts = [fit for fit in starts if int(fit.drawn.smooth.sum()) <= MOST_DRAWS]
    for rounds, keep in ((config.first_rounds, config.starts), (config.last_rounds, config.kept)):
        starts = sorted(starts, key=lambda fit: fit.misfit)[:keep]
        starts = [descend(problem, fit, rounds) for fit in starts]
    return min(starts, key=lambda fit: fit.misfit, default=None)


def choose_starts(problem: DrawsProblem, modes: Posed) -> list[tuple[int, Posed]]:
    """Seeds and poses: states like the fit of the modes, and states like the network's answer."""
    model, library = problem.model, problem.states.material
    each = problem.config.starts // 2
    sigma = ALIKE * model.half
    goal = modes.place(model.material(modes.z))[model.sparse].astype(np.float32)
    like_modes = robust_poses(library[:, model.sparse], goal, np.ones(len(goal), dtype=np.float32), sigma)
    few = slice(0, None, max(1, len(problem.found.labels) // 64))
    weights = PointWeights(problem.weights.index[few], problem.weights.weight[few])
    states = np.stack([weights(material) for material in library]).astype(np.float32)
    target, weight = problem.found.points[few], problem.found.confidence[few]
    like_network = robust_poses(
        states, target.astype(np.float32), weight.astype(np.float32), problem.base.network_sigma
    )
    result = []
    for cost, rotation, translation in (like_modes, like_network):
        best = np.argsort(cost)[:each]
        result += [(problem.states.seeds[i], Posed(rotation[i], translation[i], np.empty(0))) for i in best]
    return list({seed: (seed, pose) for seed, pose in result}.values())


def started(problem: DrawsProblem, seed: int, posed: Posed) -> DrawsFit | None:
    """A random state in its pose; None where it cannot be played back."""
    drawn = Drawn.of(problem.scene, seed)
    return played(problem, drawn, drawn.z, posed)


def played(problem: DrawsProblem, drawn: Drawn, z: Float[np.ndarray, " d"], posed: Posed) -> DrawsFit | None:
    """The state of these draws and how badly it explains the frame; None where the scene refuses it."""
    deformations = drawn.deformations(problem.scene, z)
    if deformations is None:
        return None
    material = material_moved(problem.scene, problem.model, deformations)
    fixed = problem.around(material, np.zeros((len(material), 3, 0), dtype=np.float32))
    rigid = replace(posed, z=np.empty(0))
    misfit = fixed.misfit(rigid).total + float(z @ z)
    return DrawsFit(drawn, z, rigid, material, misfit)


def descend(problem: DrawsProblem, fit: DrawsFit, rounds: int) -> DrawsFit:
    """Linearize, fit, play; a step that does not lower the misfit is halved, then given up."""
    trust, sigma = problem.config.trust, problem.config.start_sigma
    for _ in range(rounds):
        step, posed = linear_step(problem, fit, trust, sigma)
        for share in (1.0, 0.5, 0.25):
            # the pose belongs to the whole step; a part of it is posed by its own next linearization
            tried = played(problem, fit.drawn, fit.z + share * step, posed if share == 1.0 else between(fit.posed, posed))
            if tried is not None and tried.misfit < fit.misfit:
                fit = tried
                break
        else:
            trust *= 0.3
        sigma *= 0.6
    return fit


def between(one: Posed, other: Posed) -> Posed:
    """Half of the way, for half of a step."""
    turn = Rotation.from_matrix(other.rotation @ one.rotation.T)
    half = Rotation.from_rotvec(turn.as_rotvec() / 2).as_matrix()
    return Posed(
        half @ one.rotation,
        (one.translation + other.translation) / 2,
        one.z,
        (one.log_scale + other.log_scale) / 2,
    )


def linear_step(
    problem: DrawsProblem, fit: DrawsFit, trust: float, sigma: float
) -> tuple[Float[np.ndarray, " d"], Posed]:
    """Change of the draws, and the pose, that explain the frame best in the linear neighbourhood."""
    modes = jacobian(problem, fit)
    moving = np.abs(modes).max(axis=(0, 1)) > 1e-9
    precision = 1.0 + 1.0 / trust**2
    center = np.where(moving, -fit.z / precision, 0.0)
    prior = Prior(center, np.diag(np.where(moving, precision, HELD)))
    linear = problem.around(fit.material, modes)
    start = replace(fit.posed, z=np.zeros(len(fit.z)))
    found = fit_cloud(linear, start, prior, sigma, problem.config.steps, 0.0)
    return found.z, found


def jacobian(problem: DrawsProblem, fit: DrawsFit) -> Float32[np.ndarray, "m 3 d"]:
    """Motion of all material points for a standard deviation of each draw: at the anchors, which the others follow."""
    model, drawn = problem.model, fit.drawn
    result = np.zeros((len(model.rest_points), 3, len(fit.z)), dtype=np.float32)
    order = np.concatenate(model.anchors)
    for number in np.flatnonzero(drawn.smooth):
        step = DIFFERENCE * (-1.0 if fit.z[number] > 0 else 1.0)
        z = fit.z.copy()
        z[number] += step
        moved = drawn.deformations(problem.scene, z)
        if moved is None:
            continue
        change = (anchors_moved(model, moved) - fit.material[order]) / step
        everywhere = np.zeros((len(model.rest_points), 3))
        everywhere[order] = change
        result[:, :, number] = problem.spread(everywhere)
    return result
