"""Pose and values of a mechanism's joints in an answer, with their covariance and intervals.

The material points of a registration are those of the mechanism in some pose, so its joint values are a least squares
problem of few unknowns, as its pose is one. The derivative at its end says how the values follow the points, whose
uncertainty is known.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from math import inf, pi
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.linalg import inv, norm
from scipy.optimize import OptimizeResult, least_squares
from scipy.special import ndtr

from mereo.deformation.samplers import RandomMotion
from mereo.fitting.problem.gauss_newton import rigid_motion
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.registration import Registration
from mereo.fitting.uncertainty import WITHIN
from mereo.geometry.brief import as_exact_as
from mereo.geometry.conventions import Range
from mereo.geometry.transforms import Indices, NamedPoses, fit_rigid, transform_points
from mereo.io.atomic_files import JsonObject
from mereo.scenes.scene import AssetUnavailable, Scene

SHOWN = {"rad": (180 / pi, "°"), "m": (1000.0, " mm"), "": (1.0, " units")}
"""Factor and name of the units in which people read values."""


WHOLE = 0.0, 1.0
"""Shares of a joint of which nothing is given; beyond them its value may lie, as far as the frame says so."""


@dataclass(frozen=True)
class JointValue:
    """Value of a joint that has a name.

    Attributes:
        value: radians of one that turns, metres of one that slides; scene units where the object's size is not known.
        interval: values between which the true one is with probability 0.95, none beyond those that are given; None
            where the registration was read from a file. Like a radius, it does not cover a fit that ended in a wrong
            state.
        unit: of the value: "rad", "m", or "" of scene units.
        limits: least and greatest value that the object's definition allows.
    """

    value: float
    interval: Range | None
    unit: Literal["rad", "m", ""]
    limits: Range

    def __str__(self) -> str:
        """Value for people, in degrees or millimetres, and its interval, unless it is given exactly."""
        factor, unit = SHOWN[self.unit]
        if self.interval is None:
            return f"{factor * self.value:.4g}{unit}"
        ends = [factor * end for end in self.interval]
        value, least, most = as_exact_as(ends[1] - ends[0], factor * self.value, *ends)
        return f"{value}{unit}" if least == most else f"{value}{unit} ({least} to {most})"

    def facts(self) -> JsonObject:
        """Content for ``summary.json``."""
        return asdict(self)


JointValues = dict[str, JointValue]
"""Values by the names of joints."""


def measure_joints(answer: Answer) -> JointValues:
    """Measure the joints that have names in the object's definition, by which they are counted, in an answer's state.

    Empty where there are none, and where the network answers. Those of a registration are measured once.
    """
    registration, fitted = answer.registered, answer.registration
    if registration is None or fitted is None or answer.registrar is None:
        return {}
    if fitted not in _MEASURED:
        with suppress(AssetUnavailable):  # the meshes of a scene's weights, which need none
            _MEASURED[fitted] = _measured(registration, answer.registrar.scene)
    return _MEASURED.get(fitted, {})


_MEASURED = WeakKeyDictionary[Registration, JointValues]()


def _measured(registration: Registration, scene: Scene | None) -> JointValues:
    motion = None if scene is None else scene.sample_deformations
    if scene is None or not isinstance(motion, RandomMotion) or not motion.joints:
        return {}
    leaders = motion.leaders
    rows = np.unique(np.concatenate([anchors[:: 1 + len(anchors) // 64] for anchors in registration.model.anchors]))
    fit = _fit_shares(registration, motion, leaders, rows)
    reach = _reach(registration, fit, rows)
    values = JointValues()
    for name, (joint, _) in motion.joints.items():
        index = leaders.index(joint.follows or name)
        leader = motion.joints[leaders[index]][0]
        unit, factor = ("rad", 1.0) if joint.turns else ("m", scene.unit_m) if scene.unit_m else ("", 1.0)
        first, second = (factor * limit for limit in joint.limits)
        ends = [first + share * (second - first) for share in leader.shares]
        value = ends[0] + float(fit.x[index]) * (ends[1] - ends[0])
        off = None if reach is None else abs(ends[1] - ends[0]) * float(reach[index])
        if joint.turns:  # a whole turn more is the same state
            turn = 2 * pi * float(np.round((value - (first + second) / 2) / (2 * pi)))
            value = value - turn
            ends = [end - turn for end in ends]
        low, high = (-inf, inf) if leader.shares == WHOLE else sorted(ends)
        interval = None if off is None else (max(value - off, low), min(value + off, high))
        values[name] = JointValue(value, interval, unit, (min(first, second), max(first, second)))  # type: ignore[arg-type]
    return values


def _fit_shares(
    registration: Registration, motion: RandomMotion, leaders: Sequence[str], rows: Indices
) -> OptimizeResult:
    """Numbers of the joints that bring the object's points at rest nearest to the registered ones.

    0 is the least and 1 the greatest share that a joint may have, between which one stays whose value is given.
    """
    model, drawn = registration.model, registration.drawn
    rest, labels = model.rest_points[rows], model.labels[rows]
    goal = registration.material[rows] / registration.scene_unit
    joints = [motion.joints[name][0] for name in leaders]
    least, most = np.transpose([joint.shares for joint in joints])

    def misfit(numbers: Float[ndarray, " j"]) -> Float[ndarray, " r"]:
        moved = np.empty_like(rest)
        shares = least + numbers * (most - least)
        for label, deform in enumerate(motion.at(dict(zip(leaders, shares.tolist(), strict=True))), start=1):
            moved[labels == label] = deform(rest[labels == label])
        return np.ravel(transform_points(fit_rigid(moved, goal), moved) - goal)

    at_rest = np.array([joint.share(0.0) for joint in joints])
    starts = [np.full(len(leaders), 0.5), (at_rest - least) / np.maximum(most - least, 1e-9)]  # the middle, and rest
    if drawn is not None and len(drawn.z) == len(leaders):
        starts = [ndtr(drawn.z)]
    free = np.where([joint.shares == WHOLE for joint in joints], inf, 0.0)
    fits = (least_squares(misfit, np.clip(start, -free, 1 + free), bounds=(-free, 1 + free)) for start in starts)
    return min(fits, key=lambda fit: float(fit.cost))


def _reach(registration: Registration, fit: OptimizeResult, rows: Indices) -> Float[ndarray, " j"] | None:
    """How far off shares may be with probability 0.95; None where the uncertainty of the points is not known.

    The parts are those of a radius (``RadiusParts``), without what each point has in addition: it averages out.
    """
    gradient = np.zeros((len(fit.x), len(registration.material), 3))
    gradient[:, rows] = np.linalg.pinv(fit.jac).reshape(len(fit.x), len(rows), 3) / registration.scene_unit
    if (moves := _moves(registration, gradient)) is None:
        return None
    gaussian, ways = moves
    return np.abs(ways).max(axis=1, initial=0.0) + WITHIN * norm(gaussian, axis=1)


def segment_poses(registration: Registration) -> NamedPoses:
    """Poses of all segments in the frame: of the links' frames of a robot's file, else of the origin of the files."""
    source = registration.model.source_frame
    poses = NamedPoses()
    for label, name in enumerate(registration.model.rest.names, start=1):
        rest = np.eye(4) if source is None else source.link_frames.get(name, np.eye(4)).copy()
        rest[:3, 3] *= registration.model_scale
        poses[name] = registration.segment_pose(label) @ rest
    return poses


def pose_covariance(registration: Registration) -> Float[ndarray, "6 6"] | None:
    """Covariance of ``Registration.pose``; None where the uncertainty of the points is not known.

    Of a rotation vector w in radians, then a translation t in the input's unit, both in the axes of the registration:
    the true pose is ``[exp(w) R, p + t]`` where the registered one is ``[R, p]``, so that w turns about the origin of
    the object's own files, which lies at p. It holds what radii hold, times the square of their factor
    (``Uncertainty.factor``): what the frame leaves open, and other states that explain it alike, by their second
    moments, and for the translation the radius that each point has in addition.
    """
    target = registration.material
    placed = registration.pose()
    source = transform_points(placed, registration.model.source_points(registration.scene_unit))
    arm, aim = source - source.mean(axis=0), target - target.mean(axis=0)
    # The turn w of the best rotation solves sum arm x (aim + shift) = 0 to first order: M w = sum arm x shift
    turning = inv((arm * aim).sum() * np.eye(3) - arm.T @ aim)
    turn = np.moveaxis(rigid_motion(arm)[:, :, :3] @ turning, 2, 0)
    lever = target.mean(axis=0) - placed[:3, 3]
    shift = np.eye(3)[:, None] / len(arm) - np.cross(turn, lever, axisa=0, axisc=0)
    moves = _moves(registration, np.concatenate([turn, shift]))
    if moves is None:
        return None
    factor = np.hstack(moves)
    covariance: Float[np.ndarray, "6 6"] = factor @ factor.T
    return covariance


def _moves(
    registration: Registration, gradient: Float[ndarray, "c m 3"]
) -> tuple[Float[ndarray, "c p"], Float[ndarray, "c o"]] | None:
    """How c numbers, of which the gradient by the material points is given, are unsure; None where points are not.

    Their changes with independent standard normal numbers, and in each other state that explains the frame alike.
    """
    sure = registration.uncertainty
    if sure is None:
        return None
    posterior, unit = sure.posterior, sure.optimum.unit
    T_registration_fit = fit_rigid(unit * posterior.material, registration.material)
    gradient = unit * (gradient @ T_registration_fit[:3, :3])
    far, ways = (np.tensordot(gradient, part, axes=2) for part in (posterior.open, posterior.ways))
    return np.hstack([sure.factor * posterior.motion_of(gradient), far]), ways
