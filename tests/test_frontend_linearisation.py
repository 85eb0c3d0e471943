"""Derivatives and whitening of the refinement, against numerical derivatives and plain numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic import random_transform, seen_points, transform, two_pair_rig

from graphvio.arrays import Float
from graphvio.frontend.motion.blocks import POINTS, SIZE, in_blocks, lane_by_lane, point_by_point
from graphvio.frontend.motion.cost import camera_motions
from graphvio.frontend.motion.linearisation import (
    LinearisationPoints,
    allocate_points,
    information_through_points,
    linearise,
    relinearise_points,
)
from graphvio.frontend.motion.observations import Observations, RigArrays

RIG = two_pair_rig()
ARRAYS = RigArrays.of(RIG)
SIGMAS, SCALE = np.array([0.3, 0.5]), 2.5  # of the pairs
TRUTH = transform([0.02, -0.03, 0.05], [-0.06, 0.02, 0.01])  # cur_T_ref
PAIRS_AND_RIGHTS = pytest.mark.parametrize(
    ("pairs", "share"), [((0,), 1.0), ((0,), 0.0), ((1,), 1.0), ((1,), 0.0), ((0, 1), 0.6)],
    ids=["first", "first, no right", "second", "second, no right", "both, some right"],
)  # fmt: skip


@dataclass
class Places:
    """Linearisation points one by one: points (N, 3), offsets (N, 4) and whiteners (N, 4, 4)."""

    points: Float
    offsets: Float
    whiteners: Float

    @staticmethod
    def of(seen: Observations, points_at: LinearisationPoints) -> Places:
        blocks, whiteners = in_blocks(seen), np.zeros((len(seen.pair), 4, 4))

        def columns(rows: Float) -> Float:
            return np.column_stack([point_by_point(blocks, row) for row in np.hsplit(rows, rows.shape[1] // POINTS)])

        whiteners[:, *np.tril_indices(4)] = columns(points_at.whiteners)
        return Places(columns(points_at.points), columns(points_at.offsets), whiteners)

    def linearisation_points(self, seen: Observations) -> LinearisationPoints:
        """The same as the kernels take it."""
        blocks = in_blocks(seen)

        def rows(columns: Float) -> Float:
            return np.hstack([lane_by_lane(blocks, np.ascontiguousarray(column)) for column in columns.T])

        shifts = self.points - seen.points
        return LinearisationPoints(
            *map(rows, (shifts, self.points, self.offsets, self.whiteners[:, *np.tril_indices(4)]))
        )


def scene(pairs: tuple[int, ...], share: float) -> tuple[Observations, Float]:
    """Points of some pairs, a share of them in the right image too, and a motion (4, 4) that is a little wrong."""
    rng = np.random.default_rng(len(pairs) + 10 * pairs[0])
    seen = seen_points(RIG, TRUTH, 25, rng, sigma_px=0.3, outlier_share=0.1)
    seen = seen.of_rows(np.isin(seen.pair, pairs))
    return seen._replace(has_right=rng.random(len(seen.pair)) < share), TRUTH @ random_transform(rng, 0.001, 0.003)


def errors_px(seen: Observations, i: int, point: Float, cur_T_ref: Float) -> Float:
    """Reprojection errors (4,) of a point ``[x, y, 1/Z]``, or (2,) where the right image does not see it."""
    pair, errors = RIG.pairs[seen.pair[i]], []
    body = cur_T_ref @ pair.left.body_T_cam @ [point[0], point[1], 1.0, point[2]]
    for camera, place in ((pair.left, seen.left[i]), (pair.right, seen.right[i])):
        x, y, z, _ = np.linalg.inv(camera.body_T_cam) @ body
        errors.append(camera.focal_px * (place - np.array([x, y]) / z))
    return np.concatenate(errors if seen.has_right[i] else errors[:1])


def moved(step: Float, cur_T_ref: Float) -> Float:
    """``exp(step) cur_T_ref`` for a step along one axis."""
    return transform(step[:3], step[3:]) @ cur_T_ref


def by_motion(seen: Observations, i: int, point: Float, cur_T_ref: Float) -> Float:
    """Derivative (4 or 2, 6) of a point's predicted pixels with respect to a step of the motion."""
    h = 1e-6 * np.eye(6)
    return np.column_stack(
        [
            (errors_px(seen, i, point, moved(-step, cur_T_ref)) - errors_px(seen, i, point, moved(step, cur_T_ref)))
            / 2e-6
            for step in h
        ]
    )


