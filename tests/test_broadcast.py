"""One thread tells many, and waits for none of them."""

import threading
from collections.abc import Callable

from graphvio.broadcast import Broadcast, Subscription

SOON_S = 20.0  # until then a thread is waited for; only a test that fails takes so long


def in_thread(work: Callable[[], object]) -> tuple[threading.Thread, list[object]]:
    results: list[object] = []
    thread = threading.Thread(target=lambda: results.append(work()), daemon=True)
    thread.start()
    return thread, results


def all_of(subscription: Subscription[int]) -> list[int]:
    taken = []
    while (item := subscription.get(SOON_S)) is not None:
        taken.append(item)
    return taken


def test_each_listener_gets_what_comes_after_it_began() -> None:
    broadcast: Broadcast[int] = Broadcast()
    broadcast.publish(0)
    early = broadcast.subscribe(10)
    broadcast.publish(1)
    late = broadcast.subscribe(10)
    broadcast.publish(2)
    broadcast.close()
    assert (all_of(early), all_of(late)) == ([1, 2], [2])
    assert early.missed == late.missed == 0


def test_a_listener_that_does_not_keep_up_loses_the_oldest_and_is_told() -> None:
    broadcast: Broadcast[int] = Broadcast()
    slow, quick = broadcast.subscribe(3), broadcast.subscribe(100)
    for item in range(10):
        broadcast.publish(item)
    assert (slow.missed, quick.missed) == (7, 0)
    assert slow.get(0.0) == 7
    broadcast.publish(10)
    assert slow.missed == 7
    broadcast.close()
    assert (all_of(slow), all_of(quick)) == ([8, 9, 10], list(range(11)))


def test_nothing_comes_by_the_end_of_the_time() -> None:
    subscription = Broadcast[int]().subscribe(1)
    assert subscription.get(0.0) is None
    assert subscription.get(0.01) is None
    assert not subscription.is_closed


def test_what_waits_is_handed_over_as_it_comes_to_any_number_of_threads() -> None:
    broadcast: Broadcast[int] = Broadcast()
    listeners = [broadcast.subscribe(10_000) for _ in range(3)]
    threads = [in_thread(lambda each=each: all_of(each)) for each in listeners]  # type: ignore[misc]
    for item in range(2000):
        broadcast.publish(item)
    broadcast.close()
    for (thread, results), listener in zip(threads, listeners, strict=True):
        thread.join(SOON_S)
        assert results == [list(range(2000))]
        assert listener.missed == 0


def test_closing_wakes_all_that_wait_and_ends_all_that_come() -> None:
    broadcast: Broadcast[int] = Broadcast()
    waiting = [in_thread(broadcast.subscribe(1).get) for _ in range(3)]
    broadcast.close()
    for thread, results in waiting:
        thread.join(SOON_S)
        assert results == [None]
    late = broadcast.subscribe(1)
    assert late.is_closed
    assert late.get() is None


def test_a_listener_that_leaves_is_woken_and_kept_no_longer() -> None:
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
    assert len(broadcast._subscriptions) == 1
