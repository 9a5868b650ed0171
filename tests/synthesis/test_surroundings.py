"""Tools, hands and backgrounds: where they are, what they hide, and what of them a wrong mask lets into the cloud."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from shapes import ball, box, one, segment
from toy_scene import toy_scene

from mereo.geometry.camera import Camera
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.scenes.seeds import example_rng
from mereo.synthesis.clutter import BACKGROUND, OBJECT, OCCLUDER, Capsule
from mereo.synthesis.config import GenerateConfig, SamplingConfig, SensorConfig
from mereo.synthesis.depth_sensor import SimulatedView, observe
from mereo.synthesis.examples import sample_view, synthesize

CAMERA = Camera.from_fov(96, 96, np.deg2rad(35))
RAYS = CAMERA.directions().reshape(-1, 3)
OFF = SensorConfig()
SCENE = toy_scene()
PAIR = Solids(SegmentedMesh((ball((-5, 0, 150), 15.0), box((12, -15, 140), (30, 15, 165), color=1))))


def look(seed: int, solids: Solids = PAIR, **terms: float) -> SimulatedView:
    return observe(solids, CAMERA, 0.0, replace(OFF, **terms), np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(5))
def test_rays_hit_a_capsule_where_they_hit_its_triangles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, high = (-30, -30, 100), (30, 30, 160)
    start, end, radius = rng.uniform(low, high), rng.uniform(low, high), rng.uniform(3, 10)
    rows, hits = Capsule(start, end, radius).first_hit(RAYS)
    length = float(np.linalg.norm(end - start))
    mesh = trimesh.creation.capsule(length, radius, count=[128, 128], transform=np.eye(4))
    mesh.apply_translation([0, 0, -mesh.bounds.mean(axis=0)[2]])
    mesh.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], (end - start) / length))
    mesh.apply_translation((start + end) / 2)
    expected = Solids(one(segment(mesh))).first_hit(RAYS)
    distance = np.full(len(RAYS), np.inf)
    distance[rows] = hits.distance
    both = np.isfinite(distance) & np.isfinite(expected.distance)
    assert both.sum() > 100 and (np.isfinite(distance) != np.isfinite(expected.distance)).sum() < 0.03 * both.sum()
    assert np.median(np.abs(distance[both] - expected.distance[both])) < 0.01
    normal = hits.normal / np.linalg.norm(hits.normal, axis=1, keepdims=True)
    assert np.allclose(np.linalg.norm(hits.normal, axis=1), radius)
    assert (np.einsum("ij,ij->i", normal, RAYS[rows]) < 1e-9).all()


def test_a_capsule_without_length_is_a_ball_and_behind_the_camera_nothing() -> None:
    center = np.array([3.0, -4.0, 120.0])
    rows, hits = Capsule(center, center, 10.0).first_hit(RAYS)
    places = RAYS[rows] * hits.distance[:, None]
    assert len(rows) > 100 and np.allclose(np.linalg.norm(places - center, axis=1), 10.0)
    assert len(Capsule(-center, np.array([40.0, 0, -100]), 10.0).first_hit(RAYS)[0]) == 0


BOXES = [
    box(low, low + np.array([20, 12, 15]))
    for low in np.random.default_rng(0).uniform((-40, -40, 90), (20, 20, 190), (8, 3))
]


@pytest.mark.parametrize("part", [ball((-38, 30, 130), 14.0), ball((0, 0, 10), 14.0), *BOXES])
def test_rays_that_are_left_out_would_have_missed(part: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    culled = Solids(one(part)).first_hit(RAYS).distance
    monkeypatch.setattr("mereo.geometry.solids.toward", lambda directions, low, high: np.arange(len(directions)))
    found = Solids(one(part)).first_hit(RAYS).distance
    assert np.isfinite(found).sum() > 50 and np.array_equal(found, culled)


@pytest.mark.parametrize("term", ["tool", "hand"])
def test_occluders_are_in_front_hide_the_object_and_come_from_outside(term: str) -> None:
    clear = look(0)
    depth, hidden, borders = clear.whole.depth, [], 0
    for seed in range(40):
        seen = look(seed, **{term: 1.0})
        occluder = seen.source == OCCLUDER
        over = occluder & (clear.source == OBJECT)
        assert (seen.whole.depth[over] < depth[over]).all() and not seen.mask[occluder].any()
        assert np.array_equal(seen.image.depth, np.where(occluder, 0, depth))
        hidden.append(over.sum())
        edge = np.concatenate([occluder[0], occluder[-1], occluder[:, 0], occluder[:, -1]])
        borders += bool(edge.any())
    assert np.mean(np.array(hidden) > 0) > 0.9 and np.mean(hidden) > 10 and borders >= 38


def test_a_wrong_mask_lets_background_and_tools_in_and_loses_the_object() -> None:
    """As many pixels on both sides of the outline, on average; without a background only losses remain."""
    truth = (look(0).source == OBJECT).sum()
    leaked, lost = [], []
    for seed in range(60):
        seen = look(seed, background=1.0, mask_offset_px=1.0)
        leaked.append((seen.image.valid & (seen.source == BACKGROUND)).sum())
        lost.append(truth - seen.object_points)
    outline = 2 * np.pi * 15 + 96
    assert 0.5 < np.mean(leaked) / np.mean(lost) < 2
    assert 0.1 * outline < np.mean(leaked) < outline
    alone = look(0, mask_offset_px=1.0)
    assert alone.image.valid.sum() == alone.object_points
    stray = [look(seed, tool=1.0, mask_offset_px=1.5) for seed in range(20)]
    assert sum(bool((seen.image.valid & (seen.source == OCCLUDER)).any()) for seen in stray) > 10


def test_the_paper_makes_the_examples_it_always_made() -> None:
    """Values from before there were other sensors, within the single precision of rays: 4e-7 of an image's sum."""
    config = GenerateConfig(image_size=48, points=128, sampling=SamplingConfig(per_segment=16))
    example, view = (make(SCENE, config, example_rng(3, 5)) for make in (synthesize, sample_view))
    assert view.depth.valid.sum() == 243 and view.depth.depth.sum() == pytest.approx(31193.8164, rel=1e-6)
    assert example.normalizer.scale == pytest.approx(0.0489688726, rel=1e-6)
    assert np.allclose(example.cloud[1], [-0.9883676, -0.23809237, 0.19280505], atol=1e-5)
    assert np.allclose(example.queries.positions[0], [-0.70238803, 0.09261255, 0.62152631], atol=1e-5)
