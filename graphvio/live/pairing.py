"""Assembly of framesets from cameras' images: which belong together, and how long missing ones are waited for."""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from operator import attrgetter

from graphvio.arrays import Image
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.sensors import FrameSet
from graphvio.odometry.synchroniser import StampJumpFilter
from graphvio.rig import Camera, Rig

_SILENT_NS = 1_000_000_000  # a pair is not waited for if one of its cameras has not delivered for this time
_MAX_WAITING = 32  # images of a camera, or matched ones of a pair: enough for a wait at any sensible rate
_REMEMBERED = 32  # stamps of a camera, to recognise an image that comes twice

_by_stamp = attrgetter("stamp_ns")


class FramesetAssembler:
    """Assembles framesets with increasing stamps, by the same rules as `graphvio.sources.matching` for recordings.

    The stamp of a pair is that of its left image, and the stamp of a frameset that of its first pair; a camera without
    a partner counts as a pair that has no right image. A mean of stamps would depend on the pairs that are present, and
    be the time of no image; this way, a live run and the session that it recorded have the same framesets. Only if
    another image follows so closely that it would lie within the tolerance of this stamp, the frameset takes the stamp
    of its earliest pair.

    A frameset is complete once no image can join it any more, provided that each camera delivers its own images in
    order; between cameras, any order is possible. A camera whose last image is later than an instant has no other image
    of that instant. A camera that lost an image, and a pair at half the rate or at other instants, delay the others
    until their next image, and by ``max_wait_ms`` at most. A pair that has been silent for a second is not waited for.

    The tolerance should be less than half of the shortest time between a camera's images.

    Args:
        rig: the rig, with the names of the cameras and the offsets of their stamps.
        tolerance_ms: images whose stamps differ by no more than this are of the same instant.
        max_wait_ms: longest time from an image's arrival until its frameset is returned, where time passes only with
            the arrival times that `add` and `advance` are given.
        report: takes events with the stamp of an image that is left out: ``image_without_partner``, ``late_image`` for
            one that is not later than the last frameset, ``duplicate_image``, ``image_future_stamp`` for one far ahead
            of those before and after it, and ``unknown_camera``.
    """

    def __init__(self, rig: Rig, tolerance_ms: float, max_wait_ms: float, report: Report) -> None:
        self._tolerance_ns = round(1e6 * tolerance_ms)
        self._max_wait_ns = round(1e6 * max_wait_ms)
        self._report = report
        self._groups = [_Group(tuple(_Camera(each, report) for each in group.cameras)) for group in rig.groups]
        self._places = {each.name: (group, each) for group in self._groups for each in group.cameras}
        self._now_ns: int | None = None
        self._given_ns: int | None = None

    def add(self, camera: str, stamp_ns: int, image: Image, arrival_ns: int) -> list[FrameSet]:
        """Add an image.

        Args:
            camera: name of the camera in the rig.
            stamp_ns: stamp on the clock of all cameras, without the camera's ``stamp_offset_s``, which is added here.
            image: the image (height, width).
            arrival_ns: host time of its arrival.

        Returns:
            The framesets that are complete or have waited long enough.
        """
        self._set_time(arrival_ns)
        if camera not in self._places:
            detail = f"image of {camera!r}, which is not in the rig: left out"
            self._report(stamp_ns, EventKind.UNKNOWN_CAMERA, detail)
            return list(self._due())
        pair, place = self._places[camera]
        stamp_ns += place.stamp_offset_ns
        place.newest_ns = arrival_ns if place.newest_ns is None else max(place.newest_ns, arrival_ns)
        for confirmed in place.jumps.confirm(_Arrived(stamp_ns, image, arrival_ns)):
            self._take(pair, place, confirmed)
        return list(self._due())

    def advance(self, arrival_ns: int) -> list[FrameSet]:
        """Advance the host time without an image; returns the framesets that have waited long enough."""
        self._set_time(arrival_ns)
        return list(self._due())

    def flush(self) -> list[FrameSet]:
        """Return all framesets that are left, when no more images will come."""
        framesets = []
        while entry := self._earliest():
            framesets.append(self._give(entry.stamp_ns))
        for camera in self._cameras():
            camera.jumps.end()
            self._abandon(camera, list(camera.waiting))
        return framesets

    def _set_time(self, arrival_ns: int) -> None:
        if self._now_ns is None:
            for camera in self._cameras():
                camera.newest_ns = arrival_ns  # all are waited for at first
        self._now_ns = arrival_ns if self._now_ns is None else max(self._now_ns, arrival_ns)

    def _cameras(self) -> Iterator[_Camera]:
        return (camera for group in self._groups for camera in group.cameras)

    def _take(self, pair: _Group, camera: _Camera, image: _Arrived) -> None:
        camera.last_ns = image.stamp_ns
        if image.stamp_ns in camera.seen:
            detail = f"{camera.name}: a second image of this stamp, left out"
            self._report(image.stamp_ns, EventKind.DUPLICATE_IMAGE, detail)
            return
        camera.seen.append(image.stamp_ns)
        if self._is_too_late(pair, camera, image):
            assert self._given_ns is not None
            late_ms = 1e-6 * (self._given_ns - image.stamp_ns)
            detail = f"{camera.name}: {late_ms:.1f} ms before the newest frameset, left out"
            self._report(image.stamp_ns, EventKind.LATE_IMAGE, detail)
            return
        if pair.right is None:
            insort(pair.matched, _Matched(image.stamp_ns, (image.image,), image.arrival_ns), key=_by_stamp)
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
            _Matched(left.stamp_ns, (left.image, right.image), min(left.arrival_ns, right.arrival_ns)),
            key=_by_stamp,
        )

    def _is_too_late(self, pair: _Group, camera: _Camera, image: _Arrived) -> bool:
        """Return whether an image cannot join a frameset any more; a right one may be earlier by the tolerance."""
        if self._given_ns is None:
            return False
        slack_ns = 0 if camera is pair.left else self._tolerance_ns
        return image.stamp_ns <= self._given_ns - slack_ns

    def _due(self) -> Iterator[FrameSet]:
        for camera in self._cameras():
            self._abandon(camera, [image for image in camera.waiting if self._has_waited(image.arrival_ns)])
            self._abandon(camera, camera.waiting[:-_MAX_WAITING])
        while (entry := self._earliest()) and self._is_due(entry.stamp_ns):
            yield self._give(entry.stamp_ns)

    def _abandon(self, camera: _Camera, images: Iterable[_Arrived]) -> None:
        for image in images:
            camera.waiting.remove(image)
            detail = f"{camera.name}: no image of the other side, left out"
            self._report(image.stamp_ns, EventKind.IMAGE_WITHOUT_PARTNER, detail)

    def _has_waited(self, arrival_ns: int) -> bool:
        assert self._now_ns is not None
        return self._now_ns - arrival_ns >= self._max_wait_ns

    def _earliest(self) -> _Matched | None:
        return min((pair.matched[0] for pair in self._groups if pair.matched), key=_by_stamp, default=None)

    def _group(self, begin_ns: int) -> dict[int, _Matched]:
        """Return the images of the frameset whose earliest pair has this stamp: pair -> images."""
        group: dict[int, _Matched] = {}
        entries = ((entry.stamp_ns, number) for number, pair in enumerate(self._groups) for entry in pair.matched[:2])
        for stamp_ns, number in sorted(entries):
            if stamp_ns - begin_ns > self._tolerance_ns or number in group:
                break
            group[number] = self._groups[number].matched[0]
        return group

    def _is_due(self, begin_ns: int) -> bool:
        group = self._group(begin_ns)
        if any(self._has_waited(entry.arrival_ns) for entry in group.values()):
            return True
        if any(len(pair.matched) > _MAX_WAITING for pair in self._groups):
            return True
        until_ns = begin_ns + self._tolerance_ns
        return not any(
            self._is_alive(pair) and self._may_deliver(pair, until_ns, number in group)
            for number, pair in enumerate(self._groups)
        )

    def _is_alive(self, pair: _Group) -> bool:
        assert self._now_ns is not None
        newest = [camera.newest_ns for camera in pair.cameras]
        return all(at is not None and self._now_ns - at < _SILENT_NS for at in newest)

    def _may_deliver(self, pair: _Group, until_ns: int, is_in_group: bool) -> bool:
        """Return whether a pair may get more matched images up to a stamp; in the group, only from waiting images."""
        if pair.right is None:
            return not (is_in_group or pair.left.is_past(until_ns))
        slack_ns = self._tolerance_ns
        for camera, other, latest_ns in (
            (pair.left, pair.right, until_ns),
            (pair.right, pair.left, until_ns + slack_ns),
        ):
            for image in camera.waiting:
                if image.stamp_ns <= latest_ns and not other.is_past(image.stamp_ns + slack_ns):
                    return True
        return not (is_in_group or pair.left.is_past(until_ns) or pair.right.is_past(until_ns + slack_ns))

    def _give(self, begin_ns: int) -> FrameSet:
        group = self._group(begin_ns)
        for number in group:
            del self._groups[number].matched[0]
        stamp_ns = group[min(group)].stamp_ns
        following = [entry.stamp_ns for pair in self._groups for entry in pair.matched[:1]]
        following += [
            image.stamp_ns for pair in self._groups for image in pair.left.waiting if image.stamp_ns > begin_ns
        ]
        if any(each - stamp_ns <= self._tolerance_ns for each in following):
            stamp_ns = begin_ns
        self._given_ns = stamp_ns
        for pair in self._groups:
            for camera in pair.cameras:
                self._abandon(camera, [image for image in camera.waiting if self._is_too_late(pair, camera, image)])
        return FrameSet(stamp_ns, {number: entry.images for number, entry in group.items()})


