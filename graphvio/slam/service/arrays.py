"""Conversion of arrays to and from lists of numbers in messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.errors import ServiceError


def packed(array: AnyArray | None) -> list[float]:
    """Return the values of an array, row by row; an empty list for None."""
    return [] if array is None else np.asarray(array, dtype=np.float64).ravel().tolist()


def floats(values: Sequence[float], shape: tuple[int, ...], what: str) -> Float:
    """Return an array of a shape from its values row by row; raises a ServiceError if their number does not fit."""
    _check_count(len(values), shape, what)
    return np.array(values, dtype=np.float64).reshape(shape)


def maybe_floats(values: Sequence[float], shape: tuple[int, ...], what: str) -> Float | None:
    """Return an array as `floats` does, but None for an empty list."""
    return floats(values, shape, what) if len(values) else None


def whole_numbers(values: Sequence[int], what: str, count: int) -> Int:
    """Return an int64 array (count,); arguments and error as of `floats`."""
    _check_count(len(values), (count,), what)
    return np.array(values, dtype=np.int64)


def byte_rows(data: bytes, shape: tuple[int, int], what: str) -> AnyArray:
    """Return a uint8 array, such as an image; arguments and error as of `floats`."""
    _check_count(len(data), shape, what)
    return np.frombuffer(data, dtype=np.uint8).reshape(shape).copy()


def _check_count(count: int, shape: tuple[int, ...], what: str) -> None:
    wanted = int(np.prod(shape))
    if count != wanted:
        raise ServiceError(f"{what}: has {count} values; it must have {wanted}")
