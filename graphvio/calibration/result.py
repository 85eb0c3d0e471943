"""The result of a calibration: poses of all pairs, their difference from the rig file, and the corrected rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space
from scipy.special import chdtrc, ndtri

from graphvio.arrays import Bool, Float
from graphvio.calibration.clocks import ClockRelation
from graphvio.calibration.imu_alignment import ImuAlignment
from graphvio.calibration.pair_calibration import PairCalibration, size_in_words
from graphvio.calibration.several import CameraExtrinsics
from graphvio.errors import CalibrationError
from graphvio.geometry import se3, se3_exp, se3_inverse, se3_log, so3_log, so3_right_jacobian_inverse
from graphvio.rig import Rig, StereoPair

_CHANCE = 1e-3
_SIGNIFICANT = 4.0  # sigmas of a drift of clocks
_TINY = 1e-300
_COARSE_RAD, _COARSE_M = np.deg2rad(0.5), 0.01
_NEARER = 20  # iterations towards the nearest of equally likely poses
_MAX_UNDETERMINED = 0.01  # share of undetermined directions in a value that counts as known
_SWAPPED = 0.2  # distance of the rig's inverse over that of the rig's value


@dataclass(frozen=True, eq=False)
class RigComparison:
    """Comparison of a pair's pose in the rig file with the calibration, in directions that the motions determine."""

    tangent: Float  # (6,) from the calibration to the file's ``left2_T_left1``, ``[rotation, translation]`` in left1
    sigmas: float  # significance of the difference, as a number of standard deviations of one normal variable
    is_off: bool  # whether chance does not explain it
    is_swapped: bool  # whether the file would be right if both pairs changed places
    is_partial: bool = False  # whether the motions determine only a part of the pose, so that sigmas are approximate

    @property
    def reliability(self) -> str:
        """Suffix for a sentence on the size of the difference."""
        return " as far as the motions determine it" if self.is_partial else f" ({self.sigmas:.1f} sigma)"

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation."""
        return float(np.rad2deg(np.linalg.norm(self.tangent[:3])))

    @property
    def distance_m(self) -> float:
        """Length of the translation."""
        return float(np.linalg.norm(self.tangent[3:]))


@dataclass(frozen=True, eq=False)
class PoseSummary:
    """A pose as three values each of offset and rotation, with their sigmas, and whether they are determined."""

    offset_m: Float  # (3,) position of the first left camera in another one's axes
    offset_sigmas_m: Float  # (3,)
    offset_known: Bool  # (3,)
    turn_rad: Float  # (3,) rotation vector of the first left camera in the other one
    turn_sigmas_rad: Float  # (3,)
    turn_known: Bool  # (3,)


@dataclass(frozen=True, eq=False)
class Clock:
    """A camera's clock relative to that of another camera."""

    relation: ClockRelation  # offset and drift
    offset_sigma_s: float  # standard deviation of the offset
    drift_sigma: float  # standard deviation of the drift, seconds per second

    @property
    def drifts(self) -> bool:
        """Whether the drift is significant."""
        return abs(self.relation.drift) > _SIGNIFICANT * self.drift_sigma


