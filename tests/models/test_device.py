"""Where and how exactly a network computes: device, precision, products by oneDNN, pieces of work in threads."""

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from folder_contents import run_mereo
from numpy.random import default_rng
from torch import Tensor
from torch.nn import functional as F

from mereo.models import device
from mereo.models.config import EXACT, InferenceConfig, Precision
from mereo.models.device import ROWS, bfloat16_pays, find_device, in_threads, linear, onednn_pays, pick_precision
from mereo.models.model import CPU_QUERY_CHUNK
from mereo.models.weights import load_for, load_model
from mereo.synthesis.sample_views import load_view
from mereo_experiments.speed.stages import count_operations, random_points

CPU = InferenceConfig(device="cpu", precision="bfloat16")


@pytest.fixture
def fresh_decisions() -> Iterator[None]:
    """What is decided once in a process is decided again, in the test and after it."""
    for decide in (bfloat16_pays, onednn_pays):
        decide.cache_clear()
    yield
    for decide in (bfloat16_pays, onednn_pays):
        decide.cache_clear()


@pytest.mark.usefixtures("fresh_decisions")
@pytest.mark.parametrize(
    ("features", "is_amd", "chosen"),
    [
        ({"amx": True, "avx512_bf16": True}, False, torch.bfloat16),
        ({"amx": False, "avx512_bf16": True}, True, torch.bfloat16),
        ({"amx": False, "avx512_bf16": True}, False, None),
        ({"amx": None, "avx512_bf16": None}, True, None),
    ],
)
def test_auto_takes_bfloat16_where_the_processor_gains_by_it(
    monkeypatch: pytest.MonkeyPatch, features: dict[str, bool | None], is_amd: bool, chosen: torch.dtype | None
) -> None:
    monkeypatch.setattr(device, "cpu_features", lambda: features)
    monkeypatch.setattr(device, "is_amd", lambda: is_amd)
    found = [pick_precision(asked, torch.device("cpu")) for asked in ("auto", "float32", "bfloat16")]
    assert found == [chosen, None, torch.bfloat16]


def cloud_file(folder: Path) -> Path:
    np.save(folder / "cloud.npy", default_rng(0).normal((0, 0, 0.6), 0.04, (600, 3)))
    return folder / "cloud.npy"


def test_bfloat16_changes_few_labels_and_little_distance(tmp_path: Path) -> None:
    """The stated cost: about one label in a thousand; a rounding of coordinates instead would change every tenth."""
    points = np.load(cloud_file(tmp_path))
    queries = default_rng(1).uniform(points.min(axis=0), points.max(axis=0), (4000, 3))
    on_cpu = replace(EXACT, device="cpu")
    models = [load_for("bunny", config) for config in (CPU, on_cpu, InferenceConfig(device="cpu"))]
    assert {model.device.type for model in models} == {"cpu"}
    auto = "bfloat16" if bfloat16_pays() else "float32"
    assert [model.working_precision for model in models] == ["bfloat16", "float32", auto]
    fast, exact = (model.query(model.encode(points), queries) for model in models[:2])
    assert np.abs(fast.probability - exact.probability).max() > 0
    assert (fast.label != exact.label).mean() < 0.02
    assert np.abs(fast.distance - exact.distance).mean() < 0.001


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_cuda_where_there_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert find_device("auto") == find_device("cpu") == torch.device("cpu")
    arguments = ["reconstruct", str(cloud_file(tmp_path)), "--weights", "bunny", "--output", str(tmp_path / "out")]
    assert run_mereo(*arguments, "--device", "cuda") != 0
    assert "torch sees no CUDA device; leave out --device" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.fixture
