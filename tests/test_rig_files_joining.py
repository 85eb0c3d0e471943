"""Calibrations of pairs that share no view, such as two of Kalibr's, as one rig."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import graphvio

from graphvio.geometry import se3_inverse
from graphvio.rig import Imu, Rig, StereoPair
from graphvio.rig_files import joined_rig, load_rig
from graphvio.rig_files.reading import NOISE_KEYS
from graphvio.simulation import default_rig


def write_kalibr(pair: StereoPair, path: Path, imu: Imu | None) -> Path:
    """Write a pair as Kalibr does, and with an IMU the file of its noise."""
    chain = {}
    for name, camera in zip(("cam0", "cam1"), pair.cameras, strict=True):
        chain[name] = {
            "camera_model": "pinhole",
            "intrinsics": camera.intrinsics.tolist(),
            "distortion_model": "radtan",
            "distortion_coeffs": camera.distortion[:4].tolist(),
            "resolution": list(camera.size_px),
            "rostopic": f"/{name}/image_raw",
        }
        if imu is not None:
            chain[name] |= {"T_cam_imu": camera.cam_T_body.tolist(), "timeshift_cam_imu": imu.time_offset_s}
    chain["cam1"]["T_cn_cnm1"] = pair.right_T_left.tolist()
    path.write_text(yaml.safe_dump(chain))
    if imu is not None:
        noise = ("gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density")
        keys = dict(zip(NOISE_KEYS, (*noise, "accelerometer_random_walk"), strict=True))
        values = {key: getattr(imu, name) for name, key in keys.items()} | {"update_rate": imu.rate_hz}
        (path.parent / "imu.yaml").write_text(yaml.safe_dump(values))
    return path


@pytest.fixture
def rig() -> Rig:
    return default_rig()


def test_two_files_with_the_imu_are_the_rig(rig: Rig, tmp_path: Path) -> None:
    files = [write_kalibr(pair, tmp_path / f"{pair.name}-camchain-imucam.yaml", rig.imu) for pair in rig.pairs]
    done = graphvio("rig", *files, "--out", tmp_path / "rig.yaml")
    assert done.returncode == 0, done.stderr
    assert "pair1: cam2 and cam3, 640x480 radial-tangential, baseline " in done.stdout
    assert "guessed" not in done.stdout
    joined = load_rig(tmp_path / "rig.yaml")
    assert [camera.name for camera in joined.cameras] == ["cam0", "cam1", "cam2", "cam3"]
    for camera, true in zip(joined.cameras, rig.cameras, strict=True):
        np.testing.assert_allclose(camera.body_T_cam, true.body_T_cam, atol=1e-12)
    assert joined.imu is not None
    assert graphvio("rig", *files, "--out", tmp_path / "rig.yaml").returncode == 2  # is not overwritten


def test_place_of_a_file_without_the_imu_is_guessed(rig: Rig, tmp_path: Path) -> None:
    front, back = rig.pairs
    first = write_kalibr(front, tmp_path / "camchain-imucam.yaml", rig.imu)
    second = write_kalibr(back, tmp_path / "back-camchain.yaml", None)
    done = graphvio("rig", first, second, "--out", tmp_path / "rig.yaml")
    assert done.returncode == 0, done.stderr
    assert "the place of pair1 is not known" in done.stdout
    assert f"graphvio calibrate RECORDING --rig {tmp_path / 'rig.yaml'}" in done.stdout
    joined = load_rig(tmp_path / "rig.yaml")
    np.testing.assert_allclose(joined.pairs[1].right_T_left, back.right_T_left, atol=1e-12)
    one_T_other = se3_inverse(joined.pairs[0].left.body_T_cam) @ joined.pairs[1].left.body_T_cam
    np.testing.assert_allclose(one_T_other, np.diag([-1.0, 1.0, -1.0, 1.0]), atol=1e-12)  # looks the other way
    assert graphvio("rig", second, first).returncode == 2  # the one with the IMU is to be the first


def test_names_that_differ_are_kept(rig: Rig) -> None:
    alone = [rig.with_pairs([k]) for k in range(2)]
    joined, guessed = joined_rig(alone, "joined")
    assert [pair.name for pair in joined.pairs] == [pair.name for pair in rig.pairs]
    assert [camera.name for camera in joined.cameras] == [camera.name for camera in rig.cameras]
    assert guessed == ()


@pytest.mark.parametrize(("later_s", "offset_s"), [(0.01, 0.01), (-0.01, -0.01), (0.004, 0.0)])
def test_different_time_offsets_become_offsets_of_stamps(rig: Rig, later_s: float, offset_s: float) -> None:
    """With more than 5 ms between them devices run independently; less is an error of their calibration."""
    assert rig.imu is not None
    late = replace(rig.with_pairs([1]), imu=replace(rig.imu, time_offset_s=rig.imu.time_offset_s + later_s))
    joined, _ = joined_rig([rig.with_pairs([0]), late], "joined")
    assert joined.imu == rig.imu
    assert [camera.stamp_offset_s for camera in joined.cameras] == [0.0, 0.0, offset_s, offset_s]
    again, _ = joined_rig([joined, late], "again")  # a rig that has offsets keeps them
    assert [camera.stamp_offset_s for camera in again.cameras[:4]] == [0.0, 0.0, offset_s, offset_s]
