"""The command line as a user meets it: help at once, one line for every error, the exit codes of a good citizen."""

import inspect
import io
import os
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import lru_cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from folder_contents import run_mereo

import mereo.__main__ as command_line
from mereo.api.result import Result
from mereo.cli import tools as doctor
from mereo.cli import training
from mereo.cli.answers import ReconstructCommand
from mereo.cli.options import Outcome
from mereo.cli.reconstruct import FrameJob, print_segments
from mereo.geometry.conventions import Names, Texts
from mereo.io.config import InputConfig
from mereo.models import device
from mereo.models.config import InferenceConfig
from mereo.reconstruction.pipeline import SegmentFacts
from mereo.scenes.scene import SCENES
from mereo.synthesis.config import GenerateConfig
from mereo_learning.config import PRESETS
from mereo_learning.scoring import EvaluationConfig
from mereo_learning.shards import DatasetConfig


@pytest.mark.parametrize("command", ["", "evaluate", "reconstruct", "scene"])
def test_help_loads_no_heavy_library_and_few_modules(command: str) -> None:
    """So that it comes at once: what it takes is the time of its imports, 270 to 340 modules where torch has 2,000."""
    code = (
        "import sys, mereo.__main__ as m\n"
        "try: m.main(sys.argv[1:])\n"
        "except SystemExit as end: assert not end.code\n"
        "heavy = {'torch', 'numpy', 'scipy', 'trimesh', 'matplotlib', 'rich', 'fsspec', 's3fs', 'pydantic'}\n"
        "print(sorted(heavy & set(sys.modules)), len(sys.modules))"
    )
    arguments = [*command.split(), "--help"]
    result = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    heavy, _, modules = result.stdout.splitlines()[-1].rpartition(" ")
    assert heavy == "[]", result.stderr
    assert int(modules) < 450


@pytest.mark.parametrize("confidence, cells", [(np.nan, ["1", "1 2 3"]), (0.5, ["0.50", "1", "1 2 3"])])
def test_a_row_of_what_is_lost_has_its_cells_below_their_heads(
    confidence: float, cells: Names, capsys: pytest.CaptureFixture
) -> None:
    centroid = np.array([1.0, 2.0, 3.0])
    rows = [
        SegmentFacts("a", 1, 4.0, centroid, np.zeros((2, 3)), confidence, 9, 1),
        SegmentFacts("b", 2, 0.0, np.nan * centroid, np.full((2, 3), np.nan), np.nan, 0, 0),
    ]
    made = MagicMock(segments=rows, timings_s={}, calibrated=True)
    result = MagicMock(spec=Result, seen=MagicMock(), unit_m=None, registered=None, reconstruction=made)
    result.__getitem__.return_value.error_radius = None
    print_segments(result)
    table = [[cell.strip() for cell in line.split("│")[1:-1]] for line in capsys.readouterr().out.splitlines()]
    assert ["a", "4", *cells] in table and ["b", "0", *[""] * (len(cells) - 2), "0", "not found"] in table


@pytest.mark.parametrize("option", ["-V", "--version"])
def test_version(option: str, capsys: pytest.CaptureFixture) -> None:
    assert run_mereo(option) == 0
    assert capsys.readouterr().out == f"mereo {version('mereo')}\n"


@pytest.mark.parametrize("shard", ["4/4", "1", "-1/2", "1/2/3", ""])
def test_wrong_shard_is_explained(shard: str) -> None:
    assert training.part_of("3/12") == (3, 12)
    with pytest.raises(ValueError, match="it must be i/n with i from 0 to n - 1"):
        training.part_of(shard)


def test_an_error_of_a_process_is_one_line_with_its_code() -> None:
    """In a process of its own, without the shape checks of the tests."""
    command = [sys.executable, "-m", "mereo", "scene", "check", "cube"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr.count("\n")) == (2, "", 1)
    assert ran.stderr.startswith("mereo: error: ") and ran.stderr.count("'cube' is unknown") == 1
    assert ", ".join(SCENES) in ran.stderr


