"""Numbers that settings may hold: every option has bounds, NaN passes none, and the help shows them."""

import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest

import mereo.__main__ as command_line
from mereo.cli import answers, scenes, tools, training
from mereo.io.bounds import Bounds, check_values
from mereo.io.config import InputConfig
from mereo.models.config import PARTS, NetworkConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.synthesis.config import GenerateConfig, SamplingConfig, SensorConfig
from mereo_learning.config import AugmentConfig, TrainConfig

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
OWN_RULES = {"depth_range", "box", "frame_index", "unit_m"}
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
    """Values just beyond the bounds, and what is no number."""
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
        ("train data --output run --batch 0", "batch is 0; it must be a whole number, from 1 to 65536: give for"),
        ("generate rope --examples 1 --output run --workers 9999", "--workers is 9999; it must be a whole number"),
        ("train data --output run --learning-rate nan", "learning_rate is nan; it must be greater than 0: give for"),
        ("train data --output run --network.mlp1 8 0", "network.mlp1 is 8 0; it must be whole numbers, each from"),
        ("train data --output run --network.skip-after 99", "network.skip_after is 99, of 7 layers; the query and"),
        ("train data --output run --augment.keep-points 1 0.5", "augment.keep_points is 1 0.5; the smaller prob"),
        ("train data --output run --network.local-width 6", "network.local_width is 6; it must be a multiple of its 4"),
        ("train data --output run --batch 1 --queries 1", "batch and queries are both 1; batch normalization"),
        ("generate rope --examples 0 --output run", "--examples is 0; it must be a whole number, at least 1: correct"),
        ("reconstruct a.npy --weights bunny --output run --depth-scale 0", "--depth-scale is 0.0; it must be greater"),
    ],
)
def test_an_option_out_of_its_bounds_is_refused_before_anything_is_read_or_written(
    text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command_line.main(text.split()) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"mereo: error: {message}") and printed.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_help_shows_bounds(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command_line.main(["bench", "--help"])
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
