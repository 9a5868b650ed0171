"""`mereo reconstruct --formats`: the files of one reconstruction, all in one place and unit."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from analytic import AnalyticModel, ball, logits_of
from answers import answer_to
from two_balls import front

from mereo.__main__ import main, parse
from mereo.api.result import Result
from mereo.cli.answers import ReconstructCommand
from mereo.fitting.registration.answer import Answer
from mereo.geometry.mesh import PALETTE
from mereo.io.config import FilesConfig
from mereo.io.writers.formats import WRITERS, Results, chosen_formats, write_formats
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION
from mereo.reconstruction.pipeline import Reconstruction, segment_points
from mereo.visualization.result_files import write_answer

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


def results(found: Reconstruction, files: FilesConfig, unit_m: float = 1.0) -> Results:
    parts = found.surfaces, found.labels, found.observed
    return Results(*parts, GLTF_CAMERA_ROTATION, unit_m, files.millimetres)


def test_every_format_is_written_where_the_table_says(answer: Answer, tmp_path: Path) -> None:
    pytest.importorskip("nibabel", reason="nibabel is not installed: pip install 'mereo[medical]'")
    (tmp_path / "all").mkdir()
    write_answer(tmp_path / "all", answer, FilesConfig(("all",)))
    names = {path.name for path in (tmp_path / "all").glob("[!.]*")}
    second = {"segments.mtl", "points.npz"}
    assert names == {writer.file for writer in WRITERS.values()} | second | {"preview.png", "report.html"}
    assert sorted(path.name for path in (tmp_path / "all/stl").glob("[!.]*")) == ["1-big.stl", "2-small.stl"]
    assert json.loads((tmp_path / "all/summary.json").read_text())["unit_m"] == 0.01


@pytest.mark.parametrize("name", ["ply", "stl", "vti", "seg.nrrd"])
def test_only_what_was_asked_for_is_written(found: Reconstruction, tmp_path: Path, name: str) -> None:
    write_formats(tmp_path, chosen_formats([name]), results(found, FilesConfig()))
    assert [path.name for path in tmp_path.iterdir()] == [writer.file for key, writer in WRITERS.items() if key == name]


@pytest.mark.parametrize("millimetres, factor", [(False, 1.0), (True, 10.0)])
def test_units(found: Reconstruction, tmp_path: Path, millimetres: bool, factor: float) -> None:
    """The cloud is in centimetres: GLB is in metres, volumes in millimetres, the others as asked for."""
    out, center = tmp_path, np.array(BIG[0])
    formats = chosen_formats(["glb", "ply", "stl", "obj", "vti", "points", "seg.nrrd"])
    write_formats(out, formats, results(found, FilesConfig(formats, millimetres), 0.01))
    glb = trimesh.load_scene(out / "segments.glb")
    place = trimesh.transform_points(glb.geometry["big"].vertices, glb.graph["big"][0]).mean(axis=0)
    np.testing.assert_allclose(place, 0.01 * center * [1, -1, -1], atol=1e-5)
    for path in (out / "segments.ply", out / "segments.obj"):
        bounds = trimesh.load_mesh(path, process=False).bounds
        np.testing.assert_allclose(bounds[0], factor * (center - BIG[1]), atol=0.002 * factor)
    stl = trimesh.load_mesh(out / "stl/1-big.stl")
    np.testing.assert_allclose(stl.centroid, factor * center, atol=0.002 * factor)
    points = trimesh.load(out / "points.ply", process=False).vertices
    np.testing.assert_allclose(points, factor * view(), atol=1e-6 * factor)
    with np.load(out / "points.npz") as stored:
        np.testing.assert_allclose(stored["points"], view())
    origin = re.search(r'Origin="(.*?)"', (out / "labels.vti").read_text())
    assert origin is not None
    np.testing.assert_allclose([float(value) for value in origin[1].split()], factor * found.labels.origin)
    head = (out / "labels.seg.nrrd").read_bytes().partition(b"\n\n")[0].decode()
    origin = re.search(r"space origin: \((.*)\)", head)
    assert origin is not None
    np.testing.assert_allclose([float(value) for value in origin[1].split(",")], 10.0 * found.labels.origin)


def test_observed_points_have_the_segment_they_lie_on(found: Reconstruction) -> None:
    """Although half of them are outside of the surface by rounding, where empty space is the most likely class."""
    cloud = found.observed
    assert cloud is not None and cloud.names == NAMES
    np.testing.assert_array_equal(cloud.labels, np.repeat([1, 2], 600))
    np.testing.assert_allclose(cloud.occupancy[cloud.points[:, 1] < 0.22], 0.5, atol=0.01)
    np.testing.assert_array_equal(cloud.points, view())
    logits = np.log(np.array([[0.5, 0.4, 0.1], [0.98, 0.005, 0.015]], dtype=np.float32))
    cloud = segment_points(logits, np.zeros((2, 3)), NAMES, PALETTE[:2])
    np.testing.assert_array_equal(cloud.labels, [1, 2])
    np.testing.assert_allclose(cloud.confidence, [0.8, 0.75], rtol=1e-5)
    np.testing.assert_allclose(cloud.occupancy, [0.5, 0.02], rtol=1e-5)


def test_points_without_labels_are_refused(tmp_path: Path) -> None:
    plain = Result.of(answer_to(view(), model(), resolution=16))
    with pytest.raises(ValueError, match="the format 'points' needs them: pass label_points=True"):
        plain.save(tmp_path / "out", formats=("ply", "points"))
    assert list(tmp_path.iterdir()) == [], "the PLY that was already written neither"


def test_a_missing_extra_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "nibabel", None)
    arguments = ["reconstruct", "absent.ply", "--weights", "rope", "--output", str(tmp_path / "o"), "--formats", "all"]
    assert main(arguments) == 2
    assert "NIfTI needs nibabel, which is not installed: pip install 'mereo[medical]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_takes_formats(tmp_path: Path) -> None:
    start = ["reconstruct", "c.ply", "--weights", "w", "--output", "o"]
    chosen, default = (
        parse([*start, "--formats", "ply", "seg.nrrd", "--millimetres", "--unit-m", "0.001"]),
        parse(start),
    )
    assert isinstance(chosen, ReconstructCommand) and isinstance(default, ReconstructCommand)
    assert chosen.files == FilesConfig(("ply", "seg.nrrd"), True)
    assert chosen.reading.unit_m == 0.001
    assert chosen_formats(default.files.formats) == ("glb", "npz", "json")
    with pytest.raises(ValueError, match="there is no format 'step'; the formats are glb, ply, .* and all: choose one"):
        chosen_formats(["ply", "step"])
