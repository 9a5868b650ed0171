"""Commands that are killed at a write boundary: just before or just after the n-th call that moves, makes or removes.

Each runs in a process that is forked from a server of the standard library, which has imported this module and so all
that takes long. Nothing in mereo knows of it: in that process the functions of ``os`` are wrapped, and an audit hook of
Python's own counts the same calls, so that none goes past them.
"""

import os
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib.pyplot  # noqa: F401 (loaded before the forks, as all that takes long)
import pytest
import scipy.interpolate  # noqa: F401
import torch
from toy_data import make_small_datasets

import mereo.__main__ as command_line
from mereo.io import atomic_files  # noqa: F401
from mereo.models.export import onnx_export  # noqa: F401
from mereo_learning import trainer

MOVES = {"replace": "os.rename", "rename": "os.rename", "link": "os.link"}
"""Functions that give a file its name, and the events of Python's audit hooks that they raise."""

CALLS = {**MOVES, "mkdir": "os.mkdir", "unlink": "os.remove", "remove": "os.remove", "rmdir": "os.rmdir"}
"""All functions that change what is in a folder, but for opening a new file."""

SERVER = get_context("forkserver")
SERVER.set_forkserver_preload(["failpoints"])


@dataclass(frozen=True)
class Ended:
    """End of a command: its exit code (minus the signal), what it said, and the calls that it made, by function."""

    code: int
    said: str
    calls: list[str]


class Failpoints:
    """Wrapped functions that kill this process at call number ``at``; -1 never."""

    def __init__(self, functions: dict[str, str], at: int, after: bool, report: int) -> None:
        self.at, self.after, self.report, self.count, self.seen = at, after, report, 0, 0
        self.main, self.events = os.getpid(), set(functions.values())
        for name in functions:
            setattr(os, name, self._wrapped(name, getattr(os, name)))
        sys.addaudithook(self._audit)

    def _audit(self, event: str, arguments: Any) -> None:
        if os.getpid() == self.main and event in self.events:
            self.seen += 1

    def _wrapped(self, name: str, plain: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            if os.getpid() != self.main:
                return plain(*arguments, **options)
            number, self.count = self.count, self.count + 1
            place = os.fspath(arguments[-1] if name in MOVES else arguments[0])
            os.write(self.report, f"{name} {place}\n".encode())
            if number == self.at and not self.after:
                os.kill(self.main, signal.SIGKILL)
            try:
                return plain(*arguments, **options)
            finally:
                if number == self.at:
                    os.kill(self.main, signal.SIGKILL)

        return wrapped


def run_command(folder: Path, arguments: str, *, at: int = -1, after: bool = False, every_call: bool = False) -> Ended:
    """Run a command in ``folder``, killed before (or after) call ``at`` of the moves, or of all calls."""
    with TemporaryDirectory() as place:
        said, calls = (Path(place, name) for name in ("said", "calls"))
        said.touch(), calls.touch()
        points = CALLS if every_call else MOVES, at, after
        process = SERVER.Process(target=_run, args=(folder, arguments.split(), points, said, calls))
        with pytest.MonkeyPatch.context() as patch:  # Python 3.11's server does not take over the path of modules
            patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
            process.start()
        process.join()
        assert process.exitcode is not None
        return Ended(process.exitcode, said.read_text(errors="replace"), calls.read_text(errors="replace").splitlines())


def _run(folder: Path, arguments: list[str], points: tuple[dict[str, str], int, bool], said: Path, calls: Path) -> None:
    code = 98
    try:
        sys.stdout = sys.stderr = said.open("w", buffering=1, encoding="utf-8")
        os.chdir(folder)
        torch.set_num_threads(1)
        make_small_datasets(pytest.MonkeyPatch())  # which nothing undoes
        assert trainer.train.__kwdefaults__ is not None
        trainer.train.__kwdefaults__["checkpoint_every_s"] = 0.0
        passed = Failpoints(*points, os.open(calls, os.O_WRONLY | os.O_APPEND))
        code = command_line.main(arguments)
        if passed.count != passed.seen:
            raise AssertionError(f"{passed.seen} calls were made, but {passed.count} passed a failpoint")
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)
