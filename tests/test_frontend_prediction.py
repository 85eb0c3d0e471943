"""Predicted places and deformations against the exact view of a plane through each camera model."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import transform, two_pair_rig

from graphvio.arrays import Float
from graphvio.cameras import project_points
from graphvio.frontend.depth.prediction import (
    around,
    inverse_depths_around,
    predict_pixels,
    predict_warps,
    stereo_warps,
)
from graphvio.rig import Camera, StereoPair

PAIR = two_pair_rig().pairs[0]
CAMERA = PAIR.left
LENSES = [
    ("radial-tangential", np.zeros(5)),
    ("radial-tangential", np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0])),
    ("equidistant", np.array([0.03, -0.01, 0.004, -0.001])),
]
with_lenses = pytest.mark.parametrize("lens", LENSES, ids=["ideal", "barrel", "fisheye"])
MODEL = (CAMERA.model_number, CAMERA.intrinsics, np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0]))
MOTION = transform([0.05, -0.1, 0.2], [0.2, -0.1, 0.3])


def rays(n: int = 50) -> Float:
    return np.random.default_rng(0).uniform(-0.4, 0.4, (n, 2))


def test_predict_pixels_returns_pixels_and_inverse_depths() -> None:
    depths = np.random.default_rng(1).uniform(1.0, 10.0, 50)
    pixels, inverse_depths, valid = predict_pixels(rays(), 1.0 / depths, MOTION, *MODEL)
    points = np.column_stack([rays(), np.ones(50)]) * depths[:, None] @ MOTION[:3, :3].T + MOTION[:3, 3]
    expected, ok = project_points(*MODEL, np.ascontiguousarray(points))
    assert valid.all()
    assert ok.all()
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(inverse_depths, 1.0 / points[:, 2], rtol=1e-12)


def test_predict_pixels_behind_the_camera_is_invalid() -> None:
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


def through(lens: tuple[str, Float]) -> StereoPair:
    """The pair with other lenses, not quite the same left and right."""
    model, distortion = lens
    right = replace(PAIR.right, model=model, distortion=0.9 * distortion)
    return replace(PAIR, left=replace(CAMERA, model=model, distortion=distortion), right=right)


def unprojected(at: Float, camera: Camera = CAMERA) -> Float:
    return np.asarray(camera.unproject(np.ascontiguousarray(at.reshape(-1, 2)))[0].reshape(at.shape))


def on_wall(rays: Float) -> Float:
    return np.asarray(rays @ WALL[:2] + WALL[2])


def seen_after(at: Float, motion: Float, camera: Camera = CAMERA, after: Camera | None = None) -> Float:
    """Where the wall's points at pixels (..., 2) are after a motion, or in another camera, by the exact homography."""
    rays = unprojected(at, camera).reshape(-1, 2)
    points = np.column_stack([rays, np.ones(len(rays))]) / on_wall(rays)[:, None] @ motion[:3, :3].T + motion[:3, 3]
    return np.asarray((after or camera).project(np.ascontiguousarray(points))[0].reshape(at.shape))


@with_lenses
def test_predict_warps_are_nearest_to_the_deformation_of_a_slanted_wall(lens: tuple[str, Float]) -> None:
    camera = through(lens).left
    motion = transform([0.01, -0.03, 0.02], [0.05, 0.05, -0.35])
    at = around(pixels(), STEP_PX)
    rays = unprojected(at, camera)
    warps, bends, valid = predict_warps(
        rays, on_wall(rays), STEP_PX, motion, camera.model_number, camera.intrinsics, camera.distortion
    )
    assert valid.all()
    offsets = np.stack(np.meshgrid(np.arange(-7.0, 8.0), np.arange(-7.0, 8.0)), axis=-1).reshape(-1, 2)
    constants, by_centre = [], []
    for k in range(len(warps)):
        source = pixels()[k] + offsets
        target = seen_after(source, motion, camera) - seen_after(pixels()[k : k + 1], motion, camera)
        mapped = target @ warps[k].T
        bent = (offsets**2 @ bends[k]) @ warps[k].T
        constants.append(np.mean(offsets - mapped + bent, axis=0))
        by_centre.append(np.mean(offsets - mapped, axis=0))
        np.testing.assert_allclose(mapped - bent, offsets, atol=0.2)
    assert np.abs(constants).max() < 0.004  # pixels
    assert np.abs(by_centre).max() > 0.015  # what a map that is right at the centre alone would add to every point


