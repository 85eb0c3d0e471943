"""Initialisation in motion: attitude, velocity and biases come from the first motions by vision and the IMU."""

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import pytest

from graphvio.arrays import Float
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.backend.states import InitialUncertainty, level_R_nav, origin_covariance
from graphvio.config import Config
from graphvio.geometry import se3, se3_exp, se3_inverse, se3_log, so3_exp, so3_log
from graphvio.measurements.estimate import Status
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import GRAVITY_M_S2, ImuSample
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Imu
from graphvio.simulation.default_rig import default_rig

STEP_S = 0.05
UP = np.array([0.0, 0.0, GRAVITY_M_S2])
SIGMAS = np.repeat([1e-3, 2e-3], 3)
BASE_NS = 10_000_000_000


class Swing:
    """A rig that swings in all directions about a steady course, tilted by some ten degrees."""

    def __init__(self, rng: np.random.Generator, accel_m_s2: float, hertz: float, turn_rad: float = 0.5) -> None:
        self._rng, self._turn_rad = rng, turn_rad
        self._w = 2.0 * np.pi * hertz * rng.uniform(0.7, 1.3, 3)
        self._amplitude = accel_m_s2 / (2.0 * np.pi * hertz) ** 2 * rng.uniform(0.5, 1.0, 3)
        self._phase, self._turn_phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
        self._course, self._tilt = rng.standard_normal(3), 0.3 * rng.standard_normal(3)
        self.gyro_bias, self.accel_bias = 0.01 * rng.standard_normal(3), 0.1 * rng.standard_normal(3)

    def pose(self, t: float) -> Float:
        rotation = so3_exp(self._turn_rad * np.sin(1.5 * t + self._turn_phase) + self._tilt)
        return np.asarray(se3(rotation, self._amplitude * np.sin(self._w * t + self._phase) + self._course * t))

    def velocity(self, t: float) -> Float:
        return np.asarray(self._amplitude * self._w * np.cos(self._w * t + self._phase) + self._course)

    def sample(self, t: float, imu: Imu) -> ImuSample:
        rotation, h = self.pose(t)[:3, :3], 1e-4
        accel = -self._amplitude * self._w**2 * np.sin(self._w * t + self._phase)
        rate = so3_log(np.ascontiguousarray(self.pose(t - h)[:3, :3].T @ self.pose(t + h)[:3, :3])) / (2.0 * h)
        noise = np.sqrt(imu.rate_hz) * self._rng.standard_normal((2, 3))
        return ImuSample(
            BASE_NS + round(t * 1e9),
            rate + self.gyro_bias + imu.gyro_noise_density * noise[0],
            rotation.T @ (accel + UP) + self.accel_bias + imu.accel_noise_density * noise[1],
        )


@dataclass
class Outcome:
    """Of a run of four seconds: a number for each frameset.

    Attributes:
        tilt_deg, speed_m_s: errors of roll and pitch, and of velocity in body.
        tilt_sigma_deg, speed_sigma_m_s: as reported.
        step_m: how far the step to the frameset is from the true one, in the frame of the rig before it.
        tilt_square: squared Mahalanobis distance of the error of roll and pitch.
        turned_deg, moved_m: errors of the motion from the first pose, as it was emitted, to the newest one.
    """

    tilt_deg: list[float] = field(default_factory=list)
    tilt_sigma_deg: list[float] = field(default_factory=list)
    speed_m_s: list[float] = field(default_factory=list)
    speed_sigma_m_s: list[float] = field(default_factory=list)
    step_m: list[float] = field(default_factory=list)
    tilt_square: list[float] = field(default_factory=list)
    turned_deg: list[float] = field(default_factory=list)
    moved_m: list[float] = field(default_factory=list)
    status: list[Status] = field(default_factory=list)
    events: list[tuple[float, str, str]] = field(default_factory=list)

    @property
    def initialised_s(self) -> float:
        """From when on all is known."""
        return STEP_S * self.status.index(Status.TRACKING)


