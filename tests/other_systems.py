"""Configurations of OpenVINS, VINS-Fusion and ORB-SLAM3 for a rig."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from graphvio.rig import Rig

NOISE = {
    "gyroscope_noise_density": 1.6e-4,
    "gyroscope_random_walk": 2.2e-5,
    "accelerometer_noise_density": 2.8e-3,
    "accelerometer_random_walk": 8.6e-4,
    "update_rate": 200.0,
}


def write_openvins(folder: Path, rig: Rig, imu: dict[str, Any]) -> Path:
    """Three files of a configuration."""
    chain = {
        f"cam{i}": {
            "T_imu_cam": camera.body_T_cam.tolist(),
            "camera_model": "pinhole",
            "distortion_coeffs": camera.distortion[:4].tolist(),
            "distortion_model": "radtan",
            "intrinsics": camera.intrinsics.tolist(),
            "resolution": list(camera.size_px),
            "timeshift_cam_imu": 0.004,
        }
        for i, camera in enumerate(rig.cameras)
    }
    header = "%YAML:1.0\n\n"
    (folder / "kalibr_imucam_chain.yaml").write_text(header + yaml.safe_dump(chain))
    (folder / "kalibr_imu_chain.yaml").write_text(header + yaml.safe_dump({"imu0": {**NOISE, **imu}}))
    names = {"relative_config_imu": "kalibr_imu_chain.yaml", "relative_config_imucam": "kalibr_imucam_chain.yaml"}
    (folder / "estimator_config.yaml").write_text(header + yaml.safe_dump({"verbosity": "INFO", **names}))
    return folder / "estimator_config.yaml"


def write_opencv(path: Path, values: dict[str, Any]) -> Path:
    """Values and matrices as OpenCV writes them."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        if isinstance(value, dict):
            storage.startWriteStruct(key, cv2.FileNode_MAP)
            for name, each in value.items():
                storage.write(name, each)
            storage.endWriteStruct()
        else:
            storage.write(key, value)
    storage.release()
    return path


VINS_LENSES: dict[str, Callable[[np.ndarray, np.ndarray], dict[str, Any]]] = {
    "radial-tangential": lambda f, d: {
        "model_type": "PINHOLE",
        "distortion_parameters": dict(zip(("k1", "k2", "p1", "p2"), d, strict=False)),
        "projection_parameters": dict(zip(("fx", "fy", "cx", "cy"), f, strict=True)),
    },
    "rational": lambda f, d: {
        "model_type": "PINHOLE_FULL",
        "distortion_parameters": dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), d, strict=True)),
        "projection_parameters": dict(zip(("fx", "fy", "cx", "cy"), f, strict=True)),
    },
    "equidistant": lambda f, d: {
        "model_type": "KANNALA_BRANDT",
        "projection_parameters": dict(zip(("k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0"), [*d[:4], *f], strict=True)),
    },
    "omnidirectional": lambda f, d: {
        "model_type": "MEI",
        "mirror_parameters": {"xi": d[0]},
        "distortion_parameters": dict(zip(("k1", "k2", "p1", "p2"), d[1:5], strict=True)),
        "projection_parameters": dict(zip(("gamma1", "gamma2", "u0", "v0"), f, strict=True)),
    },
}


def write_vins_fusion(folder: Path, rig: Rig, change: dict[str, Any] | None = None) -> Path:
    """A configuration and the files of its lenses, after a change of the configuration."""
    config: dict[str, Any] = {"imu": int(rig.imu is not None), "num_of_cam": len(rig.cameras), "max_cnt": 150}
    for i, camera in enumerate(rig.cameras):
        lens = VINS_LENSES[camera.model](camera.intrinsics, camera.distortion)
        width, height = camera.size_px
        write_opencv(folder / f"lens{i}.yaml", {**lens, "image_width": width, "image_height": height})
        config[f"cam{i}_calib"] = f"lens{i}.yaml"
        config[f"body_T_cam{i}"] = camera.body_T_cam
    config |= {"gyr_n": 0.01, "gyr_w": 1e-5, "acc_n": 0.1, "acc_w": 0.1, "td": -0.0125}
    return write_opencv(folder / "stereo_imu_config.yaml", config | (change or {}))


ORB_TYPES = {"radial-tangential": "PinHole", "equidistant": "KannalaBrandt8"}
ORB_COEFFICIENTS = {"radial-tangential": ("k1", "k2", "p1", "p2"), "equidistant": ("k1", "k2", "k3", "k4")}


def write_orb_slam3(folder: Path, rig: Rig, change: dict[str, Any] | None = None) -> Path:
    """Settings of version 1.0, after a change; None takes a key out."""
    left, right = rig.cameras
    settings: dict[str, Any] = {"File.version": "1.0", "Camera.type": ORB_TYPES[left.model]}
    for number, camera in enumerate((left, right), 1):
        names = ("fx", "fy", "cx", "cy", *ORB_COEFFICIENTS[camera.model])
        values = [*camera.intrinsics.tolist(), *camera.distortion[:4].tolist()]
        settings |= {f"Camera{number}.{name}": value for name, value in zip(names, values, strict=True)}
    settings |= {"Camera.width": left.size_px[0], "Camera.height": left.size_px[1], "Camera.fps": 20}
    settings |= {"Stereo.T_c1_c2": left.cam_T_body @ right.body_T_cam, "IMU.T_b_c1": left.body_T_cam}
    settings |= {"IMU.NoiseGyro": 1.6e-4, "IMU.GyroWalk": 2.2e-5, "IMU.NoiseAcc": 2.8e-3, "IMU.AccWalk": 8.6e-4}
    settings |= {"IMU.Frequency": 100.0} | (change or {})
    lines = ["%YAML:1.0"]
    for key, value in settings.items():
        if isinstance(value, np.ndarray):
            data = ", ".join(map(repr, value.ravel().tolist()))
            rows, columns = value.shape
            lines.append(f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: f\n   data: [{data}]")
        elif value is not None:
            lines.append(f"{key}: {value!r}")
    path = folder / "EuRoC.yaml"
    path.write_text("\n".join(lines).replace("'", '"'))
    return path
