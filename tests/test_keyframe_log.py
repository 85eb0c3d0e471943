"""The log of the newest keyframes, and its readers."""

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from graphvio.measurements.estimate import Status
from graphvio.slam.keyframe import Keyframe, Landmarks
from graphvio.slam.keyframe_log import KeyframeLog

SOON_S = 20.0  # until then a thread is waited for; only a test that fails takes so long
IMAGE = np.zeros((10, 10), dtype=np.uint8)  # a keyframe of 200 bytes


def keyframe(number: int) -> Keyframe:
    return Keyframe(
        number, 0, number, Status.TRACKING, np.eye(4), np.eye(6), None, None, None, Landmarks.none(),
        {0: (IMAGE, IMAGE)},
    )  # fmt: skip


def filled(count: int, max_bytes: int = 2**20) -> KeyframeLog:
    log = KeyframeLog(max_bytes)
    for number in range(count):
        log.add(keyframe(number))
    return log


def in_thread(work: Callable[[], object]) -> tuple[threading.Thread, list[object]]:
    results: list[object] = []
    thread = threading.Thread(target=lambda: results.append(work()), daemon=True)
    thread.start()
    return thread, results


def test_memory_is_bounded_by_dropping_the_oldest() -> None:
    log = filled(100, max_bytes=1000)
    assert (log.oldest_id, log.next_id) == (95, 100)
    log.close()
    assert [each.id for each in log.follow(0)] == [95, 96, 97, 98, 99]
    assert log._bytes == 1000


def test_landmarks_count_as_images() -> None:
    whole, pixels = np.zeros(4, dtype=np.int64), np.zeros((4, 2))
    descriptors = np.zeros((4, 32), dtype=np.uint8)
    marks = Landmarks(whole, whole, np.zeros((4, 3)), np.zeros((4, 3, 3)), pixels, pixels, descriptors)
    log = KeyframeLog()
    log.add(replace(keyframe(0), landmarks=marks))
    assert log._bytes == 200 + 8 * 4 * (1 + 1 + 3 + 9 + 2 + 2) + 4 * 32


def test_newest_keyframe_stays_whatever_its_size() -> None:
    log = filled(3, max_bytes=10)
    assert (log.oldest_id, log.next_id) == (2, 3)
    newest = log.read(0)
    assert newest is not None
    assert newest.id == 2


def test_reader_resumes_at_an_id() -> None:
    log = filled(5)
    log.close()
    first = log.follow(0)
    assert [next(first).id, next(first).id] == [0, 1]
    assert [each.id for each in log.follow(2)] == [2, 3, 4]
    assert [each.id for each in first] == [2, 3, 4]
    assert list(log.follow(5)) == []
    assert next(log.follow(-3)).id == 0


def test_missing_ids_are_skipped() -> None:
    log = KeyframeLog()
    for number in (3, 4, 9, 11):
        log.add(keyframe(number))
    log.close()
    assert [each.id for each in log.follow(0)] == [3, 4, 9, 11]
    assert [each.id for each in log.follow(5)] == [9, 11]


def test_empty_log_has_the_next_id() -> None:
    log = KeyframeLog()
    assert (log.oldest_id, log.next_id, log.is_closed) == (0, 0, False)
    assert log.read(0, timeout_s=0.0) is None
    log.add(keyframe(7))
    assert log.read(8, timeout_s=0.01) is None
    assert (log.oldest_id, log.next_id) == (7, 8)


def test_waiting_reader_gets_the_next_keyframe() -> None:
    log = filled(2)
    thread, results = in_thread(lambda: log.read(2))
    assert thread.is_alive()
    log.add(keyframe(2))
    thread.join(SOON_S)
    assert [each.id for each in results] == [2]  # type: ignore[attr-defined]


def test_all_readers_get_all_kept_keyframes() -> None:
    log = KeyframeLog()
    readers = [in_thread(lambda: [each.id for each in log.follow(0)]) for _ in range(4)]
    for number in range(500):
        log.add(keyframe(number))
    log.close()
    for thread, results in readers:
        thread.join(SOON_S)
        assert results == [list(range(500))]


@pytest.mark.parametrize("from_id", [0, 5])
def test_close_wakes_waiting_readers(from_id: int) -> None:
    log = KeyframeLog()
    waiting = [in_thread(lambda: log.read(from_id)) for _ in range(3)]
    log.close()
    for thread, results in waiting:
        thread.join(SOON_S)
        assert results == [None]
    assert log.is_closed
