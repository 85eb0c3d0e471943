import numpy as np
from synthetic import transform, two_pair_rig

from graphvio.arrays import Float
from graphvio.cameras import project_points
from graphvio.frontend.prediction import around, inverse_depths_around, predict_pixels, predict_warps
from graphvio.rig import Camera

CAMERA = two_pair_rig().pairs[0].left
MODEL = (CAMERA.model_number, CAMERA.intrinsics, np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0]))
MOTION = transform([0.05, -0.1, 0.2], [0.2, -0.1, 0.3])


def rays(n: int = 50) -> Float:
    return np.random.default_rng(0).uniform(-0.4, 0.4, (n, 2))


def test_pixels_and_inverse_depths() -> None:
    depths = np.random.default_rng(1).uniform(1.0, 10.0, 50)
    pixels, inverse_depths, valid = predict_pixels(rays(), 1.0 / depths, MOTION, *MODEL)
    points = np.column_stack([rays(), np.ones(50)]) * depths[:, None] @ MOTION[:3, :3].T + MOTION[:3, 3]
    expected, ok = project_points(*MODEL, np.ascontiguousarray(points))
    assert valid.all()
    assert ok.all()
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(inverse_depths, 1.0 / points[:, 2], rtol=1e-12)


def test_points_that_come_behind_the_camera_have_no_pixel() -> None:
    back = transform([0.0, 0.0, 0.0], [0.0, 0.0, -2.0])
    pixels, inverse_depths, valid = predict_pixels(rays(3), np.array([1.0, 0.4, 0.0]), back, *MODEL)
    assert valid.tolist() == [False, True, True]
    assert np.isfinite(pixels).all()
    assert inverse_depths.tolist()[0] == 0.0
    assert inverse_depths[2] == 0.0  # infinitely far, before and after


STEP_PX = 4.3  # as for patches of 15 pixels
NORMAL, DISTANCE_M = np.array([0.8, -0.3, 0.52]), 0.9  # a wall seen askew
WALL = NORMAL / DISTANCE_M  # inverse depth of a ray [x, y, 1] is its product with this


def pixels(n: int = 50) -> Float:
    return np.random.default_rng(2).uniform([150.0, 100.0], [500.0, 400.0], (n, 2))


def unprojected(at: Float, camera: Camera = CAMERA) -> Float:
    return np.asarray(camera.unproject(np.ascontiguousarray(at.reshape(-1, 2)))[0].reshape(at.shape))


def on_wall(rays: Float) -> Float:
    return np.asarray(rays @ WALL[:2] + WALL[2])


def seen_after(at: Float, motion: Float, camera: Camera = CAMERA) -> Float:
    """Where the wall's points at pixels (..., 2) are after a motion, by the exact homography."""
    rays = unprojected(at).reshape(-1, 2)
    points = np.column_stack([rays, np.ones(len(rays))]) / on_wall(rays)[:, None] @ motion[:3, :3].T + motion[:3, 3]
    return np.asarray(camera.project(np.ascontiguousarray(points))[0].reshape(at.shape))


def test_warps_are_the_affine_maps_nearest_to_a_slanted_walls_deformation() -> None:
    motion = transform([0.01, -0.03, 0.02], [0.05, 0.05, -0.35])
    at = around(pixels(), STEP_PX)
    rays = unprojected(at)
    warps, shifts, valid = predict_warps(
        rays, on_wall(rays), STEP_PX, motion, CAMERA.model_number, CAMERA.intrinsics, CAMERA.distortion
    )
    assert valid.all()
    offsets = np.stack(np.meshgrid(np.arange(-7.0, 8.0), np.arange(-7.0, 8.0)), axis=-1).reshape(-1, 2)
    constants, by_centre = [], []
    for k in range(len(warps)):
        source = pixels()[k] + offsets
        target = seen_after(source, motion) - seen_after(pixels()[k : k + 1], motion)
        mapped = target @ warps[k].T
        constants.append(np.mean(offsets - mapped - shifts[k], axis=0))
        by_centre.append(np.mean(offsets - mapped, axis=0))
        np.testing.assert_allclose(mapped + shifts[k], offsets, atol=0.2)
    assert np.abs(constants).max() < 0.004  # pixels
    assert np.abs(by_centre).max() > 0.015  # what a map that is right at the centre alone would add to every point


def test_without_motion_nothing_is_deformed() -> None:
    rays = unprojected(around(pixels(), STEP_PX))
    warps, shifts, valid = predict_warps(
        rays, on_wall(rays), STEP_PX, np.eye(4), CAMERA.model_number, CAMERA.intrinsics, CAMERA.distortion
    )
    assert valid.all()
    np.testing.assert_allclose(warps, np.tile(np.eye(2), (50, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(shifts, 0.0, atol=1e-6)


def test_warps_need_a_visible_surface() -> None:
    rays = unprojected(around(pixels(3), STEP_PX))
    behind = transform([0.0, 0.0, 0.0], [0.0, 0.0, -50.0])
    edge_on = np.repeat([[0.5], [0.5], [0.9], [0.5], [0.5]], 3, axis=1)
    for depths, motion in ((on_wall(rays), behind), (edge_on, transform([0.0, 0.0, 0.0], [-3.0, 0.0, 0.0]))):
        arguments = (STEP_PX, motion, CAMERA.model_number, CAMERA.intrinsics, CAMERA.distortion)
        assert not predict_warps(rays, depths, *arguments)[2].any()


def test_the_slopes_of_stereo_matches_tell_the_wall() -> None:
    pair = two_pair_rig().pairs[0]
    at = around(pixels(), STEP_PX)
    rays = unprojected(at)
    middle = rays[0]
    along = _right_pixel(middle, on_wall(middle) + 0.01) - _right_pixel(middle, on_wall(middle))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    slopes = np.empty((50, 2))
    for k in range(2):
        step = np.eye(2)[k]
        ahead, behind = (seen_after(at[0] + sign * step, pair.right_T_left, pair.right) for sign in (1.0, -1.0))
        slopes[:, k] = np.sum((0.5 * (ahead - behind) - step) * along, axis=1)
    right = pair.right
    arguments = (pair.right_T_left, right.model_number, right.intrinsics, right.distortion)
    told = inverse_depths_around(rays, on_wall(middle), slopes, STEP_PX, *arguments)
    np.testing.assert_allclose(told, on_wall(rays), rtol=5e-3)
    assert np.ptp(on_wall(rays) / on_wall(middle), axis=0).min() > 0.01  # the wall is slanted, all over


def _right_pixel(rays: Float, inverse_depths: Float) -> Float:
    pair = two_pair_rig().pairs[0]
    points = np.column_stack([rays, np.ones(len(rays))]) / inverse_depths[:, None]
    moved = points @ pair.right_T_left[:3, :3].T + pair.right_T_left[:3, 3]
    return np.asarray(pair.right.project(np.ascontiguousarray(moved))[0])
