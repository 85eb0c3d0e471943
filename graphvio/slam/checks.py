"""Checks of the parts of a correction: the pose of a keyframe in the map, and its covariance."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import MeasurementError

_MAX_RIGID_ERROR = 1e-6
_MAX_ASYMMETRY = 1e-6  # relative to the largest value: that of single-precision numbers


def check_pose(matrix: Float, what: str) -> None:
    """Check that a matrix (4, 4) is a rigid transform.

    Raises:
        MeasurementError: If it is not finite or not rigid, or its last row is not [0, 0, 0, 1].
    """
    _check_finite(matrix, (4, 4), what)
    rotation = matrix[:3, :3]
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > _MAX_RIGID_ERROR:
        raise MeasurementError(f"{what}: the last row is {matrix[3].tolist()}; it must be [0, 0, 0, 1], row by row")
    if np.abs(rotation).max() > 2.0:
        raise MeasurementError(f"{what}: holds no rotation; give metres in the fourth column only, row by row")
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > _MAX_RIGID_ERROR or np.linalg.det(rotation) < 0.0:
        raise MeasurementError(
            f"{what}: holds no rotation (R R^T differs from 1 by {off:.2g}, determinant "
            f"{np.linalg.det(rotation):.3g}); make it orthonormal"
        )


def check_covariance(matrix: Float, what: str) -> None:
    """Check that a matrix (6, 6) is a covariance.

    Raises:
        MeasurementError: If it is not finite, not symmetric, or not positive definite.
    """
    _check_finite(matrix, (6, 6), what)
    with np.errstate(over="ignore", invalid="ignore"):
        largest = float(np.abs(matrix).max())
        is_symmetric = bool(np.abs(matrix - matrix.T).max() <= _MAX_ASYMMETRY * largest)
    if not is_symmetric:
        raise MeasurementError(f"{what}: is not symmetric; give all of it, row by row")
    try:
        is_positive = bool(np.isfinite(np.linalg.cholesky(matrix)).all())
    except np.linalg.LinAlgError:
        is_positive = False
    if not is_positive:
        raise MeasurementError(f"{what}: is not positive definite; every direction needs a variance above zero")


def _check_finite(matrix: Float, shape: tuple[int, int], what: str) -> None:
    if matrix.shape != shape:
        raise MeasurementError(f"{what}: has shape {matrix.shape}; give {shape}")
    if not np.isfinite(matrix).all():
        raise MeasurementError(f"{what}: holds NaN or infinity")
