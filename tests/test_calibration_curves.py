"""The calibration as curves in handy units, and the picture of a run's calibration."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from graphvio.arrays import Float
from graphvio.results.calibration_plot import CalibrationHistory
from graphvio.rig import Rig
from graphvio.self_calibration.curves import curves_of, values_of, with_sigma
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.evidence import Gaussian
from graphvio.self_calibration.parameters import BODY, PAIR, PLACE, SINGLE, STEREO, parameter_names
from graphvio.self_calibration.prior import file_prior
from graphvio.simulation.default_rig import default_rig


def estimate_of(rig: Rig, difference: Float) -> CalibrationEstimate:
    prior = file_prior(rig)
    posterior = Gaussian(difference, np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64))
    return CalibrationEstimate(rig, posterior, difference, np.ones(prior.n_groups))


def values_by_name(rig: Rig, difference: Float) -> dict[tuple[str, str], tuple[float, float]]:
    curves = curves_of(rig)
    values, sigmas = values_of(curves, estimate_of(rig, difference))
    return {(c.group, c.name): (float(v), float(s)) for c, v, s in zip(curves, values, sigmas, strict=True)}


def test_curves_have_their_units_and_the_file_s_standard_deviations() -> None:
    rig = default_rig()
    index = {name: i for i, name in enumerate(parameter_names(rig))}
    difference = np.zeros(len(index))
    difference[index["cam0.fx_px"]] = 0.01 * rig.pairs[0].left.intrinsics[0]
    difference[index["cam3.cy_px"]] = 0.7
    stereo = PAIR + STEREO
    difference[stereo + 1] = np.deg2rad(0.2)
    difference[stereo + 3 : stereo + 6] = 0.002 * rig.pairs[1].right_T_left[:3, 3]
    difference[BODY + 2], difference[PAIR + BODY + 2] = np.deg2rad([1.0, 1.25])
    difference[BODY + 4], difference[PAIR + BODY + 4] = 0.003, 0.001
    difference[index["imu.gyro_matrix.yy"]] = 0.004
    difference[index["imu.time_offset_s"]] = -0.0015
    found = values_by_name(rig, difference)
    front, back = (pair.left.body_T_cam[:3, 3] for pair in rig.pairs)
    turned_mm = 1e3 * np.cross([0.0, 0.0, np.deg2rad(1.0)], back - front)  # of both pairs together
    expected = {
        ("focal lengths", "cam0 fx"): (1.0, 0.1),
        ("principal points", "cam3 cy"): (0.7, 0.5),
        ("left to right, rotation", "back y"): (0.2, 0.05),
        ("baselines", "back"): (0.2, 0.2),
        ("pairs against front, rotation", "back z"): (0.25, 0.3),
        ("pairs against front, translation", "back y"): (-2.0 - turned_mm[1], 5.0),
        ("pairs against front, translation", "back x"): (-turned_mm[0], 5.0),
        ("cameras to IMU, rotation", "z"): (1.0, 0.3),
        ("cameras to IMU, translation", "y"): (3.0, np.hypot(5.0, 1e3 * np.deg2rad(0.3) * np.hypot(*front[[0, 2]]))),
        ("IMU, gyro's scale", "y"): (0.4, 0.3),
        ("IMU, time offset", ""): (-1.5, 2.0),
    }
    for name, value in expected.items():
        assert found.pop(name) == pytest.approx(value), name
    assert [value for value, _ in found.values()] == pytest.approx(np.zeros(len(found)))


def test_curves_of_single_cameras_are_of_lenses_and_of_places_against_the_first() -> None:
    rig = default_rig().without_pairs()
    index = {name: i for i, name in enumerate(parameter_names(rig))}
    difference = np.zeros(len(index))
    difference[index["cam3.cy_px"]] = 0.7
    difference[SINGLE + PLACE + 1] = np.deg2rad(0.2)
    difference[index["imu.time_offset_s"]] = -0.0015
    found = values_by_name(rig, difference)
    assert found[("principal points", "cam3 cy")] == pytest.approx((0.7, 0.5))
    assert found[("cameras against cam0, rotation", "cam1 y")] == pytest.approx((0.2, 0.3))
    assert found[("IMU, time offset", "")] == pytest.approx((-1.5, 2.0))
    assert not any(group.startswith(("left to right", "baselines", "pairs")) for group, _ in found)
    assert sum(group == "cameras against cam0, translation" for group, _ in found) == 9


def test_curves_without_imu_have_no_imu() -> None:
    groups = {curve.group for curve in curves_of(default_rig().without_imu())}
    assert "focal lengths" in groups
    assert not any("IMU" in group for group in groups)


def test_with_sigma_shows_two_digits_of_the_standard_deviation() -> None:
    assert with_sigma(0.04567, 0.0234) == "+0.046 ± 0.023"
    assert with_sigma(-123.4, 12.3) == "-123 ± 12"


@pytest.mark.parametrize("has_imu", [True, False])
def test_picture_shows_steps_where_the_calibration_changed(tmp_path: Path, has_imu: bool) -> None:
    rig = default_rig().with_pairs([0])
    rig = rig if has_imu else rig.without_imu()
    zero = np.zeros(len(parameter_names(rig)))
    pictures = []
    for size in (0.0, 3.0):
        history = CalibrationHistory()
        history.add(0, estimate_of(rig, zero))
        history.add(5_000_000_000, estimate_of(rig, size * np.sqrt(np.diag(file_prior(rig).covariance))))
        path = tmp_path / f"{size}.png"
        history.plot(path, 10_000_000_000, "walk")
        picture = cv2.imread(str(path))
        assert picture is not None
        pictures.append(picture)
    flat, moved = pictures
    assert flat.shape == moved.shape
    blue = [int((np.abs(each.astype(int) - (0xBF, 0x5F, 0x1F)).max(axis=2) < 12).sum()) for each in pictures]
    assert blue[0] > 300  # the first curve of each panel
    assert blue[1] > 1.05 * blue[0]  # with steps, which are vertical lines


def test_estimate_joins_the_imus_matrices_to_those_of_the_file() -> None:
    rig = default_rig()
    assert rig.imu is not None
    of_file = np.eye(3) + 0.01 * np.eye(3, k=1)
    rig = replace(rig, imu=replace(rig.imu, gyro_matrix=tuple(of_file.ravel().tolist())))
    names = parameter_names(rig)
    difference = np.zeros(len(names))
    difference[names.index("imu.gyro_matrix.yy")] = 0.02
    difference[names.index("imu.accel_matrix.zx")] = 0.003
    refined = estimate_of(rig, difference).rig
    assert refined.imu is not None
    gyro, accel = refined.imu.matrices
    assert gyro == pytest.approx(np.diag([1.0, 1.02, 1.0]) @ of_file)
    assert accel[2, 0] == pytest.approx(0.003)
