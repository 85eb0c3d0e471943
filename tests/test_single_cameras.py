"""Rigs with a camera that has no stereo partner, from rig files to the trajectory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import graphvio
from recordings import half_size
from undrawn import undrawn

from graphvio import FrameSet, Odometry, RigError, load_rig, load_trajectory, save_rig
from graphvio.config import Config
from graphvio.geometry import so3_exp, so3_log
from graphvio.live.pairing import FramesetAssembler
from graphvio.measurements.events import EventKind
from graphvio.pipeline import run
from graphvio.results import ResultWriter
from graphvio.results.summary import Summary
from graphvio.rig import Rig, SingleCamera, overlap
from graphvio.rig_files.grouping import grouped_rig
from graphvio.sessions.euroc_writer import EurocWriter
from graphvio.simulation import CalibrationErrorSizes
from graphvio.simulation.calibration_error import draw
from graphvio.simulation.named_rigs import NAMED_RIGS, stereo_and_back
from graphvio.sources import open_source

DURATION_S = 6.0


def half_size_stereo_and_back() -> Rig:
    return stereo_and_back().with_cameras(half_size)


@pytest.fixture(scope="module")
def walk(stereo_and_back_walk: Path) -> Path:
    return stereo_and_back_walk


def summary_of(recording: Path, rig: Rig, out: Path, config: Config | None = None) -> Summary:
    config = config or Config()
    source = open_source(recording, rig)
    with undrawn(), ResultWriter(out, source.rig, config.to_yaml()) as writer:
        return run(source, Odometry(source.rig, config), writer)


# ------------------------------------------------------------------ rig files


def test_save_rig_with_a_single_camera_is_version_2_and_reads_back(tmp_path: Path) -> None:
    rig = stereo_and_back()
    save_rig(rig, tmp_path / "rig.yaml")
    assert "graphvio_rig: 2" in (tmp_path / "rig.yaml").read_text()
    loaded = load_rig(tmp_path / "rig.yaml")
    assert [group.name for group in loaded.groups] == ["front", "cam2"]
    for one, other in zip(loaded.cameras, rig.cameras, strict=True):
        np.testing.assert_array_equal(one.body_T_cam, other.body_T_cam)
        np.testing.assert_array_equal(one.intrinsics, other.intrinsics)


def test_load_rig_of_version_1_with_single_cameras_names_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save_rig(stereo_and_back(), path)
    path.write_text(path.read_text().replace("graphvio_rig: 2", "graphvio_rig: 1"))
    with pytest.raises(RigError, match=r"rig.yaml: single_cameras: is of version 2; write  graphvio_rig: 2"):
        load_rig(path)


def test_load_rig_of_three_cameras_pairs_those_that_overlap(tmp_path: Path) -> None:
    rig = stereo_and_back()
    left, right, back = rig.cameras
    renamed = [replace(camera, name=f"cam{k}") for k, camera in enumerate((back, left, right))]
    with EurocWriter(tmp_path / "three", Rig((replace(rig.pairs[0], left=renamed[1], right=renamed[2]),), rig.imu,
                                             singles=(SingleCamera(renamed[0]),))) as writer:  # fmt: skip
        grey = np.zeros((480, 640), dtype=np.uint8)
        writer.add(FrameSet(0, {0: (grey, grey), 1: (grey,)}))
    (tmp_path / "three" / "rig.yaml").unlink()
    loaded = load_rig(tmp_path / "three")
    assert [(pair.left.name, pair.right.name) for pair in loaded.pairs] == [("cam1", "cam2")]
    assert [single.name for single in loaded.singles] == ["cam0"]


def test_rig_with_two_groups_of_one_name_is_refused() -> None:
    rig = stereo_and_back()
    single = SingleCamera(replace(rig.singles[0].left, name="front"))
    with pytest.raises(RigError, match="group 'front' appears twice"):
        replace(rig, singles=(single,))


def test_with_only_keeps_pairs_and_makes_single_cameras_of_others() -> None:
    rig = NAMED_RIGS["paper"]()
    chosen = rig.with_only(["0", "cam1", "3"])
    assert [group.name for group in chosen.groups] == ["front", "cam3"]
    with pytest.raises(RigError, match="there is no camera 'cam7'; choose from cam0, cam1, cam2, cam3"):
        rig.with_only(["0", "1", "7"])
    assert [group.name for group in rig.with_only(["0", "2"]).groups] == ["cam0", "cam2"]
    with pytest.raises(RigError, match="cam0, cam2 without a stereo pair and without an IMU"):
        rig.without_imu().with_only(["0", "2"])


def test_with_only_takes_numbers_for_names_whatever_the_order() -> None:
    rig = stereo_and_back()
    names = {"cam0": "cam1", "cam1": "cam2", "cam2": "cam0"}
    renamed = rig.with_cameras(lambda camera: replace(camera, name=names[camera.name]))
    assert [camera.name for camera in renamed.with_only(["1", "2"]).cameras] == ["cam1", "cam2"]


def test_cameras_that_overlap_but_look_apart_are_single(tmp_path: Path) -> None:
    """Fisheyes 60 degrees apart see much of the same, but their patches look too different for stereo."""
    front, right = stereo_and_back().pairs[0].cameras
    wide = [
        replace(camera, model="equidistant", intrinsics=np.array([250.0, 250.0, 320.0, 240.0]), distortion=np.zeros(4))
        for camera in (front, right)
    ]
    turned = front.body_T_cam.copy()
    turned[:3, :3] = turned[:3, :3] @ so3_exp(np.array([0.0, np.pi / 3.0, 0.0]))
    turned[:3, 3] += 0.1
    side = replace(wide[0], name="cam2", body_T_cam=turned)
    assert overlap(wide[0], side) > 0.25
    rig = grouped_rig([*wide, side], None, "wide", tmp_path)
    assert [group.name for group in rig.groups] == ["pair0", "cam2"]
    with pytest.raises(RigError, match="no two of the cameras"):
        grouped_rig([wide[0], side, replace(stereo_and_back().singles[0].left, name="cam3")], None, "wide", tmp_path)


def test_framesets_of_live_images_hold_single_cameras_as_recordings_do() -> None:
    """Images in any order; the pair's right image of one instant and the single camera's of another are missing."""
    reports: list[tuple[int, str]] = []
    assembler = FramesetAssembler(stereo_and_back(), 2.0, 50.0, lambda ns, kind, _: reports.append((ns, kind)))
    missing, framesets = {("cam1", 3), ("cam2", 5)}, []
    image = np.zeros((480, 640), dtype=np.uint8)
    for k in range(8):
        for camera in ("cam2", "cam1", "cam0"):
            if (camera, k) not in missing:
                stamp_ns = 50_000_000 * k + (500_000 if camera == "cam2" else 0)
                framesets += assembler.add(camera, stamp_ns, image, 50_000_000 * k + 5_000_000)
    framesets += assembler.flush()
    assert [each.stamp_ns // 1_000_000 for each in framesets] == [50 * k for k in range(8)]
    assert [{j: len(images) for j, images in each.images.items()} for each in framesets] == [
        {1: 1} if k == 3 else {0: 2} if k == 5 else {0: 2, 1: 1} for k in range(8)
    ]
    assert reports == [(150_000_000, EventKind.IMAGE_WITHOUT_PARTNER)]


# ------------------------------------------------------------------ odometry


def test_run_with_a_single_camera_is_no_worse_than_the_pair_alone(walk: Path, tmp_path: Path) -> None:
    """Without IMU, where the second view matters, and with a calibration that is trusted: motions of a second."""
    rig, config = load_rig(walk).without_imu(), Config.from_yaml("calibration: {online: false}")
    alone = summary_of(walk, rig.with_pairs([0]), tmp_path / "alone", config).evaluation
    both = summary_of(walk, rig, tmp_path / "both", config)
    assert (both.completion, both.resets) == (1.0, 0)
    assert alone is not None
    assert both.evaluation is not None
    for measure, share in (("position_m", 0.8), ("rotation_deg", 0.6)):
        assert both.evaluation["rpe"]["1 s"][measure]["rmse"] < share * alone["rpe"]["1 s"][measure]["rmse"]
    kinds = {line.split('"kind": "')[1].split('"')[0] for line in (tmp_path / "both" / "events.jsonl").open()}
    assert EventKind.EXTRINSICS_OFF not in kinds  # the file is exact


def test_session_and_folder_of_a_single_camera_give_the_same_trajectory(walk: Path, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    assert graphvio("convert", walk, "--out", tmp_path / "walk.mcap").returncode == 0
    rig = load_rig(walk)
    poses = []
    for recording in (walk, tmp_path / "walk.mcap"):
        odometry = Odometry(rig)
        source = open_source(recording, rig, to_s=1.5)
        poses.append([e.nav_T_body for e in map(odometry.process, source) if e is not None])
    for one, other in zip(*poses, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_dark_pair_leaves_the_motion_to_the_single_camera(walk: Path) -> None:
    """Without IMU the pair's images are black for half a second: motions are of the single camera meanwhile."""
    source = open_source(walk, load_rig(walk).without_imu())
    assert source.truth is not None
    truth = load_trajectory(source.truth)
    odometry, darkness, errors_m = Odometry(source.rig), (3_000_000_000, 3_500_000_000), []
    first_ns, before = None, None
    for measurement in source:
        assert isinstance(measurement, FrameSet)
        first_ns = measurement.stamp_ns if first_ns is None else first_ns
        is_dark = darkness[0] <= measurement.stamp_ns - first_ns < darkness[1]
        if is_dark:
            black = np.zeros((240, 320), dtype=np.uint8)
            noisy = tuple(black + np.uint8(measurement.stamp_ns // 50_000_000 % 2 + k) for k in (0, 1))
            measurement = FrameSet(measurement.stamp_ns, {**measurement.images, 0: noisy})
        estimate = odometry.process(measurement)
        if estimate is None or estimate.nav_T_body is None:
            continue
        at = int(np.searchsorted(truth.stamps_ns, estimate.stamp_ns))
        now = (estimate.nav_T_body, truth.nav_T_body[at])
        if is_dark and before is not None:
            moved, really = (np.linalg.inv(b) @ n for b, n in zip(before, now, strict=True))
            errors_m.append(np.linalg.norm(moved[:3, 3] - really[:3, 3]))
            assert estimate.pairs[1].inliers > 30
        before = now
    assert len(errors_m) == 10
    assert np.median(errors_m) < 0.005  # 50 mm in each frameset


def test_a_single_camera_that_is_triggered_by_itself_claims_no_scale(walk: Path) -> None:
    """Its depths come from motions that it measured itself: the pair and the IMU have the scale, and go on with it."""
    source = open_source(walk)
    assert source.truth is not None
    truth, odometry = load_trajectory(source.truth), Odometry(source.rig)
    begun_ns, silent_ns, number, estimates, events = source.start_ns, (3.0e9, 4.5e9), 0, [], []
    for measurement in source:
        if isinstance(measurement, FrameSet):
            group, number = number % 2, number + 1
            if group == 0 and silent_ns[0] < measurement.stamp_ns - begun_ns < silent_ns[1]:
                continue
            measurement = FrameSet(measurement.stamp_ns, {group: measurement.images[group]})
        estimate = odometry.process(measurement)
        events += odometry.take_events()
        if estimate is not None:
            estimates.append(estimate)
    estimates += odometry.finish()
    assert not {event.kind for event in events} & {EventKind.IMU_LEFT_OUT, EventKind.GATE_RESET, EventKind.LOST}
    found, _ = truth.at(np.array([e.stamp_ns for e in estimates]), 0.1)
    assert len(found.stamps_ns) == len(estimates)
    assert estimates[0].nav_T_body is not None
    nav_T_world = estimates[0].nav_T_body @ np.linalg.inv(found.nav_T_body[0])
    for estimate, true_pose in zip(estimates, found.nav_T_body, strict=True):
        assert estimate.nav_T_body is not None
        assert np.linalg.norm(estimate.nav_T_body[:3, 3] - (nav_T_world @ true_pose)[:3, 3]) < 0.05


def test_run_with_a_wrong_place_of_the_single_camera_learns_it(walk: Path, tmp_path: Path) -> None:
    """The camera is half a degree and 1 cm from where the file has it, of which the angle is reported."""
    rig = load_rig(walk)
    camera = rig.singles[0].left
    turned = camera.body_T_cam @ np.block(
        [[so3_exp(np.deg2rad([0.5, 0.0, 0.0])), np.array([[0.01], [0.0], [0.0]])],
         [np.zeros((1, 3)), np.ones((1, 1))]]
    )  # fmt: skip
    wrong = replace(rig, singles=(SingleCamera(replace(camera, body_T_cam=turned)),))
    summary = summary_of(walk, wrong, tmp_path / "wrong")
    assert summary.evaluation is not None
    assert summary.evaluation["ate_percent"] < 0.035  # 1.4 mm, with what the first seconds are off
    learnt = load_rig(tmp_path / "wrong" / "rig-refined.yaml")
    found = learnt.pairs[0].left.cam_T_body @ learnt.singles[0].left.body_T_cam
    exact = rig.pairs[0].left.cam_T_body @ camera.body_T_cam
    off_deg = np.rad2deg(so3_log(np.ascontiguousarray(found[:3, :3] @ exact[:3, :3].T)))
    # What is written for the next run is wider than what was found: a file has no correlations.
    sigma_deg = learnt.calibration_sigmas.pair_rotation_deg
    assert np.abs(off_deg).max() < min(3.0 * sigma_deg, 0.2)
    assert sigma_deg < rig.calibration_sigmas.pair_rotation_deg / 3.0
    assert EventKind.EXTRINSICS_OFF in (tmp_path / "wrong" / "events.jsonl").read_text()


def test_frameset_with_the_wrong_number_of_images_is_refused(walk: Path) -> None:
    rig = load_rig(walk)
    grey = np.zeros((240, 320), dtype=np.uint8)
    odometry = Odometry(rig.without_imu())
    with pytest.raises(RigError, match="cam2: has 2 images; the rig says 1"):
        odometry.process(FrameSet(1, {1: (grey, grey)}))


def test_calibration_error_of_a_rig_with_a_single_camera_is_on_it_too() -> None:
    rig = stereo_and_back()
    written = draw(rig, CalibrationErrorSizes.of_level("2"), 3).written_rig
    assert not np.allclose(written.singles[0].left.body_T_cam, rig.singles[0].left.body_T_cam, atol=1e-4)
    assert not np.allclose(written.singles[0].left.intrinsics, rig.singles[0].left.intrinsics, atol=1e-2)
