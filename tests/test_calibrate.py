"""Calibration of a rig from images, by the command and by the function behind it."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from calibration_walks import Course, on_the_spot, planar, recorded, straight, with_wrong_place
from scipy.stats import chi2
from typer.testing import CliRunner, Result
from undrawn import undrawn

from graphvio import Calibration, CalibrationError, Rig, calibrate_pairs, load_rig, open_source, save_rig
from graphvio.arrays import Float
from graphvio.calibration.camera_motions import SeparateMotions
from graphvio.calibration.guide import ENOUGH_MOTIONS, Advice, Guide
from graphvio.cli import app
from graphvio.config import Config
from graphvio.geometry import se3_exp, se3_inverse, se3_log, so3_exp, so3_log

SECONDS = 6.0


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("calibrate") / "walk", SECONDS)


@pytest.fixture(scope="module")
def found(walk: Path) -> Calibration:
    return calibrate_pairs(walk)


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)), env={"COLUMNS": "160"})


def sigmas_from(found: Calibration, left2_T_left1: Float) -> float:
    off = se3_log(se3_inverse(found.left2_T_left1) @ np.ascontiguousarray(left2_T_left1))
    return float(np.sqrt(off @ np.linalg.solve(found.covariance, off)))


def is_plausible(found: Calibration, rig: Rig) -> bool:
    return sigmas_from(found, rig.left2_T_left1()) ** 2 < float(chi2.isf(1e-4, 6))


def test_calibrate_pairs_errors_are_within_covariance(walk: Path, found: Calibration) -> None:
    rig = load_rig(walk / "rig.yaml")
    assert is_plausible(found, rig)
    sigmas = np.sqrt(np.diag(found.covariance))
    assert np.rad2deg(sigmas[:3].max()) < 0.05
    assert sigmas[3:].max() < 4e-3
    assert found.is_complete
    assert found.inliers.mean() > 0.95
    assert found.pair.frame_inlier.mean() > 0.97
    assert found.pair.frame_errors_m.mean() < 3.29e-3
    present = found.compare_rig()
    assert present is not None
    assert not present.is_off
    assert not found.warnings


def test_calibrate_pairs_wrong_rig_gives_same_result(walk: Path, found: Calibration) -> None:
    rig = load_rig(walk / "rig.yaml")
    other = calibrate_pairs(open_source(walk, with_wrong_place(rig, 3.0, 0.05)))
    assert sigmas_from(found, other.left2_T_left1) < 0.02  # rounding, which the tracking's iterations magnify
    present = other.compare_rig()
    assert present is not None
    assert present.is_off
    assert not present.is_swapped
    assert present.angle_deg == pytest.approx(3.0, abs=0.1)
    assert any("from where it is relative to front" in sentence for sentence in other.warnings)


def test_compare_rig_swapped_pairs_warns(walk: Path) -> None:
    rig = load_rig(walk / "rig.yaml")
    places = [pair.left.body_T_cam for pair in rig.pairs]
    moved = []
    for pair, place in zip(rig.pairs, places[::-1], strict=True):
        right = place @ se3_inverse(pair.right_T_left)
        moved.append(
            replace(pair, left=replace(pair.left, body_T_cam=place), right=replace(pair.right, body_T_cam=right))
        )
    swapped = calibrate_pairs(open_source(walk, replace(rig, pairs=tuple(moved))))
    present = swapped.compare_rig()
    assert present is not None
    assert present.is_swapped
    assert any("changed places" in sentence for sentence in swapped.warnings)


def test_command_wrong_rig_is_corrected(walk: Path, tmp_path: Path) -> None:
    rig = load_rig(walk / "rig.yaml")
    wrong, out, report = tmp_path / "wrong.yaml", tmp_path / "right.yaml", tmp_path / "report"
    save_rig(with_wrong_place(rig, 3.0, 0.05), wrong)
    with undrawn():
        ran = command("run", walk, "--rig", wrong, "--out", tmp_path / "results")
    assert ran.exit_code == 0
    found = {}
    for part, unit in (("rotation", "deg"), ("translation", "mm")):
        match = re.search(rf"pair back, {part} against front: ([\d.]+) {unit} from .* \(sigma ([\d.]+)\)", ran.stderr)
        assert match is not None, ran.stderr
        found[part] = (float(match[1]), float(match[2]))
    left, wrong_left = (each.pairs[1].left.body_T_cam for each in (rig, load_rig(wrong)))
    mm = 1e3 * float(np.linalg.norm(left[:3, 3] - wrong_left[:3, 3]))
    for part, expected, max_sigma in (("rotation", 3.0, 0.05), ("translation", mm, 5.0)):
        value, sigma = found[part]
        assert abs(value - expected) < 4.0 * sigma < 4.0 * max_sigma
    done = command("calibrate", walk, "--rig", wrong, "--out", out, "--report", report)
    assert done.exit_code == 0, done.output
    assert re.search(r"the rig has back (2\.9|3\.0)\d+ degrees and 5\d\.\d mm from where it is", done.stderr)
    right = load_rig(out)
    assert np.rad2deg(np.linalg.norm(so3_log(right.left2_T_left1()[:3, :3] @ rig.left2_T_left1()[:3, :3].T))) < 0.1
    np.testing.assert_allclose(right.left2_T_left1()[:3, 3], rig.left2_T_left1()[:3, 3], atol=5e-3)
    np.testing.assert_array_equal(right.pairs[0].left.body_T_cam, rig.pairs[0].left.body_T_cam)
    for j in range(2):
        np.testing.assert_allclose(right.pairs[j].right_T_left, rig.pairs[j].right_T_left, atol=1e-12)

    numbers = yaml.safe_load((report / "calibration.yaml").read_text())
    assert yaml.safe_load(out.with_suffix(".calibration.yaml").read_text()) == numbers
    np.testing.assert_allclose(numbers["left_T_left1"]["back"], right.left2_T_left1(), atol=1e-12)
    assert np.linalg.eigvalsh(np.array(numbers["covariance"])).min() > 0.0
    assert numbers["rig_before"][0]["off"] is True
    page = (report / "report.html").read_text()
    names = {"alignment_errors", "residuals", "turning", "growth"}
    assert page.count("data:image/png;base64,") == len(names)
    assert {file.name for file in report.glob("*.png")} == {f"{name}-0-1.png" for name in names}
    assert "http" not in page  # nothing is fetched from elsewhere


@pytest.mark.parametrize(
    ("course", "words", "code"),  # 1: an exception, of which the command makes a line and exit code 2
    [
        (planar, ["rotation only about the axis y (down)", "offset along y (down) cannot be found; tilt the rig"], 3),
        (on_the_spot, ["rotation only about the axis y (down)", "turn the rig about another axis"], 3),
        (straight, ["without rotation the poses of the cameras cannot be found", "turn the rig about two axes"], 1),
    ],
    ids=["planar", "on the spot", "straight"],
)
def test_command_insufficient_motion_is_diagnosed(course: Course, words: list[str], code: int, tmp_path: Path) -> None:
    source = recorded(tmp_path / "walk", 4.0, course)
    done = command("calibrate", source, "--out", tmp_path / "out.yaml", "--guide")
    for each in words:
        assert each in " ".join(done.output.split()) or each in str(done.exception), done.output
    assert done.exit_code == code
    assert not (tmp_path / "out.yaml").exists()
    assert "the rig has back" not in done.output  # in the directions that the motions determine
    if code == 3:
        assert "unknown" in done.stdout
        numbers = yaml.safe_load((tmp_path / "out.calibration.yaml").read_text())
        assert numbers["complete"] is False
        assert numbers["left_T_left1"]["back"] is None
        assert None in numbers["known"]["back"]["offset_m"]
        assert len(numbers["undetermined_directions"]["back"]) == (2 if course is on_the_spot else 1)
        assert numbers["rig_before"][0]["off"] is False


def test_calibrate_pairs_trigger_offset_stays_consistent(tmp_path: Path) -> None:
    source = recorded(tmp_path / "walk", SECONDS, trigger_offset_ms=17.0)
    found = calibrate_pairs(source)
    assert is_plausible(found, load_rig(source / "rig.yaml"))
    assert np.sqrt(np.diag(found.covariance))[3:].max() < 6e-3


def test_calibrated_rig_wrong_imu_is_corrected(walk: Path) -> None:
    rig = load_rig(walk / "rig.yaml")
    assert rig.imu is not None
    turned = np.eye(4)
    turned[:3, :3] = so3_exp(np.deg2rad(2.0) * np.array([0.6, 0.0, 0.8]))
    pairs = []
    for pair in rig.pairs:
        left, right = (replace(each, body_T_cam=turned @ each.body_T_cam) for each in (pair.left, pair.right))
        pairs.append(replace(pair, left=left, right=right))
    wrong = replace(rig, pairs=tuple(pairs), imu=replace(rig.imu, time_offset_s=0.015))
    made = calibrate_pairs(open_source(walk, wrong))
    assert any(re.match(r"front is turned by (1\.9|2\.0)\d degrees", sentence) for sentence in made.warnings)
    assert any("time offset between cameras and IMU is" in sentence for sentence in made.warnings)
    assert made.imu is not None
    assert abs(made.imu[0].time_offset_s) < 4.0 * made.imu[0].time_offset_sigma_s
    corrected = made.calibrated_rig(correct_imu=True)
    for j in range(2):
        off = so3_log(corrected.pairs[j].left.body_T_cam[:3, :3] @ rig.pairs[j].left.body_T_cam[:3, :3].T)
        assert np.rad2deg(np.linalg.norm(off)) < 0.2
    assert corrected.imu is not None
    assert abs(corrected.imu.time_offset_s) < 1e-3
    kept = made.calibrated_rig()
    np.testing.assert_array_equal(kept.pairs[0].left.body_T_cam, wrong.pairs[0].left.body_T_cam)
    assert kept.imu == wrong.imu


def test_calibrated_rig_right_imu_is_kept(walk: Path, found: Calibration) -> None:
    rig, corrected = load_rig(walk / "rig.yaml"), found.calibrated_rig(correct_imu=True)
    np.testing.assert_allclose(corrected.pairs[0].left.body_T_cam, rig.pairs[0].left.body_T_cam, atol=1e-15)
    assert corrected.imu == rig.imu


def test_calibrate_pairs_callback_ends_recording(walk: Path) -> None:
    counts: list[int] = []

    def enough(number: int, _: SeparateMotions) -> bool:
        counts.append(number)
        return number == 60

    found = calibrate_pairs(walk, on_frameset=enough)
    assert counts == list(range(1, 61))
    assert len(found.pair.frames) < 60


def test_guide_more_motion_improves_advice(walk: Path) -> None:
    advice, _ = guided(walk)
    assert not advice[0].is_enough
    assert "turn the rig about two axes" in advice[0].text
    assert not advice[-1].is_enough  # accurate enough, but from six seconds only
    assert advice[-1].text.startswith("go on like this")
    assert replace(advice[-1], motions=ENOUGH_MOTIONS).text.startswith("enough")
    sigmas = [each.translation_sigma_m for each in advice]
    assert sigmas[-1] < sigmas[len(sigmas) // 2] < sigmas[2]


def test_calibrate_pairs_repeated_gives_same_bits(walk: Path, found: Calibration) -> None:
    """Also where it is looked at while it goes on."""
    _, again = guided(walk)
    np.testing.assert_array_equal(again.left2_T_left1, found.left2_T_left1)
    np.testing.assert_array_equal(again.covariance, found.covariance)


def test_calibrate_pairs_one_pair_raises(walk: Path) -> None:
    rig = load_rig(walk / "rig.yaml").with_pairs([0])
    with pytest.raises(CalibrationError, match="has one stereo pair"):
        calibrate_pairs(open_source(walk, rig))


def test_calibrate_pairs_crossed_left_right_names_pair(walk: Path) -> None:
    """Left and right of the second pair are exchanged: hardly anything is found where it should be."""
    rig = load_rig(walk / "rig.yaml")
    back = rig.pairs[1]
    crossed = replace(
        back, left=replace(back.left, name=back.right.name), right=replace(back.right, name=back.left.name)
    )
    with pytest.raises(CalibrationError, match=r"back measured motion in \d of 120 framesets"):
        calibrate_pairs(open_source(walk, replace(rig, pairs=(rig.pairs[0], crossed))))


@pytest.mark.parametrize("lit", [24, 60])
def test_calibrate_pairs_mostly_dark_pair_is_not_called_wrong(walk: Path, lit: int, tmp_path: Path) -> None:
    """A pair that is in the dark for half of the walk, or most of it, is as its rig says."""
    folder = tmp_path / "dark"
    shutil.copytree(walk, folder)
    for camera in ("cam2", "cam3"):
        for image in sorted((folder / "mav0" / camera / "data").iterdir())[lit:]:
            black = np.zeros_like(cv2.imread(str(image), cv2.IMREAD_GRAYSCALE))
            assert cv2.imwrite(str(image), black)
    found = calibrate_pairs(open_source(folder))
    assert is_plausible(found, load_rig(walk / "rig.yaml"))


def test_calibrate_pairs_crossed_pairs_raises(walk: Path) -> None:
    """The rig file has the names of the cameras the other way round."""
    front, back = load_rig(walk / "rig.yaml").pairs
    names = [[each.left.name, each.right.name] for each in (back, front)]
    crossed = tuple(
        replace(pair, left=replace(pair.left, name=left), right=replace(pair.right, name=right))
        for pair, (left, right) in zip((front, back), names, strict=True)
    )
    rig = replace(load_rig(walk / "rig.yaml"), pairs=crossed)
    with pytest.raises(CalibrationError, match="another pair's"):  # each pair's own calibration is the other's
        calibrate_pairs(open_source(walk, rig))


def test_pose_summary_sigmas_match_sampled_poses(found: Calibration) -> None:
    """Offsets and rotation vectors of poses sampled from the covariance scatter as the summary says."""
    rng, root = np.random.default_rng(0), np.linalg.cholesky(found.covariance)
    offsets, turns = [], []
    for _ in range(3000):
        sampled = found.left2_T_left1 @ se3_exp(root @ rng.standard_normal(6))
        offsets.append(sampled[:3, 3])
        turns.append(so3_log(np.ascontiguousarray(sampled[:3, :3])))
    summary = found.pose_summary(1)
    np.testing.assert_allclose(np.std(offsets, axis=0), summary.offset_sigmas_m, rtol=0.08)
    np.testing.assert_allclose(np.std(turns, axis=0), summary.turn_sigmas_rad, rtol=0.08)
    np.testing.assert_allclose(summary.offset_m, found.left2_T_left1[:3, 3])
    assert summary.offset_known.all()
    assert summary.turn_known.all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--scale", "maybe"], "--scale maybe: give one of auto, estimate, fixed"),
        (["--pairs", "0"], "one stereo pair"),
        (["--correct-imu"], "--correct-imu wants --out FILE"),
        (["--out", "rig.txt"], "end its name in .yaml"),
        (["--out", "missing/rig.yaml"], "name a file in a folder that exists"),
        (["--pairs", "0,7"], "there is no pair 7"),
    ],
)
def test_command_invalid_options_are_refused(walk: Path, arguments: list[str], words: str) -> None:
    done = command("calibrate", walk, *arguments)
    assert done.exit_code != 0
    assert words in str(done.exception)


def test_command_existing_output_is_not_overwritten(walk: Path, tmp_path: Path) -> None:
    out = tmp_path / "rig.yaml"
    out.write_text("of yesterday")
    for what in ("pairs", "all"):
        done = command("calibrate", walk, "--what", what, "--out", out)
        assert isinstance(done.exception, CalibrationError)
        assert "exists already" in str(done.exception)
    assert out.read_text() == "of yesterday"


@cache
def guided(walk: Path) -> tuple[list[Advice], Calibration]:
    source = open_source(walk)
    guide = Guide([pair.name for pair in source.rig.pairs])
    advice = []

    def follow(number: int, separate: SeparateMotions) -> bool:
        if number % 10 == 0:
            advice.append(guide.advise(separate.motions()))
        return False

    return advice, calibrate_pairs(source, config=Config(), on_frameset=follow)


def test_sigmas_from_same_pose_are_zero(found: Calibration) -> None:
    assert sigmas_from(found, found.left2_T_left1) < 1e-6
    moved = found.left2_T_left1 @ se3_exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]))
    assert sigmas_from(found, moved) > 20.0
