"""The covariance that errors of the calibration add to innovations: of the way since vision was last followed."""

from __future__ import annotations

import numpy as np
import pytest

from graphvio.arrays import Float
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.backend.states import RigState
from graphvio.config import Config
from graphvio.geometry import se3, se3_adjoint, se3_inverse, so3_exp
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.motion import PairReport, Quality, RelativeMotion, VisualResult
from graphvio.odometry.calibration_innovation_covariance import CalibrationInnovationCovariance
from graphvio.self_calibration.imu_model import PARAMETERS
from graphvio.self_calibration.innovation import InnovationErrors
from graphvio.self_calibration.parameters import PAIR, STEREO
from graphvio.simulation.default_rig import default_rig

STEP_NS, STEP = 50_000_000, se3(so3_exp(np.array([0.02, -0.03, 0.05])), np.array([0.04, 0.0, 0.01]))
RATE = np.array([0.4, -0.6, 1.0])
COVARIANCE = 1e-4 * np.eye(2 * PAIR + PARAMETERS)


class MovingEstimator(SmootherEstimator):
    """A smoother whose states are one step apart: what is tested needs their motions and gate results only."""

    def __init__(self) -> None:
        super().__init__(default_rig(), Config(), lambda *_: None)
        self.poses: dict[int, Float] = {}

    def move(self, is_accepted: bool) -> int:
        """Go one step on, whose vision passes or fails the test."""
        k = len(self.poses)
        self.poses[k * STEP_NS] = np.linalg.matrix_power(STEP, k)
        self.gate_results = {"vision": GateResult(is_accepted, 0.0, 1.0, np.zeros(6), np.eye(6))}
        return k * STEP_NS

    def state(self) -> RigState:
        return RigState(self.poses[max(self.poses)], np.array([0.5, 0.1 * len(self.poses), 0.0]), *np.zeros((2, 3)))

    def latest_rate(self) -> Float:
        return RATE

    def motion_since(self, then_ns: int) -> Float | None:
        then = self.poses.get(then_ns)
        return None if then is None else se3_inverse(self.poses[max(self.poses)]) @ then


def added_to_motion(
    innovation_covariance: CalibrationInnovationCovariance, estimator: MovingEstimator, reference_ns: int
) -> Float | None:
    """Return what is added to a motion from a reference to the newest state."""
    stamp_ns = max(estimator.poses)
    since = estimator.motion_since(reference_ns)
    measured = np.eye(4) if since is None else se3_inverse(since)
    motion = RelativeMotion(reference_ns, stamp_ns, measured, np.eye(6), np.zeros((6, 6)), 100)
    found = innovation_covariance.with_calibration_covariance(
        VisualResult(motion, Quality.GOOD, "", {}), estimator
    ).motion
    assert found is not None
    return found.calibration_covariance


@pytest.mark.parametrize("refused", [0, 3])
def test_calibration_covariance_is_for_the_way_since_vision_was_followed(refused: int) -> None:
    innovation_covariance, estimator = CalibrationInnovationCovariance(default_rig()), MovingEstimator()
    for k in range(10):
        stamp_ns = estimator.move(is_accepted=k < 10 - refused)
        innovation_covariance.add_frameset(stamp_ns, estimator, {0}, COVARIANCE)
    estimator.move(is_accepted=False)
    found, errors = added_to_motion(innovation_covariance, estimator, 0), InnovationErrors(COVARIANCE, default_rig())
    assert found is not None
    way = np.linalg.matrix_power(STEP, 1 + refused)
    without_time_offset = errors.covariance(way, None, None)
    assert np.linalg.eigvalsh(found - without_time_offset)[0] > -1e-15  # the velocity has changed
    np.testing.assert_allclose(found[:3, :3], without_time_offset[:3, :3], rtol=0.05)
    assert np.trace(found) < 0.5 * np.trace(errors.covariance(np.linalg.matrix_power(STEP, 10), None, None))


def test_calibration_covariance_from_a_newer_reference_is_for_the_way_from_there() -> None:
    innovation_covariance, estimator = CalibrationInnovationCovariance(default_rig()), MovingEstimator()
    for k in range(6):
        innovation_covariance.add_frameset(estimator.move(is_accepted=k < 2), estimator, {0, 4 * STEP_NS}, COVARIANCE)
    found = added_to_motion(innovation_covariance, estimator, 4 * STEP_NS)
    assert found is not None
    of_step = InnovationErrors(COVARIANCE, default_rig()).covariance(STEP, None, None)
    np.testing.assert_allclose(found[:3, :3], of_step[:3, :3], rtol=0.05)


def test_calibration_covariance_before_the_first_frameset_and_from_a_forgotten_state_is_none() -> None:
    innovation_covariance, estimator = CalibrationInnovationCovariance(default_rig()), MovingEstimator()
    estimator.move(is_accepted=True)
    assert added_to_motion(innovation_covariance, estimator, 0) is None
    innovation_covariance.add_frameset(0, estimator, {0}, COVARIANCE)
    assert added_to_motion(innovation_covariance, estimator, 7) is None


