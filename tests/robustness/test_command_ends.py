"""How a command ends: by TERM and HUP as by Ctrl-C, with nothing half-written; what nobody has foreseen is one line."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from safetensors.numpy import load_file

import mereo.__main__ as command_line
from mereo.__main__ import STOPPING, Stopped, stop_signals
from mereo.cli.answers import StreamCommand
from mereo.cli.stream import stream_reconstructions
from mereo.io.atomic_files import atomic_file


@pytest.fixture(autouse=True)
def hang_ups_count() -> Iterator[None]:
    """As in a terminal, also where the tests themselves were started to outlive one (nohup)."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def run(work: Callable[[], object], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Exit code of the command line when a command does this work, whatever its arguments."""
    monkeypatch.setattr(command_line, "parse", lambda _: SimpleNamespace(run=work))
    return command_line.main(list(arguments))


@pytest.mark.parametrize("number", [signal.SIGINT, *STOPPING])
def test_a_signal_leaves_nothing_half_written(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def write() -> None:
        with atomic_file(tmp_path / "results" / "table.md") as partial:
            partial.write_text("half of it")
            os.kill(os.getpid(), number)
            threading.Event().wait(20)

    assert run(write, monkeypatch) == 128 + number
    words = "interrupted" if number == signal.SIGINT else f"stopped by {number.name}"
    assert capsys.readouterr().err == f"mereo: {words}\n"
    assert not list(tmp_path.iterdir())
    assert signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)


@pytest.mark.parametrize("number", STOPPING)
def test_a_terminal_that_closes_meanwhile_cuts_no_cleaning_short(number: signal.Signals) -> None:
    cleaned = []
    with pytest.raises(Stopped), stop_signals():
        try:
            os.kill(os.getpid(), number)
            threading.Event().wait(20)
        finally:
            os.kill(os.getpid(), signal.SIGHUP)
            cleaned.append(number)
    assert cleaned == [number]


def test_a_second_term_ends_the_process_at_once() -> None:
    program = """
import os, signal, threading
from mereo.__main__ import stop_signals
with stop_signals():
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(20)
    finally:
        print("cleaning", flush=True)
        os.kill(os.getpid(), signal.SIGTERM)
        print("cleaned", flush=True)
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr) == (128 + signal.SIGTERM, "cleaning\n", "")


SWALLOWING = """
import os, time
try:
    os.kill(os.getpid(), {number})
    for _ in range({steps}):
        time.sleep(0.001)
except BaseException:  # as a library does that tries one import after the other
    raise SystemExit("the signal is lost")
"""


@pytest.mark.parametrize("number", [signal.SIGINT, *STOPPING])
@pytest.mark.parametrize("is_last", [False, True])
def test_no_signal_is_lost_in_an_import(
    number: signal.Signals, is_last: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some modules catch whatever is raised while they are imported; the command ends as soon as they are there."""
    monkeypatch.syspath_prepend(tmp_path)
    for attempt in range(12):
        name = f"swallowing_{number}_{is_last}_{attempt}"
        (tmp_path / f"{name}.py").write_text(SWALLOWING.format(number=int(number), steps=4 * attempt))
        end = KeyboardInterrupt if number == signal.SIGINT else Stopped
        with pytest.raises(end) as caught, stop_signals():
            __import__(name)
            if not is_last:
                threading.Event().wait(20)
        assert name in sys.modules and (number == signal.SIGINT or caught.value.signal == number)
        assert signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_what_is_ignored_stays_ignored() -> None:
    """As ``nohup`` asks for."""
    number = STOPPING[-1]
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with stop_signals():
            os.kill(os.getpid(), number)
            assert signal.getsignal(number) == signal.SIG_IGN
    finally:
        signal.signal(number, before)


def test_a_stream_sums_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "a.npy").touch()
    with monkeypatch.context() as patched:
        nothing = SimpleNamespace(network=None, registrar=lambda *_: None)
        patched.setattr("mereo.cli.stream.loaded_object", lambda *_: nothing)
        patched.setattr("mereo.cli.stream.Answering", lambda *_: SimpleNamespace(close=lambda: None))
        patched.setattr("mereo.cli.stream.stream", lambda *_, **__: iter(lambda: os.kill(os.getpid(), STOPPING[0]), 1))
        assert run(lambda: stream_reconstructions(StreamCommand(str(tmp_path), weights="rope")) and None, patched) == 0
    assert capsys.readouterr().err.startswith("stopped\n0 frames answered")


