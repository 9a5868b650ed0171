"""Every reader, with damaged files: each is taken, or refused with one sentence (``fuzz_rule``).

The fast tests try a few inputs of each kind in this process. The nightly ones spend ``MEREO_FUZZ_MINUTES`` (30) on as
many as they allow, in processes of their own, so that a crash of a library is a finding and not the end.
"""

import json
import os
import subprocess
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import fuzz_run
import numpy as np
import pytest
import yaml
from fuzz_mutations import ODD_VALUES, places, with_value
from fuzz_rule import fault_of, limits, listing
from fuzz_run import cases
from fuzz_targets import TARGETS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mereo import __main__ as command_line

SEED = int(os.environ.get("MEREO_FUZZ_SEED", "0"))
MINUTES = float(os.environ.get("MEREO_FUZZ_MINUTES", "30"))
COUNT = 10
"""Inputs of a kind in the fast test."""

DEAR = {
    **{f"frames.{suffix}": 1 for suffix in ("vtk", "vtu", "pvd", "xdmf")},
    "bar.yaml": 3,
    "left.stl": 3,
    "truth.json": 3,
    "weights.safetensors": 3,
}
"""Fewer where one takes long."""


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_taken_or_refused_with_one_sentence(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for case in islice(cases(TARGETS[name], tmp_path / "in", SEED), DEAR.get(name, COUNT)):
        if case.fault is not None:
            (tmp_path / Path(name).name).write_bytes(case.content)
            pytest.fail(
                f"{case.fault.text}\n{case.fault.kind}; the input is {tmp_path / Path(name).name}, and again: "
                f"python tests/support/fuzz_run.py {name} --seed {SEED} --first {case.number}"
            )
    printed = capfd.readouterr()
    assert printed.out + printed.err == "", "a reader prints nothing"


# --- documents: one value of a tree, shrunk to the simplest that breaks the rule --------------------------------------

LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.sampled_from(ODD_VALUES)
VALUES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner))
DOCUMENTS = [name for name in TARGETS if name.endswith((".json", ".yaml"))]


def load(name: str, content: str) -> Any:
    return yaml.safe_load(content) if name.endswith(".yaml") else json.loads(content)


def dump(name: str, tree: Any) -> str:
    return yaml.safe_dump(tree, allow_unicode=True) if name.endswith(".yaml") else json.dumps(tree)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_documents_with_another_value_somewhere(name: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    target, path = TARGETS[name], tmp_path_factory.mktemp("document") / name
    target.write(path)
    whole = load(name, path.read_text(encoding="utf-8"))
    names = (path.parent.name,) if target.folder else ()

    @settings(max_examples=6 if name in DEAR else 12, deadline=None, database=None, derandomize=True,
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(st.sampled_from(list(places(whole))), VALUES | st.just(...))
    def holds(place: tuple[str | int, ...], value: Any) -> None:
        changed = with_value(whole, place, None if value is ... and not place else value)
        path.write_text(dump(name, changed), encoding="utf-8", errors="replace")
        _, fault = fault_of(target.read, path, names)
        assert fault is None, fault

    holds()


# --- through the command line -----------------------------------------------------------------------------------------

RECONSTRUCT = "reconstruct {} --weights tiny.safetensors --resolution 8 --output out"
FRAMES = ("little.ply", "ascii.pcd", "cloud.csv", "cloud.npz", "depth.tif", "frames.db3")
COMMANDS: dict[str, str] = {
    **dict.fromkeys(FRAMES, RECONSTRUCT),
    "depth.png": f"{RECONSTRUCT} --intrinsics camera.json",
    "camera.json": f"{RECONSTRUCT.replace('{}', 'depth.png')} --intrinsics {{}}",
    "weights.safetensors": "reconstruct cloud.npy --weights {} --resolution 8 --output out",
    "poses.csv": f"{RECONSTRUCT.replace('{}', 'cloud.npy')} --carry {{}}",
    "bar.yaml": "scene preview {} --output out.png",
    "volume.yaml": "scene export {} --output out",
    "start.json": "align cloud.npy --scene bar.yaml --start {} --output out",
    "manifest.json": "train . --preset tiny --epochs 1 --output out",
}


def beside(folder: Path) -> None:
    """What the commands need besides the file that is damaged."""
    for name, other in (
        ("weights.safetensors", "tiny.safetensors"),
        ("depth.png", "depth.png"),
        ("bar.yaml", "bar.yaml"),
    ):
        if not (folder / other).exists():
            TARGETS[name].write(folder / other)
    if not (folder / "cloud.npy").exists():
        np.save(folder / "cloud.npy", np.random.default_rng(0).normal((0, 0, 20), 1, (200, 3)))


def refusal(arguments: list[str], folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Run a command that must fail: exit code 2, one line, nothing written."""
    before = listing(folder)
    capfd.readouterr()
    with limits():
        code = command_line.main(arguments)
    said = capfd.readouterr().err
    lines = [line for line in said.splitlines() if not line.startswith("mereo: warning: ")]
    assert code == 2 and len(lines) == 1 and lines[0].startswith("mereo: error: "), (code, said[:2000])
    assert lines[0].isprintable() and listing(folder) == before


@pytest.mark.parametrize("name", [name for name in COMMANDS if name in TARGETS])
def test_what_a_reader_refuses_the_command_refuses(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Inputs that the reader takes are left out here: their commands work, some of them for long."""
    target, path = TARGETS[name], tmp_path / name
    monkeypatch.chdir(tmp_path)
    seen = 0
    for case in cases(target, tmp_path, SEED):
        if not case.taken:
            beside(tmp_path)
            path.write_bytes(case.content)
            refusal(COMMANDS[name].format(name).split(), tmp_path, capfd)
            seen += 1
        if seen == 3:
            break


# --- all day ----------------------------------------------------------------------------------------------------------


PARTS = 4
"""Processes, one after the other: each takes seconds to begin, and a crash of a library ends one."""


@pytest.mark.nightly
@pytest.mark.parametrize("part", range(PARTS))
def test_many_damaged_files(part: int, tmp_path: Path) -> None:
    names = list(TARGETS)[part::PARTS]
    seconds = 60 * MINUTES / len(TARGETS)
    command = [sys.executable, str(Path(fuzz_run.__file__)), *names, "--seed", str(SEED + 1)]
    command += ["--count", str(10**9), "--seconds", str(seconds), "--keep", str(tmp_path)]
    printed = Path(os.environ.get("MEREO_FUZZ_LOG", tmp_path / "log.jsonl"))
    with printed.open("a", encoding="utf-8") as log:
        done = subprocess.run(command, stdout=log, stderr=subprocess.PIPE, text=True, check=False)
    counts = printed.read_text(encoding="utf-8")
    assert done.returncode == 0, f"exit code {done.returncode}\n{counts}\n{done.stderr[-3000:]}"
    assert done.stderr == "", "a reader prints nothing"
