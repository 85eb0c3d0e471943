"""COLMAP's rig configurations, as its own library reads them too."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import small_rig

from graphvio.errors import RigError
from graphvio.geometry import quat_wxyz_from_rotation
from graphvio.rig import Rig
from graphvio.rig_files import load_rig

PARAMETERS = [50.0, 51.0, 32.0, 24.0, -0.1, 0.01, 3e-4, -2e-4]  # fx, fy, cx, cy, k1, k2, p1, p2


def written(folder: Path, rig: Rig, change: dict[str, Any] | None = None) -> Path:
    """A configuration of a rig's cameras, the first the reference, after a change of the second."""
    cameras: list[dict[str, Any]] = []
    for camera in rig.cameras:
        cam_T_first = camera.cam_T_body @ rig.cameras[0].body_T_cam
        quat_wxyz = quat_wxyz_from_rotation(np.ascontiguousarray(cam_T_first[:3, :3]))
        place = {"cam_from_rig_rotation": quat_wxyz.tolist(), "cam_from_rig_translation": cam_T_first[:3, 3].tolist()}
        cameras.append({"image_prefix": f"rig1/{camera.name}/", **({"ref_sensor": True} if not cameras else place)})
    cameras[1].update(change or {})
    (folder / "rig_config.json").write_text(json.dumps([{"cameras": cameras}]))
    lines = [f"{k + 1} OPENCV 64 48 {' '.join(map(str, PARAMETERS))}" for k in range(len(cameras))]
    (folder / "cameras.txt").write_text("\n".join(["# Camera list with one line of data per camera:", *lines, ""]))
    return folder / "rig_config.json"


def test_load_rig_of_a_colmap_configuration(tmp_path: Path) -> None:
    rig = load_rig(written(tmp_path, small_rig(2)))
    assert [camera.name for camera in rig.cameras] == ["cam0", "cam1", "cam2", "cam3"]
    assert len(rig.pairs) == 2
    assert rig.imu is None
    expected = small_rig(2)
    np.testing.assert_allclose(rig.left2_T_left1(), expected.left2_T_left1(), atol=1e-12)
    np.testing.assert_allclose(rig.pairs[1].right_T_left, expected.pairs[1].right_T_left, atol=1e-12)
    camera = rig.cameras[0]
    assert camera.size_px == (64, 48)
    np.testing.assert_allclose(camera.intrinsics, [50.0, 51.0, 31.5, 23.5])
    np.testing.assert_allclose(camera.distortion[:4], PARAMETERS[4:])


def test_places_and_lenses_are_those_that_colmap_reads(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    lens = {"camera_model_name": "OPENCV_FISHEYE", "camera_params": [40.0, 41.0, 33.0, 25.0, 0.01, -0.002, 1e-3, 0.0]}
    path = written(tmp_path, small_rig(1), lens)
    rig = load_rig(path)
    (config,) = pycolmap.read_rig_config(path)
    cam_T_rig = np.vstack([config.cameras[1].cam_from_rig.matrix(), [0.0, 0.0, 0.0, 1.0]])
    np.testing.assert_allclose(rig.pairs[0].right_T_left, cam_T_rig, atol=1e-12)
    camera, theirs = rig.pairs[0].right, config.cameras[1].camera
    points = np.random.default_rng(0).uniform([-0.5, -0.5, 1.0], [0.5, 0.5, 2.0], (20, 3))
    np.testing.assert_allclose(camera.project(points)[0] + 0.5, theirs.img_from_cam(points), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_id": 7}, r"cameras\[1\]\.camera_id: cameras\.txt has no camera 7; it has 1, 2"),
        ({"camera_model_name": "FOV", "camera_params": [1, 2, 3, 4, 5]}, r"camera 2: unknown model 'FOV'; use one of"),
        ({"camera_model_name": "PINHOLE", "camera_params": [1, 2, 3]}, r"camera 2 has 3 parameters; PINHOLE has 4"),
        ({"cam_from_rig_rotation": [1, 0, 0, 1]}, r"cam_from_rig_rotation: the quaternion's norm is 1\.414; it must"),
        ({"cam_from_rig_translation": None}, r"cam_from_rig_translation is missing; add it"),
    ],
)
def test_load_rig_of_a_wrong_configuration_says_where(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(RigError, match=message):
        load_rig(written(tmp_path, small_rig(1), change))


def test_load_rig_of_a_configuration_without_its_cameras_says_what_to_write(tmp_path: Path) -> None:
    path = written(tmp_path, small_rig(1))
    (tmp_path / "cameras.txt").write_text("1 OPENCV 64\n")
    with pytest.raises(RigError, match=r"cameras\.txt: line 1 is no camera; it must be: id, model"):
        load_rig(path)
    (tmp_path / "cameras.txt").unlink()
    with pytest.raises(RigError, match=r"cameras\.txt: does not exist; .* has no image sizes: write"):
        load_rig(path)
    both = json.loads(path.read_text()) * 2
    path.write_text(json.dumps(both))
    with pytest.raises(RigError, match="has 2 rigs; write a file of the one that is wanted"):
        load_rig(path)
