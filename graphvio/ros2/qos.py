"""Qualities of service, as ROS 2 has them (`rmw_qos_profiles.h`) and by DDS's names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from graphvio.sessions import cdr


@dataclass(frozen=True, slots=True)
class Profile:
    """How samples are kept and sent again.

    Attributes:
        depth: how many of the newest samples are kept.
        is_reliable: whether lost samples are sent again.
        is_latched: whether readers that come late get the kept samples, too (transient local).
    """

    depth: int = 10
    is_reliable: bool = True
    is_latched: bool = False

    def dds(self, type_name: str) -> Any:
        """The policies of an endpoint; a writer never waits for readers that do not keep up.

        ROS 2 from Iron on expects the type's hash in the user data; older ones ignore it.
        """
        from cyclonedds.qos import Policy, Qos

        return Qos(
            Policy.Reliability.Reliable(max_blocking_time=0) if self.is_reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if self.is_latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(self.depth),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(f"typehash={cdr.types().hash_rihs01(type_name)};".encode()),
        )


DEFAULT = Profile()
SENSOR_DATA = Profile(depth=5, is_reliable=False)
TF = Profile(depth=100)
TF_STATIC = Profile(depth=1, is_latched=True)
"""Of those who publish."""
TF_STATIC_READER = Profile(depth=100, is_latched=True)
"""Of those who listen: there may be several who publish."""
