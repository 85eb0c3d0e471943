import cv2
import numpy as np
import pytest
from synthetic import transform

from graphvio.arrays import Bool, Float, Image
from graphvio.cameras import RADIAL_TANGENTIAL, project_points, unproject_pixels
from graphvio.config.stages import StereoConfig
from graphvio.frontend.depth.stereo import epipolar_lines, epipolar_search, triangulate
from graphvio.frontend.imaging.lucas_kanade import build_pyramid

FOCAL, BASELINE = 400.0, 0.1
INTRINSICS = np.array([FOCAL, FOCAL, 160.0, 120.0])
RECTIFIED = transform([0.0, 0.0, 0.0], [-BASELINE, 0.0, 0.0])
SKEWED = transform([0.02, -0.05, 0.03], [-0.11, 0.01, -0.02])


def homogeneous(points: Float) -> Float:
    """Points (N, 3) in metres as ``[x, y, 1/Z]``."""
    return np.column_stack([points[:, :2] / points[:, 2:], 1.0 / points[:, 2]])


def views(points: Float, right_T_left: Float) -> tuple[Float, Float]:
    moved = points @ right_T_left[:3, :3].T + right_T_left[:3, 3]
    return (np.ascontiguousarray(points[:, :2] / points[:, 2:]), np.ascontiguousarray(moved[:, :2] / moved[:, 2:]))


def scattered(n: int, seed: int = 0) -> Float:
    rng = np.random.default_rng(seed)
    depths = rng.uniform(0.4, 40.0, n)
    return np.column_stack([rng.uniform(-0.6, 0.6, n), rng.uniform(-0.5, 0.5, n), np.ones(n)]) * depths[:, None]


def test_triangulate_rectified_pair_is_depth_from_disparity() -> None:
    disparity_px = np.array([0.5, 1.0, 7.0, 40.0, 120.0])
    left = np.column_stack([np.linspace(-0.3, 0.3, 5), np.linspace(0.2, -0.2, 5)])
    right = left - np.column_stack([disparity_px / FOCAL, np.zeros(5)])
    points, covariances, errors = triangulate(left, right, RECTIFIED, FOCAL, FOCAL)
    np.testing.assert_allclose(1.0 / points[:, 2], FOCAL * BASELINE / disparity_px, rtol=1e-10)  # Z = f b / d
    np.testing.assert_allclose(points[:, :2], left, atol=1e-12)
    np.testing.assert_allclose(errors, 0.0, atol=1e-8)
    # w = (x_l - x_r) / b, y seen twice: closed forms of the variances for 1 px.
    np.testing.assert_allclose(covariances[:, 2, 2], 2.0 / (FOCAL * BASELINE) ** 2, rtol=1e-8)
    np.testing.assert_allclose(covariances[:, 0, 0], 1.0 / FOCAL**2, rtol=1e-8)
    np.testing.assert_allclose(covariances[:, 1, 1], 0.5 / FOCAL**2, rtol=1e-8)
    np.testing.assert_allclose(covariances[:, 0, 2], 1.0 / (FOCAL**2 * BASELINE), rtol=1e-8)


def test_triangulate_any_pair_agrees_with_opencv() -> None:
    points = scattered(200)
    left, right = views(points, SKEWED)
    found, _, errors = triangulate(left, right, SKEWED, FOCAL, 1.1 * FOCAL)
    np.testing.assert_allclose(found, homogeneous(points), atol=1e-9)
    assert errors.max() < 1e-6
    by_opencv = cv2.triangulatePoints(np.eye(4)[:3], np.ascontiguousarray(SKEWED[:3]), left.T, right.T)
    np.testing.assert_allclose(found, homogeneous((by_opencv[:3] / by_opencv[3]).T), atol=1e-6)


def test_triangulate_error_is_the_distance_from_the_epipolar_line() -> None:
    left = np.array([[0.1, 0.05]])
    right = left - [[0.03, 6.0 / FOCAL]]
    _, _, errors = triangulate(left, right, RECTIFIED, FOCAL, FOCAL)
    assert errors[0] == pytest.approx(6.0 / np.sqrt(2.0))  # shared evenly by both images


def test_triangulate_infinitely_far_points_is_regular() -> None:
    left = np.array([[0.0, 0.0], [0.3, -0.2]])
    rays = np.column_stack([left, np.ones(2)]) @ SKEWED[:3, :3].T
    found, covariances, errors = triangulate(left, rays[:, :2] / rays[:, 2:], SKEWED, FOCAL, FOCAL)
    np.testing.assert_allclose(found, np.column_stack([left, np.zeros(2)]), atol=1e-12)
    assert errors.max() < 1e-9
    assert np.linalg.eigvalsh(covariances).min() > 0.0


def test_triangulate_negative_disparity_is_a_negative_inverse_depth() -> None:
    left = np.array([[0.1, 0.0]])
    found, _, _ = triangulate(left, left + np.array([2.0 / FOCAL, 0.0]), RECTIFIED, FOCAL, FOCAL)
    assert found[0, 2] == pytest.approx(-2.0 / (FOCAL * BASELINE))


