"""Sources: what they yield, each fault of a recording by itself, and their threads."""

from __future__ import annotations

import dataclasses
import gc
import logging
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from recordings import (
    FRAME_PERIOD_NS,
    IMU_PERIOD_NS,
    REAL_DATA,
    START_NS,
    frame_stamps,
    imu_row,
    noise_image,
    read_rows,
    small_rig,
    write_euroc,
    write_image,
    write_imu,
    write_kitti_odometry,
    write_kitti_raw,
    write_rows,
)

from graphvio import FrameSet, ImuSample, RigError, SourceError, open_source
from graphvio.rig import Rig, SingleCamera
from graphvio.rig_files import load_rig, save_rig
from graphvio.sources import Source
from graphvio.sources.read_ahead import read_ahead
from graphvio.sources.read_ahead_process import can_fork, read_ahead_in_process
from graphvio.sources.reading import Reading

S = 10**9


def framesets(source: Source) -> list[FrameSet]:
    return [measurement for measurement in source if isinstance(measurement, FrameSet)]


def samples(source: Source) -> list[ImuSample]:
    return [measurement for measurement in source if isinstance(measurement, ImuSample)]


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    return write_euroc(tmp_path / "walk")


def image_file(walk: Path, camera: int, frame: int) -> Path:
    return walk / "mav0" / f"cam{camera}" / "data" / f"{START_NS + frame * FRAME_PERIOD_NS}.png"


@pytest.mark.parametrize("inner", [False, True])
def test_euroc_yields_all_images_and_samples(walk: Path, inner: bool) -> None:
    source = open_source(walk / "mav0" if inner else str(walk))
    assert (source.name, source.frameset_count) == ("walk", 10)
    assert (source.start_ns, source.end_ns) == (START_NS, START_NS + 9 * FRAME_PERIOD_NS)
    assert source.truth is None
    measurements = list(source)
    sets = [measurement for measurement in measurements if isinstance(measurement, FrameSet)]
    assert [s.stamp_ns for s in sets] == frame_stamps(10)
    for i, frameset in enumerate(sets):
        assert sorted(frameset.images) == [0, 1]
        for pair, images in frameset.images.items():
            for side, image in enumerate(images):
                np.testing.assert_array_equal(image, noise_image(100 * (2 * pair + side) + i))
    imu = [measurement for measurement in measurements if isinstance(measurement, ImuSample)]
    assert [s.stamp_ns for s in imu] == list(range(START_NS - S, source.end_ns + 10**8 + 1, IMU_PERIOD_NS))
    np.testing.assert_array_equal(imu[3].angular_velocity, [0.01, -0.02, 0.03])
    np.testing.assert_array_equal(imu[3].linear_acceleration, [0.1, 0.2, 9.81])
    assert source.faults.counts == {}
    assert len(source.decode_ms) == 10
    assert min(source.decode_ms) > 0


def test_covering_sample_comes_before_its_frameset(walk: Path) -> None:
    latest = 0
    for measurement in open_source(walk):
        if isinstance(measurement, FrameSet):
            assert measurement.stamp_ns <= latest < measurement.stamp_ns + IMU_PERIOD_NS
        else:
            latest = measurement.stamp_ns


def test_rig_selects_pairs_and_imu(walk: Path) -> None:
    rig = small_rig(2)
    only_second = open_source(walk, rig.with_pairs([1]).without_imu())
    assert samples(only_second) == []
    first = framesets(only_second)[0]
    assert list(first.images) == [0]
    np.testing.assert_array_equal(first.images[0][1], noise_image(300))


def test_reading_of_one_pair_needs_no_images_of_the_other(walk: Path) -> None:
    save_rig(small_rig(), walk / "rig.yaml")
    shutil.rmtree(walk / "mav0" / "cam3")
    source = Reading(pairs=(0,)).open(walk, None, None)
    assert source.frameset_count == 10
    assert source.faults.counts == {}
    with pytest.raises(SourceError, match="has no camera cam3"):
        Reading().open(walk, None, None)


def test_euroc_truth_is_found(walk: Path) -> None:
    write_rows(walk / "mav0" / "mocap0" / "data.csv", ["#"])
    assert open_source(walk).truth == walk / "mav0" / "mocap0" / "data.csv"
    write_rows(walk / "mav0" / "state_groundtruth_estimate0" / "data.csv", ["#"])
    assert open_source(walk).truth == walk / "mav0" / "state_groundtruth_estimate0" / "data.csv"