def by_point(seen: Observations, i: int, point: Float, cur_T_ref: Float) -> Float:
    """Derivative (4 or 2, 3) of a point's predicted pixels with respect to the point."""
    h = 1e-7 * np.eye(3)
    return np.column_stack(
        [
            (errors_px(seen, i, point - step, cur_T_ref) - errors_px(seen, i, point + step, cur_T_ref)) / 2e-7
            for step in h
        ]
    )


def linearised(
    seen: Observations, cur_T_ref: Float, points_at: LinearisationPoints, active: Float | None = None
) -> tuple[float, Float, Float, Float]:
    """What `linearise` says: cost, normal matrix (6, 6), gradient (6,) and squared errors (N,)."""
    blocks = in_blocks(seen)
    hessian, gradient, errors2 = np.empty((6, 6)), np.empty(6), np.empty((len(blocks.pair), POINTS))
    counted = lane_by_lane(blocks, np.ones(len(seen.pair)) if active is None else active)
    motions = camera_motions(np.ascontiguousarray(cur_T_ref), ARRAYS)
    cost = linearise(motions, ARRAYS, blocks, points_at, counted, SCALE, hessian, gradient, errors2)
    return cost, hessian, gradient, point_by_point(blocks, errors2)


def relinearised(seen: Observations, cur_T_ref: Float) -> LinearisationPoints:
    blocks = in_blocks(seen)
    points_at = allocate_points(blocks)
    for _ in range(2):  # the second goes on where the first ended
        relinearise_points(camera_motions(np.ascontiguousarray(cur_T_ref), ARRAYS), ARRAYS, blocks, SIGMAS, points_at)
    return points_at


