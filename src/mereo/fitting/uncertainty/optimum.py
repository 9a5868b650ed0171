"""Where fits of modes, of the rest model and of draws have ended, from which a posterior is made when it is asked for.

ModesOptimum, DrawsOptimum -> Terms of the normal equations -> Posterior
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32

from mereo.fitting.draws.problem import DrawsFit, DrawsProblem
from mereo.fitting.draws.problem import terms as terms_of_draws
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed
from mereo.fitting.problem.own_turns import left_open
from mereo.fitting.problem.posterior import Observed, Posterior, Terms
from mereo.fitting.problem.priors import Prior
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import Surface, add_witnesses
from mereo.io.cores import one_blas_thread


@dataclass(frozen=True, eq=False)
class ModesOptimum:
    """End of a fit of the modes, or, with a model that has none, of the pose alone.

    Attributes:
        problem: everything the fit worked on.
        posed: coefficients and pose.
        unit: length of a scene unit in the input's unit, before the fit's own scale.
    """

    problem: Problem
    posed: Posed
    unit: float

    @property
    def tolerance(self) -> float:
        """Distance in scene units up to which an observed point lies on the surface, by the frame's noise."""
        return self.problem.config.tolerance

    @cached_property
    def terms(self) -> Terms:
        """Terms under the prior of all states; that of the states near the answer is too sure (design note 22)."""
        problem, posed, config = self.problem, self.posed, self.problem.config
        nothing = NormalEquations.nothing(POSE + len(posed.z))
        with one_blas_thread():
            samples = problem.samples.posed(posed).few(config.witnesses)
            return Terms(
                known=problem.known(posed, Prior.whole(problem.model), 0.0),
                network=problem.network.add_to(
                    nothing, posed, problem.network_sigma, config.network_worth[1], robust=True
                ),
                cloud=problem.cloud_rows(posed),
                partners=problem.evidence.partners,
                ruled_out=add_witnesses(nothing, posed, samples, problem.evidence, config.cloud_sigma),
            )

    @cached_property
    def observed(self) -> Observed:
        """Observed points beside the surface."""
        points = self.problem.evidence.points
        return points, Surface.of(self.problem.model, self.posed).nearest(points)[0]

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of pose, scale and coefficients."""
        model = self.problem.model
        material = self.posed.place(model.material(self.posed.z))
        with one_blas_thread():
            turns = turns_left_open(self.problem, material)
            return Posterior.of(self.terms.total, self.posed, material, model.modes, model.residue, turns)


@dataclass(frozen=True, eq=False)
class DrawsOptimum:
    """End of a fit of a scene's draws.

    Attributes:
        problem: everything the fit worked on.
        fit: the played state.
        unit: length of a scene unit in the input's unit, before the fit's own scale.
    """

    problem: DrawsProblem
    fit: DrawsFit
    unit: float

    @property
    def tolerance(self) -> float:
        """Distance in scene units up to which an observed point lies on the surface, by the frame's noise."""
        return self.problem.base.config.tolerance

    @cached_property
    def terms(self) -> Terms:
        """Terms of the neighbourhood in which the scene is linear in its draws."""
        with one_blas_thread():
            return terms_of_draws(self.problem, self.fit, self._motion, self.problem.base.config.cloud_sigma)

    @property
    def _motion(self) -> Float32[np.ndarray, "a 3 d"]:
        assert self.fit.motion is not None
        return self.fit.motion

    @cached_property
    def observed(self) -> Observed:
        """Observed points beside the surface."""
        points = self.problem.base.evidence.points
        return points, self.fit.surface.nearest(points)[0]

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of pose, scale and draws."""
        motion, spread = self._motion, self.problem.states.played.spread
        modes: Float32[np.ndarray, "m 3 d"] = (spread @ motion.reshape(len(motion), -1)).reshape(
            spread.shape[0], *motion.shape[1:]
        )
        material: Float[np.ndarray, "m 3"] = self.fit.placed()
        with one_blas_thread():
            turns = turns_left_open(self.problem.base, material)
            return Posterior.of(self.terms.total, self.fit.posed, material, modes, turns=turns)


def turns_left_open(problem: Problem, material: Float[np.ndarray, "m 3"]) -> Float32[np.ndarray, "m 3 e"]:
    """How far turns of single segments that the frame does not tell apart may have moved the material points."""
    config = problem.config
    return left_open(problem.model, material, problem.evidence.partners, config.cloud_sigma, config.cloud_worth)


Optimum = ModesOptimum | DrawsOptimum
"""Where a fit has ended, with all that it worked on."""
