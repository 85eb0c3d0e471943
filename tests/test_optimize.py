"""``graphvio optimize`` on rendered images: files, interruption, several sessions, real data."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_walks import recorded, walk_simulator, with_wrong_place
from real_clip import CLIP, half_size_clip
from rendered import copy_part
from typer.testing import CliRunner, Result
from undrawn import undrawn

from graphvio import Odometry, open_source
from graphvio.arrays import Float
from graphvio.cli import app
from graphvio.config import Config
from graphvio.errors import MissingExtraError, OptimizationError
from graphvio.evaluation import evaluate
from graphvio.geometry import se3, se3_inverse, se3_log, so3_exp
from graphvio.measurements.sensors import ImuSample
from graphvio.monocular import sample_buffer
from graphvio.optimization.loops.closures import load_closures
from graphvio.optimization.loops.database import FeatureDatabase
from graphvio.optimization.optimize import optimize
from graphvio.optimization.pipeline import DATABASE, Session, Stages, optimize_sessions
from graphvio.optimization.record import Recorder, SessionRecord
from graphvio.rig_files import load_rig, save_rig
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

pycolmap: Any = pytest.importorskip("pycolmap", reason="loop closure needs the extra maps")
SECONDS = 7.0
ONCE_AND_AGAIN_S = 5.5  # of the walk, in which it comes by its first places again
SETTINGS = "optimization: {loop_interval_s: 3.0, place_distance_m: 0.2, features: 500}\n"
ALWAYS_EQUAL = (
    "trajectory_optimized.txt",
    "covariance.csv",
    "points.ply",
    "plan.png",
    "graph.g2o",
    "loops.npz",
    "walk/record.npz",
)


def to_and_fro(t: Float) -> Float:
    """A motion that returns to the same pose every four seconds."""
    swing, zero = 0.5 * np.pi * t, np.zeros_like(t)
    return np.column_stack(
        [0.7 * np.sin(swing), 0.5 * np.cos(swing), 1.45 + zero, 0.3 * np.sin(swing), zero, 0.05 * np.cos(2.0 * swing)]
    )


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("optimize") / "walk", SECONDS, to_and_fro)


@pytest.fixture(scope="module")
def short_walk(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first part, for runs that close loops."""
    folder = tmp_path_factory.mktemp("short") / "walk"
    copy_part(walk, folder, ONCE_AND_AGAIN_S)
    return folder


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("settings") / "settings.yaml"
    file.write_text(SETTINGS)
    return file


