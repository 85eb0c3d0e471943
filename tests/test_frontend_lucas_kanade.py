"""Lucas-Kanade against shifts that are known, and against OpenCV's."""

from functools import cache

import cv2
import numpy as np
import pytest
from waves import picture, waves

from graphvio.arrays import Bool, Float, Image
from graphvio.frontend.imaging.lucas_kanade import build_pyramid, register, track
from graphvio.frontend.imaging.patches import bordered_room, lattice, prepare, room
from graphvio.frontend.imaging.sampling import pixel_words

LEVELS = 4


def texture(shift: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> Image:
    """Smooth random texture whose content is moved by (x, y) pixels, exactly: a sum of waves."""
    rng = np.random.default_rng(seed)
    kx, ky, phase = np.array([[*rng.normal(0.0, 0.25, 2), rng.uniform(0.0, 2.0 * np.pi)] for _ in range(80)]).T
    along_x, along_y = np.outer(kx, np.arange(320.0) - shift[0]), np.outer(ky, np.arange(240.0) - shift[1])
    along_y += phase[:, None]
    image = np.cos(along_y).T @ np.cos(along_x) - np.sin(along_y).T @ np.sin(along_x)  # the cosines of their sums
    return np.asarray(np.clip(np.round(128.0 + 12.0 * image), 0, 255), dtype=np.uint8)


def grid() -> Float:
    x, y = np.meshgrid(np.arange(50.0, 271.0, 20.0), np.arange(50.0, 191.0, 20.0))
    return np.column_stack([x.ravel(), y.ravel()]) + 0.3


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, -0.21), (6.5, 3.25), (-14.2, 9.9)])
def test_track_finds_a_known_shift(shift: tuple[float, float]) -> None:
    source, target = build_pyramid(texture(), LEVELS), build_pyramid(texture(shift), LEVELS)
    moved, found = track(source, target, grid(), grid(), window_px=15, levels=LEVELS, max_return_px=0.5)
    assert found.mean() > 0.85  # the others see the edge
    error = np.linalg.norm(moved - grid() - shift, axis=1)[found]
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.95) < 0.1


@pytest.mark.parametrize(("gain", "offset", "within_px"), [(1.0, -20.0, 0.03), (0.9, -10.0, 0.12)])
def test_track_under_a_change_of_exposure_hardly_moves(gain: float, offset: float, within_px: float) -> None:
    darker = (texture((1.3, 0.6)) * gain + offset).clip(0, 255).astype(np.uint8)
    source, target = build_pyramid(texture(), LEVELS), build_pyramid(darker, LEVELS)
    moved, found = track(source, target, grid(), grid(), window_px=15, levels=LEVELS, max_return_px=0.5)
    assert found.mean() > 0.9
    assert np.median(np.linalg.norm(moved - grid() - (1.3, 0.6), axis=1)[found]) < within_px


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 10.0), (0.5, 120.0)])
@pytest.mark.parametrize("is_brighter", [False, True])
def test_register_in_an_image_of_another_contrast_hardly_moves(gain: float, offset: float, is_brighter: bool) -> None:
    darker = (texture() * gain + offset).clip(0, 255).astype(np.uint8)
    source, target = (darker, texture((0.6, -0.4))) if is_brighter else (texture((-0.6, 0.4)), darker)
    level, everything = np.tile(np.eye(2), (len(grid()), 1, 1)), np.ones(len(grid()), dtype=bool)
    moved, found, _, _ = register(
        pixel_words(source), target, grid(), level, np.zeros_like(level), grid(), everything, 7, 2.0, 0.5, True
    )
    assert found.mean() > 0.9
    assert np.median(np.linalg.norm(moved - grid() - (0.6, -0.4), axis=1)[found]) < 0.03


def blurred(image: Image, length: int) -> Image:
    return np.asarray(cv2.filter2D(image, -1, np.full((1, length), 1.0 / length)), dtype=np.uint8)