@pytest.mark.parametrize(
    ("from_s", "to_s", "frames"),
    [(0.1, None, range(2, 10)), (None, 0.2, range(5)), (0.07, 0.21, range(2, 5))],
)
def test_from_to_cuts_framesets_and_samples(
    walk: Path, from_s: float | None, to_s: float | None, frames: range
) -> None:
    source = open_source(walk, from_s=from_s, to_s=to_s)
    assert [s.stamp_ns for s in framesets(source)] == [START_NS + i * FRAME_PERIOD_NS for i in frames]
    assert source.frameset_count == len(frames)
    imu = samples(source)
    assert imu[0].stamp_ns == START_NS - S
    if to_s is not None:
        assert imu[-1].stamp_ns == source.end_ns
    assert source.faults.counts == {}


def test_imu_samples_begin_at_most_5_s_before_the_first_frameset(tmp_path: Path) -> None:
    write_euroc(tmp_path, pairs=1, frames=3)
    write_imu(tmp_path / "mav0", list(range(START_NS - 8 * S, START_NS + S, IMU_PERIOD_NS)))
    assert samples(open_source(tmp_path))[0].stamp_ns == START_NS - 5 * S


@pytest.mark.parametrize(
    ("from_s", "to_s", "message"),
    [
        (5.0, None, r"no frameset lies from 5\.0 s to the end; the recording lasts 0\.450 s"),
        (0.4, 0.1, r"no frameset lies from 0\.4 s to 0\.1 s; the recording lasts 0\.450 s"),
        (0.3, 0.1, r"from 0\.3 s to 0\.1"),
        (float("nan"), None, "from_s is nan"),
        (None, float("inf"), "to_s is inf"),
        (-1.0, None, "from_s is -1; give seconds after the first frameset, 0 or more"),
        (None, -0.5, r"to_s is -0\.5"),
    ],
)
def test_from_to_without_framesets_is_refused(
    walk: Path, from_s: float | None, to_s: float | None, message: str
) -> None:
    with pytest.raises(SourceError, match=message):
        open_source(walk, from_s=from_s, to_s=to_s)


def test_open_source_of_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="does not exist"):
        open_source(tmp_path / "none")
    with pytest.raises(SourceError, match="cannot be read"):
        open_source(tmp_path / ("x" * 300))
    with pytest.raises(SourceError, match="is empty; looked for EuRoC/ASL"):
        open_source(tmp_path)
    file = tmp_path / "file.avi"
    file.write_bytes(b"x")
    with pytest.raises(SourceError, match="is no recording that graphvio knows"):
        open_source(file)
    with pytest.raises(SourceError, match=r"none of the known layouts.*KITTI odometry.*KITTI raw") as caught:
        open_source(tmp_path)
    assert "\n" not in str(caught.value)


def test_open_source_without_calibration_is_refused(tmp_path: Path) -> None:
    write_kitti_odometry(tmp_path)
    (tmp_path / "calib.txt").unlink()
    with pytest.raises(RigError, match=r"carries no calibration; write a rig\.yaml"):
        open_source(tmp_path)


def test_open_source_without_a_camera_of_the_rig_is_refused(tmp_path: Path) -> None:
    write_euroc(tmp_path, pairs=1)
    with pytest.raises(SourceError, match="no camera cam2, which the rig names; it has cam0, cam1"):
        open_source(tmp_path, small_rig(2))


# Each fault by itself: what is done to a recording of 10 frames; what is counted; framesets; samples.
ALL_SAMPLES = (S + 9 * FRAME_PERIOD_NS + 10**8) // IMU_PERIOD_NS + 1


def cut_image(keep: float) -> Callable[[Path], None]:
    def damage(walk: Path) -> None:
        file = image_file(walk, 2, 4)
        data = file.read_bytes()
        file.write_bytes(data[: int(keep * len(data))])

    return damage


def unlink_all(walk: Path) -> None:
    for camera in range(4):
        image_file(walk, camera, 4).unlink()


def flip_byte(walk: Path) -> None:
    file = image_file(walk, 2, 4)
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0xFF
    file.write_bytes(data)


def jpeg(keep: float) -> Callable[[Path], None]:
    def damage(walk: Path) -> None:
        encoded = cv2.imencode(".jpg", noise_image(1))[1].tobytes()
        image_file(walk, 2, 4).write_bytes(encoded[: int(keep * len(encoded))])

    return damage


def csv_edit(sensor: str, edit: Callable[[list[str]], None], end: str = "\n") -> Callable[[Path], None]:
    def damage(walk: Path) -> None:
        file = walk / "mav0" / sensor / "data.csv"
        rows = read_rows(file)
        edit(rows)
        write_rows(file, rows, end)

    return damage


def swap(i: int, j: int) -> Callable[[list[str]], None]:
    def edit(rows: list[str]) -> None:
        rows[i], rows[j] = rows[j], rows[i]

    return edit


def put(i: int, *rows_put: str) -> Callable[[list[str]], None]:
    def edit(rows: list[str]) -> None:
        rows[i:i] = rows_put

    return edit


