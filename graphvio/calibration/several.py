"""Calibration of any number of cameras: two at a time, and all at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import chdtri

from graphvio.arrays import Float
from graphvio.calibration import joint
from graphvio.calibration.nuisances import ScaleMode
from graphvio.calibration.pair_calibration import SYSTEMATIC_POSE_COVARIANCE, PairCalibration, size_in_words
from graphvio.calibration.segments import Segments, information_gains, most_informative
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_adjoint, se3_inverse, se3_log

_CHANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Loop:
    """A chain of results for two cameras at a time around three cameras; without errors it is the identity."""

    cameras: tuple[int, int, int]  # their indices
    error: Float  # (6,) tangent ``[rotation, translation]`` in the first of the three
    covariance: Float  # (6, 6) of the error, if the three results were independent

    @property
    def statistic(self) -> float:
        """Squared Mahalanobis distance of the error from zero, 6 degrees of freedom."""
        return float(self.error @ np.linalg.solve(self.covariance, self.error))


@dataclass(frozen=True, eq=False)
class CameraExtrinsics:
    """The poses of all cameras relative to the first."""

    left_T_left1: Float  # (J, 4, 4) pose of the first left camera in each; the first is the identity
    covariance: Float  # (6 (J - 1), 6 (J - 1)) of the others, tangents ``[rotation, translation]`` in left1
    pairwise: Mapping[tuple[int, int], PairCalibration]  # (first, second) -> result for these two alone
    loops: tuple[Loop, ...]  # loops of three cameras; empty for two cameras
    # (first, second) -> squared Mahalanobis distance (6 degrees of freedom) of the result for all cameras from that for
    # these two alone, by the latter's covariance
    distances: Mapping[tuple[int, int], float]
    warnings: tuple[str, ...]  # sentences


def pairwise(
    names: Sequence[str], calibrate: Callable[[int, int, ScaleMode], PairCalibration], scale_mode: ScaleMode
) -> tuple[dict[tuple[int, int], PairCalibration], list[str]]:
    """Calibrate all cameras, two at a time; if one scale is significantly wrong, the scales of all are estimated.

    Returns:
        (first, second) -> result, and a sentence on each result that is missing.

    Raises:
        CalibrationError: if the pose of one of the cameras relative to the first cannot be found.
    """
    found: dict[tuple[int, int], PairCalibration] = {}
    missing: list[str] = []
    for one, other in combinations(range(len(names)), 2):
        try:
            found[one, other] = calibrate(one, other, scale_mode)
        except CalibrationError as error:
            message = f"{names[one]} and {names[other]}: {error}"
            if one == 0:
                raise CalibrationError(message) from None
            missing.append(message)
    if any(each.scale_estimated for each in found.values()):
        found = {
            cameras: each if each.scale_estimated else calibrate(*cameras, "estimate")
            for cameras, each in found.items()
        }
    return found, missing


def place_all(
    found: Mapping[tuple[int, int], PairCalibration],
    names: Sequence[str],
    segments: Segments,
    systematic_pose_covariance: Float = SYSTEMATIC_POSE_COVARIANCE,
) -> CameraExtrinsics:
    """Find the poses that fit all motions at once.

    Args:
        found: results for two cameras at a time, including those of the first camera and each other one.
        names: names of J cameras.
        segments: all segments of J cameras that may be chosen.
        systematic_pose_covariance: covariance (6, 6) of each camera's pose as its images see it.

    Raises:
        CalibrationError: if a camera agrees with the others in too few motions.
    """
    warnings = [
        f"{names[i]} and {names[j]}: {sentence}" for (i, j), each in found.items() for sentence in each.warnings
    ]
    warnings += [
        f"{names[i]} and {names[j]}: {each.scale.describe(names[i], names[j])}"
        + ("; the result is corrected for it" if each.scale_estimated else "; the result is not corrected for it")
        for (i, j), each in found.items()
        if each.scale.is_wrong
    ]
    count = len(names)
    start = np.array([np.eye(4), *(found[0, j].left2_T_left1 for j in range(1, count))])
    if count == 2:
        return CameraExtrinsics(start, found[0, 1].covariance, found, (), {}, tuple(warnings))
    segments = _rescaled(segments, found)
    chosen = segments.select(most_informative(segments, _gains(segments, found, count)))
    held = [found[0, j].observability.undetermined for j in range(1, count)]
    solution = joint.solve(chosen, start, held)
    covariance = max(each.dispersion for each in found.values()) * solution.covariance
    covariance = (
        covariance + _systematic(solution.left_T_left1, systematic_pose_covariance) + _undetermined(found, count)
    )
    apart = {(i, j): se3_log(se3_inverse(_in_first_lengths(found, i, j)) @ solution.between(i, j)) for i, j in found}
    distances = {
        cameras: float(apart[cameras] @ np.linalg.solve(each.covariance, apart[cameras]))
        for cameras, each in found.items()
    }
    for (i, j), distance in distances.items():
        if distance > chdtri(6, _CHANCE):
            warnings.append(
                f"{names[i]} and {names[j]}: all cameras together put them {size_in_words(apart[i, j])} from where "
                f"these two alone do, more than the noise explains (chi-square {distance:.0f} of 6)"
            )
    loops = tuple(
        _loop(found, three)
        for three in combinations(range(count), 3)
        if all(two in found for two in combinations(three, 2))
    )
    return CameraExtrinsics(solution.left_T_left1, covariance, found, loops, distances, tuple(warnings))


def _rescaled(segments: Segments, found: Mapping[tuple[int, int], PairCalibration]) -> Segments:
    """Scale all motions to the lengths that the first camera measures, where scales were estimated."""
    motions = segments.motions.copy()
    for j in range(1, segments.cameras):
        if found[0, j].scale_estimated:
            motions[:, j, :3, 3] *= np.exp(-found[0, j].scale.log_ratio)
    return replace(segments, motions=motions)


def _gains(segments: Segments, found: Mapping[tuple[int, int], PairCalibration], count: int) -> Float:
    """Return the information gains (N,) of segments, summed over all cameras."""
    gains = np.zeros(len(segments))
    for j in range(1, count):
        both = segments.known[:, 0] & segments.known[:, j]
        each = found[0, j]
        gains[both] += information_gains(segments.of_both(0, j).pairs, each.left2_T_left1, each.covariance)
    return gains


def _systematic(left_T_left1: Float, systematic_pose_covariance: Float) -> Float:
    """Return the covariance of all poses by the cameras' systematic errors; the first camera's is common to all."""
    others = len(left_T_left1) - 1
    covariance = np.tile(systematic_pose_covariance, (others, others))
    for j in range(others):
        adjoint = se3_adjoint(se3_inverse(np.ascontiguousarray(left_T_left1[j + 1])))
        covariance[6 * j : 6 * j + 6, 6 * j : 6 * j + 6] += adjoint @ systematic_pose_covariance @ adjoint.T
    return covariance


def _undetermined(found: Mapping[tuple[int, int], PairCalibration], count: int) -> Float:
    """Return the covariance of all poses in directions that the motions do not determine."""
    covariance = np.zeros((6 * (count - 1), 6 * (count - 1)))
    for j in range(1, count):
        each = found[0, j]
        across = each.observability.undetermined.T @ each.observability.undetermined
        covariance[6 * j - 6 : 6 * j, 6 * j - 6 : 6 * j] = across @ each.covariance @ across
    return covariance


def _in_first_lengths(found: Mapping[tuple[int, int], PairCalibration], one: int, other: int) -> Float:
    """Return ``left_other_T_left_one`` (4, 4) by these two cameras alone, in lengths of the first camera."""
    place = np.array(found[one, other].left2_T_left1)
    if one and found[0, one].scale_estimated:
        place[:3, 3] *= np.exp(-found[0, one].scale.log_ratio)
    return place


def _loop(found: Mapping[tuple[int, int], PairCalibration], three: tuple[int, int, int]) -> Loop:
    i, j, k = three
    one, other, both = found[i, j], found[j, k], found[i, k]
    first, second, across = (_in_first_lengths(found, *two) for two in ((i, j), (j, k), (i, k)))
    around = se3_inverse(across) @ second @ first
    adjoint = se3_adjoint(se3_inverse(one.left2_T_left1))
    covariance = one.covariance + adjoint @ other.covariance @ adjoint.T + both.covariance
    return Loop(three, se3_log(around), covariance)