def test_track_along_a_blur_is_rejected() -> None:
    """Along the blur an alignment ends where it begins; many points with one such error look like a motion."""
    images = [picture(waves(*np.meshgrid(np.arange(320.0) - x, np.arange(240.0)))) for x in (0.0, 0.6)]
    sharp, moved_by = build_pyramid(images[0], LEVELS), np.array([0.6, 0.0])
    level, everything = np.tile(np.eye(2), (len(grid()), 1, 1)), np.ones(len(grid()), dtype=bool)
    kept = []
    for length in (1, 5, 41):
        target = blurred(images[1], length)
        flowed, found = track(
            sharp, build_pyramid(target, LEVELS), grid(), grid(), window_px=15, levels=1, max_return_px=0.5
        )
        registered, there, _, _ = register(
            pixel_words(sharp[0]), target, grid(), level, np.zeros_like(level), grid(), everything, 7, 2.0, 0.5, False
        )
        kept.append((found.mean(), there.mean()))
        for places, good in ((flowed, found), (registered, there)):
            if good.sum() > 5:
                assert np.abs(np.median((places - grid() - moved_by)[good], axis=0)).max() < 0.05
    assert min(kept[0]) > 0.9
    assert min(kept[1]) > 0.7  # little blur leaves most places as they are
    assert max(kept[2]) < 0.15


def test_track_agrees_with_opencv() -> None:
    first, second = texture(), texture((4.2, -2.7))
    ours, found = track(
        build_pyramid(first, LEVELS), build_pyramid(second, LEVELS), grid(), grid(),
        window_px=15, levels=LEVELS, max_return_px=0.5,
    )  # fmt: skip
    points = grid().astype(np.float32)
    theirs, status, _ = cv2.calcOpticalFlowPyrLK(
        first, second, points, points.copy(), winSize=(15, 15), maxLevel=LEVELS - 1
    )
    both = found & (status.ravel() == 1)
    assert both.mean() > 0.95
    assert np.median(np.linalg.norm(ours - theirs, axis=1)[both]) < 0.02


def test_track_without_texture_finds_nothing() -> None:
    flat = np.full((240, 320), 120, dtype=np.uint8)
    edge = flat.copy()
    edge[:, 160:] = 200
    for image in (flat, edge):
        pyramid = build_pyramid(image, LEVELS)
        points = np.array([[160.0, 120.0], [100.0, 60.0]])
        _, found = track(pyramid, pyramid, points, points, window_px=15, levels=LEVELS, max_return_px=0.5)
        assert not found.any()


def test_track_of_points_at_the_edge_and_of_none() -> None:
    pyramid = build_pyramid(texture(), LEVELS)
    edge = np.array([[2.0, 2.0], [318.0, 100.0], [-5.0, 20.0], [1e6, 1e6]])
    _, found = track(pyramid, pyramid, edge, edge, window_px=15, levels=LEVELS, max_return_px=0.5)
    assert not found.any()
    none = np.zeros((0, 2))
    moved, found = track(pyramid, pyramid, none, none, window_px=15, levels=LEVELS, max_return_px=0.5)
    assert moved.shape == (0, 2)
    assert found.shape == (0,)


def test_track_into_another_scene_fails_the_way_back() -> None:
    source, target = build_pyramid(texture(seed=1), LEVELS), build_pyramid(texture(seed=2), LEVELS)
    _, found = track(source, target, grid(), grid(), window_px=15, levels=LEVELS, max_return_px=0.5)
    assert found.mean() < 0.2


# ------------------------------------------------------------------ deformed patches


