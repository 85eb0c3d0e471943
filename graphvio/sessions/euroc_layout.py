"""Rows, texts and images of the EuRoC/ASL layout, as the simulator and ``graphvio convert`` write them."""

from __future__ import annotations

import errno
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from graphvio.arrays import Float, Image
from graphvio.rig import Camera, Imu
from graphvio.rig_files import kalibr

IMU_FOLDER, TRUTH_FOLDER = "imu0", "state_groundtruth_estimate0"
MASKS_FOLDER = "masks"
"""Folder beside a camera's ``data`` with masks of its images, ``STAMP.png``."""
FRAME_HEADER = "#timestamp [ns],filename"
IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
POSE_HEADER = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
STATE_HEADER = (
    f"{POSE_HEADER}, "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)

_PNG_OPTIONS = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # more effort hardly compresses noise any better


def write_image(path: Path, image: Image) -> None:
    """Write an image as PNG."""
    is_encoded, png = cv2.imencode(".png", image, _PNG_OPTIONS)
    if not is_encoded:
        raise OSError(errno.EINVAL, "the image cannot be encoded", str(path))
    path.write_bytes(png.tobytes())


def frame_row(stamp_ns: int) -> str:
    """Return a row of a camera's ``data.csv``."""
    return f"{stamp_ns},{stamp_ns}.png"


def rounded_row(stamp_ns: int, values: Iterable[float]) -> str:
    """Return a row of a table whose values have twelve significant digits."""
    return f"{stamp_ns}," + ",".join(f"{value:.12g}" for value in values)


def exact_row(stamp_ns: int, values: Iterable[float]) -> str:
    """Return a row of a table whose values can be read back exactly."""
    return f"{stamp_ns}," + ",".join(repr(float(value)) for value in values)


def camera_yaml(camera: Camera, rate_hz: float, comment: str) -> str:
    """Return a camera's ``sensor.yaml``."""
    lens = kalibr.written_lens(camera)
    shutter = f"{kalibr.LINE_DELAY_KEY}: {1e-6 * camera.line_time_us:.12g}\n" if camera.line_time_us else ""
    return (
        f"sensor_type: camera\ncomment: {comment}\n{_matrix_yaml(camera.body_T_cam)}"
        f"rate_hz: {rate_hz:g}\nresolution: [{camera.size_px[0]}, {camera.size_px[1]}]\n"
        f"camera_model: {lens.camera_model}\n"
        f"intrinsics: [{', '.join(f'{value:.12g}' for value in lens.intrinsics)}]\n"
        f"distortion_model: {lens.distortion_model}\n"
        f"distortion_coefficients: [{', '.join(f'{value:.12g}' for value in lens.coefficients)}]\n"
        f"{shutter}"
    )


def imu_yaml(imu: Imu, comment: str) -> str:
    """Return the IMU's ``sensor.yaml``."""
    return (
        f"sensor_type: imu\ncomment: {comment}\n{_matrix_yaml(np.eye(4))}rate_hz: {imu.rate_hz:g}\n"
        f"gyroscope_noise_density: {imu.gyro_noise_density:.12g}\n"
        f"gyroscope_random_walk: {imu.gyro_random_walk:.12g}\n"
        f"accelerometer_noise_density: {imu.accel_noise_density:.12g}\n"
        f"accelerometer_random_walk: {imu.accel_random_walk:.12g}\n"
    )


def truth_yaml(comment: str) -> str:
    """Return the ``sensor.yaml`` of the true trajectory, whose poses are those of body."""
    return f"sensor_type: visual-inertial\ncomment: {comment}\n{_matrix_yaml(np.eye(4))}"


def _matrix_yaml(body_T_sensor: Float) -> str:
    rows = ",\n         ".join(", ".join(f"{value:.15g}" for value in row) for row in body_T_sensor)
    return f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n"
