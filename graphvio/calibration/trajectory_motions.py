"""Motions of cameras from trajectories of any odometry, each on a clock of its own.

Such trajectories carry no covariance: the noise of their motions is estimated from the residuals of a first solution,
for each length of segment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.calibration import graph, paper_method
from graphvio.calibration.clocks import ClockRelation, first_relation
from graphvio.calibration.consistency import LIMIT, errors_of, whitened
from graphvio.calibration.nuisances import Nuisances
from graphvio.calibration.pose_pairs import inverses
from graphvio.calibration.segments import LENGTHS_S, Segments, of_one_length, segment_ends
from graphvio.calibration.validation import dispersion
from graphvio.geometry import se3_adjoint, se3_inverse
from graphvio.trajectory import Trajectory

_MAX_GAP_S = 0.25  # longest time between two poses over which a trajectory is interpolated
_MIN_PERIOD_NS = 19_500_000  # somewhat less than 20 ms, as stamps may be rounded
_INITIAL_SIGMAS = np.repeat([3e-3, 6e-3], 3)  # radians and metres
_MIN_SIGMA = 1e-6
_NORMAL_MEDIAN = 1.4826  # sigma of a normal distribution over its median of absolute values
_MAX_NOISE_SHARE = 2e-3  # of noise in the mean square of the rotation about the second axis
_ROUNDS = 5
_STEP_NS = 5_000_000
_OFFSET_SIGMA_S, _DRIFT_SIGMA = 0.05, 1e-4  # a priori: seconds, seconds per second
_NS_PER_S = 1_000_000_000


def segments_of(trajectories: Sequence[Trajectory], clocks: Sequence[ClockRelation]) -> Segments:
    """List segments of J trajectories, with equal initial covariances; ``clocks`` are relative to the first clock."""
    stamps = _thinned(trajectories[0].stamps_ns)
    sampled = [_at(trajectories[0], stamps)]
    sampled += [_at(each, clock.of(stamps)) for each, clock in zip(trajectories[1:], clocks, strict=True)]
    first, last = segment_ends(stamps)
    inverse = [inverses(poses) for poses, _ in sampled]
    motions = np.stack([back[first] @ poses[last] for back, (poses, _) in zip(inverse, sampled, strict=True)], axis=1)
    known = np.stack([there[first] & there[last] for _, there in sampled], axis=1)
    rows = known[:, 0] & (known.sum(axis=1) > 1)
    covariances = np.broadcast_to(np.diag(0.5 * _INITIAL_SIGMAS**2), (*known.shape, 6, 6)).copy()
    return Segments(stamps[first], stamps[last], first, last, motions, covariances, known).select(rows)


@dataclass(frozen=True, eq=False)
class TwoTrajectories:
    """Segments of two trajectories, ready for calibration."""

    segments: Segments  # segments with covariances estimated from residuals
    clock: ClockRelation  # refined together with the relative pose
    nuisances: Nuisances | None  # corrections of its offset, seconds, and drift; None for one clock


def aligned(one: Trajectory, other: Trajectory, same_clock: bool = False, seed: int = 0) -> TwoTrajectories:
    """Estimate the noise, the relative pose and, unless both have one clock, the clocks' relation, in alternation.

    Raises:
        CalibrationError: if no offset makes their angular speeds agree, or no relative pose explains their motions.
    """
    clock = first_relation(one, other, same_clock)
    segments = segments_of([one, other], [clock])
    rows = of_one_length(segments)
    pose = paper_method.calibrate(segments.pairs.select(rows), seed).left2_T_left1
    for _ in range(_ROUNDS):
        segments = _with_noise(segments, pose)
        nuisances = None if same_clock else _clock_nuisances(one, other, clock, segments, pose)
        found = graph.solve(segments.pairs.select(rows), pose, None if nuisances is None else nuisances.select(rows))
        pose = found.left2_T_left1
        if nuisances is not None:
            clock = clock.corrected(*found.nuisances.tolist())
            segments = segments_of([one, other], [clock])
            rows = of_one_length(segments)
    segments = _long_enough(_with_noise(segments, pose))
    nuisances = None if same_clock else _clock_nuisances(one, other, clock, segments, pose)
    return TwoTrajectories(segments, clock, nuisances)


def of_all(trajectories: Sequence[Trajectory], two: Mapping[tuple[int, int], TwoTrajectories]) -> Segments:
    """List segments of J trajectories on the first one's clock; their noise is the mean of that by two at a time."""
    segments = segments_of(trajectories, [two[0, j].clock for j in range(1, len(trajectories))])
    length = _length_classes(segments)
    noise: dict[tuple[int, int], list[Float]] = {}  # camera, length -> covariances
    for cameras, aligned_two in two.items():
        of_two = aligned_two.segments
        classes, rows = np.unique(_length_classes(of_two), return_index=True)
        for each, row in zip(classes.tolist(), rows.tolist(), strict=True):
            for column, camera in enumerate(cameras):
                noise.setdefault((camera, each), []).append(of_two.covariances[row, column])
    for (camera, each), covariances in noise.items():
        segments.covariances[length == each, camera] = np.mean(covariances, axis=0)
    complete = [
        each for each in np.unique(length).tolist() if all((j, each) in noise for j in range(len(trajectories)))
    ]
    return segments.select(np.isin(length, complete))


