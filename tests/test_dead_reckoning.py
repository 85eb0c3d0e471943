"""Pairs that contradict each other: the IMU alone, over some tenths of a second, shows which ones are right."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from monte_carlo import band
from synthetic import filled_buffer, measured_motion, pose_at, velocity_at

from graphvio.backend.dead_reckoning import DeadReckoning
from graphvio.backend.smoother import Smoother
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.backend.states import InitialUncertainty, RigState, certain_origin
from graphvio.backend.window import WindowError
from graphvio.config import Config
from graphvio.config.stages import SmootherConfig
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Imu
from graphvio.simulation.default_rig import default_rig

IMU, PERIOD_NS = Imu(), 50_000_000
AGREED_S = 2.0  # time until which the pairs agree
SIGMAS = 2e-4, 4e-4  # of motions by vision: rad, m


class Walk:
    """The synthetic walk with two pairs, which agree at first; later, each has an error of its own.

    Args:
        seed: Seed of all noise.
        scales: Lengths of the motions that the two pairs measure, as a share of the true ones.
        per_reference: Number of framesets whose motions have the same reference.
        sigmas: Noise of motions by vision, rad and m.
    """

    def __init__(
        self,
        seed: int,
        scales: tuple[float, float] = (1.0, 1.0),
        per_reference: int = 1,
        sigmas: tuple[float, float] = SIGMAS,
    ) -> None:
        self._sigmas = sigmas
        self._rng, self._scales, self._per_reference = np.random.default_rng(seed), scales, per_reference
        biases = 0.003 * self._rng.standard_normal(3), 0.05 * self._rng.standard_normal(3)
        self._samples = filled_buffer(IMU, 5.0, self._rng, *biases)
        self.smoother = Smoother(SmootherConfig(imu_noise_scale=1.0), IMU)
        state = RigState(pose_at(0.0), velocity_at(0.0), np.zeros(3), np.zeros(3))
        uncertainty = InitialUncertainty(certain_origin(), 0.1, 0.003, gravity=1e-4 * np.eye(3))
        self.smoother.initialise(0, state, uncertainty)
        self.dead_reckoning = DeadReckoning()
        self._reference_ns = self._framesets = 0

    def until(
        self, end_s: float, *, contradicts: bool = False, has_imu: bool = True, is_trusted: bool = True
    ) -> Iterator[tuple[int, ...]]:
        """Yield the pairs to follow at each frameset until a time."""
        while self.smoother.latest_ns < round(end_s * 1e9):
            self.predict(has_imu=has_imu)
            visual = replace(self._visual(contradicts), is_calibration_trusted=is_trusted)
            yield self.dead_reckoning.pairs_to_follow(visual, self.smoother)
            assert visual.motion is not None
            self.smoother.add_motion(visual.motion)
            self.smoother.update(frozenset([self._reference_ns]))
            self._framesets += 1
            if self._framesets % self._per_reference == 0:
                self._reference_ns = self.smoother.latest_ns

    def predict(self, *, has_imu: bool = True) -> None:
        """Predict the next frameset."""
        stamp_ns = self.smoother.latest_ns + PERIOD_NS
        interval = self._samples.interval(self.smoother.latest_ns, stamp_ns)
        self.smoother.extend(stamp_ns, interval)
        self.dead_reckoning.predict(stamp_ns, interval if has_imu else None)

    def _visual(self, contradicts: bool) -> VisualResult:
        motions = [self._measured(scale if contradicts else 1.0, (j,)) for j, scale in enumerate(self._scales)]
        if not contradicts:
            return VisualResult(motions[0], Quality.GOOD, "", {})
        apart = motions[0].reference_T_current[:3, 3] - motions[1].reference_T_current[:3, 3]
        covering = motions[0].covariance + float(apart @ apart) * np.eye(6)
        first = motions[0]
        motion = RelativeMotion(
            first.reference_stamp_ns, first.stamp_ns, first.reference_T_current, covering, np.zeros((6, 6)), 100
        )
        return VisualResult(motion, Quality.WEAK, "two motions", {}, alternatives=tuple(motions))

    def _measured(self, scale: float, pairs: tuple[int, ...]) -> RelativeMotion:
        motion = measured_motion(self._reference_ns, self.smoother.latest_ns, self._rng, *self._sigmas)
        measured = motion.reference_T_current.copy()
        measured[:3, 3] *= scale
        return RelativeMotion(
            motion.reference_stamp_ns, motion.stamp_ns, measured, motion.covariance, np.zeros((6, 6)), 100, pairs=pairs
        )


def followed(walk: Walk, duration_s: float = 1.0) -> list[tuple[int, ...]]:
    """Return the pairs to follow at each frameset of a contradiction, after the pairs have agreed."""
    assert set(walk.until(AGREED_S)) == {()}
    return list(walk.until(AGREED_S + duration_s, contradicts=True))


@pytest.mark.parametrize("per_reference", [1, 7])
@pytest.mark.parametrize("right", [0, 1])
@pytest.mark.parametrize("seed", range(3))
def test_pairs_that_agree_with_the_imu_are_followed(seed: int, right: int, per_reference: int) -> None:
    scales = (1.0, 1.1) if right == 0 else (1.1, 1.0)
    found = followed(Walk(seed, scales, per_reference))
    assert set(found) <= {(), (right,)}
    assert found[-1] == (right,)


@pytest.mark.parametrize("scales", [(1.0, 1.004), (1.2, 0.8)])
def test_no_pairs_are_followed_if_all_agree_with_the_imu_or_none_does(scales: tuple[float, float]) -> None:
    for seed in range(4):
        assert set(followed(Walk(seed, scales, 7), 2.0)) == {()}


def test_pairs_that_the_imu_contradicts_later_are_no_longer_followed() -> None:
    walk = Walk(0, (1.0, 1.1))
    assert followed(walk)[-1] == (0,)
    walk._scales = (1.2, 0.8)
    assert list(walk.until(AGREED_S + 3.0, contradicts=True))[-1] == ()


@pytest.mark.parametrize(("agreed_s", "goes_on"), [(0.4, True), (0.6, False)])
def test_contradiction_ends_after_half_a_second_of_agreement(agreed_s: float, goes_on: bool) -> None:
    """Afterwards it takes some framesets again until the IMU shows who is right."""
    walk, now_s = Walk(0, (1.0, 1.035)), AGREED_S + 1.0
    assert followed(walk)[-1] == (0,)
    assert set(walk.until(now_s + agreed_s)) == {()}
    (found,) = walk.until(now_s + agreed_s + 0.05, contradicts=True)
    assert found == ((0,) if goes_on else ())


@pytest.mark.parametrize("seed", range(3))
def test_comparison_that_begins_during_a_contradiction_finds_the_pairs(seed: int) -> None:
    """Motions are from an older keyframe then, until which the pairs had contradicted each other."""
    walk = Walk(seed, (1.0, 1.1), 7)
    assert set(walk.until(AGREED_S)) == {()}
    assert set(walk.until(AGREED_S + 0.5, contradicts=True, is_trusted=False)) == {()}
    assert (1,) not in (found := list(walk.until(AGREED_S + 2.5, contradicts=True)))
    assert found[-1] == (0,)


def test_contradiction_after_a_gap_is_another_one() -> None:
    walk = Walk(0, (1.0, 1.1))
    assert followed(walk)[-1] == (0,)
    for _ in range(12):  # framesets without a motion
        walk.predict()
        walk.smoother.update(frozenset())
    walk._reference_ns, walk._scales = walk.smoother.latest_ns, (1.01, 1.0)
    (found,) = walk.until(AGREED_S + 1.65, contradicts=True)
    assert found == ()


def test_prediction_by_the_imu_ends_after_a_while() -> None:
    walk = Walk(0, (1.0, 1.1))
    assert followed(walk)[-1] == (0,)
    assert walk.dead_reckoning._comparison is not None
    for _ in range(30):
        walk.predict()
    assert walk.dead_reckoning._comparison is None


def test_state_is_not_at_fault_if_the_comparison_has_no_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise WindowError("no solution")

    walk = Walk(0, (1.0, 1.1))
    assert set(walk.until(AGREED_S)) == {()}
    with monkeypatch.context() as patched:
        patched.setattr(Smoother, "from_state", fail)
        assert set(walk.until(AGREED_S + 0.5, contradicts=True)) == {()}


def test_comparison_goes_on_while_the_pairs_agree_for_a_moment() -> None:
    """Each motion begins at the frameset before, so that one that is left out would break the chain."""
    walk = Walk(0, (1.0, 1.02))
    assert set(walk.until(AGREED_S)) == {()}
    for k in range(9):
        list(walk.until(AGREED_S + 0.05 * (k + 1), contradicts=k % 2 == 0))
    comparison = walk.dead_reckoning._comparison
    assert comparison is not None
    assert all(walk.smoother.latest_ns in chain for chain in comparison.chains.values())


def test_pairs_are_found_although_the_contradiction_was_small_for_long() -> None:
    """The IMU alone is too inaccurate after some seconds, so that the comparison begins again from time to time."""
    walk = Walk(0, (1.0, 1.004))
    assert set(followed(walk, 1.75)) == {()}
    walk._scales = (1.0, 1.08)
    assert list(walk.until(AGREED_S + 2.75, contradicts=True))[-1] == (0,)


def test_gap_of_the_imu_ends_the_comparison() -> None:
    walk = Walk(0, (1.0, 1.1))
    assert set(walk.until(AGREED_S)) == {()}
    assert set(walk.until(AGREED_S + 1.5, contradicts=True, has_imu=False)) == {()}


def test_nothing_is_decided_while_the_calibration_is_not_trusted() -> None:
    walk = Walk(0, (1.0, 1.1))
    assert set(walk.until(AGREED_S)) == {()}
    assert set(walk.until(AGREED_S + 1.0, contradicts=True, is_trusted=False)) == {()}


def test_pairs_are_still_followed_when_the_calibration_is_no_longer_trusted() -> None:
    """As after a knock, which the contradiction itself has shown."""
    walk = Walk(0, (1.0, 1.1))
    assert followed(walk)[-1] == (0,)
    assert set(walk.until(AGREED_S + 2.0, contradicts=True, is_trusted=False)) == {(0,)}


def moved_m(*, is_trusted: bool) -> float:
    """Return how far a rig that stands still seems to move in 3 s, while the first pair sees something pass slowly."""
    rig, rng = default_rig(), np.random.default_rng(1)
    synchroniser = Synchroniser(rig, Config(), lambda *_: None)
    for stamp_ns in range(9_000_000_000, 16_000_000_000, 5_000_000):
        noise = np.array([1e-3, 0.02])[:, None] * rng.standard_normal((2, 3))
        synchroniser.add_sample(ImuSample(stamp_ns, noise[0], noise[1] + np.array([0.0, 0.0, 9.80665])))
    estimator, now_ns = SmootherEstimator(rig, Config(), lambda *_: None), 10_000_000_000
    estimator.initialise(now_ns, synchroniser.initial_interval(now_ns))
    estimator.update(now_ns, True, frozenset())
    passing = np.eye(4)
    passing[0, 3] = 0.003  # m in a frameset
    for k in range(100):
        before_ns, now_ns = now_ns, now_ns + PERIOD_NS
        estimator.predict(now_ns, synchroniser.interval(before_ns, now_ns))
        covariance = np.diag(np.repeat(SIGMAS, 3) ** 2)
        still = RelativeMotion(before_ns, now_ns, np.eye(4), covariance, np.zeros((6, 6)), 100, pairs=(1,))
        visual = VisualResult(still, Quality.GOOD, "", {}, is_calibration_trusted=is_trusted)
        if k >= 40:
            moving = replace(still, reference_T_current=passing, pairs=(0,))
            covering = replace(moving, covariance=covariance + passing[0, 3] ** 2 * np.eye(6), pairs=())
            visual = replace(visual, motion=covering, quality=Quality.WEAK, alternatives=(moving, still))
        estimator.apply(visual, is_stationary=False)
        estimator.update(now_ns, True, frozenset([now_ns]))
    return float(np.linalg.norm(estimator.state().nav_T_body[:3, 3]))


def test_state_follows_the_pairs_that_the_imu_agrees_with() -> None:
    assert moved_m(is_trusted=True) < 0.005
    assert moved_m(is_trusted=False) > 0.01


@pytest.mark.parametrize("sigmas", [SIGMAS, (5e-3, 2e-3)])
def test_prediction_from_a_state_is_as_uncertain_as_that_of_the_whole_window(sigmas: tuple[float, float]) -> None:
    """Attitude, velocity and gravity have common errors in nav, which do not matter for the motion since then."""
    walk = Walk(0, sigmas=sigmas)
    list(walk.until(AGREED_S))
    whole, since_ns = walk.smoother, walk.smoother.latest_ns
    alone = whole.from_state(since_ns)
    for _ in range(10):
        walk.predict()
        alone.extend(whole.latest_ns, walk._samples.interval(alone.latest_ns, whole.latest_ns))
    np.testing.assert_allclose(
        np.linalg.inv(alone.pose(since_ns)) @ alone.pose(alone.latest_ns),
        np.linalg.inv(whole.pose(since_ns)) @ whole.pose(whole.latest_ns),
        atol=1e-9,
    )
    expected = whole.covariance_since(since_ns)
    scale = np.sqrt(np.diag(expected))
    difference = (alone.covariance_since(since_ns) - expected) / np.outer(scale, scale)
    np.testing.assert_allclose(difference, 0.0, atol=0.05)


def test_prediction_from_a_state_is_consistent() -> None:
    """Its error over half a second, by the IMU alone, is as large as the covariance of the state says."""
    statistics = []
    for seed in range(40):
        walk = Walk(seed)
        list(walk.until(AGREED_S))
        since_ns = walk.smoother.latest_ns
        alone = walk.smoother.from_state(since_ns)
        for _ in range(10):
            stamp_ns = alone.latest_ns + PERIOD_NS
            alone.extend(stamp_ns, walk._samples.interval(alone.latest_ns, stamp_ns))
        true = np.linalg.inv(pose_at(since_ns * 1e-9)) @ pose_at(alone.latest_ns * 1e-9)
        zero = np.zeros((6, 6))
        statistics.append(alone.gate(RelativeMotion(since_ns, alone.latest_ns, true, zero, zero, 0)).statistic)
    low, high = band(40)
    assert low < np.mean(statistics) < high
