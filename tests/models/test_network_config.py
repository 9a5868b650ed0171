"""Settings of networks have parts, and are flat wherever they are written: in weights, in runs, as options."""

import json
from dataclasses import fields
from typing import Any, get_args

import pytest

import mereo.__main__ as command_line
from mereo.cli.training import Train
from mereo.models.config import PARTS, Encoder, NetworkConfig
from mereo_learning.config import PRESETS, TrainConfig

OTHERS: dict[type, Any] = {
    bool: lambda value: not value,
    int: lambda value: value + 4,
    float: lambda value: value + 0.25,
}


def another(name: str, value: Any) -> Any:
    """A value of the same kind that is not the default."""
    if name == "encoder":
        return get_args(Encoder)[-1]
    if name == "skip_after":
        return value + 1  # of seven layers
    return (*value, 7) if isinstance(value, tuple) else OTHERS[type(value)](value)


def options(settings: dict[str, Any]) -> list[str]:
    """As a command line has them, where a switch that is on is switched off by ``no-``."""
    found = []
    for name, value in settings.items():
        option = name.replace("_", "-")
        if isinstance(value, bool):
            found += [f"--network.{option}" if value else f"--network.no-{option}"]
        else:
            found += [f"--network.{option}", *map(str, value if isinstance(value, tuple) else (value,))]
    return found


ALL_OTHERS = {name: another(name, value) for name, value in NetworkConfig().to_dict().items()} | {"spread_penalty": 0.5}


def test_every_setting_has_one_name_and_comes_back_as_it_was_written() -> None:
    """Side by side none hides another: as many names as the parts have settings."""
    count = 2 + sum(len(fields(part)) for part in PARTS.values())
    assert len(NetworkConfig().to_dict()) == count - 1  # an unused penalty is not written
    assert len(NetworkConfig.from_dict(ALL_OTHERS).to_dict()) == len(ALL_OTHERS) == count
    assert not any(isinstance(value, dict) for value in NetworkConfig().to_dict().values())
    for config in (
        NetworkConfig(),
        NetworkConfig.from_dict(ALL_OTHERS),
        *(preset.network for preset in PRESETS.values()),
    ):
        assert NetworkConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert NetworkConfig.from_dict(ALL_OTHERS).to_dict() == ALL_OTHERS
    assert NetworkConfig.from_dict({}) == NetworkConfig(), "what is not stated is at its default"


@pytest.mark.parametrize("name", ["heads", "decoder", "pointnet2"])
def test_unknown_settings_are_named(name: str) -> None:
    with pytest.raises(ValueError, match=f"the network settings differ in '{name}' from this version of mereo"):
        NetworkConfig.from_dict({"width": 64, name: 3})


def test_every_setting_is_an_option_without_its_part() -> None:
    command = command_line.parse(["train", "data", "--output", "run", "--preset", "paper", *options(ALL_OTHERS)])
    assert isinstance(command, Train)
    assert command.config.network.to_dict() == ALL_OTHERS


def test_a_recipe_is_written_flat() -> None:
    """Runs and weights hold the network's settings as they did before there were parts."""
    written = TrainConfig().to_dict()
    names = [item.name for item in fields(TrainConfig)]
    assert list(written) == [name for name in names if name != "code_length"]  # of an autodecoder's codes
    assert list(PRESETS["tiny-autodecoder"].to_dict()) == names
    assert list(written["network"])[:6] == ["encoder", "points", "neighbors", "ratio1", "radius1", "mlp1"]
    assert written["augment"]["keep_points"] == (1.0, 1.0)
