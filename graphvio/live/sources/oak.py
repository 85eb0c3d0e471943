"""Live source of Luxonis OAK cameras with a stereo pair of grey cameras, such as OAK-D, by DepthAI 3."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from typing import Any, Protocol

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError, SourceError, importing
from graphvio.geometry import se3_inverse
from graphvio.live.devices import HandOver
from graphvio.live.lens_fit import FittedLens, fit_rational
from graphvio.live.source import DeviceInfo, LiveSource
from graphvio.live.sources import SourceSpec, check_options
from graphvio.live.sources.spec_options import choice_of, number_of, size_of
from graphvio.live.sources.stereo_cameras import StereoCamera, has_imu, is_guessed, open_cameras
from graphvio.measurements.readings import CameraFrame, ImuReading, host_ns
from graphvio.rig import Camera, Imu, Rig, StereoPair

_OPTIONS = ("size", "fps", "imu_hz", "exposure_us", "iso", "imu", "lens", "places")

_SIZE_PX = (640, 400)
_FPS = 30
_IMU_HZ = 200
_ISO = 400
_MICROSECOND = timedelta(microseconds=1)
_IMAGES_QUEUED = 8
_IMU_QUEUED = 64
_IMU_BATCH = 10
_M_PER_CM = 0.01


def list_devices() -> Sequence[DeviceInfo]:
    """See `SourceKind.list_devices`."""
    found = _library().Device.getAllAvailableDevices()
    return [
        DeviceInfo(f"oak:{each.getDeviceId()}", f"OAK at {each.name}, {each.platform.name}, {each.state.name}")
        for each in found
    ]


@dataclass(frozen=True)
class StreamSettings:
    """Settings of a camera's streams."""

    size_px: tuple[int, int]  # (width, height)
    fps: float  # images a second
    imu_hz: int | None  # rate of the IMU, or None to leave it off
    exposure_us: int | None = None  # exposure time, with `iso`, or None for automatic exposure
    iso: int = 400  # sensitivity
    is_lens_fitted: bool = True  # whether images are corrected where graphvio does not have the factory's lens model
    is_imu_guessed: bool = False  # whether the pose of an IMU without calibration is taken to be the left camera's


class Connection(Protocol):
    """Interface to a running camera: depthai's device and pipeline, or queues of messages in tests.

    Attributes:
        calibration: `depthai.CalibrationHandler` with the factory's calibration.
        images: queues of `depthai.ImgFrame`, left and right.
        imu: queue of `depthai.IMUData`, or None.
        detail: model and connection, for people.
    """

    calibration: Any
    images: tuple[Any, Any]
    imu: Any | None
    detail: str

    def is_alive(self) -> bool:
        """Return whether the camera runs, as far as the library knows."""

    def close(self) -> None:
        """Release the camera."""


Connect = Callable[[str, StreamSettings], Connection]


class DepthAiConnection:
    """A `Connection` to a real camera."""

    def __init__(self, device_id: str, settings: StreamSettings) -> None:
        import depthai as dai

        is_found, info = dai.Device.getDeviceById(device_id)  # `dai.Device` would search for ten seconds
        if not is_found:
            raise RuntimeError("it is not connected")
        self._device = dai.Device(info)
        try:
            self._device.setMaxReconnectionAttempts(0)  # losses are to be reported; `DeviceSource` reconnects
            self.calibration = self._device.readCalibration()
            self.detail = f"{self._device.getDeviceName()}, {self._device.getUsbSpeed().name}"
            self._pipeline = dai.Pipeline(self._device)
            left, right = (self._camera(dai, socket, settings) for socket in _sockets())
            self.images = (left, right)
            self.imu = self._imu(dai, settings.imu_hz) if settings.imu_hz is not None else None
            self._pipeline.start()
        except BaseException:
            self._device.close()
            raise

    def _camera(self, dai: Any, socket: Any, settings: StreamSettings) -> Any:
        camera = self._pipeline.create(dai.node.Camera).build(socket, sensorFps=settings.fps)
        if settings.exposure_us is not None:
            camera.initialControl.setManualExposure(settings.exposure_us, settings.iso)
        output = camera.requestOutput(settings.size_px, type=dai.ImgFrame.Type.GRAY8, fps=settings.fps)
        return output.createOutputQueue(maxSize=_IMAGES_QUEUED, blocking=False)

    def _imu(self, dai: Any, rate_hz: int) -> Any:
        imu = self._pipeline.create(dai.node.IMU)
        imu.enableIMUSensor([dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW], rate_hz)
        imu.setBatchReportThreshold(1)
        imu.setMaxBatchReports(_IMU_BATCH)
        return imu.out.createOutputQueue(maxSize=_IMU_QUEUED, blocking=False)

    def is_alive(self) -> bool:
        """See `Connection`."""
        return bool(self._pipeline.isRunning() and not self._device.isClosed())

    def close(self) -> None:
        """See `Connection`."""
        with suppress(RuntimeError):
            self._pipeline.stop()
        self._device.close()


