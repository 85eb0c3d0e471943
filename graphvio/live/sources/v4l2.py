"""Live source of UVC stereo cameras by Video4Linux: both images side by side from one device, or a device per camera.

Images are passed on as the driver delivers them, and converted when they are decoded. In OpenCV's back-end
(``modules/videoio/src/cap_v4l.cpp``), ``CAP_PROP_POS_MSEC`` is the time stamp of the buffer that was grabbed last;
exposures are in units of 100 us; 1 is manual and 3 is automatic exposure; without ``CAP_PROP_CONVERT_RGB``, a JPEG is a
row of bytes and YUYV has two channels.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Image
from graphvio.errors import RigError, SourceError
from graphvio.live.device_clock import host_ns_of_monotonic, host_ns_of_realtime
from graphvio.live.devices import Counts, Device, DeviceLostError, DeviceSource, HandOver
from graphvio.live.imu_readers.iio_imu import IioImu
from graphvio.live.imu_readers.serial_imu import SerialImu
from graphvio.live.source import DeviceInfo, LiveSource
from graphvio.live.sources import SourceSpec, check_options
from graphvio.live.sources.spec_options import choice_of, names_of, number_of, size_of
from graphvio.measurements.readings import CameraFrame, host_ns
from graphvio.rig import Camera, Rig

_OPTIONS = ("layout", "size", "fps", "format", "exposure_us", "gain", "imu", "imu_baud", "imu_rate_hz")
_LAYOUTS = ("side_by_side", "right_left", "separate")
_FORMATS = ("MJPG", "YUYV", "UYVY", "GREY")

_BAUD = 921_600
_NODES = Path("/sys/class/video4linux")
_BY_ID = Path("/dev/v4l/by-id")
_MANUAL, _AUTOMATIC = 1, 3
_BUFFERS = 4
_MAX_AGE_NS = 5_000_000_000
_END_OF_JPEG = b"\xff\xd9"

_Part = tuple[str, slice, slice]  # a camera's name, and the rows and columns of its image


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of a video device."""

    size_px: tuple[int, int]  # (width, height) of the whole image, of both cameras where they are side by side
    fps: float | None = None  # images a second, or None for the driver's choice
    pixel_format: str = "MJPG"  # ``MJPG``, ``YUYV``, ``UYVY`` or ``GREY``
    exposure_us: float | None = None  # exposure time, or None for automatic exposure
    gain: float | None = None  # in the driver's units, or None


class Capture(Protocol):
    """The methods of `cv2.VideoCapture` that are used while it runs."""

    def grab(self) -> bool:
        """Wait for the next image."""

    def retrieve(self) -> tuple[bool, AnyArray]:
        """Return the image that was grabbed, a new array each time."""

    def get(self, propId: int) -> float:
        """Return a property."""

    def release(self) -> None:
        """Release the device."""


class Adjustable(Protocol):
    """The methods of `cv2.VideoCapture` that set it up."""

    def get(self, propId: int) -> float:
        """Return a property."""

    def set(self, propId: int, value: float) -> bool:
        """Set a property; returns whether that succeeded."""


OpenCapture = Callable[[str, CaptureSettings], Capture]


def open_v4l2(path: str, settings: CaptureSettings) -> Capture:
    """Open a device and set it up.

    Raises:
        SourceError: if it is missing, in use, or refuses a setting.
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
    """Apply settings to a capture.

    Raises:
        SourceError: if the driver refuses or changes one.
    """
    # The format comes first, as sizes and rates depend on it.
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
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _AUTOMATIC)  # a camera that refuses has a fixed exposure
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
    """Return the stamp, as of `host_ns`, of the image grabbed last; None if it is not by one of the host's clocks.

    Drivers stamp by ``CLOCK_MONOTONIC`` or, with uvcvideo's parameter ``clock``, by ``CLOCK_REALTIME``; the clock whose
    time is near the stamp is assumed.
    """
    stamp_ns = round(1e6 * capture.get(cv2.CAP_PROP_POS_MSEC))
    if abs(stamp_ns - time.monotonic_ns()) < _MAX_AGE_NS:
        return host_ns_of_monotonic(stamp_ns)
    if abs(stamp_ns - time.time_ns()) < _MAX_AGE_NS:
        return host_ns_of_realtime(stamp_ns)
    return None


class GreyImage:
    """An image as the driver delivered it, converted to grey once for all its parts; usable from any thread."""

    def __init__(self, raw: AnyArray, pixel_format: str, size_px: tuple[int, int], where: str) -> None:
        self._raw: AnyArray | None = raw
        self._format, self._size_px, self._where = pixel_format, size_px, where
        self._lock = threading.Lock()
        self._grey: Image | None = None
        self._damage: str | None = None

    def part(self, rows: slice, columns: slice) -> Image:
        """Return a part of the image, as a contiguous copy.

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
        # libjpeg decodes truncated data, too: check the end marker.
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


