"""Settings: every number has bounds, NaN passes none, the help shows them; those of networks are flat where written."""

import json
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest
from folder_contents import run_mereo

import mereo.__main__ as command_line
from mereo.cli import answers, scenes, tools, training
from mereo.io.bounds import Bounds, check_values
from mereo.io.config import InputConfig
from mereo.models.config import PARTS, Encoder, NetworkConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.synthesis.config import GenerateConfig, SamplingConfig, SensorConfig
from mereo_learning.config import PRESETS, AugmentConfig, TrainConfig

SETTINGS = (
    *(*PARTS.values(), NetworkConfig, AugmentConfig, TrainConfig),
    *(SensorConfig, SamplingConfig, GenerateConfig, IsolationConfig, InputConfig),
)
COMMANDS = [
    found
    for module in (answers, scenes, tools, training)
    for found in vars(module).values()
    if is_dataclass(found) and found.__module__ == module.__name__
]
OWN_RULES = {"depth_range", "box", "point", "frame_index", "unit_m", "mask_value"}
"""Options whose rule is more than an interval."""


def has_numbers(kind: Any) -> bool:
    return kind in (int, float) or any(has_numbers(part) for part in get_args(kind) if get_origin(kind) is not None)


def bounds_of(kind: Any) -> Bounds | None:
    return next((extra for extra in getattr(kind, "__metadata__", ()) if isinstance(extra, Bounds)), None)


OPTIONS = [
    pytest.param(settings, item.name, kind, id=f"{settings.__name__}.{item.name}")
    for settings in (*SETTINGS, *COMMANDS)
    for kinds in (get_type_hints(settings, include_extras=True),)
    for item in fields(settings)
    for kind in (kinds[item.name],)
    if has_numbers(kind) and item.name not in OWN_RULES
]


def outside(bounds: Bounds, kind: Any) -> list[Any]:
    values = ["1", True, float("nan"), float("inf"), float("-inf")]
    if bounds.most < 1e9:
        values.append(bounds.most if bounds.below else bounds.most + 1)
    values.append(bounds.least if bounds.above else bounds.least - 1)
    many = get_origin(get_args(kind)[0]) is tuple
    return [(), *((value, value) for value in values)] if many else values


@pytest.mark.parametrize(("settings", "name", "kind"), OPTIONS)
def test_every_number_has_bounds_that_it_cannot_leave(settings: type, name: str, kind: Any) -> None:
    bounds = bounds_of(kind)
    assert bounds is not None, "annotate it with a kind of mereo.io.bounds"
    sentence = rf"{name.replace('_', '[_-]')} is .*; it must be .*{re.escape(bounds.rule)}: "
    for value in outside(bounds, kind):
        with pytest.raises(ValueError, match=sentence):
            check_values(settings, {name: value})
    if settings in SETTINGS:
        with pytest.raises(ValueError, match=sentence):
            settings(**{name: outside(bounds, kind)[-1]})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("generate rope --examples 1 --output run --workers 9999", "--workers is 9999; it must be a whole number"),
        ("train data --output run --learning-rate nan", "learning_rate is nan; it must be greater than 0: give for"),
        ("train data --output run --network.skip-after 99", "network.skip_after is 99, of 7 layers; the query and"),
        ("train data --output run --augment.keep-points 1 0.5", "augment.keep_points is 1 0.5; the smaller prob"),
        ("train data --output run --network.local-width 6", "network.local_width is 6; it must be a multiple of its 4"),
        ("train data --output run --batch 1 --queries 1", "batch and queries are both 1; batch normalization"),
    ],
)
def test_an_option_out_of_its_bounds_is_refused_before_anything_is_read_or_written(
    text: str, message: str, working_folder: Path, capsys: pytest.CaptureFixture
) -> None:
    assert command_line.main(text.split()) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"mereo: error: {message}") and printed.count("\n") == 1
    assert not list(working_folder.iterdir())


def test_the_help_shows_bounds(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        run_mereo("bench", "--help")
    assert "(default: 7; at least 1)" in " ".join(capsys.readouterr().out.replace("│", "").split())


def test_settings_of_a_file_have_the_types_of_their_fields() -> None:
    for name, value, rule in (
        ("encoder", "transformer", "one of pointnet2, "),
        ("encode_positions", 1, "true or false"),
        ("width", "64", "a whole number, from 1 to 8192"),
        ("mlp1", 64, "whole numbers, each from 1 to 8192"),
        ("mlp1", (64, "64 \n"), "whole numbers, each from 1 to 8192"),
    ):
        with pytest.raises(ValueError, match=f"network.{name} is .*; it must be {rule}"):
            NetworkConfig.from_dict({name: value})


# --- settings of networks have parts, and are flat wherever they are written ------------------------------------------


OTHERS = {
    bool: lambda value: not value,
    int: lambda value: value + 4,
    float: lambda value: value + 0.25,
}


def another(name: str, value: Any) -> Any:
    if name == "encoder":
        return get_args(Encoder)[-1]
    if name == "skip_after":
        return value + 1  # of seven layers
    return (*value, 7) if isinstance(value, tuple) else OTHERS[type(value)](value)


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


def test_a_recipe_is_written_flat() -> None:
    """Runs and weights hold the network's settings as they did before there were parts."""
    written = TrainConfig().to_dict()
    names = [item.name for item in fields(TrainConfig)]
    assert list(written) == [name for name in names if name != "code_length"]  # of an autodecoder's codes
    assert list(PRESETS["tiny-autodecoder"].to_dict()) == names
    assert list(written["network"])[:6] == ["encoder", "points", "neighbors", "ratio1", "radius1", "mlp1"]
    assert written["augment"]["keep_points"] == (1.0, 1.0)