def open_source(spec: SourceSpec, rig: Rig | None, connect: Connect = DepthAiConnection) -> LiveSource:
    """See `SourceKind.open_source`."""
    _library()
    check_options(spec, _OPTIONS)
    exposure_us, iso = number_of(spec, "exposure_us", 1, 33_000), number_of(spec, "iso", 100, 1600)
    if iso is not None and exposure_us is None:
        raise SourceError("oak: iso= needs exposure_us=; give both, or neither for automatic exposure")
    settings = StreamSettings(
        size_px=size_of(spec, "size") or (rig.cameras[0].size_px if rig is not None else _SIZE_PX),
        fps=number_of(spec, "fps", 1, 240) or _FPS,
        imu_hz=round(number_of(spec, "imu_hz", 1, 1000) or _IMU_HZ),
        exposure_us=None if exposure_us is None else round(exposure_us),
        iso=round(iso or _ISO),
        is_lens_fitted=choice_of(spec, "lens", ("fitted", "raw")) == "fitted",
        is_imu_guessed=is_guessed(spec),
    )
    is_imu_read = has_imu(spec, rig)

    def make(device_id: str, cameras: tuple[str, str], k: int) -> OakDevice:
        own = settings if is_imu_read and k == 0 else replace(settings, imu_hz=None)
        return OakDevice(device_id, cameras, own, connect)

    return open_cameras(
        spec, rig, settings.size_px, lambda: [each.spec.partition(":")[2] for each in list_devices()], make
    )


class OakDevice(StereoCamera):
    """An OAK camera as a `Device`."""

    def __init__(self, device_id: str, cameras: tuple[str, str], settings: StreamSettings, connect: Connect) -> None:
        super().__init__("oak", device_id, cameras)
        self._settings, self._connect = settings, connect
        self._connection: Connection | None = None
        self._lenses: tuple[FittedLens, FittedLens] | None = None
        self._detail = ""

    def start(self, hand_over: HandOver) -> None:
        """See `Device.start`."""
        self._reset(hand_over)
        try:
            self._connection = connection = self._connect(self.clock, self._settings)
        except RuntimeError as error:
            raise SourceError(
                f"{self.name}: cannot be started ({error}); check the cable, the udev rules, and that no other program "
                "uses it"
            ) from None
        self._detail = connection.detail
        self._calibrate(lambda: self._read_calibration(connection.calibration))
        for side, queue in enumerate(connection.images):  # depthai's threads call; the queues are not read
            queue.addCallback(self._guarded(partial(self._on_image, side, hand_over), "bad_message"))
        if connection.imu is not None:
            connection.imu.addCallback(self._guarded(self._on_imu, "bad_message"))

    def stop(self) -> None:
        """See `Device.stop`."""
        if self._connection is not None:
            connection, self._connection = self._connection, None
            connection.close()

    def detail(self) -> str:
        """See `Device.detail`."""
        moved_px = max((lens.error_px for lens in self._lenses or () if lens.maps is not None), default=0.0)
        return self._detail + (f"; images moved by {moved_px:.1f} px at most, for the lens" if moved_px else "")

    def _is_gone(self) -> bool:
        assert self._connection is not None
        return any(queue.isClosed() for queue in self._connection.images) or not self._connection.is_alive()

    def _read_calibration(self, calibration: Any) -> Rig:
        size_px, sockets = self._settings.size_px, _sockets()
        left, right = (fitted_lens(calibration, each, size_px, f"{self.name}: {each.name}") for each in sockets)
        if self._settings.is_lens_fitted:
            self._lenses = (left, right)
        elif left.maps is not None or right.maps is not None:
            raise RigError(
                f"{self.name}: lens=raw needs a rig file (--rig): graphvio does not have the factory's lens model"
            )
        return factory_rig(calibration, sockets, (left, right), self._settings, f"oak-{self.clock}")

    def _on_image(self, side: int, hand_over: HandOver, frame: Any) -> None:
        import depthai as dai

        arrival_ns = self._newest_ns = host_ns()
        self._count_lost(side, frame.getSequenceNum())
        image = np.asarray(frame.getCvFrame(), dtype=np.uint8)  # always a copy
        stamp_ns = _ns(frame.getTimestampDevice(dai.CameraExposureOffset.MIDDLE))
        lens = self._lenses[side] if self._lenses is not None else None
        decode = partial(np.asarray, image) if lens is None else partial(lens.corrected, image)
        hand_over(CameraFrame(self._cameras[side], stamp_ns, decode, arrival_ns, self.clock))

    def _on_imu(self, data: Any) -> None:
        assert self._merging is not None
        arrival_ns = host_ns()
        for packet in data.packets:
            accel, gyro = packet.acceleroMeter, packet.gyroscope
            self._merging.add_accel(_ns(accel.getTimestampDevice()), np.array([accel.x, accel.y, accel.z]))
            rate, stamp_ns = np.array([gyro.x, gyro.y, gyro.z]), _ns(gyro.getTimestampDevice())
            self._merging.add_gyro(ImuReading(stamp_ns, rate, np.zeros(3), arrival_ns, self.clock))


