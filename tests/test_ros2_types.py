"""Types on the wire: two libraries must encode a message to the same bytes, and decode these to the same message."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from rosbags.interfaces import Nodetype

from graphvio.errors import SourceError
from graphvio.ros2 import interfaces
from graphvio.ros2.node import domain_of
from graphvio.ros2.wire import (
    DEFAULT,
    SENSOR_DATA,
    TF,
    TF_STATIC,
    Profile,
    dds_topic,
    dds_type_name,
    idl_struct,
    ros_topic,
    ros_type_name,
    wire_type,
)
from graphvio.sessions import cdr

TYPES = [
    "std_msgs/msg/Header",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/PointCloud2",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path",
    "tf2_msgs/msg/TFMessage",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "diagnostic_msgs/msg/DiagnosticArray",
    "rmw_dds_common/msg/ParticipantEntitiesInfo",
    "rcl_interfaces/msg/ListParametersResult",
    "rcl_interfaces/msg/ParameterValue",
    "rcl_interfaces/msg/ParameterDescriptor",
    "rcl_interfaces/msg/SetParametersResult",
]
WORDS = ["", "a", "odom", "base_link", "Köln"]


def random_message(rng: np.random.Generator, type_name: str, length: int) -> Any:
    """A message of random values; strings of all lengths put the following fields at all alignments."""

    def value(kind: Any) -> Any:
        node, what = kind
        if node == Nodetype.NAME:
            return random_message(rng, what, length)
        if node == Nodetype.BASE:
            name = what[0]
            if name == "string":
                return str(rng.choice(WORDS))
            if name == "bool":
                return bool(rng.integers(2))
            return float(rng.normal()) if name.startswith("float") else int(rng.integers(0, 100))
        of, count = what
        count = count if node == Nodetype.ARRAY else min(length, count or length)
        made = [value(of) for _ in range(count)]
        is_list = of[0] == Nodetype.NAME or of[1][0] == "string"
        return made if is_list else np.array(made, dtype={"char": "uint8", "byte": "uint8"}.get(of[1][0], of[1][0]))

    _, fields = interfaces.types().fielddefs[type_name]
    return interfaces.make(type_name, **{name: value(kind) for name, kind in fields})


def same(one: Any, other: Any) -> None:
    """A message of rosbags and one of cyclonedds hold the same."""
    if hasattr(one, "__msgtype__"):
        for name, _ in interfaces.types().fielddefs[one.__msgtype__][1]:
            same(getattr(one, name), getattr(other, name))
    elif isinstance(one, list | np.ndarray):
        assert len(one) == len(other)
        for first, second in zip(one, other, strict=True):
            same(first, second)
    else:
        assert one == other


@pytest.mark.parametrize("length", [0, 1, 3])
@pytest.mark.parametrize("type_name", TYPES)
def test_types_agree_between_libraries(type_name: str, length: int) -> None:
    rng = np.random.default_rng(length)
    for _ in range(10):
        message = random_message(rng, type_name, length)
        data = interfaces.encode(message)
        decoded = idl_struct(type_name).deserialize(data)
        same(message, decoded)
        encoded = decoded.serialize(use_version_2=False)
        assert encoded == data
        same(cdr.decode(encoded, type_name, known=interfaces.types()), decoded)


def test_names_match_ros() -> None:
    assert dds_type_name("sensor_msgs/msg/Image") == "sensor_msgs::msg::dds_::Image_"
    assert ros_type_name("sensor_msgs::msg::dds_::Image_") == "sensor_msgs/msg/Image"
    assert ros_type_name("DDS::Chatter") is None
    assert dds_topic("/front/image_raw") == "rt/front/image_raw"
    assert ros_topic("rt/front/image_raw") == "/front/image_raw"
    assert ros_topic("rq/some_serviceRequest") is None
    assert wire_type("sensor_msgs/msg/Image").__idl_typename__ == "sensor_msgs.msg.dds_.Image_"


@pytest.mark.parametrize(
    ("profile", "is_reliable", "is_latched"),
    [(SENSOR_DATA, False, False), (DEFAULT, True, False), (TF, True, False), (TF_STATIC, True, True)],
)
def test_profile_matches_ros(profile: Profile, is_reliable: bool, is_latched: bool) -> None:
    from cyclonedds.qos import Policy

    qos = profile.dds("sensor_msgs/msg/Imu")
    assert (qos[Policy.Reliability] == Policy.Reliability.BestEffort) != is_reliable
    durability = Policy.Durability.TransientLocal if is_latched else Policy.Durability.Volatile
    assert qos[Policy.Durability] == durability
    assert qos[Policy.History] == Policy.History.KeepLast(profile.depth)
    assert Policy.Partition not in qos
    assert qos[Policy.Userdata].data == (  # of sensor_msgs/msg/Imu in ROS 2 Jazzy
        b"typehash=RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b;"
    )


def test_domain_of_matches_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "17")
    assert domain_of(None) == 17
    assert domain_of("3") == 3
    monkeypatch.setenv("ROS_DOMAIN_ID", "seventeen")
    with pytest.raises(SourceError, match="ROS_DOMAIN_ID is 'seventeen'"):
        domain_of(None)
    monkeypatch.delenv("ROS_DOMAIN_ID")
    assert domain_of(None) == 0
    with pytest.raises(SourceError, match="from 0 to 232"):
        domain_of("233")
