"""One thread tells many: each listener has a bounded queue of its own, and is told what it missed."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Subscription(Generic[T]):
    """What one listener has not taken yet; the oldest is dropped when it does not keep up."""

    def __init__(self, owner: Broadcast[T], depth: int) -> None:
        self._owner = owner
        self._changed = threading.Condition()
        self._waiting: deque[T] = deque(maxlen=depth)
        self._missed = 0
        self._is_closed = False

    @property
    def missed(self) -> int:
        """How many were dropped since the subscription began."""
        return self._missed

    @property
    def is_closed(self) -> bool:
        """Whether nothing more will come."""
        return self._is_closed

    def get(self, timeout_s: float | None = None) -> T | None:
        """The oldest that waits, or None when nothing came by the end of the time or nothing will."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            return self._waiting.popleft() if self._waiting else None

    def close(self) -> None:
        """Listen no more."""
        self._owner._forget(self)
        self._end()

    def _put(self, item: T) -> None:
        with self._changed:
            self._missed += len(self._waiting) == self._waiting.maxlen
            self._waiting.append(item)
            self._changed.notify()

    def _end(self) -> None:
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


class Broadcast(Generic[T]):
    """Hands items to all that listen; it never waits for any of them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscriptions: tuple[Subscription[T], ...] = ()
        self._is_closed = False

    def subscribe(self, depth: int) -> Subscription[T]:
        """Listen from now on; so many items wait at most."""
        subscription = Subscription(self, depth)
        with self._lock:
            self._subscriptions += (subscription,)
            if self._is_closed:
                subscription._end()
        return subscription

    def publish(self, item: T) -> None:
        """Hand over an item; returns at once."""
        for subscription in self._subscriptions:
            subscription._put(item)

    def close(self) -> None:
        """Nothing more will come; what waits can still be taken."""
        with self._lock:
            self._is_closed = True
        for subscription in self._subscriptions:
            subscription._end()

    def _forget(self, subscription: Subscription[T]) -> None:
        with self._lock:
            self._subscriptions = tuple(each for each in self._subscriptions if each is not subscription)
