"""Lens models: projection, its inverse and derivatives, where they are valid, and faults of coefficients."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import pytest
import synthetic  # noqa: F401  (hypothesis' settings)
from hypothesis import assume, given
from hypothesis import strategies as st

from graphvio.arrays import Float
from graphvio.cameras import (
    COEFFICIENTS,
    DOUBLE_SPHERE,
    EQUIDISTANT,
    EXTENDED_UNIFIED,
    MODEL_NAMES,
    N_COEFFICIENTS,
    N_ESTIMATED,
    OMNIDIRECTIONAL,
    RADIAL_TANGENTIAL,
    RATIONAL,
    central_scale,
    distort,
    distortion_basis,
    fold_radius,
    project_points,
    undistort,
    unproject_pixels,
)
from graphvio.rig.lens_checks import lens_fault, view_fault


def filled(*coefficients: float) -> Float:
    return np.pad(np.array(coefficients, dtype=np.float64), (0, N_COEFFICIENTS - len(coefficients)))


INTRINSICS = np.array([410.0, 405.0, 322.0, 237.0])
LENSES = {
    "ideal": (RADIAL_TANGENTIAL, filled()),
    "barrel": (RADIAL_TANGENTIAL, filled(-0.28, 0.074, 2e-4, -1.8e-5)),
    "k3": (RADIAL_TANGENTIAL, filled(-0.3, 0.12, -1e-3, 8e-4, -0.02)),
    "ideal fisheye": (EQUIDISTANT, filled()),
    "fisheye": (EQUIDISTANT, filled(-0.01, 0.05, -0.03, 0.005)),
    "wide fisheye": (EQUIDISTANT, filled(0.003482, 0.000715, -0.00205, 0.000203)),
    "rational": (RATIONAL, filled(-0.2, 0.1, 1e-3, -5e-4, 0.01, 0.15, 0.02, 0.003)),
    "wide rational": (RATIONAL, filled(8.0, 5.0, 1e-4, -5e-5, 0.2, 8.4, 7.5, 1.1)),
    "double sphere": (DOUBLE_SPHERE, filled(-0.2, 0.6)),
    "double sphere, xi > 0": (DOUBLE_SPHERE, filled(0.3, 0.4)),
    "extended unified": (EXTENDED_UNIFIED, filled(0.6, 1.1)),
    "extended unified, beta < 1": (EXTENDED_UNIFIED, filled(0.2, 0.7)),
    "omnidirectional": (OMNIDIRECTIONAL, filled(1.6, -0.2, 0.1, 1e-3, 5e-4)),
}
lens = pytest.mark.parametrize(("model", "distortion"), LENSES.values(), ids=LENSES.keys())
WIDE = [name for name, (model, _) in LENSES.items() if model not in (RADIAL_TANGENTIAL, RATIONAL)] + ["wide rational"]
OF_OPENCV = {name: each for name, each in LENSES.items() if each[0] in (RADIAL_TANGENTIAL, EQUIDISTANT, RATIONAL)}


def points_within(angle_deg: float, n: int = 300) -> Float:
    """Points all over a cone around the optical axis, the axis itself among them."""
    rng = np.random.default_rng(5)
    angle, around = np.deg2rad(rng.uniform(0.0, angle_deg, n)), rng.uniform(0.0, 2.0 * np.pi, n)
    angle[:3] = [0.0, 1e-10, 1e-7]
    rays = np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
    return np.ascontiguousarray(rays * rng.uniform(0.5, 30.0, (n, 1)))


def widest(model: int, distortion: Float) -> float:
    return 79.9 if any((LENSES[name][1] == distortion).all() and LENSES[name][0] == model for name in WIDE) else 45.0


@lens
def test_unproject_inverts_project(model: int, distortion: Float) -> None:
    points = points_within(widest(model, distortion))
    pixels, valid = project_points(model, INTRINSICS, distortion, points)
    assert valid.all()
    rays, found = unproject_pixels(model, INTRINSICS, distortion, pixels)
    assert found.all()
    np.testing.assert_allclose(rays, points[:, :2] / points[:, 2:], rtol=1e-9, atol=1e-10)


coefficients = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3))


@given(coefficients, st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_undistort_inverts_moderate_distortion(k: tuple[float, float, float, float], x: float, y: float) -> None:
    for model in (RADIAL_TANGENTIAL, EQUIDISTANT):
        distortion = filled(*k)
        xd, yd, *_ = distort(model, distortion, x, y)
        back_x, back_y, found = undistort(model, distortion, xd, yd)
        assert found
        assert np.hypot(back_x - x, back_y - y) < 1e-9


@pytest.mark.parametrize(("model", "distortion"), OF_OPENCV.values(), ids=OF_OPENCV.keys())
def test_project_points_is_opencvs(model: int, distortion: Float) -> None:
    points = points_within(widest(model, distortion))
    matrix = np.array([[INTRINSICS[0], 0.0, INTRINSICS[2]], [0.0, INTRINSICS[1], INTRINSICS[3]], [0.0, 0.0, 1.0]])
    still = np.zeros(3)
    if model == EQUIDISTANT:
        expected, _ = cv2.fisheye.projectPoints(points[:, None], still, still, matrix, distortion[:4])
    else:
        expected, _ = cv2.projectPoints(points, still, still, matrix, distortion)
    pixels, _ = project_points(model, INTRINSICS, distortion, points)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-7)


@lens
def test_distort_at_the_centre_is_a_scale(model: int, distortion: Float) -> None:
    scale = central_scale(model, distortion)
    assert model in (DOUBLE_SPHERE, OMNIDIRECTIONAL) or scale == 1.0
    np.testing.assert_allclose(distort(model, distortion, 0.0, 0.0), [0, 0, scale, 0, 0, scale])
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
    distortion = filled(-0.3, 0.0, 0.0, 0.0, 0.0)  # r (1 - 0.3 r^2) turns back at r = 1.054, where it is 0.703
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
    distortion = filled(-0.3, 0.0, 0.0, 0.0, 0.0)  # the same polynomial, of the angle
    fold = np.tan(1.0 / np.sqrt(0.9))
    points = np.array([[0.98 * fold, 0.0, 1.0], [1.02 * fold, 0.0, 1.0]])
    assert project_points(EQUIDISTANT, INTRINSICS, distortion, points)[1].tolist() == [True, False]
    assert not undistort(EQUIDISTANT, distortion, 0.71, 0.0)[2]
    x, _, found = undistort(EQUIDISTANT, distortion, 0.70, 0.0)
    assert found
    assert x < fold


def test_beyond_two_folds_nothing_is_valid() -> None:
    # r (1 - 0.5 r^2 + 0.1 r^4) rises up to r = 1 and again from r = sqrt(2): 1.5 would hide behind 0.8.
    distortion = filled(-0.5, 0.1, 0.0, 0.0, 0.0)
    points = np.array([[0.8, 0.0, 1.0], [1.2, 0.0, 1.0], [1.5, 0.0, 1.0]])
    _, valid = project_points(RADIAL_TANGENTIAL, INTRINSICS, distortion, points)
    assert valid.tolist() == [True, False, False]


def test_beyond_a_tangential_fold_nothing_is_valid() -> None:
    points = np.array([[0.1, 0.1, 1.0], [-1.6, 0.0, 1.0]])  # x + 3 p2 x^2 turns back at -1 / (6 p2)
    _, valid = project_points(RADIAL_TANGENTIAL, INTRINSICS, filled(0.0, 0.0, 0.0, 0.11, 0.0), points)
    assert valid.tolist() == [True, False]


# ---------------------------------------------------------------- models with a sphere, and the rational one


def double_sphere(points: Float, xi: float, alpha: float) -> Float:
    """Usenko et al. 2018, (40) to (42)."""
    x, y, z = points.T
    d1 = np.sqrt(x * x + y * y + z * z)
    d2 = np.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
    projected: Float = points[:, :2] / (alpha * d2 + (1.0 - alpha) * (xi * d1 + z))[:, None]
    return projected


def extended_unified(points: Float, alpha: float, beta: float) -> Float:
    """Khomutenko et al. 2016, as in Usenko et al., (18) and (19)."""
    x, y, z = points.T
    projected: Float = points[:, :2] / (alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1.0 - alpha) * z)[:, None]
    return projected


def omnidirectional(points: Float, xi: float, k1: float, k2: float, p1: float, p2: float) -> Float:
    """Mei and Rives 2007, as Kalibr writes it: unit sphere, plane at `xi` from its centre, distortion."""
    on_sphere = points / np.linalg.norm(points, axis=1)[:, None]
    x, y = on_sphere[:, 0] / (on_sphere[:, 2] + xi), on_sphere[:, 1] / (on_sphere[:, 2] + xi)
    r2 = x * x + y * y
    radial = k1 * r2 + k2 * r2 * r2
    return np.column_stack(
        [
            x + x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y + y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
        ]
    )


FORMULAS: dict[int, Callable[..., Float]] = {
    DOUBLE_SPHERE: double_sphere,
    EXTENDED_UNIFIED: extended_unified,
    OMNIDIRECTIONAL: omnidirectional,
}
WITH_SPHERE = {name: each for name, each in LENSES.items() if each[0] in FORMULAS}


def distorted(model: int, distortion: Float, points: Float) -> Float:
    pixels, valid = project_points(model, np.array([1.0, 1.0, 0.0, 0.0]), distortion, points)
    assert valid.all()
    return pixels


@pytest.mark.parametrize(("model", "distortion"), WITH_SPHERE.values(), ids=WITH_SPHERE.keys())
def test_project_points_is_the_papers(model: int, distortion: Float) -> None:
    points = points_within(79.9)
    (name,) = (name for name, number in MODEL_NAMES.items() if number == model)
    expected = FORMULAS[model](points, *distortion[: len(COEFFICIENTS[name])])
    np.testing.assert_allclose(distorted(model, distortion, points), expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.5, 0.7, 1.0])
def test_models_that_are_the_unified_one_agree(alpha: float) -> None:
    points = points_within(79.9)
    unified = distorted(EXTENDED_UNIFIED, filled(alpha, 1.0), points)
    np.testing.assert_allclose(distorted(DOUBLE_SPHERE, filled(0.0, alpha), points), unified, rtol=1e-13)
    if alpha < 1.0:
        xi = alpha / (1.0 - alpha)  # and focal lengths that are larger by 1 + xi
        moved = (1.0 + xi) * distorted(OMNIDIRECTIONAL, filled(xi), points)
        np.testing.assert_allclose(moved, unified, rtol=1e-13)


def test_models_that_are_radial_tangential_agree() -> None:
    points, k = points_within(45.0), (-0.28, 0.074, 2e-4, -1.8e-5)
    expected = distorted(RADIAL_TANGENTIAL, filled(*k, -0.01), points)
    np.testing.assert_array_equal(distorted(RATIONAL, filled(*k, -0.01), points), expected)
    expected = distorted(RADIAL_TANGENTIAL, filled(*k), points)
    np.testing.assert_allclose(distorted(OMNIDIRECTIONAL, filled(0.0, *k), points), expected, rtol=1e-13)
    for model in (DOUBLE_SPHERE, EXTENDED_UNIFIED, OMNIDIRECTIONAL):
        np.testing.assert_allclose(distorted(model, filled(), points), points[:, :2] / points[:, 2:], rtol=1e-13)


small = st.floats(-0.05, 0.05)
tangential = st.floats(-1e-3, 1e-3)
WRITTEN = {
    RATIONAL: st.tuples(small, small, tangential, tangential, small, small, small, small),
    DOUBLE_SPHERE: st.tuples(st.floats(-0.95, 1.0), st.floats(0.0, 1.0)),
    EXTENDED_UNIFIED: st.tuples(st.floats(0.0, 1.0), st.floats(0.1, 4.0)),
    OMNIDIRECTIONAL: st.tuples(st.floats(0.7, 3.0), small, small, tangential, tangential),
}


@pytest.mark.parametrize("model", WRITTEN)
@given(data=st.data(), share=st.floats(0.0, 0.98), around=st.floats(-np.pi, np.pi))
def test_undistort_inverts_over_the_whole_domain(model: int, data: st.DataObject, share: float, around: float) -> None:
    distortion = filled(*data.draw(WRITTEN[model]))
    radius = share * (fold_radius(model, distortion) - 0.01)
    assume(radius >= 0.0)
    x, y = radius * np.cos(around), radius * np.sin(around)
    xd, yd, a, b, c, d = distort(model, distortion, x, y)
    assume(a > 0.0 and a * d - b * c > 1e-4)
    back_x, back_y, found = undistort(model, distortion, xd, yd)
    assert found
    assert np.hypot(back_x - x, back_y - y) < 1e-9 * max(1.0, radius)


@lens
def test_distort_derivatives_equal_finite_differences(model: int, distortion: Float) -> None:
    points, h = points_within(widest(model, distortion), 60), 1e-6
    for x, y in points[:, :2] / points[:, 2:]:
        by_x = np.subtract(distort(model, distortion, x + h, y), distort(model, distortion, x - h, y))[:2] / (2.0 * h)
        by_y = np.subtract(distort(model, distortion, x, y + h), distort(model, distortion, x, y - h))[:2] / (2.0 * h)
        jacobian = np.reshape(distort(model, distortion, x, y)[2:], (2, 2))
        np.testing.assert_allclose(jacobian, np.column_stack([by_x, by_y]), atol=2e-8 * (1.0 + x * x + y * y))


@lens
def test_distortion_basis_equals_finite_differences_by_the_coefficients(model: int, distortion: Float) -> None:
    (name,) = (name for name, number in MODEL_NAMES.items() if number == model)
    points, h = points_within(widest(model, distortion), 60), 1e-5
    for x, y in points[:, :2] / points[:, 2:]:
        basis = distortion_basis(model, distortion, x, y)
        assert basis.shape == (N_ESTIMATED, 2)
        for i in range(N_ESTIMATED):
            step = np.zeros(N_COEFFICIENTS)
            step[i] = h
            difference = np.zeros(2)
            if i < len(COEFFICIENTS[name]):
                after, before = (distort(model, distortion + sign * step, x, y)[:2] for sign in (1.0, -1.0))
                difference = np.subtract(after, before) / (2.0 * h)
            np.testing.assert_allclose(basis[i], difference, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("xi", "alpha"), [(-0.8, 0.1), (-0.6, 0.9), (-0.4, 0.0)])
def test_beyond_a_double_spheres_domain_nothing_is_valid(xi: float, alpha: float) -> None:
    # z > -w1 d at the second sphere, Usenko et al. (44), for points at an angle from the centre of the first one.
    w1 = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
    cosine = -xi * (1.0 - w1 * w1) - w1 * np.sqrt(1.0 - xi * xi * (1.0 - w1 * w1))
    radius = np.tan(np.arccos(cosine))
    assert fold_radius(DOUBLE_SPHERE, filled(xi, alpha)) == pytest.approx(radius, abs=0.011)
    points = np.array([[0.97 * radius, 0.0, 1.0], [1.01 * radius, 0.0, 1.0], [0.0, -2.0 * radius, 1.0]])
    _, valid = project_points(DOUBLE_SPHERE, INTRINSICS, filled(xi, alpha), points)
    assert valid.tolist() == [True, False, False]
    assert distort(DOUBLE_SPHERE, filled(xi, alpha), 1.01 * radius, 0.0)[2] == -1.0


def test_beyond_the_disc_of_a_sphere_there_is_no_ray() -> None:
    # Usenko et al. (51) and (31): r^2 <= 1 / (2 alpha - 1), and for the extended model that over beta.
    for model, distortion, beta in ((DOUBLE_SPHERE, filled(0.2, 0.8), 1.0), (EXTENDED_UNIFIED, filled(0.8, 2.0), 2.0)):
        disc = 1.0 / np.sqrt(0.6 * beta)
        assert not undistort(model, distortion, 1.001 * disc, 0.0)[2]
        edge = distort(model, distortion, np.tan(np.deg2rad(79.9)), 0.0)[0]
        assert edge < disc
        assert undistort(model, distortion, edge, 0.0)[2]
        assert not undistort(model, distortion, 0.5 * (edge + disc), 0.0)[2]  # a ray beyond 80 degrees


def test_beyond_a_pole_of_the_rational_model_nothing_is_valid() -> None:
    distortion = filled(0.0, 0.0, 0.0, 0.0, 0.0, -0.25)  # r / (1 - r^2 / 4)
    assert fold_radius(RATIONAL, distortion) == pytest.approx(2.0, abs=0.011)
    points = np.array([[1.9, 0.0, 1.0], [2.1, 0.0, 1.0]])
    assert project_points(RATIONAL, INTRINSICS, distortion, points)[1].tolist() == [True, False]
    x, _, found = undistort(RATIONAL, distortion, 1.9 / (1.0 - 0.9025), 0.0)  # which is itself beyond the pole
    assert found
    assert x == pytest.approx(1.9, abs=1e-9)


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("double-sphere", [0.6, -0.2], r"alpha is -0.2, and must be between 0 and 1; .*xi, alpha in this order"),
        ("double-sphere", [1.5, 0.6], r"xi is 1.5, and must be at most 1"),
        ("double-sphere", [-1.0, 0.6], r"xi is -1, and must be more than -1"),
        ("double-sphere", [-0.2, 0.6, 0.0, 0.1], r"has 4 distortion coefficients, and double-sphere has 2"),
        ("extended-unified", [1.1, 0.6], r"alpha is 1.1, and must be between 0 and 1; .*alpha, beta in this order"),
        ("extended-unified", [0.6, 0.0], r"beta is 0, and must be positive"),
        ("omnidirectional", [-1.2, 0.0], r"xi is -1.2, and must be more than -1"),
        ("omnidirectional", [1.2, 0.1, 0.0, 0.0, 0.0, 0.3], r"has 6 distortion coefficients"),
        ("equidistant", [0.1, 0.0, 0.0, 0.0, 0.2], r"has 5 distortion coefficients, and equidistant has 4"),
        ("radial-tangential", [0.1] * 8, r"has 8 distortion coefficients, and radial-tangential has 5"),
    ],
)
def test_lens_fault_says_what_is_wrong_and_what_to_do(model: str, coefficients: Sequence[float], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(lens_fault(model, filled(*coefficients)))


@lens
def test_lenses_have_no_fault(model: int, distortion: Float) -> None:
    (name,) = (name for name, number in MODEL_NAMES.items() if number == model)
    assert lens_fault(name, distortion) == ""
    intrinsics = INTRINSICS.copy()
    intrinsics[:2] /= central_scale(model, distortion)
    assert view_fault(name, intrinsics, distortion, (640, 480)) == ""


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("double-sphere", [-0.2, 0.9]),
        ("extended-unified", [0.9, 1.1]),
        ("omnidirectional", [3.0]),
        ("rational", [-0.5, 0.0, 0.0, 0.0, 0.0, 0.1]),
    ],
)
def test_view_fault_of_a_lens_that_does_not_reach_the_corner(model: str, coefficients: Sequence[float]) -> None:
    fault = view_fault(model, np.array([150.0, 150.0, 320.0, 240.0]), filled(*coefficients), (640, 480))
    assert fault.startswith(f"no ray reaches the image's corner (0, 0) by its {model} lens; check intrinsics")
    assert "mask" in fault
