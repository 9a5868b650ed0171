"""How many cores there are and are free, and how many threads a command takes of them."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from mereo import __main__ as command_line
from mereo.cli import training
from mereo.io import cores
from mereo.io.cores import THREAD_VARIABLES, FreeCores, one_blas_thread, threads_for, use_free_cores, workers_for


@pytest.mark.parametrize(
    ("free", "there", "threads"),
    [(2.0, 2, 2), (1.6, 2, 2), (1.4, 2, 1), (-3.0, 2, 1), (12.2, 16, 12), (3.0, 16, 8), (9.0, 4, 4), (0.0, 1, 1)],
)
def test_threads_are_as_many_as_cores_are_free_and_half_of_them_at_least(free: float, there: int, threads: int) -> None:
    assert threads_for(free, there) == threads


def test_free_cores_are_idle_ones_and_those_that_this_process_uses(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of the cores that it may use: the third one here is another's."""
    counts = "cpu  0 0 0 9 9\n" + "".join(
        f"cpu{core} 70 80 90 {idle} 5 0\n" for core, idle in enumerate((700, 440, 99))
    )
    monkeypatch.setattr(cores, "STATISTICS", tmp_path / "stat")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    monkeypatch.setattr(os, "sysconf", lambda _: 100, raising=False)
    (tmp_path / "stat").write_text(counts)
    assert FreeCores().idle_s == 11.5
    monkeypatch.setattr(cores, "time", SimpleNamespace(monotonic=lambda: 9.0, process_time=lambda: 3.5))
    monkeypatch.setattr(cores.time, "sleep", lambda _: None, raising=False)
    before = FreeCores(7.0, 3.0, 10.0)
    assert before.now() == 1.0
    monkeypatch.setattr(cores, "STATISTICS", tmp_path / "none")
    monkeypatch.setattr(os, "getloadavg", lambda: (1.5, 0.0, 0.0), raising=False)
    assert FreeCores().now() == cores.cores() - 1.5


@pytest.mark.parametrize(
    ("files", "count"),
    [(["250000 100000"], 3), (["max 100000"], 8), (["50000", "100000"], 1), (["-1", "100000"], 8), ([], 8)],
)
def test_a_containers_quota_bounds_its_cores(
    files: list[str], count: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    paths = [tmp_path / str(number) for number in range(max(1, len(files)))]
    for path, text in zip(paths, files, strict=False):
        path.write_text(text)
    monkeypatch.setattr(cores, "QUOTAS", (tuple(map(str, paths)),))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert cores.cores() == count


@pytest.mark.parametrize(
    ("own", "free", "taken", "told"),
    [(None, 0.9, 1, [1]), (None, 2.0, 2, []), ("2", 0.1, 2, []), ("", 0.1, 1, [1])],
)
def test_what_is_free_is_taken_unless_the_user_has_said(
    own: str | None, free: float, taken: int, told: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[int] = []
    monkeypatch.setattr(cores, "use_threads", said.append)
    monkeypatch.setattr(cores, "cores", lambda: 2)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(FreeCores, "now", lambda _: free)
    monkeypatch.delenv("OMP_NUM_THREADS") if own is None else monkeypatch.setenv("OMP_NUM_THREADS", own)
    assert use_free_cores(FreeCores()) == taken and said == told


def test_a_moment_of_other_work_takes_no_core_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """What starts beside a command, a shell's own listing for one, is over before the command has loaded anything."""
    counted = iter([1.2, 1.9])
    monkeypatch.setattr(cores, "use_threads", lambda count: pytest.fail(f"{count} threads"))
    monkeypatch.setattr(cores, "cores", lambda: 2)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(FreeCores, "now", lambda _: next(counted))
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert use_free_cores(FreeCores()) == 2


def test_commands_that_answer_take_free_cores_and_those_that_train_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[object] = []
    monkeypatch.setattr(command_line, "use_free_cores", chosen.append)
    monkeypatch.setattr(command_line, "use_threads", chosen.append)
    for command in (training.Evaluate, training.Train):
        monkeypatch.setattr(command, "run", lambda self: None)
    assert command_line.main(["train", "data", "--output", "out"]) == 0 and chosen == []
    assert command_line.main(["evaluate", "rope", "--output", "out"]) == 0
    assert command_line.main(["evaluate", "rope", "--output", "out", "--threads", "3"]) == 0
    assert isinstance(chosen[0], FreeCores) and chosen[1:] == [3]


THREADS = """
import os, sys
from mereo import __main__ as command_line
from mereo.cli.training import Train

def show(self):
    import torch, threadpoolctl
    import numpy
    print(torch.get_num_threads(), *{pool["num_threads"] for pool in threadpoolctl.threadpool_info()})
    print(*(os.environ[name] for name in sys.argv[1:]))

Train.run = show
assert command_line.main("train data --output out --threads 1".split()) == 0
assert command_line.main("train data --output out --threads 2".split()) == 0
"""


def test_threads_hold_for_torch_blas_and_what_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before torch is loaded and after it."""
    for name in THREAD_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    command = [sys.executable, "-c", THREADS, *THREAD_VARIABLES]
    told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout.split("\n")
    assert told[:4] == ["1 1", "1 1 1 1", "2 2", "2 2 2 2"]


def test_workers_are_as_many_as_threads_unless_said() -> None:
    assert (workers_for(3, 2), workers_for(0, 2)) == (3, 2) and workers_for(0, 0) >= 1


def test_one_blas_thread_lasts_until_the_last_thread_lets_go() -> None:
    def counts() -> set[int]:
        return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

    with threadpool_limits(2, "blas"):
        before = counts()
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        assert counts() == {1}
        first.__exit__(None, None, None)  # in the order in which threads may end, not the one of nested blocks
        assert counts() == {1}
        second.__exit__(None, None, None)
        assert counts() == before
