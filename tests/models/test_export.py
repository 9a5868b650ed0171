"""Exported networks answer as the network does: ONNX Runtime, torch.export, and the runner without torch."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from folder_contents import read_json
from numpy import ndarray
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from torch import Tensor

from mereo.geometry.downsampling import farthest_point_order
from mereo.geometry.mesh import PALETTE
from mereo.io.atomic_files import JsonObject
from mereo.models.config import NetworkConfig
from mereo.models.export.mereo_onnx import main, prepare
from mereo.models.export.onnx_export import ANSWERS, RUNNER, code_tensors, export_weights
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.weights import load_model, save_model
from mereo.scenes.rest_pose import TEMPLATE_NODES, TEMPLATE_REACH
from mereo_learning.config import PRESETS

TOLERANCE = 1e-4

NAMES = ("head", "left ear", "tail")

TINY = PRESETS["tiny"].network

SMALL = NetworkConfig().changed(
    points=96, neighbors=16, mlp1=(16, 16), mlp2=(16, 24), mlp_global=(24, 32), width=32, depth=3, skip_after=2
)
"""The paper's structure in small: no alignment, no local features, no template."""

CASES = {
    "plain": (SMALL.changed(sight_neighbors=4), "l1"),
    "everything": (TINY, "ce+l1+cd"),
    "transformer": (
        TINY.changed(encoder="point-transformer", points=320, transformer_widths=(8, 16, 24, 32, 40)),
        "ce+l1+cd",
    ),
}


def model_of(config: NetworkConfig, loss: str) -> Model:
    """With the statistics of two batches, and a template that is a ball for each segment."""
    torch.manual_seed(3)
    network = Network(config, len(NAMES))
    if config.additions.rest_template:
        lookup = network.decoder.lookup
        axis = torch.linspace(-TEMPLATE_REACH, TEMPLATE_REACH, TEMPLATE_NODES)
        places = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        centers = torch.tensor([[0.3, 0.0, 0.1], [-0.2, 0.5, 0.0], [0.0, -0.4, -0.6]])
        lookup.distance.copy_(torch.stack([(places - center).norm(dim=-1) - 0.5 for center in centers]))
        for layer in (lookup.where, lookup.read):
            torch.nn.init.normal_(layer.weight, std=0.1)
    clouds = torch.stack([torch.from_numpy(seen(config.points, seed)) for seed in (0, 1)])
    network.train()
    with torch.no_grad():
        for _ in range(2):
            network(clouds, torch.tensor([[0.2, -0.1, -8.0]] * 2), 2 * torch.rand(2, 64, 3) - 1)
    domain = ((-1.2, -1.2, -1.2), (1.2, 1.2, 1.4))
    return Model(
        network.eval().requires_grad_(False), NAMES, PALETTE[: len(NAMES)], loss, {"scene": "rope"}, domain=domain
    )


def seen(count: int, seed: int) -> ndarray:
    """Normalized points on a bent surface, in random order, float32."""
    u, v = default_rng(seed).uniform(-1, 1, (2, count))
    return np.stack([u, 0.7 * v, 0.4 * np.sin(2 * u) + 0.3 * v * v], axis=1).astype(np.float32)


SHIPPED = "bunny"


def inputs_of(model: Model) -> Iterator[tuple[Tensor, Tensor]]:
    """Clouds in the order of the model, and points to query: one, then more of both than the model's own number."""
    for extra, queries in ((0, 1), (31, 100)):
        points = seen(model.network.config.points + extra, 5)
        cloud = torch.from_numpy(points[farthest_point_order(points, len(points))])[None]
        yield cloud, 3.0 * torch.rand(1, queries, 3, generator=torch.Generator().manual_seed(1)) - 1.5


def answers_of(model: Model, cloud: Tensor, points: Tensor) -> tuple[ndarray, ...]:
    with torch.inference_mode():
        code = model.network.encode(cloud, torch.tensor([[0.1, -0.2, -8.0]]))
        return tuple(part.numpy() for part in model.respond(model.network.query(code, points), points))


def agree(found: JsonObject, expected: tuple[ndarray, ...]) -> None:
    for name, wanted in zip(ANSWERS, expected, strict=True):
        got = np.asarray(found[name])
        assert got.shape == wanted.shape
        assert_allclose(got, wanted, atol=TOLERANCE, rtol=TOLERANCE, err_msg=name)
    assert np.asarray(found["logits"]).std() > 100 * TOLERANCE, "the comparison would be empty"


