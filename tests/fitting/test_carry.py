"""Carrying what is defined in the rest model to where the object is: theorems."""

from dataclasses import replace

import numpy as np
import pytest
from analytic import untrained
from carried_cases import SCENE, T, registered
from scipy.spatial.transform import Rotation
from toy_scene import Lift, Shear

from mereo.deformation.maps import Deformation
from mereo.fitting.registration.carry import Placed, carry, local_rotations, place
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration, nearest_labels
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points
from mereo.io.attachments import Attachment, PoseTable, Positions, Surfaces
from mereo.scenes.random_states import state_points
from mereo.scenes.scene import State
from mereo.scenes.statistical_model import StatisticalModel


@pytest.fixture(scope="module")
def registrar(model: StatisticalModel) -> Registrar:
    return Registrar(untrained(model.rest.names, "mine"), model)


@pytest.fixture(scope="module")
def state() -> State:
    shear = Shear(3.0, 0.3, 0.1)
    return SCENE.deform((shear, shear, shear, Lift(2.0, shear)))


@pytest.fixture(scope="module")
def bent(model: StatisticalModel, state: State) -> Registration:
    return registered(model, transform_points(T, state_points(state, model.nodes, model.node_labels)))


def table(points: np.ndarray, rotations: np.ndarray | None = None) -> PoseTable:
    rows = tuple(("0",) * 7 for _ in points)
    return PoseTable(("x", "y", "z", "qx", "qy", "qz", "qw"), rows, ",", points, rotations)


def placed_one(registrar: Registrar, content: Surfaces | Positions | PoseTable, frame: str = "scene") -> Placed:
    return place([Attachment("one", content)], registrar, frame)[0]  # type: ignore[arg-type]


def test_a_rigid_pose_carries_everything_rigidly(model: StatisticalModel, registrar: Registrar) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(*model.rest.bounds, size=(200, 3)) * 1.3
    turns = Rotation.random(200, rng=rng).as_matrix()
    here = registered(model, transform_points(T, model.rest_points), 0.001)
    found = carry(placed_one(registrar, table(points, turns)), here)
    np.testing.assert_allclose(found.content.points, 0.001 * transform_points(T, points), atol=1.5e-5)
    assert found.content.rotations is not None
    np.testing.assert_allclose(found.content.rotations, T[:3, :3] @ turns, atol=5e-3)
    labels = Solids(model.rest).label(points)
    distance = Solids(model.rest).nearest(points).distance * (labels == 0)
    assert found.inside == (labels > 0).sum() and 0 < found.inside < 200
    assert found.farthest == pytest.approx(0.001 * distance.max())


def test_interior_points_follow_the_scenes_own_maps(registrar: Registrar, state: State, bent: Registration) -> None:
    points = np.random.default_rng(1).uniform(*SCENE.rest.bounds, size=(500, 3))
    labels = Solids(SCENE.rest).label(points)
    found = carry(placed_one(registrar, Positions(points)), bent)
    for label in range(1, 5):
        truth = transform_points(T, state.deformations[label - 1](points[labels == label]))
        assert np.linalg.norm(found.content.points[labels == label] - truth, axis=1).max() < 0.1


def polar(motion: Deformation, points: np.ndarray) -> np.ndarray:
    """Rotation of a map's Jacobian at points, by scipy-free polar decomposition of central differences."""
    columns = [(motion(points + e) - motion(points - e)) / 2e-4 for e in 1e-4 * np.eye(3)]
    u, _, v = np.linalg.svd(np.stack(columns, axis=2))
    return np.asarray(u @ v)


def test_poses_turn_as_their_surroundings_do(state: State, bent: Registration) -> None:
    points = np.random.default_rng(2).uniform((-15, -4, -3), (15, 4, 3), size=(50, 3))
    shares = np.eye(4)[nearest_labels(bent.rest_solids, points) - 1]
    found = local_rotations(bent, points, shares)
    truth = T[:3, :3] @ polar(state.deformations[0], points)
    angle = Rotation.from_matrix(found @ truth.transpose(0, 2, 1)).magnitude()
    assert np.rad2deg(angle).max() < 2.0 and np.linalg.det(found).min() > 0.999
    still = np.rad2deg(Rotation.from_matrix(truth @ T[:3, :3].T).magnitude())
    assert np.median(still) > 3.0  # it has turned by more than the tolerance


def test_a_surface_outside_does_not_tear(registrar: Registrar, bent: Registration) -> None:
    """It passes from the boxes' surroundings to the ball's, which is lifted by 2 units: edges of 0.9 stay under 2."""
    corners = np.array([[-15.0, 7, -5], [15, 7, -5], [15, 7, 16], [-15, 7, 16]])
    plane = Segment("plan", (1, 2, 3), corners, np.array([[0, 1, 2], [0, 2, 3]]))
    placed = placed_one(registrar, Surfaces(SegmentedMesh((plane,))))
    assert isinstance(placed.content, Surfaces) and (placed.distance > 0).all()
    # shares fall with the fourth power of the distance
    distance = np.stack([Solids(SCENE.rest).segment_distance(i, placed.content.points) for i in range(4)], axis=1)
    relative, nearer = placed.shares / placed.shares.max(axis=1, keepdims=True), distance.min(axis=1, keepdims=True)
    np.testing.assert_allclose(relative, (nearer / distance) ** 4, atol=2e-3)
    found, faces = carry(placed, bent).content.points, placed.content.mesh.segments[0].faces
    nearest = bent.to_camera(placed.content.points)

    def longest(points: np.ndarray) -> float:
        return float(np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2).max())

    assert longest(placed.content.points) <= 0.9 + 1e-9
    assert longest(found) < 2.0 < longest(nearest)


def test_far_away_things_are_refused(registrar: Registrar) -> None:
    points = np.random.default_rng(0).uniform(*SCENE.rest.bounds, size=(100, 3))
    with pytest.raises(
        ValueError, match="of 100 points of one are farther from the object than it is long .* bring it"
    ):
        placed_one(registrar, Positions(1000 * points))
    assert placed_one(registrar, Positions(points)).distance.max() < 20


def test_the_frame_of_the_files_must_be_known(registrar: Registrar) -> None:
    older = replace(registrar, model=replace(registrar.model, source_frame=None))
    points = Positions(SCENE.rest.segments[0].vertices)
    with pytest.raises(ValueError, match="do not say how the object's own files lie in the scene: .* with --scene, or"):
        placed_one(older, points, "source")
    np.testing.assert_array_equal(placed_one(older, points, "scene").content.points, points.points)
    frame = replace(SCENE, T_scene_source=np.diag([10.0, 10.0, 10.0, 1.0]))
    tenth = Positions(points.points / 10)
    named = placed_one(replace(older, given=frame), tenth, "source")
    np.testing.assert_allclose(named.content.points, points.points)
