"""``graphvio run`` on simulated and real recordings."""

import json
import os
import re
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import undrawn_run
from command_line import Ran, graphvio, python_alone
from real_clip import CLIP, real_clip
from undrawn import undrawn

from graphvio import FrameSet, load_rig, open_source
from graphvio.trajectory_files import load_trajectory

needs_clip = pytest.mark.skipif(not CLIP.is_dir(), reason=f"the real recording {CLIP.name} is not next to the project")


def run(
    source: Path, out: Path, *options: object, command: Callable[..., Ran] = graphvio, plots: bool = False
) -> dict[str, Any]:
    """Run, expect success, and return the summary."""
    with nullcontext() if plots else undrawn():
        done = command("run", source, "--out", out, *options)
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


def refused(done: Ran) -> str:
    """The one line of an error in the input, exit code 2."""
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("graphvio: ")]
    assert len(lines) == 1, done.stderr
    return lines[0]


def copy_of(recording: Path, out: Path) -> Path:
    """A copy whose csv files may be changed; images are linked."""
    shutil.copytree(
        recording, out, copy_function=lambda a, b: os.link(a, b) if a.endswith(".png") else shutil.copy(a, b)
    )
    return out


def change_lines(path: Path, change: Any) -> None:
    header, *lines = path.read_text().splitlines()
    path.write_text("\n".join([header, *change(lines)]) + "\n")


# ---------------------------------------------------------------- real data


@needs_clip
@pytest.mark.parametrize(("options", "max_ate_m"), [((), 0.0055), (("--no-imu",), 0.006)], ids=["imu", "no-imu"])
def test_run_real_clip_started_in_motion_is_accurate(
    tmp_path: Path, options: tuple[str, ...], max_ate_m: float
) -> None:
    summary = run(real_clip(), tmp_path / "out", *options)
    assert summary["framesets"] == summary["estimated"] == 340
    assert summary["completion"] == 1.0
    assert summary["input_faults"] == {"frame_gap": 1}
    assert summary["resets"] == 0
    assert summary["evaluation"]["ate_position_m"]["rmse"] < max_ate_m
    if not options:
        assert_gravity_and_gyro_bias_are_found(tmp_path / "out")


def assert_gravity_and_gyro_bias_are_found(out: Path) -> None:
    """At the end of the clip, by the file's truth."""
    path = CLIP / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    estimate, truth = load_trajectory(out / "trajectory.txt"), load_trajectory(path)
    (true,), known = truth.at(estimate.stamps_ns[-1:], 0.1)[0].nav_T_body, truth.at(estimate.stamps_ns[-1:], 0.1)[1]
    assert known.all()
    gravity = np.loadtxt(out / "gravity.csv", delimiter=",", skiprows=1)[-1, 1:4]
    up, true_up = -gravity @ estimate.nav_T_body[-1, :3, :3] / np.linalg.norm(gravity), true[2, :3]
    assert np.rad2deg(np.linalg.norm(np.cross(up, true_up))) < 0.3
    assert up @ true_up > 0.0
    columns = np.genfromtxt(path, delimiter=",", comments="#")
    true_bias = columns[np.argmin(np.abs(columns[:, 0] - estimate.stamps_ns[-1])), 11:14]
    *_, last = (out / "imu_bias.csv").read_text().splitlines()
    bias = np.array([float(value) for value in last.split(",")[1:4]])
    assert np.abs(bias - true_bias).max() < 2e-3


# ---------------------------------------------------------------- simulated data


