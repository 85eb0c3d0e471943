"""Options of reading a recording: which part of its rig and of its time is read, and from which topics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from graphvio.rig import Rig
from graphvio.sources.opening import open_source, recorded_rig
from graphvio.sources.recording import Source


@dataclass(frozen=True)
class Reading:
    """What is read of each recording, as given by the options of a command."""

    pairs: tuple[int, ...] | None = None  # numbers of the stereo pairs; None for all
    cameras: tuple[str, ...] | None = None  # names of the cameras; None for all
    with_pairs: bool = True  # whether pairs stay pairs; otherwise each camera is a single one
    with_imu: bool = True  # whether the IMU is used
    topics: tuple[tuple[str, str], ...] = ()  # cameras of the rig, or ``imu``, with their topics
    from_s: float | None = None  # seconds after the first frameset at which to begin, or None
    to_s: float | None = None  # seconds after the first frameset at which to end, or None

    def of(self, rig: Rig) -> Rig:
        """Return the part of a rig that is read."""
        rig = rig if self.pairs is None else rig.with_pairs(list(self.pairs))
        rig = rig if self.cameras is None else rig.with_only(list(self.cameras))
        rig = rig if self.with_pairs else rig.without_pairs()
        return rig if self.with_imu else rig.without_imu()

    def open(self, path: Path, rig: Rig | None, tolerance_ms: float | None) -> Source:
        """Open a recording, of which the selected part is read.

        Args:
            path: folder of the recording, or file of a session or bag.
            rig: rig of the whole recording; None takes the recording's own.
            tolerance_ms: tolerance within which images are of one instant, see `open_source`.

        Raises:
            SourceError: if the recording cannot be read, has no known layout, or holds nothing in the given time.
            RigError: if there is no rig, or it has no such pairs or cameras.
            SessionError: if a session or bag cannot be read.
        """

        def opened(of: Rig | None) -> Source:
            topics = dict(self.topics)
            return open_source(path, of, from_s=self.from_s, to_s=self.to_s, tolerance_ms=tolerance_ms, topics=topics)

        if self.pairs is None and self.cameras is None and self.with_pairs and self.with_imu:
            return opened(rig)
        return opened(self.of(recorded_rig(path) if rig is None else rig))
