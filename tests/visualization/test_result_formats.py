"""`mereo reconstruct --formats`: the files of one reconstruction, all in one place and unit."""

import json
import re
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from analytic import AnalyticModel, ball, logits_of, untrained
from analytic import ball as distance_to_ball
from answers import answer_to
from folder_contents import read_json
from numpy.testing import assert_allclose, assert_array_equal
from overlapping import check_overlap
from PIL import Image
from reported_scenes import page_data
from small_training import SMALL as RECIPE
from toy_data import write_toy_dataset
from two_balls import front

from mereo.__main__ import main
from mereo.api.result import Result
from mereo.fitting.registration.answer import Answer
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import PALETTE
from mereo.geometry.solids import Solids
from mereo.io.config import FilesConfig
from mereo.io.writers.formats import WRITERS, Results, chosen_formats, write_formats
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION
from mereo.io.writers.meshes import OUTER_OPACITY
from mereo.models.weights import load_model
from mereo.reconstruction.pipeline import Reconstruction, segment_points
from mereo.visualization.previews import render_cloud_and_segments
from mereo.visualization.result_files import write_answer
from mereo_learning.trainer import train

NAMES = ("big", "small")
BIG, SMALL = ((0.1, 0.2, 0.5), 0.06), ((0.1, 0.2905, 0.5), 0.03)


def model() -> AnalyticModel:
    field = logits_of(ball(*BIG), ball(*SMALL))
    return AnalyticModel.of(lambda points: 200.0 * field(points), NAMES)


def view() -> np.ndarray:
    return np.concatenate([front(*BIG, -1.0), front(*SMALL, -1.0)])


@pytest.fixture(scope="module")
def answer() -> Answer:
    return answer_to(view(), model(), resolution=24, unit_m=0.01, label_points=True)


@pytest.fixture(scope="module")
def found(answer: Answer) -> Reconstruction:
    return answer.reconstruction


def test_every_format_is_written_where_the_table_says(answer: Answer, tmp_path: Path) -> None:
    pytest.importorskip("nibabel", reason="nibabel is not installed: pip install 'mereo[medical]'")
    (tmp_path / "all").mkdir()
    write_answer(tmp_path / "all", answer, FilesConfig(("all",)))
    names = {path.name for path in (tmp_path / "all").glob("[!.]*")}
    second = {"segments.mtl", "points.npz"}
    assert names == {writer.file for writer in WRITERS.values()} | second | {"preview.png", "report.html"}
    assert sorted(path.name for path in (tmp_path / "all/stl").glob("[!.]*")) == ["1-big.stl", "2-small.stl"]
    assert read_json(tmp_path / "all/summary.json")["unit_m"] == 0.01


@pytest.mark.parametrize("millimetres, factor", [(False, 1.0), (True, 10.0)])
def test_units(found: Reconstruction, tmp_path: Path, millimetres: bool, factor: float) -> None:
    """The cloud is in centimetres: GLB is in metres, volumes in millimetres, the others as asked for."""
    out = tmp_path
    center = np.array(BIG[0])
    formats = chosen_formats(["glb", "ply", "stl", "obj", "vti", "points", "seg.nrrd"])
    parts = found.surfaces, found.labels, found.observed
    write_formats(out, formats, Results(*parts, GLTF_CAMERA_ROTATION, 0.01, millimetres))
    glb = trimesh.load_scene(out / "segments.glb")
    place = trimesh.transform_points(glb.geometry["big"].vertices, glb.graph["big"][0]).mean(axis=0)
    assert_allclose(place, 0.01 * center * [1, -1, -1], atol=1e-5)
    for path in (out / "segments.ply", out / "segments.obj"):
        bounds = trimesh.load_mesh(path, process=False).bounds
        assert_allclose(bounds[0], factor * (center - BIG[1]), atol=0.002 * factor)
    stl = trimesh.load_mesh(out / "stl/1-big.stl")
    assert_allclose(stl.centroid, factor * center, atol=0.002 * factor)
    points = trimesh.load(out / "points.ply", process=False).vertices
    assert_allclose(points, factor * view(), atol=1e-6 * factor)
    with np.load(out / "points.npz") as stored:
        assert_allclose(stored["points"], view())
    origin = re.search(r'Origin="(.*?)"', (out / "labels.vti").read_text())
    assert origin is not None
    assert_allclose([float(value) for value in origin[1].split()], factor * found.labels.origin)
    head = (out / "labels.seg.nrrd").read_bytes().partition(b"\n\n")[0].decode()
    origin = re.search(r"space origin: \((.*)\)", head)
    assert origin is not None
    assert_allclose([float(value) for value in origin[1].split(",")], 10.0 * found.labels.origin)


