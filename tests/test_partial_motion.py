"""How the smoother uses what few points show while vision has failed."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from graphvio import Config
from graphvio.arrays import Float
from graphvio.backend.estimator import MeasurementUpdate
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.odometry.calibration_innovation_covariance import CalibrationInnovationCovariance
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.optimization.nodes import choose_nodes
from graphvio.optimization.record import Motions, SessionRecord
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
        self.used: RelativeMotion | None = None
        self._now_ns = BASE_NS - BLIND_STEPS * STEP_NS
        self.estimator.initialise(self._now_ns, self._synchroniser.initial_interval(self._now_ns))
        self.estimator.update(self._now_ns, True, frozenset())
        for _ in range(BLIND_STEPS):
            self.step(motion=np.eye(4))

    def step(self, motion: Float | None = None, partial: Float | None = None, is_covered: bool = True) -> None:
        """Go on by a frameset with a motion since the one before, or what few points show of it."""
        before_ns, self._now_ns = self._now_ns, self._now_ns + STEP_NS
        interval = self._synchroniser.interval(before_ns, self._now_ns) if is_covered else None
        self.estimator.predict(self._now_ns, interval)

        def since(reference_T_current: Float | None, covariance: Float) -> RelativeMotion | None:
            if reference_T_current is None:
                return None
            return RelativeMotion(before_ns, self._now_ns, reference_T_current, covariance, np.zeros((6, 6)), 5)

        good = since(motion, 1e-6 * np.eye(6))
        quality = Quality.FAILED if good is None else Quality.GOOD
        result = VisualResult(good, quality, "", {}, partial_motion=since(partial, ALONG_X))
        update = self.estimator.apply(result, is_stationary=False)
        assert (update.motion is None) == (motion is None)  # few points do not constrain the state
        self.used = update.partial_motion
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


def apply_partial(blind: Blind, reference_ns: int = BASE_NS) -> MeasurementUpdate:
    motion = RelativeMotion(reference_ns, BASE_NS, np.eye(4), ALONG_X, np.zeros((6, 6)), 5)
    return blind.estimator.apply(VisualResult(None, Quality.FAILED, "", {}, partial_motion=motion), is_stationary=False)


def test_partial_motion_from_a_state_that_has_left_asks_for_a_keyframe(blind: Blind) -> None:
    update = apply_partial(blind, BASE_NS - 10**12)
    assert update.partial_motion is None
    assert update.needs_keyframe


def test_partial_motion_is_not_used_while_the_imu_is_left_out(blind: Blind) -> None:
    blind.estimator.leave_imu_out()
    update = apply_partial(blind)
    assert update.partial_motion is None
    assert update.needs_keyframe


def test_partial_motion_is_not_used_after_a_step_without_samples(blind: Blind) -> None:
    blind.step(partial=np.eye(4))
    assert blind.used is not None
    blind.step(partial=np.eye(4), is_covered=False)
    assert blind.used is None


def test_calibration_errors_of_partial_motions_are_shared_by_those_of_one_reference() -> None:
    rig = default_rig()
    added = 1e-4 * np.eye(6)

    class Errors(CalibrationInnovationCovariance):
        def _motion_with_covariance(self, motion: RelativeMotion, *_: object) -> RelativeMotion:
            return replace(motion, calibration_covariance=added)

    errors = Errors(rig)
    motion = RelativeMotion(0, STEP_NS, np.eye(4), ALONG_X, 0.5 * ALONG_X, 5)
    noisier = errors._noisier(motion, Blind().estimator)
    assert noisier is not None
    assert noisier.calibration_covariance is None
    assert noisier.covariance == pytest.approx(ALONG_X + added)
    own = noisier.covariance - noisier.shared_covariance
    assert np.linalg.eigvalsh(own)[0] > 0.0
    assert np.all(np.diag(own) < 0.5 * np.diag(ALONG_X) + 0.2e-4)


def test_nodes_keep_the_last_motion_of_a_keyframe_beside_partial_ones() -> None:
    recorded = [(0, 4, False), (0, 7, False), (0, 8, True), (0, 11, True)]
    reference, row, is_partial = (np.array(column) for column in zip(*recorded, strict=True))
    count, frames = len(recorded), 12
    covariances = np.tile(np.eye(6), (count, 1, 1))
    motions = Motions(
        reference, row, np.tile(np.eye(4), (count, 1, 1)), covariances, 0.0 * covariances, np.full(count, 9), is_partial
    )
    no = np.zeros(frames, dtype=bool)
    record = SimpleNamespace(
        stamps_ns=STEP_NS * np.arange(frames), motions=motions, is_keyframe=np.arange(frames) == 0, is_stationary=no,
        epoch=np.zeros(frames, dtype=int), own=SimpleNamespace(reference=reference[:0], row=row[:0]),
        views=SimpleNamespace(row=row[:0]), first_windows=SimpleNamespace(row=row[:0]),
    )  # fmt: skip
    nodes = choose_nodes(cast(SessionRecord, record), 1.0)
    assert {0, 7, 11} <= set(nodes.rows.tolist())
    assert nodes.motions.tolist() == [1, 3]
