"""Values of a mechanism's joints in a registered state, with their intervals.

The material points of a registration are those of the mechanism in some pose, so its joint values are a least squares
problem of few unknowns. The Jacobian at its end says how the values follow the points, whose uncertainty is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import OptimizeResult, least_squares
from scipy.special import ndtr

from mereo.deformation.samplers import RandomMotion
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.registration import Registration
from mereo.fitting.uncertainty import WITHIN, Uncertainty
from mereo.geometry.transforms import fit_rigid, transform_points


@dataclass(frozen=True)
class JointValue:
    """Value of a joint that has a name.

    Attributes:
        name: of the joint.
        value: radians of one that turns, metres of one that slides; scene units where the object's size is not known.
        interval: values between which the true one is with probability 0.95; None where the registration was read from
            a file.
        unit: of the value: "rad", "m", or "" of scene units.
        limits: least and greatest value that the object's definition allows.
    """

    name: str
    value: float
    interval: tuple[float, float] | None
    unit: Literal["rad", "m", ""]
    limits: tuple[float, float]

    def __str__(self) -> str:
        """Value and interval for people, in degrees or millimetres."""
        factor, unit = {"rad": (180 / np.pi, "°"), "m": (1000.0, " mm"), "": (1.0, " units")}[self.unit]
        between = " ({:.1f} to {:.1f})".format(*(factor * end for end in self.interval)) if self.interval else ""
        return f"{factor * self.value:.1f}{unit}{between}"

    def facts(self) -> dict[str, object]:
        """Content for ``summary.json``."""
        interval = self.interval and list(self.interval)
        return {"value": self.value, "interval": interval, "unit": self.unit, "limits": list(self.limits)}


def measure_joints(answer: Answer) -> dict[str, JointValue]:
    """Measure the joints that have names in the object's definition, by which they are counted, in an answer's state.

    Empty where there are none, and where the network answers.
    """
    registration, scene = answer.registered, None if answer.registrar is None else answer.registrar.scene
    motion = None if scene is None else scene.sample_deformations
    if registration is None or scene is None or not isinstance(motion, RandomMotion) or not motion.joints:
        return {}
    leaders = list(dict.fromkeys(joint.follows or joint.name for joint, _ in motion.joints.values()))
    rows = np.unique(np.concatenate([anchors[:: 1 + len(anchors) // 64] for anchors in registration.model.anchors]))
    end = _fitted_shares(registration, motion, leaders, rows)
    off = _off(registration, end, rows)
    values = dict[str, JointValue]()
    for name, (joint, _) in motion.joints.items():
        index = leaders.index(joint.follows or name)
        unit, factor = ("rad", 1.0) if joint.turns else ("m", scene.unit_m) if scene.unit_m else ("", 1.0)
        least, most = (factor * limit for limit in joint.limits)
        value = least + float(end.x[index]) * (most - least)
        if joint.turns:  # a whole turn more is the same state
            value -= 2 * np.pi * np.round((value - (least + most) / 2) / (2 * np.pi))
        reach = None if off is None else abs(most - least) * float(off[index])
        interval = None if reach is None else (value - reach, value + reach)
        values[name] = JointValue(name, value, interval, unit, (min(least, most), max(least, most)))
    return values


def _fitted_shares(
    registration: Registration, motion: RandomMotion, leaders: Sequence[str], rows: Int[np.ndarray, " n"]
) -> OptimizeResult:
    """Shares of the joints' ranges that bring the object's points at rest nearest to the registered ones, in any pose."""
    model, drawn = registration.model, registration.drawn
    rest, labels = model.rest_points[rows], model.labels[rows]
    goal = registration.material[rows] / registration.scene_unit

    def misfit(shares: Float[np.ndarray, " j"]) -> Float[np.ndarray, " r"]:
        moved = np.empty_like(rest)
        for label, deform in enumerate(motion.at(dict(zip(leaders, shares.tolist(), strict=True))), start=1):
            moved[labels == label] = deform(rest[labels == label])
        return np.ravel(transform_points(fit_rigid(moved, goal), moved) - goal)

    zero = [-joint.limits[0] / np.ptp(joint.limits) for joint, _ in map(motion.joints.get, leaders)]  # type: ignore[misc]
    starts = [np.full(len(leaders), 0.5), np.array(zero)]
    if drawn is not None and len(drawn.z) == len(leaders):
        starts = [ndtr(drawn.z)]
    return min((least_squares(misfit, start, method="lm") for start in starts), key=lambda end: float(end.cost))


def _off(
    registration: Registration, end: OptimizeResult, rows: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " j"] | None:
    """How far off shares may be with probability 0.95; None where the uncertainty of the points is not known.

    By the same parts as a radius (``RadiusParts``); the extra one moves a typical point by ``extra_radius``.
    """
    sure: Uncertainty | None = registration.uncertainty
    if sure is None:
        return None
    posterior = sure.posterior
    T_registration_fit = fit_rigid(sure.optimum.unit * posterior.material, registration.material)
    follow = np.linalg.pinv(end.jac).reshape(len(end.x), len(rows), 3) @ T_registration_fit[:3, :3]
    gradient = np.zeros((len(end.x), len(posterior.material), 3))
    gradient[:, rows] = follow * (sure.optimum.unit / registration.scene_unit)
    gaussian, far = (
        WITHIN * np.linalg.norm(each, axis=1)
        for each in (posterior.motion_of(gradient), np.tensordot(gradient, posterior.open, axes=2))
    )
    reach = np.abs(np.tensordot(gradient, posterior.ways, axes=2)).max(axis=1, initial=0.0)
    extra = sure.extra_radius * np.sqrt(len(rows)) / np.linalg.norm(end.jac, axis=0)
    result: np.ndarray = reach + np.sqrt((sure.factor * gaussian) ** 2 + far**2 + extra**2)
    return result