def drop(*which: slice) -> Callable[[list[str]], None]:
    def edit(rows: list[str]) -> None:
        for part in which:
            del rows[part]

    return edit


def replace(i: int, row: str) -> Callable[[list[str]], None]:
    def edit(rows: list[str]) -> None:
        rows[i] = row

    return edit


def both(sensors: tuple[str, ...], edit: Callable[[list[str]], None]) -> Callable[[Path], None]:
    def damage(walk: Path) -> None:
        for sensor in sensors:
            csv_edit(sensor, edit)(walk)

    return damage


CAMERAS = ("cam0", "cam1", "cam2", "cam3")
IMU_T0 = START_NS - S
FAULTS: dict[str, tuple[Callable[[Path], object], dict[str, int], int, int]] = {
    "image missing": (lambda w: image_file(w, 2, 4).unlink(), {"image_missing": 1}, 10, ALL_SAMPLES),
    "both images missing": (
        unlink_all,
        {"image_missing": 4, "frameset_empty": 1},
        9,
        ALL_SAMPLES,
    ),
    "image empty": (cut_image(0), {"image_undecodable": 1}, 10, ALL_SAMPLES),
    "image cut in half": (cut_image(0.5), {"image_undecodable": 1}, 10, ALL_SAMPLES),
    "image lacks its end": (cut_image(0.99), {"image_undecodable": 1}, 10, ALL_SAMPLES),
    "image damaged": (flip_byte, {"image_undecodable": 1}, 10, ALL_SAMPLES),
    "image is text": (
        lambda w: write_rows(image_file(w, 2, 4), ["no image"]),
        {"image_undecodable": 1},
        10,
        ALL_SAMPLES,
    ),
    "JPEG": (jpeg(1), {}, 10, ALL_SAMPLES),
    "JPEG cut": (jpeg(0.7), {"image_undecodable": 1}, 10, ALL_SAMPLES),
    "image size": (
        lambda w: write_image(image_file(w, 2, 4), noise_image(0, (32, 32))),
        {"image_wrong_size": 1},
        10,
        ALL_SAMPLES,
    ),
    "left without right": (
        csv_edit("cam1", drop(slice(5, 6))),
        {"unpaired_image": 1, "frame_gap": 1, "frameset_incomplete": 1},
        10,
        ALL_SAMPLES,
    ),
    "pairs of different lengths": (
        both(("cam2", "cam3"), drop(slice(8, None))),
        {"frameset_incomplete": 3},
        10,
        ALL_SAMPLES,
    ),
    "frame gap": (both(CAMERAS, drop(slice(4, 7))), {"frame_gap": 1}, 7, ALL_SAMPLES),
    "duplicate frame": (
        both(CAMERAS, put(3, f"{START_NS},x.png")),
        {"frame_backward": 0, "frame_duplicate": 4},
        10,
        ALL_SAMPLES,
    ),
    "frames swapped": (both(CAMERAS, swap(4, 5)), {"frame_backward": 4, "frame_gap": 1}, 9, ALL_SAMPLES),
    "frame stamp far ahead": (
        both(CAMERAS, put(3, f"{START_NS + 900 * S},x.png")),
        {"frame_backward": 4},
        10,
        ALL_SAMPLES,
    ),
    "frame stamp zero": (
        both(CAMERAS, put(1, "0,x.png")),
        {"frame_outlier": 4},
        10,
        ALL_SAMPLES,
    ),
    "frame garbage": (both(CAMERAS, put(3, "what?,x.png")), {"frame_garbage": 4}, 10, ALL_SAMPLES),
    "no frame csv": (lambda w: (w / "mav0/cam0/data.csv").unlink(), {"csv_missing": 1}, 10, ALL_SAMPLES),
    "frame CRLF": (csv_edit("cam0", lambda rows: None, "\r\n"), {}, 10, ALL_SAMPLES),
    "frame without header": (csv_edit("cam0", drop(slice(0, 1))), {}, 10, ALL_SAMPLES),
    "frame without names": (
        csv_edit("cam0", lambda rows: rows.__setitem__(slice(None), [r.split(",")[0] for r in rows])),
        {},
        10,
        ALL_SAMPLES,
    ),
    "IMU CRLF": (csv_edit("imu0", lambda rows: None, "\r\n"), {}, 10, ALL_SAMPLES),
    "IMU CR": (csv_edit("imu0", lambda rows: None, "\r"), {}, 10, ALL_SAMPLES),
    "IMU without header": (csv_edit("imu0", drop(slice(0, 1))), {}, 10, ALL_SAMPLES),
    "IMU header in words": (csv_edit("imu0", replace(0, "timestamp,wx,wy,wz,ax,ay,az")), {}, 10, ALL_SAMPLES),
    "IMU semicolons": (
        csv_edit("imu0", lambda rows: rows.__setitem__(slice(None), [r.replace(",", ";") for r in rows])),
        {},
        10,
        ALL_SAMPLES,
    ),
    "IMU semicolons and decimal commas, without header": (
        csv_edit(
            "imu0",
            lambda rows: rows.__setitem__(slice(None), [r.replace(",", ";").replace(".", ",") for r in rows[1:]]),
        ),
        {},
        10,
        ALL_SAMPLES,
    ),
    "frame semicolons": (
        both(CAMERAS, lambda rows: rows.__setitem__(slice(None), [r.replace(",", ";") for r in rows])),
        {},
        10,
        ALL_SAMPLES,
    ),
    "IMU blank lines": (csv_edit("imu0", put(9, "", "# a remark", "  ")), {}, 10, ALL_SAMPLES),
    "IMU extra column": (
        csv_edit("imu0", replace(9, imu_row(IMU_T0 + 8 * IMU_PERIOD_NS) + ",25.0")),
        {},
        10,
        ALL_SAMPLES,
    ),
    "IMU stamp as float": (csv_edit("imu0", replace(1, f"{IMU_T0}.0,0,0,0,0,0,9.81")), {}, 10, ALL_SAMPLES),
    "IMU NaN": (
        csv_edit("imu0", replace(9, f"{IMU_T0 + 8 * IMU_PERIOD_NS},nan,0,0,0,0,0")),
        {"imu_garbage": 1},
        10,
        ALL_SAMPLES - 1,
    ),
    "IMU row cut": (csv_edit("imu0", replace(9, f"{IMU_T0},0,0")), {"imu_garbage": 1}, 10, ALL_SAMPLES - 1),
    "IMU negative stamp": (
        csv_edit("imu0", replace(9, imu_row(-5))),
        {"imu_garbage": 1},
        10,
        ALL_SAMPLES - 1,
    ),
    "IMU stamp too large": (
        csv_edit("imu0", replace(9, imu_row(10**30))),
        {"imu_garbage": 1},
        10,
        ALL_SAMPLES - 1,
    ),
    "IMU garbage": (csv_edit("imu0", put(9, "\x00\x00", "a,b,c")), {"imu_garbage": 2}, 10, ALL_SAMPLES),
    "IMU duplicate": (
        csv_edit("imu0", put(9, imu_row(IMU_T0 + 2 * IMU_PERIOD_NS))),
        {"imu_duplicate": 1},
        10,
        ALL_SAMPLES,
    ),
    "IMU backward": (csv_edit("imu0", swap(9, 10)), {"imu_backward": 1}, 10, ALL_SAMPLES - 1),
    "IMU far ahead": (
        csv_edit("imu0", put(9, imu_row(START_NS + 10**6 * S))),
        {"imu_backward": 1},
        10,
        ALL_SAMPLES,
    ),
    "IMU zero": (csv_edit("imu0", put(1, imu_row(0), imu_row(1))), {"imu_outlier": 2}, 10, ALL_SAMPLES),
    "IMU ends far ahead": (
        csv_edit("imu0", lambda rows: rows.append(imu_row(START_NS + 10**6 * S))),
        {"imu_outlier": 1},
        10,
        ALL_SAMPLES,
    ),
    "IMU gap": (csv_edit("imu0", drop(slice(220, 250))), {"imu_gap": 1}, 10, ALL_SAMPLES - 30),
    "IMU small gap": (csv_edit("imu0", drop(slice(220, 224))), {}, 10, ALL_SAMPLES - 4),
    "IMU begins late": (csv_edit("imu0", drop(slice(1, 221))), {"imu_begins_late": 1}, 10, ALL_SAMPLES - 220),
    "IMU stops early": (csv_edit("imu0", drop(slice(251, None))), {"imu_stops_early": 1}, 10, 250),
    "IMU csv missing": (lambda w: (w / "mav0/imu0/data.csv").unlink(), {"imu_missing": 1}, 10, 0),
    "IMU csv empty": (
        lambda w: (w / "mav0/imu0/data.csv").write_text(""),
        {"imu_missing": 1},
        10,
        0,
    ),
    "IMU of another day": (
        csv_edit(
            "imu0",
            lambda rows: rows.__setitem__(slice(1, None), [imu_row(i * IMU_PERIOD_NS) for i in range(50)]),
        ),
        {"imu_missing": 1},
        10,
        0,
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_fault_is_counted_and_logged_once(walk: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    damage, counts, frames, imu = FAULTS[name]
    damage(walk)
    with caplog.at_level(logging.WARNING, logger="graphvio"):
        source = open_source(walk)
        measurements = list(source)
    assert source.faults.counts == {kind: count for kind, count in counts.items() if count}
    assert sum(isinstance(measurement, FrameSet) for measurement in measurements) == frames
    assert sum(isinstance(measurement, ImuSample) for measurement in measurements) == imu
    assert [event.kind for event in source.faults.events] == list(source.faults.counts)
    assert len(caplog.records) == len(source.faults.counts)
    stamps = [measurement.stamp_ns for measurement in measurements if isinstance(measurement, FrameSet)]
    assert stamps == sorted(set(stamps))
    assert set(stamps) <= set(frame_stamps(10))


def test_missing_image_removes_only_its_pair(walk: Path) -> None:
    image_file(walk, 2, 4).unlink()
    assert [list(s.images) for s in framesets(open_source(walk))] == [[0, 1]] * 4 + [[0]] + [[0, 1]] * 5


def test_second_iteration_yields_and_counts_the_same(walk: Path, caplog: pytest.LogCaptureFixture) -> None:
    image_file(walk, 2, 4).unlink()
    csv_edit("imu0", drop(slice(220, 250)))(walk)
    source = open_source(walk)
    first = [measurement.stamp_ns for measurement in source]
    counts = dict(source.faults.counts)
    assert counts == {"imu_gap": 1, "image_missing": 1}
    assert [measurement.stamp_ns for measurement in source] == first
    assert source.faults.counts == counts
    assert len(source.decode_ms) == 10
    assert len(caplog.records) == 2


def test_events_of_faults_have_their_places(walk: Path) -> None:
    csv_edit("imu0", drop(slice(221, 251)))(walk)
    image_file(walk, 1, 3).unlink()
    source = open_source(walk)
    list(source)
    gap, image = source.faults.events
    assert gap.stamp_ns == IMU_T0 + 219 * IMU_PERIOD_NS
    assert gap.detail == f"no samples for 155 ms after {gap.stamp_ns}"
    assert image.stamp_ns == START_NS + 3 * FRAME_PERIOD_NS
    assert str(image_file(walk, 1, 3)) in image.detail


def test_frameset_in_an_imu_gap_does_not_wait_for_samples(walk: Path) -> None:
    csv_edit("imu0", drop(slice(221, 271)))(walk)  # 250 ms from 100 ms after the first frameset
    order = [
        type(measurement).__name__[0]
        for measurement in open_source(walk)
        if measurement.stamp_ns > START_NS + 90_000_000
    ]
    assert "".join(order).startswith("IF" + "FFF")


@pytest.mark.parametrize(
    ("content", "shown"),
    [
        (b"\n<!DOCTYPE html>\n<html>Not found, sorry</html>\n", "line 2 is '<!DOCTYPE html>'"),
        ("#timestamp [ns],filename\n1700000000000000000,a.png\n".encode("utf-16"), "line 1 is "),
        (bytes(range(128, 256)), "line 1 is "),
    ],
    ids=["html", "utf-16", "binary"],
)
def test_euroc_table_that_is_none_is_shown(content: bytes, shown: str, tmp_path: Path) -> None:
    write_euroc(tmp_path, pairs=1, frames=2)
    table = tmp_path / "mav0" / "cam1" / "data.csv"
    table.write_bytes(content)
    with pytest.raises(SourceError, match="cannot be read") as caught:
        open_source(tmp_path)
    assert str(table) in str(caught.value)
    assert shown in str(caught.value)
    assert "\n" not in str(caught.value)
    table.unlink()  # the remedy
    assert open_source(tmp_path).frameset_count == 2


def test_first_image_of_another_size_is_refused(tmp_path: Path) -> None:
    write_euroc(tmp_path, pairs=1, frames=2)
    for i in range(2):
        write_image(image_file(tmp_path, 1, i), noise_image(0, (32, 40)))
    with pytest.raises(RigError, match="cam1: image is 32x40, the rig says 64x48; calibrate"):
        list(open_source(tmp_path))


def test_recording_without_a_readable_frameset_is_refused(tmp_path: Path) -> None:
    write_euroc(tmp_path, pairs=1, frames=3)
    for i in range(3):
        image_file(tmp_path, 1, i).unlink()
    with pytest.raises(
        SourceError, match=r"none of its 3 framesets could be read \(frameset_empty 3, image_missing 3\)"
    ):
        list(open_source(tmp_path))
    write_rows(tmp_path / "mav0" / "cam1" / "data.csv", ["#timestamp"])
    with pytest.raises(SourceError, match="holds no row"):
        open_source(tmp_path)
    write_rows(tmp_path / "mav0" / "cam1" / "data.csv", ["12345"])
    with pytest.raises(SourceError, match="no left image has a right one"):
        open_source(tmp_path)


def test_staggered_pairs_make_framesets_of_their_own(walk: Path) -> None:
    for camera in ("cam2", "cam3"):
        rows = [f"{s + 20_000_000},{s}.png" for s in frame_stamps(10)]
        write_rows(walk / "mav0" / camera / "data.csv", rows)
    source = open_source(walk)
    assert source.frameset_count == 20
    assert [list(s.images) for s in framesets(source)] == [[0], [1]] * 10
    assert source.faults.counts == {}


def test_stamps_within_tolerance_are_joined(walk: Path) -> None:
    for number, camera in enumerate(CAMERAS):
        rows = [f"{s - 500_000 * number},{s}.png" for s in frame_stamps(10)]
        write_rows(walk / "mav0" / camera / "data.csv", rows)
    source = open_source(walk)
    assert [s.stamp_ns for s in framesets(source)] == frame_stamps(10)
    assert source.faults.counts == {}


def test_time_offset_moves_the_covering_sample(tmp_path: Path) -> None:
    write_euroc(tmp_path, pairs=1)
    rig_file = tmp_path / "rig.yaml"
    save_rig(small_rig(1), rig_file)
    rig_file.write_text(rig_file.read_text().replace("time_offset_s: 0.0", "time_offset_s: 0.02"))
    latest = 0
    for measurement in open_source(tmp_path):
        if isinstance(measurement, FrameSet):
            assert latest == measurement.stamp_ns + 20_000_000
        else:
            latest = measurement.stamp_ns


@pytest.mark.parametrize("kind", ["16 bit", "colour", "colour with alpha"])
def test_pixel_formats_become_grey(tmp_path: Path, kind: str) -> None:
    write_euroc(tmp_path, pairs=1, frames=1)
    grey = noise_image(7)
    images: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.uint8 | np.uint16]]] = {
        "16 bit": grey.astype(np.uint16) * 256 + 99,
        "colour": np.stack([grey] * 3, axis=2),
        "colour with alpha": np.stack([grey] * 4, axis=2),
    }
    write_image(image_file(tmp_path, 0, 0), images[kind])
    got = framesets(open_source(tmp_path))[0].images[0][0]
    assert got.dtype == np.uint8
    assert got.flags.c_contiguous
    np.testing.assert_array_equal(got, grey)


