"""Arguments that mean no command: one sentence, what was probably meant, and where help is."""

import os
import subprocess
import sys
from contextlib import contextmanager

import pytest

from mereo import __main__ as command_line

RECONSTRUCT = "reconstruct scan.ply --weights bunny --output out"


def said(text: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that refuses these arguments."""
    assert command_line.main(text.split()) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("mereo: error: ") and printed.err.count("\n") == 1
    return printed.err.removeprefix("mereo: error: ").rstrip()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        # commands
        ("recontruct a.ply", "mereo has no command 'recontruct' (did you mean reconstruct?); see `mereo --help`"),
        ("paint", "mereo has no command 'paint'; see `mereo --help`"),
        ("assets gett x", "mereo assets has no command 'gett' (did you mean get?); it must be one of list, get; "
         "see `mereo assets --help`"),
        ("assets", "mereo assets is only the first word of a command; the next must be one of list, get; "
         "see `mereo assets --help`"),
        ("--weights b reconstruct", "'--weights' comes before the command; options follow it: give the command first; "
         "see `mereo --help`"),
        # options
        ("learn lamp.stl", "mereo learn lacks --output: add it; see `mereo learn --help`"),
        ("train data", "mereo train lacks --output: add it; see `mereo train --help`"),
        (f"{RECONSTRUCT} --resoluton 64", "mereo reconstruct has no option '--resoluton' (did you mean --resolution?); "
         "see `mereo reconstruct --help`"),
        (f"{RECONSTRUCT} --depth_rnge=1", "mereo reconstruct has no option '--depth_rnge' (did you mean "
         "--depth-range?); see `mereo reconstruct --help`"),
        ("reconstruct --batch 3 a.ply", "mereo reconstruct has no option '--batch'; see `mereo reconstruct --help`"),
        (f"{RECONSTRUCT} b.ply", "'b.ply' is one word too many for mereo reconstruct: leave it out, or put its option "
         "before it; see `mereo reconstruct --help`"),
        # values
        ("train data --output run --batch x", "--batch is 'x'; it must be a whole number, from 1 to 65536; "
         "see `mereo train --help`"),
        ("train data --output run --network.width=1.5", "--network.width is '1.5'; it must be a whole number, from 1 "
         "to 8192; see `mereo train --help`"),
        (f"{RECONSTRUCT} --depth_scale x", "--depth-scale is 'x'; it must be a number, greater than 0; "
         "see `mereo reconstruct --help`"),
        (f"{RECONSTRUCT} --depth-range 1 x", "--depth-range is '1 x'; it must be 2 values: a number, a number; "
         "see `mereo reconstruct --help`"),
        (f"{RECONSTRUCT} --method mods", "--method is 'mods' (did you mean modes?); it must be one of auto, "
         "network, search, modes, full; see `mereo reconstruct --help`"),
        ("train data --output run --preset huge", "--preset is 'huge'; it must be one of paper, paper-autodecoder, "
         "base, large, tiny, tiny-autodecoder; see `mereo train --help`"),
        ("export bunny --output", "--output has no value; it must be a path; see `mereo export --help`"),
        ("generate rope --output o --examples " + "9" * 99 + "x", "--examples is '" + "9" * 60 + "'...; it must be a "
         "whole number, at least 1; see `mereo generate --help`"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_sentence(text: str, sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said(text, capsys) == sentence


@pytest.mark.parametrize("hook", [None, "told"])
@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("learn lamp.stl", ("Missing from mereo learn", "--output")),
        ("train data --output run --batch x", ("--batch", "'x'")),
        (f"{RECONSTRUCT} --method mods", ("'mods'", "--method", "'modes'")),
    ],
)
def test_a_tyro_that_tells_less_still_gives_one_sentence(
    text: str,
    parts: tuple[str, ...],
    hook: str | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """What it prints is said then, in one line; the names of commands and options come from the help."""

    class MissingArgs:
        """Event of another version, without what is read of it."""

    @contextmanager
    def other_hook() -> object:  # type: ignore[misc]
        yield [MissingArgs()] if hook else []

    monkeypatch.setattr(command_line, "noted_events", other_hook)
    sentence = said(text, capsys)
    assert all(part in sentence for part in parts) and "│" not in sentence and len(sentence) < 400
    assert sentence.endswith(f"; see `mereo {text.split()[0]} --help`")
    assert "did you mean reconstruct?" in said("recontruct", capsys)
    assert "did you mean --batch?" in said("train data --output run --bach 3", capsys)


def test_a_terminal_without_these_characters_is_no_error() -> None:
    command = [sys.executable, "-m", "mereo", "assets", "--help"]
    done = subprocess.run(command, capture_output=True, env={**os.environ, "PYTHONIOENCODING": "ascii"}, check=False)
    assert done.returncode == 0 and b"? list" in done.stdout and done.stderr == b""
