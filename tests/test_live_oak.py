"""OAK cameras without one: DepthAI's own queues, messages and calibration, written here as an EEPROM holds it."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from typing import Any

import cv2
import numpy as np
import pytest
from recordings import small_rig

from graphvio.arrays import Float, Image
from graphvio.cameras import MODEL_NAMES, project_points
from graphvio.errors import MissingExtraError, RigError, SourceError
from graphvio.geometry import se3, se3_inverse, so3_exp
from graphvio.live.devices import DeviceSource
from graphvio.live.lens_fit import fit_rational
from graphvio.live.sources import SourceSpec, kind_of
from graphvio.live.sources.oak import StreamSettings, list_devices, open_source
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import CameraFrame, ImuReading, Notice, Reading, host_ns
from graphvio.rig import Rig

dai = pytest.importorskip("depthai")

SIZE_PX = (640, 400)
LEFT, RIGHT = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
RIGHT_T_LEFT = se3(so3_exp(np.array([0.01, -0.02, 0.005])), np.array([-0.075, 0.001, 0.0]))
LEFT_T_IMU = se3(so3_exp(np.array([0.0, 0.0, 0.5 * np.pi])), np.array([0.02, -0.01, 0.005]))
INTRINSICS = np.array([802.0, 803.0, 645.5, 386.5])  # at 1280x800
NARROW = [9.49, -102.07, 8.2e-4, 2.0e-3, 401.2, 9.265, -100.43, 394.56, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
WIDE = [0.334, -0.0391, -7.1e-5, -1.8e-5, -0.0015, 0.665, -0.0098, -0.0093, 0.0, 0.0, 0.0, 0.0, 2e-4, -5e-4]


def rows(rotation: Float) -> list[list[float]]:
    return [[float(value) for value in row] for row in rotation]


def centimetres(transform: Float) -> list[float]:
    return [100.0 * float(value) for value in transform[:3, 3]]


def calibration(coefficients: list[float], model: str = "Perspective", imu: bool = True) -> Any:
    """What an EEPROM holds, written by DepthAI and read again."""
    made = dai.CalibrationHandler()
    fx, fy, cx, cy = INTRINSICS
    for socket in (LEFT, RIGHT):
        made.setCameraIntrinsics(socket, [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], 1280, 800)
        made.setDistortionCoefficients(socket, coefficients)
        made.setCameraType(socket, getattr(dai.CameraModel, model))
    made.setCameraExtrinsics(LEFT, RIGHT, rows(RIGHT_T_LEFT[:3, :3]), centimetres(RIGHT_T_LEFT))
    if imu:
        right_T_imu = RIGHT_T_LEFT @ LEFT_T_IMU
        made.setImuExtrinsics(RIGHT, rows(right_T_imu[:3, :3]), centimetres(right_T_imu))
    return dai.CalibrationHandler.fromJson(made.eepromToJson())


PLAIN = [0.1, -0.05, 0.001, -0.002, 0.01] + [0.0] * 9


class Queues:
    """A camera as its queues, and the hand that fills them."""

    def __init__(self, handler: Any, imu: bool = True) -> None:
        self.calibration = handler
        self.images = tuple(dai.MessageQueue(name, maxSize=16, blocking=False) for name in ("left", "right"))
        self.imu = dai.MessageQueue("imu", maxSize=64, blocking=False) if imu else None
        self.detail = "OAK-D, SUPER"
        self.alive = True
        self.closed = 0

    def is_alive(self) -> bool:
        return self.alive

    def close(self) -> None:
        self.closed += 1

    def image(self, side: int, image: Image, stamp: timedelta, number: int = 0) -> None:
        frame = dai.ImgFrame()
        frame.setCvFrame(image, dai.ImgFrame.Type.GRAY8)
        frame.setTimestampDevice(stamp)
        frame.setSequenceNum(number)
        self.images[side].send(frame)

    def samples(self, packets: list[tuple[int, tuple[float, float, float], int, tuple[float, float, float]]]) -> None:
        """Accelerations and rates with their stamps in microseconds."""
        data, made = dai.IMUData(), []
        for accel_us, acceleration, gyro_us, rate in packets:
            packet = dai.IMUPacket()
            for report, stamp_us, values in (
                (packet.acceleroMeter, accel_us, acceleration),
                (packet.gyroscope, gyro_us, rate),
            ):
                report.x, report.y, report.z = values
                stamp = dai.Timestamp()
                stamp.sec, stamp.nsec = stamp_us // 1_000_000, 1000 * (stamp_us % 1_000_000)
                report.tsDevice = stamp
            made.append(packet)
        data.packets = made
        assert self.imu is not None
        self.imu.send(data)


class Plugs:
    """Which cameras are connected, and what was asked of them."""

    def __init__(self, **connected: Queues) -> None:
        self.connected = connected
        self.settings: dict[str, StreamSettings] = {}

    def __call__(self, device_id: str, settings: StreamSettings) -> Queues:
        self.settings[device_id] = settings
        if device_id not in self.connected:
            raise RuntimeError("Cannot find any device with given deviceInfo")
        return self.connected[device_id]


def begun(spec: str, plugs: Plugs, rig: Rig | None = None) -> tuple[DeviceSource, Rig, Iterator[Reading]]:
    source = open_source(SourceSpec.parse(spec), rig, plugs)
    assert isinstance(source, DeviceSource)
    source._retry_s = (0.01, 0.02)
    return source, source.open(), source.readings()


def smooth(seed: int) -> Image:
    noise = np.random.default_rng(seed).integers(0, 256, (SIZE_PX[1], SIZE_PX[0]), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 3.0), np.uint8)


def test_source_yields_images_and_imu() -> None:
    camera = Queues(calibration(PLAIN))
    source, rig, readings = begun("oak:A", Plugs(A=camera))
    left, right = smooth(1), smooth(2)
    before_ns = host_ns()
    camera.image(0, left, timedelta(seconds=12, microseconds=500_003), 7)
    first = next(readings)
    camera.image(1, right, timedelta(seconds=12, microseconds=500_003), 7)
    second = next(readings)
    camera.image(0, left, timedelta(seconds=12, microseconds=600_000), 10)
    third = next(readings)
    for frame, name, image in ((first, "cam0", left), (second, "cam1", right)):
        assert isinstance(frame, CameraFrame)
        assert (frame.camera, frame.stamp_ns, frame.clock) == (name, 12_500_003_000, "A")
        assert before_ns <= frame.arrival_ns <= host_ns()
        np.testing.assert_array_equal(frame.decode(), image)
    assert isinstance(third, CameraFrame)
    camera.samples([(1000, (0.0, 0.0, 9.0), 1000, (0.1, 0.2, 0.3)), (1000, (0.0, 0.0, 9.0), 3500, (0.2, 0.2, 0.3))])
    camera.samples([(6000, (0.0, 4.0, 10.0), 6000, (0.3, 0.2, 0.3))])
    samples = [reading for reading in (next(readings) for _ in range(3)) if isinstance(reading, ImuReading)]
    assert [sample.stamp_ns for sample in samples] == [1_000_000, 3_500_000, 6_000_000]
    np.testing.assert_allclose(samples[1].linear_acceleration, [0.0, 2.0, 9.5], rtol=1e-6)
    np.testing.assert_allclose(samples[1].angular_velocity, [0.2, 0.2, 0.3], rtol=1e-6)
    assert samples[1].clock == "A"
    (health,) = source.health()
    assert health.connected
    assert health.detail == "OAK-D, SUPER"
    assert health.counts == {"frames_lost": 2}
    source.close()
    assert camera.closed >= 1
    assert rig.imu is not None


def test_image_stamp_is_middle_of_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    stamp_of = dai.ImgFrame.getTimestampDevice

    def spy(frame: Any, *offset: Any) -> timedelta:
        asked.extend(offset)
        found: timedelta = stamp_of(frame, *offset)
        return found

    monkeypatch.setattr(dai.ImgFrame, "getTimestampDevice", spy)
    camera = Queues(calibration(PLAIN))
    source, _, readings = begun("oak:A", Plugs(A=camera))
    camera.image(0, smooth(0), timedelta(seconds=1))
    next(readings)
    source.close()
    assert asked == [dai.CameraExposureOffset.MIDDLE]  # messages made on the host have no exposure to see it by


def test_factory_rig_matches_calibration() -> None:
    source, rig, _ = begun("oak:A?imu_hz=400", Plugs(A=Queues(calibration(PLAIN))))
    source.close()
    (pair,) = rig.pairs
    np.testing.assert_allclose(pair.right_T_left, RIGHT_T_LEFT, atol=1e-6)
    np.testing.assert_allclose(pair.left.cam_T_body, LEFT_T_IMU, atol=1e-6)
    np.testing.assert_allclose(pair.left.intrinsics, INTRINSICS / 2)
    np.testing.assert_allclose(pair.right.distortion[:5], PLAIN[:5], rtol=1e-6)
    assert (pair.left.model, pair.left.size_px) == ("radial-tangential", SIZE_PX)
    assert rig.imu is not None
    assert rig.imu.rate_hz == 400.0


def test_factory_rig_fisheye_lens() -> None:
    coefficients = [0.05, -0.01, 0.002, -0.0005]
    handler = calibration(coefficients + [0.0] * 10, "Fisheye")
    source, rig, _ = begun("oak:A", Plugs(A=Queues(handler)))
    source.close()
    point = np.array([[0.5, -0.3, 1.0]])
    matrix = np.array(handler.getCameraIntrinsics(LEFT, *SIZE_PX))
    expected = cv2.fisheye.projectPoints(point[None], np.zeros(3), np.zeros(3), matrix, np.array(coefficients))[0]
    np.testing.assert_allclose(rig.pairs[0].left.project(point)[0], expected[0], atol=1e-3)
    with pytest.raises(RigError, match="model Equirectangular, which graphvio has not"):
        begun("oak:A", Plugs(A=Queues(calibration(PLAIN, "Equirectangular"))))


@pytest.mark.parametrize(("coefficients", "focal_px"), [(NARROW, 401.0), (WIDE, 285.0)])
def test_fit_rational_corrected_image_matches_fitted_lens(coefficients: list[float], focal_px: float) -> None:
    intrinsics = np.array([focal_px, focal_px + 0.5, 322.75, 193.25])
    lens = fit_rational(intrinsics, np.array(coefficients), SIZE_PX, "here")
    assert 0.05 < lens.error_px < 4.0
    # A scene of bright dots, through the camera's own lens; each must come to where the fitted lens has it.
    matrix = np.array([[intrinsics[0], 0.0, intrinsics[2]], [0.0, intrinsics[1], intrinsics[3]], [0.0, 0.0, 1.0]])
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 15), np.linspace(-0.4, 0.4, 9))
    points = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    own = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))[0].reshape(-1, 2)
    fitted, _ = project_points(MODEL_NAMES[lens.model], lens.intrinsics, lens.distortion, points)
    own_errors, moved_errors = [], []
    for pixel, wanted in zip(own, fitted, strict=True):
        image = dot(np.asarray(pixel, np.float64))
        own_errors.append(np.linalg.norm(centre(image) - wanted))
        moved_errors.append(np.linalg.norm(centre(lens.corrected(image)) - wanted))
    assert max(moved_errors) < 0.05
    assert max(own_errors) > 2.0 * max(moved_errors)


def dot(pixel: Float) -> Image:
    x, y = np.meshgrid(np.arange(SIZE_PX[0]), np.arange(SIZE_PX[1]))
    return np.asarray(255.0 * np.exp(-((x - pixel[0]) ** 2 + (y - pixel[1]) ** 2) / 18.0), np.uint8)


def centre(image: Image) -> Float:
    x, y = np.meshgrid(np.arange(SIZE_PX[0]), np.arange(SIZE_PX[1]))
    weights = image.astype(np.float64)
    return np.asarray(np.array([(weights * x).sum(), (weights * y).sum()]) / weights.sum())


def test_fit_rational_few_coefficients_are_exact() -> None:
    image = smooth(0)
    for coefficients in (PLAIN, PLAIN[:5], PLAIN[:4]):
        lens = fit_rational(INTRINSICS, np.array(coefficients), SIZE_PX, "here")
        assert lens.corrected(image) is image
        np.testing.assert_array_equal(lens.distortion[: len(coefficients[:5])], coefficients[:5])
    with pytest.raises(RigError, match=r"here: .* is like none of"):
        fit_rational(INTRINSICS / 2, np.array([-60.0, 900.0, 0.3, 0.2, 100.0, -59.0, 800.0, 90.0]), SIZE_PX, "here")


def test_source_corrects_rational_lens_unless_raw() -> None:
    camera, image = Queues(calibration(NARROW)), smooth(1)
    source, rig, readings = begun("oak:A", Plugs(A=camera))
    camera.image(0, image, timedelta(seconds=1))
    frame = next(readings)
    assert isinstance(frame, CameraFrame)
    moved = frame.decode().astype(int)
    assert 0 < np.abs(moved - image).max() < 60
    assert "images moved by 0." in source.health()[0].detail
    source.close()
    source, used, readings = begun("oak:A?lens=raw", Plugs(A=camera), rig)
    assert used is rig
    camera.image(0, image, timedelta(seconds=1))
    frame = next(readings)
    assert isinstance(frame, CameraFrame)
    np.testing.assert_array_equal(frame.decode(), image)
    source.close()
    with pytest.raises(RigError, match="lens=raw needs a rig file"):
        begun("oak:A?lens=raw", Plugs(A=camera))


def test_factory_rig_without_imu_pose_needs_guess() -> None:
    plugs = Plugs(A=Queues(calibration(PLAIN, imu=False)))
    with pytest.raises(RigError, match=r"pose of the IMU.*places=guess.*--correct-imu"):
        begun("oak:A", plugs)
    source, rig, _ = begun("oak:A?imu=none", plugs)
    source.close()
    assert rig.imu is None
    assert plugs.settings["A"].imu_hz is None
    source, rig, _ = begun("oak:A?places=guess", plugs)
    source.close()
    assert rig.imu is not None
    np.testing.assert_array_equal(rig.pairs[0].left.body_T_cam, np.eye(4))


def test_source_without_calibration_needs_rig() -> None:
    camera = Queues(dai.CalibrationHandler())
    with pytest.raises(RigError, match="calibration is incomplete"):
        begun("oak:A", Plugs(A=camera))
    rig = small_rig(1)
    source, used, readings = begun("oak:A", Plugs(A=camera), rig)
    assert used is rig
    camera.image(1, smooth(0), timedelta(seconds=1))
    frame = next(readings)
    assert isinstance(frame, CameraFrame)
    assert frame.camera == "cam1"
    source.close()


@pytest.mark.parametrize("way", ["closed queues", "dead pipeline"])
def test_source_unplugged_camera_reconnects(way: str) -> None:
    camera = Queues(calibration(PLAIN))
    plugs = Plugs(A=camera)
    source, _, readings = begun("oak:A", plugs)
    plugs.connected.clear()
    if way == "closed queues":
        for queue in (*camera.images, camera.imu):
            queue.close()
    else:
        camera.alive = False
    lost = next(readings)
    assert isinstance(lost, Notice)
    assert (lost.kind, lost.clock) == (EventKind.DEVICE_LOST, "A")
    assert "unplugged" in lost.detail
    limit_s = time.monotonic() + 10.0
    while "Cannot find any device" not in source.health()[0].detail:
        assert time.monotonic() < limit_s
        time.sleep(0.005)
    again = Queues(calibration(PLAIN))
    plugs.connected["A"] = again
    back = next(readings)
    assert isinstance(back, Notice)
    assert (back.kind, back.clock) == (EventKind.DEVICE_BACK, "A")
    again.image(0, smooth(0), timedelta(seconds=1))
    assert isinstance(next(readings), CameraFrame)
    source.close()
    assert camera.closed == 1
    assert again.closed == 1


def test_source_two_cameras_guess_or_rig() -> None:
    front, back = Queues(calibration(PLAIN)), Queues(calibration(PLAIN, imu=False), imu=False)
    plugs = Plugs(A=front, B=back)
    with pytest.raises(RigError, match=r"oak:A,B\?places=guess"):
        begun("oak:A,B", plugs)
    source, rig, readings = begun("oak:A,B?places=guess", plugs)
    assert [camera.name for camera in rig.cameras] == ["cam0", "cam1", "cam2", "cam3"]
    np.testing.assert_allclose(rig.pairs[0].left.cam_T_body, LEFT_T_IMU, atol=1e-6)
    np.testing.assert_allclose(rig.left2_T_left1()[:3, :3], np.diag([-1.0, 1.0, -1.0]), atol=1e-6)
    back.image(1, smooth(0), timedelta(seconds=5))
    frame = next(readings)
    assert isinstance(frame, CameraFrame)
    assert (frame.camera, frame.clock) == ("cam3", "B")
    assert (plugs.settings["A"].imu_hz, plugs.settings["B"].imu_hz) == (200, None)
    source.close()
    source, used, _ = begun("oak:A,B?exposure_us=5000&iso=800", plugs, rig)
    source.close()
    assert used is rig
    assert (plugs.settings["B"].exposure_us, plugs.settings["B"].iso) == (5000, 800)
    np.testing.assert_allclose(se3_inverse(rig.pairs[1].left.cam_T_body), rig.pairs[1].left.body_T_cam, atol=1e-12)


def test_source_bad_message_is_counted() -> None:
    camera = Queues(calibration(PLAIN))
    source, _, readings = begun("oak:A", Plugs(A=camera))
    assert camera.imu is not None
    camera.imu.send(dai.ImgFrame())
    camera.image(0, smooth(0), timedelta(seconds=1))
    assert isinstance(next(readings), CameraFrame)
    assert source.health()[0].counts == {"bad_message": 1}
    source.close()


def test_source_close_ends_readings() -> None:
    camera = Queues(calibration(PLAIN))
    source, _, readings = begun("oak:A", Plugs(A=camera))
    reader = threading.Thread(target=lambda: list(readings))
    reader.start()
    source.close()
    reader.join(10.0)
    assert not reader.is_alive()
    assert not any(thread.name == "oak:A" for thread in threading.enumerate())


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("oak:Z", "Cannot find any device"),
        ("oak:A,B,C", "3 cameras, but the rig has 1 pairs"),
        ("oak:A?iso=800", "iso= needs exposure_us="),
        ("oak:A?imu=second", "choose one of first, none"),
        ("oak:A?sync=hardware", "has no option 'sync'"),
    ],
)
def test_open_source_bad_spec_is_refused(spec: str, words: str) -> None:
    with pytest.raises(SourceError, match=words):
        begun(spec, Plugs(A=Queues(calibration(PLAIN))), small_rig(1))


def test_source_rig_of_other_size_is_refused() -> None:
    rig = small_rig(1)
    larger = replace(rig.pairs[0], right=replace(rig.pairs[0].right, size_px=(640, 480)))
    with pytest.raises(RigError, match="images are 64x48, but the rig has cam1 with 640x480"):
        begun("oak:A", Plugs(A=Queues(calibration(PLAIN))), replace(rig, pairs=(larger,)))


def test_list_devices_without_camera_is_empty() -> None:
    assert list_devices() == []
    assert kind_of("oak").list_devices() == []
    with pytest.raises(SourceError, match="no camera is connected"):
        open_source(SourceSpec.parse("oak:"), None)
    source = open_source(SourceSpec.parse("oak:184430102111"), None)  # by the real library, which looks for it
    with pytest.raises(SourceError, match="it is not connected"):
        source.open()


def test_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(MissingExtraError, match=r"graphvio\[oak\]"):
        list_devices()
    with pytest.raises(MissingExtraError, match=r"graphvio\[oak\]"):
        open_source(SourceSpec.parse("oak:"), None)
