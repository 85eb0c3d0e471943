"""Runs of the odometry on hard cases, in which every motion of its front-end is compared with the truth."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field

from benchmarks.motions import BREAK_STATISTIC, log_vision, motion_error
from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.odometry import Odometry
from graphvio.rig import Rig

MATERIAL_M, MATERIAL_DEG = 0.01, 0.2


@dataclass(frozen=True)
class MotionOutcome:
    """One motion that the front-end returned, or that the odometry used.

    Attributes:
        since_s: time of its end since the first frameset.
        during: whether it ends while the fault lasts.
        quality: quality that the front-end reports.
        nees: squared Mahalanobis distance from the truth, 6 degrees of freedom.
        error_m: error of the translation.
        error_deg: error of the rotation.
        interval_s: time from its reference to its end.
        inliers: number of inliers of each pair.
        points: number of candidate points of each pair in the estimation.
    """

    since_s: float
    during: bool
    quality: Quality
    nees: float
    error_m: float
    error_deg: float
    interval_s: float
    inliers: dict[int, int]
    points: dict[int, int]

    @property
    def wrong(self) -> bool:
        """Whether the error is beyond 5 sigma."""
        return not self.nees <= BREAK_STATISTIC

    @property
    def materially_wrong(self) -> bool:
        """Whether the error is beyond 5 sigma, and larger than 1 cm or 0.2 degrees."""
        return self.wrong and (self.error_m > MATERIAL_M or self.error_deg > MATERIAL_DEG)


@dataclass
class Outcome:
    """Result of one run.

    Attributes:
        framesets: number of framesets that the front-end has processed.
        during: number of framesets in a fault's interval.
        failures: reason -> number of framesets without a motion.
        events: kind -> number of events.
        motions: all motions that the front-end returned.
        used: the motions that went into the estimate; where pairs contradict each other, that of one consensus set.
    """

    framesets: int = 0
    during: int = 0
    failures: Counter[str] = field(default_factory=Counter)
    events: Counter[str] = field(default_factory=Counter)
    motions: list[MotionOutcome] = field(default_factory=list)
    used: list[MotionOutcome] = field(default_factory=list)

    def add(self, other: Outcome) -> None:
        """Add the counts and motions of another run."""
        self.framesets += other.framesets
        self.during += other.during
        self.failures.update(other.failures)
        self.events.update(other.events)
        self.motions += other.motions
        self.used += other.used


class Run:
    """An odometry whose motions are logged, with the rig's IMU or with vision alone.

    Args:
        rig: rig of the recording.
        config: configuration of the odometry.
        with_imu: whether the IMU is used.
    """

    def __init__(self, rig: Rig, config: Config, *, with_imu: bool) -> None:
        self._with_imu = with_imu
        self._odometry = Odometry(rig if with_imu else rig.without_imu(), config)
        self._vision_log = log_vision(self._odometry)
        self._during: dict[int, bool] = {}

    def feed(self, measurement: Measurement, during: bool) -> None:
        """Process a measurement; ``during`` says whether a fault is active."""
        if isinstance(measurement, FrameSet):
            self._during[measurement.stamp_ns] = during
        elif not self._with_imu:
            return
        self._odometry.process(measurement)

    def finish(self, truth: dict[int, Float], start_ns: int) -> Outcome:
        """End the run, and compare its motions with the truth, stamp -> ``world_T_body`` (4, 4)."""
        self._odometry.finish()
        results, used = self._vision_log
        outcome = Outcome(len(results), sum(self._during.values()))
        outcome.events.update(event.kind for event in self._odometry.take_events())
        for stamp_ns, result in results.items():
            if result.motion is None:
                outcome.failures[re.sub(r"\d+", "N", result.reason) or "no reason given"] += 1
            else:
                outcome.motions.append(self._motion_outcome(stamp_ns, result, result.motion, truth, start_ns))
            if stamp_ns in used:
                outcome.used.append(self._motion_outcome(stamp_ns, result, used[stamp_ns], truth, start_ns))
        return outcome

    def _motion_outcome(
        self, stamp_ns: int, result: VisualResult, motion: RelativeMotion, truth: dict[int, Float], start_ns: int
    ) -> MotionOutcome:
        error = motion_error(motion, truth[motion.reference_stamp_ns], truth[motion.stamp_ns])
        return MotionOutcome(
            since_s=(stamp_ns - start_ns) * 1e-9,
            during=self._during[stamp_ns],
            quality=result.quality,
            nees=error.statistic,
            error_m=error.error_m,
            error_deg=error.error_deg,
            interval_s=motion.duration_s,
            inliers={pair: report.inliers for pair, report in sorted(result.pairs.items())},
            points={pair: report.points for pair, report in sorted(result.pairs.items())},
        )
