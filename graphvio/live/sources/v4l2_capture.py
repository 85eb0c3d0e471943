"""Images of a V4L2 device, by OpenCV, as the driver delivers them: nothing is converted where it is grabbed.

What is said here of OpenCV's back-end is from its source (``modules/videoio/src/cap_v4l.cpp``): ``CAP_PROP_POS_MSEC``
is the time stamp of the buffer that was grabbed last; exposures are counted in 100 us; 1 is manual and 3 is automatic
exposure; without ``CAP_PROP_CONVERT_RGB``, a JPEG comes as a row of bytes and YUYV with two channels.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Image
from graphvio.errors import SourceError
from graphvio.live.device_clock import host_ns_of_monotonic, host_ns_of_realtime

FORMATS = ("MJPG", "YUYV", "UYVY", "GREY")

_MANUAL, _AUTOMATIC = 1, 3
_BUFFERS = 4
_MOST_APART_NS = 5_000_000_000
_END_OF_JPEG = b"\xff\xd9"


@dataclass(frozen=True)
class CaptureSettings:
    """How a device is to deliver.

    Attributes:
        size_px: (width, height) of the whole image, of both cameras where they are side by side.
        fps: images a second, or None for the driver's choice.
        pixel_format: one of `FORMATS`.
        exposure_us: time of exposure, or None for automatic exposure.
        gain: in the driver's units, or None.
    """

    size_px: tuple[int, int]
    fps: float | None = None
    pixel_format: str = "MJPG"
    exposure_us: float | None = None
    gain: float | None = None


class Capture(Protocol):
    """What is needed of `cv2.VideoCapture`."""

    def grab(self) -> bool:
        """Wait for the next image."""

    def retrieve(self) -> tuple[bool, AnyArray]:
        """The image that was grabbed, a new array each time."""

    def get(self, propId: int) -> float:
        """A property."""

    def release(self) -> None:
        """Let go."""


class Adjustable(Protocol):
    """What is needed of `cv2.VideoCapture` before the first image."""

    def get(self, propId: int) -> float:
        """A property."""

    def set(self, propId: int, value: float) -> bool:
        """Set a property; returns whether that was possible."""


OpenCapture = Callable[[str, CaptureSettings], Capture]


def open_v4l2(path: str, settings: CaptureSettings) -> Capture:
    """Open a device and set it up.

    Raises:
        SourceError: if it is not there, is in use, or does not do what is asked for.
    """
    if not Path(path).exists():
        raise SourceError(f"{path}: is not there; check the cable, and `graphvio live --list`")
    capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
    if not capture.isOpened():
        raise SourceError(
            f"{path}: cannot be opened for images; check that no other program uses it, that you are in the group "
            "'video', and that it is no node for metadata (cameras have two nodes; take the first)"
        )
    try:
        set_up(capture, path, settings)
    except SourceError:
        capture.release()
        raise
    return capture


def set_up(capture: Adjustable, path: str, settings: CaptureSettings) -> None:
    """Set a capture up.

    Raises:
        SourceError: if it does not do what is asked for.
    """
    # The format comes first, as it decides which sizes and rates there are.
    fourcc = _fourcc(settings.pixel_format)
    capture.set(cv2.CAP_PROP_FOURCC, fourcc)
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, settings.size_px[0])
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.size_px[1])
    capture.set(cv2.CAP_PROP_BUFFERSIZE, _BUFFERS)
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    if settings.fps is not None:
        capture.set(cv2.CAP_PROP_FPS, settings.fps)
    _expect(capture.get(cv2.CAP_PROP_FOURCC) == fourcc, path, f"does not deliver {settings.pixel_format}", "format=")
    size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    asked = f"{settings.size_px[0]}x{settings.size_px[1]}"
    _expect(size == settings.size_px, path, f"delivers {size[0]}x{size[1]}, not {asked}", "size= and the rig")
    if settings.fps is not None:
        fps = capture.get(cv2.CAP_PROP_FPS)
        _expect(abs(fps - settings.fps) < 0.5, path, f"delivers {fps:g} images a second at this size", "fps=")
    if settings.exposure_us is None:
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _AUTOMATIC)  # a camera that cannot has one exposure only
    else:
        is_set = capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)
        is_set &= capture.set(cv2.CAP_PROP_EXPOSURE, max(round(settings.exposure_us / 100.0), 1))
        _expect(is_set, path, "does not let its exposure be set", "exposure_us=")
    if settings.gain is not None:
        _expect(capture.set(cv2.CAP_PROP_GAIN, settings.gain), path, "does not let its gain be set", "gain=")


def _expect(is_so: bool, path: str, what: str, option: str) -> None:
    if not is_so:
        raise SourceError(f"{path}: {what}; change {option} to what `v4l2-ctl --list-formats-ext -d {path}` lists")


def _fourcc(text: str) -> int:
    return int.from_bytes(text.encode(), "little")


def stamp_of(capture: Capture) -> int | None:
    """`host_ns` of the image that was grabbed last, or None if the driver's stamp is by no clock of the host.

    The kernel's own cameras stamp by ``CLOCK_MONOTONIC``; some drivers, and uvcvideo's parameter ``clock``, by
    ``CLOCK_REALTIME``. Which it is, is told by what is near.
    """
    stamp_ns = round(1e6 * capture.get(cv2.CAP_PROP_POS_MSEC))
    if abs(stamp_ns - time.monotonic_ns()) < _MOST_APART_NS:
        return host_ns_of_monotonic(stamp_ns)
    if abs(stamp_ns - time.time_ns()) < _MOST_APART_NS:
        return host_ns_of_realtime(stamp_ns)
    return None


class GreyImage:
    """An image as the driver delivered it, made grey once for all who want a part of it; from any thread."""

    def __init__(self, raw: AnyArray, pixel_format: str, size_px: tuple[int, int], where: str) -> None:
        self._raw: AnyArray | None = raw
        self._format, self._size_px, self._where = pixel_format, size_px, where
        self._lock = threading.Lock()
        self._grey: Image | None = None
        self._damage: str | None = None

    def part(self, rows: slice, columns: slice) -> Image:
        """A part of it, as an array of its own.

        Raises:
            SourceError: if the image is damaged.
        """
        with self._lock:
            if self._raw is not None:
                raw, self._raw = self._raw, None
                try:
                    self._grey = self._decoded(raw)
                except SourceError as error:
                    self._damage = str(error)
            if self._grey is None:
                raise SourceError(self._damage)
            return np.ascontiguousarray(self._grey[rows, columns])

    def _decoded(self, raw: AnyArray) -> Image:
        grey = self._jpeg(raw) if self._format == "MJPG" else self._luminance(raw)
        width, height = self._size_px
        if grey.shape != (height, width):
            raise SourceError(f"{self._where}: an image of {grey.shape[1]}x{grey.shape[0]} came, not {width}x{height}")
        return grey

    def _jpeg(self, raw: AnyArray) -> Image:
        # libjpeg makes an image of a half one, too; only the marker at its end tells.
        if bytes(raw.ravel()).rfind(_END_OF_JPEG) < 0:
            raise SourceError(f"{self._where}: a JPEG is cut short")
        grey = cv2.imdecode(raw.ravel(), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            raise SourceError(f"{self._where}: a JPEG cannot be decoded")
        return grey.astype(np.uint8, copy=False)

    def _luminance(self, raw: AnyArray) -> Image:
        width, height = self._size_px
        channels = 1 if self._format == "GREY" else 2
        if raw.size != width * height * channels:
            raise SourceError(f"{self._where}: {raw.size} bytes came, not {width * height * channels}")
        pixels = raw.reshape(height, width, channels)
        return np.asarray(pixels[:, :, 1 if self._format == "UYVY" else 0], np.uint8)