@dataclass(frozen=True, slots=True, eq=False)
class _Arrived:
    """An image of one camera, and the host time of its arrival."""

    stamp_ns: int
    image: Image
    arrival_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class _Matched:
    """The images of a pair, or of a camera without a partner, and the host time of the first one's arrival."""

    stamp_ns: int
    images: tuple[Image, ...]
    arrival_ns: int


class _Camera:
    """The state of one camera.

    Attributes:
        name: name of the camera in the rig.
        stamp_offset_ns: offset that is added to its stamps.
        waiting: images whose partner has not come, by stamp.
        seen: stamps of the newest images.
        last_ns: stamp of the last image; the largest stamp would stay wrong forever if it was damaged.
        newest_ns: host time of the latest arrival.
        jumps: filter that holds back an image whose stamp is far ahead.
    """

    def __init__(self, camera: Camera, report: Report) -> None:
        self.name = name = camera.name
        self.stamp_offset_ns = camera.stamp_offset_ns
        self.waiting: list[_Arrived] = []
        self.seen: deque[int] = deque(maxlen=_REMEMBERED)
        self.last_ns: int | None = None
        self.newest_ns: int | None = None
        self.jumps: StampJumpFilter[_Arrived] = StampJumpFilter(
            EventKind.IMAGE_FUTURE_STAMP, lambda stamp_ns, kind, detail: report(stamp_ns, kind, f"{name}: {detail}")
        )

    def is_past(self, stamp_ns: int) -> bool:
        """Return whether no image up to a stamp will come any more."""
        return self.last_ns is not None and self.last_ns > stamp_ns


@dataclass(slots=True)
class _Group:
    """The cameras of a pair, or one camera without a partner, and their matched images by stamp."""

    cameras: tuple[_Camera, ...]
    matched: list[_Matched] = field(default_factory=list)

    @property
    def left(self) -> _Camera:
        return self.cameras[0]

    @property
    def right(self) -> _Camera | None:
        return self.cameras[1] if len(self.cameras) > 1 else None
