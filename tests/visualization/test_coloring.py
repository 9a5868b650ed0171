"""What surfaces are coloured by, on shapes where the right numbers are known."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from answers import answer_to
from shapes import ball

import mereo
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh, vertex_normals
from mereo.models.model import Model
from mereo.models.trained import Answer, EncodedCloud
from mereo.models.weights import load_model
from mereo.synthesis.sample_views import load_view
from mereo.visualization.color_scales import (
    ColorScale,
    confidence,
    distance_scale,
    observed_distance,
)
from mereo_viewer.result_page import ask_network, first_point, probe_answer

GREYS = ColorScale("grey", 1.0, 3.0, ((0, 0, 0), (100, 100, 100), (250, 250, 250)), ("low", "high"))


def two_balls(radius: float = 2.0) -> SegmentedMesh:
    return SegmentedMesh((ball((0, 0, 0), radius, "one", 0, level=3), ball((6, 0, 0), radius, "two", 1, level=3)))


def test_a_scale_is_linear_between_its_stops_and_vertex_normals_of_a_ball_point_outward() -> None:
    values = np.array([-5.0, 1.0, 1.5, 2.0, 2.5, 3.0, 9.0, np.nan])
    assert GREYS.colors(values)[:, 0].tolist() == [0, 0, 50, 100, 175, 250, 250, 128]
    segment = ball((1, 2, 3), 2.0, "one", 0, level=3)
    np.testing.assert_allclose(vertex_normals(segment), (segment.vertices - [1, 2, 3]) / 2.0, atol=0.02)


def test_confidence_is_the_drop_of_probability_across_the_surface() -> None:
    """A model that is certain of one ball's border, and says one half everywhere near the other's."""

    def ask(points: np.ndarray) -> Answer:
        inside = (np.linalg.norm(points, axis=1) < 2.0).astype(float)
        unsure = 0.5 * (np.linalg.norm(points - [6, 0, 0], axis=1) < 3.0)
        probability = np.stack([1 - inside - unsure, inside, unsure], axis=1)
        nothing = np.zeros(len(points))
        return Answer(probability.argmax(axis=1).astype(np.uint8), probability, nothing, np.zeros_like(points))

    sure, guessed = confidence(two_balls(), ask)
    np.testing.assert_array_equal(sure, 1.0)
    np.testing.assert_array_equal(guessed, 0.0)


def test_distance_to_what_was_observed_tells_seen_from_guessed() -> None:
    mesh = two_balls()
    one, two = observed_distance(mesh, mesh.segments[0].vertices)
    np.testing.assert_array_equal(one, 0.0)
    assert two.min() == pytest.approx(2.0, abs=0.05)
    assert two.max() == pytest.approx(6.0, abs=0.05)
    scale = distance_scale([one, two], " mm")
    assert 0 < scale.high <= 6 and scale.words[1].endswith(" mm, guessed")
    lost = replace(mesh.segments[1], vertices=np.zeros((0, 3)), faces=np.zeros((0, 3), dtype=np.int64))
    mesh = SegmentedMesh((mesh.segments[0], lost))
    assert [len(v) for v in observed_distance(mesh, np.zeros((1, 3)))] == [len(mesh.segments[0].vertices), 0]
    assert distance_scale([np.zeros(0)], "").high > 0


def test_a_ray_meets_the_nearest_surface_that_is_shown() -> None:
    mesh, origin, along = two_balls(), np.array([-9.0, 0.01, 0.02]), np.array([2.0, 0.0, 0.0])
    np.testing.assert_allclose(first_point(mesh, origin, along, [True, True]), [-2.0, 0.01, 0.02], atol=0.05)
    np.testing.assert_allclose(first_point(mesh, origin, along, [False, True]), [4.0, 0.01, 0.02], atol=0.05)
    assert first_point(mesh, origin, along, [False, False]) is None
    assert first_point(mesh, origin, -along, [True, True]) is None


@pytest.fixture
def encoded(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The points of every cloud that a model encodes."""
    clouds: list[np.ndarray] = []
    encode = Model.encode

    def counted(model: Model, cloud: PointCloud) -> EncodedCloud:
        clouds.append(np.asarray(cloud.points))
        return encode(model, cloud)

    monkeypatch.setattr(Model, "encode", counted)
    return clouds


def test_no_cloud_is_encoded_twice(encoded: list[np.ndarray], tmp_path: Path) -> None:
    cloud = load_view("rope").depth.to_points()
    mereo.reconstruct(cloud, load_model("rope"), "network", resolution=16).save(tmp_path / "result")
    assert len(encoded) == 1
    model = load_model("rope")
    answer = answer_to(cloud, model, None, 16)
    probe_answer(answer, cloud.points[:5])
    confidence(answer.reconstruction.surfaces, partial(ask_network, answer))
    assert len(encoded) == 2, "once for each"
