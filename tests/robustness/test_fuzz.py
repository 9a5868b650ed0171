"""Every reader, with damaged files: each is taken, or refused with one sentence (``fuzz``).

``MEREO_FUZZ_SEED`` draws other damage; the nightly tests spend ``MEREO_FUZZ_MINUTES`` (30) on as much as they allow.
"""

import os
import time
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from fuzz import TARGETS, inputs, limits, listing

from mereo import __main__ as command_line

SEED = int(os.environ.get("MEREO_FUZZ_SEED", "0"))
MINUTES = float(os.environ.get("MEREO_FUZZ_MINUTES", "30"))
COUNT = {**dict.fromkeys(TARGETS, 10), "frames.vtu": 1, "frames.pvd": 1, "frames.xdmf": 1}
COUNT |= {"bar.yaml": 3, "left.stl": 3, "truth.json": 3, "weights.safetensors": 3}
"""Inputs of a kind in the fast test: fewer where one takes long."""


def check_kind(name: str, folder: Path, capfd: pytest.CaptureFixture[str], count: int, seed: int, end: float) -> None:
    for content, _, fault in islice(inputs(name, folder / "in", seed), count):
        if fault:
            (kept := folder / Path(name).name).write_bytes(content)
            pytest.fail(f"{fault}; the input is {kept}")
        if time.monotonic() > end:
            break
    printed = capfd.readouterr()
    assert printed.out + printed.err == "", "a reader prints nothing"


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_taken_or_refused_with_one_sentence(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    check_kind(name, tmp_path, capfd, COUNT[name], SEED, float("inf"))


@pytest.mark.nightly
@pytest.mark.parametrize("name", TARGETS)
def test_many_damaged_files(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    check_kind(name, tmp_path, capfd, 10**9, SEED + 1, time.monotonic() + 60 * MINUTES / len(TARGETS))


RECONSTRUCT = "reconstruct {} --weights tiny.safetensors --resolution 8 --output out"
COMMANDS: dict[str, str] = {
    **dict.fromkeys(("labelled.ply", "cloud.csv", "cloud.npz", "frames.db3"), RECONSTRUCT),
    "depth.png": f"{RECONSTRUCT} --intrinsics camera.json",
    "camera.json": f"{RECONSTRUCT.replace('{}', 'depth.png')} --intrinsics {{}}",
    "poses.csv": f"{RECONSTRUCT.replace('{}', 'cloud.npy')} --carry {{}}",
    "bar.yaml": "scene preview {} --output out.png",
    "start.json": "align cloud.npy --scene bar.yaml --start {} --output out",
    "manifest.json": "train . --preset tiny --epochs 1 --output out",
}


@pytest.mark.parametrize("name", [name for name in COMMANDS if name in TARGETS])
def test_what_a_reader_refuses_the_command_refuses(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2, one line, nothing written. Inputs that are taken are left out: their commands work."""
    monkeypatch.chdir(tmp_path)
    for content, _, _ in islice((case for case in inputs(name, tmp_path, SEED) if not case[1]), 3):
        for kind, file in (("weights.safetensors", "tiny.safetensors"), ("depth.png",) * 2, ("bar.yaml",) * 2):
            if not Path(file).exists():
                TARGETS[kind].write(tmp_path / file)
        np.save("cloud.npy", np.random.default_rng(0).normal((0, 0, 20), 1, (200, 3)))
        (tmp_path / name).write_bytes(content)
        before = listing(tmp_path)
        capfd.readouterr()
        with limits():
            code = command_line.main(COMMANDS[name].format(name).split())
        printed = capfd.readouterr().err
        lines = [line for line in printed.splitlines() if not line.startswith("mereo: warning: ")]
        assert code == 2 and len(lines) == 1 and lines[0].startswith("mereo: error: "), (code, printed[:2000])
        assert lines[0].isprintable() and listing(tmp_path) == before
