"""The offset between two cameras' clocks, from their angular speeds."""

import numpy as np
import pytest
from hand_eye import LEFT2_T_LEFT1

from graphvio.arrays import Float
from graphvio.calibration.clocks import find_offset
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.trajectory import Trajectory

OFFSET_NS = 126_834_000_000
START_NS = 1_491_495_696_920_000_000


def pose(time_s: float) -> Float:
    """Pose of a rig that turns at changing speeds."""
    waves = [np.sin(0.9 * time_s), np.sin(1.3 * time_s + 0.4), np.sin(0.55 * time_s**1.2), 0.5 * np.sin(0.7 * time_s)]
    return se3_exp(np.array([0.5 * waves[0], 0.6 * waves[1], 0.9 * waves[2], waves[3], 0.3 * time_s, 0.2 * waves[1]]))


def trajectories(
    rng: np.random.Generator, first_s: tuple[float, float], second_s: tuple[float, float], noise_rad: float = 1e-3
) -> tuple[Trajectory, Trajectory]:
    """Trajectories of both cameras, each on its own clock, over some seconds of the walk."""
    made = []
    for (begin_s, end_s), period_s, to_camera, clock_ns in (
        (first_s, 0.031, np.eye(4), START_NS),
        (second_s, 0.029, se3_inverse(LEFT2_T_LEFT1), START_NS + OFFSET_NS),
    ):
        times = np.arange(begin_s, end_s, period_s)
        noise = np.repeat([noise_rad, 2.0 * noise_rad], 3)
        poses = np.array([pose(time) @ to_camera @ se3_exp(noise * rng.standard_normal(6)) for time in times])
        made.append(Trajectory(clock_ns + np.round(times * 1e9).astype(np.int64), poses))
    return made[0], made[1]


@pytest.mark.parametrize(("second_s"), [(0.0, 40.0), (5.0, 30.0), (25.0, 60.0)])
def test_find_offset_partial_overlap_is_accurate(second_s: tuple[float, float]) -> None:
    one, other = trajectories(np.random.default_rng(0), (0.0, 40.0), second_s)
    found = find_offset(one, other)
    assert abs(found.offset_ns - OFFSET_NS) < 3_000_000
    assert found.correlation > 0.95


def test_find_offset_no_overlap_raises() -> None:
    one, other = trajectories(np.random.default_rng(1), (0.0, 20.0), (70.0, 90.0))
    with pytest.raises(CalibrationError, match="overlap in time"):
        find_offset(one, other)


def test_find_offset_short_trajectory_raises() -> None:
    one, other = trajectories(np.random.default_rng(2), (0.0, 20.0), (3.0, 6.0))
    with pytest.raises(CalibrationError, match=r"second trajectory is 2\.\d s long"):
        find_offset(one, other)


def test_find_offset_periodic_rotation_raises() -> None:
    """At one frequency, a shift by any number of periods fits."""
    times = np.arange(0.0, 40.0, 0.03)
    poses = np.array([se3_exp(np.array([0.0, 0.5 * np.sin(2.0 * time), 0.0, 0.0, 0.0, 0.0])) for time in times])
    even = Trajectory(START_NS + np.round(times * 1e9).astype(np.int64), poses)
    with pytest.raises(CalibrationError, match="ambiguous"):
        find_offset(even, even)
