"""The calibration as curves for plots: single numbers in convenient units, in groups of what belongs together."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.rig import Rig
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.imu_model import ACCEL_MATRIX, GYRO_MATRIX, PARAMETERS, TIME_OFFSET
from graphvio.self_calibration.parameters import (
    CAMERA,
    INTRINSICS,
    STEREO,
    extrinsics_of,
    has_coefficient,
    n_camera_parameters,
    relative_to_first,
    slices_of_groups,
)

_DEG = float(np.rad2deg(1.0))
_AXES = tuple("xyz")
_SHOWN_DISTORTION = 2  # coefficients, the first ones that are estimated, which matter most


class Curve(NamedTuple):
    """One number of the calibration.

    Attributes:
        group: what it belongs to, such as ``focal lengths``.
        unit: unit of the number; empty where it has none.
        item: the camera, pair or sensor; empty where the group has one only.
        component: which number of the item, such as ``fx`` or an axis; empty where it has one only.
        row: (C,) vector whose product with a difference from the rig file is the number.
    """

    group: str
    unit: str
    item: str
    component: str
    row: Float

    @property
    def name(self) -> str:
        """Item and component."""
        return f"{self.item} {self.component}".strip()


def curves_of(rig: Rig) -> list[Curve]:
    """Return the curves of a rig, group after group; the IMU's biases are not among them."""
    by_group: dict[str, list[Curve]] = {}
    for curve in (*_of_cameras(rig), *_of_pairs(rig), *_of_singles(rig), *_of_imu(rig)):
        by_group.setdefault(curve.group, []).append(curve)
    return [curve for curves in by_group.values() for curve in curves]


def values_of(curves: list[Curve], estimate: CalibrationEstimate) -> tuple[Float, Float]:
    """Return the current differences (N,) of N curves from the rig file, and their standard deviations (N,)."""
    rows = np.array([curve.row for curve in curves])
    variances = np.einsum("nc,cd,nd->n", rows, estimate.posterior.covariance, rows)
    return rows @ estimate.difference, np.sqrt(np.maximum(variances, 0.0))


def with_sigma(value: float, sigma: float) -> str:
    """Format a number and its standard deviation, with two digits of the latter."""
    decimals = max(0, 1 - math.floor(math.log10(sigma))) if sigma > 0.0 else 3
    return f"{value:+.{decimals}f} ± {sigma:.{decimals}f}"


def _of_cameras(rig: Rig) -> Iterator[Curve]:
    unit = np.eye(_size(rig))
    lenses = [
        (camera, own.start + which * CAMERA)
        for group, own in zip(rig.groups, slices_of_groups(rig), strict=True)
        for which, camera in enumerate(group.cameras)
    ]
    for camera, at in lenses:
        for i, axis in enumerate("xy"):
            focal = 100.0 / camera.intrinsics[i]
            yield Curve("focal lengths", "%", camera.name, f"f{axis}", focal * unit[at + i])
            yield Curve("principal points", "px", camera.name, f"c{axis}", unit[at + 2 + i])
        for i in np.flatnonzero(has_coefficient(camera))[:_SHOWN_DISTORTION]:
            yield Curve("distortion", "1e-3", camera.name, f"d{i + 1}", 1e3 * unit[at + INTRINSICS + i])


def _of_singles(rig: Rig) -> Iterator[Curve]:
    unit = np.eye(_size(rig))
    against = f"cameras against {rig.groups[0].name}"
    for j, single in enumerate(rig.singles, start=len(rig.pairs)):
        relative = relative_to_first(rig, j) @ unit[: n_camera_parameters(rig)]
        for i, axis in enumerate(_AXES if j > 0 else ()):
            yield Curve(f"{against}, rotation", "deg", single.name, axis, _DEG * relative[i])
            yield Curve(f"{against}, translation", "mm", single.name, axis, 1e3 * relative[3 + i])


def _of_pairs(rig: Rig) -> Iterator[Curve]:
    unit = np.eye(_size(rig))
    for j, pair in enumerate(rig.pairs):
        stereo = unit[slices_of_groups(rig)[j]][STEREO:]
        relative = relative_to_first(rig, j) @ unit[: n_camera_parameters(rig)]
        for i, axis in enumerate(_AXES):
            yield Curve("left to right, rotation", "deg", pair.name, axis, _DEG * stereo[i])
        along = pair.right_T_left[:3, 3] / pair.baseline_m**2
        yield Curve("baselines", "%", pair.name, "", 100.0 * along @ stereo[3:6])
        for i, axis in enumerate(_AXES if j > 0 else ()):
            against = f" against {rig.pairs[0].name}"
            yield Curve(f"pairs{against}, rotation", "deg", pair.name, axis, _DEG * relative[i])
            yield Curve(f"pairs{against}, translation", "mm", pair.name, axis, 1e3 * relative[3 + i])


def _of_imu(rig: Rig) -> Iterator[Curve]:
    if rig.imu is None:
        return
    unit = np.eye(_size(rig))
    imu, extrinsics = unit[n_camera_parameters(rig) :], unit[extrinsics_of(rig, 0)]
    for i, axis in enumerate(_AXES):
        yield Curve("cameras to IMU, rotation", "deg", "", axis, _DEG * extrinsics[i])
        yield Curve("cameras to IMU, translation", "mm", "", axis, 1e3 * extrinsics[3 + i])
    yield Curve("IMU, time offset", "ms", "", "", 1e3 * imu[TIME_OFFSET])
    for i, axis in enumerate(_AXES):
        yield Curve("IMU, gyro's scale", "%", "", axis, 100.0 * imu[GYRO_MATRIX + 4 * i])
        yield Curve("IMU, accelerometer's scale", "%", "", axis, 100.0 * imu[ACCEL_MATRIX + 4 * i])


def _size(rig: Rig) -> int:
    return n_camera_parameters(rig) + (PARAMETERS if rig.imu is not None else 0)