def test_predict_warps_without_motion_are_the_identity() -> None:
    rays = unprojected(around(pixels(), STEP_PX))
    warps, bends, valid = predict_warps(
        rays, on_wall(rays), STEP_PX, np.eye(4), CAMERA.model_number, CAMERA.intrinsics, CAMERA.distortion
    )
    assert valid.all()
    np.testing.assert_allclose(warps, np.tile(np.eye(2), (50, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(bends, 0.0, atol=1e-7)


def test_predict_warps_of_hidden_surfaces_are_invalid() -> None:
    rays = unprojected(around(pixels(3), STEP_PX))
    behind = transform([0.0, 0.0, 0.0], [0.0, 0.0, -50.0])
    edge_on = np.repeat([[0.5], [0.5], [0.9], [0.5], [0.5]], 3, axis=1)
    for depths, motion in ((on_wall(rays), behind), (edge_on, transform([0.0, 0.0, 0.0], [-3.0, 0.0, 0.0]))):
        arguments = (STEP_PX, motion, CAMERA.model_number, CAMERA.intrinsics, CAMERA.distortion)
        assert not predict_warps(rays, depths, *arguments)[2].any()


@with_lenses
def test_inverse_depths_around_follow_the_slopes_of_stereo_matches(lens: tuple[str, Float]) -> None:
    pair = through(lens)
    at = around(pixels(), STEP_PX)
    rays = unprojected(at, pair.left)
    found = inverse_depths_around(rays, on_wall(rays[0]), slopes(pair, at[0]), STEP_PX, *right_view(pair))
    np.testing.assert_allclose(found, on_wall(rays), rtol=5e-3)
    assert np.ptp(on_wall(rays) / on_wall(rays[0]), axis=0).min() > 0.01  # the wall is slanted, all over


def test_inverse_depths_around_are_those_of_a_plane_far_from_a_fisheyes_axis() -> None:
    """A plane's inverse depth is not linear in the pixels of such a lens: without that, all points seem to move too
    far."""
    lens = (512, 512), np.array([190.0, 190.0, 255.5, 255.5]), np.array([0.0034, 0.0007, -0.0020, 0.0002])
    left, right = (Camera(each.name, "equidistant", *lens, each.body_T_cam) for each in (PAIR.left, PAIR.right))
    pair = replace(PAIR, left=left, right=right)
    angles = np.random.default_rng(3).uniform([0.8, -0.3], [1.15, 0.3], (50, 2))  # from the axis, to the right
    turn = angles[:, 1]
    at = around(255.5 + 190.0 * angles[:, :1] * np.column_stack([np.cos(turn), np.sin(turn)]), STEP_PX)
    rays = unprojected(at, left)
    found, true = (
        inverse_depths_around(rays, on_wall(rays[0]), slopes(pair, at[0]), STEP_PX, *right_view(pair)),
        on_wall(rays),
    )
    bend, true_bend = (0.5 * each[1:].sum(axis=0) - 2.0 * each[0] for each in (found, true))
    assert np.abs(true_bend).min() > 0.0
    np.testing.assert_allclose(bend, true_bend, rtol=0.1)
    np.testing.assert_allclose(found, true, rtol=5e-3)


def test_inverse_depths_around_unseen_points_are_their_own() -> None:
    at = around(pixels(3), STEP_PX)
    rays, steep = unprojected(at), np.full((3, 2), 0.3)
    behind = transform([0.0, 0.0, 0.0], [0.0, 0.0, -50.0])  # of all points
    found = inverse_depths_around(rays, on_wall(rays[0]), steep, STEP_PX, behind, *right_view(PAIR)[1:])
    np.testing.assert_array_equal(found, np.tile(on_wall(rays[0]), (5, 1)))


@with_lenses
def test_stereo_warps_are_derivatives_at_constant_depth(lens: tuple[str, Float]) -> None:
    pair, at = through(lens), pixels()
    rays = unprojected(at, pair.left)
    depths = on_wall(rays)
    warps, bends = stereo_warps(rays, depths, pair.right_T_left, *lens_of(pair.left), *lens_of(pair.right))
    middle = right_pixel(pair, rays, depths)
    for k, step in enumerate(np.eye(2)):
        ahead, behind = (right_pixel(pair, unprojected(at + s * step, pair.left), depths) for s in (1.0, -1.0))
        np.testing.assert_allclose(warps[:, :, k], 0.5 * (ahead - behind), atol=1e-5)
        bent = 0.5 * (ahead + behind) - middle
        np.testing.assert_allclose(bends[:, k], bent, atol=2e-6 + 0.05 * np.abs(bent).max())  # of a step to one side


def test_stereo_warps_where_a_lens_does_not_reach_are_the_identity() -> None:
    behind = transform([0.0, 0.0, 0.0], [0.0, 0.0, -50.0])
    warps, bends = stereo_warps(rays(3), np.full(3, 0.5), behind, *lens_of(CAMERA), *lens_of(CAMERA))
    np.testing.assert_array_equal(warps, np.tile(np.eye(2), (3, 1, 1)))
    assert not bends.any()


def lens_of(camera: Camera) -> tuple[int, Float, Float]:
    return camera.model_number, camera.intrinsics, camera.distortion


def right_view(pair: StereoPair) -> tuple[Float, int, Float, Float]:
    return pair.right_T_left, pair.right.model_number, pair.right.intrinsics, pair.right.distortion


def slopes(pair: StereoPair, at: Float) -> Float:
    """What stereo matching would measure on the wall: the shift's derivative with respect to the left pixel."""
    rays = unprojected(at, pair.left)
    depths = on_wall(rays)
    direction, measured = along(pair, rays, depths), np.empty((len(at), 2))
    for k, step in enumerate(np.eye(2)):
        slanted, level = np.zeros((2, len(at), 2))
        for sign in (1.0, -1.0):
            beside = at + sign * step
            slanted += 0.5 * sign * seen_after(beside, pair.right_T_left, pair.left, pair.right)
            level += 0.5 * sign * right_pixel(pair, unprojected(beside, pair.left), depths)
        measured[:, k] = np.sum((slanted - level) * direction, axis=1)
    return measured


def along(pair: StereoPair, rays: Float, inverse_depths: Float) -> Float:
    """Directions (N, 2) of the epipolar lines in the right image, towards near points."""
    direction = right_pixel(pair, rays, inverse_depths + 0.01) - right_pixel(pair, rays, inverse_depths)
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


def right_pixel(pair: StereoPair, rays: Float, inverse_depths: Float) -> Float:
    moved = np.column_stack([rays, np.ones(len(rays))]) @ pair.right_T_left[:3, :3].T
    moved += inverse_depths[:, None] * pair.right_T_left[:3, 3]
    return np.asarray(pair.right.project(np.ascontiguousarray(moved))[0])
