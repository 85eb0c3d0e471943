"""Motions of one camera between any two instants, and the choice of segments."""

from functools import cache

import numpy as np
import pytest
from hand_eye import LEFT2_T_LEFT1, PERIOD_NS
from monte_carlo import band
from synthetic import pose_at, random_covariance, transform

from graphvio.arrays import Float, Int
from graphvio.calibration.camera_motions import CameraMotions
from graphvio.calibration.consistency import information
from graphvio.calibration.segments import LENGTHS_S, all_segments, information_gains, most_informative, of_one_length
from graphvio.geometry import se3_adjoint, se3_inverse, se3_log
from graphvio.measurements.motion import RelativeMotion

BODY_T_LEFT = transform(np.array([0.3, -1.2, 0.5]), np.array([0.1, 0.2, -0.05]))
FRAMES, KEYFRAMES = 16, 4
SCALE = np.diag(np.repeat([1e-3, 2e-3], 3))
SHARED, OWN = (SCALE @ random_covariance(np.random.default_rng(n), 6, size) @ SCALE for n, size in ((1, 1.0), (2, 0.5)))
RUNS = 400


def truth(first: int, second: int) -> Float:
    """Motion (4, 4) of body."""
    return np.ascontiguousarray(np.linalg.inv(pose_at(0.2 * first)) @ pose_at(0.2 * second))


@cache
def measured(seed: int, skip: tuple[int, ...] = ()) -> CameraMotions:
    """A walk of which each instant is measured from the keyframe before it."""
    rng = np.random.default_rng(seed)
    own_root, shared_root = np.linalg.cholesky(OWN), np.linalg.cholesky(SHARED)
    motions = []
    for k in range(1, FRAMES):
        key = (k - 1) // KEYFRAMES * KEYFRAMES
        if k == key + 1:
            shared_error = shared_root @ rng.standard_normal(6)
        own_error = own_root @ rng.standard_normal(6)
        true = truth(key, k)
        seen = transform(shared_error[:3], shared_error[3:]) @ true @ transform(own_error[:3], own_error[3:])
        adjoint = se3_adjoint(se3_inverse(true))
        shared = adjoint @ SHARED @ adjoint.T
        if k not in skip:
            motions.append(RelativeMotion(key * PERIOD_NS, k * PERIOD_NS, seen, shared + OWN, shared, 100))
    return CameraMotions([k * PERIOD_NS for k in range(FRAMES)], motions, BODY_T_LEFT)


@pytest.mark.parametrize(("first", "second"), [(0, 3), (0, 4), (1, 3), (2, 7), (4, 9), (3, 15), (4, 8), (1, 4)])
def test_between_any_two_instants_is_consistent(first: int, second: int) -> None:
    left_T_body = se3_inverse(BODY_T_LEFT)
    true = left_T_body @ truth(first, second) @ BODY_T_LEFT
    squares = []
    for seed in range(RUNS):
        found = measured(seed).between(first * PERIOD_NS, second * PERIOD_NS)
        assert found is not None
        motion, covariance = found
        error = se3_log(np.ascontiguousarray(se3_inverse(motion) @ true))
        squares.append(error @ np.linalg.solve(covariance, error))
    low, high = band(RUNS)
    assert low - 0.3 < np.mean(squares) < high


def test_between_disconnected_instants_is_none() -> None:
    broken = measured(0, skip=(4,))  # the second keyframe has no reference
    assert broken.between(1 * PERIOD_NS, 3 * PERIOD_NS) is not None
    assert broken.between(5 * PERIOD_NS, 7 * PERIOD_NS) is not None
    assert broken.between(3 * PERIOD_NS, 5 * PERIOD_NS) is None


def steady(step_ns: int, gap_at: int | None = None) -> tuple[list[int], CameraMotions]:
    """Motions from instant to instant along a walk, one of which may be missing."""
    stamps = [k * step_ns for k in range(120)]
    motions = []
    for k in range(1, len(stamps)):
        true = np.linalg.inv(pose_at(stamps[k - 1] * 1e-9)) @ pose_at(stamps[k] * 1e-9)
        if k != gap_at:
            motions.append(RelativeMotion(stamps[k - 1], stamps[k], true, SCALE**2, np.zeros((6, 6)), 100))
    return stamps, CameraMotions(stamps, motions, BODY_T_LEFT)


@pytest.mark.parametrize("gap_at", [None, 50])
def test_most_informative_segments_are_disjoint_and_beat_any_length(gap_at: int | None) -> None:
    stamps, motions = steady(PERIOD_NS, gap_at)
    other = CameraMotions(stamps, [], BODY_T_LEFT)
    other._edge, other._reference = motions._edge, motions._reference
    segments = all_segments(stamps, [motions.between, other.between])
    first = segments.select(of_one_length(segments)).pairs
    covariance = np.asarray(np.linalg.inv(information(first, LEFT2_T_LEFT1)))
    rows = most_informative(segments, information_gains(segments.pairs, LEFT2_T_LEFT1, covariance))
    pairs = segments.select(rows).pairs
    assert np.all(pairs.start_ns[1:] >= pairs.end_ns[:-1])
    assert np.all(pairs.end_ns - pairs.start_ns <= LENGTHS_S[-1] * 1e9)
    if gap_at is not None:
        across = (pairs.start_ns < gap_at * PERIOD_NS) & (pairs.end_ns >= gap_at * PERIOD_NS)
        assert not across.any()

    def gained(chosen: Int) -> float:
        known = information(segments.select(chosen).pairs, LEFT2_T_LEFT1)
        return float(np.trace(covariance @ known))

    for length in (1, 2, 7, 20):
        of_length = [
            row
            for row in range(len(segments))
            if segments.last[row] - segments.first[row] == length and segments.first[row] % length == 0
        ]
        assert gained(rows) >= gained(np.array(of_length))
