"""How many cores there are, and how many threads a command takes of them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from mereo.io import cores
from mereo.io.cores import THREAD_VARIABLES, limit_blas_threads, use_threads


@pytest.mark.parametrize(
    ("files", "count"),
    [(["250000 100000"], 3), (["max 100000"], 8), (["50000", "100000"], 1), (["-1", "100000"], 8), ([], 8)],
)
def test_a_quota_bounds_the_cores(
    files: list[str], count: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    paths = [tmp_path / str(number) for number in range(max(1, len(files)))]
    for path, text in zip(paths, files, strict=False):
        path.write_text(text)
    monkeypatch.setattr(cores, "QUOTAS", (tuple(map(str, paths)),))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert cores.cores() == count


def test_threads_are_as_many_as_cores_unless_the_user_has_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "cores", lambda: 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    for own, count, then in (("2", 0, "2"), (None, 0, "1"), (None, 2, "2"), ("1", 2, "2")):
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
        if own is not None:
            monkeypatch.setenv("OMP_NUM_THREADS", own)
        with threadpool_limits(2):
            use_threads(count)
        assert os.environ["OMP_NUM_THREADS"] == then


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


def test_one_blas_thread_lasts_until_the_last_thread_lets_go() -> None:
    def counts() -> set[int]:
        return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

    with threadpool_limits(2, "blas"):
        before = counts()
        first, second = limit_blas_threads(), limit_blas_threads()
        first.__enter__()
        second.__enter__()
        assert counts() == {1}
        first.__exit__(None, None, None)  # in the order in which threads may end, not the one of nested blocks
        assert counts() == {1}
        second.__exit__(None, None, None)
        assert counts() == before
