"""Device and precision of a trained network, as a user asks for them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from mereo import __main__ as command_line
from mereo.cli.answers import ReconstructCommand
from mereo.cli.reconstruct import FrameJob, reconstruct_file
from mereo.models.config import EXACT, InferenceConfig
from mereo.models.device import bfloat16_pays, find_device
from mereo.models.weights import load_for

CPU = InferenceConfig(device="cpu", precision="bfloat16")


def cloud_file(folder: Path) -> Path:
    """A blob of the bunny's size in front of the camera."""
    points = np.random.default_rng(0).normal((0, 0, 0.6), 0.04, (600, 3))
    np.save(folder / "cloud.npy", points)
    return folder / "cloud.npy"


def test_where_and_how_exactly_is_what_was_asked_for() -> None:
    fast, exact = load_for("bunny", CPU), load_for("bunny", EXACT)
    assert (fast.device.type, fast.working_precision) == ("cpu", "bfloat16")
    assert exact.working_precision == "float32"
    on_cpu = load_for("bunny", InferenceConfig(device="cpu"))
    assert on_cpu.working_precision == ("bfloat16" if bfloat16_pays() else "float32")


def test_bfloat16_changes_few_labels_and_little_distance(tmp_path: Path) -> None:
    """The stated cost: about one label in a thousand; a rounding of coordinates instead would change every tenth."""
    points = np.load(cloud_file(tmp_path))
    queries = np.random.default_rng(1).uniform(points.min(axis=0), points.max(axis=0), (4000, 3))
    fast, exact = (
        model.query(model.encode(points), queries) for model in (load_for("bunny", CPU), load_for("bunny", EXACT))
    )
    assert np.abs(fast.probability - exact.probability).max() > 0
    assert (fast.label != exact.label).mean() < 0.02
    assert np.abs(fast.distance - exact.distance).mean() < 0.001


def test_results_say_where_they_were_computed(tmp_path: Path) -> None:
    options = ReconstructCommand((), weights="bunny", resolution=12, inference=CPU, method="network")
    reconstruct_file(cloud_file(tmp_path), tmp_path / "out", FrameJob(options))
    facts = json.loads((tmp_path / "out/summary.json").read_text())
    assert (facts["device"], facts["precision"]) == ("cpu", "bfloat16")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_cuda_where_there_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert find_device("auto") == find_device("cpu") == torch.device("cpu")
    arguments = ["reconstruct", str(cloud_file(tmp_path)), "--weights", "bunny", "--output", str(tmp_path / "out")]
    assert command_line.main([*arguments, "--device", "cuda"]) != 0
    assert "torch sees no CUDA device; leave out --device" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
