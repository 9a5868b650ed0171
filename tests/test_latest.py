"""A slider that is dragged: the newest request is served, the others are dropped, and errors do not stop it."""

import threading

from browser import until

from mereo.visualization.viewer.latest_request import LatestWins


def test_only_the_newest_waiting_request_is_served_and_refined() -> None:
    started, go_on = threading.Event(), threading.Event()
    quick: list[int] = []
    fine: list[int] = []

    def work(request: int) -> None:
        quick.append(request)
        started.set()
        assert go_on.wait(10)

    worker = LatestWins(work, fine.append, lambda error: None, settle_s=0.05)
    worker.submit(0)
    assert started.wait(10)
    for request in range(1, 50):
        worker.submit(request)
    go_on.set()
    until(lambda: fine, 10)
    worker.stop()
    assert quick == [0, 49]
    assert fine == [49]


def test_no_fine_work_while_requests_keep_coming() -> None:
    quick: list[int] = []
    fine: list[int] = []
    worker = LatestWins(quick.append, fine.append, lambda error: None, settle_s=30.0)
    for request in range(5):
        worker.submit(request)
        until(lambda request=request: request in quick, 10)
    worker.stop()
    assert quick == [0, 1, 2, 3, 4]
    assert fine == []


def test_errors_are_reported_and_the_thread_lives_on() -> None:
    failures: list[Exception] = []
    fine: list[int] = []

    def work(request: int) -> None:
        if request == 1:
            raise KeyError("nothing is found")

    worker = LatestWins(work, fine.append, failures.append, settle_s=0.01)
    worker.submit(1)
    until(lambda: failures, 10)
    worker.submit(2)
    until(lambda: fine, 10)
    worker.stop()
    assert [type(error) for error in failures] == [KeyError]
    assert fine == [2]


def test_an_object_that_is_none_is_a_request_too() -> None:
    served: list[None] = []
    worker = LatestWins(served.append, lambda request: None, lambda error: None)
    worker.submit(None)
    until(lambda: served, 10)
    worker.stop()
