"""One step of the odometry with all that went into it: what an optimisation of the whole session starts from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from graphvio.measurements.estimate import Estimate
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion


@dataclass(frozen=True, eq=False)
class Step:
    """What the odometry measured at a frameset, and what it made of that.

    Attributes:
        estimate: as emitted.
        motion: by which vision constrains the state; where the gate refused, what it refused; or None.
        used: whether the motion was let in.
        interval: the IMU since the step before, or None.
        started: whether the estimation began here, be it anew: what is known of the time before then does not count.
        references: stamps of the framesets that later motions are measured from.
        own: pair index -> what it alone says of the motion, at the end of a keyframe whose motion is used.
    """

    estimate: Estimate
    motion: RelativeMotion | None
    used: bool
    interval: ImuInterval | None
    started: bool
    references: frozenset[int]
    own: Mapping[int, RelativeMotion]
