from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from synthetic import random_covariance, transform

from graphvio.arrays import Float
from graphvio.backend.window import GraphWindow, WindowError


def x(k: int) -> int:
    return int(gtsam.symbol("x", k))


def noise(covariance: Float) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def add_point(windows: list[GraphWindow], k: int, rng: np.random.Generator, spread: float = 1.0) -> None:
    """A state of three numbers, tied to the one before and the one before that, to all windows alike."""
    for window in windows:
        window.values.insert(x(k), np.zeros(3))
    factors: list[gtsam.NonlinearFactor]
    if k == 0:
        factors = [
            gtsam.PriorFactorVector(x(0), spread * rng.standard_normal(3), noise(random_covariance(rng, 3, 0.5)))
        ]
    else:
        factors = [
            gtsam.BetweenFactorVector(
                x(j), x(k), spread * rng.standard_normal(3), noise(random_covariance(rng, 3, 0.3))
            )
            for j in range(max(k - 2, 0), k)
        ]
    for window in windows:
        for factor in factors:
            window.add(factor)


def test_marginalisation_of_a_linear_problem_is_exact() -> None:
    rng = np.random.default_rng(0)
    short, whole = GraphWindow(), GraphWindow()
    for k in range(12):
        add_point([short, whole], k, rng)
        for window in (short, whole):
            window.optimize()
        np.testing.assert_allclose(short.values.atVector(x(k)), whole.values.atVector(x(k)), atol=1e-8)
        pair = [x(k - 1), x(k)] if k else [x(0)]
        np.testing.assert_allclose(short.joint_covariance(pair), whole.joint_covariance(pair), atol=1e-8)
        if k >= 3:
            short.marginalise([x(k - 3)])
    assert sorted(short.values.keys()) == [x(9), x(10), x(11)]


def test_marginalising_several_at_once_is_the_same_as_one_by_one() -> None:
    rng = np.random.default_rng(1)
    together, apart = GraphWindow(), GraphWindow()
    for k in range(6):
        add_point([together, apart], k, rng)
    together.marginalise([x(1), x(0), x(3)])
    for k in (3, 0, 1):
        apart.marginalise([x(k)])
    for window in (together, apart):
        window.optimize()
    keys = [x(2), x(4), x(5)]
    np.testing.assert_allclose(together.joint_covariance(keys), apart.joint_covariance(keys), atol=1e-9)
    np.testing.assert_allclose(together.values.atVector(x(5)), apart.values.atVector(x(5)), atol=1e-9)


def test_marginalisation_of_poses_with_small_errors() -> None:
    rng = np.random.default_rng(2)
    short, whole = GraphWindow(), GraphWindow()
    step, previous = transform([0.02, 0.01, -0.03], [0.1, 0.0, 0.02]), np.eye(4)
    for k in range(8):
        previous = previous @ step
        for window in (short, whole):
            window.values.insert(x(k), gtsam.Pose3(previous))
        factors: list[gtsam.NonlinearFactor] = []
        if k == 0:
            factors.append(gtsam.PriorFactorPose3(x(0), gtsam.Pose3(step), noise(np.eye(6) * 1e-6)))
        for j in range(max(k - 2, 0), k):
            motion = gtsam.Pose3(np.linalg.matrix_power(step, k - j)).retract(1e-5 * rng.standard_normal(6))
            factors.append(gtsam.BetweenFactorPose3(x(j), x(k), motion, noise(random_covariance(rng, 6, 1e-4))))
        for window in (short, whole):
            for factor in factors:
                window.add(factor)
            window.optimize()
        if k >= 3:
            short.marginalise([x(k - 3)])
    np.testing.assert_allclose(short.values.atPose3(x(7)).matrix(), whole.values.atPose3(x(7)).matrix(), atol=5e-8)
    found, expected = short.joint_covariance([x(7)]), whole.joint_covariance([x(7)])
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_joint_covariance_is_in_the_order_asked_for() -> None:
    rng = np.random.default_rng(3)
    window = GraphWindow()
    for k in range(3):
        add_point([window], k, rng)
    window.optimize()
    ahead, back = window.joint_covariance([x(0), x(2)]), window.joint_covariance([x(2), x(0)])
    np.testing.assert_allclose(ahead[:3, :3], window.joint_covariance([x(0)]), atol=1e-12)
    np.testing.assert_allclose(ahead[:3, 3:], back[3:, :3], atol=1e-12)
    np.testing.assert_allclose(ahead, ahead.T, atol=1e-12)
    assert np.abs(ahead[:3, 3:]).max() > 1e-3


