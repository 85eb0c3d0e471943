"""The files of an optimisation's report: ``report.html`` and ``summary.json``."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import OptimizationError, writing
from graphvio.optimization.loops.closures import Place
from graphvio.optimization.optimize import JudgedLoop, Optimization
from graphvio.optimization.report import figures
from graphvio.optimization.report.calibration import SessionCalibration
from graphvio.optimization.report.numbers import Numbers, SessionNumbers, median_sigmas, numbers_of
from graphvio.optimization.report.page import page, size_of
from graphvio.optimization.solver import Residuals
from graphvio.reporting.figures import png
from graphvio.reporting.files import replace_file
from graphvio.trajectory import Trajectory

PAGE, SUMMARY, PLAN = "report.html", "summary.json", "plan.png"
VERSION = 1
_MAX_MAPS = 6


def write_report(found: Optimization, folder: Path, truths: Sequence[Trajectory | None]) -> None:
    """Write all numbers as JSON, and the page with its figures; each file is whole or absent.

    Args:
        found: the optimisation.
        folder: the folder to write to, made if missing; the odometry's results may be in ``NAME/odometry``.
        truths: true trajectory of each session, poses of body in any frame; or None.

    Raises:
        OptimizationError: if the number of truths is not that of the sessions, or the folder cannot be written.
    """
    numbers = numbers_of(found, truths, folder)
    summary = json.dumps(_summary(found, numbers), indent=2, allow_nan=False) + "\n"
    maps = {frame: png(figures.plot_map(found, numbers, frame)) for frame in _largest_frames(numbers)}
    pictures = {
        "residuals": png(figures.plot_residuals(numbers)),
        "moved": png(figures.plot_moved(found, numbers)),
        "sigmas": png(figures.plot_sigmas(found, numbers)),
    }
    with writing(folder, OptimizationError, "choose another place"):
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(folder / SUMMARY, summary)
        replace_file(folder / PAGE, page(found, numbers, maps, pictures))


def write_plan(found: Optimization, folder: Path, points: Float | None) -> None:
    """Write a picture from above of the frame with most framesets, with the points (N, 3) of its map unless None.

    Raises:
        OptimizationError: if the folder cannot be written.
    """
    numbers = numbers_of(found, [None] * len(found.sessions), folder)
    plan = png(figures.plot_plan(found, numbers, _largest_frames(numbers)[0], points))
    with writing(folder, OptimizationError, "choose another place"):
        replace_file(folder / PLAN, plan)


def _largest_frames(numbers: Numbers) -> list[int]:
    """Return the frames with most framesets, `_MAX_MAPS` at most, in order of their numbers."""
    framesets = [0] * numbers.frames
    for part in numbers.parts:
        framesets[part.frame] += part.framesets
    return sorted(sorted(range(numbers.frames), key=lambda frame: -framesets[frame])[:_MAX_MAPS])


def _summary(found: Optimization, numbers: Numbers) -> dict[str, Any]:
    """Return all numbers: metres, degrees and seconds unless a name says otherwise; null where unknown."""
    fell = 1.0 - found.cost_after / found.cost_before if found.cost_before > 1e-6 else None
    return {
        "graphvio_optimization": VERSION,
        "sessions": [_session(each) for each in numbers.sessions],
        "frames": numbers.frames,
        "parts": [asdict(part) for part in numbers.parts],
        "cost": {
            "before": found.cost_before,
            "after": found.cost_after,
            "fell_percent": None if fell is None else 100.0 * fell,
        },
        "calibrations": [None if each is None else _calibration(each) for each in numbers.calibrations],
        "residuals": {
            kind.name: {"before": _residuals(kind.before), "after": _residuals(kind.after)} for kind in numbers.kinds
        },
        "dimensions": numbers.dimensions,
        "unknowns": numbers.unknowns,
        "per_dimension": numbers.per_dimension,
        "expected_per_dimension": numbers.expected_per_dimension,
        "loops": {
            "found": len(found.loops),
            "used": numbers.used,
            "refused": numbers.refused,
            "error_of_used": {stage: asdict(spread) for stage, spread in numbers.loop_errors.items()},
            "all": [_loop(found, loop) for loop in found.loops],
        },
    }


def _session(each: SessionNumbers) -> dict[str, Any]:
    return {
        "name": each.name,
        "framesets": each.framesets,
        "completion": each.completion,
        "states": each.states,
        "duration_s": each.duration_s,
        "length_m": each.length_m,
        "ate_rmse": each.accuracy and {stage: asdict(value) for stage, value in each.accuracy.items()},
        "no_ate": each.no_accuracy,
        "calibration": list(each.calibration),
        "moved": {
            "rms_m": _rms(each.moved_m),
            "max_m": float(each.moved_m.max()),
            "rms_deg": _rms(each.moved_deg),
            "max_deg": float(each.moved_deg.max()),
        },
        "sigma": {
            "median_m": float(np.median(each.sigma_m)),
            "max_m": float(each.sigma_m.max()),
            "median_deg": float(np.median(each.sigma_deg)),
            "max_deg": float(each.sigma_deg.max()),
        },
    }


def _calibration(each: SessionCalibration) -> dict[str, Any]:
    return {
        "session": each.session,
        "borne_out": each.is_consistent,
        "pairs": [
            {
                "pair": pair.pair,
                "name": pair.name or None,
                "held": pair.is_held,
                "of": pair.of,
                "angle_deg": pair.angle_deg,
                "angle_sigma_deg": pair.angle_sigma_deg,
                "angle_sigmas": pair.angle_sigmas,
                "distance_m": pair.distance_m,
                "distance_sigma_m": pair.distance_sigma_m,
                "distance_sigmas": pair.distance_sigmas,
                "squared_distance": pair.squared_distance,
                "borne_out": pair.is_consistent,
            }
            for pair in each.pairs
        ],
        "time_offset": each.offset
        and {
            "correction_s": each.offset.offset_s,
            "sigma_s": each.offset.sigma_s,
            "sigmas": each.offset.sigmas,
            "borne_out": each.offset.is_consistent,
        },
    }


def _residuals(residuals: Residuals) -> dict[str, Any]:
    return {
        "factors": len(residuals.distances),
        "dimensions": residuals.dimensions,
        "per_dimension": residuals.per_dimension if residuals.dimensions else None,
        "median_sigmas": median_sigmas(residuals),
    }


def _loop(found: Optimization, loop: JudgedLoop) -> dict[str, Any]:
    closure = loop.closure
    metres, degrees = size_of(closure.reference_T_current)

    def place(which: Place) -> dict[str, Any]:
        record = found.sessions[which.session].record
        return {
            "session": record.name,
            "stamp_ns": int(which.stamp_ns),
            "since_start_s": float(which.stamp_ns - record.stamps_ns[0]) * 1e-9,
        }

    return {
        "reference": place(closure.reference),
        "current": place(closure.current),
        "pairs": [list(pairs) for pairs in closure.pairs],
        "points": int(closure.inliers),
        "registered": bool(closure.is_registered),
        "distance_m": metres,
        "angle_deg": degrees,
        "squared_distance": loop.distance if math.isfinite(loop.distance) else None,
        "refusal": loop.refusal,
    }


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))
