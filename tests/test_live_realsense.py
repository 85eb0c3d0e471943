"""RealSense cameras: librealsense's own software device, so that streams, frames and metadata are the library's."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from recordings import noise_image, small_rig

from graphvio.arrays import Float, Image
from graphvio.errors import MissingExtraError, RigError, SourceError
from graphvio.geometry import se3, se3_inverse, so3_exp
from graphvio.live.devices import DeviceSource
from graphvio.live.sources import SourceSpec, kind_of
from graphvio.live.sources.realsense import list_devices, open_source
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import CameraFrame, ImuReading, Notice, Reading, host_ns
from graphvio.rig import Rig, StereoPair

rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)

SIZE_PX = (64, 48)
RIGHT_T_LEFT = se3(so3_exp(np.array([0.01, -0.02, 0.005])), np.array([-0.05, 0.001, 0.0]))
IMU_T_LEFT = se3(so3_exp(np.array([0.3, 0.1, -0.2])), np.array([-0.005, 0.016, 0.012]))


def extrinsics(b_T_a: Float) -> Any:
    made = rs.extrinsics()
    made.rotation = b_T_a[:3, :3].ravel(order="F").tolist()
    made.translation = b_T_a[:3, 3].tolist()
    return made


class Software:
    """A software device with the streams of a D435i, and the hand that moves it."""

    def __init__(
        self, serial: str, model: Any = None, coefficients: tuple[float, ...] = (0.0,) * 5, imu: bool = True
    ) -> None:
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, serial)
        self.device.register_info(rs.camera_info.name, "Intel RealSense D435I")
        self.serial = serial
        self.stereo = self.device.add_sensor("Stereo Module")
        lens = rs.intrinsics()
        lens.width, lens.height = SIZE_PX
        lens.fx, lens.fy, lens.ppx, lens.ppy = 50.0, 51.0, 31.5, 23.25
        lens.model = model or rs.distortion.brown_conrady
        lens.coeffs = list(coefficients)
        self.images = [self._video(k, fps, lens) for fps in (15, 30) for k in (1, 2)][2:]
        for option in ("emitter_enabled", "global_time_enabled", "enable_auto_exposure", "exposure", "gain"):
            self._option(self.stereo, option, 100_000)
        self._option(self.stereo, "inter_cam_sync_mode", 10)
        self.images[0].register_extrinsics_to(self.images[1], extrinsics(RIGHT_T_LEFT))
        self.numbers = [0, 0]
        if not imu:
            return
        self.motion = self.device.add_sensor("Motion Module")
        self._option(self.motion, "global_time_enabled", 1)
        self.accel, self.gyro = self._motion(5, rs.stream.accel, 100), self._motion(6, rs.stream.gyro, 200)
        self.images[0].register_extrinsics_to(self.accel, extrinsics(IMU_T_LEFT))
        self.images[0].register_extrinsics_to(self.gyro, extrinsics(IMU_T_LEFT))

    def _video(self, index: int, fps: int, lens: Any) -> Any:
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fps = rs.stream.infrared, index, 10 * index + fps, fps
        stream.width, stream.height, stream.bpp, stream.fmt, stream.intrinsics = *SIZE_PX, 1, rs.format.y8, lens
        return self.stereo.add_video_stream(stream)

    def _motion(self, uid: int, kind: Any, fps: int) -> Any:
        stream = rs.motion_stream()
        stream.type, stream.index, stream.uid, stream.fps = kind, 0, uid, fps
        stream.fmt, stream.intrinsics = rs.format.motion_xyz32f, rs.motion_device_intrinsic()
        return self.motion.add_motion_stream(stream)

    @staticmethod
    def _option(sensor: Any, name: str, most: float) -> None:
        option_range = rs.option_range()
        option_range.min, option_range.max, option_range.default, option_range.step = 0.0, most, 1.0, 1.0
        sensor.add_option(getattr(rs.option, name), option_range, True)

    def option(self, name: str) -> float:
        return float(self.stereo.get_option(getattr(rs.option, name)))

    def image(
        self, side: int, image: Image, stamp_ms: float, half_exposure_us: int = 0, domain: Any = None, skip: int = 0
    ) -> None:
        self.numbers[side] += 1 + skip
        stamp_us = round(1e3 * stamp_ms)
        self.stereo.set_metadata(rs.frame_metadata_value.frame_timestamp, stamp_us)
        self.stereo.set_metadata(rs.frame_metadata_value.sensor_timestamp, stamp_us - half_exposure_us)
        frame = rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = image.tobytes(), SIZE_PX[0], 1
        frame.timestamp, frame.domain = stamp_ms, domain or rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile = self.numbers[side], self.images[side].as_video_stream_profile()
        self.stereo.on_video_frame(frame)

    def sample(self, profile: Any, values: tuple[float, float, float], stamp_ms: float) -> None:
        frame, vector = rs.software_motion_frame(), rs.vector()
        vector.x, vector.y, vector.z = values
        frame.data, frame.timestamp, frame.domain = vector, stamp_ms, rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile = 1, profile.as_motion_stream_profile()
        self.motion.on_motion_frame(frame)


class SoftwareBus:
    """Software devices in the place of those that are plugged in; librealsense's context does not list them."""

    def __init__(self, *devices: Software) -> None:
        self.connected = {device.serial: device for device in devices}
        self._monitored: list[tuple[Any, Callable[[], None]]] = []

    def serials(self) -> list[str]:
        return list(self.connected)

    def find(self, serial: str) -> Any | None:
        return self.connected[serial].device if serial in self.connected else None

    def monitor(self, device: Any, on_removed: Callable[[], None]) -> None:
        self._monitored.append((device, on_removed))

    def unplug(self, serial: str) -> None:
        gone = self.connected.pop(serial).device
        for device, on_removed in self._monitored:
            if device is gone:
                on_removed()


