"""Index of a recording: the images and samples in it, to which every format is brought.

It takes some 100 bytes an image or sample, and is all that grows with the length of a recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from graphvio.arrays import Image, Int
from graphvio.image_decoding import read_grey
from graphvio.sources.tables import ImuTable


class ImageSequence(Protocol):
    """Images of one camera, read one by one."""

    @property
    def stamps_ns(self) -> Int:
        """(N,) stamps, as recorded, increasing; `Source` adds ``stamp_offset_s`` of the camera."""

    def read(self, row: int) -> Image:
        """Return the image of a row, (height, width) uint8; from any thread.

        Args:
            row: index of its stamp.

        Raises:
            ImageError: if it is missing or damaged.
        """


@dataclass(frozen=True, eq=False)
class ImageFiles:
    """Image files in one folder."""

    folder: Path  # that holds them
    stamps_ns: Int  # (N,) as recorded, increasing
    names: Sequence[str]  # of the files

    def read(self, row: int) -> Image:
        """Return the image of a row, (height, width) uint8; from any thread.

        Args:
            row: index of its stamp.

        Raises:
            ImageError: if it is missing or damaged.
        """
        return read_grey(self.folder / self.names[row])


@dataclass(frozen=True, eq=False)
class Index:
    """Content of a recording."""

    name: str  # of the recording
    images: Mapping[str, ImageSequence]  # camera name -> its images
    imu: ImuTable | None = None  # samples, or None if there are none
    truth: Path | None = None  # file with the true trajectory, or None
    masks: Mapping[str, ImageSequence] = field(default_factory=dict)  # camera name -> masks of its images, by stamp
