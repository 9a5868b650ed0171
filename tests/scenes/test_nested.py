"""A segment inside a segment: every rule of docs/method.md, on balls whose answers are in closed form."""

from math import pi

import numpy as np
import pytest
from analytic import ball as distance_to_ball
from analytic import logits_of
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator, default_rng
from numpy.testing import assert_allclose
from overlapping import check_overlap
from scipy.spatial import cKDTree
from shapes import ball, box
from toy_scene import Shear

from mereo.deformation.maps import Deformation
from mereo.geometry.conventions import Triple
from mereo.geometry.mesh import Nested, SegmentedMesh
from mereo.geometry.mesh_check import overlaps
from mereo.geometry.solids import Solids, signed_distance_and_direction
from mereo.geometry.transforms import transform_points, unit_rows
from mereo.reconstruction.isosurfaces import extract
from mereo.scenes.rest_pose import TEMPLATE_NODES, TEMPLATE_REACH, rest_distances, rest_frame
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo.synthesis.examples import sample_view, synthesize
from mereo.synthesis.query_sampling import sample_queries, sort_sample

CORE, ORGAN = ((2.0, 0.0, 0.0), 2.6), ((0.0, 0.0, 0.0), 5.0)
"""Centre and radius; the core comes as near as 0.4 to the organ's surface."""


def organ(nested: Nested = (("core", "organ"),)) -> SegmentedMesh:
    return SegmentedMesh((ball(*CORE, "core", 0), ball(*ORGAN, "organ", 1)), nested)


def onion() -> SegmentedMesh:
    balls = [ball((0, 0, 0), radius, name, i) for i, (name, radius) in enumerate((("a", 1.0), ("b", 2.0), ("c", 3.0)))]
    return SegmentedMesh(tuple(balls), (("a", "b"), ("b", "c")))


def radius(points: ndarray, part: tuple[Triple, float]) -> ndarray:
    return norm(points - part[0], axis=1)


def clear_of(points: ndarray, gap: float) -> ndarray:
    """Which points are farther from both surfaces; facets deviate from balls by up to 0.01."""
    return (np.abs(radius(points, CORE) - CORE[1]) > gap) & (np.abs(radius(points, ORGAN) - ORGAN[1]) > gap)


def true_labels(points: ndarray) -> ndarray:
    """1 in the core, 2 in the rest of the organ."""
    return np.where(radius(points, CORE) < CORE[1], 1, np.where(radius(points, ORGAN) < ORGAN[1], 2, 0))


def test_what_is_nested_in_a_nested_segment_is_nested_too_and_owns_its_shell() -> None:
    assert onion().nesting == ((0, 1), (0, 2), (1, 2)) and organ(()).nesting == ()
    meshes = np.array([segment.volume for segment in onion().segments])
    assert_allclose(onion().owned_volumes, np.diff(meshes, prepend=0.0))
    assert_allclose(onion().owned_volumes / (4 / 3 * pi), [1, 7, 19], rtol=0.01)


@pytest.mark.parametrize(
    ("inner", "outer", "fault"),
    [
        ("organ", "core", " but does not come before it;.*first"),
        ("core", "core", " but does not come before it"),
        ("core", "liver", ", but no segment is called 'liver'"),
    ],
)
def test_the_inner_segment_comes_first_and_both_exist(inner: str, outer: str, fault: str) -> None:
    with pytest.raises(ValueError, match=f"'{inner}' is declared nested in '{outer}'{fault}"):
        organ(((inner, outer),))


def test_declared_pairs_may_overlap_and_no_others_and_the_inner_segment_must_be_inside() -> None:
    assert overlaps(organ()) == overlaps(onion()) == ()
    (found,) = overlaps(organ(()))
    assert (found.small, found.large, found.nested) == ("core", "organ", False) and found.share > 0.99
    vein = SegmentedMesh((*organ().segments, box((-4, -1, -1), (-3, 1, 1), "vein")), organ().nested)
    (found,) = overlaps(vein)
    assert (found.small, found.large) == ("vein", "organ")
    half_out = SegmentedMesh(
        (box((4, -1, -1), (6, 1, 1), "core"), box((0, -5, -5), (5, 5, 5), "organ")), organ().nested
    )
    (found,) = overlaps(half_out)
    assert str(found) == "core is nested in organ, but 50.00% of it lies outside"
    larger = SegmentedMesh((ball(*ORGAN, "core"), ball(*CORE, "organ", 1)), organ().nested)
    (found,) = overlaps(larger)
    assert found.nested and found.share == pytest.approx(0.86, abs=0.01)


def test_distance_and_direction_lead_to_the_surface_of_what_the_owner_owns() -> None:
    points = default_rng(0).uniform(-6, 6, size=(5000, 3))
    solids = Solids(organ())
    points = points[clear_of(points, 0.02)]
    labels = solids.label(points)
    distance, direction = signed_distance_and_direction(solids, points, labels)
    to_core, to_organ = radius(points, CORE) - CORE[1], radius(points, ORGAN) - ORGAN[1]
    expected = np.select([labels == 1, labels == 2], [to_core, -np.minimum(-to_organ, to_core)], to_organ)
    assert_allclose(distance, expected, atol=0.02)  # facets lie up to 0.01 inside the ball
    wall = (labels == 1) | ((labels == 2) & (to_core < -to_organ))
    center = np.where(wall[:, None], CORE[0], ORGAN[0])
    outward = unit_rows(points - center)
    within = np.where(wall, to_core, to_organ) < 0
    cosine = np.einsum("ni,ni->n", direction, np.where(within[:, None], outward, -outward))
    tie = np.abs(np.abs(to_core) - np.abs(to_organ)) < 0.03
    assert (cosine[~tie & (np.abs(distance) > 0.2)] > 0.95).all()


