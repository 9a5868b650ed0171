"""A result names the scene file that it was made with, and the viewer opens it again while that is as it was."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic import untrained
from answers import answer_to
from scene_files import write_bar

from mereo.__main__ import main
from mereo.api.result import Result
from mereo.evaluation.sample_views import load_view
from mereo.fitting.draws.playback import Drawn, material_moved
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.registration.state import STATE, save_state, state_of
from mereo.io.atomic_files import write_json
from mereo.models.model import Model
from mereo.models.weights import load_model, save_model
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene
from mereo.visualization.result_files import summary_of
from mereo.visualization.result_scene import scene_facts, scene_of_result
from mereo.visualization.viewer import serve

BENDS = "deformations:\n  - type: lattice\n    strength: 0.5\n"
PYTHON = """\
from dataclasses import replace
from mereo.scenes.registry import load_scene
def scene():
    return replace(load_scene({file!r}), name="trusted")
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a scene file, weights, and a result by the scene's draws."""
    folder = tmp_path_factory.mktemp("own")
    scene = load_scene(write_bar(folder, BENDS))
    model = replace(untrained(scene.rest.names, "bar"), statistical_model=scene_model(scene, count=40))
    save_model(model, folder / "weights.safetensors")
    states, drawn = load_model(folder / "weights.safetensors").statistical_model, Drawn.of(scene, 3)
    deformations = drawn.deformations(scene, drawn.z)
    assert states is not None and deformations is not None
    material = material_moved(scene, states, deformations) + np.array([0.0, 0.0, 150.0])
    found = Registration(states, material, "draws", drawn.z, 1.0, True, 0.98, True, 0.1, drawn)
    save_state(folder / "result" / STATE, state_of(found, scene, weights=str(folder / "weights.safetensors")))
    write_json(folder / "result/summary.json", {"points": 7, **scene_facts(scene)})
    return folder


@pytest.fixture
def result(made: Path, tmp_path: Path) -> Path:
    """A copy of the result, whose summary a test may change."""
    for name in (STATE, "summary.json"):
        (tmp_path / name).write_bytes((made / "result" / name).read_bytes())
    return tmp_path


def telling(result: Path, **changed: str) -> None:
    summary = json.loads((result / "summary.json").read_text())
    write_json(result / "summary.json", {**summary, "scene_file": {**summary["scene_file"], **changed}})


def test_the_viewer_opens_the_scene_of_an_object_of_ones_own(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages: list[tuple[Any, ...]] = []
    monkeypatch.setattr(serve, "import_viser", lambda: None)
    monkeypatch.setattr(serve, "start_server", lambda *_: None)
    monkeypatch.setattr(serve, "FramePage", lambda *given: pages.append(given))
    monkeypatch.setattr(serve.OpenPage, "__init__", lambda *_: None)
    monkeypatch.setattr(serve.OpenPage, "stay", lambda page, _: page)
    for path in (made / "result", made / "result" / STATE):
        assert main(["view", str(path)]) == 0
        registration = pages.pop()[1].registration
        assert registration.method == "draws" and registration.model.rest.names == ("left", "right")


def test_a_result_names_the_file_as_it_was_given(
    rope: Model, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(made)
    given = load_scene("bar.yaml")
    found = answer_to(load_view("rope").depth.to_points(), rope, None, 16)
    assert rope.statistical_model is not None
    registrar = Registrar(rope, rope.statistical_model, "modes", given)
    Result.of(replace(found, registrar=registrar)).save(tmp_path / "own", formats=["json"])
    told = json.loads((tmp_path / "own/summary.json").read_text())["scene_file"]
    assert told == scene_facts(given)["scene_file"] and told["path"] == "bar.yaml" and len(told["sha256"]) == 64
    assert "scene_file" not in summary_of(found)
    assert scene_facts(load_scene("rope")) == {} == scene_facts(None)
    opened = scene_of_result(tmp_path / "own")
    assert opened is not None and opened.definition == given.definition
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"own was made with the scene file bar.yaml, which is not there"):
        scene_of_result(tmp_path / "own")


def changed_strength(made: Path) -> None:
    (made / "bar.yaml").write_text((made / "bar.yaml").read_text().replace("0.5", "0.4"))


def changed_mesh(made: Path) -> None:
    (made / "left.stl").write_bytes((made / "right.stl").read_bytes())


@pytest.mark.parametrize("change", [changed_strength, changed_mesh])
def test_a_scene_that_has_changed_is_told(change: Callable[[Path], None], tmp_path: Path) -> None:
    scene = load_scene(write_bar(tmp_path, BENDS))
    write_json(tmp_path / "summary.json", scene_facts(scene))
    (tmp_path / "bar.yaml").write_text("# a comment\n" + (tmp_path / "bar.yaml").read_text())
    assert scene_of_result(tmp_path) is not None
    change(tmp_path)
    with pytest.raises(ValueError, match=r"bar.yaml; that or its meshes have changed since: bring them back"):
        scene_of_result(tmp_path)


def test_no_python_is_run_for_a_result(made: Path, result: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = result / "mine.py"
    code.write_text(PYTHON.format(file=str(made / "bar.yaml")))
    assert load_scene(code).file == code
    code.write_text("raise SystemExit('this was run')")
    telling(result, path=str(code))
    assert main(["view", str(result)]) == 2
    told = capsys.readouterr().err
    assert f"scene file {code}, and files of results run no Python" in told and "--scene" in told
    assert "this was run" not in told and told.count("\n") == 1


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"scene_file": "x.yaml"}', '{"scene_file": {"path": 3}}'])
def test_a_summary_that_names_no_scene_leaves_the_old_sentence(
    content: str, result: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (result / "summary.json").write_text(content)
    assert scene_of_result(result) is None
    assert main(["view", str(result)]) == 2
    assert "scene 'bar', which is not built in: name its file with --scene" in capsys.readouterr().err
