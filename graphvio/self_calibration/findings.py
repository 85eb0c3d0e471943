"""Result of the self-calibration, part by part: differences from the rig file, their uncertainty and significance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from graphvio.arrays import Float
from graphvio.rig import Camera, StereoPair
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.imu_model import ACCEL_MATRIX, GYRO_MATRIX, TIME_OFFSET
from graphvio.self_calibration.parameters import (
    BODY,
    CAMERA,
    INTRINSICS,
    STEREO,
    extrinsics_of,
    n_camera_parameters,
    relative_to_first,
    slices_of_groups,
)
from graphvio.self_calibration.prior import SINGLE_CENTRE_PX, SINGLE_FOCAL_SHARE

_FIVE_SIGMA = 5.7e-7  # probability of a normal variable beyond 5 standard deviations
_OBSERVED = 0.5  # share of the rig file's standard deviation, below which a part is observed
_MAX_HIDDEN_SHARE = 0.5  # of all parts; where more are hidden, it is not one kind of motion that is missing
_TURN = "turn about two axes near textured surfaces"
_DEPTHS = "walk past things at many distances, and let them move across the image"
SCALE_MOTION = "accelerate: walk briskly with turns, or shake the rig"
"""Motion that shows lengths; a good rig file knows them better than most recordings show them."""


@dataclass(frozen=True, eq=False)
class Finding:
    """One part of the calibration, such as the rotation of a pair's stereo extrinsics.

    Attributes:
        part: what it is, such as ``pair front, rotation left to right``.
        unit: unit of the difference.
        difference: (N,) difference from the rig file.
        sigmas: (N,) standard deviations of the difference.
        file_sigmas: (N,) standard deviations of the rig file.
        is_significant: whether the file is wrong in this part beyond 5 sigma, after the variance of effects that the
            covariance does not model is added.
        motion: which motion would make it observable.
    """

    part: str
    unit: str
    difference: Float
    sigmas: Float
    file_sigmas: Float
    is_significant: bool
    motion: str

    @property
    def is_observed(self) -> bool:
        """Whether the measurements have reduced all standard deviations to less than half of the rig file's."""
        return bool((self.sigmas < _OBSERVED * self.file_sigmas).all())

    @property
    def distance(self) -> float:
        """Norm of the difference, in its standard deviations."""
        return float(np.linalg.norm(self.difference / self.sigmas))

    def __str__(self) -> str:
        size, sigma = float(np.linalg.norm(self.difference)), float(np.sqrt(np.mean(self.sigmas**2)))
        return f"{self.part}: {size:.3g} {self.unit} from the rig file (sigma {sigma:.2g})"


def findings(estimate: CalibrationEstimate, file_covariance: Float) -> list[Finding]:
    """Compare all parts of a calibration with the rig file.

    Args:
        estimate: estimate of the calibration.
        file_covariance: (C, C) covariance of the rig file's values.
    """
    covariance = estimate.posterior.covariance
    found = []
    for part, unit, scale, rows, floor, motion in _parts(estimate):
        difference = scale * (rows @ estimate.difference)
        of_part = scale**2 * rows @ covariance @ rows.T
        of_file = np.abs(scale) * np.sqrt(np.diag(rows @ file_covariance @ rows.T))
        uncertain = of_part + floor**2 * np.eye(len(difference))
        distance = float(difference @ np.linalg.solve(uncertain, difference))
        is_significant = distance > float(chdtri(len(difference), _FIVE_SIGMA))
        found.append(Finding(part, unit, difference, np.sqrt(np.diag(of_part)), of_file, is_significant, motion))
    return found


def contradiction(found: list[Finding]) -> str | None:
    """Return the part in which the rig file is wrong most clearly, in words, or None where none is beyond 5 sigma."""
    wrong = [finding for finding in found if finding.is_significant]
    return str(max(wrong, key=lambda finding: finding.distance)) if wrong else None


