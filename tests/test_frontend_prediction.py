import numpy as np
from synthetic import transform, two_pair_rig

from graphvio.arrays import Float
from graphvio.cameras import project_points
from graphvio.frontend.prediction import predict_pixels, predict_warps

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


def test_warps_are_the_derivative_of_the_way_back() -> None:
    at, w, step = rays(), np.full(50, 0.25), 1e-3
    px = [at + np.array(d) / CAMERA.intrinsics[:2] for d in ([0.0, 0.0], [step, 0.0], [0.0, step])]
    moved = [predict_pixels(p, w, MOTION, *MODEL)[0] for p in px]
    warps, valid = predict_warps(np.stack(px), w, MOTION, *MODEL)
    assert not valid.any()  # steps of a thousandth of a pixel have too small an area
    ahead = [at + np.array(d) / CAMERA.intrinsics[:2] for d in ([1.0, 0.0], [0.0, 1.0])]
    warps, valid = predict_warps(np.stack([at, *ahead]), w, MOTION, *MODEL)
    assert valid.all()
    forth = np.stack([(moved[1] - moved[0]) / step, (moved[2] - moved[0]) / step], axis=-1)
    np.testing.assert_allclose(warps @ forth, np.tile(np.eye(2), (50, 1, 1)), atol=0.01)


def test_without_motion_nothing_is_deformed() -> None:
    at = rays()
    right, below = (at + np.diag(1.0 / CAMERA.intrinsics[:2])[k] for k in range(2))
    no_lens = (*MODEL[:2], np.zeros(5))
    warps, valid = predict_warps(np.stack([at, right, below]), np.full(50, 0.5), np.eye(4), *no_lens)
    assert valid.all()
    np.testing.assert_allclose(warps, np.tile(np.eye(2), (50, 1, 1)), atol=1e-9)
