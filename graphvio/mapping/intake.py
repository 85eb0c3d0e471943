"""Intake of the mapper: reads keyframes as fast as they come, and queues those that become places."""

from __future__ import annotations

import threading
from collections.abc import Callable

from graphvio.config.stages import OptimizationConfig
from graphvio.errors import MapError
from graphvio.mapping.places import KeyframeAtPlace, NewPlace, PlaceChooser
from graphvio.queues import BoundedQueue, WhenFull
from graphvio.slam.interface import SlamFrontEnd

_MAX_WAITING = 8  # places that may wait, with their images


class Intake:
    """Reads a front-end's keyframes in a thread of its own, so that the front-end never waits.

    While too many places wait, no keyframe becomes a place: the map gets coarser, but does not fall behind. ``share``
    is called before each keyframe; it returns the share of the configured distance and angle that suffices now for the
    next place.

    Attributes:
        skipped: Number of keyframes that did not become places because too many waited.
        lost: Number of keyframes that were lost: gaps in their ids.
    """

    def __init__(self, front_end: SlamFrontEnd, settings: OptimizationConfig, share: Callable[[], float]) -> None:
        self.skipped = 0
        self.lost = 0
        self._front_end = front_end
        self._share = share
        self._chooser = PlaceChooser(settings.place_distance_m, settings.place_angle_deg)
        self._lock = threading.Lock()
        self._waiting: BoundedQueue[NewPlace] = BoundedQueue(_MAX_WAITING, WhenFull.DROP_NEWEST)
        self._keyframes: list[KeyframeAtPlace] = []
        self._failure: BaseException | None = None

    @property
    def waiting(self) -> int:
        """Number of places that wait in the queue."""
        return len(self._waiting)

    @property
    def keyframes(self) -> list[KeyframeAtPlace]:
        """All keyframes so far that belong to a place."""
        with self._lock:
            return list(self._keyframes)

    def start(self) -> None:
        """Start the reading thread."""
        threading.Thread(target=self._read, name="graphvio-keyframes", daemon=True).start()

    def stop(self) -> None:
        """Stop reading, and drop waiting places."""
        self._waiting.abandon()

    def next(self) -> NewPlace | None:
        """Wait for the next place; None after the last one.

        Raises:
            GraphvioError: An error of the front-end, after all earlier places; a MapError if keyframes have no images.
        """
        place = self._waiting.get()
        if place is None and self._failure is not None:
            raise self._failure
        return place

    def _read(self) -> None:
        try:
            self._follow()
        except BaseException as error:
            self._failure = error
        finally:
            self._waiting.close()

    def _follow(self) -> None:
        expected: int | None = None
        for keyframe in self._front_end.keyframes():
            if expected is None and not keyframe.images:
                raise MapError("the keyframes have no images, by which places are recognised; request images")
            with self._lock:
                if self._waiting.is_closed:
                    return
                self.lost += max(keyframe.id - (keyframe.id if expected is None else expected), 0)
                expected = keyframe.id + 1
                place, is_one = self._chooser.add(keyframe, self._share(), len(self._waiting) < _MAX_WAITING)
                newest = self._chooser.newest()
                if newest is not None:
                    self._keyframes.append(newest)
                if place is not None:
                    self._waiting.put(place)
                self.skipped += is_one and place is None
