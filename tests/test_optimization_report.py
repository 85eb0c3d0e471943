"""The report of an optimisation, on two laps of a circle without images."""

from __future__ import annotations

import io
import json
import re
from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from synthetic import two_pair_rig

from graphvio.arrays import Float
from graphvio.cli.optimize import print_summary
from graphvio.config import Config
from graphvio.errors import OptimizationError
from graphvio.geometry import se3, se3_exp, se3_inverse, so3_exp
from graphvio.optimization.extrinsics import RigCorrection
from graphvio.optimization.first_windows import FirstWindows
from graphvio.optimization.loops.closures import LoopClosure, Place
from graphvio.optimization.optimize import JudgedLoop, Optimization, optimize
from graphvio.optimization.record import Inertial, Motions, SessionRecord
from graphvio.optimization.report.calibration import calibrations
from graphvio.optimization.report.page import length, plain
from graphvio.optimization.report.write import write_plan, write_report
from graphvio.optimization.solver import Residuals
from graphvio.optimization.views import Views
from graphvio.trajectory import Trajectory

POSES, LAP = 120, 60
SIGMAS = np.repeat([2e-3, 1e-2], 3)  # radians, metres
STEP_NS = 100_000_000


def circle() -> Float:
    """(N, 4, 4): two laps."""
    angles = 2.0 * np.pi * np.arange(POSES) / LAP
    rotations = [so3_exp(np.array([0.0, 0.0, angle])) for angle in angles]
    places = np.column_stack([5.0 * np.sin(angles), 5.0 - 5.0 * np.cos(angles), 0.2 * np.sin(3.0 * angles)])
    return np.array([se3(rotation, place) for rotation, place in zip(rotations, places, strict=True)])


def session(name: str, seed: int, breaks: tuple[int, ...] = ()) -> SessionRecord:
    """What an odometry without IMU would record on the circle, with drift; a new epoch begins at each break."""
    rng, true = np.random.default_rng(seed), circle()
    epoch = np.searchsorted(np.array(breaks, dtype=np.int64), np.arange(POSES), side="right")
    poses, relative, rows = [np.eye(4)], [], []
    for k in range(1, POSES):
        motion = se3_inverse(true[k - 1]) @ true[k] @ se3_exp(SIGMAS * rng.standard_normal(6))
        if epoch[k] == epoch[k - 1]:
            relative.append(motion)
            rows.append(k)
        poses.append(poses[-1] @ motion if epoch[k] == epoch[k - 1] else np.eye(4))
    ends, count = np.array(rows, dtype=np.int64), len(rows)
    covariance, zero = np.diag(SIGMAS**2), np.zeros((POSES, 3))
    no, nothing = np.zeros(POSES, dtype=bool), np.zeros((count, 6, 6))
    motions = Motions(
        ends - 1, ends, np.array(relative), np.repeat(covariance[None], count, 0), nothing, np.full(count, 100),
        np.zeros(count, dtype=bool),
    )  # fmt: skip
    none: list[Any] = [column[:0] for column in motions]
    return SessionRecord(
        name=name,
        stamps_ns=STEP_NS * np.arange(1, POSES + 1, dtype=np.int64),
        epoch=epoch.astype(np.int64),
        online=np.array(poses),
        smoothed=np.array(poses),
        covariance=np.array([(k + 1) * covariance for k in range(POSES)]),
        velocity_nav=zero,
        gyro_bias=zero,
        accel_bias=zero,
        is_stationary=no,
        is_keyframe=~no,
        with_imu=no,
        is_start=no,
        keyframe_before=np.full(POSES, -1),
        keyframe_covariance=np.zeros((POSES, 6, 6)),
        motions=motions,
        own=Motions(*none),
        own_pair=np.zeros(0, dtype=np.int64),
        inertial=Inertial(np.zeros(POSES + 1, dtype=np.int64), no, np.zeros(0), np.zeros((0, 6))),
        views=Views.of([], {}),
        first_windows=FirstWindows.of([], {}),
    )


