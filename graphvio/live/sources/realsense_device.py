"""One RealSense camera: its sensors, set up for odometry, and what their frames say."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from graphvio.arrays import Float, Image
from graphvio.errors import RigError, SourceError
from graphvio.live.device_clock import MicrosecondCounter, host_ns_of_realtime
from graphvio.live.devices import Counts, DeviceLostError, HandOver
from graphvio.live.imu_merging import AccelOntoGyro
from graphvio.live.sources.realsense_calibration import factory_rig
from graphvio.measurements.readings import CameraFrame, ImuReading, host_ns
from graphvio.rig import Rig

SYNC_MODES = {"none": 0, "master": 1, "slave": 2}

_POLL_S = 0.1
_SILENCE_NS = 5_000_000_000
_LONGEST_EXPOSURE_US = 500_000


class Bus(Protocol):
    """Where cameras are found: librealsense's context, or in tests a software device."""

    def find(self, serial: str) -> Any | None:
        """The `pyrealsense2.device` with this serial number, if it is connected."""

    def serials(self) -> list[str]:
        """Serial numbers of all that are connected."""

    def watch(self, device: Any, on_removed: Callable[[], None]) -> None:
        """Call when the device is pulled out."""


@dataclass(frozen=True)
class StreamSettings:
    """How a camera is to deliver.

    Attributes:
        size_px: (width, height).
        fps: images a second.
        gyro_hz: rate of the gyro, or None to leave the IMU alone.
        accel_hz: the least rate of the accelerometer.
        exposure_us: time of exposure, or None for automatic exposure.
        gain: in the device's units, or None.
        sync: one of `SYNC_MODES`.
    """

    size_px: tuple[int, int]
    fps: int
    gyro_hz: int | None
    accel_hz: int
    exposure_us: float | None
    gain: float | None
    sync: str = "none"


