"""The data that a run passes to its `ResultWriter` at its end, and the contents of ``summary.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.rig import Rig
from graphvio.trajectory import Trajectory, travelled


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedRun:
    """Data of a run that are known only at its end; all others are passed to `ResultWriter` frameset by frameset."""

    wall_s: float  # processing time of the whole run
    frameset_ms: Sequence[float]  # time per frameset, without decoding
    smoothed: Sequence[tuple[int, Float]]  # stamps and poses ``nav_T_body`` (4, 4), as they left the smoother's window
    input_faults: Mapping[str, int]  # kind -> count
    framesets: int  # number of framesets read
    awaited: int  # number of framesets that could have had a pose: those since the IMU's first sample
    resets: int  # number of times that the estimator was reinitialised
    warnings: Sequence[str] = ()  # sentences on what to correct before the next run
    calibration: Sequence[str] = ()  # sentences on what the self-calibration found
    refined_rig: Rig | None = None  # the rig as calibrated at the end, written to ``rig-refined.yaml``


@dataclass(frozen=True)
class Percentiles:
    """Distribution of a processing time, milliseconds."""

    median: float
    p95: float
    p99: float

    @staticmethod
    def of(values_ms: Sequence[float]) -> Percentiles | None:
        """Compute the percentiles; None if there are no values."""
        if not len(values_ms):
            return None
        return Percentiles(*(round(float(v), 4) for v in np.percentile(np.asarray(values_ms), [50.0, 95.0, 99.0])))


@dataclass(frozen=True)
class PairMedians:
    """Medians of figures over the reports of one pair; None if no report has the figure."""

    inliers: float | None  # number of points that the selected motion explains
    rms_px: float | None  # rms reprojection error of these points under that motion, pixels
    own_rms_px: float | None  # rms reprojection error of the pair's points under its own motion, pixels

    @staticmethod
    def of(figures: Mapping[str, Sequence[float]]) -> PairMedians:
        """Compute the medians from the values of each figure, by the figure's name."""
        return PairMedians(**{name: _median(values) for name, values in figures.items()})


@dataclass(frozen=True)
class Summary:
    """The contents of ``summary.json``."""

    framesets: int  # number of framesets of the recording, including those of which no image could be read
    estimated: int  # number of estimates with a pose
    completion: float  # share of the framesets since the IMU's first sample that have a pose
    duration_s: float  # from the first to the last estimate, with or without a pose
    path_length_m: float  # along the estimated positions, within epochs
    wall_s: float  # processing time of the whole run
    realtime_factor: float  # ``duration_s / wall_s``; above 1 is faster than real time
    stage_ms: Mapping[str, Percentiles | None]  # stage -> time per frameset
    frameset_ms: Percentiles | None  # time per frameset of all stages, without decoding images
    input_faults: Mapping[str, int]  # kind -> count
    resets: int  # number of times that the estimator was reinitialised
    events: Mapping[str, int]  # kind -> count, of all events in ``events.jsonl``
    warnings: Sequence[str]  # what to correct before the next run, such as a rig file that the motions contradict
    calibration: Sequence[str]  # sentences on what the self-calibration found, and what the recording did not show
    status: Mapping[str, int]  # status -> number of estimates
    pair_medians: Mapping[str, PairMedians]  # name of the pair or single camera -> its medians
    # name of the pair or single camera -> check of tracking or stereo matching -> corners and tracks that failed it
    pair_rejected: Mapping[str, Mapping[str, int]]
    # for each epoch: its number, first and last stamp in nanoseconds, and number of poses
    epochs: Sequence[Mapping[str, int]]
    # last estimate of the offset between cameras and IMU, or None where it is not estimated
    time_offset_s: float | None
    time_offset_sigma_s: float | None  # its standard deviation, or None
    graphvio_version: str  # version with which the run was made
    config_sha256: str  # SHA-256 of ``config.yaml``
    evaluation: Mapping[str, Any] | None = None  # figures of the evaluation against the truth, or None
    evaluation_error: str | None = None  # why the truth could not be used, or None


def _median(values: Sequence[float]) -> float | None:
    """Compute the median; None if there are no values or the median is not finite."""
    if not len(values):
        return None
    median = float(np.median(np.asarray(values)))
    return round(median, 4) if np.isfinite(median) else None


def path_length(trajectory: Trajectory, epochs: Int) -> float:
    """Compute the path length in metres, without the steps between epochs; ``epochs`` (N,) are those of the poses."""
    parts = (trajectory.positions[epochs == epoch] for epoch in np.unique(epochs))
    return float(sum(travelled(part)[-1] for part in parts))


def epoch_intervals(trajectory: Trajectory, epochs: Int) -> list[dict[str, int]]:
    """List number, first and last stamp (ns) and number of poses of each epoch; ``epochs`` (N,) are those of poses."""
    intervals = []
    for epoch in np.unique(epochs):
        stamps = trajectory.stamps_ns[epochs == epoch]
        intervals.append(
            {
                "epoch": int(epoch),
                "first_stamp_ns": int(stamps[0]),
                "last_stamp_ns": int(stamps[-1]),
                "poses": len(stamps),
            }
        )
    return intervals
