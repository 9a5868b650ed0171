"""Progress of long work: one style, on a terminal and off it, with the time to the very end."""

import io
import re
import sys
from collections.abc import Callable

import pytest
from rich.console import Console

from mereo.io import progress as module
from mereo.io.progress import duration, progress, tracked


@pytest.fixture
def wait(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Let a number of seconds pass, on a clock that only this moves; every step is worth a line."""
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(module, "LINE_EVERY_S", 0.0)

    def pass_by(seconds: float) -> None:
        now[0] += seconds

    return pass_by


def test_lines_say_stage_rate_and_time_left(wait: Callable[[float], None], capsys: pytest.CaptureFixture) -> None:
    with progress("generate", 30) as shown:
        wait(2.0)
        shown.advance(10)
        wait(2.0)
        shown.advance(10, "loss 1.5")
    printed = capsys.readouterr()
    assert printed.out == "", "results alone are on standard output"
    assert printed.err.splitlines() == [
        "generate: 10 of 30 examples, 5.0 examples/s, 4 s left",
        "generate: 20 of 30 examples, 5.0 examples/s, 2 s left, loss 1.5",
        "generate: 20 examples in 4 s",
    ]


def test_pauses_count_for_the_end_not_the_rate(wait: Callable[[float], None], capsys: pytest.CaptureFixture) -> None:
    with progress("train", 4, "steps", each=2) as shown:
        wait(1.0)
        shown.advance()
        with shown.paused():
            wait(50.0)
        wait(1.0)
        shown.advance()
    *_, last, end = capsys.readouterr().err.splitlines()
    assert last == "train: 2 of 4 steps, 2.0 examples/s, 2 s left" and end == "train: 2 steps in 52 s"


def test_a_failure_is_not_called_done_and_nothing_to_do_says_nothing(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(ValueError, match="broken"), progress("generate", 3) as shown:
        shown.advance()
        raise ValueError("broken")
    for _ in tracked("evaluate", 0, "views"):
        pass
    for _ in tracked("evaluate", 2, "views", quiet=True):
        pass
    assert capsys.readouterr().err == ""


def test_a_terminal_gets_a_bar_below_what_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    drawn = io.StringIO()
    monkeypatch.setattr(
        module, "Console", lambda **_: Console(file=drawn, force_terminal=True, width=100, legacy_windows=False)
    )
    with progress("generate", 4) as shown:
        shown.advance(2)
        print("a result", file=sys.stdout)
        shown.advance(2)
    assert re.search(r"generate.*━.*4 of 4 examples, .* examples/s, 0 s left", drawn.getvalue())
    assert "a result" not in drawn.getvalue() and capsys.readouterr().out == "a result\n", "it may go into a file"


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (89, "89 s"), (91, "2 min"), (7100, "118 min"), (7300, "2 h 02 min")]
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text
