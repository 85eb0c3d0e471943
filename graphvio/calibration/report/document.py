"""Conversion of a calibration's numbers to plain lists, in full precision, and to a YAML file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.calibration.imu_alignment import ImuAlignment
from graphvio.calibration.pair_calibration import PairCalibration
from graphvio.calibration.result import Calibration, Clock, RigComparison
from graphvio.errors import CalibrationError, writing

VERSION = 1


def document(found: Calibration) -> dict[str, Any]:
    """Convert a calibration to plain lists and dicts, as YAML and JSON hold them.

    Units are metres, radians, seconds; transforms are ``a_T_b``, 4x4 by rows; covariances have the tangent
    ``[rotation, translation]`` in the frame b.
    """
    made: dict[str, Any] = {
        "graphvio_calibration": VERSION,
        "names": list(found.names),
        "complete": found.is_complete,
        "undetermined_directions": {
            name: found.places.pairwise[0, j].observability.undetermined.tolist()
            for j, name in enumerate(found.names)
            if j
        },
        "left_T_left1": {
            name: pose.tolist() if found.is_complete else None
            for name, pose in zip(found.names, found.places.left_T_left1, strict=True)
        },
        "known": {name: _known(found, j) for j, name in enumerate(found.names) if j},
        "covariance": found.places.covariance.tolist(),
        "two_at_a_time": [_two(found, i, j) for i, j in found.places.pairwise],
        "loops": _loops(found),
        "warnings": list(found.warnings),
    }
    if found.rig is not None:
        compared = {name: found.compare_rig(j) for j, name in enumerate(found.names) if j}
        made["rig_before"] = [_rig_before(name, each) for name, each in compared.items() if each is not None]
    if found.imu:
        made["imu"] = [_imu(found.names[j], each) for j, each in found.imu.items()]
    if found.clocks:
        made["clocks"] = [_clock(found.names[i], found.names[j], each) for (i, j), each in found.clocks.items()]
    return made


def write_document(found: Calibration, path: Path) -> None:
    """Write `document` as YAML.

    Raises:
        CalibrationError: if the file cannot be written.
    """
    import yaml

    text = (
        "# Metres, radians, seconds. A transform a_T_b is the pose of b in a, by rows; covariances have the tangent\n"
    )
    text += "# [rotation, translation] in b.\n"
    text += yaml.safe_dump(document(found), sort_keys=False, width=110, default_flow_style=None)
    with writing(path, CalibrationError, "choose another place"):
        path.write_text(text, encoding="utf-8")


def _two(found: Calibration, i: int, j: int) -> dict[str, Any]:
    distances = found.places.distances
    return {
        "first": found.names[i],
        "second": found.names[j],
        **_pair(found.places.pairwise[i, j]),
        **({"squared_distance_of_all": distances[i, j]} if distances else {}),
    }


def _pair(each: PairCalibration) -> dict[str, Any]:
    return {
        "left2_T_left1": each.left2_T_left1.tolist() if each.observability.is_complete else None,
        "covariance": each.covariance.tolist(),
        "motions": len(each.pairs),
        "inliers": int(each.inlier.sum()),
        "mean_alignment_error_m": float(each.alignment_errors_m[each.inlier].mean()),
        "frame_to_frame": {
            "motions": len(each.frames),
            "inliers": int(each.frame_inlier.sum()),
            "mean_alignment_error_m": float(each.frame_errors_m.mean()) if len(each.frames) else None,
        },
        "dispersion": each.dispersion,
        "by_the_papers_method": {
            "left2_T_left1": each.paper_left2_T_left1.tolist() if each.observability.is_complete else None,
            "covariance": each.comparison.paper_covariance.tolist(),
            "chi_square": each.comparison.statistic,
            "limit": each.comparison.limit,
            "agrees": each.comparison.agrees,
        },
        "log_scale_ratio": each.scale.log_ratio,
        "log_scale_ratio_sigma": each.scale.sigma,
        "scale_estimated": each.scale_estimated,
        "bootstrap_covariance": each.resampled_covariance.tolist(),
        "halves": None
        if each.halves is None
        else {
            "own_mean_alignment_error_m": list(each.halves.own_m),
            "crossed_mean_alignment_error_m": list(each.halves.crossed_m),
            "chi_square": each.halves.statistic,
            "agree": each.halves.agree,
        },
        "translation_singular_values": each.observability.translation_singular_values.tolist(),
        "turning_rad": each.observability.turning_rad.tolist(),
        "missing": list(each.observability.missing),
    }


def _known(found: Calibration, j: int) -> dict[str, Any]:
    """Return offset and rotation of a pair as single values, None where they are not determined."""
    shown = found.pose_summary(j)

    def where_known(values: Float, known: Bool) -> list[float | None]:
        return [float(value) if is_known else None for value, is_known in zip(values, known, strict=True)]

    return {
        "offset_m": where_known(shown.offset_m, shown.offset_known),
        "offset_sigmas_m": where_known(shown.offset_sigmas_m, shown.offset_known),
        "rotation_vector_rad": where_known(shown.turn_rad, shown.turn_known),
        "rotation_vector_sigmas_rad": where_known(shown.turn_sigmas_rad, shown.turn_known),
    }


def _rig_before(name: str, rig: RigComparison) -> dict[str, Any]:
    return {
        "name": name,
        "rotation_deg": rig.angle_deg,
        "translation_m": rig.distance_m,
        "sigmas": rig.sigmas,
        "off": rig.is_off,
        "swapped": rig.is_swapped,
    }


def _loops(found: Calibration) -> list[dict[str, Any]]:
    return [
        {
            "names": [found.names[k] for k in loop.cameras],
            "rotation_rad": float(np.linalg.norm(loop.error[:3])),
            "translation_m": float(np.linalg.norm(loop.error[3:])),
            "squared_distance": loop.statistic,
        }
        for loop in found.places.loops
    ]


def _imu(name: str, each: ImuAlignment) -> dict[str, Any]:
    return {
        "name": name,
        "body_R_left": each.body_R_left.tolist(),
        "misrotation_rad": each.misrotation.tolist(),
        "misrotation_covariance": each.covariance.tolist(),
        "time_offset_s": each.time_offset_s,
        "time_offset_sigma_s": each.time_offset_sigma_s,
        "gyro_bias_rad_s": each.gyro_bias.tolist(),
    }


def _clock(first: str, second: str, clock: Clock) -> dict[str, Any]:
    return {
        "first": first,
        "second": second,
        "offset_ns": clock.relation.offset_ns,
        "at_ns": clock.relation.at_ns,
        "offset_sigma_s": clock.offset_sigma_s,
        "drift": clock.relation.drift,
        "drift_sigma": clock.drift_sigma,
    }
