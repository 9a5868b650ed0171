"""The states of a mechanism are those that its scene plays, and its derivatives are theirs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from igl import point_mesh_squared_distance
from numpy.testing import assert_allclose
from robot_files import LAMP, write_gripper
from scipy.spatial.transform import Rotation
from trimesh.creation import icosphere

import mereo
from mereo.fitting.draws.playback import material_moved, shares_of
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.residuals import SampledSurface
from mereo.fitting.search import MechanismTables, tables_of
from mereo.geometry.transforms import rigid, transform_points
from mereo.scenes.mechanism import Mechanism
from mereo.scenes.parameters import played_back, with_frame_joints, with_joints
from mereo.scenes.random_states import STATES_SEED
from mereo.scenes.scene import Scene

TURN = '<limit lower="-2.5" upper="2.5" effort="1" velocity="1"/>'


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


@pytest.fixture(scope="module", params=["lamp", "gripper", "spinning lamp"])
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> mereo.Object:
    """Three joints that turn, one of which another follows, and one without limits."""
    folder = tmp_path_factory.mktemp("robot")
    if request.param == "gripper":
        return mereo.load_object(write_gripper(folder))
    path = folder / "lamp.urdf"
    endless = LAMP.replace(TURN, "").replace('"turn" type="revolute"', '"turn" type="continuous"')
    path.write_text(LAMP if request.param == "lamp" else endless)
    return mereo.load_object(path)


@pytest.fixture(scope="module")
def mechanism(robot: mereo.Object) -> Mechanism:
    model = robot.registrar().states
    assert isinstance(model, Mechanism)
    return model


def played(scene: Scene, mechanism: Mechanism, z: np.ndarray) -> np.ndarray:
    state = played_back(scene, STATES_SEED, shares_of(mechanism.draws(z), mechanism.sizes))
    return material_moved(scene, mechanism.registered, state.deformations)


def test_states_are_those_that_the_scene_plays(robot: mereo.Object, mechanism: Mechanism) -> None:
    for z in mechanism.library[:4].astype(float):
        assert_allclose(mechanism.material(z), played(robot.scene, mechanism, z), atol=1e-4)
    assert_allclose(mechanism.material(np.zeros(mechanism.count)), mechanism.mean, atol=1e-12)


def test_derivatives_are_those_of_the_states(mechanism: Mechanism) -> None:
    z = mechanism.library[1].astype(float)
    rows = mechanism.sparse
    steps = 1e-4 * np.eye(mechanism.count)
    change = (mechanism.positions(z + steps, rows) - mechanism.positions(z - steps, rows)) / 2e-4
    assert_allclose(mechanism.tangent(z, rows), np.moveaxis(change, 0, 2), atol=1e-3)


def test_samples_lie_on_the_surface_of_a_state(mechanism: Mechanism) -> None:
    z = mechanism.library[2].astype(float)
    samples = SampledSurface.of(mechanism, 400)
    position = samples.posed(Posed(np.eye(3), np.zeros(3), z)).position.astype(float)
    vertices = mechanism.material(z)
    assert point_mesh_squared_distance(position, vertices, mechanism.faces)[0].max() < 1e-6
    assert_allclose(samples.every(2).frames(z)[:, 0], position[::2], atol=1e-4)
    change = (samples.frames(z + 1e-2)[:, 0] - samples.frames(z - 1e-2)[:, 0]) / 2e-2
    assert_allclose(samples.tangent(z, np.arange(400)).sum(axis=2), change, atol=0.05)  # in single precision


def test_a_state_is_found_again_from_its_points(mechanism: Mechanism) -> None:
    T = rigid(Rotation.random(random_state=0).as_matrix(), np.arange(3.0))
    for z in mechanism.library[3:6].astype(float):
        material = transform_points(T, mechanism.material(z))
        found, again = mechanism.project(material)
        assert_allclose(transform_points(found, mechanism.material(again)), material, atol=1e-3)


def test_a_joint_that_is_known_stays_where_it_is(robot: mereo.Object, mechanism: Mechanism) -> None:
    first, *others = mechanism.free
    joint = mechanism.chain.joints[first][0]
    value = joint.limits[0] + 0.3 * (joint.limits[1] - joint.limits[0])
    given = {first: value * (1.0 if joint.turns else robot.scene.unit_m)}
    known = with_joints(robot.scene, given)
    narrowed = Mechanism.of(known, mechanism)
    assert isinstance(narrowed, Mechanism) and narrowed.free == tuple(others)
    z = np.full(len(others), 0.4)
    assert_allclose(narrowed.material(z), played(known, narrowed, z), atol=1e-4)
    assert narrowed.registered is mechanism.registered
    moves = replace(mechanism.chain, steps=(*mechanism.chain.steps, (replace(joint, name=""), (0,))))
    with pytest.raises(ValueError, match="with a frame, but the object bends as well: give those that stay"):
        with_frame_joints(replace(robot.scene, sample_deformations=moves), given)


def test_what_bends_has_a_linear_model() -> None:
    soft = mereo.load_object({"ball": icosphere(2)}, deformations="soft")
    assert not isinstance(soft.registrar().states, Mechanism)


def test_a_segment_too_small_for_a_sample_is_left_out_of_the_screening(tmp_path: Path) -> None:
    path = tmp_path / "lamp.urdf"
    path.write_text(LAMP.replace("0.12 0.07 0.05", "0.002 0.002 0.002"))
    tables = tables_of(mereo.load_object(path).registrar().states, 2)
    assert isinstance(tables, MechanismTables) and sorted(tables.segments) == [0, 1, 2]
