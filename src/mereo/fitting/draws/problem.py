"""States of a scene as explanations of a frame: playing them, judging them, and their linear neighbourhood.

Around a state the material points are linear in the draws, so its neighbourhood is a linear model like that of the
modes, fitted by the same code.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.sparse import csr_array

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.config import MANY_DRAWS, DrawsConfig
from mereo.fitting.draws.approach import HELD, prior_of_draws, unmoving
from mereo.fitting.draws.playback import Drawn, DrawnStates, as_sparse, material_moved
from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed, Rows, along, geman_mcclure
from mereo.fitting.problem.posterior import Terms
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import MOST_VIOLATIONS, ROBUST, WITNESS_WEIGHT, NetworkTerm, Surface, robust_square
from mereo.geometry.mesh import barycentric
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel


@dataclass(frozen=True, eq=False)
class DrawsProblem:
    """A frame to be explained by the states of a scene.

    Attributes:
        base: the same frame, explained by modes, with the worths that the draws are fitted by.
        states: random states of the scene.
        found: correspondences, scene units.
        weights: how their rest positions follow the material points.
        config: constants.
        by_sight: whether observed points are compared with what their lines of sight meet, or with the nearest places.
    """

    base: Problem
    states: DrawnStates
    found: Correspondences
    weights: PointWeights
    config: DrawsConfig
    by_sight: bool = False

    @property
    def model(self) -> StatisticalModel:
        """Statistical model of the object."""
        return self.base.model

    @property
    def last(self) -> Problem:
        """``base`` with the points of the last descent."""
        return self.base.by_every_point if self.config.every_point else self.base

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
        worths = replace(base.config, cloud_worth=config.cloud_worth, network_worth=(config.network_worth,) * 2)
        base = replace(base, config=worths)
        return cls(base, states, found, model.weights(found.rest, found.labels), config)

    def around(self, mean: Float[np.ndarray, "m 3"], modes: Float32[np.ndarray, "m 3 d"]) -> Problem:
        """The problem in the linear neighbourhood of a state."""
        model = self.model.around(mean, modes)
        network = NetworkTerm(self.found.points, self.weights(mean), self.weights(modes), self.found.confidence)
        return replace(self.base, model=model, network=network)

    def network(self, fit: "DrawsFit", modes: Float32[np.ndarray, "n 3 d"] | None = None) -> NetworkTerm:
        """Correspondences in the neighbourhood of a state."""
        modes = np.zeros((len(self.found.labels), 3, 0), dtype=np.float32) if modes is None else modes
        return NetworkTerm(self.found.points, self.weights(fit.material), modes, self.found.confidence)

    @cached_property
    def followed(self) -> csr_array:
        """How the rest positions of the correspondences follow the played points."""
        return as_sparse(self.weights, len(self.model.rest_points)) @ self.states.played.spread

    def rigid(self, material: Float[np.ndarray, "m 3"]) -> Problem:
        """Problem of one state's pose alone."""
        return self.around(material, np.zeros((len(material), 3, 0), dtype=np.float32))


@dataclass(frozen=True, eq=False)
class DrawsFit:
    """A played state beside the frame.

    Attributes:
        drawn, z: the state by its draws.
        posed: rigid pose; its ``z`` is empty.
        material: material points, unposed.
        surface: the posed surface.
        distance, face, place: of what each observed partner is compared with.
        misfit: with the prior of the draws, the cloud by its last sigma.
        motion: of the played points for a standard deviation of each draw, where it is known.
    """

    drawn: Drawn
    z: Float[np.ndarray, " d"]
    posed: Posed
    material: Float[np.ndarray, "m 3"]
    surface: Surface
    distance: Float[np.ndarray, " p"]
    face: Int[np.ndarray, " p"]
    place: Float[np.ndarray, "p 3"]
    misfit: float
    motion: Float32[np.ndarray, "a 3 d"] | None = None

    def placed(self) -> Float[np.ndarray, "m 3"]:
        """Material points in the camera frame."""
        return self.surface.material


def played(problem: DrawsProblem, drawn: Drawn, z: Float[np.ndarray, " d"], posed: Posed) -> DrawsFit | None:
    """The state of these draws and how badly it explains the frame; None where the scene refuses it."""
    deformations = drawn.deformations(problem.scene, z)
    if deformations is None:
        return None
    material = material_moved(problem.scene, problem.model, deformations)
    return beside(problem, drawn, z, posed, material)


def beside(
    problem: DrawsProblem,
    drawn: Drawn,
    z: Float[np.ndarray, " d"],
    posed: Posed,
    material: Float[np.ndarray, "m 3"],
) -> DrawsFit | None:
    """Material points beside the frame as those of a state; None where no face of them is seen."""
    rigid = replace(posed, z=np.empty(0))
    surface = Surface.through(problem.model, rigid.place(material))
    if len(surface.facing) == 0:
        return None
    partners = problem.base.evidence.partners
    met = problem.base.met(surface) if problem.by_sight else surface.nearest(partners)
    fit = DrawsFit(drawn, z, rigid, material, surface, *met, np.inf)
    return replace(fit, misfit=misfit(problem, fit, problem.base.config.cloud_sigma))


