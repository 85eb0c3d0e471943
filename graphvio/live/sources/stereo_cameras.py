"""Common parts of stereo cameras with a factory calibration: monitoring, opening, and the rig of one or several."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from graphvio.errors import RigError, SourceError
from graphvio.live.devices import Counts, DeviceLostError, DeviceSource, HandOver
from graphvio.live.imu_merging import AccelOntoGyro
from graphvio.live.sources import SourceSpec
from graphvio.live.sources.spec_options import choice_of, names_of
from graphvio.measurements.readings import host_ns
from graphvio.rig import Rig
from graphvio.rig_files import joined_rig

_POLL_S = 0.1
_MAX_SILENCE_NS = 5_000_000_000


class StereoCamera(ABC):
    """Base class of a `Device` whose library's threads hand readings over, while its own thread monitors them.

    Args:
        kind: kind of source.
        device_id: identifier of the camera, which is also the name of its clock.
        cameras: names of the left and the right camera in the rig.
    """

    def __init__(self, kind: str, device_id: str, cameras: tuple[str, str]) -> None:
        self.name = f"{kind}:{device_id}"
        self.clock = device_id
        self._cameras = cameras
        self.counts = Counts()
        self._numbers: dict[int, int] = {}  # sequence number of the newest image of each side
        self._newest_ns = 0
        self._merging: AccelOntoGyro | None = None
        self._factory_rig: Rig | RigError = RigError(f"{self.name}: was not started")

    def run(self, hand_over: HandOver, stopping: threading.Event) -> None:
        """See `Device.run`."""
        self._newest_ns = host_ns()
        while not stopping.wait(_POLL_S):
            if self._is_gone():
                raise DeviceLostError("unplugged, or it has crashed")
            if host_ns() - self._newest_ns > _MAX_SILENCE_NS:
                raise DeviceLostError("no image for 5 s")

    def factory_rig(self) -> Rig:
        """Return the factory's calibration of the camera, once it is started.

        Raises:
            RigError: if the calibration is not usable as a rig.
        """
        if isinstance(self._factory_rig, RigError):
            raise self._factory_rig
        return self._factory_rig

    @abstractmethod
    def start(self, hand_over: HandOver) -> None:
        """See `Device.start`."""

    @abstractmethod
    def stop(self) -> None:
        """See `Device.stop`."""

    @abstractmethod
    def detail(self) -> str:
        """See `Device.detail`."""

    @abstractmethod
    def _is_gone(self) -> bool:
        """Return whether the library reports the loss of the camera."""

    def _reset(self, hand_over: HandOver) -> None:
        self._numbers = {}
        self._merging = AccelOntoGyro(hand_over, self.counts)

    def _calibrate(self, read: Callable[[], Rig]) -> None:
        """Read the factory's calibration; an error matters only if no rig is given."""
        try:
            self._factory_rig = read()
        except RigError as error:
            self._factory_rig = error

    def _guarded(self, on_message: Callable[[Any], None], kind: str) -> Callable[[Any], None]:
        """Wrap a callback to count its errors, as an exception in the library's thread would end the process."""

        def guarded(message: Any) -> None:
            try:
                on_message(message)
            except Exception:
                self.counts.add(kind)

        return guarded

    def _count_lost(self, side: int, number: int) -> None:
        self.counts.add("frames_lost", max(number - self._numbers.get(side, number - 1) - 1, 0))
        self._numbers[side] = number


def has_imu(spec: SourceSpec, rig: Rig | None) -> bool:
    """Return whether the first camera's IMU is read, which depends on the option ``imu`` and the rig."""
    return choice_of(spec, "imu", ("first", "none")) == "first" and (rig is None or rig.imu is not None)


def is_guessed(spec: SourceSpec) -> bool:
    """Return whether the relative poses of the cameras may be guessed, which the option ``places`` decides."""
    return choice_of(spec, "places", ("known", "guess")) == "guess"


