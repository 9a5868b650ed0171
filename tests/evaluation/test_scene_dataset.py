"""Datasets of a user's own scene: the same for any number of workers, and only resumed while the scene is the same."""

import json
from pathlib import Path

import pytest
from analytic import AnalyticModel
from scene_code import CODE
from scene_files import write_bar, write_mesh
from shapes import ball
from toy_data import SMALL

from mereo.api.generate import generate
from mereo.evaluation.scoring import trained_scene


def made(scene: Path, output: Path, workers: int = 1, examples: int = 2, resume: bool = False) -> dict[str, bytes]:
    generate(str(scene), output, SMALL, examples=examples, seed=0, workers=workers, resume=resume)
    return {file.name: file.read_bytes() for file in output.iterdir()}


def test_an_edited_scene_is_not_resumed_but_an_edited_comment_is(tmp_path: Path) -> None:
    scene = write_bar(tmp_path, "deformations:\n  - type: lattice\n    strength: 0.5\n")
    first = made(scene, tmp_path / "data")
    manifest = json.loads(first["manifest.json"])
    assert manifest["scene"] == "bar" and len(manifest["scene_file_sha256"]) == 64
    assert manifest["unit_m"] == pytest.approx(0.0005)
    scene.write_text("# a comment\n" + scene.read_text())
    assert made(scene, tmp_path / "data", resume=True) == first
    scene.write_text(scene.read_text().replace("0.5", "0.4"))
    # the deformation decides how long faces are divided, so the rest mesh is another one, too, and is compared first
    with pytest.raises(ValueError, match="was made with (rest|scene_file)_sha256 = .*resuming needs equal settings"):
        made(scene, tmp_path / "data", resume=True)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["yaml", "py"])
def test_two_workers_make_the_same_files_as_one(kind: str, tmp_path: Path) -> None:
    scene = write_bar(tmp_path)
    if kind == "py":
        scene = tmp_path / "mine.py"
        file = write_mesh(ball((0, 0, 0), 10.0, level=2), tmp_path / "ball.ply")
        scene.write_text(CODE.format(name="mine", file=str(file)))
    one = made(scene, tmp_path / "one", 1, examples=70)
    assert made(scene, tmp_path / "two", 2, examples=70) == one


def test_weights_of_a_scene_that_is_not_built_in_ask_for_its_file() -> None:
    model = AnalyticModel.of(lambda points: points, ("a", "b", "c"))
    object.__setattr__(model, "provenance", {"scene": "bar"})
    with pytest.raises(ValueError, match=r"trained on the scene 'bar', which is not built in; .*--scene FILE.yaml"):
        trained_scene(model)