def test_optimise_converges_from_afar() -> None:
    window = GraphWindow()
    truth = [transform([0.1 * k, 0.2 * k, -0.1 * k], [k, 0.5 * k, 0.0]) for k in range(5)]
    for k, pose in enumerate(truth):
        window.values.insert(x(k), gtsam.Pose3(pose @ transform([0.2, -0.1, 0.1], [0.3, -0.2, 0.1])))
    window.add(gtsam.PriorFactorPose3(x(0), gtsam.Pose3(truth[0]), noise(np.eye(6) * 1e-4)))
    for j in range(4):
        motion = gtsam.Pose3(np.linalg.inv(truth[j]) @ truth[j + 1])
        window.add(gtsam.BetweenFactorPose3(x(j), x(j + 1), motion, noise(np.eye(6) * 1e-4)))
    for _ in range(2):
        window.optimize()
    for k, pose in enumerate(truth):
        np.testing.assert_allclose(window.values.atPose3(x(k)).matrix(), pose, atol=1e-8)


def loose_window() -> GraphWindow:
    """Two states, of which nothing says where they are."""
    window = GraphWindow()
    for k in range(2):
        window.values.insert(x(k), np.zeros(3))
    window.add(gtsam.BetweenFactorVector(x(0), x(1), np.ones(3), noise(np.eye(3))))
    return window


def test_what_is_not_constrained_has_no_solution_and_no_covariance() -> None:
    with pytest.raises(WindowError):
        loose_window().optimize()
    with pytest.raises(WindowError):
        loose_window().joint_covariance([x(1)])
    with pytest.raises(WindowError):
        loose_window().joint_covariance([x(0), x(1)])


@pytest.mark.parametrize(
    "use",
    [lambda w: w.optimize(), lambda w: w.joint_covariance([x(5)]), lambda w: w.marginalise([x(5)])],
    ids=["optimise", "joint_covariance", "marginalise"],
)
def test_a_variable_without_any_factor_is_not_constrained(use: Callable[[GraphWindow], object]) -> None:
    window = GraphWindow()
    add_point([window], 0, np.random.default_rng(4))
    window.values.insert(x(5), np.zeros(3))
    with pytest.raises(WindowError):
        use(window)


def test_a_state_that_hangs_in_the_air_cannot_be_marginalised() -> None:
    window = loose_window()
    window.values.insert(x(2), np.zeros(3))
    window.add(gtsam.BetweenFactorVector(x(1), x(2), np.ones(3), noise(np.eye(3))))
    with pytest.raises(WindowError):
        window.marginalise([x(0), x(1), x(2)])
    assert len(window.values.keys()) == 3  # as it was
    window.marginalise([x(0)])  # says nothing of the others: fine
    window.add(gtsam.PriorFactorVector(x(2), np.array([5.0, 6.0, 7.0]), noise(np.eye(3))))
    window.optimize()
    np.testing.assert_allclose(window.values.atVector(x(1)), [4.0, 5.0, 6.0], atol=1e-9)
    np.testing.assert_allclose(window.joint_covariance([x(1)]), 2.0 * np.eye(3), atol=1e-9)


def test_a_failed_solution_leaves_the_values() -> None:
    window = loose_window()
    before = window.values.atVector(x(1))
    with pytest.raises(WindowError):
        window.optimize()
    assert np.array_equal(window.values.atVector(x(1)), before)
    window.add(gtsam.PriorFactorVector(x(0), np.zeros(3), noise(np.eye(3))))
    window.optimize()
    np.testing.assert_allclose(window.values.atVector(x(1)), np.ones(3), atol=1e-9)


def test_covariances_of_followed_variables_need_no_new_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    followed, plain = GraphWindow(), GraphWindow()
    for k in range(6):
        add_point([followed, plain], k, rng)
    for window, last in ((followed, [x(4), x(5)]), (plain, [])):
        window.optimize(last)
        add_point([window], 6, np.random.default_rng(5))
    expected = plain.joint_covariance([x(4), x(6)])
    with monkeypatch.context() as patched:
        patched.delattr(GraphWindow, "_solve")
        np.testing.assert_allclose(followed.joint_covariance([x(4), x(6)]), expected, atol=1e-12)
    # A factor that ties in what is not followed needs the whole window.
    for window in (followed, plain):
        window.add(gtsam.BetweenFactorVector(x(0), x(6), np.zeros(3), noise(np.eye(3) * 0.01)))
    expected = plain.joint_covariance([x(4), x(6)])
    np.testing.assert_allclose(followed.joint_covariance([x(4), x(6)]), expected, atol=1e-12)


