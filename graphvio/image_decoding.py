"""Decoding of image files to 8-bit grey, with detection of damaged files."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np

from graphvio.arrays import Image
from graphvio.measurements.events import EventKind

_PNG = b"\x89PNG\r\n\x1a\n"
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
    damage = damage_of(data)
    if damage:
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} {damage}")
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


def damage_of(data: bytes) -> str | None:
    """Describe damage of an image file, to follow its name in a message; None if none is found.

    Decoders fill missing parts with grey and report success, so PNG chunks and the JPEG end marker are checked.
    """
    if not data:
        return "is empty"
    if data.startswith(_PNG):
        return _png_damage(data)
    if data.startswith(_JPEG) and _JPEG_END not in data[-64:]:  # some writers pad
        return "is truncated"
    return None


def _png_damage(data: bytes) -> str | None:
    view = memoryview(data)
    at = len(_PNG)
    while at + 12 <= len(data):
        body_end = at + 8 + int.from_bytes(view[at : at + 4], "big")
        if body_end + 4 > len(data):
            return "is truncated"
        if zlib.crc32(view[at + 4 : body_end]) != int.from_bytes(view[body_end : body_end + 4], "big"):
            return "is damaged (checksum)"
        if bytes(view[at + 4 : at + 8]) == b"IEND":
            return None
        at = body_end + 4
    return "is truncated"