def loop(first: tuple[int, int], second: tuple[int, int], reference_T_current: Float, points: int) -> LoopClosure:
    """A loop closure between places, given as session and row."""
    earlier, later = (Place(number, row, STEP_NS * (row + 1)) for number, row in (first, second))
    return LoopClosure(earlier, later, reference_T_current, 1e-6 * np.eye(6), points, ((0, 0), (0, 1)), True)


def between(first: int, second: int) -> Float:
    return np.asarray(se3_inverse(circle()[first]) @ circle()[second])


@pytest.fixture(scope="module")
def one() -> Optimization:
    """A session with a true loop closure and a false one."""
    loops = [loop((0, 2), (0, 62), between(2, 62), 321), loop((0, 20), (0, 110), np.eye(4), 45)]
    return optimize([session("ring<1>", 1)], [None], loops, Config())


def two_sessions() -> Optimization:
    """Two sessions; the second's first epoch is in a frame of its own."""
    records = [session("first", 2), session("second", 3, breaks=(30,))]
    found = optimize(records, [None, None], [], Config())
    first, second = found.sessions
    frame, poses = np.where(np.arange(POSES) < 30, 1, 0), second.nav_T_body.copy()
    poses[30:] = circle()[30:]
    loops = [JudgedLoop(loop((0, row), (1, row + LAP), between(row, row + LAP), 100), "", 3.0) for row in (5, 15, 25)]
    return replace(
        found, sessions=[first, replace(second, frame=frame, nav_T_body=poses)], frames=[0, 1, 0], loops=loops
    )


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    return Trajectory(STEP_NS * np.arange(1, POSES + 1, dtype=np.int64), circle())


