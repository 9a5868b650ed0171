"""The human body: what MakeHuman's files say of it, its symmetry, and poses that are refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mereo_objects import human
from mereo_objects._human_joints import JOINTS, NAMES, rotations
from mereo_objects._human_parts import rest_mesh
from mereo_objects._human_skin import PosedBody


@pytest.fixture(autouse=True)
def body(require_asset: Callable[[str], Path]) -> None:
    for name in ("makehuman_base.obj", "makehuman_default.mhskel", "makehuman_default_weights.mhw"):
        require_asset(f"human/{name}")


def posed(**angles_deg: tuple[float, float, float]) -> PosedBody:
    angles = np.zeros((len(JOINTS), 3))
    for name, turns in angles_deg.items():
        angles[NAMES.index(name.replace("_L", ".L").replace("_R", ".R"))] = np.deg2rad(turns)
    return PosedBody(rotations(angles), np.zeros(len(JOINTS)), 1.0)


def test_left_and_right_are_mirror_images_at_rest() -> None:
    segments = {segment.name: segment for segment in rest_mesh().segments}
    for name in ("upper_arm", "forearm", "thigh", "shin"):
        left, right = segments[f"{name}_left"], segments[f"{name}_right"]
        assert left.vertices[:, 0].mean() > 3 and right.volume == pytest.approx(left.volume, rel=0.01)
        gaps = cKDTree(left.vertices).query(right.vertices * [-1.0, 1.0, 1.0])[0]
        assert np.quantile(gaps, 0.9) < 1.0


def test_a_pose_without_angles_changes_nothing() -> None:
    vertices = np.concatenate([segment.vertices for segment in rest_mesh().segments])
    assert np.allclose(posed()(vertices), vertices, atol=1e-9)


def test_a_bent_knee_moves_the_foot_back_and_leaves_the_rest() -> None:
    move = posed(shin_L=(90.0, 0.0, 0.0))
    segments = {segment.name: segment for segment in rest_mesh().segments}
    foot = segments["shin_left"].vertices
    foot = foot[foot[:, 1] < foot[:, 1].min() + 2.0]
    shift = move(foot) - foot
    assert shift[:, 2].max() < -8.0 and shift[:, 1].min() > 5.0
    for name in ("head", "forearm_left", "shin_right"):
        assert np.abs(move(segments[name].vertices) - segments[name].vertices).max() < 0.05


def test_poses_in_which_parts_meet_are_refused() -> None:
    assert human.is_clear(posed())
    assert human.is_clear(posed(thigh_L=(10.0, -60.0, 0.0), shin_L=(90.0, 0.0, 0.0)))
    assert not human.is_clear(posed(upper_arm_L=(-60.0, 0.0, 0.0)))  # through the flank, beyond the limits
    assert not human.is_clear(posed(thigh_L=(-30.0, 0.0, 0.0), thigh_R=(-30.0, 0.0, 0.0)))  # legs crossed