def open_cameras(
    spec: SourceSpec,
    rig: Rig | None,
    size_px: tuple[int, int],
    list_ids: Callable[[], Sequence[str]],
    make: Callable[[str, tuple[str, str], int], StereoCamera],
) -> DeviceSource:
    """Make the source of one or several cameras.

    Args:
        spec: names the cameras; if it names none, exactly one must be connected.
        rig: the rig, or None for the factory's calibration.
        size_px: (width, height) of the images.
        list_ids: returns the identifiers of all connected cameras.
        make: returns a camera by its identifier, the names of its cameras in the rig, and its index.

    Raises:
        SourceError: if the number of cameras is not that of the rig's pairs.
        RigError: if the rig has single cameras.
    """
    ids = names_of(spec) or [_only_id(spec.kind, list_ids())]
    if rig is not None and rig.singles:
        alone = ", ".join(single.name for single in rig.singles)
        raise RigError(
            f"{spec.kind}: delivers stereo pairs, and the rig has {alone} without a partner; give a rig of pairs, and "
            "by --cameras those that are to be used"
        )
    if rig is not None and len(ids) != len(rig.pairs):
        raise SourceError(
            f"{spec.kind}: {len(ids)} cameras, but the rig has {len(rig.pairs)} pairs; name one for each pair, in the "
            f"rig's order: {spec.kind}:FIRST,SECOND"
        )
    name = f"{spec.kind}-{'-'.join(ids)}"
    if rig is not None:
        names = [(pair.left.name, pair.right.name) for pair in rig.pairs]
        devices = [make(device_id, names[k], k) for k, device_id in enumerate(ids)]
        return DeviceSource(name, devices, partial(_checked_rig, rig, size_px, has_imu(spec, rig), spec.kind))
    if len(ids) > 1 and not is_guessed(spec):
        return DeviceSource(name, [], partial(_refuse_unknown_poses, spec.kind, ids))
    devices = [make(device_id, (f"cam{2 * k}", f"cam{2 * k + 1}"), k) for k, device_id in enumerate(ids)]
    return DeviceSource(name, devices, lambda: _guessed_rig([device.factory_rig() for device in devices], name))


def _only_id(kind: str, ids: Sequence[str]) -> str:
    if not ids:
        raise SourceError(f"{kind}: no camera is connected; check the cable (USB 3) and the udev rules")
    if len(ids) > 1:
        raise SourceError(f"{kind}: {len(ids)} cameras are connected; name those to use: {kind}:{','.join(ids)}")
    return ids[0]


def _checked_rig(rig: Rig, size_px: tuple[int, int], is_imu_read: bool, kind: str) -> Rig:
    """Check that a rig has images of the size that the cameras deliver; return it, without the IMU if not read."""
    for camera in rig.cameras:
        if camera.size_px != size_px:
            raise RigError(
                f"{kind}: images are {size_px[0]}x{size_px[1]}, but the rig has {camera.name} with "
                f"{camera.size_px[0]}x{camera.size_px[1]}; choose size= as in the rig, or calibrate at this size"
            )
    return rig if is_imu_read else rig.without_imu()


def _refuse_unknown_poses(kind: str, ids: Sequence[str]) -> Rig:
    raise RigError(
        f"{kind}: each camera has its own calibration, but not the transforms between {len(ids)} of them; give "
        f"a rig file (--rig rig.yaml). To make one, record a walk from '{kind}:{','.join(ids)}?places=guess' and "
        "calibrate it: graphvio calibrate RECORDING --out rig.yaml"
    )


def _guessed_rig(rigs: Sequence[Rig], name: str) -> Rig:
    """Join rigs of one pair each into one with guessed poses, to record a session for `graphvio calibrate`.

    The first rig keeps its pose and its IMU; each of the others has an IMU of its own, which is not used.
    """
    return joined_rig([rigs[0], *(rig.without_imu() for rig in rigs[1:])], name)[0]
