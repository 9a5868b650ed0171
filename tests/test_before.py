"""What an earlier mereo wrote is still good: datasets, interrupted runs, weights (how: ``before/README.md``).

Values are compared within the precision of what computes them: other processors add in another order. Public names and
the command line only, so that the tests outlive any move of modules.
"""

import json
import shutil
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

import mereo
from mereo.__main__ import main

BEFORE = Path(__file__).parent / "before"
SHARD = "shard-00000.safetensors"
GENERATE = "--examples 12 --seed 7 --workers 1 --points 96 --per-segment 12 --uniform-fraction 0.15"  # the default then
TRAIN = (
    "--preset tiny --precision float32 --compile off --batch 4 --queries 96 --epochs 4 --network.points 64 "
    "--network.neighbors 8 --network.mlp1 8 8 --network.mlp2 8 16 --network.mlp-global 16 16 --network.width 16 "
    "--network.depth 3 --network.skip-after 2 --network.lowest-exponent -2 --network.highest-exponent 3 "
    "--network.local-width 8 --network.align-points 32 --network.no-rest-template"
)
SHIPPED = sorted(Path(mereo.__file__).parent.rglob("weights/*.safetensors"))


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Sums are split among threads, so their number moves last bits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def mereo_does(*arguments: object) -> None:
    """Options are text, paths are not split."""
    assert main([part for a in arguments for part in (a.split() if isinstance(a, str) else [str(a)])]) == 0