def test_the_template_has_the_signed_distance_to_what_each_segment_owns() -> None:
    mesh = organ()
    axis = np.linspace(-TEMPLATE_REACH, TEMPLATE_REACH, TEMPLATE_NODES)[::3]
    center, half = rest_frame(mesh)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) * half + center
    to_core, to_organ = radius(points, CORE) - CORE[1], radius(points, ORGAN) - ORGAN[1]
    grid = rest_distances(mesh)[:, ::3, ::3, ::3].reshape(2, -1).astype(float) * half
    assert_allclose(grid[0], to_core, atol=0.03)
    assert_allclose(grid[1], np.maximum(to_organ, -to_core), atol=0.03)


def test_the_outside_of_a_nested_segment_is_the_segment_around_it() -> None:
    solids = Solids(organ())
    keep = 200
    samples = sort_sample(solids, keep, 2 * keep, default_rng(0))
    core_in, core_out, organ_in, organ_out = np.split(samples.labels, 4)
    assert (core_in == 1).all() and (organ_in == 2).all() and (organ_out == 0).all()
    assert (core_out == 2).mean() > 0.9 and set(core_out) <= {0, 2}  # a part of its draw box reaches out of the organ
    points = np.split(samples.points, 4)
    for side, part in ((0, CORE), (1, CORE), (2, ORGAN), (3, ORGAN)):
        # equal volumes on both sides of the own surface: the organ's inside points gather at its outer surface
        assert np.median(np.abs(radius(points[side], part) - part[1])) < 0.2 * part[1]


@pytest.mark.parametrize("sampler", ["volume-uniform", "label-uniform", "sort-sample", "nested-sort-sample"])
def test_every_sampler_gives_points_to_their_owner(sampler: str) -> None:
    settings = SamplingConfig(sampler=sampler, per_segment=128, uniform_fraction=1.0)  # type: ignore[arg-type]
    samples = sample_queries(Solids(organ()), settings, default_rng(2))
    assert len(samples.points) == settings.total(2)
    clear = clear_of(samples.points, 0.02)
    assert np.array_equal(samples.labels[clear], true_labels(samples.points[clear]))
    assert set(samples.labels.tolist()) == {0, 1, 2}


@pytest.mark.parametrize("nested", [(), (("core", "organ"),)])
def test_a_declared_outer_surface_leaves_out_the_wall_of_the_cavity(nested: Nested) -> None:
    # off the grid: a node exactly on both surfaces would be as likely empty
    core, whole = distance_to_ball((0.313, 0.107, -0.211), 0.45), distance_to_ball((0, 0, 0), 1.0)
    field = logits_of(core, lambda points: np.maximum(whole(points), -core(points)))
    box_around = np.array([[-1.2] * 3, [1.2] * 3])
    found, dense = (
        extract(field, box_around, 48, ("core", "organ"), ((1, 2, 3), (4, 5, 6)), nested, dense=every)
        for every in (False, True)
    )
    assert np.array_equal(found.grid.labels, dense.grid.labels)
    found.surfaces.check()
    check_overlap(found.surfaces)
    inner, outer = found.surfaces.segments
    spheres = 1 if nested else 2  # that bound the organ's mesh
    assert [len(part.vertices) - len(part.faces) // 2 for part in (inner, outer)] == [2, 2 * spheres]
    volumes = found.surfaces.owned_volumes
    assert volumes[0] == pytest.approx(4 / 3 * pi * 0.45**3, rel=0.02)
    assert volumes.sum() == pytest.approx(4 / 3 * pi, rel=0.01)
    apart = cKDTree(outer.vertices).query(inner.vertices)[0].max()  # marching cubes is in single precision
    assert apart > 0.1 if nested else apart < 1e-5


def test_rest_coordinates_lie_in_the_owner_at_rest() -> None:
    def move_together(rng: Generator) -> tuple[Deformation, ...]:
        return (Shear(*(rng.uniform(-1, 1, size=3) * [1.5, 0.2, 0.15])),) * 2

    scene = Scene("organ", organ(), move_together)
    settings = GenerateConfig(sampling=SamplingConfig(per_segment=128))
    example = synthesize(scene, settings, example_rng(1, 0))
    view = sample_view(scene, settings, example_rng(1, 0))
    queries, (center, half) = example.queries, rest_frame(scene.rest)
    rest = queries.rest * half + center
    inside = queries.labels > 0
    assert np.array_equal(np.isnan(rest).any(axis=1), ~inside)
    world = transform_points(view.T_world_camera, example.normalizer.invert(queries.positions))
    assert np.abs(view.deformations[0](rest[inside]) - world[inside]).max() < 1e-3
    # faces are flat before and after, the map between them is not: points beside a face may change sides
    clear = inside & clear_of(rest, 0.06)
    assert np.array_equal(true_labels(rest[clear]), queries.labels[clear]) and clear.sum() > 150
    check_overlap(view.mesh, tolerance=0.02)
