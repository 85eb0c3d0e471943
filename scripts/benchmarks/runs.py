"""One run of the odometry over a recording with truth, and its errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from benchmarks.motions import BREAK_STATISTIC, EXACT, TruthNoise, VisionLog, log_vision, motion_error, uses_vision
from benchmarks.recordings import blocks
from graphvio.arrays import Bool, Float, Int
from graphvio.config import Config
from graphvio.errors import GraphvioError, TrajectoryError
from graphvio.evaluation import MAX_GAP_S, Evaluation, evaluate
from graphvio.geometry import se3, so3_exp
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.odometry import Odometry
from graphvio.rig import Rig, StereoPair
from graphvio.sources import open_source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory
from graphvio.warmup import warm_up

_BLOCK = 40
_RPE_METRES = ("5 m", "1 m")

Alter = Callable[[FrameSet], FrameSet]
"""Alters each frameset before the odometry processes it."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a run.

    Attributes:
        estimate: causal poses of all epochs, ``nav_T_body``.
        epochs: (N,) epoch of each pose.
        by_vision: (N,) whether vision was used for each pose; otherwise the odometry has reported that it coasts or is
            lost.
        truth: true trajectory of the recording.
        evaluation: comparison of the estimate with the truth; None if too few poses could be compared.
        framesets: number of framesets for which the odometry has returned an estimate.
        motions: number of visual motions that the odometry used and whose truth is known.
        breaks: number of these motions that are off by more than 5 sigma of their own covariance.
        refused: number of the front-end's motions that the odometry did not use.
    """

    estimate: Trajectory
    epochs: Int
    by_vision: Bool
    truth: Trajectory
    evaluation: Evaluation | None
    framesets: int
    motions: int
    breaks: int
    refused: int

    @property
    def ate_m(self) -> float:
        """Rmse of the position after alignment, metres; infinite if there is no evaluation."""
        return self.evaluation.ate_position_m.rmse if self.evaluation is not None else np.inf

    @cached_property
    def epoch_ate_m(self) -> float:
        """ATE with each epoch aligned by itself, of poses with vision only, metres; infinite if there are none.

        Between epochs is a break that the odometry reports; before it, the odometry coasts, and reports that, too.
        """
        squares, poses = 0.0, 0
        for epoch in np.unique(self.epochs):
            rows = (self.epochs == epoch) & self.by_vision
            try:
                errors_m = evaluate(self.estimate.select(rows), self.truth).position_error_m
            except TrajectoryError:
                continue  # too few poses to align
            squares, poses = squares + float(errors_m @ errors_m), poses + len(errors_m)
        return float(np.sqrt(squares / poses)) if poses else np.inf

    @property
    def by_vision_percent(self) -> float:
        """Share of the framesets in whose pose vision was used, percent."""
        return float(100.0 * np.count_nonzero(self.by_vision) / max(self.framesets, 1))

    def cells(self) -> list[str]:
        """Return the cells of a table's row below `HEAD`."""
        done = f"{100 * len(self.estimate) / max(self.framesets, 1):.0f}"
        epochs = f"{len(np.unique(self.epochs))}"
        breaks = [f"{self.breaks} / {self.motions}", f"{self.refused}", done, epochs]
        if self.evaluation is None:
            return ["-", "-", "-", "-", *breaks]
        rpe = next((self.evaluation.rpe[d] for d in _RPE_METRES if d in self.evaluation.rpe), None)
        return [
            f"{100 * self.ate_m:.2f}",
            "-" if self.evaluation.drift_percent is None else f"{self.evaluation.drift_percent:.2f}",
            "-" if rpe is None or rpe.percent is None else f"{rpe.percent:.2f}",
            "-" if rpe is None or rpe.deg_per_m is None else f"{rpe.deg_per_m:.3f}",
            *breaks,
        ]


HEAD = (
    "ATE, cm",
    "drift, %",
    "RPE, %",
    "RPE, deg/m",
    "breaks / motions",
    "refused",
    "poses, %",
    "epochs",
)


