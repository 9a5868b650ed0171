"""No cloud is encoded twice: the code that a reconstruction comes with answers everything that is asked after it."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from answers import answer_to, reconstruct

import mereo
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import PointCloud, into_camera
from mereo.geometry.transforms import transform_points
from mereo.models.model import Model
from mereo.models.trained import EncodedCloud
from mereo.models.weights import load_model
from mereo.scenes.parameters import random_state
from mereo.scenes.registry import load_scene
from mereo.synthesis.sample_views import load_view
from mereo.visualization.color_scales import confidence
from mereo_viewer.laboratory import Laboratory
from mereo_viewer.result_page import ask_network, probe_answer


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


@pytest.mark.slow
def test_a_trial_of_the_laboratory(encoded: list[np.ndarray]) -> None:
    laboratory = Laboratory(load_scene("rope"), model := load_model("rope"), Registrar.of(model, "modes"))
    view = laboratory.look(random_state(laboratory.scene, 3), laboratory.first_place)
    laboratory.answer(view)
    assert 1 <= len(encoded) <= 2, "a frame that counts as noisy is smoothed, which is another cloud"
    assert len({cloud.tobytes() for cloud in encoded}) == len(encoded)


def test_a_result_that_is_written_and_a_page_of_a_frame(encoded: list[np.ndarray], tmp_path: Path) -> None:
    cloud = load_view("rope").depth.to_points()
    mereo.reconstruct(cloud, load_model("rope"), "network", resolution=16).save(tmp_path / "result")
    assert len(encoded) == 1
    model = load_model("rope")
    answer = answer_to(cloud, model, None, 16)
    probe_answer(answer, cloud.points[:5])
    confidence(answer.reconstruction.surfaces, partial(ask_network, answer))
    assert len(encoded) == 2, "once for each"


def test_the_code_answers_in_the_camera_frame() -> None:
    """Of a scan too, whose result is in the scanner's."""
    model, seen = load_model("rope"), load_view("rope").depth.to_points().points
    scan = seen * [1.0, -1.0, -1.0]
    result = reconstruct(scan, model, 16, "scanner")
    np.testing.assert_array_equal(result.T_camera_input, into_camera(scan, "scanner"))
    in_camera = transform_points(result.T_camera_input, scan)
    alone = model.encode(PointCloud(in_camera))
    np.testing.assert_array_equal(model.logits(result.code, in_camera[:9]), model.logits(alone, in_camera[:9]))
