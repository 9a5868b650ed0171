"""The page's way from a simulation to a reconstruction, with a solid of tetrahedra that a closed form bends."""

import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh
from folder_contents import read_json
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator, default_rng
from page_blocks import ROOT, blocks

import mereo
from mereo import __main__ as command_line
from mereo.geometry.conventions import Range
from mereo.geometry.metrics import grid_confusion, intersection_over_union, labels_on, truth_grid
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.writers.meshes import write_positions_ply
from mereo.scenes.random_states import CACHE_VARIABLE
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import View, sample_view

PAGE = (ROOT / "docs/own-object.md").read_text().partition("### From a simulation to a reconstruction")[2]


@dataclass
class Simulator:
    """An angle 120 mm long whose arm bends and whose end twists, by other amounts at each step."""

    rest: ndarray
    rng: Generator
    amounts: Range = (0.0, 0.0)

    def step(self) -> None:
        bend, twist = self.rng.uniform(-1, 1, 2)
        self.amounts = (float(bend), float(twist))

    def positions(self) -> ndarray:
        x, y, z = self.rest.T
        bend, twist = self.amounts
        angle = 0.5 * twist * x / 120
        y, z = np.cos(angle) * y - np.sin(angle) * z, np.sin(angle) * y + np.cos(angle) * z
        return np.stack([x, y, z + 18 * bend * (x / 120) ** 2], axis=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the page's Python and YAML leave, and a frame of a state that is held out."""
    pyvista = pytest.importorskip("pyvista", reason="pyvista is not installed: pip install 'mereo[dev]'")
    found = tmp_path_factory.mktemp("organ")
    cubes = pyvista.ImageData(dimensions=(7, 6, 3), spacing=(20, 18, 13)).cast_to_rectilinear_grid()
    solid = cubes.to_tetrahedra(5)
    x, y, _ = solid.cell_centers().points.T
    solid = solid.extract_cells((x < 40) | (y < 36))
    solid.save(found / "volume.vtk")
    simulator = Simulator(np.array(solid.points, float), default_rng(0))
    (code,) = (code for code in blocks(ROOT / "docs/own-object.md", "python") if "simulator.step()" in code)
    (text,) = (text for text in blocks(ROOT / "docs/own-object.md", "yaml") if text.startswith("name: organ"))
    (found / "organ.yaml").write_text(text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(found)
        exec(compile(code, "own-object.md", "exec"), {"simulator": simulator})
    scene = mereo.load_scene(str(found / "organ.yaml"))
    assert scene.unit_m is not None
    write_positions_ply(found / "frame.ply", held_out_view(found).depth.to_points().points * scene.unit_m)
    return found


def held_out_view(folder: Path) -> View:
    scene = mereo.load_scene(str(folder / "organ.yaml")).for_seed(TEST_SEED_START)
    return sample_view(scene, GenerateConfig(image_size=48), example_rng(TEST_SEED_START, 3))


def run_command(folder: Path, word: str, *more: str) -> int:
    """The only command of the page's section with a word, in the folder."""
    (line,) = (line for line in PAGE.splitlines() if line.startswith(f"mereo {word} "))
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        patched.setenv(CACHE_VARIABLE, str(folder / "cache"))
        return command_line.main([*shlex.split(line)[1:], *more])


def test_the_scene_is_checked(folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert run_command(folder, "scene check") == 0
    assert "organ: 1 segments, closed, outward oriented, without overlap" in capsys.readouterr().out


@pytest.mark.slow
def test_a_state_that_was_held_out_is_found(folder: Path) -> None:
    assert run_command(folder, "reconstruct", "--unit-m", "1") == 0
    assert read_json(folder / "result/summary.json")["registration"]["located_by"] == "search"
    scene = mereo.load_scene(str(folder / "organ.yaml"))
    view = held_out_view(folder)
    assert scene.unit_m is not None
    truth = truth_grid(view.mesh.with_vertices([scene.unit_m * part.vertices for part in view.mesh.segments]), 40)
    found = read_segmented_mesh(folder / "result/segments.glb")
    assert intersection_over_union(grid_confusion(truth, labels_on(found, truth.grid), 1)).iou > 0.9


@pytest.mark.slow
def test_it_is_learnt(folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert run_command(folder, "learn", "--train", "never") == 0
    assert read_json(folder / "learned/metrics.json")


def run_mereo(*arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "mereo", *map(str, arguments)], capture_output=True, text=True, timeout=1200
    )
    assert done.returncode in (0, 4), done.stderr  # a network of two minutes may leave doubts
    return done.stdout


@pytest.mark.slow
def test_a_tiny_network_finds_the_rope(tmp_path: Path) -> None:
    """About two CPU minutes of training suffice to see the object; more examples are what the presets are for."""
    data, run, test, result = (tmp_path / name for name in ("data", "run", "test", "result"))
    run_mereo("generate", "rope", "--examples", 1536, "--seed", 7, "--workers", 2, "--output", data)
    run_mereo("train", data, "--output", run, "--preset", "tiny", "--epochs", 12)
    weights = run / "weights.safetensors"
    run_mereo("evaluate", weights, "--examples", 6, "--seed", TEST_SEED_START, "--output", test)
    scores = read_json(test / "metrics.json")
    assert scores["iou"] > 0.45 and scores["miou"] > 0.15
    view = sample_view(load_scene("rope"), GenerateConfig(), example_rng(TEST_SEED_START, 0))
    np.save(tmp_path / "cloud.npy", view.depth.to_points().points)
    run_mereo("reconstruct", tmp_path / "cloud.npy", "--weights", weights, "--resolution", 64, "--output", result)
    assert {path.name for path in result.glob("[!.]*")} == {
        "config.json", "segments.glb", "labels.npz", "summary.json", "state.json", "preview.png", "radius95.glb",
        "report.html"
    }  # fmt: skip
    nodes = trimesh.load(result / "segments.glb").graph.nodes_geometry
    assert "base" in nodes
    base = next(s for s in view.mesh.segments if s.name == "base")
    found = next(s for s in read_json(result / "summary.json")["segments"] if s["name"] == "base")
    assert norm(np.array(found["centroid"]) - base.vertices.mean(axis=0)) < 4.0
