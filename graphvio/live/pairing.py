"""Images of single cameras to framesets, as they come: which belong together, and how long others are waited for."""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from operator import attrgetter

from graphvio.arrays import Image
from graphvio.measurements.events import Report
from graphvio.measurements.sensors import FrameSet
from graphvio.odometry.synchroniser import JumpGuard
from graphvio.rig import Rig

_SILENT_NS = 1_000_000_000  # a pair one of whose cameras has not delivered for so long is not waited for
_MOST_WAITING = 32  # images of a camera, or matched ones of a pair: what a wait may hold at any sensible rate
_REMEMBERED = 32  # stamps of a camera, to know an image that comes twice

_by_stamp = attrgetter("stamp_ns")


class FramesetAssembler:
    """Makes framesets that increase in time, by the rules by which `graphvio.sources.matching` joins recorded images.

    The left image's stamp is its pair's, and that of the first pair is the frameset's. A mean would move with the pairs
    that happen to be there, and no image would be of that time; so a live run and the session that it recorded have
    the same framesets. Only where another image follows so closely that it would lie within the tolerance of this
    stamp is the frameset's that of its earliest pair.

    A frameset is given out once no image can join it any more, if each camera delivers its own images in their order;
    cameras may come in any order among each other. A camera that is past an instant has no image of it: one that lost
    an image, a pair at half the rate or at instants of its own holds the others up until its next image, and
    ``max_wait_ms`` at most. Nobody waits for a pair that has been silent for a second.

    The tolerance should be less than half of the shortest time between a camera's images.

    Args:
        rig: its cameras' names.
        tolerance_ms: images whose stamps differ by no more are of the same instant.
        max_wait_ms: longest time from an image's arrival until its frameset is given out, as far as anything that
            arrives tells the time.
        report: is told what had to be left out, with the image's stamp: ``image_without_partner``, ``late_image`` for
            those not after the frameset given out last, ``duplicate_image``, ``image_future_stamp`` for one far ahead
            of those before and after it, and ``unknown_camera``.
    """

    def __init__(self, rig: Rig, tolerance_ms: float, max_wait_ms: float, report: Report) -> None:
        self._tolerance_ns = round(1e6 * tolerance_ms)
        self._max_wait_ns = round(1e6 * max_wait_ms)
        self._report = report
        self._pairs = [_Pair(_Camera(p.left.name, report), _Camera(p.right.name, report)) for p in rig.pairs]
        self._places = {each.name: (pair, each) for pair in self._pairs for each in (pair.left, pair.right)}
        self._now_ns: int | None = None
        self._given_ns: int | None = None

    def add(self, camera: str, stamp_ns: int, image: Image, arrival_ns: int) -> list[FrameSet]:
        """Take an image; the framesets that need wait no longer.

        Args:
            camera: its name in the rig.
            stamp_ns: on the clock of all cameras.
            image: (height, width).
            arrival_ns: when it came.
        """
        self._tell_time(arrival_ns)
        if camera not in self._places:
            self._report(stamp_ns, "unknown_camera", f"image of {camera!r}, which is not in the rig: left out")
            return list(self._due())
        pair, place = self._places[camera]
        place.heard_ns = arrival_ns if place.heard_ns is None else max(place.heard_ns, arrival_ns)
        for confirmed in place.jumps.confirm(_Arrived(stamp_ns, image, arrival_ns)):
            self._take(pair, place, confirmed)
        return list(self._due())

    def advance(self, arrival_ns: int) -> list[FrameSet]:
        """Something else came at this time, such as a sample of the IMU; the framesets that need wait no longer."""
        self._tell_time(arrival_ns)
        return list(self._due())

    def flush(self) -> list[FrameSet]:
        """Nothing more will come: all framesets that there are."""
        framesets = []
        while entry := self._earliest():
            framesets.append(self._give(entry.stamp_ns))
        for camera in self._cameras():
            camera.jumps.end()
            self._abandon(camera, list(camera.waiting))
        return framesets

    @property
    def waiting(self) -> int:
        """Number of images that are held."""
        return sum(len(camera.waiting) for camera in self._cameras()) + sum(2 * len(p.matched) for p in self._pairs)

    def _tell_time(self, arrival_ns: int) -> None:
        if self._now_ns is None:
            for camera in self._cameras():
                camera.heard_ns = arrival_ns  # all are waited for at first
        self._now_ns = arrival_ns if self._now_ns is None else max(self._now_ns, arrival_ns)

    def _cameras(self) -> Iterator[_Camera]:
        return (camera for pair in self._pairs for camera in (pair.left, pair.right))

    def _take(self, pair: _Pair, camera: _Camera, image: _Arrived) -> None:
        camera.last_ns = image.stamp_ns
        if image.stamp_ns in camera.seen:
            self._report(image.stamp_ns, "duplicate_image", f"{camera.name}: a second image of this stamp, left out")
            return
        camera.seen.append(image.stamp_ns)
        if self._is_too_late(pair, camera, image):
            assert self._given_ns is not None
            late_ms = 1e-6 * (self._given_ns - image.stamp_ns)
            self._report(
                image.stamp_ns, "late_image", f"{camera.name}: {late_ms:.1f} ms before the newest frameset, left out"
            )
            return
        partner = pair.right if camera is pair.left else pair.left
        match = min(
            partner.waiting, key=lambda other: (abs(other.stamp_ns - image.stamp_ns), other.stamp_ns), default=None
        )
        if match is None or abs(match.stamp_ns - image.stamp_ns) > self._tolerance_ns:
            insort(camera.waiting, image, key=_by_stamp)
            return
        partner.waiting.remove(match)
        left, right = (image, match) if camera is pair.left else (match, image)
        insort(
            pair.matched,
            _Matched(left.stamp_ns, (left.image, right.image), min(left.at_ns, right.at_ns)),
            key=_by_stamp,
        )

    def _is_too_late(self, pair: _Pair, camera: _Camera, image: _Arrived) -> bool:
        """Whether an image cannot be in a frameset any more; the left one of a pair is what counts."""
        if self._given_ns is None:
            return False
        slack_ns = 0 if camera is pair.left else self._tolerance_ns
        return image.stamp_ns <= self._given_ns - slack_ns

    def _due(self) -> Iterator[FrameSet]:
        for camera in self._cameras():
            self._abandon(camera, [image for image in camera.waiting if self._has_waited(image.at_ns)])
            self._abandon(camera, camera.waiting[:-_MOST_WAITING])
        while (entry := self._earliest()) and self._is_due(entry.stamp_ns):
            yield self._give(entry.stamp_ns)

    def _abandon(self, camera: _Camera, images: Iterable[_Arrived]) -> None:
        for image in images:
            camera.waiting.remove(image)
            self._report(
                image.stamp_ns, "image_without_partner", f"{camera.name}: no image of the other side, left out"
            )

    def _has_waited(self, arrival_ns: int) -> bool:
        assert self._now_ns is not None
        return self._now_ns - arrival_ns >= self._max_wait_ns

    def _earliest(self) -> _Matched | None:
        return min((pair.matched[0] for pair in self._pairs if pair.matched), key=_by_stamp, default=None)

    def _group(self, begun_ns: int) -> dict[int, _Matched]:
        """Pairs of the frameset that begins with the earliest matched images."""
        group: dict[int, _Matched] = {}
        entries = ((entry.stamp_ns, number) for number, pair in enumerate(self._pairs) for entry in pair.matched[:2])
        for stamp_ns, number in sorted(entries):
            if stamp_ns - begun_ns > self._tolerance_ns or number in group:
                break
            group[number] = self._pairs[number].matched[0]
        return group

    def _is_due(self, begun_ns: int) -> bool:
        group = self._group(begun_ns)
        if any(self._has_waited(entry.at_ns) for entry in group.values()):
            return True
        if any(len(pair.matched) > _MOST_WAITING for pair in self._pairs):
            return True
        until_ns = begun_ns + self._tolerance_ns
        return not any(
            self._is_alive(pair) and self._may_deliver(pair, until_ns, number in group)
            for number, pair in enumerate(self._pairs)
        )

    def _is_alive(self, pair: _Pair) -> bool:
        assert self._now_ns is not None
        heard = (pair.left.heard_ns, pair.right.heard_ns)
        return all(at is not None and self._now_ns - at < _SILENT_NS for at in heard)

    def _may_deliver(self, pair: _Pair, until_ns: int, is_in_group: bool) -> bool:
        """Whether a pair may still have matched images up to a stamp, or up to what it has in the group."""
        slack_ns = self._tolerance_ns
        for camera, other, latest_ns in (
            (pair.left, pair.right, until_ns),
            (pair.right, pair.left, until_ns + slack_ns),
        ):
            for image in camera.waiting:
                if image.stamp_ns <= latest_ns and not other.is_past(image.stamp_ns + slack_ns):
                    return True
        return not (is_in_group or pair.left.is_past(until_ns) or pair.right.is_past(until_ns + slack_ns))

    def _give(self, begun_ns: int) -> FrameSet:
        group = self._group(begun_ns)
        for number in group:
            del self._pairs[number].matched[0]
        stamp_ns = group[min(group)].stamp_ns
        following = [entry.stamp_ns for pair in self._pairs for entry in pair.matched[:1]]
        following += [
            image.stamp_ns for pair in self._pairs for image in pair.left.waiting if image.stamp_ns > begun_ns
        ]
        if any(each - stamp_ns <= self._tolerance_ns for each in following):
            stamp_ns = begun_ns
        self._given_ns = stamp_ns
        for pair in self._pairs:
            for camera in (pair.left, pair.right):
                self._abandon(camera, [image for image in camera.waiting if self._is_too_late(pair, camera, image)])
        return FrameSet(stamp_ns, {number: entry.images for number, entry in group.items()})