@dataclass(frozen=True, eq=False)
class Calibration:
    """The poses of all stereo pairs, or of cameras with trajectories, on a rig.

    Attributes:
        names: names of J pairs or cameras.
        places: poses of all pairs or cameras, with the results for two at a time.
        rig: the rig that was calibrated; None for trajectories.
        imu: pair -> alignment of its left camera with the IMU, where both could be compared.
        clocks: (first, second) -> relation of their clocks, for trajectories.
        warnings: sentences on everything that a user should know before using the result.
    """

    names: tuple[str, ...]
    places: CameraExtrinsics
    rig: Rig | None = None
    imu: Mapping[int, ImuAlignment] | None = None
    clocks: Mapping[tuple[int, int], Clock] | None = None
    warnings: tuple[str, ...] = ()

    @property
    def pair(self) -> PairCalibration:
        """The calibration of the first two pairs or cameras alone, with all details."""
        return self.places.pairwise[0, 1]

    @property
    def left2_T_left1(self) -> Float:
        """Relative pose (4, 4), the paper's P_12, of the first two."""
        return np.ascontiguousarray(self.places.left_T_left1[1])

    @property
    def covariance(self) -> Float:
        """Covariance (6, 6) of left2_T_left1, tangent ``[rotation, translation]`` in left1."""
        return self.places.covariance[:6, :6]

    @property
    def inliers(self) -> Bool:
        """Mask (N,) of pose pairs of the first two that are not outliers."""
        return self.pair.inlier

    @property
    def alignment_errors_m(self) -> Float:
        """Lengths (N,) of the paper's alignment errors, eq. (7), of the first two."""
        return self.pair.alignment_errors_m

    @property
    def is_complete(self) -> bool:
        """Whether the motions determine every pose in full."""
        return not any(len(self._undetermined(j)) for j in range(1, len(self.names)))

    def pose_summary(self, j: int) -> PoseSummary:
        """Summarise the first left camera's pose in the left camera of another pair.

        Args:
            j: index of the pair, from 1.

        Returns:
            Its rotation and translation with standard deviations.
        """
        place = np.ascontiguousarray(self.places.left_T_left1[j])
        covariance = self.places.covariance[6 * j - 6 : 6 * j, 6 * j - 6 : 6 * j]
        turn = so3_log(place[:3, :3])
        # A tangent in left1 changes the offset by R rho, and the rotation vector by the inverse right Jacobian.
        by_tangent = np.zeros((6, 6))
        by_tangent[:3, :3], by_tangent[3:, 3:] = so3_right_jacobian_inverse(turn), place[:3, :3]
        sigmas = np.sqrt(np.diag(by_tangent @ covariance @ by_tangent.T))
        known = np.linalg.norm(by_tangent @ self._undetermined(j).T, axis=1) < _MAX_UNDETERMINED
        return PoseSummary(place[:3, 3], sigmas[3:], known[3:], turn, sigmas[:3], known[:3])

    def compare_rig(self, j: int = 1) -> RigComparison | None:
        """Compare the rig's pose of a pair relative to the first with the calibration.

        Args:
            j: index of the pair, from 1.

        Returns:
            Their difference, or None without a rig.
        """
        if self.rig is None:
            return None
        given = np.ascontiguousarray(self.rig.left2_T_left1(0, j))
        tangent, square, degrees = self._apart(j, given)
        _, of_swapped, _ = self._apart(j, se3_inverse(given))
        chance = float(chdtrc(degrees, square))
        sigmas = float(0.0 - ndtri(0.5 * chance)) if chance > _TINY else float(np.sqrt(square))
        is_off = chance < _CHANCE
        if degrees < 6:  # only to first order are these independent of the undetermined directions
            rotation, translation = np.linalg.norm(tangent.reshape(2, 3), axis=1)
            is_off = is_off and bool(rotation > _COARSE_RAD or translation > _COARSE_M)
        is_swapped = is_off and of_swapped < _SWAPPED**2 * square
        return RigComparison(tangent, sigmas, is_off, is_swapped, degrees < 6)

    def _undetermined(self, j: int) -> Float:
        return self.places.pairwise[0, j].observability.undetermined

    def _apart(self, j: int, given: Float) -> tuple[Float, float, int]:
        """Return the determined part of the tangent (6,) to a pose, its squared Mahalanobis length and dimension."""
        undetermined = self._undetermined(j)
        place = np.ascontiguousarray(self.places.left_T_left1[j])
        for _ in range(_NEARER):  # all poses along these directions are equally likely: take the nearest one
            apart = se3_log(se3_inverse(place) @ given)
            place = place @ se3_exp(undetermined.T @ (undetermined @ apart))
        determined = null_space(undetermined).T if len(undetermined) else np.eye(6)
        apart = determined @ se3_log(se3_inverse(place) @ given)
        covariance = determined @ self.places.covariance[6 * j - 6 : 6 * j, 6 * j - 6 : 6 * j] @ determined.T
        return determined.T @ apart, float(apart @ np.linalg.solve(covariance, apart)), len(determined)

    def calibrated_rig(self, correct_imu: bool = False) -> Rig:
        """Return the rig with the calibrated poses of all pairs; the first left camera keeps its pose.

        Args:
            correct_imu: also correct the rotation of the cameras in body and the time offset by the first left
                camera's comparison with the IMU, where the rig is significantly wrong; the position in body stays,
                which rotations do not determine.

        Raises:
            CalibrationError: if there is no rig, the poses are not fully determined, or there was no IMU to correct by.
        """
        if self.rig is None:
            raise CalibrationError("trajectories were calibrated, not a rig: there is no rig to correct")
        if not self.is_complete:
            missing = next(part for each in self.places.pairwise.values() for part in each.observability.missing)
            raise CalibrationError(f"there is no calibrated rig, as the motions do not determine it: {missing}")
        body_T_left1 = np.ascontiguousarray(self.rig.pairs[0].left.body_T_cam)
        imu = self.rig.imu
        if correct_imu:
            if not self.imu or 0 not in self.imu or imu is None:
                raise CalibrationError(
                    "the first pair was not compared with an IMU; the warnings say why, if there is one"
                )
            if self.imu[0].is_turned:
                body_T_left1 = se3(self.imu[0].body_R_left, body_T_left1[:3, 3].copy())
            if self.imu[0].is_late:
                imu = replace(imu, time_offset_s=self.imu[0].time_offset_s)
        first, *others = self.rig.pairs
        placed = [
            _placed(pair, body_T_left1 @ se3_inverse(np.ascontiguousarray(left_T_left1)))
            for pair, left_T_left1 in zip(others, self.places.left_T_left1[1:], strict=True)
        ]
        first = _placed(first, body_T_left1) if correct_imu else first
        return replace(self.rig, pairs=(first, *placed), imu=imu)


def rig_warnings(found: Calibration) -> list[str]:
    """Return sentences on what is wrong with the rig file."""
    sentences = []
    for j in range(1, len(found.names)):
        rig = found.compare_rig(j)
        if rig is None or not rig.is_off:
            continue
        sentence = f"the rig has {found.names[j]} {size_in_words(rig.tangent)} from where it is relative to "
        sentence += f"{found.names[0]}{rig.reliability}"
        if rig.is_swapped:
            sentence += "; it would be right if both pairs changed places: are their images, or their cables, swapped?"
        sentences.append(sentence)
    for j, alignment in (found.imu or {}).items():
        sentences += alignment.warnings(found.names[j])
    return sentences


def _placed(pair: StereoPair, body_T_left: Float) -> StereoPair:
    right = body_T_left @ se3_inverse(np.ascontiguousarray(pair.right_T_left))
    return replace(pair, left=replace(pair.left, body_T_cam=body_T_left), right=replace(pair.right, body_T_cam=right))
