"""Index of a recording: its images and samples, in a common form for all formats.

It takes some 100 bytes per image or sample, and nothing else in memory grows with the length of a recording.
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
    """Interface to the images of one camera, which are read one by one."""

    @property
    def stamps_ns(self) -> Int:
        """(N,) stamps, as recorded, increasing; `Source` adds ``stamp_offset_s`` of the camera."""

    def read(self, row: int) -> Image:
        """Return the image of a row, (height, width) uint8; may be called from any thread.

        Args:
            row: index of the image's stamp.

        Raises:
            ImageError: if the image is missing or damaged.
        """


@dataclass(frozen=True, eq=False)
class ImageFiles:
    """An `ImageSequence` of image files in one folder."""

    folder: Path  # folder of the files
    stamps_ns: Int  # (N,) stamps as recorded, increasing
    names: Sequence[str]  # names of the files

    def read(self, row: int) -> Image:
        """Return the image of a row, (height, width) uint8; may be called from any thread.

        Args:
            row: index of the image's stamp.

        Raises:
            ImageError: if the image is missing or damaged.
        """
        return read_grey(self.folder / self.names[row])


@dataclass(frozen=True, eq=False)
class Index:
    """Content of a recording."""

    name: str  # name of the recording
    images: Mapping[str, ImageSequence]  # camera name -> its images
    imu: ImuTable | None = None  # samples of the IMU, or None if there are none
    truth: Path | None = None  # file with the true trajectory, or None
    masks: Mapping[str, ImageSequence] = field(default_factory=dict)  # camera name -> masks with their images' stamps
