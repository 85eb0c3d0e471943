"""Recordings as streams of IMU samples and framesets: EuRoC/ASL, TUM-VI, KITTI odometry and raw, sessions (MCAP)."""

from graphvio.sources.base import Source
from graphvio.sources.faults import FaultLog
from graphvio.sources.opening import is_recording, open_source

__all__ = ["FaultLog", "Source", "is_recording", "open_source"]
