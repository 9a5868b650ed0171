"""A command that is killed between two changes of a folder is finished by the same command again; so on a full disk."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from failpoints import MOVES, run_command
from fuzz import weights as tiny_weights
from scene_files import write_bar
from toy_data import write_toy_dataset

from mereo.models.weights_place import find_weights
from mereo.synthesis.sample_views import load_view


class Case(NamedTuple):
    """Command that writes ``out`` (or ``out.SUFFIX``), with INPUTS for the folder of its inputs.

    ``again`` is added where the same command refuses because its result, or a part of it, is there; where nothing can
    be added, it is what that says of a whole result. ``first`` writes the result which this one replaces. A command
    that is ``dear`` takes seconds, so it is killed only where it gives a file its name.
    """

    arguments: str
    again: str = ""
    first: str = ""
    dear: bool = False


TRAIN = (
    "train INPUTS/data --output out --preset tiny --precision float32 --compile off --batch 8 --queries 48 --epochs 1 "
    "--network.points 64 --network.width 48 --network.neighbors 8 --holdout 0"
)
GENERATE = "generate INPUTS/bar.yaml --examples 4 --workers 1 --output out --image-size 32 --points 32 --per-segment 4"
DONE = 0, 4
"""Exit statuses of a command that has done its work; 4 of one whose answer nothing has checked, as the network's."""
RECONSTRUCT = (
    "reconstruct INPUTS/cloud.npy --weights INPUTS/w.safetensors --output out --resolution 24 --method network"
)
RELEASE = "release INPUTS/tiny.safetensors --output out --name"
CASES = {
    "generate": Case(GENERATE, again="--resume"),
    "train": Case(TRAIN),
    "reconstruct": Case(RECONSTRUCT, again="--force", dear=True),
    "release": Case(f"{RELEASE} new", again="--force"),
    "release over another": Case(f"{RELEASE} new --force", first=f"{RELEASE} old"),
    "scene new": Case("scene new INPUTS/ball.ply --output out.yaml", again="choose another --output"),
    "scene export": Case("scene export rope --output out.ply", again="--force"),
    "scene export over another": Case(
        "scene export rope --output out.ply --force", first="scene export shapes --output out.ply"
    ),
    "scene check": Case(
        "scene check out.yaml --repair", again="move or remove it", first="scene new INPUTS/open.ply --output out.yaml"
    ),
    "export": Case("export INPUTS/tiny.safetensors --output out --format torch", again="--force", dear=True),
}
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in CASES if name != "scene export"]

ALIKE = (".out.mine.mereo", ".out.ply.mine.mereo", ".other.00000000.mereo", ".out.00000000.partial")
FOREIGN = ("thesis.tex", *(f"{name}/mine.txt" for name in ALIKE))
"""Files of somebody else beside an output, most in folders that look like mereo's own."""

TIMES = re.compile(rb'"timings_s": {[^}]*}|"seconds": [0-9.e+-]+')
"""Durations in JSON, and in pages that hold it: all that differs between two runs of a command."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_toy_dataset(folder / "data", examples=16)
    np.save(folder / "cloud.npy", load_view("rope").depth.to_points().points)
    shutil.copy(find_weights("rope"), folder / "w.safetensors")
    tiny_weights(folder / "tiny.safetensors")
    write_bar(folder)
    ball = trimesh.creation.icosphere(2)
    ball.export(folder / "ball.ply")
    trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False).export(folder / "open.ply")
    return folder


def content(folder: Path) -> dict[str, bytes]:
    """All files without durations; the list of times and sizes says no more."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".mereo.json")
    return {path.relative_to(folder).as_posix(): TIMES.sub(b"", path.read_bytes()) for path in files}


def names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def go_on(case: Case, arguments: str, place: Path, where: str) -> None:
    """The same command again, as a person would give it: it succeeds, or refuses and succeeds with ``case.again``."""
    done = run_command(place, arguments)
    if done.code not in DONE:
        assert (done.code, done.said.count("mereo: error: ")) == (2, 1), f"{where}\n{done.said}"
        assert case.again and case.again in done.said, f"{where}\n{done.said}"
        if not case.again.startswith("--"):
            return
        done = run_command(place, f"{arguments} {case.again}")
    assert done.code in DONE, f"{where}\n{done.said}"


