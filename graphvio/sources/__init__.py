"""Reading of recordings as IMU samples and framesets: EuRoC/ASL, TUM-VI, KITTI odometry and raw, sessions (MCAP)."""

from graphvio.sources.faults import FaultLog
from graphvio.sources.index import ImageFiles, Index
from graphvio.sources.opening import is_recording, open_source
from graphvio.sources.recording import Source
from graphvio.sources.tables import ImuTable

__all__ = ["FaultLog", "ImageFiles", "ImuTable", "Index", "Source", "is_recording", "open_source"]
