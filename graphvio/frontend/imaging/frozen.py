"""Detection of cameras that repeat their image, which would look like a standstill."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Image
from graphvio.measurements.sensors import FrameSet


@dataclass(frozen=True)
class Frozen:
    """Repeated images of a frameset.

    Attributes:
        pairs: Pairs with a camera that repeats its image while its partner or another pair's cameras do not.
        all_since_ns: Stamp since which every image is the same, or None. A standstill without image noise looks the
            same.
        reason: Description in one line, or empty.
    """

    pairs: frozenset[int]
    all_since_ns: int | None
    reason: str


class FrozenImages:
    """Detects repeated images by comparing each with the one before, byte for byte: noise changes every real image."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[Image, ...]] = {}
        self._changed_ns: dict[int, int] = {}  # when both of a pair's images last were new
        self._seen_ns: dict[int, int] = {}  # when a pair last had images

    def update(self, frameset: FrameSet) -> Frozen:
        """Return which images of a frameset repeat those before."""
        others_changed = self._others_changed(frameset)
        repeats: dict[int, int] = {}
        for j, images in frameset.images.items():
            before = self._last.get(j)
            repeats[j] = 0 if before is None else sum(_same(a, b) for a, b in zip(before, images, strict=True))
            if repeats[j] == 0:
                self._changed_ns[j] = frameset.stamp_ns
            self._last[j] = tuple(images)
            self._seen_ns[j] = frameset.stamp_ns
        if repeats and all(count == len(frameset.images[j]) for j, count in repeats.items()) and not others_changed:
            return Frozen(frozenset(), max(self._changed_ns[j] for j in repeats), "every image repeats the one before")
        stuck = frozenset(j for j, count in repeats.items() if count)
        return Frozen(stuck, None, f"pairs {sorted(stuck)} repeat an image" if stuck else "")

    def _others_changed(self, frameset: FrameSet) -> bool:
        """Return whether pairs that are not in this frameset had new images since the last images of those that are."""
        since_ns = min((self._seen_ns.get(j, frameset.stamp_ns) for j in frameset.images), default=0)
        return any(
            seen_ns > since_ns and self._changed_ns.get(j) == seen_ns
            for j, seen_ns in self._seen_ns.items()
            if j not in frameset.images
        )


def _same(one: Image, other: Image) -> bool:
    if one is other:
        return True
    middle = len(one) // 2  # one row nearly always differs
    return bool(np.array_equal(one[middle], other[middle]) and np.array_equal(one, other))