@dataclass(frozen=True, slots=True, eq=False)
class _Arrived:
    """An image of one camera; ``at_ns`` is when it came."""

    stamp_ns: int
    image: Image
    at_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class _Matched:
    """Both images of a pair; ``at_ns`` is when the first of them came."""

    stamp_ns: int
    images: tuple[Image, Image]
    at_ns: int


class _Camera:
    """What came of one camera.

    Attributes:
        name: in the rig.
        waiting: images whose partner has not come, by stamp.
        seen: stamps of the newest images.
        last_ns: stamp of the image that came last; the largest one would be wrong for ever if it was damaged.
        heard_ns: when the newest one came.
        jumps: holds back an image that is far ahead.
    """

    def __init__(self, name: str, report: Report) -> None:
        self.name = name
        self.waiting: list[_Arrived] = []
        self.seen: deque[int] = deque(maxlen=_REMEMBERED)
        self.last_ns: int | None = None
        self.heard_ns: int | None = None
        self.jumps: JumpGuard[_Arrived] = JumpGuard(
            "image_future_stamp", lambda stamp_ns, kind, detail: report(stamp_ns, kind, f"{name}: {detail}")
        )

    def is_past(self, stamp_ns: int) -> bool:
        """Whether no image up to a stamp will come."""
        return self.last_ns is not None and self.last_ns > stamp_ns


@dataclass(slots=True)
class _Pair:
    """Its cameras, and its matched images, by stamp."""

    left: _Camera
    right: _Camera
    matched: list[_Matched] = field(default_factory=list)
