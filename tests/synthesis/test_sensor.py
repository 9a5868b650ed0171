"""Simulated sensors: each term is what its formula says, after a depth camera that is one of closed forms."""

from dataclasses import replace
from math import pi
from statistics import NormalDist

import numpy as np
import pytest
import trimesh
from numpy import ndarray
from numpy.linalg import norm, svd
from numpy.random import default_rng
from shapes import ball, box, one, segment
from toy_scene import toy_scene

from mereo.geometry.camera import Camera
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import unit_rows
from mereo.scenes.seeds import example_rng
from mereo.synthesis.clutter import BACKGROUND, NOTHING, OBJECT, OCCLUDER, Capsule
from mereo.synthesis.config import SENSOR_TERMS, SENSORS, GenerateConfig, SamplingConfig, SensorConfig, SensorModel
from mereo.synthesis.depth_sensor import (
    SimulatedView,
    add_depth_noise,
    axial_std_m,
    dropout_probability,
    lateral_std,
    mix_edges,
    observe,
    quantize,
    render_depth,
    sample_mask,
)
from mereo.synthesis.examples import sample_view, synthesize

CAMERA = Camera.from_fov(96, 96, np.deg2rad(35))
RAYS = CAMERA.directions()
OFF = SensorConfig()
UNIT_M = OFF.metres_per_unit
MODELS = ("structured-light", "time-of-flight")


def wall(z: float, tilt_deg: float = 0.0) -> Solids:
    part = box((-9000, -9000, 0), (9000, 9000, 5))
    cosine = np.cos(np.deg2rad(tilt_deg))
    sine = np.sin(np.deg2rad(tilt_deg))
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    return Solids(one(replace(part, vertices=part.vertices @ turn.T + [0, 0, z])))


def slant(tilt_deg: float) -> ndarray:
    """Angle between each ray and that wall's normal."""
    normal = np.array([np.sin(np.deg2rad(tilt_deg)), 0, np.cos(np.deg2rad(tilt_deg))])
    return np.arccos(np.abs(RAYS @ normal) / norm(RAYS, axis=-1))


def look(solids: Solids, seed: int = 0, noise_std: float = 0.0, **terms: object) -> SimulatedView:
    return observe(solids, CAMERA, noise_std, replace(OFF, **terms), default_rng(seed))  # type: ignore[arg-type]


def test_published_values() -> None:
    """By hand from the papers' formulas: Kinect at 1 m and at 0.4 m and 45 degrees, Kinect v2 at 2 m; pixels."""
    z = np.array([1.0])
    flat = np.zeros(1)
    assert axial_std_m(z, flat) == pytest.approx(0.001884)
    assert axial_std_m(np.array([0.4]), np.array([pi / 4])) == pytest.approx(0.0012 + 0.0001 / np.sqrt(0.4))
    assert axial_std_m(np.array([2.0]), flat, "time-of-flight") == pytest.approx(0.0017)
    assert lateral_std(z, flat) * 585 == pytest.approx(0.8)
    assert lateral_std(z, np.array([pi / 4])) * 585 == pytest.approx(0.835)
    assert lateral_std(np.array([2.0]), flat, "time-of-flight") == pytest.approx(0.0008)
    assert np.isfinite(axial_std_m(np.linspace(0.5, 4, 50), np.full(50, pi / 2))).all()
    dropout = dropout_probability(np.linspace(0, pi / 2, 91), 0.7)  # from 60 degrees on
    assert (dropout[:61] < 1e-9).all() and (np.diff(dropout[60:]) > 0).all() and dropout[-1] == pytest.approx(0.7)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("z, tilt_deg", [(100.0, 0.0), (200.0, 0.0), (400.0, 0.0), (150.0, 60.0), (150.0, 70.0)])
