"""What nobody has foreseen: one line that names the command and its files, and exit code 70."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

import mereo.__main__ as command_line


@pytest.fixture(autouse=True)
def without_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(command_line.TRACEBACK_VARIABLE, raising=False)


def command(monkeypatch: pytest.MonkeyPatch, work: Callable[[], object]) -> None:
    """Let any arguments mean this work."""
    monkeypatch.setattr(command_line, "parse", lambda arguments: SimpleNamespace(run=work))


@pytest.mark.parametrize(
    ("error", "end"),
    [
        (TypeError("a\nbug"), "TypeError: a bug; this is a fault of mereo: run it again with MEREO_TRACEBACK=1, and "),
        (MemoryError(), "MemoryError; the memory does not suffice: ask for less"),
        (RuntimeError("CUDA out of memory. " + 99 * "Tried. "), "...; the memory does not suffice: ask for less"),
        (RecursionError("too deep"), "RecursionError: too deep; something is nested too deeply, or in itself: look"),
    ],
)
def test_whatever_else_happens_is_one_line_that_names_command_and_files(
    error: Exception, end: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def fail() -> None:
        raise error

    command(monkeypatch, fail)
    assert command_line.main(["scene", "check", "cube", "--output", str(tmp_path), "\0"]) == command_line.FAULT == 70
    printed = capsys.readouterr().err
    assert printed.startswith(f"mereo: error: mereo scene check on {tmp_path}: {type(error).__name__}")
    assert end in printed and printed.count("\n") == 1
    monkeypatch.setenv(command_line.TRACEBACK_VARIABLE, "1")
    with pytest.raises(type(error)):
        command_line.main([])


def test_what_a_library_says_of_its_arguments_is_no_sentence_for_users(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """``json`` names neither the file nor a cure, and a ``ValueError`` of its own is a ``ValueError``."""
    command(monkeypatch, lambda: json.loads("{"))
    assert command_line.main(["align", "my.py", __file__]) == command_line.FAULT
    assert f"mereo align on {__file__}: JSONDecodeError: Expecting" in (line := capsys.readouterr().err)
    assert "this is a fault of mereo, or of the Python file: run it again with MEREO_TRACEBACK=1" in line
