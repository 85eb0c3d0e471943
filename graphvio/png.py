"""Decoding of grey PNG files, of which most recordings consist, in less than half of OpenCV's time.

OpenCV's decoder needs two thirds of the processor time of the odometry itself.

Reference: Portable Network Graphics (PNG) Specification, W3C, sections 5 (chunks), 9 (filters) and 11.2.2 (IHDR).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import numpy as np
from isal import isal_zlib

from graphvio.arrays import Image
from graphvio.kernels import kernel

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER = struct.Struct(">IIBBBBB")
_PLAIN_GREY = (0, 0, 0, 0)  # colour type, compression, filters, no interlacing
_MAX_EXPANSION = 1032  # largest ratio of expansion by Deflate
_SUB, _UP, _AVERAGE, _PAETH = 1, 2, 3, 4


class DamagedPngError(Exception):
    """A PNG file that is truncated or damaged; the message follows the file's name."""


def decode_grey_png(data: bytes) -> Image | None:
    """Decode a PNG file of grey pixels of 8 or 16 bits.

    Of 16 bits the upper 8 are returned. PNG predicts each byte of a pixel from the same byte of other pixels, so the
    lower bytes are never computed.

    Args:
        data: contents of the file.

    Returns:
        (height, width) uint8; None where the file has colours, other depths or interlacing.

    Raises:
        DamagedPngError: if it is truncated or damaged.
    """
    header, compressed = b"", []
    for kind, body in _chunks(data):
        if kind == b"IHDR":
            header = bytes(body)
        elif kind == b"IDAT":
            compressed.append(body)
    if len(header) != _HEADER.size:
        raise DamagedPngError("is damaged (header)")
    width, height, depth, *layout = _HEADER.unpack(header)
    if depth not in (8, 16) or tuple(layout) != _PLAIN_GREY or width == 0 or height == 0:
        return None
    row_bytes = 1 + width * (depth // 8)
    if height * row_bytes > _MAX_EXPANSION * sum(map(len, compressed)):
        raise DamagedPngError("is damaged (pixels are missing)")
    try:
        filtered = isal_zlib.decompress(b"".join(compressed), bufsize=height * row_bytes)
    except isal_zlib.error as error:  # type: ignore[misc]  # its stub takes the class for an instance
        raise DamagedPngError(f"is damaged ({error})") from None
    if len(filtered) < height * row_bytes:
        raise DamagedPngError("is damaged (pixels are missing)")
    rows = np.frombuffer(filtered, dtype=np.uint8, count=height * row_bytes).reshape(height, row_bytes)
    image = np.zeros((1 + height, width), dtype=np.uint8)  # above the first row all is zero
    if not undo_filters(rows, depth // 8, image):
        raise DamagedPngError("is damaged (unknown filter)")
    return image[1:]


def _chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Yield type and contents of each chunk, up to the one that ends the file."""
    view, at = memoryview(data), len(SIGNATURE)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(view[at : at + 4], "big")
        if end + 4 > len(data):
            break
        if zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            raise DamagedPngError("is damaged (checksum)")
        kind = bytes(view[at + 4 : at + 8])
        if kind == b"IEND":
            return
        yield kind, view[at + 8 : end]
        at = end + 4
    raise DamagedPngError("is truncated")


@kernel
def undo_filters(filtered: Image, step: int, image: Image) -> bool:
    """Compute the pixels from the filtered rows, each of which names the filter that predicted its bytes.

    Args:
        filtered: (height, 1 + step * width) rows: filter, then the filtered bytes, of which each ``step``-th is used.
        step: bytes of a pixel.
        image: (1 + height, width) result, written from its second row on; the first row has to be zero.

    Returns:
        Whether all filters are known.
    """
    y = 0
    while y < len(filtered):
        used = filtered[y, 0]
        if used == _PAETH:
            count = 2 if y + 1 < len(filtered) and filtered[y + 1, 0] == _PAETH else 1
            _undo_paeth(filtered, step, image, y, y + count - 1)
            y += count
            continue
        left = 0
        for x in range(image.shape[1]):
            byte, above = filtered[y, 1 + step * x], image[y, x]
            if used == _AVERAGE:
                left = (byte + ((left + above) >> 1)) & 255
            elif used == _SUB:
                left = (byte + left) & 255
            elif used == _UP:
                left = (byte + above) & 255
            elif used == 0:
                left = byte
            else:
                return False
            image[y + 1, x] = left
        y += 1
    return True


@kernel
def _undo_paeth(filtered: Image, step: int, image: Image, y: int, next_y: int) -> None:
    """Undo Paeth's filter of row y and of ``next_y``, one pixel behind; both may be the same row.

    A pixel has to wait for its left neighbour; so the processor can compute one pixel of each row at the same time.
    """
    width = image.shape[1]
    above_left = np.int64(image[y, 0])  # numba's sums of unsigned and signed integers are float64
    left = (filtered[y, 1] + above_left) & 255
    next_left, next_above_left = np.int64(0), np.int64(0)
    image[y + 1, 0] = left
    for x in range(1, width):
        above = np.int64(image[y, x])
        pixel = (filtered[y, 1 + step * x] + _paeth(left, above, above_left)) & 255
        next_left = (filtered[next_y, 1 + step * (x - 1)] + _paeth(next_left, left, next_above_left)) & 255
        next_above_left, left, above_left = left, pixel, above
        image[y + 1, x] = pixel
        if next_y > y:
            image[next_y + 1, x - 1] = next_left
    if next_y > y:
        last = filtered[next_y, 1 + step * (width - 1)]
        image[next_y + 1, width - 1] = (last + _paeth(next_left, left, next_above_left)) & 255


@kernel
def _paeth(left: np.int64, above: np.int64, above_left: np.int64) -> np.int64:
    """Return the neighbour of a byte that is nearest to ``left + above - above_left``."""
    to_left, to_above = abs(above - above_left), abs(left - above_left)
    to_above_left = abs(left + above - 2 * above_left)
    other = above if to_above <= to_above_left else above_left
    return left if to_left <= min(to_above, to_above_left) else other
