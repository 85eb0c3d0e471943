"""The result of a calibration: places of all pairs, what they were before, and the rig that follows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space
from scipy.stats import chi2, norm

from graphvio.arrays import Bool, Float
from graphvio.calibration.imu_alignment import ImuAlignment
from graphvio.calibration.pair_calibration import PairCalibration, size_in_words
from graphvio.calibration.several import Places
from graphvio.calibration.trajectory_motions import ClockRelation
from graphvio.errors import CalibrationError
from graphvio.geometry import se3, se3_exp, se3_inverse, se3_log, so3_log, so3_right_jacobian_inverse
from graphvio.rig import Rig, StereoPair

_CHANCE = 1e-3
_SIGNIFICANT = 4.0  # sigmas of a drift of clocks
_TINY = 1e-300
_COARSE_RAD, _COARSE_M = np.deg2rad(0.5), 0.01
_NEARER = 20  # steps to the nearest of places that are as likely
_HARDLY = 0.01  # of a direction that is not determined: a value without that is known
_SWAPPED = 0.2  # of the distance from the rig's value, that of its inverse is


@dataclass(frozen=True, eq=False)
class Present:
    """What a rig file says of a pair's place, against the calibration, as far as the motions tell.

    Attributes:
        tangent: (6,) from the calibration to the file's ``left2_T_left1``, ``[rotation, translation]`` in left1.
        sigmas: how unlikely that is by chance, as so many standard deviations of one normal variable.
        is_off: whether chance does not explain it.
        is_swapped: whether the file's would be right if both pairs changed places.
        is_partial: whether the motions tell a part only, so that sigmas are about right at best.
    """

    tangent: Float
    sigmas: float
    is_off: bool
    is_swapped: bool
    is_partial: bool = False

    @property
    def doubt(self) -> str:
        """What is to be said of its size."""
        return " as far as the motions tell" if self.is_partial else f" ({self.sigmas:.1f} sigma)"

    @property
    def angle_deg(self) -> float:
        """Size of the rotation."""
        return float(np.rad2deg(np.linalg.norm(self.tangent[:3])))

    @property
    def distance_m(self) -> float:
        """Size of the translation."""
        return float(np.linalg.norm(self.tangent[3:]))


@dataclass(frozen=True, eq=False)
class Shown:
    """A place as people read it: three values each, their standard deviations, and whether the motions tell them.

    Attributes:
        offset_m: (3,) the first left camera's place in another one's axes.
        offset_sigmas_m: (3,).
        offset_known: (3,).
        turn_rad: (3,) rotation vector of the first left camera in the other one.
        turn_sigmas_rad: (3,).
        turn_known: (3,).
    """

    offset_m: Float
    offset_sigmas_m: Float
    offset_known: Bool
    turn_rad: Float
    turn_sigmas_rad: Float
    turn_known: Bool


@dataclass(frozen=True, eq=False)
class Clock:
    """How a camera's clock relates to the first one's.

    Attributes:
        relation: offset and drift.
        offset_sigma_s: of the offset.
        drift_sigma: of the drift, seconds a second.
    """

    relation: ClockRelation
    offset_sigma_s: float
    drift_sigma: float

    @property
    def drifts(self) -> bool:
        """Whether the drift is there beyond doubt."""
        return abs(self.relation.drift) > _SIGNIFICANT * self.drift_sigma


@dataclass(frozen=True, eq=False)
class Calibration:
    """Where all stereo pairs, or cameras with trajectories, are on a rig.

    Attributes:
        names: (J) of the pairs.
        places: of all, with what was found for two at a time.
        rig: that was calibrated; None for trajectories.
        imu: each left camera against the IMU, where both were recorded and could be compared.
        clocks: (first, second) -> how their clocks relate, for trajectories.
        warnings: a sentence for everything that a person should know before using the result.
    """

    names: tuple[str, ...]
    places: Places
    rig: Rig | None = None
    imu: Mapping[int, ImuAlignment] | None = None
    clocks: Mapping[tuple[int, int], Clock] | None = None
    warnings: tuple[str, ...] = ()

    @property
    def pair(self) -> PairCalibration:
        """The first two, by themselves: all details."""
        return self.places.pairwise[0, 1]

    @property
    def left2_T_left1(self) -> Float:
        """(4, 4), the paper's P_12 of the first two."""
        return np.ascontiguousarray(self.places.left_T_left1[1])

    @property
    def covariance(self) -> Float:
        """(6, 6) of it, tangent ``[rotation, translation]`` in left1."""
        return self.places.covariance[:6, :6]

    @property
    def inliers(self) -> Bool:
        """(N,) pose pairs of the first two that are no outliers."""
        return self.pair.inlier

    @property
    def alignment_errors_m(self) -> Float:
        """(N,) lengths of the paper's alignment errors, eq. (7), of the first two."""
        return self.pair.alignment_errors_m

    @property
    def is_complete(self) -> bool:
        """Whether the motions tell all of every place."""
        return not any(len(self._undetermined(j)) for j in range(1, len(self.names)))

    def shown(self, j: int) -> Shown:
        """The first left camera's pose in that of pair j."""
        place = np.ascontiguousarray(self.places.left_T_left1[j])
        covariance = self.places.covariance[6 * j - 6 : 6 * j, 6 * j - 6 : 6 * j]
        turn = so3_log(place[:3, :3])
        # A tangent in left1 moves the place by R rho, and the rotation vector by the inverse right Jacobian.
        by_tangent = np.zeros((6, 6))
        by_tangent[:3, :3], by_tangent[3:, 3:] = so3_right_jacobian_inverse(turn), place[:3, :3]
        sigmas = np.sqrt(np.diag(by_tangent @ covariance @ by_tangent.T))
        known = np.linalg.norm(by_tangent @ self._undetermined(j).T, axis=1) < _HARDLY
        return Shown(place[:3, 3], sigmas[3:], known[3:], turn, sigmas[:3], known[:3])

    def present(self, j: int = 1) -> Present | None:
        """The rig's own value for pair j, relative to the first, against the calibration; None without a rig."""
        if self.rig is None:
            return None
        given = np.ascontiguousarray(self.rig.left2_T_left1(0, j))
        tangent, square, told = self._apart(j, given)
        _, of_swapped, _ = self._apart(j, se3_inverse(given))
        chance = float(chi2.sf(square, told))
        sigmas = float(norm.isf(0.5 * chance)) if chance > _TINY else float(np.sqrt(square))
        is_off = chance < _CHANCE
        if told < 6:  # to first order only does the rest not depend on what is not known
            rotation, translation = np.linalg.norm(tangent.reshape(2, 3), axis=1)
            is_off = is_off and bool(rotation > _COARSE_RAD or translation > _COARSE_M)
        is_swapped = is_off and of_swapped < _SWAPPED**2 * square
        return Present(tangent, sigmas, is_off, is_swapped, told < 6)

    def _undetermined(self, j: int) -> Float:
        return self.places.pairwise[0, j].observability.undetermined

    def _apart(self, j: int, given: Float) -> tuple[Float, float, int]:
        """Tangent (6,) from the calibration to another value, without what the motions do not tell; its squared
        Mahalanobis distance, and of how many degrees of freedom that is."""
        undetermined = self._undetermined(j)
        place = np.ascontiguousarray(self.places.left_T_left1[j])
        for _ in range(_NEARER):  # all places along these directions are as likely: take the nearest one
            apart = se3_log(se3_inverse(place) @ given)
            place = place @ se3_exp(undetermined.T @ (undetermined @ apart))
        told = null_space(undetermined).T if len(undetermined) else np.eye(6)
        apart = told @ se3_log(se3_inverse(place) @ given)
        covariance = told @ self.places.covariance[6 * j - 6 : 6 * j, 6 * j - 6 : 6 * j] @ told.T
        return told.T @ apart, float(apart @ np.linalg.solve(covariance, apart)), len(told)

    def calibrated_rig(self, correct_imu: bool = False) -> Rig:
        """The rig with all pairs where the calibration has them; the first left camera keeps its place.

        Args:
            correct_imu: whether the cameras are turned against the IMU, and the time offset is set, as the first left
                camera's comparison with the IMU says, where the rig is wrong beyond doubt; its position in body stays,
                which rotations do not tell.

        Raises:
            CalibrationError: if there is no rig, the motions do not tell all, or there was no IMU to correct by.
        """
        if self.rig is None:
            raise CalibrationError("trajectories were calibrated, not a rig: there is no rig to correct")
        if not self.is_complete:
            missing = next(told for each in self.places.pairwise.values() for told in each.observability.missing)
            raise CalibrationError(f"there is no calibrated rig, as not all is known: {missing}")
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
    """What is wrong with the rig file, a sentence each."""
    told = []
    for j in range(1, len(found.names)):
        present = found.present(j)
        if present is None or not present.is_off:
            continue
        where = f"the rig has {found.names[j]} {size_in_words(present.tangent)} from where it is relative to "
        where += f"{found.names[0]}{present.doubt}"
        if present.is_swapped:
            where += "; it would be right if both pairs changed places: are their images, or their cables, swapped?"
        told.append(where)
    for j, alignment in (found.imu or {}).items():
        told += alignment.warnings(found.names[j])
    return told


def _placed(pair: StereoPair, body_T_left: Float) -> StereoPair:
    right = body_T_left @ se3_inverse(np.ascontiguousarray(pair.right_T_left))
    return replace(pair, left=replace(pair.left, body_T_cam=body_T_left), right=replace(pair.right, body_T_cam=right))