def test_observed_points_have_the_segment_they_lie_on(found: Reconstruction) -> None:
    """Although half of them are outside of the surface by rounding, where empty space is the most likely class."""
    cloud = found.observed
    assert cloud is not None and cloud.names == NAMES
    assert_array_equal(cloud.labels, np.repeat([1, 2], 600))
    assert_allclose(cloud.occupancy[cloud.points[:, 1] < 0.22], 0.5, atol=0.01)
    assert_array_equal(cloud.points, view())
    logits = np.log(np.array([[0.5, 0.4, 0.1], [0.98, 0.005, 0.015]], np.float32))
    cloud = segment_points(logits, np.zeros((2, 3)), NAMES, PALETTE[:2])
    assert_array_equal(cloud.labels, [1, 2])
    assert_allclose(cloud.confidence, [0.8, 0.75], rtol=1e-5)
    assert_allclose(cloud.occupancy, [0.5, 0.02], rtol=1e-5)


def test_points_without_labels_are_refused(tmp_path: Path) -> None:
    plain = Result.of(answer_to(view(), model(), resolution=16))
    with pytest.raises(ValueError, match="the format 'points' needs them: pass label_points=True"):
        plain.save(tmp_path / "out", formats=("ply", "points"))
    assert list(tmp_path.iterdir()) == [], "the PLY that was already written neither"


def test_a_missing_extra_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "nibabel", None)
    arguments = ["reconstruct", "absent.ply", "--weights", "rope", "--output", str(tmp_path / "o"), "--formats", "all"]
    assert main(arguments) == 2
    assert "NIfTI needs nibabel, which is not installed: pip install 'mereo[medical]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


NESTED = (("core", "organ"),)
CENTER = (0.0, 0.0, 5.0)
RADIUS = 1.0
CORE_CENTER = (0.2, 0.1, 4.9)
CORE_RADIUS = 0.5


CLOUD = front(CENTER, RADIUS, -1.0)


@pytest.fixture(scope="module")
def nested_answer() -> Answer:
    core, organ = distance_to_ball(CORE_CENTER, CORE_RADIUS), distance_to_ball(CENTER, RADIUS)
    base = untrained(("core", "organ"))
    field = logits_of(core, lambda points: np.maximum(organ(points), -core(points)), sharpness=4.0)
    model = AnalyticModel(base.network, base.names, base.colors, nested=NESTED, field=field)
    return answer_to(CLOUD, model, resolution=40)


@pytest.fixture(scope="module")
def result(nested_answer: Answer) -> Reconstruction:
    return nested_answer.reconstruction


def test_a_reconstruction_is_nested_as_the_model_is_and_the_inner_segment_owns_its_voxels(
    result: Reconstruction,
) -> None:
    assert result.surfaces.nested == NESTED
    result.surfaces.check()
    check_overlap(result.surfaces)
    core, organ = (found.volume / (4 / 3 * np.pi) for found in result.segments)
    assert core == pytest.approx(CORE_RADIUS**3, rel=0.03)
    assert organ == pytest.approx(RADIUS**3 - CORE_RADIUS**3, rel=0.03)
    voxels = np.argwhere(result.labels.labels == 1)
    solids = Solids(result.surfaces)
    places = result.labels.positions(voxels)
    assert solids.inside(0, places).all() and solids.inside(1, places).all()
    assert np.array_equal(solids.label(places), np.ones(len(places), np.uint8))


def test_files_show_the_inner_segment_through_the_outer_one(
    nested_answer: Answer, result: Reconstruction, tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    write_answer(tmp_path / "out", nested_answer)
    glb = (tmp_path / "out" / "segments.glb").read_bytes()
    document = json.loads(glb[20 : 20 + struct.unpack("<I", glb[12:16])[0]])
    inner, outer = document["materials"]
    assert "alphaMode" not in inner and inner["pbrMetallicRoughness"]["baseColorFactor"][3] == 1.0
    assert outer["alphaMode"] == "BLEND" and outer["pbrMetallicRoughness"]["baseColorFactor"][3] == OUTER_OPACITY < 1
    page = page_data(tmp_path / "out" / "report.html")
    assert [segment["opacity"] for segment in page["segments"]] == [1.0, OUTER_OPACITY]
    assert read_json(tmp_path / "out" / "summary.json")["nested"] == [["core", "organ"]]
    picture = np.asarray(Image.open(tmp_path / "out" / "preview.png")).astype(int)
    alone = replace(result.surfaces, segments=result.surfaces.segments[1:], nested=())
    render_cloud_and_segments(tmp_path / "opaque.png", PointCloud(CLOUD), alone, "mereo reconstruction")
    opaque = np.asarray(Image.open(tmp_path / "opaque.png")).astype(int)
    assert (np.abs(picture - opaque).max(axis=2) > 40).sum() > 5000


def test_weights_remember_it(tmp_path: Path) -> None:
    data = write_toy_dataset(tmp_path / "data")
    manifest = read_json(data / "manifest.json")
    first, second = (segment["name"] for segment in manifest["segments"][:2])
    (data / "manifest.json").write_text(json.dumps({**manifest, "nested": [[first, second]]}))
    assert load_model(train(data, tmp_path / "run", replace(RECIPE, epochs=1))).nested == ((first, second),)
