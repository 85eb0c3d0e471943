"""Takes keyframes as fast as they come, and keeps those that are places for who works on them."""

from __future__ import annotations

import threading
from collections.abc import Callable

from graphvio.config.stages import OptimizationConfig
from graphvio.errors import MapError
from graphvio.mapping.places import Anchored, NewPlace, PlaceChooser
from graphvio.queues import BoundedQueue, WhenFull
from graphvio.slam.interface import SlamFrontEnd

_MAX_WAITING = 8  # places, with their images


class Intake:
    """Reads a front-end in a thread of its own, so that its keyframes are never waited for.

    When too many places wait, further keyframes are none: the map gets coarser, but does not fall behind.

    Args:
        front_end: whose keyframes are read.
        settings: how far apart places are.
        share: asked before each keyframe: the share of these distances that is enough now.
    """

    def __init__(self, front_end: SlamFrontEnd, settings: OptimizationConfig, share: Callable[[], float]) -> None:
        self._front_end = front_end
        self._share = share
        self._chooser = PlaceChooser(settings.place_distance_m, settings.place_angle_deg)
        self._lock = threading.Lock()
        self._waiting: BoundedQueue[NewPlace] = BoundedQueue(_MAX_WAITING, WhenFull.DROP_NEWEST)
        self._keyframes: list[Anchored] = []
        self._skipped = 0
        self._lost = 0
        self._failure: BaseException | None = None

    @property
    def skipped(self) -> int:
        """Places that were none because too many waited."""
        return self._skipped

    @property
    def lost(self) -> int:
        """Keyframes whose ids were passed over."""
        return self._lost

    @property
    def waiting(self) -> int:
        """Places that are not worked on yet."""
        return len(self._waiting)

    @property
    def keyframes(self) -> list[Anchored]:
        """All that belong to a place, so far."""
        with self._lock:
            return list(self._keyframes)

    def start(self) -> None:
        """Begin to read."""
        threading.Thread(target=self._read, name="graphvio-keyframes", daemon=True).start()

    def stop(self) -> None:
        """Read no more; places that wait are dropped."""
        self._waiting.abandon()

    def next(self) -> NewPlace | None:
        """The next place, waited for; None when there will be none.

        Raises:
            GraphvioError: whatever the front-end raised, after all places that came before it; MapError, if its
                keyframes carry no images.
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
                raise MapError("the keyframes carry no images, and places are recognised by them: ask for images")
            with self._lock:
                if self._waiting.is_closed:
                    return
                self._lost += max(keyframe.id - (keyframe.id if expected is None else expected), 0)
                expected = keyframe.id + 1
                place, is_one = self._chooser.add(keyframe, self._share(), len(self._waiting) < _MAX_WAITING)
                anchored = self._chooser.anchored()
                if anchored is not None:
                    self._keyframes.append(anchored)
                if place is not None:
                    self._waiting.put(place)
                self._skipped += is_one and place is None
