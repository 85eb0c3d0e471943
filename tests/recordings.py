"""Tiny recordings on disk, for tests: EuRoC/ASL, TUM-VI and KITTI layouts with images of noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from graphvio.arrays import Float
from graphvio.rig import Camera, Imu, Rig, StereoPair
from graphvio.simulation import default_rig

START_NS = 1_403_636_579_763_555_584
FRAME_PERIOD_NS = 50_000_000
IMU_PERIOD_NS = 5_000_000
SIZE_PX = (64, 48)
REAL_DATA = Path(__file__).parents[2] / "shared/data"


def small_rig(pairs: int = 2, imu: bool = True) -> Rig:
    """A rig whose pairs look forward and backward by turns, baseline 10 cm, cameras ``cam0``, ``cam1`` ..."""
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    backward = np.diag([-1.0, -1.0, 1.0]) @ forward
    made = []
    for number in range(pairs):
        body_R_cam = backward if number % 2 else forward
        cameras = []
        for side in range(2):
            body_T_cam = np.eye(4)
            body_T_cam[:3, :3] = body_R_cam
            body_T_cam[:3, 3] = body_R_cam @ [0.1 * side, 0.0, 0.05]
            cameras.append(
                Camera(
                    name=f"cam{2 * number + side}",
                    model="radial-tangential",
                    size_px=SIZE_PX,
                    intrinsics=np.array([50.0, 50.0, 31.5, 23.5]),
                    distortion=np.array([-0.01, 0.001, 0.0, 0.0]),
                    body_T_cam=body_T_cam,
                )
            )
        made.append(StereoPair(f"pair{number}", *cameras))
    return Rig(tuple(made), Imu() if imu else None, "small")


LENSES = {
    "rational": [0.3, -0.05, 3e-4, -2e-4, 0.01, 0.4, -0.03, 0.02],
    "double-sphere": [-0.2, 0.6],
    "extended-unified": [0.6, 1.1],
    "omnidirectional": [0.7, -0.1, 0.05, 3e-4, -2e-4],
}
"""Coefficients of lens models, by name, for views of about 80 degrees."""


def with_lens(rig: Rig, model: str) -> Rig:
    """The rig with lenses of another model, whose images have the same scale at their centre."""
    distortion = np.array(LENSES[model])

    def change(camera: Camera) -> Camera:
        changed = replace(camera, model=model, distortion=distortion)
        scale = changed.focal_px / camera.focal_px
        return replace(changed, intrinsics=camera.intrinsics / [scale, scale, 1.0, 1.0])

    return rig.with_cameras(change)


def scaled(camera: Camera, scale: float) -> Camera:
    """The camera with images of another size and the same view: pixel (0, 0) is the centre of one."""
    corner = np.array([0.0, 0.0, 0.5, 0.5])
    width, height = camera.size_px
    size_px = (round(scale * width), round(scale * height))
    return replace(camera, intrinsics=scale * (camera.intrinsics + corner) - corner, size_px=size_px)


def half_size(camera: Camera) -> Camera:
    """The camera with pixels of twice the side."""
    return scaled(camera, 0.5)


def half_size_rig() -> Rig:
    """The simulator's rig with images of 320x240: rendering is most of what tests wait for."""
    rig = default_rig()
    pairs = tuple(replace(pair, left=half_size(pair.left), right=half_size(pair.right)) for pair in rig.pairs)
    return replace(rig, pairs=pairs)


def frame_stamps(frames: int) -> list[int]:
    """Stamps of the frames of `write_euroc`."""
    return [START_NS + i * FRAME_PERIOD_NS for i in range(frames)]


def noise_image(seed: int, size_px: tuple[int, int] = SIZE_PX) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    """A grey image (height, width) that is the same for the same seed."""
    return np.random.default_rng(seed).integers(0, 256, (size_px[1], size_px[0]), dtype=np.uint8)


