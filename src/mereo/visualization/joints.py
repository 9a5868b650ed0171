"""Values of a mechanism's joints in an answer, with their intervals, and how sure its pose is.

The material points of a registration are those of the mechanism in some pose, so its joint values are a least squares
problem of few unknowns. The Jacobian at its end says how the values follow the points, whose uncertainty is known.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy.linalg import norm
from scipy.optimize import OptimizeResult, least_squares
from scipy.special import chdtri, ndtr

from mereo.deformation.samplers import RandomMotion
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.registration import Registration
from mereo.fitting.uncertainty import LEVEL, WITHIN
from mereo.geometry.transforms import fit_rigid, transform_points
from mereo.visualization.units import as_exact_as

SHOWN = {"rad": (180 / np.pi, "°"), "m": (1000.0, " mm"), "": (1.0, " units")}
"""Factor and name of the units in which people read values."""


@dataclass(frozen=True)
class JointValue:
    """Value of a joint that has a name.

    Attributes:
        value: radians of one that turns, metres of one that slides; scene units where the object's size is not known.
        interval: values between which the true one is with probability 0.95; None where the registration was read from
            a file. Like a radius, it does not cover a fit that ended in a wrong state.
        unit: of the value: "rad", "m", or "" of scene units.
        limits: least and greatest value that the object's definition allows.
    """

    value: float
    interval: tuple[float, float] | None
    unit: Literal["rad", "m", ""]
    limits: tuple[float, float]

    def __str__(self) -> str:
        """Value and interval for people, in degrees or millimetres."""
        factor, unit = SHOWN[self.unit]
        if self.interval is None:
            return f"{factor * self.value:.4g}{unit}"
        ends = [factor * end for end in self.interval]
        value, least, most = as_exact_as(ends[1] - ends[0], factor * self.value, *ends)
        return f"{value}{unit} ({least} to {most})"

    def facts(self) -> dict[str, Any]:
        """Content for ``summary.json``."""
        return asdict(self)


def measure_joints(answer: Answer) -> dict[str, JointValue]:
    """Measure the joints that have names in the object's definition, by which they are counted, in an answer's state.

    Empty where there are none, and where the network answers.
    """
    registration, scene = answer.registered, None if answer.registrar is None else answer.registrar.scene
    motion = None if scene is None else scene.sample_deformations
    if registration is None or scene is None or not isinstance(motion, RandomMotion) or not motion.joints:
        return {}
    leaders = list(dict.fromkeys(joint.follows or joint.name for joint, _ in motion.joints.values()))  # as drawn
    rows = np.unique(np.concatenate([anchors[:: 1 + len(anchors) // 64] for anchors in registration.model.anchors]))
    fit = _fit_shares(registration, motion, leaders, rows)
    reach = _reach(registration, fit, rows)
    values = dict[str, JointValue]()
    for name, (joint, _) in motion.joints.items():
        index = leaders.index(joint.follows or name)
        unit, factor = ("rad", 1.0) if joint.turns else ("m", scene.unit_m) if scene.unit_m else ("", 1.0)
        first, second = (factor * limit for limit in joint.limits)
        value = first + float(fit.x[index]) * (second - first)
        if joint.turns:  # a whole turn more is the same state
            value -= 2 * np.pi * float(np.round((value - (first + second) / 2) / (2 * np.pi)))
        off = None if reach is None else abs(second - first) * float(reach[index])
        interval = None if off is None else (value - off, value + off)
        values[name] = JointValue(value, interval, unit, (min(first, second), max(first, second)))  # type: ignore[arg-type]
    return values


def _fit_shares(
    registration: Registration, motion: RandomMotion, leaders: Sequence[str], rows: Int[np.ndarray, " n"]
) -> OptimizeResult:
    """Shares of the joints' ranges that bring the object's points at rest nearest to the registered ones."""
    model, drawn = registration.model, registration.drawn
    rest, labels = model.rest_points[rows], model.labels[rows]
    goal = registration.material[rows] / registration.scene_unit

    def misfit(shares: Float[np.ndarray, " j"]) -> Float[np.ndarray, " r"]:
        moved = np.empty_like(rest)
        for label, deform in enumerate(motion.at(dict(zip(leaders, shares.tolist(), strict=True))), start=1):
            moved[labels == label] = deform(rest[labels == label])
        return np.ravel(transform_points(fit_rigid(moved, goal), moved) - goal)

    limits = np.array([motion.joints[name][0].limits for name in leaders])
    starts = [np.full(len(leaders), 0.5), limits[:, 0] / (limits[:, 0] - limits[:, 1])]  # the middle, and rest
    if drawn is not None and len(drawn.z) == len(leaders):
        starts = [ndtr(drawn.z)]
    return min((least_squares(misfit, start, method="lm") for start in starts), key=lambda fit: float(fit.cost))


def _reach(
    registration: Registration, fit: OptimizeResult, rows: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " j"] | None:
    """How far off shares may be with probability 0.95; None where the uncertainty of the points is not known.

    The parts are those of a radius (``RadiusParts``), without what each point has in addition: it averages out.
    """
    follow = np.zeros((len(fit.x), len(registration.material), 3))
    follow[:, rows] = np.linalg.pinv(fit.jac).reshape(len(fit.x), len(rows), 3) / registration.scene_unit
    spread = _spread(registration, follow)
    return None if spread is None else np.abs(spread[1]).max(axis=1, initial=0.0) + WITHIN * norm(spread[0], axis=1)


# --- pose -------------------------------------------------------------------------------------------------------------


def measure_pose_covariance(answer: Answer) -> Float[np.ndarray, "6 6"] | None:
    """Measure the covariance of an answer's pose: of the place of the object's origin, then of turns about the axes.

    Axes are the frame's, lengths its unit, angles radians. What is far from Gaussian, such as another state that
    explains the frame as well, counts by its second moments. None where the network answers, and where the registration
    was read from a file.
    """
    registration = answer.registered
    if registration is None:
        return None
    material, origin = registration.material, registration.pose()[:3, 3]
    middle = material.mean(axis=0)
    arms = _crosses(material - middle)
    # motion of the best rigid body: of its middle the mean one, and the turn whose angular momentum is that of all
    turn = np.moveaxis(np.linalg.solve(np.einsum("nij,nkj->ik", arms, arms), arms), 0, 1)
    shift = np.repeat(np.eye(3)[:, None] / len(material), len(material), axis=1)
    shift -= np.tensordot(_crosses(origin - middle), turn, axes=1)
    spread = _spread(registration, np.concatenate([shift, turn]))
    if spread is None or registration.uncertainty is None:
        return None
    factor = np.hstack(spread)
    covariance: np.ndarray = factor @ factor.T
    extra = registration.uncertainty.optimum.unit * registration.uncertainty.extra_radius
    covariance[range(3), range(3)] += extra**2 / chdtri(3, 1 - LEVEL)  # as of every position
    return covariance


def _crosses(arms: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Matrices whose products with vectors are cross products."""
    return np.cross(arms[..., None, :], np.eye(3), axis=-1).swapaxes(-1, -2)


def _spread(
    registration: Registration, gradient: Float[np.ndarray, "c m 3"]
) -> tuple[Float[np.ndarray, "c q"], Float[np.ndarray, "c o"]] | None:
    """Factor of the covariance of numbers with this gradient by the material points, and their ways to other states.

    None where the uncertainty of the points is not known.
    """
    sure = registration.uncertainty
    if sure is None:
        return None
    posterior, unit = sure.posterior, sure.optimum.unit
    T_registration_fit = fit_rigid(unit * posterior.material, registration.material)
    gradient = unit * gradient @ T_registration_fit[:3, :3]
    near, far = sure.factor * posterior.motion_of(gradient), np.tensordot(gradient, posterior.open, axes=2)
    return np.hstack([near, far]), np.tensordot(gradient, posterior.ways, axes=2)
