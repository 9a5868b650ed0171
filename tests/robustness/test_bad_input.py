"""What a user sees after a mistake: one line that says value, rule and cure, exit code 2, and nothing half-written."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from mereo import __main__ as command_line
from mereo.geometry.mesh import Segment, SegmentedMesh, check_segment
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.weights import load_model, save_model
from mereo_learning.config import PRESETS


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    network = Network(PRESETS["tiny"].network, 2).eval()
    save_model(Model(network, ("a", "b"), ((1, 2, 3), (4, 5, 6))), path)
    return path


def sphere() -> Segment:
    ball = trimesh.creation.icosphere(3)
    return Segment("ball", (1, 2, 3), np.asarray(ball.vertices), np.asarray(ball.faces, np.int64))


def refused(capsys: pytest.CaptureFixture[str], folder: Path, text: str, *arguments: object) -> None:
    """The command fails with one line that contains ``text`` and makes no output."""
    before = sorted(folder.rglob("*"))
    code = command_line.main([str(a) for a in arguments])
    message = capsys.readouterr().err.strip()
    assert code == 2, message
    assert message.startswith("mereo: error: ") and "\n" not in message, message
    assert text in message, message
    assert sorted(folder.rglob("*")) == before


def cloud(count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).normal(loc=(0.0, 0.0, 20.0), size=(count, 3))


BAD_CLOUDS = {
    "missing": (None, "missing.npy"),
    "too few": (cloud(20), "has 20 points; a reconstruction needs at least 32"),
    "behind": (cloud() - [0.0, 0.0, 40.0], "behind the camera"),
    "one place": (np.ones((100, 3)), "all points coincide"),
}


@pytest.mark.parametrize("case", BAD_CLOUDS)
def test_bad_clouds(case: str, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, text = BAD_CLOUDS[case]
    path = tmp_path / "missing.npy"
    if points is not None:
        np.save(path, points)
    refused(capsys, tmp_path, text, "reconstruct", path, "--weights", weights, "--output", tmp_path / "out")


@pytest.mark.parametrize("number", ["1e400", "1e300", "nan"])
def test_a_mesh_beyond_all_numbers(number: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places, faces = f"v 0 0 0\nv {number} 0 0\nv 0 1 0\nv 0 0 1\n", "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / "part.obj").write_text(places + faces)
    text = "part.obj cannot be read as a mesh (its part 'part' has vertices that are NaN, infinite or beyond 1e+12)"
    refused(capsys, tmp_path, text, "learn", tmp_path / "part.obj", "--output", tmp_path / "out")


def test_bad_segments_are_named_with_the_cure() -> None:
    ball = sphere()
    cases = {
        r"segment 'ball' has 3 open edges; it must be closed: fill its holes": replace(ball, faces=ball.faces[1:]),
        r"segment 'ball' has volume -.*it must be positive.*reverse them": replace(ball, faces=ball.faces[:, ::-1]),
        r"edges whose faces disagree in orientation": replace(
            ball, faces=np.concatenate([ball.faces[:1, ::-1], ball.faces[1:]])
        ),
        r"NaN or infinite vertices": replace(ball, vertices=np.where(ball.vertices > 0.99, np.nan, ball.vertices)),
        r"refers to vertex 700 of 642": replace(ball, faces=np.concatenate([ball.faces, [[0, 1, 700]]])),
        r"has no faces": replace(ball, faces=ball.faces[:0]),
    }
    check_segment(ball)
    for text, segment in cases.items():
        with pytest.raises(ValueError, match=text):
            check_segment(segment)


def test_segment_names_are_unique_and_few() -> None:
    with pytest.raises(ValueError, match="'ball' is used twice"):
        SegmentedMesh((sphere(), sphere()))
    with pytest.raises(ValueError, match="0 segments"):
        SegmentedMesh(())
    with pytest.raises(ValueError, match="at most 254"):
        SegmentedMesh(tuple(replace(sphere(), name=str(i)) for i in range(255)))


def test_half_precision_weights_answer_alike(weights: Path, tmp_path: Path) -> None:
    model = load_model(weights)
    assert model.names == ("a", "b") and model.colors == ((1, 2, 3), (4, 5, 6)) and not model.network.training
    save_model(model, tmp_path / "half.safetensors", torch.float16)
    half = load_model(tmp_path / "half.safetensors")
    points = cloud()
    full, rounded = (m.query(m.encode(points), points[:50]).probability for m in (model, half))
    assert np.abs(full - rounded).max() < 0.02
    assert (tmp_path / "half.safetensors").stat().st_size < 0.6 * weights.stat().st_size


def test_nothing_is_found_where_nothing_ever_was_in_training(weights: Path) -> None:
    """An untrained network says anything anywhere; outside its domain the answer is empty all the same."""
    points = cloud()
    wild = replace(load_model(weights), domain=None)
    code = wild.encode(points)
    places = code.normalizer.invert(np.random.default_rng(1).uniform(-4, 4, size=(3000, 3)))
    outside = (np.abs(code.normalizer.apply(places)) > 1.5).any(axis=1)
    tame = replace(wild, domain=((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5)))
    assert (wild.query(code, places).label[outside] > 0).any()
    answer = tame.query(code, places)
    assert (answer.label[outside] == 0).all() and answer.probability[outside, 0].min() > 0.999
    assert np.array_equal(answer.label[~outside], wild.query(code, places).label[~outside])