def by_onednn(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """The product by oneDNN, as if it were faster here."""
    monkeypatch.setattr(device, "onednn_pays", lambda: True)
    monkeypatch.setattr(device, "_by_onednn", Mock(wraps=device._by_onednn))
    return device._by_onednn


def layer(inputs: int = 70, outputs: int = 40) -> tuple[Tensor, Tensor]:
    numbers = torch.Generator().manual_seed(0)
    return torch.randn(outputs, inputs, generator=numbers), torch.randn(outputs, generator=numbers)


def rows(count: int, inputs: int = 70) -> Tensor:
    return torch.randn(1, count, inputs, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("biased", [True, False])
def test_products_are_torchs_own(by_onednn: Mock, biased: bool) -> None:
    weight, bias = layer()
    with torch.inference_mode():
        for calls, count in enumerate((ROWS, 2 * ROWS), start=1):
            found = linear(rows(count), weight, bias if biased else None)
            exact = F.linear(rows(count).double(), weight.double(), bias.double() if biased else None)
            torch.testing.assert_close(found.double(), exact, rtol=0, atol=1e-4)
            assert by_onednn.call_count == calls
        assert count_operations(lambda: linear(rows(ROWS), weight)) == 2 * ROWS * 70 * 40


def test_other_sizes_precisions_and_trainings_are_torchs(by_onednn: Mock) -> None:
    weight, bias = layer()
    with torch.inference_mode():
        assert torch.equal(linear(rows(ROWS + 1), weight, bias), F.linear(rows(ROWS + 1), weight, bias))
        linear(rows(ROWS).double(), weight.double())
        linear(rows(0), weight)
        with torch.autocast("cpu", torch.bfloat16):
            assert linear(rows(ROWS), weight).dtype == torch.bfloat16
    weight.requires_grad_()
    linear(rows(ROWS), weight, bias).sum().backward()
    assert weight.grad is not None and not by_onednn.called


@pytest.mark.usefixtures("fresh_decisions")
def test_the_processor_decides_and_no_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    for is_amd, missing, pays in ((True, False, True), (False, False, False), (True, True, False)):
        onednn_pays.cache_clear()
        monkeypatch.setattr(device, "is_amd", lambda is_amd=is_amd: is_amd)
        if missing:  # a private operator of torch, which may go
            monkeypatch.setattr(torch.ops, "mkldnn", object())
        assert onednn_pays() is pays
    with torch.inference_mode():
        weight, bias = layer()
        assert torch.equal(linear(rows(ROWS), weight, bias), F.linear(rows(ROWS), weight, bias))


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_answers_are_the_same_bits_in_any_number_of_threads(precision: Precision) -> None:
    model = replace(load_model("bunny"), precision=precision)
    view = load_view("bunny")
    code = model.encode(view.depth.to_points())
    points = default_rng(0).normal(size=(3 * CPU_QUERY_CHUNK + 7, 3)) * 8 + view.depth.to_points().points[0]
    torch.set_num_threads(1)
    alone = model.query(code, points)
    for count in (2, 3):
        torch.set_num_threads(count)
        together = model.query(code, points)
        for name in ("label", "probability", "distance", "direction"):
            assert np.array_equal(getattr(alone, name), getattr(together, name), equal_nan=True), (count, name)
    assert len(np.unique(alone.label)) > 2


@pytest.mark.usefixtures("threads")
def test_each_thread_computes_alone_and_the_callers_number_stays() -> None:
    found = in_threads(lambda piece: (piece, torch.get_num_threads()), range(20))
    assert found == [(piece, 1) for piece in range(20)]
    assert in_threads(lambda _: torch.get_num_threads(), [0]) == [2]  # one piece has them all
    assert in_threads(lambda _: torch.get_num_threads(), range(5), most=1) == [2] * 5
    ones = torch.ones(10, 20)
    assert count_operations(lambda: in_threads(lambda _: ones @ ones.T, range(3))) == 3 * 2 * 10 * 20 * 10
    assert torch.get_num_threads() == 2
    torch.set_num_threads(5)
    assert in_threads(lambda _: torch.get_num_threads(), range(2)) == [2, 2]


FORKED = """
import os, sys, torch
from mereo.models.device import in_threads
torch.set_num_threads(2)
product = lambda: torch.nn.functional.linear(torch.ones(512, 512), torch.ones(512, 512)).sum().item()
before, pieces = product(), in_threads(str, range(4))
child = os.fork()
if child == 0:
    os._exit(0 if in_threads(str, range(4)) == pieces == list("0123") and product() == before else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_forked_process_has_threads_of_its_own_and_computes() -> None:
    """OpenMP's threads do not survive a fork: without care it waits for them without end."""
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED], check=True, timeout=120)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("name", ["bunny", "rope"])
def test_cuda_answers_as_the_cpu(name: str) -> None:
    exact = load_model(name)
    view = load_view(name)
    fast = replace(load_model(name, "cuda"), precision="float32")
    points = random_points(view, 900)
    cloud = view.depth.to_points()
    expected, answer = (model.query(model.encode(cloud), points) for model in (exact, fast))
    assert (answer.label != expected.label).mean() < 0.01
    assert abs(answer.distance - expected.distance).mean() < 0.01 * (points.max() - points.min())