def misfit(problem: DrawsProblem, fit: DrawsFit, sigma: float) -> float:
    """Misfit as ``Problem.misfit`` counts it, by any sigma of the cloud, without looking for partners again."""
    base = problem.base
    cloud = base.config.cloud_worth * float(robust_square(fit.distance, sigma).mean())
    network = base.config.network_worth[1] * problem.network(fit).energy(fit.posed, base.network_sigma)
    amount = base.evidence.violations(fit.surface.material[base.witnesses], ROBUST * sigma)[1]
    witnesses = WITNESS_WEIGHT * float(robust_square(amount, sigma, 4 * ROBUST).sum())
    return cloud + network + witnesses + float(fit.z @ fit.z)


def narrowing(problem: DrawsProblem, fit: DrawsFit) -> float:
    """``NormalEquations.narrowing`` of the draws that move something."""
    assert fit.motion is not None
    equations = normal_equations(problem, fit, fit.motion, problem.base.config.cloud_sigma)
    return equations.narrowing() - int(unmoving(fit.motion).sum()) * float(np.log(HELD))


def normal_equations(
    problem: DrawsProblem, fit: DrawsFit, motion: Float32[np.ndarray, "a 3 d"], sigma: float
) -> NormalEquations:
    """Of everything that the frame shows, for changes of pose and draws, whose motion of the played points is given."""
    return terms(problem, fit, motion, sigma).total


def terms(problem: DrawsProblem, fit: DrawsFit, motion: Float32[np.ndarray, "a 3 d"], sigma: float) -> Terms:
    """Terms of ``normal_equations``."""
    base, posed, config = problem.base, fit.posed, problem.base.config
    flat, count = motion.reshape(len(motion), -1), len(fit.z)
    nothing, state = NormalEquations.nothing(POSE + count), replace(posed, z=np.zeros(count))
    network = problem.network(fit, (problem.followed @ flat).reshape(-1, 3, count))
    return Terms(
        known=prior_of_draws(fit.z, motion, posed.log_scale, base.scale_std),
        network=network.add_to(nothing, state, base.network_sigma, config.network_worth[1], robust=True),
        cloud=cloud_rows(problem, fit, motion, sigma),
        partners=base.evidence.partners,
        ruled_out=ruled_out(problem, fit, motion, sigma),
    )


def cloud_rows(problem: DrawsProblem, fit: DrawsFit, motion: Float32[np.ndarray, "a 3 d"], sigma: float) -> Rows:
    """Each observed partner's distance to its plane of the surface, its derivatives, and its weight."""
    base, spread = problem.base, problem.states.played.spread
    corners = problem.model.faces[fit.surface.facing[fit.face]]
    within = barycentric(fit.surface.material[corners], fit.place).astype(np.float32)
    rows = np.repeat(np.arange(len(corners)), 3)
    at_places = csr_array((within.ravel(), (rows, corners.ravel())), shape=(len(corners), spread.shape[0])) @ spread
    modes = (at_places @ motion.reshape(len(motion), -1)).reshape(-1, 3, len(fit.z))
    direction = fit.surface.normals[fit.face]
    residual = np.einsum("pi,pi->p", direction, fit.place - base.evidence.partners)
    weight = geman_mcclure(residual, ROBUST * sigma) * (base.config.cloud_worth / len(residual) / sigma**2)
    return along(fit.posed, fit.place, modes, direction), residual, weight


def ruled_out(
    problem: DrawsProblem, fit: DrawsFit, motion: Float32[np.ndarray, "a 3 d"], sigma: float
) -> NormalEquations:
    """Normal equations of the vertices that are outside the silhouette or in free space."""
    base, spread, nothing = problem.base, problem.states.played.spread, NormalEquations.nothing(POSE + len(fit.z))
    chosen = base.witnesses
    direction, amount = base.evidence.violations(fit.surface.material[chosen], ROBUST * sigma)
    rows = np.flatnonzero(amount > 0)
    if len(rows) == 0:
        return nothing
    rows = rows[:: max(1, -(-len(rows) // MOST_VIOLATIONS))]
    modes = (spread[chosen[rows]] @ motion.reshape(len(motion), -1)).reshape(-1, 3, len(fit.z))
    jacobian = along(fit.posed, fit.surface.material[chosen[rows]], modes, direction[rows])
    weight = WITNESS_WEIGHT / sigma**2 * geman_mcclure(amount[rows], 4 * ROBUST * sigma)
    return nothing.add(jacobian, -amount[rows], weight)
