"""Sensors and workspaces from the options to the files: presets, datasets that state them, evaluation with them."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from toy_scene import toy_scene

import mereo.__main__ as command_line
from mereo.cli import training
from mereo.geometry.camera import PointCloud
from mereo.models.model import Model
from mereo.models.trained import EncodedCloud
from mereo.models.weights import load_model
from mereo.scenes.scene import PAPER_APERTURE_RAD, WHOLE_SPHERE_RAD, Workspace
from mereo.synthesis.config import SENSOR_TERMS, SENSORS, GenerateConfig, Sensor, SensorConfig
from mereo_learning.evaluation_report import evaluate_weights
from mereo_learning.model_card import card
from mereo_learning.scoring import EvaluationConfig
from mereo_learning.tables import read_metrics

NARROW = Workspace(axis=(0.0, 1.0, 0.0), aperture_rad=0.5)
ALL_AROUND = Workspace(axis=(1.0, 0.0, 0.0), aperture_rad=WHOLE_SPHERE_RAD, any_roll=True, distance=(90.0, 95.0))


def parsed(text: str) -> training.Generate | training.Evaluate:
    command = command_line.parse(text.split())
    assert isinstance(command, training.Generate | training.Evaluate)
    return command


def generate_options(text: str) -> GenerateConfig:
    command = parsed(f"generate rope --examples 7 --output out {text}")
    assert isinstance(command, training.Generate)
    return command.settings


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("form", ["--sensor {}", "--sensor={}"])
def test_an_option_chooses_a_sensor(name: Sensor, form: str) -> None:
    assert generate_options(form.format(name)) == GenerateConfig(sensor=SENSORS[name])
    command = parsed(f"evaluate rope --output out {form.format(name)}")
    assert isinstance(command, training.Evaluate) and command.terms == SENSORS[name]
    assert SENSORS[name].on == (name != "paper")


def test_terms_are_added_to_a_sensor_and_all_are_off_by_default() -> None:
    chosen = generate_options("--sensor structured-light --sensor.tool 0.3 --sensor.holes 0 --sampler label-uniform")
    assert chosen.sensor == replace(SENSORS["structured-light"], tool=0.3, holes=0.0)
    assert chosen.sampling.sampler == "label-uniform"
    assert generate_options("--sensor.axial 1").sensor == SensorConfig(axial=1.0)
    lengths = {"metres_per_unit", "model", "hole_radius_m"}
    assert set(SENSOR_TERMS) | lengths == set(SensorConfig.__dataclass_fields__)
    assert not SensorConfig().on and set(get_args(Sensor)) == set(SENSORS)
    assert all(replace(SensorConfig(), **{name: 0.1}).on for name in SENSOR_TERMS)


@pytest.mark.parametrize(
    "options, sentences",
    [
        ("generate rope --examples 7 --sensor lidar", ("invalid choice 'lidar'", "'time-of-flight'")),
        ("evaluate rope --workspace dome", ("invalid choice 'dome' for argument '--workspace'",)),
        (
            "generate rope --examples 1 --sensor.flying 2",
            ("mereo: error: sensor.flying is 2.0; it must be from 0 to 1: give for example 0.0\n",),
        ),
        ("evaluate bunny --scans --sensor time-of-flight", ("are real and take no simulated camera: leave out --sen",)),
        ("evaluate bunny --scans --workspace cone", ("--noise-std and --workspace",)),
    ],
)
def test_unknown_and_contradictory_options_are_refused_before_anything_is_written(
    options: str, sentences: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = command_line.main([*options.split(), "--output", str(tmp_path / "out")])
    except SystemExit as leaving:
        code = leaving.code
    printed = capsys.readouterr().err
    assert code == 2 and all(sentence in printed for sentence in sentences), printed
    assert not list(tmp_path.iterdir())


def test_a_scene_has_its_own_workspace_a_cone_and_the_sphere() -> None:
    scene = replace(toy_scene(), workspace=NARROW)
    assert scene.workspace_named("own") is scene.workspace_named("cone") is NARROW
    assert scene.workspace_named("sphere") is not NARROW
    assert asdict(scene.workspace_named("sphere")) == asdict(NARROW) | {"aperture_rad": 2 * np.pi, "any_roll": True}
    scene = replace(toy_scene(), workspace=ALL_AROUND)
    assert scene.workspace_named("own") is scene.workspace_named("sphere") is ALL_AROUND
    expected = asdict(ALL_AROUND) | {"aperture_rad": PAPER_APERTURE_RAD, "any_roll": False}
    assert asdict(scene.workspace_named("cone")) == expected
    assert replace(scene, cone=NARROW).workspace_named("cone") is NARROW


def test_evaluation_looks_through_the_sensor_from_the_workspace_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds: list[PointCloud] = []
    encode = Model.encode

    def watch(model: Model, cloud: PointCloud) -> EncodedCloud:
        clouds.append(cloud)
        return encode(model, cloud)

    monkeypatch.setattr(Model, "encode", watch)
    spoilt = GenerateConfig(128, 0.5, sensor=SENSORS["structured-light"])
    found = []
    for number, settings in enumerate((GenerateConfig(), spoilt, GenerateConfig(workspace="sphere"))):
        config = EvaluationConfig(examples=1, cells=12, settings=settings, method="network")
        evaluate_weights("rope", tmp_path / str(number), config)
        found.append(read_metrics(tmp_path / str(number) / "metrics.json"))
    own, through, around = found
    assert [(fact["image_size"], fact["noise_std"]) for fact in found] == [(96, 0.1), (128, 0.5), (96, 0.1)]
    assert [SensorConfig(**fact["sensor"]) for fact in (own, through)] == [SENSORS["paper"], spoilt.sensor]
    assert len(clouds) == 3 and not np.array_equal(clouds[0].points[:20], clouds[1].points[:20])
    assert (own["workspace"], around["workspace"]) == ("own", "sphere") and own["iou"] != around["iou"]
    assert ", workspace sphere, noise 0.1 units" in card("rope", load_model("rope"), [around], b"")
    assert "workspace sphere" not in card("rope", load_model("rope"), [own], b"").split("## Results")[-1]
