"""A ROS 2 system in another process, received over the loopback."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from recordings import SIZE_PX, noise_image, small_rig
from ros2_loopback import PERIOD_NS, START_NS, URI, Other, free_domain, until

from graphvio.errors import MissingExtraError, RigError, SourceError
from graphvio.live.source import LiveSource
from graphvio.live.sources import open_live_source
from graphvio.live.sources.ros2 import list_devices
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import CameraFrame, ImuReading, Notice, Reading
from graphvio.rig import Rig

FRAMESETS = 5


@pytest.fixture(autouse=True)
def on_the_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", URI)


def robot_on(domain: int) -> Other:
    other = Other("robot", domain)
    assert other.read() == "ready"
    return other


@pytest.fixture(scope="module")
def domain() -> int:
    return free_domain()


@pytest.fixture(scope="module")
def robot_of_all(domain: int) -> Iterator[Other]:
    other = robot_on(domain)
    yield other
    other.end()


@pytest.fixture
def robot(robot_of_all: Other) -> Other:
    """The robot of all tests, once it has seen that nobody listens any more."""
    assert robot_of_all.do("alone") == "True"
    return robot_of_all


class Listening:
    """Takes readings in a thread."""

    def __init__(self, source: LiveSource) -> None:
        self.source = source
        self.received: list[Reading] = []
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for reading in self.source.readings():
            self.received.append(reading)

    def count(self, kind: type[Reading]) -> int:
        return sum(isinstance(each, kind) for each in self.received)

    def notices(self) -> list[str]:
        return [each.kind for each in self.received if isinstance(each, Notice)]

    def end(self) -> None:
        self.source.close()
        self._thread.join(5.0)
        assert not self._thread.is_alive()
        self.source.close()


def check_frames(listening: Listening, cameras: list[str], first: int) -> None:
    """All images of all cameras are there, with their stamps and pixels, whatever their encoding."""
    for k, camera in enumerate(cameras):
        frames = [each for each in listening.received if isinstance(each, CameraFrame) and each.camera == camera]
        assert [each.stamp_ns for each in frames] == [
            START_NS + number * PERIOD_NS for number in range(first, first + FRAMESETS)
        ]
        for number, frame in enumerate(frames, first):
            np.testing.assert_array_equal(frame.decode(), noise_image(10 * number + k, SIZE_PX))
            assert frame.clock is None


def test_source_yields_all_published(domain: int, robot: Other) -> None:
    rig = small_rig()
    source = open_live_source(f"ros2:?domain={domain}", rig)
    assert source.open() is rig
    listening = Listening(source)
    assert robot.do("await /imu /pair0 /pair1") == "True"
    for number in range(FRAMESETS):
        assert robot.do(str(number)) == "sent"
    assert until(lambda: listening.count(CameraFrame) == 4 * FRAMESETS and listening.count(ImuReading) == 50)
    check_frames(listening, [camera.name for camera in rig.cameras], 0)
    samples = [each for each in listening.received if isinstance(each, ImuReading)]
    assert [each.stamp_ns for each in samples] == [START_NS + k * 5_000_000 for k in range(50)]
    np.testing.assert_array_equal(samples[-1].angular_velocity, [0.1, 0.2, FRAMESETS - 1])
    assert all(each.connected and each.counts["lost"] == 0 for each in source.health())
    listening.end()


def test_source_receives_rig(domain: int, robot: Other) -> None:
    source = open_live_source(f"ros2:?domain={domain}")
    rigs = []
    opening = threading.Thread(target=lambda: rigs.append(source.open()))
    opening.start()
    assert until(lambda: robot.do("0") == "sent" and not opening.is_alive())
    (rig,) = rigs
    expected = small_rig()
    assert [pair.name for pair in rig.pairs] == [pair.name for pair in expected.pairs]
    assert rig.imu is not None
    body_R_imu = rig.cameras[0].body_T_cam[:3, :3] @ expected.cameras[0].body_T_cam[:3, :3].T
    np.testing.assert_allclose(body_R_imu, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-9)
    for one, other in zip(rig.cameras, expected.cameras, strict=True):
        np.testing.assert_allclose(one.intrinsics, other.intrinsics)
        np.testing.assert_allclose(one.distortion, other.distortion)
    listening = Listening(source)
    assert robot.do("await /imu /pair0 /pair1") == "True"
    for number in range(100, 100 + FRAMESETS):
        assert robot.do(str(number)) == "sent"
    assert until(
        lambda: (
            sum(each.stamp_ns > START_NS for each in listening.received if isinstance(each, CameraFrame))
            == 4 * FRAMESETS
        )
    )
    listening.end()


def test_source_rotates_samples_into_body(domain: int, robot: Other) -> None:
    source = open_live_source(f"ros2:?domain={domain}&body=base_link", small_rig())
    source.open()
    listening = Listening(source)
    assert robot.do("await /imu") == "True"
    assert robot.do("3") == "sent"
    assert until(lambda: listening.count(ImuReading) == 10)
    reading = next(each for each in listening.received if isinstance(each, ImuReading))
    np.testing.assert_allclose(reading.angular_velocity, [-0.2, 0.1, 3.0], atol=1e-12)
    listening.end()


def test_source_reliable_yields_images(domain: int, robot: Other) -> None:
    rig = small_rig().with_pairs([1]).without_imu()
    source = open_live_source(f"ros2:?domain={domain}&reliable=1", rig)
    source.open()
    listening = Listening(source)
    assert robot.do("await /pair1") == "True"
    assert robot.do("4") == "sent"
    assert until(lambda: listening.count(CameraFrame) == 2)
    listening.end()


def test_open_missing_network_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", URI.replace("'lo'", "'nosuch0'"))
    source = open_live_source(f"ros2:?domain={free_domain()}", small_rig())
    with pytest.raises(SourceError, match=r"DDS domain \d+: cannot be joined .*CYCLONEDDS_URI"):
        source.open()


def test_source_late_and_damaged_are_reported(domain: int, robot: Other) -> None:
    source = open_live_source(f"ros2:?domain={domain}", small_rig().with_pairs([0]))
    source.open()
    listening = Listening(source)
    assert robot.do("await /imu /pair0") == "True"
    for number in (7, 6, 8):
        assert robot.do(str(number)) == "sent"
    assert until(lambda: listening.count(ImuReading) == 30 and listening.count(CameraFrame) == 6)
    assert until(lambda: [each.counts.get("late", 0) for each in source.health()] == [10, 1, 1])
    assert robot.do("cut") == "sent"
    assert until(lambda: listening.count(CameraFrame) == 7)
    cut = [each for each in listening.received if isinstance(each, CameraFrame)][-1]
    with pytest.raises(SourceError, match=r"/pair0/left/image_raw: an image cannot be decoded .*cut short"):
        cut.decode()
    listening.end()


def test_source_lost_publisher_is_reported_and_read_again() -> None:
    domain = free_domain()
    robot = robot_on(domain)
    rig = small_rig().without_imu().with_pairs([0])
    source = open_live_source(f"ros2:?domain={domain}", rig)
    source.open()
    listening = Listening(source)
    robot.end()
    assert until(lambda: listening.notices() == [EventKind.DEVICE_LOST] * 2)
    assert not any(each.connected for each in source.health())
    again = robot_on(domain)
    try:
        assert until(lambda: listening.notices() == [EventKind.DEVICE_LOST] * 2 + [EventKind.DEVICE_BACK] * 2)
        assert again.do("await /pair0") == "True"
        for number in range(FRAMESETS):
            assert again.do(str(number)) == "sent"
        assert until(lambda: listening.count(CameraFrame) == 2 * FRAMESETS)
        check_frames(listening, [camera.name for camera in rig.cameras], 0)
    finally:
        again.end()
        listening.end()


def test_list_devices_lists_domain(domain: int, robot: Other, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    (device,) = list_devices()
    assert device.spec == f"ros2:?domain={domain}"
    assert "pair pair0: /pair0/left/image_raw, /pair0/right/image_raw" in device.description
    assert "IMU: /imu" in device.description


def test_open_waits_for_publishers() -> None:
    domain = free_domain()
    source = open_live_source(f"ros2:?domain={domain}&wait_s=60", small_rig())
    opened = threading.Event()

    def run() -> None:
        source.open()
        opened.set()

    opening = threading.Thread(target=run)
    opening.start()
    assert not opened.wait(1.5)
    robot = robot_on(domain)
    try:
        assert opened.wait(20.0)
    finally:
        source.close()
        robot.end()
        opening.join()


def rig_of_other_names() -> Rig:
    (pair,) = small_rig(pairs=1, imu=False).pairs
    return Rig((replace(pair, name="other", left=replace(pair.left, name="north")),))


def test_open_missing_topics_are_named(domain: int, robot: Other) -> None:
    """All at once: each waits for what does not come."""
    rig = small_rig()
    absent = open_live_source(f"ros2:?domain={domain}&cam0=/front/image_raw&wait_s=1.5", rig)
    of_another_type = open_live_source(f"ros2:?domain={domain}&cam0=/imu", rig)
    reliable = open_live_source(f"ros2:?domain={domain}&reliable=1", rig)
    nameless = open_live_source(f"ros2:?domain={domain}&wait_s=1.5", rig_of_other_names())
    no_pair = open_live_source(f"ros2:?domain={domain}&left=/pair0/left/image_raw&wait_s=1.5")
    sources = (absent, of_another_type, reliable, nameless, no_pair)
    with ThreadPoolExecutor(len(sources)) as threads:
        opened = [threads.submit(source.open) for source in sources]
    for future, kind, message in zip(
        opened,
        (SourceError, SourceError, SourceError, SourceError, RigError),
        (
            r"no publisher of /front/image_raw; start it.*Topics on domain .*: .*/imu",
            r"/imu: has messages of type sensor_msgs/msg/Imu",
            "best effort",
            r"images of north; give north=/TOPIC\. Topics with images: /pair0/left",
            "no stereo pair has images and camera_info",
        ),
        strict=True,
    ):
        with pytest.raises(kind, match=message):
            future.result()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ros2:imu", "topics are named by options"),
        ("ros2:?cam9=/a", "no option 'cam9'"),
        ("ros2:?cam0=a", "topics begin with a slash"),
        ("ros2:?domain=1000", "from 0 to 232"),
        ("ros2:?reliable=yes", "choose one of 0, 1"),
        ("ros2:?wait_s=soon", "write a number from 0"),
    ],
)
def test_open_source_bad_option_is_refused(text: str, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        open_live_source(text, small_rig())


def test_open_source_options_must_match_rig() -> None:
    with pytest.raises(SourceError, match="small has no IMU"):
        open_live_source("ros2:?imu=/imu", small_rig().without_imu())
    with pytest.raises(SourceError, match="body is an option for a rig file"):
        open_live_source("ros2:?body=base_link")


def test_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    for act in (lambda: open_live_source("ros2:", small_rig()), list_devices):
        with pytest.raises(MissingExtraError, match=r"cyclonedds: install it with .*graphvio\[ros2\]"):
            act()
