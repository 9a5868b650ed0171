"""What must be true of a command that was killed at a write boundary, and of the same command after it."""

import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from failpoints import MOVES, Commands

FOREIGN = ("thesis.tex", ".out.mine.mereo/mine.txt", ".out.00000000.partial/mine.txt")
"""Files of somebody else beside an output, two in folders that look like mereo's own."""

TIMES = re.compile(rb'"timings_s": {[^}]*}|"seconds": [0-9.e+-]+')
"""Durations in JSON, and in pages that hold it: all that differs between two runs of a command."""

RARELY = 3
"""Of calls that give a file its name, of a kind that was tried already, one in so many is tried."""


@dataclass(frozen=True)
class Case:
    """Command that writes ``out`` (or ``out.SUFFIX``).

    Attributes:
        arguments: the command line, with INPUTS for the folder of its inputs.
        again: what is added where the same command refuses because its result, or a part of it, is there; where
            nothing can be added, what it says of a whole result.
        timed: files that hold durations.
        first: a command that writes the result which this one replaces.
        dear: it takes seconds, so it is killed less often.
        only_once: it takes so long that it is not repeated after a full disk.
    """

    arguments: str
    again: str = ""
    timed: tuple[str, ...] = ()
    first: str = ""
    dear: bool = False
    only_once: bool = False


def boundaries(calls: list[str], every_call: bool) -> list[tuple[int, bool]]:
    """Sample of the moments at which a command is killed: the number of a call, and whether just after it.

    With ``every_call`` just after the first call of each kind, just before the first of each function that gives a file
    its name, and after every third (``RARELY``) further one of those; otherwise just after each of ``calls``. Just
    before another is what just after the one before it is, but for a scratch folder.
    """
    if not every_call:
        return [(number, True) for number in range(len(calls))]
    functions, kinds, further = dict[str, int](), dict[str, int](), list[int]()
    for number, (function, place) in enumerate(call.split(" ", 1) for call in calls):
        kind = f"{function} {_kind(function, Path(place))}"
        if kinds.setdefault(kind, number) != number and function in MOVES:
            further.append(number)
        if function in MOVES:
            functions.setdefault(function, number)
    before = [(number, False) for number in functions.values()]
    return [*before, *((number, True) for number in (*kinds.values(), *further[::RARELY]))]


def _kind(function: str, place: Path) -> str:
    """What makes two calls the same: the name that a file gets but for its numbers; of others only what it is."""
    if function in MOVES:
        return re.sub("[0-9a-f]{8}|[0-9]+", "0", place.name)
    if place.is_absolute():
        return "what is not mereo's, such as a cache of torch"
    return place.suffix if place.suffix == ".mereo" else "file or folder"


def check_boundaries(commands: Commands, case: Case, inputs: Path, folder: Path, *, every_call: bool) -> None:
    """Kill a command at each of its ``boundaries``, and demand the whole result of the next one.

    The next one succeeds, or refuses in one sentence and succeeds with ``case.again``. The result has the same bytes as
    one that was never disturbed; nothing is left over, and no file of somebody else has changed.
    """
    arguments, before = case.arguments.replace("INPUTS", str(inputs)), _content(inputs, case)
    fresh, whole, place = folder / "fresh", folder / "whole", folder / "place"
    _prepare(commands, case, inputs, fresh)
    shutil.copytree(fresh, whole)
    undisturbed = commands.run(whole, arguments, every_call=every_call)
    assert undisturbed.code == 0 and undisturbed.calls, undisturbed.said
    expected = _content(whole, case)
    for number, after in boundaries(undisturbed.calls, every_call):
        shutil.copytree(fresh, place)
        killed = commands.run(place, arguments, at=number, after=after, every_call=every_call)
        where = f"killed {'after' if after else 'before'} call {number}: {killed.calls[-1]}"
        assert killed.code == -9, f"{where}\n{killed.said}"
        _go_on(commands, case, arguments, place, where)
        assert _names(place) == _names(whole), where
        assert _content(place, case) == expected, where
        shutil.rmtree(place)
    assert _content(inputs, case) == before


def _prepare(commands: Commands, case: Case, inputs: Path, place: Path) -> None:
    for name in FOREIGN:
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text("precious")
    if case.first:
        first = commands.run(place, case.first.replace("INPUTS", str(inputs)))
        assert first.code == 0, first.said


def _go_on(commands: Commands, case: Case, arguments: str, place: Path, where: str) -> None:
    """The same command again, as a person would give it."""
    done = commands.run(place, arguments)
    if done.code:
        assert (done.code, done.said.count("mereo: error: ")) == (2, 1), f"{where}\n{done.said}"
        assert case.again and case.again in done.said, f"{where}\n{done.said}"
        if not case.again.startswith("--"):
            return
        done = commands.run(place, f"{arguments} {case.again}")
    assert done.code == 0, f"{where}\n{done.said}"


def _names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def _content(folder: Path, case: Case) -> dict[str, bytes]:
    """Bytes of all files, without durations; the list of times says no more."""
    return {
        name: TIMES.sub(b"", path.read_bytes()) if path.name in case.timed else path.read_bytes()
        for name, path in _files(folder)
        if path.name != ".mereo.json"
    }


def _files(folder: Path) -> Iterable[tuple[str, Path]]:
    return ((path.relative_to(folder).as_posix(), path) for path in sorted(folder.rglob("*")) if path.is_file())
