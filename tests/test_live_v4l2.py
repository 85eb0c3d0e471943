"""UVC cameras. There is no V4L2 device where tests run: images come from files, by OpenCV, through the same code."""

from __future__ import annotations

import os
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import noise_image, small_rig

from graphvio.arrays import AnyArray, Image
from graphvio.errors import RigError, SourceError
from graphvio.live.source import LiveSource
from graphvio.live.sources import SourceSpec, kind_of
from graphvio.live.sources.v4l2 import (
    CaptureSettings,
    GreyImage,
    OpenCapture,
    list_devices,
    open_source,
    open_v4l2,
    set_up,
)
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import CameraFrame, ImuReading, Notice, Reading, host_ns

SIZE_PX = (64, 48)


def picture(number: int, width: int) -> Image:
    """Smooth, so that JPEG keeps it, and different left and right."""
    y, x = np.mgrid[0:48, 0:width]
    return np.asarray(60 + 20 * number + (x // 2) % 64 + y // 2, np.uint8)


def write_video(path: Path, width: int, frames: int = 4) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (width, 48))
    assert writer.isOpened()
    for number in range(frames):
        writer.write(cv2.cvtColor(picture(number, width), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


class FileCapture:
    """A file's JPEGs as they are, as V4L2 delivers a camera's, with stamps of the clock that its driver has."""

    def __init__(self, path: str, clock_ns: int) -> None:
        self._capture = cv2.VideoCapture(path, cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
        self._clock_ms = 1e-6 * clock_ns

    def grab(self) -> bool:
        return self._capture.grab()

    def retrieve(self) -> tuple[bool, AnyArray]:
        is_there, raw = self._capture.retrieve()
        return is_there, raw

    def get(self, propId: int) -> float:
        offset_ms = self._clock_ms if propId == cv2.CAP_PROP_POS_MSEC else 0.0
        return offset_ms + self._capture.get(propId)

    def release(self) -> None:
        self._capture.release()


def files(clock_ns: int) -> OpenCapture:
    return lambda path, settings: FileCapture(path, clock_ns)


def begun(spec: str, open_capture: OpenCapture, pairs: int = 1) -> tuple[LiveSource, Iterator[Reading]]:
    source = open_source(SourceSpec.parse(spec), small_rig(pairs), open_capture)
    source.open()
    return source, source.readings()


def frames_of(readings: Iterator[Reading], count: int) -> list[CameraFrame]:
    found: list[CameraFrame] = []
    while len(found) < count:
        reading = next(readings)
        if isinstance(reading, CameraFrame):
            found.append(reading)
    return found


def test_source_splits_side_by_side_images(tmp_path: Path) -> None:
    path = write_video(tmp_path / "wide.avi", 128)
    clock_ns = time.monotonic_ns()
    before_ns = host_ns()
    source, readings = begun(f"v4l2:{path}?fps=30&size=128x48", files(clock_ns))
    frames = frames_of(readings, 8)
    assert [frame.camera for frame in frames] == ["cam0", "cam1"] * 4
    for number in range(4):
        left, right = frames[2 * number], frames[2 * number + 1]
        assert left.stamp_ns == right.stamp_ns
        assert left.clock is None
        assert abs(left.stamp_ns - before_ns - number * 33_333_333) < 100_000_000
        whole = picture(number, 128).astype(int)
        assert left.decode().shape == (48, 64)
        assert np.abs(left.decode() - whole[:, :64]).max() <= 4
        assert np.abs(right.decode() - whole[:, 64:]).max() <= 4
        assert left.decode().flags.c_contiguous
    lost = next(readings)
    assert isinstance(lost, Notice)
    assert lost.kind == EventKind.DEVICE_LOST  # the file's end
    back = next(readings)
    assert isinstance(back, Notice)
    assert back.kind == EventKind.DEVICE_BACK
    np.testing.assert_array_equal(frames_of(readings, 1)[0].decode(), frames[0].decode())
    source.close()


def test_source_right_left_layout_swaps_cameras(tmp_path: Path) -> None:
    path = write_video(tmp_path / "wide.avi", 128)
    source, readings = begun(f"v4l2:{path}?layout=right_left", files(time.monotonic_ns()))
    frames = frames_of(readings, 2)
    assert [frame.camera for frame in frames] == ["cam1", "cam0"]
    assert np.abs(frames[1].decode().astype(int) - picture(0, 128)[:, 64:]).max() <= 4
    source.close()


def test_source_separate_layout_reads_one_device_per_camera(tmp_path: Path) -> None:
    paths = [str(write_video(tmp_path / f"{k}.avi", 64)) for k in range(4)]
    source, readings = begun(f"v4l2:{','.join(paths)}", files(time.monotonic_ns()), pairs=2)
    frames = frames_of(readings, 16)
    assert sorted({frame.camera for frame in frames}) == ["cam0", "cam1", "cam2", "cam3"]
    assert all(np.abs(frame.decode().astype(int) - picture(0, 64)).max() < 90 for frame in frames)
    assert [health.name for health in source.health()] == paths
    source.close()


def test_source_two_devices_side_by_side_give_four_cameras(tmp_path: Path) -> None:
    paths = [str(write_video(tmp_path / f"{k}.avi", 128)) for k in range(2)]
    source, readings = begun(f"v4l2:{','.join(paths)}?layout=side_by_side", files(time.monotonic_ns()), pairs=2)
    assert {frame.camera for frame in frames_of(readings, 16)} == {"cam0", "cam1", "cam2", "cam3"}
    source.close()


@pytest.mark.parametrize("clock", ["realtime", "none"])
def test_stamp_of_realtime_or_no_clock(tmp_path: Path, clock: str) -> None:
    path = write_video(tmp_path / "wide.avi", 128)
    before_ns = host_ns()
    source, readings = begun(f"v4l2:{path}", files(time.time_ns() if clock == "realtime" else 0))
    frame = frames_of(readings, 3)[2]
    if clock == "realtime":
        assert abs(frame.stamp_ns - before_ns - 33_333_333) < 100_000_000
    else:
        assert frame.stamp_ns == frame.arrival_ns
    (health,) = source.health()
    assert ("no_kernel_stamp" in health.counts) == (clock == "none")
    source.close()


def test_source_reads_serial_imu(tmp_path: Path) -> None:
    path = write_video(tmp_path / "wide.avi", 128)
    controller, port = os.openpty()
    tty.setraw(port)
    name = os.ttyname(port)
    source, readings = begun(f"v4l2:{path}?imu=serial:{name}&imu_baud=115200", files(time.monotonic_ns()))
    os.write(controller, b"\n" + b"1000,0,0,0.5,0,0,9.81\n")
    sample = next(reading for reading in readings if isinstance(reading, ImuReading))
    assert sample.clock == f"serial:{name}"
    assert sample.angular_velocity[2] == 0.5
    assert [health.name for health in source.health()] == [str(path), f"serial:{name}"]
    source.close()
    os.close(port)
    os.close(controller)


def test_source_rig_and_imu_must_agree(tmp_path: Path) -> None:
    path = write_video(tmp_path / "wide.avi", 128)
    source = open_source(SourceSpec.parse(f"v4l2:{path}"), small_rig(1), files(0))
    assert source.open().imu is None  # none is asked for
    source.close()
    with pytest.raises(RigError, match="give a rig file"):
        open_source(SourceSpec.parse(f"v4l2:{path}"), None, files(0)).open()
    spec = SourceSpec.parse(f"v4l2:{path}?imu=serial:/dev/null")
    with pytest.raises((RigError, SourceError), match=r"has none|cannot be opened"):
        open_source(spec, small_rig(1, imu=False), files(0)).open()


@pytest.mark.parametrize(
    ("spec", "error", "words"),
    [
        ("v4l2:", SourceError, "name the devices"),
        ("v4l2:a,b,c", SourceError, "3 devices are named, but the rig has 1 pairs"),
        ("v4l2:a?layout=separate", SourceError, "1 devices are named"),
        ("v4l2:a,b?layout=side_by_side", SourceError, "2 devices are named"),
        ("v4l2:a?size=64x48", RigError, "the image of cam0 and cam1 is 128x48"),
        ("v4l2:a,b?size=128x48", RigError, "the image of cam0 is 64x48"),
        ("v4l2:a?format=H264", SourceError, "choose one of MJPG"),
        ("v4l2:a?exposure_us=0", SourceError, "exposure_us"),
        ("v4l2:a?exposure=5", SourceError, "did you mean 'exposure_us'"),
        ("v4l2:a?imu=usb", SourceError, "write imu=serial"),
        ("v4l2:a?imu=serial:/dev/x&imu_rate_hz=5", SourceError, "write imu=serial"),
        ("v4l2:a?imu=iio:", SourceError, "write imu=serial"),
        ("v4l2:a?imu=iio:a+b+c", SourceError, "write imu=serial"),
    ],
)
def test_open_source_bad_spec_is_refused(spec: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        open_source(SourceSpec.parse(spec), small_rig(1))


def test_grey_image_damaged_jpeg_is_refused() -> None:
    is_made, jpeg = cv2.imencode(".jpg", picture(0, 64))
    assert is_made
    everything = (slice(None), slice(None))
    for padding in (0, 300):  # cameras pad
        raw = np.concatenate([jpeg.ravel(), np.zeros(padding, np.uint8)])
        assert GreyImage(raw[None], "MJPG", SIZE_PX, "a").part(*everything).shape == (48, 64)
    for raw, words in (
        (jpeg.ravel()[: len(jpeg) // 2], "cut short"),
        (np.array([0xFF, 0xD8, 1, 2, 0xFF, 0xD9], np.uint8), "cannot be decoded"),
    ):
        image = GreyImage(raw, "MJPG", SIZE_PX, "/dev/video7")
        for _ in range(2):  # for the left and the right part
            with pytest.raises(SourceError, match=f"/dev/video7.*{words}"):
                image.part(*everything)
    with pytest.raises(SourceError, match="64x48 came, not 128x48"):
        GreyImage(jpeg, "MJPG", (128, 48), "a").part(*everything)


@pytest.mark.parametrize("pixel_format", ["YUYV", "UYVY", "GREY"])
def test_grey_image_uncompressed_formats(pixel_format: str) -> None:
    grey = noise_image(0, SIZE_PX)
    raw: AnyArray = grey
    if pixel_format != "GREY":
        chroma = np.full_like(grey, 128)
        raw = np.stack([grey, chroma] if pixel_format == "YUYV" else [chroma, grey], axis=2)
    for shaped in (raw, raw.reshape(1, -1)):
        found = GreyImage(shaped, pixel_format, SIZE_PX, "a").part(slice(0, 48), slice(32, 64))
        np.testing.assert_array_equal(found, grey[:, 32:])
    with pytest.raises(SourceError, match="bytes came"):
        GreyImage(raw[:40], pixel_format, SIZE_PX, "a").part(slice(None), slice(None))


class Properties:
    """The properties of a capture as a driver has them: what it takes, and what it has in place of what it refuses."""

    def __init__(self, refused: dict[int, float | None]) -> None:
        self.refused = refused
        self.values: dict[int, float] = {}
        self.order: list[int] = []

    def set(self, propId: int, value: float) -> bool:
        self.order.append(propId)
        if propId in self.refused:
            return False
        self.values[propId] = value
        return True

    def get(self, propId: int) -> float:
        refused = self.refused.get(propId)
        return self.values.get(propId, 0.0) if refused is None else refused


def test_set_up_sets_properties() -> None:
    manual = Properties({})
    set_up(manual, "/dev/video0", CaptureSettings((1280, 480), 60.0, "YUYV", 5040.0, 3.0))
    assert manual.order.index(cv2.CAP_PROP_FOURCC) < manual.order.index(cv2.CAP_PROP_FRAME_WIDTH)
    assert manual.values[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*"YUYV")
    assert manual.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert manual.values[cv2.CAP_PROP_EXPOSURE] == 50
    assert manual.values[cv2.CAP_PROP_CONVERT_RGB] == 0
    assert manual.values[cv2.CAP_PROP_FPS] == 60
    automatic = Properties({})
    set_up(automatic, "/dev/video0", CaptureSettings((1280, 480)))
    assert automatic.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 3
    assert cv2.CAP_PROP_EXPOSURE not in automatic.order


@pytest.mark.parametrize(
    ("refused", "words"),
    [
        ({cv2.CAP_PROP_FOURCC: 1448695129.0}, "does not deliver MJPG; change format="),
        ({cv2.CAP_PROP_FRAME_WIDTH: 640.0}, "delivers 640x480, not 1280x480"),
        ({cv2.CAP_PROP_FPS: 15.0}, "delivers 15 images a second"),
        ({cv2.CAP_PROP_EXPOSURE: None}, "does not let its exposure be set"),
        ({cv2.CAP_PROP_GAIN: None}, "does not let its gain be set"),
    ],
)
def test_set_up_refused_property_is_reported(refused: dict[int, float | None], words: str) -> None:
    with pytest.raises(SourceError, match=words):
        set_up(Properties(refused), "/dev/video0", CaptureSettings((1280, 480), 30.0, "MJPG", 5000.0, 3.0))


def test_open_v4l2_without_camera_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="is not there"):
        open_v4l2(str(tmp_path / "video0"), CaptureSettings(SIZE_PX))
    (tmp_path / "video0").write_bytes(b"")
    with pytest.raises(SourceError, match="cannot be opened for images"):
        open_v4l2(str(tmp_path / "video0"), CaptureSettings(SIZE_PX))


def test_list_devices_lists_image_nodes(tmp_path: Path) -> None:
    nodes, by_id = tmp_path / "nodes", tmp_path / "by-id"
    by_id.mkdir()
    for node, name, index in (("video10", "Other", 0), ("video2", "Stereo", 0), ("video3", "Stereo", 1)):
        (nodes / node).mkdir(parents=True)
        (nodes / node / "name").write_text(f"{name}\n")
        (nodes / node / "index").write_text(f"{index}\n")
    (by_id / "usb-Stereo-index0").symlink_to("../../video2")
    found = list_devices(nodes, by_id)
    assert [each.spec for each in found] == [f"v4l2:{by_id / 'usb-Stereo-index0'}", "v4l2:/dev/video10"]
    assert found[0].description == "Stereo (video2)"
    assert list_devices(tmp_path / "none", tmp_path / "none") == []
    assert kind_of("v4l2").list_devices() is not None
