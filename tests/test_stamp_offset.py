"""Cameras whose stamps are off by a known time: corrected where images enter, once, in recordings and live."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import graphvio
from live_runs import Scripted, run
from recordings import (
    FRAME_PERIOD_NS,
    START_NS,
    frame_stamps,
    half_size_rig,
    noise_image,
    read_rows,
    small_rig,
    write_euroc,
    write_image,
    write_imu,
    write_kitti_odometry,
    write_rows,
)
from rendered import rendered_once
from test_rig_files import KALIBR_IMU, assert_same, kalibr_chain

from graphvio import Odometry, open_source
from graphvio.errors import RigError
from graphvio.live.pairing import FramesetAssembler
from graphvio.live.session_recorder import SessionRecorder
from graphvio.live.sources.replay import Replay
from graphvio.measurements.readings import CameraFrame, ImuReading, Reading, host_ns
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.rig import Camera, Imu, Rig, as_written
from graphvio.rig_files import load_rig, save_rig
from graphvio.simulation import Simulator, build_scene, write_recording

MS = 1_000_000
LATE_MS = 8
BACK = ("cam2", "cam3")


def with_offsets(rig: Rig, seconds: float, cameras: Sequence[str] = BACK) -> Rig:
    def late(camera: Camera) -> Camera:
        if camera.name not in cameras:
            return camera
        return as_written(replace(camera, stamp_offset_s=seconds), camera.body_T_cam)  # to the last digit

    return rig.with_cameras(late)


def offsets_of(rig: Rig) -> list[float]:
    return [camera.stamp_offset_s for camera in rig.cameras]


def same(one: Sequence[Measurement], other: Sequence[Measurement]) -> None:
    """Assert that measurements are equal to the bit."""
    assert [(type(each), each.stamp_ns) for each in one] == [(type(each), each.stamp_ns) for each in other]
    for a, b in zip(one, other, strict=True):
        if isinstance(a, ImuSample):
            assert isinstance(b, ImuSample)
            np.testing.assert_array_equal(a.angular_velocity, b.angular_velocity)
            np.testing.assert_array_equal(a.linear_acceleration, b.linear_acceleration)
            continue
        assert isinstance(b, FrameSet)
        for mine, theirs in ((a.images, b.images), (a.masks, b.masks)):
            assert mine.keys() == theirs.keys()
            for j in mine:
                for x, y in zip(mine[j], theirs[j], strict=True):
                    np.testing.assert_array_equal(x, y)


# ------------------------------------------------------------------ rig files


@pytest.mark.parametrize("seconds", [1.0, -1.5, float("nan"), float("inf")])
def test_offsets_of_a_second_and_more_are_refused(seconds: float) -> None:
    with pytest.raises(RigError, match=r"camera cam2: stamp_offset_s is .*; it must be in seconds, less than one"):
        with_offsets(small_rig(2), seconds)


def test_rig_yaml_keeps_offsets_in_version_2(tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    rig = with_offsets(small_rig(2), -0.0081234567891)
    save_rig(rig, file)
    assert_same(load_rig(file), rig)
    assert file.read_text().count("stamp_offset_s") == 2  # not of the cameras without
    assert "graphvio_rig: 2" in file.read_text()
    file.write_text(file.read_text().replace("graphvio_rig: 2", "graphvio_rig: 1"))
    with pytest.raises(RigError, match="stamp_offset_s is of version 2; write  graphvio_rig: 2"):
        load_rig(file)
    corrected = rig.without_stamp_offsets()
    save_rig(corrected, file)
    assert "graphvio_rig: 1" in file.read_text()
    assert "stamp_offset_s" not in file.read_text()
    assert_same(corrected, small_rig(2))


def kalibr_rig(folder: Path, rig: Rig, shifts_s: Sequence[float | None]) -> Rig:
    chain = yaml.safe_load(kalibr_chain(rig))
    for section, shift_s in zip(chain.values(), shifts_s, strict=True):
        section["timeshift_cam_imu"] = shift_s
    (folder / "camchain-imucam.yaml").write_text(yaml.safe_dump(chain))
    (folder / "imu.yaml").write_text(KALIBR_IMU)
    return load_rig(folder / "camchain-imucam.yaml")


def test_kalibr_shifts_that_agree_are_one_time_offset(tmp_path: Path) -> None:
    rig = kalibr_rig(tmp_path, small_rig(2), [0.001, 0.002, 0.003, 0.0055])
    assert rig.imu is not None
    assert rig.imu.time_offset_s == float(np.mean([0.001, 0.002, 0.003, 0.0055]))
    assert offsets_of(rig) == [0.0] * 4


def test_kalibr_shifts_of_pairs_become_offsets(tmp_path: Path) -> None:
    """The shift that Kalibr found for a camera is the sum of its offset and the IMU's."""
    rig = kalibr_rig(tmp_path, small_rig(2), [0.004, 0.006, -0.012, -0.014])
    assert rig.imu is not None
    assert rig.imu.time_offset_s == pytest.approx(0.005, abs=1e-12)
    assert offsets_of(rig) == [0.0, 0.0, -0.018, -0.018]


