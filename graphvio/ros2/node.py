"""A participant of a DDS domain that reads and writes ROS 2 topics."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from graphvio.errors import ServiceError, SourceError
from graphvio.ros2 import interfaces
from graphvio.ros2.wire import TF_STATIC, Profile, dds_topic, require_dds, ros_topic, ros_type_name, wire_type

_DOMAIN_VARIABLE: Final = "ROS_DOMAIN_ID"
_MAX_DOMAIN: Final = 232
_NS_PER_S: Final = 1_000_000_000


def domain_of(text: str | None) -> int:
    """Parse the number of a domain; None stands for ``ROS_DOMAIN_ID``, or 0 if that is not set.

    Raises:
        SourceError: if it is no such number.
    """
    where, given = ("domain", text) if text is not None else (_DOMAIN_VARIABLE, os.environ.get(_DOMAIN_VARIABLE, ""))
    if not given:
        return 0
    if not given.isdecimal() or int(given) > _MAX_DOMAIN:
        raise SourceError(f"{where} is {given!r}; a domain of ROS 2 is a number from 0 to {_MAX_DOMAIN}")
    return int(given)


@dataclass(frozen=True, slots=True)
class Publication:
    """A topic that another participant publishes."""

    topic: str  # name of the topic, such as ``/imu``
    type_name: str  # type of its messages, such as ``sensor_msgs/msg/Imu``


class Reader:
    """Reads the samples of one topic, in one thread.

    Args:
        node: node that the reader belongs to.
        topic: name of the topic, such as ``/imu``.
        type_name: type of its messages, such as ``sensor_msgs/msg/Imu``.
        profile: quality of service.
        prefix: prefix of the topic's name in DDS, such as ``rq`` for the requests of a service.
        user_data: user data of the endpoint in DDS, such as a service's identity; empty for topics.
    """

    def __init__(
        self, node: Node, topic: str, type_name: str, profile: Profile, prefix: str = "rt", user_data: str = ""
    ) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        self.topic, self.type_name, self._depth = topic, type_name, profile.depth
        of_dds = node.topic(dds_topic(topic, prefix), type_name)
        self._reader = DataReader(node.participant, of_dds, qos=profile.dds(type_name, user_data))
        self.ready = ReadCondition(self._reader, SampleState.Any | ViewState.Any | InstanceState.Any)
        node.reader_gids.append(self._reader.guid.bytes)

    def take(self) -> list[bytes]:
        """Return the CDR messages received since the last call, oldest first."""
        return [data for data, _ in self.take_with_writers()]

    def take_with_writers(self) -> list[tuple[bytes, int]]:
        """Return the CDR messages received since the last call, oldest first, each with the handle of its writer."""
        taken = self._reader.take(self._depth)
        return [(each.data, each.sample_info.publication_handle) for each in taken if each.sample_info.valid_data]

    def user_data_of(self, writer: int) -> dict[str, str]:
        """Return the entries of a writer's user data by name; empty if the writer is gone."""
        return _user_data(self._reader.get_matched_publication_data(writer))

    @property
    def writers(self) -> int:
        """Number of matching writers that are alive."""
        return int(self._reader.get_liveliness_changed_status().alive_count)

    @property
    def lost(self) -> int:
        """Number of samples that the protocol knows to be lost."""
        return int(self._reader.get_sample_lost_status().total_count)

    @property
    def refused_writers(self) -> int:
        """Number of writers whose quality of service is too low: best effort where reliable was requested."""
        return int(self._reader.get_requested_incompatible_qos_status().total_count)


class Writer:
    """Publishes messages of one topic, from any thread and without waiting; see `Reader` for the arguments.

    Attributes:
        refused: number of messages that were dropped.
    """

    def __init__(
        self, node: Node, topic: str, type_name: str, profile: Profile, prefix: str = "rt", user_data: str = ""
    ) -> None:
        from cyclonedds.pub import DataWriter

        self.topic, self._type = topic, wire_type(type_name)
        of_dds = node.topic(dds_topic(topic, prefix), type_name)
        self._writer = DataWriter(node.participant, of_dds, qos=profile.dds(type_name, user_data))
        self.refused = 0
        node.writer_gids.append(self._writer.guid.bytes)

    def write(self, message: Any) -> None:
        """Publish a message; if there is no room for it, it is dropped and counted in ``refused``.

        Raises:
            ServiceError: if DDS refuses it for another reason.
        """
        self.write_bytes(interfaces.encode(message))

    def write_bytes(self, data: bytes) -> None:
        """Publish a CDR message; see `write`."""
        from cyclonedds.core import DDSException

        try:
            self._writer.write(self._type(data))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise ServiceError(f"{self.topic}: cannot be published ({error.msg or error})") from None
            self.refused += 1

    @property
    def readers(self) -> int:
        """Number of matching readers."""
        return len(self._writer.get_matched_subscriptions())

    def user_data_of_readers(self) -> list[dict[str, str]]:
        """Return the entries of the user data of each matching reader, by name."""
        readers = self._writer.get_matched_subscriptions()
        return [_user_data(self._writer.get_matched_subscription_data(each)) for each in readers]


