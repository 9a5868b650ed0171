"""A scene with a deformation model, its random states, and frames of them as a fit gets them."""

import numpy as np
from numpy import ndarray
from scipy.spatial.transform import Rotation
from toy_scene import Lift, Shear, toy_scene

from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import rigid, transform_points
from mereo.scenes.random_states import state_points
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.depth_sensor import render_depth

SCENE = toy_scene()


IN_FRONT = rigid(Rotation.from_euler("xyz", [25, 30, 10], degrees=True).as_matrix(), np.array([1.0, 2.0, 120.0]))
"""``T_camera_world`` of an object around the world's origin."""


def seen(mesh: SegmentedMesh) -> ndarray:
    """Cloud of a noiseless depth image, from the origin along z."""
    return render_depth(mesh, Camera.from_fov(128, 128, 0.6)).to_points().points


def shown(model: StatisticalModel, excess: float) -> tuple[ndarray, ndarray]:
    """Cloud and material points of a state whose draws are ``excess`` times the scene's bounds, camera frame."""
    shear = Shear(3.0 * excess, 0.3 * excess, 0.2 * excess)
    state = SCENE.deform((shear, shear, shear, Lift(1.0, shear)))
    material = transform_points(IN_FRONT, state_points(state, model.nodes, model.node_labels))
    return seen(state.mesh.transformed(IN_FRONT)), material
