"""Bounded queues between threads, and distribution of items to several readers by such queues."""

from __future__ import annotations

import threading
from collections import deque
from enum import Enum, auto
from typing import Generic, NamedTuple, TypeVar

T = TypeVar("T")


class WhenFull(Enum):
    """Behaviour when an item is put into a full queue."""

    WAIT = auto()
    """The writer waits for room."""
    DROP_OLDEST = auto()
    """The oldest item makes room."""
    DROP_NEWEST = auto()
    """The item itself is dropped."""


class Limit(NamedTuple):
    """The capacity of a lane, and the behaviour when it is full."""

    capacity: int
    when_full: WhenFull


class BoundedQueue(Generic[T]):
    """First-in, first-out queue between threads, which either end can close.

    Items may belong to lanes with separate limits. They are taken in the order in which they were put, across all
    lanes.

    Args:
        capacity: number of items of the default lane that may wait.
        when_full: behaviour when the default lane is full.
        lanes: limits of other lanes, by name.
    """

    def __init__(self, capacity: int, when_full: WhenFull, **lanes: Limit) -> None:
        self._limits = {"": Limit(capacity, when_full), **lanes}
        self._changed = threading.Condition()
        self._items: deque[tuple[str, T]] = deque()
        self._waiting = dict.fromkeys(self._limits, 0)
        self._dropped = dict.fromkeys(self._limits, 0)
        self._is_closed = False

    def put(self, item: T, lane: str = "") -> bool:
        """Add an item.

        Args:
            item: item to add.
            lane: lane of the item.

        Returns:
            Whether it was added: not if the queue is closed, or the item was dropped.
        """
        capacity, when_full = self._limits[lane]
        with self._changed:
            if when_full is WhenFull.WAIT:
                self._changed.wait_for(lambda: self._waiting[lane] < capacity or self._is_closed)
            if self._is_closed:
                return False
            if self._waiting[lane] >= capacity:
                self._dropped[lane] += 1
                if when_full is WhenFull.DROP_NEWEST:
                    return False
                del self._items[next(i for i, (each, _) in enumerate(self._items) if each == lane)]
                self._waiting[lane] -= 1
            self._items.append((lane, item))
            self._waiting[lane] += 1
            self._changed.notify_all()
            return True

    def get(self, timeout_s: float | None = None) -> T | None:
        """Take the oldest item, and wait for it if there is none.

        Args:
            timeout_s: longest wait, s; None waits until there is an item or the queue is closed.

        Returns:
            The item, or None if none came in time, or the queue is closed and empty.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._is_closed, timeout_s)
            if not self._items:
                return None
            lane, item = self._items.popleft()
            self._waiting[lane] -= 1
            self._changed.notify_all()
            return item

    def close(self) -> None:
        """Accept no more items; those that wait can still be taken."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def abandon(self) -> None:
        """Accept no more items, and discard those that wait."""
        with self._changed:
            self._items.clear()
            self._waiting = dict.fromkeys(self._limits, 0)
            self.close()

    @property
    def is_closed(self) -> bool:
        """Whether no more items are accepted."""
        return self._is_closed

    @property
    def is_finished(self) -> bool:
        """Whether it is closed and empty."""
        with self._changed:
            return self._is_closed and not self._items

    def waiting(self, lane: str = "") -> int:
        """Return the number of items of a lane that wait."""
        return self._waiting[lane]

    def dropped(self, lane: str = "") -> int:
        """Return the number of items of a lane that were dropped because it was full."""
        return self._dropped[lane]

    def __len__(self) -> int:
        return len(self._items)


class Broadcast(Generic[T]):
    """Distributes items to any number of readers, and never waits for them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._queues: list[BoundedQueue[T]] = []
        self._is_closed = False

    def subscribe(self, capacity: int) -> BoundedQueue[T]:
        """Return a new queue for one reader, who closes it to unsubscribe.

        Args:
            capacity: number of items that may wait; a slow reader loses the oldest.

        Returns:
            The queue of all items that are published from now on.
        """
        queue: BoundedQueue[T] = BoundedQueue(capacity, WhenFull.DROP_OLDEST)
        with self._lock:
            self._queues = [each for each in self._queues if not each.is_closed]
            if self._is_closed:
                queue.close()
            else:
                self._queues.append(queue)
        return queue

    def publish(self, item: T) -> None:
        """Put an item into all readers' queues; this returns at once."""
        with self._lock:
            self._queues = [queue for queue in self._queues if queue.put(item)]

    def close(self) -> None:
        """Publish no more items; those that wait can still be taken."""
        with self._lock:
            self._is_closed = True
            for queue in self._queues:
                queue.close()
