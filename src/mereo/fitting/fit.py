"""Registration: the object's own deformation model, fitted to one frame.

code -correspondences-> pose and state of the model -deform-> SegmentedMesh, and a map rest <-> camera
"""

import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from mereo.fitting.config import FitConfig
from mereo.fitting.correspondences import Correspondences, find_correspondences
from mereo.fitting.draws_fit import fit_draws
from mereo.fitting.draws_problem import DrawsProblem
from mereo.fitting.evidence import Evidence
from mereo.fitting.gauss_newton import Posed
from mereo.fitting.modes_fit import fit_modes
from mereo.fitting.playback import DrawnStates
from mereo.fitting.problem import Problem
from mereo.fitting.registration import Method, Registration
from mereo.fitting.residuals import Surface
from mereo.geometry.camera import PointCloud
from mereo.models.model import EncodedCloud, Model
from mereo.scenes.statistical_model import StatisticalModel

KNOWN_SCALE_STD = 1e-6
SCALE_PAIRS = 4000
"""Pairs of correspondences whose distances, there and at rest, tell an unknown unit."""


def fit(
    cloud: PointCloud,
    network: Model,
    model: StatisticalModel,
    scene_unit: float | None = None,
    states: DrawnStates | None = None,
    config: FitConfig = FitConfig(),  # noqa: B008 (frozen)
    code: EncodedCloud | None = None,
) -> Registration:
    """The model's state and pose that explain a cloud.

    Args:
        cloud: observed points, camera frame, any unit.
        network: trained on this object, with rest coordinates.
        model: statistical model of the same object.
        scene_unit: length of a scene unit in the cloud's unit; found together with the pose where None.
        states: of the model's scene, whose own draws are then fitted too; the better of modes and draws is returned.
        config: constants.
        code: of the cloud, where it is known already.

    Raises ``ValueError`` for a network without rest coordinates or of other segments, and where it finds too little.
    """
    if network.names != model.rest.names:
        raise ValueError(
            f"the weights know the segments {', '.join(network.names)} but the statistical model has "
            f"{', '.join(model.rest.names)}; they must be of one object: build the model from the weights' own scene"
        )
    code = network.encode(cloud) if code is None else code
    found = find_correspondences(network, code, model.rest_center, model.half)
    if found is None:
        raise ValueError(
            "the weights predict no rest coordinates, from which a fit starts; train with a dataset that has a template"
        )
    return fit_correspondences(cloud.points, found.evenly(), model, scene_unit, states, config)


def fit_correspondences(
    points: Float[np.ndarray, "n 3"],
    found: Correspondences,
    model: StatisticalModel,
    scene_unit: float | None = None,
    states: DrawnStates | None = None,
    config: FitConfig = FitConfig(),  # noqa: B008 (frozen)
) -> Registration:
    """``fit`` from given correspondences; ``points`` are the observed cloud, seen from the origin."""
    with threadpool_limits(1, "blas"):  # products this small are slower on two threads, and 20 times on busy cores
        return _fit(points, found, model, scene_unit, states, config)


def _fit(
    points: Float[np.ndarray, "n 3"],
    found: Correspondences,
    model: StatisticalModel,
    scene_unit: float | None,
    states: DrawnStates | None,
    config: FitConfig,
) -> Registration:
    started = time.perf_counter()
    unit = estimate_unit(found) if scene_unit is None else scene_unit
    scale_std = config.scale_std if scene_unit is None else KNOWN_SCALE_STD
    found = found.scaled(1 / unit)
    problem = Problem.of(model, found, Evidence.of(points / unit), scale_std, config)
    modes = fit_modes(problem)
    best = Chosen("modes", modes.z, modes, modes.place(model.material(modes.z)))
    if states is not None:
        drawn = fit_draws(DrawsProblem.of(problem, states, found), modes)
        if drawn is not None and drawn.misfit < problem.misfit(modes).total:
            best = Chosen("draws", drawn.z, drawn.posed, drawn.placed())
    explained = explained_share(problem, best.material)
    return Registration(
        model=model,
        material=best.material * unit,
        method=best.method,
        z=best.z,
        scene_unit=unit * float(np.exp(best.posed.log_scale)),
        explained=explained,
        accepted=explained >= config.accepted,
        seconds=time.perf_counter() - started,
    )


@dataclass(frozen=True, eq=False)
class Chosen:
    """The description of the state that explains a frame best; material points in the camera frame, scene units."""

    method: Method
    z: Float[np.ndarray, " k"]
    posed: Posed
    material: Float[np.ndarray, "m 3"]


def explained_share(problem: Problem, material: Float[np.ndarray, "m 3"]) -> float:
    """Share of the observed points within the tolerance of the surface that faces the camera."""
    distance = Surface.through(problem.model, material).nearest(problem.evidence.partners)[0]
    return float((distance <= problem.config.tolerance).mean())


def estimate_unit(found: Correspondences) -> float:
    """Length of a scene unit in the unit of the correspondences: distances within a segment hardly change."""
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(found.labels), size=(2, SCALE_PAIRS))
    rest = np.linalg.norm(found.rest[first] - found.rest[second], axis=1)
    seen = np.linalg.norm(found.points[first] - found.points[second], axis=1)
    usable = (found.labels[first] == found.labels[second]) & (rest > np.median(rest[rest > 0]) / 4)
    if not usable.any():
        raise ValueError(
            f"the network finds only {len(found.labels)} points of the object, too few to tell its size: name the "
            "unit with scene_unit, or isolate the object first"
        )
    return float(np.median(seen[usable] / rest[usable]))
