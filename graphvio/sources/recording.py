"""Lazy reading of a recording by its index: images are decoded ahead, joined to framesets and merged with the IMU."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Image
from graphvio.errors import RigError, SourceError
from graphvio.image_decoding import ImageError
from graphvio.measurements.events import EventKind
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.rig import Camera, Rig
from graphvio.sources.coverage import count_image_faults, count_imu_faults
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import ImageFiles, Index
from graphvio.sources.matching import TOLERANCE_NS, FramesetIndex, group_pairs, match_sides, of_single
from graphvio.sources.read_ahead import read_ahead
from graphvio.sources.read_ahead_process import can_fork, read_ahead_in_process
from graphvio.sources.sequencer import merge
from graphvio.sources.tables import ImuTable

_LEAD_NS = 5_000_000_000  # samples from before the first frameset help to initialise


@dataclass(frozen=True, eq=False)
class _Decoded:
    stamp_ns: int
    images: Mapping[int, tuple[Image, ...]]
    masks: Mapping[int, tuple[Image | None, ...]]
    faults: Sequence[tuple[EventKind, str]]
    decode_ms: float


class Source:
    """A recording as a stream of IMU samples and framesets in time order; may be iterated more than once.

    Arguments are those of `graphvio.sources.open_source`, and the results of `graphvio.sources.opening.read_index`.

    Attributes:
        name: name of the recording, which can also be used for a folder of results.
        rig: rig of the measurements; its IMU is None if the recording has no samples.
        faults: faults of the recording; complete once an iteration has ended, and counted again by the next one.
        frameset_count: number of framesets, of which those without usable images are not yielded.
        stamps_ns: (N,) stamps of the framesets, camera clock, increasing; offsets of cameras' stamps are corrected.
        start_ns: stamp of the first frameset.
        end_ns: stamp of the last frameset.
        truth: file, session or bag from which `load_trajectory` reads the true trajectory, or None.
        decode_ms: time that the decoding of each frameset took in its thread, milliseconds.
        decodes_in_process: whether image files are decoded in a forked process while the recording is iterated, which
            is faster, rather than in threads. False by default; to be set by programs that can safely be forked.

    Raises:
        SourceError: if no frameset is left.
    """

    def __init__(
        self,
        index: Index,
        rig: Rig,
        faults: FaultLog,
        from_s: float | None = None,
        to_s: float | None = None,
        tolerance_ns: int | None = None,
    ) -> None:
        self.name = index.name
        self.truth = index.truth
        self.faults = faults
        self.decode_ms: list[float] = []
        self.decodes_in_process = False
        self._images, self._masks = index.images, index.masks
        self._fit_cameras: set[str] = set()
        stamps_ns = {each.name: index.images[each.name].stamps_ns + each.stamp_offset_ns for each in rig.cameras}
        pairs = [match_sides(stamps_ns[pair.left.name], stamps_ns[pair.right.name], tolerance_ns) for pair in rig.pairs]
        pairs += [of_single(stamps_ns[single.name]) for single in rig.singles]
        self._framesets = _cut(
            group_pairs(pairs, TOLERANCE_NS if tolerance_ns is None else tolerance_ns), from_s, to_s, index.name
        )
        self.stamps_ns = self._framesets.stamps_ns
        self.frameset_count = len(self.stamps_ns)
        self.start_ns, self.end_ns = int(self.stamps_ns[0]), int(self.stamps_ns[-1])
        count_image_faults(rig, pairs, self._framesets, faults)
        self._imu: ImuTable | None = None
        if rig.imu is not None:
            self._imu = self._cut_imu(index.imu, rig.imu.time_offset_ns, is_whole=to_s is None)
        self.rig = rig if self._imu is not None else rig.without_imu()
        self._opened = faults.mark()

    def __iter__(self) -> Iterator[Measurement]:
        """Yield IMU samples and framesets; the sample that covers a frameset's instant comes before it.

        Raises:
            SourceError: at the end, if not one frameset could be read.
            RigError: if the first image of a camera does not have the rig's size.
        """
        self.faults.rewind(self._opened)
        self.decode_ms = []
        offset_ns = self.rig.imu.time_offset_ns if self.rig.imu else 0
        with closing(self._read_framesets()) as framesets:
            yield from merge(self._read_imu(), framesets, offset_ns)

    def frameset_at(self, stamp_ns: int) -> FrameSet:
        """Return the usable images of any one frameset; may be called from any thread.

        Raises:
            SourceError: if there is no frameset with this stamp.
        """
        at = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if at == self.frameset_count or self.stamps_ns[at] != stamp_ns:
            raise SourceError(f"{self.name}: has no frameset at {stamp_ns}; give the recording that it is from")
        sizes = [[camera.size_px for camera in group.cameras] for group in self.rig.groups]
        decoded = self._decode(at)
        fits = {
            j: images
            for j, images in decoded.images.items()
            if all(image.shape[::-1] == size for image, size in zip(images, sizes[j], strict=True))
        }
        return FrameSet(stamp_ns, fits, decoded.masks)

    def _read_imu(self) -> Iterator[ImuSample]:
        if self._imu is None:
            return
        for stamp, values in zip(self._imu.stamps_ns, self._imu.values, strict=True):
            yield ImuSample(int(stamp), values[:3].copy(), values[3:].copy())

    def _read_framesets(self) -> Generator[FrameSet, None, None]:
        is_empty = True
        with closing(self._decoded()) as decoded:
            for item in decoded:
                self.decode_ms.append(item.decode_ms)
                for kind, detail in item.faults:
                    self.faults.add(kind, item.stamp_ns, detail)
                images = self._checked(item)
                if images:
                    is_empty = False
                    yield FrameSet(item.stamp_ns, images, item.masks)
                else:
                    self.faults.add(
                        EventKind.FRAMESET_EMPTY,
                        item.stamp_ns,
                        "no pair has two usable images, and no single camera one",
                    )
        if is_empty:
            raise SourceError(
                f"{self.name}: none of its {self.frameset_count} framesets could be read ({self.faults}); "
                f"{self.faults.events[0].detail}"
            )

    def _decoded(self) -> Generator[_Decoded, None, None]:
        """Decode all framesets ahead of their use."""
        numbers = range(self.frameset_count)
        sequences = [*self._images.values(), *self._masks.values()]
        if self.decodes_in_process and can_fork() and all(isinstance(each, ImageFiles) for each in sequences):
            pixels = sum(width * height for width, height in (camera.size_px for camera in self.rig.cameras))
            return read_ahead_in_process(self._decode, numbers, pixels * (2 if self._masks else 1))
        return read_ahead(self._decode, numbers)

    def _decode(self, at: int) -> _Decoded:
        begun = time.perf_counter()
        images: dict[int, tuple[Image, ...]] = {}
        masks: dict[int, tuple[Image | None, ...]] = {}
        faults: list[tuple[EventKind, str]] = []
        for number, group in enumerate(self.rig.groups):
            if self._framesets.rows[at, number, 0] < 0:
                continue
            read = []
            for camera, row in zip(group.cameras, self._framesets.rows[at, number], strict=False):
                try:
                    read.append(self._images[camera.name].read(int(row)))
                except ImageError as fault:
                    faults.append((fault.kind, fault.detail))
            if len(read) == len(group.cameras):
                images[number] = tuple(read)
                if any(camera.name in self._masks for camera in group.cameras):
                    rows = self._framesets.rows[at, number]
                    masks[number] = tuple(
                        self._mask(camera.name, int(row), faults)
                        for camera, row in zip(group.cameras, rows, strict=False)
                    )
        decode_ms = 1e3 * (time.perf_counter() - begun)
        return _Decoded(int(self.stamps_ns[at]), images, masks, faults, decode_ms)

    def _mask(self, camera: str, row: int, faults: list[tuple[EventKind, str]]) -> Image | None:
        """Read the mask of a camera's image, which has the image's stamp; None if there is none."""
        if camera not in self._masks:
            return None
        masks, stamp_ns = self._masks[camera], int(self._images[camera].stamps_ns[row])
        at = int(np.searchsorted(masks.stamps_ns, stamp_ns))
        detail = f"{camera}: no mask has the stamp {stamp_ns} of its image"
        if at < len(masks.stamps_ns) and masks.stamps_ns[at] == stamp_ns:
            try:
                return masks.read(at)
            except ImageError as fault:
                detail = fault.detail
        faults.append((EventKind.MASK_MISSING, detail))
        return None

    def _checked(self, item: _Decoded) -> dict[int, tuple[Image, ...]]:
        """Return the images that have the rig's size."""
        good = {}
        for number, images in item.images.items():
            cameras = self.rig.groups[number].cameras
            fit = [self._fits(camera, image, item.stamp_ns) for camera, image in zip(cameras, images, strict=True)]
            if all(fit):  # `_fits` counts each one that does not
                good[number] = images
        return good

    def _fits(self, camera: Camera, image: Image, stamp_ns: int) -> bool:
        size, expected = (image.shape[1], image.shape[0]), camera.size_px
        if size == expected:
            self._fit_cameras.add(camera.name)
            return True
        detail = f"{camera.name}: image is {size[0]}x{size[1]}, the rig says {expected[0]}x{expected[1]}"
        if camera.name not in self._fit_cameras:  # no image has fitted so far: the rig is of other cameras
            raise RigError(
                f"{self.name}: {detail}; calibrate at the recording's size, or give the rig that belongs to it"
            )
        self.faults.add(EventKind.IMAGE_WRONG_SIZE, stamp_ns, f"{detail}, at stamp {stamp_ns}")
        return False

    def _cut_imu(self, table: ImuTable | None, offset_ns: int, is_whole: bool) -> ImuTable | None:
        """Return the samples around the framesets, with their faults counted; None if there are none."""
        begin, end = self.start_ns + offset_ns, self.end_ns + offset_ns
        if table is not None:
            first = int(np.searchsorted(table.stamps_ns, begin - _LEAD_NS))
            last = len(table.stamps_ns) if is_whole else int(np.searchsorted(table.stamps_ns, end)) + 1
            table = ImuTable(table.stamps_ns[first:last], table.values[first:last])
        if table is None or not len(table.stamps_ns):
            detail = "the rig has an IMU, the recording no samples of it"
            self.faults.add(EventKind.IMU_MISSING, self.start_ns, detail)
            return None
        count_imu_faults(table.stamps_ns, begin, end, self.faults)
        return table


def _cut(index: FramesetIndex, from_s: float | None, to_s: float | None, name: str) -> FramesetIndex:
    stamps = index.stamps_ns
    if not len(stamps):
        raise SourceError(
            f"{name}: no left image has a right one of the same time; check the cameras' data.csv and images"
        )
    first = 0 if from_s is None else int(np.searchsorted(stamps, int(stamps[0]) + round(from_s * 1e9)))
    end = None if to_s is None else int(stamps[0]) + round(to_s * 1e9)
    last = len(stamps) if end is None else int(np.searchsorted(stamps, end, side="right"))
    if first >= last:
        raise SourceError(
            f"{name}: no frameset lies from {from_s or 0.0} s to {'the end' if to_s is None else f'{to_s} s'}; "
            f"the recording lasts {1e-9 * float(stamps[-1] - stamps[0]):.3f} s"
        )
    return FramesetIndex(stamps[first:last], index.rows[first:last])
