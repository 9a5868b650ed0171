"""A result's segments by their names, its pose, and where it is saved."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from answers import answer_to
from toy_frames import CENTERS, MODEL, NAMES, RADII, seen

import mereo
from mereo.api.result import Result
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import SCANNER_TO_CAMERA
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.transforms import transform_points
from mereo.models.model import Model
from mereo.scenes.scene import SourceFrame
from mereo.synthesis.sample_views import load_view

pytestmark = pytest.mark.usefixtures("small_previews")

UNIT_M, SCALE = 0.01, 4.0
"""Metres per scene unit of the sized rope, and scene units per unit of its files."""


@pytest.fixture(scope="module")
def result() -> Result:
    return mereo.reconstruct(seen(), MODEL, "network", resolution=24)


def test_segments_are_had_by_their_names(result: Result) -> None:
    assert result.names == NAMES and len(result) == 3
    for name, center, radius in zip(NAMES, CENTERS, RADII, strict=False):
        found = result[name]
        np.testing.assert_allclose(found.centroid, center, atol=0.003)
        assert found.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.05)
        assert found.name == name and found.label == NAMES.index(name) + 1 and found.is_present
        assert 0.5 < found.confidence <= 1 and found.error_radius is None and found.pose is None
        assert found.mesh is result.surfaces.segments[found.label - 1]
    assert result["big"] is result["big"]


def test_an_absent_segment_is_there_and_says_so(result: Result) -> None:
    absent = result["absent"]
    assert not absent.is_present and absent.volume == 0 and np.isnan(absent.confidence) and len(absent.mesh.faces) == 0
    with pytest.raises(KeyError, match="there is no segment 'bigg'; the segments are big, <small>, absent"):
        result["bigg"]
    assert repr(absent) == "SegmentResult('absent', not found)" and "volume" in repr(result["big"])


@pytest.fixture(scope="module")
def registrar(rope: Model) -> Registrar:
    """That of a rope of a known true size, whose files are in another frame and unit than its scene."""
    T_scene_source = np.array([[0.0, -SCALE, 0, 1], [SCALE, 0, 0, 2], [0, 0, SCALE, 3], [0, 0, 0, 1]])
    assert rope.statistical_model is not None
    own = replace(rope.statistical_model, source_frame=SourceFrame(T_scene_source, UNIT_M))
    return Registrar(rope, own, "modes")


@pytest.mark.parametrize("unit, axes", [(UNIT_M, "camera"), (0.001, "scanner")])
def test_the_pose_brings_the_objects_files_to_the_frame(
    unit: float, axes: CloudAxes, rope: Model, registrar: Registrar
) -> None:
    points = load_view("rope").depth.to_points().points * (UNIT_M / unit)
    points = points if axes == "camera" else points @ SCANNER_TO_CAMERA[:3, :3]
    answer = answer_to(points, rope, registrar, 16, axes, unit)
    result = Result.of(answer)
    registered = result.registered
    assert registered is not None and result.pose is not None and result.unit_m == unit
    assert result.model_scale == pytest.approx(SCALE * UNIT_M / unit, rel=0.1)
    np.testing.assert_allclose(result.pose[:3, :3] @ result.pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(result.pose[:3, :3]) == pytest.approx(1.0)
    source = registered.model.source_frame
    assert source is not None
    rest = transform_points(np.linalg.inv(source.T_scene_source), registered.model.rest_points)
    placed = transform_points(result.pose, result.model_scale * rest)
    away = np.linalg.norm(placed - registered.material, axis=1)
    length = float(np.ptp(registered.material, axis=0).max())
    assert np.median(away) < 0.5 * length, "rigidly placed, a bent rope lies about where it is"
    np.testing.assert_allclose(placed.mean(axis=0), registered.material.mean(axis=0), atol=1e-6 * length)


def test_each_segment_has_its_own_pose_and_radius(rope: Model, registrar: Registrar) -> None:
    result = Result.of(answer_to(load_view("rope").depth.to_points(), rope, registrar, 16, unit_m=UNIT_M))
    registered, whole = result.registered, result.pose
    assert registered is not None and whole is not None and result.model_scale is not None
    source = registered.model.source_frame
    assert source is not None
    rest = transform_points(np.linalg.inv(source.T_scene_source), registered.model.rest_points)
    for one in result:
        rows = registered.model.labels == one.label
        assert one.pose is not None and one.error_radius is not None and one.error_radius > 0
        own, common = (
            np.linalg.norm(transform_points(T, result.model_scale * rest[rows]) - registered.material[rows], axis=1)
            for T in (one.pose, whole)
        )
        assert np.sqrt((own**2).mean()) < np.sqrt((common**2).mean()), one.name


def test_a_unit_that_nobody_states_is_found_by_the_true_size(rope: Model, registrar: Registrar) -> None:
    cloud = load_view("rope").depth.to_points()
    result = Result.of(answer_to(cloud, rope, registrar, 16))
    assert result.unit_m == pytest.approx(UNIT_M, rel=0.05) and result.seen.facts()["unit_m"] == result.unit_m
    unsized = Registrar(rope, replace(registrar.model, source_frame=None), "modes")
    free = Result.of(answer_to(cloud, rope, unsized, 16))
    assert free.taken and free.unit_m is None and free.pose is not None
    assert free.registered is not None and free.model_scale == free.registered.scene_unit


def test_without_a_name_it_is_saved_beside_the_last(
    result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert [result.save(formats=("json",)) for _ in range(3)] == [Path("result"), Path("result2"), Path("result3")]
    assert {path.name for path in tmp_path.iterdir()} == {"result", "result2", "result3"}
    (tmp_path / "result2").rename(tmp_path / "other")
    (tmp_path / "result2").symlink_to(tmp_path / "nowhere")
    assert result.save(formats=("json",)) == Path("result4"), "a link that leads nowhere is somebody's"