def test_kalibr_shift_of_a_single_camera_becomes_its_offset(tmp_path: Path) -> None:
    whole = small_rig(2)
    singles = whole.with_only(["cam0", "cam1", "cam2"])
    rig = kalibr_rig(tmp_path, singles, [0.004, 0.004, 0.03])
    assert [single.name for single in rig.singles] == ["cam2"]
    assert offsets_of(rig) == [0.0, 0.0, 0.026]


def test_kalibr_shifts_within_a_pair_have_to_agree(tmp_path: Path) -> None:
    with pytest.raises(RigError, match=r"timeshift_cam_imu differs by 6\.0 ms between cam2 and cam3"):
        kalibr_rig(tmp_path, small_rig(2), [0.0, 0.0, 0.02, 0.026])


def test_kalibr_shift_that_is_missing_is_not_0_beside_others(tmp_path: Path) -> None:
    """As in a chain to which cameras without the IMU were added by hand."""
    assert kalibr_rig(tmp_path, small_rig(2), [0.004, 0.004, None, None]).imu == replace(Imu(), time_offset_s=0.002)
    with pytest.raises(RigError, match="cam2 has no timeshift_cam_imu, and other cameras have different ones; add it"):
        kalibr_rig(tmp_path, small_rig(2), [0.02, 0.02, None, None])


def test_tum_vi_chain_has_offsets(tmp_path: Path) -> None:
    write_euroc(tmp_path, frames=1)
    for folder in ("cam0", "cam1", "cam2", "cam3", "imu0"):
        (tmp_path / "mav0" / folder / "sensor.yaml").unlink()
    (tmp_path / "dso").mkdir()
    kalibr_rig(tmp_path / "dso", small_rig(2), [0.01, 0.01, 0.0, 0.0])
    (tmp_path / "dso/camchain-imucam.yaml").rename(tmp_path / "dso/camchain.yaml")
    rig = load_rig(tmp_path)
    assert rig.imu is not None
    assert rig.imu.time_offset_s == 0.01
    assert offsets_of(rig) == [0.0, 0.0, -0.01, -0.01]


def test_command_rig_shows_offsets(tmp_path: Path) -> None:
    kalibr_rig(tmp_path, small_rig(2), [0.0, 0.0, -0.018, -0.018])
    done = graphvio("rig", tmp_path / "camchain-imucam.yaml")
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()[:2]
    assert "stamps" not in first
    assert second.endswith(", stamps -18.00 ms")


# ------------------------------------------------------------------ recordings