@pytest.mark.parametrize("suffix", ["png", "png with alpha", "16 bit png"])
def test_colours_have_the_documented_weights(tmp_path: Path, suffix: str) -> None:
    write_euroc(tmp_path, pairs=1, frames=1)
    blue, green, red = (noise_image(seed) for seed in (7, 8, 9))
    image: np.ndarray[tuple[int, ...], np.dtype[np.uint8 | np.uint16]] = np.stack([blue, green, red], axis=2)
    if suffix == "png with alpha":
        image = np.dstack([image, noise_image(10)])
    if suffix == "16 bit png":
        image = image.astype(np.uint16) * 256 + 99
    write_image(image_file(tmp_path, 0, 0), image)
    got = framesets(open_source(tmp_path))[0].images[0][0]
    np.testing.assert_allclose(got, 0.299 * red + 0.587 * green + 0.114 * blue, atol=1.0)


def test_kitti_odometry_yields_framesets_and_truth(tmp_path: Path) -> None:
    path = write_kitti_odometry(tmp_path / "dataset" / "sequences" / "07")
    write_rows(tmp_path / "dataset" / "poses" / "07.txt", ["1 0 0 0 0 1 0 0 0 0 1 0"])
    (path / "image_1" / "000002.png").unlink()
    source = open_source(path)
    assert (source.name, source.frameset_count, source.end_ns) == ("07", 5, 400_000_000)
    assert source.truth == tmp_path / "dataset" / "poses" / "07.txt"
    sets = framesets(source)
    assert [s.stamp_ns for s in sets] == [0, 100_000_000, 300_000_000, 400_000_000]
    np.testing.assert_array_equal(sets[2].images[0][1], noise_image(103))
    assert source.faults.counts == {"image_missing": 1, "frameset_empty": 1}


