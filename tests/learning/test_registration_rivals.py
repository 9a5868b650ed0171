"""The rivals of benchmarks/registration_rivals.py are called as their authors mean it: each finds what it can find."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mereo.geometry.transforms import rigid, transform_points
from mereo.scenes.statistical_model import StatisticalModel

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from rivals.frames import Frame, surface_points
from rivals.methods import atlas_cpd, deformable_cpd, icp, library, rigid_cpd, stay
from rivals.settings import RIVALS

POSE = rigid(Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix(), np.array([3.0, -2.0, 90.0]))


@pytest.fixture(scope="module")
def model(toy_model: StatisticalModel) -> StatisticalModel:
    return toy_model


def started(model: StatisticalModel, shape: np.ndarray, cloud: np.ndarray, T: np.ndarray) -> Frame:
    empty = Frame(model, cloud, shape, np.eye(3), surface_points(model))
    return empty.started(shape, T)


def off(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth, axis=1).max())


def nearby() -> np.ndarray:
    turned = POSE.copy()
    turned[:3, :3] = Rotation.from_rotvec([0.0, 0.02, 0.01]).as_matrix() @ POSE[:3, :3]
    turned[:3, 3] += [0.2, -0.1, 0.2]
    return turned


def test_icp_finds_a_rigid_motion(model: StatisticalModel) -> None:
    pytest.importorskip("small_gicp", reason="small_gicp is not installed: pip install 'mereo[align]'")
    truth = transform_points(POSE, model.rest_points)
    frame = started(model, model.rest_points, truth[surface_points(model)], nearby())
    assert off(frame.posed, truth) > 0.3
    assert off(icp(frame, RIVALS["ICP"].default).material, truth) < 0.1


def test_rigid_cpd_without_scale_finds_a_rigid_motion(model: StatisticalModel) -> None:
    pytest.importorskip("rustcpd", reason="rustcpd is not installed: pip install rustcpd")
    frame = started(model, model.rest_points, np.empty((0, 3)), nearby())
    truth = transform_points(POSE, model.rest_points)
    frame = replace(frame, cloud=truth[frame.source(500, False)])
    settings = RIVALS["rigid CPD"].default | {"scale": False, "tolerance": 1e-9, "max_iterations": 500}
    assert off(rigid_cpd(frame, settings).material, truth) < 0.01


def test_atlas_cpd_finds_a_state_of_the_model(model: StatisticalModel) -> None:
    pytest.importorskip("rustcpd", reason="rustcpd is not installed: pip install rustcpd")
    frame = started(model, model.mean, np.empty((0, 3)), POSE)
    z = np.random.default_rng(0).normal(size=model.count)
    truth = transform_points(POSE, model.material(z))
    frame = replace(frame, cloud=truth[frame.source(500, False)])
    settings = RIVALS["atlas CPD"].default | {"scale": False, "lambda_regularization": 1e-6, "tolerance": 1e-9}
    assert off(stay(frame, settings).material, truth) > 0.5
    assert off(atlas_cpd(frame, settings).material, truth) < 0.05


def test_all_points_follow_deformable_cpd_as_its_own_do(model: StatisticalModel) -> None:
    """Ours at the source points is what the library answers, and the other library answers the same everywhere."""
    pycpd = pytest.importorskip("pycpd", reason="pycpd is not installed: pip install pycpd")
    pytest.importorskip("rustcpd", reason="rustcpd is not installed: pip install rustcpd")
    cloud = transform_points(POSE, model.material(np.ones(model.count)))[::7]
    frame = started(model, model.rest_points, cloud, POSE)
    chosen = frame.source(200, False)
    source, target = frame.normalized(frame.posed[chosen]), frame.normalized(cloud)
    moved, _ = pycpd.DeformableRegistration(X=target, Y=source, beta=0.7, w=0.1).register()
    settings = RIVALS["deformable CPD"].default | {"beta": 0.7, "count": 200, "w": 0.1}
    found = deformable_cpd(frame, settings).material
    np.testing.assert_allclose(found[chosen], frame.restored(moved), atol=1e-9)
    np.testing.assert_allclose(found, deformable_cpd(frame, settings | {"fast": True}).material, atol=1e-9)


def test_facing_points_turn_with_the_object(model: StatisticalModel) -> None:
    """Half a turn of the object about itself shows the other faces, so hardly a vertex is seen in both."""
    frame = started(model, model.rest_points, np.empty((0, 3)), POSE)
    axis = frame.center / np.linalg.norm(frame.center)
    side = np.cross(axis, [0.0, 1.0, 0.0])
    turn = Rotation.from_rotvec(np.pi * side / np.linalg.norm(side)).as_matrix()
    other = replace(frame, posed=(frame.posed - frame.center) @ turn.T + frame.center)
    here, there = (set(f.source(10_000, True).tolist()) for f in (frame, other))
    assert here | there == set(frame.surface.tolist())
    assert len(here & there) < 0.25 * len(frame.surface)


def test_a_missing_rival_is_named_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycpd", None)
    with pytest.raises(ImportError, match=r"pycpd, a rival of this benchmark, .*: pip install pycpd"):
        library("pycpd")
