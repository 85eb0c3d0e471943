"""Bags of ROS 1 and ROS 2, and MCAP files, written by the library rosbags."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import write_euroc
from test_sessions import same, written
from typer.testing import CliRunner

from graphvio import FrameSet, load_rig, open_source
from graphvio.cli import app
from graphvio.errors import RigError, SessionError, SourceError
from graphvio.sessions import cdr
from graphvio.sessions.store import open_store
from graphvio.sources.description import describe

pytest.importorskip("mcap")
pytest.importorskip("rosbags")

LATE_NS = 3_000_000
Message = tuple[str, str, int, bytes]  # topic, type, when it was recorded, CDR
Change = Callable[[Message], Message | None]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("bags") / "walk", frames=6)


def messages(recording: Path, folder: Path) -> list[Message]:
    """All messages of a session of the recording, recorded a little after they were measured."""
    file = open_store(written(recording, folder / "session.mcap"))
    found = [
        (topic.name, topic.type_name, logged_ns + LATE_NS, file.read(place))
        for topic in file.topics.values()
        if not topic.name.startswith("/rosout")
        for logged_ns, place in zip(topic.logged_ns, topic.places, strict=True)
    ]
    return sorted(found, key=lambda message: message[2])


def ros2_bag(messages: list[Message], path: Path, storage: str) -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage]) as writer:
        connections: dict[str, Any] = {}
        for topic, type_name, logged_ns, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=types)
            writer.write(connections[topic], logged_ns, data)
    return path


def ros1_bag(messages: list[Message], path: Path) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))

    def old(message: Any) -> Any:
        """The ROS 1 message."""
        if isinstance(message, list):
            return [old(each) for each in message]
        name = getattr(message, "__msgtype__", None)
        if name is None:
            return message
        fields = {key: old(value) for key, value in vars(message).items() if key != "__msgtype__"}
        if name == "std_msgs/msg/Header":
            fields["seq"] = 7
        if name == "sensor_msgs/msg/CameraInfo":
            fields = {key.upper() if len(key) == 1 else key: value for key, value in fields.items()}
        return types.types[name](**fields)

    with Writer(path) as writer:
        connections: dict[str, Any] = {}
        for topic, type_name, logged_ns, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=types)
            message = types.serialize_ros1(old(cdr.decode(data, type_name)), type_name)
            writer.write(connections[topic], logged_ns, message)
    return path


def bag(kind: str, messages: list[Message], folder: Path) -> Path:
    if kind == "ros1":
        return ros1_bag(messages, folder / "walk.bag")
    made = ros2_bag(messages, folder / "walk", "MCAP" if kind.startswith("mcap") else "SQLITE3")
    return next(made.glob("*" + kind.removesuffix(" file"))) if kind.endswith(" file") else made


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap", "db3 file", "mcap file"])
def test_bag_yields_the_recorded_measurements(kind: str, recording: Path, tmp_path: Path) -> None:
    original = open_source(recording)
    path = bag(kind, messages(recording, tmp_path), tmp_path)
    source = open_source(path, original.rig)
    measurements, expected = list(source), list(original)
    assert len(measurements) == len(expected)
    for one, other in zip(measurements, expected, strict=True):
        same(one, other)


@pytest.mark.parametrize("kind", ["ros1", "db3"])
def test_bag_has_the_rig_of_its_messages(kind: str, recording: Path, tmp_path: Path) -> None:
    expected = open_source(recording).rig
    source = open_source(bag(kind, messages(recording, tmp_path), tmp_path))
    assert [pair.name for pair in source.rig.pairs] == ["pair0", "pair1"]
    assert source.rig.imu is not None
    for one, other in zip(source.rig.cameras, expected.cameras, strict=True):
        np.testing.assert_allclose(one.intrinsics, other.intrinsics)
        np.testing.assert_allclose(one.distortion, other.distortion)
        np.testing.assert_allclose(one.body_T_cam, other.body_T_cam, atol=1e-9)
    assert len([measurement for measurement in source if isinstance(measurement, FrameSet)]) == 6


def test_bag_without_right_transform_takes_the_baseline_of_the_projection(recording: Path, tmp_path: Path) -> None:
    """As drivers of stereo cameras do: both cameras in one frame, and the baseline in ``camera_info``."""

    def change(message: Message) -> Message | None:
        topic, type_name, logged_ns, data = message
        if topic.startswith("/pair1") or topic == "/imu" or topic == "/tf_static":
            return None
        if topic == "/pair0/right/camera_info":
            info = cdr.decode(data, type_name)
            info.header.frame_id = "cam0"
            info.p = np.array(info.p)
            info.p[3] = -info.p[0] * 0.12
            return topic, type_name, logged_ns, cdr.encode(info)
        return message

    changed = [each for message in messages(recording, tmp_path) if (each := change(message)) is not None]
    source = open_source(bag("db3", changed, tmp_path))
    assert source.rig.imu is None
    (pair,) = source.rig.pairs
    assert pair.baseline_m == pytest.approx(0.12)
    np.testing.assert_allclose(pair.left.body_T_cam, np.eye(4))


def test_topics_of_other_names_are_mapped(recording: Path, tmp_path: Path) -> None:
    def renamed(message: Message) -> Message:
        topic, *others = message
        names = {"/pair0/left/image_raw": "/a", "/pair0/right/image_raw": "/b", "/imu": "/c"}
        return (names.get(topic, topic), *others)  # type: ignore[return-value]

    path = bag("db3", [renamed(message) for message in messages(recording, tmp_path)], tmp_path)
    rig = open_source(recording).rig.with_pairs([0])
    odd = replace(rig, pairs=(replace(rig.pairs[0], name="other"),))
    with pytest.raises(SourceError, match="has no images of camera cam0"):
        open_source(path, odd)
    source = open_source(path, odd, topics={"cam0": "/a", "cam1": "/b", "imu": "/c"})
    assert source.rig.imu is not None
    assert len([measurement for measurement in source if isinstance(measurement, FrameSet)]) == 6
    with pytest.raises(SourceError, match="has no topic /d; it has /a, /b, /c"):
        open_source(path, odd, topics={"cam0": "/d"})
    with pytest.raises(SourceError, match="the rig has no cam7 to be mapped"):
        open_source(path, odd, topics={"cam7": "/a"})
    with pytest.raises(SourceError, match="has no topics to be mapped"):
        open_source(recording, topics={"cam0": "/a"})
    done = CliRunner().invoke(app, ["convert", str(path), "--topics", "cam0", "--out", str(tmp_path / "x.mcap")])
    assert "give NAME=TOPIC separated by commas" in str(done.exception)


def test_bag_without_transforms_or_calibration_is_refused(recording: Path, tmp_path: Path) -> None:
    made = messages(recording, tmp_path)
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    without_places = [message for message in made if message[0] != "/tf_static"]
    with pytest.raises(RigError, match="no transform leads from the IMU"):
        open_source(bag("db3", without_places, tmp_path / "one"))
    without_infos = [message for message in made if "camera_info" not in message[0]]
    with pytest.raises(RigError, match="carries no calibration"):
        open_source(bag("db3", without_infos, tmp_path / "two"))


def test_describe_gives_the_latency(recording: Path, tmp_path: Path) -> None:
    found = describe(bag("mcap file", messages(recording, tmp_path), tmp_path))
    assert {topic.name: topic.latency_ms for topic in found.topics}["/imu"] == pytest.approx(3.0)


def test_ros2_bag_without_metadata_names_its_files(recording: Path, tmp_path: Path) -> None:
    path = bag("db3", messages(recording, tmp_path), tmp_path)
    (path / "metadata.yaml").unlink()
    file = next(path.glob("*.db3"))
    with pytest.raises(SourceError, match=re.escape(f"holds the recording {file}; give that")):
        open_source(path)
    for name in ("walk_0.db3", "walk_1.db3"):
        (path / name).write_bytes(file.read_bytes())
    file.unlink()
    with pytest.raises(SourceError, match=r"walk_0\.db3.*walk_1\.db3.*ros2 bag reindex"):
        open_source(path)


@pytest.mark.parametrize("content", [b"", b"no database"])
def test_ros2_file_damaged_is_refused(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "walk.db3"
    file.write_bytes(content)
    with pytest.raises(SessionError, match=re.escape(str(file))):
        open_source(file)


def test_damaged_bag_is_refused(recording: Path, tmp_path: Path) -> None:
    path = bag("ros1", messages(recording, tmp_path), tmp_path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(SessionError, match="cannot be read as a bag"):
        open_source(path, load_rig(recording))


def test_rig_command_output_that_is_no_yaml_is_refused(recording: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["rig", str(recording), "--out", str(tmp_path / "rig.txt")])
    assert isinstance(done.exception, RigError)
    assert not (tmp_path / "rig.txt").exists()


def test_rig_command_of_a_session_shows_its_rig(recording: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["rig", str(written(recording, tmp_path / "walk.mcap"))])
    assert done.exit_code == 0, done.stderr
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == ["pair0", "pair1", "IMU"]