def restamp(recording: Path, camera: str, by_ns: int) -> None:
    """Move the stamps of a camera's images and masks, also where they are in names of files."""
    folder = recording / "mav0" / camera
    stamps = [int(row.partition(",")[0]) + by_ns for row in read_rows(folder / "data.csv")[1:]]
    write_rows(folder / "data.csv", ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in stamps)])
    for kind in ("data", "masks"):
        for image in sorted((folder / kind).glob("*.png"), reverse=by_ns > 0):  # none replaces another
            image.rename(image.with_name(f"{int(image.stem) + by_ns}.png"))


def small_recording(path: Path) -> Path:
    """Two pairs with masks of cam3, the second one triggered 17 ms after the first."""
    write_euroc(path, frames=6)
    save_rig(small_rig(2), path / "rig.yaml")
    for image in (path / "mav0/cam3/data").glob("*.png"):
        write_image(path / "mav0/cam3/masks" / image.name, noise_image(int(image.stem) % 1000) // 128 * 255)
    for camera in BACK:
        restamp(path, camera, 17 * MS)
    return path


def late_recording(path: Path) -> Path:
    """The same with stamps of the second pair that are late, as its rig says."""
    small_recording(path)
    for camera in BACK:
        restamp(path, camera, LATE_MS * MS)
    save_rig(with_offsets(small_rig(2), -1e-3 * LATE_MS), path / "rig.yaml")
    return path


def test_recording_has_corrected_stamps(tmp_path: Path) -> None:
    """Images and masks of the second pair are as those of a recording with right stamps, and so are ends of it."""
    right, late = open_source(small_recording(tmp_path / "right")), open_source(late_recording(tmp_path / "late"))
    same(list(late), list(right))
    assert late.faults.counts == right.faults.counts == {}
    np.testing.assert_array_equal(late.stamps_ns, right.stamps_ns)
    assert sum(bool(each.masks) for each in late if isinstance(each, FrameSet)) == 6
    stamp_ns = START_NS + 17 * MS + FRAME_PERIOD_NS
    same([late.frameset_at(stamp_ns)], [right.frameset_at(stamp_ns)])
    assert offsets_of(late.rig) == [0.0, 0.0, -0.008, -0.008]  # which a calibrated one keeps


def test_corrected_stamps_of_one_instant_are_one_frameset(tmp_path: Path) -> None:
    """Late stamps alone make two of it."""
    write_euroc(tmp_path, frames=6)
    for camera in BACK:
        restamp(tmp_path, camera, LATE_MS * MS)
    assert open_source(tmp_path, small_rig(2)).frameset_count == 12
    source = open_source(tmp_path, with_offsets(small_rig(2), -1e-3 * LATE_MS))
    assert source.stamps_ns.tolist() == frame_stamps(6)
    assert all(sorted(each.images) == [0, 1] for each in source if isinstance(each, FrameSet))


def test_right_camera_whose_stamps_are_late_joins_its_left_one(tmp_path: Path) -> None:
    """By a third of the period and more it has no partner otherwise."""
    write_euroc(tmp_path, pairs=1, frames=6)
    restamp(tmp_path, "cam1", 30 * MS)
    source = open_source(tmp_path, with_offsets(small_rig(1), -0.03, ["cam1"]))
    assert source.stamps_ns.tolist() == frame_stamps(6)
    assert source.faults.counts == {}


def test_imu_covers_corrected_stamps(tmp_path: Path) -> None:
    """A frameset comes after the first sample at or after its corrected stamp."""
    write_euroc(tmp_path, pairs=1, frames=3)
    write_imu(tmp_path / "mav0", list(range(START_NS - 1000 * MS, START_NS + 400 * MS, 5 * MS)))
    newest_ns, ahead_ns = 0, []
    for measurement in open_source(tmp_path, with_offsets(small_rig(1), 0.2, ["cam0", "cam1"])):
        if isinstance(measurement, FrameSet):
            ahead_ns.append(newest_ns - measurement.stamp_ns)
        else:
            newest_ns = measurement.stamp_ns
    assert len(ahead_ns) == 3
    assert all(0 <= each < 5 * MS for each in ahead_ns)


def test_kitti_is_joined_by_row_with_offsets(tmp_path: Path) -> None:
    source = open_source(write_kitti_odometry(tmp_path / "00"))
    names = [camera.name for camera in source.rig.cameras]
    for seconds in (0.25, -0.25):  # with stamps before 0
        shifted = open_source(tmp_path / "00", with_offsets(source.rig, seconds, names))
        assert shifted.stamps_ns.tolist() == (source.stamps_ns + round(1e9 * seconds)).tolist()
        framesets = [replace(each, stamp_ns=each.stamp_ns - round(1e9 * seconds)) for each in shifted]
        same(framesets, list(source))


# ------------------------------------------------------------------ what is recorded


@pytest.mark.parametrize("out", ["walk.mcap", "walk.bag", "rosbag2", "euroc"])
def test_converted_recording_is_not_corrected_again(tmp_path: Path, out: str) -> None:
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    late = late_recording(tmp_path / "late")
    target = tmp_path / out
    done = graphvio("convert", late, "--out", target, *([] if target.suffix else ["--format", out]))
    assert done.returncode == 0, done.stderr
    again = open_source(target)
    assert offsets_of(again.rig) == [0.0] * 4
    same(list(again), list(open_source(late)))
    assert_same(again.rig, small_rig(2))


def test_session_of_a_device_with_raw_stamps_is_corrected_by_its_rig(tmp_path: Path) -> None:
    """As a bag is that another program recorded: topics have the stamps of the devices."""
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    late = late_recording(tmp_path / "late")
    rig = load_rig(late / "rig.yaml")
    raw = tmp_path / "raw"
    raw.mkdir()
    (raw / "mav0").symlink_to(late / "mav0")
    save_rig(rig.without_stamp_offsets(), raw / "rig.yaml")  # so that stamps are written as they are
    done = graphvio("convert", raw, "--out", tmp_path / "raw.bag")
    assert done.returncode == 0, done.stderr
    same(list(open_source(tmp_path / "raw.bag", rig)), list(open_source(late)))


def test_simulated_stamps_are_instants(tmp_path: Path) -> None:
    """Whatever the rig file says that the simulator takes for the truth."""
    save_rig(with_offsets(small_rig(2), 0.3), tmp_path / "rig.yaml")
    done = graphvio("simulate", "room", "--duration", 0.5, "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "walk")
    assert done.returncode == 0, done.stderr
    walk = open_source(tmp_path / "walk")
    assert offsets_of(walk.rig) == [0.0] * 4
    assert all(sorted(each.images) == [0, 1] for each in walk if isinstance(each, FrameSet))


# ------------------------------------------------------------------ live


def images_of(source_rig: Rig, framesets: int, late_ns: int) -> Iterator[tuple[str, int, int]]:
    """Camera, stamp and instant of images as they come, both pairs at the same instants."""
    for i in range(framesets):
        instant_ns = START_NS + i * FRAME_PERIOD_NS
        for camera in source_rig.cameras:
            yield camera.name, instant_ns + (late_ns if camera.name in BACK else 0), instant_ns


@pytest.mark.parametrize("late_ms", [LATE_MS, -LATE_MS, 60])
def test_live_images_have_corrected_stamps(late_ms: int) -> None:
    rig = with_offsets(small_rig(2), -1e-3 * late_ms)
    reports: list[str] = []
    assembler = FramesetAssembler(rig, 2.0, 100.0, lambda _, kind, __: reports.append(kind))
    framesets = []
    for name, stamp_ns, instant_ns in images_of(rig, 5, late_ms * MS):
        framesets += assembler.add(name, stamp_ns, noise_image(0), instant_ns + 5 * MS)
    framesets += assembler.flush()
    assert [each.stamp_ns for each in framesets] == frame_stamps(5)
    assert all(sorted(each.images) == [0, 1] for each in framesets)
    assert reports == []


def readings_of(rig: Rig) -> Iterator[Reading]:
    """Of a stationary rig: images of the second pair have late stamps."""
    samples = iter(range(START_NS - FRAME_PERIOD_NS, START_NS + 20 * FRAME_PERIOD_NS, 5 * MS))
    for name, stamp_ns, instant_ns in images_of(rig, 12, LATE_MS * MS):
        while (sample_ns := next(samples)) < instant_ns:
            yield ImuReading(sample_ns, np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, 9.81]), host_ns())
        yield CameraFrame(name, stamp_ns, partial(noise_image, int(name[-1])), host_ns())


