"""Views of landmarks by single cameras, and what was known before the first pose, as factors of a session's graph."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from synthetic_session import make_session

from graphvio.arrays import Float
from graphvio.backend.factors import b, v, x
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.measurements.window_views import FirstWindow, WindowViews
from graphvio.optimization.first_windows import FirstWindows, first_window_factor
from graphvio.optimization.record import SessionRecord
from graphvio.optimization.views import Views, root_of, views_factor
from graphvio.rig import Imu

STATES = 4
STEP = 1e-6


def chain(rng: np.random.Generator) -> Float:
    poses = [se3_exp(rng.normal(0.0, 0.4, 6))]
    for _ in range(STATES - 1):
        poses.append(poses[-1] @ se3_exp(rng.normal(0.0, 0.2, 6)))
    return np.array(poses)


def relative_cost(rng: np.random.Generator, poses: Float, others: int = 0) -> tuple[Float, Float]:
    """Information and gradient of a cost that does not change if all poses move together."""
    size = 6 * STATES + others
    jacobian, target = rng.normal(size=(40, size)), rng.normal(size=40)
    adjoints = [np.asarray(gtsam.Pose3(se3_inverse(pose) @ poses[0]).AdjointMap()) for pose in poses]
    together = np.concatenate([*adjoints, np.zeros((others, 6))])
    away = np.eye(size) - together @ np.linalg.pinv(together)
    jacobian = jacobian @ away
    return jacobian.T @ jacobian, jacobian.T @ target


def numerical(factor: gtsam.CustomFactor, values: gtsam.Values, key: int, size: int) -> Float:
    columns = []
    for k in range(size):
        ends = []
        for sign in (1.0, -1.0):
            step = gtsam.VectorValues()
            step.insert(key, sign * STEP * np.eye(size)[k])
            ends.append(factor.unwhitenedError(values.retract(_complete(step, values))))
        columns.append((ends[0] - ends[1]) / (2.0 * STEP))
    return np.array(columns).T


def _complete(step: gtsam.VectorValues, values: gtsam.Values) -> gtsam.VectorValues:
    made = values.zeroVectors()
    made.update(step)
    return made


def assert_derivatives(factor: gtsam.CustomFactor, values: gtsam.Values) -> None:
    jacobian, at = factor.linearize(values).jacobian()[0], 0
    for key in factor.keys():  # noqa: SIM118
        size = values.zeroVectors().at(key).size
        np.testing.assert_allclose(jacobian[:, at : at + size], numerical(factor, values, key, size), atol=2e-5)
        at += size


def test_views_factor_derivatives_are_numerical_ones_and_its_cost_is_relative() -> None:
    rng = np.random.default_rng(1)
    poses = chain(rng)
    information, gradient = relative_cost(rng, poses)
    factor = views_factor([x(k) for k in range(STATES)], poses, information, gradient)
    values, moved, turned = gtsam.Values(), gtsam.Values(), gtsam.Pose3(se3_exp(rng.normal(0.0, 1.0, 6)))
    steps = rng.normal(0.0, 0.02, (STATES, 6))
    for k, pose in enumerate(poses):
        values.insert(x(k), gtsam.Pose3(pose @ se3_exp(steps[k])))
        moved.insert(x(k), turned.compose(values.atPose3(x(k))))
    assert_derivatives(factor, values)
    assert factor.error(moved) == pytest.approx(factor.error(values), rel=1e-9)
    at_poses = gtsam.Values()
    small = 1e-4 * steps
    for k, pose in enumerate(poses):
        at_poses.insert(x(k), gtsam.Pose3(pose))
        values.update(x(k), gtsam.Pose3(pose @ se3_exp(small[k])))
    step = small.ravel()
    expected = gradient @ step + 0.5 * step @ information @ step
    assert factor.error(values) - factor.error(at_poses) == pytest.approx(expected, rel=1e-3)


def test_first_window_factor_derivatives_are_numerical_ones_and_its_cost_is_relative() -> None:
    """In nav it may turn about the vertical only, since gravity is a part of it."""
    rng = np.random.default_rng(2)
    poses = chain(rng)
    information, gradient = relative_cost(rng, poses, 12)
    information[:6, :6] += 1e6 * np.eye(6)  # of the frame, which is nothing that is known
    velocity, gravity, biases = rng.normal(0.0, 1.0, 3), np.array([0.1, -0.2, -9.8]), rng.normal(0.0, 0.05, 6)
    start = FirstWindow(np.arange(STATES), poses, velocity, gravity, biases, information, gradient)
    factor = first_window_factor(np.arange(STATES), *FirstWindows.of([start], {k: k for k in range(STATES)}).at(0)[1:])
    values, moved = gtsam.Values(), gtsam.Values()
    turned = gtsam.Pose3(gtsam.Rot3.Rz(0.7), np.array([1.0, -2.0, 0.5]))
    for k, pose in enumerate(poses):
        values.insert(x(k), gtsam.Pose3(pose @ se3_exp(rng.normal(0.0, 0.02, 6))))
        moved.insert(x(k), turned.compose(values.atPose3(x(k))))
    values.insert(v(0), velocity + 0.1)
    moved.insert(v(0), turned.rotation().matrix() @ (velocity + 0.1))
    for each in (values, moved):
        each.insert(b(0), gtsam.imuBias.ConstantBias(np.array([0.1, 0.2, 0.3]), np.array([0.01, -0.02, 0.03])))
    assert_derivatives(factor, values)
    assert factor.error(moved) == pytest.approx(factor.error(values), rel=1e-9)


def test_root_of_information_of_a_few_directions() -> None:
    rng = np.random.default_rng(3)
    jacobian = rng.normal(size=(3, 8)) * [1e4, 1.0, 1.0, 1e-2, 1.0, 1.0, 1.0, 1.0]
    information, gradient = jacobian.T @ jacobian, jacobian.T @ rng.normal(size=3)
    root, offset = root_of(information, gradient)
    assert len(root) == 3
    np.testing.assert_allclose(root.T @ root, information, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(root.T @ offset, gradient, rtol=1e-6, atol=1e-6)


def test_views_without_a_state_have_the_minimum_over_its_pose() -> None:
    rng = np.random.default_rng(4)
    poses = chain(rng)
    information, gradient = relative_cost(rng, poses)
    whole = WindowViews(np.arange(STATES), poses, information, gradient)
    kept = whole.of(np.array([False, True, True, True]))
    for _ in range(5):
        step = rng.normal(0.0, 0.1, 18)
        best = -np.linalg.solve(information[:6, :6], gradient[:6] + information[:6, 6:] @ step)
        costs = [
            each.gradient @ d + 0.5 * d @ each.information @ d
            for each, d in ((whole, np.concatenate([best, step])), (kept, step))
        ]
        at_zero = -0.5 * gradient[:6] @ np.linalg.solve(information[:6, :6], gradient[:6])
        assert costs[0] - at_zero == pytest.approx(costs[1], rel=1e-6)


def test_record_with_views_reads_back(tmp_path: Path) -> None:
    record = make_session(4.0, 1, Imu(), 0).record
    rng = np.random.default_rng(5)
    row_of = {int(ns): k for k, ns in enumerate(record.stamps_ns)}
    costs = []
    for count in (3, 4):
        poses = chain(rng)[:count]
        square = rng.normal(size=(6 * count, 6 * count))
        costs.append(WindowViews(record.stamps_ns[:count], poses, square @ square.T, rng.normal(size=6 * count)))
    unknown = WindowViews(np.array([-5, -4]), poses[:2], np.eye(12), np.zeros(12))
    made = Views.of([*costs, unknown], row_of)
    object.__setattr__(record, "views", made)
    (tmp_path / "record.npz").write_bytes(record.to_bytes())
    loaded = SessionRecord.load(tmp_path / "record.npz").views
    assert len(loaded.begins) == 3
    for number, cost in enumerate(costs):
        rows, poses, information, gradient = loaded.at(number)
        np.testing.assert_array_equal(rows, np.arange(len(cost.poses)))
        np.testing.assert_array_equal(poses, cost.poses)
        np.testing.assert_array_equal(information, cost.information)
        np.testing.assert_array_equal(gradient, cost.gradient)
