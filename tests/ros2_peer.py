"""What ROS 2's command line sees of a domain, found with cyclonedds and rosbags' types alone: nothing of graphvio.

It lists nodes as ``ros2 node list`` does, endpoints with their nodes as ``ros2 topic info --verbose``, and calls the
parameter services as ``ros2 param`` does, with the header of `rmw_cyclonedds`. Run as a program it prints that as JSON.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl.types import array, bounded_str, float64, int64, sequence, uint8, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.typesys import Stores, get_typestore

ROS = get_typestore(Stores.ROS2_JAZZY)
_LATCHED = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepLast(100))
_CALLS = Qos(
    Policy.Reliability.Reliable(100_000_000),
    Policy.History.KeepLast(1000),
    Policy.Userdata(b"clientid=1.2.3.4;"),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
_TIMEOUT_S = 20.0


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common.msg.dds_.Gid_"):
    data: array[uint8, 16]


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.NodeEntitiesInfo_"):
    node_namespace: bounded_str[256]
    node_name: bounded_str[256]
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_"):
    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]


@dataclass
class ParameterValue(IdlStruct, typename="rcl_interfaces.msg.dds_.ParameterValue_"):
    type: uint8
    bool_value: bool
    integer_value: int64
    double_value: float64
    string_value: str
    byte_array_value: sequence[uint8]
    bool_array_value: sequence[bool]
    integer_array_value: sequence[int64]
    double_array_value: sequence[float64]
    string_array_value: sequence[str]


@dataclass
class Parameter(IdlStruct, typename="rcl_interfaces.msg.dds_.Parameter_"):
    name: str
    value: ParameterValue


@dataclass
class SetParametersResult(IdlStruct, typename="rcl_interfaces.msg.dds_.SetParametersResult_"):
    successful: bool
    reason: str


@dataclass
class ListParametersResult(IdlStruct, typename="rcl_interfaces.msg.dds_.ListParametersResult_"):
    names: sequence[str]
    prefixes: sequence[str]


@dataclass
class FloatingPointRange(IdlStruct, typename="rcl_interfaces.msg.dds_.FloatingPointRange_"):
    from_value: float64
    to_value: float64
    step: float64


@dataclass
class IntegerRange(IdlStruct, typename="rcl_interfaces.msg.dds_.IntegerRange_"):
    from_value: int64
    to_value: int64
    step: uint64


@dataclass
class ParameterDescriptor(IdlStruct, typename="rcl_interfaces.msg.dds_.ParameterDescriptor_"):
    name: str
    type: uint8
    description: str
    additional_constraints: str
    read_only: bool
    dynamic_typing: bool
    floating_point_range: sequence[FloatingPointRange, 1]
    integer_range: sequence[IntegerRange, 1]


def service(name: str, request: dict[str, Any], response: dict[str, Any]) -> tuple[Any, Any]:
    """Make the types of requests and responses, with the header of `rmw_cyclonedds`."""
    header = {"guid": uint64, "seq": int64}
    made = []
    for kind, fields in (("Request", request), ("Response", response)):
        made.append(
            make_idl_struct(
                f"{name}_{kind}", f"rcl_interfaces.srv.dds_.{name}_{kind}_", {**header, **fields}, dataclassify=True
            )
        )
    return made[0], made[1]


SERVICES = {
    "list_parameters": service(
        "ListParameters", {"prefixes": sequence[str], "depth": uint64}, {"result": ListParametersResult}
    ),
    "get_parameters": service("GetParameters", {"names": sequence[str]}, {"values": sequence[ParameterValue]}),
    "get_parameter_types": service("GetParameterTypes", {"names": sequence[str]}, {"types": sequence[uint8]}),
    "describe_parameters": service(
        "DescribeParameters", {"names": sequence[str]}, {"descriptors": sequence[ParameterDescriptor]}
    ),
    "set_parameters": service(
        "SetParameters", {"parameters": sequence[Parameter]}, {"results": sequence[SetParametersResult]}
    ),
    "set_parameters_atomically": service(
        "SetParametersAtomically", {"parameters": sequence[Parameter]}, {"result": SetParametersResult}
    ),
}


def until(get: Callable[[], Any]) -> Any:
    """Wait until something is true, and return it."""
    end_s = time.monotonic() + _TIMEOUT_S
    while not (got := get()):
        if time.monotonic() > end_s:
            raise TimeoutError
        time.sleep(0.02)
    return got


def as_rosbags(sample: Any, type_name: str, header_bytes: int = 0) -> Any:
    """Decode a sample's bytes with rosbags' type."""
    data = sample.serialize(use_version_2=False)
    return ROS.deserialize_cdr(data[:4] + data[4 + header_bytes :], type_name)


class Peer:
    """A participant that looks at the others."""

    def __init__(self, domain: int) -> None:
        self.participant = DomainParticipant(domain)
        topic = Topic(self.participant, "ros_discovery_info", ParticipantEntitiesInfo)
        self._discovery = DataReader(self.participant, topic, qos=_LATCHED)
        self._publications = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication)
        self._subscriptions = BuiltinDataReader(self.participant, BuiltinTopicDcpsSubscription)

    def graph(self) -> dict[str, Any]:
        """Nodes with the topics and types of their writers and readers, once all of them are known."""
        (info,) = until(lambda: self._discovery.read(10))
        checked = as_rosbags(info, "rmw_dds_common/msg/ParticipantEntitiesInfo")
        endpoints: dict[bytes, Any] = {}
        nodes = {}
        for node in checked.node_entities_info_seq:
            gids = {
                "publishes": [bytes(each.data) for each in node.writer_gid_seq],
                "subscribes": [bytes(each.data) for each in node.reader_gid_seq],
            }

            def known(wanted: list[bytes]) -> bool:
                for each in (*self._publications.read(1000), *self._subscriptions.read(1000)):
                    if each.sample_info.valid_data:
                        endpoints[each.key.bytes] = each
                return all(each in endpoints for each in wanted)

            until(lambda: known([*gids["publishes"], *gids["subscribes"]]))  # noqa: B023
            nodes[f"{node.node_namespace.rstrip('/')}/{node.node_name}"] = {
                what: [[endpoints[each].topic_name, endpoints[each].type_name] for each in of]
                for what, of in gids.items()
            }
            participants = {endpoints[each].participant_key.bytes for of in gids.values() for each in of}
            assert participants == {bytes(checked.gid.data)}
        return nodes

    def call(self, node: str, name: str, **request: Any) -> Any:
        """Call a service of a node, whose response has to be the one to this request."""
        sent, received = SERVICES[name]
        writer = DataWriter(
            self.participant, Topic(self.participant, f"rq{node}/{name}Request", sent, qos=_CALLS), qos=_CALLS
        )
        reader = DataReader(
            self.participant, Topic(self.participant, f"rr{node}/{name}Reply", received, qos=_CALLS), qos=_CALLS
        )
        until(lambda: writer.get_matched_subscriptions() and reader.get_matched_publications())
        guid = writer.instance_handle % 2**64
        for number in (7, 8):
            writer.write(sent(guid=guid, seq=number, **request))
        responses: list[Any] = []
        until(lambda: responses.extend(reader.take(10)) or len(responses) >= 2)  # type: ignore[func-returns-value]
        assert [(each.guid, each.seq) for each in responses] == [(guid, 7), (guid, 8)]
        return responses[0]


def _parameter(name: str) -> Parameter:
    return Parameter(name, ParameterValue(2, False, 5, 0.0, "", [], [], [], [], []))


def main(domain: int) -> dict[str, Any]:
    peer = Peer(domain)
    nodes = peer.graph()
    (node,) = nodes
    listed = peer.call(node, "list_parameters", prefixes=[], depth=0).result
    below = peer.call(node, "list_parameters", prefixes=["motion"], depth=1).result
    names = [*listed.names, "unknown"]
    values = peer.call(node, "get_parameters", names=names).values
    kinds = peer.call(node, "get_parameter_types", names=names).types
    descriptors = peer.call(node, "describe_parameters", names=names).descriptors
    checked = [as_rosbags(each, "rcl_interfaces/msg/ParameterValue") for each in values]
    fields = {1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value", 8: "double_array_value"}
    read: list[Any] = [getattr(each, fields[each.type]) if each.type else None for each in checked]
    return {
        "nodes": nodes,
        "listed": asdict(listed),
        "below": asdict(below),
        "values": {
            name: each.tolist() if hasattr(each, "tolist") else each for name, each in zip(names, read, strict=True)
        },
        "kinds": list(kinds),
        "descriptors": [asdict(each) for each in descriptors],
        "set": asdict(peer.call(node, "set_parameters", parameters=[_parameter(each) for each in names[-2:]])),
        "set_all": asdict(peer.call(node, "set_parameters_atomically", parameters=[_parameter(names[0])]).result),
    }


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]))))
