"""Graph optimisation of synthetic sessions, whose truth and noise are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from synthetic_session import SyntheticSession, closure_between, make_session

from graphvio import ImuSample, Odometry, open_source
from graphvio.arrays import Bool, Float
from graphvio.backend.factors import x
from graphvio.config import Config
from graphvio.config.stages import SmootherConfig
from graphvio.errors import OptimizationError
from graphvio.evaluation import evaluate
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.measurements.motion import RelativeMotion
from graphvio.optimization.exchange import write_g2o
from graphvio.optimization.extrinsics import c, d, own_motion
from graphvio.optimization.loops.closures import LoopClosure, closures_to_bytes, load_closures
from graphvio.optimization.nodes import choose_nodes, spread
from graphvio.optimization.optimize import Optimization, optimize
from graphvio.optimization.record import Motions, Recorder, SessionRecord
from graphvio.optimization.solver import Marginals
from graphvio.optimization.workspace import Workspace
from graphvio.rig import Imu
from graphvio.simulation import default_rig
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

IMU = Imu()
CONFIG = Config()


@pytest.fixture(scope="module")
def walk() -> SyntheticSession:
    """A lap and two thirds with 40 closures, of which the last 12 are false."""
    return make_session(150.0, 1, IMU, 40, 0.3)


@pytest.fixture(scope="module")
def mixed(walk: SyntheticSession) -> Optimization:
    """From all its closures."""
    return optimized(walk, walk.closures)


def ate_m(poses: Float, session: SyntheticSession) -> float:
    return evaluate(Trajectory(session.record.stamps_ns, poses), session.truth).ate_position_m.rmse


def optimized(session: SyntheticSession, closures: list[LoopClosure]) -> Optimization:
    return optimize([session.record], [IMU], closures, CONFIG)


def test_optimize_false_closures_are_refused(walk: SyntheticSession, mixed: Optimization) -> None:
    """With 30 % false closures the error is within a tenth of that with the true ones alone."""
    right = walk.closures[: -walk.false]
    clean, alone = optimized(walk, right), optimized(walk, [])
    assert ate_m(clean.sessions[0].nav_T_body, walk) < 0.5 * ate_m(alone.sessions[0].nav_T_body, walk)
    assert ate_m(alone.sessions[0].nav_T_body, walk) < ate_m(walk.record.online, walk)
    assert ate_m(mixed.sessions[0].nav_T_body, walk) < 1.1 * ate_m(clean.sessions[0].nav_T_body, walk)
    assert [bool(loop.refusal) for loop in mixed.loops] == [False] * len(right) + [True] * walk.false
    assert all("standard deviations from the solution" in loop.refusal for loop in mixed.loops[-walk.false :])
    assert mixed.cost_after < mixed.cost_before
    assert 0.1 < mixed.after["loop"].per_dimension < 1.2  # of the IMU's noise three times as much is expected


def test_optimize_false_closures_in_agreement_are_refused(walk: SyntheticSession) -> None:
    """As many false closures as true ones, all off by the same two metres, as of a repeated pattern."""
    right = walk.closures[: -walk.false]
    shift = np.eye(4)
    shift[:3, 3] = 2.0, 0.0, 0.0
    wrong = [replace(each, reference_T_current=shift @ each.reference_T_current) for each in right]
    found = optimized(walk, right + wrong)
    assert [bool(loop.refusal) for loop in found.loops] == [False] * len(right) + [True] * len(wrong)


def test_marginals_poses_are_those_of_each_pose(mixed: Optimization) -> None:
    assert any(not loop.refusal for loop in mixed.loops)
    marginals = Marginals(mixed.graph, mixed.values)
    together = marginals.poses(len(mixed.sessions[0].nodes.rows))
    for k in range(0, len(together), 10):
        one = marginals.variable(x(k))
        np.testing.assert_allclose(together[k], one, rtol=0.0, atol=1e-6 * np.abs(one).max())


def test_marginals_motion_is_consistent() -> None:
    """NEES of the last pose seen from the first, over 40 walks with the IMU's noise as it is: 95 % band of its mean."""
    config = replace(CONFIG, smoother=replace(SmootherConfig(), imu_noise_scale=1.0))
    squares = []
    for seed in range(40):
        session = make_session(12.0, seed, IMU, 0)
        found = optimize([session.record], [IMU], [], config)
        last = len(found.sessions[0].nodes.rows) - 1
        relative, covariance = Marginals(found.graph, found.values).motion(0, last)
        true = se3_inverse(session.truth.nav_T_body[0]) @ session.truth.nav_T_body[-1]
        error = se3_log(se3_inverse(relative) @ true)
        squares.append(error @ np.linalg.solve(covariance, error))
    assert 4.95 < np.mean(squares) < 7.1


