"""The server as it is run: processes, signals, and clients that ask all the time."""

import contextlib
import json
import os
import signal
import sys
import threading
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="fastapi (extra `serve`) is not installed")
pytest.importorskip("python_multipart", reason="python-multipart (extra `serve`) is not installed")

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import serving as bench

ADDRESS = "/v1/{weights}/reconstruct"


def get(port: int, path: str) -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=20) as answer:
        content: bytes = answer.read()
        return content


def within(seconds: float, condition: Callable[[], bool]) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end and not condition():
        time.sleep(0.05)
    return condition()


def is_there(pid: int) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, 0)
        return True
    return False


@pytest.mark.slow
def test_twenty_seconds_of_four_clients_and_the_end(tmp_path: Path) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    frames, _ = bench.one_after_the_other(bench.frames_of(["rope"], 6, tmp_path), "modes", 24, tmp_path)
    arguments = ("--weights", "rope", "--method", "modes", "--resolution", "24", "--workers", "2")
    with bench.served(*arguments, scratch=scratch) as (server, port):
        seen = bench.load(port, frames, 4, 20.0, ADDRESS, lambda _: None)
        assert set(seen.counts) == {"right"} and seen.counts["right"] >= 10
        workers = [pid for pid, mb in bench.resident_mb(server.pid).items() if pid != server.pid and mb > 150]
        assert len(workers) == 2
        os.kill(workers[0], signal.SIGKILL)
        before = bench.load(port, frames, 4, 3.0, ADDRESS, lambda _: None).counts
        assert before["right"] > 0 and before["wrong"] == before["lost"] == 0 and before["500"] <= 1
        assert within(30, lambda: b"mereo_restarts_total 1.0" in get(port, "/metrics"))
        assert json.loads(get(port, "/readyz")) == {"status": "ready"}
        workers = [pid for pid, mb in bench.resident_mb(server.pid).items() if pid != server.pid]

        tallies = [bench.Tally() for _ in range(4)]
        ended = threading.Event()
        threads = [
            threading.Thread(target=bench.client, args=(port, frames, n, lambda: not ended.is_set(), ADDRESS, tally))
            for n, tally in enumerate(tallies)
        ]
        for thread in threads:
            thread.start()
        time.sleep(2.0)
        server.send_signal(signal.SIGTERM)
        ended.set()
        assert server.wait(30) == 128 + signal.SIGTERM
        for thread in threads:
            thread.join(20)
        told = sum((tally.counts for tally in tallies), start=type(tallies[0].counts)())
        assert told["wrong"] == told["lost"] == told["500"] == 0, told
        assert set(told) <= {"right", "503"}, told
        assert within(10, lambda: not any(map(is_there, workers)))
    assert not list(scratch.glob(".mereo-serve*")), "what requests brought is removed"


@pytest.mark.slow
def test_processes_end_with_a_server_that_is_killed(tmp_path: Path) -> None:
    with bench.served("--weights", "rope", "--method", "network", "--workers", "1", scratch=tmp_path) as (server, _):
        workers = [pid for pid in bench.resident_mb(server.pid) if pid != server.pid]
        server.send_signal(signal.SIGKILL)
        server.wait(20)
        assert within(10, lambda: not any(map(is_there, workers)))