def described(found: list[Finding]) -> list[str]:
    """Return sentences for a person: what differs from the rig file, and what the motion did not show."""
    if not found:
        return []
    wrong = [finding.part for finding in found if finding.is_significant]
    if wrong:
        sentences = [f"calibration corrected: {'; '.join(wrong)}"]
    elif any(np.any(finding.difference) for finding in found):
        sentences = ["calibration refined: it differs from the rig file, in no part beyond doubt"]
    else:
        sentences = ["calibration: as in the rig file"]
    n_hidden = sum(not finding.is_observed for finding in found)
    if n_hidden > _MAX_HIDDEN_SHARE * len(found):
        shown = f"{len(found) - n_hidden} of {len(found)} parts of the calibration"
        return [*sentences, f"this recording shows {shown}: it is short, or moves little"]
    for motion in dict.fromkeys(finding.motion for finding in found):
        hidden = [finding.part for finding in found if finding.motion == motion and not finding.is_observed]
        if hidden:
            sentences.append(f"not shown by this recording: {'; '.join(hidden)} (to show it, {motion})")
    return sentences


class _Part(NamedTuple):
    """A part of the calibration, as people name it.

    Attributes:
        name: name of the part, with that of the pair or camera.
        unit: unit in which it is reported.
        scale: factor to this unit.
        rows: (N, C) its parameters, as rows that a difference from the rig file is multiplied with.
        floor: standard deviation in the unit that is added to its uncertainty: smaller errors are no fault of a file.
        motion: motion that makes it observable.
    """

    name: str
    unit: str
    scale: float
    rows: Float
    floor: float
    motion: str


def _parts(estimate: CalibrationEstimate) -> Iterator[_Part]:
    """Yield all parts, with the difference that a careful calibration may have as the floor."""
    rig, whole = estimate.file_rig, np.eye(len(estimate.difference))
    deg, first = float(np.rad2deg(1.0)), rig.groups[0].name
    for j, (group, of_group) in enumerate(zip(rig.groups, slices_of_groups(rig), strict=True)):
        own = whole[of_group]
        if isinstance(group, StereoPair):
            name = f"pair {group.name}"
            for which, camera in enumerate(group.cameras):
                yield from _of_lens(camera, own[which * CAMERA :], 0.05, 0.3)
            rotation, translation = own[STEREO : STEREO + 3], own[STEREO + 3 : BODY]
            yield _Part(f"{name}, rotation left to right", "deg", deg, rotation, 0.005, _DEPTHS)
            yield _Part(f"{name}, translation left to right", "mm", 1e3, translation, 0.1, SCALE_MOTION)
        else:
            name = f"camera {group.name}"
            yield from _of_lens(group.left, own, 100.0 * SINGLE_FOCAL_SHARE, SINGLE_CENTRE_PX)
        if j > 0:
            relative = relative_to_first(rig, j) @ whole[: n_camera_parameters(rig)]
            yield _Part(f"{name}, rotation against {first}", "deg", deg, relative[:3], 0.03, _TURN)
            yield _Part(f"{name}, translation against {first}", "mm", 1e3, relative[3:], 3.0, _TURN)
    if rig.imu is None:
        return
    at, extrinsics = n_camera_parameters(rig), whole[extrinsics_of(rig, 0)]
    yield _Part("cameras to IMU, rotation", "deg", deg, extrinsics[:3], 0.1, _TURN)
    yield _Part("cameras to IMU, translation", "mm", 1e3, extrinsics[3:], 3.0, _TURN)
    yield _Part("IMU, time offset", "ms", 1e3, whole[at + TIME_OFFSET : at + TIME_OFFSET + 1], 0.2, _TURN)
    yield _Part("IMU, gyro's scale", "%", 100.0, whole[at + GYRO_MATRIX : at + ACCEL_MATRIX : 4], 0.1, _TURN)
    # With pairs, accelerations are seen in units of the baselines: where both differ, nothing shows which one is wrong.
    scale = "IMU, accelerometer's scale" + (" (or that of all baselines)" if rig.pairs else "")
    yield _Part(scale, "%", 100.0, whole[at + ACCEL_MATRIX : at + TIME_OFFSET : 4], 0.1, SCALE_MOTION)


def _of_lens(camera: Camera, rows: Float, focal_percent: float, centre_px: float) -> Iterator[_Part]:
    """Yield the parts of a lens, whose parameters come first in some rows (N, C), with their floors."""
    focal = 100.0 / float(camera.intrinsics[:2].mean())
    yield _Part(f"{camera.name}, focal lengths", "%", focal, rows[:2], focal_percent, _DEPTHS)
    yield _Part(f"{camera.name}, principal point", "px", 1.0, rows[2:INTRINSICS], centre_px, _DEPTHS)
