"""An object without weights needs no torch, and what does need it says how to get it: the pages run as printed."""

import os
import re
import shlex
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from angle import write_angle
from folder_contents import read_json
from numpy.testing import assert_allclose
from page_blocks import FENCE, ROOT, blocks

from mereo.scenes.files.object_files import scene_of_meshes
from mereo.scenes.random_states import CACHE_VARIABLE
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view

HIDDEN = """
import sys
from importlib.machinery import PathFinder

class Hidden(PathFinder):
    asked = []
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        package = name.partition(".")[0]
        if package == "torch":
            cls.asked.append(name)
        elif package != "mereo_weights":
            return super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Hidden
"""
"""Beginning of a program for which the extra `network` is not installed: neither torch nor the shipped weights."""


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
load = "load_object('rope')", "load_object(weights='bunny')", "load_object('rope', 'rope')", "load_model('bunny')"
for call in (*load, "learn('rope', 'out')"):
    try:
        print(eval(f"mereo.{call}").network)
    except (ImportError, ValueError) as error:
        print(error)
print(main(["train", "data", "--output", "run"]))
Hidden.asked.clear()
"""
    ran = hidden(program, tmp_path)
    assert (
        ran.stdout.startswith("None\n")
        and ran.stdout.count("run pip install 'mereo[network]'") == 3
        and ran.stdout.endswith("\n2\n")
    ), ran.stderr
    assert ran.stderr.startswith("mereo: error: PyTorch is not installed") and ran.stderr.count("\n") == 1


# --- the pages, as printed, after a clone and its ./demo --------------------------------------------------------------

PAGES = {page: ROOT / page for page in ("README.md", "docs/quickstart.md")}
ANSWERS, PYTHON = ROOT / "docs/faq.md", ROOT / "docs/python.md"
"""What goes on with what the quickstart has left: commands, and blocks that are one program."""


def test_five_lines_find_a_built_in_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the README, where neither PyTorch nor the object's own mesh is to be had."""
    monkeypatch.setenv("MEREO_ASSETS", str(tmp_path / "none"))
    (code,) = blocks(PAGES["README.md"], "python")
    checks = """
import numpy as np
assert repr(bunny) == "Object('bunny': body, head, ear_left, ear_right, tail)"
assert result.known is True and result.located_by == "search" and result["head"].error_radius > 0
np.testing.assert_allclose(result.carry([[0.0, 0.1, 0.0]]), [[0.0, 0.1, 0.0]], atol=0.002)  # the scan is in their frame
"""
    ran = hidden(f"{code}{checks}Hidden.asked.clear()", tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert (
        ran.stderr.count("Warning") == 1
        and "so bunny is searched by its model: pip install 'mereo[network]'" in ran.stderr
    )
    assert (tmp_path / "result/segments.glb").is_file()


PROGRAMS = ("mereo view", "mereo serve")
"""Commands that go on until Ctrl-C."""

CAMERA = "mereo stream realsense "
"""A command that needs a camera; tests/io/test_realsense.py runs it with a stand-in."""


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder with the command ``mereo``; no assets are there, the extra `network` only with MEREO_TEST_TORCH."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/mereo").write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m mereo "$@"\n')
    (tmp_path / "bin/mereo").chmod(0o755)
    torch = 'import os\nif "MEREO_TEST_TORCH" not in os.environ:\n'
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "site").mkdir()
    (tmp_path / "site/sitecustomize.py").write_text(torch + textwrap.indent(HIDDEN, "    "))
    for name, first, divider in (("PATH", "bin", ":"), ("PYTHONPATH", "site", os.pathsep)):
        monkeypatch.setenv(name, f"{tmp_path / first}{divider}{os.environ.get(name, '')}")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("MEREO_ASSETS", str(tmp_path / "none"))
    return tmp_path


def run_line(line: str, clone: Path) -> None:
    """Run a line of a shell block; one that installs is done already, one that waits is interrupted when it does."""
    if line.startswith(("git clone ", "pip install ", CAMERA)):
        return
    line = re.sub(r"^\./demo\b", "mereo demo", line).replace("source .venv/bin/activate", "true")
    if not line.startswith(PROGRAMS):
        ran = subprocess.run(["bash", "-ec", line], cwd=clone, capture_output=True, text=True, timeout=600)
        assert ran.returncode == 0, f"{line}\n{ran.stdout}{ran.stderr}"
        return
    words = [*shlex.split(line, comments=True), "--port", "0"]
    with subprocess.Popen(words, cwd=clone, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        printed = []
        for text in process.stdout:
            printed.append(text)
            if "Ctrl-C ends" in text:
                process.send_signal(signal.SIGINT)
    assert "Ctrl-C ends" in "".join(printed) and process.returncode in (0, 130), f"{line}\n{''.join(printed)}"


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_every_block_of_a_page_runs_as_printed(page: str, clone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the page; those after a paragraph that installs PyTorch with it, all others without."""
    for library in ("viser", "fastapi", "onnxscript", "yourdfpy"):
        pytest.importorskip(library)
    text = PAGES[page].read_text("utf-8")
    done = 0
    if page == "docs/quickstart.md":
        program = "".join(blocks(PYTHON, "python"))
        text += f"{ANSWERS.read_text('utf-8')}\n\npip install '[network]'\n\n```python\n{program}```"
    for block in FENCE.finditer(text):
        before = text[: block.start()].rstrip().rsplit("\n\n", 1)[-1]
        monkeypatch.delenv("MEREO_TEST_TORCH", raising=False)
        if re.search(r"pip install '[^']*network", before) and "```" not in before:
            monkeypatch.setenv("MEREO_TEST_TORCH", "1")
        if block[1] == "python":
            # as somebody who types it, whose pages stay open while the next line is typed
            program = f"import sys\nsys.ps1 = '>>> '\n{block[2]}"
            ran = subprocess.run(
                [sys.executable, "-c", program], cwd=clone, capture_output=True, text=True, timeout=600
            )
            assert ran.returncode == 0, f"{block[2]}\n{ran.stdout}{ran.stderr}"
        else:
            assert block[1] == "sh", block[0]
            for line in block[2].splitlines():
                run_line(line, clone)
        done += 1
    assert done >= 2 and (clone / "out/demo/bun000-meshes/report.html").is_file()
    for shown in re.findall(r"hinge: (\S+)° \((\S+) to (\S+)\)", text):
        hinge = read_json(clone / "opened/summary.json")["joints"]["hinge"]
        assert_allclose(np.array(shown, float), np.rad2deg([hinge["value"], *hinge["interval"]]), atol=0.05)


@pytest.mark.slow
def test_the_tour_needs_torch_only_where_it_says_so(tmp_path: Path) -> None:
    cells = read_json(ROOT / "docs/tour.ipynb")["cells"]
    sources = ["".join(cell["source"]) for cell in cells]
    (first,) = [n for n, source in enumerate(sources) if "pip install 'mereo[network]'" in source]
    code = [source for cell, source in zip(cells[:first], sources, strict=False) if cell["cell_type"] == "code"]
    ran = hidden("\n".join([*code, "Hidden.asked.clear()"]), tmp_path)
    assert ran.returncode == 0 and "the tip of ear_left" in ran.stdout, ran.stderr