# ------------------------------------------------------------------ errors within pairs

BY_DEPTH = np.zeros((2, 2, 6))
BY_DEPTH[0, 0] = [0.001, -0.002, 0.0, 0.04, 0.01, 0.02]  # of one step
BY_DEPTH[1, 0] = [0.0, 0.002, 0.001, -0.03, 0.01, 0.01]


class Walk:
    """Steps, each of which is measured from the first frameset by one or both pairs."""

    def __init__(self) -> None:
        self.innovation_covariance, self.estimator = CalibrationInnovationCovariance(default_rig()), MovingEstimator()
        self.estimator.move(is_accepted=True)
        self.innovation_covariance.add_frameset(0, self.estimator, {0}, COVARIANCE)

    def step(self, pairs: frozenset[int], is_accepted: bool = True) -> Float:
        """Return what is added to the motion."""
        stamp_ns = self.estimator.move(is_accepted)
        since = self.estimator.motion_since(0)
        assert since is not None
        steps = stamp_ns // STEP_NS
        seen = np.array([[[j in pairs]] for j in range(2)])
        now_T_each = [np.linalg.matrix_power(se3_inverse(STEP), k) for k in range(steps)]
        of_steps = np.array([seen * BY_DEPTH @ se3_adjoint(back).T for back in now_T_each])  # the error is in each step
        motion = RelativeMotion(0, stamp_ns, se3_inverse(since), np.eye(6), np.zeros((6, 6)), 100, of_steps.sum(axis=0))
        report = PairReport(100, 100, np.zeros((0, 2)), np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64), {})
        visual = VisualResult(motion, Quality.GOOD, "", dict.fromkeys(pairs, report))
        found = self.innovation_covariance.with_calibration_covariance(visual, self.estimator).motion
        assert found is not None
        assert found.calibration_covariance is not None
        self.innovation_covariance.add_frameset(stamp_ns, self.estimator, {0}, COVARIANCE)
        return found.calibration_covariance


BOTH, FRONT, BACK = frozenset({0, 1}), frozenset({0}), frozenset({1})


def test_calibration_covariance_for_wrong_depths_is_for_the_way_since_vision_was_followed() -> None:
    walk, errors = Walk(), InnovationErrors(COVARIANCE, default_rig())
    found = [walk.step(BOTH, is_accepted) for is_accepted in (True, True, True, False, False, True)]
    of_step = np.trace(errors.of_depths(BY_DEPTH))
    added = [np.trace(each) for each in found]
    assert of_step > 0.5 * added[2]
    np.testing.assert_allclose(added[1:3], added[0], rtol=0.1)
    assert added[4] > 1.8 * added[2]  # nothing was followed for two steps


def test_calibration_covariance_for_other_pairs_is_for_the_whole_way() -> None:
    of_pairs = Walk()
    walk = Walk()
    for _ in range(8):
        walk.step(FRONT)
        of_pairs.step(FRONT)
    alone = of_pairs.step(FRONT)
    assert np.trace(walk.step(BACK)) > 10.0 * np.trace(alone)


def test_calibration_covariance_after_recalibration_is_for_the_whole_way() -> None:
    walk, change = Walk(), np.zeros(2 * PAIR)
    for _ in range(8):
        before = walk.step(BOTH)
    assert not walk.innovation_covariance.recalibrate(change)
    assert np.trace(walk.step(BOTH)) > 10.0 * np.trace(before)


def test_calibration_covariance_from_a_new_reference_has_the_error_of_the_velocity() -> None:
    """The motion itself is too short to be wrong, and the prediction continues what the motions before have shown."""
    walk, errors = Walk(), InnovationErrors(COVARIANCE, default_rig())
    for _ in range(8):
        walk.step(BOTH)
    walk.innovation_covariance.recalibrate(np.zeros(2 * PAIR))
    newest_ns, now_ns = max(walk.estimator.poses), walk.estimator.move(is_accepted=True)
    since = walk.estimator.motion_since(newest_ns)
    assert since is not None
    nothing = np.zeros_like(BY_DEPTH)
    motion = RelativeMotion(newest_ns, now_ns, se3_inverse(since), np.eye(6), np.zeros((6, 6)), 100, nothing)
    visual = VisualResult(motion, Quality.GOOD, "", {})
    found = walk.innovation_covariance.with_calibration_covariance(visual, walk.estimator).motion
    assert found is not None
    assert found.calibration_covariance is not None
    assert np.trace(found.calibration_covariance) > 0.9 * np.trace(errors.of_depths(BY_DEPTH))


def test_recalibration_by_more_than_the_noise_of_motions_is_a_jump() -> None:
    walk, change = Walk(), np.zeros(2 * PAIR)
    walk.step(BOTH)
    change[STEREO : STEREO + 3] = 1e-3
    assert not walk.innovation_covariance.recalibrate(change)  # the covariance of the motion is large
    change[STEREO : STEREO + 3] = 1e3
    assert walk.innovation_covariance.recalibrate(change)
