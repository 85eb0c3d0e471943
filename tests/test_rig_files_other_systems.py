"""Calibrations of OpenVINS, VINS-Fusion and ORB-SLAM3, and Kalibr's models of the IMU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from recordings import LENSES, small_rig, with_lens

from graphvio.errors import RigError
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.rig import Imu, Rig
from graphvio.rig_files import find_rig, load_rig

NOISE = {
    "gyroscope_noise_density": 1.6e-4,
    "gyroscope_random_walk": 2.2e-5,
    "accelerometer_noise_density": 2.8e-3,
    "accelerometer_random_walk": 8.6e-4,
    "update_rate": 200.0,
}
M_GYRO = np.array([[1.002, 0.0, 0.0], [0.001, 0.998, 0.0], [-0.0015, 0.0005, 1.003]])
M_ACCEL = np.array([[0.997, 0.0, 0.0], [-0.002, 1.004, 0.0], [0.001, 0.002, 0.999]])
GYRO_R_IMU = se3_exp(np.array([0.004, -0.003, 0.002, 0.0, 0.0, 0.0]))[:3, :3]


def rig_with(model: str) -> Rig:
    """One pair with lenses of a model, whose coefficients all differ."""
    if model in LENSES:
        return with_lens(small_rig(1), model)
    distortion = np.array([-0.01, 0.001, 3e-4, -2e-4])
    return small_rig(1).with_cameras(lambda camera: replace(camera, model=model, distortion=distortion))


def assert_cameras(loaded: Rig, rig: Rig) -> None:
    """Cameras are the same, and so are their pairs."""
    assert [len(group.cameras) for group in loaded.groups] == [len(group.cameras) for group in rig.groups]
    for one, other in zip(loaded.cameras, rig.cameras, strict=True):
        assert (one.name, one.model, one.size_px) == (other.name, other.model, other.size_px)
        np.testing.assert_allclose(one.intrinsics, other.intrinsics, rtol=1e-12)
        np.testing.assert_allclose(one.distortion, other.distortion, rtol=1e-12)
        np.testing.assert_allclose(one.body_T_cam, other.body_T_cam, atol=1e-9)


# ------------------------------------------------------------------ OpenVINS, and Kalibr's models of the IMU


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


def test_openvins_configuration_chain_and_folder_are_one_rig(tmp_path: Path) -> None:
    rig = small_rig(2)
    config = write_openvins(tmp_path, rig, {"model": "kalibr", "Tg": np.zeros((3, 3)).tolist()})
    for loaded in (load_rig(config), load_rig(tmp_path / "kalibr_imucam_chain.yaml"), find_rig(tmp_path)):
        assert loaded is not None
        assert_cameras(loaded, rig)
        assert loaded.imu == Imu(200.0, 1.6e-4, 2.2e-5, 2.8e-3, 8.6e-4, 0.004)


@pytest.mark.parametrize(
    "matrices",
    [
        {
            "model": "scale-misalignment",
            "gyroscopes": {"M": M_GYRO.tolist(), "C_gyro_i": GYRO_R_IMU.tolist(), "A": np.zeros((3, 3)).tolist()},
            "accelerometers": {"M": M_ACCEL.tolist()},
        },
        {"Tw": M_GYRO.tolist(), "R_IMUtoGYRO": GYRO_R_IMU.tolist(), "Ta": M_ACCEL.tolist()},
    ],
    ids=["Kalibr", "OpenVINS"],
)
def test_matrices_of_the_imu_invert_what_the_sensor_does(tmp_path: Path, matrices: dict[str, Any]) -> None:
    imu = load_rig(write_openvins(tmp_path, small_rig(1), matrices)).imu
    assert imu is not None
    rate, force = np.array([0.3, -0.5, 0.7]), np.array([1.0, -2.0, 9.5])
    gyro_matrix, accel_matrix = imu.matrices
    np.testing.assert_allclose(gyro_matrix @ (M_GYRO @ GYRO_R_IMU @ rate), rate, rtol=1e-12)
    np.testing.assert_allclose(accel_matrix @ (M_ACCEL @ force), force, rtol=1e-12)


def test_matrix_of_the_imu_without_inverse_raises(tmp_path: Path) -> None:
    config = write_openvins(tmp_path, small_rig(1), {"Tw": np.zeros((3, 3)).tolist()})
    with pytest.raises(RigError, match=r"kalibr_imu_chain.yaml: imu0.Tw and .*R_IMUtoGYRO: cannot be inverted"):
        load_rig(config)


# ------------------------------------------------------------------ VINS-Fusion


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


@pytest.mark.parametrize("model", VINS_LENSES)
def test_vins_fusion_configuration_has_cameras_and_imu(tmp_path: Path, model: str) -> None:
    rig = rig_with(model)
    loaded = load_rig(write_vins_fusion(tmp_path, rig))
    assert_cameras(loaded, rig)
    assert loaded.imu is not None
    assert loaded.imu.time_offset_s == -0.0125
    assert loaded.imu.gyro_noise_density == pytest.approx(0.01 / np.sqrt(200.0))
    assert loaded.imu.accel_noise_density == pytest.approx(0.1 / np.sqrt(200.0))
    assert loaded.imu.gyro_random_walk == Imu().gyro_random_walk  # 1e-5 of a sample would be less
    assert loaded.imu.accel_random_walk == pytest.approx(0.1 / np.sqrt(200.0))


def test_vins_fusion_configuration_without_imu_is_a_pair(tmp_path: Path) -> None:
    rig = small_rig(1).without_imu()
    loaded = load_rig(write_vins_fusion(tmp_path, rig))
    assert_cameras(loaded, rig)
    assert loaded.imu is None


def test_vins_fusion_configuration_of_one_camera_is_a_single(tmp_path: Path) -> None:
    loaded = load_rig(write_vins_fusion(tmp_path, small_rig(1), {"num_of_cam": 1}))
    assert [single.left.name for single in loaded.singles] == ["cam0"]
    assert not loaded.pairs


def test_vins_fusion_invalid_value_raises(tmp_path: Path) -> None:
    config = write_vins_fusion(tmp_path, small_rig(1), {"cam1_calib": "none.yaml"})
    with pytest.raises(RigError, match=r"none.yaml: cannot be read"):
        load_rig(config)
    config = write_vins_fusion(tmp_path, small_rig(1))
    lens = tmp_path / "lens1.yaml"
    lens.write_text(lens.read_text().replace("PINHOLE", "SCARAMUZZA"))
    with pytest.raises(RigError, match=r"lens1.yaml: model_type: unknown model 'SCARAMUZZA'; use one of PINHOLE"):
        load_rig(config)
    config = write_vins_fusion(tmp_path, small_rig(1), {"num_of_cam": 3})
    with pytest.raises(RigError, match=r"stereo_imu_config.yaml: cam2_calib is missing"):
        load_rig(config)


# ------------------------------------------------------------------ ORB-SLAM3

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


@pytest.mark.parametrize("model", ORB_TYPES)
def test_orb_slam3_settings_have_cameras_and_imu(tmp_path: Path, model: str) -> None:
    rig = rig_with(model)
    loaded = load_rig(write_orb_slam3(tmp_path, rig))
    assert_cameras(loaded, rig)
    assert loaded.imu == Imu(100.0, 1.6e-4, 2.2e-5, 2.8e-3, 8.6e-4)


def test_orb_slam3_settings_without_imu_have_the_first_camera_as_body(tmp_path: Path) -> None:
    rig = small_rig(1)
    loaded = load_rig(write_orb_slam3(tmp_path, rig, {"IMU.T_b_c1": None}))
    assert loaded.imu is None
    np.testing.assert_array_equal(loaded.cameras[0].body_T_cam, np.eye(4))
    np.testing.assert_allclose(loaded.pairs[0].right_T_left, rig.pairs[0].right_T_left, atol=1e-9)


def test_orb_slam3_rectified_cameras_have_no_distortion(tmp_path: Path) -> None:
    rig = small_rig(1)
    change = {"Camera.type": "Rectified", "Stereo.T_c1_c2": None, "Stereo.b": 0.12, "Camera2.fx": None}
    loaded = load_rig(write_orb_slam3(tmp_path, rig, change))
    left, right = loaded.cameras
    assert not left.distortion.any()
    np.testing.assert_array_equal(left.intrinsics, right.intrinsics)
    left_T_right = se3_inverse(left.body_T_cam) @ right.body_T_cam
    np.testing.assert_allclose(left_T_right, se3_exp(np.array([0.0, 0.0, 0.0, 0.12, 0.0, 0.0])), atol=1e-12)


def test_orb_slam3_settings_of_one_camera_are_a_single(tmp_path: Path) -> None:
    loaded = load_rig(write_orb_slam3(tmp_path, small_rig(1), {"Stereo.T_c1_c2": None}))
    assert [single.left.name for single in loaded.singles] == ["cam0"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"Camera1.fx": None, "Camera.fx": 40.0}, r"EuRoC.yaml: Camera1.fx is missing; .* version 1.0"),
        ({"Camera.type": "Fov"}, r"Camera.type: unknown type 'Fov'; use one of PinHole"),
        ({"Camera2.cy": None}, r"Camera2.cy is missing"),
        ({"IMU.NoiseGyro": None}, r"IMU.NoiseGyro is missing"),
        ({"IMU.T_b_c1": 2.0 * np.eye(4)}, r"IMU.T_b_c1: .*no rotation"),
    ],
)
def test_orb_slam3_invalid_value_raises(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(RigError, match=message):
        load_rig(write_orb_slam3(tmp_path, small_rig(1), change))


def test_orb_slam3_fisheye_without_a_coefficient_raises(tmp_path: Path) -> None:
    with pytest.raises(RigError, match=r"Camera1.k4 is missing"):
        load_rig(write_orb_slam3(tmp_path, rig_with("equidistant"), {"Camera1.k4": None}))