def write_image(path: Path, image: np.ndarray[tuple[int, ...], np.dtype[np.uint8 | np.uint16]]) -> None:
    """Write an image, and the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_euroc(path: Path, pairs: int = 2, frames: int = 10, imu: bool = True, rig: Rig | None = None) -> Path:
    """Write an EuRoC/ASL recording with a ``sensor.yaml`` per sensor; returns its path.

    Frames come every 50 ms from `START_NS`; the IMU, at 200 Hz and stationary, from 1 s before to 0.1 s after.
    """
    rig = rig or small_rig(pairs, imu)
    root = path / "mav0"
    stamps = frame_stamps(frames)
    for number, camera in enumerate(rig.cameras):
        folder = root / camera.name
        for i, stamp in enumerate(stamps):
            write_image(folder / "data" / f"{stamp}.png", noise_image(100 * number + i, camera.size_px))
        rows = [f"{stamp},{stamp}.png" for stamp in stamps]
        write_rows(folder / "data.csv", ["#timestamp [ns],filename", *rows])
        write_camera_yaml(folder / "sensor.yaml", camera)
    if rig.imu is not None:
        (root / "imu0").mkdir(parents=True)
        write_imu_yaml(root / "imu0" / "sensor.yaml", rig.imu)
        write_imu(root, np.arange(stamps[0] - 10**9, stamps[-1] + 10**8 + 1, IMU_PERIOD_NS).tolist())
    return path


def imu_row(stamp: int) -> str:
    """A row of ``imu0/data.csv`` of a stationary IMU."""
    return f"{stamp},0.01,-0.02,0.03,0.1,0.2,9.81"


def write_imu(root: Path, stamps: list[int]) -> None:
    """Write ``imu0/data.csv`` with these stamps."""
    write_rows(root / "imu0" / "data.csv", ["#timestamp [ns],wx,wy,wz,ax,ay,az", *map(imu_row, stamps)])


def write_rows(path: Path, rows: list[str], end: str = "\n") -> None:
    """Write lines with a chosen line end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes((end.join(rows) + end).encode())


def read_rows(path: Path) -> list[str]:
    """Lines of a csv, to change and write again."""
    return path.read_text().splitlines()


def matrix_text(matrix: Float) -> str:
    """A matrix as EuRoC's files hold it."""
    return "\n".join(
        ["T_BS:", "  cols: 4", "  rows: 4", f"  data: [{', '.join(repr(float(v)) for v in matrix.ravel())}]"]
    )


def write_camera_yaml(path: Path, camera: Camera) -> None:
    """Write a camera's ``sensor.yaml``."""
    path.write_text(
        f"""# General sensor definitions.
sensor_type: camera
{matrix_text(camera.body_T_cam)}
rate_hz: 20
resolution: [{camera.size_px[0]}, {camera.size_px[1]}]
camera_model: pinhole
intrinsics: {camera.intrinsics.tolist()} #fu, fv, cu, cv
distortion_model: {camera.model}
distortion_coefficients: {camera.distortion[:4].tolist()}
"""
    )


def write_imu_yaml(path: Path, imu: Imu, body_T_imu: Float | None = None) -> None:
    """Write an IMU's ``sensor.yaml``, with the first line that EuRoC's have."""
    path.write_text(
        f"""%YAML:1.0
sensor_type: imu
{matrix_text(np.eye(4) if body_T_imu is None else body_T_imu)}
rate_hz: {imu.rate_hz}
gyroscope_noise_density: {imu.gyro_noise_density!r}
gyroscope_random_walk: {imu.gyro_random_walk!r}
accelerometer_noise_density: {imu.accel_noise_density!r}
accelerometer_random_walk: {imu.accel_random_walk!r}
"""
    )


KITTI_P = {
    0: "7.0e+01 0 3.15e+01 0 0 7.0e+01 2.35e+01 0 0 0 1 0",
    1: "7.0e+01 0 3.15e+01 -3.5e+01 0 7.0e+01 2.35e+01 0 0 0 1 0",
    2: "7.0e+01 0 3.15e+01 4.2e+00 0 7.0e+01 2.35e+01 0 0 0 1 0.003",
    3: "7.0e+01 0 3.15e+01 -3.08e+01 0 7.0e+01 2.35e+01 0 0 0 1 0.003",
}


def write_kitti_odometry(path: Path, frames: int = 5, cameras: tuple[int, int] = (0, 1)) -> Path:
    """Write a sequence at 10 Hz, and return its path."""
    for number in cameras:
        for i in range(frames):
            write_image(path / f"image_{number}" / f"{i:06d}.png", noise_image(100 * number + i))
    write_rows(path / "times.txt", [f"{0.1 * i:e}" for i in range(frames)])
    write_rows(path / "calib.txt", [f"P{i}: {text}" for i, text in KITTI_P.items()] + ["Tr: 1 0 0 0 0 1 0 0 0 0 1 0"])
    return path


def write_kitti_raw(day: Path, frames: int = 5, cameras: tuple[int, int] = (0, 1)) -> Path:
    """Write a synchronised drive at 10 Hz below the folder of its day, and return the drive's path."""
    drive = day / f"{day.name}_drive_0001_sync"
    for number in cameras:
        folder = drive / f"image_{number:02d}"
        for i in range(frames):
            write_image(folder / "data" / f"{i:010d}.png", noise_image(100 * number + i))
        rows = [f"2011-09-26 13:02:25.{1234567 * number + 100_000_000 * i + 7:09d}" for i in range(frames)]
        write_rows(folder / "timestamps.txt", rows)
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for i, text in KITTI_P.items():
        lines += [f"S_rect_{i:02d}: 6.400000e+01 4.800000e+01", f"P_rect_{i:02d}: {text}"]
    write_rows(day / "calib_cam_to_cam.txt", lines)
    return drive