def begun(spec: str, bus: SoftwareBus, rig: Rig | None = None) -> tuple[DeviceSource, Rig, Iterator[Reading]]:
    source = open_source(SourceSpec.parse(spec), rig, bus)
    assert isinstance(source, DeviceSource)
    source._retry_s = (0.01, 0.02)
    return source, source.open(), source.readings()


SPEC = "realsense:0123?size=64x48"


def test_source_yields_images_and_imu() -> None:
    camera = Software("0123")
    source, rig, readings = begun(SPEC, SoftwareBus(camera))
    left, right = noise_image(1, SIZE_PX), noise_image(2, SIZE_PX)
    before_ns = host_ns()
    camera.image(0, left, 1000.0, half_exposure_us=2500)
    camera.image(1, right, 1000.0, half_exposure_us=2500)
    camera.image(0, np.zeros_like(left), 1033.0, skip=2)
    frames = [next(readings) for _ in range(3)]
    for frame, name, image in zip(frames, ("cam0", "cam1"), (left, right), strict=False):
        assert isinstance(frame, CameraFrame)
        assert (frame.camera, frame.stamp_ns, frame.clock) == (name, 997_500_000, "0123")
        assert before_ns <= frame.arrival_ns <= host_ns()
        np.testing.assert_array_equal(frame.decode(), image)  # its own, though the next image has come
    assert isinstance(frames[2], CameraFrame)
    assert frames[2].stamp_ns == 1_033_000_000
    camera.sample(camera.accel, (0.0, 0.0, 9.0), 1000.0)
    camera.sample(camera.gyro, (0.1, 0.2, 0.3), 1002.5)
    camera.sample(camera.accel, (0.0, 4.0, 10.0), 1010.0)
    sample = next(readings)
    assert isinstance(sample, ImuReading)
    assert (sample.stamp_ns, sample.clock) == (1_002_500_000, "0123")
    np.testing.assert_allclose(sample.angular_velocity, [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(sample.linear_acceleration, [0.0, 1.0, 9.25], rtol=1e-6)
    (health,) = source.health()
    assert health.connected
    assert health.detail.startswith("Intel RealSense D435I")
    assert health.counts == {"frames_lost": 2}
    assert [camera.option(name) for name in ("emitter_enabled", "global_time_enabled", "enable_auto_exposure")] == [
        0,
        0,
        1,
    ]
    source.close()
    assert rig.imu is not None


def test_factory_rig_matches_calibration() -> None:
    source, rig, _ = begun(SPEC, SoftwareBus(Software("0123", coefficients=(0.1, -0.2, 0.003, 0.004, 0.05))))
    source.close()
    (pair,) = rig.pairs
    np.testing.assert_allclose(pair.right_T_left, RIGHT_T_LEFT, atol=1e-6)
    np.testing.assert_allclose(pair.left.cam_T_body, se3_inverse(IMU_T_LEFT), atol=1e-6)
    np.testing.assert_allclose(pair.left.intrinsics, [50.0, 51.0, 31.5, 23.25])
    np.testing.assert_allclose(pair.right.distortion[:5], [0.1, -0.2, 0.003, 0.004, 0.05], rtol=1e-6)
    assert (pair.left.model, pair.left.size_px) == ("radial-tangential", SIZE_PX)
    assert rig.imu is not None
    assert rig.imu.rate_hz == 200.0


def test_factory_rig_projects_like_librealsense() -> None:
    coefficients = (0.1, -0.2, 0.003, 0.004, 0.05)
    for model in (rs.distortion.brown_conrady, rs.distortion.kannala_brandt4):
        camera = Software("0123", model, coefficients)
        source, rig, _ = begun(SPEC, SoftwareBus(camera))
        source.close()
        lens = camera.images[0].as_video_stream_profile().get_intrinsics()
        for point in ((0.1, -0.2, 1.0), (-0.4, 0.3, 1.2)):
            pixels, _ = rig.pairs[0].left.project(np.array([point]))
            np.testing.assert_allclose(pixels[0], rs.rs2_project_point_to_pixel(lens, list(point)), atol=1e-3)


def test_factory_rig_unknown_lens_is_refused() -> None:
    model = rs.distortion.inverse_brown_conrady
    source, rig, _ = begun(SPEC, SoftwareBus(Software("0123", model)))  # without coefficients it is none
    source.close()
    assert not rig.pairs[0].left.distortion.any()
    source = open_source(SourceSpec.parse(SPEC), None, SoftwareBus(Software("0123", model, (0.1, 0.0, 0.0, 0.0, 0.0))))  # type: ignore[assignment]
    with pytest.raises(RigError, match="inverse_brown_conrady, which graphvio has not"):
        source.open()
    source.close()


def test_source_camera_without_imu() -> None:
    bus = SoftwareBus(Software("0123", imu=False))
    with pytest.raises(SourceError, match="no streams of a gyro at 200 Hz"):
        begun(SPEC, bus)
    source, rig, _ = begun(f"{SPEC}&imu=none", bus)
    source.close()
    assert rig.imu is None
    np.testing.assert_array_equal(rig.pairs[0].left.body_T_cam, np.eye(4))


def test_source_unplugged_camera_reconnects() -> None:
    camera = Software("0123")
    bus = SoftwareBus(camera)
    source, _, readings = begun(SPEC, bus)
    camera.image(0, noise_image(0, SIZE_PX), 4_294_967.0)  # shortly before its clock wraps
    camera.image(0, noise_image(0, SIZE_PX), 10.0)
    first, second = next(readings), next(readings)
    assert isinstance(first, CameraFrame)
    assert isinstance(second, CameraFrame)
    assert second.stamp_ns - first.stamp_ns == 10_000_000 + 1000 * (1 << 32) - 4_294_967_000_000
    bus.unplug("0123")
    lost = next(readings)
    assert isinstance(lost, Notice)
    assert (lost.kind, lost.clock) == (EventKind.DEVICE_LOST, "0123")
    assert "unplugged" in lost.detail
    again = Software("0123")
    bus.connected["0123"] = again
    back = next(readings)
    assert isinstance(back, Notice)
    assert (back.kind, back.clock) == (EventKind.DEVICE_BACK, "0123")
    again.image(1, noise_image(3, SIZE_PX), 50.0)
    frame = next(readings)
    assert isinstance(frame, CameraFrame)
    assert (frame.camera, frame.stamp_ns) == ("cam1", 50_000_000)
    assert source.health()[0].counts == {"device_lost": 1}
    source.close()


def test_source_two_cameras_need_rig_or_guess() -> None:
    front, back = Software("0123"), Software("4567")
    bus = SoftwareBus(front, back)
    spec = "realsense:0123,4567?size=64x48"
    with pytest.raises(RigError, match=r"places=guess.*graphvio calibrate"):
        begun(spec, bus)
    source, guessed, _ = begun(f"{spec}&places=guess", bus)
    source.close()
    np.testing.assert_allclose(guessed.left2_T_left1()[:3, :3], np.diag([-1.0, 1.0, -1.0]), atol=1e-6)
    np.testing.assert_allclose(guessed.pairs[1].right_T_left, RIGHT_T_LEFT, atol=1e-6)
    np.testing.assert_allclose(guessed.pairs[0].left.cam_T_body, se3_inverse(IMU_T_LEFT), atol=1e-6)
    assert [camera.name for camera in guessed.cameras] == ["cam0", "cam1", "cam2", "cam3"]


def named(rig: Rig, prefix: str) -> Rig:
    """The same rig with other names of cameras."""

    def renamed(pair: StereoPair) -> StereoPair:
        left, right = (replace(camera, name=prefix + camera.name) for camera in (pair.left, pair.right))
        return replace(pair, left=left, right=right)

    return replace(rig, pairs=tuple(renamed(pair) for pair in rig.pairs))


def test_source_two_cameras_with_rig() -> None:
    front, back = Software("0123"), Software("4567")
    rig = named(small_rig(2), "my-")
    spec = "realsense:0123,4567?sync=hardware&exposure_us=4000&gain=30"
    source, used, readings = begun(spec, SoftwareBus(back, front), rig)
    assert used is rig
    back.image(0, noise_image(0, SIZE_PX), 20.0)
    front.image(1, noise_image(0, SIZE_PX), 3000.0)
    found = [
        (frame.camera, frame.clock) for frame in (next(readings), next(readings)) if isinstance(frame, CameraFrame)
    ]
    assert found == [("my-cam2", "4567"), ("my-cam1", "0123")]
    assert (front.option("inter_cam_sync_mode"), back.option("inter_cam_sync_mode")) == (1, 2)
    assert (back.option("exposure"), back.option("gain"), back.option("enable_auto_exposure")) == (4000, 30, 0)
    assert front.motion.get_active_streams()
    assert not back.motion.get_active_streams()  # the first camera's IMU is body
    source.close()
    source, without, _ = begun(spec + "&imu=none", SoftwareBus(front, back), rig)
    source.close()
    assert without.imu is None


def test_source_host_stamps_are_reported() -> None:
    camera = Software("0123")
    source, _, readings = begun(SPEC, SoftwareBus(camera))
    camera.image(0, noise_image(0, SIZE_PX), 1e3 * time.time(), domain=rs.timestamp_domain.system_time)
    frame = next(readings)
    assert isinstance(frame, CameraFrame)
    assert frame.clock is None
    assert abs(frame.stamp_ns - host_ns()) < 1_000_000_000
    assert "no hardware stamps" in source.health()[0].detail
    source.close()


def test_source_close_while_frames_arrive() -> None:
    camera = Software("0123")
    source, _, readings = begun(SPEC, SoftwareBus(camera))
    stop = threading.Event()

    def feed() -> None:
        number = 0
        while not stop.is_set():
            number += 1
            camera.image(number % 2, noise_image(0, SIZE_PX), float(number))

    feeding = threading.Thread(target=feed)
    feeding.start()
    for _ in range(20):
        next(readings)
    closing = threading.Thread(target=source.close)
    closing.start()
    remaining = list(readings)
    closing.join(10.0)
    stop.set()
    feeding.join(10.0)
    assert not closing.is_alive()
    assert len(remaining) < 1000
    assert not source.health()[0].connected


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("realsense:0123?size=848x480", "no streams of"),
        ("realsense:9999", "is not connected"),
        ("realsense:", "2 cameras are connected; name those to use: realsense:0123,4567"),
        ("realsense:0123?sync=software", "choose one of none, hardware"),
        ("realsense:0123?emitter=off", "has no option 'emitter'"),
        ("realsense:0123?fps=x", "fps"),
    ],
)
def test_open_source_bad_spec_is_refused(spec: str, words: str) -> None:
    with pytest.raises(SourceError, match=words):
        begun(spec, SoftwareBus(Software("0123"), Software("4567")))


def test_source_rig_mismatch_is_refused() -> None:
    bus = SoftwareBus(Software("0123"))
    with pytest.raises(SourceError, match="1 cameras, but the rig has 2 pairs"):
        begun("realsense:", bus, small_rig(2))
    camera = small_rig(1).pairs[0]
    larger = replace(camera, right=replace(camera.right, size_px=(640, 480)))
    with pytest.raises(RigError, match="images are 64x48, but the rig has cam1 with 640x480"):
        begun("realsense:", bus, Rig((larger,), small_rig(1).imu))
    with pytest.raises(SourceError, match="no camera is connected"):
        begun("realsense:", SoftwareBus())


def test_list_devices_without_camera_is_empty() -> None:
    assert list_devices() == []
    assert kind_of("realsense").list_devices() == []


def test_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(MissingExtraError, match=r"graphvio\[realsense\]"):
        list_devices()
    with pytest.raises(MissingExtraError, match=r"graphvio\[realsense\]"):
        open_source(SourceSpec.parse("realsense:"), None)