def test_optimize_sessions_with_closures_share_frame() -> None:
    """Two walks in different frames are joined by three closures between them, but not by one."""
    one, other = make_session(100.0, 1, IMU, 10), make_session(100.0, 2, IMU, 10, session=1)
    turned = se3_exp(np.array([0.0, 0.0, 2.0, 5.0, -3.0, 0.4]))
    elsewhere = replace(
        other.record,
        online=turned @ other.record.online,
        smoothed=turned @ other.record.smoothed,
        velocity_nav=other.record.velocity_nav @ turned[:3, :3].T,
    )
    between = [closure_between(one, other, row, 5) for row in (80, 400, 1200)]
    apart = optimize([one.record, elsewhere], [IMU, IMU], [*one.closures, *other.closures, between[0]], CONFIG)
    assert apart.frames == [0, 1]
    assert apart.loops[-1].refusal.startswith("too few closures agree")
    joined = optimize([one.record, elsewhere], [IMU, IMU], [*one.closures, *other.closures, *between], CONFIG)
    assert joined.frames == [0, 0]
    assert [set(each.frame.tolist()) for each in joined.sessions] == [{0}, {0}]
    apart_m = np.linalg.norm(
        joined.sessions[0].nav_T_body[:, :3, 3] - joined.sessions[1].nav_T_body[:, :3, 3], axis=1
    )  # both walks go the same way at the same time
    assert apart_m.max() < 0.1


def test_optimize_closures_of_few_points_do_not_join_sessions() -> None:
    """Ten closures that agree do not join sessions with 60 points each, as of one poster, but do with 100."""
    one, other = make_session(40.0, 1, IMU, 0), make_session(40.0, 2, IMU, 0, session=1)
    between = [closure_between(one, other, row, 5) for row in range(100, 300, 20)]
    few = [replace(each, inliers=60) for each in between]
    assert optimize([one.record, other.record], [IMU, IMU], few, CONFIG).frames == [0, 1]
    assert optimize([one.record, other.record], [IMU, IMU], between, CONFIG).frames == [0, 0]


def test_optimize_closures_of_other_sessions_raise(walk: SyntheticSession) -> None:
    other = make_session(40.0, 2, IMU, 0)
    with pytest.raises(OptimizationError, match="belong to other sessions"):
        optimize([other.record], [IMU], walk.closures, CONFIG)


def chosen(motions: Motions, which: Bool) -> Motions:
    columns: dict[str, Any] = {name: column[which] for name, column in motions._asdict().items()}
    return Motions(**columns)


def broken(session: SyntheticSession, row: int) -> SessionRecord:
    """The same walk with a new epoch from a row on, in another frame."""
    record, moved = session.record, se3_exp(np.array([0.0, 0.0, 0.5, 3.0, 1.0, 0.0]))
    kept = (record.motions.reference >= row) | (record.motions.row < row)
    poses = record.smoothed.copy()
    poses[row:] = moved @ poses[row:]
    velocity = record.velocity_nav.copy()
    velocity[row:] = velocity[row:] @ moved[:3, :3].T
    epoch = record.epoch.copy()
    epoch[row:] = 1
    motions = chosen(record.motions, kept)
    return replace(record, online=poses, smoothed=poses, velocity_nav=velocity, epoch=epoch, motions=motions)


def test_optimize_epochs_are_joined_by_closures_only(walk: SyntheticSession) -> None:
    record = broken(walk, 2000)
    found = optimize([record], [IMU], walk.closures, CONFIG)
    assert found.frames == [0, 0]
    assert ate_m(found.sessions[0].nav_T_body, walk) < 0.1
    alone = optimize([record], [IMU], [], CONFIG)
    assert alone.frames == [0, 1]
    assert np.array_equal(alone.sessions[0].frame, record.epoch)


