"""One OAK camera: its pipeline of two grey cameras and the IMU, and what their messages say."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from typing import Any, Protocol

import numpy as np

from graphvio.errors import RigError, SourceError
from graphvio.live.devices import Counts, DeviceLostError, HandOver
from graphvio.live.imu_merging import AccelOntoGyro
from graphvio.live.lens_fit import FittedLens
from graphvio.live.sources.oak_calibration import factory_rig, fitted_lens
from graphvio.measurements.readings import CameraFrame, ImuReading, host_ns
from graphvio.rig import Rig

_POLL_S = 0.1
_SILENCE_NS = 5_000_000_000
_MICROSECOND = timedelta(microseconds=1)
_IMAGES_WAITING = 8
_IMU_WAITING = 64
_IMU_BATCH = 10


@dataclass(frozen=True)
class StreamSettings:
    """How a camera is to deliver.

    Attributes:
        size_px: (width, height).
        fps: images a second.
        imu_hz: rate of the IMU, or None to leave it alone.
        exposure_us: time of exposure, with `iso`, or None for automatic exposure.
        iso: sensitivity.
        is_lens_fitted: whether images are put right where the factory's lens model is none of graphvio's.
        is_imu_guessed: see `graphvio.live.sources.oak_calibration.factory_rig`.
    """

    size_px: tuple[int, int]
    fps: float
    imu_hz: int | None
    exposure_us: int | None = None
    iso: int = 400
    is_lens_fitted: bool = True
    is_imu_guessed: bool = False


class Connection(Protocol):
    """A camera that runs: depthai's device and pipeline, or in tests queues of messages.

    Attributes:
        calibration: `depthai.CalibrationHandler`.
        images: queues of `depthai.ImgFrame`, left and right.
        imu: queue of `depthai.IMUData`, or None.
        detail: model and connection, for people.
    """

    calibration: Any
    images: tuple[Any, Any]
    imu: Any | None
    detail: str

    def is_alive(self) -> bool:
        """Whether it runs, as far as the library knows."""

    def close(self) -> None:
        """Let go."""


Connect = Callable[[str, StreamSettings], Connection]


class DepthAiConnection:
    """A `Connection` to a real camera."""

    def __init__(self, device_id: str, settings: StreamSettings) -> None:
        import depthai as dai

        left, right = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
        is_found, info = dai.Device.getDeviceById(device_id)  # `dai.Device` would look for ten seconds
        if not is_found:
            raise RuntimeError("it is not connected")
        self._device = dai.Device(info)
        try:
            self._device.setMaxReconnectionAttempts(0)  # a loss is to be told; reconnecting is done here
            self.calibration = self._device.readCalibration()
            self.detail = f"{self._device.getDeviceName()}, {self._device.getUsbSpeed().name}"
            self._pipeline = dai.Pipeline(self._device)
            self.images = (self._camera(dai, left, settings), self._camera(dai, right, settings))
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
        return output.createOutputQueue(maxSize=_IMAGES_WAITING, blocking=False)

    def _imu(self, dai: Any, rate_hz: int) -> Any:
        imu = self._pipeline.create(dai.node.IMU)
        imu.enableIMUSensor([dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW], rate_hz)
        imu.setBatchReportThreshold(1)
        imu.setMaxBatchReports(_IMU_BATCH)
        return imu.out.createOutputQueue(maxSize=_IMU_WAITING, blocking=False)

    def is_alive(self) -> bool:
        """See `Connection`."""
        return bool(self._pipeline.isRunning() and not self._device.isClosed())

    def close(self) -> None:
        """See `Connection`."""
        with suppress(RuntimeError):
            self._pipeline.stop()
        self._device.close()


class OakDevice:
    """A `Device`; depthai's threads hand over, its own thread only watches."""

    def __init__(self, device_id: str, cameras: tuple[str, str], settings: StreamSettings, connect: Connect) -> None:
        self.name = f"oak:{device_id}"
        self.clock = device_id
        self._id, self._cameras, self._settings, self._connect = device_id, cameras, settings, connect
        self._connection: Connection | None = None
        self._lenses: tuple[FittedLens, FittedLens] | None = None
        self._factory_rig: Rig | RigError = RigError(f"{self.name}: was not started")
        self._merging: AccelOntoGyro | None = None
        self._counts = Counts()
        self._numbers: dict[str, int] = {}
        self._detail = ""
        self._newest_ns = 0

    def start(self, hand_over: HandOver) -> None:
        """See `Device.start`."""
        self._merging = AccelOntoGyro(hand_over, self._counts)
        self._numbers = {}
        try:
            self._connection = self._connect(self._id, self._settings)
        except RuntimeError as error:
            raise SourceError(
                f"{self.name}: cannot be started ({error}); check the cable, the udev rules, and that nothing else "
                "uses it"
            ) from None
        self._detail = self._connection.detail
        try:
            self._calibrate(self._connection.calibration)
        except RigError as error:  # it matters only if no rig is given
            self._factory_rig = error
        self._listen(self._connection, hand_over)

    def _calibrate(self, calibration: Any) -> None:
        import depthai as dai

        sockets = (dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C)
        size_px, imu_hz = self._settings.size_px, self._settings.imu_hz
        left, right = (fitted_lens(calibration, each, size_px, f"{self.name}: {each.name}") for each in sockets)
        if self._settings.is_lens_fitted:
            self._lenses = (left, right)
        elif left.maps is not None or right.maps is not None:
            raise RigError(
                f"{self.name}: lens=raw needs a rig file (--rig): the factory's lens model is none of graphvio's"
            )
        name = f"oak-{self._id}"
        guessed = self._settings.is_imu_guessed
        self._factory_rig = factory_rig(calibration, sockets, (left, right), size_px, imu_hz, guessed, name)

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
        assert self._connection is not None
        left, right = self._connection.images
        self._newest_ns = host_ns()
        while not stopping.wait(_POLL_S):
            if left.isClosed() or right.isClosed() or not self._connection.is_alive():
                raise DeviceLostError("unplugged, or it has crashed")
            if host_ns() - self._newest_ns > _SILENCE_NS:
                raise DeviceLostError("no image for 5 s")

    def _listen(self, connection: Connection, hand_over: HandOver) -> None:
        """Take messages in the threads that bring them; what depthai's queues keep besides is not read."""
        for side, queue in enumerate(connection.images):
            queue.addCallback(self._guarded(partial(self._on_image, side, hand_over)))
        if connection.imu is not None:
            connection.imu.addCallback(self._guarded(self._on_imu))

    def _guarded(self, on_message: Callable[[Any], None]) -> Callable[[Any], None]:
        def guarded(message: Any) -> None:
            try:
                on_message(message)
            except Exception:  # an exception in depthai's thread would end the process
                self._counts.add("bad_message")

        return guarded

    def stop(self) -> None:
        """See `Device.stop`."""
        if self._connection is not None:
            connection, self._connection = self._connection, None
            connection.close()

    def detail(self) -> str:
        """See `Device.detail`."""
        moved_px = max((lens.error_px for lens in self._lenses or () if lens.maps is not None), default=0.0)
        return self._detail + (f"; images moved by {moved_px:.1f} px at most, for the lens" if moved_px else "")

    def counts(self) -> Mapping[str, int]:
        """See `Device.counts`."""
        return self._counts.totals()

    def _on_image(self, side: int, hand_over: HandOver, frame: Any) -> None:
        import depthai as dai

        arrival_ns = self._newest_ns = host_ns()
        camera, number = self._cameras[side], frame.getSequenceNum()
        self._counts.add("frames_lost", max(number - self._numbers.get(camera, number - 1) - 1, 0))
        self._numbers[camera] = number
        image = np.asarray(frame.getCvFrame(), dtype=np.uint8)  # always a copy
        stamp_ns = _ns(frame.getTimestampDevice(dai.CameraExposureOffset.MIDDLE))
        lens = self._lenses[side] if self._lenses is not None else None
        decode = partial(np.asarray, image) if lens is None else partial(lens.corrected, image)
        hand_over(CameraFrame(camera, stamp_ns, decode, arrival_ns, self.clock))

    def _on_imu(self, data: Any) -> None:
        assert self._merging is not None
        arrival_ns = host_ns()
        for packet in data.packets:
            accel, gyro = packet.acceleroMeter, packet.gyroscope
            self._merging.add_accel(_ns(accel.getTimestampDevice()), np.array([accel.x, accel.y, accel.z]))
            rate = np.array([gyro.x, gyro.y, gyro.z])
            self._merging.add_gyro(
                ImuReading(_ns(gyro.getTimestampDevice()), rate, np.zeros(3), arrival_ns, self.clock)
            )


def _ns(since_boot: timedelta) -> int:
    return 1000 * (since_boot // _MICROSECOND)