class V4l2Camera:
    """A `Device` with the images of one or two cameras of the rig, stamped by the host's clock."""

    clock = None

    def __init__(self, path: str, parts: Sequence[_Part], settings: CaptureSettings, open_capture: OpenCapture) -> None:
        self.name = path
        self._parts, self._settings, self._open_capture = tuple(parts), settings, open_capture
        self._capture: Capture | None = None
        self.counts = Counts()

    def start(self, hand_over: HandOver) -> None:
        """See `Device.start`."""
        self._capture = self._open_capture(self.name, self._settings)

    def run(self, hand_over: HandOver, stopping: threading.Event) -> None:
        """See `Device.run`; OpenCV waits for an image for 10 s at most."""
        assert self._capture is not None
        while not stopping.is_set():
            if not self._capture.grab():
                raise DeviceLostError("no image could be grabbed")
            arrival_ns = host_ns()
            stamp_ns = stamp_of(self._capture)
            if stamp_ns is None:
                self.counts.add("no_kernel_stamp")
                stamp_ns = arrival_ns
            is_there, raw = self._capture.retrieve()
            if not is_there:
                self.counts.add("no_image")
                continue
            image = GreyImage(raw, self._settings.pixel_format, self._settings.size_px, self.name)
            for camera, rows, columns in self._parts:
                hand_over(CameraFrame(camera, stamp_ns, partial(image.part, rows, columns), arrival_ns))

    def stop(self) -> None:
        """See `Device.stop`."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def detail(self) -> str:
        """See `Device.detail`."""
        width, height = self._settings.size_px
        stamps = "; its driver does not stamp, arrivals are used" if "no_kernel_stamp" in self.counts.totals() else ""
        return (
            f"{', '.join(name for name, _, _ in self._parts)}, {width}x{height} {self._settings.pixel_format}{stamps}"
        )


def list_devices(nodes: Path = _NODES, by_id: Path = _BY_ID) -> Sequence[DeviceInfo]:
    """See `SourceKind.list_devices`; nodes for metadata are left out."""
    paths = {link.resolve().name: str(link) for link in sorted(by_id.glob("*"))} if by_id.exists() else {}
    found = []
    for node in sorted(nodes.glob("video*"), key=lambda node: (len(node.name), node.name)):
        if (node / "index").read_text().strip() == "0":
            path = paths.get(node.name, f"/dev/{node.name}")
            found.append(DeviceInfo(f"v4l2:{path}", f"{(node / 'name').read_text().strip()} ({node.name})"))
    return found


def open_source(spec: SourceSpec, rig: Rig | None, open_capture: OpenCapture = open_v4l2) -> LiveSource:
    """See `SourceKind.open_source`."""
    check_options(spec, _OPTIONS)
    paths = names_of(spec)
    if not paths:
        raise SourceError("v4l2: name the devices, such as v4l2:/dev/video0; `graphvio live --list` lists them")
    settings = CaptureSettings(
        size_px=size_of(spec, "size") or (0, 0),
        fps=number_of(spec, "fps", 1, 1000),
        pixel_format=choice_of(spec, "format", _FORMATS),
        exposure_us=number_of(spec, "exposure_us", 1, 1e6),
        gain=number_of(spec, "gain", 0, 1e6),
    )
    layout = choice_of(spec, "layout", _LAYOUTS) if "layout" in spec.options else None
    imu = _imu(spec)
    if rig is None:
        return DeviceSource("v4l2", [], _no_rig)
    devices: list[Device] = list(_cameras(paths, layout, settings, rig, open_capture))
    if imu is not None:
        devices.append(imu)
    return DeviceSource("v4l2", devices, partial(_checked_rig, rig, imu is not None))


def _no_rig() -> Rig:
    raise RigError(
        "v4l2: UVC cameras have no factory calibration; give a rig file (--rig rig.yaml), such as Kalibr's results; "
        "the transforms between several pairs may be guessed, as `graphvio calibrate` estimates them"
    )


def _checked_rig(rig: Rig, has_imu: bool) -> Rig:
    if has_imu and rig.imu is None:
        raise RigError(f"v4l2: imu= is given, but the rig {rig.name} has none; add it to the rig file, or imu=none")
    return rig if has_imu else rig.without_imu()


def _cameras(
    paths: list[str], layout: str | None, settings: CaptureSettings, rig: Rig, open_capture: OpenCapture
) -> list[V4l2Camera]:
    cameras = rig.cameras
    count = len(cameras) if layout == "separate" else len(rig.groups)
    if layout is None and len(paths) == len(cameras):
        layout, count = "separate", len(cameras)
    if len(paths) != count:
        each = "a device for each camera" if layout == "separate" else "a device for each pair, or for each camera,"
        has = f"{len(rig.pairs)} pairs" + (f" and {len(rig.singles)} single cameras" if rig.singles else "")
        raise SourceError(
            f"v4l2: {len(paths)} devices are named, but the rig has {has}; name {each} in the rig's order"
        )
    if layout == "separate":
        groups: list[tuple[Camera, ...]] = [(camera,) for camera in cameras]
    else:
        groups = [each.cameras[::-1] if layout == "right_left" else each.cameras for each in rig.groups]
    found = []
    for path, group in zip(paths, groups, strict=True):
        size_px, parts = _parts(group)
        if settings.size_px not in ((0, 0), size_px):
            names = " and ".join(camera.name for camera in group)
            raise RigError(
                f"v4l2: size is {settings.size_px[0]}x{settings.size_px[1]}, but by the rig the image of {names} is "
                f"{size_px[0]}x{size_px[1]}; leave size out, or calibrate at that size"
            )
        found.append(V4l2Camera(path, parts, replace(settings, size_px=size_px), open_capture))
    return found


def _parts(group: Sequence[Camera]) -> tuple[tuple[int, int], list[_Part]]:
    """Return the size of an image with these cameras side by side, and each camera's part of it."""
    parts: list[_Part] = []
    left = 0
    for camera in group:
        width, height = camera.size_px
        parts.append((camera.name, slice(0, height), slice(left, left + width)))
        left += width
    heights = {camera.size_px[1] for camera in group}
    if len(heights) > 1:
        raise RigError(f"v4l2: {group[0].name} and {group[1].name} have images of different height side by side")
    return (left, heights.pop()), parts


def _imu(spec: SourceSpec) -> Device | None:
    text = spec.options.get("imu", "none")
    baud = number_of(spec, "imu_baud", 1200, 10_000_000)
    rate_hz = number_of(spec, "imu_rate_hz", 1, 10_000)
    kind, _, what = text.partition(":")
    if (kind, what) == ("none", ""):
        return None
    if kind == "serial" and what and rate_hz is None:
        return SerialImu(what, int(baud or _BAUD))
    names = what.split("+")
    if kind == "iio" and all(names) and len(names) <= 2 and baud is None:
        return IioImu(names, rate_hz)
    raise SourceError(
        f"v4l2: imu is {text!r}; write imu=serial:/dev/ttyACM0 (with imu_baud=), imu=iio:NAME or imu=iio:GYRO+ACCEL "
        "(with imu_rate_hz=), or imu=none"
    )