def prepare(case: Case, inputs: Path, place: Path) -> str:
    """Arguments of the command; the result that it replaces, and files of somebody else, are there."""
    for name in FOREIGN:
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text("precious")
    if case.first:
        assert run_command(place, case.first.replace("INPUTS", str(inputs))).code in DONE
    return case.arguments.replace("INPUTS", str(inputs))


def boundaries(changes: list[str], dear: bool) -> list[int]:
    """Changes before which to kill: those that follow the first of a kind, and the first moves themselves."""
    numbers = set[int]()
    seen = set[str]()
    for number, (event, place) in enumerate(change.split(" ", 1) for change in changes):
        name = re.sub("[0-9a-f]{8}|[0-9]+", "0", Path(place).name) if event in MOVES else Path(place).suffix
        if event in MOVES or (event != "open" and not dear):
            numbers |= {number + 1} if f"{event} {name}" not in seen else set()
            numbers |= {number} if event in MOVES and event not in seen else set()
            seen |= {event, f"{event} {name}"}
    return sorted(numbers - {len(changes)})


@pytest.mark.parametrize("name", ["scene export", *SLOW])
def test_a_killed_command_is_finished_by_the_next(name: str, inputs: Path, tmp_path: Path) -> None:
    """With the bytes of one that was never disturbed; nothing is left over, and no file of somebody else changes."""
    case = CASES[name]
    before = content(inputs)
    fresh, whole, place = (tmp_path / folder for folder in ("fresh", "whole", "place"))
    arguments = prepare(case, inputs, fresh)
    shutil.copytree(fresh, whole)
    undisturbed = run_command(whole, arguments)
    assert undisturbed.code in DONE and undisturbed.changes, undisturbed.said
    assert all((whole / name).is_file() for name in FOREIGN)
    for number in boundaries(undisturbed.changes, case.dear):
        shutil.copytree(fresh, place)
        killed = run_command(place, arguments, at=number)
        where = f"killed before change {number}: {killed.changes[-1]}"
        assert killed.code == -9, f"{where}\n{killed.said}"
        go_on(case, arguments, place, where)
        assert names(place) == names(whole) and content(place) == content(whole), where
        shutil.rmtree(place)
    assert content(inputs) == before


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 24 MB that is in memory."""
    (place := tmp_path / "disk").mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(place)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no disk can be mounted here")
    yield place
    subprocess.run(["umount", str(place)], check=True)


@pytest.mark.parametrize(
    ("name", "room"),
    [
        ("scene export", 40_000),
        *(pytest.param(name, room, marks=pytest.mark.slow) for name in CASES for room in (0, 8_192)),
    ],
)
def test_a_full_disk_is_said_and_leaves_nothing(name: str, room: int, inputs: Path, small_disk: Path) -> None:
    """No room at all, and some for folders, locks and the smallest files; with more the command does its work."""
    case = CASES[name]
    place = small_disk
    arguments = prepare(case, inputs, place)
    before = content(place)
    with (place / "ballast").open("wb") as file:
        file.write(bytes(os.statvfs(place).f_bavail * os.statvfs(place).f_frsize - room))
    full = run_command(place, arguments)
    if room and full.code in DONE:  # a small file had room
        return
    assert (full.code, full.said.count("mereo: error: ")) == (2, 1) and "Traceback" not in full.said, full.said
    assert "the disk is full while writing" in full.said or "GB free" in full.said, full.said
    (place / "ballast").unlink()
    after = content(place)
    if arguments.startswith(("train", "generate", "scene check")):  # whole files stay, and the work is continued
        after = {file: after[file] for file in before}
    assert after == before
    go_on(case, arguments, place, "after a full disk")
    assert {path.name for path in place.rglob(".*.mereo")} == set(ALIKE[:3])
