import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import UP, filled_buffer, pose_at, velocity_at

from graphvio.arrays import Float
from graphvio.backend.inertial import ImuBuffer
from graphvio.backend.preintegration import preintegrate, preintegration_params
from graphvio.measurements.events import EventKind
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.sensors import GRAVITY_M_S2, ImuSample
from graphvio.rig import Imu

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000  # of today's size: float64 cannot hold it
PARAMS = preintegration_params(Imu(), 1.0)
NO_BIAS = gtsam.imuBias.ConstantBias()


def sample(stamp_ns: int, rate: object = (0.1, 0.2, 0.3), force: object = (0.0, 0.0, GRAVITY_M_S2)) -> ImuSample:
    return ImuSample(stamp_ns, np.array(rate, dtype=np.float64), np.array(force, dtype=np.float64))


def linear(stamp_ns: int) -> tuple[Float, Float]:
    t = (stamp_ns - START_NS) * 1e-9
    return np.array([1.0, -2.0, 3.0]) * t + 0.5, np.array([10.0, 20.0, -30.0]) * t - 1.0


def linear_buffer(stamps: list[int]) -> ImuBuffer:
    buffer = ImuBuffer(50.0)
    for stamp in stamps:
        assert buffer.add(sample(START_NS + stamp, *linear(START_NS + stamp))) == ""
    return buffer


# ------------------------------------------------------------------ the buffer


def test_faulty_samples_are_named_and_left_out() -> None:
    buffer = ImuBuffer(50.0)
    assert not buffer.covers(0)
    assert buffer.add(sample(10 * MS)) == ""
    assert buffer.add(sample(20 * MS, rate=[np.nan, 0, 0])) == "imu_not_finite"
    assert buffer.add(sample(20 * MS, force=[0, np.inf, 0])) == "imu_not_finite"
    assert buffer.add(sample(10 * MS)) == "imu_duplicate_stamp"
    assert buffer.add(sample(9 * MS)) == "imu_backward_stamp"
    assert not buffer.covers(10 * MS + 1)
    assert buffer.add(sample(20 * MS)) == ""
    assert buffer.covers(20 * MS)
    assert not buffer.covers(20 * MS + 1)


@pytest.mark.parametrize(("step", "found"), [(0.0, slice(215, 400)), (0.02, slice(300, 400))], ids=["fine", "coarse"])
def test_stuck_axis_while_others_change_is_reported(step: float, found: slice) -> None:
    """Of readings that change with every sample at once; of coarse ones when the others have moved enough."""
    rng, buffer = np.random.default_rng(0), ImuBuffer(50.0)
    faults = []
    for i in range(600):
        t = 20e-3 * i
        rate, force = np.array([np.sin(t), 0.3 * np.cos(t), 0.1]), np.array([np.sin(2.0 * t), 0.2, 9.8])
        rate, force = rate + 0.01 * rng.standard_normal(3), force + 0.05 * rng.standard_normal(3)
        if step:
            rate, force = step * np.round(rate / step), step * np.round(force / step)
        if 200 <= i < 400:
            rate[1] = 0.25  # the end of its range
        faults.append(buffer.add(sample(5 * MS * i, rate, force)))
    assert set(faults[:201]) == {""}
    assert set(faults[found]) == {"imu_stuck"}
    assert set(faults[400:]) == {""}


@pytest.mark.parametrize("noise", [0.2, 0.25, 0.3, 0.4])
def test_one_coarse_axis_beside_fine_ones_is_not_stuck(noise: float) -> None:
    """Its readings change with every second to hundredth sample; noise is in units of its last digit."""
    rng, buffer, changes = np.random.default_rng(0), ImuBuffer(50.0), 0
    before = 0.0
    for i in range(8000):
        rate, force = 0.01 * rng.standard_normal(3), np.array([0.0, 0.0, 9.8]) + 0.05 * rng.standard_normal(3)
        rate[0] = 0.001 * np.round(noise * rng.standard_normal())
        changes += rate[0] != before
        before = rate[0]
        assert buffer.add(sample(5 * MS * i, rate, force)) == ""
    assert 80 < changes < 4000