def test_kitti_odometry_with_invalid_times_keeps_rows_and_images(tmp_path: Path) -> None:
    write_kitti_odometry(tmp_path)
    write_rows(tmp_path / "times.txt", ["0", "1.036224e-01", "?", "3.0e-01", "3.0e-01", "5e-01", ""], "\r\n")
    source = open_source(tmp_path)
    sets = framesets(source)
    assert [s.stamp_ns for s in sets] == [0, 103_622_400, 300_000_000]
    np.testing.assert_array_equal(sets[2].images[0][0], noise_image(3))  # the rows keep their images
    expected = {"frame_garbage": 1, "frame_duplicate": 1, "image_missing": 2, "frameset_empty": 1}
    assert source.faults.counts == expected
    (tmp_path / "times.txt").unlink()
    with pytest.raises(SourceError, match=r"times\.txt: is missing"):
        open_source(tmp_path)


def test_kitti_raw_yields_single_cameras_beside_a_pair(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path / "2011_09_26")
    shutil.copytree(drive / "image_00", drive / "image_02")
    (pair,) = load_rig(drive.parent / "calib_cam_to_cam.txt").pairs
    rig = Rig((pair,), singles=(SingleCamera(dataclasses.replace(pair.left, name="image_02")),))
    seen = framesets(open_source(drive, rig))
    assert [sorted(frameset.images) for frameset in seen] == 5 * [[0, 1]]
    for frameset in seen:
        np.testing.assert_array_equal(frameset.images[0][0], frameset.images[1][0])


