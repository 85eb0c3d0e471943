import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import UP, filled_buffer, pose_at

from graphvio.arrays import Float
from graphvio.backend.initialisation import initial_attitude, level
from graphvio.config.stages import InitialisationConfig
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.rig import Imu

CONFIG = InitialisationConfig()
IMU = Imu()
FORWARD = np.array([1.0, 0.0, 0.0])


def stationary(
    nav_R_body: Float, gyro_bias: Float, seed: int, duration_s: float = 1.0, noise: float = 1.0
) -> ImuInterval:
    n = round(duration_s * IMU.rate_hz)
    rng = np.random.default_rng(seed)
    root = noise * np.sqrt(IMU.rate_hz)
    rates = gyro_bias + IMU.gyro_noise_density * root * rng.standard_normal((n, 3))
    forces = nav_R_body.T @ UP + IMU.accel_noise_density * root * rng.standard_normal((n, 3))
    return ImuInterval(np.full(n, 1.0 / IMU.rate_hz), rates, forces)


def tilt_between(nav_R_body: Float, truth: Float) -> float:
    """Angle between the two ideas of up, seen from body."""
    return float(np.arccos(np.clip(nav_R_body[2] @ truth[2], -1.0, 1.0)))


def assert_heading_is_zero(nav_R_body: Float) -> None:
    np.testing.assert_allclose(nav_R_body @ nav_R_body.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(nav_R_body) == pytest.approx(1.0)
    assert nav_R_body[1, 0] == pytest.approx(0.0, abs=1e-12)  # body's x has no part along nav's y
    assert nav_R_body[0, 0] > 0.0


@pytest.mark.parametrize("angles_deg", [(0, 0), (20, -35), (-50, 170), (5, 90)])
def test_initial_attitude_at_a_standstill_is_level(angles_deg: tuple[float, float]) -> None:
    truth = Rotation.from_euler("YX", angles_deg, degrees=True).as_matrix()
    bias = np.array([0.01, -0.02, 0.015])
    normalised = []
    for seed in range(10):
        at = initial_attitude(stationary(truth, bias, seed), 1.0, CONFIG)
        assert at.is_stationary
        assert np.rad2deg(tilt_between(at.nav_R_body, truth)) < 0.1
        assert np.abs(at.gyro_bias - bias).max() < 1e-3
        normalised.append((at.gyro_bias - bias) / at.gyro_bias_sigma)
        assert_heading_is_zero(at.nav_R_body)
    assert 0.1 < np.std(normalised) < 1.5  # the stated sigma is none too small


def test_tilt_sigma_covers_an_accelerometer_bias() -> None:
    interval = stationary(np.eye(3), np.zeros(3), 0)
    biased = ImuInterval(interval.steps_s, interval.angular_velocity, interval.linear_acceleration + 0.15 * FORWARD)
    at = initial_attitude(biased, 1.0, CONFIG)
    assert tilt_between(at.nav_R_body, np.eye(3)) < 1.1 * at.tilt_sigma_rad


def walking(start_s: float, end_s: float, at_s: float) -> tuple[ImuInterval, float]:
    rng = np.random.default_rng(1)
    buffer = filled_buffer(IMU, end_s + 0.1, rng, np.zeros(3), np.zeros(3))
    interval = buffer.interval(round(start_s * 1e9), round(end_s * 1e9))
    assert interval is not None
    return interval, at_s - start_s


@pytest.mark.parametrize("start_s", [0.5, 1.0, 1.7, 2.6, 3.3])
@pytest.mark.parametrize("place", [0.0, 0.5, 1.0])
def test_in_motion(start_s: float, place: float) -> None:
    interval, offset_s = walking(start_s, start_s + 1.0, start_s + place)
    at = initial_attitude(interval, offset_s, CONFIG)
    truth = pose_at(start_s + place)[:3, :3]
    assert not at.is_stationary
    assert tilt_between(at.nav_R_body, truth) < 3.0 * at.tilt_sigma_rad
    assert at.tilt_sigma_rad < 0.2
    assert_heading_is_zero(at.nav_R_body)


def test_a_turn_within_the_interval_is_followed() -> None:
    """Turned by 90 degrees about x in a second, on the spot: the attitude asked for is that of the instant."""
    n, rate = 200, np.array([np.pi / 2.0, 0.0, 0.0])
    steps = np.full(n, 1.0 / n)
    turns = Rotation.from_rotvec(((np.arange(n) + 0.5) / n)[:, None] * rate)
    forces = turns.inv().apply(np.tile(UP, (n, 1)))
    interval = ImuInterval(steps, np.tile(rate, (n, 1)), forces)
    for at_s in (0.0, 0.5, 1.0):
        at = initial_attitude(interval, at_s, CONFIG)
        truth = Rotation.from_rotvec(at_s * rate).as_matrix()
        assert not at.is_stationary
        assert np.rad2deg(tilt_between(at.nav_R_body, truth)) < 0.6


def test_shorter_intervals_are_less_certain() -> None:
    long, short = (initial_attitude(*walking(1.0, end, end), CONFIG).tilt_sigma_rad for end in (2.0, 1.3))
    assert short > 1.5 * long


def test_standstill_with_motion_is_not_detected() -> None:
    shaken, turning, falling = (stationary(np.eye(3), np.zeros(3), 0) for _ in range(3))
    shake = 0.3 * np.sin(np.arange(200))[:, None] * np.ones(3)
    intervals = [
        ImuInterval(shaken.steps_s, shaken.angular_velocity, shaken.linear_acceleration + shake),
        ImuInterval(turning.steps_s, turning.angular_velocity + 0.3, turning.linear_acceleration),
        ImuInterval(falling.steps_s, falling.angular_velocity, falling.linear_acceleration + 0.08 * UP),
        stationary(np.eye(3), np.zeros(3), 0, duration_s=0.2),
    ]
    for interval in intervals:
        assert not initial_attitude(interval, 0.1, CONFIG).is_stationary


@pytest.mark.parametrize("up", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.9, 0.1, 0.2), (-0.95, 0.2, 0.1)])
def test_where_x_is_steep_z_gives_the_heading(up: tuple[float, float, float]) -> None:
    nav_R_body = level(3.0 * np.array(up))
    np.testing.assert_allclose(nav_R_body @ nav_R_body.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(nav_R_body) == pytest.approx(1.0)
    np.testing.assert_allclose(nav_R_body @ up / np.linalg.norm(up), [0.0, 0.0, 1.0], atol=1e-12)
    assert nav_R_body[1, 2] == pytest.approx(0.0, abs=1e-12)
    assert nav_R_body[0, 2] > 0.0


def test_every_direction_of_up_gives_a_rotation() -> None:
    for up in np.random.default_rng(3).standard_normal((200, 3)):
        nav_R_body = level(up)
        np.testing.assert_allclose(nav_R_body @ nav_R_body.T, np.eye(3), atol=1e-10)
        np.testing.assert_allclose(nav_R_body @ up, np.linalg.norm(up) / GRAVITY_M_S2 * UP, atol=1e-10)