def run(
    seed: int,
    accel_m_s2: float,
    hertz: float,
    sigmas: Float | None = SIGMAS,
    duration_s: float = 4.0,
    bias_error: Float | None = None,
    with_imu: bool = True,
    turn_rad: float = 0.5,
    quality: Quality = Quality.GOOD,
) -> Outcome:
    """Vision has these errors, one sigma, or sees nothing; the gyro's bias may be thought to be known, and be wrong."""
    rng, rig, config = np.random.default_rng(seed), default_rig(), Config()
    imu = rig.imu
    assert imu is not None
    if not with_imu:
        rig = rig.without_imu()
    swing, out = Swing(rng, accel_m_s2, hertz, turn_rad), Outcome()
    synchroniser = Synchroniser(rig, config, lambda *_: None)
    for k in range(-round(imu.rate_hz), round((duration_s + 0.1) * imu.rate_hz)):
        sample = swing.sample(k / imu.rate_hz, imu)
        if with_imu:
            synchroniser.add_sample(sample)
    estimator = SmootherEstimator(
        rig,
        config,
        lambda ns, kind, detail: out.events.append(((ns - BASE_NS) * 1e-9, kind, detail)),
    )
    before_ns, before, true_before = BASE_NS, np.eye(4), swing.pose(0.0)
    for n in range(round(duration_s / STEP_S)):
        t = n * STEP_S
        stamp_ns, true = BASE_NS + round(t * 1e9), swing.pose(t)
        used = n == 0
        if n == 0:
            estimator.initialise(stamp_ns, synchroniser.initial_interval(stamp_ns) if with_imu else None)
            first, true_first = estimator.state().nav_T_body, true
            if bias_error is not None:
                state = replace(estimator.state(), gyro_bias=swing.gyro_bias + bias_error)
                known = InitialUncertainty(origin_covariance(state.nav_T_body[:3, :3], 0.25), 0.3, 0.001)
                estimator._running.initialise(stamp_ns, state, known)
        else:
            estimator.predict(stamp_ns, synchroniser.interval(before_ns, stamp_ns) if with_imu else None)
            if sigmas is not None:
                measured = np.linalg.inv(true_before) @ true @ se3_exp(sigmas * rng.standard_normal(6))
                motion = RelativeMotion(before_ns, stamp_ns, measured, np.diag(sigmas**2), np.zeros((6, 6)), 200)
                used = estimator.apply(VisualResult(motion, quality, "", {}), is_stationary=False).motion is not None
        out.status.append(estimator.update(stamp_ns, used, frozenset()).status)
        state, covariance = estimator.state(), estimator.covariance
        rotation = state.nav_T_body[:3, :3]
        moved, true_moved = se3_inverse(first) @ state.nav_T_body, se3_inverse(true_first) @ true
        out.turned_deg.append(float(np.rad2deg(np.linalg.norm(se3_log(se3_inverse(moved) @ true_moved)[:3]))))
        out.moved_m.append(float(np.linalg.norm(moved[:3, 3] - true_moved[:3, 3])))
        if not with_imu:
            before_ns, before, true_before = stamp_ns, state.nav_T_body, true
            continue
        up = -rotation.T @ state.gravity_nav / np.linalg.norm(state.gravity_nav)
        out.tilt_deg.append(float(np.rad2deg(np.arccos(min(float(up @ true[2, :3]), 1.0)))))
        assert covariance.tilt is not None
        tilt = (level_R_nav(state.gravity_nav) @ rotation @ true[2, :3])[[1, 0]] * [1.0, -1.0]
        out.tilt_square.append(float(tilt @ np.linalg.solve(covariance.tilt, tilt)))
        out.tilt_sigma_deg.append(float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(covariance.tilt)[-1]))))
        error = rotation.T @ state.velocity_nav - true[:3, :3].T @ swing.velocity(t)
        assert covariance.velocity is not None
        out.speed_m_s.append(float(np.linalg.norm(error)))
        out.speed_sigma_m_s.append(float(np.sqrt(np.linalg.eigvalsh(covariance.velocity)[-1])))
        step, true_step = (np.linalg.inv(a) @ b for a, b in ((before, state.nav_T_body), (true_before, true)))
        out.step_m.append(float(np.linalg.norm(step[:3, 3] - true_step[:3, 3])))
        before_ns, before, true_before = stamp_ns, state.nav_T_body, true
    return out


@cache
def walked(seed: int, accel_m_s2: float, hertz: float) -> Outcome:
    """The outcome of a run with an IMU, of which several tests look at one thing each."""
    return run(seed, accel_m_s2, hertz)


