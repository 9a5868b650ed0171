"""What is there stays: outputs of the examples and experiments, and the meshes of a scene."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from written_results import segments

from mereo import __main__ as command_line
from mereo.io.atomic_files import new_directory
from mereo.io.writers.glb import write_segments_glb

EXAMPLES = Path(__file__).parents[2] / "examples"
OUTPUTS = {
    "isolate_object.py": ("--output", "out/kept.png"),
    "loop.py": ("--output", "out/kept.webp"),
    "reconstruct_cloud.py": ("cloud.npy", "out"),
    "sensors.py": ("--output", "out/kept.png"),
    "shipped_weights.py": ("--output", "out/kept.png"),
    "simulate_liver.py": ("--output", "out/kept.npz"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OUTPUTS)
def test_an_example_replaces_no_file(name: str, tmp_path: Path) -> None:
    place = tmp_path / OUTPUTS[name][1]
    place = place / "thesis.tex" if not place.suffix else place
    place.parent.mkdir(parents=True)
    place.write_text("precious")
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *OUTPUTS[name]],
        cwd=tmp_path,
        env={**os.environ, "JAXTYPING_DISABLE": "1"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode != 0 and "it is not overwritten" in done.stderr and "Traceback" not in done.stderr
    assert place.read_text() == "precious" and len(list(place.parent.iterdir())) == 1


@pytest.mark.parametrize("command", ["reconstruct", "align"])
def test_the_meshes_of_a_scene_are_not_replaced(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not even where mereo wrote them: a result that a scene file names as its mesh."""
    with new_directory(tmp_path / "out") as folder:
        write_segments_glb(folder / "segments.glb", segments(), np.eye(3))
    (tmp_path / "s.yaml").write_text("name: s\nunits: m\nmodel: out/segments.glb\n")
    np.save(tmp_path / "cloud.npy", np.ones((300, 3)))
    before = (tmp_path / "out" / "segments.glb").read_bytes()
    more = ["--weights", "rope"]
    arguments = [command, tmp_path / "cloud.npy", "--scene", tmp_path / "s.yaml", "--output", tmp_path / "out"]
    assert command_line.main([*map(str, arguments), *more, "--force"]) == 2
    said = capsys.readouterr().err
    assert "segments.glb, which is read; it is not replaced: choose another --output" in said, said
    assert (tmp_path / "out" / "segments.glb").read_bytes() == before


def test_an_experiment_says_what_to_do_with_older_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Results that a version without lists of files has left; the folder of all the work is not the one to change."""
    older = tmp_path / "results" / "noise-smoke"
    older.mkdir(parents=True)
    (older / "table.md").write_text("precious")
    assert command_line.main(["experiment", "noise", "--output", str(tmp_path)]) == 2
    assert capsys.readouterr().err == (
        f"mereo: error: {older} holds table.md, not written by this version of mereo or changed since; it is not "
        "replaced: move it away or delete it, and run the same command again, which keeps the datasets, runs and "
        "scores and writes these results anew\n"
    )
    assert (older / "table.md").read_text() == "precious" and not (tmp_path / "datasets").exists()
