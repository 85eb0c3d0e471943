"""Self-calibration of a single camera beside a pair, on tracks without images."""

import numpy as np
from scipy.stats import chi2
from walked_views import Walk, calibrated, true_difference

from graphvio.arrays import Float
from graphvio.geometry import se3_exp, so3_log
from graphvio.rig import Rig
from graphvio.self_calibration.online import SelfCalibration
from graphvio.self_calibration.parameters import PAIR, SINGLE, moved_cameras, n_camera_parameters, parameter_names
from graphvio.self_calibration.window import inverse_depths_of_tracks
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.simulation.named_rigs import stereo_and_back

CAMERAS = ["focal", "principal-point", "distortion", "left-right-rotation", "baseline", "pair-transform"]


def against_pair(rig: Rig) -> Float:
    return rig.pairs[0].left.cam_T_body @ rig.singles[0].left.body_T_cam


def angle_deg(one: Float, other: Float) -> float:
    return float(np.rad2deg(np.linalg.norm(so3_log(np.ascontiguousarray(one[:3, :3] @ other[:3, :3].T)))))


def sampled(level: int, seed: int) -> tuple[Rig, Rig]:
    error = draw(stereo_and_back(), CalibrationErrorSizes.of_level(level, CAMERAS), seed)
    return error.written_rig.without_imu(), error.true_rig.without_imu()


def test_self_calibration_finds_the_lens_and_the_place_of_a_single_camera() -> None:
    before_deg: list[float] = []
    after_deg: list[float] = []
    before_px: list[float] = []
    after_px: list[float] = []
    normalised = []
    for seed in range(4):
        written, true = sampled(2, seed)
        estimate = calibrated(SelfCalibration(written), Walk(true, seed=seed), 12.0).estimate
        for rig, turned_deg, off_px in ((written, before_deg, before_px), (estimate.rig, after_deg, after_px)):
            turned_deg.append(angle_deg(against_pair(rig), against_pair(true)))
            off_px.append(np.abs(rig.singles[0].left.intrinsics - true.singles[0].left.intrinsics)[2:].max())
        single = slice(PAIR, PAIR + SINGLE)
        off = (estimate.posterior.mean - true_difference(written, true))[single]
        normalised.append(off @ np.linalg.solve(estimate.posterior.covariance[single, single], off))
    assert max(after_deg) < 0.03 < 0.1 * np.median(before_deg)
    assert np.median(after_px) < 0.5 * np.median(before_px)
    assert np.mean(normalised) < chi2.ppf(0.999, 4 * SINGLE) / 4


def test_self_calibration_of_exact_files_with_a_single_camera_leaves_them_alone() -> None:
    rig = stereo_and_back().without_imu()
    for seed in range(3):
        assert calibrated(SelfCalibration(rig), Walk(rig, seed=seed), 8.0).estimate.rig is rig


def test_inverse_depths_of_tracks_are_those_of_points_seen_from_known_places() -> None:
    rng, step = np.random.default_rng(4), 0.2 * np.array([0.1, -0.2, 0.05, 1.0, 0.5, -0.2])
    cameras = [se3_exp(k * step) for k in range(3)]
    points = np.column_stack([rng.uniform(-1, 1, (20, 2)), rng.uniform(2, 8, 20)])
    still = np.zeros(20, dtype=bool)
    still[15:] = True  # seen from one place only
    ids = np.repeat(np.arange(20), 3)
    odom_T_cam = np.array([cameras[0] if still[i] else each for i in range(20) for each in cameras])
    seen = np.einsum("nji,nj->ni", odom_T_cam[:, :3, :3], points[ids] - odom_T_cam[:, :3, 3])
    found, is_known = inverse_depths_of_tracks(ids, seen[:, :2] / seen[:, 2:], odom_T_cam)
    np.testing.assert_array_equal(is_known, ~still[ids])
    np.testing.assert_allclose(found[is_known], (1.0 / points[:, 2])[ids[is_known]], rtol=1e-9)
    assert [len(column) for column in inverse_depths_of_tracks(ids[:0], np.zeros((0, 2)), odom_T_cam[:0])] == [0, 0]


def test_parameters_of_pairs_and_single_cameras_are_in_one_vector() -> None:
    rig = stereo_and_back().without_imu()
    names = parameter_names(rig)
    assert len(names) == n_camera_parameters(rig) == PAIR + SINGLE
    difference = np.zeros(len(names))
    difference[names.index("cam2.cx_px")], difference[names.index("cam2.body_T_cam.ty")] = 0.7, 0.02
    moved = moved_cameras(rig, difference)
    for one, other in zip(moved.pairs[0].cameras, rig.pairs[0].cameras, strict=True):
        np.testing.assert_allclose(one.body_T_cam, other.body_T_cam, atol=1e-15)
        np.testing.assert_array_equal(one.intrinsics, other.intrinsics)
    np.testing.assert_allclose(moved.singles[0].left.intrinsics - rig.singles[0].left.intrinsics, [0, 0, 0.7, 0])
    shift = (moved.singles[0].left.body_T_cam - rig.singles[0].left.body_T_cam)[:3, 3]
    np.testing.assert_allclose(shift, [0.0, 0.02, 0.0], atol=1e-15)
