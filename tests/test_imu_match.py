"""Whether an IMU moves as the cameras do: shifts between clocks, and IMUs that do not at any shift."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from graphvio.arrays import Float
from graphvio.backend.imu_match import VisualStep, match_imu, match_rates, turn_disagreement
from graphvio.backend.inertial import ImuBuffer, MeanReadings
from graphvio.geometry import se3, se3_inverse, so3_exp
from graphvio.measurements.sensors import GRAVITY_M_S2, ImuSample

RATE_HZ, FRAMES_HZ = 200, 20
MAX_SHIFT_S = 0.5
FIRST_NS = 10_000_000_000
BIAS = np.array([0.02, -0.01, 0.03, 0.1, -0.05, 0.08])


def angles(t: float) -> Float:
    return np.array([0.3 * np.sin(1.7 * t), 0.2 * np.sin(2.3 * t + 1.0), 0.8 * np.sin(0.9 * t) + 0.4 * np.sin(2.9 * t)])


def position(t: float) -> Float:
    return np.array([0.5 * np.sin(1.3 * t), 0.4 * np.sin(1.9 * t + 0.5), 0.05 * np.sin(7.0 * t)])


def pose(t: float) -> Float:
    return se3(so3_exp(angles(t)), position(t))


def steps(
    duration_s: float, noise: float = 0.0, still: bool = False, noise_m: float = 0.0, rate_hz: int = FRAMES_HZ
) -> list[VisualStep]:
    """Steps with noise of turns, radians, and of positions."""
    rng = np.random.default_rng(3)
    made = []
    off = np.zeros(3)
    for k in range(round(duration_s * rate_hz)):
        begin_s, end_s = k / rate_hz, (k + 1) / rate_hz
        begin, end = pose(begin_s), pose(end_s)
        begin[:3, 3] += off
        off = noise_m * rng.standard_normal(3)
        end[:3, 3] += off
        motion = np.eye(4) if still else se3_inverse(begin) @ end
        motion[:3, :3] = motion[:3, :3] @ so3_exp(noise * rng.standard_normal(3))
        made.append(VisualStep(FIRST_NS + round(begin_s * 1e9), FIRST_NS + round(end_s * 1e9), motion))
    return made


def readings(
    late_s: float,
    change: Callable[[Float], Float] = lambda values: values,
    until_s: float = 6.0,
) -> MeanReadings:
    buffer, h = ImuBuffer(50.0), 1e-4
    for k in range(-RATE_HZ, round(until_s * RATE_HZ)):
        t = k / RATE_HZ
        world_R_body = so3_exp(angles(t))
        turned = world_R_body.T @ (so3_exp(angles(t + h)) - so3_exp(angles(t - h))) / (2 * h)
        rate = np.array([turned[2, 1], turned[0, 2], turned[1, 0]])
        acceleration = (position(t + h) - 2.0 * position(t) + position(t - h)) / h**2
        force = world_R_body.T @ (acceleration + np.array([0.0, 0.0, GRAVITY_M_S2]))
        values = change(np.concatenate([rate, force])) + BIAS
        assert not buffer.add(ImuSample(FIRST_NS + round((t + late_s) * 1e9), values[:3], values[3:]))
    return buffer.means()


@pytest.mark.parametrize("late_s", [0.0, 0.002, -0.0137, 0.1, -0.45])
def test_match_imu_is_that_of_the_clock(late_s: float) -> None:
    found = match_imu(steps(3.5, noise=1e-4), readings(late_s), MAX_SHIFT_S)
    assert found is not None
    assert found.shift_s == pytest.approx(late_s, abs=0.001)
    np.testing.assert_allclose(found.gyro_bias, BIAS[:3], atol=0.005)  # the shift is on a grid of 5 ms there
    down = pose(3.5)[:3, :3].T @ np.array([0.0, 0.0, -GRAVITY_M_S2])
    np.testing.assert_allclose(found.gravity_body, down, atol=0.2)


@pytest.mark.parametrize("rate_hz", [20, 30, 60])
@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_match_imu_with_noise_of_positions_is_that_of_the_clock(rate_hz: int, late_s: float) -> None:
    found = match_imu(steps(3.5, noise_m=0.003, rate_hz=rate_hz), readings(late_s), MAX_SHIFT_S)
    assert found is not None
    assert found.shift_s == pytest.approx(late_s, abs=0.001)


def test_match_rates_at_the_edge_of_the_samples_is_none() -> None:
    """Where they end, the smallest difference of those that are known need not be a minimum."""
    assert match_rates(steps(2.1), readings(0.08, until_s=2.1 - 0.08), MAX_SHIFT_S) is None


def scaled(gyro: float = 1.0, force: float = 1.0) -> Callable[[Float], Float]:
    return lambda values: values * np.repeat([gyro, force], 3)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(scaled(gyro=10.0), id="gyro's units"),
        pytest.param(scaled(gyro=-1.0), id="gyro's axes reversed"),
        pytest.param(scaled(gyro=0.5), id="gyro's scale"),
        pytest.param(scaled(force=1.0 / GRAVITY_M_S2), id="accelerometer in g"),
        pytest.param(scaled(force=-1.0), id="accelerometer's axes reversed"),
        pytest.param(lambda values: values[[1, 0, 2, 4, 3, 5]], id="axes swapped"),
    ],
)
def test_match_imu_of_an_imu_that_is_not_the_rigs_is_none(change: Callable[[Float], Float]) -> None:
    assert match_imu(steps(3.5), readings(0.0, change), MAX_SHIFT_S) is None
    assert match_imu(steps(3.5, noise_m=0.002), readings(0.0, change), MAX_SHIFT_S) is None


def test_match_imu_without_turns_or_time_is_none() -> None:
    assert match_imu(steps(3.5, still=True), readings(0.0), MAX_SHIFT_S) is None
    assert match_imu(steps(1.5), readings(0.0), MAX_SHIFT_S) is None
    assert match_imu(steps(3.5), readings(0.0, until_s=1.5), MAX_SHIFT_S) is None
    assert match_imu([], readings(0.0), MAX_SHIFT_S) is None


def test_match_imu_beyond_the_largest_one_is_none() -> None:
    assert match_imu(steps(3.5), readings(0.8), MAX_SHIFT_S) is None


def test_match_imu_of_a_turn_that_repeats_is_none() -> None:
    """Several shifts fit as well as each other."""
    times = np.arange(0, 4, 1 / FRAMES_HZ)

    def turn(t: float) -> Float:
        return se3(so3_exp(np.array([0.0, 0.0, 0.3 * np.sin(2.0 * np.pi * 2.5 * t)])), np.zeros(3))

    made = [
        VisualStep(
            FIRST_NS + round(t * 1e9),
            FIRST_NS + round((t + 1 / FRAMES_HZ) * 1e9),
            se3_inverse(turn(t)) @ turn(t + 1 / FRAMES_HZ),
        )
        for t in times
    ]
    buffer = ImuBuffer(50.0)
    for t in np.arange(-1.0, 6.0, 1 / RATE_HZ):
        rate = 0.3 * 2.0 * np.pi * 2.5 * np.cos(2.0 * np.pi * 2.5 * t)
        buffer.add(
            ImuSample(
                FIRST_NS + round(t * 1e9),
                np.array([1e-4 * t, 2e-4 * t, rate]),
                np.array([1e-3 * t, 2e-3 * t, GRAVITY_M_S2]),
            )
        )
    assert match_imu(made, buffer.means(), MAX_SHIFT_S) is None


def test_mean_readings_are_those_of_the_intervals_and_nan_in_gaps() -> None:
    rng, buffer = np.random.default_rng(0), ImuBuffer(50.0)
    stamps = [k * 5_000_000 for k in [*range(40), *range(60, 100)]]
    for stamp in stamps:
        buffer.add(ImuSample(stamp, rng.standard_normal(3), rng.standard_normal(3)))
    begins, ends = (
        np.array([12_345_678, 150_000_000, 310_000_000, 480_000_000]),
        np.array([77_000_000, 320_000_000, 333_000_001, 500_000_000]),
    )
    found = buffer.means().between(begins, ends)
    for k in (0, 2):
        interval = buffer.interval(int(begins[k]), int(ends[k]))
        assert interval is not None
        np.testing.assert_allclose(found[k], np.concatenate([interval.mean_rate, interval.mean_force]), atol=1e-9)
    assert np.isnan(found[[1, 3]]).all()
    assert np.isnan(ImuBuffer(50.0).means().between(begins, ends)).all()


@pytest.mark.parametrize("late_s", [0.0, -0.0137, 0.1])
def test_match_rates_needs_no_translations(late_s: float) -> None:
    turns = [each._replace(begin_T_end=se3(each.begin_T_end[:3, :3].copy(), np.zeros(3))) for each in steps(2.5)]
    found = match_rates(turns, readings(late_s), MAX_SHIFT_S)
    assert found is not None
    assert found.shift_s == pytest.approx(late_s, abs=0.001)


def test_turn_disagreement_grows_with_the_error_of_the_clock() -> None:
    """It is in multiples of what errors of both explain: well below one by the right clock."""
    found = [turn_disagreement(steps(1.5, noise=1e-4), readings(late_s)) for late_s in (0.0, 0.03, 0.1)]
    at_once, little, much = (value for value in found if value is not None)
    assert at_once < 0.1
    assert 2.0 * at_once < little < 0.6 * much
    assert much > 1.0


def test_turn_disagreement_is_not_that_of_a_few_wrong_turns() -> None:
    wrong = steps(1.5)
    for k in range(0, len(wrong), 3):
        turned = wrong[k].begin_T_end @ se3(so3_exp(np.array([0.2, 0.0, 0.0])), np.zeros(3))
        wrong[k] = wrong[k]._replace(begin_T_end=turned)
    disagreement = turn_disagreement(wrong, readings(0.0))
    assert disagreement is not None
    assert disagreement < 0.3


def test_turn_disagreement_without_turns_or_samples_is_unknown() -> None:
    assert turn_disagreement(steps(1.5, still=True), readings(0.0)) is None
    assert turn_disagreement(steps(8.0), readings(0.0)) is None
