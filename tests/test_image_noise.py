"""Image noise is measured, and smoothed where it hides what corners look like."""

from __future__ import annotations

import numpy as np
import pytest
from real_clip import CLIP, real_clip
from waves import picture, waves

from graphvio import FrameSet, Odometry, open_source
from graphvio.arrays import AnyArray, Image
from graphvio.config.stages import CornerConfig
from graphvio.evaluation import evaluate
from graphvio.frontend.imaging.corners import find_corners
from graphvio.frontend.imaging.image_noise import NoiseFilter, has_less_contrast, noise_sigma
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

X, Y = np.meshgrid(np.arange(320.0), np.arange(240.0))


def noisy(image: AnyArray, sigma: float, seed: int) -> Image:
    white = np.random.default_rng(seed).normal(0.0, sigma, image.shape)
    return np.asarray(np.clip(np.round(image + white), 0, 255), dtype=np.uint8)


def test_noise_sigma_ignores_texture() -> None:
    flat = np.full(X.shape, 100.0)
    for sigma in (0.7, 2.0, 6.0):
        for scene in (flat, flat + 0.2 * X, flat + 40.0 * (X > 150)):
            assert noise_sigma(noisy(scene, sigma, 1)) == pytest.approx(sigma, rel=0.12)
        white = sigma * np.random.default_rng(1).standard_normal(flat.shape)
        assert noise_sigma(picture(waves(0.5 * X, 0.5 * Y) + white / 45.0)) == pytest.approx(sigma, rel=0.5)
    assert noise_sigma(flat.astype(np.uint8)) == pytest.approx(1.0 / np.sqrt(12.0))  # rounding is noise
    assert noise_sigma(np.zeros(X.shape, dtype=np.uint8)) > 0.0


def test_contrast_is_that_of_the_textured_blocks() -> None:
    checked = (X.astype(int) // 2 + Y.astype(int) // 2) % 2 == 0
    for width, is_textured in ((100, True), (60, False)):  # of 320 pixels: a quarter of the blocks counts
        image = np.where(checked & (width > X), 140, 100).astype(np.uint8)
        assert has_less_contrast(image, 19.9) != is_textured
        assert has_less_contrast(image, 20.1)
    assert has_less_contrast(np.full(X.shape, 100, dtype=np.uint8), 0.1)
    assert has_less_contrast(np.zeros((8, 8), dtype=np.uint8), 0.1)  # smaller than a block


def test_filter_smooths_both_images_while_one_is_noisy_and_leaves_clean_ones_alone() -> None:
    scene = 128.0 + 45.0 * waves(0.5 * X, 0.5 * Y)
    texture = next(sigma for sigma in np.arange(1.0, 60.0, 0.1) if has_less_contrast(noisy(scene, 0.0, 0), sigma))
    noise_filter = NoiseFilter()
    for k, share in enumerate([0.1, 0.17, 0.3, 0.17, 0.1, 0.17]):
        clean, image = noisy(scene, 0.0, k), noisy(scene, share * texture, k)
        left, right = noise_filter.filtered(clean, image)
        assert right is not None
        is_smoothed = k in (2, 3)  # a share of 0.17 stays what it was
        assert (left is not clean, right is not image) == (is_smoothed, is_smoothed)
        if is_smoothed:
            assert np.std(right - scene) < 0.6 * np.std(image - scene)
            assert np.std(left - scene) < 0.2 * texture
    assert noise_filter.filtered(clean, None) == (clean, None)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 6.0])
def test_smoothed_noise_shows_no_corners(sigma: float) -> None:
    """Of a blank wall, smoothed noise looks like corners beside a deviation that is measured after the smoothing."""
    noise_filter, config = NoiseFilter(), CornerConfig()
    image, _ = noise_filter.filtered(noisy(np.full(X.shape, 120.0), sigma, 1), None)
    admitted = config.noise_factor * noise_filter.left_sigma
    everywhere, nothing = np.ones(image.shape, dtype=np.bool_), (np.zeros((0, 2)), np.zeros(0, dtype=bool))
    assert len(find_corners(image, everywhere, *nothing, 18, config.border_px, admitted)) <= 2
    # The deviation is that of white noise with the gradients that the image has.
    slopes = 0.5 * (image[:, 2:].astype(float) - image[:, :-2])
    assert noise_filter.left_sigma == pytest.approx(np.sqrt(2.0) * slopes.std(), rel=0.15)


@pytest.mark.skipif(not CLIP.exists(), reason="the real recording is not here")
def test_pair_alone_in_noise() -> None:
    """Noise of 15 grey levels hides most corners' likeness: unsmoothed, the path is wrong by half a metre."""
    source = open_source(real_clip())
    rig = source.rig.without_imu()
    odometry, estimates = Odometry(rig), []
    for measurement in open_source(real_clip(), rig, to_s=12.0):
        if isinstance(measurement, FrameSet):
            left, right = measurement.images[0]
            seed = measurement.stamp_ns % 2**32
            images = {0: (noisy(left, 15.0, seed), noisy(right, 15.0, seed + 1))}
            estimates.append(odometry.process(FrameSet(measurement.stamp_ns, images)))
    poses = [(each.stamp_ns, each.nav_T_body) for each in (*estimates, *odometry.finish()) if each is not None]
    assert all(pose is not None for _, pose in poses)
    assert source.truth is not None
    estimated = Trajectory(np.array([stamp_ns for stamp_ns, _ in poses]), np.array([pose for _, pose in poses]))
    assert evaluate(estimated, load_trajectory(source.truth)).ate_position_m.rmse < 0.015
