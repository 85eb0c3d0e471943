"""Calibration of all parameters from a whole recording: accuracy, certainty, what is fixed, and the command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.calibration_differences import calibration_differences
from calibration_walks import planar, recorded
from scipy.stats import chi2
from typer.testing import CliRunner, Result
from walked_views import Walk, calibrated

from graphvio.calibration_sigmas import FACTORY
from graphvio.cli import app
from graphvio.config import Config
from graphvio.config.stages import MotionConfig
from graphvio.errors import CalibrationError
from graphvio.geometry import so3_log
from graphvio.odometry.recorded_calibration import calibrate_recording
from graphvio.rig import Rig
from graphvio.rig_files import load_rig, save_rig
from graphvio.self_calibration.batch import Batch, calibrate_windows, difference_of
from graphvio.self_calibration.collector import FullWindow
from graphvio.self_calibration.online import SelfCalibration
from graphvio.self_calibration.parameters import BODY, PAIR, STEREO
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.simulation.default_rig import default_rig
from graphvio.sources import open_source

SECONDS = 12.0
OF_CAMERAS = ["focal", "principal-point", "distortion", "left-right-rotation", "baseline", "pair-transform"]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("recorded_calibration") / "walk", SECONDS)


def windows_of(rig: Rig, true: Rig, seed: int) -> list[FullWindow]:
    windows: list[FullWindow] = []
    calibration = SelfCalibration(rig)
    calibration.on_full_window = windows.append
    calibrated(calibration, Walk(true, seed=seed), SECONDS)
    return windows


def batch_of(rig: Rig, windows: list[FullWindow]) -> Batch:
    return calibrate_windows(rig, windows, np.zeros(PAIR * len(rig.pairs)))


def rms(rig: Rig, true: Rig) -> dict[str, float]:
    return {name: float(np.sqrt(np.mean(off**2))) for name, off in calibration_differences(rig, true).items()}


# ---------------------------------------------------------------- the estimation


def test_batch_is_as_wrong_as_its_covariance_says() -> None:
    true = default_rig().without_imu()
    for seed in (0, 1):
        written = draw(true, CalibrationErrorSizes.of_level(2, OF_CAMERAS), seed).written_rig.without_imu()
        batch = batch_of(written, windows_of(written, true, seed))
        before, after = rms(written, true), rms(batch.estimate.rig, true)
        for name, share in (("principal_point_px", 0.5), ("left_right_deg", 0.2), ("pair_transform_deg", 0.2)):
            assert after[name] < share * before[name], name
        assert not any(batch.left_out)
        stereo = np.concatenate([np.arange(j * PAIR + STEREO, j * PAIR + STEREO + 3) for j in (0, 1)])
        left = np.array([each.right_T_left for each in written.pairs])
        found = batch.estimate.posterior.mean[stereo].reshape(2, 3)
        expected = np.array([so3_log(left[j, :3, :3].T @ true.pairs[j].right_T_left[:3, :3]) for j in (0, 1)])
        off = (found - expected).ravel()
        covariance = batch.estimate.posterior.covariance[np.ix_(stereo, stereo)]
        assert off @ np.linalg.solve(covariance, off) < chi2.isf(1e-4, 6)


def test_halves_of_one_rig_agree_and_those_of_two_do_not() -> None:
    rig = default_rig().without_imu()
    knocked = draw(rig, CalibrationErrorSizes.of_level(2, ["left-right-rotation"]), 4).written_rig.without_imu()
    first, second, other = (
        batch_of(rig, windows_of(rig, true, seed)) for true, seed in ((rig, 0), (rig, 1), (knocked, 2))
    )
    statistics = []
    for one, another in ((first, second), (first, other)):
        difference, covariance = difference_of(one, another)
        cameras = np.r_[0:BODY]
        off = difference[cameras]
        statistics.append(float(off @ np.linalg.solve(covariance[np.ix_(cameras, cameras)], off)))
    assert statistics[0] < chi2.isf(1e-4, BODY)
    assert statistics[1] > 3.0 * chi2.isf(1e-4, BODY)


# ---------------------------------------------------------------- recordings


def test_calibrate_recording_finds_all_parameters(walk: Path) -> None:
    source, true = open_source(walk, to_s=9.0), load_rig(walk)
    written = draw(true, CalibrationErrorSizes.of_level(2, [*OF_CAMERAS, "cameras-in-body"]), 1).written_rig
    found = calibrate_recording(source, written)
    before, after = rms(written, true), rms(found.rig, true)
    for name, share in (
        ("left_right_deg", 0.3),
        ("principal_point_px", 0.7),
        ("pair_transform_deg", 0.3),
        ("cameras_in_body_deg", 0.5),
    ):
        assert after[name] < share * before[name], name
    assert found.rig.calibration_sigmas.stereo_rotation_deg < 0.5 * FACTORY.stereo_rotation_deg
    assert [each.group for each in found.agreements if not each.is_good] == []
    assert {each.part for each in found.findings if each.is_significant} >= {"pair back, rotation against front"}


def test_calibrate_recording_of_single_cameras_finds_lenses_and_places(walk: Path) -> None:
    true = load_rig(walk).with_only(["0", "1", "2"]).without_pairs()
    written = draw(
        true, CalibrationErrorSizes.of_level(2, ["principal-point", "cameras-in-body", "time-offset"]), 1
    ).written_rig
    found = calibrate_recording(open_source(walk, written, to_s=9.0), written)
    before, after = rms(written, true), rms(found.rig, true)
    for name, share in (("principal_point_px", 0.8), ("cameras_in_body_deg", 0.5)):
        assert after[name] < share * before[name], name
    assert {curve.group for curve in found.curves} >= {
        "focal lengths",
        f"cameras against {true.singles[0].name}, rotation",
    }
    assert not any(found.batch.left_out)


def test_command_left_to_right_of_single_cameras_is_refused(walk: Path) -> None:
    for what in ("pairs", "stereo"):
        done = command(walk, "--no-pairs", "--what", what)
        assert done.exit_code != 0
        assert "needs a stereo pair" in str(done.exception)


def test_calibrate_recording_of_one_group_keeps_the_others(walk: Path) -> None:
    source, true = open_source(walk, to_s=8.0), load_rig(walk)
    written = draw(true, CalibrationErrorSizes.of_level(2, ["left-right-rotation", "pair-transform"]), 2).written_rig
    found = calibrate_recording(source, written, "stereo")
    before, after = rms(written, true), rms(found.rig, true)
    assert after["left_right_deg"] < 0.2 * before["left_right_deg"]
    for name in set(before) - {"left_right_deg", "baseline_percent"}:
        assert after[name] == pytest.approx(before[name], abs=1e-6), name
    assert found.is_consistent
    assert {each.part.split(", ")[1] for each in found.findings} == {
        "rotation left to right", "translation left to right",
    }  # fmt: skip
    assert any("against front" in each.part for each in found.contradicted)
    sigmas = found.rig.calibration_sigmas
    assert sigmas.stereo_rotation_deg < FACTORY.stereo_rotation_deg
    assert (
        replace(
            sigmas,
            stereo_rotation_deg=FACTORY.stereo_rotation_deg,
            stereo_baseline_share=FACTORY.stereo_baseline_share,
        )
        == FACTORY
    )


def test_calibrate_recording_that_hardly_moves_is_refused(walk: Path) -> None:
    with pytest.raises(CalibrationError, match="the images hardly move, or are not tracked"):
        calibrate_recording(open_source(walk, to_s=2.0), load_rig(walk))


def test_calibrate_recording_without_keyframes_is_refused(walk: Path) -> None:
    config = Config(motion=MotionConfig(reference="previous"))
    with pytest.raises(CalibrationError, match="reference is previous"):
        calibrate_recording(open_source(walk), load_rig(walk), config=config)


# ---------------------------------------------------------------- the command


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, arguments)])


def test_command_writes_rig_and_report(walk: Path, tmp_path: Path) -> None:
    true = load_rig(walk)
    save_rig(
        draw(true, CalibrationErrorSizes.of_level(2, ["left-right-rotation"]), 3).written_rig, tmp_path / "rig.yaml"
    )
    out, report = tmp_path / "out.yaml", tmp_path / "report"
    done = command(walk, "--rig", tmp_path / "rig.yaml", "--what", "all", "--out", out, "--report", report)
    assert done.exit_code == 0, done.output
    assert "pair front, rotation left to right" in done.stdout
    assert "first half against second: 12 of 12 groups agree" in done.stdout
    before, after = (rms(load_rig(path), true)["left_right_deg"] for path in (tmp_path / "rig.yaml", out))
    assert after < 0.3 * before
    assert {path.name for path in report.iterdir()} == {"report.html", "calibration.png", "rig-calibrated.yaml"}
    assert load_rig(report / "rig-calibrated.yaml").calibration_sigmas == load_rig(out).calibration_sigmas
    page = (report / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 1
    assert "http" not in page


def test_command_insufficient_motion_is_diagnosed(tmp_path: Path) -> None:
    source = recorded(tmp_path / "walk", 6.0, planar)
    done = command(source, "--what", "imu", "--out", tmp_path / "out.yaml")
    assert done.exit_code == 3, done.output
    assert "hardly better known than by the file: " in done.stderr
    assert "turn about two axes near textured surfaces" in done.stderr
    assert load_rig(tmp_path / "out.yaml").calibration_sigmas.body_translation_m > 0.5 * FACTORY.body_translation_m


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--what", "lenses"], "--what lenses: give one of pairs, cameras, stereo, imu, all"),
        (["--what", "all", "--guide"], "--guide is for --what pairs"),
        (["--what", "all", "--out", "missing/rig.yaml"], "name a file in a folder that exists"),
    ],
)
def test_command_invalid_options_are_refused(walk: Path, arguments: list[str], words: str) -> None:
    done = command(walk, *arguments)
    assert done.exit_code != 0
    assert words in str(done.exception)
