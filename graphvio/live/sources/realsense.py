"""Live source of Intel RealSense D400 cameras: infrared stereo pairs with a global shutter, and their IMU."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import MissingExtraError, RigError, SourceError
from graphvio.geometry import se3, se3_inverse
from graphvio.live.device_clock import MicrosecondCounter, host_ns_of_realtime
from graphvio.live.devices import HandOver
from graphvio.live.source import DeviceInfo, LiveSource
from graphvio.live.sources import SourceSpec, check_options
from graphvio.live.sources.spec_options import choice_of, number_of, size_of
from graphvio.live.sources.stereo_cameras import StereoCamera, has_imu, open_cameras
from graphvio.measurements.readings import CameraFrame, ImuReading, host_ns
from graphvio.rig import Camera, Imu, Rig, StereoPair

_OPTIONS = ("size", "fps", "gyro_hz", "accel_hz", "exposure_us", "gain", "imu", "sync", "places")
_SYNC_MODES = {"none": 0, "master": 1, "slave": 2}

_SIZE_PX = (848, 480)
_FPS = 30
_GYRO_HZ = 200
_ACCEL_HZ = 100
_MAX_EXPOSURE_US = 500_000
# The data sheets of the IMUs of D435i, D455 and others (BMI055, BMI085): 0.014 deg/s/sqrt(Hz), 150 ug/sqrt(Hz).
_GYRO_NOISE = 2.4e-4
_ACCEL_NOISE = 1.5e-3


class Bus(Protocol):
    """Interface to find cameras: librealsense's context, or software devices in tests."""

    def find(self, serial: str) -> Any | None:
        """Return the `pyrealsense2.device` with this serial number, if it is connected."""

    def serials(self) -> list[str]:
        """Return the serial numbers of all cameras that are connected."""

    def monitor(self, device: Any, on_removed: Callable[[], None]) -> None:
        """Call a function when the device is unplugged."""


class ContextBus:
    """A `Bus` of the cameras that librealsense finds."""

    def __init__(self) -> None:
        import pyrealsense2 as rs

        self._serial_number = rs.camera_info.serial_number
        self._context = rs.context()
        self._lock = threading.Lock()
        self._monitored: list[tuple[Any, Callable[[], None]]] = []
        self._context.set_devices_changed_callback(self._on_change)

    def devices(self) -> dict[str, Any]:
        """Return all cameras by serial number."""
        found = {}
        for device in self._context.query_devices():
            with suppress(RuntimeError):  # raised for a device that is being unplugged
                found[str(device.get_info(self._serial_number))] = device
        return found

    def serials(self) -> list[str]:
        """See `Bus.serials`."""
        return list(self.devices())

    def find(self, serial: str) -> Any | None:
        """See `Bus.find`."""
        return self.devices().get(serial)

    def monitor(self, device: Any, on_removed: Callable[[], None]) -> None:
        """See `Bus.monitor`."""
        with self._lock:
            self._monitored.append((device, on_removed))

    def _on_change(self, event: Any) -> None:
        with self._lock:
            removed = [each for each in self._monitored if event.was_removed(each[0])]
            self._monitored = [each for each in self._monitored if each not in removed]
        for _, on_removed in removed:
            on_removed()


@dataclass(frozen=True)
class StreamSettings:
    """Settings of a camera's streams."""

    size_px: tuple[int, int]  # (width, height)
    fps: int  # images a second
    gyro_hz: int | None  # rate of the gyro, or None to leave the IMU off
    accel_hz: int  # minimum rate of the accelerometer
    exposure_us: float | None  # exposure time, or None for automatic exposure
    gain: float | None  # in the device's units, or None
    sync: str = "none"  # one of ``none``, ``master`` and ``slave``


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
    check_options(spec, _OPTIONS)
    is_synchronised = choice_of(spec, "sync", ("none", "hardware")) == "hardware"
    settings = StreamSettings(
        size_px=size_of(spec, "size") or (rig.cameras[0].size_px if rig is not None else _SIZE_PX),
        fps=round(number_of(spec, "fps", 1, 300) or _FPS),
        gyro_hz=round(number_of(spec, "gyro_hz", 1, 2000) or _GYRO_HZ),
        accel_hz=round(number_of(spec, "accel_hz", 1, 2000) or _ACCEL_HZ),
        exposure_us=number_of(spec, "exposure_us", 1, 200_000),
        gain=number_of(spec, "gain", 0, 1000),
    )
    is_imu_read = has_imu(spec, rig)
    used_bus = bus or ContextBus()

    def make(serial: str, cameras: tuple[str, str], k: int) -> RealSenseDevice:
        gyro_hz = settings.gyro_hz if is_imu_read and k == 0 else None
        sync = ("slave" if k else "master") if is_synchronised else "none"
        return RealSenseDevice(serial, cameras, replace(settings, gyro_hz=gyro_hz, sync=sync), used_bus)

    return open_cameras(spec, rig, settings.size_px, used_bus.serials, make)


