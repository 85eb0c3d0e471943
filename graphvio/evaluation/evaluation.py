"""Errors of estimated trajectories against the truth.

Definitions:

- *Association*: truth is interpolated to the estimate's stamps (linearly, slerp) between true poses at most
  ``max_gap_s`` apart; other estimates are left out and counted.
- *ATE*: distance between positions, and angle between rotations, after SE(3) alignment of all associated
  positions (Umeyama's least squares without scale).
- *Scale error*: by how much the estimate's lengths are too long, from the scale of Umeyama's Sim(3) alignment. The ATE
  after that alignment is the part of the error that neither a wrong baseline nor an unknown scale explains.
- *RPE* over 1 s, or over a distance along the truth: error of the motion from each pose to the later pose that is
  nearest to that distance (within a tenth of it). Over 100 to 800 m these are KITTI's segments.
- *Drift*: position error of the last pose with the start aligned by position and rotation (the first 5 % of the path
  and at least 2 s), in percent of the path. ``ate_percent`` is ATE rmse in percent of the path.
- *Loop-closure error*, where the truth is at least 4 m long and ends within 1 m of its start: estimated minus true
  displacement from start to end.

Path lengths are those of the associated truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.errors import TrajectoryError
from graphvio.evaluation.measures import (
    RelativeError,
    Stats,
    align,
    align_scale,
    align_with_rotations,
    angle_between,
    relative_errors,
)
from graphvio.trajectory import Trajectory

MAX_GAP_S = 0.25
_START_SHARE = 0.05
_START_S = 2.0
_MAX_LOOP_GAP_M = 1.0
_MIN_LOOP_PATH_M = 4.0
_MIN_PATH_M = 0.1
_MIN_POSES = 3
_NS_PER_S = 1e9


@dataclass(frozen=True)
class LoopClosureError:
    """Error of the displacement from the start to the end, in metres and in percent of the path."""

    error_m: float
    error_percent: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Errors of an estimate against the truth; the module's docstring defines each figure."""

    associated: int  # number of estimates that have a true pose
    estimates: int  # number of all estimates
    duration_s: float  # from the first to the last associated stamp
    path_length_m: float  # path length of the truth in between
    ate_position_m: Stats  # ATE of the position, metres
    ate_rotation_deg: Stats  # ATE of the rotation, degrees
    ate_percent: float | None  # ATE rmse in percent of the path; None for paths under 0.1 m
    scale_error_percent: float | None  # scale error, positive if lengths are too long; None for paths under 0.1 m
    ate_scaled_m: float | None  # ATE rmse of position after alignment with scale; None for paths under 0.1 m
    drift_m: float  # position error at the end with the start aligned
    drift_percent: float | None  # the same in percent of the path; None for paths under 0.1 m
    loop_closure: LoopClosureError | None  # None where the truth does not return to its start
    rpe: Mapping[str, RelativeError]  # ``1 s``, ``1 m``, ``5 m``... -> error, for distances within the path's length
    kitti_percent: float | None  # mean position error over all segments of 100 to 800 m, or None if there are none
    kitti_deg_per_m: float | None  # mean rotation error over the same segments, or None
    truth_T_nav: Float  # (4, 4) alignment of the ATE
    stamps_ns: Int  # (associated,) stamps of the associated estimates
    position_error_m: Float  # (associated,) position error after alignment
    rotation_error_deg: Float  # (associated,) rotation error after alignment
    aligned: Trajectory  # associated estimates in the truth's frame
    truth: Trajectory  # truth at the same stamps

    def as_dict(self) -> dict[str, Any]:
        """Convert all figures, without the series over time, to JSON values."""
        figures = {name: value for name, value in vars(self).items() if name not in _SERIES}
        figures["ate_position_m"] = asdict(self.ate_position_m)
        figures["ate_rotation_deg"] = asdict(self.ate_rotation_deg)
        figures["loop_closure"] = asdict(self.loop_closure) if self.loop_closure else None
        figures["rpe"] = {name: asdict(error) for name, error in self.rpe.items()}
        figures["truth_T_nav"] = self.truth_T_nav.tolist()
        return figures


_SERIES = ("stamps_ns", "position_error_m", "rotation_error_deg", "aligned", "truth")


