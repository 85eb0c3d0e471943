"""Decoding of image files to 8-bit grey, with detection of damaged files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from graphvio.arrays import Image
from graphvio.measurements.events import EventKind
from graphvio.png import SIGNATURE, DamagedPngError, decode_grey_png

_JPEG = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"


class ImageError(Exception):
    """An image that cannot be used.

    Attributes:
        kind: ``IMAGE_MISSING`` or ``IMAGE_UNDECODABLE``.
        detail: one line with the file.
    """

    def __init__(self, kind: EventKind, detail: str) -> None:
        super().__init__(detail)
        self.kind = kind
        self.detail = detail


def read_grey(path: Path) -> Image:
    """Read an image file as (height, width) uint8; 16 bits are scaled to 8, colour is converted to grey.

    Raises:
        ImageError: if the file is missing, truncated or damaged.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ImageError(EventKind.IMAGE_MISSING, f"{path} does not exist") from None
    except OSError as error:
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{path} cannot be read ({error.strerror})") from None
    return decode_grey(data, str(path))


def decode_grey(data: bytes, where: str) -> Image:
    """Decode a PNG, a JPEG or any other format of OpenCV to (height, width) uint8.

    Args:
        data: contents of the file.
        where: path or other source, for messages.

    Raises:
        ImageError: if it is truncated or damaged.
    """
    if data.startswith(SIGNATURE):
        try:
            grey = decode_grey_png(data)
        except DamagedPngError as error:
            raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} {error}") from None
        return grey if grey is not None else _decode_by_opencv(data, where)
    if not data:
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} is empty")
    if data.startswith(_JPEG) and _JPEG_END not in data[-64:]:  # some writers pad the file
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} is truncated")
    return _decode_by_opencv(data, where)


def _decode_by_opencv(data: bytes, where: str) -> Image:
    """Decode any format of OpenCV, which fills missing parts with grey and reports success: detect these beforehand."""
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} is no image ({error.err})") from None
    if image is None:
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} is no image")
    if image.dtype == np.uint16:
        image = np.right_shift(image, 8).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} holds {image.dtype} pixels, not 8 or 16 bits")
    if image.ndim == 3:
        codes = {1: None, 3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
        code = codes.get(image.shape[2])
        image = image[:, :, 0] if code is None else cv2.cvtColor(image, code)
    return np.ascontiguousarray(image, dtype=np.uint8)
