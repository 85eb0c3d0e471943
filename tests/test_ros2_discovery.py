"""The publisher as ROS 2's command line sees it: node, topics and parameters, read by a process without graphvio."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from ros2_loopback import URI, free_domain
from test_ros2_publisher import Running

from graphvio.config import Config
from graphvio.errors import SessionError
from graphvio.ros2 import interfaces
from graphvio.ros2.parameters import Parameters, flatten
from graphvio.ros2.publisher import Publisher
from graphvio.ros2.services import split_header, with_header
from graphvio.ros2.wire import dds_type_name, idl_struct

PARAMETERS = {**flatten(asdict(Config())), "frames.base": "base_link", "frames.imu": "imu_link"}
SERVICES = {
    "list_parameters": "ListParameters",
    "get_parameters": "GetParameters",
    "get_parameter_types": "GetParameterTypes",
    "describe_parameters": "DescribeParameters",
    "set_parameters": "SetParameters",
    "set_parameters_atomically": "SetParametersAtomically",
}


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """What a process with cyclonedds and rosbags' types alone sees."""
    domain, here = free_domain(), Path(__file__).resolve().parent
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CYCLONEDDS_URI", URI)
        with Publisher(Running(), domain, "/robot/graphvio", parameters=flatten(asdict(Config()))) as publisher:
            done = subprocess.run(
                [sys.executable, "ros2_peer.py", str(domain)],
                cwd=here,
                env={key: value for key, value in os.environ.items() if key != "PYTHONPATH"},
                capture_output=True,
                text=True,
                timeout=100,
            )
            publisher.check()
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def test_node_has_its_topics_and_services(seen: dict[str, Any]) -> None:
    assert list(seen["nodes"]) == ["/robot/graphvio"]
    node = seen["nodes"]["/robot/graphvio"]
    topics = {
        "rt/robot/graphvio/odometry": "nav_msgs/msg/Odometry",
        "rt/robot/graphvio/path": "nav_msgs/msg/Path",
        "rt/robot/graphvio/landmarks": "sensor_msgs/msg/PointCloud2",
        "rt/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
        "rt/tf": "tf2_msgs/msg/TFMessage",
        "rt/tf_static": "tf2_msgs/msg/TFMessage",
    }
    replies = {
        f"rr/robot/graphvio/{name}Reply": f"rcl_interfaces/srv/{kind}_Response" for name, kind in SERVICES.items()
    }
    requests = {
        f"rq/robot/graphvio/{name}Request": f"rcl_interfaces/srv/{kind}_Request" for name, kind in SERVICES.items()
    }
    correction = {"rt/robot/graphvio/correction": "geometry_msgs/msg/PoseWithCovarianceStamped"}
    for what, expected in (("publishes", {**topics, **replies}), ("subscribes", {**correction, **requests})):
        assert dict(node[what]) == {name: dds_type_name(kind) for name, kind in expected.items()}
        assert len(node[what]) == len(expected)


def test_parameters_are_listed_and_read(seen: dict[str, Any]) -> None:
    values = dict(seen["values"])
    assert values.pop("unknown") is None
    base_T_imu = values.pop("frames.base_T_imu")
    np.testing.assert_allclose(
        base_T_imu, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    )  # the small rig's IMU has REP 103's axes
    assert values == PARAMETERS
    names = sorted([*PARAMETERS, "frames.base_T_imu"])
    assert seen["listed"]["names"] == names
    assert seen["listed"]["prefixes"] == sorted({name.rpartition(".")[0] for name in names})
    assert seen["below"] == {"names": [each for each in names if each.startswith("motion.")], "prefixes": ["motion"]}
    kinds = {bool: 1, int: 2, float: 3, str: 4}
    expected = [8 if name == "frames.base_T_imu" else kinds[type(PARAMETERS[name])] for name in names]
    assert seen["kinds"] == [*expected, 0]
    described = [(each["name"], each["type"], each["read_only"]) for each in seen["descriptors"]]
    assert described == [(name, kind, True) for name, kind in zip(names, expected, strict=True)] + [
        ("unknown", 0, False)
    ]