@pytest.mark.parametrize("depth", [0.5, 3.0, 50.0])
def test_triangulate_covariance_matches_monte_carlo(depth: float) -> None:
    n, sigma_px = 20000, 0.3
    rng = np.random.default_rng(3)
    left, right = views(np.array([[0.2, -0.1, 1.0]]) * depth, SKEWED)
    noisy_left = left + sigma_px / FOCAL * rng.standard_normal((n, 2))
    noisy_right = right + sigma_px / (1.1 * FOCAL) * rng.standard_normal((n, 2))
    found, covariances, errors = triangulate(noisy_left, noisy_right, SKEWED, FOCAL, 1.1 * FOCAL)
    truth = np.array([0.2, -0.1, 1.0 / depth])
    whitened = np.linalg.inv(np.linalg.cholesky(sigma_px**2 * covariances[0])) @ (found - truth).T
    np.testing.assert_allclose(whitened.mean(axis=1), 0.0, atol=0.05)
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=0.05)
    assert np.mean(errors**2) == pytest.approx(sigma_px**2, rel=0.05)  # four coordinates, three unknowns


# ------------------------------------------------------------------ epipolar search


def textured(seed: int = 0) -> Image:
    """Smooth random grey, finer than a patch, so that every place looks different."""
    grey = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((240, 320)), (0, 0), 1.5)
    return np.asarray(np.clip(128.0 + 150.0 * grey, 0, 255), dtype=np.uint8)


def search(left: Image, right: Image, pixels: Float, nearest_m: float = 0.5) -> tuple[Float, Bool]:
    lens = np.zeros(5)
    rays, _ = unproject_pixels(RADIAL_TANGENTIAL, INTRINSICS, lens, pixels)
    bounds = np.column_stack([np.zeros(len(pixels)), np.full(len(pixels), 1.0 / nearest_m)])
    least = StereoConfig().min_correlation
    images = build_pyramid(left, 2), build_pyramid(right, 2)
    camera = (RECTIFIED, RADIAL_TANGENTIAL, INTRINSICS, lens)
    inverse_depths, found, _ = epipolar_search(images[0], images[1], pixels, rays, bounds, *camera, least)
    return epipolar_lines(rays, inverse_depths, *camera)[0], found


def grid() -> Float:
    x, y = np.meshgrid(np.arange(100.0, 300.0, 23.0), np.arange(20.0, 220.0, 23.0))
    return np.column_stack([x.ravel(), y.ravel()])


@pytest.mark.parametrize("disparity", [0, 3, 17, 60])
def test_epipolar_search_finds_the_known_disparity(disparity: int) -> None:
    left = textured()
    right = np.roll(left, -disparity, axis=1)
    noise = np.random.default_rng(1).normal(0.0, 3.0, right.shape)
    pixels = grid()
    matches, found = search(left, np.clip(0.7 * right + 20.0 + noise, 0, 255).astype(np.uint8), pixels)
    assert found.all()
    np.testing.assert_allclose(matches, pixels - [disparity, 0.0], atol=0.76)


def test_epipolar_search_of_a_repeating_texture_is_rejected() -> None:
    tile = textured()[:, :24]
    left = np.ascontiguousarray(np.tile(tile, (1, 14))[:, :320])
    _, found = search(left, np.roll(left, -30, axis=1), grid())
    assert not found.any()
    _, found = search(left, np.roll(left, -10, axis=1), grid(), nearest_m=2.0)  # only 20 px are searched
    assert found.mean() > 0.8


def test_epipolar_search_without_the_patch_is_rejected() -> None:
    _, found = search(textured(), textured(1), grid())
    assert found.mean() < 0.25  # a fine texture looks like any other somewhere
    flat = np.full((240, 320), 90, dtype=np.uint8)
    assert not search(flat, flat, grid())[1].any()
    assert not search(textured(), flat, grid())[1].any()


def test_epipolar_search_follows_the_curve_of_a_distorted_lens() -> None:
    left, lens = textured(2), np.array([-0.25, 0.06, 1e-3, -1e-3, 0.0])
    pixels = grid()[::5]
    rays, _ = unproject_pixels(RADIAL_TANGENTIAL, INTRINSICS, np.zeros(5), pixels)
    points = np.column_stack([rays, np.ones(len(rays))]) * 2.0
    moved = np.ascontiguousarray(points @ SKEWED[:3, :3].T + SKEWED[:3, 3])
    places, _ = project_points(RADIAL_TANGENTIAL, INTRINSICS, lens, moved)
    right = textured(3)
    for (x, y), (u, v) in zip(pixels.astype(int), np.round(places).astype(int), strict=True):
        if 12 <= u < 308 and 12 <= v < 228:
            right[v - 11 : v + 12, u - 11 : u + 12] = left[y - 11 : y + 12, x - 11 : x + 12]
    inside = (places.min(axis=1) > 12) & (places[:, 0] < 307) & (places[:, 1] < 227)
    bounds = np.column_stack([np.zeros(len(rays)), np.full(len(rays), 2.0)])
    images = build_pyramid(left, 2), build_pyramid(right, 2)
    camera = (SKEWED, RADIAL_TANGENTIAL, INTRINSICS, lens)
    inverse_depths, found, _ = epipolar_search(images[0], images[1], pixels, rays, bounds, *camera, 0.7)
    matches = epipolar_lines(rays, inverse_depths, *camera)[0]
    assert inside.sum() >= 10
    assert found[inside].mean() > 0.8
    good = inside & found
    assert np.abs(matches[good] - places[good]).max() < 1.5