class RealSenseDevice:
    """A `Device`; librealsense's threads hand over, its own thread only watches."""

    def __init__(self, serial: str, cameras: tuple[str, str], settings: StreamSettings, bus: Bus) -> None:
        self.name = f"realsense:{serial}"
        self.clock = serial
        self._serial, self._settings, self._bus = serial, settings, bus
        self._camera_of = dict(zip((1, 2), cameras, strict=True))  # by librealsense's index of the infrared stream
        self._open: list[Any] = []
        self._removed = threading.Event()
        self._newest_ns = 0
        self._detail = ""
        self._counts = Counts()
        self._merging: AccelOntoGyro | None = None
        self._frame_numbers: dict[int, int] = {}
        self._counter = MicrosecondCounter()
        self._factory_rig: Rig | RigError = RigError(f"{self.name}: was not started")

    def start(self, hand_over: HandOver) -> None:
        """See `Device.start`."""
        device = self._bus.find(self._serial)
        if device is None:
            raise SourceError(f"{self.name}: is not connected; check the cable (USB 3) and the udev rules")
        # A camera that was unplugged counts from zero again.
        self._counter, self._removed = MicrosecondCounter(), threading.Event()
        self._frame_numbers = {}
        self._merging = AccelOntoGyro(hand_over, self._counts)
        self._bus.watch(device, self._removed.set)
        try:
            self._start(device, hand_over)
        except RuntimeError as error:
            raise SourceError(f"{self.name}: cannot be started ({error}); check that nothing else uses it") from None

    def _start(self, device: Any, hand_over: HandOver) -> None:
        import pyrealsense2 as rs

        self._detail = _describe(device)
        size_px, fps, gyro_hz = self._settings.size_px, self._settings.fps, self._settings.gyro_hz
        stereo, images = self._sensor(device, lambda p: _is_image(p, size_px, fps), 2, f"{size_px} at {fps} Hz")
        images.sort(key=lambda profile: profile.stream_index())
        gyro: Any | None = None
        motion: Any | None = None
        if gyro_hz is not None:
            what = f"a gyro at {gyro_hz} Hz and an accelerometer at {self._settings.accel_hz} Hz or more"
            motion, profiles = self._sensor(device, self._is_motion, 2, what)
            gyro = next(profile for profile in profiles if profile.stream_type() == rs.stream.gyro)
        try:
            self._factory_rig = factory_rig(
                images[0], images[1], gyro, float(gyro_hz or 0), f"realsense-{self._serial}"
            )
        except RigError as error:  # it matters only if no rig is given
            self._factory_rig = error
        self._set_up(stereo)
        self._run(stereo, images, lambda frame: self._on_image(frame, hand_over))
        if motion is not None:
            _set(motion, rs.option.global_time_enabled, 0)
            self._run(motion, profiles, self._on_motion)

    def factory_rig(self) -> Rig:
        """What the device, once started, tells of itself.

        Raises:
            RigError: if that is no usable rig.
        """
        if isinstance(self._factory_rig, RigError):
            raise self._factory_rig
        return self._factory_rig

    def run(self, hand_over: HandOver, stopping: threading.Event) -> None:
        """See `Device.run`."""
        self._newest_ns = host_ns()
        while not stopping.wait(_POLL_S):
            if self._removed.is_set():
                raise DeviceLostError("unplugged")
            if host_ns() - self._newest_ns > _SILENCE_NS:
                raise DeviceLostError("no image for 5 s")

    def stop(self) -> None:
        """See `Device.stop`."""
        while self._open:
            sensor = self._open.pop()
            with suppress(RuntimeError):  # it may not have come to its start, or be gone
                sensor.stop()
            with suppress(RuntimeError):
                sensor.close()

    def detail(self) -> str:
        """See `Device.detail`."""
        host_stamps = "; no hardware stamps: librealsense's kernel patch or its RSUSB build is needed"
        return self._detail + (host_stamps if "host_stamp" in self._counts.totals() else "")

    def counts(self) -> Mapping[str, int]:
        """See `Device.counts`."""
        return self._counts.totals()

    def _sensor(self, device: Any, wanted: Callable[[Any], bool], count: int, what: str) -> tuple[Any, list[Any]]:
        """The sensor that has so many different streams as wanted, and their profiles."""
        for sensor in device.query_sensors():
            found: dict[tuple[Any, int], Any] = {}
            for profile in sorted(sensor.get_stream_profiles(), key=lambda profile: profile.fps()):
                if wanted(profile):
                    found.setdefault((profile.stream_type(), profile.stream_index()), profile)
            if len(found) == count:
                return sensor, list(found.values())
        raise SourceError(
            f"{self.name}: has no streams of {what}; `rs-enumerate-devices` lists those that it has (some need USB 3)"
        )

    def _is_motion(self, profile: Any) -> bool:
        import pyrealsense2 as rs

        if profile.stream_type() == rs.stream.gyro:
            return bool(profile.fps() == self._settings.gyro_hz)
        return bool(profile.stream_type() == rs.stream.accel and profile.fps() >= self._settings.accel_hz)

    def _set_up(self, stereo: Any) -> None:
        import pyrealsense2 as rs

        settings = self._settings
        _set(stereo, rs.option.emitter_enabled, 0)  # its dots move with the rig
        _set(stereo, rs.option.global_time_enabled, 0)  # the stamps' clock is to be the device's own
        _set(stereo, rs.option.enable_auto_exposure, float(settings.exposure_us is None))
        if settings.exposure_us is not None:
            _set(stereo, rs.option.exposure, settings.exposure_us)
        if settings.gain is not None:
            _set(stereo, rs.option.gain, settings.gain)
        if not _set(stereo, rs.option.inter_cam_sync_mode, SYNC_MODES[settings.sync]) and settings.sync != "none":
            raise SourceError(f"{self.name}: cannot be synchronised with other cameras; leave sync= out")

    def _run(self, sensor: Any, profiles: list[Any], on_frame: Callable[[Any], None]) -> None:
        def guarded(frame: Any) -> None:
            try:
                on_frame(frame)
            except Exception:  # an exception in librealsense's thread would end the process
                self._counts.add("bad_frame")

        self._open.append(sensor)
        sensor.open(profiles)
        sensor.start(guarded)

    def _on_image(self, frame: Any, hand_over: HandOver) -> None:
        arrival_ns = host_ns()
        index = frame.get_profile().stream_index()
        number = frame.get_frame_number()
        before = self._frame_numbers.get(index, number - 1)
        self._counts.add("frames_lost", max(number - before - 1, 0))
        self._frame_numbers[index] = number
        # librealsense has few buffers and waits for those that are not given back: the copy is what is handed on.
        image = np.array(frame.get_data(), dtype=np.uint8)
        stamp_ns, clock = self._stamp(frame, arrival_ns)
        self._newest_ns = arrival_ns
        hand_over(CameraFrame(self._camera_of[index], stamp_ns, _Same(image), arrival_ns, clock))

    def _on_motion(self, frame: Any) -> None:
        import pyrealsense2 as rs

        assert self._merging is not None
        arrival_ns = host_ns()
        data = frame.as_motion_frame().get_motion_data()
        vector: Float = np.array([data.x, data.y, data.z], dtype=np.float64)
        stamp_ns, clock = self._stamp(frame, arrival_ns)
        if frame.get_profile().stream_type() == rs.stream.gyro:
            self._merging.add_gyro(ImuReading(stamp_ns, vector, np.zeros(3), arrival_ns, clock))
        else:
            self._merging.add_accel(stamp_ns, vector)

    def _stamp(self, frame: Any, arrival_ns: int) -> tuple[int, str | None]:
        """When, and by which clock: the device's, or the host's where the system does not hand on the device's."""
        import pyrealsense2 as rs

        stamp_ms = frame.get_timestamp()
        if frame.get_frame_timestamp_domain() != rs.timestamp_domain.hardware_clock:
            self._counts.add("host_stamp")
            return host_ns_of_realtime(round(1e6 * stamp_ms)), None
        # The stamp is of the readout's begin; the driver tells the middle of the exposure besides.
        readout, middle = rs.frame_metadata_value.frame_timestamp, rs.frame_metadata_value.sensor_timestamp
        before_us = 0
        if frame.supports_frame_metadata(readout) and frame.supports_frame_metadata(middle):
            before_us = frame.get_frame_metadata(readout) - frame.get_frame_metadata(middle)
            before_us = before_us if 0 <= before_us < _LONGEST_EXPOSURE_US else 0
        return self._counter.stamp_ns(1e3 * stamp_ms) - 1000 * before_us, self.clock


class _Same:
    """An image that needs no decoding."""

    def __init__(self, image: Image) -> None:
        self._image = image

    def __call__(self) -> Image:
        return self._image


def _is_image(profile: Any, size_px: tuple[int, int], fps: int) -> bool:
    import pyrealsense2 as rs

    if profile.stream_type() != rs.stream.infrared or profile.format() != rs.format.y8 or profile.fps() != fps:
        return False
    video = profile.as_video_stream_profile()
    return profile.stream_index() in (1, 2) and (video.width(), video.height()) == size_px


def _set(sensor: Any, option: Any, value: float) -> bool:
    """Set an option if the sensor has it; returns whether it has."""
    if not sensor.supports(option):
        return False
    sensor.set_option(option, value)
    return True


def _describe(device: Any) -> str:
    import pyrealsense2 as rs

    wanted = (
        (rs.camera_info.name, ""),
        (rs.camera_info.firmware_version, "firmware "),
        (rs.camera_info.usb_type_descriptor, "USB "),
    )
    return ", ".join(word + device.get_info(what) for what, word in wanted if device.supports(what))
