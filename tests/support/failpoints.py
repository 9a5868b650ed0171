"""Commands that are killed at a write boundary: just before or just after the n-th call that moves, makes or removes.

Run as a script it is a server, so that mereo is imported once: for each line of JSON on standard input it forks a
process that runs one command line, and answers with one line. Nothing in mereo knows of it: in that process the
functions of ``os`` are wrapped, and an audit hook of Python's own counts the same calls, so that none goes past them.
"""

import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MOVES = {"replace": "os.rename", "rename": "os.rename", "link": "os.link"}
"""Functions that give a file its name, and the events of Python's audit hooks that they raise."""

CALLS = {**MOVES, "mkdir": "os.mkdir", "unlink": "os.remove", "remove": "os.remove", "rmdir": "os.rmdir"}
"""All functions that change what is in a folder, but for opening a new file."""


NETWORKS = ("train", "reconstruct", "export")
"""Commands that load torch's compiler, whether they compile or not."""


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


def _serve() -> None:
    import matplotlib.pyplot  # noqa: F401 (loaded before the forks, as all that takes long)
    import pytest
    import scipy.interpolate  # noqa: F401
    import torch
    from toy_data import make_small_datasets

    import mereo.__main__ as command_line
    from mereo.io import atomic_files  # noqa: F401
    from mereo.models.export import onnx_export
    from mereo.models.weights import load_model
    from mereo_learning import trainer

    torch.set_num_threads(1)
    make_small_datasets(pytest.MonkeyPatch())  # which nothing undoes
    assert trainer.train.__kwdefaults__ is not None
    trainer.train.__kwdefaults__["checkpoint_every_s"] = 0.0
    traced = list[onnx_export.Graphs]()
    for line in sys.stdin:
        asked = json.loads(line)
        if asked["arguments"][0] in NETWORKS:
            import torch._dynamo  # 800 modules
        if asked["arguments"][0] == "export" and not traced:  # seconds of work that write nothing, of one network
            traced.append(onnx_export.export_graphs(load_model(asked["arguments"][1])))
            onnx_export.export_graphs = lambda _: traced[0]
        print(json.dumps(_forked(asked, command_line.main)), flush=True)


def _forked(asked: dict[str, Any], main: Callable[[list[str]], int]) -> dict[str, Any]:
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as report:
        child = os.fork()
        if child == 0:
            _run(asked, main, said.fileno(), report.fileno())
        _, status = os.waitpid(child, 0)
        said.seek(0)
        report.seek(0)
        text, calls = said.read().decode(errors="replace"), report.read().decode(errors="replace")
        return {"code": os.waitstatus_to_exitcode(status), "said": text, "calls": calls.splitlines()}


def _run(asked: dict[str, Any], main: Callable[[list[str]], int], said: int, report: int) -> None:
    """One command, in a process of its own, which never returns."""
    code = 99
    try:
        os.dup2(said, 1)
        os.dup2(said, 2)
        sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb", closefd=False), write_through=True)
        sys.stderr = io.TextIOWrapper(os.fdopen(2, "wb", closefd=False), write_through=True)
        os.chdir(asked["folder"])
        points = Failpoints(CALLS if asked["all"] else MOVES, asked["at"], asked["after"], report)
        code = main(asked["arguments"])
        if points.count != points.seen:
            raise AssertionError(f"{points.seen} calls were made, but {points.count} passed a failpoint")
    except BaseException:
        traceback.print_exc()
        code = 98
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


class Commands:
    """The server, from a test's side."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self.process = process

    def run(
        self, folder: Path, arguments: str, *, at: int = -1, after: bool = False, every_call: bool = False
    ) -> Ended:
        """Run a command in ``folder``, killed before (or after) call ``at`` of the moves, or of all calls."""
        asked = {"folder": str(folder), "arguments": arguments.split(), "at": at, "after": after, "all": every_call}
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(asked) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        assert line, "the server of commands has ended"
        return Ended(**json.loads(line))


@contextmanager
def command_server() -> Iterator[Commands]:
    """Server of commands for as long as it is used."""
    here = Path(__file__)
    paths = os.pathsep.join([str(here.parent), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, str(here)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths, "JAXTYPING_DISABLE": "1", "OMP_NUM_THREADS": "1"},
    ) as process:
        yield Commands(process)
        assert process.stdin is not None
        process.stdin.close()


if __name__ == "__main__":
    _serve()
