"""Work shared between processes ends as it should: with results, with the first error, or with nobody left behind."""

import os

import pytest
from cluster_work import die, fail_on_three, report, square, wait_long

from mereo.io.cores import THREAD_VARIABLES
from mereo.workers.spread import spread


def test_one_worker_works_here_and_in_order() -> None:
    assert list(spread(square, [3, 1, 2])) == [(3, 9), (1, 1), (2, 4)]
    assert next(spread(report, [0], 8))[1][0] == os.getpid()
    assert list(spread(square, [], 4)) == []


def test_an_error_arrives_as_it_was_raised_or_is_replaced() -> None:
    with pytest.raises(ValueError, match="three is bad"):
        list(spread(fail_on_three, range(5)))
    assert dict(spread(fail_on_three, range(5), 1, lambda item, error: -item))[3] == -3


def test_work_that_cannot_be_sent_is_refused_with_the_cure() -> None:
    with pytest.raises(ValueError, match="cannot be sent to other processes .*top level of a module, .* use one"):
        list(spread(lambda number: number, [1, 2], 2))


@pytest.mark.slow
def test_every_item_once_in_other_processes_of_one_thread() -> None:
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    assert dict(spread(square, range(20), 2)) == {n: n * n for n in range(20)}
    workers, variables, _ = zip(*dict(spread(report, range(20), 2)).values(), strict=True)
    assert os.getpid() not in workers and len(set(workers)) <= 2
    assert all(value == ["1"] * len(THREAD_VARIABLES) for value in variables)
    assert before == {name: os.environ.get(name) for name in THREAD_VARIABLES}


@pytest.mark.slow
def test_an_error_in_a_worker_ends_the_work() -> None:
    with pytest.raises(ValueError, match="three is bad"):
        list(spread(fail_on_three, range(50), 2))


@pytest.mark.slow
def test_a_killed_worker_is_one_sentence_and_no_hang() -> None:
    with pytest.raises(ChildProcessError, match="a worker process was killed, most often for memory.*--resume"):
        list(spread(die, range(50), 2))


@pytest.mark.slow
def test_closing_ends_work_in_progress() -> None:
    results = spread(wait_long, range(50), 2)
    assert next(results) == (0, 0)
    results.close()  # returns, though one worker would not have for a minute
