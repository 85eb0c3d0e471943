"""Which epoch a running odometry is in, and the map as far as it belongs to one."""

from __future__ import annotations

from graphvio.arrays import Float
from graphvio.slam.interface import Served


def newest_epoch(served: Served) -> int | None:
    """The newest keyframe's, or None before the first."""
    log = served.keyframe_log
    newest = log.read(max(log.next_id - 1, 0), timeout_s=0.0)
    return None if newest is None else newest.epoch


def map_of_epoch(served: Served, epoch: int) -> Float | None:
    """``map_T_odom`` (4, 4) in force, unless it is another epoch's than that of an estimate that waited."""
    before = newest_epoch(served)
    map_T_odom = served.map_T_odom
    return map_T_odom if before == epoch == newest_epoch(served) else None
