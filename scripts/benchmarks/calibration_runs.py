"""Runs of the odometry with wrong calibration files on a rendered recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.calibration_differences import calibration_differences
from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import GraphvioError, TrajectoryError
from graphvio.evaluation import evaluate
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.odometry import Odometry
from graphvio.rig import Rig
from graphvio.simulation import RIG_CHANGES, make_simulator
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.sources import open_source
from graphvio.sources.sequencer import merge
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory
from graphvio.warmup import warm_up

_FRAMESETS_OF_NEES = 20  # the NEES is that of every 20th pose


@dataclass(frozen=True)
class CalibrationOutcome:
    """Result of a run.

    Attributes:
        ate_m: rmse of the causal positions after alignment of all epochs together; infinite where there are none.
        ate_scaled_m: the same after an alignment with scale, which removes the effect of a wrong baseline.
        scale_error_percent: error of the estimate's scale.
        epochs: number of epochs.
        posed_percent: share of the framesets that have a pose.
        frameset_ms: mean wall time per frameset, including decoding.
        pose_nees: NEES per dimension, mean over every 20th pose; 1 if covariances are right. NaN if the epoch
            changes.
        before: parameter with unit -> rms of its errors in the files, against the true rig at the end.
        after: the same for the parameters that the odometry estimated, with the estimates.
        events: kind -> number of events; not stored in the file of results.
    """

    ate_m: float
    ate_scaled_m: float
    scale_error_percent: float
    epochs: int
    posed_percent: float
    frameset_ms: float
    pose_nees: float
    before: dict[str, float] = field(default_factory=dict)
    after: dict[str, float] = field(default_factory=dict)
    events: dict[str, int] = field(default_factory=dict)


class WronglyCalibrated:
    """A rendered scene whose files have a calibration error.

    Args:
        folder: folder of the recording with exact files.
        scene: name of the scene.
        duration_s: duration of the part that is run, in seconds; None for the whole walk.
        rig_change: change of the rig with which it was rendered, one of `graphvio.simulation.RIG_CHANGES`, or None.
        error: sizes of the calibration errors.
        seed: seed with which the errors are sampled.
        begin_s: time in the walk at which the odometry begins; after the scene's first second the rig is in motion.
    """

    def __init__(
        self,
        folder: Path,
        scene: str,
        duration_s: float | None,
        rig_change: str | None,
        error: CalibrationErrorSizes,
        seed: int,
        begin_s: float = 0.0,
    ) -> None:
        self._folder, self._duration_s, self._begin_s = folder, duration_s, begin_s
        exact = open_source(folder)
        if exact.truth is None:
            raise GraphvioError(f"{folder}: holds no true trajectory; remove it, so that it is rendered again")
        self._truth = load_trajectory(exact.truth)
        sampled = draw(exact.rig, error, seed)
        self._written_rig = sampled.written_rig
        change = RIG_CHANGES[rig_change] if rig_change is not None else None
        simulator = make_simulator(
            scene, duration_s=duration_s, rig=sampled.true_rig, imu_error=sampled.imu, rig_change=change
        )
        self._true_rig = simulator.rig_at(-1)
        track = simulator.imu_track
        begin_ns = track.stamps_ns[0] + round(1e9 * begin_s)
        self._samples = [
            ImuSample(int(stamp), rate, force)
            for stamp, rate, force in zip(
                track.stamps_ns, track.angular_velocity, track.linear_acceleration, strict=True
            )
            if stamp >= begin_ns
        ]

    def run(self, config: Config, select: Callable[[Rig], Rig]) -> CalibrationOutcome:
        """Run the odometry with the part of the rig that ``select`` returns."""
        written, true = (select(rig) for rig in (self._written_rig, self._true_rig))
        warm_up(written, config)
        odometry = Odometry(written, config)
        begin = perf_counter()
        estimates = [e for e in map(odometry.process, self._measurements(written)) if e is not None]
        estimates += odometry.finish()
        wall_s = perf_counter() - begin
        posed = [e for e in estimates if e.nav_T_body is not None]
        poses: Float = np.array([e.nav_T_body for e in posed]).reshape(-1, 4, 4)
        try:
            estimated = Trajectory(np.array([e.stamp_ns for e in posed], dtype=np.int64), poses)
            evaluation = evaluate(estimated, self._truth)
            ate_m, pose_nees = evaluation.ate_position_m.rmse, _pose_nees(posed, self._truth)
            ate_scaled_m, scale_error = evaluation.ate_scaled_m, evaluation.scale_error_percent
        except TrajectoryError:
            ate_m, pose_nees, ate_scaled_m, scale_error = np.inf, np.nan, None, None
        refined: Rig | None = getattr(odometry, "refined_rig", None)
        after = _rms(refined, true) if refined is not None else {}
        offset_s = estimates[-1].time_offset_s if estimates else None
        if offset_s is not None and true.imu is not None:
            after["time_offset_ms"] = 1e3 * abs(offset_s - true.imu.time_offset_s)
        return CalibrationOutcome(
            ate_m=ate_m,
            ate_scaled_m=np.inf if ate_scaled_m is None else ate_scaled_m,
            scale_error_percent=np.nan if scale_error is None else scale_error,
            epochs=len({e.epoch for e in posed}),
            posed_percent=100.0 * len(posed) / max(len(estimates), 1),
            frameset_ms=1e3 * wall_s / max(len(estimates), 1),
            pose_nees=pose_nees,
            before=_rms(written, true),
            after=after,
            events=Counter(event.kind for event in odometry.take_events()),
        )

    def _measurements(self, rig: Rig) -> Iterator[Measurement]:
        """Merge the images on disk with the IMU samples in memory."""
        source = open_source(self._folder, rig, from_s=self._begin_s, to_s=self._duration_s)
        framesets = (measurement for measurement in source if isinstance(measurement, FrameSet))
        if rig.imu is None:
            return framesets
        return merge(self._samples, framesets, rig.imu.time_offset_ns)


def _pose_nees(estimates: Sequence[Estimate], truth: Trajectory) -> float:
    """Compute the mean NEES per dimension of the poses after the first one, which defines the frame nav."""
    true = dict(zip(truth.stamps_ns.tolist(), truth.nav_T_body, strict=True))
    first, *others = [e for e in estimates if e.stamp_ns in true][::_FRAMESETS_OF_NEES]
    if not others or others[-1].epoch != first.epoch:
        return np.nan
    assert first.nav_T_body is not None
    nav_T_world, nees = first.nav_T_body @ se3_inverse(true[first.stamp_ns]), []
    for estimate in others:
        assert estimate.nav_T_body is not None
        assert estimate.covariance is not None
        error = se3_log(se3_inverse(nav_T_world @ true[estimate.stamp_ns]) @ estimate.nav_T_body)
        nees.append(float(error @ np.linalg.solve(estimate.covariance, error)) / len(error))
    return float(np.mean(nees))


def _rms(rig: Rig, true_rig: Rig) -> dict[str, float]:
    return {name: float(np.sqrt(np.mean(e**2))) for name, e in calibration_differences(rig, true_rig).items() if len(e)}