def test_optimize_without_imu_uses_motions(walk: SyntheticSession) -> None:
    record = replace(walk.record, with_imu=np.zeros(len(walk.record.stamps_ns), dtype=bool))
    found = optimize([record], [None], walk.closures, CONFIG)
    assert "imu" not in found.after
    assert ate_m(found.sessions[0].nav_T_body, walk) < 0.3 * ate_m(record.online, walk)


def test_optimize_gap_has_constant_velocity(walk: SyntheticSession) -> None:
    """The graph has a unique solution with neither motions nor IMU for half a second."""
    record = walk.record
    blind = (record.motions.row > 1000) & (record.motions.reference < 1010)
    covers = record.inertial.covers.copy()
    covers[1000:1011] = False
    motions = chosen(record.motions, ~blind)
    record = replace(record, motions=motions, inertial=record.inertial._replace(covers=covers))
    found = optimize([record], [IMU], [], CONFIG)
    assert np.isfinite(found.sessions[0].covariance).all()
    assert "walk" in found.after


def test_spread_keeps_smoothed_motion(walk: SyntheticSession) -> None:
    nodes = choose_nodes(walk.record, 1.0)
    exact = spread(nodes, walk.record.smoothed[nodes.rows])
    np.testing.assert_allclose(exact, walk.record.smoothed, atol=1e-9)
    moved = se3_exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    elsewhere = spread(nodes, moved @ walk.record.smoothed[nodes.rows])
    np.testing.assert_allclose(elsewhere, moved @ walk.record.smoothed, atol=1e-9)


def test_optimize_calibrates_extrinsics_and_time_offset() -> None:
    """Corrections of 0.5 degrees and 3 mm, 2 degrees and 4 cm, and 6 ms are estimated consistently."""
    true = [
        se3_exp(np.array([0.005, -0.006, 0.004, 0.002, -0.001, 0.002])),
        se3_exp(np.array([-0.02, 0.03, 0.01, 0.03, 0.02, -0.02])),
    ]
    session = make_session(100.0, 4, IMU, 5, corrections=true, offset_s=0.006)
    found = optimize([session.record], [IMU], session.closures, CONFIG, calibrates=True)
    (correction,) = found.corrections
    assert correction is not None
    for pair, expected in enumerate(true):
        error = se3_log(se3_inverse(correction.pairs[pair]) @ expected)
        assert np.linalg.norm(error[:3]) < 2e-3
        assert error @ np.linalg.solve(correction.covariances[pair], error) < 16.8
    assert correction.offset_sigma_s is not None
    assert abs(correction.offset_s - 0.006) < min(1e-3, 4.0 * correction.offset_sigma_s)
    rig = correction.corrected(default_rig())
    np.testing.assert_allclose(
        rig.pairs[1].right.body_T_cam, correction.pairs[1] @ default_rig().pairs[1].right.body_T_cam
    )


def test_own_motion_derivatives_are_numerical_ones() -> None:
    rng = np.random.default_rng(3)
    twists = rng.standard_normal((2, 6))
    motion = RelativeMotion(0, 1, se3_exp(0.5 * rng.standard_normal(6)), np.eye(6), np.zeros((6, 6)), 10)
    factor = own_motion(0, 1, 0, 1, motion, (twists[0], twists[1]))
    values = gtsam.Values()
    for key in (x(0), x(1), c(0, 1)):
        values.insert(key, gtsam.Pose3(se3_exp(0.5 * rng.standard_normal(6))))
    values.insert(d(0), np.array([0.1]))
    found, _ = factor.linearize(values).jacobian()
    columns = []
    for key, size in ((x(0), 6), (x(1), 6), (c(0, 1), 6), (d(0), 1)):
        for axis in range(size):
            both = []
            for step in (1e-6, -1e-6):
                change = gtsam.VectorValues()
                change.insert(key, step * np.eye(size)[axis])
                both.append(factor.unwhitenedError(values.retract(change)))
            columns.append((both[0] - both[1]) / 2e-6)
    np.testing.assert_allclose(found, np.array(columns).T, atol=1e-6)


