"""The rope in random states: closed, of one volume, joined at its interfaces, nowhere through itself or the base."""

from itertools import pairwise

import numpy as np
import pytest
from overlapping import check_overlap

from mereo.deformation.maps import jacobian_determinant
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.scenes.registry import load_scene
from mereo_objects import rope

STATES = 100


@pytest.fixture(scope="module")
def states() -> list[SegmentedMesh]:
    scene, rng = load_scene("rope"), np.random.default_rng(1)
    return [scene.sample_state(rng).mesh for _ in range(STATES)]


def rings(mesh: SegmentedMesh) -> np.ndarray:
    """Rims of the rope's cross-sections, segment by segment, from the deformed vertices alone: ``r SIDES 3``."""
    loops = []
    for segment in mesh.segments[1:]:
        disc = 1 + 2 * rope.SIDES
        first, last = segment.vertices[1 + rope.SIDES : disc], segment.vertices[disc + 1 + rope.SIDES : 2 * disc]
        loops += [first, *segment.vertices[2 * disc :].reshape(-1, rope.SIDES, 3), last]
    return np.stack(loops)


def test_rest_pose_is_a_base_and_eight_pieces_of_one_length() -> None:
    mesh = rope.rest_mesh()
    assert mesh.names == ("base", *(f"segment_{number}" for number in range(1, 9)))
    assert len(set(mesh.colors)) == 9
    volumes = np.array([segment.volume for segment in mesh.segments[1:]])
    sides = rope.SIDES
    prism = rope.SEGMENT_LENGTH * rope.RADIUS**2 * sides / 2 * np.sin(2 * np.pi / sides)
    assert np.allclose(volumes, prism)
    size = np.prod(rope.BASE_SIZE)
    assert 0.85 * size < mesh.segments[0].volume < size
    check_overlap(mesh)


def test_states_stay_closed_and_nearly_keep_their_volumes(states: list[SegmentedMesh]) -> None:
    """Pappus: a sweep whose centroid follows the curve keeps the volume, up to the mesh's chords."""
    rest = [segment.volume for segment in rope.rest_mesh().segments]
    for mesh in states[::5]:
        mesh.check()
    for mesh in states:
        ratio = np.array([segment.volume for segment in mesh.segments]) / rest
        assert ratio[0] == 1.0
        assert ratio.min() > 0.97 and ratio.max() < 1.03


def test_neighbours_share_their_interface_exactly(states: list[SegmentedMesh]) -> None:
    """Same vertices to the last bit and the same triangles, seen from the other side."""
    disc = 1 + 2 * rope.SIDES
    for mesh in [rope.rest_mesh(), *states]:
        for left, right in pairwise(mesh.segments[1:]):
            assert np.array_equal(left.vertices[disc : 2 * disc], right.vertices[:disc])
    segment = states[0].segments[1]  # all have the same faces, which no deformation changes
    assert all(np.array_equal(other.faces, segment.faces) for mesh in states for other in mesh.segments[1:])
    end = {turned(face - disc) for face in segment.faces if face.min() >= disc and face.max() < 2 * disc}
    start = {turned(face[::-1]) for face in segment.faces if face.max() < disc}
    assert len(start) == 3 * rope.SIDES and start == end


def turned(face: np.ndarray) -> tuple[int, ...]:
    """The same triangle from its lowest vertex on."""
    return tuple(np.roll(face, -face.argmin()).tolist())


def test_rope_does_not_pass_through_itself(states: list[SegmentedMesh]) -> None:
    """Cross-sections more than a half turn apart along the rope are more than a diameter apart in space."""
    for mesh in states:
        centers = rings(mesh).mean(axis=1)
        place = np.repeat(np.arange(rope.SEGMENTS), rope.RINGS + 1) * rope.SEGMENT_LENGTH
        place = place + np.tile(np.linspace(0, rope.SEGMENT_LENGTH, rope.RINGS + 1), rope.SEGMENTS)
        far = np.abs(place[:, None] - place) > np.pi / rope.MAX_BEND
        assert np.linalg.norm(centers[:, None] - centers, axis=-1)[far].min() > 2.3 * rope.RADIUS


def test_segments_overlap_neither_each_other_nor_the_base(states: list[SegmentedMesh]) -> None:
    """Every vertex is checked against the solids of all segments that it does not belong to or touch."""
    for mesh in states[:10]:
        solids = Solids(mesh)
        for index in range(len(mesh.segments)):
            others = [mesh.segments[i].vertices for i in range(len(mesh.segments)) if abs(i - index) > 1]
            assert not solids.inside(index, np.concatenate(others)).any()
    for mesh in states[:2]:
        check_overlap(mesh)