def test_kitti_raw_yields_framesets(tmp_path: Path) -> None:
    source = open_source(write_kitti_raw(tmp_path / "2011_09_26"))
    assert source.name == "2011_09_26_drive_0001_sync"
    begin = 1_317_042_145_000_000_007
    assert [s.stamp_ns for s in framesets(source)] == [begin + i * 100_000_000 for i in range(5)]
    assert source.faults.counts == {}
    assert source.truth is None


def readers() -> int:
    return sum(thread.name.startswith("graphvio-read") for thread in threading.enumerate())


def ended(seconds: float = 5.0) -> bool:
    limit = time.monotonic() + seconds
    while readers() and time.monotonic() < limit:
        time.sleep(0.01)
    return readers() == 0


def first_frameset(measurements: Iterator[object]) -> None:
    while not isinstance(next(measurements), FrameSet):
        pass


@pytest.mark.parametrize("how", ["exhausted", "closed", "collected", "broken out of", "raised"])
def test_reading_threads_end(walk: Path, how: str) -> None:
    source = open_source(walk)
    measurements = iter(source)
    first_frameset(measurements)
    assert readers() > 0
    if how == "exhausted":
        list(measurements)
    elif how == "closed":
        measurements.close()  # type: ignore[attr-defined]
    elif how == "collected":
        del measurements
        gc.collect()
    elif how == "broken out of":
        del measurements
        for measurement in source:
            if isinstance(measurement, FrameSet):
                break
        del measurement
    else:
        del measurements
        image_file(walk, 0, 0).write_bytes(cv2.imencode(".png", noise_image(0, (32, 32)))[1].tobytes())
        with pytest.raises(RigError):
            list(open_source(walk))
    assert ended()