def test_record_and_closures_files_are_lossless(walk: SyntheticSession, mixed: Optimization, tmp_path: Path) -> None:
    record, closures = tmp_path / "record.npz", tmp_path / "loops.npz"
    record.write_bytes(walk.record.to_bytes())
    closures.write_bytes(closures_to_bytes(walk.closures))
    again, loops = SessionRecord.load(record), load_closures(closures)
    assert again.to_bytes() == walk.record.to_bytes()
    assert closures_to_bytes(loops) == closures_to_bytes(walk.closures)
    first, second = mixed, optimize([again], [IMU], loops, CONFIG)
    assert np.array_equal(first.sessions[0].nav_T_body, second.sessions[0].nav_T_body)
    record.write_bytes(record.read_bytes()[:-100])
    with pytest.raises(OptimizationError, match="is no record of a session"):
        SessionRecord.load(record)


def test_write_g2o_optimum_is_that_of_full_graph(walk: SyntheticSession, mixed: Optimization, tmp_path: Path) -> None:
    """The pose graph's optimum is near that of the full graph, which has correlations by the IMU in addition."""
    found = mixed
    write_g2o(found, tmp_path / "graph.g2o")
    graph, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    nodes = found.sessions[0].nodes
    assert values.size() == len(nodes.rows)
    disturbed = gtsam.Values()
    for k, row in enumerate(nodes.rows.tolist()):
        disturbed.insert(k, gtsam.Pose3(walk.record.smoothed[row]))
    first = gtsam.Pose3(found.sessions[0].nav_T_body[nodes.rows[0]])
    graph.add(gtsam.PriorFactorPose3(0, first, gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, disturbed).optimize()
    apart = [
        np.linalg.norm(solution.atPose3(k).translation() - found.sessions[0].nav_T_body[row, :3, 3])
        for k, row in enumerate(nodes.rows.tolist())
    ]
    moved = found.sessions[0].nav_T_body[:, :3, 3] - walk.record.smoothed[:, :3, 3]
    assert max(apart) < 0.15 * np.linalg.norm(moved, axis=1).max()
    assert found.values.exists(x(0))


def test_optimize_wrong_imu_is_not_used(room_walk: Path) -> None:
    """Its biases jump at 2.5 s: vision is gated for a second, and then used, also for that second."""
    source = open_source(room_walk)
    recorder = Recorder("walk")
    odometry = Odometry(source.rig, CONFIG)
    odometry.subscribe(recorder.add)
    kinds = []
    for measurement in source:
        if isinstance(measurement, ImuSample) and measurement.stamp_ns - source.start_ns > 2_500_000_000:
            measurement = replace(
                measurement,
                angular_velocity=measurement.angular_velocity + np.array([0.05, 0.0, 0.05]),
                linear_acceleration=measurement.linear_acceleration + np.array([0.5, 0.0, 0.0]),
            )
        odometry.process(measurement)
        recorder.add_smoothed(odometry.take_smoothed())
        kinds += [event.kind for event in odometry.take_events()]
    odometry.finish()
    recorder.add_smoothed(odometry.take_smoothed())
    assert "gate_reset" in kinds
    record = recorder.record()
    assert record.is_start.sum() == 2
    found = optimize([record], [source.rig.imu], [], CONFIG)
    assert source.truth is not None
    truth = load_trajectory(source.truth)
    before, after = (
        evaluate(Trajectory(record.stamps_ns, poses), truth).ate_position_m.rmse
        for poses in (record.online, found.sessions[0].nav_T_body)
    )
    assert after < 0.5 * before
    assert found.after["imu"].per_dimension < 0.3


def test_folder_of_an_optimisation_is_refused_to_a_second_one_until_the_first_ends(tmp_path: Path) -> None:
    inputs = {"walk": "1"}
    with Workspace(tmp_path / "out", inputs).locked():
        second = Workspace(tmp_path / "out", inputs)
        with pytest.raises(OptimizationError, match="another run writes into it"), second.locked():
            pass
    with Workspace(tmp_path / "out", inputs).locked():
        pass
