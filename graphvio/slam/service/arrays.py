"""Arrays as the lists of numbers in messages, and the checks of what came in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.errors import ServiceError

_RIGID = 1e-6
_SYMMETRIC = 1e-9


def packed(array: AnyArray | None) -> list[float]:
    """Values row after row; none for None."""
    return [] if array is None else np.asarray(array, dtype=np.float64).ravel().tolist()


def floats(values: Sequence[float], shape: tuple[int, ...], what: str) -> Float:
    """An array of a shape; writable, and nobody else's.

    Raises:
        ServiceError: if there are more or fewer values.
    """
    _check_count(len(values), shape, what)
    return np.array(values, dtype=np.float64).reshape(shape)


def maybe_floats(values: Sequence[float], shape: tuple[int, ...], what: str) -> Float | None:
    """As `floats`, but None where there are no values."""
    return floats(values, shape, what) if len(values) else None


def whole_numbers(values: Sequence[int], what: str, count: int) -> Int:
    """(count,) int64.

    Raises:
        ServiceError: if there are more or fewer values.
    """
    _check_count(len(values), (count,), what)
    return np.array(values, dtype=np.int64)


def byte_rows(data: bytes, shape: tuple[int, int], what: str) -> AnyArray:
    """A uint8 array, such as an image.

    Raises:
        ServiceError: if there are more or fewer bytes.
    """
    _check_count(len(data), shape, what)
    return np.frombuffer(data, dtype=np.uint8).reshape(shape).copy()


def checked_pose(matrix: Float, what: str) -> Float:
    """The same (4, 4), if it is a rigid transform.

    Raises:
        ServiceError: if it is not finite, not rigid, or its last row is another.
    """
    _check_finite(matrix, what)
    rotation = matrix[:3, :3]
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > _RIGID:
        raise ServiceError(f"{what}: the last row is {matrix[3].tolist()}; it must be [0, 0, 0, 1], row by row")
    if np.abs(rotation).max() > 2.0:
        raise ServiceError(f"{what}: holds no rotation; give metres in the fourth column only, row by row")
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > _RIGID or np.linalg.det(rotation) < 0.0:
        raise ServiceError(
            f"{what}: holds no rotation (R R^T differs from 1 by {off:.2g}, determinant "
            f"{np.linalg.det(rotation):.3g}); make it orthonormal"
        )
    return matrix


def checked_covariance(matrix: Float, what: str) -> Float:
    """The same matrix, if it is a covariance.

    Raises:
        ServiceError: if it is not finite, not symmetric, or not positive definite.
    """
    _check_finite(matrix, what)
    with np.errstate(over="ignore", invalid="ignore"):
        largest = float(np.abs(matrix).max())
        is_symmetric = bool(np.abs(matrix - matrix.T).max() <= _SYMMETRIC * largest)
    if not is_symmetric:
        raise ServiceError(f"{what}: is not symmetric; give all of it, row by row")
    try:
        is_positive = bool(np.isfinite(np.linalg.cholesky(matrix)).all())
    except np.linalg.LinAlgError:
        is_positive = False
    if not is_positive:
        raise ServiceError(f"{what}: is not positive definite; every direction needs a variance above zero")
    return matrix


def _check_finite(matrix: Float, what: str) -> None:
    if not np.isfinite(matrix).all():
        raise ServiceError(f"{what}: holds NaN or infinity")


def _check_count(count: int, shape: tuple[int, ...], what: str) -> None:
    wanted = int(np.prod(shape))
    if count != wanted:
        raise ServiceError(f"{what}: has {count} values; it must have {wanted}")