def fitted_lens(calibration: Any, socket: Any, size_px: tuple[int, int], where: str) -> FittedLens:
    """Read a camera's lens from the EEPROM, for images of a size.

    Args:
        calibration: `depthai.CalibrationHandler`.
        socket: `depthai.CameraBoardSocket`.
        size_px: (width, height); images of another aspect ratio than the sensor's are cropped, as the camera does.
        where: name of the camera, for messages.

    Raises:
        RigError: if the camera is not calibrated, or none of graphvio's models is near enough.
    """
    matrix = _read(lambda: calibration.getCameraIntrinsics(socket, *size_px), where)
    coefficients = _read(lambda: calibration.getDistortionCoefficients(socket), where).ravel()
    kind = calibration.getDistortionModel(socket).name
    intrinsics = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    if kind == "Perspective":
        return fit_rational(intrinsics, coefficients, size_px, where)
    if kind == "Fisheye":
        return FittedLens("equidistant", intrinsics, np.pad(coefficients[:4], (0, 1)))
    raise RigError(f"{where}: its lens is of model {kind}, which graphvio has not; give a rig file (--rig)")


def factory_rig(
    calibration: Any,
    sockets: tuple[Any, Any],
    lenses: tuple[FittedLens, FittedLens],
    settings: StreamSettings,
    name: str,
) -> Rig:
    """Read a rig of one pair, cameras ``cam0`` and ``cam1``, from the EEPROM.

    Args:
        calibration: `depthai.CalibrationHandler`.
        sockets: `depthai.CameraBoardSocket` of the left and the right camera.
        lenses: lenses of both cameras.
        settings: settings of the streams; body is the IMU if it is read, otherwise the left camera.
        name: name of the rig.

    Raises:
        RigError: if the calibration is incomplete.
    """
    left, right = sockets
    right_T_left = _transform(lambda: calibration.getCameraExtrinsics(left, right), name)
    body_T_left = np.eye(4)
    if settings.imu_hz is not None:
        try:
            body_T_left = se3_inverse(_transform(lambda: calibration.getImuToCameraExtrinsics(left), name))
        except RigError as error:
            if not settings.is_imu_guessed:
                raise RigError(
                    f"{name}: its calibration lacks the pose of the IMU ({error}); give --rig FILE or imu=none: "
                    "a walk with places=guess makes it:  graphvio calibrate WALK --correct-imu --out FILE"
                ) from None
    body_T_right = body_T_left @ se3_inverse(right_T_left)
    cameras = [
        Camera(f"cam{k}", lens.model, settings.size_px, lens.intrinsics, lens.distortion, body_T_cam)
        for k, (lens, body_T_cam) in enumerate(zip(lenses, (body_T_left, body_T_right), strict=True))
    ]
    imu = None if settings.imu_hz is None else Imu(settings.imu_hz)
    return Rig((StereoPair("pair0", *cameras),), imu, name)


def _transform(read: Callable[[], Any], where: str) -> Float:
    """Read a transform (4, 4) that is given in centimetres, and return it in metres."""
    transform = _read(read, where)
    transform[:3, 3] *= _M_PER_CM
    if not np.abs(transform[:3, :3]).max() > 0.0:  # an EEPROM that was never written
        raise RigError(f"{where}: the factory's calibration is empty")
    return transform


def _read(read: Callable[[], Any], where: str) -> Float:
    try:
        return np.array(read(), dtype=np.float64)
    except (RuntimeError, IndexError) as error:  # depthai does not check that cameras are there
        raise RigError(f"{where}: the factory's calibration is incomplete ({error}); give a rig file (--rig)") from None


def _sockets() -> tuple[Any, Any]:
    import depthai as dai

    return dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C


def _ns(since_boot: timedelta) -> int:
    return 1000 * (since_boot // _MICROSECOND)


def _library() -> Any:
    os.environ.setdefault("DEPTHAI_LEVEL", "error")  # otherwise it warns if no camera is connected
    with importing("depthai", "oak", "an OAK camera"):
        import depthai
    return depthai