def test_an_accelerometer_that_reads_zero_is_stuck() -> None:
    buffer = ImuBuffer(50.0)
    assert buffer.add(sample(0, force=(0.0, 0.0, 0.0))) == EventKind.IMU_STUCK
    assert buffer.add(sample(5_000_000, force=(0.0, 0.0, 1e-3))) == ""  # in free fall


def test_an_imu_that_repeats_itself_is_stuck() -> None:
    rng, buffer, faults = np.random.default_rng(0), ImuBuffer(50.0), []
    for i in range(400):
        if not 200 <= i < 300:
            values = rng.standard_normal(3)
        faults.append(buffer.add(sample(5 * MS * i, 0.01 * values, np.array([0.0, 0.0, 9.8]) + 0.05 * values)))
    assert set(faults[:200]) == {""}
    assert set(faults[206:300]) == {"imu_stuck"}
    assert set(faults[300:]) == {""}


def test_a_simulator_without_noise_is_not_stuck() -> None:
    """A rig on wheels, straight ahead, then in a bend: most axes have one value all the time."""
    buffer = ImuBuffer(50.0)
    for i in range(2000):
        bend = np.array([0.0, 0.0, 0.3 if 600 <= i < 900 else 0.0])
        speeding_up = np.array([0.1 * np.sin(0.01 * i), 0.0, 9.81])
        assert buffer.add(sample(5 * MS * i, bend, speeding_up)) == ""


def test_stuck_axes_coarse_readings_at_a_standstill_pass() -> None:
    """Also after a turn: an accelerometer that hardly sees it repeats its values from time to time."""
    rng, buffer = np.random.default_rng(0), ImuBuffer(50.0)
    for i in range(600):
        turning = 200 <= i < 300
        rate = np.round(0.3 * rng.standard_normal(3) + (500.0 if turning else 0.0)) * 1e-3
        force = np.array([0.0, 0.0, 9.8]) + 0.01 * (i % 20 if turning else 0)
        assert buffer.add(sample(5 * MS * i, rate, force)) == ""


@pytest.mark.parametrize(("start", "end"), [(0, 20), (3, 17), (10, 20), (11, 13), (0, 11), (19, 40)])
def test_a_interval_of_linear_signals_is_exact(start: int, end: int) -> None:
    buffer = linear_buffer([0, 10 * MS, 15 * MS, 20 * MS, 40 * MS])
    interval = buffer.interval(START_NS + start * MS, START_NS + end * MS)
    assert interval is not None
    assert interval.steps_s.sum() == pytest.approx((end - start) * 1e-3, abs=1e-12)
    assert interval.steps_s.min() > 0.0
    middle = START_NS + (start + end) * MS // 2
    np.testing.assert_allclose(interval.mean_rate, linear(middle)[0], atol=1e-9)
    mean_force = interval.steps_s @ interval.linear_acceleration / interval.steps_s.sum()
    np.testing.assert_allclose(mean_force, linear(middle)[1], atol=1e-8)
    middles = np.cumsum(interval.steps_s) - 0.5 * interval.steps_s + start * 1e-3
    expected = [linear(START_NS + round(t * 1e9))[0] for t in middles]
    np.testing.assert_allclose(interval.angular_velocity, expected, atol=1e-8)


def test_intervals_that_are_not_known() -> None:
    buffer = linear_buffer([0, 10 * MS, 20 * MS, 75 * MS, 80 * MS])
    assert buffer.interval(START_NS - 1, START_NS + 10 * MS) is None
    assert buffer.interval(START_NS + 75 * MS, START_NS + 80 * MS + 1) is None
    assert buffer.interval(START_NS + 10 * MS, START_NS + 10 * MS) is None
    assert buffer.interval(START_NS + 10 * MS, START_NS + 5 * MS) is None
    assert buffer.interval(START_NS + 15 * MS, START_NS + 78 * MS) is None  # a gap of 55 ms
    assert buffer.interval(START_NS + 30 * MS, START_NS + 40 * MS) is None
    assert buffer.interval(START_NS, START_NS + 20 * MS) is not None
    assert ImuBuffer(50.0).interval(0, 1) is None


