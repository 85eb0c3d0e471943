"""The watch on P_12: an error of the extrinsics is found from motions, and nothing where there is none."""

import numpy as np
import pytest
from scipy.special import chdtri
from synthetic import random_covariance, random_transform, transform

from graphvio.arrays import Float
from graphvio.frontend.motion.refinement import Refined
from graphvio.frontend.pairs.extrinsic_monitor import ExtrinsicMonitor, combined, placed
from graphvio.geometry import se3_exp, se3_log

NONE = np.zeros(6)
OFF = np.array([0.012, -0.009, 0.008, 0.02, -0.015, 0.018])  # about 1 degree and 3 cm
INLIER = np.ones(50, dtype=bool)
ERRORS_PX = np.full(50, 0.3)


def refined(motion: Float, rng: np.random.Generator, sigma: float) -> Refined:
    """A measurement of a motion with an error that its covariance describes."""
    covariance = random_covariance(rng, 6, sigma)
    error = np.linalg.cholesky(covariance) @ rng.standard_normal(6)
    return Refined(np.ascontiguousarray(se3_exp(error) @ motion), covariance, 0.5 * covariance, INLIER, ERRORS_PX)


def watch(
    off: Float, keyframes: int, seed: int, outlier_share: float = 0.0, sigma: float = 2e-4
) -> tuple[ExtrinsicMonitor, np.random.Generator]:
    rng = np.random.default_rng(seed)
    monitor = ExtrinsicMonitor()
    for _ in range(keyframes):
        add_keyframe(monitor, off, rng, outlier_share, sigma)
    return monitor, rng


def add_keyframe(
    monitor: ExtrinsicMonitor, off: Float, rng: np.random.Generator, outlier_share: float = 0.0, sigma: float = 2e-4
) -> None:
    motion = random_transform(rng, 0.1, 0.2)
    seen = np.linalg.inv(se3_exp(off)) @ motion @ se3_exp(off)  # what the pair reports with the rig file's extrinsics
    if rng.random() < outlier_share:
        seen = seen @ random_transform(rng, 0.05, 0.1)
    correction = monitor.correction
    reported = np.ascontiguousarray(correction @ seen @ np.linalg.inv(correction))
    monitor.add(refined(motion, rng, sigma), refined(reported, rng, sigma))


def test_an_error_of_the_extrinsics_is_found() -> None:
    nees = []
    for seed in range(60):
        monitor, _ = watch(OFF, 30, seed)
        found = monitor.solve()
        assert found is not None
        assert found.statistic > float(chdtri(6, 1e-9))
        error = se3_log(np.ascontiguousarray(se3_exp(found.tangent) @ np.linalg.inv(se3_exp(OFF))))
        nees.append(error @ np.linalg.solve(found.covariance, error))
    assert 3.0 < np.mean(nees) < 9.0  # of 6; the Cauchy weights cost a little


def test_it_is_found_among_outliers() -> None:
    found = watch(OFF, 60, 1, outlier_share=0.2)[0].solve()
    assert found is not None
    assert found.statistic > float(chdtri(6, 1e-9))
    assert np.linalg.norm(found.tangent[:3] - OFF[:3]) < np.deg2rad(0.1)
    assert np.linalg.norm(found.tangent[3:] - OFF[3:]) < 0.003


def test_sound_extrinsics_are_left_alone() -> None:
    for seed in range(60):
        found = watch(NONE, 40, seed)[0].solve()
        assert found is not None
        assert found.statistic < float(chdtri(6, 1e-9))


def test_motions_that_no_extrinsics_explain_are_no_error_of_them() -> None:
    assert watch(NONE, 40, 2, outlier_share=0.7)[0].solve() is None
    assert watch(OFF, 3, 3)[0].solve() is None  # too few


def test_a_correction_in_force_goes_on_being_refined() -> None:
    monitor, rng = watch(OFF, 10, 4)
    for _ in range(6):
        found = monitor.solve()
        assert found is not None
        monitor.in_force = found
        for _ in range(10):
            add_keyframe(monitor, OFF, rng)
    found = monitor.solve()
    assert found is not None
    np.testing.assert_allclose(found.tangent, OFF, atol=1e-3)


