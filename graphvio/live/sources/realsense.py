"""Intel RealSense cameras of the D400 series: infrared stereo pairs with a global shutter, and their IMU."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

from graphvio.errors import MissingExtraError, SourceError
from graphvio.live.devices import DeviceSource
from graphvio.live.factory_rigs import (
    camera_names,
    check_one_for_each_pair,
    checked_rig,
    guessed_rig,
    refuse_unknown_places,
)
from graphvio.live.source import DeviceInfo, LiveSource
from graphvio.live.sources import SourceSpec, check_options
from graphvio.live.sources.realsense_device import Bus, RealSenseDevice, StreamSettings
from graphvio.live.spec_options import choice_of, names_of, number_of, size_of
from graphvio.rig import Rig

OPTIONS = ("size", "fps", "gyro_hz", "accel_hz", "exposure_us", "gain", "imu", "sync", "places")

_SIZE_PX = (848, 480)
_FPS = 30
_GYRO_HZ = 200
_ACCEL_HZ = 100


class ContextBus:
    """Cameras that librealsense finds."""

    def __init__(self) -> None:
        import pyrealsense2 as rs

        self._rs = rs
        self._context = rs.context()
        self._lock = threading.Lock()
        self._watched: list[tuple[Any, Callable[[], None]]] = []
        self._context.set_devices_changed_callback(self._on_change)

    def devices(self) -> dict[str, Any]:
        """All cameras, by serial number."""
        found, key = {}, self._rs.camera_info.serial_number
        for device in self._context.query_devices():
            with suppress(RuntimeError):  # one that is being pulled out
                found[str(device.get_info(key))] = device
        return found

    def serials(self) -> list[str]:
        """See `Bus.serials`."""
        return list(self.devices())

    def find(self, serial: str) -> Any | None:
        """See `Bus.find`."""
        return self.devices().get(serial)

    def watch(self, device: Any, on_removed: Callable[[], None]) -> None:
        """See `Bus.watch`."""
        with self._lock:
            self._watched.append((device, on_removed))

    def _on_change(self, event: Any) -> None:
        with self._lock:
            gone = [each for each in self._watched if event.was_removed(each[0])]
            self._watched = [each for each in self._watched if each not in gone]
        for _, on_removed in gone:
            on_removed()


def list_devices() -> Sequence[DeviceInfo]:
    """See `SourceKind.list_devices`."""
    rs = _library()
    found = []
    for serial, device in ContextBus().devices().items():
        with suppress(RuntimeError):
            found.append(DeviceInfo(f"realsense:{serial}", device.get_info(rs.camera_info.name)))
    return found


def open_source(spec: SourceSpec, rig: Rig | None, bus: Bus | None = None) -> LiveSource:
    """See `SourceKind.open_source`."""
    _library()
    check_options(spec, OPTIONS)
    has_imu = choice_of(spec, "imu", ("first", "none")) == "first" and (rig is None or rig.imu is not None)
    is_synchronised = choice_of(spec, "sync", ("none", "hardware")) == "hardware"
    is_guessed = choice_of(spec, "places", ("known", "guess")) == "guess"
    settings = StreamSettings(
        size_px=size_of(spec, "size") or (rig.pairs[0].left.size_px if rig is not None else _SIZE_PX),
        fps=round(number_of(spec, "fps", 1, 300) or _FPS),
        gyro_hz=round(number_of(spec, "gyro_hz", 1, 2000) or _GYRO_HZ),
        accel_hz=round(number_of(spec, "accel_hz", 1, 2000) or _ACCEL_HZ),
        exposure_us=number_of(spec, "exposure_us", 1, 200_000),
        gain=number_of(spec, "gain", 0, 1000),
    )
    serials = names_of(spec)
    bus = bus or ContextBus()
    if not serials:
        serials = [_only_serial(bus)]
    check_one_for_each_pair("realsense", serials, rig, "serial number")
    name = f"realsense-{'-'.join(serials)}"
    if rig is None and len(serials) > 1 and not is_guessed:
        return DeviceSource(name, [], partial(refuse_unknown_places, "realsense", serials))
    devices = []
    for k, serial in enumerate(serials):
        own = replace(
            settings,
            gyro_hz=settings.gyro_hz if has_imu and k == 0 else None,
            sync=("slave" if k else "master") if is_synchronised else "none",
        )
        devices.append(RealSenseDevice(serial, camera_names(rig, k), own, bus))
    if rig is not None:
        return DeviceSource(name, devices, partial(checked_rig, rig, settings.size_px, has_imu, "realsense"))
    return DeviceSource(name, devices, partial(_factory_rig, devices, name))


def _factory_rig(devices: Sequence[RealSenseDevice], name: str) -> Rig:
    return guessed_rig([device.factory_rig() for device in devices], name)


def _only_serial(bus: Bus) -> str:
    serials = bus.serials()
    if len(serials) == 1:
        return serials[0]
    if not serials:
        raise SourceError("realsense: no camera is connected; check the cable (USB 3) and the udev rules")
    raise SourceError(
        f"realsense: {len(serials)} cameras are connected; name those to use: realsense:{','.join(serials)}"
    )


def _library() -> Any:
    try:
        import pyrealsense2
    except ImportError:
        raise MissingExtraError("pyrealsense2", "realsense", "a RealSense camera") from None
    return pyrealsense2