def test_a_closed_terminal_takes_no_words_and_raises_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(*_: object, **__: object) -> None:
        raise OSError(5, "Input/output error")

    def hang_up() -> None:
        os.kill(os.getpid(), STOPPING[-1])
        threading.Event().wait(20)

    monkeypatch.setattr("sys.stderr", SimpleNamespace(write=closed, flush=closed))
    assert run(hang_up, monkeypatch) == 128 + STOPPING[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "number, how", [(signal.SIGINT, "interrupted"), *((each, f"stopped by {each.name}") for each in STOPPING)]
)
def test_a_real_signal_leaves_complete_shards_only(tmp_path: Path, number: signal.Signals, how: str) -> None:
    """A real command, signalled as a terminal does it: to every process of the group."""
    output = tmp_path / "data"
    options = "--examples 20000 --workers 2 --image-size 32 --points 32 --per-segment 4 --output"
    command = [sys.executable, "-m", "mereo", "generate", "rope", *options.split(), str(output)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0)
    deadline = time.monotonic() + 300
    while not list(output.glob("shard-*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=120)
    *progress, last = errors.splitlines()
    assert (process.returncode, last) == (128 + number, f"mereo: {how}")
    assert all(line.startswith("model: ") for line in progress), errors  # the states of a slow machine
    names = {path.name for path in output.iterdir()}
    shards = names - {"manifest.json", "statistical_model.safetensors", "template.safetensors"}
    assert len(names) - len(shards) == 3 and shards, names
    assert all(len(load_file(output / name)["labels"]) == 64 for name in shards)


# --- what nobody has foreseen: one line that names the command and its files, and exit code 70 ------------------------


@pytest.mark.parametrize(
    ("error", "code", "end"),
    [
        (ValueError("the scale is -1;\n it must be positive"), 2, "the scale is -1; it must be positive"),
        (FileNotFoundError("there is no file 'a.ply'"), 2, "there is no file 'a.ply'"),
        (FileNotFoundError(2, "No such file", "a.ply"), 2, "a.ply: no such file: correct that"),
        (OSError(28, "No space left on device"), 2, "no space left on device: correct that"),
        (ImportError("pyvista is missing: pip install pyvista"), 2, "pyvista is missing: pip install pyvista"),
        (ValueError(), 2, "ValueError"),
        (TypeError("a\nbug"), 70, "a bug; this is a fault of mereo: run it again with MEREO_TRACEBACK=1, and "),
        (MemoryError(), 70, "; the memory does not suffice: ask for less"),
        (RuntimeError("CUDA out of memory. " + 99 * "Tried. "), 70, "...; the memory does not suffice: ask for less"),
        (RecursionError("too deep"), 70, ": too deep; something is nested too deeply, or in itself: look"),
    ],
)
def test_every_error_is_one_line_which_names_command_and_files_where_it_is_not_foreseen(
    error: Exception,
    code: int,
    end: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    tmp_path: Path,
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.delenv(command_line.TRACEBACK_VARIABLE, raising=False)
    assert run(fail, monkeypatch, "scene", "check", "cube", "--output", str(tmp_path), "\0") == code
    out, err = capsys.readouterr()
    start = end if code == 2 else f"mereo scene check on {tmp_path}: {type(error).__name__}"
    assert err.startswith(f"mereo: error: {start}") and end in err and err.count("\n") == 1 and out == ""
    monkeypatch.setenv(command_line.TRACEBACK_VARIABLE, "1")
    with pytest.raises(type(error)):
        command_line.main([])


def test_what_a_library_says_of_its_arguments_is_no_sentence_for_users(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """``json`` names neither the file nor a cure, and a ``ValueError`` of its own is a ``ValueError``."""
    monkeypatch.delenv(command_line.TRACEBACK_VARIABLE, raising=False)
    compiled = "ValueError: cannot reshape array of size 0 into shape (0)"  # it has no frame of its own
    assert run(lambda: np.empty(0).reshape(-1, 0), monkeypatch, "align", "my.py", __file__) == command_line.FAULT
    assert f"mereo align on {__file__}: {compiled}" in capsys.readouterr().err
    assert run(lambda: json.loads("{"), monkeypatch, "align", "my.py", __file__) == command_line.FAULT
    assert f"mereo align on {__file__}: JSONDecodeError: Expecting" in (line := capsys.readouterr().err)
    assert "this is a fault of mereo, or of the Python file: run it again with MEREO_TRACEBACK=1" in line