def test_parameters_cannot_be_set(seen: dict[str, Any]) -> None:
    known, unknown = seen["set"]["results"]
    assert not known["successful"]
    assert "read-only" in known["reason"]
    assert unknown == {"successful": False, "reason": "unknown: no such parameter"}
    assert not seen["set_all"]["successful"]


@pytest.mark.parametrize(
    ("prefixes", "depth", "names"),
    [
        ([], 0, ["a", "a.b", "a.b.c", "ab.c"]),
        ([], 1, ["a"]),
        ([], 2, ["a", "a.b", "ab.c"]),
        (["a"], 0, ["a", "a.b", "a.b.c"]),
        (["a"], 1, ["a", "a.b"]),
        (["a.b"], 1, ["a.b", "a.b.c"]),
        (["other"], 0, []),
    ],
)
def test_list_parameters_has_depth_and_prefixes_of_ros(prefixes: list[str], depth: int, names: list[str]) -> None:
    request = interfaces.make(interfaces.request_type("ListParameters"), prefixes=prefixes, depth=depth)
    parameters = Parameters({"a": 1, "a.b": 2, "a.b.c": 3, "ab.c": 4})
    assert parameters.answer("ListParameters", request).result.names == names


def test_header_is_inserted_and_split_in_both_byte_orders() -> None:
    message = interfaces.encode(interfaces.make(interfaces.request_type("ListParameters"), prefixes=["abc"], depth=2))
    sample = with_header((2**63 + 5, 7), message)
    assert split_header(sample) == ((2**63 + 5, 7), message)
    decoded = idl_struct(interfaces.request_type("ListParameters")).deserialize(sample)
    assert (decoded.guid, decoded.seq, decoded.prefixes, decoded.depth) == (2**63 + 5, 7, ["abc"], 2)
    assert decoded.serialize(use_version_2=False) == sample
    big = bytes([0, 0, 0, 0]) + (3).to_bytes(8, "big") + (4).to_bytes(8, "big") + b"text"
    assert split_header(big) == ((3, 4), bytes(4) + b"text")
    with pytest.raises(SessionError, match="19 bytes has no header"):
        split_header(sample[:19])


@pytest.mark.parametrize(("distribution", "size"), [("humble", 24), ("jazzy", 16), ("", 16)])
def test_identifiers_have_the_size_of_the_distribution(
    distribution: str, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DISTRO", distribution)
    interfaces.types.cache_clear()
    try:
        message = interfaces.entities(bytes(range(16)), "/robot/graphvio", [bytes(16)], [])
        assert bytes(message.gid.data) == bytes(range(16)).ljust(size, b"\0")
        (node,) = (
            interfaces.types().deserialize_cdr(interfaces.encode(message), interfaces.DISCOVERY).node_entities_info_seq
        )
        assert (node.node_namespace, node.node_name) == ("/robot", "graphvio")
        assert [len(each.data) for each in node.reader_gid_seq] == [size]
    finally:
        interfaces.types.cache_clear()


def test_closed_publisher_leaves_no_node(monkeypatch: pytest.MonkeyPatch) -> None:
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
    from cyclonedds.core import InstanceState
    from cyclonedds.domain import DomainParticipant

    monkeypatch.setenv("CYCLONEDDS_URI", URI)
    domain = free_domain()
    here = DomainParticipant(domain)
    reader = BuiltinDataReader(here, BuiltinTopicDcpsParticipant)

    def others() -> int:
        alive = [each for each in reader.read(100) if each.sample_info.instance_state == InstanceState.Alive]
        return sum(each.key != here.guid for each in alive)

    with Publisher(Running(), domain):
        assert others() == 1
    end_s = time.monotonic() + 10.0
    while others() and time.monotonic() < end_s:
        time.sleep(0.02)
    assert others() == 0