class Page(HTMLParser):
    """Text and pictures of a page; fails if elements are not nested properly."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text, self.pictures, self._open = "", list[bytes](), list[str]()
        self.feed(html)
        self.close()
        self.text = " ".join(self.text.split())
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag == "img":
            kind, data = str(values["src"]).split(",", 1)
            assert kind == "data:image/png;base64"
            assert values["alt"]
            self.pictures.append(b64decode(data, validate=True))
        elif tag != "meta":
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data + " "


def report(found: Optimization, folder: Path, truths: list[Trajectory | None]) -> tuple[Page, dict[str, Any]]:
    write_report(found, folder, truths)
    assert {file.name for file in folder.iterdir()} == {"report.html", "summary.json"}
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert "://" not in html  # base64 may spell http, but has no colon
    return Page(html), json.loads((folder / "summary.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def written(
    one: Optimization, truth: Trajectory, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Page, dict[str, Any]]:
    return report(one, tmp_path_factory.mktemp("one") / "new" / "folder", [truth])


def test_write_report_page_and_summary_agree(one: Optimization, written: tuple[Page, dict[str, Any]]) -> None:
    page, summary = written
    assert summary["loops"]["found"] == 2
    assert summary["loops"]["used"] == 1
    assert "2 found, 1 used, 1 refused" in page.text
    assert summary["cost"]["after"] == one.cost_after
    assert summary["cost"]["before"] == one.cost_before
    (each,) = summary["sessions"]
    assert (each["framesets"], each["states"]) == (POSES, len(one.sessions[0].nodes.rows))
    assert f"{POSES}, of which {each['states']} are states" in page.text
    for stage in ("online", "optimized"):
        assert length(each["ate_rmse"][stage]["position_m"]) in page.text
    assert each["ate_rmse"]["optimized"]["position_m"] < each["ate_rmse"]["online"]["position_m"]
    error = summary["loops"]["error_of_used"]
    assert error["online"]["count"] == 1
    assert error["optimized"]["max_m"] < 0.1 * error["online"]["max_m"]
    assert length(error["online"]["max_m"]) in page.text
    for kind, residuals in summary["residuals"].items():
        assert kind in page.text
        assert plain(residuals["after"]["per_dimension"]) in page.text
        assert plain(residuals["after"]["median_sigmas"]) in page.text
    motion = one.after["motion"]
    expected = np.sqrt(np.median(motion.distances) / (motion.dimensions / len(motion.distances)))
    assert summary["residuals"]["motion"]["after"]["median_sigmas"] == pytest.approx(expected)
    assert f"motions from images 0 before, {plain(expected)} after" in page.text
    assert "fell by" not in page.text
    assert summary["residuals"]["loop"]["before"]["per_dimension"] > 100.0
    assert summary["unknowns"] == one.values.dim()
    assert "ring<1>" in page.text


def test_write_report_refused_loop_states_reason(written: tuple[Page, dict[str, Any]]) -> None:
    page, summary = written
    wrong = summary["loops"]["all"][1]
    assert wrong["refusal"]
    assert f"refused: {wrong['refusal']}" in page.text
    assert wrong["points"] == 45
    assert (wrong["reference"]["since_start_s"], wrong["current"]["since_start_s"]) == (2.0, 11.0)
    assert re.search(r"2\.00 s\s+11\.00 s\s+0 by 0; 0 by 1\s+45\s+0\.000 m, 0\.0 degrees", page.text)


def test_write_report_pictures_show_everything(written: tuple[Page, dict[str, Any]]) -> None:
    page, _ = written
    assert len(page.pictures) == 4  # map, moved, sigmas, residuals
    for png in page.pictures:
        pixels = matplotlib.image.imread(io.BytesIO(png))[..., :3]
        assert min(pixels.shape[:2]) > 300
        assert 0.01 < (pixels.min(axis=2) < 0.9).mean() < 0.6
        ink = pixels.min(axis=2) < 0.9
        assert not ink[[0, -1]].any()
        assert not ink[:, [0, -1]].any()
    pixels = matplotlib.image.imread(io.BytesIO(page.pictures[0]))[..., :3]
    redder = pixels[..., 0] - pixels[..., 2]
    blue, faint = redder < -0.2, (redder > 0.03) & (pixels.min(axis=2) > 0.7)  # the refused loop
    for half in (slice(None, pixels.shape[1] // 2), slice(pixels.shape[1] // 2, None)):
        assert blue[:, half].sum() > 300
        assert faint[:, half].sum() > 100


def test_write_plan_shows_trajectory_loops_and_points(one: Optimization, tmp_path: Path) -> None:
    counts = {}
    few = np.random.default_rng(0).normal([3.0, 5.0, 0.0], 1.0, (500, 3))
    for name, points in {"none": None, "empty": np.zeros((0, 3)), "some": few}.items():
        (tmp_path / name).mkdir()
        write_plan(one, tmp_path / name, points)
        image = matplotlib.image.imread(tmp_path / name / "plan.png")[..., :3]
        red, green, blue = np.moveaxis(image, 2, 0)
        grey = (np.ptp(image, axis=2) < 0.02) & (red > 0.4) & (red < 0.7)
        counts[name] = [int(each.sum()) for each in (grey, blue - red > 0.3, green - red > 0.2)]
    assert all(min(each[1], each[2]) > 100 for each in counts.values())
    assert counts["some"][0] > counts["none"][0] + 500


def test_write_plan_of_a_long_corridor_gives_no_warning(
    one: Optimization, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_plan(one, tmp_path, np.linspace([-300.0, 0.0, 0.0], [300.0, 0.0, 0.0], 500))
    assert not caplog.messages  # such as matplotlib's of limits that it changes


def test_write_report_unjoined_parts_are_listed(truth: Trajectory, tmp_path: Path) -> None:
    found = two_sessions()
    page, summary = report(found, tmp_path, [truth, None])
    assert summary["frames"] == 2
    assert "there are 2 frames" in page.text
    assert "Frame 1" in page.text
    assert "second, epoch 0: 0.0 to 2.9 s, 30 framesets" in page.text
    assert len(page.pictures) == 5
    assert "second: no ground truth" in page.text
    error = summary["loops"]["error_of_used"]
    assert error["online"]["count"] == 0
    assert error["optimized"]["count"] == 3


def correction(angle_rad: float, shift_m: float, offset_s: float | None) -> RigCorrection:
    """A correction of two pairs; the first is held unless there is an offset."""
    covariance = np.diag(np.repeat([1e-3, 2e-3], 3) ** 2)
    found = se3_exp(np.array([0.0, 0.0, angle_rad, shift_m, 0.0, 0.0]))
    first = covariance if offset_s is not None else np.zeros((6, 6))
    pairs = {0: np.eye(4), 1: found}
    return RigCorrection(pairs, {0: first, 1: covariance}, offset_s or 0.0, None if offset_s is None else 1e-3)


@pytest.mark.usefixtures("without_plots")
def test_write_report_calibration_contradicts_rig_file(one: Optimization, tmp_path: Path) -> None:
    page, summary = report(replace(one, corrections=[correction(0.01, 0.0, -0.005)]), tmp_path, [None])
    (each,) = summary["calibrations"]
    first, second = each["pairs"]
    assert not each["borne_out"]
    assert first["borne_out"]
    assert not second["borne_out"]
    assert second["of"] == "body's origin"
    assert second["angle_deg"] == pytest.approx(np.rad2deg(0.01))
    assert second["angle_sigma_deg"] == pytest.approx(np.rad2deg(1e-3))
    assert second["angle_sigmas"] == pytest.approx(10.0)
    assert second["distance_sigma_m"] == pytest.approx(2e-3)
    assert each["time_offset"] == {"correction_s": -0.005, "sigma_s": 1e-3, "sigmas": 5.0, "borne_out": False}
    assert "0.573 degrees, sigma 0.057: 10.0 sigmas" in page.text
    assert "-5.00 ms, sigma 1.00: 5.0 sigmas" in page.text
    assert "contradicts the rig file" in page.text
    assert "the calibration contradicts" in page.text


@pytest.mark.usefixtures("without_plots")
def test_write_report_calibration_consistent_with_rig_file(one: Optimization, tmp_path: Path) -> None:
    found = replace(one, corrections=[correction(0.001, 0.003, None)])
    page, summary = report(found, tmp_path, [None])
    (each,) = summary["calibrations"]
    first, second = each["pairs"]
    assert each["borne_out"]
    assert first["held"]
    assert first["angle_sigmas"] is None
    assert each["time_offset"] is None
    assert second["distance_sigmas"] == pytest.approx(1.5, rel=1e-3)
    assert "held at the rig file's value" in page.text
    assert "consistent with the rig file" in page.text
    assert "the calibration contradicts" not in page.text


def test_calibrations_joint_test_can_contradict_rig_file(one: Optimization) -> None:
    """The largest sigma hides a displacement along an axis that is known much better."""
    found = correction(0.0, 0.002, None)
    sharp = found.covariances[1].copy()
    sharp[3, 3] = 1e-4**2
    both = replace(found, covariances=found.covariances | {1: sharp})
    (each,) = calibrations(replace(one, corrections=[both]), [None])
    assert each is not None
    assert each.pairs[1].distance_sigmas == pytest.approx(1.0)
    assert not each.is_consistent


def test_calibrations_rotation_about_left_camera_is_no_displacement(one: Optimization) -> None:
    """A pair far from body's origin that turns about its left camera does not move."""
    rig = two_pair_rig()
    place = rig.pairs[1].left.body_T_cam[:3, 3]
    turned = se3_exp(np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    turned[:3, 3] = place - turned[:3, :3] @ place
    known = RigCorrection({0: np.eye(4), 1: turned}, {0: np.zeros((6, 6)), 1: 1e-6 * np.eye(6)}, 0.0, None)
    (each,) = calibrations(replace(one, corrections=[known]), [rig])
    assert each is not None
    assert each.pairs[1].of == "left camera"
    assert each.pairs[1].distance_m == pytest.approx(0.0, abs=1e-12)
    assert each.pairs[1].distance_sigma_m == pytest.approx(1e-3 * np.sqrt(1.0 + place @ place))
    assert calibrations(one, [rig]) == [None]


@pytest.mark.usefixtures("without_plots")
def test_write_report_good_result_has_no_doubts(one: Optimization, tmp_path: Path) -> None:
    page, summary = report(replace(one, loops=one.loops[:1]), tmp_path, [None])
    assert "no check speaks against the result" in page.text
    assert summary["sessions"][0]["completion"] is None


@pytest.mark.usefixtures("without_plots")
def test_write_report_many_refused_loops_are_a_doubt(one: Optimization, tmp_path: Path) -> None:
    half, _ = report(one, tmp_path / "half", [None])
    assert "places look alike" not in half.text
    page, _ = report(replace(one, loops=[*one.loops, one.loops[1]]), tmp_path / "most", [None])
    assert "Read before use" in page.text
    assert "2 of 3 loop closures that were found are refused: places look alike here" in page.text


@pytest.mark.usefixtures("without_plots")
def test_write_report_contradicting_loops_are_a_doubt(one: Optimization, tmp_path: Path) -> None:
    after = one.after | {"loop": Residuals(np.array([7.2]), 6)}
    page, _ = report(replace(one, loops=one.loops[:1], after=after), tmp_path, [None])
    assert "Read before use" in page.text
    assert "their mean square per dimension is 1.2, that of motions" in page.text


@pytest.mark.usefixtures("without_plots")
@pytest.mark.parametrize(("completion", "is_doubtful"), [(0.89, True), (0.9, False)])
def test_write_report_incomplete_session_is_a_doubt(
    one: Optimization, tmp_path: Path, completion: float, is_doubtful: bool
) -> None:
    odometry = tmp_path / "ring<1>" / "odometry"
    odometry.mkdir(parents=True)
    (odometry / "summary.json").write_text(json.dumps({"completion": completion}))
    write_report(replace(one, loops=one.loops[:1]), tmp_path, [None])
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert ("Only 89 % of the framesets" in html) == is_doubtful
    assert ("Read before use" in html) == is_doubtful
    assert json.loads((tmp_path / "summary.json").read_text())["sessions"][0]["completion"] == completion


def test_cli_prints_medians_and_calibration(
    one: Optimization, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    print_summary(replace(one, corrections=[correction(0.01, 0.0, -0.005)]), tmp_path)
    output = capsys.readouterr().out
    assert re.search(r"^cost \S+ -> \S+; median error per motion \S+ -> \S+ sigmas$", output, re.MULTILINE)
    assert "pair 1: turned by 0.573 degrees (sigma 0.057: 10.0 sigmas)" in output
    assert "time offset -5.00 ms (sigma 1.00 ms: 5.0 sigmas): contradicts the rig file" in output


def test_calibrations_of_one_session_only() -> None:
    corrections: Any = [None, correction(0.0, 0.0, None)]
    found = replace(two_sessions(), corrections=corrections)
    first, second = calibrations(found, [None, None])
    assert first is None
    assert second is not None
    assert second.session == "second"


@pytest.mark.usefixtures("without_plots")
def test_write_report_many_loops_are_truncated(one: Optimization, tmp_path: Path) -> None:
    many = replace(one, loops=[one.loops[0]] * 230)
    page, summary = report(many, tmp_path, [None])
    assert "no ground truth" in page.text
    assert "and 30 more" in page.text
    assert page.text.count("0 by 0; 0 by 1") == 200
    assert len(summary["loops"]["all"]) == 230


@pytest.mark.usefixtures("without_plots")
def test_write_report_bad_arguments_raise(one: Optimization, tmp_path: Path) -> None:
    with pytest.raises(OptimizationError, match="2 truths for 1 sessions"):
        write_report(one, tmp_path, [None, None])
    (tmp_path / "file").write_text("")
    with pytest.raises(OptimizationError, match="cannot be written"):
        write_report(one, tmp_path / "file", [None])
