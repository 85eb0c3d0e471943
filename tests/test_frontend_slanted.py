"""Alignment of patches on slanted surfaces, seen by a rectified pair: disparities and their gradients are known."""

import numpy as np
import pytest
from waves import picture, waves

from graphvio.arrays import Bool, Float, Image
from graphvio.frontend.depth.slanted import align_slanted
from graphvio.frontend.imaging.lucas_kanade import register
from graphvio.frontend.imaging.sampling import pixel_words

HALF = 7
DISPARITY = 12.3
MIDDLE = (160.0, 120.0)
X, Y = np.meshgrid(np.arange(320.0), np.arange(240.0))
NEARER = np.array([-1.0, 0.0])  # where a right pixel moves when its point comes nearer


def views(slope_x: float, slope_y: float, seed: int = 0, noise: float = 1.0) -> tuple[Image, Image]:
    """Left and right image of a plane whose disparity grows by these slopes along the left image's axes."""
    # x_right = x - d with d = DISPARITY + slope_x (x - mx) + slope_y (y - my), solved for x
    source_x = (X + DISPARITY - slope_x * MIDDLE[0] + slope_y * (Y - MIDDLE[1])) / (1.0 - slope_x)
    rng = np.random.default_rng(seed)
    left, right = waves(X, Y, seed), waves(source_x, Y, seed)
    white = noise / 45.0 * rng.standard_normal((2, *X.shape))
    return picture(left + white[0]), picture(right + white[1])


def grid() -> Float:
    x, y = np.meshgrid(np.arange(100.0, 221.0, 24.0), np.arange(70.0, 171.0, 20.0))
    return np.column_stack([x.ravel(), y.ravel()]) + 0.3


def truth(pixels: Float, slope_x: float, slope_y: float) -> Float:
    disparity = DISPARITY + slope_x * (pixels[:, 0] - MIDDLE[0]) + slope_y * (pixels[:, 1] - MIDDLE[1])
    return np.asarray(pixels - np.column_stack([disparity, np.zeros(len(pixels))]))


def aligned(
    images: tuple[Image, Image],
    guess: Float,
    slopes: Float | None = None,
    wanted: Bool | None = None,
) -> tuple[Float, Float, Float, Bool]:
    n = len(guess)
    known, start = np.full(n, slopes is not None), np.zeros((n, 2)) if slopes is None else slopes
    return align_slanted(
        *images, pixel_words(images[1]), grid(), guess, np.tile(NEARER, (n, 1)), np.tile(np.eye(2), (n, 1, 1)),
        np.zeros((n, 2, 2)), start, known,
        np.ones(n, dtype=bool) if wanted is None else wanted, HALF,
    )  # fmt: skip


SLANTS = [(0.0, 0.0), (0.15, 0.0), (0.0, 0.3), (-0.25, 0.2), (0.3, -0.35)]


@pytest.mark.parametrize("slant", SLANTS)
def test_align_slanted_finds_place_and_slopes(slant: tuple[float, float]) -> None:
    right = truth(grid(), *slant)
    moved, slopes, correlations, found = aligned(views(*slant), right + np.array([0.7, 0.2]))
    assert found.mean() > 0.8
    error = np.linalg.norm(moved - right, axis=1)[found]
    assert np.median(error) < 0.04
    assert np.quantile(error, 0.9) < 0.12
    np.testing.assert_allclose(np.median(slopes[found], axis=0), slant, atol=0.01)
    assert np.median(correlations[found]) > 0.98


@pytest.mark.parametrize("slant", SLANTS[2:])
def test_align_slanted_without_slopes_is_off_or_fails(slant: tuple[float, float]) -> None:
    images, right = views(*slant), truth(grid(), *slant)
    n, left_words = len(right), pixel_words(images[0])
    level, everything = np.tile(np.eye(2), (n, 1, 1)), np.ones(n, dtype=bool)
    shifted, kept, _, _ = register(
        left_words, images[1], grid(), level, np.zeros_like(level), right, everything, HALF, 3.0, 1.0, True
    )
    moved, _, _, found = aligned(images, right)
    by_shift = np.where(kept, np.linalg.norm(shifted - right, axis=1), np.inf)
    by_slant = np.where(found, np.linalg.norm(moved - right, axis=1), np.inf)
    assert np.median(by_shift) > 3.0 * np.median(by_slant)


def test_align_slanted_accepts_initial_slopes() -> None:
    slant = (-0.25, 0.2)
    images, right = views(*slant), truth(grid(), *slant)
    before = np.tile(slant, (len(right), 1)) + np.array([0.03, -0.03])
    known, slopes, _, found_known = aligned(images, right + np.array([0.5, -0.2]), before)
    new, _, _, found_new = aligned(images, right + np.array([0.5, -0.2]))
    both = found_known & found_new
    assert both.mean() > 0.95
    assert np.median(np.linalg.norm(known - new, axis=1)[both]) < 0.02
    np.testing.assert_allclose(np.median(slopes[both], axis=0), slant, atol=0.01)


