"""Calibration of a rig from a recording, or of cameras from trajectories of any odometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.calibration.camera_motions import CameraMotions, SeparateMotions
from graphvio.calibration.imu_alignment import ImuAlignment, align
from graphvio.calibration.nuisances import ScaleMode
from graphvio.calibration.pair_calibration import PairCalibration, calibrate_pair
from graphvio.calibration.result import Calibration, Clock, rig_warnings
from graphvio.calibration.segments import Segments, all_segments
from graphvio.calibration.several import pairwise, place_all
from graphvio.calibration.trajectory_motions import TwoTrajectories, aligned, of_all
from graphvio.config import Config
from graphvio.errors import CalibrationError
from graphvio.measurements.sensors import FrameSet, ImuSample
from graphvio.rig import Rig
from graphvio.sources import Source, open_source
from graphvio.trajectory import Trajectory

OnFrameset = Callable[[int, SeparateMotions], bool]
"""Called after each frameset with the number of framesets and all motions so far; returns True to end the recording."""

_NO_ERROR = np.zeros((6, 6))
_MIN_MEASURED = 0.04  # relative to the best pair's number of motions: exchanged images reach this by chance


def calibrate_pairs(
    source: Source | str | Path,
    *,
    config: Config | None = None,
    seed: int = 0,
    scale_mode: ScaleMode = "auto",
    on_frameset: OnFrameset | None = None,
) -> Calibration:
    """Calibrate the relative poses of a rig's stereo pairs from a recording of its motion (section 4).

    Every pair tracks by itself; neither the poses of the pairs in the rig file nor an overlap of their views matter.
    Pairs must have one clock but need not be triggered together.

    Args:
        source: a recording, or its folder.
        config: configuration of the front-ends.
        seed: seed of all random choices.
        scale_mode: whether to estimate ratios of the lengths that pairs measure, see `calibrate_pair`.
        on_frameset: called after each frameset; may end the recording.

    Returns:
        The poses of all pairs with their covariance, the comparison with the rig file, and what they are based on.

    Raises:
        CalibrationError: if the rig has one pair only, or the recording does not determine the poses of the pairs.
        SourceError: if the recording cannot be read.
        RigError: if the rig has no usable calibration of each pair's own cameras.
    """
    opened = open_source(source) if isinstance(source, str | Path) else source
    rig = opened.rig
    if len(rig.pairs) < 2:
        raise CalibrationError(f"{rig.name} has one stereo pair; there is no other to calibrate it against")
    framesets, motions, stamps_ns, gyro = _track(opened, SeparateMotions(rig, config or Config()), on_frameset)
    names = tuple(pair.name for pair in rig.pairs)
    most = max(measured.count for measured in motions)
    for name, measured in zip(names, motions, strict=True):
        if measured.count <= _MIN_MEASURED * most:
            raise CalibrationError(
                f"{name} measured motion in {measured.count} of {framesets} framesets: does it see texture, are its "
                "left and right images in this order and not another pair's, and is its own calibration right?"
            )
    segments = segments_of_motions(motions)

    def calibrate(one: int, other: int, mode: ScaleMode) -> PairCalibration:
        return calibrate_pair(segments.of_both(one, other), seed, scale_mode=mode)

    found, missing = pairwise(names, calibrate, scale_mode)
    extrinsics = place_all(found, names, segments)
    imu, unchecked = _imu(rig, segments, stamps_ns, gyro)
    made = Calibration(names, extrinsics, rig, imu)
    return replace(made, warnings=(*extrinsics.warnings, *missing, *rig_warnings(made), *unchecked))


def calibrate_trajectories(
    trajectories: Sequence[Trajectory],
    names: Sequence[str] | None = None,
    *,
    same_clock: bool = False,
    seed: int = 0,
    scale_mode: ScaleMode = "auto",
) -> Calibration:
    """Calibrate the relative poses of cameras from their trajectories by any odometry (section 4).

    Args:
        trajectories: J trajectories ``world_T_camera``, each in a world frame and on a clock of its own.
        names: names of the J cameras.
        same_clock: whether all stamps are of one clock; else offsets and drifts are estimated.
        seed: seed of all random choices.
        scale_mode: whether to estimate ratios of the lengths that odometries measure, see `calibrate_pair`.

    Returns:
        The poses of all cameras with their covariance, and what they are based on.

    Raises:
        CalibrationError: if there are fewer than two, their clocks cannot be related, or the motions do not determine
            the poses of the cameras.
    """
    if len(trajectories) < 2:
        raise CalibrationError(f"{len(trajectories)} trajectories; calibration takes two or more")
    if names is None:
        names = [f"camera {j}" for j in range(len(trajectories))]
    for i, j in combinations(range(len(trajectories)), 2):
        if np.array_equal(trajectories[i].nav_T_body, trajectories[j].nav_T_body):
            raise CalibrationError(f"{names[i]} and {names[j]} are the same trajectory; give one of each camera")
    if len(set(names)) != len(trajectories):
        raise CalibrationError(f"{len(trajectories)} trajectories want as many different names, not {', '.join(names)}")
    two: dict[tuple[int, int], TwoTrajectories] = {}

    def calibrate(one: int, other: int, mode: ScaleMode) -> PairCalibration:
        if (one, other) not in two:
            two[one, other] = aligned(trajectories[one], trajectories[other], same_clock, seed)
        both = two[one, other]
        return calibrate_pair(
            both.segments, seed, nuisances=both.nuisances, scale_mode=mode, systematic_pose_covariance=_NO_ERROR
        )

    found, missing = pairwise(names, calibrate, scale_mode)
    extrinsics = place_all(found, names, of_all(trajectories, {each: two[each] for each in found}), _NO_ERROR)
    clocks = (
        None
        if same_clock
        else {each: Clock(two[each].clock, *result.nuisance_sigmas[:2].tolist()) for each, result in found.items()}
    )
    drifts = [
        f"the clocks of {names[i]} and {names[j]} drift apart by {1e6 * clock.relation.drift:.0f} (+- "
        f"{1e6 * clock.drift_sigma:.0f}) microseconds per second; it is corrected here"
        for (i, j), clock in (clocks or {}).items()
        if clock.drifts
    ]
    return Calibration(tuple(names), extrinsics, clocks=clocks, warnings=(*extrinsics.warnings, *missing, *drifts))


def _track(
    source: Source, separate: SeparateMotions, on_frameset: OnFrameset | None
) -> tuple[int, list[CameraMotions], Int, Float]:
    """Track every pair by itself through a recording, until ``on_frameset`` ends it, and collect the gyro's samples.

    Returns the number of framesets, the motions of each pair, and stamps (N,) and angular rates (N, 3), rad/s, of body.
    """
    stamps_ns: list[int] = []
    gyro: list[Float] = []
    framesets = 0
    try:
        for measurement in source:
            if isinstance(measurement, ImuSample):
                stamps_ns.append(measurement.stamp_ns)
                gyro.append(measurement.angular_velocity)
            elif isinstance(measurement, FrameSet):
                separate.add(measurement)
                framesets += 1
                if on_frameset is not None and on_frameset(framesets, separate):
                    break
    finally:
        separate.close()
    return framesets, separate.motions(), np.array(stamps_ns, dtype=np.int64), np.array(gyro).reshape(-1, 3)


def segments_of_motions(motions: Sequence[CameraMotions]) -> Segments:
    """List segments of all cameras between the instants of the first."""
    return all_segments(motions[0].stamps_ns.tolist(), [each.between for each in motions])


def _imu(rig: Rig, segments: Segments, stamps_ns: Int, gyro: Float) -> tuple[dict[int, ImuAlignment], list[str]]:
    """Align all left cameras with the IMU; return the alignments, and the reasons why some could not be found."""
    if rig.imu is None or not len(stamps_ns):
        return {}, []
    found, missing = {}, []
    for j, pair in enumerate(rig.pairs):
        try:
            found[j] = align(segments, j, stamps_ns, gyro, rig.imu, pair.left.body_T_cam[:3, :3])
        except CalibrationError as error:
            missing.append(f"{pair.name}: {error}")
    return found, missing
