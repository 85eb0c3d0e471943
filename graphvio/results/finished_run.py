"""What a run hands over to its results at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from graphvio.arrays import Float
from graphvio.rig import Rig


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedRun:
    """What is known of a run at its end only, beside what its `ResultWriter` got frameset by frameset.

    Attributes:
        wall_s: processing time of the whole run, seconds.
        frameset_ms: time per frameset, without decoding, milliseconds.
        smoothed: stamps, nanoseconds, and poses ``nav_T_body`` (4, 4), as they left the smoother's window.
        input_faults: kind -> count.
        framesets: number of framesets read.
        awaited: number of framesets that could have had a pose: those since the IMU's first sample.
        resets: number of times that the estimator was reinitialised.
        warnings: what to correct before the next run, a sentence each.
        calibration: sentences on what the self-calibration found.
        refined_rig: the rig as calibrated at the end, written to ``rig-refined.yaml``, or None.
    """

    wall_s: float
    frameset_ms: Sequence[float]
    smoothed: Sequence[tuple[int, Float]]
    input_faults: Mapping[str, int]
    framesets: int
    awaited: int
    resets: int
    warnings: Sequence[str] = ()
    calibration: Sequence[str] = ()
    refined_rig: Rig | None = None