def test_run_is_complete_accurate_and_repeatable(room_walk: Path, tmp_path: Path) -> None:
    summary = run(room_walk, tmp_path / "a", plots=True)
    run(room_walk, tmp_path / "b", command=partial(python_alone, Path(undrawn_run.__file__)))
    for name in ("trajectory.txt", "pairs.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    names = {path.name for path in (tmp_path / "a").iterdir()}
    assert names == {
        "trajectory.txt", "trajectory_smoothed.txt", "covariance.csv", "imu_bias.csv", "gravity.csv", "pairs.csv",
        "events.jsonl", "config.yaml", "rig.yaml", "summary.json", "trajectory.png",
        "calibration.csv", "calibration.png", "rig-refined.yaml",
    }  # fmt: skip
    assert load_rig(tmp_path / "a/rig-refined.yaml").pairs[0].name == load_rig(tmp_path / "a/rig.yaml").pairs[0].name
    for plot in ("trajectory.png", "calibration.png"):
        assert (tmp_path / "a" / plot).stat().st_size > 1000
    assert summary["completion"] == 1.0
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 0.01
    assert {"predict", "track", "stereo", "motion", "update"} <= set(summary["stage_ms"])
    assert set(summary["frameset_ms"]) == {"median", "p95", "p99"}
    assert summary["status"] == {"tracking": 100}
    assert (tmp_path / "a/pairs.csv").read_text().count("\n") == 1 + 2 * 100
    assert set(summary["pair_medians"]) == {pair.name for pair in open_source(room_walk).rig.pairs}
    for medians in summary["pair_medians"].values():
        assert medians["inliers"] > 50
        assert 0.0 < medians["own_rms_px"] <= 1.05 * medians["rms_px"] < 1.0


def test_run_of_vga_images_is_accurate(vga_walk: Path, tmp_path: Path) -> None:
    """The simulator's own rig; other recordings have images of half its size."""
    summary = run(vga_walk, tmp_path / "out")
    assert load_rig(tmp_path / "out/rig.yaml").cameras[0].size_px == (640, 480)
    assert summary["status"] == {"tracking": 100}
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 0.01


@pytest.mark.parametrize("pair", [0, 1])
def test_run_with_one_pair_is_accurate(room_walk: Path, tmp_path: Path, pair: int) -> None:
    summary = run(room_walk, tmp_path / "out", "--pairs", pair)
    assert summary["completion"] == 1.0
    (medians,) = summary["pair_medians"].values()
    assert medians["rms_px"] < 1.0
    assert medians["own_rms_px"] is None  # there is no motion of other pairs
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 0.03


def test_run_without_imu_with_paper_profile_is_accurate(room_walk: Path, tmp_path: Path) -> None:
    summary = run(room_walk, tmp_path / "out", "--no-imu", "--config", "paper")
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 0.03
    assert (tmp_path / "out/imu_bias.csv").read_text().count("\n") == 1  # the header alone


def test_run_from_to_uses_interval(room_walk: Path, tmp_path: Path) -> None:
    summary = run(room_walk, tmp_path / "out", "--from", 2, "--to", 4)
    assert summary["framesets"] == 41
    assert summary["completion"] == 1.0
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 0.03


def test_run_with_damaged_image_leaves_out_its_pair(room_walk: Path, tmp_path: Path) -> None:
    broken = copy_of(room_walk, tmp_path / "broken")
    image = sorted((broken / "mav0/cam1/data").iterdir())[50]
    whole = image.read_bytes()
    image.unlink()
    image.write_bytes(whole[: len(whole) // 2])
    summary = run(broken, tmp_path / "out")
    assert summary["input_faults"] == {"image_undecodable": 1}
    assert summary["completion"] == 1.0
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 0.01
    events = [json.loads(line) for line in (tmp_path / "out/events.jsonl").read_text().splitlines()]
    assert image.name in next(e["detail"] for e in events if e["kind"] == "image_undecodable")


def test_run_with_imu_gap_keeps_tracking(room_walk: Path, tmp_path: Path) -> None:
    gap = copy_of(room_walk, tmp_path / "gap")
    change_lines(gap / "mav0/imu0/data.csv", lambda lines: lines[:400] + lines[800:])
    summary = run(gap, tmp_path / "out")
    assert summary["input_faults"] == {"imu_gap": 1}
    assert summary["completion"] == 1.0
    assert summary["status"] == {"tracking": 100}
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 0.02


def test_run_with_backward_stamps_leaves_them_out(room_walk: Path, tmp_path: Path) -> None:
    def swap(lines: list[str]) -> list[str]:
        return [*lines[:40], lines[41], lines[40], *lines[42:]]

    backwards = copy_of(room_walk, tmp_path / "backwards")
    for name in ("cam0", "cam1", "cam2", "cam3", "imu0"):
        change_lines(backwards / "mav0" / name / "data.csv", swap)
    summary = run(backwards, tmp_path / "out")
    assert summary["framesets"] == 99
    assert summary["input_faults"]["frame_backward"] == 4
    assert summary["input_faults"]["imu_backward"] == 1
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 0.01
    stamps = np.loadtxt(tmp_path / "out/trajectory.txt")[:, 0]
    assert (np.diff(stamps) > 0).all()


def test_run_with_grey_images_exits_with_3(room_walk: Path, tmp_path: Path) -> None:
    blind = copy_of(room_walk, tmp_path / "blind")
    for cam in range(4):
        for image in sorted((blind / f"mav0/cam{cam}/data").iterdir())[40:]:
            image.unlink()
            image.write_bytes(_grey_png())
    shutil.rmtree(blind / "mav0/imu0")
    (blind / "rig.yaml").write_text(re.sub(r"(?ms)^imu:.*?(?=^\w)", "", (blind / "rig.yaml").read_text()))
    done = graphvio("run", blind, "--out", tmp_path / "out")
    assert done.returncode == 3, done.stderr
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert summary["completion"] < 0.9
    assert summary["events"]["lost"] == 1
    assert (tmp_path / "out/trajectory.png").stat().st_size > 1000


def _grey_png() -> bytes:
    return cv2.imencode(".png", np.full((240, 320), 128, dtype=np.uint8))[1].tobytes()


def test_run_with_unreadable_truth_has_no_evaluation(room_walk: Path, tmp_path: Path) -> None:
    spoilt = copy_of(room_walk, tmp_path / "spoilt")
    truth = spoilt / "mav0/state_groundtruth_estimate0/data.csv"
    truth.write_text(truth.read_text() + "no,pose,at,all\n")
    summary = run(spoilt, tmp_path / "out", "--to", 1)
    assert summary["evaluation"] is None
    assert "columns" in summary["evaluation_error"]
    assert (tmp_path / "out/trajectory_smoothed.txt").read_text().count("\n") == 21


def write_as_kitti(recording: Path, sequence: Path, frames: int) -> None:
    """The front pair's images, rectified, as a KITTI sequence with poses of the rectified left camera."""
    source = open_source(recording)
    pair = source.rig.pairs[0]
    intrinsics = [
        np.array([[c[0], 0, c[2]], [0, c[1], c[3]], [0, 0, 1]]) for c in (pair.left.intrinsics, pair.right.intrinsics)
    ]
    size, right_T_left = pair.left.size_px, pair.right_T_left
    rotations_and_projections = cv2.stereoRectify(
        intrinsics[0], pair.left.distortion, intrinsics[1], pair.right.distortion, size,
        right_T_left[:3, :3].copy(), right_T_left[:3, 3:].copy(), alpha=0,
    )  # fmt: skip
    rotations, projections = rotations_and_projections[:2], rotations_and_projections[2:4]
    maps = [
        cv2.initUndistortRectifyMap(intrinsics[k], camera.distortion, rotations[k], projections[k], size, cv2.CV_32FC1)
        for k, camera in enumerate((pair.left, pair.right))
    ]
    stamps: list[int] = []
    for frameset in (measurement for measurement in source if isinstance(measurement, FrameSet)):
        for k in range(2):
            image = sequence / f"image_{k}/{len(stamps):06d}.png"
            image.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(image), cv2.remap(frameset.images[0][k], *maps[k], cv2.INTER_CUBIC))
        stamps.append(frameset.stamp_ns)
        if len(stamps) == frames:
            break
    rows = [" ".join(map(str, projections[k % 2].ravel())) for k in range(4)]
    (sequence / "calib.txt").write_text("".join(f"P{k}: {row}\n" for k, row in enumerate(rows)))
    (sequence / "times.txt").write_text("".join(f"{(stamp - stamps[0]) * 1e-9:e}\n" for stamp in stamps))
    assert source.truth is not None
    bodies, _ = load_trajectory(source.truth).at(np.array(stamps), 0.1)
    body_T_cam = pair.left.body_T_cam.copy()
    body_T_cam[:3, :3] = body_T_cam[:3, :3] @ rotations[0].T
    poses = np.linalg.inv(bodies.nav_T_body[0] @ body_T_cam) @ bodies.nav_T_body @ body_T_cam
    truth = sequence.parents[1] / "poses" / f"{sequence.name}.txt"
    truth.parent.mkdir()
    truth.write_text("".join(" ".join(map(str, pose[:3].ravel())) + "\n" for pose in poses))


def test_run_kitti_sequence_is_accurate(room_walk: Path, tmp_path: Path) -> None:
    sequence = tmp_path / "sequences/07"
    write_as_kitti(room_walk, sequence, frames=80)
    summary = run(sequence, tmp_path / "out")
    assert summary["completion"] == 1.0
    assert summary["evaluation"]["associated"] == 80
    assert summary["evaluation"]["ate_position_m"]["rmse"] < 0.02


def test_run_saves_viewer_recording_in_results(room_walk: Path, tmp_path: Path) -> None:
    run(room_walk, tmp_path / "out", "--to", 0.5, "--save-rrd", tmp_path / "out/run.rrd")
    assert (tmp_path / "out/run.rrd").stat().st_size > 10_000


def test_run_that_cannot_start_leaves_no_folder(room_walk: Path, tmp_path: Path) -> None:
    other = copy_of(room_walk, tmp_path / "other")
    (other / "rig.yaml").write_text((other / "rig.yaml").read_text().replace("[320, 240]", "[752, 480]"))
    assert "image is 320x240, the rig says 752x480" in refused(graphvio("run", other, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- mistakes


def test_run_unusable_source_exits_with_2(tmp_path: Path) -> None:
    assert "does not exist" in refused(graphvio("run", tmp_path / "nowhere"))
    (tmp_path / "file").write_text("no folder")
    assert "is no recording that graphvio knows" in refused(graphvio("run", tmp_path / "file"))
    (tmp_path / "empty").mkdir()
    assert "is empty" in refused(graphvio("run", tmp_path / "empty"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").write_text("no recording")
    assert "known layouts" in refused(graphvio("run", tmp_path / "other"))


def test_run_invalid_options_exit_with_2(room_walk: Path, tmp_path: Path) -> None:
    (tmp_path / "typo.yaml").write_text("motion: {cauchy_scale: 2.0}")
    assert "did you mean 'cauchy_scale_px'" in refused(graphvio("run", room_walk, "--config", tmp_path / "typo.yaml"))
    assert "no pair 7" in refused(graphvio("run", room_walk, "--pairs", "0,7"))
    assert "give numbers" in refused(graphvio("run", room_walk, "--pairs", "front"))
    assert "give numbers" in refused(graphvio("run", room_walk, "--pairs", "", "--no-imu"))  # an unset variable
    assert "there is no camera ''" in refused(graphvio("run", room_walk, "--cameras", ""))
    (tmp_path / "full").mkdir()
    (tmp_path / "full/thesis.tex").write_text("do not overwrite")
    assert "not empty" in refused(graphvio("run", room_walk, "--out", tmp_path / "full", "--to", 0.2))


def test_usage_errors_are_one_line(tmp_path: Path) -> None:
    assert "Missing argument" in refused(graphvio("run"))
    assert "--from" in refused(graphvio("run", tmp_path, "--from", "soon"))
    assert "No such option" in refused(graphvio("run", tmp_path, "--nope"))
    assert "No such command" in refused(graphvio("walk"))
    assert graphvio("--help").returncode == 0


def test_run_verbose_shows_traceback(tmp_path: Path) -> None:
    done = graphvio("run", tmp_path / "nowhere", "--verbose")
    assert done.returncode != 0
    assert "Traceback" in done.stderr


@pytest.mark.usefixtures("without_plots")
def test_run_without_out_numbers_folders(room_walk: Path, tmp_path: Path) -> None:
    for number in (1, 2):
        done = graphvio("run", room_walk, "--to", 0.5, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        assert (tmp_path / f"results/room-{number}/trajectory.txt").is_file()
