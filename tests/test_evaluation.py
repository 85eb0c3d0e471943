from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.core.units import Unit
from evo.tools import file_interface

from graphvio.arrays import Float
from graphvio.errors import TrajectoryError
from graphvio.evaluation import Evaluation, evaluate, umeyama_se3
from graphvio.geometry import se3, so3_exp
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory, save_trajectory

RATE_HZ = 20
ELSEWHERE = se3(so3_exp(np.array([0.2, -0.1, 2.0])), np.array([3.0, -7.0, 1.0]))


def walk(count: int = 1600, drift_m: float = 0.0, turns: float = 2.0) -> Trajectory:
    """Two rounds of about 75 m each; with ``drift_m`` per step of random walk in position and rotation."""
    random = np.random.default_rng(5)
    u = np.linspace(0.0, 2.0 * np.pi * turns, count)
    positions = np.column_stack([15 * np.sin(u), 8 * (1 - np.cos(u)), np.sin(2 * u)])
    off = np.cumsum(random.normal(0.0, drift_m, (count, 3)), axis=0) if drift_m else np.zeros((count, 3))
    poses = [
        se3(so3_exp(np.array([0.1 * np.sin(3 * a), 0.1 * np.cos(2 * a), a]) + 0.1 * e), p + e)
        for a, p, e in zip(u, positions, off, strict=True)
    ]
    return Trajectory(1_400_000_000_000_000_000 + np.arange(count) * (10**9 // RATE_HZ), np.array(poses))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Evaluation, Any, Any]:
    """Our figures, and truth and estimate as evo reads them from the same files."""
    folder: Path = tmp_path_factory.mktemp("trajectories")
    save_trajectory(walk(drift_m=0.01).transformed(ELSEWHERE), folder / "estimate.txt")
    save_trajectory(walk(), folder / "truth.txt")
    ours = evaluate(load_trajectory(folder / "estimate.txt"), load_trajectory(folder / "truth.txt"))
    truth = file_interface.read_tum_trajectory_file(str(folder / "truth.txt"))
    estimate = file_interface.read_tum_trajectory_file(str(folder / "estimate.txt"))
    truth, estimate = sync.associate_trajectories(truth, estimate, max_diff=1e-3)
    estimate.align(truth, correct_scale=False)
    return ours, truth, estimate


def agrees(stats: Any, evo_metric: Any, rel: float = 1e-6) -> None:
    theirs = evo_metric.get_all_statistics()
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(stats, name) == pytest.approx(theirs[name], rel=rel), name


def test_ate_agrees_with_evo(pair: tuple[Evaluation, Any, Any]) -> None:
    ours, truth, estimate = pair
    assert ours.ate_position_m.rmse > 0.05  # there is something to measure
    for stats, relation in (
        (ours.ate_position_m, metrics.PoseRelation.translation_part),
        (ours.ate_rotation_deg, metrics.PoseRelation.rotation_angle_deg),
    ):
        ape = metrics.APE(relation)
        ape.process_data((truth, estimate))
        agrees(stats, ape)


@pytest.mark.parametrize(
    ("name", "delta", "unit"),
    [("1 s", RATE_HZ, Unit.frames), ("1 m", 1, Unit.meters), ("5 m", 5, Unit.meters), ("100 m", 100, Unit.meters)],
)
def test_rpe_agrees_with_evo(pair: tuple[Evaluation, Any, Any], name: str, delta: float, unit: Unit) -> None:
    ours, truth, estimate = pair
    for stats, relation in (
        (ours.rpe[name].position_m, metrics.PoseRelation.translation_part),
        (ours.rpe[name].rotation_deg, metrics.PoseRelation.rotation_angle_deg),
    ):
        rpe = metrics.RPE(relation, delta, unit, rel_delta_tol=0.1, all_pairs=True, pairs_from_reference=True)
        rpe.process_data((truth, estimate))
        assert ours.rpe[name].pairs == len(rpe.error)
        agrees(stats, rpe)


def test_evaluate_equal_trajectories_in_other_frame_has_no_error() -> None:
    figures = evaluate(walk().transformed(ELSEWHERE), walk())
    assert figures.ate_position_m.max < 1e-9
    assert figures.ate_rotation_deg.max < 1e-6
    assert figures.drift_m < 1e-6
    assert figures.loop_closure is not None
    assert figures.loop_closure.error_m < 1e-9
    assert max(error.position_m.max for error in figures.rpe.values()) < 1e-9
    assert figures.associated == figures.estimates == 1600


def test_umeyama_finds_transform_and_no_reflection() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3))
    found = umeyama_se3(points, points @ ELSEWHERE[:3, :3].T + ELSEWHERE[:3, 3])
    np.testing.assert_allclose(found, ELSEWHERE, atol=1e-12)
    mirrored = umeyama_se3(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1.0)


