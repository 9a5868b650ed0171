"""Help of all commands, found from the help of the whole: every option is explained, every positional has its word."""

import io
import re
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import lru_cache
from pathlib import Path

import pytest

from mereo import __main__ as command_line

QUICKSTART = Path(__file__).parents[2] / "docs/quickstart.md"
METAVARS = ("SCENE", "OBJECT", "DATASET", "WEIGHTS", "INPUT", "SCAN", "ASSET")
"""Words for positionals: see ``cli.options``."""

FREE = ("{encoder-loss,",)
"""Beginning of positionals that are chosen from a list, which is shown instead of a word."""


ADDED = re.compile(r"\((default|required|repeatable)[^()]*(\([^()]*\))?[^()]*\)")
"""What is said of an option without being an explanation."""


@lru_cache
def help_of(command: str) -> str:
    """Text of ``mereo COMMAND --help`` as a terminal shows it."""
    text = io.TextIOWrapper(io.BytesIO(), "utf-8")  # without an encoding, boxes are drawn otherwise
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(text):
        patch.setenv("COLUMNS", "120")  # wider ones show two boxes side by side
        with pytest.raises(SystemExit):
            command_line.main([*command.split(), "--help"])
    text.seek(0)
    return text.read()


def commands(group: str = "") -> Iterator[str]:
    listed = re.findall(r"^│ +• ([a-z-]+)", help_of(group), re.MULTILINE)
    for name in listed:
        yield from commands(f"{group} {name}".strip())
    if not listed:
        yield group


def entries(command: str) -> dict[str, str]:
    """What a command takes, as its help shows it, each with its explanation but for defaults and rules."""
    found: dict[str, str] = {}
    for line in help_of(command).splitlines():
        if re.match(r"│ (-|[A-Z{\[])", line):  # lower case begins what is said of a whole box
            name, _, text = line.strip("│ ").partition("  ")
            found[name] = text.strip()
        elif line.startswith("│   ") and found:
            found[next(reversed(found))] += f" {line.strip('│ ')}"
    return {name: ADDED.sub("", text).strip() for name, text in found.items()}


COMMANDS = tuple(commands())


def test_all_commands_are_found() -> None:
    assert {"generate", "scene new", "weights show", "assets get", "reconstruct", "learn"} <= set(COMMANDS)
    assert len(COMMANDS) >= 22


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_is_explained(command: str) -> None:
    found = entries(command)
    assert "-h, --help" in found
    for name, text in found.items():
        assert len(text.split()) >= 2, f"mereo {command} {name}: {text!r}"


@pytest.mark.parametrize("command", COMMANDS)
def test_positionals_have_the_words_of_all_commands(command: str) -> None:
    box = help_of(command).partition("positional arguments")[2].partition("╰")[0]
    for name in re.findall(r"^│ ([^ │].*?)(?:  |$)", box, re.MULTILINE):
        assert name.startswith(FREE) or set(re.findall(r"[A-Z]+", name)) <= set(METAVARS), name


def test_long_work_takes_threads_and_options_from_a_file() -> None:
    for command in ("generate", "train", "evaluate", "learn", "reconstruct"):
        assert "--config" in help_of(command), command
    for command in ("generate", "train", "evaluate", "learn", "reconstruct", "stream", "experiment"):
        assert "--threads INT" in entries(command), command
    for command in ("train", "evaluate", "reconstruct", "stream", "bench"):
        assert "--device {auto,cpu,cuda}" in entries(command), command


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_prints_as_documented(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"mereo --tyro-print-completion {shell}" in QUICKSTART.read_text("utf-8")
    with pytest.raises(SystemExit) as end:
        command_line.main(["--tyro-print-completion", shell])
    script = capsys.readouterr().out
    assert not end.value.code and "mereo" in script
    for word in ("reconstruct", "weights", "--resolution", "--learning-rate"):
        assert word in script, word
