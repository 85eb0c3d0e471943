"""The covariance of a motion against the errors that it really has, on the geometry of the simulator's scenes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from monte_carlo import (
    Campaign,
    Conditions,
    arrays_of_walks,
    at_reference,
    band,
    error_of,
    run_campaign,
    run_smoothed,
    sample_frame,
    sample_shared,
    solve,
)

from graphvio.arrays import Bool, Float
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.observations import Observations
from graphvio.frontend.motion.refinement import refine
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log

CONFIG = replace(MotionConfig(), sigma_inflation=1.0, hypotheses=60)
FRAMES = 400
RICH = Conditions()
FAR = Conditions(depth_scale=8.0, min_depth_m=15.0)
FEW = Conditions(per_pair=(9, 8))


@cache
def campaign_of(conditions: Conditions) -> Campaign:
    """The same frames for all claims on them."""
    return run_campaign(conditions, CONFIG, FRAMES, seed=11)


def at_the_left_edge(pixels: Float, points: Float) -> Bool:
    return np.asarray(pixels[:, 0] < 200.0)


def flattened(seen: Observations, truth: Float) -> Observations:
    """The same tracks on one plane across the first pair's view, without noise."""
    arrays = arrays_of_walks()
    points = seen.points.copy()
    points[:, 2] = 0.25 + 0.05 * points[:, 0]  # an inverse depth that is linear in the ray: a plane
    homogeneous = np.column_stack([points[:, :2], np.ones(len(points)), points[:, 2]])
    places = []
    for side in range(2):
        moved = homogeneous @ (arrays.cam_T_body[0, side] @ truth @ arrays.body_T_left[0]).T
        places.append(np.ascontiguousarray(moved[:, :2] / moved[:, 2:3]))
    return seen._replace(points=points, left=places[0], right=places[1])


def test_covariance_is_of_the_current_body_frame() -> None:
    truth, seen = sample_frame(replace(FAR, noise_px=0.0), np.random.default_rng(1))
    refined = refine(arrays_of_walks(), seen, truth, CONFIG)
    np.testing.assert_allclose(refined.cur_T_ref, truth, atol=1e-6)
    step = np.array([1e-3, -2e-3, 3e-3, 1e-2, 2e-2, -1e-2])
    np.testing.assert_allclose(error_of(np.ascontiguousarray(se3_exp(step) @ truth), truth), step, atol=1e-9)
    # ref_T_cur, as a between factor takes it, is then perturbed on its right, in body at the current instant
    perturbed = se3_inverse(np.ascontiguousarray(se3_exp(step) @ truth))
    np.testing.assert_allclose(se3_log(truth @ perturbed), -step, atol=1e-9)
    np.testing.assert_allclose(
        se3_log(np.ascontiguousarray(perturbed @ truth)), -se3_adjoint(se3_inverse(truth)) @ step, atol=1e-9
    )


@pytest.mark.parametrize(
    "conditions",
    [RICH, FAR, FEW, Conditions(per_pair=(150, 0)), Conditions(outlier_share=0.3)],
    ids=["rich", "far", "few points", "one pair blind", "outliers"],
)
def test_covariance_is_consistent(conditions: Conditions) -> None:
    campaign = campaign_of(conditions)
    low, high = band(FRAMES)
    assert low < campaign.nees().mean() < high
    assert campaign.nees().max() < 50.0  # no frame that the covariance does not cover at all


def test_refine_of_far_points_is_unbiased() -> None:
    """Noisy depths must not shorten the motion: its mean error along it is small compared with its sigma."""
    campaign = campaign_of(FAR)
    standardised = np.array(campaign.errors) / np.sqrt([np.diag(c) for c in campaign.covariances])
    assert np.abs(standardised.mean(axis=0)).max() < 0.25  # the mean of 400 is known to 0.05


@pytest.mark.parametrize("noise_px", [0.15, 0.6])
def test_covariance_follows_the_actual_noise(noise_px: float) -> None:
    """Within 10 % of 6 beyond the band of the mean: the Cauchy scale follows only noise that is less than modelled."""
    campaign = run_campaign(replace(RICH, noise_px=noise_px, per_pair=(80, 80)), CONFIG, FRAMES, seed=13)
    low, high = band(FRAMES)
    assert low - 0.6 < campaign.nees().mean() < high + 0.6


@pytest.mark.parametrize(
    ("conditions", "most"),
    [
        (Conditions(per_pair=(60, 0), choice=at_the_left_edge), 0.6),
        (Conditions(has_right=False, per_pair=(80, 80)), 0.6),
        (Conditions(per_pair=(4, 0)), 1.5),
        (Conditions(per_pair=(25, 25), outlier_share=0.3), 1.0),
        (replace(FAR, outlier_share=0.3, per_pair=(80, 80)), 1.0),
    ],
    ids=["one side", "no right image", "four points", "few and outliers", "far and outliers"],
)
def test_covariance_in_poor_geometry_is_nearly_consistent(conditions: Conditions, most: float) -> None:
    """The NEES may leave its band by so much: the variance of few residuals is itself not known well."""
    campaign = run_campaign(conditions, CONFIG, FRAMES, seed=14)
    low, high = band(FRAMES)
    assert low - most < campaign.nees().mean() < high + most


