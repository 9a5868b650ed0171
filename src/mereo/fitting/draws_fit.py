"""A scene's own draws that explain a frame: Gauss and Newton's method on states that the scene really has.

Around a state the material points are linear in the draws, so its neighbourhood is a linear model like that of the
modes, fitted by the same code; then the scene is played with the draws that were found, and so on.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation
from scipy.sparse import csr_array
from scipy.special import ndtri

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.config import DrawsConfig
from mereo.fitting.correspondences import Correspondences
from mereo.fitting.gauss_newton import Posed
from mereo.fitting.hypotheses import ALIKE, robust_poses
from mereo.fitting.modes_fit import fit_cloud, fit_network
from mereo.fitting.playback import Drawn, DrawnStates, anchors_moved, material_moved
from mereo.fitting.priors import Prior
from mereo.fitting.problem import Problem
from mereo.fitting.residuals import NetworkTerm, robust_square
from mereo.geometry.procrustes import fit_rigid
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel, following

MOST_DRAWS = 120
"""Scenes with more free numbers are left to the modes."""

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
        spread: how all material points follow the anchors, as a sparse matrix.
    """

    base: Problem
    states: DrawnStates
    found: Correspondences
    weights: PointWeights
    spread: csr_array
    config: DrawsConfig

    @property
    def model(self) -> StatisticalModel:
        return self.base.model

    @property
    def scene(self) -> Scene:
        return self.states.scene

    @classmethod
    def of(cls, base: Problem, states: DrawnStates, found: Correspondences, config: DrawsConfig) -> "DrawsProblem":
        model = base.model
        every = following(model.rest_anchors, model.rest_points, model.labels)
        rows = np.repeat(np.arange(len(every.index)), every.index.shape[1])
        entries = (every.weight.ravel().astype(np.float32), (rows, every.index.ravel()))
        spread = csr_array(entries, shape=(len(model.rest_points),) * 2)
        return cls(base, states, found, model.weights(found.rest, found.labels), spread, config)

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
    guess = problem.states.guess(modes.z, problem.model.motion, config.near)
    guessed = played(problem, guess, guess.z, pose_on(problem, guess, modes))
    starts = [approach(problem, fit, modes) for fit in [*starts, *([] if guessed is None else [guessed])]]
    for rounds, keep in ((config.first_rounds, config.starts), (config.last_rounds, config.kept)):
        starts = sorted(starts, key=lambda fit: wide_misfit(problem, fit))[:keep]
        starts = [descend(problem, fit, rounds) for fit in starts]
    best = min(starts, key=lambda fit: fit.misfit, default=None)
    return None if best is None else jump(problem, best)


def pose_on(problem: DrawsProblem, drawn: Drawn, modes: Posed) -> Posed:
    """The rigid pose of a state on the fit of the modes."""
    deformations = drawn.deformations(problem.scene, drawn.z)
    if deformations is None:
        return modes
    model = problem.model
    T = fit_rigid(material_moved(problem.scene, model, deformations), modes.place(model.material(modes.z)))
    return Posed(T[:3, :3], T[:3, 3], modes.z)


def wide_misfit(problem: DrawsProblem, fit: DrawsFit) -> float:
    """By the cloud's first sigma."""
    seen = played(problem, fit.drawn, fit.z, fit.posed, wide=True)
    return np.inf if seen is None else seen.misfit


def approach(problem: DrawsProblem, fit: DrawsFit, modes: Posed) -> DrawsFit:
    """Towards the fit of the modes, which is dense and smooth where the frame is neither."""
    model, config = problem.model, problem.config
    target = modes.place(model.material(modes.z))[model.sparse]
    sigma, best, least = problem.base.network_sigma, fit, np.inf
    for number in range(config.approaches + 1):
        apart = robust_square(np.linalg.norm(fit.placed()[model.sparse] - target, axis=1), sigma).mean()
        if apart >= least:
            break
        best, least = fit, apart
        if number == config.approaches:
            break
        motion = jacobian(problem, fit)
        network = NetworkTerm(target, fit.material[model.sparse], motion[model.sparse], np.ones(len(target)))
        linear = replace(problem.around(fit.material, motion), network=network)
        start = replace(fit.posed, z=np.zeros(len(fit.z)))
        found = fit_network(linear, start, draws_prior(fit, motion, config.trust))
        nearer = played(problem, fit.drawn, fit.z + found.z, found)
        if nearer is None:
            break
        fit = nearer
    return best


