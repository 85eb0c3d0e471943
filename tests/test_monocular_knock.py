"""Knocks in rigs of single cameras: what overlapping views show, and what a window knows afterwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import random_transform
from test_monocular import Flown, Tracks, aligned, fewer, fly, moving, overlapping_rig

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.geometry import se3, se3_inverse, se3_log, so3_exp
from graphvio.monocular.calibration import WindowCalibration
from graphvio.monocular.estimator import MonocularEstimator
from graphvio.monocular.knock import OverlapKnockDetector
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.sightings import Views
from graphvio.monocular.states import States
from graphvio.monocular.window_prior import Prior
from graphvio.self_calibration.evidence import Evidence
from graphvio.self_calibration.parameters import extrinsics_of, n_camera_parameters
from graphvio.simulation.default_rig import default_rig

RIG = default_rig().without_pairs()
CAMERAS = Cameras.of(RIG)
NOISE_PX = 0.15
NO_DIFFERENCE: Float = np.zeros(n_camera_parameters(RIG))
KNOWN = NO_DIFFERENCE, lambda: 1e-10 * np.eye(len(NO_DIFFERENCE) + 19)
"""A calibration that is known to 0.0006 degrees and 0.01 mm."""


def turned(camera: int, axis: tuple[float, float, float], degrees: float) -> Cameras:
    """Return the true cameras after one of them was turned about an axis of its own."""
    places = CAMERAS.body_T_cam.copy()
    places[camera] = places[camera] @ se3(so3_exp(np.deg2rad(degrees) * np.array(axis)), np.zeros(3))
    return CAMERAS._replace(body_T_cam=places)


def views(cameras: Cameras, rng: np.random.Generator, speed_px: float = 0.0, count: int = 80) -> Views:
    """Return views of the same points in cameras 0 and 1.

    Args:
        cameras: true cameras.
        rng: source of points and noise.
        speed_px: shift of all views in camera 1 along its y axis, as of a camera that is late in a turn.
        count: number of points.
    """
    points = np.column_stack([rng.uniform(-1.0, 1.0, (count, 2)), rng.uniform(2.0, 8.0, count)])
    points[:, :2] *= points[:, 2:] * 0.5
    in_body = points @ cameras.body_T_cam[0, :3, :3].T + cameras.body_T_cam[0, :3, 3]
    rays = []
    for camera in (0, 1):
        cam_T_body = se3_inverse(cameras.body_T_cam[camera])
        seen = in_body @ cam_T_body[:3, :3].T + cam_T_body[:3, 3]
        noise = NOISE_PX / CAMERAS.focal_px[camera] * rng.standard_normal((count, 2))
        rays.append(seen[:, :2] / seen[:, 2:] + noise)
    rays[1][:, 1] += speed_px / CAMERAS.focal_px[1]
    seen_by, landmark = np.repeat([0, 1], count), np.tile(np.arange(count), 2)
    return Views(
        seen_by, seen_by, landmark, landmark, np.concatenate(rays), np.zeros((2 * count, 4)), np.zeros(2 * count, bool)
    )


def found(
    cameras: list[Cameras], seed: int = 0, speeds_px: Float | None = None, count: int = 80
) -> list[frozenset[int]]:
    """Return the cameras that are found at each keyframe."""
    detector, rng = OverlapKnockDetector(CAMERAS), np.random.default_rng(seed)
    speeds = np.zeros(len(cameras)) if speeds_px is None else speeds_px
    return [
        detector.update(views(each, rng, speed, count), *KNOWN) for each, speed in zip(cameras, speeds, strict=True)
    ]


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.5, 0.5, 0.7)])
def test_turned_camera_is_found_at_the_third_keyframe(camera: int, axis: tuple[float, float, float]) -> None:
    knocked = turned(camera, axis, 0.15)
    assert found([CAMERAS] * 10 + [knocked] * 3) == [frozenset()] * 12 + [frozenset({0, 1})]


@pytest.mark.parametrize(
    "case",
    [
        [CAMERAS] * 40,
        [turned(1, (1.0, 0.0, 0.0), 0.5)] * 40,  # as wrong from the beginning: the file's error
        [CAMERAS] * 10 + [turned(1, (0.0, 1.0, 0.0), 0.1)] * 10,  # along the epipolar lines
        [CAMERAS] * 10 + [turned(1, (1.0, 0.0, 0.0), 0.02)] * 10,  # by less than a quarter of a pixel
        [CAMERAS] * 10 + [turned(1, (1.0, 0.0, 0.0), 0.5)] * 2 + [CAMERAS] * 10,  # for two keyframes
        [CAMERAS] * 6 + [turned(1, (1.0, 0.0, 0.0), 0.5)] * 7,  # too little was known before
    ],
)
def test_no_knock_is_found_where_offsets_do_not_change_and_stay(case: list[Cameras]) -> None:
    for seed in range(5):
        assert set(found(case, seed)) == {frozenset()}


def test_late_camera_is_no_knock() -> None:
    """Its offset changes with the speed of the turn."""
    speeds_px = np.concatenate([np.zeros(10), 4.0 * np.sin(0.5 * np.arange(40))])
    assert set(found([CAMERAS] * 50, 0, speeds_px)) == {frozenset()}


def test_few_common_landmarks_show_no_knock() -> None:
    assert set(found([CAMERAS] * 10 + [turned(1, (1.0, 0.0, 0.0), 0.5)] * 10, count=29)) == {frozenset()}


@pytest.mark.parametrize(("sigma_m", "is_found"), [(1e-5, True), (1e-3, False)])
def test_change_that_the_covariance_of_the_places_explains_is_no_knock(sigma_m: float, is_found: bool) -> None:
    """As where a wall comes near, and a camera is not exactly where it is believed to be."""
    detector, rng = OverlapKnockDetector(CAMERAS), np.random.default_rng(0)
    covariance = sigma_m**2 * np.eye(len(NO_DIFFERENCE) + 19)
    found = [
        detector.update(views(cameras, rng), NO_DIFFERENCE, lambda: covariance)
        for cameras in [CAMERAS] * 10 + [turned(1, (1.0, 0.0, 0.0), 0.15)] * 4
    ]
    assert (frozenset({0, 1}) in found) == is_found


def test_rolling_shutters_show_no_knock() -> None:
    detector, rng = OverlapKnockDetector(CAMERAS), np.random.default_rng(0)
    for cameras in [CAMERAS] * 10 + [turned(1, (1.0, 0.0, 0.0), 0.5)] * 4:
        seen = views(cameras, rng)
        assert detector.update(seen._replace(readout=seen.readout + 0.01), *KNOWN) == frozenset()


def test_only_places_of_knocked_cameras_become_uncertain() -> None:
    calibration = WindowCalibration(RIG)
    assert calibration.file() is None
    change = calibration.release_places({1})
    file = calibration.file()
    assert file is not None
    assert not calibration.is_file_exact
    sigmas = np.sqrt(np.diag(np.linalg.inv(file.information)))
    places = np.arange(calibration.size)[extrinsics_of(RIG, 1)]
    others = np.setdiff1d(np.arange(calibration.size), places)
    stated = np.sqrt(np.diag(WindowCalibration(RIG)._prior.covariance))
    assert (sigmas[places[:3]] > np.deg2rad(0.25)).all()
    assert (sigmas[places[3:]] > 0.004).all()
    assert (sigmas[others] < 0.01 * stated[others]).all()
    np.testing.assert_array_equal(np.flatnonzero(np.diag(change)), places)


def test_knock_after_a_correction_of_the_file_is_in_the_prior() -> None:
    calibration = WindowCalibration(RIG)
    calibration.begin(np.ones(2))
    before = calibration.file()
    change = calibration.release_places({1})
    after = calibration.file()
    assert before is not None
    assert after is not None
    added = np.linalg.inv(after.information) - np.linalg.inv(before.information)
    np.testing.assert_allclose(added, change, rtol=1e-3, atol=1e-9)


def test_knock_of_a_camera_that_is_well_known_is_possible() -> None:
    sigmas = replace(RIG.calibration_sigmas, pair_rotation_deg=0.006, body_rotation_deg=0.006)
    calibration = WindowCalibration(replace(RIG, calibration_sigmas=sigmas))
    difference = np.zeros(calibration.size)
    difference[extrinsics_of(RIG, 1)][0] = np.deg2rad(2.0)
    assert not calibration.is_possible(difference)
    calibration.release_places({1})
    assert calibration.is_possible(difference)


def test_file_stays_exact_but_for_a_knock_until_the_evidence_is_strong() -> None:
    """By as much as without a knock, for the other camera."""
    for knocked in (set[int](), {1}):
        for sigmas, is_exact in ((4.0, True), (12.0, False)):
            calibration = WindowCalibration(RIG)
            if knocked:
                calibration.release_places(knocked)
            stated = np.sqrt(np.diag(WindowCalibration(RIG)._prior.covariance))
            information, vector = np.zeros((calibration.size, calibration.size)), np.zeros(calibration.size)
            at = extrinsics_of(RIG, 0).start
            information[at, at] = 1e4 / stated[at] ** 2
            vector[at] = information[at, at] * sigmas * stated[at] * 0.01
            assert calibration.update(Evidence(information, vector)) != is_exact


def test_calibration_after_a_restart_of_the_imu_keeps_the_knock() -> None:
    calibration = WindowCalibration(RIG)
    calibration.release_places({1})
    begun = calibration.after_restart()
    assert not begun.is_file_exact
    assert begun.size == calibration.size


def test_evidence_about_knocked_cameras_is_forgotten() -> None:
    calibration = WindowCalibration(RIG)
    size = calibration.size
    calibration._evidence = Evidence(1e12 * np.eye(size), np.zeros(size))
    change = calibration.release_places({0})
    kept = np.diag(calibration._evidence.information)
    changed = np.diag(change) > 0.0
    np.testing.assert_allclose(kept[changed], 1.0 / (np.diag(change)[changed] + 1e-12), rtol=1e-6)
    np.testing.assert_allclose(kept[~changed], 1e12)


def test_prior_after_a_change_is_that_of_the_changed_variables() -> None:
    """Covariance and mean, where the prior determines all of them."""
    rng, n_free = np.random.default_rng(3), n_camera_parameters(RIG) + 19
    size = 9 + 9 + n_free
    root = rng.standard_normal((size, size))
    information, gradient = root @ root.T + np.eye(size), rng.standard_normal(size)
    states = States(
        np.zeros(1, dtype=np.int64), random_transform(rng, 0.1, 1.0)[None], np.zeros((1, 3)), np.zeros(3), np.zeros(6)
    )
    prior = Prior(replace(states, calibration=np.zeros(n_free)), information, gradient)
    change = WindowCalibration(RIG).release_places({0, 1})
    after = prior.after_change(change)
    covariance = np.linalg.inv(information)
    covariance[-n_free:, -n_free:] += change
    np.testing.assert_allclose(np.linalg.inv(after.information), covariance, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.solve(after.information, after.gradient), np.linalg.solve(information, gradient), rtol=1e-5, atol=1e-8
    )


def flown_with_a_knock(
    axis: tuple[float, float, float], degrees: float, config: Config | None = None
) -> tuple[Flown, float]:
    """Fly two cameras of which one is turned after 5 s; return also the error of their relative rotation, degrees."""
    rig = overlapping_rig()
    other = rig.singles[1].left
    knocked = replace(
        other, body_T_cam=other.body_T_cam @ se3(so3_exp(np.deg2rad(degrees) * np.array(axis)), np.zeros(3))
    )

    def knock(t: float, _: MonocularEstimator, tracks: Tracks) -> None:
        tracks._cameras[1] = knocked if t >= 5.0 else other

    flown = fly(moving(), 10.0, fewer, rig=rig, on_keyframe=knock, config=config)
    estimate = flown.estimator.calibration
    if estimate is None:
        return flown, degrees
    first, second = (single.left.body_T_cam for single in estimate.rig.singles)
    error = se3_log(
        se3_inverse(se3_inverse(first) @ second) @ se3_inverse(rig.singles[0].left.body_T_cam) @ knocked.body_T_cam
    )
    return flown, float(np.rad2deg(np.linalg.norm(error[:3])))


def test_knock_is_followed() -> None:
    flown, error_deg = flown_with_a_knock((0.48, 0.64, 0.6), 0.5)
    assert [kind for kind, _ in flown.events].count("calibration_changed") == 1
    assert error_deg < 0.02
    error_m, scale = aligned(flown)
    assert error_m < 0.015
    assert scale == pytest.approx(1.0, abs=0.01)
    steps, true_steps = (np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (flown.poses, flown.truth))
    assert np.linalg.norm((steps - true_steps)[:, :3, 3], axis=1).max() < 0.01  # the trajectory has no step


def test_knock_is_not_looked_for_where_the_calibration_is_not_estimated() -> None:
    flown, _ = flown_with_a_knock((0.48, 0.64, 0.6), 0.5, Config.from_yaml("calibration: {online: false}"))
    assert "calibration_changed" not in [kind for kind, _ in flown.events]


def test_flight_without_a_knock_shows_none() -> None:
    flown, _ = flown_with_a_knock((1.0, 0.0, 0.0), 0.0)
    assert [kind for kind, _ in flown.events] == ["scale_known"]
