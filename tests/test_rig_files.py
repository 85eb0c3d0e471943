"""Rig files: formats that are read and written, and errors of files that are not usable."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from recordings import (
    KITTI_P,
    LENSES,
    REAL_DATA,
    small_rig,
    with_lens,
    write_euroc,
    write_image,
    write_imu_yaml,
    write_kitti_odometry,
    write_kitti_raw,
)

from graphvio.errors import RigError
from graphvio.geometry import quat_wxyz_from_rotation, se3, se3_exp, se3_inverse
from graphvio.rig import Camera, Imu, Rig, StereoPair
from graphvio.rig_files import find_rig, load_rig, save_rig
from graphvio.sessions.euroc_layout import camera_yaml


def assert_same(a: Rig, b: Rig) -> None:
    assert a.imu == b.imu
    assert [pair.name for pair in a.pairs] == [pair.name for pair in b.pairs]
    for one, other in zip(a.cameras, b.cameras, strict=True):
        assert one.line_time_us == pytest.approx(other.line_time_us, abs=1e-9)
        assert one.stamp_offset_s == other.stamp_offset_s
        assert (one.name, one.model, one.size_px, one.mask) == (
            other.name,
            other.model,
            other.size_px,
            other.mask,
        )
        np.testing.assert_array_equal(one.intrinsics, other.intrinsics)
        np.testing.assert_array_equal(one.distortion, other.distortion)
        np.testing.assert_allclose(one.body_T_cam, other.body_T_cam, atol=1e-12, rtol=0)


def edited(tmp_path: Path, edit: Callable[[dict], None], pairs: int = 1) -> Path:  # type: ignore[type-arg]
    """A rig.yaml of a small rig after a change."""
    path = tmp_path / "rig.yaml"
    save_rig(small_rig(pairs), path)
    document = yaml.safe_load(path.read_text())
    edit(document)
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.mark.parametrize("pairs", [1, 2, 3])
@pytest.mark.parametrize("imu", [True, False])
def test_save_rig_then_load_rig_returns_equal_rig(tmp_path: Path, pairs: int, imu: bool) -> None:
    rig = small_rig(pairs, imu)
    save_rig(rig, tmp_path / "rig.yaml")
    loaded = load_rig(tmp_path / "rig.yaml")
    assert loaded.name == rig.name
    assert_same(rig, loaded)


@given(
    numbers=st.tuples(*[st.floats(1e-9, 1e3)] * 5),
    offset_s=st.floats(-1, 1),
    xi=st.lists(st.floats(-2, 2), min_size=6, max_size=6),
    name=st.text(min_size=1, max_size=12),
)
def test_save_rig_then_load_rig_with_any_values_returns_equal_rig(
    tmp_path_factory: pytest.TempPathFactory,
    numbers: tuple[float, float, float, float, float],
    offset_s: float,
    xi: list[float],
    name: str,
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    body_T_left = se3_exp(np.array(xi))
    body_T_right = body_T_left @ se3(np.eye(3), np.array([0.1, 0.0, 0.0]))
    left, right = (
        Camera(
            f"{side}{name}",
            "equidistant",
            (640, 480),
            np.array([300.1, 299.7, 320.3, 240.9]),
            np.zeros(4),
            pose,
        )
        for side, pose in (("l", body_T_left), ("r", body_T_right))
    )
    rig = Rig((StereoPair(name, left, right),), Imu(*numbers, offset_s), name)
    save_rig(rig, path)
    assert_same(rig, load_rig(path))


@pytest.mark.parametrize("model", LENSES)
def test_save_rig_then_load_rig_keeps_the_lens(tmp_path: Path, model: str) -> None:
    rig = with_lens(small_rig(1), model)
    save_rig(rig, tmp_path / "rig.yaml")
    assert_same(rig, load_rig(tmp_path / "rig.yaml"))
    camera = yaml.safe_load((tmp_path / "rig.yaml").read_text())["pairs"][0]["left"]
    assert camera["model"] == model
    assert camera["distortion"] == LENSES[model]


def test_line_times_of_rolling_shutters_are_read_from_every_format(tmp_path: Path) -> None:
    rig = small_rig(2).with_cameras(lambda camera: replace(camera, line_time_us=41.67))
    save_rig(rig, tmp_path / "rig.yaml")
    assert_same(rig, load_rig(tmp_path / "rig.yaml"))
    first = (tmp_path / "rig.yaml").read_text()
    assert "graphvio_rig: 2" in first
    (tmp_path / "rig.yaml").write_text(first.replace("graphvio_rig: 2", "graphvio_rig: 1"))
    with pytest.raises(RigError, match="line_time_us is of version 2; write  graphvio_rig: 2"):
        load_rig(tmp_path / "rig.yaml")
    chain = yaml.safe_load(kalibr_chain(rig))
    for section in chain.values():
        section["line_delay"] = 41.67e-6
    (tmp_path / "camchain-imucam.yaml").write_text(yaml.safe_dump(chain))
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    assert_same(rig, load_rig(tmp_path / "camchain-imucam.yaml"))
    euroc = write_euroc(tmp_path / "euroc", rig=rig, frames=1)
    for camera in rig.cameras:
        (euroc / "mav0" / camera.name / "sensor.yaml").write_text(camera_yaml(camera, 20.0, "rolling"))
    assert_same(rig, load_rig(euroc))


def test_load_rig_with_a_wrong_lens_names_the_camera_and_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save_rig(with_lens(small_rig(1), "double-sphere"), path)
    text = path.read_text()
    path.write_text(text.replace("[-0.2, 0.6]", "[0.6, -0.2]", 1))
    with pytest.raises(RigError, match=r"rig.yaml: camera cam0: alpha is -0.2, and must be between 0 and 1; give .*xi"):
        load_rig(path)
    path.write_text(text.replace("[-0.2, 0.6]", "[-0.2, 0.6, 0, 0, 0, 0, 0, 0, 0]", 1))
    with pytest.raises(RigError, match=r"camera cam0: 9 distortion coefficients; give at most 8"):
        load_rig(path)
    path.write_text(text.replace("intrinsics: [40.0", "intrinsics: [10.0", 1))
    with pytest.raises(RigError, match=r"camera cam0: no ray reaches the image's corner \(0, 0\) by its double-sphere"):
        load_rig(path)
    write_image(tmp_path / "mask.png", np.full((48, 64), 255, dtype=np.uint8))
    path.write_text(path.read_text().replace("distortion:", 'mask: "mask.png"\n      distortion:', 1))
    assert load_rig(path).cameras[0].mask == (tmp_path / "mask.png").resolve()


def test_save_rig_keeps_the_matrices_of_the_imu(tmp_path: Path) -> None:
    matrix = (1.01, 0.001, -0.002, 0.0, 0.99, 0.003, 0.0, 0.0, 1.005)
    rig = replace(small_rig(1), imu=Imu(gyro_matrix=matrix))
    save_rig(rig, tmp_path / "rig.yaml")
    loaded = load_rig(tmp_path / "rig.yaml")
    assert loaded.imu == rig.imu
    assert loaded.imu is not None
    assert loaded.imu.matrices[0] == pytest.approx(np.reshape(matrix, (3, 3)), abs=0.0)
    assert "gyro_matrix" not in (edited(tmp_path, lambda _: None)).read_text()


@pytest.mark.parametrize("matrix", [[[1.0, 0.0], [0.0, 1.0]], [[2.0, 0, 0], [0, 1, 0], [0, 0, 1]], "identity"])
def test_load_rig_with_an_invalid_matrix_of_the_imu_names_it(tmp_path: Path, matrix: object) -> None:
    with pytest.raises(RigError, match="accel_matrix"):
        load_rig(edited(tmp_path, lambda d: d["imu"].update(accel_matrix=matrix)))


def test_with_pairs_selects_pairs_in_order() -> None:
    rig = small_rig(3)
    assert rig.with_pairs([2, 0]).pairs == (rig.pairs[2], rig.pairs[0])
    with pytest.raises(RigError, match="a pair is asked for twice"):
        rig.with_pairs([1, 1])
    with pytest.raises(RigError, match="there is no pair 3; choose from 0 to 2"):
        rig.with_pairs([0, 3])
    with pytest.raises(RigError, match="has no stereo pairs"):
        rig.without_pairs().with_pairs([0])


def test_save_rig_writes_mask_relative_to_file(tmp_path: Path) -> None:
    write_image(tmp_path / "masks" / "cam0.png", np.zeros((48, 64), dtype=np.uint8))
    path = edited(tmp_path, lambda d: d["pairs"][0]["left"].update(mask="masks/cam0.png"))
    rig = load_rig(path)
    assert rig.pairs[0].left.mask == tmp_path.resolve() / "masks" / "cam0.png"
    save_rig(rig, tmp_path / "again.yaml")
    assert 'mask: "masks/cam0.png"' in (tmp_path / "again.yaml").read_text()
    assert_same(rig, load_rig(tmp_path / "again.yaml"))


def test_load_rig_number_without_point_is_read(tmp_path: Path) -> None:
    path = edited(tmp_path, lambda d: d["imu"].update(gyro_random_walk="2e-5"))
    imu = load_rig(path).imu
    assert imu is not None
    assert imu.gyro_random_walk == 2e-5


def _set(keys: str, value: object) -> Callable[[dict], None]:  # type: ignore[type-arg]
    def edit(document: dict) -> None:  # type: ignore[type-arg]
        *path, last = [int(key) if key.isdigit() else key for key in keys.split(".")]
        for key in path:
            document = document[key]
        document[last] = value

    return edit


REFUSED = {
    "unknown key": (
        _set("imu.gyro_noise", 1.0),
        r"rig\.yaml: imu\.gyro_noise: unknown key.*'gyro_noise_density'",
    ),
    "unknown top key": (_set("piars", []), r"piars: unknown key; did you mean 'pairs'"),
    "unrelated key": (_set("pairs.0.colour", 1), r"colour: unknown key; known here: name, left, right$"),
    "unknown camera key": (_set("pairs.0.left.intrinsic", 1), r"pairs\[0\]\.left\.intrinsic.*'intrinsics'"),
    "version missing": (lambda d: d.pop("graphvio_rig"), r"begin the file with  graphvio_rig: 2"),
    "version unknown": (_set("graphvio_rig", 3), r"reads versions 1 and 2"),
    "noise missing": (
        lambda d: d["imu"].pop("accel_random_walk"),
        r"imu\.accel_random_walk is missing.*graphvio's default:  accel_random_walk: 0\.003",
    ),
    "rate missing": (lambda d: d["imu"].pop("rate_hz"), r"imu\.rate_hz is missing.*rate_hz: 200\.0"),
    "NaN": (_set("pairs.0.left.intrinsics", [float("nan"), 1, 1, 1]), r"left\.intrinsics: holds NaN"),
    "NaN in noise": (_set("imu.gyro_noise_density", float("nan")), r"imu\.gyro_noise_density: holds NaN"),
    "text": (_set("pairs.0.left.intrinsics", ["a", 1, 1, 1]), r"left\.intrinsics: .* numbers only"),
    "shape": (_set("pairs.0.left.intrinsics", [1, 1, 1]), r"left\.intrinsics: has shape \(3,\)"),
    "no rotation": (
        _set("pairs.0.left.body_T_cam", [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        r"rig\.yaml: camera cam0: body_T_cam: .* no rotation",
    ),
    "last row": (
        _set("pairs.0.left.body_T_cam", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2]]),
        r"last row",
    ),
    "no pair": (_set("pairs", []), r"pairs must be a list of at least one pair"),
    "side missing": (lambda d: d["pairs"][0].pop("right"), r"pairs\[0\]\.right is missing"),
    "size": (_set("pairs.0.left.size_px", [64.5, 48]), r"size_px.* two whole numbers"),
    "model": (_set("pairs.0.left.model", "fisheye"), r"unknown model 'fisheye'; use one of"),
    "mask": (_set("pairs.0.left.mask", "none.png"), r"left\.mask: there is no image"),
    "same name": (_set("pairs.0.right.name", "cam0"), r"camera 'cam0' appears twice"),
    "imu is no mapping": (_set("imu", 200), r"imu: is 200; it must be a mapping"),
    "offset in ms": (_set("imu.time_offset_s", 12.5), r"time_offset_s is 12\.5"),
    "pair is a truth value": (_set("pairs.0.name", True), r"pairs\[0\]\.name: is True.*in quotes"),
    "camera is a truth value": (_set("pairs.0.left.name", False), r"left\.name: is False.*in quotes"),
    "focal length in mm": (_set("pairs.0.left.intrinsics", [3.0, 3.0, 32.0, 24.0]), r"cam0: a focal length of 3 px"),
    "view of half a degree": (_set("pairs.0.left.intrinsics", [7e3, 7e3, 32.0, 24.0]), r"cam0: a focal length of 7000"),
    "principal point": (_set("pairs.0.right.intrinsics", [60.0, 60.0, 32.0, 61.0]), r"cam1: its principal point"),
    "camera in mm": (_set("pairs.0.right.body_T_cam.0.3", 110.0), r"cam1: is \d+ m from the IMU; .*metres"),
    "negative noise": (_set("imu.gyro_noise_density", -1.0), r"must be positive"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_load_rig_invalid_file_raises(tmp_path: Path, name: str) -> None:
    edit, message = REFUSED[name]
    path = edited(tmp_path, edit)
    with pytest.raises(RigError, match=message) as caught:
        load_rig(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_load_rig_baseline_in_millimetres_raises(tmp_path: Path) -> None:
    def edit(document: dict) -> None:  # type: ignore[type-arg]
        del document["imu"]
        _set("pairs.0.right.body_T_cam.1.3", 110.0)(document)

    path = edited(tmp_path, edit)
    with pytest.raises(RigError, match=r"pair pair0: baseline is \d+ m; .*metres"):
        load_rig(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("pairs.0.left.intrinsics", [60.0, 60.0, 70.0, -10.0]),  # a part of a larger image
        ("pairs.0.left.intrinsics", [3e3, 3e3, 32.0, 24.0]),  # of a telescope
        ("pairs.0.right.name", "yes"),
        ("pairs.0.name", 7),
    ],
)
def test_load_rig_unusual_but_possible_value_is_read(tmp_path: Path, key: str, value: object) -> None:
    assert load_rig(edited(tmp_path, _set(key, value))).pairs


def test_load_rig_pair_without_baseline_or_common_view_raises(tmp_path: Path) -> None:
    document = edited(tmp_path, lambda d: d["pairs"][0]["right"].update(body_T_cam=d["pairs"][0]["left"]["body_T_cam"]))
    with pytest.raises(RigError, match=r"baseline is 0\.000 mm"):
        load_rig(document)
    other = edited(tmp_path, lambda d: d["pairs"][0].update(right=d["pairs"][1]["left"]), pairs=2)
    with pytest.raises(RigError, match="optical axes are 180 degrees apart"):
        load_rig(other)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("rig.yaml", b"graphvio_rig: 1\npairs: [", "line 2 is not valid YAML"),
        ("rig.yaml", b"graphvio_rig: 1\npairs: []\nname: a\nname: b\n", "line 4 .*name is there twice"),
        ("rig.yaml", b"- 1\n- 2\n", "must be a mapping"),
        ("rig.yaml", b"", "graphvio_rig is missing"),
        ("rig.yaml", b"\xff\xfe\x00", "no text file"),
        ("rig.bin", b"", "no calibration file"),
        ("notes.txt", b"lens: dirty\n", "no calibration that graphvio knows"),
        ("stereo.yml", b"%YAML:1.0\n---\nM1: 3\n", "no calibration that graphvio knows.* graphvio_rig: 2"),
    ],
)
def test_load_rig_unreadable_file_raises(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RigError, match=message):
        load_rig(tmp_path / name)


def test_load_rig_example_of_documentation_is_valid(tmp_path: Path) -> None:
    text = (Path(__file__).parents[1] / "docs" / "reference" / "data-contract.md").read_text()
    (example,) = re.findall(r"```yaml\n(graphvio_rig.*?)```", text, re.DOTALL)
    (tmp_path / "rig.yaml").write_text(example)
    rig = load_rig(tmp_path / "rig.yaml")
    assert [pair.name for pair in rig.pairs] == ["front", "back"]
    assert rig.imu == Imu()  # the defaults in error messages


def test_load_rig_missing_path_raises(tmp_path: Path) -> None:
    with pytest.raises(RigError, match="does not exist"):
        load_rig(tmp_path / "none.yaml")
    with pytest.raises(RigError, match="cannot be read"):
        load_rig(tmp_path / ("x" * 300))
    with pytest.raises(RigError, match="holds no calibration"):
        load_rig(tmp_path)
    with pytest.raises(RigError, match="cannot be written"):
        save_rig(small_rig(), tmp_path / "none" / "rig.yaml")


def test_load_rig_euroc_folder(tmp_path: Path) -> None:
    rig = small_rig(2)
    write_euroc(tmp_path / "walk", frames=1)
    for path in (
        tmp_path / "walk",
        tmp_path / "walk" / "mav0",
        tmp_path / "walk" / "mav0" / "cam0" / "sensor.yaml",
    ):
        loaded = load_rig(path)
        assert_same(rig, loaded)
        assert loaded.name == "walk"


def test_load_rig_folder_with_rig_yaml_prefers_it(tmp_path: Path) -> None:
    write_euroc(tmp_path, frames=1)
    save_rig(small_rig(1), tmp_path / "rig.yaml")
    assert len(load_rig(tmp_path).pairs) == 1
    assert len(load_rig(tmp_path / "mav0").pairs) == 1


def test_load_rig_euroc_imu_off_body_makes_imu_the_body(tmp_path: Path) -> None:
    rig = small_rig(1)
    write_euroc(tmp_path, pairs=1, frames=1)
    B_T_imu = se3_exp(np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.3]))
    write_imu_yaml(tmp_path / "mav0" / "imu0" / "sensor.yaml", Imu(), B_T_imu)
    loaded = load_rig(tmp_path)
    for got, camera in zip(loaded.cameras, rig.cameras, strict=True):
        np.testing.assert_allclose(B_T_imu @ got.body_T_cam, camera.body_T_cam, atol=1e-12)


def test_load_rig_euroc_with_the_same_camera_twice_raises(tmp_path: Path) -> None:
    write_euroc(tmp_path, frames=1)
    (tmp_path / "mav0" / "cam4").mkdir()
    sensor = (tmp_path / "mav0" / "cam0" / "sensor.yaml").read_text()
    (tmp_path / "mav0" / "cam4" / "sensor.yaml").write_text(sensor)
    with pytest.raises(RigError, match=r"cameras cam0 and cam4 have the same body_T_cam"):
        load_rig(tmp_path)


@pytest.mark.parametrize(
    ("sensor", "pattern", "replacement", "message"),
    [
        (
            "imu0",
            r"gyroscope_noise_density.*\n",
            "",
            r"gyroscope_noise_density is missing.*default:  gyroscope_noise",
        ),
        ("cam1", r"intrinsics.*\n", "", r"cam1/sensor\.yaml: intrinsics is missing"),
        ("cam1", r"radial-tangential", "fov", r"distortion_model: unknown model 'fov'"),
        ("cam1", r"pinhole", "division", r"camera_model: is 'division'; calibrate with pinhole"),
        ("cam1", r"resolution.*\n", "resolution: 752\n", r"resolution: has shape"),
        ("cam1", r"data: \[[^,]*", "data: [nan", r"T_BS\.data: holds NaN"),
    ],
)
def test_load_rig_euroc_invalid_value_raises(
    tmp_path: Path, sensor: str, pattern: str, replacement: str, message: str
) -> None:
    write_euroc(tmp_path, pairs=1, frames=1)
    file = tmp_path / "mav0" / sensor / "sensor.yaml"
    file.write_text(re.sub(pattern, replacement, file.read_text()))
    with pytest.raises(RigError, match=message):
        load_rig(tmp_path)


def kalibr_chain(rig: Rig, shift_s: float = 0.0, model: str = "radtan") -> str:
    chain = {}
    for i, camera in enumerate(rig.cameras):
        chain[f"cam{i}"] = {
            "T_cam_imu": camera.cam_T_body.tolist(),
            "cam_overlaps": [],
            "camera_model": "pinhole",
            "distortion_coeffs": camera.distortion[:4].tolist(),
            "distortion_model": model,
            "intrinsics": camera.intrinsics.tolist(),
            "resolution": list(camera.size_px),
            "rostopic": f"/cam{i}/image_raw",
            "timeshift_cam_imu": shift_s,
        }
    return yaml.safe_dump(chain)


KALIBR_IMU = """
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-3
gyroscope_noise_density: 1.7e-4
gyroscope_random_walk: 2.0e-5
rostopic: /imu0
update_rate: 200.0
"""


@pytest.mark.parametrize(
    ("chain", "imu"),
    [
        ("camchain-imucam.yaml", "imu.yaml"),
        ("walk-camchain-imucam.yaml", "walk-imu.yaml"),
        ("camchain.yaml", "imu_config.yaml"),
    ],
)
@pytest.mark.parametrize("nested", [False, True])
def test_load_rig_kalibr(tmp_path: Path, chain: str, imu: str, nested: bool) -> None:
    rig = small_rig(2)
    (tmp_path / chain).write_text(kalibr_chain(rig, shift_s=-0.0125))
    text = "imu0:\n" + KALIBR_IMU.replace("\n", "\n  ") if nested else KALIBR_IMU
    (tmp_path / imu).write_text(text)
    loaded = load_rig(tmp_path / chain)
    assert loaded.imu == Imu(time_offset_s=-0.0125)
    assert_same(rig.without_imu(), loaded.without_imu())
    assert_same(loaded, load_rig(tmp_path))


@pytest.mark.parametrize(
    ("chain", "imu"), [("my-imu.yaml", "imu.yaml"), ("imu.yaml", "adis-imu.yaml"), ("imucam.yaml", "camchain-imu.yaml")]
)
def test_load_rig_kalibr_chain_named_after_the_imu_is_not_taken_for_it(tmp_path: Path, chain: str, imu: str) -> None:
    rig = small_rig(1)
    (tmp_path / chain).write_text(kalibr_chain(rig))
    (tmp_path / f"copy-of-{chain}").write_text(kalibr_chain(rig))
    with pytest.raises(RigError, match=r"no imu\.yaml next to it"):
        load_rig(tmp_path / chain)
    (tmp_path / imu).write_text(KALIBR_IMU)
    assert load_rig(tmp_path / chain).imu == Imu()


KALIBR_LENSES = {
    "double-sphere": ("ds", ["xi", "alpha"]),
    "extended-unified": ("eucm", ["alpha", "beta"]),
    "omnidirectional": ("omni", ["xi"]),
}


def kalibr_lens_chain(rig: Rig, change: Callable[[dict], None] = lambda _: None) -> str:  # type: ignore[type-arg]
    """A chain of cameras whose lenses have a sphere, as Kalibr writes it, after a change of the first."""
    chain = yaml.safe_load(kalibr_chain(rig))
    for camera, section in zip(rig.cameras, chain.values(), strict=True):
        name, of_sphere = KALIBR_LENSES[camera.model]
        sphere = camera.distortion[: len(of_sphere)].tolist()
        section.update(camera_model=name, intrinsics=[*sphere, *camera.intrinsics.tolist()])
        section.update(distortion_model="none", distortion_coeffs=[])
        if camera.model == "omnidirectional":
            section.update(distortion_model="radtan", distortion_coeffs=camera.distortion[1:5].tolist())
    change(chain["cam0"])
    return yaml.safe_dump(chain)


@pytest.mark.parametrize("model", KALIBR_LENSES)
def test_load_rig_kalibr_reads_lenses_with_a_sphere(tmp_path: Path, model: str) -> None:
    rig = with_lens(small_rig(2), model)
    (tmp_path / "camchain-imucam.yaml").write_text(kalibr_lens_chain(rig))
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    assert_same(rig, load_rig(tmp_path))


def test_load_rig_kalibr_reads_pinholes_and_spheres_without_distortion(tmp_path: Path) -> None:
    path = tmp_path / "camchain-imucam.yaml"
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    path.write_text(kalibr_chain(small_rig(1), model="equidistant"))
    assert load_rig(path).cameras[0].model == "equidistant"
    path.write_text(kalibr_chain(small_rig(1), model="none"))
    assert load_rig(path).cameras[0].model == "radial-tangential"
    assert not load_rig(path).cameras[0].distortion.any()
    rig = with_lens(small_rig(1), "omnidirectional")
    path.write_text(kalibr_lens_chain(rig, lambda d: d.update(distortion_model="none")))
    assert load_rig(path).cameras[0].distortion.tolist() == [0.7] + 7 * [0.0]


@pytest.mark.parametrize(
    ("model", "change", "message"),
    [
        ("double-sphere", {"intrinsics": [50.0, 50.0, 31.5, 23.5]}, r"cam0.intrinsics: has shape \(4,\).* \(6,\)"),
        ("double-sphere", {"distortion_model": "radtan"}, r"distortion_model: is 'radtan'; with .* ds it must be none"),
        ("omnidirectional", {"distortion_model": "equi"}, r"with camera_model omni it must be radtan or none"),
        (
            "extended-unified",
            {"intrinsics": [1.1, 0.6, 50.0, 50.0, 31.5, 23.5]},
            r"camera cam0: alpha is 1.1, and must",
        ),
        ("extended-unified", {"intrinsics": [0.9, 1.1, 9.0, 9.0, 31.5, 23.5]}, r"camera cam0: no ray reaches the"),
        ("omnidirectional", {"camera_model": "fov"}, r"cam0.camera_model: is 'fov'; calibrate with .* ds, eucm, omni"),
    ],
)
def test_load_rig_kalibr_with_a_wrong_lens_says_which(
    tmp_path: Path, model: str, change: dict[str, object], message: str
) -> None:
    chain = kalibr_lens_chain(with_lens(small_rig(1), model), lambda d: d.update(change))
    (tmp_path / "camchain-imucam.yaml").write_text(chain)
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    with pytest.raises(RigError, match=message):
        load_rig(tmp_path)


@pytest.mark.parametrize("model", LENSES)
def test_camera_yaml_is_read_back(tmp_path: Path, model: str) -> None:
    write_euroc(tmp_path, pairs=1, frames=1)
    rig = with_lens(small_rig(1), model)
    for camera in rig.cameras:
        (tmp_path / "mav0" / camera.name / "sensor.yaml").write_text(camera_yaml(camera, 20.0, "of a test"))
    loaded = load_rig(tmp_path)
    for one, other in zip(loaded.cameras, rig.cameras, strict=True):
        assert one.model == other.model
        np.testing.assert_allclose(one.intrinsics, other.intrinsics, rtol=1e-11)
        np.testing.assert_array_equal(one.distortion, other.distortion)


# ---------------------------------------------------------------- Basalt


def basalt_calibration(rig: Rig) -> dict:  # type: ignore[type-arg]
    """A calibration as Basalt writes it, of lenses that differ from camera to camera."""
    lenses = [
        ("ds", [-0.2, 0.6], ["xi", "alpha"]),
        ("eucm", [0.6, 1.1], ["alpha", "beta"]),
        ("kb4", [0.01, -0.02, 0.003, -0.004], ["k1", "k2", "k3", "k4"]),
        ("pinhole-radtan8", LENSES["rational"], ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]),
        ("ucm", [0.6], ["alpha"]),
        ("pinhole", [], []),
    ]
    poses, intrinsics = [], []
    for camera, (kind, coefficients, names) in zip(rig.cameras, lenses, strict=False):
        w, x, y, z = quat_wxyz_from_rotation(camera.body_T_cam[:3, :3]).tolist()
        px, py, pz = camera.body_T_cam[:3, 3].tolist()
        poses.append({"px": px, "py": py, "pz": pz, "qx": x, "qy": y, "qz": z, "qw": w})
        values = dict(zip(["fx", "fy", "cx", "cy", *names], [*camera.intrinsics, *coefficients], strict=True))
        if kind == "pinhole-radtan8":
            values["rpmax"] = 2.0
        intrinsics.append({"camera_type": kind, "intrinsics": values})
    return {
        "T_imu_cam": poses,
        "intrinsics": intrinsics,
        "resolution": [list(camera.size_px) for camera in rig.cameras],
        "calib_accel_bias": [0.1, 0.2, 0.3, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06],
        "calib_gyro_bias": [0.1, 0.2, 0.3, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09],
        "imu_update_rate": 200.0,
        "accel_noise_std": [0.016, 0.016, 0.017],
        "gyro_noise_std": [0.000282, 0.000282, 0.000282],
        "accel_bias_std": [0.001, 0.001, 0.001],
        "gyro_bias_std": [0.0001, 0.0001, 0.0001],
        "cam_time_offset_ns": -12_500_000,
        "vignette": [],
    }


def write_basalt(path: Path, value: object) -> Path:
    path.write_text(json.dumps({"value0": value}))
    return path


def test_load_rig_basalt(tmp_path: Path) -> None:
    rig = small_rig(3)
    path = write_basalt(tmp_path / "calibration.json", basalt_calibration(rig))
    loaded = load_rig(path)
    assert [pair.name for pair in loaded.pairs] == ["pair0", "pair1", "pair2"]
    models = ["double-sphere", "extended-unified", "equidistant", "rational", "extended-unified", "radial-tangential"]
    assert [camera.model for camera in loaded.cameras] == models
    for one, other in zip(loaded.cameras, rig.cameras, strict=True):
        assert (one.name, one.size_px) == (other.name, other.size_px)
        np.testing.assert_array_equal(one.intrinsics, other.intrinsics)
        np.testing.assert_allclose(one.body_T_cam, other.body_T_cam, atol=1e-12)
    assert loaded.cameras[0].distortion.tolist() == [-0.2, 0.6] + 6 * [0.0]
    assert loaded.cameras[3].distortion.tolist() == LENSES["rational"]
    assert loaded.cameras[4].distortion.tolist() == [0.6, 1.0] + 6 * [0.0]
    assert loaded.imu is not None
    assert (loaded.imu.rate_hz, loaded.imu.time_offset_s) == (200.0, -0.0125)
    assert (loaded.imu.gyro_noise_density, loaded.imu.gyro_random_walk) == (0.000282, 0.0001)
    assert (loaded.imu.accel_noise_density, loaded.imu.accel_random_walk) == (0.017, 0.001)
    gyro, accel = loaded.imu.matrices
    np.testing.assert_allclose(gyro, [[1.01, 0.04, 0.07], [0.02, 1.05, 0.08], [0.03, 0.06, 1.09]])
    np.testing.assert_allclose(accel, [[1.01, 0.0, 0.0], [0.02, 1.04, 0.0], [0.03, 0.05, 1.06]])
    assert_same(loaded, load_rig(tmp_path))
    save_rig(loaded, tmp_path / "again.yaml")
    assert_same(loaded, load_rig(tmp_path / "again.yaml"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("T_imu_cam"), r"value0.T_imu_cam is missing"),
        (lambda d: d.update(resolution=7), r"value0.resolution: must be a list"),
        (lambda d: d["resolution"].pop(), r"2 T_imu_cam, 2 intrinsics, 1 resolution; give one of each"),
        (lambda d: d["intrinsics"][0].update(camera_type="fov"), r"intrinsics\[0\].camera_type: unknown model 'fov'"),
        (lambda d: d["intrinsics"][1]["intrinsics"].pop("beta"), r"value0.intrinsics\[1\].intrinsics.beta is missing"),
        (lambda d: d["intrinsics"][0]["intrinsics"].update(alpha=2.0), r"camera cam0: alpha is 2, and must be between"),
        (lambda d: d["T_imu_cam"][1].update(qw=2.0), r"T_imu_cam\[1\].qw: the quaternion's norm is .*it must be 1"),
        (lambda d: d["resolution"].__setitem__(0, [64.5, 48]), r"value0.resolution\[0\]: is .*two whole numbers"),
        (lambda d: d.pop("gyro_bias_std"), r"value0.gyro_bias_std is missing"),
        (lambda d: d.update(accel_noise_std=[0.0, 0.0, 0.0]), r"imu: accel_noise_density is 0.0; it must be positive"),
        (lambda d: d.update(calib_gyro_bias=[0.0] * 3), r"value0.calib_gyro_bias: has shape"),
    ],
)
def test_load_rig_basalt_invalid_value_raises(
    tmp_path: Path,
    change: Callable[[dict], object],  # type: ignore[type-arg]
    message: str,
) -> None:
    calibration = basalt_calibration(small_rig(1))
    change(calibration)
    with pytest.raises(RigError, match=message):
        load_rig(write_basalt(tmp_path / "calibration.json", calibration))


def test_load_rig_of_other_json_raises(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text("{")
    with pytest.raises(RigError, match=r"line 1 is not valid JSON"):
        load_rig(path)
    path.write_text("[]")
    with pytest.raises(RigError, match=r"is no calibration of Basalt"):
        load_rig(path)
    path.write_text('{"cameras": 3}')
    with pytest.raises(RigError, match=r"value0 is missing"):
        load_rig(path)
    assert find_rig(tmp_path) is None


# ---------------------------------------------------------------- chains without an IMU, and the other formats


def test_load_rig_kalibr_without_imu_chains_cameras(tmp_path: Path) -> None:
    rig = small_rig(1, imu=False)
    chain = yaml.safe_load(kalibr_chain(rig))
    for camera in chain.values():
        del camera["T_cam_imu"]
    chain["cam1"]["T_cn_cnm1"] = rig.pairs[0].right_T_left.tolist()
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(chain))
    loaded = load_rig(tmp_path / "camchain.yaml")
    assert loaded.imu is None
    np.testing.assert_allclose(loaded.pairs[0].right_T_left, rig.pairs[0].right_T_left, atol=1e-12)
    np.testing.assert_allclose(loaded.pairs[0].left.body_T_cam, np.eye(4), atol=1e-12)


def test_load_rig_kalibr_invalid_value_raises(tmp_path: Path) -> None:
    path = tmp_path / "camchain-imucam.yaml"
    path.write_text(kalibr_chain(small_rig(1)))
    with pytest.raises(RigError, match=r"no imu.yaml next to.*gyroscope_noise_density: 0.00017"):
        load_rig(path)
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU.replace("update_rate: 200.0", ""))
    with pytest.raises(RigError, match=r"imu.yaml: update_rate is missing.*update_rate: 200.0"):
        load_rig(path)
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    path.write_text(kalibr_chain(small_rig(1), model="fov"))
    with pytest.raises(RigError, match=r"cam0\.distortion_model: unknown model 'fov'"):
        load_rig(path)
    chain = yaml.safe_load(kalibr_chain(small_rig(1)))
    chain["cam1"]["timeshift_cam_imu"] = 0.02
    path.write_text(yaml.safe_dump(chain))
    with pytest.raises(RigError, match=r"timeshift_cam_imu differs by 20.0 ms"):
        load_rig(path)


@pytest.mark.parametrize("sensor_yaml", ["", "missing", "sensor_type: camera\ncomment: TUM\n"])
def test_load_rig_tum_vi_without_sensor_yaml_reads_dso_chain(tmp_path: Path, sensor_yaml: str) -> None:
    rig = small_rig(1)
    write_euroc(tmp_path, pairs=1, frames=1)
    for camera in ("cam0", "cam1"):
        file = tmp_path / "mav0" / camera / "sensor.yaml"
        file.unlink() if sensor_yaml == "missing" else file.write_text(sensor_yaml)
    (tmp_path / "mav0" / "imu0" / "sensor.yaml").unlink()
    (tmp_path / "dso").mkdir()
    (tmp_path / "dso" / "camchain.yaml").write_text(kalibr_chain(rig, model="equidistant"))
    (tmp_path / "dso" / "imu_config.yaml").write_text(KALIBR_IMU)
    loaded = load_rig(tmp_path)
    assert {camera.model for camera in loaded.cameras} == {"equidistant"}
    np.testing.assert_allclose(loaded.pairs[0].right_T_left, rig.pairs[0].right_T_left, atol=1e-12)
    assert loaded.imu == Imu()


def test_load_rig_kitti_odometry(tmp_path: Path) -> None:
    write_kitti_odometry(tmp_path / "07", frames=1)
    rig = load_rig(tmp_path / "07" / "calib.txt")
    assert rig.imu is None
    assert [camera.name for camera in rig.cameras] == ["image_0", "image_1"]
    assert rig.pairs[0].left.size_px == (64, 48)
    np.testing.assert_allclose(rig.pairs[0].left.intrinsics, [70, 70, 31.5, 23.5])
    # P1's 4th column is -f b: the right camera is b = 0.5 m to the right of the left one
    np.testing.assert_allclose(rig.pairs[0].right.body_T_cam[:3, 3], [0.5, 0, 0], atol=1e-12)
    assert_same(rig, load_rig(tmp_path / "07"))


def test_load_rig_kitti_without_grey_images_reads_colour_pair(tmp_path: Path) -> None:
    write_kitti_odometry(tmp_path, frames=1, cameras=(2, 3))
    rig = load_rig(tmp_path)
    assert [camera.name for camera in rig.cameras] == ["image_2", "image_3"]
    left = rig.pairs[0].left
    P = np.array(KITTI_P[2].split(), dtype=float).reshape(3, 4)
    point = np.array([0.3, -0.2, 4.0])  # in the frame of the rectified grey left camera, which is body
    u, v, w = P @ [*point, 1.0]
    pixels, valid = left.project((se3_inverse(left.body_T_cam) @ [*point, 1.0])[None, :3])
    assert valid.all()
    np.testing.assert_allclose(pixels[0], [u / w, v / w], atol=1e-9)


def test_load_rig_kitti_raw(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path / "2011_09_26", frames=1)
    for path in (drive, tmp_path / "2011_09_26" / "calib_cam_to_cam.txt"):
        rig = load_rig(path)
        assert [camera.name for camera in rig.cameras] == ["image_00", "image_01"]
        assert rig.pairs[0].baseline_m == pytest.approx(0.5)
        assert rig.pairs[0].left.size_px == (64, 48)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("P1:", "Q1:", "P1 is missing"),
        (KITTI_P[1], "1 2 3", "P1: holds 3 numbers"),
        (KITTI_P[1], KITTI_P[1].replace("-3.5e+01", "x"), "P1: is not numeric"),
        (KITTI_P[1], KITTI_P[0], "baseline is 0.000 mm"),
        (KITTI_P[1], KITTI_P[1].replace("-3.5e+01", "nan"), "finite"),
    ],
)
def test_load_rig_kitti_invalid_value_raises(tmp_path: Path, old: str, new: str, message: str) -> None:
    write_kitti_odometry(tmp_path, frames=1)
    file = tmp_path / "calib.txt"
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(RigError, match=message):
        load_rig(tmp_path)


def test_load_rig_kitti_without_images_raises(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text("P0: 1")
    with pytest.raises(RigError, match="image size"):
        load_rig(tmp_path / "calib.txt")


def test_find_rig_several_chains_raises(tmp_path: Path) -> None:
    for name in ("a-camchain.yaml", "b-camchain.yaml"):
        (tmp_path / name).write_text(kalibr_chain(small_rig(1)))
    with pytest.raises(RigError, match="several camera chains"):
        find_rig(tmp_path)


@pytest.mark.skipif(not (REAL_DATA / "euroc_mh01_clip").is_dir(), reason="the real EuRoC clip is not here")
def test_load_rig_real_euroc_calibration() -> None:
    rig = load_rig(REAL_DATA / "euroc_mh01_clip")
    assert rig.pairs[0].baseline_m == pytest.approx(0.110078, abs=1e-5)
    assert rig.imu is not None
    assert rig.imu.gyro_noise_density == 1.6968e-4
    np.testing.assert_allclose(
        rig.pairs[0].left.body_T_cam[:3, 3], [-0.0216401454975, -0.064676986768, 0.00981073058949]
    )
