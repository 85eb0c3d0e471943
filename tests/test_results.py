import csv
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphvio.errors import GraphvioError
from graphvio.geometry import se3, so3_exp
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import Event, EventKind
from graphvio.measurements.motion import PairReport
from graphvio.results import FinishedRun, PairMedians, ResultWriter, Summary
from graphvio.rig import Camera, Imu, Rig, StereoPair
from graphvio.rig_files import load_rig
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory, save_trajectory
from graphvio.version import __version__

START_NS = 1_403_636_579_763_555_584
STEP_NS = 50_000_000
COUNT = 60
LOST = range(30, 35)


def some_rig() -> Rig:
    def camera(name: str, y: float) -> Camera:
        body_T_cam = np.array([[0.0, 0, 1, 0], [-1, 0, 0, y], [0, -1, 0, 0], [0, 0, 0, 1]])
        return Camera(name, "radial-tangential", (64, 48), np.array([40.0, 40, 32, 24]), np.zeros(5), body_T_cam)

    front = StereoPair("front", camera("cam0", 0.05), camera("cam1", -0.05))
    return Rig((front, StereoPair("rear, low", camera("cam2", 0.25), camera("cam3", 0.15))), Imu(), "test")


def pose(k: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.asarray(se3(so3_exp(np.array([0.0, 0.0, 0.02 * k])), np.array([0.1 * k, np.sin(0.1 * k), 0.0])))


def reports(k: int) -> dict[int, PairReport]:
    """Both pairs, the rear one first: without images in every third frameset, and without a motion of its own."""
    nothing = np.zeros((0, 2)), np.zeros(0, dtype=bool)
    front = PairReport(
        50, k, *nothing, rms_px=0.2 + 0.01 * k if k else None, own_inliers=k + 1, own_rms_px=0.1 + 0.003 * k,
        rejected={"search": k, "epipolar": 1},
    )  # fmt: skip
    rear = {1: PairReport(7, 0, *nothing)}
    return {**(rear if k % 3 else {}), 0: front}


def estimates() -> list[Estimate]:
    return [
        Estimate(
            START_NS + k * STEP_NS,
            Status.LOST if k in LOST else Status.COASTING if 20 <= k < 30 else Status.TRACKING,
            None if k in LOST else pose(k),
            None if k in LOST else np.arange(36.0).reshape(6, 6) + np.arange(36.0).reshape(6, 6).T,
            epoch=int(k >= LOST.stop),
            gyro_bias=np.array([0.001, 0.002, 0.003]),
            accel_bias=np.array([0.1, 0.2, 0.3]),
            gravity_nav=np.array([0.1, 0.2, -9.8]),
            tilt_covariance=np.diag([0.02, 0.01]) ** 2,
            pairs=reports(k),
            stage_ms={"track": float(k), "solve": 2.0},
        )
        for k in range(COUNT)
    ]


def written(truth: Trajectory, folder: Path) -> Path:
    path = folder.with_name(f"{folder.name}-truth.txt")
    save_trajectory(truth, path)
    return path


def finish(writer: ResultWriter, truth: Trajectory | None = None, framesets: int = COUNT) -> Summary:
    run = FinishedRun(
        wall_s=1.5,
        frameset_ms=[1.0, 2.0, 3.0],
        smoothed=[(START_NS, pose(0)), (START_NS + STEP_NS, pose(1))],
        input_faults={"imu_gap": 2},
        framesets=framesets,
        awaited=COUNT - 5,
        resets=1,
    )
    return writer.finish(run, None if truth is None else written(truth, writer.folder))


def write_all(folder: Path, truth: Trajectory | None = None) -> Summary:
    with ResultWriter(folder, some_rig(), "profile: balanced\n") as writer:
        for estimate in estimates():
            writer.add(estimate)
        writer.add_event(Event(START_NS, EventKind.VISION_GATED, "front: 3 of 40 points, «far off»"))
        writer.add_event(Event(START_NS + 1, EventKind.NEW_EPOCH, "lost"))
        return finish(writer, truth)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("results") / "walk-1"
    truth = Trajectory(START_NS + STEP_NS * np.arange(COUNT), np.array([pose(k) for k in range(COUNT)]))
    write_all(folder, truth)
    return folder


def test_writer_writes_all_files(folder: Path) -> None:
    assert sorted(file.name for file in folder.iterdir()) == [
        "calibration.csv",
        "config.yaml",
        "covariance.csv",
        "events.jsonl",
        "gravity.csv",
        "imu_bias.csv",
        "pairs.csv",
        "rig.yaml",
        "summary.json",
        "trajectory.png",
        "trajectory.txt",
        "trajectory_smoothed.txt",
    ]
    assert (folder / "config.yaml").read_text() == "profile: balanced\n"
    assert load_rig(folder / "rig.yaml").pairs[0].baseline_m == pytest.approx(0.1)


def test_trajectory_has_one_line_per_pose(folder: Path) -> None:
    lines = (folder / "trajectory.txt").read_text().splitlines()
    assert len(lines) == COUNT - len(LOST)
    assert lines[1].startswith("1403636579.813555584 0.100000000 ")
    read = load_trajectory(folder / "trajectory.txt")
    np.testing.assert_allclose(read.nav_T_body[20], pose(20), atol=1e-8)
    assert len(load_trajectory(folder / "trajectory_smoothed.txt")) == 2


def test_covariance_is_upper_triangle_by_rows(folder: Path) -> None:
    lines = (folder / "covariance.csv").read_text().splitlines()
    header = lines[0].split(",")
    assert len(header) == 22
    first = dict(zip(header, lines[1].split(","), strict=True))
    assert first["stamp_ns"] == str(START_NS)
    assert float(first["rx_tz"]) == 5 + 30  # entry (0, 5) of the matrix above
    assert float(first["ty_ty"]) == 2 * 28
    assert len(lines) == 1 + COUNT - len(LOST)


def test_biases_and_events_are_written(folder: Path) -> None:
    bias = np.loadtxt(folder / "imu_bias.csv", delimiter=",", skiprows=1)
    assert bias.shape == (COUNT, 7)
    np.testing.assert_allclose(bias[0, 1:], [0.001, 0.002, 0.003, 0.1, 0.2, 0.3])
    gravity = np.loadtxt(folder / "gravity.csv", delimiter=",", skiprows=1)
    assert gravity.shape == (COUNT, 5)
    np.testing.assert_allclose(gravity[0, 1:], [0.1, 0.2, -9.8, 0.02])
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    assert events[0] == {
        "stamp_ns": START_NS,
        "kind": "vision_gated",
        "detail": "front: 3 of 40 points, «far off»",
    }
    assert len(events) == 2


def test_pairs_have_one_line_per_report_with_or_without_pose(folder: Path) -> None:
    text = (folder / "pairs.csv").read_text()
    header, *rows = csv.reader(text.splitlines())
    assert header == ["stamp_ns", "pair", "points", "inliers", "rms_px", "own_inliers", "own_rms_px"]
    expected = [
        (START_NS + k * STEP_NS, name, report)
        for k in range(COUNT)
        for index, name in enumerate(["front", "rear, low"])
        if (report := reports(k).get(index)) is not None
    ]
    assert [(int(row[0]), row[1]) for row in rows] == [(stamp, name) for stamp, name, _ in expected]
    for row, (_, _, report) in zip(rows, expected, strict=True):
        expected_fields = [report.points, report.inliers, report.rms_px, report.own_inliers, report.own_rms_px]
        assert [float(field) if field else None for field in row[2:]] == pytest.approx(expected_fields, abs=1e-9)
    lines = text.splitlines()
    assert lines[1] == f"{START_NS},front,50,0,,1,1.000000000e-01"
    assert lines[3] == f'{START_NS + STEP_NS},"rear, low",7,0,,,'


def test_pair_medians_ignore_missing_values(folder: Path) -> None:
    medians = json.loads((folder / "summary.json").read_text())["pair_medians"]
    assert medians == {
        "front": {"inliers": 29.5, "rms_px": 0.5, "own_rms_px": 0.1885},
        "rear, low": {"inliers": 0.0, "rms_px": None, "own_rms_px": None},
    }


def test_pair_rejected_counts_by_test(folder: Path) -> None:
    rejected = json.loads((folder / "summary.json").read_text())["pair_rejected"]
    assert rejected == {"front": {"epipolar": COUNT, "search": COUNT * (COUNT - 1) // 2}, "rear, low": {}}


def test_summary_with_infinite_residual_has_null(tmp_path: Path) -> None:
    behind = PairReport(1, 1, np.zeros((1, 2)), np.ones(1, dtype=bool), rms_px=np.inf)
    with ResultWriter(tmp_path / "behind", some_rig(), "") as writer:
        writer.add(Estimate(START_NS, Status.LOST, None, None, pairs={0: behind}))
        summary = finish(writer)
    assert summary.pair_medians["front"] == PairMedians(1.0, None, None)
    assert json.loads((tmp_path / "behind" / "summary.json").read_text())["pair_medians"]["front"]["rms_px"] is None


def test_summary_has_figures_of_run(folder: Path) -> None:
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["framesets"] == COUNT
    assert summary["estimated"] == COUNT - len(LOST)
    assert summary["completion"] == 1.0
    assert summary["duration_s"] == pytest.approx(59 * 0.05)
    assert summary["realtime_factor"] == pytest.approx(59 * 0.05 / 1.5)
    assert summary["stage_ms"]["track"] == {"median": 29.5, "p95": 56.05, "p99": 58.41}
    assert summary["frameset_ms"]["median"] == 2.0
    assert summary["input_faults"] == {"imu_gap": 2}
    assert summary["events"] == {"vision_gated": 1, "new_epoch": 1}
    assert summary["status"] == {"tracking": 45, "coasting": 10, "lost": 5}
    assert [epoch["poses"] for epoch in summary["epochs"]] == [30, 25]
    assert summary["graphvio_version"] == __version__
    assert summary["config_sha256"] == hashlib.sha256(b"profile: balanced\n").hexdigest()
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 1e-9


def test_path_length_leaves_out_step_between_epochs(folder: Path) -> None:
    positions = np.array([pose(k)[:3, 3] for k in range(COUNT)])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    expected = steps.sum() - steps[LOST.start - 1 : LOST.stop].sum()
    assert json.loads((folder / "summary.json").read_text())["path_length_m"] == pytest.approx(expected)


def test_writer_with_equal_input_writes_equal_bytes(folder: Path, tmp_path: Path) -> None:
    write_all(tmp_path / "again")
    for name in (
        "trajectory.txt", "trajectory_smoothed.txt", "covariance.csv", "imu_bias.csv", "gravity.csv", "pairs.csv",
        "events.jsonl",
    ):  # fmt: skip
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name


def test_new_folder_is_numbered_and_never_overwritten(folder: Path, tmp_path: Path) -> None:
    assert [ResultWriter.new_folder(tmp_path / "r", "walk").name for _ in range(3)] == ["walk-1", "walk-2", "walk-3"]
    before = (folder / "trajectory.txt").read_bytes()
    with pytest.raises(GraphvioError, match="is not empty"):
        ResultWriter(folder, some_rig(), "")
    assert (folder / "trajectory.txt").read_bytes() == before


def test_writer_of_interrupted_run_leaves_lines(tmp_path: Path) -> None:
    writer = ResultWriter(tmp_path / "broken", some_rig(), "")
    for estimate in estimates()[:7]:
        writer.add(estimate)
    assert len((tmp_path / "broken" / "trajectory.txt").read_text().splitlines()) == 7  # not closed yet
    writer.close()
    assert not (tmp_path / "broken" / "summary.json").exists()


def test_finish_without_pose_writes_summary(tmp_path: Path) -> None:
    truth = Trajectory(START_NS + STEP_NS * np.arange(COUNT), np.array([pose(k) for k in range(COUNT)]))
    with ResultWriter(tmp_path / "none", some_rig(), "") as writer:
        summary = finish(writer, truth, framesets=0)
    assert summary.estimated == 0
    assert summary.completion == 0.0
    assert summary.path_length_m == 0.0
    assert summary.pair_medians["front"] == PairMedians(None, None, None)
    assert summary.evaluation is None
    assert summary.evaluation_error is not None
    assert "0 poses" in summary.evaluation_error
    assert (tmp_path / "none" / "trajectory.png").stat().st_size > 0


def test_writer_with_unusable_folder_raises(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(GraphvioError, match="cannot be written"):
        ResultWriter(tmp_path / "file" / "x", some_rig(), "")
    with pytest.raises(GraphvioError, match="cannot be written"):
        ResultWriter.new_folder(tmp_path / "file", "x")
