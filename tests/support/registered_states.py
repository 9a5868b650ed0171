"""Registrations by modes, to keep and to read again."""

from typing import Any

import numpy as np
from numpy.random import default_rng
from scipy.spatial.transform import Rotation
from toy_scene import toy_scene

from mereo.fitting.registration.registration import Registration
from mereo.geometry.transforms import rigid
from mereo.scenes.statistical_model import StatisticalModel

SCENE = toy_scene()


T = rigid(Rotation.from_rotvec([0.4, -1.1, 0.3]).as_matrix(), np.array([0.013, -0.2, 0.71]))


UNIT = 0.0017
"""A scan in metres, of an object of 40 scene units."""


def placed(model: StatisticalModel, unposed: np.ndarray, **facts: Any) -> Registration:
    material = UNIT * unposed @ T[:3, :3].T + T[:3, 3]
    return Registration(
        model, material, scene_unit=UNIT, unit_known=True, explained=0.97, accepted=True, seconds=0.25, **facts
    )


def by_modes(model: StatisticalModel) -> Registration:
    z = default_rng(3).normal(size=model.count)
    return placed(model, model.material(z), method="modes", z=z)