class Node:
    """A participant of a DDS domain, which becomes a ROS 2 node when it is announced.

    Attributes:
        domain: number of the domain.
        reader_gids: identifiers of its readers, 16 bytes each.
        writer_gids: identifiers of its writers, 16 bytes each.

    Raises:
        SourceError: if no network can be used.
        MissingExtraError: if the extra ``ros2`` is not installed.
    """

    def __init__(self, domain: int) -> None:
        require_dds()
        from cyclonedds.core import DDSException, GuardCondition, WaitSet
        from cyclonedds.domain import DomainParticipant
        from cyclonedds.qos import Policy, Qos

        self.domain = domain
        try:
            self.participant: Any = DomainParticipant(domain, qos=Qos(Policy.Userdata(b"enclave=/;")))
        except DDSException as error:
            raise SourceError(
                f"DDS domain {domain}: cannot be joined ({error.msg or error}); check the network and CYCLONEDDS_URI"
            ) from None
        self._lock = threading.Lock()
        self._topics: dict[tuple[str, str], Any] = {}
        self.reader_gids: list[bytes] = []
        self.writer_gids: list[bytes] = []
        self._services = 0
        self._discovery: Writer | None = None
        self._waitset_class = WaitSet
        self._stop: Any = GuardCondition(self.participant)

    def topic(self, dds_name: str, type_name: str) -> Any:
        """Return the DDS topic with a name and a type; all its endpoints share one object."""
        from cyclonedds.topic import Topic

        with self._lock:
            key = dds_name, type_name
            if key not in self._topics:
                self._topics[key] = Topic(self.participant, dds_name, wire_type(type_name))
            return self._topics[key]

    def next_service_id(self) -> str:
        """Return an identity for a service's reader and writer, in the notation of `rmw_cyclonedds`."""
        self._services += 1
        identity = self.participant.guid.bytes[:12] + self._services.to_bytes(4, "big")
        return ".".join(f"{each:x}" for each in identity)

    def announce(self, name: str) -> None:
        """Announce a node, such as ``/graphvio``, with the readers and writers that have been made so far."""
        readers, writers = list(self.reader_gids), list(self.writer_gids)
        self._discovery = Writer(self, interfaces.DISCOVERY_TOPIC, interfaces.DISCOVERY, TF_STATIC, prefix="")
        self._discovery.write(interfaces.entities(self.participant.guid.bytes, name, readers, writers))

    def waiter(self, readers: Sequence[Reader]) -> Callable[[float], None]:
        """Return a function that waits until a reader has samples, the node is stopped, or a timeout (s) is over."""
        waitset = self._waitset_class(self.participant)
        for condition in (*(reader.ready for reader in readers), self._stop):
            waitset.attach(condition)

        def wait(timeout_s: float) -> None:
            waitset.wait(round(timeout_s * _NS_PER_S))

        return wait

    def publications(self) -> list[Publication]:
        """Return the publications that have been discovered in the domain; a new node needs about a second for it."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

        found = []
        for each in BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication).read(4096):
            topic, type_name = ros_topic(each.topic_name), ros_type_name(each.type_name)
            if topic is not None and type_name is not None and each.sample_info.valid_data:
                found.append(Publication(topic, type_name))
        return found

    def stop(self) -> None:
        """End the waits of all functions of `waiter`, now and later; may be called from any thread."""
        if self._stop is not None:
            self._stop.set(True)

    def leave(self) -> None:
        """Release the participant; it leaves the domain as soon as its readers and writers are released, too."""
        with self._lock:
            self._topics.clear()
            self._discovery = None
            self._stop = self.participant = None


def _user_data(endpoint: Any) -> dict[str, str]:
    """Parse the user data of an endpoint, such as ``typehash=...;clientid=...;``; empty if there is none."""
    from cyclonedds.qos import Policy

    if endpoint is None or Policy.Userdata not in endpoint.qos:
        return {}
    entries = endpoint.qos[Policy.Userdata].data.decode(errors="replace").split(";")
    return {name: value for name, _, value in (each.partition("=") for each in entries) if name}