def test_a_segment_ends_at_the_newest_sample_and_at_a_gap() -> None:
    buffer = linear_buffer([0, 10 * MS, 65 * MS, 70 * MS, 80 * MS, 90 * MS])
    found = buffer.segment(START_NS, START_NS + 85 * MS)
    assert found is not None
    interval, start_ns = found
    assert start_ns == START_NS + 65 * MS
    assert interval.steps_s.sum() == pytest.approx(15e-3)
    found = buffer.segment(START_NS + 70 * MS, START_NS + 10**9)
    assert found is not None
    assert found[1] == START_NS + 70 * MS
    assert found[0].steps_s.sum() == pytest.approx(20e-3)
    assert buffer.segment(START_NS + 81 * MS, START_NS + 95 * MS) is None  # one sample
    assert buffer.segment(START_NS - 10 * MS, START_NS - 1) is None
    assert ImuBuffer(50.0).segment(0, 10) is None


def test_samples_without_framesets_do_not_fill_the_memory() -> None:
    buffer = ImuBuffer(50.0)
    for k in range(100_000):
        assert buffer.add(sample(START_NS + 20 * MS * k)) == ""
    assert buffer.oldest_ns is not None
    assert buffer.newest_ns is not None
    assert buffer.newest_ns - buffer.oldest_ns < 180_000 * MS  # of 2000 s
    assert buffer.interval(buffer.newest_ns - 50_000 * MS, buffer.newest_ns) is not None


def test_discarding_keeps_what_a_later_interval_needs() -> None:
    buffer = linear_buffer([i * 10 * MS for i in range(10)])
    before = buffer.interval(START_NS + 35 * MS, START_NS + 60 * MS)
    buffer.discard_before(START_NS + 35 * MS)
    after = buffer.interval(START_NS + 35 * MS, START_NS + 60 * MS)
    assert before is not None
    assert after is not None
    assert np.array_equal(before.angular_velocity, after.angular_velocity)
    assert buffer.interval(START_NS + 25 * MS, START_NS + 60 * MS) is None


# ------------------------------------------------------------------ preintegration


def predicted(
    interval: ImuInterval, start: gtsam.NavState, bias: gtsam.imuBias.ConstantBias = NO_BIAS
) -> gtsam.NavState:
    return preintegrate(interval, PARAMS, bias).predict(start, bias)


def constant_interval(rate: Float, force: Float, duration_s: float, rate_hz: float = 200.0) -> ImuInterval:
    n = round(duration_s * rate_hz)
    return ImuInterval(np.full(n, 1.0 / rate_hz), np.tile(rate, (n, 1)), np.tile(force, (n, 1)))


def test_preintegration_at_a_standstill_stays() -> None:
    pose = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, -0.8, 1.2), np.array([1.0, 2.0, 3.0]))
    up_in_body = pose.rotation().matrix().T @ [0.0, 0.0, GRAVITY_M_S2]  # specific force points up
    end = predicted(constant_interval(np.zeros(3), up_in_body, 2.0), gtsam.NavState(pose, np.zeros(3)))
    np.testing.assert_allclose(end.pose().matrix(), pose.matrix(), atol=1e-9)
    np.testing.assert_allclose(end.velocity(), 0.0, atol=1e-9)


def test_free_fall_is_down() -> None:
    end = predicted(constant_interval(np.zeros(3), np.zeros(3), 1.0), gtsam.NavState())
    np.testing.assert_allclose(end.velocity(), [0.0, 0.0, -GRAVITY_M_S2], atol=1e-9)
    np.testing.assert_allclose(end.position(), [0.0, 0.0, -0.5 * GRAVITY_M_S2], atol=1e-9)