def evaluate(estimate: Trajectory, truth: Trajectory, max_gap_s: float = MAX_GAP_S) -> Evaluation:
    """Evaluate an estimate against the truth.

    Args:
        estimate: poses of body in nav. All epochs are aligned as one, so that a break counts as an error.
        truth: true poses of body in any fixed frame, on the same clock.
        max_gap_s: longest interval of the truth that is bridged by interpolation, seconds.

    Raises:
        TrajectoryError: if fewer than 3 estimates have a true pose.
    """
    at_estimates, known = truth.at(estimate.stamps_ns, max_gap_s)
    if len(at_estimates) < _MIN_POSES:
        raise TrajectoryError(_why_not_associated(estimate, truth, len(at_estimates), max_gap_s))
    used = estimate.select(known)
    truth_T_nav = align(used, at_estimates)
    aligned = used.transformed(truth_T_nav)
    position_m = np.linalg.norm(aligned.positions - at_estimates.positions, axis=1)
    rotation_deg = np.rad2deg(angle_between(at_estimates.rotations, aligned.rotations))
    path_m = float(at_estimates.distances[-1])
    drift_m = _drift(used, at_estimates)
    rpe, kitti = relative_errors(used, at_estimates)
    scaled = align_scale(aligned.positions, at_estimates.positions) if path_m >= _MIN_PATH_M else (None, None)
    return Evaluation(
        associated=len(used),
        estimates=len(estimate),
        duration_s=used.duration_s,
        path_length_m=path_m,
        ate_position_m=(ate := Stats.of(position_m)),
        ate_rotation_deg=Stats.of(rotation_deg),
        ate_percent=_percent(ate.rmse, path_m),
        scale_error_percent=scaled[0],
        ate_scaled_m=scaled[1],
        drift_m=drift_m,
        drift_percent=_percent(drift_m, path_m),
        loop_closure=_loop_closure(aligned, at_estimates, path_m),
        rpe=rpe,
        kitti_percent=float(kitti[:, 0].mean()) if len(kitti) else None,
        kitti_deg_per_m=float(kitti[:, 1].mean()) if len(kitti) else None,
        truth_T_nav=truth_T_nav,
        stamps_ns=used.stamps_ns,
        position_error_m=position_m,
        rotation_error_deg=rotation_deg,
        aligned=aligned,
        truth=at_estimates,
    )


@dataclass(frozen=True)
class Compared:
    """One of several results that are compared."""

    name: str  # name of the result
    evaluation: Evaluation | None  # evaluation against the truth, or None if it failed
    why_not: str  # reason of the failure, or empty
    ate_ratio: float | None  # ATE rmse of position relative to the first result that could be evaluated

    @property
    def ate_m(self) -> float:
        """ATE rmse of position, metres; infinite where there is none."""
        return np.inf if self.evaluation is None else self.evaluation.ate_position_m.rmse


def compare(names: Sequence[str], results: Sequence[Trajectory], truth: Trajectory) -> list[Compared]:
    """Evaluate several results against the same truth by `evaluate`; one that fails does not affect the others."""
    compared: list[Compared] = []
    for name, result in zip(names, results, strict=True):
        try:
            evaluation = evaluate(result, truth)
        except TrajectoryError as error:
            compared.append(Compared(name, None, str(error), None))
            continue
        first = next((each.ate_m for each in compared if each.evaluation is not None), evaluation.ate_position_m.rmse)
        ratio = evaluation.ate_position_m.rmse / first if first > 0.0 else None
        compared.append(Compared(name, evaluation, "", ratio))
    return compared


def _percent(error_m: float, path_m: float) -> float | None:
    return 100.0 * error_m / path_m if path_m >= _MIN_PATH_M else None


def _drift(estimate: Trajectory, truth: Trajectory) -> float:
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) / _NS_PER_S
    distances = truth.distances
    start = (distances <= _START_SHARE * distances[-1]) | (seconds <= _START_S)
    truth_T_nav = align_with_rotations(estimate.select(start), truth.select(start))
    end = truth_T_nav[:3, :3] @ estimate.positions[-1] + truth_T_nav[:3, 3]
    return float(np.linalg.norm(end - truth.positions[-1]))


def _loop_closure(aligned: Trajectory, truth: Trajectory, path_m: float) -> LoopClosureError | None:
    true_displacement = truth.positions[-1] - truth.positions[0]
    if np.linalg.norm(true_displacement) > _MAX_LOOP_GAP_M or path_m < _MIN_LOOP_PATH_M:
        return None
    error_m = float(np.linalg.norm(aligned.positions[-1] - aligned.positions[0] - true_displacement))
    return LoopClosureError(error_m, 100.0 * error_m / path_m)


def _why_not_associated(estimate: Trajectory, truth: Trajectory, associated: int, max_gap_s: float) -> str:
    def interval(trajectory: Trajectory) -> str:
        if not len(trajectory):
            return "no pose"
        first, last = trajectory.stamps_ns[0] / _NS_PER_S, trajectory.stamps_ns[-1] / _NS_PER_S
        return f"{first:.3f} to {last:.3f} s"

    if len(estimate) < _MIN_POSES:
        return f"the estimate has {len(estimate)} poses; at least {_MIN_POSES} are needed for an alignment"
    return (
        f"only {associated} of {len(estimate)} estimates ({interval(estimate)}) have a true pose ({interval(truth)}, "
        f"at most {max_gap_s:g} s apart); at least {_MIN_POSES} are needed: are both of one recording, by one clock?"
    )