def test_advancing_is_the_whole_solution_for_what_is_followed() -> None:
    rng = np.random.default_rng(6)
    quick, whole = GraphWindow(), GraphWindow()
    for k in range(10):
        add_point([quick, whole], k, rng, spread=1e-3)
        whole.optimize()
        if k == 5:
            quick.optimize([x(4), x(5)])
        if k > 5:  # each new state is tied to the two before it, which are followed
            before = quick.values.atVector(x(3))
            assert quick.advance([x(k - 1), x(k)])
            pair = [x(k - 1), x(k)]
            for key in pair:
                np.testing.assert_allclose(quick.values.atVector(key), whole.values.atVector(key), atol=1e-12)
            np.testing.assert_allclose(quick.joint_covariance(pair), whole.joint_covariance(pair), atol=1e-12)
            assert np.array_equal(quick.values.atVector(x(3)), before)
    quick.optimize()
    for k in range(10):
        np.testing.assert_allclose(quick.values.atVector(x(k)), whole.values.atVector(x(k)), atol=1e-12)


def test_advancing_counts_what_a_covariance_was_asked_with() -> None:
    """Factors that the marginal already knows of, since a gate asked for it, still correct the values."""
    rng = np.random.default_rng(7)
    asked, whole = GraphWindow(), GraphWindow()
    for k in range(4):
        add_point([asked, whole], k, rng, spread=1e-3)
    asked.optimize([x(2), x(3)])
    add_point([asked, whole], 4, rng, spread=1e-3)
    asked.joint_covariance([x(4)])
    assert asked.advance([x(4)])
    whole.optimize()
    np.testing.assert_allclose(asked.values.atVector(x(4)), whole.values.atVector(x(4)), atol=1e-12)


@pytest.mark.parametrize("reason", ["new window", "not followed", "long step", "robust kernel", "unconstrained"])
def test_where_advancing_is_impossible_nothing_changes(reason: str) -> None:
    rng = np.random.default_rng(8)
    window = GraphWindow(min_iterations=2 if reason == "robust kernel" else 1)
    for k in range(5):
        add_point([window], k, rng)
    if reason != "new window":
        window.optimize([x(3), x(4)])
    window.values.insert(x(5), window.values.atVector(x(4)))
    step, last = {"long step": np.full(3, 0.02)}.get(reason, np.full(3, 0.002)), 0 if reason == "not followed" else 4
    if reason != "unconstrained":
        window.add(gtsam.BetweenFactorVector(x(last), x(5), step, noise(np.eye(3) * 0.01)))
    before = {key: window.values.atVector(key) for key in list(window.values.keys())}
    assert not window.advance([x(5)])
    assert all(np.array_equal(window.values.atVector(key), value) for key, value in before.items())
    if reason != "unconstrained":
        window.optimize([x(5)])
        expected = window.values.atVector(x(last)) + step
        np.testing.assert_allclose(window.values.atVector(x(5)), expected, atol=1e-9)


@pytest.mark.parametrize("walk", [1e-2, 1e-5, 1e-8, 1e-10])
def test_values_that_hardly_change_lose_no_digits(walk: float) -> None:
    """As biases of good sensors: the information of a step may exceed all that is known of the value itself."""
    window, unit = GraphWindow(), np.eye(3)
    for k in range(10):
        window.values.insert(x(k), np.zeros(3))
        window.add(
            gtsam.PriorFactorVector(x(0), np.ones(3), noise(0.25 * unit))
            if k == 0
            else gtsam.BetweenFactorVector(x(k - 1), x(k), np.zeros(3), noise(walk**2 * unit))
        )
    window.optimize([x(9)])
    np.testing.assert_allclose(window.values.atVector(x(9)), np.ones(3), rtol=1e-6)
    np.testing.assert_allclose(window.joint_covariance([x(9)]), (0.25 + 9 * walk**2) * unit, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(window.joint_covariance([x(0)]), 0.25 * unit, rtol=1e-6, atol=1e-9)


def test_optimize_shortens_a_step_that_makes_it_worse() -> None:
    """Gauss-Newton from 3 to the zero of the arc tangent leaps to -9.5, and from there ever farther away."""

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        at = values.atVector(factor.keys()[0])
        if jacobians is not None:
            jacobians[0] = np.array([[1.0 / (1.0 + at[0] ** 2)]])
        return np.arctan(at)

    window = GraphWindow()
    window.values.insert(0, np.array([3.0]))
    window.add(gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, 0.1), [0], error))
    errors = []
    for _ in range(5):
        window.optimize()
        errors.append(abs(window.values.atVector(0)[0]))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-3
