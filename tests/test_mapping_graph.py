"""The map's pose graph on random chains: which closures are used, and the covariance of places."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from graphvio.arrays import Float
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.mapping.chains import Chains
from graphvio.mapping.pose_graph import PoseGraph
from graphvio.optimization.loops.closures import LoopClosure, Place
from graphvio.optimization.solver import Edge, Marginals

STEP_SIGMAS = np.repeat([1e-3, 4e-3], 3)
LOOP_SIGMAS = np.repeat([1e-3, 3e-3], 3)
PROBABILITY = 0.999


def circle(laps: float, count: int) -> Float:
    """Poses (N, 4, 4) on a circle of 5 m, looking along it."""
    made = []
    for angle in np.linspace(0.0, 2.0 * np.pi * laps, count):
        pose = se3_exp(np.array([0.0, 0.0, angle + 0.5 * np.pi, 0.0, 0.0, 0.0]))
        pose[:3, 3] = 5.0 * np.cos(angle), 5.0 * np.sin(angle), 0.1 * np.sin(3.0 * angle)
        made.append(pose)
    return np.array(made)


def walked(
    graph: PoseGraph,
    truth: Float,
    rng: np.random.Generator,
    origin: Float | None = None,
    sigmas: Float = STEP_SIGMAS,
) -> None:
    """Add a fragment with random drift; its odom frame is the world, or at the origin (4, 4)."""
    world_T_odom = np.eye(4) if origin is None else origin
    graph.begin(se3_inverse(world_T_odom) @ truth[0])
    for one, other in pairwise(truth):
        motion = se3_inverse(one) @ other @ se3_exp(sigmas * rng.standard_normal(6))
        graph.add(motion, np.diag(sigmas**2))


def closure(
    truth: Float,
    one: int,
    other: int,
    rng: np.random.Generator,
    wrong: Float | None = None,
    inliers: int = 200,
    sigmas: Float = LOOP_SIGMAS,
) -> LoopClosure:
    motion = se3_inverse(truth[one]) @ truth[other] @ se3_exp(sigmas * rng.standard_normal(6))
    if wrong is not None:
        motion = motion @ se3_exp(wrong)
    return LoopClosure(Place(0, one, one), Place(0, other, other), motion, np.diag(sigmas**2), inliers, ((0, 0),), True)


def worst_m(graph: PoseGraph, truth: Float) -> float:
    poses = np.array([graph.pose(k) for k in range(len(graph))])
    return float(np.linalg.norm((poses - truth)[:, :3, 3], axis=1).max())


def test_motions_of_chains_equal_those_of_the_solved_graph() -> None:
    truth, rng = circle(1.0, 30), np.random.default_rng(0)
    graph = PoseGraph(PROBABILITY)
    walked(graph, truth, rng)
    known = Marginals(*graph._graph(0))
    for first, second in ((3, 4), (2, 25), (25, 2)):
        motion, covariance = graph.chains.motion(first, second)
        expected_motion, expected = known.motion(first, second)
        np.testing.assert_allclose(motion, expected_motion, atol=1e-9)
        np.testing.assert_allclose(covariance, expected, rtol=1e-4, atol=1e-10)
    edge = Edge(2, 25, se3_inverse(truth[2]) @ truth[25], np.diag(LOOP_SIGMAS**2))
    assert edge.distance(graph.chains) == pytest.approx(edge.distance(known), rel=1e-4)


def test_covariance_of_zero_can_be_used() -> None:
    chains = Chains()
    chains.begin(np.eye(4))
    chains.add(np.eye(4), np.zeros((6, 6)))
    assert np.linalg.eigvalsh(chains.motion(0, 1)[1])[0] > 0.0


def test_closures_remove_drift_consistently_with_the_covariance() -> None:
    truth = circle(1.5, 60)
    squares, before, after = [], [], []
    for seed in range(12):
        rng = np.random.default_rng([3, seed])
        graph = PoseGraph(PROBABILITY)
        walked(graph, truth, rng)
        before.append(worst_m(graph, truth))
        found = [closure(truth, k, k + 40, rng) for k in range(0, 20, 2)]
        assert all(graph.add_closures([each]) for each in found)
        after.append(worst_m(graph, truth))
        error = se3_log(se3_inverse(graph.pose(59)) @ truth[59])
        squares.append(error @ np.linalg.solve(graph.covariance(59), error))
    assert np.mean(after) < 0.6 * np.mean(before)
    assert 3.0 < np.mean(squares) < 10.0


def test_closure_refuted_by_the_odometry_is_never_used() -> None:
    truth, rng = circle(1.5, 60), np.random.default_rng(4)
    graph = PoseGraph(PROBABILITY)
    walked(graph, truth, rng)
    assert not graph.add_closures([closure(truth, 0, 50, rng, np.array([0.0, 0.0, 0.3, 2.0, 0.0, 0.0]))])
    assert graph.closures[0].is_refuted
    assert not graph.closures[0].is_used


def test_wrong_first_closure_is_rejected_later() -> None:
    """The odometry does not refute it; five other closures do, one after the other."""
    truth, rng = circle(1.5, 60), np.random.default_rng(5)
    graph = PoseGraph(PROBABILITY)
    walked(graph, truth, rng)
    off = np.array([0.0, 0.0, 0.0, 0.06, 0.05, 0.0])
    assert graph.add_closures([closure(truth, 0, 40, rng, off)])
    for k in range(2, 14, 2):
        graph.add_closures([closure(truth, k, k + 40, rng)])
    assert [each.is_used for each in graph.closures] == [False] + 6 * [True]
    assert np.linalg.norm((graph.pose(52) - truth[52])[:3, 3]) < 0.02


def test_places_out_of_sight_are_not_compared() -> None:
    """Another fragment may be anywhere."""
    truth, rng = np.tile(np.eye(4), (60, 1, 1)), np.random.default_rng(8)
    truth[:, 0, 3] = np.arange(60)
    graph = PoseGraph(PROBABILITY)
    walked(graph, truth, rng)
    assert graph.may_see(50, 59)
    assert not graph.may_see(0, 59)
    graph.begin(truth[0])
    assert graph.may_see(0, 60)


def test_fragment_is_joined_by_three_places_that_agree() -> None:
    """Two places, even with many closures, are too few; so are three of which one disagrees."""
    truth, rng = circle(1.5, 60), np.random.default_rng(6)
    graph = PoseGraph(PROBABILITY)
    walked(graph, truth[:40], rng)
    walked(graph, truth[40:], rng, origin=truth[40])
    assert not graph.add_closures([closure(truth, k, 40, rng) for k in (0, 1, 2)])
    assert not graph.add_closures([closure(truth, k, 42, rng) for k in (1, 2, 3)])
    elsewhere = np.array([0.0, 0.0, 1.0, 3.0, 0.0, 0.0])
    assert not graph.add_closures([closure(truth, 3, 44, rng, elsewhere)])
    assert not graph.add_closures([closure(truth, 5, 45, rng, inliers=60)])  # of few points: it may be one thing
    assert not graph.is_in_map(59)
    assert graph.add_closures([closure(truth, 6, 46, rng)])
    assert graph.is_in_map(59)
    assert graph.component == [0, 0]
    assert worst_m(graph, truth) < 0.15
    used = {(each.edge.first, each.edge.second): each.is_used for each in graph.closures}
    assert not used[3, 44]
    assert used[5, 45]
    error = se3_log(se3_inverse(graph.pose(50)) @ truth[50])
    assert error @ np.linalg.solve(graph.covariance(50), error) < 25.0


@pytest.mark.parametrize("off_m", [0.3, 1.0, 1.9])
def test_closure_far_off_does_not_keep_a_fragment_apart(off_m: float) -> None:
    """One that the vague joint of the fragments does not refute, between chains that are hardly to be bent."""
    truth, rng, steps, loops = circle(1.2, 48), np.random.default_rng(10), 0.05 * STEP_SIGMAS, 0.3 * LOOP_SIGMAS
    graph = PoseGraph(PROBABILITY)
    walked(graph, truth[:7], rng, sigmas=steps)
    walked(graph, truth[40:46], rng, origin=truth[40], sigmas=steps)
    truth = np.concatenate([truth[:7], truth[40:46]])
    off = np.array([0.0, 0.0, 0.0, off_m, 0.0, 0.0])
    graph.add_closures([closure(truth, 0, 9, rng, off, inliers=60, sigmas=loops)])
    for k in range(8, 13):
        graph.add_closures([closure(truth, k - step, k, rng, sigmas=loops) for step in (6, 7)])
    assert graph.is_in_map(12)
    used = {(each.edge.first, each.edge.second): each.is_used for each in graph.closures}
    assert not used.pop((0, 9))
    assert all(used.values())


def test_joined_fragment_uses_single_closures() -> None:
    truth, rng = circle(1.5, 60), np.random.default_rng(7)
    graph = PoseGraph(PROBABILITY)
    walked(graph, truth[:40], rng)
    walked(graph, truth[40:], rng, origin=truth[40])
    for k in (0, 2, 4):
        graph.add_closures([closure(truth, k, k + 40, rng)])
    before = graph.covariance(55)
    assert graph.add_closures([closure(truth, 15, 55, rng)])
    assert np.trace(graph.covariance(55)) < 0.8 * np.trace(before)
    assert not graph.add_closures([closure(truth, 16, 56, rng, np.array([0.0, 0.0, 0.4, 1.0, 0.0, 0.0]))])


def test_votes_are_compared_in_the_solution() -> None:
    """The first session's two rounds lie metres apart by the odometry; another one sees places of both."""
    truth, rng = circle(3.0, 120), np.random.default_rng(9)
    graph = PoseGraph(PROBABILITY)
    sigmas = 30.0 * STEP_SIGMAS
    graph.begin(truth[0])
    for one, other in pairwise(truth[:80]):
        graph.add(se3_inverse(one) @ other @ se3_exp(sigmas * rng.standard_normal(6)), np.diag(sigmas**2))
    spacing = 119.0 / 3.0  # places of a round
    for k in range(1, 30, 3):
        graph.add_closures([closure(truth, k, round(k + spacing), rng)])
    drifted = np.linalg.norm((graph.chains.poses[50] - truth[50])[:3, 3])
    assert drifted > 1.0
    walked(graph, truth[80:], rng, origin=truth[80])
    for first, second in ((3, 82), (43, 83), (4, 84)):
        graph.add_closures([closure(truth, first, second, rng)])
    assert graph.is_in_map(119)
    assert [each.is_used for each in graph.closures[-3:]] == [True, True, True]
    error = se3_inverse(graph.pose(43)) @ graph.pose(83) - se3_inverse(truth[43]) @ truth[83]
    assert np.linalg.norm(error[:3, 3]) < 0.02