def test_covariance_of_far_points_is_large_in_translation_only() -> None:
    near, far = (
        np.mean(run_campaign(replace(c, per_pair=(80, 80)), CONFIG, 30, seed=15).covariances, axis=0)
        for c in (RICH, FAR)
    )
    assert np.trace(far[3:, 3:]) > 20.0 * np.trace(near[3:, 3:])
    assert np.trace(far[:3, :3]) < 2.0 * np.trace(near[:3, :3])


@pytest.mark.parametrize("count", [1, 2, 3])
def test_refine_of_too_few_points_gives_a_large_covariance(count: int) -> None:
    truth, seen = sample_frame(Conditions(per_pair=(count, 0)), np.random.default_rng(2))
    for has_right in (True, False):
        part = seen._replace(has_right=np.full(count, has_right))
        refined = solve(part, truth, CONFIG, np.random.default_rng(3))
        assert np.isfinite(refined.cur_T_ref).all()
        assert np.linalg.eigvalsh(refined.covariance).min() > 0.0
        sigmas = np.sqrt(np.linalg.eigvalsh(refined.covariance))
        if (4 if has_right else 2) * count < 6 or count == 1:
            assert sigmas.max() > 1.0  # the direction that nothing constrains


def test_refine_of_points_in_one_plane_constrains_all_directions() -> None:
    truth, seen = sample_frame(Conditions(per_pair=(100, 0)), np.random.default_rng(4))
    flat = flattened(seen, truth)
    refined = solve(flat, truth, CONFIG, np.random.default_rng(5))
    np.testing.assert_allclose(refined.cur_T_ref, truth, atol=1e-6)
    assert np.sqrt(np.diag(refined.covariance)).max() < 0.05


# ------------------------------------------------------------------ motions from one reference, and chains


SHARED_SAMPLES = 400


@pytest.mark.parametrize(
    "conditions",
    [Conditions(per_pair=(60, 60)), replace(FAR, per_pair=(60, 60)), Conditions(per_pair=(60, 60), outlier_share=0.3)],
    ids=["rich", "far", "outliers"],
)
def test_shared_covariance_is_that_between_motions_of_one_reference(conditions: Conditions) -> None:
    """Two currents at one place: their errors have in common what comes from the reference's points."""
    sampled = sample_shared(conditions, CONFIG, (3, 3), SHARED_SAMPLES, seed=16)
    shared, total = (
        at_reference(sampled.true_cur_T_ref, np.mean([getattr(r, name) for r in sampled.refined], axis=0))
        for name in ("shared_covariance", "covariance")
    )
    white = np.linalg.inv(np.linalg.cholesky(total))
    found, stated = (white @ c @ white.T for c in (sampled.cross_covariance(), shared))
    # an element of a covariance of unit variables, from 400 samples, is known to 0.05
    assert np.abs(found - stated).max() < 0.2
    assert np.trace(found) == pytest.approx(np.trace(stated), rel=0.15)
    assert np.linalg.eigvalsh(total - shared).min() > 0.0


CHAINS = 60


@pytest.mark.parametrize("conditions", [RICH, FAR], ids=["near", "far"])
def test_pose_over_twenty_frames_is_consistent(conditions: Conditions) -> None:
    """From between two keyframes, through three, to between two others; each keyframe has tracks of its own."""
    some = replace(conditions, per_pair=(40, 40))
    low, high = band(CHAINS)
    assert low < run_smoothed(some, CONFIG, CHAINS, seed=17, new_tracks=True).nees().mean() < high


def test_pose_without_shared_covariance_is_overconfident() -> None:
    some = replace(RICH, per_pair=(40, 40))
    unaware = run_smoothed(some, CONFIG, CHAINS, seed=17, new_tracks=True, split=False)
    assert unaware.nees().mean() < band(CHAINS)[0] - 0.3


@pytest.mark.parametrize("conditions", [RICH, FAR], ids=["near", "far"])
def test_pose_of_tracks_through_keyframes_is_conservative(conditions: Conditions) -> None:
    """Noise of a keyframe's images then cancels in part, which the smoother does not know: it errs on the safe side,
    by less than a factor of 1.8 in sigma."""
    some = replace(conditions, per_pair=(40, 40))
    _, high = band(CHAINS)
    assert 6.0 / 1.8**2 < run_smoothed(some, CONFIG, CHAINS, seed=18, new_tracks=False).nees().mean() < high
