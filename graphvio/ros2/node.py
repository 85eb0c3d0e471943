"""A participant of a DDS domain that writes and reads ROS 2 topics."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from graphvio.errors import ServiceError, SourceError
from graphvio.ros2.qos import Profile
from graphvio.ros2.types import dds, dds_topic, ros_topic, ros_type_name, wire_type
from graphvio.sessions import cdr

_DOMAIN_VARIABLE: Final = "ROS_DOMAIN_ID"
_LAST_DOMAIN: Final = 232
_NS_PER_S: Final = 1_000_000_000


def domain_of(text: str | None) -> int:
    """The number of a domain: as given, or else by ``ROS_DOMAIN_ID``, or else 0.

    Raises:
        SourceError: if it is none.
    """
    where, given = ("domain", text) if text is not None else (_DOMAIN_VARIABLE, os.environ.get(_DOMAIN_VARIABLE, ""))
    if not given:
        return 0
    if not given.isdecimal() or int(given) > _LAST_DOMAIN:
        raise SourceError(f"{where} is {given!r}; a domain of ROS 2 is a number from 0 to {_LAST_DOMAIN}")
    return int(given)


@dataclass(frozen=True, slots=True)
class Publication:
    """Somebody publishes a topic.

    Attributes:
        topic: such as ``/imu``.
        type_name: such as ``sensor_msgs/msg/Imu``.
        is_reliable: whether what is lost can be sent again.
    """

    topic: str
    type_name: str
    is_reliable: bool


@dataclass(frozen=True, slots=True)
class Sample:
    """What came.

    Attributes:
        data: the message, CDR.
        sent_ns: when it was written, by the writer's host.
    """

    data: bytes
    sent_ns: int


class Reader:
    """Samples of one topic; use one from one thread."""

    def __init__(self, node: Node, topic: str, type_name: str, profile: Profile) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        self.topic, self.type_name, self._depth = topic, type_name, profile.depth
        self._reader = DataReader(node.participant, node.topic(topic, type_name), qos=profile.dds(type_name))
        self.ready = ReadCondition(self._reader, SampleState.Any | ViewState.Any | InstanceState.Any)

    def take(self) -> list[Sample]:
        """What came since the last call, the oldest first."""
        return [
            Sample(each.data, each.sample_info.source_timestamp)
            for each in self._reader.take(self._depth)
            if each.sample_info.valid_data
        ]

    @property
    def writers(self) -> int:
        """How many there are whose samples would come, and who are alive."""
        return int(self._reader.get_liveliness_changed_status().alive_count)

    @property
    def lost(self) -> int:
        """Samples that never came, so far as the protocol could tell."""
        return int(self._reader.get_sample_lost_status().total_count)

    @property
    def refused_writers(self) -> int:
        """How many offered less than is asked for: best effort where reliable was asked for."""
        return int(self._reader.get_requested_incompatible_qos_status().total_count)


class Writer:
    """Publishes messages of one topic; from any thread, and never waits."""

    def __init__(self, node: Node, topic: str, type_name: str, profile: Profile) -> None:
        from cyclonedds.pub import DataWriter

        self.topic, self._type = topic, wire_type(type_name)
        self._writer = DataWriter(node.participant, node.topic(topic, type_name), qos=profile.dds(type_name))
        self.refused = 0

    def write(self, message: Any) -> None:
        """Publish a message; it is dropped, and counted in ``refused``, where there is no room for it.

        Raises:
            ServiceError: if DDS does not take it for another reason.
        """
        from cyclonedds.core import DDSException

        try:
            self._writer.write(self._type(cdr.encode(message)))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise ServiceError(f"{self.topic}: cannot be published ({error.msg or error})") from None
            self.refused += 1

    @property
    def readers(self) -> int:
        """How many listen."""
        return len(self._writer.get_matched_subscriptions())


class Node:
    """A participant.

    Args:
        domain: see `domain_of`.

    Raises:
        SourceError: if no network can be used.
        MissingExtraError: if the extra ``ros2`` is not installed.
    """

    def __init__(self, domain: int) -> None:
        dds()
        from cyclonedds.core import DDSException, GuardCondition, WaitSet
        from cyclonedds.domain import DomainParticipant

        self.domain = domain
        try:
            self.participant: Any = DomainParticipant(domain)
        except DDSException as error:
            raise SourceError(
                f"DDS domain {domain}: cannot be joined ({error.msg or error}); check the network, and what "
                "CYCLONEDDS_URI says of it"
            ) from None
        self._lock = threading.Lock()
        self._topics: dict[tuple[str, str], Any] = {}
        self._waitset_class = WaitSet
        self._stop: Any = GuardCondition(self.participant)

    def topic(self, name: str, type_name: str) -> Any:
        """The topic of DDS; one object for all who use it."""
        from cyclonedds.topic import Topic

        with self._lock:
            key = name, type_name
            if key not in self._topics:
                self._topics[key] = Topic(self.participant, dds_topic(name), wire_type(type_name))
            return self._topics[key]

    def reader(self, topic: str, type_name: str, profile: Profile) -> Reader:
        """Listen to a topic."""
        return Reader(self, topic, type_name, profile)

    def writer(self, topic: str, type_name: str, profile: Profile) -> Writer:
        """Publish a topic."""
        return Writer(self, topic, type_name, profile)

    def waiter(self, readers: Sequence[Reader]) -> Waiter:
        """Waits for samples of several topics."""
        waitset = self._waitset_class(self.participant)
        for reader in readers:
            waitset.attach(reader.ready)
        waitset.attach(self._stop)
        return Waiter(waitset)

    def publications(self) -> list[Publication]:
        """What others publish, as far as it is known by now: give discovery a second after the start."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
        from cyclonedds.qos import Policy

        found = []
        for each in BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication).read(4096):
            topic, type_name = ros_topic(each.topic_name), ros_type_name(each.type_name)
            if topic is not None and type_name is not None and each.sample_info.valid_data:
                is_reliable = each.qos[Policy.Reliability] != Policy.Reliability.BestEffort
                found.append(Publication(topic, type_name, is_reliable))
        return found

    def stop(self) -> None:
        """Wake all waiters, now and from now on; from any thread."""
        if self._stop is not None:
            self._stop.set(True)

    def leave(self) -> None:
        """Hold the domain no more: it is left when readers and writers are gone, too."""
        with self._lock:
            self._topics.clear()
            self._stop = self.participant = None


class Waiter:
    """See `Node.waiter`."""

    def __init__(self, waitset: Any) -> None:
        self._waitset = waitset

    def wait(self, timeout_s: float) -> None:
        """Until something is there to be taken, the node is stopped, or the time is over."""
        self._waitset.wait(round(timeout_s * _NS_PER_S))
