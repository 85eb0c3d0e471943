"""Luxonis OAK cameras with a stereo pair of grey cameras: OAK-D and its kin, by DepthAI 3."""

from __future__ import annotations

import os
from collections.abc import Sequence
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
from graphvio.live.sources.oak_device import Connect, DepthAiConnection, OakDevice, StreamSettings
from graphvio.live.spec_options import choice_of, names_of, number_of, size_of
from graphvio.rig import Rig

OPTIONS = ("size", "fps", "imu_hz", "exposure_us", "iso", "imu", "lens", "places")

_SIZE_PX = (640, 400)
_FPS = 30
_IMU_HZ = 200
_ISO = 400


def list_devices() -> Sequence[DeviceInfo]:
    """See `SourceKind.list_devices`."""
    found = _library().Device.getAllAvailableDevices()
    return [
        DeviceInfo(f"oak:{each.getDeviceId()}", f"OAK at {each.name}, {each.platform.name}, {each.state.name}")
        for each in found
    ]


def open_source(spec: SourceSpec, rig: Rig | None, connect: Connect = DepthAiConnection) -> LiveSource:
    """See `SourceKind.open_source`."""
    _library()
    check_options(spec, OPTIONS)
    has_imu = choice_of(spec, "imu", ("first", "none")) == "first" and (rig is None or rig.imu is not None)
    is_guessed = choice_of(spec, "places", ("known", "guess")) == "guess"
    exposure_us, iso = number_of(spec, "exposure_us", 1, 33_000), number_of(spec, "iso", 100, 1600)
    if iso is not None and exposure_us is None:
        raise SourceError("oak: iso= counts with exposure_us= only; give both, or none for automatic exposure")
    settings = StreamSettings(
        size_px=size_of(spec, "size") or (rig.pairs[0].left.size_px if rig is not None else _SIZE_PX),
        fps=number_of(spec, "fps", 1, 240) or _FPS,
        imu_hz=round(number_of(spec, "imu_hz", 1, 1000) or _IMU_HZ),
        exposure_us=None if exposure_us is None else round(exposure_us),
        iso=round(iso or _ISO),
        is_lens_fitted=choice_of(spec, "lens", ("fitted", "raw")) == "fitted",
        is_imu_guessed=is_guessed,
    )
    ids = names_of(spec) or [_only_id()]
    check_one_for_each_pair("oak", ids, rig, "id")
    name = f"oak-{'-'.join(ids)}"
    if rig is None and len(ids) > 1 and not is_guessed:
        return DeviceSource(name, [], partial(refuse_unknown_places, "oak", ids))
    devices = []
    for k, device_id in enumerate(ids):
        own = settings if has_imu and k == 0 else replace(settings, imu_hz=None)
        devices.append(OakDevice(device_id, camera_names(rig, k), own, connect))
    if rig is not None:
        return DeviceSource(name, devices, partial(checked_rig, rig, settings.size_px, has_imu, "oak"))
    return DeviceSource(name, devices, partial(_factory_rig, devices, name))


def _factory_rig(devices: Sequence[OakDevice], name: str) -> Rig:
    return guessed_rig([device.factory_rig() for device in devices], name)


def _only_id() -> str:
    ids = [each.spec.partition(":")[2] for each in list_devices()]
    if len(ids) == 1:
        return ids[0]
    if not ids:
        raise SourceError("oak: no camera is connected; check the cable and the udev rules")
    raise SourceError(f"oak: {len(ids)} cameras are connected; name those to use: oak:{','.join(ids)}")


def _library() -> Any:
    os.environ.setdefault("DEPTHAI_LEVEL", "error")  # it warns of what is nobody's concern where no camera is
    try:
        import depthai
    except ImportError:
        raise MissingExtraError("depthai", "oak", "an OAK camera") from None
    return depthai