@pytest.fixture(scope="module")
def done(short_walk: Path, settings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of an uninterrupted run."""
    out = tmp_path_factory.mktemp("results") / "walk"
    finished = command(short_walk, "--config", settings, "--out", out)
    assert finished.exit_code == 0, finished.output
    return out


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["optimize", *map(str, arguments)], env={"COLUMNS": "160"})


def test_optimize_rendered_walk_improves_on_online(done: Path) -> None:
    summary = json.loads((done / "summary.json").read_text())
    (session,) = summary["sessions"]
    errors = {name: each["position_m"] for name, each in session["ate_rmse"].items()}
    assert errors["optimized"] < 0.9 * errors["online"]
    assert errors["optimized"] < 0.0004
    assert summary["loops"]["used"] >= 5
    assert summary["cost"]["after"] < summary["cost"]["before"]
    for name in (*ALWAYS_EQUAL, "report.html", "plan.png", "points.ply", "database.db", "colmap/sparse/0/points3D.bin"):
        assert (done / name).stat().st_size > 100, name
    trajectory = load_trajectory(done / "trajectory_optimized.txt")
    assert len(trajectory) == session["framesets"]


@pytest.fixture(scope="module")
def of_one_camera(short_walk: Path, settings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the same walk by one camera and the IMU."""
    out = tmp_path_factory.mktemp("one-camera") / "walk"
    with undrawn():
        finished = command(short_walk, "--cameras", "0", "--no-pairs", "--config", settings, "--out", out)
    assert finished.exit_code == 0, finished.output
    return out


def test_optimize_one_camera_improves_on_online(of_one_camera: Path) -> None:
    summary = json.loads((of_one_camera / "summary.json").read_text())
    (session,) = summary["sessions"]
    errors = {name: each["position_m"] for name, each in session["ate_rmse"].items()}
    assert errors["optimized"] < 0.5 * min(errors["online"], errors["smoothed"])
    assert errors["optimized"] < 0.003
    assert summary["loops"]["used"] >= 5
    assert summary["loops"]["refused"] == 0
    assert summary["loops"]["error_of_used"]["optimized"]["rmse_m"] < 0.008
    assert session["framesets"] == len(load_trajectory(of_one_camera / "trajectory_optimized.txt"))


@pytest.mark.usefixtures("without_plots")
def test_fleet_one_camera_equals_optimize(
    of_one_camera: Path, short_walk: Path, settings: Path, tmp_path: Path
) -> None:
    listed, out = tmp_path / "list.txt", tmp_path / "out"
    listed.write_text(f"{short_walk}\n")
    arguments = [listed, "--cameras", "0", "--no-pairs", "--config", settings, "--workers", "1", "--out", out]
    finished = CliRunner().invoke(app, ["fleet", "optimize", *map(str, arguments)])
    assert finished.exit_code == 0, finished.output
    for name in ("trajectory_optimized.txt", "covariance.csv", "graph.g2o", "loops.npz"):
        assert (out / "walk" / name).read_bytes() == (of_one_camera / name).read_bytes(), name


@pytest.mark.parametrize("with_loops", [False, True])
def test_optimize_one_camera_is_consistent(of_one_camera: Path, short_walk: Path, with_loops: bool) -> None:
    """Where position and heading are those of the first state."""
    source, record = open_source(short_walk), SessionRecord.load(of_one_camera / "walk/record.npz")
    closures = load_closures(of_one_camera / "loops.npz") if with_loops else []
    (session,) = optimize([record], [source.rig.imu], closures, Config()).sessions
    assert source.truth is not None
    known, is_known = load_trajectory(source.truth).at(session.nodes.stamps_ns, 0.1)
    assert is_known.all()
    truth = known.nav_T_body
    poses = session.nav_T_body[session.nodes.rows]
    turn = poses[0, :3, :3] @ truth[0, :3, :3].T
    heading = np.arctan2(turn[1, 0], turn[0, 0])
    nav_T_world = se3(so3_exp(np.array([0.0, 0.0, heading])), np.zeros(3))
    nav_T_world[:3, 3] = poses[0, :3, 3] - nav_T_world[:3, :3] @ truth[0, :3, 3]
    squares = []
    for pose, true, covariance in zip(poses[1:], truth[1:], session.covariance[1:], strict=True):
        error = se3_log(np.ascontiguousarray(se3_inverse(pose) @ nav_T_world @ true))
        squares.append(error @ np.linalg.solve(covariance, error))
    assert np.mean(squares) < 9.0


def test_optimize_epochs_of_single_cameras(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the IMU was silent, the scale has to be found again; each epoch has a frame of its own."""
    monkeypatch.setattr(sample_buffer, "_MAX_BRIDGED_NS", 200_000_000)  # so that half a second is long
    rig = open_source(walk).rig.with_only(["cam0", "cam2"]).without_pairs()
    source, odometry, recorder = open_source(walk, rig), Odometry(rig, Config()), Recorder("walk")
    odometry.subscribe(recorder.add)
    odometry.on_views(recorder.add_views)
    gap_ns = source.start_ns + 3_000_000_000, source.start_ns + 3_500_000_000
    for measurement in source:
        if not (isinstance(measurement, ImuSample) and gap_ns[0] < measurement.stamp_ns < gap_ns[1]):
            odometry.process(measurement)
            recorder.add_smoothed(odometry.take_smoothed())
    odometry.finish()
    recorder.add_smoothed(odometry.take_smoothed())
    record = recorder.record()
    found = optimize([record], [rig.imu], [], Config())
    assert [each.epoch for each in found.fragments] == [0, 1]
    assert list(found.frames) == [0, 1]
    assert len(record.first_windows.begins) == 3
    assert source.truth is not None
    truth, _ = load_trajectory(source.truth).at(record.stamps_ns, 0.1)
    for epoch in (0, 1):
        rows = np.flatnonzero(record.epoch == epoch)
        assert len(rows) > 30
        moved, true = found.sessions[0].nav_T_body[rows], truth.nav_T_body[rows]
        error = evaluate(Trajectory(record.stamps_ns[rows], moved), Trajectory(record.stamps_ns[rows], true))
        assert error.ate_position_m.rmse < 0.006


def test_optimize_one_camera_writes_points_on_true_surfaces(of_one_camera: Path, walk: Path) -> None:
    model = pycolmap.Reconstruction(of_one_camera / "colmap/sparse/0")
    assert {image.name.split("/")[1] for image in model.images.values()} == {"cam0"}
    assert model.num_rigs() == model.num_cameras() == 1
    simulator = walk_simulator(SECONDS, to_and_fro)
    row_of = {int(stamp): row for row, stamp in enumerate(simulator.stamps_ns)}
    errors = []
    for name in sorted(image.name for image in model.images.values())[::4]:
        image = model.find_image_with_name(name)
        depth, cam_T_world = simulator.view(row_of[int(Path(name).stem)], 0).depth, image.cam_from_world()
        for each in image.points2D:
            if each.has_point3D():
                u, v = np.round(each.xy - 0.5).astype(int)
                errors.append((cam_T_world * model.point3D(each.point3D_id).xyz)[2] / depth[v, u] - 1.0)
    assert len(errors) > 300
    assert np.median(np.abs(errors)) < 0.02
    assert np.mean(np.abs(errors) > 0.1) < 0.05


@pytest.mark.usefixtures("without_plots")
def test_optimize_killed_run_continues_to_equal_results(
    short_walk: Path, settings: Path, done: Path, tmp_path: Path
) -> None:
    out = tmp_path / "walk"
    line = [sys.executable, "-c", "from graphvio.cli import main; main()", "optimize", short_walk, "--config", settings]
    line += ["--out", out]
    process = subprocess.Popen([str(part) for part in line], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120.0
    while not (out / "walk/features-ahead.db").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    finished = json.loads((out / "stages.json").read_text())["finished"]
    assert not finished  # features are extracted while the odometry runs
    assert command(short_walk, "--config", settings, "--out", out).exit_code == 0
    for name in ALWAYS_EQUAL:
        assert (out / name).read_bytes() == (done / name).read_bytes(), name
    assert not (out / "walk/features-ahead.db").exists()


def test_record_with_features_extracts_first_places(walk: Path, settings: Path, tmp_path: Path) -> None:
    source, config = open_source(walk, to_s=3.0), Config.load(settings)
    stages = Stages([Session("walk", source)], tmp_path / "out", config)
    record = stages.record(0, with_features=True)
    ahead = tmp_path / "out/walk/features-ahead.db"
    with FeatureDatabase(ahead) as database:
        stored = {int(Path(name).stem) for name in database.names}
    chosen = [place.stamp_ns for place in stages.places(0, record).places]
    assert 0 < len(stored) <= len(chosen)
    assert stored == set(chosen[: len(stored)])
    assert not (tmp_path / "out" / DATABASE).exists()  # to which sessions are added one after the other
    stages.features(0, record)
    assert not ahead.exists()
    with FeatureDatabase(tmp_path / "out" / DATABASE) as database:
        assert [int(Path(name).stem) for name in list(database._ids)[:: len(source.rig.cameras)]] == chosen


def test_optimize_foreign_folder_is_refused_and_unchanged(
    short_walk: Path, settings: Path, done: Path, tmp_path: Path
) -> None:
    before = {path: path.read_bytes() for path in done.rglob("*.txt")}
    refused = command(short_walk, "--out", done)
    assert isinstance(refused.exception, OptimizationError)
    assert "holds results of other input (different: config)" in str(refused.exception)
    assert {path: path.read_bytes() for path in done.rglob("*.txt")} == before
    (tmp_path / "mine.txt").write_text("mine")
    refused = command(short_walk, "--config", settings, "--out", tmp_path)
    assert isinstance(refused.exception, OptimizationError)
    assert "is not empty" in str(refused.exception)


@pytest.mark.usefixtures("without_plots")
def test_optimize_missing_files_are_written_again(done: Path, short_walk: Path, settings: Path, tmp_path: Path) -> None:
    out = tmp_path / "walk"
    shutil.copytree(done, out)
    for name in ("database.db", "walk/record.npz", "graph.g2o"):
        (out / name).unlink()
    shutil.rmtree(out / "colmap")
    assert command(short_walk, "--config", settings, "--out", out).exit_code == 0
    for name in (*ALWAYS_EQUAL, "colmap/sparse/0/points3D.bin", "summary.json"):
        assert (out / name).read_bytes() == (done / name).read_bytes(), name


def test_optimize_exact_file_runs_the_odometry_once(done: Path) -> None:
    assert Config.load(done / "walk/odometry/config.yaml").calibration.online
    finished = json.loads((done / "stages.json").read_text())["finished"]
    assert list(finished)[:3] == ["odometry of walk", "calibration of walk", "features of walk"]


def test_calibrate_wrong_file_keeps_nothing_measured_with_it(walk: Path, tmp_path: Path) -> None:
    wrong = draw(open_source(walk).rig, CalibrationErrorSizes.of_level(3, ["left-right-rotation"]), seed=1).written_rig
    out = tmp_path / "out"
    stages = Stages([Session("walk", open_source(walk, wrong, to_s=4.0))], out, Config())
    stages.calibrate(0, with_features=True)
    assert list(json.loads((out / "stages.json").read_text())["finished"]) == ["calibration of walk"]
    assert not (out / DATABASE).exists()
    assert not (out / "walk/features-ahead.db").exists()
    stages.record(0)
    assert not Config.load(out / "walk/odometry/config.yaml").calibration.online
    used, refined = (load_rig(out / "walk" / name).pairs[0].right_T_left for name in ("odometry", "rig-refined.yaml"))
    np.testing.assert_allclose(used, refined, atol=1e-9)
    assert np.abs(used - wrong.pairs[0].right_T_left).max() > 1e-4
    (out / "walk/calibration.json").unlink()
    stages = Stages([Session("walk", open_source(walk, wrong, to_s=4.0))], out, Config())
    stages.calibrate(0)  # writes over what the second pass has left
    assert list(json.loads((out / "stages.json").read_text())["finished"]) == ["calibration of walk"]


def test_optimize_exact_file_stays(short_walk: Path, done: Path) -> None:
    used, of_file = load_rig(done / "walk/odometry/rig.yaml"), open_source(short_walk).rig
    np.testing.assert_allclose(used.left2_T_left1(), of_file.left2_T_left1(), atol=1e-12)
    (found,) = json.loads((done / "summary.json").read_text())["sessions"][0]["calibration"]
    assert found.startswith("calibration: as in the rig file")


@pytest.mark.usefixtures("without_plots")
def test_optimize_wrong_file_is_calibrated_first(walk: Path, tmp_path: Path) -> None:
    wrong = draw(open_source(walk).rig, CalibrationErrorSizes.of_level(3, ["left-right-rotation"]), seed=1).written_rig
    save_rig(wrong, tmp_path / "wrong.yaml")
    (tmp_path / "as_it_is.yaml").write_text("calibration: {online: false}")
    errors = {}
    for config in ("default", tmp_path / "as_it_is.yaml"):
        out = tmp_path / Path(config).stem
        done = command(
            walk, "--rig", tmp_path / "wrong.yaml", "--no-loops", "--to", 4, "--config", config, "--out", out
        )
        assert done.exit_code == 0, done.output
        assert ("walk: calibration corrected: " in done.stdout) == (config == "default")
        (session,) = json.loads((out / "summary.json").read_text())["sessions"]
        errors[out.name] = session["ate_rmse"]["optimized"]["position_m"]
    assert errors["default"] < 0.3 * errors["as_it_is"]


@pytest.mark.usefixtures("without_plots")
def test_optimize_refined_calibration_is_used_for_map(walk: Path, settings: Path, tmp_path: Path) -> None:
    rig = open_source(walk).rig
    save_rig(with_wrong_place(rig, 1.0, 0.03), tmp_path / "wrong.yaml")
    out = tmp_path / "walk"
    refined = command(
        walk, "--config", settings, "--rig", tmp_path / "wrong.yaml", "--refine-calibration", "--out", out
    )
    assert refined.exit_code == 0, refined.output
    first = load_rig(out / "walk" / "rig-refined.yaml")
    error = se3_log(se3_inverse(rig.left2_T_left1()) @ first.left2_T_left1())
    sigma_deg = first.calibration_sigmas.pair_rotation_deg
    assert sigma_deg < 0.25 * rig.calibration_sigmas.pair_rotation_deg
    assert np.rad2deg(np.linalg.norm(error[:3])) < 3.4 * sigma_deg  # 99 % of three components
    used = load_rig(out / "walk" / "odometry" / "rig.yaml")
    np.testing.assert_allclose(used.left2_T_left1(), first.left2_T_left1(), atol=1e-12)
    found = load_rig(out / "walk" / "rig_optimized.yaml")
    error = se3_log(se3_inverse(rig.left2_T_left1()) @ found.left2_T_left1())
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.2
    assert np.linalg.norm(error[3:]) < 0.5 * 0.03
    model = pycolmap.Reconstruction(out / "colmap" / "sparse" / "0")
    (other,) = [each for each in model.rigs[1].non_ref_sensors.values() if abs(each.rotation.angle()) > 1.0][:1]
    expected = found.pairs[1].left.cam_T_body @ found.pairs[0].left.body_T_cam
    np.testing.assert_allclose(other.matrix(), expected[:3], atol=1e-6)


@pytest.mark.usefixtures("without_plots")
def test_optimize_sessions_overlapping_recordings_share_frame(short_walk: Path, tmp_path: Path) -> None:
    """Two parts of one recording that overlap by a second."""
    sources = [open_source(short_walk, from_s=0.0, to_s=3.5), open_source(short_walk, from_s=2.5)]
    config = Config.from_yaml(SETTINGS + "calibration: {online: false}\n")  # other tests calibrate first
    found = optimize_sessions(sources, tmp_path / "both", config)
    assert found.frames == [0, 0]
    first, second = (Trajectory(each.record.stamps_ns, each.nav_T_body) for each in found.sessions)
    common = np.intersect1d(first.stamps_ns, second.stamps_ns)
    assert len(common) == 21
    for stamp in common:
        one, other = (each.nav_T_body[np.searchsorted(each.stamps_ns, stamp)] for each in (first, second))
        assert np.linalg.norm(se3_log(se3_inverse(one) @ other)) < 0.005
    for name in ("walk", "walk-2"):
        assert (tmp_path / "both" / name / "trajectory_optimized.txt").exists()


@pytest.mark.usefixtures("without_plots")
def test_optimize_without_loops_needs_no_extra(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert command(walk, "--to", "3", "--no-loops", "--out", tmp_path / "walk").exit_code == 0
    assert not (tmp_path / "walk" / "database.db").exists()
    refused = command(walk, "--to", "3", "--out", tmp_path / "other")
    assert isinstance(refused.exception, MissingExtraError)
    assert "graphvio[maps]" in str(refused.exception)
    assert not (tmp_path / "other").exists()


def test_optimize_a_lens_that_loop_closure_does_not_know_is_refused_before_anything_is_done(
    walk: Path, tmp_path: Path
) -> None:
    rig = load_rig(walk).with_cameras(
        lambda camera: replace(camera, model="double-sphere", distortion=np.array([-0.2, 0.6]))
    )
    save_rig(rig, tmp_path / "rig.yaml")
    refused = command(walk, "--to", "3", "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "other")
    assert isinstance(refused.exception, OptimizationError)
    assert "--no-loops" in str(refused.exception)
    assert not (tmp_path / "other").exists()


@pytest.mark.skipif(not CLIP.is_dir(), reason="shared/data/euroc_mh01_clip is absent")
@pytest.mark.usefixtures("without_plots")
def test_optimize_real_recording_improves_on_online(tmp_path: Path) -> None:
    """With the files as they are, and no less where they are calibrated first."""
    (tmp_path / "as_it_is.yaml").write_text("calibration: {online: false}")
    errors = {}
    for config in ("default", tmp_path / "as_it_is.yaml"):
        out = tmp_path / Path(config).stem
        done = command(half_size_clip(), "--config", config, "--out", out)
        assert done.exit_code == 0, done.output
        (session,) = json.loads((out / "summary.json").read_text())["sessions"]
        errors[out.name] = {name: each["position_m"] for name, each in session["ate_rmse"].items()}
    for each in errors.values():
        assert each["optimized"] < 0.98 * each["online"]
        assert each["optimized"] < 0.0045  # the truth is no better than some 4 mm
