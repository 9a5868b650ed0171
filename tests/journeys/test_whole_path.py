"""The whole path through the command line: generate, train, evaluate, reconstruct; on the rope, with preset `tiny`."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view


def mereo(*arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "mereo", *map(str, arguments)], capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_tiny_network_finds_the_rope(tmp_path: Path) -> None:
    """About two CPU minutes of training suffice to see the object; more examples are what the presets are for."""
    data, run, test, result = (tmp_path / name for name in ("data", "run", "test", "result"))
    mereo("generate", "rope", "--examples", 1536, "--seed", 7, "--workers", 2, "--output", data)
    mereo("train", data, "--output", run, "--preset", "tiny", "--epochs", 12)
    weights = run / "weights.safetensors"
    mereo("evaluate", weights, "--examples", 6, "--seed", TEST_SEED_START, "--output", test)
    scores = json.loads((test / "metrics.json").read_text())
    assert scores["iou"] > 0.45 and scores["miou"] > 0.15
    view = sample_view(load_scene("rope"), GenerateConfig(), example_rng(TEST_SEED_START, 0))
    np.save(tmp_path / "cloud.npy", view.depth.to_points().points)
    mereo("reconstruct", tmp_path / "cloud.npy", "--weights", weights, "--resolution", 64, "--output", result)
    assert {path.name for path in result.glob("[!.]*")} == {
        "config.json", "segments.glb", "labels.npz", "summary.json", "state.json", "preview.png", "radius95.glb",
        "report.html"
    }  # fmt: skip
    nodes = trimesh.load(result / "segments.glb").graph.nodes_geometry
    assert "base" in nodes
    base = next(s for s in view.mesh.segments if s.name == "base")
    found = next(s for s in json.loads((result / "summary.json").read_text())["segments"] if s["name"] == "base")
    assert np.linalg.norm(np.array(found["centroid"]) - base.vertices.mean(axis=0)) < 4.0
