import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import random_transform

from graphvio.arrays import Float
from graphvio.frontend.motion.resection import real_quartic_roots, resect

seeds = st.integers(0, 2**32 - 1)


def three_points(seed: int) -> tuple[Float, Float, Float]:
    """Points (3, 3) in frame a, unit rays (3, 3) in frame cam, and ``cam_T_a``."""
    rng = np.random.default_rng(seed)
    cam_T_a = random_transform(rng, rng.uniform(0.0, 3.0), rng.uniform(0.0, 3.0))
    seen = np.column_stack([rng.uniform(-0.7, 0.7, (3, 2)), np.ones(3)]) * rng.uniform(1.0, 20.0, (3, 1))
    points = (seen - cam_T_a[:3, 3]) @ cam_T_a[:3, :3]
    return np.ascontiguousarray(points), seen / np.linalg.norm(seen, axis=1, keepdims=True), cam_T_a


def distance(a: Float, b: Float) -> float:
    return float(np.abs(a - b).max())


@settings(max_examples=300)
@given(seeds)
def test_resect_solutions_are_valid_and_differ(seed: int) -> None:
    points, rays, _ = three_points(seed)
    poses, count = resect(points, rays)
    assert 1 <= count <= 4
    for cam_T_a in poses[:count]:
        rotation = cam_T_a[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert cam_T_a[3].tolist() == [0.0, 0.0, 0.0, 1.0]
        moved = points @ rotation.T + cam_T_a[:3, 3]
        assert np.sum(moved * rays, axis=1).min() > 0.0  # in front


def test_resect_solutions_contain_the_truth() -> None:
    missed = 0
    for seed in range(1000):
        points, rays, truth = three_points(seed)
        poses, count = resect(points, rays)
        missed += min((distance(pose, truth) for pose in poses[:count]), default=np.inf) > 1e-4
    assert missed <= 5  # a double root is only known to half the digits


def test_resect_solutions_are_opencvs() -> None:
    agree = 0
    for seed in range(300):
        points, rays, _ = three_points(seed)
        image = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
        _, rotations, translations = cv2.solveP3P(points, image, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_P3P)
        expected = []
        for r, t in zip(rotations, translations, strict=True):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(r)[0], t.ravel()
            if (points @ pose[:3, :3].T + pose[:3, 3])[:, 2].min() > 0.0:
                expected.append(pose)
        poses, count = resect(points, rays)
        agree += count == len(expected) and all(
            min(distance(pose, other) for pose in poses[:count]) < 1e-4 for other in expected
        )
    assert agree >= 290


def test_resect_of_an_equilateral_triangle_seen_straight_on() -> None:
    angle = 2.0 * np.pi / 3.0 * np.arange(3)
    points = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(3)])
    seen = points + np.array([0.0, 0.0, 4.0])
    poses, count = resect(points, seen / np.linalg.norm(seen, axis=1, keepdims=True))
    truth = np.eye(4)
    truth[2, 3] = 4.0
    assert min((distance(pose, truth) for pose in poses[:count]), default=np.inf) < 1e-4


def test_resect_of_degenerate_triangles_has_no_solution() -> None:
    rays = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    line = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [2.0, 0.0, 5.0]])
    point = np.ones((3, 3))
    for points in (line, point):
        poses, count = resect(points, rays)
        assert count == 0
        assert np.isfinite(poses).all()


def roots_of(coefficients: Float) -> Float:
    roots, count = real_quartic_roots(coefficients)
    return np.sort(roots[:count])


@settings(max_examples=300)
@given(seeds)
def test_real_quartic_roots_are_numpys(seed: int) -> None:
    coefficients = np.random.default_rng(seed).uniform(-3.0, 3.0, 5)
    expected = np.roots(coefficients)
    real = np.abs(expected.imag) < 1e-9 * (1.0 + np.abs(expected))
    if abs(coefficients[0]) < 1e-3 or np.any(~real & (np.abs(expected.imag) < 1e-4)):
        return  # nearly a cubic, or nearly a double root
    np.testing.assert_allclose(roots_of(coefficients), np.sort(expected[real].real), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    "roots",
    [
        [-2.0, -1.0, 1.0, 3.0],
        [-2.0, -1.0, 1.0, 2.0],  # biquadratic
        [0.0, 0.0, 1.0, 2.0],
        [1.0, 1.0, 1.0, 5.0],
        [0.999, 1.0, 1.001, 1.002],
        [-1e3, -1.0, 1e-3, 10.0],
    ],
)
def test_real_quartic_roots_are_the_known_ones(roots: list[float]) -> None:
    found = roots_of(np.asarray(-2.5 * np.poly(roots), dtype=np.float64))
    for root in roots:
        assert np.abs(found - root).min() < 1e-3 * max(1.0, abs(root))
    for x in found:
        assert np.abs(np.array(roots) - x).min() < 1e-3 * max(1.0, abs(x))


def test_real_quartic_roots_of_none() -> None:
    assert len(roots_of(np.array([1.0, 0.0, 2.0, 0.0, 1.5]))) == 0
    assert len(roots_of(np.array([1.0, 0.2, 5.0, -0.3, 9.0]))) == 0
    assert len(roots_of(np.array([0.0, 1.0, 0.0, 0.0, -1.0]))) == 0  # a cubic is not solved