Exported = tuple[Model, Path]
"""A model and the folder that it was exported to."""


def export(case: str, place: Path, kind: str) -> Exported:
    """By the command, in a process of its own: the tests' shape checks know no sizes that are left open."""
    weights = case
    if case != SHIPPED:
        weights = str(place / "w.safetensors")
        config, loss = CASES.get(case) or (PRESETS[case].network, "ce+l1+cd")
        save_model(model_of(config, loss), Path(weights))
    command = [sys.executable, "-m", "mereo", "export", weights, "--output", str(place / "out"), "--format", kind]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0 and "wrote" in run.stdout and run.stderr == "", run.stderr
    return load_model(weights), place / "out"


@pytest.mark.slow
@pytest.mark.parametrize("case", ["plain", "everything"])
def test_a_reloaded_torch_program_answers_as_the_network(tmp_path: Path, case: str) -> None:
    model, folder = export(case, tmp_path, "torch")
    assert sorted(path.name for path in folder.glob("[!.]*")) == ["encoder.pt2", "model.json", "query.pt2"]
    encoder, query = (torch.export.load(folder / f"{name}.pt2").module() for name in ("encoder", "query"))
    wanted = read_json(folder / "model.json")["query_inputs"]
    for cloud, places in inputs_of(model):
        given = {**encoder(cloud), "cloud": cloud, "viewpoint": torch.tensor([[0.1, -0.2, -8.0]])}
        found = query(places, {name: given[name] for name in wanted})
        agree(found, answers_of(model, cloud, places))


def test_an_autodecoder_is_refused(tmp_path: Path) -> None:
    config = PRESETS["tiny"].network.changed(encoder="autodecoder", local_neighbors=0)
    save_model(Model(Network(config, 3).eval(), NAMES, PALETTE[:3]), tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match=r"an autodecoder's, which finds .* by gradient steps; .*: train with"):
        export_weights(tmp_path / "w.safetensors", tmp_path / "out", "torch")
    assert [path.name for path in tmp_path.iterdir()] == ["w.safetensors"]


