"""Synthetic sessions of any length with known truth: what the odometry would measure on a walk in laps, no images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.optimization.first_windows import FirstWindows
from graphvio.optimization.loops.closures import LoopClosure, Place
from graphvio.optimization.record import Inertial, Motions, SessionRecord
from graphvio.optimization.views import Views
from graphvio.rig import Imu
from graphvio.simulation.imu import ImuTrack, measure
from graphvio.simulation.motion import Motion
from graphvio.trajectory import Trajectory

_FRAMESET_HZ = 20
_KEYFRAME_FRAMES = 4
_LAP_S = 90.0
_HALF_LENGTH_M, _HALF_WIDTH_M = 15.0, 9.0
_MOTION_SIGMAS = np.repeat([3e-4, 8e-4], 3)  # radians and metres, of one keyframe's motion
_SHARED = 0.5  # share of a motion's covariance that all motions from its keyframe have in common
_LOOP_SIGMAS = np.repeat([1e-3, 3e-3], 3)
_FALSE_SIGMAS = np.repeat([0.3, 2.0], 3)
_VELOCITY_SIGMA = 0.02
_GYRO_BIAS_SIGMA, _ACCEL_BIAS_SIGMA = 2e-4, 5e-3
_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class SyntheticSession:
    """A synthetic session and its truth.

    Attributes:
        record: as the odometry would have it.
        closures: between places of different laps; the false ones come last.
        false: how many of them are false.
        truth: of all framesets.
    """

    record: SessionRecord
    closures: list[LoopClosure]
    false: int
    truth: Trajectory


def make_session(
    duration_s: float, seed: int, imu: Imu, loops: int, false_share: float = 0.0, session: int = 0,
    corrections: Sequence[Float] = (), offset_s: float = 0.0,
) -> SyntheticSession:  # fmt: skip
    """Sample a walk in laps of 90 s around a building, 20 framesets and 5 keyframes a second.

    Args:
        duration_s: of the walk.
        seed: of all noise; walks of different seeds go the same way.
        imu: whose noise is simulated.
        loops: number of closures.
        false_share: share of them that are false: between any places, and off by metres.
        session: number of the session in the closures' places.
        corrections: (4, 4) for each pair, by which its extrinsics in the rig file are multiplied from the left; motions
            of single pairs are sampled for these.
        offset_s: added to the rig file's time offset.
    """
    rng = np.random.default_rng([seed, 7])
    rate = round(imu.rate_hz)
    samples = round(duration_s * rate)
    times = np.arange(samples + 1) / rate
    motion = Motion(_course, duration_s + 1.0)
    track = measure(motion, imu, times, (times * _NS).astype(np.int64), seed)
    rows = np.arange(0, samples + 1, rate // _FRAMESET_HZ)
    truth = track.states.world_T_body[rows]
    seen = motion.at(times[rows] + offset_s).world_T_body if offset_s else truth
    motions = _motions(seen, rng)
    own, own_pair = _own_motions(seen, corrections, rng)
    drifting = _integrated(truth[0], motions, len(rows))
    record = SessionRecord(
        name=f"synthetic-{seed}",
        stamps_ns=track.stamps_ns[rows],
        epoch=np.zeros(len(rows), dtype=np.int64),
        online=drifting,
        smoothed=drifting,
        covariance=np.tile(np.diag(_MOTION_SIGMAS**2), (len(rows), 1, 1)),
        velocity_nav=track.states.velocity[rows] + _VELOCITY_SIGMA * rng.standard_normal((len(rows), 3)),
        gyro_bias=track.gyro_bias[rows] + _GYRO_BIAS_SIGMA * rng.standard_normal((len(rows), 3)),
        accel_bias=track.accel_bias[rows] + _ACCEL_BIAS_SIGMA * rng.standard_normal((len(rows), 3)),
        is_stationary=np.zeros(len(rows), dtype=bool),
        is_keyframe=np.arange(len(rows)) % _KEYFRAME_FRAMES == 0,
        with_imu=np.ones(len(rows), dtype=bool),
        is_start=np.arange(len(rows)) == 0,
        keyframe_before=np.full(len(rows), -1),
        keyframe_covariance=np.zeros((len(rows), 6, 6)),
        motions=motions,
        own=own,
        own_pair=own_pair,
        inertial=_inertial(track, rows),
        views=Views.of([], {}),
        first_windows=FirstWindows.of([], {}),
    )
    false = round(false_share * loops)
    closures = [_true_loop(record, truth, rng, session) for _ in range(loops - false)]
    closures += [_false_loop(record, rng, session) for _ in range(false)]
    return SyntheticSession(record, closures, false, Trajectory(record.stamps_ns, truth))


def closure_between(one: SyntheticSession, other: SyntheticSession, row: int, seed: int) -> LoopClosure:
    """Return a true closure between two sessions, 0 and 1, at the same row."""
    rng = np.random.default_rng([seed, row])
    motion = se3_inverse(one.truth.nav_T_body[row]) @ other.truth.nav_T_body[row]
    return _closure(one.record, row, other.record, row, motion, rng, (0, 1))


def _course(times_s: Float) -> Float:
    """Return ``[x, y, z, yaw, pitch, roll]`` (N, 6) along an ellipse, with the motion of steps."""
    phase = 2.0 * np.pi * times_s / _LAP_S
    step = 2.0 * np.pi * 1.9 * times_s
    heading = np.unwrap(np.arctan2(_HALF_WIDTH_M * np.cos(phase), -_HALF_LENGTH_M * np.sin(phase)))
    return np.column_stack(
        [
            _HALF_LENGTH_M * np.cos(phase),
            _HALF_WIDTH_M * np.sin(phase),
            1.5 + 0.02 * np.sin(step),
            heading + 0.05 * np.sin(0.5 * step),
            0.01 * np.sin(step),
            0.02 * np.sin(0.5 * step),
        ]
    )


def _motions(truth: Float, rng: np.random.Generator) -> Motions:
    """Sample each frameset's motion from the keyframe before it."""
    count = len(truth)
    row = np.arange(1, count)
    reference = (row - 1) // _KEYFRAME_FRAMES * _KEYFRAME_FRAMES
    covariance = np.diag(_MOTION_SIGMAS**2)
    shared = np.sqrt(_SHARED) * _MOTION_SIGMAS * rng.standard_normal((count // _KEYFRAME_FRAMES + 1, 6))
    own = np.sqrt(1.0 - _SHARED) * _MOTION_SIGMAS * rng.standard_normal((count - 1, 6))
    poses = np.array(
        [
            se3_inverse(truth[i]) @ truth[j] @ se3_exp(shared[i // _KEYFRAME_FRAMES] + error)
            for i, j, error in zip(reference.tolist(), row.tolist(), own, strict=True)
        ]
    )
    return Motions(
        reference,
        row,
        poses,
        np.tile(covariance, (count - 1, 1, 1)),
        np.tile(_SHARED * covariance, (count - 1, 1, 1)),
        np.full(count - 1, 200),
        np.zeros(count - 1, dtype=bool),
    )


def _own_motions(truth: Float, corrections: Sequence[Float], rng: np.random.Generator) -> tuple[Motions, Int]:
    """Sample each pair's motion over each keyframe; returns the motions and their pairs."""
    ends = np.arange(_KEYFRAME_FRAMES, len(truth), _KEYFRAME_FRAMES)
    row = np.repeat(ends, len(corrections))
    pair = np.tile(np.arange(len(corrections)), len(ends))
    sigmas = np.sqrt(len(corrections)) * _MOTION_SIGMAS
    poses = [
        se3_inverse(corrections[j]) @ se3_inverse(truth[k - _KEYFRAME_FRAMES]) @ truth[k] @ corrections[j]
        @ se3_exp(sigmas * rng.standard_normal(6))
        for k, j in zip(row.tolist(), pair.tolist(), strict=True)
    ]  # fmt: skip
    covariance = np.tile(np.diag(sigmas**2), (len(row), 1, 1))
    motions = Motions(
        row - _KEYFRAME_FRAMES,
        row,
        np.array(poses).reshape(-1, 4, 4),
        covariance.reshape(-1, 6, 6),
        np.zeros((len(row), 6, 6)),
        np.full(len(row), 100),
        np.zeros(len(row), dtype=bool),
    )
    return motions, pair


def _integrated(first: Float, motions: Motions, count: int) -> Float:
    poses = np.empty((count, 4, 4))
    poses[0] = first
    for i, j, motion in zip(motions.reference.tolist(), motions.row.tolist(), motions.reference_T_current, strict=True):
        poses[j] = poses[i] @ motion
    return poses


def _inertial(track: ImuTrack, rows: Int) -> Inertial:
    """Return steps from sample to sample, with the mean of both ends."""
    values = np.hstack([track.angular_velocity, track.linear_acceleration])
    means = 0.5 * (values[:-1] + values[1:])
    begins = np.concatenate([[0], rows]).astype(np.int64)
    covers = np.ones(len(rows), dtype=bool)
    return Inertial(begins, covers, np.diff(track.stamps_ns) * 1e-9, means)


def _true_loop(record: SessionRecord, truth: Float, rng: np.random.Generator, session: int) -> LoopClosure:
    lap = round(_LAP_S * _FRAMESET_HZ)
    keyframes = np.flatnonzero(record.is_keyframe)
    first = int(rng.choice(keyframes[keyframes < len(truth) - lap]))
    laps = int(rng.integers(1, (len(truth) - 1 - first) // lap + 1))
    second = first + laps * lap
    motion = se3_inverse(truth[first]) @ truth[second]
    return _closure(record, first, record, second, motion, rng, (session, session))


def _false_loop(record: SessionRecord, rng: np.random.Generator, session: int) -> LoopClosure:
    keyframes = np.flatnonzero(record.is_keyframe)
    first, second = np.sort(rng.choice(keyframes, 2, replace=False)).tolist()
    wrong = se3_exp(_FALSE_SIGMAS * rng.standard_normal(6))
    return _closure(record, first, record, second, wrong, rng, (session, session))


def _closure(
    one: SessionRecord, first: int, other: SessionRecord, second: int, motion: Float, rng: np.random.Generator,
    sessions: tuple[int, int],
) -> LoopClosure:  # fmt: skip
    return LoopClosure(
        Place(sessions[0], first, int(one.stamps_ns[first])),
        Place(sessions[1], second, int(other.stamps_ns[second])),
        motion @ se3_exp(_LOOP_SIGMAS * rng.standard_normal(6)),
        np.diag(_LOOP_SIGMAS**2),
        100,
        ((0, 0),),
        True,
    )