def jump(problem: DrawsProblem, fit: DrawsFit) -> DrawsFit:
    """One draw anywhere in its range, where that explains the frame better: a wheel by half a turn, a finger's other side.

    Only while the cloud is not explained.
    """
    config, base = problem.config, problem.base
    for _ in range(config.jumps):
        cloud = problem.around(fit.material, np.zeros((len(fit.material), 3, 0), dtype=np.float32)).misfit(fit.posed).cloud
        if cloud < base.config.explained:
            break
        others = []
        for number in np.flatnonzero(fit.drawn.smooth):
            for value in ndtri((np.arange(config.places) + 0.5) / config.places):
                z = fit.z.copy()
                z[number] = value
                others.append(played(problem, fit.drawn, z, fit.posed, wide=True))
        likely = sorted((other for other in others if other is not None), key=lambda other: other.misfit)
        found = [descend(problem, other, config.first_rounds) for other in likely[: config.kept + 1]]
        best = min(found, key=lambda other: other.misfit, default=fit)
        if best.misfit >= fit.misfit:
            break
        fit = descend(problem, best, config.first_rounds)
    return fit


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
    fixed = problem.around(material, np.zeros((len(material), 3, 0), dtype=np.float32))
    rigid = replace(posed, z=np.empty(0))
    sigma = problem.config.start_sigma * problem.model.half if wide else None
    misfit = fixed.misfit(rigid, sigma).total + float(z @ z)
    return DrawsFit(drawn, z, rigid, material, misfit)


def descend(problem: DrawsProblem, fit: DrawsFit, rounds: int) -> DrawsFit:
    """Linearize, fit, play; a step that does not lower the misfit is halved, then given up.

    Half of the rounds judge by the wide misfit: far from the answer the narrow one is flat.
    """
    trust, sigma = problem.config.trust, problem.config.start_sigma
    for number in range(rounds):
        wide = 2 * number < rounds
        before = played(problem, fit.drawn, fit.z, fit.posed, wide)
        assert before is not None
        fit = before
        step, posed = linear_step(problem, fit, trust, sigma)
        for share, place in ((1.0, posed), (0.5, between(fit.posed, posed))):
            tried = played(problem, fit.drawn, fit.z + share * step, place, wide)
            if tried is not None and tried.misfit < fit.misfit:
                fit = tried
                break
        else:
            trust *= 0.3
        sigma *= 0.6
    return played(problem, fit.drawn, fit.z, fit.posed) or fit


def draws_prior(fit: DrawsFit, motion: Float32[np.ndarray, "m 3 d"], trust: float) -> Prior:
    """Of a change of the draws: N(0, 1) of the draws themselves, near where they are; those that move nothing stay."""
    moving = np.abs(motion).max(axis=(0, 1)) > 1e-9
    precision = 1.0 + 1.0 / trust**2
    return Prior(np.where(moving, -fit.z / precision, 0.0), np.diag(np.where(moving, precision, HELD)))


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
    linear = problem.around(fit.material, modes)
    prior = draws_prior(fit, modes, trust)
    start = replace(fit.posed, z=np.zeros(len(fit.z)))
    found = fit_cloud(linear, start, prior, sigma, problem.config.steps, 0.0)
    return found.z, found


def jacobian(problem: DrawsProblem, fit: DrawsFit) -> Float32[np.ndarray, "m 3 d"]:
    """Motion of all material points for a standard deviation of each draw: at the anchors, which the others follow."""
    model, drawn = problem.model, fit.drawn
    order = np.concatenate(model.anchors)
    change = np.zeros((len(model.rest_points), 3, len(fit.z)), dtype=np.float32)
    for number in np.flatnonzero(drawn.smooth):
        step = DIFFERENCE * (-1.0 if fit.z[number] > 0 else 1.0)
        z = fit.z.copy()
        z[number] += step
        moved = drawn.deformations(problem.scene, z)
        if moved is not None:
            change[order, :, number] = (anchors_moved(model, moved) - fit.material[order]) / step
    spread: np.ndarray = problem.spread @ change.reshape(len(change), -1)
    return spread.reshape(change.shape)
