"""The commands as functions, with what they leave returned; and the lines of the README."""

import inspect
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic import untrained

import mereo
from mereo.api import steps
from mereo.scenes.registry import load_scene
from mereo.synthesis.config import GenerateConfig
from mereo_learning import shards
from mereo_learning.config import PRESETS, TrainConfig
from mereo_learning.learn import LearnConfig


def test_generate_and_train_are_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[Any, ...]] = []
    monkeypatch.setattr(shards, "generate", lambda *given, **named: calls.append((*given, named)))
    assert mereo.generate(tmp_path / "mine.yaml", str(tmp_path / "data"), examples=3, workers=2) == tmp_path / "data"
    ((scene, output, config, named),) = calls
    assert (scene, output) == (str(tmp_path / "mine.yaml"), tmp_path / "data")
    assert config == shards.DatasetConfig(GenerateConfig(), 3, 0)
    assert named == {"workers": 2, "shard": (0, 1), "resume": False}
    trained: list[TrainConfig] = []
    monkeypatch.setattr(steps.trainer, "train", lambda data, run, recipe, device: trained.append(recipe) or run / "w")
    assert mereo.train("data", tmp_path, "tiny", init="rope") == tmp_path / "w"
    assert trained == [replace(PRESETS["tiny"], init="rope")]
    with pytest.raises(ValueError, match="the preset is 'tinny'; it must be one of paper, .*: correct the spelling"):
        inspect.unwrap(mereo.train)("data", tmp_path, "tinny")
    with pytest.raises(TypeError, match="epoch"):
        mereo.train("data", tmp_path, epoch=3)


def test_evaluate_scores_with_and_without_a_folder(tmp_path: Path) -> None:
    model = untrained(load_scene("rope").rest.names)
    alone = mereo.evaluate(model, examples=1, cells=8, method="network", progress=False)
    written = mereo.evaluate(
        model, scene=load_scene("rope"), output=tmp_path / "out", examples=1, cells=8, method="network"
    )
    np.testing.assert_array_equal(alone.confusion, written.confusion)
    assert len(alone.seconds) == 1
    assert json.loads((tmp_path / "out/metrics.json").read_text())["scene"] == "rope"
    with pytest.raises(ValueError, match="scans are real and take no simulated camera"):
        mereo.evaluate(model, scans=(), settings=GenerateConfig(image_size=48))


def test_learn_and_export_return_what_they_leave(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    scores = {"iou": 0.9, "miou": 0.8, "trained": True, "method": "auto"}
    monkeypatch.setattr(steps.learning, "learn", lambda files, output, config: calls.append((files, config)) or scores)
    learned = mereo.learn("rope", tmp_path, minutes=3)
    assert calls == [([Path("rope")], LearnConfig(minutes=3))]
    assert learned.weights == tmp_path / "weights.safetensors" and learned.scene == "rope" and learned.miou == 0.8
    assert repr(learned) == f"Learned({str(tmp_path)!r}: trained, method auto, IoU 0.900, mIoU 0.800)"
    scores |= {"trained": False, "method": "search"}
    learned = mereo.learn("rope", tmp_path, train="never")
    assert learned.weights is learned.report is None and learned.method == "search" and learned.folder == tmp_path
    with pytest.raises(
        ValueError, match="train is 'once'; it must be one of auto, always, never: correct the spelling"
    ):
        inspect.unwrap(mereo.learn)("rope", tmp_path, train="once")
    monkeypatch.setattr(steps, "export_weights", lambda *given: calls.append(given))
    assert mereo.export("rope", tmp_path / "graphs", "torch") == tmp_path / "graphs"
    assert calls[-1] == ("rope", tmp_path / "graphs", "torch", False)


@pytest.mark.slow
def test_the_lines_of_the_readme_run_as_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[2] / "README.md").read_text("utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(code, "README.md", "exec"), names)
    result = names["result"]
    assert result.taken and result.known is True and result["head"].error_radius > 0
    here = result.registered.to_camera([[0.0, 1.0, 2.0]])
    np.testing.assert_allclose(result.registered.to_rest(here), [[0, 1, 2]], atol=0.01)
    assert sorted(path.name for path in (tmp_path / "result").glob("[!.]*")) == [
        *("labels.npz", "preview.png", "radius95.glb", "report.html", "segments.glb", "state.json", "summary.json")
    ]
