"""Sessions on disk: what is written is read back, also after a crash, and by other libraries."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import small_rig, write_euroc
from typer.testing import CliRunner

from graphvio import FrameSet, ImuSample, open_source
from graphvio.cli import app
from graphvio.errors import SessionError, SourceError
from graphvio.geometry import se3, so3_exp
from graphvio.image_decoding import ImageError
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import Measurement
from graphvio.sessions import cdr
from graphvio.sessions.mcap_storage import McapStorage
from graphvio.sessions.messages import IMAGE, header, odometry
from graphvio.sessions.pixels import grey
from graphvio.sessions.store import open_store
from graphvio.sessions.topics import ImageFormat
from graphvio.sessions.writer import SessionWriter
from graphvio.sources.description import describe

pytest.importorskip("mcap")
pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("sessions") / "walk", frames=12)


def written(recording: Path, path: Path, image_format: ImageFormat = "raw") -> Path:
    source = open_source(recording)
    with SessionWriter(path, source.rig, image_format) as writer:
        for measurement in source:
            writer.add(measurement)
        writer.add_event(Event(source.end_ns, "imu_gap", "no samples for 80 ms"))
    assert writer.stopped is None
    return path


def same(one: Measurement, other: Measurement) -> None:
    assert type(one) is type(other)
    assert one.stamp_ns == other.stamp_ns
    if isinstance(one, ImuSample) and isinstance(other, ImuSample):
        np.testing.assert_array_equal(one.angular_velocity, other.angular_velocity)
        np.testing.assert_array_equal(one.linear_acceleration, other.linear_acceleration)
    if isinstance(one, FrameSet) and isinstance(other, FrameSet):
        assert one.images.keys() == other.images.keys()
        for j, images in one.images.items():
            for a, b in zip(images, other.images[j], strict=True):
                np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("image_format", ["raw", "png"])
def test_session_yields_the_recorded_measurements_exactly(
    recording: Path, tmp_path: Path, image_format: ImageFormat
) -> None:
    session = open_source(written(recording, tmp_path / "walk.mcap", image_format))
    original = open_source(recording)
    measurements, expected = list(session), list(original)
    assert len(measurements) == len(expected)
    for one, other in zip(measurements, expected, strict=True):
        same(one, other)
    assert session.rig.pairs[1].left.name == original.rig.pairs[1].left.name
    np.testing.assert_array_equal(session.rig.left2_T_left1(), original.rig.left2_T_left1())
    assert not session.faults.counts


def test_session_is_read_by_mcap_and_rosbags(recording: Path, tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_typestore

    path = written(recording, tmp_path / "walk.mcap")
    types = get_typestore(Stores.ROS2_HUMBLE)
    seen: dict[str, int] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            seen[channel.topic] = seen.get(channel.topic, 0) + 1
            decoded: Any = types.deserialize_cdr(message.data, schema.name)
            if channel.topic == "/tf_static":
                assert [each.child_frame_id for each in decoded.transforms] == ["cam0", "cam1", "cam2", "cam3"]
            if channel.topic == "/pair0/left/camera_info":
                assert decoded.distortion_model == "plumb_bob"
                assert decoded.k[0] == 50.0
    assert seen["/pair0/left/image_raw"] == 12
    assert seen["/rosout"] == 1
    assert seen["/imu"] > 200


@pytest.mark.parametrize("share", [0.3, 0.4, 0.5])
def test_cut_session_is_read_as_far_as_it_goes(recording: Path, tmp_path: Path, share: float) -> None:
    source = open_source(recording)
    path = tmp_path / "walk.mcap"
    with SessionWriter(path, source.rig) as writer:
        assert isinstance(writer._storage, McapStorage)
        for measurement in source:
            writer.add(measurement)
            writer._storage._last_flush_s = -1.0  # so that each measurement has a chunk of its own
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    cut = open_source(path)
    measurements = list(cut)
    assert cut.faults.counts.get("session_cut") == 1
    for one, other in zip(
        (e for e in measurements if isinstance(e, FrameSet)), source_framesets(recording), strict=False
    ):
        same(one, other)
    assert 0 < len(measurements) < len(list(source))


def source_framesets(recording: Path) -> list[FrameSet]:
    return [measurement for measurement in open_source(recording) if isinstance(measurement, FrameSet)]


_RECORDERS = """
import os, sys, time
from pathlib import Path
import numpy as np
sys.path.insert(0, {tests!r})
from recordings import small_rig
from graphvio import FrameSet, ImuSample
from graphvio.sessions.writer import SessionWriter
def record(path):
    with SessionWriter(path, small_rig(1)) as writer, path.with_suffix(".txt").open("w") as stamps:
        while True:
            now = time.monotonic_ns()
            writer.add(ImuSample(now, np.zeros(3), np.array([0.0, 0.0, 9.81])))
            image = np.full((48, 64), now // 10**6 % 256, np.uint8)
            writer.add(FrameSet(now, {{0: (image, image)}}))
            print(now, file=stamps, flush=True)
            time.sleep(0.005)
for k in range({count}):
    pid = os.fork()  # modules are imported once
    if not pid:
        record(Path({folder!r}) / f"{{k}}.mcap")
    print(pid, flush=True)
for _ in range({count}):
    print(os.wait()[0], flush=True)
"""


def test_killed_recordings_lose_at_most_the_last_second(tmp_path: Path) -> None:
    """Six of them, at moments of all kinds."""
    moments_s = np.sort(np.random.default_rng(0).uniform(0.8, 2.5, 6))
    code = _RECORDERS.format(tests=str(Path(__file__).parent), folder=str(tmp_path), count=len(moments_s))
    paths = [tmp_path / f"{k}.mcap" for k in range(len(moments_s))]
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert parent.stdout is not None
    try:
        recorders = [int(parent.stdout.readline()) for _ in paths]
        for path in paths:
            while not stamps_of(path):  # until it has begun
                time.sleep(0.005)
        begun_s = time.monotonic()
        for path, recorder, moment_s in zip(paths, recorders, moments_s, strict=True):
            time.sleep(max(begun_s + moment_s - time.monotonic(), 0.0))
            os.kill(recorder, signal.SIGKILL)
            assert int(parent.stdout.readline()) == recorder  # it is dead
            check_killed(path, stamps_of(path)[-1])
        assert parent.wait() == 0
    finally:
        if parent.poll() is None:
            os.killpg(parent.pid, signal.SIGKILL)
        parent.communicate()


def stamps_of(recording: Path) -> list[int]:
    """What its recorder has noted, a line each, of which the last may not be whole."""
    noted = recording.with_suffix(".txt")
    return [int(line) for line in noted.read_text().split("\n")[:-1]] if noted.exists() else []


def check_killed(path: Path, last_ns: int) -> None:
    file = open_store(path)
    assert not file.is_whole
    left, right = (file.topics[f"/pair0/{side}/image_raw"].logged_ns for side in ("left", "right"))
    assert last_ns - left[-1] < 1_000_000_000
    assert len(left) - len(right) in (0, 1)  # it may have been killed between the two
    framesets = source_framesets(path)
    assert len(framesets) == len(right)
    for frameset in framesets:
        assert frameset.images[0][0][0, 0] == frameset.stamp_ns // 10**6 % 256


def test_full_disk_stops_only_the_recording(tmp_path: Path) -> None:
    """A limit on the size of files is as good as a full disk."""
    code = f"""
import resource, signal, sys
from pathlib import Path
import numpy as np
sys.path.insert(0, {str(Path(__file__).parent)!r})
from recordings import small_rig
from graphvio import FrameSet
from graphvio.sessions.writer import SessionWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
writer = SessionWriter(Path({str(tmp_path / "full.mcap")!r}), small_rig(1))
rng = np.random.default_rng(0)
for k in range(60):
    writer._storage._last_flush_s = -1.0
    image = rng.integers(0, 256, (48, 64), np.uint8)
    writer.add(FrameSet(k * 50_000_000, {{0: (image, image)}}))
writer.close()
print(writer.stopped)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "recording stopped (File too large)" in done.stdout
    framesets = [
        measurement for measurement in open_source(tmp_path / "full.mcap") if isinstance(measurement, FrameSet)
    ]
    assert 10 < len(framesets) < 60


def test_info_describes_a_session(recording: Path, tmp_path: Path) -> None:
    path = written(recording, tmp_path / "walk.mcap")
    found = describe(path)
    assert found.is_whole
    topics = {topic.name: topic for topic in found.topics}
    images = topics["/pair1/right/image_raw"]
    assert images.regularity is not None
    assert images.regularity.rate_hz == pytest.approx(20.0)
    assert images.regularity.gaps == 0
    assert images.latency_ms == 0.0
    done = CliRunner().invoke(app, ["info", str(path)])
    assert done.exit_code == 0
    assert "/imu  (sensor_msgs/msg/Imu)" in done.stdout
    assert "200.00 Hz" in done.stdout
    assert "pairs pair0, pair1, with IMU" in done.stdout


def test_convert_of_a_piece_writes_its_framesets(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "piece.mcap"
    done = CliRunner().invoke(app, ["convert", str(recording), "--out", str(out), "--to", "0.2"])
    assert done.exit_code == 0, done.output
    assert len(source_framesets(out)) == 5
    again = CliRunner().invoke(app, ["convert", str(recording), "--out", str(out)])
    assert isinstance(again.exception, SessionError)
    assert "never overwritten" in str(again.exception)


def test_record_writes_images_and_events(recording: Path, tmp_path: Path) -> None:
    """Images of noise give no pose, which is an event."""
    out = tmp_path / "recorded.mcap"
    done = CliRunner().invoke(app, ["record", str(recording), "--out", str(out)])
    assert done.exit_code == 0, done.output
    file = open_store(out)
    assert file.is_whole
    assert len(file.topics["/pair0/left/image_raw"].places) == 12
    assert "/rosout" in file.topics


def test_odometry_message_has_the_axes_of_ros() -> None:
    """Translation before rotation, about the axes of the parent frame; the twist is in the child's."""
    R = so3_exp(np.array([0.0, 0.0, 0.5 * np.pi]))
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])  # rotation, translation in body
    estimate = Estimate(
        stamp_ns=1_500_000_000,
        status=Status.TRACKING,
        nav_T_body=se3(R, np.array([1.0, 2.0, 3.0])),
        covariance=covariance,
        velocity_nav=np.array([0.0, 1.0, 0.0]),
        velocity_covariance=np.diag([0.1, 0.2, 0.3]),
    )
    message = odometry(estimate)
    assert message.header.stamp.sec == 1
    assert message.header.stamp.nanosec == 500_000_000
    pose = np.asarray(message.pose.covariance).reshape(6, 6)
    np.testing.assert_allclose(np.diag(pose), [5.0, 4.0, 6.0, 2.0, 1.0, 3.0], atol=1e-12)
    linear = message.twist.twist.linear
    np.testing.assert_allclose([linear.x, linear.y, linear.z], [1.0, 0.0, 0.0], atol=1e-12)
    twist = np.asarray(message.twist.covariance).reshape(6, 6)
    np.testing.assert_allclose(np.diag(twist)[:3], [0.2, 0.1, 0.3], atol=1e-12)