def test_a_correction_that_the_motions_refute_is_withdrawn() -> None:
    """Something in view misled the pair for a while; from then on its motions say that the rig file was right."""
    monitor, rng = watch(OFF, 10, 6)
    assert monitor.learn()
    assert not np.array_equal(monitor.correction, np.eye(4))
    changes = 0
    for _ in range(460):
        add_keyframe(monitor, NONE, rng)
        changes += monitor.learn()
    assert changes
    np.testing.assert_array_equal(monitor.correction, np.eye(4))


def test_what_no_motion_shows_is_not_made_up() -> None:
    """Turning about the vertical in a plane leaves the height difference open."""
    rng = np.random.default_rng(5)
    monitor = ExtrinsicMonitor()
    for _ in range(40):
        motion = transform([0.0, 0.0, rng.normal(0.0, 0.1)], [*rng.normal(0.0, 0.1, 2), 0.0])
        seen = np.linalg.inv(se3_exp(OFF)) @ motion @ se3_exp(OFF)
        monitor.add(refined(motion, rng, 1e-4), refined(np.ascontiguousarray(seen), rng, 1e-4))
    found = monitor.solve()
    assert found is not None
    assert found.statistic > float(chdtri(6, 1e-9))
    sigmas = np.sqrt(np.diag(found.covariance))
    assert sigmas[5] > 20.0 * sigmas[3:5].max()
    assert abs(found.tangent[5] - OFF[5]) < 3.0 * sigmas[5]


@pytest.mark.parametrize("translation_only", [True, False])
def test_pure_translation_shows_rotation_only(translation_only: bool) -> None:
    rng = np.random.default_rng(6)
    monitor = ExtrinsicMonitor()
    for _ in range(30):
        motion = random_transform(rng, 0.0 if translation_only else 0.1, 0.2)
        seen = np.linalg.inv(se3_exp(OFF)) @ motion @ se3_exp(OFF)
        monitor.add(refined(motion, rng, 1e-4), refined(np.ascontiguousarray(seen), rng, 1e-4))
    found = monitor.solve()
    assert found is not None
    sigmas = np.sqrt(np.diag(found.covariance))
    assert sigmas[:3].max() < 1e-3
    assert (sigmas[3:].min() > 0.1) == translation_only


@pytest.mark.parametrize(("known_to", "size"), [(1e-6, 0.5), (3e-4, None), (6e-3, 0.5 ** (1 / 3))])
def test_a_corrected_pair_counts_for_what_is_known_of_its_place(known_to: float, size: float | None) -> None:
    """With exact extrinsics, both pairs count alike. With very uncertain ones, the first one alone determines the
    motion up to two directions: a turn about the axis of the motion's turn and a shift along it."""
    rng, noise = np.random.default_rng(8), 1e-4
    covariance = noise**2 * np.eye(6)
    nees, sizes = [], []
    for _ in range(400):
        motion, d = random_transform(rng, 0.2, 0.3), known_to * rng.standard_normal(6)
        reported = (motion, se3_exp(-d) @ motion @ se3_exp(d))
        own = []
        for each in reported:
            noisy = np.ascontiguousarray(se3_exp(noise * rng.standard_normal(6)) @ each)
            own.append(Refined(noisy, covariance, 0.5 * covariance, INLIER, ERRORS_PX))
        found = combined(own[0], [placed(own[0], None), placed(own[1], known_to**2 * np.eye(6))])
        error = se3_log(np.ascontiguousarray(found.cur_T_ref @ np.linalg.inv(motion)))
        nees.append(error @ np.linalg.solve(found.covariance, error))
        sizes.append(np.linalg.det(found.covariance / noise**2) ** (1 / 6))
        assert np.linalg.eigvalsh(found.covariance - found.shared_covariance).min() > 0.0
    assert 5.5 < np.mean(nees) < 6.5  # 400 draws of 6 degrees of freedom: 6.0 +- 0.17
    assert size is None or np.mean(sizes) == pytest.approx(size, rel=0.05)
