"""UVC stereo cameras by Video4Linux: both images side by side from one device, or a device for each camera."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from graphvio.errors import RigError, SourceError
from graphvio.live.devices import Counts, Device, DeviceLostError, DeviceSource, HandOver
from graphvio.live.imu_readers.iio_imu import IioImu
from graphvio.live.imu_readers.serial_imu import SerialImu
from graphvio.live.source import DeviceInfo, LiveSource
from graphvio.live.sources import SourceSpec, check_options
from graphvio.live.sources.v4l2_capture import (
    FORMATS,
    Capture,
    CaptureSettings,
    GreyImage,
    OpenCapture,
    open_v4l2,
    stamp_of,
)
from graphvio.live.spec_options import choice_of, names_of, number_of, size_of
from graphvio.measurements.readings import CameraFrame, host_ns
from graphvio.rig import Camera, Rig

OPTIONS = ("layout", "size", "fps", "format", "exposure_us", "gain", "imu", "imu_baud", "imu_rate_hz")
LAYOUTS = ("side_by_side", "right_left", "separate")

_BAUD = 921_600
_NODES = Path("/sys/class/video4linux")

Part = tuple[str, slice, slice]  # a camera's name, and the rows and columns that are its image


class V4l2Camera:
    """A `Device` that delivers the images of one or of two cameras of the rig, stamped by the host's clock."""

    clock = None

    def __init__(self, path: str, parts: Sequence[Part], settings: CaptureSettings, open_capture: OpenCapture) -> None:
        self.name = path
        self._parts, self._settings, self._open_capture = tuple(parts), settings, open_capture
        self._capture: Capture | None = None
        self._counts = Counts()

    def start(self, hand_over: HandOver) -> None:
        """See `Device.start`."""
        self._capture = self._open_capture(self.name, self._settings)

    def run(self, hand_over: HandOver, stopping: threading.Event) -> None:
        """See `Device.run`. OpenCV waits for an image for 10 s at most."""
        assert self._capture is not None
        while not stopping.is_set():
            if not self._capture.grab():
                raise DeviceLostError("no image could be grabbed")
            arrival_ns = host_ns()
            stamp_ns = stamp_of(self._capture)
            if stamp_ns is None:
                self._counts.add("no_kernel_stamp")
                stamp_ns = arrival_ns
            is_there, raw = self._capture.retrieve()
            if not is_there:
                self._counts.add("no_image")
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
        stamps = "; its driver does not stamp, arrivals are used" if "no_kernel_stamp" in self._counts.totals() else ""
        return (
            f"{', '.join(name for name, _, _ in self._parts)}, {width}x{height} {self._settings.pixel_format}{stamps}"
        )

    def counts(self) -> Mapping[str, int]:
        """See `Device.counts`."""
        return self._counts.totals()


def list_devices(nodes: Path = _NODES, by_id: Path = Path("/dev/v4l/by-id")) -> Sequence[DeviceInfo]:
    """See `SourceKind.list_devices`; a camera's further nodes, for metadata, are left out."""
    paths = {link.resolve().name: str(link) for link in sorted(by_id.glob("*"))} if by_id.exists() else {}
    found = []
    for node in sorted(nodes.glob("video*"), key=lambda node: (len(node.name), node.name)):
        if (node / "index").read_text().strip() == "0":
            path = paths.get(node.name, f"/dev/{node.name}")
            found.append(DeviceInfo(f"v4l2:{path}", f"{(node / 'name').read_text().strip()} ({node.name})"))
    return found


def open_source(spec: SourceSpec, rig: Rig | None, open_capture: OpenCapture = open_v4l2) -> LiveSource:
    """See `SourceKind.open_source`."""
    check_options(spec, OPTIONS)
    paths = names_of(spec)
    if not paths:
        raise SourceError("v4l2: name the devices, such as v4l2:/dev/video0; `graphvio live --list` tells them")
    settings = CaptureSettings(
        size_px=size_of(spec, "size") or (0, 0),
        fps=number_of(spec, "fps", 1, 1000),
        pixel_format=choice_of(spec, "format", FORMATS),
        exposure_us=number_of(spec, "exposure_us", 1, 1e6),
        gain=number_of(spec, "gain", 0, 1e6),
    )
    layout = choice_of(spec, "layout", LAYOUTS) if "layout" in spec.options else None
    imu = _imu(spec)
    if rig is None:
        return DeviceSource("v4l2", [], _no_rig)
    devices: list[Device] = list(_cameras(paths, layout, settings, rig, open_capture))
    if imu is not None:
        devices.append(imu)
    return DeviceSource("v4l2", devices, partial(_checked_rig, rig, imu is not None))


def _no_rig() -> Rig:
    raise RigError(
        "v4l2: UVC cameras do not tell their calibration; give a rig file (--rig rig.yaml). Kalibr's results are "
        "read, too; where several pairs are to each other may be guessed, `graphvio calibrate` finds it"
    )


def _checked_rig(rig: Rig, has_imu: bool) -> Rig:
    if has_imu and rig.imu is None:
        raise RigError(
            f"v4l2: an IMU is asked for, but the rig {rig.name} has none; add it to the rig file, or imu=none"
        )
    return rig if has_imu else rig.without_imu()


def _cameras(
    paths: list[str], layout: str | None, settings: CaptureSettings, rig: Rig, open_capture: OpenCapture
) -> list[V4l2Camera]:
    pairs, cameras = rig.pairs, rig.cameras
    count = len(cameras) if layout == "separate" else len(pairs)
    if layout is None and len(paths) == len(cameras):
        layout, count = "separate", len(cameras)
    if len(paths) != count:
        each = "a device for each camera" if layout == "separate" else "a device for each pair, or for each camera,"
        raise SourceError(
            f"v4l2: {len(paths)} devices are named, but the rig has {len(pairs)} pairs; name {each} in the rig's order"
        )
    if layout == "separate":
        groups: list[tuple[Camera, ...]] = [(camera,) for camera in cameras]
    else:
        groups = [(p.right, p.left) if layout == "right_left" else (p.left, p.right) for p in pairs]
    found = []
    for path, group in zip(paths, groups, strict=True):
        size_px, parts = _parts(group)
        if settings.size_px not in ((0, 0), size_px):
            names = " and ".join(camera.name for camera in group)
            raise RigError(
                f"v4l2: size is {settings.size_px[0]}x{settings.size_px[1]}, but by the rig the image of {names} is "
                f"{size_px[0]}x{size_px[1]}; leave size out, or calibrate at that size"
            )
        chosen = CaptureSettings(size_px, settings.fps, settings.pixel_format, settings.exposure_us, settings.gain)
        found.append(V4l2Camera(path, parts, chosen, open_capture))
    return found


def _parts(group: Sequence[Camera]) -> tuple[tuple[int, int], list[Part]]:
    """The size of an image with these cameras side by side, and where each is."""
    parts: list[Part] = []
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