@pytest.mark.parametrize("encoding", ["mono8", "mono16", "bgr8", "rgb8", "bayer_rggb8"])
def test_grey_of_all_encodings(encoding: str) -> None:
    grey_level, width, height = 90, 6, 4
    channels = 3 if encoding in ("bgr8", "rgb8") else 1
    pixels = np.full((height, width, channels), grey_level, np.uint16 if encoding == "mono16" else np.uint8)
    if encoding == "mono16":
        pixels = pixels * 256 + 17
    step = pixels[0].nbytes + 2  # rows may be padded
    rows = np.zeros((height, step), np.uint8)
    rows[:, : pixels[0].nbytes] = pixels.reshape(height, -1).view(np.uint8)
    fields = {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": step}
    message = cdr.make(IMAGE, header=header(0, "cam"), data=rows.reshape(-1), **fields)
    found = grey(cdr.decode(cdr.encode(message), IMAGE), "here")
    np.testing.assert_array_equal(found, np.full((height, width), grey_level, np.uint8))


RED, GREEN, BLUE = 200, 50, 10
LAYOUTS = {
    "rgb": [[RED, GREEN, BLUE]],
    "bgr": [[BLUE, GREEN, RED]],
    "8UC3": [[BLUE, GREEN, RED]],
    "rgba": [[RED, GREEN, BLUE, 9]],
    "bgra": [[BLUE, GREEN, RED, 9]],
    "bayer_rggb": [[RED, GREEN], [GREEN, BLUE]],
    "bayer_bggr": [[BLUE, GREEN], [GREEN, RED]],
    "bayer_gbrg": [[GREEN, BLUE], [RED, GREEN]],
    "bayer_grbg": [[GREEN, RED], [BLUE, GREEN]],
}
"""Bytes of a few pixels of one colour, as they are repeated over an image, by encoding."""


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("kind", LAYOUTS)
def test_grey_of_colours_has_the_documented_weights(kind: str, bits: int) -> None:
    width, height = 8, 6
    cell = np.array(LAYOUTS[kind], dtype=np.uint16)
    across = width if not kind.startswith("bayer") else width // 2
    rows = np.tile(cell, (height // len(cell), across))
    is_wide = bits == 16 and kind != "8UC3"
    data = (rows * 256 + 77).astype(">u2") if is_wide else rows.astype(np.uint8)
    fields = {"height": height, "width": width, "is_bigendian": 1, "step": data[0].nbytes}
    encoding = kind if kind == "8UC3" else f"{kind}{bits}"
    message = cdr.make(
        IMAGE, header=header(0, "cam"), data=data.reshape(-1).view(np.uint8), encoding=encoding, **fields
    )
    found = grey(cdr.decode(cdr.encode(message), IMAGE), "here")
    assert found.shape == (height, width)
    np.testing.assert_allclose(found, 0.299 * RED + 0.587 * GREEN + 0.114 * BLUE, atol=1.0)


@pytest.mark.parametrize("kind", ["bayer_rggb", "bayer_bggr", "bayer_gbrg", "bayer_grbg"])
def test_grey_of_bayer_patterns_keeps_places(kind: str) -> None:
    scene = np.tile(np.linspace(20.0, 220.0, 32).astype(np.uint8), (16, 1))  # grey, brighter to the right
    fields = {"height": 16, "width": 32, "is_bigendian": 0, "step": 32, "encoding": f"{kind}8"}
    message = cdr.make(IMAGE, header=header(0, "cam"), data=scene.reshape(-1), **fields)
    np.testing.assert_allclose(grey(message, "here")[2:-2, 2:-2], scene[2:-2, 2:-2], atol=1.0)


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv21", "nv24"])
def test_grey_of_yuv_is_its_brightness(encoding: str) -> None:
    brightness = np.arange(24, dtype=np.uint8).reshape(4, 6)
    data = np.full((4, 12), 128, dtype=np.uint8)
    if encoding.startswith("nv"):
        data = np.concatenate([brightness, np.full((4, 6), 128, dtype=np.uint8)])  # colours follow
    else:
        data[:, encoding in ("yuv422", "uyvy") :: 2] = brightness
    fields = {"height": 4, "width": 6, "is_bigendian": 0, "step": data.shape[1], "encoding": encoding}
    message = cdr.make(IMAGE, header=header(0, "cam"), data=data.reshape(-1), **fields)
    np.testing.assert_array_equal(grey(message, "here"), brightness)


@pytest.mark.parametrize(
    ("field", "value", "words"), [("encoding", "yuv411", "yuv411, which is not known"), ("height", 9, "cut short")]
)
def test_grey_of_invalid_images_raises(field: str, value: object, words: str) -> None:
    fields = {"height": 4, "width": 6, "encoding": "mono8", "is_bigendian": 0, "step": 6} | {field: value}
    message = cdr.make(IMAGE, header=header(0, "cam"), data=np.zeros(24, np.uint8), **fields)
    with pytest.raises(ImageError, match=words):
        grey(message, "here")


def test_open_source_of_no_session_is_refused(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "noise.mcap").write_bytes(b"noise")
    with pytest.raises(SessionError, match="is no MCAP file"):
        open_source(tmp_path / "noise.mcap")
    (tmp_path / "walk.bag").write_bytes(b"#ROSBAG")
    with pytest.raises(SessionError, match="cannot be read as a bag"):
        open_source(tmp_path / "walk.bag")
    (tmp_path / "walk.avi").write_bytes(b"RIFF")
    with pytest.raises(SourceError, match="is no recording that graphvio knows"):
        open_source(tmp_path / "walk.avi")
    rig, path = small_rig(1), written(recording, tmp_path / "walk.mcap")
    other = replace(rig.pairs[0], name="other", left=replace(rig.pairs[0].left, name="cam9"))
    with pytest.raises(SourceError, match="has no images of camera cam9"):
        open_source(path, replace(rig, pairs=(other,)))
