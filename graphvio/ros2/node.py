"""A participant of a DDS domain that reads and writes ROS 2 topics."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from graphvio.errors import ServiceError, SourceError
from graphvio.ros2.wire import Profile, dds_topic, require_dds, ros_topic, ros_type_name, wire_type
from graphvio.sessions import cdr

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

    topic: str  # such as ``/imu``
    type_name: str  # such as ``sensor_msgs/msg/Imu``


class Reader:
    """Reads samples of one topic, in one thread."""

    def __init__(self, node: Node, topic: str, type_name: str, profile: Profile) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        self.topic, self.type_name, self._depth = topic, type_name, profile.depth
        self._reader = DataReader(node.participant, node.topic(topic, type_name), qos=profile.dds(type_name))
        self.ready = ReadCondition(self._reader, SampleState.Any | ViewState.Any | InstanceState.Any)

    def take(self) -> list[bytes]:
        """Return the CDR messages received since the last call, oldest first."""
        return [each.data for each in self._reader.take(self._depth) if each.sample_info.valid_data]

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
    """Publishes messages of one topic; from any thread, and never waits."""

    def __init__(self, node: Node, topic: str, type_name: str, profile: Profile) -> None:
        from cyclonedds.pub import DataWriter

        self.topic, self._type = topic, wire_type(type_name)
        self._writer = DataWriter(node.participant, node.topic(topic, type_name), qos=profile.dds(type_name))
        self.refused = 0

    def write(self, message: Any) -> None:
        """Publish a message; if there is no room for it, it is dropped and counted in ``refused``.

        Raises:
            ServiceError: if DDS refuses it for another reason.
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
        """Number of matching readers."""
        return len(self._writer.get_matched_subscriptions())


class Node:
    """A participant of a domain.

    Raises:
        SourceError: if no network can be used.
        MissingExtraError: if the extra ``ros2`` is not installed.
    """

    def __init__(self, domain: int) -> None:
        require_dds()
        from cyclonedds.core import DDSException, GuardCondition, WaitSet
        from cyclonedds.domain import DomainParticipant

        self.domain = domain
        try:
            self.participant: Any = DomainParticipant(domain)
        except DDSException as error:
            raise SourceError(
                f"DDS domain {domain}: cannot be joined ({error.msg or error}); check the network and CYCLONEDDS_URI"
            ) from None
        self._lock = threading.Lock()
        self._topics: dict[tuple[str, str], Any] = {}
        self._waitset_class = WaitSet
        self._stop: Any = GuardCondition(self.participant)

    def topic(self, name: str, type_name: str) -> Any:
        """Return the topic of DDS, one object for all its endpoints."""
        from cyclonedds.topic import Topic

        with self._lock:
            key = name, type_name
            if key not in self._topics:
                self._topics[key] = Topic(self.participant, dds_topic(name), wire_type(type_name))
            return self._topics[key]

    def waiter(self, readers: Sequence[Reader]) -> Callable[[float], None]:
        """Return a function that waits until a reader has samples, the node is stopped, or so many seconds are over."""
        waitset = self._waitset_class(self.participant)
        for condition in (*(reader.ready for reader in readers), self._stop):
            waitset.attach(condition)

        def wait(timeout_s: float) -> None:
            waitset.wait(round(timeout_s * _NS_PER_S))

        return wait

    def publications(self) -> list[Publication]:
        """Return the known publications of others; discovery takes about a second after the node is made."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

        found = []
        for each in BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication).read(4096):
            topic, type_name = ros_topic(each.topic_name), ros_type_name(each.type_name)
            if topic is not None and type_name is not None and each.sample_info.valid_data:
                found.append(Publication(topic, type_name))
        return found

    def stop(self) -> None:
        """Wake all waiters, now and from now on; from any thread."""
        if self._stop is not None:
            self._stop.set(True)

    def leave(self) -> None:
        """Release the domain; it is left when readers and writers are released, too."""
        with self._lock:
            self._topics.clear()
            self._stop = self.participant = None