def test_live_recording_is_not_corrected_again(tmp_path: Path) -> None:
    """Neither when it is read nor when it is replayed live."""
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    rig = with_offsets(small_rig(2), -1e-3 * LATE_MS)
    source = Scripted(rig, lambda: readings_of(rig))
    recorder = SessionRecorder(tmp_path / "live.mcap", rig, waits=True)
    estimates, _, _ = run(source, outputs=[recorder])
    recorder.close()
    assert [each.stamp_ns for each in estimates] == frame_stamps(12)
    recorded = open_source(tmp_path / "live.mcap")
    assert recorded.stamps_ns.tolist() == frame_stamps(12)
    assert offsets_of(recorded.rig) == [0.0] * 4
    replayed, _, _ = run(Replay(recorded, None))
    assert [each.stamp_ns for each in replayed] == frame_stamps(12)


def test_replay_of_late_stamps_corrects_once(tmp_path: Path) -> None:
    late = open_source(late_recording(tmp_path))
    estimates, _, _ = run(Replay(late, None))
    assert [each.stamp_ns for each in estimates] == late.stamps_ns.tolist()


# ------------------------------------------------------------------ the odometry


def test_walk_with_late_stamps_is_equal_to_the_bit(tmp_path: Path) -> None:
    """The second pair is triggered 17 ms after the first, and its files have stamps that are late."""

    def write(folder: Path) -> None:
        scene = build_scene("room", 3.0, 0.5)
        write_recording(Simulator(scene, half_size_rig(), 3, 20.0, trigger_offset_ms=17.0), folder)

    walk = rendered_once("staggered", write)
    late = tmp_path / "late"
    for folder in [each for each in (walk / "mav0").iterdir() if each.is_dir()]:
        (late / "mav0" / folder.name).mkdir(parents=True)
        for content in folder.iterdir():
            (late / "mav0" / folder.name / content.name).symlink_to(content)
    for camera in BACK:
        csv = late / "mav0" / camera / "data.csv"
        header, *rows = read_rows(csv)
        csv.unlink()
        cells = [row.split(",") for row in rows]
        write_rows(csv, [header, *(f"{int(stamp) + LATE_MS * MS},{name}" for stamp, name in cells)])
    save_rig(with_offsets(load_rig(walk / "rig.yaml"), -1e-3 * LATE_MS), late / "rig.yaml")

    results = []
    refined_rigs = []
    for folder in (walk, late):
        source = open_source(folder)
        odometry = Odometry(source.rig)
        estimates = [made for each in source if (made := odometry.process(each)) is not None]
        estimates += odometry.finish()
        results.append([(each.stamp_ns, each.nav_T_body, each.covariance) for each in estimates])
        assert odometry.refined_rig is not None
        refined_rigs.append(odometry.refined_rig)
    assert len(results[0]) > 100
    for (stamp_ns, pose, covariance), (other_ns, other_pose, other_covariance) in zip(*results, strict=True):
        assert stamp_ns == other_ns
        np.testing.assert_array_equal(pose, other_pose)
        np.testing.assert_array_equal(covariance, other_covariance)
    assert offsets_of(refined_rigs[1]) == [0.0, 0.0, -1e-3 * LATE_MS, -1e-3 * LATE_MS]
    assert_same(refined_rigs[0], refined_rigs[1].without_stamp_offsets())
