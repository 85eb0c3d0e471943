from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from synthetic import random_transform, transform

from graphvio.arrays import Float
from graphvio.geometry import (
    interpolate,
    quat_wxyz_from_rotation,
    rotation_from_quat_wxyz,
    se3,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_log,
    se3_right_jacobian_inverse,
    skew,
    so3_exp,
    so3_left_jacobian,
    so3_log,
    so3_right_jacobian,
    so3_right_jacobian_inverse,
)

ANGLES = [0.0, 1e-12, 1e-8, 0.99e-5, 1.01e-5, 1e-4, 0.99e-3, 1.01e-3, 0.99e-2, 1.01e-2, 0.3, 1.5, 3.0]
NEAR_PI = [np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9]


def vectors(size: int, largest: float) -> st.SearchStrategy[Float]:
    numbers = st.floats(-largest, largest, allow_subnormal=False)
    return st.lists(numbers, min_size=size, max_size=size).map(np.array)


rotation_vectors = vectors(3, 1.7)  # of norm below pi
tangents = st.tuples(rotation_vectors, vectors(3, 10.0)).map(np.concatenate)
transforms = tangents.map(lambda xi: transform(xi[:3], xi[3:]))


def axes(seed: int = 0) -> Float:
    found = np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(seed).standard_normal((6, 3))])
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def numerical(function: Callable[[Float], Float], size: int, step: float = 1e-6) -> Float:
    """Derivative at zero by central differences."""
    return np.column_stack([(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(size)])


@given(vectors(3, 10.0), vectors(3, 10.0))
def test_skew_is_the_cross_product(v: Float, w: Float) -> None:
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w), atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES + NEAR_PI)
def test_so3_exp_and_log(angle: float) -> None:
    for axis in axes():
        rotation = so3_exp(angle * axis)
        np.testing.assert_allclose(rotation, Rotation.from_rotvec(angle * axis).as_matrix(), atol=1e-14)
        np.testing.assert_allclose(so3_log(rotation), angle * axis, rtol=1e-10, atol=1e-15 + 1e-10 * angle)


def test_so3_log_at_pi_is_one_of_the_two_axes() -> None:
    for axis in axes():
        rotation = Rotation.from_rotvec(np.pi * axis).as_matrix()
        found = so3_log(rotation)
        assert np.linalg.norm(found) == pytest.approx(np.pi, abs=1e-12)
        assert abs(found @ axis) == pytest.approx(np.pi, abs=1e-12)
        np.testing.assert_allclose(so3_exp(found), rotation, atol=1e-14)


@given(tangents)
def test_se3_log_inverts_exp(xi: Float) -> None:
    np.testing.assert_allclose(se3_log(se3_exp(xi)), xi, atol=1e-11)


@pytest.mark.parametrize("angle", ANGLES + NEAR_PI)
def test_se3_exp_inverts_log(angle: float) -> None:
    for axis in axes(1):
        a_T_b = transform(angle * axis, [1.0, -2.0, 3.0])
        np.testing.assert_allclose(se3_exp(se3_log(a_T_b)), a_T_b, atol=1e-8 if angle > 3.1 else 1e-10)


@pytest.mark.parametrize("angle", ANGLES)
def test_se3_exp_is_the_matrix_exponential(angle: float) -> None:
    for axis in axes(2):
        generator = np.zeros((4, 4))
        generator[:3, :3] = skew(angle * axis)
        generator[:3, 3] = [0.5, 2.0, -1.0]
        xi = np.concatenate([angle * axis, generator[:3, 3]])
        np.testing.assert_allclose(se3_exp(xi), expm(generator), atol=1e-11)


@given(transforms, transforms, transforms)
def test_transforms_form_a_group(a: Float, b: Float, c: Float) -> None:
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-12)
    np.testing.assert_allclose(a @ se3_inverse(a), np.eye(4), atol=1e-13)
    np.testing.assert_allclose(se3_inverse(a) @ a, np.eye(4), atol=1e-13)
    np.testing.assert_allclose(se3_inverse(a @ b), se3_inverse(b) @ se3_inverse(a), atol=1e-12)
    np.testing.assert_allclose(se3_log(np.eye(4)), np.zeros(6))