def test_axial_noise_has_the_published_deviation(model: SensorModel, z: float, tilt_deg: float) -> None:
    clean = look(wall(z, tilt_deg)).whole.depth
    noisy = look(wall(z, tilt_deg), model=model, axial=1.0).whole.depth
    score = (noisy - clean) * UNIT_M / axial_std_m(clean * UNIT_M, slant(tilt_deg), model)
    assert abs(score.mean()) < 5 / np.sqrt(score.size)
    assert abs(score.std() - 1) < 5 / np.sqrt(2 * score.size)
    twice = look(wall(z, tilt_deg), model=model, axial=2.0).whole.depth
    assert np.allclose(twice - clean, 2 * (noisy - clean), atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_lateral_noise_reads_depth_beside_the_pixel(model: SensorModel) -> None:
    """On a slanted wall z = c / (n x), so the depth is off by dz/dx = -z^2 nx / c times where the pixel looks."""
    tilt = np.deg2rad(50.0)
    z = 150.0
    clean = look(wall(z, 50.0)).whole.depth
    off = look(wall(z, 50.0), model=model, lateral=1.0).whole.depth - clean
    slope = clean**2 * np.sin(tilt) / (z * np.cos(tilt))
    score = off / (slope * lateral_std(clean * UNIT_M, slant(50.0), model))
    assert abs(score.mean()) < 0.1 and abs(score.std() - 1) < 0.05
    # a wall that faces the camera has the same depth beside the pixel
    facing = look(wall(z), model=model, lateral=1.0).whole.depth
    assert np.allclose(facing, z, rtol=1e-6)


def test_depth_has_the_steps_of_whole_disparities_in_the_image_after_all_noise() -> None:
    z_m = default_rng(0).uniform(0.4, 5.0, size=5000)
    steps = quantize(z_m, 1.0)
    disparity = 351.3 / steps
    assert np.allclose(disparity, np.rint(disparity))
    assert (np.abs(steps - z_m) <= 0.5001 * np.maximum(steps, z_m) ** 2 / 351.3).all()
    assert np.array_equal(quantize(steps, 1.0), steps)
    assert np.array_equal(quantize(np.zeros(3), 1.0), np.zeros(3))
    # Khoshelham and Elberink: 2.85e-5 / cm, so 7 cm at 5 m
    assert np.isclose(np.diff(np.unique(quantize(np.linspace(4.9, 5.1, 10_000), 1.0))).mean(), 0.071, atol=0.001)
    image = look(wall(150.0, 30.0), noise_std=0.1, axial=1.0, quantization=2.0).image
    disparity = 351.3 / 2 / (image.depth * UNIT_M)
    assert np.allclose(disparity, np.rint(disparity), atol=1e-6) and len(np.unique(disparity.round())) > 20


def two_walls() -> Solids:
    near, far = box((-400, -400, 120), (0.5, 400, 125), "near"), box((0.5, -400, 160), (400, 400, 165), "far", 1)
    return Solids(SegmentedMesh((near, far)))


def test_flying_pixels_lie_between_the_two_depths_at_an_edge_and_nowhere_else() -> None:
    clean, flown = look(two_walls()).whole.depth, look(two_walls(), flying=1.0).whole.depth
    moved = flown != clean
    edge = np.flatnonzero(np.abs(np.diff(clean[0])) > 10)[0]
    assert moved[:, edge : edge + 2].all() and moved.sum() == 2 * 96
    assert (flown[moved] > 120).all() and (flown[moved] < 160).all()
    share = (flown[moved] - 120) / 40
    assert abs(share.mean() - 0.5) < 5 / np.sqrt(12 * share.size) and share.min() < 0.1 and share.max() > 0.9
    some = (look(two_walls(), flying=0.3).whole.depth != clean).sum() / moved.sum()
    assert abs(some - 0.3) < 5 * np.sqrt(0.21 / moved.sum())
    for solids in (wall(150.0, 60.0), Solids(one(box((-20, -20, 140), (20, 20, 150))))):
        assert np.array_equal(look(solids, flying=1.0).whole.depth, look(solids).whole.depth)
    depth = np.zeros((5, 5))
    depth[2, 2] = 100.0
    assert np.array_equal(mix_edges(depth, 150.0, 1.0, default_rng(0)), depth)


@pytest.mark.parametrize("tilt_deg", [40.0, 65.0, 72.0])
def test_pixels_drop_out_as_probably_as_their_slant_says(tilt_deg: float) -> None:
    kept = look(wall(150.0, tilt_deg), dropout=0.9).image.valid
    expected = dropout_probability(slant(tilt_deg), 0.9)
    lost = kept.size - kept.sum()
    assert abs(lost - expected.sum()) <= 5 * np.sqrt((expected * (1 - expected)).sum())
    assert kept[expected == 0].all()


def test_holes_take_the_expected_area() -> None:
    """Independent radii: pi r^2 each, on a wall where few reach over the border or overlap."""
    views = [look(wall(150.0), seed, holes=2.0, hole_radius_m=0.02).image.valid for seed in range(150)]
    pixel = 150.0 * UNIT_M / CAMERA.focal_x_px
    expected = 2 * pi * (0.02 / pixel) ** 2
    lost = np.array([(~valid).sum() for valid in views])
    assert 0.8 < lost.mean() / expected < 1.0
    assert abs((lost == 0).mean() - np.exp(-2)) < 5 * np.sqrt(np.exp(-2) / len(views))


def masks(seen: ndarray, count: int = 300, **terms: float) -> ndarray:
    drawn = (dict(zip(SENSOR_TERMS, default_rng(i).spawn(11), strict=True)) for i in range(count))
    return np.stack([sample_mask(seen, replace(OFF, **terms), rngs) for rngs in drawn])


def test_the_mask_is_off_and_shifted_as_probably_as_asked() -> None:
    """Pixels beside a straight edge are half a pixel away from it, the next ones one and a half."""
    seen = np.zeros((60, 60), bool)
    seen[:, :30] = True
    drawn = masks(seen, mask_offset_px=0.8)
    for column, distance in ((30, 0.5), (31, 1.5)):
        expected = 1 - NormalDist().cdf(distance / 0.8)
        assert abs(drawn[:, :, column].mean() - expected) < 0.03  # let in
        assert abs((~drawn[:, :, 59 - column]).mean() - expected) < 0.03  # lost
    # the error is smooth: neighbours along the edge mostly agree
    assert (drawn[:, 1:, 30] == drawn[:, :-1, 30]).mean() > 0.9
    assert np.array_equal(masks(seen, 2)[1], seen)
    v, u = np.mgrid[:61, :61] - 30
    centers = np.array([[u[m].mean(), v[m].mean()] for m in masks(u**2 + v**2 < 200, mask_shift_px=2.0)])
    assert np.allclose(centers.mean(axis=0), 0, atol=0.5) and np.allclose(centers.std(axis=0), 2.0, atol=0.35)


@pytest.mark.parametrize("name", [name for name in SENSORS if name != "paper"])
def test_any_sensor_leaves_later_draws_as_they_were(name: str) -> None:
    solids = Solids(one(ball((0, 0, 150), 25.0)))
    rngs = [default_rng(3) for _ in range(2)]
    for sensor, rng in zip((OFF, SENSORS[name]), rngs, strict=True):  # type: ignore[index]
        observe(solids, CAMERA, 0.1, sensor, rng)
    assert rngs[0].random() == rngs[1].random()


def test_a_term_does_not_change_what_others_draw() -> None:
    alone = look(wall(150.0, 70.0), dropout=0.9).image.valid
    assert np.array_equal(look(wall(150.0, 70.0), dropout=0.9, axial=1.0, flying=0.5).image.valid, alone)
    noise = look(wall(150.0), axial=1.0).whole.depth
    assert np.array_equal(look(wall(150.0), axial=1.0, background=1.0, tool=0.0).whole.depth, noise)


NARROW = Camera.from_fov(96, 96, float(np.deg2rad(30)))


def test_depth_of_a_sphere_is_the_smaller_root_of_the_ray_equation() -> None:
    center = np.array([6.0, -4.0, 150.0])
    radius = 25.0
    depth = render_depth(one(ball(tuple(center), radius, level=5)), NARROW).depth
    rays = NARROW.directions()
    a = (rays**2).sum(-1)
    b = rays @ center
    c = center @ center - radius**2
    discriminant = b**2 - a * c
    expected = np.where(discriminant > 0, (b - np.sqrt(np.maximum(discriminant, 0))) / a, 0.0)
    miss = norm(center - (b / a)[..., None] * rays, axis=-1)  # how far the ray passes from the centre
    well_inside, well_outside = miss < 0.95 * radius, miss > radius
    assert well_inside.sum() > 500 and well_outside.sum() > 500
    assert (depth[well_outside] == 0).all()
    # a face of this sphere is up to radius * 5e-4 below the sphere, seen at a slant of at most 1 / 0.3
    error = depth[well_inside] - expected[well_inside]
    assert error.min() > -1e-3 and error.max() < 0.05


def test_noise_has_its_deviation_on_hits_only_and_neither_loses_nor_invents_any() -> None:
    image = render_depth(one(ball((0, 0, 150), 30.0)), NARROW)
    draws = [add_depth_noise(image, 0.1, default_rng(seed)).depth - image.depth for seed in range(40)]
    noise = np.stack(draws)
    assert (noise[:, ~image.valid] == 0).all()
    hits = noise[:, image.valid]
    assert abs(hits.mean()) < 5 * 0.1 / np.sqrt(hits.size)
    assert abs(hits.std() / 0.1 - 1) < 5 / np.sqrt(2 * hits.size)
    # Gaussian tails: P(|x| > 2 sd) = 0.0455
    assert abs((np.abs(hits) > 0.2).mean() - 0.0455) < 5 * np.sqrt(0.0455 / hits.size)
    assert np.array_equal(add_depth_noise(image, 500.0, default_rng(0)).valid, image.valid)
    for std in (-0.1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"depth noise is .*; it is a standard deviation, finite and at least 0"):
            add_depth_noise(image, std, default_rng(0))


SIGHT = RAYS.reshape(-1, 3)
PAIR = Solids(SegmentedMesh((ball((-5, 0, 150), 15.0), box((12, -15, 140), (30, 15, 165), color=1))))


@pytest.mark.parametrize("seed", range(5))
def test_rays_hit_a_capsule_where_they_hit_its_triangles(seed: int) -> None:
    rng = default_rng(seed)
    low, high = (-30, -30, 100), (30, 30, 160)
    start, end, radius = rng.uniform(low, high), rng.uniform(low, high), rng.uniform(3, 10)
    rows, hits = Capsule(start, end, radius).first_hit(SIGHT)
    length = float(norm(end - start))
    mesh = trimesh.creation.capsule(length, radius, count=[128, 128], transform=np.eye(4))
    mesh.apply_translation([0, 0, -mesh.bounds.mean(axis=0)[2]])
    mesh.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], (end - start) / length))
    mesh.apply_translation((start + end) / 2)
    expected = Solids(one(segment(mesh))).first_hit(SIGHT)
    distance = np.full(len(SIGHT), np.inf)
    distance[rows] = hits.distance
    both = np.isfinite(distance) & np.isfinite(expected.distance)
    assert both.sum() > 100 and (np.isfinite(distance) != np.isfinite(expected.distance)).sum() < 0.03 * both.sum()
    assert np.median(np.abs(distance[both] - expected.distance[both])) < 0.01
    normal = unit_rows(hits.normal)
    assert np.allclose(norm(hits.normal, axis=1), radius)
    assert (np.einsum("ij,ij->i", normal, SIGHT[rows]) < 1e-9).all()