def warped(warp: Float, middle: Float, place: Float, size: tuple[int, int] = (240, 320)) -> Image:
    """`waves` as a camera sees it whose pixel ``q`` shows what is at ``middle + warp (q - place)`` elsewhere."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    u, v = x - place[0], y - place[1]
    return picture(waves(middle[0] + warp[0, 0] * u + warp[0, 1] * v, middle[1] + warp[1, 0] * u + warp[1, 1] * v))


def rotation(angle_rad: float) -> Float:
    return np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])


WARPS = [np.eye(2), rotation(0.5), 1.4 * np.eye(2), 0.75 * rotation(-0.3), np.array([[1.0, 0.4], [0.0, 1.0]])]


PLACE = np.array([40.7, 40.4])


@cache
def deformed(number: int) -> list[tuple[Float, Image]]:
    """Middles (2,) of patches, and the images that a warp makes of them, each with its middle at the same place."""
    return [(middle, warped(WARPS[number], middle, PLACE, (80, 80))) for middle in grid()[::7]]


def registered(number: int, assumed: Float, guess_error: Float) -> tuple[Float, Bool]:
    """Errors (N, 2) of patches found in an image deformed by a warp, and whether each was found (N,)."""
    source = warped(np.eye(2), np.zeros(2), np.zeros(2))
    errors, found = [], []
    for middle, target in deformed(number):
        guess = (PLACE + guess_error)[None]
        moved, ok, _, _ = register(
            pixel_words(source),
            target,
            middle[None],
            assumed[None],
            np.zeros((1, 2, 2)),
            guess,
            np.ones(1, dtype=bool),
            7,
            2.0,
            1.0,
            False,
        )
        errors.append(moved[0] - PLACE)
        found.append(ok[0])
    return np.array(errors), np.array(found)


@pytest.mark.parametrize("number", range(len(WARPS)))
def test_register_finds_deformed_patches_to_sub_pixel_precision(number: int) -> None:
    errors, found = registered(number, WARPS[number], np.array([0.6, -0.5]))
    assert found.mean() > 0.8
    assert np.median(np.linalg.norm(errors[found], axis=1)) < 0.03


@pytest.mark.parametrize("number", range(1, len(WARPS)))
def test_register_without_the_deformation_is_off_or_fails(number: int) -> None:
    right, found = registered(number, WARPS[number], np.zeros(2))
    wrong, kept = registered(number, np.eye(2), np.zeros(2))
    off = np.where(kept, np.linalg.norm(wrong, axis=1), np.inf)
    assert np.median(off) > 3.0 * np.median(np.linalg.norm(right[found], axis=1))


def test_register_returns_the_guess_where_it_fails() -> None:
    image = warped(np.eye(2), np.zeros(2), np.zeros(2))
    flat = np.full_like(image, 90)
    pixels = np.vstack([grid()[:3], [[4.0, 4.0], [-50.0, 10.0], [1e6, 1e6]]])
    guess, n = pixels + np.array([0.3, 0.2]), len(pixels)
    warps, unbent, everything = np.tile(np.eye(2), (n, 1, 1)), np.zeros((n, 2, 2)), np.ones(n, dtype=bool)
    for source, target, wanted in ((image, image, ~everything), (flat, image, everything)):
        moved, found, localised, _ = register(
            pixel_words(source), target, pixels, warps, unbent, guess, wanted, 7, 2.0, 1.0, False
        )
        np.testing.assert_array_equal(moved, guess)
        assert not found.any()
        assert not localised.any()
    moved, found, localised, _ = register(
        pixel_words(image), image, pixels, warps, unbent, guess, everything, 7, 2.0, 1.0, False
    )
    np.testing.assert_array_equal(found, [True, True, True, False, False, False])
    np.testing.assert_array_equal(localised, found)
    np.testing.assert_array_equal(moved[~found], guess[~found])
    _, found, _, _ = register(
        pixel_words(image), image, pixels[:3], warps[:3], unbent[:3], guess[:3], everything[:3], 7, 0.1, 1.0, False
    )
    assert not found.any()  # they are farther from the guess than that


# ------------------------------------------------------------------ levels and thresholds


def test_track_tries_failures_of_few_levels_again_with_all() -> None:
    shift = (-14.2, 9.9)
    source, target = build_pyramid(texture(), LEVELS), build_pyramid(texture(shift), LEVELS)
    good, poor = grid() + shift + [0.8, -0.6], grid() + 1.0
    for guess in (good, poor):
        moved, found = track(
            source, target, grid(), guess, window_px=15, levels=LEVELS, max_return_px=0.5, first_levels=2
        )
        assert found.mean() > 0.75
        right = np.linalg.norm(moved - grid() - shift, axis=1)[found] < 0.1
        assert right.mean() > 0.8  # the finest levels alone may take a similar place for the right one


def test_track_min_gradient_admits_weaker_patches() -> None:
    faint = np.round(128.0 + (texture().astype(np.float64) - 128.0) / 40.0).astype(np.uint8)
    pyramid = build_pyramid(faint, LEVELS)
    shares = [
        track(pyramid, pyramid, grid(), grid(), window_px=15, levels=1, max_return_px=0.5, min_gradient=least)[1].mean()
        for least in (1.0, 0.2)
    ]
    assert shares[0] < 0.1
    assert shares[1] > 0.9


@pytest.mark.parametrize("window_px", [9, 15, 17, 33])  # with and without a whole vector register to a row
def test_track_with_patches_of_any_size(window_px: int) -> None:
    source, target = build_pyramid(texture(), LEVELS), build_pyramid(texture((0.6, -0.3)), LEVELS)
    moved, found = track(source, target, grid(), grid(), window_px=window_px, levels=2, max_return_px=0.5)
    assert found.mean() > 0.85
    assert np.median(np.linalg.norm(moved - grid() - (0.6, -0.3), axis=1)[found]) < 0.03


def test_sample_up_to_the_edge_stays_within_the_image() -> None:
    image = texture()
    pyramid = build_pyramid(image, 1)
    x, y = np.meshgrid(np.arange(0.0, 320.0, 3.1), np.arange(0.0, 240.0, 3.1))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    moved, found = track(pyramid, pyramid, pixels, pixels, window_px=15, levels=1, max_return_px=0.5)
    inside = (pixels >= 9.0).all(axis=1) & (pixels < [310.0, 230.0]).all(axis=1)
    assert found[inside].mean() > 0.9
    assert not found[(pixels < 8.0).any(axis=1)].any()
    np.testing.assert_allclose(moved[found], pixels[found], atol=0.01)


@pytest.mark.parametrize("half", [3, 6, 7, 10, 15])
def test_prepare_computes_gradients_of_any_size(half: int) -> None:
    """Central differences of the patch with its border, all of zero mean, and zero in the padding."""
    side = 2 * half + 1
    bordered, patch, gx, gy = bordered_room(half), room(half), room(half), room(half)
    values = np.random.default_rng(half).random((side + 2, side + 2)).astype(np.float32)
    bordered.flat[:] = 1e30  # what lies behind the last row has no weight
    bordered.rows[:] = values
    normal = prepare(bordered, lattice(half).inside, patch, gx, gy)
    plain_values = [
        values[1:-1, 1:-1],
        0.5 * (values[1:-1, 2:] - values[1:-1, :-2]),
        0.5 * (values[2:, 1:-1] - values[:-2, 1:-1]),
    ]
    for found, plain in zip((patch, gx, gy), plain_values, strict=True):
        np.testing.assert_allclose(found.rows[:, :side], plain - plain.mean(), atol=1e-5)
        assert not found.rows[:, side:].any()
    columns = np.column_stack([each.rows[:, :side].ravel() for each in (gx, gy, patch)])
    expected = (columns.T @ columns)[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    found_sums = [normal.xx, normal.xy, normal.yy, normal.px, normal.py, normal.pp]
    np.testing.assert_allclose(found_sums, expected, rtol=1e-3, atol=1e-3)