class RealSenseDevice(StereoCamera):
    """A RealSense camera as a `Device`."""

    def __init__(self, serial: str, cameras: tuple[str, str], settings: StreamSettings, bus: Bus) -> None:
        super().__init__("realsense", serial, cameras)
        self._settings, self._bus = settings, bus
        self._started: list[Any] = []
        self._removed = threading.Event()
        self._counter = MicrosecondCounter()
        self._detail = ""

    def start(self, hand_over: HandOver) -> None:
        """See `Device.start`."""
        device = self._bus.find(self.clock)
        if device is None:
            raise SourceError(f"{self.name}: is not connected; check the cable (USB 3) and the udev rules")
        self._reset(hand_over)
        # A camera that was unplugged counts from zero again.
        self._counter, self._removed = MicrosecondCounter(), threading.Event()
        self._bus.monitor(device, self._removed.set)
        try:
            self._start(device, hand_over)
        except RuntimeError as error:
            raise SourceError(
                f"{self.name}: cannot be started ({error}); check that no other program uses it"
            ) from None

    def _start(self, device: Any, hand_over: HandOver) -> None:
        import pyrealsense2 as rs

        self._detail = _describe(device)
        size_px, fps, gyro_hz = self._settings.size_px, self._settings.fps, self._settings.gyro_hz
        stereo, images = self._sensor(device, lambda p: _is_image(p, size_px, fps), f"{size_px} at {fps} Hz")
        images.sort(key=lambda profile: profile.stream_index())
        gyro: Any | None = None
        motion: Any | None = None
        if gyro_hz is not None:
            what = f"a gyro at {gyro_hz} Hz and an accelerometer at {self._settings.accel_hz} Hz or more"
            motion, profiles = self._sensor(device, self._is_motion, what)
            gyro = next(profile for profile in profiles if profile.stream_type() == rs.stream.gyro)
        name = f"realsense-{self.clock}"
        self._calibrate(lambda: factory_rig(images[0], images[1], gyro, float(gyro_hz or 0), name))
        self._set_up(stereo)
        self._run(stereo, images, lambda frame: self._on_image(frame, hand_over))
        if motion is not None:
            _set(motion, rs.option.global_time_enabled, 0)
            self._run(motion, profiles, self._on_motion)

    def stop(self) -> None:
        """See `Device.stop`."""
        while self._started:
            sensor = self._started.pop()
            with suppress(RuntimeError):  # the sensor may not have been started, or be gone
                sensor.stop()
            with suppress(RuntimeError):
                sensor.close()

    def detail(self) -> str:
        """See `Device.detail`."""
        host_stamps = "; no hardware stamps: librealsense's kernel patch or its RSUSB build is needed"
        return self._detail + (host_stamps if "host_stamp" in self.counts.totals() else "")

    def _is_gone(self) -> bool:
        return self._removed.is_set()

    def _sensor(self, device: Any, is_wanted: Callable[[Any], bool], what: str) -> tuple[Any, list[Any]]:
        """Return the sensor that has two wanted streams, and their profiles."""
        for sensor in device.query_sensors():
            found: dict[tuple[Any, int], Any] = {}
            for profile in sorted(sensor.get_stream_profiles(), key=lambda profile: profile.fps()):
                if is_wanted(profile):
                    found.setdefault((profile.stream_type(), profile.stream_index()), profile)
            if len(found) == 2:
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
        _set(stereo, rs.option.emitter_enabled, 0)  # the dots of its pattern move with the rig
        _set(stereo, rs.option.global_time_enabled, 0)  # stamps by the device's own clock
        _set(stereo, rs.option.enable_auto_exposure, float(settings.exposure_us is None))
        if settings.exposure_us is not None:
            _set(stereo, rs.option.exposure, settings.exposure_us)
        if settings.gain is not None:
            _set(stereo, rs.option.gain, settings.gain)
        if not _set(stereo, rs.option.inter_cam_sync_mode, _SYNC_MODES[settings.sync]) and settings.sync != "none":
            raise SourceError(f"{self.name}: cannot be synchronised with other cameras; leave sync= out")

    def _run(self, sensor: Any, profiles: list[Any], on_frame: Callable[[Any], None]) -> None:
        self._started.append(sensor)
        sensor.open(profiles)
        sensor.start(self._guarded(on_frame, "bad_frame"))

    def _on_image(self, frame: Any, hand_over: HandOver) -> None:
        arrival_ns = host_ns()
        side = frame.get_profile().stream_index() - 1  # librealsense's index of the infrared stream, from 1
        self._count_lost(side, frame.get_frame_number())
        # librealsense has few buffers, and waits until they are released: hand over a copy.
        image = np.array(frame.get_data(), dtype=np.uint8)
        stamp_ns, clock = self._stamp(frame, arrival_ns)
        self._newest_ns = arrival_ns
        hand_over(CameraFrame(self._cameras[side], stamp_ns, partial(np.asarray, image), arrival_ns, clock))

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
        """Return stamp and clock: the device's, or the host's (None) where the system provides no device stamps."""
        import pyrealsense2 as rs

        stamp_ms = frame.get_timestamp()
        if frame.get_frame_timestamp_domain() != rs.timestamp_domain.hardware_clock:
            self.counts.add("host_stamp")
            return host_ns_of_realtime(round(1e6 * stamp_ms)), None
        # The stamp is when the readout begins; the driver also reports the middle of the exposure.
        readout, middle = rs.frame_metadata_value.frame_timestamp, rs.frame_metadata_value.sensor_timestamp
        before_us = 0
        if frame.supports_frame_metadata(readout) and frame.supports_frame_metadata(middle):
            before_us = frame.get_frame_metadata(readout) - frame.get_frame_metadata(middle)
            before_us = before_us if 0 <= before_us < _MAX_EXPOSURE_US else 0
        return self._counter.stamp_ns(1e3 * stamp_ms) - 1000 * before_us, self.clock