def test_only_the_rope_moves_and_it_leaves_the_base_at_a_right_angle(states: list[SegmentedMesh]) -> None:
    rest = rope.rest_mesh()
    for mesh in states:
        assert np.array_equal(mesh.segments[0].vertices, rest.segments[0].vertices)
        assert np.abs(rings(mesh)[0] - rings(rest)[0]).max() < 0.02


def test_rope_keeps_its_length_and_round_section(states: list[SegmentedMesh]) -> None:
    for mesh in states:
        loops = rings(mesh)
        centers = loops.mean(axis=1)
        assert np.abs(np.linalg.norm(loops - centers[:, None], axis=-1) / rope.RADIUS - 1).max() < 0.01
        assert np.isclose(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum(), rope.LENGTH, rtol=0.01)


def test_jacobian_is_positive_in_the_whole_rope() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        x, angle, radius = rng.uniform([0, 0, 0], [rope.LENGTH, 2 * np.pi, rope.RADIUS], size=(500, 3)).T
        points = np.stack([x, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        determinant = jacobian_determinant(rope.sample_deformations(rng)[1], points)
        # one minus curvature times offset, the centreline's speed being one
        assert determinant.min() > 1 - rope.MAX_BEND * rope.RADIUS - 0.05
        assert determinant.max() < 1 + rope.MAX_BEND * rope.RADIUS + 0.05


def test_states_vary_and_coil(states: list[SegmentedMesh]) -> None:
    ends = np.stack([rings(mesh)[-1].mean(axis=0) for mesh in states])
    assert ends.std(axis=0).min() > 5.0
    reach = np.linalg.norm(ends, axis=1)
    assert reach.min() < 25.0 and reach.max() > 55.0  # from coiled up to nearly straight


def test_a_state_follows_from_its_generator_alone() -> None:
    scene = rope.scene()
    first, again, other = (scene.sample_state(np.random.default_rng(seed)).mesh for seed in (5, 5, 6))
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(first.segments, again.segments, strict=True))
    assert not np.array_equal(first.segments[8].vertices, other.segments[8].vertices)


def test_clearance_test_sees_a_rope_through_itself_or_the_base() -> None:
    straight = rope.NODES[:, None] * np.array([1.0, 0, 0])
    assert rope.is_clear(straight)
    hairpin = np.where((rope.NODES < 32)[:, None], straight, np.array([64.0, 3.0, 0]) - straight)
    assert not rope.is_clear(hairpin)
    back_into_base = np.where((rope.NODES < 10)[:, None], straight, np.array([20.0, 5.0, 0]) - straight)
    assert not rope.is_clear(back_into_base)


def test_rope_leaves_its_plane_as_far_as_it_moves_in_it() -> None:
    rng = np.random.default_rng(4)
    centers = np.stack([rope.sample_centerline(rng) for _ in range(600)])
    tangents = np.diff(centers, axis=1)
    sideways, forwards = (np.abs(tangents[..., axis]).mean() for axis in (1, 2))
    assert 0.9 < forwards / sideways < 1.1  # half as large where only sideways bends are at full strength
    reach = np.quantile(np.abs(centers[:, :, 1:]).max(axis=1), [0.5, 0.9], axis=0)
    assert np.allclose(reach[:, 1] / reach[:, 0], 1.0, atol=0.12)


def test_centerline_bends_as_it_is_told() -> None:
    """A constant bend in any direction is a circle in that direction's plane."""
    for direction in (0.0, 0.7, np.pi / 2, 3.0):
        toward = np.array([0.0, np.cos(direction), np.sin(direction)])
        bends = 0.2 * np.outer(toward[1:], np.ones(len(rope.NODES)))
        center = rope.centerline(bends)
        assert np.allclose(np.linalg.norm(center - 5.0 * toward, axis=1), 5.0, atol=0.01)
        assert np.abs(center @ np.cross([1.0, 0.0, 0.0], toward)).max() < 1e-9


def test_coils_keep_their_pitch_in_any_direction() -> None:
    rng, steepest = np.random.default_rng(5), []
    for _ in range(30):
        bends = rope.coil(rng)
        center = rope.centerline(bends)
        tangents = np.diff(center[-40:], axis=0) / rope.NODES[1]
        axis = np.linalg.svd(np.diff(tangents, axis=0))[2][2]  # a helix's normals are across its axis
        rise = np.abs(tangents @ axis)
        assert np.ptp(rise) < 1e-3
        curvature = np.hypot(*bends[:, -1])
        turn = curvature / np.sqrt(1.0 - rise.mean() ** 2)
        assert 4.9 < rise.mean() * 2 * np.pi / turn < 9.1
        steepest.append(np.abs(axis[1:]))
    assert np.array(steepest).max(axis=0).min() > 0.9  # across both ways
