"""``mereo`` and ``python -m mereo``: run one command, and answer what a user can cause with one line."""

import io
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout, suppress
from dataclasses import MISSING, fields
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, TypeVar, Union

import tyro
from tyro.conf import subcommand

from mereo import __version__
from mereo.api.words import option_words
from mereo.cli import answers, scenes, tools, training, weights
from mereo.cli.demo import Demo
from mereo.cli.options import Outcome, read_options, with_options
from mereo.geometry.conventions import Facts
from mereo.io.bounds import check_bounds
from mereo.io.cores import use_threads
from mereo.io.errors import is_foreseen, printable_line, words_of
from mereo.synthesis.config import SENSORS, GenerateConfig
from mereo_learning.config import PRESETS

Choice = TypeVar("Choice")

TRACEBACK_VARIABLE = "MEREO_TRACEBACK"
"""Environment variable that shows where an error comes from."""

COMMANDS: dict[str, Any] = {
    "demo": Demo,
    "doctor": tools.Doctor,
    "learn": training.LearnCommand,
    "scene": (
        "List, write, check, draw, record or export scenes.",
        {
            "list": scenes.SceneList,
            "new": scenes.SceneNew,
            "check": scenes.SceneCheck,
            "preview": scenes.ScenePreview,
            "modes": scenes.SceneModes,
            "export": scenes.SceneExport,
            "record": scenes.SceneRecord,
        },
    ),
    "assets": (
        "List or fetch downloadable meshes and scans.",
        {"list": scenes.AssetsList, "get": scenes.AssetsGet},
    ),
    "weights": (
        "List or show weights.",
        {"list": weights.WeightsList, "show": weights.WeightsShow},
    ),
    "generate": training.Generate,
    "dataset": (
        "Check or describe generated examples.",
        {"check": training.DatasetCheck, "show": training.DatasetShow},
    ),
    "train": training.Train,
    "evaluate": training.Evaluate,
    "calibrate": weights.CalibrateCommand,
    "reconstruct": answers.ReconstructCommand,
    "align": tools.Align,
    "view": answers.ViewCommand,
    "stream": answers.StreamCommand,
    "serve": answers.ServeCommand,
    "export": training.Export,
    "experiment": tools.Experiment,
    "bench": tools.BenchCommand,
    "release": weights.Release,
}
"""Class of each command, whose fields are the options; a group of commands has a description and its own.

``run`` does the work, and prints what a person wants to know of it. It imports what it needs itself, so that ``mereo
--help`` answers without loading torch.
"""

WORK = {answers.ReconstructCommand: "mereo.cli.reconstruct", answers.StreamCommand: "mereo.cli.stream"}
"""Module whose function ``run`` does the work of a command that is options alone, as the module knows its class."""

CONFIGURABLE = ("generate", "train", "evaluate", "reconstruct", "learn")
"""Commands with the option --config."""

NO_MEMORY = ("out of memory", "can't allocate memory", "bad_alloc")
"""What torch and compiled libraries say where Python has a ``MemoryError``."""

STOPPING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals by which systems, job schedulers (TERM) and closed terminals (HUP) end a program; Windows has no HUP."""

USER_ERROR, FAULT, INTERRUPTED, BROKEN_PIPE = 2, 70, 130, 141
"""Exit codes; 70 is EX_SOFTWARE of sysexits.h, the last two are 128 plus the signal's number, as shells report them."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, and return the exit code. With MEREO_TRACEBACK=1 errors are raised as they are."""
    arguments = sys.argv[1:] if arguments is None else arguments
    warnings.formatwarning = _warning_line
    for stream in ("stdout", "stderr"):  # Python has none where whoever started it has closed it
        if getattr(sys, stream) is None:
            setattr(sys, stream, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (to the end)
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal that lacks a character gets another one, and no error
        sys.stdout.reconfigure(errors="replace")
    try:
        with option_words(), stop_signals():
            if arguments in (["--version"], ["-V"]):
                print(f"mereo {__version__}")
                status = 0
            else:
                command = parse(arguments)
                use_threads(getattr(command, "threads", 0))
                status = _run(command)
            sys.stdout.flush()
    except Stopped as stopped:
        return _stop(f"mereo: stopped by {stopped.signal.name}", 128 + stopped.signal)
    except KeyboardInterrupt:
        return _stop("mereo: interrupted", INTERRUPTED)
    except BrokenPipeError:  # the reader (head, less) has gone
        _drop_output()
        return BROKEN_PIPE
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):  # which rich has caught in a table
            return BROKEN_PIPE
        raise
    except Exception as error:
        if os.environ.get(TRACEBACK_VARIABLE) == "1":
            raise
        if is_foreseen(error):
            return _stop(f"mereo: error: {words_of(error)}", USER_ERROR)
        return _stop(f"mereo: error: {fault_sentence(error, arguments)}", FAULT)
    return status


