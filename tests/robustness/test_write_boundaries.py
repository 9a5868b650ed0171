"""A command that is killed anywhere between two changes of a folder is finished by the same command again."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from analytic import untrained
from failpoints import Commands, command_server
from fuzz_files import weights as tiny_weights
from scene_files import write_bar
from toy_data import write_toy_dataset
from write_boundaries import Case, check_boundaries

from mereo.models.weights import save_model
from mereo.models.weights_place import find_weights
from mereo.scenes.registry import load_scene
from mereo.synthesis.sample_views import load_view

TRAIN = (
    "train INPUTS/data --output out --preset tiny --precision float32 --compile off --batch 8 --queries 48 --epochs 1 "
    "--network.points 64 --network.width 48 --network.neighbors 8 --holdout 0"
)
GENERATE = "generate INPUTS/bar.yaml --examples 4 --workers 1 --output out --image-size 32 --points 32 --per-segment 4"
RELEASE = "release INPUTS/tiny.safetensors --output out --name"

CASES = {
    "generate": Case(GENERATE, again="--resume"),
    "train": Case(TRAIN),
    "reconstruct": Case(
        "reconstruct INPUTS/cloud.npy --weights INPUTS/w.safetensors --output out --resolution 24 --method network",
        again="--force",
        timed=("summary.json", "report.html"),
        dear=True,
    ),
    "evaluate": Case(
        "evaluate INPUTS/w.safetensors --output out --examples 1 --method network",
        again="choose another --output",
        timed=("metrics.json",),
        dear=True,
    ),
    "calibrate": Case(
        "calibrate INPUTS/rope.safetensors --output out.safetensors --views 8", again="--force", dear=True
    ),
    "release": Case(f"{RELEASE} new", again="--force"),
    "release over another": Case(f"{RELEASE} new --force", first=f"{RELEASE} old"),
    "scene new": Case("scene new INPUTS/ball.ply --output out.yaml", again="choose another --output"),
    "scene export": Case("scene export rope --output out.ply", again="--force"),
    "scene export over another": Case(
        "scene export rope --output out.ply --force", first="scene export shapes --output out.ply"
    ),
    "scene preview": Case("scene preview rope --output out.png", again="--force"),
    "scene check": Case(
        "scene check out.yaml --repair",
        again="move or remove it",
        first="scene new INPUTS/open.ply --output out.yaml",
    ),
    "export": Case("export INPUTS/tiny.safetensors --output out --format torch", again="--force", dear=True),
}


@pytest.fixture(scope="module")
def commands() -> Iterator[Commands]:
    if not hasattr(os, "fork"):
        pytest.skip("processes are forked, which this system cannot")
    with command_server() as server:
        yield server


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_toy_dataset(folder / "data", examples=16)
    points = load_view("rope").depth.to_points().points
    np.save(folder / "cloud.npy", points)
    shutil.copy(find_weights("rope"), folder / "w.safetensors")
    tiny_weights(folder / "tiny.safetensors")
    save_model(untrained(load_scene("rope").rest.names), folder / "rope.safetensors")
    write_bar(folder)
    ball = trimesh.creation.icosphere(2)
    ball.export(folder / "ball.ply")
    trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False).export(folder / "open.ply")
    return folder


@pytest.mark.parametrize("name", [pytest.param("release over another", marks=pytest.mark.slow), "scene export"])
def test_a_killed_command_is_finished_by_the_next(name: str, commands: Commands, inputs: Path, tmp_path: Path) -> None:
    check_boundaries(commands, CASES[name], inputs, tmp_path, every_call=False)


# --- a full disk ------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 24 MB that is in memory."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(place)], capture_output=True, text=True, check=False
    )
    if not mounted or mounted.returncode:
        pytest.skip(f"no disk can be mounted here: {mounted.stderr.strip() if mounted else 'there is no mount'}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def check_full_disk(commands: Commands, case: Case, inputs: Path, place: Path, room: int) -> None:
    """With ``room`` bytes the command says that the disk is full and leaves nothing; with more it does its work."""
    arguments = case.arguments.replace("INPUTS", str(inputs))
    if case.first:
        assert commands.run(place, case.first.replace("INPUTS", str(inputs))).code == 0
    before = {path.name: path.read_bytes() for path in place.rglob("*") if path.is_file()}
    with (place / "ballast").open("wb") as file:
        file.write(bytes(os.statvfs(place).f_bavail * os.statvfs(place).f_frsize - room))
    full = commands.run(place, arguments)
    if room and full.code == 0:  # a small file had room
        return
    assert (full.code, full.said.count("mereo: error: ")) == (2, 1), full.said
    assert "the disk is full while writing" in full.said or "GB free" in full.said, full.said
    assert "Traceback" not in full.said
    (place / "ballast").unlink()
    after = {path.name: path.read_bytes() for path in place.rglob("*") if path.is_file()}
    if arguments.startswith(("train", "generate", "scene check")):  # whole files stay, and the work is continued
        after = {name: after[name] for name in before}
    assert after == before
    assert not list(place.rglob("*.mereo"))
    if case.only_once:
        return
    done = commands.run(place, arguments)
    if done.code:
        assert case.again and case.again in done.said, done.said
        done = commands.run(place, f"{arguments} {case.again}")
    assert done.code == 0, done.said
    assert not list(place.rglob("*.mereo"))


@pytest.mark.parametrize("name", [pytest.param("release over another", marks=pytest.mark.slow), "scene export"])
def test_a_full_disk_is_said_and_leaves_nothing(name: str, commands: Commands, inputs: Path, small_disk: Path) -> None:
    check_full_disk(commands, CASES[name], inputs, small_disk, room=40_000)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("room", [0, 8_192])
def test_whatever_room_a_disk_has(name: str, room: int, commands: Commands, inputs: Path, small_disk: Path) -> None:
    """No room at all, and some for folders, locks and the smallest files."""
    check_full_disk(commands, CASES[name], inputs, small_disk, room)


@pytest.mark.slow
def test_a_disk_that_has_no_room_for_an_onnx_graph(commands: Commands, inputs: Path, small_disk: Path) -> None:
    pytest.importorskip("onnxscript", reason="the extra onnx is not installed")
    arguments = CASES["export"].arguments.replace("torch", "onnx")
    check_full_disk(commands, replace(CASES["export"], arguments=arguments, only_once=True), inputs, small_disk, 8_192)


# --- every call -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_whatever_call_a_command_is_killed_at(name: str, commands: Commands, inputs: Path, tmp_path: Path) -> None:
    """At a sample of the changes of folders: each kind of change, and one in three of the further renames.

    Commands that take seconds are killed only where they give a file its name. ``write_boundaries.boundaries`` says it
    exactly.
    """
    check_boundaries(commands, CASES[name], inputs, tmp_path, every_call=not CASES[name].dear)
