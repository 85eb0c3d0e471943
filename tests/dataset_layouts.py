"""One small rendered recording in the layouts of public data sets."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from recordings import half_size, write_rows
from rendered import rendered_once
from test_rig_files import KALIBR_IMU, basalt_calibration, kalibr_chain

from graphvio.geometry import quat_wxyz_from_rotation
from graphvio.rig import Camera, Rig, StereoPair
from graphvio.rig_files import load_rig
from graphvio.simulation import default_rig, simulate
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

_DURATION_S = 3.0
_SEED = 5


def ideal_rig() -> Rig:
    """One pair without distortion, rows along the baseline, as KITTI's rectified images have it; 320x240."""
    pair = default_rig().pairs[0]

    def ideal(camera: Camera, name: str) -> Camera:
        small = half_size(replace(camera, model="radial-tangential", distortion=np.zeros(4)))
        return replace(small, name=name, intrinsics=half_size(pair.left).intrinsics)

    left = ideal(pair.left, "cam0")
    left_T_right = np.eye(4)
    left_T_right[0, 3] = 0.12
    right = replace(ideal(pair.right, "cam1"), body_T_cam=left.body_T_cam @ left_T_right)
    return Rig((StereoPair("pair0", left, right),), default_rig().imu, "ideal")


def rendered_walk() -> Path:
    """The recording, in the EuRoC layout: 3 s in the room at 20 Hz, no part of them at a standstill."""
    options = (_DURATION_S, _SEED, "ideal")
    return rendered_once(
        "ideal",
        lambda out: simulate("room", out, duration_s=_DURATION_S, seed=_SEED, stationary_s=0.0, rig=ideal_rig()),
        *options,
    )


def _stamps() -> list[int]:
    return sorted(int(file.stem) for file in (rendered_walk() / "mav0/cam0/data").glob("*.png"))


def _image(camera: int, stamp_ns: int) -> Path:
    return rendered_walk() / "mav0" / f"cam{camera}" / "data" / f"{stamp_ns}.png"


def true_poses() -> Trajectory:
    """True poses of the IMU."""
    return load_trajectory(rendered_walk() / "mav0/state_groundtruth_estimate0/data.csv")


def _asl(path: Path, truth: str | None = None, calibrated: bool = True) -> Path:
    """EuRoC's layout; the truth has another folder's name in other data sets."""
    source = rendered_walk() / "mav0"
    root = path / "mav0"
    root.mkdir(parents=True)
    for name in ("cam0", "cam1", "imu0"):
        (root / name).mkdir()
        for entry in source.joinpath(name).iterdir():
            if calibrated or entry.name != "sensor.yaml":
                (root / name / entry.name).symlink_to(entry)
    if truth is not None:
        write_rows(
            root / truth / "data.csv",
            ["#timestamp [ns],x,y,z,qw,qx,qy,qz"]
            + [
                ",".join(
                    [str(stamp), *(f"{v:.9f}" for v in (*pose[:3, 3], *quat_wxyz_from_rotation(pose[:3, :3].copy())))]
                )
                for stamp, pose in zip(true_poses().stamps_ns, true_poses().nav_T_body, strict=True)
            ],
        )
    return path


def write_euroc(folder: Path) -> Path:
    """``machine_hall/MH_03_medium/mav0``."""
    return _asl(folder / "machine_hall/MH_03_medium", "state_groundtruth_estimate0")


def write_tum_vi(folder: Path) -> Path:
    """``dataset-room1_512_16/mav0`` with ``mocap0``, and the calibration in ``dso``."""
    path = _asl(folder / "dataset-room1_512_16", "mocap0", calibrated=False)
    (path / "dso").mkdir()
    (path / "dso/camchain.yaml").write_text(kalibr_chain(load_rig(rendered_walk())))
    (path / "dso/imu_config.yaml").write_text(KALIBR_IMU)
    return path


def write_monado(folder: Path) -> Path:
    """``MI_valve_index/MIO_others/MIO01_hand_puncher_1/mav0`` with ``gt``; the calibration is in ``extras``."""
    device = folder / "M_monado_datasets/MI_valve_index"
    path = _asl(device / "MIO_others/MIO01_hand_puncher_1", "gt", calibrated=False)
    (device / "extras").mkdir()
    rig = load_rig(rendered_walk())
    names = ("fx", "fy", "cx", "cy")
    lenses = [
        {"camera_type": "pinhole", "intrinsics": dict(zip(names, camera.intrinsics, strict=True))}
        for camera in rig.cameras
    ]
    calibration = basalt_calibration(rig) | {
        "intrinsics": lenses,
        "cam_time_offset_ns": 0,
        "calib_accel_bias": [0.0] * 9,
        "calib_gyro_bias": [0.0] * 12,
    }
    (device / "extras/calibration.json").write_text(json.dumps({"value0": calibration}))
    return path