def run(recording: Path, rig: Rig, config: Config, alter: Alter | None = None, noise: TruthNoise = EXACT) -> Outcome:
    """Run the odometry over a recording.

    Images are decoded in blocks before these are processed, so that decoding takes no processor time from the odometry.

    Args:
        recording: folder of the recording, which must contain the truth.
        rig: rig with the pairs and the IMU that are used.
        config: configuration of the odometry.
        alter: function that is applied to every frameset, or None.
        noise: noise of the true poses, which is considered in the count of breaks.

    Raises:
        GraphvioError: if the recording cannot be read or has no truth.
    """
    source = open_source(recording, rig)
    if source.truth is None:
        raise GraphvioError(f"{recording}: holds no true trajectory; the accuracy cannot be measured without")
    truth = load_trajectory(source.truth)
    warm_up(source.rig, config)
    cv2.setNumThreads(-1)  # as in a new process; the odometry then sets its own number
    odometry = Odometry(source.rig, config)
    vision_log = log_vision(odometry)
    estimates: list[Estimate] = []
    for block in blocks(iter(source), _BLOCK):
        for measurement in _altered(block, alter):
            estimate = odometry.process(measurement)
            if estimate is not None:
                estimates.append(estimate)
    estimates += odometry.finish()
    cv2.setNumThreads(-1)
    return _outcome(estimates, vision_log, truth, noise)


def _altered(block: list[Measurement], alter: Alter | None) -> list[Measurement]:
    if alter is None:
        return block
    return [alter(measurement) if isinstance(measurement, FrameSet) else measurement for measurement in block]


def _outcome(estimates: list[Estimate], vision_log: VisionLog, truth: Trajectory, noise: TruthNoise) -> Outcome:
    posed = [e for e in estimates if e.nav_T_body is not None]
    stamps_ns = np.array([e.stamp_ns for e in posed], dtype=np.int64)
    estimate = Trajectory(stamps_ns, np.array([e.nav_T_body for e in posed]).reshape(-1, 4, 4))
    returned = sum(result.motion is not None for result in vision_log.results.values())
    statistics = _statistics(list(vision_log.used.values()), truth, noise)
    try:
        evaluation = evaluate(estimate, truth)
    except TrajectoryError:
        evaluation = None
    return Outcome(
        estimate=estimate,
        epochs=np.array([e.epoch for e in posed], dtype=np.int64),
        by_vision=np.array([uses_vision(e) for e in posed], dtype=bool),
        truth=truth,
        evaluation=evaluation,
        framesets=len(estimates),
        motions=len(statistics),
        breaks=int(np.sum(statistics > BREAK_STATISTIC)),
        refused=returned - len(vision_log.used),
    )


def _statistics(motions: list[RelativeMotion], truth: Trajectory, noise: TruthNoise) -> Float:
    """Return squared Mahalanobis distances (M,) to the truth of those motions whose truth is known at both ends."""
    stamps_ns = np.unique([ns for m in motions for ns in (m.reference_stamp_ns, m.stamp_ns)]).astype(np.int64)
    known = truth.at(stamps_ns, MAX_GAP_S)[0]
    world_T_body = dict(zip(known.stamps_ns.tolist(), known.nav_T_body, strict=True))
    return np.array(
        [
            motion_error(motion, world_T_body[earlier_ns], world_T_body[later_ns], noise).statistic
            for motion in motions
            for earlier_ns, later_ns in [(motion.reference_stamp_ns, motion.stamp_ns)]
            if earlier_ns in world_T_body and later_ns in world_T_body
        ]
    )


def blinded(pair: int, start_ns: int, end_ns: int) -> Alter:
    """Return a function that blackens the images of one pair with stamps from ``start_ns`` to before ``end_ns``."""

    def alter(frameset: FrameSet) -> FrameSet:
        if pair not in frameset.images or not start_ns <= frameset.stamp_ns < end_ns:
            return frameset
        left, right = frameset.images[pair]
        black = (np.zeros_like(left), np.zeros_like(right))
        return FrameSet(frameset.stamp_ns, {**frameset.images, pair: black})

    return alter


def with_moved_pair(rig: Rig, index: int, angle_deg: float, shift_m: float) -> Rig:
    """Return a rig with a calibration error: both cameras of a pair are moved together, about the pair's left camera.

    Args:
        rig: the true rig.
        index: index of the pair.
        angle_deg: angle of the rotation, about an axis that is not near to any camera's axis.
        shift_m: length of the translation, along another such axis.
    """
    axis, direction = np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0), np.array([1.0, -1.0, 1.0]) / np.sqrt(3.0)
    left_T_moved = se3(so3_exp(np.deg2rad(angle_deg) * axis), shift_m * direction)
    pair = rig.pairs[index]
    body_T_left = pair.left.body_T_cam
    moved_T_body = body_T_left @ left_T_moved @ pair.left.cam_T_body
    left = replace(pair.left, body_T_cam=moved_T_body @ body_T_left)
    right = replace(pair.right, body_T_cam=moved_T_body @ pair.right.body_T_cam)
    pairs = list(rig.pairs)
    pairs[index] = StereoPair(pair.name, left, right)
    return replace(rig, pairs=tuple(pairs))
