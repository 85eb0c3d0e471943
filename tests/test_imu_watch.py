"""An IMU that contradicts good images is left out, and its clock is corrected where that explains it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_walks import recorded

from graphvio import Odometry, open_source
from graphvio.evaluation import evaluate
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import EventKind
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.self_calibration.parameters import STEREO, moved_cameras, n_camera_parameters
from graphvio.sources import Source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

SECONDS = 8.0
FAULT_S = 4.0  # after the first frameset
LEFT_OUT, USED_AGAIN, CLOCK_OFF = EventKind.IMU_LEFT_OUT, EventKind.IMU_USED_AGAIN, EventKind.IMU_CLOCK_OFF
Change = Callable[[ImuSample, float], ImuSample]
"""A fault: takes a sample, and the time of its stamp since the first frameset, seconds."""


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("watch") / "walk", SECONDS)


def by_one_camera(walk: Path, to_s: float | None = None) -> Source:
    return open_source(walk, open_source(walk).rig.with_only(["cam0"]).without_pairs(), to_s=to_s)


class Walked:
    """The odometry at the end of a walk with a fault of the IMU, its events, and its error."""

    def __init__(self, source: Source, change: Change) -> None:
        assert source.truth is not None
        measurements = list(source)
        first_ns = next(each.stamp_ns for each in measurements if isinstance(each, FrameSet))
        faulty: list[Measurement] = [
            change(each, 1e-9 * (each.stamp_ns - first_ns)) if isinstance(each, ImuSample) else each
            for each in measurements
        ]
        faulty.sort(key=lambda each: each.stamp_ns)  # as recordings are
        self.predicted_ns: list[int] = []
        self.odometry = Odometry(source.rig, on_prediction=lambda each: self.predicted_ns.append(each.stamp_ns))
        estimates = [each for each in map(self.odometry.process, faulty) if each is not None]
        estimates += self.odometry.finish()
        posed = [each for each in estimates if each.nav_T_body is not None]
        self.epochs = {each.epoch for each in posed}
        self.last_status = estimates[-1].status
        self.events = Counter(event.kind for event in self.odometry.take_events())
        newest = [each for each in posed if each.epoch == max(self.epochs)]
        self.newest_poses = len(newest)
        estimated = Trajectory(
            np.array([each.stamp_ns for each in newest]), np.array([each.nav_T_body for each in newest])
        )
        self.error_m = evaluate(estimated, load_trajectory(source.truth)).ate_position_m.rmse  # of the newest epoch


def late(seconds: float, since_s: float = -np.inf) -> Change:
    def change(sample: ImuSample, at_s: float) -> ImuSample:
        return replace(sample, stamp_ns=sample.stamp_ns + round(seconds * 1e9)) if at_s > since_s else sample

    return change


@pytest.mark.parametrize("seconds", [0.08, -0.1])
def test_clock_that_is_off_is_corrected(walk: Path, seconds: float) -> None:
    walked = Walked(open_source(walk), late(seconds))
    assert (walked.events[LEFT_OUT], walked.events[CLOCK_OFF]) == (1, 1)
    assert walked.epochs == {0}
    assert walked.error_m < 0.02
    rig, refined = walked.odometry.rig, walked.odometry.refined_rig
    assert rig.imu is not None
    assert refined is not None
    assert refined.imu is not None
    assert refined.imu.time_offset_s - rig.imu.time_offset_s == pytest.approx(seconds, abs=0.002)
    assert any(f"{1e3 * abs(seconds):.0f} ms" in warning for warning in walked.odometry.rig_warnings)


def test_clock_that_is_too_late_is_reported(walk: Path) -> None:
    """By that of the refined rig, a recording can be read in the order of instants."""
    walked = Walked(open_source(walk), late(0.3))
    assert (walked.events[LEFT_OUT], walked.events[USED_AGAIN], walked.events[CLOCK_OFF]) == (1, 0, 1)
    assert walked.error_m < 0.03
    refined = walked.odometry.refined_rig
    assert refined is not None
    assert refined.imu is not None
    assert refined.imu.time_offset_s == pytest.approx(0.3, abs=0.002)
    (warning,) = walked.odometry.rig_warnings
    assert "300 ms" in warning


def test_clock_that_jumps_is_corrected(walk: Path) -> None:
    walked = Walked(open_source(walk), late(-0.06, FAULT_S))
    assert (walked.events[LEFT_OUT], walked.events[CLOCK_OFF]) == (1, 1)
    assert walked.odometry.clock_shift_s == pytest.approx(-0.06, abs=0.002)
    assert walked.epochs == {0}
    assert walked.error_m < 0.02


def test_axes_that_are_not_the_rigs_are_left_out(walk: Path) -> None:
    z90 = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    walked = Walked(
        open_source(walk),
        lambda sample, _: replace(
            sample, angular_velocity=z90 @ sample.angular_velocity, linear_acceleration=z90 @ sample.linear_acceleration
        ),
    )
    assert walked.events[LEFT_OUT] == 1
    assert not walked.events[USED_AGAIN] + walked.events[CLOCK_OFF]
    assert walked.odometry.clock_shift_s == 0.0
    assert walked.last_status is Status.TRACKING
    assert np.diff(walked.predicted_ns[-1000:]).max() < 50_000_000  # by vision, as often as the IMU's samples come
    assert walked.error_m < 0.05
    assert any("left out" in warning for warning in walked.odometry.rig_warnings)


def test_fault_that_passes_is_left_out_until_then(tmp_path: Path) -> None:
    """The gyro reads half of its rates for 3 s."""
    walked = Walked(
        open_source(recorded(tmp_path / "walk", 12.0)),
        lambda sample, at_s: (
            replace(sample, angular_velocity=0.5 * sample.angular_velocity)
            if FAULT_S < at_s < FAULT_S + 3.0
            else sample
        ),
    )
    assert (walked.events[LEFT_OUT], walked.events[USED_AGAIN], walked.events[CLOCK_OFF]) == (1, 1, 0)
    assert walked.error_m < 0.02
    assert not walked.odometry.rig_warnings


def test_imu_that_is_right_is_not_left_out(walk: Path) -> None:
    walked = Walked(open_source(walk), lambda sample, _: sample)
    assert not walked.events & Counter([LEFT_OUT, USED_AGAIN, CLOCK_OFF])
    assert walked.odometry.clock_shift_s == 0.0


@pytest.mark.parametrize("pair", [0, 1])
def test_imu_is_not_left_out_where_the_calibration_of_a_pair_is_wrong(long_room_walk: Path, pair: int) -> None:
    """Left to right is off by 0.15 degrees: until that is known, motions by the pair are too long by a tenth."""
    rig = open_source(long_room_walk).rig.with_pairs([pair])
    difference = np.zeros(n_camera_parameters(rig))
    difference[STEREO + 1] = np.deg2rad(0.15)
    walked = Walked(open_source(long_room_walk, moved_cameras(rig, difference)), lambda sample, _: sample)
    assert not walked.events & Counter([LEFT_OUT, EventKind.VISION_GATED, EventKind.GATE_RESET])
    assert walked.events[EventKind.CALIBRATION_CORRECTED] == 1
    assert walked.error_m < 0.02


@pytest.mark.parametrize("seconds", [0.05, -0.1])
def test_clock_of_a_single_cameras_imu_is_corrected_before_the_first_pose(long_room_walk: Path, seconds: float) -> None:
    walked = Walked(by_one_camera(long_room_walk), late(seconds))
    assert walked.events[CLOCK_OFF] == 1
    assert walked.epochs == {0}
    assert walked.odometry.clock_shift_s == pytest.approx(seconds, abs=0.003)
    assert walked.newest_poses > 60
    assert walked.error_m < 0.02
    shift = f"{1e3 * abs(walked.odometry.clock_shift_s):.0f} ms"
    assert any(shift in warning for warning in walked.odometry.rig_warnings)
    refined = walked.odometry.refined_rig
    assert refined is not None
    assert refined.imu is not None
    assert refined.imu.time_offset_s == pytest.approx(seconds, abs=0.002)


def test_clock_of_a_single_cameras_imu_that_jumps_is_corrected(long_room_walk: Path) -> None:
    walked = Walked(by_one_camera(long_room_walk), late(-0.06, FAULT_S))
    assert (walked.events[EventKind.LOST], walked.events[CLOCK_OFF]) == (1, 1)
    assert walked.odometry.clock_shift_s == pytest.approx(-0.06, abs=0.005)


def test_clock_of_a_single_cameras_imu_that_is_too_late_is_in_the_refined_rig(long_room_walk: Path) -> None:
    source = by_one_camera(long_room_walk)
    odometry = Odometry(source.rig)
    measurements = [late(0.3)(each, 0.0) if isinstance(each, ImuSample) else each for each in source]
    for each in sorted(measurements, key=lambda each: each.stamp_ns):
        estimate = odometry.process(each)
        assert estimate is None or estimate.nav_T_body is None
    assert [event.kind for event in odometry.take_events()].count(CLOCK_OFF) == 1
    assert odometry.refined_rig is not None
    assert odometry.refined_rig.imu is not None
    assert odometry.refined_rig.imu.time_offset_s == pytest.approx(0.3, abs=0.003)


def test_single_camera_has_no_pose_by_an_imu_of_other_axes(long_room_walk: Path) -> None:
    """It would be wrong; where the rig does not turn, that cannot be seen."""
    z90 = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    source = by_one_camera(long_room_walk, 7.0)
    odometry = Odometry(source.rig)
    posed = 0
    for each in source:
        if isinstance(each, ImuSample):
            each = replace(
                each, angular_velocity=z90 @ each.angular_velocity, linear_acceleration=z90 @ each.linear_acceleration
            )
        estimate = odometry.process(each)
        posed += estimate is not None and estimate.nav_T_body is not None
    assert not posed
    (event,) = [event for event in odometry.take_events() if event.kind is EventKind.NOT_INITIALISED]
    assert "axes" in event.detail


def test_clock_of_a_single_cameras_imu_that_is_right_is_kept(long_room_walk: Path) -> None:
    walked = Walked(by_one_camera(long_room_walk, 7.0), lambda sample, _: sample)
    assert not walked.events & Counter([CLOCK_OFF, EventKind.LOST])
    assert walked.odometry.clock_shift_s == 0.0
    assert walked.epochs == {0}
