"""Self-calibration on tracks without images: what it finds, how certain it is, and what it must leave alone."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from walked_views import RATE_HZ, Walk, calibrated, true_difference

from graphvio.arrays import Float
from graphvio.calibration_sigmas import LEVELS
from graphvio.cameras import MODEL_NAMES
from graphvio.errors import RigError
from graphvio.geometry import se3_exp, so3_exp, so3_log
from graphvio.linear_algebra import eliminated, inverse, solve_symmetric
from graphvio.measurements.sensors import GRAVITY_M_S2, ImuSample
from graphvio.rig import Rig
from graphvio.rig_files import load_rig, save_rig
from graphvio.self_calibration import solver, window_adjustment
from graphvio.self_calibration.adjustment import adjusted
from graphvio.self_calibration.bundle import Eliminated, Tracks, eliminate_landmarks
from graphvio.self_calibration.collector import FullWindow, WindowCollector
from graphvio.self_calibration.evidence import (
    _FACTORS,
    EXACT,
    MAX_FACTOR,
    Evidence,
    FactorLikelihood,
    FilePrior,
    Gaussian,
)
from graphvio.self_calibration.findings import contradiction, described
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.knock import KnockDetector, epipolar_offset_px
from graphvio.self_calibration.observation import COLUMNS, ERROR_AT, new_scratch, observe
from graphvio.self_calibration.online import SelfCalibration
from graphvio.self_calibration.parameters import (
    BODY,
    CAMERA,
    DISTORTION,
    INTRINSICS,
    PAIR,
    RigCalibration,
    has_coefficient,
    n_camera_parameters,
    parameter_names,
)
from graphvio.self_calibration.prior import file_prior, refined_sigmas
from graphvio.self_calibration.solver import Solution, States, Window, solve
from graphvio.self_calibration.window import Keyframe, View, choose_tracks
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.simulation.default_rig import default_rig
from graphvio.simulation.motion import Motion

CAMERAS = ["focal", "principal-point", "distortion", "left-right-rotation", "baseline", "pair-transform"]


LENSES = {
    "equidistant": [0.02, -0.01, 0.003, -0.001],
    "rational": [0.3, -0.05, 3e-4, -2e-4, 0.01, 0.4, -0.03, 0.02],
    "double-sphere": [-0.2, 0.6],
    "extended-unified": [0.6, 1.1],
    "omnidirectional": [1.2, -0.1, 0.05, 3e-4, -2e-4],
}


def rig_of(model: str) -> Rig:
    rig = default_rig().without_imu()
    if model == "radial-tangential":
        return rig
    return rig.with_cameras(lambda camera: replace(camera, model=model, distortion=np.array(LENSES[model])))


# ---------------------------------------------------------------- derivatives and equations


@pytest.mark.parametrize("model", MODEL_NAMES)
@pytest.mark.parametrize("pair", [0, 1])
def test_observe_derivatives_equal_finite_differences(model: str, pair: int) -> None:
    calibration = RigCalibration.of(rig_of(model))
    rng = np.random.default_rng(1)
    pose = se3_exp(0.3 * rng.standard_normal(6))
    odom_T_landmark = pose @ calibration.body_T_left[pair] @ se3_exp(0.05 * rng.standard_normal(6))
    landmark = np.array([0.2, -0.1, 0.5])

    def rows_after(pose_step: Float, calibration_step: Float, point_step: Float) -> Float:
        moved = pose.copy()
        moved[:3, 3] += pose[:3, :3] @ pose_step[3:]
        moved[:3, :3] = pose[:3, :3] @ so3_exp(pose_step[:3].copy())
        rows, step = np.zeros((4, COLUMNS)), np.zeros((2, PAIR))
        step[pair] = calibration_step
        filled = observe(
            moved, calibration.moved(step.ravel()), pair, odom_T_landmark, landmark + point_step, np.zeros(2),
            np.zeros(2), True, new_scratch(), rows,
        )  # fmt: skip
        assert filled == 4
        return rows

    analytic, h = rows_after(np.zeros(6), np.zeros(PAIR), np.zeros(3)), 1e-6
    kept = [6 + at + INTRINSICS + np.flatnonzero(~has_coefficient(rig_of(model).cameras[0])) for at in (0, CAMERA)]
    assert not analytic[:, np.concatenate(kept)].any()
    for column in np.setdiff1d(np.arange(ERROR_AT), np.concatenate(kept)):
        step = np.zeros(ERROR_AT)
        step[column] = h
        after, before = (rows_after(*np.split(sign * step, [6, 6 + PAIR]))[:, ERROR_AT] for sign in (1.0, -1.0))
        assert analytic[:, column] == pytest.approx((after - before) / (2.0 * h), abs=1e-5)


@pytest.mark.parametrize("model", LENSES)
def test_file_prior_knows_each_coefficient_of_the_lens_and_keeps_those_it_does_not_have(model: str) -> None:
    rig = rig_of(model)
    sigmas = np.sqrt(np.diag(file_prior(rig).covariance))
    of_first = sigmas[INTRINSICS:CAMERA]
    assert ((of_first > 1e-6) == has_coefficient(rig.cameras[0])).all()
    assert (of_first[~has_coefficient(rig.cameras[0])] <= 1e-9).all()
    moved = RigCalibration.of(rig).moved(0.01 * sigmas).applied_to(rig)
    for one, other in zip(moved.cameras, rig.cameras, strict=True):
        np.testing.assert_array_equal(one.distortion[DISTORTION:], other.distortion[DISTORTION:])


def test_eliminate_landmarks_gradient_equals_that_of_the_cost_over_all_unknowns() -> None:
    rig = rig_of("radial-tangential")
    walk, calibration = Walk(rig, sigma_px=0.3), RigCalibration.of(rig)
    poses = np.array([walk.pose(0.0), walk.pose(0.3)])
    views = [walk.views(pose)[0] for pose in poses]
    ids = np.intersect1d(views[0].ids, views[1].ids)[:20]
    rows = [np.searchsorted(view.ids, ids) for view in views]
    n = len(ids)
    order = np.argsort(np.tile(np.arange(n), 2), kind="stable")

    def column(field: int) -> Float:
        both = [view[field][at] for view, at in zip(views, rows, strict=True)]
        joined: Float = np.ascontiguousarray(np.concatenate(both)[order])
        return joined

    tracks = Tracks(
        np.zeros(n, dtype=np.int64), np.tile(poses[0] @ calibration.body_T_left[0], (n, 1, 1)),
        np.arange(0, 2 * n + 1, 2), np.tile([0, 1], n), column(1), column(2), column(3).astype(bool),
        np.full(2 * n, 0.3),
    )  # fmt: skip
    landmarks = np.column_stack([rig.pairs[0].left.unproject(column(1)[::2])[0], column(4)[::2]])
    size = 12 + 2 * PAIR
    hessian, gradient, found = np.zeros((size, size)), np.zeros(size), Eliminated.empty(tracks)
    eliminate_landmarks(poses, calibration, landmarks, tracks, 2.5, 0.0, hessian, gradient, found)
    h, numeric = 1e-6, np.zeros(12)
    for k in range(12):
        costs = []
        for sign in (1.0, -1.0):
            moved, step = poses.copy(), np.zeros(12)
            step[k] = sign * h
            for i, of_pose in enumerate(step.reshape(2, 6)):
                moved[i, :3, 3] += poses[i, :3, :3] @ of_pose[3:]
                moved[i, :3, :3] = poses[i, :3, :3] @ so3_exp(of_pose[:3].copy())
            unused = np.zeros((size, size)), np.zeros(size), Eliminated.empty(tracks)
            costs.append(eliminate_landmarks(moved, calibration, landmarks, tracks, 2.5, 0.0, *unused)[0])
        numeric[k] = (costs[0] - costs[1]) / (2.0 * h)
    # The eliminated gradient is that of the poses less what the landmarks take over.
    couplings = np.zeros(12)
    for point in range(n):
        taken = found.inverse[point] @ found.gradient[point]
        for at in (2 * point, 2 * point + 1):
            k = 6 * int(tracks.keyframe[at])
            couplings[k : k + 6] += found.by_pose[at].T @ taken
    assert gradient[:12] + couplings == pytest.approx(numeric, rel=1e-4, abs=1e-2)
    assert np.linalg.eigvalsh(hessian).min() > -1e-6 * np.abs(hessian).max()


def test_solve_symmetric_inverse_and_eliminated_agree_with_numpy() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((40, 40))
    matrix, right = root @ root.T + np.eye(40), rng.standard_normal(40)
    assert solve_symmetric(matrix, right) == pytest.approx(np.linalg.solve(matrix, right))
    expected = matrix[30:, 30:] - matrix[30:, :30] @ np.linalg.solve(matrix[:30, :30], matrix[:30, 30:])
    assert eliminated(matrix, 10) == pytest.approx(expected)
    assert inverse(matrix) == pytest.approx(np.linalg.inv(matrix), abs=1e-12)
    assert np.isnan(inverse(-matrix)).all()


# ---------------------------------------------------------------- how wrong the file is


def test_file_factor_of_sampled_errors_is_near_the_true_one() -> None:
    rng = np.random.default_rng(0)
    prior = FilePrior(np.diag(rng.uniform(0.5, 2.0, 60)), np.zeros(60, dtype=np.int64))
    for true_factor in (0.3, 1.0, 3.0):
        found = []
        for _ in range(20):
            x = true_factor * np.sqrt(np.diag(prior.covariance)) * rng.standard_normal(60)
            information = np.diag(rng.uniform(100.0, 1000.0, 60))
            noise = np.linalg.cholesky(np.linalg.inv(information)) @ rng.standard_normal(60)
            found.append(Evidence(information, information @ (x + noise)).file_factors(prior, np.zeros(1))[0][0])
        assert 0.6 * true_factor < np.median(found) < 1.6 * true_factor


def test_file_factor_of_exact_files_is_exact() -> None:
    rng = np.random.default_rng(0)
    prior = FilePrior(np.eye(60), np.zeros(60, dtype=np.int64))
    false_alarms = 0
    for _ in range(200):
        information = np.diag(rng.uniform(100.0, 1000.0, 60))
        noise = np.linalg.cholesky(np.linalg.inv(information)) @ rng.standard_normal(60)
        evidence = Evidence(information, information @ noise)
        factors, twice_log_bayes_factor = evidence.file_factors(prior, np.full(1, 10.0))
        false_alarms += factors[0] != EXACT
        assert twice_log_bayes_factor >= 0.0
    assert false_alarms == 0


@pytest.mark.parametrize("which", [0, 1])
def test_file_factors_of_what_two_groups_explain_are_those_of_the_likelier_one(which: int) -> None:
    """A sum of two parameters is off by six sigma, and one group's other parameters are off as well."""
    prior = FilePrior(np.eye(8), np.repeat([0, 1], 4))
    x = np.where(prior.group == which, [6.0, 1.5, -1.5, 1.5, 1.5, -1.5, 1.5, 6.0], 0.0)
    rows, sigmas = np.eye(8)[:7], np.array([0.01, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    rows[0, 7] = 1.0
    information, vector = rows.T / sigmas**2 @ rows, rows.T / sigmas**2 @ rows @ x
    factors, _ = Evidence(information, vector).file_factors(prior, np.full(2, 10.0))
    assert factors[which] > 1.0
    assert factors[1 - which] == EXACT


def test_mean_square_of_sampled_errors_is_theirs_however_wrong_the_file_is() -> None:
    rng, prior = np.random.default_rng(0), FilePrior(np.diag([1.0, 4.0, 0.25, 1.0]), np.repeat([0, 1], 2))
    information = np.diag([1.0, 4.0, 0.0, 1.0])  # of the third one nothing is seen
    squares, reported = np.zeros((4, 4)), np.zeros((4, 4))
    # Each pair of factors as often as the others: half as many samples are as good as of pairs by chance.
    pairs = 12 * [np.array(each) for each in product(_FACTORS, repeat=2)]
    n = len(pairs)
    for factors in pairs:
        x = prior.of_each(factors) * np.sqrt(np.diag(prior.covariance)) * rng.standard_normal(4)
        noise = np.array([1.0, 0.5, 0.0, 1.0]) * rng.standard_normal(4)
        squares += np.outer(x, x) / n
        reported += Evidence(information, information @ (x + noise)).mean_square(prior, np.zeros(4)) / n
    assert np.diag(reported) == pytest.approx(np.diag(squares), rel=0.15)
    assert np.abs(reported - squares).max() < 0.15 * squares.max()


def test_mean_square_of_what_nothing_shows_is_not_that_of_an_exact_file() -> None:
    prior = FilePrior(np.diag([1.0, 4.0]), np.array([0, 1]))
    found = Evidence(np.diag([1e8, 0.0]), np.zeros(2)).mean_square(prior, np.zeros(2))
    assert found[0, 0] < 1e-7
    assert 1.0 < found[1, 1] / prior.covariance[1, 1] < MAX_FACTOR**2


def test_mean_square_of_what_nothing_shows_stays_that_of_an_estimated_file_though_all_the_others_are_exact() -> None:
    """An estimation before has corrected what measurements show; of what they do not show that says nothing."""
    estimated = FilePrior(np.eye(30), np.zeros(30, dtype=np.int64), estimated=True)
    shown = np.diag([*np.full(29, 1e6), 0.0])
    assert Evidence(shown, np.zeros(30)).mean_square(estimated, np.zeros(30))[29, 29] >= 1.0
    assert Evidence(shown, np.zeros(30)).mean_square(estimated._replace(estimated=False), np.zeros(30))[29, 29] < 0.01


def test_mean_square_is_that_over_all_factors_though_few_are_evaluated() -> None:
    prior = FilePrior(np.diag([1.0, 4.0, 0.25, 1.0, 2.0, 0.5]), np.repeat([0, 1], 3))
    grid, ratios = [np.array(each) for each in product(_FACTORS, repeat=2)], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        rows = rng.standard_normal((rng.integers(1, 8), 6)) * 10.0 ** rng.uniform(-1.0, 3.0)
        x = prior.of_each(rng.choice(_FACTORS, 2)) * np.sqrt(np.diag(prior.covariance)) * rng.standard_normal(6)
        evidence = Evidence(rows.T @ rows, rows.T @ (rows @ x + rng.standard_normal(len(rows))))
        likelihood = FactorLikelihood(evidence, prior)
        twice_log = np.array([likelihood(each) for each in grid])
        weights, expected = np.exp(0.5 * (twice_log - twice_log.max())), np.zeros((6, 6))
        for weight, each in zip(weights / weights.sum(), grid, strict=True):
            posterior = evidence.given(prior, each)
            expected += weight * (posterior.covariance + np.outer(posterior.mean, posterior.mean))
        ratios.append(np.sqrt(np.diag(evidence.mean_square(prior, np.zeros(6))) / np.diag(expected)))
    assert np.max(ratios) < 1.0 + 1e-4
    assert np.percentile(ratios, 1) > 0.99
    assert np.min(ratios) > 0.5


def test_forgotten_evidence_never_gains_and_keeps_the_mean_where_it_is_regular() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((5, 5))
    information = root @ root.T + np.eye(5)
    mean, walk = rng.standard_normal(5), 0.1 * np.eye(5)
    later = Evidence(information, information @ mean).after_random_walk(walk)
    assert np.linalg.inv(later.information) == pytest.approx(np.linalg.inv(information) + walk)
    assert np.linalg.solve(later.information, later.vector) == pytest.approx(mean)
    assert Evidence.none(5).after_random_walk(walk).information == pytest.approx(np.zeros((5, 5)))


def test_with_window_restores_the_posterior() -> None:
    rng = np.random.default_rng(0)
    prior = FilePrior(np.eye(4), np.zeros(4, dtype=np.int64))
    before = Evidence.none(4).given(prior, np.ones(1))
    posterior = Gaussian(rng.standard_normal(4), before.information + np.diag([1.0, 2.0, 0.0, 4.0]))
    again = Evidence.none(4).with_window(before, posterior).given(prior, np.ones(1))
    assert again.mean == pytest.approx(posterior.mean)
    assert again.information == pytest.approx(posterior.information)


# ---------------------------------------------------------------- walks


@pytest.mark.parametrize("level", [1, 2, 3])
def test_self_calibration_in_a_walk_finds_what_the_cameras_show(level: int) -> None:
    turned_deg, against_deg = [], []
    for seed in range(3):
        written, true, _ = sampled(level, seed)
        found = calibrated(SelfCalibration(written), Walk(true, seed=seed), 14.0).estimate
        assert found.file_factors[0] == pytest.approx({1: 0.3, 2: 1.0, 3: 3.0}[level], rel=0.7)
        pairs = list(zip(found.rig.pairs, true.pairs, strict=True))
        turned_deg.append(max(angles_deg(one.right_T_left, other.right_T_left).max() for one, other in pairs))
        against_deg.append(np.linalg.norm(angles_deg(found.rig.left2_T_left1(), true.left2_T_left1())))
        for pair, exact in pairs:
            assert pair.left.intrinsics[:2] == pytest.approx(exact.left.intrinsics[:2], rel=5e-4)
    assert np.median(turned_deg) < 0.005
    assert max(turned_deg) < 0.02
    assert max(against_deg) < 0.03


def angles_deg(one: Float, other: Float) -> Float:
    """Magnitudes (3,) of the rotation between two transforms, about each axis."""
    return np.asarray(np.rad2deg(np.abs(so3_log(np.ascontiguousarray(one[:3, :3] @ other[:3, :3].T)))))


def sampled(level: int, seed: int) -> tuple[Rig, Rig, object]:
    error = draw(default_rig(), CalibrationErrorSizes.of_level(level, CAMERAS), seed)
    return error.written_rig.without_imu(), error.true_rig.without_imu(), error.imu


def test_self_calibration_errors_are_consistent_with_its_covariance() -> None:
    # Windows, noise factor and forgetting make it cautious, never confident: the band is one-sided, with what a wrong
    # linearisation or counting twice would give (several times the dimension) far outside.
    normalised = []
    for seed in range(8):
        written, true, _ = sampled(2, seed)
        found = calibrated(SelfCalibration(written), Walk(true, seed=seed), 6.0).estimate
        off = found.posterior.mean - true_difference(written, true)
        normalised.append(off @ found.posterior.information @ off)
    dimension = 2 * PAIR
    assert np.mean(normalised) < chi2.ppf(0.999, 8 * dimension) / 8


def test_self_calibration_that_begins_with_what_others_found_stays_consistent_with_its_covariance() -> None:
    normalised = []
    for seed in range(4):
        rig, true, _ = sampled(3, seed)
        for run in range(3):
            found = calibrated(SelfCalibration(rig), Walk(true, seed=10 * run + seed), 6.0).estimate
            assert not found.is_file_exact
            off = found.posterior.mean - true_difference(rig, true)
            rig = found.rig
        normalised.append(off @ found.posterior.information @ off)
    dimension = 2 * PAIR
    assert np.mean(normalised) < chi2.ppf(0.999, 4 * dimension) / 4


def test_refined_sigmas_hold_what_measurements_show_only_together_however_often_they_are_the_next_file() -> None:
    """Of baselines and the accelerometer's scale each run shows the ratios, and never the lengths."""
    rig, shares = default_rig(), []
    names = parameter_names(rig)
    baselines = [names.index(f"{pair.name}.right_T_left.tx") for pair in rig.pairs]
    scales = [names.index(f"imu.accel_matrix.{axis}{axis}") for axis in "xyz"]
    rows = np.zeros((4, len(names)))
    rows[:, baselines[0]] = 1.0 / rig.pairs[0].baseline_m
    rows[0, baselines[1]] = -1.0 / rig.pairs[1].baseline_m
    rows[np.arange(1, 4), scales] = -1.0
    shown = Evidence(1e8 * rows.T @ rows, np.zeros(len(names)))
    for _ in range(5):
        prior = file_prior(rig)
        posterior = shown.given(prior, np.ones(prior.n_groups))
        shares.append(np.sqrt(posterior.covariance[baselines[0], baselines[0]]) / rig.pairs[0].baseline_m)
        rig = replace(rig, calibration_sigmas=refined_sigmas(rig, posterior, np.ones(prior.n_groups)))
        assert rig.calibration_sigmas.estimated
    assert shares == pytest.approx(np.full(5, shares[0]), rel=0.2)


@pytest.mark.parametrize("has_distortion", [True, False])
@pytest.mark.parametrize("has_imu", [True, False])
def test_refined_sigmas_are_half_as_large_where_all_is_known_twice_as_well(has_distortion: bool, has_imu: bool) -> None:
    rig = default_rig() if has_imu else default_rig().without_imu()
    if not has_distortion:  # as of images that were rectified
        rig = rig.with_cameras(lambda camera: replace(camera, distortion=np.zeros_like(camera.distortion)))
    prior = file_prior(rig)
    posterior = Gaussian(np.zeros(len(prior.group)), np.asarray(4.0 * np.linalg.inv(prior.covariance), np.float64))
    found, of_file = refined_sigmas(rig, posterior, np.ones(prior.n_groups)).values, rig.calibration_sigmas.values
    unknown = set() if has_imu else {"time_offset_s", "imu_scale_share", "imu_misalignment_deg"}
    unknown |= set() if has_distortion else {"distortion_share"}
    for name, sigma in found.items():
        assert sigma == pytest.approx((1.0 if name in unknown else 0.5) * of_file[name], rel=0.05)


def test_self_calibration_corrects_a_file_that_is_more_wrong_than_any_once_two_windows_agree() -> None:
    true = default_rig().without_imu().with_pairs([0])
    front = true.pairs[0]
    wrong = replace(front.left, intrinsics=front.left.intrinsics * np.array([1.04, 1.04, 1.0, 1.0]))
    written = replace(true, pairs=(replace(front, left=wrong),))
    one_window = calibrated(SelfCalibration(written), Walk(true), 3.0)
    assert not one_window.has_full_window
    found = calibrated(SelfCalibration(written), Walk(true), 8.0)
    assert found.has_full_window
    assert found.implausible_parameter is None
    np.testing.assert_allclose(found.estimate.rig.cameras[0].intrinsics, front.left.intrinsics, rtol=2e-3)


@pytest.mark.parametrize(
    ("name", "values", "is_accepted"),
    [
        ("cam0.fx_px", (20.0, 20.0), True),
        ("cam0.fx_px", (20.0, -20.0), False),
        ("imu.accel_matrix.xx", (0.5, 0.5), False),
    ],
)
def test_self_calibration_takes_what_two_windows_say_beyond_any_file_of_cameras_only(
    name: str, values: tuple[float, float], is_accepted: bool
) -> None:
    calibration = SelfCalibration(default_rig())
    names = parameter_names(default_rig())
    accepted = []
    for value in values:
        mean = np.zeros(len(names))
        mean[names.index(name)] = value
        accepted.append(calibration._is_plausible(Gaussian(mean, 1e6 * np.eye(len(names))), is_full=True))
    assert accepted == [False, is_accepted]
    assert calibration.implausible_parameter == (None if is_accepted else name)


@pytest.mark.parametrize("level", [0, 3])
def test_self_calibration_by_a_usual_file_finds_it_plausible(level: int) -> None:
    written, true, _ = sampled(level, 0) if level else (default_rig(), default_rig(), None)
    assert calibrated(SelfCalibration(written), Walk(true), 6.0).implausible_parameter is None


def test_self_calibration_of_exact_files_leaves_them_alone() -> None:
    rig = default_rig()
    for seed in range(3):
        calibration = calibrated(SelfCalibration(rig), Walk(rig, seed=seed), 8.0)
        assert calibration.estimate.is_file_exact
        assert calibration.estimate.rig is rig
        assert not calibration.estimate.difference.any()


def test_self_calibration_at_a_standstill_learns_nothing_more_than_the_first_frameset_shows() -> None:
    written, true, _ = sampled(2, 1)
    sigmas = []
    for duration_s in (1.0, 60.0):
        calibration = SelfCalibration(written)
        sigmas.append(calibrated(calibration, Walk(true, speed=0.0), duration_s).estimate.sigmas)
    assert sigmas[1] == pytest.approx(sigmas[0], rel=1e-9)


class Straight(Walk):
    """Straight ahead, without a turn."""

    def pose(self, seconds: float) -> Float:
        pose = super().pose(0.0).copy()
        pose[:3, 3] += 0.35 * seconds * pose[:3, 0]
        return pose


class OnTheSpot(Walk):
    """Turning about body's z, without a step."""

    def pose(self, seconds: float) -> Float:
        pose = super().pose(0.0).copy()
        pose[:3, :3] = pose[:3, :3] @ so3_exp(np.array([0.0, 0.0, 0.6 * seconds]))
        return pose


class Blind(Walk):
    """No images for five seconds."""

    def framesets(self, duration_s: float) -> Iterator[tuple[int, Float, dict[int, View]]]:
        for stamp_ns, pose, views in super().framesets(duration_s):
            yield stamp_ns, pose, {} if 2_000_000_000 <= stamp_ns < 7_000_000_000 else views


class Glare(Walk):
    """Images that are over-exposed for 0.6 s: each corner is found beside its place, by half a pixel."""

    def framesets(self, duration_s: float) -> Iterator[tuple[int, Float, dict[int, View]]]:
        off_px = 0.5 * np.random.default_rng(self.seed).standard_normal((2, 2, len(self._points), 2))
        for stamp_ns, pose, views in super().framesets(duration_s):
            if 300_000_000 <= stamp_ns < 900_000_000:
                for j, view in views.items():
                    left_px, right_px = view.left_px + off_px[j, 0, view.ids], view.right_px + off_px[j, 1, view.ids]
                    views[j] = view._replace(left_px=left_px, right_px=right_px)
            yield stamp_ns, pose, views


class LateRight(Walk):
    """The first pair's right images are those of the frameset before."""

    def framesets(self, duration_s: float) -> Iterator[tuple[int, Float, dict[int, View]]]:
        before: View | None = None
        for stamp_ns, pose, views in super().framesets(duration_s):
            newest = views[0]
            if before is not None:
                _, now, then = np.intersect1d(newest.ids, before.ids, return_indices=True)
                right_px, has_right = np.zeros_like(newest.right_px), np.zeros_like(newest.has_right)
                right_px[now], has_right[now] = before.right_px[then], before.has_right[then]
                views[0] = newest._replace(right_px=right_px, has_right=has_right)
            before = newest
            yield stamp_ns, pose, views


class Crowd(Walk):
    """A third of all points walks to one side."""

    def views(self, world_T_body: Float) -> dict[int, View]:
        self._points[::3] += np.array([0.02, 0.01, 0.0])
        return super().views(world_T_body)


@pytest.mark.parametrize("level", [0, 1, 3])
def test_contradiction_is_never_a_false_alarm(level: int) -> None:
    """A part that is right is not called wrong, and what is called wrong is off by what is said."""
    named = []
    for seed in range(3):
        written, true, _ = sampled(level, seed) if level else (default_rig().without_imu(),) * 2 + (None,)
        right = written.pairs[1]  # its cameras are as in the file, those of the first pair are not
        true = replace(true, pairs=(true.pairs[0], right))
        calibration = calibrated(SelfCalibration(written), Walk(true, seed=seed), 6.0)
        assert calibration.is_confirmed
        found = calibration.findings()
        wrong = contradiction(found)
        significant = [finding for finding in found if finding.is_significant]
        assert (wrong is None) == (not significant)
        assert not [each.part for each in significant if each.part.startswith((right.left.name, right.right.name))]
        assert all(each.distance > 5.0 for each in significant)
        named += [each.part for each in significant]
    assert bool(named) == (level == 3)


@pytest.mark.parametrize("walk", [Straight, OnTheSpot, Blind, Crowd])
@pytest.mark.parametrize("level", [0, 2])
def test_self_calibration_in_motions_that_show_little_stays_near_the_file(walk: type[Walk], level: int) -> None:
    for seed in range(2):
        written, true, _ = sampled(level, seed) if level else (default_rig().without_imu(),) * 2 + (None,)
        found = calibrated(SelfCalibration(written), walk(true, seed=seed), 8.0).estimate
        assert found.is_file_exact == (level == 0)
        known = np.sqrt(np.diag(file_prior(written).covariance)) > 0.0
        off = (found.posterior.mean - true_difference(written, true))[known]
        assert (np.abs(off) < 3.0 * np.sqrt(np.diag(file_prior(written).covariance))[known]).all()
        assert (np.abs(off) < 5.0 * found.sigmas[known]).all()


def test_self_calibration_in_a_new_frame_of_poses_begins_another_window() -> None:
    rig = default_rig().without_imu()
    walk, jump, jump_ns = Walk(rig), se3_exp(np.array([0.0, 0.0, 1.5, 5.0, -3.0, 1.0])), 4_000_000_000
    calibration, windows = SelfCalibration(rig), list[FullWindow]()
    calibration.on_full_window = windows.append
    for stamp_ns, pose, views in walk.framesets(9.0):
        calibration.update()
        if stamp_ns == jump_ns:
            calibration.start_window()
        calibration.add_frameset(stamp_ns, np.ascontiguousarray(jump @ pose) if stamp_ns >= jump_ns else pose, views)
    calibration.close()
    assert calibration.estimate.is_file_exact
    assert {keyframe.stamp_ns >= jump_ns for window in windows for keyframe in window.keyframes} == {False, True}
    for window in windows:
        assert len({keyframe.stamp_ns >= jump_ns for keyframe in window.keyframes}) == 1


@pytest.mark.parametrize("failure", ["raises", "is NaN"])
def test_self_calibration_leaves_out_what_cannot_be_solved(failure: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = default_rig().without_imu()
    solve_window, count = adjusted, 0

    def fails_at_first(*arguments: Any) -> Solution:
        nonlocal count
        count += 1
        if count > 2:
            return solve_window(*arguments)
        if failure == "raises":
            raise np.linalg.LinAlgError("singular")
        solution = solve_window(*arguments)
        unknown = Gaussian(np.full_like(solution.calibration.mean, np.nan), solution.calibration.information)
        return solution._replace(calibration=unknown)

    monkeypatch.setattr(window_adjustment, "adjusted", fails_at_first)
    found = calibrated(SelfCalibration(rig), Walk(rig), 5.0)
    assert count > 2
    assert found.has_full_window
    assert found.estimate.is_file_exact
    assert np.isfinite(found.estimate.posterior.mean).all()


def test_self_calibration_leaves_out_windows_whose_adjustment_has_not_converged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    error = draw(default_rig().without_imu(), CalibrationErrorSizes.of_level(3, CAMERAS), 0)
    monkeypatch.setattr(solver, "_MAX_STEPS", 1)
    found = calibrated(SelfCalibration(error.written_rig), Walk(error.true_rig), 3.0)
    assert not found.has_full_window
    assert not found.estimate.posterior.mean.any()
    monkeypatch.undo()
    assert calibrated(SelfCalibration(error.written_rig), Walk(error.true_rig), 3.0).has_full_window


def test_self_calibration_at_a_standstill_keeps_few_samples() -> None:
    calibration, zero = SelfCalibration(default_rig()), np.zeros(3)
    for k in range(200 * 120):
        calibration.add_sample(ImuSample(5_000_000 * k, zero, zero))
    calibration.close()
    assert len(calibration._collector._samples) <= 200 * 30 + 1


def test_self_calibration_after_a_knock_finds_the_turned_camera_and_keeps_the_lenses() -> None:
    rig = default_rig().without_imu()
    pair = rig.pairs[0]
    turned = pair.right.body_T_cam @ se3_exp(np.deg2rad([0.06, 0.06, 0.06, 0.0, 0.0, 0.0]))
    knocked = replace(rig, pairs=(replace(pair, right=replace(pair.right, body_T_cam=turned)), *rig.pairs[1:]))
    walk, calibration = Walk(rig), SelfCalibration(rig)
    restarts_before = -1
    for stamp_ns, pose, views in walk.framesets(14.0):
        if stamp_ns == 6_000_000_000:
            restarts_before, walk.rig = calibration.restarts, knocked
        calibration.update()
        calibration.add_frameset(stamp_ns, pose, views)
    calibration.close()
    assert (restarts_before, calibration.restarts) == (0, 1)
    found = calibration.estimate.rig.pairs[0]
    off = so3_log(np.ascontiguousarray(found.right_T_left[:3, :3] @ knocked.pairs[0].right_T_left[:3, :3].T))
    assert np.rad2deg(np.abs(off)).max() < 0.01
    assert found.left.intrinsics == pytest.approx(pair.left.intrinsics, abs=0.02)
    assert not calibration.estimate.is_file_exact
    other, in_file = calibration.estimate.rig.pairs[1], rig.pairs[1]  # an exact file stays exact where nothing moved
    assert np.abs(other.right_T_left - in_file.right_T_left).max() < 1e-5
    assert np.abs(other.left.body_T_cam - in_file.left.body_T_cam).max() < 1e-5


@pytest.mark.parametrize("has_agreed", [False, True])
def test_self_calibration_takes_another_window_if_pairs_never_agreed_under_the_first_one(
    has_agreed: bool,
) -> None:
    written, true, _ = sampled(2, 1)
    walk, calibration = Walk(true), SelfCalibration(written)
    agreeing = 0
    for stamp_ns, pose, views in walk.framesets(10.0):
        calibration.update()
        may_agree = not calibration.has_full_window or (has_agreed and agreeing < 12)
        agreeing += calibration.has_full_window and may_agree
        calibration.add_frameset(stamp_ns, pose, views, are_contradicting=not may_agree)
    calibration.close()
    assert calibration.has_full_window
    assert not calibration.estimate.is_file_exact
    assert calibration.is_confirmed == (not has_agreed)


def with_contradictions(
    walk: Walk, seconds: float, contradicts: Callable[[float, SelfCalibration], bool]
) -> SelfCalibration:
    """Calibrate an exact file, and say at each instant whether the pairs contradict each other."""
    calibration = SelfCalibration(default_rig().without_imu())
    for stamp_ns, pose, views in walk.framesets(seconds):
        calibration.update()
        are_contradicting = contradicts(1e-9 * stamp_ns, calibration)
        calibration.note_contradiction(stamp_ns, are_contradicting)
        calibration.add_frameset(stamp_ns, pose, views, are_contradicting)
    calibration.close()
    return calibration


@pytest.mark.parametrize("pause_s", [0.0, 0.3])
def test_self_calibration_after_a_knock_that_no_epipolar_line_shows_finds_it_if_contradictions_last(
    pause_s: float,
) -> None:
    """A right camera turns towards the left one: pairs contradict each other, with pauses, until that is known."""
    rig = default_rig().without_imu()
    pair = rig.pairs[0]
    turned = pair.right.body_T_cam @ se3_exp(np.deg2rad([0.0, 0.15, 0.0, 0.0, 0.0, 0.0]))
    knocked = replace(rig, pairs=(replace(pair, right=replace(pair.right, body_T_cam=turned)), *rig.pairs[1:]))
    walk = Walk(rig)

    def contradicts(time_s: float, calibration: SelfCalibration) -> bool:
        if time_s >= 6.0:
            walk.rig = knocked
        return time_s >= 6.0 and not calibration.restarts and time_s % 1.0 >= pause_s

    found = with_contradictions(walk, 24.0, contradicts)
    assert found.restarts == 1
    right_T_left = found.estimate.rig.pairs[0].right_T_left
    off = so3_log(np.ascontiguousarray(right_T_left[:3, :3] @ knocked.pairs[0].right_T_left[:3, :3].T))
    assert np.rad2deg(np.abs(off)).max() < 0.01


def test_self_calibration_takes_no_short_contradictions_for_a_knock() -> None:
    rig = default_rig().without_imu()
    doubts = []

    def contradicts(time_s: float, calibration: SelfCalibration) -> bool:
        doubts.append(calibration.is_doubted)
        return time_s >= 6.0 and time_s % 3.0 < 2.0

    found = with_contradictions(Walk(rig), 14.0, contradicts)
    assert not any(doubts[-100:])
    assert found.restarts == 0
    assert found.estimate.is_file_exact


class Door(Walk):
    """From an instant on, the second pair sees nothing but points that move to one side together."""

    begin_s, _framesets, _moved = 6.0, 0, np.zeros(3)

    def views(self, world_T_body: Float) -> dict[int, View]:
        found, points = super().views(world_T_body), self._points
        self._framesets += 1
        if self._framesets > self.begin_s * RATE_HZ:
            self._moved = self._moved + np.array([0.01, 0.005, 0.0])
            self._points = points + self._moved
            found[1] = super().views(world_T_body)[1]
            self._points = points
        return found


@pytest.mark.parametrize("walk", [Crowd, Door])
def test_self_calibration_takes_no_lasting_contradiction_by_the_scene_for_a_knock(walk: type[Walk]) -> None:
    found = with_contradictions(walk(default_rig().without_imu()), 34.0, lambda time_s, _: time_s >= 6.0)
    assert found.restarts == 0


def test_self_calibration_takes_no_door_before_the_first_full_window_for_a_wrong_file() -> None:
    walk = Door(default_rig().without_imu())
    walk.begin_s = 1.0
    assert with_contradictions(walk, 12.0, lambda time_s, _: time_s >= 1.0).estimate.is_file_exact


def test_self_calibration_takes_contradictions_before_and_after_a_gap_for_two() -> None:
    calibration = calibrated(SelfCalibration(default_rig().without_imu()), Walk(default_rig().without_imu()), 6.0)
    assert calibration.is_confirmed
    for second in (0, 10):
        calibration.note_contradiction(second * 1_000_000_000, True)
    assert not calibration.is_doubted
    for k in range(40):
        calibration.note_contradiction(10_000_000_000 + k * 100_000_000, True)
    assert calibration.is_doubted


def known_cameras(rig: Rig) -> Float:
    """Return the covariance of cameras that are known ten times better than by a file."""
    n = n_camera_parameters(rig)
    return 0.01 * file_prior(rig).covariance[:n, :n]


def test_knock_detector_names_the_pair_that_is_off() -> None:
    rig = default_rig().without_imu()
    pair = rig.pairs[1]
    turned = pair.right.body_T_cam @ se3_exp(np.deg2rad([0.06, 0.06, 0.06, 0.0, 0.0, 0.0]))
    knocked = replace(rig, pairs=(rig.pairs[0], replace(pair, right=replace(pair.right, body_T_cam=turned))))
    in_force, known = RigCalibration.of(rig), known_cameras(rig)
    every_view = [views for _, _, views in Walk(knocked).framesets(0.5)]
    detector = KnockDetector()
    assert [detector.update(views, in_force, known) for views in every_view[:3]] == [[], [], [1]]
    detector = KnockDetector()  # pairs that are triggered in turns
    in_turns = [{k % 2: views[k % 2]} for k, views in enumerate(every_view)]
    assert [detector.update(views, in_force, known) for views in in_turns[:6]] == [[], [], [], [], [], [1]]


@pytest.mark.parametrize("seed", range(4))
def test_knock_detector_takes_no_calibration_that_is_not_known_yet_for_a_knock(seed: int) -> None:
    error = draw(default_rig().without_imu(), CalibrationErrorSizes.of_level(2, CAMERAS), seed)
    in_force, by_file = RigCalibration.of(error.written_rig), 100.0 * known_cameras(error.written_rig)
    every_view = [views for _, _, views in Walk(error.true_rig, seed=seed).framesets(0.5)]
    found = {}
    for share in (1.0, 1e-4):
        detector = KnockDetector()
        found[share] = sum(len(detector.update(views, in_force, share * by_file)) for views in every_view)
    assert found[1.0] == 0
    assert found[1e-4] > 0


@pytest.mark.parametrize(("scene", "most"), [("room", 0), ("calibration", 1)])
def test_knock_detector_takes_no_late_camera_for_a_turned_one(scene: str, most: int) -> None:
    rig = default_rig().without_imu()
    detector, in_force, known = KnockDetector(), RigCalibration.of(rig), known_cameras(rig)
    off_px, knocks = [], 0
    for _, _, views in list(LateRight(rig, scene=scene).framesets(20.0))[::3]:
        off_px.append(abs(epipolar_offset_px(views[0], in_force, 0) or 0.0))
        knocks += len(detector.update(views, in_force, known))
    assert np.mean(np.array(off_px) > 0.25) > 0.8
    assert knocks <= most  # some 30 and 40 where three keyframes off their lines are enough


@pytest.mark.parametrize("level", [0, 2])
def test_self_calibration_of_a_rig_that_stays_as_it_is_reports_no_knock(level: int) -> None:
    for seed in range(3):
        written, true, _ = sampled(level, seed) if level else (default_rig().without_imu(),) * 2 + (None,)
        assert calibrated(SelfCalibration(written), Walk(true, seed=seed), 8.0).restarts == 0


@pytest.mark.parametrize(("field", "spike"), [("linear_acceleration", 100.0), ("angular_velocity", 8.0)])
def test_self_calibration_leaves_out_a_wild_sample(field: str, spike: float) -> None:
    rig = default_rig()
    walk = Walk(rig)
    samples = walk.samples(6.0)
    values = getattr(samples[500], field) + np.array([0.0, spike, 0.0])
    samples[500] = replace(samples[500], **{field: values})
    walk.samples = lambda _: samples  # type: ignore[method-assign, assignment]
    assert calibrated(SelfCalibration(rig), walk, 6.0).estimate.is_file_exact


class Recorded(SelfCalibration):
    """Remembers of each frameset whether the rig file was as good as exact then."""

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig)
        self.was_exact: list[bool] = []

    def update(self) -> bool:
        has_changed = super().update()
        self.was_exact.append(self.estimate.is_file_exact)
        return has_changed


def test_self_calibration_takes_no_exact_file_for_wrong_after_images_with_larger_errors() -> None:
    for seed in range(5):
        found = calibrated(calibration := Recorded(default_rig()), Glare(default_rig(), sigma_px=0.04, seed=seed), 2.0)
        assert found.has_full_window
        assert all(calibration.was_exact)


def test_self_calibration_repeats_to_the_bit() -> None:
    written, true, _ = sampled(2, 2)
    first, second = (calibrated(SelfCalibration(written), Walk(true), 5.0).estimate.posterior for _ in range(2))
    assert np.array_equal(first.mean, second.mean)
    assert np.array_equal(first.information, second.information)


def test_self_calibration_with_imu_finds_time_offset_and_cameras_in_body() -> None:
    error = draw(default_rig(), CalibrationErrorSizes.of_level(2, ["cameras-in-body", "time-offset"]), 3)
    walk = Walk(error.true_rig, scene="calibration")
    assert error.true_rig.imu is not None
    assert error.written_rig.imu is not None
    offset_ns = error.true_rig.imu.time_offset_ns
    found = calibrated(SelfCalibration(error.written_rig), walk, 15.0).estimate
    assert found.rig.imu is not None
    assert found.rig.imu.time_offset_s == pytest.approx(offset_ns * 1e-9, abs=2e-4)
    before, after, true = (rig.pairs[0].left.body_T_cam for rig in (error.written_rig, found.rig, error.true_rig))

    def angle_deg(body_T_cam: Float) -> float:
        return float(np.rad2deg(np.linalg.norm(so3_log(np.ascontiguousarray(body_T_cam[:3, :3] @ true[:3, :3].T)))))

    assert angle_deg(after) < 0.3 * angle_deg(before)


@pytest.mark.parametrize("offset_ms", [-8.0, 8.0])
def test_self_calibration_with_an_imu_that_begins_with_the_images_finds_a_time_offset_of_either_sign(
    offset_ms: float,
) -> None:
    # They end with the newest keyframe, or begin with the first one, and do not cover it by the offset that is found.
    for seed in range(4):
        error = draw(default_rig(), CalibrationErrorSizes.of_level(3, CAMERAS), seed)
        assert error.true_rig.imu is not None
        true = replace(error.true_rig, imu=replace(error.true_rig.imu, time_offset_s=1e-3 * offset_ms))
        found = calibrated(SelfCalibration(error.written_rig), Walk(true, seed=seed), 1.0).estimate
        assert 1e3 * found.time_offset_s == pytest.approx(offset_ms, abs=0.3)


def test_self_calibration_whose_steps_were_refused_does_not_claim_to_know_the_cameras_in_body() -> None:
    # The clock's offset moves an end of the IMU's samples: in some of these, steps that lose an interval are refused.
    components = [*CAMERAS, "cameras-in-body", "time-offset", "imu-noise"]
    in_body, distances2 = slice(BODY, BODY + 3), []
    for seed in range(6):
        error = draw(default_rig(), CalibrationErrorSizes.of_level(2, components), seed)
        walk = Walk(error.true_rig, seed=seed)
        found = calibrated(SelfCalibration(error.written_rig), walk, 3.0).estimate.posterior
        off = found.mean[in_body] - true_difference(error.written_rig, error.true_rig)[in_body]
        distances2.append(off @ np.linalg.solve(found.covariance[in_body, in_body], off))
    assert max(distances2) < chi2.ppf(1.0 - 1e-4 / len(distances2), 3)


def test_solve_late_clock_does_not_drop_intervals_that_the_samples_cover() -> None:
    # Samples end with the last keyframe, but the clock's offset would need later ones.
    rig = default_rig()
    walk, nominal = Walk(rig), RigCalibration.of(rig)
    framesets = list(walk.framesets(3.2))
    keyframes = tuple(Keyframe(*framesets[k]) for k in (20, 22, 60))
    late = [replace(sample, stamp_ns=sample.stamp_ns + 20_000_000) for sample in walk.samples(3.2)]
    seen = [sample for sample in late if sample.stamp_ns <= keyframes[-1].stamp_ns]
    samples = InertialSamples(
        np.array([sample.stamp_ns for sample in seen]),
        np.array([[*sample.angular_velocity, *sample.linear_acceleration] for sample in seen]),
        np.array([keyframe.stamp_ns for keyframe in keyframes]),
        np.array([1e-4, 1e-3]),
        50_000_000,
        np.ones((len(seen), 2)),
    )
    poses = np.array([keyframe.odom_T_body for keyframe in keyframes])
    tracks, landmarks = choose_tracks(keyframes, poses, nominal, 150, 0.15)
    velocities = np.zeros((3, 3))
    states = States(poses, velocities, np.array([0.0, 0.0, -GRAVITY_M_S2]), landmarks)
    prior = Evidence.none(len(parameter_names(rig))).given(file_prior(rig), np.full(2, 5.0))
    solution = solve(Window(tracks, samples), states, nominal, prior.mean, prior)
    assert np.isfinite(solution.imu_errors2).all()


@dataclass
class Flight(Walk):
    """A flight at 12 m/s in a curve, with points 60 to 200 m away, or farther: disparities are a pixel or less."""

    farther: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._motion = Motion(self._course, 6.0)
        self._points = self.farther * self._rng.uniform([80.0, -90.0, -60.0], [200.0, 90.0, 60.0], (2000, 3))

    @staticmethod
    def _course(t: Float) -> Float:
        still = np.zeros_like(t)
        return np.column_stack([12.0 * t, 6.0 * np.sin(0.8 * t), 2.0 * np.sin(t), still, still, still])


def test_adjusted_window_of_far_points_does_not_keep_the_scale_of_the_first_poses() -> None:
    # The odometry measured its motions with a left-right rotation that is off by a tenth of a pixel.
    error = draw(default_rig(), CalibrationErrorSizes.of_level(2, ["left-right-rotation"]), 0)
    written, walk = error.written_rig, Flight(error.true_rig)
    keyframes = [Keyframe(*frameset) for frameset in walk.framesets(6.0)][5::5]
    collector = WindowCollector(written)
    for sample in walk.samples(6.0):
        collector.add_sample(sample)
    prior = Evidence.none(len(file_prior(written).group)).given(file_prior(written), np.ones(2))
    true_m, found_m = np.linalg.norm(keyframes[-1].odom_T_body[:3, 3] - keyframes[0].odom_T_body[:3, 3]), []
    for scale in (0.8, 1.2):
        first = [np.array(keyframe.odom_T_body) for keyframe in keyframes]
        for pose in first:
            pose[:3, 3] *= scale
        window = tuple(k._replace(odom_T_body=pose) for k, pose in zip(keyframes, first, strict=True))
        samples = collector.samples_of(window)
        solution = adjusted(window, samples, RigCalibration.of(written), prior.mean, prior, 0.15)
        found_m.append(float(np.linalg.norm(solution.states.poses[-1, :3, 3] - solution.states.poses[0, :3, 3])))
    assert found_m == pytest.approx([true_m] * 2, rel=0.02)
    assert found_m[0] == pytest.approx(found_m[1], rel=1e-3)


@pytest.mark.parametrize("farther", [3.0, 10.0])
def test_adjustments_of_points_that_are_nearly_infinite_converge(
    farther: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    solutions = []

    def keep(*arguments: Any) -> Solution:
        solutions.append(adjusted(*arguments))
        return solutions[-1]

    monkeypatch.setattr(window_adjustment, "adjusted", keep)
    for seed in (1, 2, 3):
        error = draw(default_rig(), CalibrationErrorSizes.of_level(3, CAMERAS), seed)
        calibrated(SelfCalibration(error.written_rig), Flight(error.true_rig, seed=seed, farther=farther), 2.5)
    assert len(solutions) > 10
    assert all(solution.has_converged for solution in solutions)


# ---------------------------------------------------------------- what users see


def test_findings_name_what_is_wrong_and_only_that() -> None:
    error = draw(default_rig(), CalibrationErrorSizes.of_level(3, ["left-right-rotation"]), 1)
    written, true = error.written_rig.without_imu(), error.true_rig.without_imu()
    wrong = calibrated(SelfCalibration(written), Walk(true), 10.0).findings()
    assert {finding.part for finding in wrong if finding.is_significant} == {
        f"pair {name}, rotation left to right" for name in ("front", "back")
    }
    exact = calibrated(SelfCalibration(true), Walk(true), 10.0).findings()
    assert not any(finding.is_significant for finding in exact)
    assert described(exact)[0] == "calibration: as in the rig file"
    assert any("baseline" in line or "translation left to right" in line for line in described(exact))


def test_refined_rig_with_its_sigmas_is_a_rig_file(tmp_path: Path) -> None:
    written, true, _ = sampled(2, 0)
    refined = calibrated(SelfCalibration(written), Walk(true), 10.0).estimate.rig
    assert refined.calibration_sigmas.stereo_rotation_deg < written.calibration_sigmas.stereo_rotation_deg
    save_rig(refined, tmp_path / "rig.yaml")
    assert load_rig(tmp_path / "rig.yaml").calibration_sigmas == refined.calibration_sigmas


def test_calibration_sigmas_in_a_rig_file_are_checked(tmp_path: Path) -> None:
    save_rig(default_rig(), tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text()
    for added, message in (
        ("calibration_sigmas: factry", "there is no level 'factry'"),
        ("calibration_sigmas: {focal_shar: 0.1}", "focal_share"),
        ("calibration_sigmas: {focal_share: -0.1}", "positive"),
        ("calibration_sigmas: {focal_share: true}", "numbers only"),
        ("calibration_sigmas: {estimated: 1}", "true or false"),
        ("calibration_sigmas:", "no level given"),
    ):
        (tmp_path / "wrong.yaml").write_text(f"{text}{added}\n")
        with pytest.raises(RigError, match=message):
            load_rig(tmp_path / "wrong.yaml")
    (tmp_path / "named.yaml").write_text(f"{text}calibration_sigmas: kalibr\n")
    assert load_rig(tmp_path / "named.yaml").calibration_sigmas == LEVELS["kalibr"]
