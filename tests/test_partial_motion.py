"""How the smoother uses what few points show while vision has failed."""

import numpy as np
import pytest

from graphvio import Config
from graphvio.arrays import Float
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.simulation.default_rig import default_rig

STEP_NS, BASE_NS = 50_000_000, 10_000_000_000
BLIND_STEPS = 20
WRONG_M_S2 = 0.2  # error of the accelerometer, which the blind estimator takes for motion
ALONG_X = np.diag(np.array([0.02, 0.02, 0.02, 0.002, 0.2, 0.2]) ** 2)


class Blind:
    """An estimator that has stood still by good motions, and has none from `BASE_NS` on, though it stands."""

    def __init__(self) -> None:
        config, rig = Config(), default_rig()
        self._synchroniser = Synchroniser(rig, config, lambda *_: None)
        for stamp_ns in range(BASE_NS - 2_000_000_000, BASE_NS + 3_000_000_000, 5_000_000):
            wrong = WRONG_M_S2 if stamp_ns >= BASE_NS else 0.0
            self._synchroniser.add_sample(ImuSample(stamp_ns, np.zeros(3), np.array([wrong, 0.0, 9.80665])))
        self.estimator = SmootherEstimator(rig, config, lambda *_: None)
        self._now_ns = BASE_NS - BLIND_STEPS * STEP_NS
        self.estimator.initialise(self._now_ns, self._synchroniser.initial_interval(self._now_ns))
        self.estimator.update(self._now_ns, True, frozenset())
        for _ in range(BLIND_STEPS):
            self.step(motion=np.eye(4))

    def step(self, motion: Float | None = None, partial: Float | None = None) -> None:
        """Go on by a frameset with a motion since the one before, or what few points show of it."""
        before_ns, self._now_ns = self._now_ns, self._now_ns + STEP_NS
        self.estimator.predict(self._now_ns, self._synchroniser.interval(before_ns, self._now_ns))

        def since(reference_T_current: Float | None, covariance: Float) -> RelativeMotion | None:
            if reference_T_current is None:
                return None
            return RelativeMotion(before_ns, self._now_ns, reference_T_current, covariance, np.zeros((6, 6)), 5)

        good = since(motion, 1e-6 * np.eye(6))
        quality = Quality.FAILED if good is None else Quality.GOOD
        result = VisualResult(good, quality, "", {}, partial_motion=since(partial, ALONG_X))
        used = self.estimator.apply(result, is_stationary=False)
        assert (used.motion is None) == (motion is None)  # few points do not constrain the state
        self.estimator.update(self._now_ns, motion is not None, frozenset({self._now_ns}))

    @property
    def x_m(self) -> float:
        return float(self.estimator.state().nav_T_body[0, 3])


def shifted(x_m: float) -> Float:
    motion = np.eye(4)
    motion[0, 3] = x_m
    return motion


@pytest.fixture
def blind() -> Blind:
    return Blind()


def test_partial_motions_correct_the_prediction(blind: Blind) -> None:
    alone = Blind()
    for _ in range(BLIND_STEPS):
        blind.step(partial=np.eye(4))
        alone.step()
    assert alone.x_m > 0.08  # 0.1 m by the wrong acceleration
    assert abs(blind.x_m) < 0.02


def test_partial_motions_that_contradict_the_imu_are_left_out_until_vision_measures(blind: Blind) -> None:
    other = Blind()
    for step in range(10):
        blind.step(partial=shifted(0.05) if step == 0 else shifted(0.004))  # somebody passes, and goes on slowly
        other.step()
    assert blind.x_m == pytest.approx(other.x_m, abs=1e-9)
    for each in (blind, other):
        each.step(motion=np.eye(4))
    blind.step(partial=np.eye(4))
    other.step()
    assert abs(blind.x_m - other.x_m) > 1e-6


def test_partial_motion_from_a_state_that_has_left_is_ignored(blind: Blind) -> None:
    old = RelativeMotion(BASE_NS - 10**12, BASE_NS, np.eye(4), ALONG_X, np.zeros((6, 6)), 5)
    before = blind.x_m
    blind.estimator.apply(VisualResult(None, Quality.FAILED, "", {}, partial_motion=old), is_stationary=False)
    assert blind.x_m == before