def _run(command: Any) -> int:
    """Run a command, and return its exit status; with ``--json`` standard output gets one object and nothing else."""
    as_json = getattr(command, "json", False)
    with redirect_stdout(sys.stderr) if as_json else nullcontext():
        work = WORK.get(type(command))
        outcome: Outcome | None = command.run() if work is None else import_module(work).run(command)
    if outcome is None:
        return 0
    if as_json:
        from mereo.io.atomic_files import json_text

        print(json_text(outcome.facts), end="")
    return outcome.status


def _warning_line(message: Warning | str, *_: Any, **__: Any) -> str:
    return f"mereo: warning: {printable_line(str(message))}\n"


def _stop(message: str, code: int) -> int:
    try:
        sys.stdout.flush()
    except OSError:
        _drop_output()
    with suppress(OSError):  # a terminal that was closed (HUP) takes no words
        print(message, file=sys.stderr)
    return code


def _drop_output() -> None:
    """Let what is left of standard output go nowhere: else flushing it at exit would complain once more."""
    with suppress(OSError):  # of a stream that is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


# --- how a command ends before its end --------------------------------------------------------------------------------


class Stopped(KeyboardInterrupt):
    """End by a signal other than Ctrl-C's, which everything that knows Ctrl-C takes as that.

    Attributes:
        signal: which one.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.signal = signal.Signals(number)


LOOK_S = 0.02
"""Seconds after which it is looked again whether a signal can be obeyed."""

WHOLE = "<frozen importlib", str(Path(multiprocessing.__file__).with_name("popen_"))
"""Beginnings of the files of Python whose work is not broken off: some modules catch whatever is raised while they are
imported, so that it would be lost, and a process that has got half of its work prints a traceback."""


@contextmanager
def stop_signals() -> Iterator[None]:
    """Raise ``Stopped`` in the block where a signal asks for the end, and ``KeyboardInterrupt`` where Ctrl-C does.

    They wait for what is not broken off (``WHOLE``). After the first signal cleaning goes on whatever HUP says, but a
    second TERM ends the process at once.

    A signal that is ignored stays so (``nohup``). Outside the main thread, where Python sets no handlers, nothing
    changes; nor do processes that are started meanwhile inherit anything.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    alarm = tuple(getattr(signal, name) for name in ("SIGALRM",) if hasattr(signal, name))  # Windows has none
    before = {number: signal.getsignal(number) for number in (*STOPPING, signal.SIGINT, *alarm)}
    ignored = signal.SIG_IGN, None
    taken = [number for number in STOPPING if before[number] not in ignored]
    waiting = list[KeyboardInterrupt]()

    def stop(number: int, frame: FrameType | None) -> None:
        for each in taken:
            signal.signal(each, _end_at_once if each == signal.SIGTERM else signal.SIG_IGN)
        waiting.append(Stopped(number))
        end(number, frame)

    def interrupt(number: int, frame: FrameType | None) -> None:
        waiting.append(KeyboardInterrupt())
        end(number, frame)

    def end(_: int, frame: FrameType | None) -> None:
        if alarm and _is_whole(frame):
            signal.signal(alarm[0], end)
            signal.setitimer(signal.ITIMER_REAL, LOOK_S)
        elif waiting:
            raise waiting.pop(0)

    for number in taken:
        signal.signal(number, stop)
    if before[signal.SIGINT] is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
    try:
        yield
        end(0, None)
    finally:
        if alarm and signal.getsignal(alarm[0]) is end:
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            if handler is not None:  # that of a library, which Python cannot set
                signal.signal(number, handler)


def _is_whole(frame: FrameType | None) -> bool:
    """Whether a command is within what is not broken off."""
    while frame is not None and frame.f_code is not main.__code__:
        if frame.f_code.co_filename.startswith(WHOLE):
            return True
        frame = frame.f_back
    return False


def _end_at_once(number: int, _: FrameType | None) -> None:
    os._exit(128 + number)


