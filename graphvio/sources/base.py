"""The interface of all sources, whatever the format of the recording."""

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
        """Rig of the measurements; its IMU is None if the recording has no samples."""

    @property
    def faults(self) -> FaultLog:
        """Faults of the recording; complete once an iteration has ended, and counted again by the next one."""

    @property
    def frameset_count(self) -> int:
        """Number of framesets, of which those without usable images are not yielded."""

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
        """File, session or bag from which `load_trajectory` reads the true trajectory, or None."""

    @property
    def decode_ms(self) -> Sequence[float]:
        """Time that the decoding of each frameset took in its thread, milliseconds."""

    def frameset_at(self, stamp_ns: int) -> FrameSet:
        """Return the usable images of one frameset, out of order; from any thread.

        Raises:
            SourceError: if there is no frameset with this stamp.
        """

    def __iter__(self) -> Iterator[Measurement]:
        """Yield IMU samples and framesets; the sample that covers a frameset's instant comes before it.

        Raises:
            SourceError: at the end, if not one frameset could be read.
            RigError: if the first image of a camera does not have the rig's size.
        """
