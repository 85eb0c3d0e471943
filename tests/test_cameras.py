import cv2
import numpy as np
import pytest
import synthetic  # noqa: F401  (hypothesis' settings)
from hypothesis import given
from hypothesis import strategies as st

from graphvio.arrays import Float
from graphvio.cameras import EQUIDISTANT, RADIAL_TANGENTIAL, distort, project_points, undistort, unproject_pixels

INTRINSICS = np.array([410.0, 405.0, 322.0, 237.0])
LENSES = {
    "ideal": (RADIAL_TANGENTIAL, np.zeros(5)),
    "barrel": (RADIAL_TANGENTIAL, np.array([-0.28, 0.074, 2e-4, -1.8e-5, 0.0])),
    "k3": (RADIAL_TANGENTIAL, np.array([-0.3, 0.12, -1e-3, 8e-4, -0.02])),
    "ideal fisheye": (EQUIDISTANT, np.zeros(5)),
    "fisheye": (EQUIDISTANT, np.array([-0.01, 0.05, -0.03, 0.005, 0.0])),
    "wide fisheye": (EQUIDISTANT, np.array([0.003482, 0.000715, -0.00205, 0.000203, 0.0])),
}
lens = pytest.mark.parametrize(("model", "distortion"), LENSES.values(), ids=LENSES.keys())


def points_within(angle_deg: float, n: int = 300) -> Float:
    """Points all over a cone around the optical axis, the axis itself among them."""
    rng = np.random.default_rng(5)
    angle, around = np.deg2rad(rng.uniform(0.0, angle_deg, n)), rng.uniform(0.0, 2.0 * np.pi, n)
    angle[:3] = [0.0, 1e-10, 1e-7]
    rays = np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
    return np.ascontiguousarray(rays * rng.uniform(0.5, 30.0, (n, 1)))


def widest(model: int) -> float:
    return 79.9 if model == EQUIDISTANT else 45.0


@lens
def test_unproject_inverts_project(model: int, distortion: Float) -> None:
    points = points_within(widest(model))
    pixels, valid = project_points(model, INTRINSICS, distortion, points)
    assert valid.all()
    rays, found = unproject_pixels(model, INTRINSICS, distortion, pixels)
    assert found.all()
    np.testing.assert_allclose(rays, points[:, :2] / points[:, 2:], rtol=1e-9, atol=1e-10)


coefficients = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3))


@given(coefficients, st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_undistort_inverts_moderate_distortion(k: tuple[float, float, float, float], x: float, y: float) -> None:
    for model in (RADIAL_TANGENTIAL, EQUIDISTANT):
        distortion = np.array([*k, 0.0])
        xd, yd, *_ = distort(model, distortion, x, y)
        back_x, back_y, found = undistort(model, distortion, xd, yd)
        assert found
        assert np.hypot(back_x - x, back_y - y) < 1e-9


@lens
def test_project_points_is_opencvs(model: int, distortion: Float) -> None:
    points = points_within(widest(model))
    matrix = np.array([[INTRINSICS[0], 0.0, INTRINSICS[2]], [0.0, INTRINSICS[1], INTRINSICS[3]], [0.0, 0.0, 1.0]])
    still = np.zeros(3)
    if model == EQUIDISTANT:
        expected, _ = cv2.fisheye.projectPoints(points[:, None], still, still, matrix, distortion[:4])
    else:
        expected, _ = cv2.projectPoints(points, still, still, matrix, distortion)
    pixels, _ = project_points(model, INTRINSICS, distortion, points)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-7)


@lens
def test_distort_at_the_centre_is_the_identity(model: int, distortion: Float) -> None:
    np.testing.assert_allclose(distort(model, distortion, 0.0, 0.0), [0, 0, 1, 0, 0, 1])
    assert undistort(model, distortion, 0.0, 0.0) == (0.0, 0.0, True)


@lens
def test_project_points_outside_the_view_is_invalid(model: int, distortion: Float) -> None:
    nan, limit = float("nan"), np.tan(np.deg2rad(80.0))
    points = np.array(
        [[0, 0, -1], [0, 0, 0], [0, 0, nan], [nan, 0, 1], [0, nan, 1], [1.001 * limit, 0, 1], [0, -1e9, 1], [0, 0, 1]],
        dtype=np.float64,
    )
    pixels, valid = project_points(model, INTRINSICS, distortion, points)
    assert valid.tolist() == [False] * 7 + [True]
    assert np.isfinite(pixels[valid]).all()


@lens
def test_unproject_pixels_that_no_ray_reaches_is_invalid(model: int, distortion: Float) -> None:
    rays, found = unproject_pixels(model, INTRINSICS, distortion, np.array([[1e5, 0.0], [np.nan, 0.0], [322.0, 237.0]]))
    assert found.tolist() == [False, False, True]
    assert np.isfinite(rays[found]).all()


def test_beyond_a_fold_nothing_is_valid() -> None:
    distortion = np.array([-0.3, 0.0, 0.0, 0.0, 0.0])  # r (1 - 0.3 r^2) turns back at r = 1.054, where it is 0.703
    fold = 1.0 / np.sqrt(0.9)
    inside, outside = np.array([[0.99 * fold, 0.0, 1.0]]), np.array([[1.01 * fold, 0.0, 1.0]])
    assert project_points(RADIAL_TANGENTIAL, INTRINSICS, distortion, inside)[1].all()
    assert not project_points(RADIAL_TANGENTIAL, INTRINSICS, distortion, outside)[1].any()
    _, _, found = undistort(RADIAL_TANGENTIAL, distortion, 0.71, 0.0)
    assert not found
    x, _, found = undistort(RADIAL_TANGENTIAL, distortion, 0.70, 0.0)
    assert found
    assert x < fold


def test_beyond_a_fisheyes_fold_nothing_is_valid() -> None:
    distortion = np.array([-0.3, 0.0, 0.0, 0.0, 0.0])  # the same polynomial, of the angle
    fold = np.tan(1.0 / np.sqrt(0.9))
    points = np.array([[0.98 * fold, 0.0, 1.0], [1.02 * fold, 0.0, 1.0]])
    assert project_points(EQUIDISTANT, INTRINSICS, distortion, points)[1].tolist() == [True, False]
    assert not undistort(EQUIDISTANT, distortion, 0.71, 0.0)[2]
    x, _, found = undistort(EQUIDISTANT, distortion, 0.70, 0.0)
    assert found
    assert x < fold


def test_beyond_two_folds_nothing_is_valid() -> None:
    # r (1 - 0.5 r^2 + 0.1 r^4) rises up to r = 1 and again from r = sqrt(2): 1.5 would hide behind 0.8.
    distortion = np.array([-0.5, 0.1, 0.0, 0.0, 0.0])
    points = np.array([[0.8, 0.0, 1.0], [1.2, 0.0, 1.0], [1.5, 0.0, 1.0]])
    _, valid = project_points(RADIAL_TANGENTIAL, INTRINSICS, distortion, points)
    assert valid.tolist() == [True, False, False]


def test_beyond_a_tangential_fold_nothing_is_valid() -> None:
    points = np.array([[0.1, 0.1, 1.0], [-1.6, 0.0, 1.0]])  # x + 3 p2 x^2 turns back at -1 / (6 p2)
    _, valid = project_points(RADIAL_TANGENTIAL, INTRINSICS, np.array([0.0, 0.0, 0.0, 0.11, 0.0]), points)
    assert valid.tolist() == [True, False]
