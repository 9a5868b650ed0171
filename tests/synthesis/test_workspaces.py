"""Where virtual cameras may be: a scene's own workspace, a cone, the whole sphere; from the options to the files."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from toy_scene import toy_scene

import mereo.__main__ as command_line
from mereo.api.generate import generate
from mereo.cli import training
from mereo.evaluation.scoring import EvaluationConfig
from mereo.evaluation.tables import read_metrics
from mereo.models.weights import load_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import PAPER_APERTURE_RAD, WHOLE_SPHERE_RAD, Scene, Workspace
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo.synthesis.examples import sample_view
from mereo.training.model_card import card
from mereo.visualization.evaluation_report import evaluate_weights

SMALL = GenerateConfig(image_size=48, points=64, sampling=SamplingConfig(per_segment=8))
NARROW = Workspace(axis=(0.0, 1.0, 0.0), aperture_rad=0.5)
ALL_AROUND = Workspace(axis=(1.0, 0.0, 0.0), aperture_rad=WHOLE_SPHERE_RAD, any_roll=True, distance=(90.0, 95.0))


def looks(scene: Scene, settings: GenerateConfig, count: int) -> np.ndarray:
    """Unit vectors from the object to random cameras."""
    poses = [sample_view(scene, settings, example_rng(1, index)).T_world_camera for index in range(count)]
    return np.stack([-pose[:3, 2] for pose in poses])


def test_a_scene_with_a_cone_keeps_it_and_may_be_seen_from_all_around() -> None:
    scene = replace(toy_scene(), workspace=NARROW)
    assert scene.workspace_named("own") is scene.workspace_named("cone") is NARROW
    assert scene.workspace_named("sphere") is not NARROW
    assert asdict(scene.workspace_named("sphere")) == asdict(NARROW) | {"aperture_rad": 2 * np.pi, "any_roll": True}


def test_a_scene_seen_from_all_around_has_its_own_cone_or_the_papers() -> None:
    scene = replace(toy_scene(), workspace=ALL_AROUND)
    assert scene.workspace_named("own") is scene.workspace_named("sphere") is ALL_AROUND
    expected = asdict(ALL_AROUND) | {"aperture_rad": PAPER_APERTURE_RAD, "any_roll": False}
    assert asdict(scene.workspace_named("cone")) == expected
    assert replace(scene, cone=NARROW).workspace_named("cone") is NARROW


def test_cameras_are_where_the_settings_say() -> None:
    scene = replace(toy_scene(), workspace=NARROW)
    assert looks(scene, SMALL, 20)[:, 1].min() > np.cos(0.25) - 1e-9
    around = looks(scene, replace(SMALL, workspace="sphere"), 20)
    assert np.abs(around).max() > 0.8 and (around < -0.3).any(axis=0).all() and (around > 0.3).any(axis=0).all()


def test_the_bunny_is_seen_from_all_around_or_from_above(require_asset: Callable[[str], Path]) -> None:
    require_asset("bunny/bunny.off")
    bunny = load_scene("bunny")
    own, sphere = looks(bunny, SMALL, 10), looks(bunny, replace(SMALL, workspace="sphere"), 10)
    assert np.array_equal(own, sphere) and own[:, 1].min() < -0.3
    above = looks(bunny, replace(SMALL, workspace="cone"), 10)
    up = np.mean([bunny.rest.segments[k].vertices.mean(axis=0) for k in (2, 3)], axis=0)[1]  # the ears are on top
    assert up > bunny.rest.segments[0].vertices.mean(axis=0)[1] and above[:, 1].min() > np.cos(np.deg2rad(70)) - 1e-9


# --- datasets ---------------------------------------------------------------------------------------------------------


def test_the_manifest_states_the_workspace_and_resuming_needs_the_same(tmp_path: Path) -> None:
    scene, cone = replace(toy_scene(), workspace=ALL_AROUND), replace(SMALL, workspace="cone")
    generate(scene, tmp_path / "data", cone, examples=2, seed=3)
    manifest = json.loads((tmp_path / "data" / "manifest.json").read_text())
    assert manifest["settings"]["workspace"] == "cone" and manifest["any_roll"] is False
    assert manifest["workspace"] == json.loads(json.dumps(asdict(scene.workspace_named("cone"))))
    generate(scene, tmp_path / "data", cone, examples=2, seed=3, resume=True)
    with pytest.raises(ValueError, match="was made with settings.workspace = 'cone', not 'own'; resuming needs equal"):
        generate(scene, tmp_path / "data", SMALL, examples=2, seed=3, resume=True)


def test_settings_say_nothing_of_the_scenes_own_workspace() -> None:
    """So manifests, and the keys of datasets made of them, are as they were before there was a choice."""
    assert "workspace" not in SMALL.stated() and "observations" not in SMALL.stated()
    assert replace(SMALL, workspace="sphere").stated() == SMALL.stated() | {"workspace": "sphere"}


# --- evaluation -------------------------------------------------------------------------------------------------------


def test_evaluation_looks_from_the_workspace_and_says_so(tmp_path: Path) -> None:
    for name in ("own", "sphere"):
        settings = GenerateConfig(workspace=name)  # type: ignore[arg-type]
        config = EvaluationConfig(examples=1, cells=12, settings=settings, method="network")
        evaluate_weights("rope", tmp_path / name, config)
    own, sphere = (read_metrics(tmp_path / name / "metrics.json") for name in ("own", "sphere"))
    assert (own["workspace"], sphere["workspace"]) == ("own", "sphere") and own["iou"] != sphere["iou"]
    said = ", workspace sphere, noise 0.1 units"
    assert said in card("rope", load_model("rope"), [sphere], b"")
    assert "workspace sphere" not in card("rope", load_model("rope"), [own], b"").split("## Results")[-1]


def test_the_command_line_names_workspaces(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["rope", "--output", "out", "--workspace"]
    made = command_line.parse(["generate", "--examples", "7", *options, "sphere"])
    scored = command_line.parse(["evaluate", *options, "cone"])
    assert isinstance(made, training.Generate) and made.settings.workspace == "sphere"
    assert isinstance(scored, training.Evaluate) and scored.workspace == "cone"
    with pytest.raises(SystemExit, match="^2$"):
        command_line.parse(["evaluate", *options, "dome"])
    assert "invalid choice 'dome' for argument '--workspace'" in capsys.readouterr().err
    settings = GenerateConfig()
    object.__setattr__(settings, "workspace", "dome")  # as where types are not checked
    with pytest.raises(ValueError, match="workspace is 'dome'; it must be one of own, cone, sphere: give"):
        settings.__post_init__()
    scans = ["evaluate", "bunny", "--scans", "--workspace", "cone", "--output", str(tmp_path / "out")]
    assert command_line.main(scans) == 2 and "--noise-std and --workspace" in capsys.readouterr().err
