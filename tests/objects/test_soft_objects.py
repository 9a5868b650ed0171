"""Rope, human and sheet: what deforms stays whole, and states in which it meets itself are refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.random import default_rng
from scipy.spatial import cKDTree

from mereo.deformation.maps import Deformation, jacobian
from mereo.geometry.conventions import Triple
from mereo.geometry.mesh import SegmentedMesh
from mereo.scenes.registry import load_scene
from mereo_objects import human, rope, sheet
from mereo_objects._human_joints import JOINTS, NAMES, rotations
from mereo_objects._human_parts import rest_mesh
from mereo_objects._human_skin import PosedBody
from mereo_objects._sheet_parts import THICKNESS, middle_points

STATES = 100


@pytest.fixture(scope="module")
def states() -> list[SegmentedMesh]:
    scene = load_scene("rope")
    rng = default_rng(1)
    return [scene.sample_state(rng).mesh for _ in range(STATES)]


def rings(mesh: SegmentedMesh) -> np.ndarray:
    """Rims of the rope's cross-sections, segment by segment, from the deformed vertices alone: ``r SIDES 3``."""
    loops = []
    for segment in mesh.segments[1:]:
        disc = 1 + 2 * rope.SIDES
        first, last = segment.vertices[1 + rope.SIDES : disc], segment.vertices[disc + 1 + rope.SIDES : 2 * disc]
        loops += [first, *segment.vertices[2 * disc :].reshape(-1, rope.SIDES, 3), last]
    return np.stack(loops)


def test_rope_does_not_pass_through_itself(states: list[SegmentedMesh]) -> None:
    """Cross-sections more than a half turn apart along the rope are more than a diameter apart in space."""
    for mesh in states:
        centers = rings(mesh).mean(axis=1)
        place = np.repeat(np.arange(rope.SEGMENTS), rope.RINGS + 1) * rope.SEGMENT_LENGTH
        place = place + np.tile(np.linspace(0, rope.SEGMENT_LENGTH, rope.RINGS + 1), rope.SEGMENTS)
        far = np.abs(place[:, None] - place) > np.pi / rope.MAX_BEND
        assert norm(centers[:, None] - centers, axis=-1)[far].min() > 2.3 * rope.RADIUS


def test_rope_leaves_its_base_at_a_right_angle_and_keeps_its_length_and_round_section(
    states: list[SegmentedMesh],
) -> None:
    rest = rope.rest_mesh()
    for mesh in states:
        loops = rings(mesh)
        assert np.array_equal(mesh.segments[0].vertices, rest.segments[0].vertices)
        assert np.abs(loops[0] - rings(rest)[0]).max() < 0.02
        centers = loops.mean(axis=1)
        assert np.abs(norm(loops - centers[:, None], axis=-1) / rope.RADIUS - 1).max() < 0.01
        assert np.isclose(norm(np.diff(centers, axis=0), axis=1).sum(), rope.LENGTH, rtol=0.01)


def test_states_vary_and_coil(states: list[SegmentedMesh]) -> None:
    ends = np.stack([rings(mesh)[-1].mean(axis=0) for mesh in states])
    assert ends.std(axis=0).min() > 5.0
    reach = norm(ends, axis=1)
    assert reach.min() < 25.0 and reach.max() > 55.0  # from coiled up to nearly straight


def test_clearance_test_sees_a_rope_through_itself_or_the_base() -> None:
    straight = rope.NODES[:, None] * np.array([1.0, 0, 0])
    assert rope.is_clear(straight)
    for turn, back in ((32, [64.0, 3.0, 0]), (10, [20.0, 5.0, 0])):  # a hairpin, and back into the base
        assert not rope.is_clear(np.where(rope.NODES[:, None] < turn, straight, back - straight))


def test_rope_leaves_its_plane_as_far_as_it_moves_in_it() -> None:
    rng = default_rng(4)
    centers = np.stack([rope.sample_centerline(rng) for _ in range(600)])
    tangents = np.diff(centers, axis=1)
    sideways, forwards = (np.abs(tangents[..., axis]).mean() for axis in (1, 2))
    assert 0.9 < forwards / sideways < 1.1  # half as large where only sideways bends are at full strength
    reach = np.quantile(np.abs(centers[:, :, 1:]).max(axis=1), [0.5, 0.9], axis=0)
    assert np.allclose(reach[:, 1] / reach[:, 0], 1.0, atol=0.12)


# --- human ------------------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def body(require_asset: Callable[[str], Path]) -> None:
    for name in ("makehuman_base.obj", "makehuman_default.mhskel", "makehuman_default_weights.mhw"):
        require_asset(f"human/{name}")


def posed(**angles_deg: Triple) -> PosedBody:
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


def test_a_bent_knee_moves_the_foot_back_and_leaves_the_rest() -> None:
    move = posed(shin_L=(90.0, 0.0, 0.0))
    segments = {segment.name: segment for segment in rest_mesh().segments}
    vertices = rest_mesh().merged()[0]
    assert np.allclose(posed()(vertices), vertices, atol=1e-9)  # without angles nothing moves
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


# --- sheet ------------------------------------------------------------------------------------------------------------


def underside_share(deformation: Deformation) -> float:
    """How much of the sheet shows its other side from above than the rest does."""
    _, matrix = jacobian(deformation, middle_points())
    normals = np.cross(matrix[:, :, 0], matrix[:, :, 1])
    up = normals[:, 2] / norm(normals, axis=1)
    return float(min((up < -0.2).mean(), (up > 0.2).mean()))


def first_of_kind(kind: str, seed: int) -> Deformation:
    rng = default_rng(seed)
    return next(found for found in iter(lambda: sheet.sample_deformation(rng, kind), object()) if found is not None)


@pytest.mark.parametrize("kind", sheet.KINDS[1:])
def test_folds_and_rolls_turn_part_of_the_sheet_over(kind: str) -> None:
    shares = [underside_share(first_of_kind(kind, seed)) for seed in range(8)]
    assert np.median(shares) > 0.05 and max(shares) > 0.15


def test_a_sheet_that_lies_on_itself_is_refused() -> None:
    flat = middle_points()
    assert sheet.is_clear(flat)
    folded = np.where(flat[:, :1] > 0, flat * [-1.0, 1.0, 1.0] + [0.0, 0.0, THICKNESS], flat)
    assert not sheet.is_clear(folded)
