"""A recording in files: the index of its images and samples, and their lazy reading.

Every format is brought to an `Index`; all that follows, from the matching of images to the counting of
faults, is the same for all. The index (some 100 bytes an image or sample) is all that grows with the
length of a recording.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from graphvio.arrays import Bool, Image, Int
from graphvio.errors import RigError, SourceError
from graphvio.image_decoding import ImageError, read_grey
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.rig import Camera, Rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.matching import TOLERANCE_NS, FramesetIndex, PairIndex, group_pairs, match_sides
from graphvio.sources.read_ahead import read_ahead
from graphvio.sources.sequencer import merge
from graphvio.sources.tables import ImuTable

LEAD_NS = 5_000_000_000
"""IMU samples from this long before the first frameset are yielded: they help to initialise."""
_FRAME_GAP_PERIODS = 1.5
_ABSENT_PERIODS = 0.75
_IMU_GAP_PERIODS = 5.0


class Track(Protocol):
    """Images of one camera, wherever they are."""

    @property
    def stamps_ns(self) -> Int:
        """(N,), increasing."""

    def read(self, row: int) -> Image:
        """The image of a row, from any thread.

        Raises:
            ImageError: if it is missing or damaged.
        """


@dataclass(frozen=True, eq=False)
class ImageFiles:
    """A track of files: stamps (N,), increasing, and file names in ``folder``."""

    folder: Path
    stamps_ns: Int
    names: Sequence[str]

    def read(self, row: int) -> Image:
        """The image of a row."""
        return read_grey(self.folder / self.names[row])


@dataclass(frozen=True, eq=False)
class Index:
    """What a recording holds.

    Attributes:
        name: of the recording.
        tracks: camera name -> its images.
        imu: samples, or None where there are none.
        truth: file with the true trajectory, or None.
    """

    name: str
    tracks: Mapping[str, Track]
    imu: ImuTable | None = None
    truth: Path | None = None


@dataclass(frozen=True, eq=False)
class _Decoded:
    stamp_ns: int
    images: Mapping[int, tuple[Image, Image]]
    faults: Sequence[tuple[str, str]]
    decode_ms: float


class Recording:
    """A source (`graphvio.sources.base.Source`) that reads the files of a recording lazily.

    Attributes:
        name: of the recording.
        rig: the rig to which pair indices refer; its IMU is None where the recording has no samples.
        faults: complete once an iteration has ended; a new iteration counts anew.
        stamps_ns: (N,) of the framesets.
        frameset_count: how many framesets it yields at most.
        start_ns: stamp of the first frameset.
        end_ns: stamp of the last one.
        truth: file with the true trajectory, or None.
        decode_ms: time that the decoding of each frameset took in its thread.
    """

    def __init__(
        self,
        index: Index,
        rig: Rig,
        faults: FaultLog,
        from_s: float | None = None,
        to_s: float | None = None,
        tolerance_ns: int = TOLERANCE_NS,
    ) -> None:
        """Match the images of an index, and cut it to a part of its time.

        Args:
            index: holds a track for every camera of the rig.
            rig: decides which pairs are read, and whether the IMU is.
            faults: goes on to count.
            from_s: where to begin, seconds after the first frameset.
            to_s: where to end, on the same scale.
            tolerance_ns: images whose stamps differ by no more are of one instant.

        Raises:
            SourceError: if no frameset is left.
        """
        self.name = index.name
        self.truth = index.truth
        self.faults = faults
        self.decode_ms: list[float] = []
        self._tracks = index.tracks
        self._fit_cameras: set[str] = set()
        self._tolerance_ns = tolerance_ns
        pairs = [
            match_sides(index.tracks[pair.left.name].stamps_ns, index.tracks[pair.right.name].stamps_ns, tolerance_ns)
            for pair in rig.pairs
        ]
        self._framesets = _cut(group_pairs(pairs, tolerance_ns), from_s, to_s, index.name)
        self.stamps_ns = self._framesets.stamps_ns
        self.frameset_count = len(self.stamps_ns)
        self.start_ns = int(self._framesets.stamps_ns[0])
        self.end_ns = int(self._framesets.stamps_ns[-1])
        self._count_frame_faults(rig, pairs)
        self._imu: ImuTable | None = None
        if rig.imu is not None:
            self._imu = self._cut_imu(index.imu, rig.imu.time_offset_ns, is_whole=to_s is None)
        self.rig = rig if self._imu is not None else rig.without_imu()
        self._opened = faults.mark()

    def __iter__(self) -> Iterator[Measurement]:
        """IMU samples and framesets: the sample that covers a frameset's instant comes before it.

        Raises:
            SourceError: at the end, if not one frameset could be read.
            RigError: if the first image of a camera has another size than the rig says.
        """
        self.faults.rewind(self._opened)
        self.decode_ms = []
        offset_ns = self.rig.imu.time_offset_ns if self.rig.imu else 0
        with closing(self._read_framesets()) as framesets:
            yield from merge(self._read_imu(), framesets, offset_ns)

    def frameset_at(self, stamp_ns: int) -> FrameSet:
        """One frameset, out of order: the images of it that are usable; from any thread.

        Raises:
            SourceError: if there is none of this stamp.
        """
        at = int(np.searchsorted(self._framesets.stamps_ns, stamp_ns))
        if at == self.frameset_count or self._framesets.stamps_ns[at] != stamp_ns:
            raise SourceError(f"{self.name}: has no frameset at {stamp_ns}; is it the recording that it was?")
        item = self._decode(at)
        sizes = {j: (pair.left.size_px, pair.right.size_px) for j, pair in enumerate(self.rig.pairs)}
        fits = {
            j: images
            for j, images in item.images.items()
            if all(image.shape[::-1] == size for image, size in zip(images, sizes[j], strict=True))
        }
        return FrameSet(stamp_ns, fits)

    def _read_imu(self) -> Iterator[ImuSample]:
        if self._imu is None:
            return
        for stamp, values in zip(self._imu.stamps_ns, self._imu.values, strict=True):
            yield ImuSample(int(stamp), values[:3].copy(), values[3:].copy())

    def _read_framesets(self) -> Generator[FrameSet, None, None]:
        is_empty = True
        with closing(read_ahead(self._decode, range(self.frameset_count))) as decoded:
            for item in decoded:
                self.decode_ms.append(item.decode_ms)
                for kind, detail in item.faults:
                    self.faults.add(kind, item.stamp_ns, detail)
                images = self._checked(item)
                if images:
                    is_empty = False
                    yield FrameSet(item.stamp_ns, images)
                else:
                    self.faults.add("frameset_empty", item.stamp_ns, "no pair has two usable images")
        if is_empty:
            raise SourceError(
                f"{self.name}: none of its {self.frameset_count} framesets could be read ({self.faults}); "
                f"{self.faults.events[0].detail}"
            )

    def _decode(self, at: int) -> _Decoded:
        begun = time.perf_counter()
        images: dict[int, tuple[Image, Image]] = {}
        faults: list[tuple[str, str]] = []
        for number, pair in enumerate(self.rig.pairs):
            if self._framesets.rows[at, number, 0] < 0:
                continue
            sides = []
            for camera, row in zip((pair.left, pair.right), self._framesets.rows[at, number], strict=True):
                track = self._tracks[camera.name]
                try:
                    sides.append(track.read(int(row)))
                except ImageError as fault:
                    faults.append((fault.kind, fault.detail))
            if len(sides) == 2:
                images[number] = (sides[0], sides[1])
        decode_ms = 1e3 * (time.perf_counter() - begun)
        return _Decoded(int(self._framesets.stamps_ns[at]), images, faults, decode_ms)

    def _checked(self, item: _Decoded) -> dict[int, tuple[Image, Image]]:
        """The images that have the rig's size."""
        good = {}
        for number, images in item.images.items():
            pair = self.rig.pairs[number]
            fits = [
                self._fits(camera, image, item.stamp_ns)
                for camera, image in zip((pair.left, pair.right), images, strict=True)
            ]
            if all(fits):
                good[number] = images
        return good

    def _fits(self, camera: Camera, image: Image, stamp_ns: int) -> bool:
        size, wanted = (image.shape[1], image.shape[0]), camera.size_px
        if size == wanted:
            self._fit_cameras.add(camera.name)
            return True
        says = f"{camera.name}: image is {size[0]}x{size[1]}, the rig says {wanted[0]}x{wanted[1]}"
        if camera.name not in self._fit_cameras:  # not one that fits: the rig is of other cameras
            raise RigError(
                f"{self.name}: {says}; calibrate at the recording's size, or give the rig that belongs to it"
            )
        self.faults.add("image_wrong_size", stamp_ns, f"{says}, at stamp {stamp_ns}")
        return False

    def _count_frame_faults(self, rig: Rig, pairs: Sequence[PairIndex]) -> None:
        gaps: list[tuple[int, int, str]] = []
        for number, (pair, index) in enumerate(zip(rig.pairs, pairs, strict=True)):
            for camera, other, alone in (
                (pair.left, pair.right, index.left_alone),
                (pair.right, pair.left, index.right_alone),
            ):
                alone = alone[(alone >= self.start_ns) & (alone <= self.end_ns)]
                if len(alone):
                    within = f"within {1e-6 * self._tolerance_ns:g} ms"
                    detail = f"{camera.name} has an image at {alone[0]}, {other.name} has none {within}"
                    self.faults.add("unpaired_image", int(alone[0]), detail, len(alone))
            absent = self._framesets.stamps_ns[self._framesets.rows[:, number, 0] < 0]
            absent = absent[_far_from(absent, index.stamps_ns, _ABSENT_PERIODS)]  # not: triggered at another time
            if len(absent):
                detail = f"{pair.name} has no images at {absent[0]}, another pair has"
                self.faults.add("frameset_incomplete", int(absent[0]), detail, len(absent))
            inside = (index.stamps_ns >= self.start_ns) & (index.stamps_ns <= self.end_ns)
            for begin, end in _gaps(index.stamps_ns[inside], _FRAME_GAP_PERIODS):
                gaps.append((begin, end, f"{pair.name} has no images for {_ms(end - begin)} after {begin}"))
        last_end = self.start_ns
        for begin, end, detail in sorted(gaps):
            if begin >= last_end:  # a gap that several pairs share counts once
                self.faults.add("frame_gap", begin, detail)
            last_end = max(last_end, end)

    def _cut_imu(self, table: ImuTable | None, offset_ns: int, is_whole: bool) -> ImuTable | None:
        """The samples around the framesets, with their gaps counted; None where there are none."""
        begin, end = self.start_ns + offset_ns, self.end_ns + offset_ns
        if table is not None:
            first = int(np.searchsorted(table.stamps_ns, begin - LEAD_NS))
            last = len(table.stamps_ns) if is_whole else int(np.searchsorted(table.stamps_ns, end)) + 1
            table = table.slice(first, last)
        if table is None or not len(table.stamps_ns):
            self.faults.add("imu_missing", self.start_ns, "the rig has an IMU, the recording no samples of it")
            return None
        stamps = table.stamps_ns
        period = int(np.median(np.diff(stamps))) if len(stamps) > 1 else 0
        if stamps[0] > begin + period:
            detail = f"the first sample comes {_ms(int(stamps[0]) - begin)} after the first frameset"
            self.faults.add("imu_starts_late", int(stamps[0]), detail)
        if stamps[-1] < end - period:
            detail = f"the last sample comes {_ms(end - int(stamps[-1]))} before the last frameset"
            self.faults.add("imu_stops_early", int(stamps[-1]), detail)
        for before, after in _gaps(stamps, _IMU_GAP_PERIODS):
            self.faults.add("imu_gap", before, f"no samples for {_ms(after - before)} after {before}")
        return table