def write_uzh_fpv(folder: Path) -> Path:
    """``indoor_forward_3_snapdragon_with_gt`` with text files, and ``indoor_forward_calib_snapdragon`` next to it."""
    path = folder / "indoor_forward_3_snapdragon_with_gt"
    (path / "img").mkdir(parents=True)
    for camera, name in enumerate(("left_images.txt", "right_images.txt")):
        rows = ["# id timestamp image_name"]
        for number, stamp in enumerate(_stamps()):
            (path / "img" / f"image_{camera}_{number}.png").symlink_to(_image(camera, stamp))
            rows.append(f"{number} {_seconds(stamp)} img/image_{camera}_{number}.png")
        write_rows(path / name, rows)
    samples = (rendered_walk() / "mav0/imu0/data.csv").read_text().splitlines()[1:]
    rows = ["# id timestamp ang_vel_x ang_vel_y ang_vel_z lin_acc_x lin_acc_y lin_acc_z"]
    for number, sample in enumerate(samples):
        stamp_text, *values = sample.split(",")
        rows.append(" ".join([str(number), _seconds(int(stamp_text)), *values]))
    write_rows(path / "imu.txt", rows)
    rows = ["# id timestamp tx ty tz qx qy qz qw"]
    for number, line in enumerate(_tum_lines()):
        rows.append(f"{number} {line}")
    write_rows(path / "groundtruth.txt", rows)
    calibration = folder / "indoor_forward_calib_snapdragon"
    calibration.mkdir()
    (calibration / "camchain-imucam-indoor_forward_calib_snapdragon_imu.yaml").write_text(
        kalibr_chain(load_rig(rendered_walk()))
    )
    (calibration / "imu-indoor_forward_calib_snapdragon_imu.yaml").write_text(KALIBR_IMU)
    return path


def write_kitti(folder: Path) -> Path:
    """``dataset/sequences/04`` and ``dataset/poses/04.txt``, whose poses are those of the left camera."""
    path = folder / "dataset/sequences/04"
    rig = load_rig(rendered_walk())
    left, right = rig.pairs[0].left, rig.pairs[0].right
    for camera in range(2):
        (path / f"image_{camera}").mkdir(parents=True)
        for number, stamp in enumerate(_stamps()):
            (path / f"image_{camera}" / f"{number:06d}.png").symlink_to(_image(camera, stamp))
    begin = _stamps()[0]
    write_rows(path / "times.txt", [f"{1e-9 * (stamp - begin):e}" for stamp in _stamps()])
    fx, fy, cx, cy = left.intrinsics
    shift = fx * (np.linalg.inv(right.body_T_cam) @ left.body_T_cam)[0, 3]
    rows = [f"P{i}: {fx} 0 {cx} {shift if i % 2 else 0.0} 0 {fy} {cy} 0 0 0 1 0" for i in range(4)]
    write_rows(path / "calib.txt", rows)
    at_frames, known = true_poses().at(np.array(_stamps()), 0.1)
    assert known.all()
    left_T_world = np.linalg.inv(at_frames.nav_T_body[0] @ left.body_T_cam)
    poses = left_T_world @ at_frames.nav_T_body @ left.body_T_cam
    write_rows(folder / "dataset/poses/04.txt", [" ".join(f"{v:.9e}" for v in pose[:3].ravel()) for pose in poses])
    return path


def write_hilti(folder: Path, make_bag: Callable[[Path, Path], Path]) -> Path:
    """``exp04_construction_upper_level.bag`` with alphasense's topics, ``groundtruth`` at points, ``calibration``."""
    folder.mkdir(parents=True, exist_ok=True)
    path = make_bag(rendered_walk(), folder / "exp04_construction_upper_level.bag")
    points = [line for number, line in enumerate(_tum_lines()) if number % 100 == 50]
    write_rows(folder / "groundtruth/exp_04_construction_upper_level_imu.txt", points)
    (folder / "calibration").mkdir()
    (folder / "calibration/calib_3_cam0-1-camchain-imucam.yaml").write_text(kalibr_chain(load_rig(rendered_walk())))
    (folder / "calibration/imu.yaml").write_text(KALIBR_IMU)
    return path


def _tum_lines() -> list[str]:
    lines = []
    for stamp, pose in zip(true_poses().stamps_ns, true_poses().nav_T_body, strict=True):
        w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3].copy())
        lines.append(" ".join([_seconds(int(stamp)), *(f"{v:.9f}" for v in (*pose[:3, 3], x, y, z, w))]))
    return lines


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
