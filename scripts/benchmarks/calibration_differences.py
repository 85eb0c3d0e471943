"""Differences of a rig's calibration from the true one, in the parameters of the simulation's calibration errors."""

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_inverse, so3_log
from graphvio.rig import Rig


def calibration_differences(rig: Rig, true_rig: Rig) -> dict[str, Float]:
    """Return the errors of a rig's calibration, in the parameters of the simulation's calibration errors.

    Args:
        rig: rig with the calibration of a file, or an estimated one.
        true_rig: true rig with the same cameras.

    Returns:
        Name with unit, as in the simulation's `CalibrationErrorSizes` -> errors (K,) of all cameras, pairs and axes.
        Without an IMU in both rigs there is no ``time_offset_ms``, without pairs there are no stereo extrinsics, and
        without a second pair or another single camera no extrinsics between them.
    """
    cameras = list(zip(rig.cameras, true_rig.cameras, strict=True))
    ratios = np.array([camera.intrinsics[:2] / true.intrinsics[:2] for camera, true in cameras])
    of_lens = [(camera.distortion[:2], true.distortion[:2]) for camera, true in cameras]
    in_body = rig.cameras[0].body_T_cam @ true_rig.cameras[0].cam_T_body
    turns, lengths, moves = [], [], []
    for j, (pair, true) in enumerate(zip(rig.pairs, true_rig.pairs, strict=True)):
        turns.append(so3_log(true.right_T_left[:3, :3] @ pair.right_T_left[:3, :3].T))
        lengths.append(pair.baseline_m / true.baseline_m - 1.0)
        if j > 0:
            moves.append(true.left.cam_T_body @ se3_inverse(in_body) @ pair.left.body_T_cam)
    others = slice(0 if rig.pairs else 1, None)
    for single, true_single in zip(rig.singles[others], true_rig.singles[others], strict=True):
        moves.append(true_single.left.cam_T_body @ se3_inverse(in_body) @ single.left.body_T_cam)
    found = {
        "focal_percent": 100.0 * (ratios.mean(axis=1) - 1.0),
        "principal_point_px": np.concatenate([camera.intrinsics[2:] - true.intrinsics[2:] for camera, true in cameras]),
        "distortion_percent": np.concatenate([100.0 * (k - true)[true != 0] / true[true != 0] for k, true in of_lens]),
        "cameras_in_body_deg": np.rad2deg(so3_log(np.ascontiguousarray(in_body[:3, :3]))),
        "cameras_in_body_mm": 1e3 * in_body[:3, 3],
    }
    if rig.pairs:
        found |= {
            "left_right_deg": np.rad2deg(np.concatenate(turns)),
            "baseline_percent": 100.0 * np.array(lengths),
        }
    if moves:
        found["pair_transform_deg"] = np.rad2deg(
            np.concatenate([so3_log(np.ascontiguousarray(moved[:3, :3])) for moved in moves])
        )
        found["pair_transform_mm"] = 1e3 * np.concatenate([moved[:3, 3] for moved in moves])
    if rig.imu is not None and true_rig.imu is not None:
        found["time_offset_ms"] = 1e3 * np.array([rig.imu.time_offset_s - true_rig.imu.time_offset_s])
    return found
