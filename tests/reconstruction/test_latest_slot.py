"""Room for one item between two threads: what is newest is taken, and both sides can leave."""

import threading
from types import SimpleNamespace

import pytest

from mereo.reconstruction import stream
from mereo.reconstruction.stream import LatestSlot


def test_the_newest_item_is_taken_once_and_counts_those_it_replaced() -> None:
    slot = LatestSlot[int]()
    for item in (1, 2, 3):
        assert slot.put(item)
    taken = slot.take()
    assert taken is not None and (taken.item, taken.replaced) == (3, 2)
    assert slot.take(timeout_s=0.01) is None
    slot.put(4)
    taken = slot.take()
    assert taken is not None and (taken.item, taken.replaced) == (4, 0)


def test_a_patient_item_waits_its_turn_and_arrives_then(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1.0]
    monkeypatch.setattr(stream, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    slot = LatestSlot[str]()
    slot.put("first")
    thread = threading.Thread(target=lambda: slot.put("second", wait=True))
    thread.start()
    thread.join(0.05)
    assert thread.is_alive(), "it waits"
    now[0] = 2.0
    first, second = slot.take(), slot.take(10)
    thread.join(10)
    assert first is not None and second is not None
    assert (first.item, second.item, second.replaced) == ("first", "second", 0)
    assert (first.arrived_s, second.arrived_s) == (1.0, 2.0)


def test_what_waits_is_still_taken_after_the_end() -> None:
    slot = LatestSlot[None]()
    slot.put(None)
    slot.end()
    assert slot.take() is not None
    assert slot.take() is None


def test_a_stop_drops_what_waits_and_frees_both_sides() -> None:
    slot, found = LatestSlot[int](), []
    slot.put(1)
    threads = [threading.Thread(target=lambda: found.append(slot.put(2, wait=True)))]
    empty = LatestSlot[int]()
    threads.append(threading.Thread(target=lambda: found.append(empty.take())))
    for thread in threads:
        thread.start()
    slot.stop()
    empty.stop()
    for thread in threads:
        thread.join(10)
        assert not thread.is_alive()
    assert len(found) == 2 and not any(found)
    assert slot.take() is None and slot.stopped and not slot.put(3)
