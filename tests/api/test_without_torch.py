"""An object without weights needs no torch, and what does need it says how to get it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from angle import write_angle

from mereo.scenes.files.object_files import scene_of_meshes
from mereo.scenes.random_states import CACHE_VARIABLE
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view

HIDDEN = """
import sys

class Hidden:
    asked = []
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            self.asked.append(name)
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
"""
"""Beginning of a program for which torch is not installed."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the angle's meshes, and of a view of it in a random state, in metres."""
    found = tmp_path_factory.mktemp("angle")
    scene = scene_of_meshes(write_angle(found), "mm")
    assert scene.unit_m is not None
    points = scene.unit_m * sample_view(scene, GenerateConfig(), example_rng(1000, 2)).depth.to_points().points
    (found / "frames").mkdir()
    for name in ("frame.npy", "frames/a.npy"):
        np.save(found / name, points)
    return found


@pytest.fixture(autouse=True)
def _own_cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(folder / "cache"))


def hidden(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    end = "\nassert not Hidden.asked, Hidden.asked\n"
    return subprocess.run(
        [sys.executable, "-c", HIDDEN + program + end], cwd=folder, capture_output=True, text=True, timeout=300
    )


def test_python_needs_no_torch(folder: Path) -> None:
    program = """
import mereo
known = mereo.load_object(["long.stl", "short.stl"], units="mm")
frame = mereo.load_frame("frame.npy", unit_m=1.0)
found = mereo.reconstruct(frame, known, resolution=24)
found.save("hidden", overwrite=True)
found.save("hidden.html", overwrite=True)
found.carry("long.stl").save("carried.stl", overwrite=True)
print(mereo.Tracker(known).follow(frame, 0.0).located_by, found.located_by)
from mereo.scenes.parameters import random_state
from mereo_viewer.laboratory import Laboratory
laboratory = Laboratory(known.scene, known.network, known.registrar())
trial = laboratory.answer(laboratory.look(random_state(known.scene, 0), laboratory.first_place))
print(trial.scores.iou > 0.7, trial.source.split()[0])
import mereo.api.view, mereo.cli.demo, mereo_learning.scans
from mereo.cli.tools import Doctor
Hidden.asked.clear()
Doctor().run()
Hidden.asked.clear()
"""
    ran = hidden(program, folder)
    assert ran.returncode == 0, ran.stderr
    assert (
        ran.stdout.split()[:4] == ["search", "search", "True", "registered"]
        and (folder / "hidden/report.html").is_file()
    )
    assert "objects are found by search" in ran.stdout


def test_the_command_line_needs_no_torch(folder: Path) -> None:
    program = """
from mereo.__main__ import main
known = ["--object", "long.stl", "short.stl", "--units", "mm"]
options = ["--unit-m", "1", "--resolution", "24", "--force"]
assert main(["reconstruct", "frame.npy", *known, *options, "--output", "command"]) == 0
assert main(["stream", "frames", *known, "--unit-m", "1"]) == 0
assert main(["generate", "rope", "--output", "examples", "--examples", "1"]) == 0
"""
    ran = hidden(program, folder)
    assert ran.returncode == 0, ran.stderr
    assert "found by search" in ran.stdout and '"located_by": "search"' in ran.stdout
    assert (folder / "command/summary.json").is_file()


def test_what_needs_torch_says_which_extra(tmp_path: Path) -> None:
    program = """
import mereo
from mereo.__main__ import main
for call in ("load_object('bunny')", "load_model('bunny')", "learn('rope', 'out')", "reconstruct('bun000', 'bunny')"):
    try:
        eval(f"mereo.{call}")
    except ImportError as error:
        print(error)
print(main(["train", "data", "--output", "run"]))
Hidden.asked.clear()
"""
    ran = hidden(program, tmp_path)
    assert ran.stdout.count("run pip install 'mereo[network]'") == 4 and ran.stdout.endswith("\n2\n"), ran.stderr
    assert ran.stderr.startswith("mereo: error: PyTorch is not installed") and ran.stderr.count("\n") == 1
