"""Index of a recording: the images and samples in it, to which every format is brought.

It takes some 100 bytes an image or sample, and is all that grows with the length of a recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from graphvio.arrays import Image, Int
from graphvio.image_decoding import read_grey
from graphvio.sources.tables import ImuTable


class ImageSequence(Protocol):
    """Images of one camera, read one by one."""

    @property
    def stamps_ns(self) -> Int:
        """(N,) stamps, camera clock, increasing."""

    def read(self, row: int) -> Image:
        """Return the image of a row, (height, width) uint8; from any thread.

        Raises:
            ImageError: if it is missing or damaged.
        """


@dataclass(frozen=True, eq=False)
class ImageFiles:
    """Image files in one folder.

    Attributes:
        folder: that holds them.
        stamps_ns: (N,) increasing.
        names: of the files.
    """

    folder: Path
    stamps_ns: Int
    names: Sequence[str]

    def read(self, row: int) -> Image:
        """Return the image of a row: see `ImageSequence`."""
        return read_grey(self.folder / self.names[row])


@dataclass(frozen=True, eq=False)
class Index:
    """Content of a recording.

    Attributes:
        name: of the recording.
        images: camera name -> its images.
        imu: samples, or None if there are none.
        truth: file with the true trajectory, or None.
    """

    name: str
    images: Mapping[str, ImageSequence]
    imu: ImuTable | None = None
    truth: Path | None = None