def _long_enough(segments: Segments) -> Segments:
    """Drop segments of lengths over which the rig rotates too little compared with the noise.

    Noise in a motion's rotation looks like rotation that has no effect, and so biases the offset between the cameras
    towards zero, by the share of the rotation's mean square that is noise.
    """
    length = _length_classes(segments)
    shares = {}
    for each in np.unique(length).tolist():
        pairs = segments.select(length == each).pairs
        turning = np.linalg.eigvalsh(pairs.rotations_rad.T @ pairs.rotations_rad / len(pairs))
        noise = np.trace(pairs.covariance_2[:, :3, :3], axis1=1, axis2=2).mean() / 3.0
        shares[each] = noise / max(float(turning[1]), 1e-12)
    max_share = max(_MAX_NOISE_SHARE, min(shares.values()))
    return segments.select(np.isin(length, [each for each, share in shares.items() if share <= max_share]))


def _with_noise(segments: Segments, left2_T_left1: Float) -> Segments:
    """Set covariances of two cameras: half of the residuals' covariance each, by the length of segments."""
    pairs = segments.pairs
    residuals = errors_of(left2_T_left1, pairs.motion_1, pairs.motion_2)
    adjoint = se3_adjoint(se3_inverse(left2_T_left1))
    covariances = segments.covariances.copy()
    length = _length_classes(segments)
    for each in np.unique(length):
        of_length = length == each
        half = 0.5 * _robust_covariance(residuals[of_length])
        covariances[of_length] = np.stack([adjoint @ half @ adjoint.T, half])
        covariances[of_length] *= _scatter(replace(segments, covariances=covariances).select(of_length), left2_T_left1)
    return replace(segments, covariances=covariances)


def _scatter(segments: Segments, left2_T_left1: Float) -> float:
    """Return a factor on the noise of segments of one length, as an odometry's errors are correlated over time."""
    pairs = segments.select(of_one_length(segments)).pairs
    errors, jacobians = whitened(pairs, left2_T_left1)
    within = np.sum(errors**2, axis=1) <= LIMIT
    return dispersion(pairs.select(within), errors[within], jacobians[within], np.eye(6), chance=0.5)


def _length_classes(segments: Segments) -> Int:
    """Return the index (N,) of the element of `LENGTHS_S` that is nearest to each segment's duration."""
    lengths_s = (segments.end_ns - segments.start_ns) / _NS_PER_S
    return np.asarray(np.argmin(np.abs(lengths_s[:, None] - np.array(LENGTHS_S)), axis=1))


def _robust_covariance(residuals: Float) -> Float:
    """Return a robust covariance (6, 6) of residuals (N, 6): one sigma for rotations and one for translations."""
    rotation, translation = (np.median(np.abs(residuals[:, part])) for part in (slice(0, 3), slice(3, 6)))
    sigmas = _NORMAL_MEDIAN * np.repeat([rotation, translation], 3)
    return np.diag(np.maximum(sigmas, _MIN_SIGMA) ** 2)


def _clock_nuisances(
    one: Trajectory, other: Trajectory, clock: ClockRelation, segments: Segments, left2_T_left1: Float
) -> Nuisances:
    """Return offset and drift as nuisance variables, with numerical derivatives."""
    back, ahead = (
        _errors(one, other, clock.corrected(sign * _STEP_NS / _NS_PER_S, 0.0), segments, left2_T_left1)
        for sign in (-1.0, 1.0)
    )
    by_offset = (ahead - back) * (0.5 * _NS_PER_S / _STEP_NS)
    by_offset[~np.isfinite(by_offset).all(axis=1)] = 0.0  # at the very ends
    since_s = (0.5 * (segments.start_ns + segments.end_ns) - clock.at_ns) / _NS_PER_S
    return Nuisances(
        np.stack([by_offset, since_s[:, None] * by_offset], axis=2), np.array([_OFFSET_SIGMA_S, _DRIFT_SIGMA])
    )


def _errors(
    one: Trajectory, other: Trajectory, clock: ClockRelation, segments: Segments, left2_T_left1: Float
) -> Float:
    """Return errors (N, 6) of the same segments with another relation of the clocks; NaN beyond a trajectory's end."""
    stamps = _thinned(one.stamps_ns)
    poses, known = _at(other, clock.of(stamps))
    motion_2 = inverses(poses)[segments.first] @ poses[segments.last]
    errors = errors_of(left2_T_left1, segments.pairs.motion_1, motion_2)
    errors[~(known[segments.first] & known[segments.last])] = np.nan
    return errors


def _thinned(stamps_ns: Int) -> Int:
    """Select stamps that are at least 20 ms apart."""
    kept = [int(stamps_ns[0])]
    for stamp in stamps_ns.tolist():
        if stamp - kept[-1] >= _MIN_PERIOD_NS:
            kept.append(stamp)
    return np.array(kept, dtype=np.int64)


def _at(trajectory: Trajectory, stamps_ns: Int) -> tuple[Float, Bool]:
    """Return poses (N, 4, 4) at stamps (N,), the identity where unknown, and a mask (N,) of known ones."""
    found, known = trajectory.at(stamps_ns, _MAX_GAP_S)
    poses = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    poses[known] = found.nav_T_body
    return poses, known
