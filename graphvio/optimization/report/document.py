"""All numbers of an optimisation as JSON can hold them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.optimization.optimize import JudgedLoop, Optimization
from graphvio.optimization.report.calibration import SessionCalibration
from graphvio.optimization.report.numbers import Kind, Numbers, SessionNumbers, median_sigmas
from graphvio.optimization.solver import Residuals

VERSION = 1


def document(found: Optimization, numbers: Numbers) -> dict[str, Any]:
    """All numbers. Metres, degrees, seconds; nanoseconds where a name says so; squared Mahalanobis distances have no
    unit. What is unknown is null."""
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
        "calibrations": [_calibration(each) for each in numbers.calibrations],
        "residuals": {kind.name: _kind(kind) for kind in numbers.kinds},
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


def size_of(transform: Float) -> tuple[float, float]:
    """Metres and degrees of a relative pose (4, 4)."""
    chord = float(np.linalg.norm(transform[:3, :3] - np.eye(3)))
    angle = 2.0 * math.asin(min(chord / math.sqrt(8.0), 1.0))
    return float(np.linalg.norm(transform[:3, 3])), math.degrees(angle)


def _session(each: SessionNumbers) -> dict[str, Any]:
    accuracy: Mapping[str, Any] | None = None
    if each.accuracy is not None:
        accuracy = {stage: asdict(value) for stage, value in each.accuracy.items()}
    return {
        "name": each.name,
        "framesets": each.framesets,
        "completion": each.completion,
        "states": each.states,
        "duration_s": each.duration_s,
        "length_m": each.length_m,
        "ate_rmse": accuracy,
        "no_ate": each.no_accuracy,
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


def _calibration(each: SessionCalibration | None) -> dict[str, Any] | None:
    if each is None:
        return None
    offset = each.offset
    return {
        "session": each.session,
        "borne_out": each.is_borne_out,
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
                "borne_out": pair.is_borne_out,
            }
            for pair in each.pairs
        ],
        "time_offset": None
        if offset is None
        else {
            "correction_s": offset.offset_s,
            "sigma_s": offset.sigma_s,
            "sigmas": offset.sigmas,
            "borne_out": offset.is_borne_out,
        },
    }


def _kind(kind: Kind) -> dict[str, Any]:
    def told(residuals: Residuals) -> dict[str, Any]:
        return {
            "factors": len(residuals.distances),
            "dimensions": residuals.dimensions,
            "per_dimension": residuals.per_dimension if residuals.dimensions else None,
            "median_sigmas": median_sigmas(residuals),
        }

    return {"before": told(kind.before), "after": told(kind.after)}


def _loop(found: Optimization, loop: JudgedLoop) -> dict[str, Any]:
    closure = loop.closure
    metres, degrees = size_of(closure.reference_T_current)

    def place(which: Any) -> dict[str, Any]:
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