def test_read_ahead_is_bounded_and_in_order() -> None:
    begun: list[int] = []

    def work(item: int) -> int:
        begun.append(item)
        time.sleep(0.001 * (item % 3))
        return item

    results = read_ahead(work, range(100), depth=4)
    for expected in range(20):
        assert next(results) == expected
        time.sleep(0.002)
        assert len(begun) <= expected + 1 + 4
    assert list(results) == list(range(20, 100))
    assert ended()


def test_read_ahead_works_while_its_consumer_does() -> None:
    begun = threading.Semaphore(0)
    results = read_ahead(lambda _: begun.release(), range(10), depth=4)
    next(results)
    for _ in range(1 + 4):  # the consumer asks for nothing meanwhile
        assert begun.acquire(timeout=30.0)
    list(results)
    assert ended()


def test_read_ahead_raises_errors_in_order() -> None:
    def work(item: int) -> int:
        if item == 3:
            raise RuntimeError("in a thread")
        return item

    results = read_ahead(work, range(10))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(RuntimeError, match="in a thread"):
        next(results)
    assert ended()


needs_fork = pytest.mark.skipif(not can_fork(), reason="processes are forked on Linux with two cores only")


@needs_fork
def test_read_ahead_in_process_yields_results_in_order() -> None:
    def work(item: int) -> tuple[int, NDArray[np.int64]]:
        return os.getpid(), np.arange(item)

    results = list(read_ahead_in_process(work, range(100), buffer_bytes=8 * 50, depth=4))  # half of them have room
    assert len({pid for pid, _ in results}) == 1
    assert results[0][0] != os.getpid()
    for item, (_, values) in enumerate(results):
        np.testing.assert_array_equal(values, np.arange(item))
        values[:] = -1  # which later results must not see, nor change


@needs_fork
def test_read_ahead_in_process_is_bounded(tmp_path: Path) -> None:
    def work(item: int) -> int:
        (tmp_path / str(item)).touch()
        return item

    results = read_ahead_in_process(work, range(100), buffer_bytes=8, depth=4)
    for expected in range(20):
        assert next(results) == expected
        time.sleep(0.002)
        assert not (tmp_path / str(expected + 1 + 4)).exists()
    results.close()
    assert not multiprocessing.active_children()


@needs_fork
def test_read_ahead_in_process_raises_errors_in_order() -> None:
    def work(item: int) -> int:
        if item == 3:
            raise RuntimeError("in a process")
        return item

    results = read_ahead_in_process(work, range(10), buffer_bytes=8)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(RuntimeError, match="in a process"):
        next(results)
    assert not multiprocessing.active_children()