def straight(count: int, per_pose_m: Float) -> Trajectory:
    poses = np.array([se3(np.eye(3), k * per_pose_m) for k in range(count)])
    return Trajectory(np.arange(count) * 50_000_000, poses)


def test_drift_of_wrong_scale_is_error_at_end_by_path() -> None:
    truth = straight(2001, np.array([0.05, 0.0, 0.0]))
    figures = evaluate(straight(2001, np.array([0.051, 0.0, 0.0])), truth)
    assert figures.path_length_m == pytest.approx(100.0)
    assert figures.drift_percent == pytest.approx(2.0 * 0.975, rel=0.01)  # the first 5 % are centred, not pinned
    assert figures.kitti_percent == pytest.approx(2.0, rel=1e-6)
    assert figures.rpe["10 m"].percent == pytest.approx(2.0, rel=1e-6)
    assert figures.loop_closure is None
    assert figures.ate_rotation_deg.max < 1e-6  # although positions on a line leave the roll undefined


def test_ate_with_scale_agrees_with_evo() -> None:
    truth, estimate = walk(), walk(drift_m=0.01)
    poses = estimate.nav_T_body.copy()
    poses[:, :3, 3] *= 1.02
    longer = Trajectory(estimate.stamps_ns, poses)
    figures = evaluate(longer, truth)
    theirs, reference = (
        PoseTrajectory3D(poses_se3=list(each.nav_T_body), timestamps=1e-9 * each.stamps_ns) for each in (longer, truth)
    )
    _, _, scale = theirs.align(reference, correct_scale=True)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, theirs))
    assert figures.ate_scaled_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
    assert figures.scale_error_percent == pytest.approx(100.0 * (1.0 / scale - 1.0), rel=1e-6)


def test_wrong_scale_alone_leaves_no_ate_with_scale() -> None:
    truth = walk()
    poses = truth.nav_T_body.copy()
    poses[:, :3, 3] *= 0.97
    figures = evaluate(Trajectory(truth.stamps_ns, poses).transformed(ELSEWHERE), truth)
    assert figures.scale_error_percent == pytest.approx(-3.0)
    assert figures.ate_scaled_m == pytest.approx(0.0, abs=1e-9)
    assert figures.ate_position_m.rmse > 0.1


def test_loop_closure_error_is_in_metres_and_percent() -> None:
    truth = walk(turns=1.0)
    poses = truth.nav_T_body.copy()
    poses[:, :3, 3] += np.linspace(0.0, 1.0, len(poses))[:, None] * [0.3, 0.0, 0.4]
    figures = evaluate(Trajectory(truth.stamps_ns, poses), truth)
    assert figures.loop_closure is not None
    assert figures.loop_closure.error_m == pytest.approx(0.5, rel=1e-3)
    assert figures.loop_closure.error_percent == pytest.approx(50.0 / figures.path_length_m, rel=1e-3)


def test_evaluate_at_standstill_has_no_percentage() -> None:
    figures = evaluate(straight(100, np.zeros(3)).transformed(ELSEWHERE), straight(100, np.zeros(3)))
    assert figures.ate_percent is None
    assert figures.drift_percent is None
    assert figures.scale_error_percent is None
    assert figures.loop_closure is None
    assert figures.ate_rotation_deg.max < 1e-6
    assert list(figures.rpe) == ["1 s"]


def test_evaluate_interpolates_truth_and_leaves_out_gaps() -> None:
    truth, estimate = walk(), walk()
    late = Trajectory(estimate.stamps_ns[:-1] + 25_000_000, 0.5 * (estimate.nav_T_body[:-1] + estimate.nav_T_body[1:]))
    kept = np.ones(len(truth), dtype=bool)
    kept[500:600] = False
    figures = evaluate(late, truth.select(kept))
    assert figures.associated == figures.estimates - 101
    assert figures.ate_position_m.max < 1e-6


@pytest.mark.parametrize("shift_s", [0, 4000])
def test_evaluate_too_few_associated_raises(shift_s: int) -> None:
    truth = walk(100)
    few = Trajectory(truth.stamps_ns + shift_s * 10**9, truth.nav_T_body).select(slice(0, 2 if shift_s == 0 else 50))
    with pytest.raises(TrajectoryError, match="at least 3 are needed") as caught:
        evaluate(few, truth)
    assert "\n" not in str(caught.value)


def test_as_dict_is_valid_json() -> None:
    import json

    figures = json.loads(json.dumps(evaluate(walk(drift_m=0.01), walk()).as_dict(), allow_nan=False))
    assert figures["rpe"]["5 m"]["position_m"]["rmse"] > 0
    assert "aligned" not in figures
