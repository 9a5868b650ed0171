"""How sure a registered model is, where people and programs read it: files, summary, report, stream, viewer."""

import base64
import copy
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import answer_to
from scipy.spatial import cKDTree

from mereo.cli.stream import FrameAnswer, Outcome, line
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import CloudToFit, Registrar
from mereo.fitting.tracking import Tracker
from mereo.geometry.camera import PointCloud
from mereo.io.config import FilesConfig
from mereo.models.calibration import Calibration
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.observation import observe
from mereo.synthesis.sample_views import load_view
from mereo.visualization.reconstruction_report import UNEXPLAINED, explain_centroids, point_marks
from mereo.visualization.result_files import write_answer


@pytest.fixture(scope="module")
def model() -> Model:
    return replace(load_model("liver"), calibration=None)


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return load_view("liver").depth.to_points()


@pytest.fixture(scope="module")
def found(model: Model, cloud: PointCloud) -> Answer:
    result = answer_to(cloud, model, Registrar.of(model, "modes"), 24)
    assert result.registered is not None and result.registered.uncertainty is not None
    return result


@pytest.fixture(scope="module")
def folder(found: Answer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sure")
    files = FilesConfig(("glb", "ply", "npz", "vti", "json"), millimetres=True)
    said = replace(found.seen, frame=replace(found.seen.frame, unit_m=0.5))
    write_answer(path, replace(found, seen=said), files)
    return path


def radii_of(found: Answer) -> np.ndarray:
    assert found.registered is not None and found.registered.uncertainty is not None
    return np.concatenate(found.registered.uncertainty.vertices)


def test_a_registration_says_that_it_cannot_be_sent(found: Answer) -> None:
    with pytest.raises(TypeError, match="a registration cannot be pickled or copied.*save_state"):
        copy.copy(found.registered)


def test_a_ply_has_the_radius_of_each_vertex_in_its_unit(found: Answer, folder: Path) -> None:
    """With --millimetres, of a frame whose unit is half a metre."""
    data = (folder / "segments.ply").read_bytes()
    head, body = data.split(b"end_header\n", 1)
    assert b"property uchar label\nproperty float radius95\n" in head
    assert b"comment radius95 is in the unit of x, y, z; it is not calibrated\n" in head
    kinds = [*((axis, "<f4") for axis in "xyz"), ("color", "u1", 3), ("label", "u1"), ("radius95", "<f4")]
    vertices = np.frombuffer(body, np.dtype(kinds), count=len(radii_of(found)))
    np.testing.assert_allclose(vertices["radius95"], 500.0 * radii_of(found), rtol=1e-5)
    assert found.registered is not None
    np.testing.assert_allclose(vertices["x"], 500.0 * found.registered.material[: len(vertices), 0], rtol=1e-4)


def glb(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def accessor(document: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    view = document["bufferViews"][document["accessors"][index]["bufferView"]]
    part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(part, "<f4").reshape(document["accessors"][index]["count"], -1)


def test_a_glb_has_the_radius_of_each_vertex_and_says_its_unit(found: Answer, folder: Path) -> None:
    assert found.registered is not None and found.registered.uncertainty is not None
    document, binary = glb(folder / "segments.glb")
    rows = np.split(np.arange(len(radii_of(found))), np.cumsum(found.registered.model.vertex_counts)[:-1])
    for mesh, part in zip(document["meshes"], rows, strict=True):
        attributes = mesh["primitives"][0]["attributes"]
        assert mesh["extras"]["radius95"] == {"unit_m": 0.5, "calibrated": False} and "COLOR_0" not in attributes
        told, place = (accessor(document, binary, attributes[name]) for name in ("_RADIUS95", "POSITION"))
        away, same = cKDTree(found.registered.material[part]).query(
            place
        )  # vertices that are one place are written once
        assert away.max() < 1e-4 and len(place) > 0.99 * len(part)
        np.testing.assert_allclose(told[:, 0], radii_of(found)[part][same], rtol=1e-3)


def test_label_volumes_have_the_radius_of_each_voxel(found: Answer, folder: Path) -> None:
    with np.load(folder / "labels.npz") as values:
        labels, radii = values["labels"], values["radius95"]
    assert radii.shape == labels.shape and radii.dtype == np.float32
    np.testing.assert_array_equal(np.isfinite(radii), labels > 0)
    everywhere = radii_of(found)
    assert everywhere.min() * 0.9 < np.nanmedian(radii) < everywhere.max()
    text = (folder / "labels.vti").read_text()
    array = re.search(r'Name="radius95" format="binary">([^<]+)<', text)
    assert array is not None and 'type="Float32"' in text
    packed = base64.b64decode(array[1][44:])  # after the head of 32 bytes
    told = np.frombuffer(zlib.decompress(packed), "<f4").reshape(labels.shape, order="F")
    np.testing.assert_allclose(told, 500.0 * radii, rtol=1e-5)


def test_the_summary_tells_centroids_volumes_and_the_whole(found: Answer, folder: Path) -> None:
    assert found.registered is not None and found.registered.uncertainty is not None
    summary = json.loads((folder / "summary.json").read_text())
    told = summary["radius95"]
    assert told == {
        "median": pytest.approx(np.median(radii_of(found))),
        "max": pytest.approx(radii_of(found).max()),
        "calibrated": False,
        "unit_m": 0.5,
    }
    for row, one in zip(summary["segments"], found.registered.uncertainty.segments, strict=True):
        assert row["centroid_radius95"] == pytest.approx(one.centroid_radius95)
        assert row["volume95"] == pytest.approx(list(one.volume95))
        assert row["volume95"][0] < row["volume"] < row["volume95"][1]


@pytest.mark.usefixtures("without_turns")
def test_points_that_the_model_does_not_explain_are_red(model: Model, cloud: PointCloud) -> None:
    lump = cloud.points[:40] - [0.0, 0.0, 3.0 * load_unit(model, cloud)]
    points = np.concatenate([cloud.points, lump])
    registration = answer_to(points, model, Registrar.of(model, "modes"), 16, keep_all=True).registered
    assert registration is not None
    one = registration.explain("liver")
    assert one is not None and len(one.unexplained)
    marks = point_marks(one, points)
    assert (marks[-40:] == UNEXPLAINED).mean() > 0.8 and (marks[:-40] == UNEXPLAINED).mean() < 0.1
    assert tuple(explain_centroids(registration)) == model.names


def load_unit(model: Model, cloud: PointCloud) -> float:
    """Scene units in the cloud's unit, about: the object is 25 of them long."""
    return float(np.ptp(cloud.points, axis=0).max()) / 25


def test_a_stream_says_it_where_it_is_asked_to(model: Model, cloud: PointCloud) -> None:
    tracker = Tracker(Registrar.of(model, "modes"))
    followed = [tracker.follow(observe(cloud), 0.05 * number) for number in range(2)]
    assert followed[1].tracked
    silent, told = FrameAnswer.of(followed[1]), FrameAnswer.of(followed[1], True)
    words = line(Outcome("frame", 0.0, told, "", 0.0, 0.0, 0))
    assert "radius95" not in line(Outcome("frame", 0.0, silent, "", 0.0, 0.0, 0))
    assert set(words["radius95"]) == {"median", "max", "calibrated"} and words["radius95"]["median"] > 0
    for name in model.names:
        assert "volume95" not in silent.facts["segments"][name]
        low, high = words["segments"][name]["volume95"]
        assert low < words["segments"][name]["volume"] < high and words["segments"][name]["centroid_radius95"] > 0


def test_a_calibration_comes_from_the_weights(model: Model, cloud: PointCloud) -> None:
    known = replace(model, calibration=Calibration(seed=1, views=2, radius_scale=2.5))
    registrar = Registrar.of(known, "modes")
    registration = registrar.fit_modes(CloudToFit(cloud.points)).registration()
    assert registration.uncertainty is not None and registration.uncertainty.scale == 2.5
    tracker = Tracker(registrar)
    followed = [tracker.follow(observe(cloud), 0.05 * number).registration for number in range(2)]
    assert all(one is not None and one.radius_scale == 2.5 for one in followed)


def test_the_viewer_colours_it_and_says_it_of_a_place(found: Answer, server: object) -> None:
    pytest.importorskip("viser", reason="viser (extra `view`) is not installed")
    from mereo_viewer.result_page import SURE, ResultPage, content_of_answer

    page = ResultPage(server, content_of_answer(replace(found, seen=observe(found.seen.cloud, unit_m=1.0))))
    colors, scale = page.content.colorings[SURE]()
    mesh = page.content.mesh
    assert [len(part) for part in colors] == [len(s.vertices) for s in mesh.segments]
    assert scale is not None and "mm" in scale.words[1]
    page.probe(mesh.segments[0].vertices[0])
    assert re.search(r"± [\d.]+ mm \(95\s%\)", page.facts.content)
