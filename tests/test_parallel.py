"""Work shared between processes ends as it should: with results, with the first error, or with nobody left behind."""

import os
from collections.abc import Callable

import pytest

from mereo.workers.processes import THREAD_VARIABLES, in_processes

Cancelled = Callable[[], bool]


def square(number: int, cancelled: Cancelled) -> int:
    return number * number


def report(number: int, cancelled: Cancelled) -> tuple[int, list[str | None]]:
    return os.getpid(), [os.environ.get(name) for name in THREAD_VARIABLES]


def fail_on_three(number: int, cancelled: Cancelled) -> int:
    if number == 3:
        raise ValueError("three is bad: pass another number")
    return number


def die_on_three(number: int, cancelled: Cancelled) -> int:
    if number == 3:
        os._exit(9)
    return number


def wait_until_cancelled(number: int, cancelled: Cancelled) -> int:
    while number > 0 and not cancelled():
        pass
    return number


def test_one_worker_works_here_and_in_order() -> None:
    assert list(in_processes(square, [3, 1, 2], 1)) == [(3, 9), (1, 1), (2, 4)]
    assert next(in_processes(report, [0], 8))[1][0] == os.getpid()
    assert list(in_processes(square, [], 4)) == []


def test_an_error_arrives_as_it_was_raised() -> None:
    with pytest.raises(ValueError, match="three is bad"):
        list(in_processes(fail_on_three, range(5), 1))


def test_work_that_cannot_be_sent_is_refused_with_the_cure() -> None:
    with pytest.raises(ValueError, match="cannot be sent to worker processes .*top level of a module: move them there"):
        list(in_processes(lambda number, cancelled: number, [1, 2], 2))


@pytest.mark.slow
def test_every_item_once_in_other_processes_of_one_thread() -> None:
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    assert dict(in_processes(square, range(20), 2)) == {n: n * n for n in range(20)}
    workers, variables = zip(*dict(in_processes(report, range(20), 2)).values(), strict=True)
    assert os.getpid() not in workers and len(set(workers)) <= 2
    assert all(value == ["1"] * len(THREAD_VARIABLES) for value in variables)
    assert before == {name: os.environ.get(name) for name in THREAD_VARIABLES}


@pytest.mark.slow
def test_an_error_in_a_worker_ends_the_work() -> None:
    with pytest.raises(ValueError, match="three is bad"):
        list(in_processes(fail_on_three, range(50), 2))


@pytest.mark.slow
def test_a_killed_worker_is_one_sentence_and_no_hang() -> None:
    with pytest.raises(ChildProcessError, match="a worker process was killed, most often for memory.*--resume"):
        list(in_processes(die_on_three, range(50), 2))


@pytest.mark.slow
def test_closing_cancels_work_in_progress() -> None:
    results = in_processes(wait_until_cancelled, range(50), 2)
    assert next(results) == (0, 0)
    results.close()  # returns, though one worker would never have
