"""What the gate refuses without an IMU, and reinitialisation from vision where the IMU was corrected wrongly."""

from __future__ import annotations

import numpy as np
import pytest

from graphvio import Config
from graphvio.arrays import Float
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import EventKind
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.simulation.default_rig import default_rig

STEP_NS, SAMPLE_NS, BASE_NS = 50_000_000, 5_000_000, 10_000_000_000
WRONG_FROM, WRONG_UNTIL = 20, 25  # framesets, between which the gyro is wrong
SIGMAS = np.array([2e-4] * 3 + [1e-3] * 3)  # rad, m, of a motion


def walk(distrusted: bool) -> tuple[SmootherEstimator, list[Status], list[EventKind]]:
    """Stand still while vision measures just that, and the gyro turns for some framesets; then the IMU is corrected."""
    config, kinds = Config(), list[EventKind]()
    rng, rig = np.random.default_rng(1), default_rig()
    synchroniser = Synchroniser(rig, config, lambda *_: None)
    wrong_ns = range(BASE_NS + WRONG_FROM * STEP_NS, BASE_NS + WRONG_UNTIL * STEP_NS)
    for stamp_ns in range(BASE_NS - 200 * SAMPLE_NS, BASE_NS + 40 * STEP_NS, SAMPLE_NS):
        rate = np.array([0.0, 0.0, 0.3 if stamp_ns in wrong_ns else 0.0])
        synchroniser.add_sample(ImuSample(stamp_ns, rate, np.array([0.0, 0.0, 9.81])))
    estimator = SmootherEstimator(rig, config, lambda _ns, kind, _detail: kinds.append(EventKind(kind)))
    estimator.initialise(BASE_NS, synchroniser.initial_interval(BASE_NS))
    estimator.update(BASE_NS, True, frozenset())
    statuses, reference_ns = [], BASE_NS
    for n in range(1, 30):
        stamp_ns = BASE_NS + n * STEP_NS
        if n == WRONG_UNTIL and distrusted:
            estimator.distrust_prediction()
        estimator.predict(stamp_ns, synchroniser.interval(stamp_ns - STEP_NS, stamp_ns))
        measured = se3_exp(SIGMAS * rng.standard_normal(6))
        motion = RelativeMotion(reference_ns, stamp_ns, measured, np.diag(SIGMAS**2), np.zeros((6, 6)), 200)
        applied = estimator.apply(VisualResult(motion, Quality.GOOD, "", {}), is_stationary=False)
        statuses.append(estimator.update(stamp_ns, applied.motion is not None, frozenset([reference_ns])).status)
        if applied.needs_keyframe:
            reference_ns = stamp_ns
    return estimator, statuses, kinds


def turned_rad(pose: Float) -> float:
    return float(np.linalg.norm(se3_log(pose)[:3]))


def test_prediction_that_is_distrusted_gives_way_to_refused_motions() -> None:
    estimator, statuses, kinds = walk(distrusted=True)
    assert kinds.count(EventKind.VISION_GATED) >= 3
    assert kinds.count(EventKind.GATE_RESET) == 1
    assert Status.COASTING not in statuses[WRONG_UNTIL - 1 :]
    moved = estimator.state().nav_T_body
    assert turned_rad(moved) < np.deg2rad(0.2)
    assert np.linalg.norm(moved[:3, 3]) < 0.01


def test_prediction_that_is_not_distrusted_is_kept() -> None:
    estimator, statuses, kinds = walk(distrusted=False)
    assert EventKind.GATE_RESET not in kinds
    assert statuses[WRONG_UNTIL - 1] is Status.COASTING
    assert turned_rad(estimator.state().nav_T_body) == pytest.approx(0.3 * 0.25, rel=0.2)


def turn_by_vision(angles_rad: Float) -> tuple[Float, list[EventKind]]:
    """Turn about z as vision measures it, each motion from the frameset before, without an IMU.

    Returns:
        The motion (4, 4) from the first to the last state, and the events.
    """
    kinds, rig = list[EventKind](), default_rig().without_imu()
    estimator = SmootherEstimator(rig, Config(), lambda _ns, kind, _detail: kinds.append(EventKind(kind)))
    estimator.initialise(BASE_NS, None)
    estimator.update(BASE_NS, True, frozenset())
    first, reference_ns = estimator.state().nav_T_body, BASE_NS
    for n, angle_rad in enumerate(np.diff(angles_rad), start=1):
        stamp_ns = BASE_NS + n * STEP_NS
        estimator.predict(stamp_ns, None)
        measured = se3_exp(np.array([0.0, 0.0, angle_rad, 0.0, 0.0, 0.0]))
        motion = RelativeMotion(reference_ns, stamp_ns, measured, np.diag(SIGMAS**2), np.zeros((6, 6)), 200)
        estimator.apply(VisualResult(motion, Quality.GOOD, "", {}), is_stationary=False)
        estimator.update(stamp_ns, True, frozenset([stamp_ns]))
        reference_ns = stamp_ns
    return se3_inverse(first) @ estimator.state().nav_T_body, kinds


def test_gate_without_imu_accepts_fast_hand_held_turns() -> None:
    times_s = np.arange(60) * STEP_NS * 1e-9
    angles_rad = 0.4 * np.sin(2.0 * np.pi * 2.0 * times_s)  # up to 5 rad/s and 63 rad/s^2
    turned, kinds = turn_by_vision(angles_rad)
    assert kinds == []
    assert se3_log(turned)[2] == pytest.approx(angles_rad[-1], abs=5.0 * SIGMAS[0] * np.sqrt(len(times_s)))


def test_gate_without_imu_refuses_a_leap() -> None:
    _, kinds = turn_by_vision(np.array([0.0] * 20 + [0.7]))
    assert kinds == [EventKind.VISION_GATED]
