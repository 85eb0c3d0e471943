"""What every source offers, whatever the format of the recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

from graphvio.arrays import Int
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.rig import Rig
from graphvio.sources.faults import FaultLog


class Source(Protocol):
    """A recording as a stream of IMU samples and framesets in time order; may be iterated more than once."""

    @property
    def name(self) -> str:
        """Name of the recording, fit for a folder of results."""

    @property
    def rig(self) -> Rig:
        """The rig that the measurements refer to; its IMU is None where the recording has none."""

    @property
    def faults(self) -> FaultLog:
        """What was wrong with the recording: complete once the iteration has ended."""

    @property
    def frameset_count(self) -> int:
        """How many framesets it yields at most."""

    @property
    def stamps_ns(self) -> Int:
        """(N,) stamps of the framesets, camera clock, increasing."""

    @property
    def start_ns(self) -> int:
        """Stamp of the first frameset, camera clock."""

    @property
    def end_ns(self) -> int:
        """Stamp of the last frameset, camera clock."""

    @property
    def truth(self) -> Path | None:
        """Where `load_trajectory` finds the true trajectory, if the recording carries one: a file, or a session."""

    @property
    def decode_ms(self) -> Sequence[float]:
        """Time that the decoding of each frameset took in its thread, milliseconds."""

    def frameset_at(self, stamp_ns: int) -> FrameSet:
        """One frameset, out of order: the images of it that are usable; from any thread.

        Raises:
            SourceError: if there is none of this stamp.
        """

    def __iter__(self) -> Iterator[Measurement]:
        """IMU samples and framesets: the sample that covers a frameset's instant comes before it.

        Raises:
            SourceError: at the end, if not one frameset could be read.
            RigError: if the first image of a camera has another size than the rig says.
        """
