"""Arrays as lists of numbers in messages, and checks of the received ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.errors import ServiceError

_MAX_RIGID_ERROR = 1e-6
_MAX_ASYMMETRY = 1e-9


def packed(array: AnyArray | None) -> list[float]:
    """Return the values of an array, row by row; an empty list for None."""
    return [] if array is None else np.asarray(array, dtype=np.float64).ravel().tolist()


def floats(values: Sequence[float], shape: tuple[int, ...], what: str) -> Float:
    """Return an array of a shape from its values row by row; raises a ServiceError if their number is another."""
    _check_count(len(values), shape, what)
    return np.array(values, dtype=np.float64).reshape(shape)


def maybe_floats(values: Sequence[float], shape: tuple[int, ...], what: str) -> Float | None:
    """Return the same as `floats`, but None for an empty list."""
    return floats(values, shape, what) if len(values) else None


def whole_numbers(values: Sequence[int], what: str, count: int) -> Int:
    """Return an int64 array (count,); arguments and error as of `floats`."""
    _check_count(len(values), (count,), what)
    return np.array(values, dtype=np.int64)


def byte_rows(data: bytes, shape: tuple[int, int], what: str) -> AnyArray:
    """Return a uint8 array, such as an image; arguments and error as of `floats`."""
    _check_count(len(data), shape, what)
    return np.frombuffer(data, dtype=np.uint8).reshape(shape).copy()


def checked_pose(matrix: Float, what: str) -> Float:
    """Return a matrix (4, 4) after checking that it is a rigid transform.

    Raises:
        ServiceError: If it is not finite or not rigid, or its last row is not [0, 0, 0, 1].
    """
    _check_finite(matrix, what)
    rotation = matrix[:3, :3]
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > _MAX_RIGID_ERROR:
        raise ServiceError(f"{what}: the last row is {matrix[3].tolist()}; it must be [0, 0, 0, 1], row by row")
    if np.abs(rotation).max() > 2.0:
        raise ServiceError(f"{what}: holds no rotation; give metres in the fourth column only, row by row")
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > _MAX_RIGID_ERROR or np.linalg.det(rotation) < 0.0:
        raise ServiceError(
            f"{what}: holds no rotation (R R^T differs from 1 by {off:.2g}, determinant "
            f"{np.linalg.det(rotation):.3g}); make it orthonormal"
        )
    return matrix


def checked_covariance(matrix: Float, what: str) -> Float:
    """Return a matrix after checking that it is a covariance.

    Raises:
        ServiceError: If it is not finite, not symmetric, or not positive definite.
    """
    _check_finite(matrix, what)
    with np.errstate(over="ignore", invalid="ignore"):
        largest = float(np.abs(matrix).max())
        is_symmetric = bool(np.abs(matrix - matrix.T).max() <= _MAX_ASYMMETRY * largest)
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
