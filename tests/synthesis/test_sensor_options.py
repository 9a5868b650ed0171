"""Sensors from the command line to the files: presets, datasets that state them, evaluation with them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from toy_scene import toy_scene

import mereo.__main__ as command_line
from mereo.api.generate import generate
from mereo.cli import training
from mereo.evaluation.scoring import EvaluationConfig
from mereo.geometry.camera import PointCloud
from mereo.models.model import Model
from mereo.models.trained import EncodedCloud
from mereo.synthesis.config import SENSOR_TERMS, SENSORS, GenerateConfig, SamplingConfig, Sensor, SensorConfig
from mereo.visualization.evaluation_report import evaluate_weights

SMALL = GenerateConfig(image_size=48, points=64, sampling=SamplingConfig(per_segment=8))
BASICS = "generate rope --examples 7 --output out"


def generate_options(text: str) -> GenerateConfig:
    command = command_line.parse(f"{BASICS} {text}".split())
    assert isinstance(command, training.Generate)
    return command.settings


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("form", ["--sensor {}", "--sensor={}"])
def test_one_option_chooses_a_sensor(name: Sensor, form: str) -> None:
    assert generate_options(form.format(name)) == GenerateConfig(sensor=SENSORS[name])
    command = command_line.parse(f"evaluate rope --output out {form.format(name)}".split())
    assert isinstance(command, training.Evaluate) and command.terms == SENSORS[name]
    assert SENSORS[name].on == (name != "paper")


def test_terms_are_added_to_a_sensor() -> None:
    chosen = generate_options("--sensor structured-light --sensor.tool 0.3 --sensor.holes 0 --sampler label-uniform")
    assert chosen.sensor == replace(SENSORS["structured-light"], tool=0.3, holes=0.0)
    assert chosen.sampling.sampler == "label-uniform"
    assert generate_options("--sensor.axial 1").sensor == SensorConfig(axial=1.0)


def test_every_term_is_off_by_default_and_switches_the_sensor_on() -> None:
    lengths = {"metres_per_unit", "model", "hole_radius_m"}
    assert set(SENSOR_TERMS) | lengths == set(SensorConfig.__dataclass_fields__)
    assert not SensorConfig().on and set(get_args(Sensor)) == set(SENSORS)
    assert all(replace(SensorConfig(), **{name: 0.1}).on for name in SENSOR_TERMS)


def test_an_unknown_sensor_is_answered_with_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="^2$"):
        command_line.parse(f"{BASICS} --sensor lidar".split())
    printed = capsys.readouterr().err
    assert "invalid choice 'lidar'" in printed and "'time-of-flight'" in printed


def test_a_bad_strength_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "data"
    arguments = ["generate", "rope", "--examples", "1", "--output", str(output), "--sensor.flying", "2"]
    assert command_line.main(arguments) == 2 and not output.exists()
    assert (
        capsys.readouterr().err == "mereo: error: sensor.flying is 2.0; it must be from 0 to 1: give for example 0.0\n"
    )


# --- datasets ---------------------------------------------------------------------------------------------------------


def test_the_manifest_states_the_sensor_and_resuming_needs_the_same(tmp_path: Path) -> None:
    spoiled = replace(SMALL, sensor=SENSORS["time-of-flight"])
    generate(toy_scene(), tmp_path / "data", spoiled, examples=2, seed=3)
    manifest = json.loads((tmp_path / "data" / "manifest.json").read_text())
    assert SensorConfig(**manifest["settings"]["sensor"]) == SENSORS["time-of-flight"]
    generate(toy_scene(), tmp_path / "data", spoiled, examples=2, seed=3, resume=True)
    with pytest.raises(ValueError, match="was made with settings.sensor.model = 'time-of-flight', not 'structured-lig"):
        generate(toy_scene(), tmp_path / "data", SMALL, examples=2, seed=3, resume=True)


# --- evaluation -------------------------------------------------------------------------------------------------------


def test_evaluation_looks_through_the_sensor_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clouds: list[PointCloud] = []

    def watch(model: Model, cloud: PointCloud) -> EncodedCloud:
        clouds.append(cloud)
        return encode(model, cloud)

    encode = Model.encode
    monkeypatch.setattr(Model, "encode", watch)
    for number, settings in enumerate((GenerateConfig(), GenerateConfig(128, 0.5, sensor=SENSORS["structured-light"]))):
        config = EvaluationConfig(examples=1, cells=12, settings=settings, method="network")
        evaluate_weights("rope", tmp_path / str(number), config)
    facts = [json.loads((tmp_path / str(number) / "metrics.json").read_text()) for number in range(2)]
    assert [(fact["image_size"], fact["noise_std"]) for fact in facts] == [(96, 0.1), (128, 0.5)]
    assert [SensorConfig(**fact["sensor"]) for fact in facts] == [SENSORS["paper"], SENSORS["structured-light"]]
    assert len(clouds) == 2 and not np.array_equal(clouds[0].points[:20], clouds[1].points[:20])


def test_real_scans_take_no_simulated_errors() -> None:
    arguments = ["evaluate", "bunny", "--output", "out", "--scans", "--sensor", "time-of-flight"]
    with pytest.raises(ValueError, match="--scans are real and take no simulated camera: leave out --sensor, --image"):
        command_line.parse(arguments).run()
