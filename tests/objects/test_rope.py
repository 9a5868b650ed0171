"""The rope in random states: closed, of one volume, joined at its interfaces, nowhere through itself or the base."""

import numpy as np
import pytest

from mereo.geometry.mesh import SegmentedMesh
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


def test_rope_does_not_pass_through_itself(states: list[SegmentedMesh]) -> None:
    """Cross-sections more than a half turn apart along the rope are more than a diameter apart in space."""
    for mesh in states:
        centers = rings(mesh).mean(axis=1)
        place = np.repeat(np.arange(rope.SEGMENTS), rope.RINGS + 1) * rope.SEGMENT_LENGTH
        place = place + np.tile(np.linspace(0, rope.SEGMENT_LENGTH, rope.RINGS + 1), rope.SEGMENTS)
        far = np.abs(place[:, None] - place) > np.pi / rope.MAX_BEND
        assert np.linalg.norm(centers[:, None] - centers, axis=-1)[far].min() > 2.3 * rope.RADIUS


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


def test_states_vary_and_coil(states: list[SegmentedMesh]) -> None:
    ends = np.stack([rings(mesh)[-1].mean(axis=0) for mesh in states])
    assert ends.std(axis=0).min() > 5.0
    reach = np.linalg.norm(ends, axis=1)
    assert reach.min() < 25.0 and reach.max() > 55.0  # from coiled up to nearly straight


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
