"""Each command calls its part of the library with the options it was given."""

import inspect
from importlib import import_module
from pathlib import Path

import pytest

import mereo.__main__ as command_line
from mereo.cli.answers import ReconstructCommand
from mereo.cli.options import Outcome
from mereo.cli.reconstruct import FrameJob
from mereo.io.config import InputConfig
from mereo.models.config import InferenceConfig
from mereo.synthesis.config import GenerateConfig
from mereo_learning.config import PRESETS
from mereo_learning.scoring import EvaluationConfig
from mereo_learning.shards import DatasetConfig


@pytest.mark.parametrize(
    ("text", "module", "function", "expected"),
    [
        (
            "generate rope --examples 7 --seed 3 --output out --workers 2 --shard 1/4 --resume",
            "mereo_learning.shards",
            "generate",
            {
                "config": DatasetConfig(GenerateConfig(), 7, 3),
                "output": Path("out"),
                "workers": 2,
                "shard": (1, 4),
                "resume": True,
            },
        ),
        (
            "train data --output run --preset tiny",
            "mereo.api.steps",
            "train",
            {"dataset": Path("data"), "output": Path("run"), "config": PRESETS["tiny"]},
        ),
        (
            "evaluate bunny --output out --examples 4 --seed 1000001",
            "mereo_learning.evaluation_report",
            "evaluate_weights",
            {"weights": "bunny", "output": Path("out"), "config": EvaluationConfig(None, 4, 1_000_001), "workers": 1},
        ),
        (
            "reconstruct a.png --weights rope --output out --intrinsics k.json --depth-scale 5000 --mask m.png --force",
            "mereo.cli.reconstruct",
            "reconstruct_inputs",
            {
                "inputs": (Path("a.png"),),
                "output": Path("out"),
                "job": FrameJob(
                    ReconstructCommand(
                        (Path("a.png"),),
                        weights="rope",
                        output=Path("out"),
                        reading=InputConfig(Path("k.json"), 5000.0, Path("m.png")),
                        force=True,
                    ),
                    InferenceConfig(),
                ),
            },
        ),
    ],
)
def test_command_calls_the_library_with_its_options(
    text: str,
    module: str,
    function: str,
    expected: dict[str, object],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    library = import_module(module)
    signature = inspect.signature(getattr(library, function))
    calls: list[dict[str, object]] = []
    returned = {"reconstruct_inputs": Outcome({})}.get(function)

    def called(*given: object, **named: object) -> object:
        calls.append(signature.bind(*given, **named).arguments)
        return returned

    monkeypatch.setattr(library, function, called)
    assert command_line.main(text.split()) == 0
    (call,) = calls
    assert {name: call[name] for name in expected} == expected
