import numpy as np
import pytest

from graphvio.arrays import Float
from graphvio.geometry import so3_exp, so3_log
from graphvio.rig import Imu
from graphvio.simulation.imu import GRAVITY_MPS2, ideal_readings, measure
from graphvio.simulation.scenes import SCENE_NAMES, build_scene

IMU_HZ = 200.0


def integrate(rate: Float, force: Float, step_s: float, pose: Float, velocity: Float) -> Float:
    """Final position by Runge-Kutta steps of two samples' length: readings are values at their stamps."""
    rotation, position = pose[:3, :3].copy(), pose[:3, 3].copy()
    gravity = np.array([0.0, 0.0, -GRAVITY_MPS2])
    h = 2.0 * step_s
    for i in range(0, len(rate) - 2, 2):
        w0, w1, w2 = rate[i], rate[i + 1], rate[i + 2]
        whole = h / 6.0 * (w0 + 4.0 * w1 + w2) + h * h / 12.0 * np.cross(w0, w2)
        half = h / 24.0 * (5.0 * w0 + 8.0 * w1 - w2) + h * h / 48.0 * np.cross(w0, w1)
        middle, end = rotation @ so3_exp(half), rotation @ so3_exp(whole)
        a0, a1, a2 = (
            rotation @ force[i] + gravity,
            middle @ force[i + 1] + gravity,
            end @ force[i + 2] + gravity,
        )
        position += h * velocity + h * h / 6.0 * (a0 + 2.0 * a1)
        velocity = velocity + h / 6.0 * (a0 + 4.0 * a1 + a2)
        rotation = end
    return position


@pytest.mark.parametrize("name", SCENE_NAMES)
@pytest.mark.parametrize("stationary_s", [1.0, 0.0])
def test_ideal_readings_integrate_to_truth(name: str, stationary_s: float) -> None:
    motion = build_scene(name, 20.0, stationary_s).motion
    states = motion.at(np.arange(4001) / IMU_HZ)
    rate, force = ideal_readings(states)
    end = integrate(rate, force, 1.0 / IMU_HZ, states.world_T_body[0], states.velocity[0])
    assert np.linalg.norm(end - states.world_T_body[-1, :3, 3]) < 1e-3


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_motion_derivatives_match_poses(name: str) -> None:
    motion = build_scene(name, 20.0).motion
    times, h = np.linspace(0.5, 19.5, 80), 1e-4
    before, now, after = motion.at(times - h), motion.at(times), motion.at(times + h)
    p0, p1, p2 = (s.world_T_body[:, :3, 3] for s in (before, now, after))
    np.testing.assert_allclose((p2 - p0) / (2 * h), now.velocity, atol=1e-5)
    np.testing.assert_allclose((p2 - 2 * p1 + p0) / h**2, now.acceleration, atol=1e-3)
    for i in range(len(times)):
        turn = before.world_T_body[i, :3, :3].T @ after.world_T_body[i, :3, :3]
        np.testing.assert_allclose(so3_log(turn) / (2 * h), now.angular_velocity[i], atol=1e-5)


@pytest.mark.parametrize("name", [name for name in SCENE_NAMES if name != "flight"])
def test_walk_is_stationary_first_by_default(name: str) -> None:
    stationary = build_scene(name, 5.0).motion.at(np.linspace(0.0, 0.85, 40))
    assert np.abs(stationary.velocity).max() < 1e-12
    assert np.abs(stationary.angular_velocity).max() < 1e-12
    _, force = ideal_readings(stationary)
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), GRAVITY_MPS2, atol=1e-9)
    moving = build_scene(name, 5.0, stationary_s=0.0).motion.at(np.array([0.0]))
    assert np.linalg.norm(moving.velocity) > 0.3


def test_street_is_driven_slowly_in_turns() -> None:
    motion = build_scene("street").motion
    states = motion.at(np.arange(8.0, motion.duration_s, 0.01))
    speed = np.linalg.norm(states.velocity, axis=1)
    turns = np.abs(states.angular_velocity[:, 2]) > 0.3
    assert 9.0 < speed.mean() < 10.5
    assert speed[turns].max() < 9.0
    assert turns.mean() > 0.15
    assert np.linalg.norm(states.acceleration[:, :2], axis=1).max() < 4.0
    np.testing.assert_allclose(states.world_T_body[:, 2, 3], 1.65, atol=0.04)


def test_flight_begins_in_the_air_and_leans_into_turns() -> None:
    motion = build_scene("flight").motion
    states = motion.at(np.arange(0.0, motion.duration_s, 0.01))
    np.testing.assert_allclose(states.world_T_body[:, 2, 3], 50.0, atol=0.15)
    np.testing.assert_allclose(np.linalg.norm(states.velocity, axis=1), 8.0, atol=0.5)
    _, force = ideal_readings(states)
    assert np.abs(states.acceleration[:, :2]).max() > 1.5
    assert np.abs(force[:, 1]).max() < 1.0  # what turns the drone is its thrust
    still = build_scene("flight", 5.0, stationary_s=2.0).motion.at(np.array([0.0]))
    assert np.array_equal(still.velocity, states.velocity[:1])


def test_ride_stops_after_its_end() -> None:
    for name in ("street", "flight"):
        motion = build_scene(name, 45.0).motion
        assert np.linalg.norm(motion.at(np.array([29.0])).velocity) > 7.0
        assert np.linalg.norm(motion.at(np.array([44.0])).velocity) < 1e-9


def test_walk_has_pace_and_bob() -> None:
    motion = build_scene("corridor", 20.0).motion
    states = motion.at(np.arange(4.0, 20.0, 0.01))
    speed = np.linalg.norm(states.velocity[:, :2], axis=1)
    assert 1.1 < speed.mean() < 1.3
    height = states.world_T_body[:, 2, 3]
    assert 0.03 < np.ptp(height) < 0.06


def test_calibration_scene_excites_all_axes() -> None:
    states = build_scene("calibration").motion.at(np.arange(3.0, 39.0, 0.02))
    assert states.angular_velocity.std(axis=0).min() > 0.25


def test_room_walk_ends_at_first_pose() -> None:
    motion = build_scene("room").motion
    first, last = motion.at(np.array([0.0, motion.duration_s])).world_T_body
    assert np.linalg.norm(last[:3, 3] - first[:3, 3]) < 0.01
    assert np.linalg.norm(so3_log(np.ascontiguousarray(first[:3, :3].T @ last[:3, :3]))) < 0.01


def test_measure_noise_has_densities() -> None:
    imu = Imu()
    motion = build_scene("corridor", 30.0).motion
    times = np.arange(6001) / imu.rate_hz
    track = measure(motion, imu, times, np.arange(6001), seed=3)
    rate, force = ideal_readings(track.states)
    gyro = track.angular_velocity - rate - track.gyro_bias
    accel = track.linear_acceleration - force - track.accel_bias
    root = np.sqrt(imu.rate_hz)
    assert gyro.std() == pytest.approx(imu.gyro_noise_density * root, rel=0.03)
    assert accel.std() == pytest.approx(imu.accel_noise_density * root, rel=0.03)
    assert np.diff(track.gyro_bias, axis=0).std() == pytest.approx(imu.gyro_random_walk / root, rel=0.03)
    assert np.diff(track.accel_bias, axis=0).std() == pytest.approx(imu.accel_random_walk / root, rel=0.03)
    again = measure(motion, imu, times, np.arange(6001), seed=3)
    other = measure(motion, imu, times, np.arange(6001), seed=4)
    assert np.array_equal(again.angular_velocity, track.angular_velocity)
    assert not np.array_equal(other.angular_velocity, track.angular_velocity)
