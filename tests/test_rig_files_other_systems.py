"""Calibrations of OpenVINS, VINS-Fusion and ORB-SLAM3, and Kalibr's models of the IMU."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from other_systems import ORB_TYPES, VINS_LENSES, write_openvins, write_orb_slam3, write_vins_fusion
from recordings import LENSES, small_rig, with_lens

from graphvio.errors import RigError
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.rig import Imu, Rig
from graphvio.rig_files import find_rig, load_rig

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