@pytest.mark.skipif(not hasattr(signal, "SIGPIPE"), reason="this system has no SIGPIPE")
@pytest.mark.parametrize("line", ["assets list", "--version", "weights list", "learn --help"])
def test_closed_pipe_is_quiet(line: str) -> None:
    """As of ``head``: what prints by itself, in a table, and a help."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "mereo", *line.split()]
    result = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (result.stderr, result.returncode) == ("", 128 + signal.SIGPIPE)


@pytest.mark.skipif(sys.platform == "win32", reason="streams are closed by a POSIX shell")
@pytest.mark.parametrize(("streams", "line", "status"), [(">&-", "scene list", 0), (">&- 2>&-", "scene check cube", 2)])
def test_without_standard_streams_a_command_does_its_work(streams: str, line: str, status: int) -> None:
    command = ["sh", "-c", f'exec "$@" {streams}', "sh", sys.executable, "-m", "mereo", *line.split()]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (status, "", "")


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ("recontruct a.ply", ("recontruct", "reconstruct")),
        ("assets", ("Missing subcommand", "{list, get}")),
        ("learn lamp.stl", ("Missing from mereo learn", "--output")),
        ("reconstruct a.ply --resoluton 64", ("--resoluton", "--resolution")),
        ("train data --output run --batch x", ("--batch", "'x'")),
        ("reconstruct a.ply --method mods", ("'mods'", "'modes'")),
    ],
)
def test_arguments_that_mean_no_command_are_explained_in_a_box(
    arguments: str, parts: Names, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit, match="^2$"):
        command_line.main(arguments.split())
    printed = capsys.readouterr()
    assert not printed.out and all(part in printed.err for part in parts), printed.err


OUT = {"output": Path("out")}
READING = InputConfig(Path("k.json"), 5000.0, Path("m.png"))
COMMAND = ReconstructCommand((Path("a.png"),), weights="rope", output=Path("out"), reading=READING, force=True)
CALLS = {
    "generate rope --examples 7 --seed 3 --output out --workers 2 --shard 1/4 --resume": (
        "mereo_learning.shards.generate",
        {"config": DatasetConfig(GenerateConfig(), 7, 3), "workers": 2, "shard": (1, 4), "resume": True} | OUT,
    ),
    "train data --output out": ("mereo.api.steps.train", {"dataset": Path("data"), "config": PRESETS["base"]} | OUT),
    "evaluate bunny --output out --examples 4 --seed 1000001": (
        "mereo_learning.evaluation_report.evaluate_weights",
        {"weights": "bunny", "config": EvaluationConfig(None, 4, 1_000_001), "workers": 1} | OUT,
    ),
    "reconstruct a.png --weights rope --output out --intrinsics k.json --depth-scale 5000 --mask m.png --force": (
        "mereo.cli.reconstruct.reconstruct_inputs",
        {"inputs": (Path("a.png"),), "job": FrameJob(COMMAND, InferenceConfig())} | OUT,
    ),
}


@pytest.mark.parametrize("line", CALLS)
def test_command_calls_the_library_with_its_options(
    line: str, monkeypatch: pytest.MonkeyPatch, working_folder: Path
) -> None:
    place, expected = CALLS[line]
    module, _, function = place.rpartition(".")
    library = import_module(module)
    calls = list[dict[str, object]]()
    signature = inspect.signature(getattr(library, function))

    def called(*given: object, **named: object) -> Outcome:
        calls.append(signature.bind(*given, **named).arguments)
        return Outcome({})

    monkeypatch.setattr(library, function, called)
    assert command_line.main(line.split()) == 0
    assert {name: calls[0][name] for name in expected} == expected


def test_report_names_versions_device_threads_and_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    version = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "tensorboard" else version(name))
    doctor.Doctor().run()
    facts = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if line)
    assert facts["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}.")
    assert facts["threads"].startswith(f"{torch.get_num_threads()} of ")
    assert {"device", "numpy", *doctor.PURPOSES} <= set(facts)
    (requirement,) = doctor.requirements("track")
    assert "missing, for training curves" in facts["track"]
    assert facts["track"].endswith(f"-m pip install '{requirement}'")


def test_every_extra_is_explained_and_every_explanation_has_one() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(project["optional-dependencies"]) == set(doctor.PURPOSES)
    assert all(doctor.requirements(extra) for extra in doctor.PURPOSES)
    assert any(requirement.startswith("torch") for requirement in doctor.requirements("network"))
    assert not any(requirement.startswith("torch") for requirement in doctor.requirements(""))
    assert not any("tensorboard" in requirement for requirement in doctor.requirements(""))


def test_probes_that_this_torch_lacks_are_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(torch.cpu, "_is_amx_tile_supported", raising=False)

    def refuse() -> bool:
        raise RuntimeError

    monkeypatch.setattr(torch.cpu, "_is_avx2_supported", refuse, raising=False)
    features = device.cpu_features()
    assert features["amx"] is None
    assert features["avx2"] is None


QUICKSTART = Path(__file__).parents[2] / "docs/quickstart.md"


ADDED = re.compile(r"\((default|required|repeatable)[^()]*(\([^()]*\))?[^()]*\)")
"""What is said of an option without being an explanation."""


@lru_cache
def help_of(command: str) -> str:
    """Text of ``mereo COMMAND --help`` as a terminal shows it."""
    text = io.TextIOWrapper(io.BytesIO(), "utf-8")  # without an encoding, boxes are drawn otherwise
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(text):
        patch.setenv("COLUMNS", "120")  # wider ones show two boxes side by side
        with pytest.raises(SystemExit):
            run_mereo(*command.split(), "--help")
    text.seek(0)
    return text.read()


def commands(group: str = "") -> Iterator[str]:
    listed = re.findall(r"^│ +• ([a-z-]+)", help_of(group), re.MULTILINE)
    for name in listed:
        yield from commands(f"{group} {name}".strip())
    if not listed:
        yield group


def entries(command: str) -> Texts:
    """What a command takes, as its help shows it, each with its explanation but for defaults and rules."""
    found = {}
    for line in help_of(command).splitlines():
        if re.match(r"│ (-|[A-Z{\[])", line):  # lower case begins what is said of a whole box
            name, _, text = line.strip("│ ").partition("  ")
            found[name] = text.strip()
        elif line.startswith("│   ") and found:
            found[next(reversed(found))] += f" {line.strip('│ ')}"
    return {name: ADDED.sub("", text).strip() for name, text in found.items()}


COMMANDS = tuple(commands())


def test_all_commands_are_found() -> None:
    assert {"generate", "scene new", "weights show", "assets get", "reconstruct", "learn"} <= set(COMMANDS)
    assert len(COMMANDS) >= 22


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_is_explained(command: str) -> None:
    found = entries(command)
    assert "-h, --help" in found
    for name, text in found.items():
        assert len(text.split()) >= 2, f"mereo {command} {name}: {text!r}"


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_prints_as_documented(shell: str, capsys: pytest.CaptureFixture) -> None:
    assert f"mereo --tyro-print-completion {shell}" in QUICKSTART.read_text("utf-8")
    with pytest.raises(SystemExit) as end:
        run_mereo("--tyro-print-completion", shell)
    script = capsys.readouterr().out
    assert not end.value.code and "mereo" in script
    for word in ("reconstruct", "weights", "--resolution", "--learning-rate"):
        assert word in script, word
