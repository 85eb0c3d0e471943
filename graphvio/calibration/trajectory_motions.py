"""Motions of two cameras from trajectories that others' software made, on clocks of their own.

Such trajectories carry no covariance: the noise of their motions is what the residuals of a first solution show, for
each length of segment by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.calibration import graph, paper_method
from graphvio.calibration.clocks import find_offset
from graphvio.calibration.consistency import LIMIT, Further, errors_of, whitened
from graphvio.calibration.dispersion import dispersion
from graphvio.calibration.intervals import LENGTHS_S, Segments, ends_of, of_one_length
from graphvio.calibration.pose_pairs import inverses
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_adjoint, se3_inverse
from graphvio.trajectory import Trajectory

MAX_GAP_S = 0.25
"""Interval between two poses over which a trajectory is interpolated."""

_LEAST_PERIOD_NS = 19_500_000  # some less than 20 ms: stamps may be rounded
_FIRST_SIGMAS = np.repeat([3e-3, 6e-3], 3)  # radians and metres
_LEAST_SIGMA = 1e-6
_NORMAL_MEDIAN = 1.4826  # a normal distribution's sigma over the median of absolute values
_MOST_NOISE_SHARE = 2e-3  # of what the rig turns about its second axis
_ROUNDS = 5
_STEP_NS = 5_000_000
OFFSET_SIGMA_S, DRIFT_SIGMA = 0.05, 1e-4
"""What is known beforehand of the rest of an offset, seconds, and of the drift of clocks, seconds a second."""
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class ClockRelation:
    """How the clocks of two trajectories relate.

    Attributes:
        offset_ns: add it to a stamp of the first to get the second's of the same instant, at `at_ns`.
        drift: by how much the offset grows, seconds a second.
        at_ns: an instant in the middle, by the first clock.
    """

    offset_ns: int
    drift: float
    at_ns: int

    def of(self, stamps_ns: Int) -> Int:
        """Stamps by the second clock of stamps (N,) by the first."""
        since = stamps_ns - self.at_ns
        return np.asarray(stamps_ns + self.offset_ns + np.round(self.drift * since).astype(np.int64))

    def later(self, offset_s: float, drift: float) -> ClockRelation:
        """With a correction."""
        return replace(self, offset_ns=self.offset_ns + round(offset_s * _NS_PER_S), drift=self.drift + drift)


def first_relation(one: Trajectory, other: Trajectory, same_clock: bool) -> ClockRelation:
    """The relation as angular speeds tell it.

    Raises:
        CalibrationError: if they do not.
    """
    offset_ns = 0 if same_clock else find_offset(one, other).offset_ns
    begin = max(int(one.stamps_ns[0]), int(other.stamps_ns[0]) - offset_ns)
    end = min(int(one.stamps_ns[-1]), int(other.stamps_ns[-1]) - offset_ns)
    if end <= begin:
        raise CalibrationError(
            "the trajectories do not overlap in time; if each has a clock of its own, leave out --same-clock"
            if same_clock
            else "the trajectories do not overlap in time: they are not of the same recording"
        )
    return ClockRelation(offset_ns, 0.0, (begin + end) // 2)


def segments_of(trajectories: Sequence[Trajectory], clocks: Sequence[ClockRelation]) -> Segments:
    """Segments of J trajectories, with covariances that are all the same.

    Args:
        trajectories: of the cameras.
        clocks: of all but the first, relative to the first.
    """
    stamps = _thinned(trajectories[0].stamps_ns)
    sampled = [_at(trajectories[0], stamps)]
    sampled += [_at(each, clock.of(stamps)) for each, clock in zip(trajectories[1:], clocks, strict=True)]
    first, last = ends_of(stamps)
    inverse = [inverses(poses) for poses, _ in sampled]
    motions = np.stack([back[first] @ poses[last] for back, (poses, _) in zip(inverse, sampled, strict=True)], axis=1)
    known = np.stack([there[first] & there[last] for _, there in sampled], axis=1)
    rows = known[:, 0] & (known.sum(axis=1) > 1)
    covariances = np.broadcast_to(np.diag(0.5 * _FIRST_SIGMAS**2), (*known.shape, 6, 6)).copy()
    return Segments(stamps[first], stamps[last], first, last, motions, covariances, known).chosen(rows)


@dataclass(frozen=True, eq=False)
class TwoTrajectories:
    """Segments of two trajectories, ready for calibration.

    Attributes:
        segments: with covariances that the residuals show.
        clock: as refined with the relative pose.
        further: its offset, seconds, and drift as unknowns, around this relation.
    """

    segments: Segments
    clock: ClockRelation
    further: Further | None


def aligned(one: Trajectory, other: Trajectory, same_clock: bool = False, seed: int = 0) -> TwoTrajectories:
    """Refine the clocks' relation and the noise in turns with the relative pose.

    Args:
        one: of the first camera, in any world frame.
        other: of the second one, in another.
        same_clock: whether both have one clock, so that there is nothing to find.
        seed: of the random triples.

    Raises:
        CalibrationError: if no offset makes them turn alike, or no relative pose explains their motions.
    """
    clock = first_relation(one, other, same_clock)
    segments = segments_of([one, other], [clock])
    rows = np.array(of_one_length(segments), dtype=np.int64)
    pose = paper_method.calibrate(segments.pairs.chosen(rows), seed).left2_T_left1
    for _ in range(_ROUNDS):
        segments = _with_noise(segments, pose)
        further = None if same_clock else _clock_unknowns(one, other, clock, segments, pose)
        found = graph.solve(segments.pairs.chosen(rows), pose, None if further is None else further.chosen(rows))
        pose = found.left2_T_left1
        if further is not None:
            clock = clock.later(*found.further.tolist())
            segments = segments_of([one, other], [clock])
            rows = np.array(of_one_length(segments), dtype=np.int64)
    segments = _long_enough(_with_noise(segments, pose))
    further = None if same_clock else _clock_unknowns(one, other, clock, segments, pose)
    return TwoTrajectories(segments, clock, further)


def of_all(trajectories: Sequence[Trajectory], two: Mapping[tuple[int, int], TwoTrajectories]) -> Segments:
    """Segments of J trajectories, by the clock of the first and with each one's noise as the mean of what it has in
    results for two at a time.

    Args:
        trajectories: of the cameras.
        two: (first, second) -> what was aligned; with all (0, j).
    """
    segments = segments_of(trajectories, [two[0, j].clock for j in range(1, len(trajectories))])
    length = _length_classes(segments)
    noise: dict[tuple[int, int], list[Float]] = {}  # camera, length -> covariances
    for cameras, aligned_two in two.items():
        of_two = aligned_two.segments
        classes, rows = np.unique(_length_classes(of_two), return_index=True)
        for each, row in zip(classes.tolist(), rows.tolist(), strict=True):
            for column, camera in enumerate(cameras):
                noise.setdefault((camera, each), []).append(of_two.covariances[row, column])
    for (camera, each), told in noise.items():
        segments.covariances[length == each, camera] = np.mean(told, axis=0)
    sound = [each for each in np.unique(length).tolist() if all((j, each) in noise for j in range(len(trajectories)))]
    return segments.chosen(np.isin(length, sound))


def _long_enough(segments: Segments) -> Segments:
    """Without lengths over which the rig turns too little against the noise.

    Noise in a motion's own rotation looks like turning that has no effect, and so makes the offset between the cameras
    smaller than it is, by the share of the turning's mean square that is noise.
    """
    length = _length_classes(segments)
    shares = {}
    for each in np.unique(length).tolist():
        pairs = segments.chosen(length == each).pairs
        turning = np.linalg.eigvalsh(pairs.rotations_rad.T @ pairs.rotations_rad / len(pairs))
        noise = np.trace(pairs.covariance_2[:, :3, :3], axis1=1, axis2=2).mean() / 3.0
        shares[each] = noise / max(float(turning[1]), 1e-12)
    most = max(_MOST_NOISE_SHARE, min(shares.values()))
    return segments.chosen(np.isin(length, [each for each, share in shares.items() if share <= most]))


def _with_noise(segments: Segments, left2_T_left1: Float) -> Segments:
    """Segments of two cameras, of which each has half of what the residuals of segments of that length show."""
    pairs = segments.pairs
    residuals = errors_of(left2_T_left1, pairs.motion_1, pairs.motion_2)
    adjoint = se3_adjoint(se3_inverse(left2_T_left1))
    covariances = segments.covariances.copy()
    length = _length_classes(segments)
    for each in np.unique(length):
        of_length = length == each
        half = 0.5 * _robust_covariance(residuals[of_length])
        covariances[of_length] = np.stack([adjoint @ half @ adjoint.T, half])
        covariances[of_length] *= _scatter(replace(segments, covariances=covariances).chosen(of_length), left2_T_left1)
    return replace(segments, covariances=covariances)


def _scatter(segments: Segments, left2_T_left1: Float) -> float:
    """Factor on the noise of segments of one length, as errors of an odometry last: what ten short segments tell is
    much less than ten times what one of them does."""
    pairs = segments.chosen(of_one_length(segments)).pairs
    errors, jacobians = whitened(pairs, left2_T_left1)
    within = np.sum(errors**2, axis=1) <= LIMIT
    return dispersion(pairs.chosen(within), errors[within], jacobians[within], np.eye(6), chance=0.5)


def _length_classes(segments: Segments) -> Int:
    """Which of `LENGTHS_S` each segment (N,) is nearest to."""
    lengths_s = (segments.end_ns - segments.start_ns) / _NS_PER_S
    return np.asarray(np.argmin(np.abs(lengths_s[:, None] - np.array(LENGTHS_S)), axis=1))


def _robust_covariance(residuals: Float) -> Float:
    """Covariance (6, 6) of residuals (N, 6), some of which may be outliers: one sigma for rotations and one for
    translations, as much as a minute of motions tells reliably."""
    rotation, translation = (np.median(np.abs(residuals[:, part])) for part in (slice(0, 3), slice(3, 6)))
    sigmas = _NORMAL_MEDIAN * np.repeat([rotation, translation], 3)
    return np.diag(np.maximum(sigmas, _LEAST_SIGMA) ** 2)


def _clock_unknowns(
    one: Trajectory, other: Trajectory, clock: ClockRelation, segments: Segments, left2_T_left1: Float
) -> Further:
    """Offset and drift as unknowns, with derivatives by differences."""
    back, ahead = (
        _errors(one, other, clock.later(sign * _STEP_NS / _NS_PER_S, 0.0), segments, left2_T_left1)
        for sign in (-1.0, 1.0)
    )
    by_offset = (ahead - back) * (0.5 * _NS_PER_S / _STEP_NS)
    by_offset[~np.isfinite(by_offset).all(axis=1)] = 0.0  # at the very ends
    since_s = (0.5 * (segments.start_ns + segments.end_ns) - clock.at_ns) / _NS_PER_S
    return Further(np.stack([by_offset, since_s[:, None] * by_offset], axis=2), np.array([OFFSET_SIGMA_S, DRIFT_SIGMA]))


def _errors(
    one: Trajectory, other: Trajectory, clock: ClockRelation, segments: Segments, left2_T_left1: Float
) -> Float:
    """Errors (N, 6) of the same segments under another relation of the clocks; NaN where one ends."""
    stamps = _thinned(one.stamps_ns)
    poses, known = _at(other, clock.of(stamps))
    motion_2 = inverses(poses)[segments.first] @ poses[segments.last]
    errors = errors_of(left2_T_left1, segments.pairs.motion_1, motion_2)
    errors[~(known[segments.first] & known[segments.last])] = np.nan
    return errors


def _thinned(stamps_ns: Int) -> Int:
    """Stamps that are at least 20 ms apart."""
    kept = [int(stamps_ns[0])]
    for stamp in stamps_ns.tolist():
        if stamp - kept[-1] >= _LEAST_PERIOD_NS:
            kept.append(stamp)
    return np.array(kept, dtype=np.int64)


def _at(trajectory: Trajectory, stamps_ns: Int) -> tuple[Float, Bool]:
    """Poses (N, 4, 4) at stamps (N,), and where they are known (N,); the identity elsewhere."""
    found, known = trajectory.at(stamps_ns, MAX_GAP_S)
    poses = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    poses[known] = found.nav_T_body
    return poses, known
