"""Commands that are killed at a write boundary: just before the n-th event that makes, moves or removes a file.

Each runs in a process that is forked from a server of the standard library, which has imported this module and so all
that takes long. Nothing in mereo knows of it: in that process an audit hook of Python's own counts the events.
"""

import os
import signal
import sys
import traceback
from dataclasses import dataclass
from itertools import count
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

MOVES = ("os.rename", "os.link")
"""Events of Python's audit hooks by which a file gets its name."""

CHANGES = (*MOVES, "os.mkdir", "os.remove", "os.rmdir", "open")
"""All events that change what is in a folder, ``open`` where it may make a file."""

SERVER = get_context("forkserver")
SERVER.set_forkserver_preload(["failpoints"])


@dataclass(frozen=True)
class Ended:
    """End of a command: its exit code (minus the signal), what it said, and the changes that it made, with places."""

    code: int
    said: str
    changes: list[str]


def run_command(folder: Path, arguments: str, at: int = -1) -> Ended:
    """Run a command in ``folder``, killed before change ``at``; -1 never."""
    with TemporaryDirectory() as place:
        said, changes = (Path(place, name) for name in ("said", "changes"))
        said.touch(), changes.touch()
        process = SERVER.Process(target=_run, args=(folder, arguments.split(), at, said, changes))
        with pytest.MonkeyPatch.context() as patch:  # Python 3.11's server does not take over the path of modules
            patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
            process.start()
        process.join()
        assert process.exitcode is not None
        texts = (path.read_text(errors="replace") for path in (said, changes))
        return Ended(process.exitcode, next(texts), next(texts).splitlines())


def _run(folder: Path, arguments: list[str], at: int, said: Path, changes: Path) -> None:
    code = 98
    main = os.getpid()
    numbers = count()

    def note(event: str, given: Any) -> None:
        if event not in CHANGES or os.getpid() != main or (event == "open" and not given[2] & os.O_CREAT):
            return
        os.write(report, f"{event} {given[1 if event in MOVES else 0]}\n".encode())
        if next(numbers) == at:
            os.kill(main, signal.SIGKILL)

    try:
        sys.stdout = sys.stderr = said.open("w", buffering=1, encoding="utf-8")
        os.chdir(folder)
        torch.set_num_threads(1)
        make_small_datasets(pytest.MonkeyPatch())  # which nothing undoes
        assert trainer.train.__kwdefaults__ is not None
        trainer.train.__kwdefaults__["checkpoint_every_s"] = 0.0
        report, sys.dont_write_bytecode = os.open(changes, os.O_WRONLY | os.O_APPEND), True
        sys.addaudithook(note)
        code = command_line.main(arguments)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)