@pytest.mark.parametrize(
    ("gain", "offset", "within_px"), [(1.0, -20.0, 0.05), (0.9, -10.0, 0.05), (0.5, 10.0, 0.06), (0.5, 120.0, 0.06)]
)
@pytest.mark.parametrize("is_brighter", [False, True])
def test_align_slanted_under_a_change_of_exposure_hardly_moves(
    gain: float, offset: float, within_px: float, is_brighter: bool
) -> None:
    """Contrast and brightness of one image differ from the other's, to either side."""
    images = list(views(0.1, 0.1))
    darker = 0 if is_brighter else 1
    images[darker] = np.clip(np.round(gain * images[darker] + offset), 0, 255).astype(np.uint8)
    right = truth(grid(), 0.1, 0.1)
    moved, slopes, correlations, found = aligned((images[0], images[1]), right)
    assert found.mean() > 0.9
    assert np.median(np.linalg.norm(moved - right, axis=1)[found]) < within_px
    np.testing.assert_allclose(np.median(slopes[found], axis=0), (0.1, 0.1), atol=0.03)
    assert np.median(correlations[found]) > 0.97


def test_align_slanted_in_another_scene_does_not_correlate() -> None:
    left, _ = views(0.0, 0.0)
    _, other = views(0.0, 0.0, seed=1)
    _, _, correlations, found = aligned((left, other), truth(grid(), 0.0, 0.0))
    assert np.mean(found & (correlations > 0.7)) < 0.3
    flat = np.full_like(left, 100)
    _, _, correlations, _ = aligned((left, flat), grid())
    assert correlations.max() <= 0.0
    _, _, correlations, _ = aligned((flat, flat), grid())
    assert correlations.max() <= 0.0


def test_align_slanted_leaves_out_unwanted_patches_and_the_edge() -> None:
    images, right = views(0.0, 0.0), truth(grid(), 0.0, 0.0)
    wanted = np.arange(len(right)) % 2 == 0
    assert not aligned(images, right, wanted=wanted)[3][~wanted].any()
    for far in ([-50.0, 0.0], [400.0, 0.0], [0.0, -300.0], [0.0, 300.0]):
        moved, _, _, found = aligned(images, right + far)
        outside = ((right + far) < 0).any(axis=1) | ((right + far) > [320.0, 240.0]).any(axis=1)
        assert not found[outside].any()
        np.testing.assert_array_equal(moved[outside], (right + far)[outside])


def test_align_slanted_of_cameras_that_differ_a_little_in_contrast_has_unbiased_slopes() -> None:
    """A contrast of 4 % more looks like a patch that is seen larger, 0.6 % for this texture: to all of them alike."""
    errors = []
    for seed in range(6):
        images = list(views(0.0, 0.0, seed))
        images[1] = picture(1.04 * (images[1] / 45.0 - 128.0 / 45.0))
        _, slopes, _, found = aligned((images[0], images[1]), truth(grid(), 0.0, 0.0))
        errors.append(slopes[found])
    assert np.abs(np.mean(np.concatenate(errors), axis=0)).max() < 0.001


@pytest.mark.parametrize("slant", SLANTS[:3])
def test_align_slanted_under_a_known_warp_finds_place_and_slopes(slant: tuple[float, float]) -> None:
    """The right camera is turned about its axis by 6 degrees, and sees all 5 % larger."""
    turn = 1.05 * np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    left, _ = views(*slant)
    back = np.linalg.inv(turn)
    x, y = back[0, 0] * (X - 160.0) + back[0, 1] * (Y - 120.0), back[1, 0] * (X - 160.0) + back[1, 1] * (Y - 120.0)
    x, y = x + 160.0, y + 120.0
    source_x = (x + DISPARITY - slant[0] * MIDDLE[0] + slant[1] * (y - MIDDLE[1])) / (1.0 - slant[0])
    right, straight = picture(waves(source_x, y)), truth(grid(), *slant)
    centre = np.array(MIDDLE)
    expected = (straight - centre) @ turn.T + centre
    n = len(straight)
    direction, everything = turn @ NEARER, np.ones(n, dtype=bool)
    moved, slopes, _, found = align_slanted(
        left, right, pixel_words(right), grid(), expected + np.array([0.4, -0.3]),
        np.tile(direction / np.linalg.norm(direction), (n, 1)), np.tile(turn, (n, 1, 1)), np.zeros((n, 2, 2)),
        np.zeros((n, 2)), ~everything, everything, HALF,
    )  # fmt: skip
    assert found.mean() > 0.9
    assert np.median(np.linalg.norm(moved - expected, axis=1)[found]) < 0.03
    np.testing.assert_allclose(np.median(slopes[found], axis=0) / 1.05, slant, atol=0.01)


def test_align_slanted_of_a_bent_patch_finds_its_middle() -> None:
    """Shifts grow with the square of the distance from the middle, by 0.2 px at the patch's edge."""
    bend, place = 0.004, np.array([[MIDDLE[0] - DISPARITY, MIDDLE[1]]])
    from_middle = (np.sqrt(1.0 + 4.0 * bend * np.maximum(X - place[0, 0], -20.0)) - 1.0) / (2.0 * bend)
    errors = []
    for bends in (np.zeros((1, 2, 2)), np.array([[[bend, 0.0], [0.0, 0.0]]])):
        found_at = []
        for seed in range(12):
            left, right = picture(waves(X, Y, seed)), picture(waves(MIDDLE[0] + from_middle, Y, seed))
            one = np.ones(1, dtype=bool)
            moved, _, _, found = align_slanted(
                left, right, pixel_words(right), np.array([MIDDLE]), place.copy(), NEARER[None], np.eye(2)[None], bends,
                np.zeros((1, 2)), ~one, one, HALF,
            )  # fmt: skip
            assert found.all()
            found_at.append(moved[0] - place[0])
        errors.append(np.abs(np.median(found_at, axis=0)).max())
    assert errors[1] < 0.015 < 0.04 < errors[0]
