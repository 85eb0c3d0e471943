"""Samples from the buffer of an IIO device: what its bytes mean, told by the files of ``scan_elements``."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.errors import SourceError

_TYPE = re.compile(r"(le|be):([su])(\d+)/(\d+)(?:X(\d+))?>>(\d+)")


@dataclass(frozen=True)
class ScanElement:
    """One channel of a scan, ``[be|le]:[s|u]BITS/STORAGE[XREPEAT]>>SHIFT`` in sysfs.

    Attributes:
        name: such as ``in_anglvel_x``.
        index: its place in the scan.
        is_signed: two's complement.
        bits: that count; the others may be anything.
        storage_bytes: that it takes; its place is a multiple of them.
        shift: to the right, before the bits are taken.
        is_big_endian: order of the bytes.
    """

    name: str
    index: int
    is_signed: bool
    bits: int
    storage_bytes: int
    shift: int
    is_big_endian: bool

    @staticmethod
    def parse(name: str, index: str, kind: str) -> ScanElement:
        """From the texts of ``NAME_index`` and ``NAME_type``.

        Raises:
            SourceError: if they cannot be read, or are of a kind that no IMU has.
        """
        found = _TYPE.fullmatch(kind.strip())
        if found is None or not index.strip().isdigit():
            raise SourceError(f"IIO channel {name}: type {kind.strip()!r} or index {index.strip()!r} is not understood")
        bits, storage, shift = int(found[3]), int(found[4]), int(found[6])
        if storage not in (8, 16, 32, 64) or found[5] not in (None, "1") or not 0 < bits <= storage - shift:
            raise SourceError(f"IIO channel {name}: type {kind.strip()!r} is none that an IMU has")
        return ScanElement(name, int(index), found[2] == "s", bits, storage // 8, shift, found[1] == "be")

    def values(self, stored: AnyArray) -> Int:
        """Numbers (N,) from what is stored, unsigned and of the width of the storage."""
        words = stored.astype(np.uint64) >> np.uint64(self.shift)
        unused = np.uint64(64 - self.bits)
        words = words << unused
        return (words.view(np.int64) >> np.int64(unused)) if self.is_signed else (words >> unused).view(np.int64)


class ScanFormat:
    """How the elements that are enabled lie in a scan, by the kernel's rule: each at a multiple of its own size.

    Attributes:
        dtype: of a whole scan; a field for each element.
    """

    def __init__(self, elements: list[ScanElement]) -> None:
        self._elements = {element.name: element for element in elements}
        offsets, formats, end = [], [], 0
        ordered = sorted(elements, key=lambda element: element.index)
        for element in ordered:
            size = element.storage_bytes
            offsets.append(-(-end // size) * size)
            formats.append(f"{'>' if element.is_big_endian else '<'}u{size}")
            end = offsets[-1] + size
        largest = max(element.storage_bytes for element in elements)
        names = [element.name for element in ordered]
        self.dtype: np.dtype[np.void] = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": -(-end // largest) * largest}
        )

    def channel(self, scans: AnyArray, name: str) -> Int:
        """Raw numbers (N,) of a channel in N scans of `dtype`."""
        return self._elements[name].values(scans[name])


def mount_matrix(text: str) -> Float:
    """``body_R_sensor`` (3, 3) from a mount matrix in sysfs, ``a, b, c; d, e, f; g, h, i``.

    Raises:
        SourceError: if it is no rotation.
    """
    try:
        matrix = np.array([[float(value) for value in row.split(",")] for row in text.strip().split(";")])
    except ValueError:
        matrix = np.zeros((0, 0))
    if matrix.shape != (3, 3) or np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
        raise SourceError(f"IIO mount matrix {text.strip()!r} is no rotation; correct it in the device tree")
    return matrix
