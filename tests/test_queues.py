"""Bounded queues between threads, and their distribution to several readers."""

import threading
from collections.abc import Callable

from graphvio.queues import BoundedQueue, Broadcast, WhenFull

SOON_S = 20.0  # until then a thread is waited for; only a test that fails takes so long


def in_thread(work: Callable[[], object]) -> tuple[threading.Thread, list[object]]:
    results: list[object] = []
    thread = threading.Thread(target=lambda: results.append(work()), daemon=True)
    thread.start()
    return thread, results


def all_of(queue: BoundedQueue[int]) -> list[int]:
    taken = []
    while (item := queue.get(SOON_S)) is not None:
        taken.append(item)
    return taken


# ---------------------------------------------------------------- one queue


def test_queue_that_waits_hands_on_all_items_in_order() -> None:
    queue: BoundedQueue[int] = BoundedQueue(3, WhenFull.WAIT)

    def write() -> None:
        for i in range(200):
            assert queue.put(i)
        queue.close()

    thread, _ = in_thread(write)
    taken = []
    while (item := queue.get()) is not None:
        assert len(queue) <= 3
        taken.append(item)
    thread.join(SOON_S)
    assert taken == list(range(200))
    assert queue.is_finished
    assert not queue.put(1)
    assert queue.dropped() == 0


def test_full_queue_drops_the_newest_item_and_counts_it() -> None:
    queue: BoundedQueue[int] = BoundedQueue(1, WhenFull.DROP_NEWEST)
    assert queue.put(0)
    assert not queue.put(1)
    assert queue.dropped() == 1
    queue.close()
    assert not queue.is_finished
    assert queue.get() == 0
    assert queue.get() is None


def test_abandoned_queue_releases_writer_and_closed_queue_releases_reader() -> None:
    full: BoundedQueue[int] = BoundedQueue(1, WhenFull.WAIT)
    full.put(0)
    writing, is_added = in_thread(lambda: full.put(1))
    empty: BoundedQueue[int] = BoundedQueue(1, WhenFull.WAIT)
    reading, taken = in_thread(empty.get)
    full.abandon()
    empty.close()
    for thread in (writing, reading):
        thread.join(SOON_S)
    assert (is_added, taken) == ([False], [None])
    assert full.get() is None


# ---------------------------------------------------------------- several readers


def test_broadcast_reader_gets_items_published_after_it_subscribed() -> None:
    broadcast: Broadcast[int] = Broadcast()
    broadcast.publish(0)
    early = broadcast.subscribe(10)
    broadcast.publish(1)
    late = broadcast.subscribe(10)
    broadcast.publish(2)
    broadcast.close()
    assert (all_of(early), all_of(late)) == ([1, 2], [2])
    assert early.dropped() == late.dropped() == 0


def test_broadcast_slow_reader_loses_the_oldest_items_and_they_are_counted() -> None:
    broadcast: Broadcast[int] = Broadcast()
    slow, quick = broadcast.subscribe(3), broadcast.subscribe(100)
    for item in range(10):
        broadcast.publish(item)
    assert (slow.dropped(), quick.dropped()) == (7, 0)
    assert slow.get(0.0) == 7
    broadcast.publish(10)
    assert slow.dropped() == 7
    broadcast.close()
    assert (all_of(slow), all_of(quick)) == ([8, 9, 10], list(range(11)))


def test_broadcast_get_without_items_times_out() -> None:
    queue = Broadcast[int]().subscribe(1)
    assert queue.get(0.0) is None
    assert queue.get(0.01) is None
    assert not queue.is_closed


def test_broadcast_readers_in_several_threads_get_all_items() -> None:
    broadcast: Broadcast[int] = Broadcast()
    queues = [broadcast.subscribe(10_000) for _ in range(3)]
    threads = [in_thread(lambda each=each: all_of(each)) for each in queues]  # type: ignore[misc]
    for item in range(2000):
        broadcast.publish(item)
    broadcast.close()
    for (thread, results), queue in zip(threads, queues, strict=True):
        thread.join(SOON_S)
        assert results == [list(range(2000))]
        assert queue.dropped() == 0


def test_broadcast_close_wakes_readers_and_ends_later_subscriptions() -> None:
    broadcast: Broadcast[int] = Broadcast()
    waiting = [in_thread(broadcast.subscribe(1).get) for _ in range(3)]
    broadcast.close()
    for thread, results in waiting:
        thread.join(SOON_S)
        assert results == [None]
    late = broadcast.subscribe(1)
    assert late.is_closed
    assert late.get() is None


def test_broadcast_reader_that_closes_its_queue_is_forgotten() -> None:
    broadcast: Broadcast[int] = Broadcast()
    leaving, staying = broadcast.subscribe(5), broadcast.subscribe(5)
    thread, results = in_thread(leaving.get)
    leaving.close()
    leaving.close()
    thread.join(SOON_S)
    assert results == [None]
    broadcast.publish(1)
    assert leaving.get(0.0) is None
    assert staying.get(0.0) == 1
    assert len(broadcast._queues) == 1