def test_epipolar_search_covers_the_part_of_a_curve_within_the_lens() -> None:
    """Half a metre away the points would be beyond the radius at which this lens folds back."""
    left, lens = textured(), np.array([-0.9, 0.0, 0.0, 0.0, 0.0])
    pixels = grid()[::3]
    rays, _ = unproject_pixels(RADIAL_TANGENTIAL, INTRINSICS, np.zeros(5), pixels)
    camera = RECTIFIED, RADIAL_TANGENTIAL, INTRINSICS, lens
    _, _, near = epipolar_lines(rays, np.full(len(rays), 8.0), *camera)
    _, _, far = epipolar_lines(rays, np.full(len(rays), 0.2), *camera)
    cut = far & ~near
    assert cut.sum() >= 5
    places = epipolar_lines(rays, np.full(len(rays), 0.2), *camera)[0]
    right = textured(3)
    for (x, y), (u, v) in zip(pixels[cut].astype(int), np.round(places[cut]).astype(int), strict=True):
        if 12 <= u < 308 and 12 <= v < 228:
            right[v - 11 : v + 12, u - 11 : u + 12] = left[y - 11 : y + 12, x - 11 : x + 12]
    bounds = np.column_stack([np.zeros(len(rays)), np.full(len(rays), 8.0)])
    images = build_pyramid(left, 2), build_pyramid(right, 2)
    inverse_depths, found, _ = epipolar_search(images[0], images[1], pixels, rays, bounds, *camera, 0.7)
    assert (found & cut).sum() >= 3
    seen = epipolar_lines(rays, inverse_depths, *camera)[0]
    assert np.median(np.abs(seen - places)[found & cut]) < 1.5


# ------------------------------------------------------------------ epipolar lines


def test_epipolar_lines_of_a_rectified_pair_are_rows() -> None:
    rays = np.array([[0.1, -0.05], [-0.2, 0.1], [0.0, 0.0]])
    pixels, directions, valid = epipolar_lines(
        rays, np.array([0.0, 0.5, 2.0]), RECTIFIED, RADIAL_TANGENTIAL, INTRINSICS, np.zeros(5)
    )
    assert valid.all()
    disparity = FOCAL * BASELINE * np.array([0.0, 0.5, 2.0])
    left = FOCAL * rays + INTRINSICS[2:]
    np.testing.assert_allclose(pixels, left - np.column_stack([disparity, np.zeros(3)]), atol=1e-9)
    np.testing.assert_allclose(directions, np.tile([-1.0, 0.0], (3, 1)), atol=1e-9)


def test_epipolar_lines_of_any_pair_follow_the_projection() -> None:
    lens, points = np.array([-0.25, 0.06, 1e-3, -1e-3, 0.0]), scattered(50, seed=4)
    points = points[points[:, 2] > 1.0]
    rays, _ = views(points, SKEWED)
    w = 1.0 / points[:, 2]
    pixels, directions, valid = epipolar_lines(rays, w, SKEWED, RADIAL_TANGENTIAL, INTRINSICS, lens)

    def projected(inverse_depths: Float) -> Float:
        moved = np.column_stack([rays, np.ones(len(rays))]) @ SKEWED[:3, :3].T
        moved = moved + inverse_depths[:, None] * SKEWED[:3, 3]
        return project_points(RADIAL_TANGENTIAL, INTRINSICS, lens, np.ascontiguousarray(moved))[0]

    np.testing.assert_allclose(pixels[valid], projected(w)[valid], atol=1e-9)
    slope = (projected(w + 1e-6) - projected(w - 1e-6))[valid]
    slope /= np.linalg.norm(slope, axis=1)[:, None]
    np.testing.assert_allclose(directions[valid], slope, atol=0.01)
    assert valid.mean() > 0.9


def test_epipolar_lines_behind_the_right_camera_are_invalid() -> None:
    ahead = transform([0.0, 0.0, 0.0], [-BASELINE, 0.0, -1.0])
    _, _, valid = epipolar_lines(
        np.zeros((2, 2)), np.array([2.0, 0.5]), ahead, RADIAL_TANGENTIAL, INTRINSICS, np.zeros(5)
    )
    assert valid.tolist() == [False, True]