def test_a_capsule_without_length_is_a_ball_and_behind_the_camera_nothing() -> None:
    center = np.array([3.0, -4.0, 120.0])
    rows, hits = Capsule(center, center, 10.0).first_hit(SIGHT)
    places = SIGHT[rows] * hits.distance[:, None]
    assert len(rows) > 100 and np.allclose(norm(places - center, axis=1), 10.0)
    assert len(Capsule(-center, np.array([40.0, 0, -100]), 10.0).first_hit(SIGHT)[0]) == 0


BOXES = [
    box(low, low + np.array([20, 12, 15])) for low in default_rng(0).uniform((-40, -40, 90), (20, 20, 190), (8, 3))
]


@pytest.mark.parametrize("part", [ball((-38, 30, 130), 14.0), ball((0, 0, 10), 14.0), *BOXES])
def test_rays_that_are_left_out_would_have_missed(part: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    culled = Solids(one(part)).first_hit(SIGHT).distance
    monkeypatch.setattr("mereo.geometry.solids.toward", lambda directions, low, high: np.arange(len(directions)))
    found = Solids(one(part)).first_hit(SIGHT).distance
    assert np.isfinite(found).sum() > 50 and np.array_equal(found, culled)


@pytest.mark.parametrize("term", ["tool", "hand"])
def test_occluders_are_in_front_hide_the_object_and_come_from_outside(term: str) -> None:
    clear = look(PAIR, 0)
    depth = clear.whole.depth
    hidden = []
    borders = 0
    for seed in range(40):
        seen = look(PAIR, seed, **{term: 1.0})
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
    truth = (look(PAIR, 0).source == OBJECT).sum()
    leaked, lost = [], []
    for seed in range(60):
        seen = look(PAIR, seed, background=1.0, mask_offset_px=1.0)
        leaked.append((seen.image.valid & (seen.source == BACKGROUND)).sum())
        lost.append(truth - seen.object_points)
    outline = 2 * pi * 15 + 96
    assert 0.5 < np.mean(leaked) / np.mean(lost) < 2
    assert 0.1 * outline < np.mean(leaked) < outline
    alone = look(PAIR, 0, mask_offset_px=1.0)
    assert alone.image.valid.sum() == alone.object_points
    stray = [look(PAIR, seed, tool=1.0, mask_offset_px=1.5) for seed in range(20)]
    assert sum(bool((seen.image.valid & (seen.source == OCCLUDER)).any()) for seen in stray) > 10


def test_the_paper_makes_the_examples_it_always_made() -> None:
    """Values from before there were other sensors, within the single precision of rays: 4e-7 of an image's sum."""
    config = GenerateConfig(image_size=48, points=128, sampling=SamplingConfig(per_segment=16))
    example, view = (make(toy_scene(), config, example_rng(3, 5)) for make in (synthesize, sample_view))
    assert view.depth.valid.sum() == 243 and view.depth.depth.sum() == pytest.approx(31193.8164, rel=1e-6)
    assert example.normalizer.scale == pytest.approx(0.0489688726, rel=1e-6)
    assert np.allclose(example.cloud[1], [-0.9883676, -0.23809237, 0.19280505], atol=1e-5)
    assert np.allclose(example.queries.positions[0], [-0.70238803, 0.09261255, 0.62152631], atol=1e-5)


def test_a_background_is_behind_everything_and_outside_a_true_mask() -> None:
    vertices = PAIR.mesh.merged()[0]
    clear = look(PAIR)
    for seed in range(10):
        seen = look(PAIR, seed, background=1.0)
        assert (seen.source != NOTHING).all() and np.array_equal(seen.image.depth, clear.image.depth)
        plane = seen.source == BACKGROUND
        points = (seen.whole.depth[..., None] * RAYS)[plane]
        center = points.mean(axis=0)
        normal = svd(points - center, full_matrices=False)[2][2]
        normal *= np.sign(normal[2])
        assert normal[2] > np.cos(pi / 4) - 1e-9
        gap = (center - vertices) @ normal
        assert -1e-6 < gap.min() < 0.05 / UNIT_M + 1e-6