@given(counts=st.lists(st.integers(0, 70), min_size=1, max_size=4))
def test_in_blocks_holds_every_point_once(counts: list[int]) -> None:
    rng = np.random.default_rng(sum(counts))
    n = sum(counts)
    points, covariances = rng.random((n, 3)), rng.random((n, 3, 3))
    left, right = rng.random((n, 2)), rng.random((n, 2))
    seen = Observations(np.repeat(np.arange(len(counts)), counts), points, covariances, left, right, left[:, 0] < 0.5)
    blocks = in_blocks(seen)
    assert blocks.size.sum() == n
    assert len(blocks.pair) == sum(-(-count // POINTS) for count in counts)
    rows = blocks.values.reshape(len(blocks.pair), SIZE // POINTS, POINTS)
    upper = seen.covariances[:, *np.triu_indices(3)]
    expected = np.column_stack([seen.points, upper, seen.left, seen.right, seen.has_right])
    for k, column in enumerate(expected.T):
        np.testing.assert_array_equal(point_by_point(blocks, np.ascontiguousarray(rows[:, k])), column)
    np.testing.assert_array_equal(
        point_by_point(blocks, lane_by_lane(blocks, seen.points[:, 0].copy())), seen.points[:, 0]
    )
    np.testing.assert_array_equal(np.repeat(blocks.pair, blocks.size), seen.pair)


@PAIRS_AND_RIGHTS
def test_linearise_gradient_is_the_numerical_derivative_of_the_cost(pairs: tuple[int, ...], share: float) -> None:
    """``sum w J^T r``, r being measured minus predicted, is ``-scale^2 / 2`` times the derivative of the cost."""
    seen, cur_T_ref = scene(pairs, share)
    points_at = relinearised(seen, cur_T_ref)
    gradient = linearised(seen, cur_T_ref, points_at)[2]
    numerical = np.empty(6)
    for axis, step in enumerate(1e-6 * np.eye(6)):
        more, less = (linearised(seen, moved(sign * step, cur_T_ref), points_at)[0] for sign in (1.0, -1.0))
        numerical[axis] = (more - less) / 2e-6
    np.testing.assert_allclose(gradient, -0.5 * SCALE**2 * numerical, rtol=1e-5, atol=1e-6 * np.abs(gradient).max())


@PAIRS_AND_RIGHTS
def test_linearise_normal_equations_match_numerical_derivatives(pairs: tuple[int, ...], share: float) -> None:
    seen, cur_T_ref = scene(pairs, share)
    linearisation_points = relinearised(seen, cur_T_ref)
    cost, hessian, gradient, errors2 = linearised(seen, cur_T_ref, linearisation_points)
    points_at = Places.of(seen, linearisation_points)
    expected_hessian, expected_gradient = np.zeros((6, 6)), np.zeros(6)
    expected_cost = 0.0
    for i in range(len(seen.pair)):
        plain = errors_px(seen, i, points_at.points[i], cur_T_ref)
        n = len(plain)
        whitener = points_at.whiteners[i, :n, :n]
        errors = whitener @ (plain - points_at.offsets[i, :n])
        derivative = whitener @ by_motion(seen, i, points_at.points[i], cur_T_ref)
        assert errors2[i] == pytest.approx(errors @ errors, rel=1e-9)
        weight = 1.0 / (1.0 + errors @ errors / SCALE**2)
        expected_cost += float(np.log1p(errors @ errors / SCALE**2))
        expected_hessian += weight * derivative.T @ derivative
        expected_gradient += weight * derivative.T @ errors
    assert cost == pytest.approx(expected_cost, rel=1e-9)
    scale = np.sqrt(np.diag(expected_hessian))
    np.testing.assert_allclose(hessian / np.outer(scale, scale), expected_hessian / np.outer(scale, scale), atol=1e-7)
    np.testing.assert_allclose(gradient / scale, expected_gradient / scale, atol=1e-6)


@PAIRS_AND_RIGHTS
def test_relinearise_points_whitens_at_the_point_of_both_instants(pairs: tuple[int, ...], share: float) -> None:
    """The covariance ``sigma^2 (1 + J C J^T)``, and the correction ``C J^T S^-1 r`` that leads to the same place."""
    seen, cur_T_ref = scene(pairs, share)
    points_at = Places.of(seen, relinearised(seen, cur_T_ref))
    followed = 0
    for i in range(len(seen.pair)):
        derivative = by_point(seen, i, points_at.points[i], cur_T_ref)
        n = len(derivative)
        sigma = SIGMAS[seen.pair[i]]
        covariance = sigma**2 * (np.eye(n) + derivative @ seen.covariances[i] @ derivative.T)
        whitener = np.linalg.inv(np.linalg.cholesky(covariance))
        np.testing.assert_allclose(
            points_at.whiteners[i, :n, :n], whitener, rtol=1e-5, atol=1e-6 * np.abs(whitener).max()
        )
        shift = points_at.points[i] - seen.points[i]
        np.testing.assert_allclose(points_at.offsets[i, :n], -derivative @ shift, rtol=1e-5, atol=1e-6)
        errors = errors_px(seen, i, points_at.points[i], cur_T_ref) + derivative @ shift
        e2 = float(errors @ np.linalg.solve(covariance, errors))
        if e2 < 16.0:  # farther errors move a point only in part
            best = sigma**2 * seen.covariances[i] @ derivative.T @ np.linalg.solve(covariance, errors)
            sigmas = sigma * np.sqrt(np.diag(seen.covariances[i]))
            np.testing.assert_allclose(shift / sigmas, best / sigmas, atol=0.02)
            followed += int(np.linalg.norm(shift / sigmas) > 0.3)
    assert followed > 0.3 * len(seen.pair)


@PAIRS_AND_RIGHTS
def test_information_through_points_matches_its_formula(pairs: tuple[int, ...], share: float) -> None:
    seen, cur_T_ref = scene(pairs, share)
    linearisation_points = relinearised(seen, cur_T_ref)
    points_at, blocks = Places.of(seen, linearisation_points), in_blocks(seen)
    factors = np.random.default_rng(3).uniform(-0.2, 1.0, len(seen.pair)).clip(0.0)
    motions = camera_motions(np.ascontiguousarray(cur_T_ref), ARRAYS)
    found = information_through_points(
        motions, ARRAYS, blocks, linearisation_points, SIGMAS, lane_by_lane(blocks, factors)
    )
    expected = np.zeros((6, 6))
    for i, factor in enumerate(factors):
        derivative = by_motion(seen, i, points_at.points[i], cur_T_ref)
        through = by_point(seen, i, points_at.points[i], cur_T_ref)
        sigma = SIGMAS[seen.pair[i]]
        inverse = np.linalg.inv(sigma**2 * (np.eye(len(through)) + through @ seen.covariances[i] @ through.T))
        expected += factor * derivative.T @ (inverse - sigma**2 * inverse @ inverse) @ derivative
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-5)


def test_linearise_leaves_out_points_behind_a_camera_and_inactive_ones() -> None:
    seen, cur_T_ref = scene((0, 1), 0.6)
    points_at = Places.of(seen, relinearised(seen, cur_T_ref))
    behind, n = 7, len(seen.pair)
    motions = camera_motions(np.ascontiguousarray(cur_T_ref), ARRAYS)
    points_at.points[behind, 2] = -2.0 / motions[0, 0, 2, 3]  # the motion takes its depth from 1 to about -1 of itself
    active = np.arange(n) != 3
    cost, hessian, gradient, errors2 = linearised(
        seen, cur_T_ref, points_at.linearisation_points(seen), active.astype(float)
    )
    assert np.flatnonzero(np.isinf(errors2)).tolist() == [behind]
    counted = active & (np.arange(n) != behind)
    few = seen.of_rows(counted)
    places = Places(points_at.points[counted], points_at.offsets[counted], points_at.whiteners[counted])
    part = linearised(few, cur_T_ref, places.linearisation_points(few))
    assert cost == pytest.approx(part[0] + np.log1p(1e6))
    np.testing.assert_allclose(hessian, part[1], rtol=1e-11)
    np.testing.assert_allclose(gradient, part[2], rtol=1e-9, atol=1e-9)


def test_linearise_with_points_next_to_the_camera_plane_stays_finite() -> None:
    """The derivatives of such points are without bounds; what is made of them must stay a number."""
    seen, cur_T_ref = scene((0, 1), 0.6)
    depth = camera_motions(np.ascontiguousarray(cur_T_ref), ARRAYS)[0, 0, 2]
    points, n = seen.points.copy(), len(seen.pair)
    near = np.flatnonzero(seen.pair == 0)[:10]
    for k, i in enumerate(near):  # depths over the reference depth of both signs, from nothing to a hundredth
        points[i, 2] = (1e-3 * (k - 5) - depth[:3] @ [*points[i, :2], 1.0]) / depth[3]
    seen = seen._replace(points=points, covariances=1e12 * seen.covariances)  # depths of which nothing is known
    points_at = relinearised(seen, cur_T_ref)
    assert all(np.isfinite(rows).all() for rows in points_at)
    active = np.ones(n)
    active[near] = 0.0
    cost, hessian, gradient, _ = linearised(seen, cur_T_ref, points_at, active)
    assert np.isfinite(cost)
    assert np.isfinite(hessian).all()
    assert np.isfinite(gradient).all()
