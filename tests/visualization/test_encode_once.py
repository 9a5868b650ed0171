"""No cloud is encoded twice: the code that a reconstruction comes with answers everything that is asked after it."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from answers import answer_to

import mereo
from mereo.geometry.camera import PointCloud
from mereo.models.model import Model
from mereo.models.trained import EncodedCloud
from mereo.models.weights import load_model
from mereo.synthesis.sample_views import load_view
from mereo.visualization.color_scales import confidence
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


def test_a_result_that_is_written_and_a_page_of_a_frame(encoded: list[np.ndarray], tmp_path: Path) -> None:
    cloud = load_view("rope").depth.to_points()
    mereo.reconstruct(cloud, load_model("rope"), "network", resolution=16).save(tmp_path / "result")
    assert len(encoded) == 1
    model = load_model("rope")
    answer = answer_to(cloud, model, None, 16)
    probe_answer(answer, cloud.points[:5])
    confidence(answer.reconstruction.surfaces, partial(ask_network, answer))
    assert len(encoded) == 2, "once for each"