def factory_rig(left: Any, right: Any, gyro: Any | None, imu_rate_hz: float, name: str) -> Rig:
    """Read the factory's calibration as a rig of one pair, cameras ``cam0`` and ``cam1``.

    Args:
        left: `pyrealsense2.stream_profile` of infrared 1.
        right: profile of infrared 2.
        gyro: profile of the gyro, whose frame is body; None if there is no IMU, and body is the left camera.
        imu_rate_hz: rate of the gyro.
        name: name of the rig.

    Raises:
        RigError: if graphvio does not support the model of a lens, or the calibration is incomplete.
    """
    body_T_left = np.eye(4) if gyro is None else _transform(left, gyro, name)
    body_T_right = body_T_left @ se3_inverse(_transform(left, right, name))
    imu = Imu(imu_rate_hz, gyro_noise_density=_GYRO_NOISE, accel_noise_density=_ACCEL_NOISE) if gyro else None
    pair = StereoPair("pair0", _camera("cam0", left, body_T_left, name), _camera("cam1", right, body_T_right, name))
    return Rig((pair,), imu, name)


def _transform(a: Any, b: Any, where: str) -> Float:
    """Read ``b_T_a`` (4, 4) between the frames of two stream profiles."""
    try:
        extrinsics = a.get_extrinsics_to(b)
    except RuntimeError as error:
        raise RigError(f"{where}: the factory's calibration is incomplete ({error}); give a rig file (--rig)") from None
    rotation = np.array(extrinsics.rotation, dtype=np.float64).reshape(3, 3, order="F")  # column by column
    return np.asarray(se3(np.ascontiguousarray(rotation), np.array(extrinsics.translation, dtype=np.float64)))


def _camera(name: str, profile: Any, body_T_cam: Float, where: str) -> Camera:
    lens = profile.as_video_stream_profile().get_intrinsics()
    intrinsics, distortion = np.array([lens.fx, lens.fy, lens.ppx, lens.ppy]), np.array(lens.coeffs, dtype=np.float64)
    kind = lens.model.name
    if kind == "kannala_brandt4":
        model, distortion = "equidistant", distortion[:4]
    # The D400 series rectifies infrared images: whatever model is named, its coefficients are zero.
    elif kind in ("brown_conrady", "none") or not distortion.any():
        model = "radial-tangential"
    else:
        raise RigError(
            f"{where}: {name}: its lens is of model {kind}, which graphvio has not; calibrate it with Kalibr, and give "
            "the rig file"
        )
    return Camera(name, model, (lens.width, lens.height), intrinsics, distortion, body_T_cam)


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

    info = rs.camera_info
    parts = ((info.name, ""), (info.firmware_version, "firmware "), (info.usb_type_descriptor, "USB "))
    return ", ".join(prefix + device.get_info(what) for what, prefix in parts if device.supports(what))


def _library() -> Any:
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        raise MissingExtraError("pyrealsense2", "realsense", "a RealSense camera") from None
    except ImportError as error:
        raise SourceError(
            f"realsense: pyrealsense2 cannot be loaded ({error}); its wheel needs libusb: apt install libusb-1.0-0"
        ) from None
    return pyrealsense2