def test_missing_packages_are_named_with_their_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.models.export.onnx_export.find_spec", lambda name: name != "onnxscript" or None)
    with pytest.raises(ImportError, match=r"onnxscript is needed to export to ONNX: pip install 'mereo\[onnx\]'"):
        export_weights(SHIPPED, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def raw_cloud(count: int, seed: int = 0) -> ndarray:
    points = np.concatenate([seen(count - 5, seed), seen(count - 5, seed)[:5]])
    return default_rng(seed).permutation(0.05 * points.astype(float) + [0.1, -0.2, 0.7])


@pytest.mark.parametrize("count", [40, 256, 1500, 5000])
def test_the_runner_prepares_clouds_as_the_model_does(count: int) -> None:
    """Bit by bit: few points are repeated, many are ordered, very many are thinned first."""
    model = model_of(*CASES["everything"])
    settings = {"points": 256, "dense_factor": 8, "fewest_points_of_a_cloud": 32}
    found, center, scale = prepare(raw_cloud(count), settings)
    code = model.encode(raw_cloud(count))
    assert_array_equal(found, code.code.cloud[0].numpy())
    assert_array_equal(center, code.normalizer.center)
    assert scale == code.normalizer.scale


@pytest.mark.parametrize(
    "cloud, text",
    [
        (np.zeros((40, 2)), r"has shape \(40, 2\); it must be \[n, 3\]"),
        (np.ones((31, 3)), "has 31 points; the encoder needs at least 32"),
        (-np.ones((40, 3)), "points have z <= 0, behind the camera"),
        (np.ones((40, 3)), "all points coincide"),
    ],
)
def test_the_runner_refuses_unusable_clouds(cloud: ndarray, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        prepare(cloud, {"points": 256, "dense_factor": 8, "fewest_points_of_a_cloud": 32})


def test_the_runner_says_in_one_line_what_is_wrong_and_replaces_nothing_unasked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    output = tmp_path / "out.npz"
    output.write_text("precious")
    arguments = ["mereo_onnx.py", "c.npy", "--points", "q.npy", "--model", str(tmp_path), "-o", str(output)]
    for more, text in (
        ((), "out.npz exists; it is not overwritten: choose another --output"),
        (("--force",), "model.json"),
    ):
        monkeypatch.setattr(sys, "argv", [*arguments, *more])
        assert main() == 2
        assert re.fullmatch(rf"mereo_onnx: error: .*{text}.*\n", capsys.readouterr().err)
    assert output.read_text() == "precious"


def test_the_runner_is_short_and_needs_numpy_and_onnxruntime_only() -> None:
    source = RUNNER.read_text(encoding="utf-8")
    assert len(source.splitlines()) < 140
    tree = ast.parse(source, feature_version=(3, 8))
    imported = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    imported |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imported - set(sys.stdlib_module_names) == {"numpy", "onnxruntime"}


FULL_SIZE = "paper"
"""A preset as it is; `base` is what the shipped weights are, and `large` is `base` with other widths."""


@pytest.fixture(scope="module", params=[*CASES, FULL_SIZE, SHIPPED])
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """A model, and the folder of its graphs as the command writes it."""
    for package in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(package, reason=f"{package} is not installed: pip install 'mereo[onnx]'")
    return export(request.param, tmp_path_factory.mktemp(request.param), "onnx")


@pytest.mark.slow
def test_onnx_graphs_answer_as_the_network_and_the_folder_says_what_it_holds(exported: Exported) -> None:
    import onnxruntime

    model, folder = exported
    encoder, query = (onnxruntime.InferenceSession(folder / f"{name}.onnx") for name in ("encoder", "query"))
    names = [output.name for output in encoder.get_outputs()]
    for cloud, places in inputs_of(model):
        given = dict(zip(names, encoder.run(names, {"cloud": cloud.numpy()}), strict=True))
        with torch.inference_mode():
            code = code_tensors(model.network.encode(cloud, torch.zeros(1, 3)))
        for name, tensor in code.items():
            assert_allclose(given[name], tensor.numpy(), atol=TOLERANCE, err_msg=name)
        given |= {"cloud": cloud.numpy(), "viewpoint": np.array([[0.1, -0.2, -8.0]], np.float32)}
        given["points"] = places.numpy()
        found = query.run(ANSWERS, {entry.name: given[entry.name] for entry in query.get_inputs()})
        agree(dict(zip(ANSWERS, found, strict=True)), answers_of(model, cloud, places))
    assert {"encoder.onnx", "query.onnx", "model.json", "mereo_onnx.py"} <= {path.name for path in folder.iterdir()}
    settings = read_json(folder / "model.json")
    assert settings["points"] == model.network.config.points
    assert settings["names"] == (list(model.names) if model.segmented else ["object"])
    assert len(settings["colors"]) == len(settings["names"])


ALONE = """
import runpy, sys
sys.modules["torch"] = sys.modules["mereo"] = None  # importing either is now an error
sys.argv = ["mereo_onnx.py", "frame.npy", "--points", "queries.npy", "-o", "out.npz"]
runpy.run_path("mereo_onnx.py", run_name="__main__")
"""


@pytest.mark.slow
def test_the_runner_answers_as_the_model_without_torch(exported: Exported) -> None:
    model, folder = exported
    cloud = raw_cloud(3000)
    low = cloud.min(axis=0)
    high = cloud.max(axis=0)
    size = np.ptp(cloud, axis=0).max()
    queries = default_rng(2).uniform(low - 0.3 * size, high + 0.3 * size, (20_000, 3))
    np.save(folder / "frame.npy", cloud)
    np.save(folder / "queries.npy", queries)
    run = subprocess.run([sys.executable, "-c", ALONE], cwd=folder, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    expected = model.query(model.encode(cloud), queries)
    with np.load(folder / "out.npz") as found:
        assert (found["labels"] == expected.label).mean() >= 0.999
        assert len(np.unique(found["labels"])) > 1
        # a query may have another nearest point by rounding, where two are as near
        for name, wanted, unit in (("distances", expected.distance, size), ("directions", expected.direction, 1.0)):
            assert_array_equal(np.isnan(found[name]), np.isnan(wanted))
            difference = np.abs(np.nan_to_num(found[name]) - np.nan_to_num(wanted))
            assert (difference <= TOLERANCE * unit).mean() >= 0.999, f"{name}: {difference.max()}"
        assert tuple(found["names"]) == (model.names if model.segmented else ("object",))
