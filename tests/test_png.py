"""PNG files, decoded and compared with OpenCV's decoder and with what was encoded by the specification."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphvio.arrays import AnyArray, Image
from graphvio.png import SIGNATURE, DamagedPngError, decode_grey_png

GREY, RGB = 0, 2


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(
    size_px: tuple[int, int], depth: int, filtered: bytes, *, colour: int = GREY, interlaced: int = 0, parts: int = 1
) -> bytes:
    """Assemble a file of rows that are filtered already, its data in several chunks."""
    compressed = zlib.compress(filtered)
    step = -(-len(compressed) // parts)
    data = [chunk(b"IDAT", compressed[at : at + step]) for at in range(0, len(compressed), step)]
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", *size_px, depth, colour, 0, 0, interlaced))
    return SIGNATURE + header + chunk(b"tEXt", b"Title\0walk") + b"".join(data) + chunk(b"IEND", b"")


def filtered_rows(image: AnyArray, filters: list[int]) -> bytes:
    """Filter the rows of a grey image of 8 or 16 bits as section 9 of the specification says."""
    step = image.dtype.itemsize
    rows = image.astype(image.dtype.newbyteorder(">")).view(np.uint8).reshape(len(image), -1).astype(int)
    padded = np.pad(rows, ((1, 0), (step, 0)))
    left, above, corner = padded[1:, :-step], padded[:-1, step:], padded[:-1, :-step]
    estimate = left + above - corner
    distances = np.stack([np.abs(estimate - each) for each in (left, above, corner)])
    paeth = np.choose(distances.argmin(axis=0), [left, above, corner])  # of equal ones the first
    predictions = [np.zeros_like(rows), left, above, (left + above) // 2, paeth]
    return b"".join(
        bytes([kind]) + ((row - predictions[kind][y]) & 255).astype(np.uint8).tobytes()
        for y, (kind, row) in enumerate(zip(filters, rows, strict=True))
    )


@given(
    seed=st.integers(0, 2**32 - 1),
    filters=st.lists(st.integers(0, 4), min_size=1, max_size=12),
    width=st.integers(1, 20),
    dtype=st.sampled_from([np.uint8, np.uint16]),
    smooth=st.booleans(),
    parts=st.integers(1, 3),
)
def test_decode_grey_png_any_filters_gives_the_pixels(
    seed: int, filters: list[int], width: int, dtype: type[np.uint8 | np.uint16], smooth: bool, parts: int
) -> None:
    rng = np.random.default_rng(seed)
    high = 8 if smooth else np.iinfo(dtype).max + 1  # of few values, many predictions are equal
    image: AnyArray = rng.integers(0, high, size=(len(filters), width)).astype(dtype)
    data = png((width, len(filters)), 8 * image.dtype.itemsize, filtered_rows(image, filters), parts=parts)
    by_opencv = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(by_opencv, image)
    decoded = decode_grey_png(data)
    assert decoded is not None
    assert decoded.dtype == np.uint8
    assert decoded.flags.c_contiguous
    np.testing.assert_array_equal(decoded, image if dtype == np.uint8 else image >> 8)


@pytest.mark.parametrize("strategy", range(5))
def test_decode_grey_png_written_by_opencv_is_equal(strategy: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, size=(120, 160), dtype=np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 2.0)
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_STRATEGY, strategy])
    decoded = decode_grey_png(data.tobytes())
    assert decoded is not None
    np.testing.assert_array_equal(decoded, image)


def test_decode_grey_png_of_another_layout_is_none() -> None:
    image: Image = np.arange(24, dtype=np.uint8).reshape(4, 6)
    rows = filtered_rows(image, [0] * 4)
    assert decode_grey_png(png((2, 4), 8, rows, colour=RGB)) is None
    assert decode_grey_png(png((6, 4), 8, rows, interlaced=1)) is None
    assert decode_grey_png(png((48, 4), 1, rows)) is None


def test_decode_grey_png_damaged_raises() -> None:
    image: Image = np.arange(24, dtype=np.uint8).reshape(4, 6)
    rows = filtered_rows(image, [4] * 4)
    sound = png((6, 4), 8, rows)
    assert decode_grey_png(sound) is not None
    ends = range(len(SIGNATURE), len(sound))
    damaged = {
        "truncated": [sound[:end] for end in ends],
        "checksum": [sound[:at] + bytes([sound[at] ^ 1]) + sound[at + 1 :] for at in (17, 45, len(sound) - 13)],
        "pixels are missing": [png((6, 4), 8, rows[:-1]), png((2**31 - 1, 2**31 - 1), 16, rows)],
        "unknown filter": [png((6, 4), 8, bytes([5]) + rows[1:])],
        "header": [SIGNATURE + chunk(b"IEND", b"")],
        "damaged": [
            sound.replace(chunk(b"IDAT", zlib.compress(rows)), chunk(b"IDAT", body))
            for body in (b"no Deflate at all", zlib.compress(rows)[:-6], zlib.compress(rows)[:-4] + b"sum?")
        ],
    }
    for message, files in damaged.items():
        for data in files:
            with pytest.raises(DamagedPngError, match=message):
                decode_grey_png(data)