@needs_fork
def test_read_ahead_in_process_that_is_killed_goes_on_here(caplog: pytest.LogCaptureFixture) -> None:
    pid = os.getpid()

    def work(item: int) -> int:
        if item == 3 and os.getpid() != pid:
            os.kill(os.getpid(), signal.SIGKILL)  # as where memory is short
        return item

    assert list(read_ahead_in_process(work, range(10), buffer_bytes=8, depth=4)) == list(range(10))
    assert len(caplog.records) == 1
    assert ended()


@needs_fork
@pytest.mark.parametrize("work_s", [0.0, 0.5], ids=["waiting", "working"])
def test_read_ahead_in_process_ends_with_its_parent(work_s: float) -> None:
    program = (
        "import os, signal, time\n"
        "from graphvio.sources.read_ahead_process import read_ahead_in_process\n"
        f"results = read_ahead_in_process(lambda k: time.sleep(k and {work_s}), range(100), buffer_bytes=8, depth=4)\n"
        "next(results)\n"
        "time.sleep(0.1)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    # The output is read to its end, which comes when both processes have ended.
    killed = subprocess.run(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=60.0, check=False
    )
    assert (killed.returncode, killed.stdout) == (-signal.SIGKILL, b"")


@needs_fork
def test_read_ahead_in_process_that_cannot_be_started_goes_on_here(caplog: pytest.LogCaptureFixture) -> None:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    results = read_ahead_in_process(lambda item: item, range(10), buffer_bytes=8, depth=4)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
    try:
        assert next(results) == 0
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert list(results) == list(range(1, 10))
    assert len(caplog.records) == 1
    assert ended()


@needs_fork
def test_ctrl_c_while_a_process_is_forked_is_not_lost() -> None:
    """Python prints and drops exceptions of functions that it calls before a fork."""
    program = (
        "import os, signal\n"
        "from graphvio.sources.read_ahead_process import read_ahead_in_process\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored where the tests run in the background
        "os.register_at_fork(before=lambda: os.kill(os.getpid(), signal.SIGINT))\n"
        "try:\n"
        "    next(read_ahead_in_process(lambda item: item, range(10), buffer_bytes=8))\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted')\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=60.0, check=False
    )
    assert (ran.returncode, ran.stdout) == (0, b"interrupted\n")


@needs_fork
def test_recording_that_is_decoded_in_a_process_is_the_same(walk: Path) -> None:
    image_file(walk, 2, 4).unlink()
    image_file(walk, 1, 6).write_bytes(b"no image")
    in_threads, in_process = open_source(walk), open_source(walk)
    in_process.decodes_in_process = True
    for expected, actual in zip(in_threads, in_process, strict=True):
        assert actual.stamp_ns == expected.stamp_ns
        if isinstance(expected, FrameSet):
            assert isinstance(actual, FrameSet)
            assert actual.images.keys() == expected.images.keys()
            for pair, images in expected.images.items():
                np.testing.assert_array_equal(actual.images[pair], images)
    assert in_process.faults.counts == in_threads.faults.counts == {"image_missing": 1, "image_undecodable": 1}
    assert in_process.faults.events == in_threads.faults.events
    assert len(in_process.decode_ms) == 10
    assert not multiprocessing.active_children()


@pytest.mark.skipif(not (REAL_DATA / "euroc_mh01_clip").is_dir(), reason="the real EuRoC clip is not here")
def test_real_euroc_clip_is_read_whole() -> None:
    root = REAL_DATA / "euroc_mh01_clip"
    source = open_source(root)
    measurements = list(source)
    sets = [measurement for measurement in measurements if isinstance(measurement, FrameSet)]
    assert source.frameset_count == len(sets) == 340
    rows = read_rows(root / "mav0" / "cam0" / "data.csv")[1:]
    assert [s.stamp_ns for s in sets] == [int(row.split(",")[0]) for row in rows if row]
    assert all(image.shape == (480, 752) for s in sets for image in s.images[0])
    imu_rows = [row for row in read_rows(root / "mav0" / "imu0" / "data.csv")[1:] if row]
    imu = [measurement for measurement in measurements if isinstance(measurement, ImuSample)]
    assert [s.stamp_ns for s in imu] == [int(row.split(",")[0]) for row in imu_rows]
    assert source.faults.counts == {"frame_gap": 1}
    (gap,) = source.faults.events
    assert (gap.stamp_ns, gap.detail) == (
        1403636592863555584,
        "pair0 has no images for 100 ms after 1403636592863555584",
    )
    assert source.truth == root / "mav0" / "state_groundtruth_estimate0" / "data.csv"