@given(transforms, tangents)
def test_se3_adjoint_moves_a_tangent(a_T_b: Float, xi: Float) -> None:
    left = a_T_b @ se3_exp(xi) @ se3_inverse(a_T_b)
    np.testing.assert_allclose(left, se3_exp(se3_adjoint(a_T_b) @ xi), atol=1e-9)
    np.testing.assert_allclose(se3_adjoint(se3_inverse(a_T_b)) @ se3_adjoint(a_T_b), np.eye(6), atol=1e-11)


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_right_jacobian_and_inverse(angle: float) -> None:
    for axis in axes(3):
        phi = angle * axis
        jacobian = numerical(lambda d, phi=phi: so3_log(so3_exp(-phi) @ so3_exp(phi + d)), 3)  # type: ignore[misc]
        np.testing.assert_allclose(so3_right_jacobian(phi), jacobian, atol=2e-9)
        np.testing.assert_allclose(so3_right_jacobian_inverse(phi) @ so3_right_jacobian(phi), np.eye(3), atol=1e-10)
        np.testing.assert_allclose(so3_left_jacobian(phi), so3_exp(phi) @ jacobian, atol=2e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_se3_right_jacobian_inverse_is_the_derivative_of_log(angle: float) -> None:
    for axis in axes(4):
        xi = np.concatenate([angle * axis, [0.7, -0.4, 1.1]])
        jacobian = numerical(lambda d, xi=xi: se3_log(se3_exp(xi) @ se3_exp(d)), 6)  # type: ignore[misc]
        np.testing.assert_allclose(se3_right_jacobian_inverse(xi), jacobian, atol=1e-7 if angle > 2.0 else 1e-8)


def test_se3_right_jacobian_inverse_is_smooth_at_the_end_of_the_series() -> None:
    for boundary in (1e-5, 1e-3, 1e-2):
        for axis in axes(5):
            below, above = (
                se3_right_jacobian_inverse(np.concatenate([boundary * (1.0 + s) * axis, [0.7, -0.4, 1.1]]))
                for s in (-1e-9, 1e-9)
            )
            np.testing.assert_allclose(below, above, atol=1e-10)


def test_tangent_is_gtsams(rng: np.random.Generator) -> None:
    for _ in range(30):
        xi = np.concatenate([rng.uniform(-1.5, 1.5, 3), rng.uniform(-5.0, 5.0, 3)])
        pose = gtsam.Pose3.Expmap(xi)
        np.testing.assert_allclose(se3_exp(xi), pose.matrix(), atol=1e-12)
        np.testing.assert_allclose(se3_log(pose.matrix()), gtsam.Pose3.Logmap(pose), atol=1e-10)
        np.testing.assert_allclose(se3_adjoint(pose.matrix()), pose.AdjointMap(), atol=1e-12)
        np.testing.assert_allclose(se3_inverse(pose.matrix()), pose.inverse().matrix(), atol=1e-12)
        np.testing.assert_allclose(se3(pose.rotation().matrix(), pose.translation()), pose.matrix())


@given(rotation_vectors)
def test_quaternions_of_rotations_and_back(phi: Float) -> None:
    rotation = Rotation.from_rotvec(phi)
    quat_wxyz = quat_wxyz_from_rotation(rotation.as_matrix())
    np.testing.assert_allclose(quat_wxyz, rotation.as_quat(canonical=True, scalar_first=True), atol=1e-12)
    np.testing.assert_allclose(rotation_from_quat_wxyz(quat_wxyz), rotation.as_matrix(), atol=1e-13)
    np.testing.assert_allclose(rotation_from_quat_wxyz(-3.0 * quat_wxyz), rotation.as_matrix(), atol=1e-13)


def test_quaternions_of_half_turns_have_no_preferred_axis() -> None:
    for axis in axes(6):
        for angle in (np.pi - 1e-10, np.pi):
            rotation = Rotation.from_rotvec(angle * axis).as_matrix()
            quat_wxyz = quat_wxyz_from_rotation(rotation)
            assert quat_wxyz[0] >= 0.0
            assert np.linalg.norm(quat_wxyz) == pytest.approx(1.0, abs=1e-14)
            np.testing.assert_allclose(rotation_from_quat_wxyz(quat_wxyz), rotation, atol=1e-14)


@settings(max_examples=30)
@given(transforms, transforms, st.floats(0.0, 1.0))
def test_interpolate_between_two_poses(a_T_b0: Float, b0_T_b1: Float, fraction: float) -> None:
    a_T_b1 = a_T_b0 @ b0_T_b1
    found = interpolate(a_T_b0, a_T_b1, fraction)
    np.testing.assert_allclose(interpolate(a_T_b0, a_T_b1, 0.0), a_T_b0, atol=1e-12)
    np.testing.assert_allclose(interpolate(a_T_b0, a_T_b1, 1.0), a_T_b1, atol=1e-11)
    np.testing.assert_allclose(found[:3, 3], a_T_b0[:3, 3] + fraction * (a_T_b1 - a_T_b0)[:3, 3], atol=1e-12)
    turned = Rotation.from_matrix(a_T_b0[:3, :3].T @ found[:3, :3]).as_rotvec()
    whole = Rotation.from_matrix(b0_T_b1[:3, :3]).as_rotvec()
    np.testing.assert_allclose(turned, fraction * whole, atol=1e-9)


def test_helper_makes_the_transforms_asked_for(rng: np.random.Generator) -> None:
    xi = se3_log(random_transform(rng, 0.4, 2.0))
    assert np.linalg.norm(xi[:3]) == pytest.approx(0.4)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