def test_bias_is_taken_away() -> None:
    gyro, accel = np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, -0.3])
    interval = constant_interval(gyro, accel + UP, 1.0)
    end = predicted(interval, gtsam.NavState(), gtsam.imuBias.ConstantBias(accel, gyro))
    np.testing.assert_allclose(end.pose().matrix(), np.eye(4), atol=1e-9)


def test_constant_acceleration_and_a_turn_about_it() -> None:
    spin = constant_interval(np.array([0.0, 0.0, 0.7]), np.array([0.0, 0.0, GRAVITY_M_S2 + 0.5]), 2.0)
    end = predicted(spin, gtsam.NavState(gtsam.Pose3(), np.array([1.0, 0.0, 0.0])))
    np.testing.assert_allclose(end.position(), [2.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(end.velocity(), [1.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(end.attitude().matrix(), Rotation.from_rotvec([0, 0, 1.4]).as_matrix(), atol=1e-9)


def turning_truth(rate: Float, force: Float, duration_s: float) -> tuple[Float, Float]:
    """Change of velocity and position when rate and force are constant in body, gravity aside, finely summed."""
    h = duration_s / 20000
    times = (np.arange(20000) + 0.5) * h
    accelerations = Rotation.from_rotvec(times[:, None] * rate).apply(force)
    return accelerations.sum(axis=0) * h, ((duration_s - times)[:, None] * accelerations).sum(axis=0) * h


def turning_errors(rate_hz: float) -> tuple[float, float]:
    """Errors of velocity and position after a second of rate and force that are constant in body."""
    rate, force = np.array([0.4, -0.6, 0.5]), np.array([1.0, 0.5, 9.0])
    velocity, position = turning_truth(rate, force, 1.0)
    end = predicted(constant_interval(rate, force, 1.0, rate_hz), gtsam.NavState())
    gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
    return (
        float(np.linalg.norm(end.velocity() - velocity - gravity)),
        float(np.linalg.norm(end.position() - position - 0.5 * gravity)),
    )


def test_a_turn_is_integrated_better_at_a_higher_rate() -> None:
    coarse, fine = turning_errors(100.0), turning_errors(1000.0)
    assert fine[0] < 0.15 * coarse[0]
    assert fine[1] < 0.15 * coarse[1]


def test_a_turn_under_constant_force_is_exact() -> None:
    velocity_error, position_error = turning_errors(200.0)
    assert velocity_error < 1e-4
    assert position_error < 1e-4


def test_a_walk_is_integrated_from_its_samples() -> None:
    imu, rng = Imu(), np.random.default_rng(0)
    buffer = filled_buffer(imu, 3.0, rng, np.zeros(3), np.zeros(3), noise_scale=0.0)
    interval = buffer.interval(1_002_500_000, 2_997_500_000)  # between samples
    assert interval is not None
    end = predicted(interval, gtsam.NavState(gtsam.Pose3(pose_at(1.0025)), velocity_at(1.0025)))
    np.testing.assert_allclose(end.position(), pose_at(2.9975)[:3, 3], atol=3e-4)
    np.testing.assert_allclose(end.velocity(), velocity_at(2.9975), atol=3e-4)
    np.testing.assert_allclose(end.attitude().matrix(), pose_at(2.9975)[:3, :3], atol=1e-4)


def test_noise_densities_are_the_rigs_times_the_factor() -> None:
    imu = Imu()
    one, two = (
        preintegrate(constant_interval(np.zeros(3), np.zeros(3), 1.0), preintegration_params(imu, scale), NO_BIAS)
        for scale in (1.0, 2.0)
    )
    covariance = np.asarray(one.preintMeasCov())
    assert covariance[0, 0] == pytest.approx(imu.gyro_noise_density**2, rel=0.1)  # after one second
    velocity = covariance[6, 6]
    assert velocity == pytest.approx(imu.accel_noise_density**2 + imu.accel_random_walk**2 / 3.0, rel=0.3)
    assert two.preintMeasCov()[0, 0] / covariance[0, 0] == pytest.approx(4.0, rel=0.01)
