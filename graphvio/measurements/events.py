"""What happens during a run that a person would want to know of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a person would want to know of: a gate, a reset, a fault of the input.

    Attributes:
        stamp_ns: when, on the clock of the data concerned.
        kind: short name that can be counted, such as ``vision_gated`` or ``imu_gap``.
        detail: one line for people, with the figures.
    """

    stamp_ns: int
    kind: str
    detail: str


Report = Callable[[int, str, str], None]
"""Takes stamp, kind and detail of an event."""
