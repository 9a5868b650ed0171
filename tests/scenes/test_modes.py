"""How many modes an object needs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import untrained

from mereo import __main__ as command_line
from mereo.cli.scenes import SceneModes
from mereo.models.weights import save_model
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.statistical_model import StatisticalModel, with_fewer_modes


@pytest.fixture(scope="module")
def model() -> StatisticalModel:
    return scene_model(load_scene("rope"), 100)


def test_the_residue_of_fewer_modes_is_that_of_the_model_without_the_others(model: StatisticalModel) -> None:
    for count in (0, 1, model.count // 2, model.count):
        assert model.residues[count] == pytest.approx(with_fewer_modes(model, count).residue, rel=1e-6)
    assert (np.diff(model.residues) < 0).all() and (np.diff(model.explained) > 0).all()


def test_the_number_of_modes_needed_is_the_smallest_that_is_enough(model: StatisticalModel) -> None:
    count = model.modes_for(1.0)
    assert count is not None and model.residues[count] <= 1.0 < model.residues[count - 1]
    assert model.modes_for(np.inf) == 0 and model.modes_for(model.residue / 2) is None


def test_the_command_says_how_many(capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.main(["scene", "modes", "rope", "--states", "100"]) == 0
    assert "modes leave" in capsys.readouterr().out


def test_weights_show_the_model_that_they_carry(
    model: StatisticalModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = replace(untrained(model.rest.names), provenance={"scene": "rope"})
    save_model(replace(network, statistical_model=model), tmp_path / "with.safetensors")
    SceneModes(str(tmp_path / "with.safetensors"), states=100).run()
    assert f"{model.count} modes" in capsys.readouterr().out
    save_model(network, tmp_path / "without.safetensors")
    with pytest.raises(ValueError, match="carries no statistical model: name the scene"):
        SceneModes(str(tmp_path / "without.safetensors"), states=100).run()


def test_too_few_states_are_refused() -> None:
    with pytest.raises(ValueError, match="fewer than 100 say little"):
        SceneModes("rope", states=5).run()
