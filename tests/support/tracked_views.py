"""Views of an object without weights, as a tracker gets them."""

from pathlib import Path

import numpy as np

from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.registration.answer import Answer
from mereo.fitting.search import rotations
from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.io.sensor_frame import SensorFrame
from mereo.models.weights import load_model
from mereo.reconstruction.observation import Observation, find_object, observe
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis import depth_sensor
from mereo.synthesis.clutter import Backdrop, Capsule, Surroundings, farthest
from mereo.synthesis.config import SENSORS
from mereo.synthesis.depth_sensor import SimulatedView

CAMERA = Camera.from_fov(96, 96, 0.5)
PLACE = np.array([1.0, -2.0, 130.0])
AWAY = np.array([0.0, 0.0, 1.0])


def lump_model() -> StatisticalModel:
    """Model of a lobe with a core inside and a tip that lies on it, which bends."""
    found = load_model("tests/golden/lump.safetensors").statistical_model
    assert found is not None
    return found


def mesh_of(model: StatisticalModel, turn: int, share: float = 0.0) -> SegmentedMesh:
    """Segments before the camera, on the way from one state of the library to another."""
    z = ((1 - share) * model.library[3] + share * model.library[4]).astype(np.float64)
    R = rotations(97)[turn]
    posed = Posed(R, PLACE - R @ model.mean.mean(axis=0), z)
    return model.mesh(posed.place(model.material(z)))


def view(mesh: SegmentedMesh, seed: int = 0, occluders: tuple[Capsule, ...] = ()) -> SimulatedView:
    """View before a far wall."""
    solids, rng = Solids(mesh), np.random.default_rng(seed)
    wall = Backdrop(AWAY, farthest(solids, AWAY) + 60.0)
    return depth_sensor.observe(solids, CAMERA, 0.02, SENSORS["paper"], rng, around=Surroundings(occluders, wall))


def bare(seen: SimulatedView) -> Observation:
    """The object's points alone."""
    return observe(seen.image.to_points())


def whole(seen: SimulatedView) -> Observation:
    """All that was measured, with the object's mask."""
    image = seen.image
    return find_object(SensorFrame(Path("simulated"), image.to_points(), None, "camera", image, whole=seen.whole))


def vertices(mesh: SegmentedMesh) -> np.ndarray:
    return np.concatenate([segment.vertices for segment in mesh.segments])


def rms(answer: Answer, mesh: SegmentedMesh) -> float:
    """Root mean square distance of all vertices."""
    return float(np.sqrt(((vertices(answer.surfaces) - vertices(mesh)) ** 2).sum(axis=1).mean()))
