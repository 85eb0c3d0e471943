from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from synthetic import filled_buffer, measured_motion, stamps_ns, transform

from graphvio.arrays import Float
from graphvio.backend.time_offset import TimeOffsetFilter, integrated_rates
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion
from graphvio.rig import Imu

IMU = Imu()
KEYFRAME_FRAMES = 12
DURATION_S = 8.0
LATE_S = 0.1  # the cameras' clock begins so much after the IMU's


class Run:
    """A filter that is fed the synthetic walk, of which the cameras see each instant at another stamp than the IMU."""

    def __init__(self, seed: int, error_s: float) -> None:
        rng = np.random.default_rng([seed, 3])
        self.gyro_bias = 0.02 * rng.standard_normal(3)
        buffer = filled_buffer(IMU, DURATION_S + 2.0 * LATE_S, rng, self.gyro_bias, np.zeros(3))
        late_ns = round(LATE_S * 1e9)
        self.filter = TimeOffsetFilter(
            IMU, 1.0, lambda start_ns, end_ns: buffer.interval(start_ns + late_ns, end_ns + late_ns)
        )
        shift_ns = round((LATE_S + error_s) * 1e9)
        reference_ns = 0
        for k, stamp_ns in enumerate(stamps_ns(DURATION_S)):
            if k == 0:
                continue
            motion = measured_motion(reference_ns + shift_ns, stamp_ns + shift_ns, rng)
            self.filter.update(replace(motion, reference_stamp_ns=reference_ns, stamp_ns=stamp_ns))
            if k % KEYFRAME_FRAMES == 0:
                reference_ns = stamp_ns


def test_it_is_as_certain_as_it_may_be() -> None:
    """Offsets sampled from their prior; squared errors over the reported variance."""
    rng, squares = np.random.default_rng(0), []
    for seed in range(60):
        error_s = 0.005 * rng.standard_normal()
        found = Run(seed, error_s).filter.estimate
        assert found.is_usable
        squares.append(((found.error_s - error_s) / found.sigma_s) ** 2)
    low, high = chi2.ppf([0.025, 0.975], len(squares)) / len(squares)
    # Intervals that follow each other share the noise of the frameset between them, with opposite signs; they are
    # taken for independent, so that it is a little better than it says.
    assert 0.5 * low < np.mean(squares) < high


@pytest.mark.parametrize("error_s", [-0.02, 0.004, 0.02])
def test_the_error_is_added_to_the_offset_in_use(error_s: float) -> None:
    run = Run(0, error_s)
    assert run.filter.estimate.error_s == pytest.approx(error_s, abs=1.5e-3)
    assert run.filter.corrected() == pytest.approx(error_s, abs=1.5e-3)
    assert run.filter.estimate.error_s == 0.0


def test_at_a_constant_rate_it_is_not_known() -> None:
    """Then all instants look alike; the bias is known all the same."""
    rate, bias = np.array([0.2, -0.3, 0.5]), np.array([0.01, 0.02, -0.01])

    def imu_between(start_ns: int, end_ns: int) -> ImuInterval:
        steps = round((end_ns - start_ns) * 1e-9 * IMU.rate_hz)
        return ImuInterval(np.full(steps, 1.0 / IMU.rate_hz), np.tile(rate + bias, (steps, 1)), np.zeros((steps, 3)))

    turning = TimeOffsetFilter(IMU, 1.0, imu_between)
    first_ns, *later_ns = stamps_ns(DURATION_S)
    for stamp_ns in later_ns:
        motion = transform((stamp_ns - first_ns) * 1e-9 * rate, np.zeros(3))
        covariance = np.diag(np.repeat([1e-3, 3e-3], 3) ** 2)
        turning.update(RelativeMotion(first_ns, stamp_ns, motion, covariance, np.zeros((6, 6)), 100))
    assert not turning.estimate.is_usable
    np.testing.assert_allclose(turning._mean[1:], bias, atol=1e-3)


def test_rates_and_what_a_bias_of_them_does() -> None:
    rng = np.random.default_rng(1)
    steps, rates = rng.uniform(0.003, 0.007, 40), rng.standard_normal((40, 3))

    def rotation(bias: Float) -> Rotation:
        whole = Rotation.identity()
        for step, rate in zip(steps, rates, strict=True):
            whole = whole * Rotation.from_rotvec(step * (rate - bias))
        return whole

    start_R_end, by_bias = integrated_rates(steps, rates)
    np.testing.assert_allclose(start_R_end, rotation(np.zeros(3)).as_matrix(), atol=1e-12)
    for axis in np.eye(3):
        numeric = (rotation(np.zeros(3)).inv() * rotation(1e-6 * axis)).as_rotvec() / 1e-6
        np.testing.assert_allclose(by_bias @ axis, numeric, atol=1e-3)
