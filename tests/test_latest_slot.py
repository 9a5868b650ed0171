"""Room for one item between two threads: what is newest is taken, and both sides can leave."""

import threading
import time

from mereo.reconstruction.latest_slot import LatestSlot


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


def test_a_patient_item_waits_its_turn_and_arrives_then() -> None:
    slot = LatestSlot[str]()
    slot.put("first")
    thread = threading.Thread(target=lambda: slot.put("second", wait=True))
    thread.start()
    time.sleep(0.05)
    now = time.perf_counter()
    first, second = slot.take(), slot.take(10)
    thread.join(10)
    assert first is not None and second is not None
    assert (first.item, second.item, second.replaced) == ("first", "second", 0)
    assert first.arrived_s < now <= second.arrived_s


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