def fault_sentence(error: Exception, arguments: list[str]) -> str:
    """Line about what no part of mereo has foreseen: the command, its files, the error, and what to do."""
    what = words_of(error)
    where = f"{_command(arguments)}: {what}"
    if isinstance(error, MemoryError) or any(words in what.lower() for words in NO_MEMORY):
        return f"{where}; the memory does not suffice: ask for less (resolution, points, batch, workers) or free some"
    if isinstance(error, RecursionError):
        return f"{where}; something is nested too deeply, or in itself: look into the files that are named"
    whose = "mereo, or of the Python file" if any(word.endswith(".py") for word in arguments) else "mereo"
    return (
        f"{where}; this is a fault of {whose}: run it again with {TRACEBACK_VARIABLE}=1, and report the text that it "
        "prints"
    )


def _command(arguments: list[str]) -> str:
    """Names of the command and of the existing files among its arguments: ``mereo align on scan.ply``."""
    words = next((n for n, word in enumerate(arguments) if not word.isalpha()), len(arguments))
    named = arguments[:1] if words < 2 or not isinstance(COMMANDS.get(arguments[0]), tuple) else arguments[:2]
    values = [word.partition("=")[2] if word.startswith("--") else word for word in arguments[len(named) :]]
    files = []
    for value in filter(None, values):
        with suppress(OSError, ValueError):  # a name that is too long, or has a zero in it
            files += [value] if Path(value).exists() else []
    return " ".join(["mereo", *named, *(["on", ", ".join(files)] if files else [])])


# --- from arguments to a command --------------------------------------------------------------------------------------


def parse(arguments: list[str]) -> Any:
    """Command that these arguments mean; exits with 0 after a help that they ask for, with 2 where they mean none.

    Raises ``ValueError`` for settings that are refused, such as a number out of its bounds.
    """
    path = _option(arguments, "--config")
    options = dict[str, Any]()
    if path is not None and arguments[0] in CONFIGURABLE:
        options = read_options(Path(path), arguments[0])
    recipe = _chosen(PRESETS, "base", _option(arguments, "--preset"), options.get("preset"))
    sensor = _chosen(SENSORS, "paper", _option(arguments, "--sensor"), options.get("sensor"))
    starts = {
        "generate": _start(training.Generate, settings=GenerateConfig(sensor=sensor)),
        "train": _start(training.Train, config=recipe),
        "evaluate": _start(training.Evaluate, terms=sensor),
        "reconstruct": _start(answers.ReconstructCommand),
        "learn": _start(training.LearnCommand),
    }
    if options:
        starts[arguments[0]] = with_options(starts[arguments[0]], options, Path(path or ""))
    box = io.StringIO()
    try:
        with redirect_stderr(box):
            command = tyro.cli(
                _syntax(COMMANDS, starts),
                args=arguments or ["--help"],
                prog="mereo",
                description="Reconstruct deformable objects with all their segments from one depth image or point "
                "cloud. `mereo COMMAND --help` explains a command, `mereo --version` prints the version.",
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as end:
        error = end.__context__
        while error is not None and not (isinstance(error, ValueError) and is_foreseen(error)):
            error = error.__context__
        if error is not None:  # of settings, which is enough by itself
            raise error from None
        print(box.getvalue(), end="", file=sys.stderr)
        raise
    check_bounds(command, "--")
    return command


def _syntax(members: Facts, starts: Facts) -> Any:
    """Commands, or those of a group, as a type that tyro reads; some start from other defaults than their class's."""
    kinds = list[Any]()
    for name, member in members.items():
        if isinstance(member, tuple):
            description, group = member
            kinds.append(Annotated[_syntax(group, {}), subcommand(name, description=description)])
        else:
            default = {"default": starts[name]} if name in starts else {}
            kinds.append(Annotated[member, subcommand(name, **default)])
    return Union[*kinds]


def _start(command: type, **settings: Any) -> Any:
    """Command with these settings, its other defaults, and nothing where there are none."""
    required = [item.name for item in fields(command) if item.default is item.default_factory is MISSING]
    return command(**dict.fromkeys(required, tyro.MISSING), **settings)


def _chosen(choices: Mapping[Any, Choice], otherwise: str, *names: Any) -> Choice:
    """First of these choices that there is, which must be known before parsing: other defaults depend on it."""
    return choices[next((name for name in names if isinstance(name, str) and name in choices), otherwise)]


def _option(arguments: list[str], option: str) -> str | None:
    """Last value that an option is given; None without one."""
    values = [word.partition("=")[2] for word in arguments if word.startswith(f"{option}=")]
    values += [after for before, after in pairwise(arguments) if before == option]
    return values[-1] if values else None


if __name__ == "__main__":
    sys.exit(main())