@pytest.mark.parametrize(("accel_m_s2", "hertz"), [(1.0, 0.5), (5.0, 0.5), (5.0, 0.16), (15.0, 1.0)])
def test_it_is_known_within_two_seconds_and_rightly(accel_m_s2: float, hertz: float) -> None:
    """On foot, in a take-off or a braking of a second, and shaken; the mean force is up to 40 deg off the vertical."""
    outcomes = [walked(seed, accel_m_s2, hertz) for seed in range(6)]
    for out in outcomes:
        assert out.initialised_s <= 1.0  # asked for: 2 s
        k = round(out.initialised_s / STEP_S)
        assert max(out.tilt_deg[k:]) < 8.0
        assert np.all(np.array(out.tilt_deg[k:]) < 4.0 * np.array(out.tilt_sigma_deg[k:]))
        assert np.all(np.array(out.speed_m_s[k:]) < 4.5 * np.array(out.speed_sigma_m_s[k:]))
        assert out.step_m[k] < 0.05  # the switch is no jump: 3 deg of half a metre are 2.6 cm
        assert set(out.status[k:]) == {Status.TRACKING}
        assert not out.events
    assert np.median([out.tilt_deg[-1] for out in outcomes]) < 0.6
    if accel_m_s2 > 1.0:  # where it began far off
        assert max(out.tilt_deg[0] for out in outcomes) > 10.0


@pytest.mark.parametrize(("accel_m_s2", "hertz"), [(1.0, 0.5), (5.0, 0.5), (15.0, 1.0)])
def test_gravity_turns_and_the_poses_do_not(accel_m_s2: float, hertz: float) -> None:
    """What is level is learnt by many degrees, and the motion from the first pose is right all along."""
    outcomes = [walked(seed, accel_m_s2, hertz) for seed in range(6)]
    learnt = [out.tilt_deg[0] - out.tilt_deg[-1] for out in outcomes]
    assert max(learnt) > (1.0 if accel_m_s2 == 1.0 else 10.0)
    for out in outcomes:
        assert max(out.turned_deg[20:]) < 1.5  # as without an IMU: 80 motions of 1 mrad on each axis
        assert out.moved_m[-1] < 0.12


def test_level_is_known_as_well_as_it_is_said_to_be() -> None:
    """Biases of this IMU are half as large as is allowed for, and its noise a third: the mean may be below 2."""
    squares = np.array([walked(seed, accel, 0.5).tilt_square for accel in (1.0, 5.0) for seed in range(12)])
    for seconds in (1.0, 2.0, 3.9):
        mean = squares[:, round(seconds / STEP_S)].mean()
        assert 0.2 < mean < 2.7  # 95 % of such means are below 2.7


def test_imu_makes_poses_no_worse() -> None:
    """The same motions with and without the IMU, started in motion."""
    ratios = []
    for seed in range(8):
        one, other = (run(seed, 2.0, 0.5, with_imu=with_imu) for with_imu in (True, False))
        ratios.append(np.sqrt(np.mean(np.square(one.moved_m)) / np.mean(np.square(other.moved_m))))
    assert np.median(ratios) < 1.05


def test_without_motions_it_is_never_known() -> None:
    out = run(0, 1.0, 0.5, sigmas=None)
    assert Status.TRACKING not in out.status


def test_initialisation_that_lacks_something_is_reported_once() -> None:
    """Of points that are all far away, vision measures the rotation alone."""
    out = run(0, 1.0, 0.5, sigmas=np.repeat([1e-3, 5.0], 3))
    assert set(out.status) <= {Status.INITIALISING, Status.COASTING}
    ((reported_s, _, detail),) = [event for event in out.events if event[1] == "not_initialised"]
    assert reported_s == pytest.approx(2.05, abs=0.01)
    assert "velocity" in detail


@pytest.mark.parametrize(("quality", "refused"), [(Quality.GOOD, 0), (Quality.WEAK, 2)])
def test_steady_course_that_the_imu_takes_for_a_standstill_is_known_after_some_motions(
    quality: Quality, refused: int
) -> None:
    """A good motion is believed at once; weak ones may be wrong."""
    for seed in range(4):
        out = run(seed, 0.0, 0.5, duration_s=2.0, turn_rad=0.0, quality=quality)
        assert min(out.speed_m_s[: refused + 1]) > 0.5
        assert max(out.speed_m_s[refused + 1 :]) < 0.2
        assert [kind for _, kind, _ in out.events].count("gate_reset") == 1
        assert max(out.step_m[refused + 2 :]) < 0.01


def test_what_is_wrong_and_taken_for_known_is_given_up() -> None:
    """A bias of 10 deg/s too much, to a mrad/s: vision is refused, and would be in each epoch that takes it over."""
    for seed in range(4):
        out = run(seed, 1.0, 0.5, duration_s=8.0, bias_error=np.array([-0.1, 0.1, 0.1]))
        kinds = [kind for _, kind, _ in out.events]
        assert [kinds.count(kind) for kind in ("lost", "new_epoch")] == [1, 1]
        assert set(out.status[-40:]) == {Status.TRACKING}
        assert out.tilt_deg[-1] < 3.0
        assert out.speed_m_s[-1] < 0.1