def _cut(index: FramesetIndex, from_s: float | None, to_s: float | None, name: str) -> FramesetIndex:
    stamps = index.stamps_ns
    if not len(stamps):
        raise SourceError(
            f"{name}: no left image has a right one of the same time; check the cameras' data.csv and images"
        )
    begin = None if from_s is None else int(stamps[0]) + round(from_s * 1e9)
    end = None if to_s is None else int(stamps[0]) + round(to_s * 1e9)
    first = 0 if begin is None else int(np.searchsorted(stamps, begin))
    last = len(stamps) if end is None else int(np.searchsorted(stamps, end, side="right"))
    if first >= last:
        raise SourceError(
            f"{name}: no frameset lies from {from_s or 0.0} s to {to_s if to_s is not None else 'the end'}; "
            f"the recording lasts {1e-9 * float(stamps[-1] - stamps[0]):.3f} s"
        )
    return index.slice(first, last)


def _gaps(stamps_ns: Int, periods: float) -> list[tuple[int, int]]:
    """Stamps before and after each gap of more than so many median periods."""
    steps = np.diff(stamps_ns)
    if not len(steps):
        return []
    wide = np.flatnonzero(steps > periods * np.median(steps))
    return [(int(stamps_ns[i]), int(stamps_ns[i + 1])) for i in wide]


def _far_from(stamps_ns: Int, own_ns: Int, periods: float) -> Bool:
    """Which stamps (N,) lie further than so many median periods from all of a pair's own (M,), which increase."""
    if len(own_ns) < 2:
        return ~np.isin(stamps_ns, own_ns)
    after = np.clip(np.searchsorted(own_ns, stamps_ns), 1, len(own_ns) - 1)
    nearest = np.minimum(np.abs(stamps_ns - own_ns[after - 1]), np.abs(own_ns[after] - stamps_ns))
    return np.asarray(nearest > periods * np.median(np.diff(own_ns)))


def _ms(duration_ns: int) -> str:
    return f"{1e-6 * duration_ns:.0f} ms"
