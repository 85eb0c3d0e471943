"""Checks and conversions of the values of frozen objects: arrays and rigid transforms."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError

_ROTATION_TOLERANCE = 1e-3


def checked_transform(matrix: object, where: str) -> Float:
    """Validate a rigid transform and orthonormalise its rotation.

    Args:
        matrix: transform, array-like (4, 4).
        where: start of the error message.

    Raises:
        RigError: if the shape is wrong, a value is not finite, or the upper left block is no rotation.
    """
    transform = finite(matrix, (4, 4), where)
    rotation = transform[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise RigError(
            f"{where}: the upper left 3x3 block is no rotation (R R^T differs from 1 by {off:.2g}, "
            f"determinant {np.linalg.det(rotation):.3g}); check that the matrix is complete and row-major"
        )
    if np.abs(transform[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise RigError(f"{where}: the last row is {transform[3].tolist()}; it must be [0, 0, 0, 1]")
    u, _, vt = np.linalg.svd(rotation)
    transform[:3, :3] = u @ vt
    return transform


def finite(values: object, shape: tuple[int, ...], where: str) -> Float:
    """Convert numbers to an array, and check shape and finiteness.

    Args:
        values: array-like.
        shape: required shape.
        where: start of the error message.

    Raises:
        RigError: if the values are no numbers, of another shape, or not finite.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RigError(f"{where}: is not numeric ({error})") from None
    if array.shape != shape:
        raise RigError(f"{where}: has shape {array.shape}; it must be {shape}")
    if not np.isfinite(array).all():
        raise RigError(f"{where}: holds NaN or infinity")
    return array


def set_value(frozen: object, name: str, value: object) -> None:
    """Set an attribute of a frozen object while it is constructed."""
    object.__setattr__(frozen, name, value)