def header(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as file:
        found: dict[str, Any] = json.loads(file.metadata()["mereo"])
    return found


def save_again(model: mereo.Model, path: Path, dtype: torch.dtype) -> Path:
    """With ``save_model``, which lies wherever ``load_model`` does."""
    import_module(mereo.load_model.__module__).save_model(model, path, dtype)
    return path


def assert_close(now: dict[str, Any], then: dict[str, Any], tolerance: float) -> None:
    """The same arrays, to a tolerance."""
    assert now.keys() == then.keys()
    for name, value in then.items():
        assert now[name].dtype == value.dtype and now[name].shape == value.shape, name
        found, expected = np.asarray(now[name]), np.asarray(value)
        np.testing.assert_allclose(
            found.astype(float), expected.astype(float), rtol=tolerance, atol=tolerance, err_msg=name
        )


# --- datasets ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def remade(tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("before") / "rope"
    mereo_does("generate rope", GENERATE, "--output", target)
    return target


def test_a_dataset_is_made_again(tmp_path: Path) -> None:
    """But for a rare query that falls on the other side of a surface."""
    remade = tmp_path / "lizard"
    mereo_does("generate lizard", GENERATE, "--output", remade)
    now, then = load_file(remade / SHARD), load_file(BEFORE / "lizard" / SHARD)
    assert {k: (v.dtype, v.shape) for k, v in now.items()} == {k: (v.dtype, v.shape) for k, v in then.items()}
    for name, value in then.items():
        same = torch.isclose(now[name].double(), value.double(), rtol=1e-3, atol=1e-3, equal_nan=True)
        assert same.double().mean() > 0.99, name
    manifests = [json.loads((folder / "manifest.json").read_text()) for folder in (remade, BEFORE / "lizard")]
    for manifest in manifests:
        del manifest["libraries"], manifest["version"], manifest["rest_sha256"]  # of vertices that are rounded since
    assert set(manifests[0].pop("files")) >= {SHARD, "template.safetensors"}  # which it has had since
    assert manifests[0] == manifests[1]


def test_a_datasets_template_is_made_again(remade: Path) -> None:
    with np.load(BEFORE / "answers.npz") as answers:
        then = {"distance": answers["template"]}
    now = {"distance": load_file(remade / "template.safetensors")["distance"].numpy()[:, ::9, ::9, ::9]}
    assert_close(now, then, 1e-3)


def test_a_dataset_is_continued(remade: Path, tmp_path: Path) -> None:
    """Its settings are recognized as those of the same command, and a lost shard comes back."""
    data = tmp_path / "rope"
    shutil.copytree(BEFORE / "rope", data)
    manifest = json.loads((data / "manifest.json").read_text())
    manifest["rest_sha256"] = json.loads((remade / "manifest.json").read_text())["rest_sha256"]  # rounded since
    (data / "manifest.json").write_text(json.dumps(manifest | {"version": mereo.__version__}))
    shutil.copy(remade / "template.safetensors", data)
    mereo_does("generate rope", GENERATE, "--output", data, "--resume")
    assert (data / SHARD).read_bytes() == (BEFORE / "rope" / SHARD).read_bytes(), "what is there is kept"
    (data / SHARD).unlink()
    mereo_does("generate rope", GENERATE, "--output", data, "--resume")
    assert (data / SHARD).read_bytes() == (remade / SHARD).read_bytes()


# --- runs -------------------------------------------------------------------------------------------------------------


def test_an_interrupted_run_is_continued(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It ends as the uninterrupted run did, from its checkpoint and not from the start."""
    run = tmp_path / "run"
    shutil.copytree(BEFORE / "run", run)
    settings = (run / "config.json").read_bytes()
    mereo_does("train", BEFORE / "rope", "--output", run, TRAIN)
    assert "continuing from step 5 of 11" in capsys.readouterr().out
    assert (run / "config.json").read_bytes() == settings
    rows = (run / "metrics.csv").read_text().splitlines()
    assert rows[:6] == (BEFORE / "run" / "metrics.csv").read_text().splitlines()
    assert [row.partition(",")[0] for row in rows[1:]] == [str(step) for step in range(1, 12)]
    now, then = header(run / "weights.safetensors"), header(BEFORE / "weights.safetensors")
    offsets = [part["provenance"].pop("class_offsets") for part in (now, then)]
    np.testing.assert_allclose(*offsets, atol=1.0)  # from a choice among a few steps
    assert now["provenance"].pop("examples_before") == 0 and now["provenance"]["recipe"].pop("learned_box") is True
    assert now == then
    ended = [load_file(folder / "weights.safetensors") for folder in (run, BEFORE)]
    for tensors in ended:
        del tensors["decoder.head.bias"]  # holds the offsets
    assert_close(*ended, tolerance=1e-2)


# --- weights ----------------------------------------------------------------------------------------------------------


def test_weights_answer_as_before() -> None:
    with np.load(BEFORE / "answers.npz") as file:
        then = {name: file[name] for name in ("cloud", "points", "label", "probability", "distance", "direction")}
    cloud, points, label = (then.pop(name) for name in ("cloud", "points", "label"))
    model = mereo.load_model(BEFORE / "weights.safetensors")
    answer = model.query(model.encode(cloud), points)
    assert_close({name: getattr(answer, name) for name in then}, then, 1e-4)
    first, second = np.sort(then["probability"], axis=1)[:, :-3:-1].T
    sure = first - second > 1e-3
    assert sure.mean() > 0.9 and np.array_equal(answer.label[sure], label[sure])


def test_weights_are_saved_as_before(tmp_path: Path) -> None:
    path = BEFORE / "weights.safetensors"
    again = save_again(mereo.load_model(path), tmp_path / "again.safetensors", torch.float32)
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_weights_are_read(path: Path, tmp_path: Path) -> None:
    """Every statement of the header is in the model, and the tensors go through it unchanged."""
    model, said = mereo.load_model(path.stem), header(path)
    for name in ("names", "colors", "loss", "domain", "nested", "provenance"):
        if name in said:
            assert json.loads(json.dumps(getattr(model, name))) == said[name], name
    stored, held = load_file(path), model.network.state_dict()
    tensors = {name: value for name, value in stored.items() if not name.startswith("states.")}
    assert (model.statistical_model is None) == (len(tensors) == len(stored))
    assert held.keys() == tensors.keys()
    assert all(torch.equal(held[name].double(), unpacked(value)) for name, value in tensors.items())
    saved = save_again(model, tmp_path / "again.safetensors", torch.float16)
    again, network = load_file(saved), header(saved)["network"]
    assert {name: network[name] for name in said["network"]} == said["network"]
    # version 1 kept the template in float16, today it is packed in bytes
    repacked = {"decoder.lookup.distance"} if said["version"] == 1 else set()
    assert all(torch.equal(again[name], value) for name, value in tensors.items() if name not in repacked)


def unpacked(stored: torch.Tensor) -> torch.Tensor:
    """A stored tensor's meaning: bytes are ``127 d / (|d| + 0.1)`` of a distance d."""
    if stored.dtype != torch.int8:
        return stored.double()
    share = stored.float() / 127
    return (0.1 * share / (1 - share.abs())).double()


def test_there_are_shipped_weights() -> None:
    assert {"bunny", "liver", "rope", "tumor"} <= {path.stem for path in SHIPPED}
