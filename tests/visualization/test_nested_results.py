"""What a model of a nested scene gives: the declaration travels from the manifest to weights, meshes and pictures."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
from analytic import AnalyticModel, logits_of, untrained
from analytic import ball as distance_to_ball
from answers import answer_to
from overlapping import check_overlap
from PIL import Image
from reported_scenes import page_data
from safetensors import safe_open
from small_training import SMALL
from toy_data import write_toy_dataset
from two_balls import front

from mereo.fitting.registration.answer import Answer
from mereo.geometry.camera import PointCloud
from mereo.geometry.solids import Solids
from mereo.io.writers.meshes import OUTER_OPACITY
from mereo.models.weights import load_model
from mereo.reconstruction.pipeline import Reconstruction
from mereo.visualization.previews import render_cloud_and_segments
from mereo.visualization.result_files import write_answer
from mereo_learning.trainer import train

NESTED = (("core", "organ"),)
CENTER, RADIUS = (0.0, 0.0, 5.0), 1.0
CORE_CENTER, CORE_RADIUS = (0.2, 0.1, 4.9), 0.5


CLOUD = front(CENTER, RADIUS, -1.0)


@pytest.fixture(scope="module")
def answer() -> Answer:
    core, organ = distance_to_ball(CORE_CENTER, CORE_RADIUS), distance_to_ball(CENTER, RADIUS)
    base = untrained(("core", "organ"))
    field = logits_of(core, lambda points: np.maximum(organ(points), -core(points)), sharpness=4.0)
    model = AnalyticModel(base.network, base.names, base.colors, nested=NESTED, field=field)
    return answer_to(CLOUD, model, resolution=40)


@pytest.fixture(scope="module")
def result(answer: Answer) -> Reconstruction:
    return answer.reconstruction


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
    assert np.array_equal(solids.label(places), np.ones(len(places), dtype=np.uint8))


def test_files_show_the_inner_segment_through_the_outer_one(
    answer: Answer, result: Reconstruction, tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    write_answer(tmp_path / "out", answer)
    glb = (tmp_path / "out" / "segments.glb").read_bytes()
    document = json.loads(glb[20 : 20 + struct.unpack("<I", glb[12:16])[0]])
    inner, outer = document["materials"]
    assert "alphaMode" not in inner and inner["pbrMetallicRoughness"]["baseColorFactor"][3] == 1.0
    assert outer["alphaMode"] == "BLEND" and outer["pbrMetallicRoughness"]["baseColorFactor"][3] == OUTER_OPACITY < 1
    page = page_data(tmp_path / "out" / "report.html")
    assert [segment["opacity"] for segment in page["segments"]] == [1.0, OUTER_OPACITY]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["nested"] == [["core", "organ"]]
    picture = np.asarray(Image.open(tmp_path / "out" / "preview.png")).astype(int)
    alone = replace(result.surfaces, nested=())
    render_cloud_and_segments(tmp_path / "opaque.png", PointCloud(CLOUD), alone, "mereo reconstruction")
    opaque = np.asarray(Image.open(tmp_path / "opaque.png")).astype(int)
    assert (np.abs(picture - opaque).max(axis=2) > 40).sum() > 5000


def test_weights_remember_it_and_older_ones_load(tmp_path: Path) -> None:
    data = write_toy_dataset(tmp_path / "data")
    manifest = json.loads((data / "manifest.json").read_text())
    first, second = (segment["name"] for segment in manifest["segments"][:2])
    (data / "manifest.json").write_text(json.dumps({**manifest, "nested": [[first, second]]}))
    weights = train(data, tmp_path / "run", replace(SMALL, epochs=1))
    assert load_model(weights).nested == ((first, second),)
    with safe_open(weights, framework="pt") as file:
        header = json.loads(file.metadata()["mereo"])
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a mapping)
    del header["nested"]
    safetensors.torch.save_file(tensors, tmp_path / "old.safetensors", metadata={"mereo": json.dumps(header)})
    assert load_model(tmp_path / "old.safetensors").nested == ()
