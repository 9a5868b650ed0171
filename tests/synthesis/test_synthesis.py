"""Examples obey the laws they are made by: what is stored can be walked back to the scene it came from."""

import numpy as np
import pytest
from toy_scene import rest_mesh, sample_deformations, toy_scene

from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points
from mereo.scenes.scene import Scene, Workspace
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo.synthesis.examples import Example, View, sample_view, synthesize

SETTINGS = GenerateConfig(sampling=SamplingConfig(per_segment=128))
SCENE = toy_scene()


def example_and_view(index: int, settings: GenerateConfig = SETTINGS) -> tuple[Example, View]:
    """An example and the view it was made from: the view is drawn first, from the same generator."""
    return synthesize(SCENE, settings, example_rng(1, index)), sample_view(SCENE, settings, example_rng(1, index))


@pytest.fixture(scope="module", params=range(3))
def case(request: pytest.FixtureRequest) -> tuple[Example, View]:
    return example_and_view(request.param)


Case = tuple[Example, View]


def test_an_example_can_be_made_again_alone() -> None:
    first, again, other = (synthesize(SCENE, SETTINGS, example_rng(5, index)) for index in (7, 7, 8))
    for name in ("positions", "labels", "distances", "directions", "rest"):
        assert np.array_equal(getattr(first.queries, name), getattr(again.queries, name), equal_nan=name == "rest")
    assert np.array_equal(first.cloud, again.cloud) and first.normalizer.scale == again.normalizer.scale
    assert not np.array_equal(first.queries.positions, other.queries.positions)
    assert example_rng(5, 7).random() != example_rng(7, 5).random()


def test_the_cloud_is_the_depth_image_unprojected_and_normalized(case: Case) -> None:
    example, view = case
    seen = view.depth.to_points().points
    kept = example.normalizer.invert(example.cloud)
    gaps = np.linalg.norm(kept[:, None] - seen[None], axis=-1)
    assert gaps.min(axis=1).max() < 1e-6
    assert len(np.unique(gaps.argmin(axis=1))) == len(kept) == min(len(seen), SETTINGS.points)
    low, high = example.normalizer.apply(seen).min(axis=0), example.normalizer.apply(seen).max(axis=0)
    assert np.isclose((high - low).max(), 2) and np.allclose(low + high, 0)
    _, view = case
    distance = Solids(view.mesh).nearest(view.depth.to_points().points).distance
    # noise is along the ray: never farther from the surface than that, 0.1 in standard deviation
    assert distance.max() < 0.6 and 0.02 < distance.mean() < 0.1


def test_labels_distances_and_directions_are_those_of_the_deformed_segments(case: Case) -> None:
    example, view = case
    queries, solids = example.queries, Solids(view.mesh)
    points = example.normalizer.invert(queries.positions)
    clear = solids.nearest(points).distance > 1e-6
    assert np.array_equal(solids.label(points[clear]), queries.labels[clear])
    assert np.array_equal(queries.distances < 0, queries.labels > 0)
    assert len(queries.labels) == SETTINGS.sampling.total(4)
    queries = example.queries
    foot = queries.positions + np.abs(queries.distances)[:, None] * queries.directions
    assert Solids(view.mesh).nearest(example.normalizer.invert(foot)).distance.max() < 1e-6
    assert np.allclose(np.linalg.norm(queries.directions, axis=1), 1)


def test_rest_coordinates_lead_back_to_the_query_and_lie_in_the_same_segment_at_rest(case: Case) -> None:
    """The theorem: deform(rest) is the query's place in the scene; outside there is no rest."""
    example, view = case
    queries = example.queries
    low, high = SCENE.rest.bounds
    rest = queries.rest * (high - low).max() / 2 + (low + high) / 2
    world = transform_points(view.T_world_camera, example.normalizer.invert(queries.positions))
    assert np.array_equal(np.isnan(queries.rest).any(axis=1), queries.labels == 0)
    for index, deformation in enumerate(view.deformations):
        members = queries.labels == index + 1
        assert members.sum() >= 64
        assert np.abs(deformation(rest[members]) - world[members]).max() < 1e-3
        assert (np.abs(queries.rest[members]) <= 1 + 1e-4).all()
    queries = case[0].queries
    low, high = SCENE.rest.bounds
    inside = queries.labels > 0
    rest = queries.rest[inside] * (high - low).max() / 2 + (low + high) / 2
    solids = Solids(SCENE.rest)
    # faces are flat before and after, the map between them is not: only points beside a face may change sides
    clear = solids.nearest(rest).distance > 0.1
    assert np.array_equal(solids.label(rest[clear]), queries.labels[inside][clear])


def test_views_that_see_too_little_are_drawn_again_and_a_scene_out_of_sight_is_named() -> None:
    far = toy_scene(distance=(20_000.0, 20_001.0))
    with pytest.raises(
        ValueError, match=rf"'toy' showed fewer than {MIN_POINTS} points in 100 random views; its camera"
    ):
        sample_view(far, SETTINGS, example_rng(0, 0))

    def sometimes_tiny(rng: np.random.Generator) -> tuple:
        tiny = bool(rng.random() < 0.5)
        return tuple((lambda p, d=d: 1e-3 * p) if tiny else d for d in sample_deformations(rng))

    scene = Scene("blinking", SegmentedMesh(rest_mesh().segments), sometimes_tiny, Workspace())
    counts = [sample_view(scene, SETTINGS, example_rng(4, index)).depth.valid.sum() for index in range(12)]
    assert min(counts) >= MIN_POINTS
