"""Conversion of recordings between formats: measurements, rig and truth are preserved."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from real_clip import CLIP, half_size_clip
from recordings import frame_stamps, small_rig, write_euroc, write_kitti_odometry, write_rows
from test_sessions import same
from typer.testing import CliRunner
from undrawn import undrawn

from graphvio import FrameSet, Odometry, Rig, load_rig, open_source, save_rig
from graphvio.cli import app
from graphvio.errors import SessionError, TrajectoryError
from graphvio.geometry import quat_wxyz_from_rotation, se3, so3_exp
from graphvio.rig import Imu
from graphvio.rig_files.native import to_text
from graphvio.sessions.formats import format_of
from graphvio.sessions.mcap_storage import McapStorage
from graphvio.sessions.store import open_store
from graphvio.sessions.writer import SessionWriter
from graphvio.sources.description import describe
from graphvio.trajectory_files import load_trajectory, tum_line

pytest.importorskip("mcap")
pytest.importorskip("rosbags")

CLIP_PIECE = ("--to", "3")
FRAMES = 8
PIECE_S = 0.8


def odd_rig() -> Rig:
    """A rig none of whose numbers is round, not known to any ROS message: noise, time offset, names."""
    rig = small_rig(2)
    rng = np.random.default_rng(5)
    turn = se3(so3_exp(rng.normal(0.0, 0.02, 3)), rng.normal(0.0, 0.01, 3))
    pairs = tuple(
        replace(
            pair,
            name=f"view{k}",
            left=replace(pair.left, body_T_cam=pair.left.body_T_cam @ turn, distortion=rng.normal(0.0, 0.01, 5)),
            right=replace(pair.right, intrinsics=pair.right.intrinsics + rng.normal(0.0, 0.5, 4)),
        )
        for k, pair in enumerate(rig.pairs)
    )
    return Rig(pairs, Imu(gyro_noise_density=1.23456789e-4, time_offset_s=0.0034567), "odd rig")


def write_truth(recording: Path) -> None:
    rng = np.random.default_rng(6)
    first, last = frame_stamps(FRAMES)[0], frame_stamps(FRAMES)[-1]
    rows = []
    for stamp in range(first - 20_000_000, last + 30_000_000, 10_000_000):
        quat = quat_wxyz_from_rotation(so3_exp(rng.normal(0.0, 1.0, 3)))
        rows.append(f"{stamp}," + ",".join(repr(float(v)) for v in (*rng.normal(0.0, 3.0, 3), *quat)))
    write_rows(recording / "mav0" / "state_groundtruth_estimate0" / "data.csv", ["#timestamp,p,q", *rows])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig = odd_rig()
    path = write_euroc(tmp_path_factory.mktemp("convert") / "walk", frames=FRAMES, rig=rig)
    save_rig(rig, path / "rig.yaml")
    imu = path / "mav0" / "imu0" / "data.csv"
    rng = np.random.default_rng(7)
    head, *rows = imu.read_text().splitlines()
    rows = [row.split(",")[0] + "," + ",".join(repr(float(v)) for v in rng.normal(0.0, 9.0, 6)) for row in rows]
    write_rows(imu, [head, *rows])
    write_truth(path)
    return path


def converted(source: Path, out: Path, *options: str) -> Path:
    given = ["--format", out.name] if out.name in ("rosbag2", "euroc") else []
    done = CliRunner().invoke(app, ["convert", str(source), "--out", str(out), *given, *options])
    assert done.exit_code == 0, (done.output, done.exception)
    return out


def out_of(kind: str, folder: Path) -> Path:
    return folder / {"mcap": "walk.mcap", "rosbag1": "walk.bag"}.get(kind, kind)


def equal(one: Path, other: Path) -> None:
    """The same measurements, rig and truth."""
    sources = open_source(one), open_source(other)
    for measurements in zip(*sources, strict=True):
        same(*measurements)
    assert to_text(sources[0].rig, Path()) == to_text(sources[1].rig, Path())
    assert sources[0].truth is not None
    assert sources[1].truth is not None
    truths = load_trajectory(sources[0].truth), load_trajectory(sources[1].truth)
    np.testing.assert_array_equal(truths[0].stamps_ns, truths[1].stamps_ns)
    np.testing.assert_allclose(truths[0].nav_T_body, truths[1].nav_T_body, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("kind", ["mcap", "rosbag1", "rosbag2", "euroc"])
def test_conversion_there_and_back_is_lossless(kind: str, recording: Path, tmp_path: Path) -> None:
    there = converted(recording, out_of(kind, tmp_path))
    equal(recording, there)
    (tmp_path / "back").mkdir()
    back = converted(there, tmp_path / "back" / "euroc")
    equal(recording, back)
    for camera in ("cam0", "cam3"):
        table = Path("mav0") / camera / "data.csv"
        assert (back / table).read_text() == (recording / table).read_text()
    assert (back / "mav0/imu0/data.csv").read_text().splitlines()[1:] == (
        recording / "mav0/imu0/data.csv"
    ).read_text().splitlines()[1:]


def test_conversion_from_bag_to_bag_with_png_is_lossless(recording: Path, tmp_path: Path) -> None:
    first = converted(recording, tmp_path / "a.bag", "--png")
    second = converted(first, tmp_path / "rosbag2", "--png")
    assert second.is_dir()
    equal(recording, converted(second, tmp_path / "b.mcap"))


def test_euroc_sensor_files_hold_the_rig(recording: Path, tmp_path: Path) -> None:
    """By the files of each sensor, without graphvio's own."""
    back = converted(recording, tmp_path / "euroc")
    (back / "rig.yaml").unlink()
    found, expected = load_rig(back), odd_rig()
    for one, other in zip(found.cameras, expected.cameras, strict=True):
        np.testing.assert_allclose(one.body_T_cam, other.body_T_cam, atol=1e-12)
        np.testing.assert_allclose(one.intrinsics, other.intrinsics, rtol=1e-11)
        np.testing.assert_allclose(one.distortion, other.distortion, rtol=1e-11)
    assert found.imu is not None
    assert found.imu.gyro_noise_density == 1.23456789e-4


def test_converted_piece_has_the_truth_of_its_time(recording: Path, tmp_path: Path) -> None:
    piece = converted(recording, tmp_path / "piece.mcap", "--from", "0.1", "--to", "0.2")
    stamps = load_trajectory(piece).stamps_ns
    source = open_source(piece)
    assert source.start_ns - 10_000_000 <= stamps[0] <= source.start_ns
    assert source.end_ns <= stamps[-1] <= source.end_ns + 10_000_000


def test_cut_session_is_converted_as_far_as_it_goes(recording: Path, tmp_path: Path) -> None:
    source, cut = open_source(recording), tmp_path / "cut.mcap"
    with SessionWriter(cut, source.rig) as writer:
        assert isinstance(writer._storage, McapStorage)
        for measurement in source:
            writer.add(measurement)
            writer._storage._last_flush_s = -1.0  # so that each measurement has a chunk of its own
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    bag = converted(cut, tmp_path / "cut.bag")
    assert 0 < len([measurement for measurement in open_source(bag) if isinstance(measurement, FrameSet)]) < FRAMES
    described = describe(bag)
    (log,) = (topic for topic in described.topics if topic.name == "/rosout")
    assert log.messages >= 1  # the event session_cut, which has no time of its own
    assert described.duration_s < 2.0


def test_bags_have_truth_and_latched_topics(recording: Path, tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    for path in (converted(recording, tmp_path / "walk.bag"), converted(recording, tmp_path / "rosbag2")):
        with AnyReader([path]) as reader:
            rows = list(reader.messages([c for c in reader.connections if c.topic == "/ground_truth"]))
            first = reader.deserialize(rows[0][2], rows[0][0].msgtype)
            assert first.pose.position.x == load_trajectory(path).positions[0, 0]  # type: ignore[attr-defined]
            transforms = next(c for c in reader.connections if c.topic == "/tf_static")
            assert "1" in str(getattr(transforms.ext, "latching", transforms.ext))


def test_cameras_are_renamed_for_the_euroc_layout(tmp_path: Path) -> None:
    drive = write_kitti_odometry(tmp_path / "07")
    done = CliRunner().invoke(app, ["convert", str(drive), "--format", "euroc", "--out", str(tmp_path / "euroc")])
    assert done.exit_code == 0, done.output
    assert "no truth" in done.stdout
    assert " is cam1" in done.stdout
    for one, other in zip(open_source(drive), open_source(tmp_path / "euroc"), strict=True):
        same(one, other)
    assert not (tmp_path / "euroc/mav0/imu0").exists()


def trajectory(path: Path, to_s: float | None = None) -> list[str]:
    source = open_source(path, to_s=to_s)
    odometry = Odometry(source.rig)
    found = [odometry.process(measurement) for measurement in source]
    return [tum_line(e.stamp_ns, e.nav_T_body) for e in found if e is not None and e.nav_T_body is not None]


@pytest.fixture(scope="module")
def expected(room_walk: Path) -> list[str]:
    return trajectory(room_walk, to_s=PIECE_S)


@pytest.mark.parametrize("kind", ["mcap", "rosbag1", "rosbag2", "euroc"])
def test_odometry_is_equal_on_all_formats(kind: str, room_walk: Path, expected: list[str], tmp_path: Path) -> None:
    assert len(expected) > 10
    assert trajectory(converted(room_walk, out_of(kind, tmp_path), "--to", str(PIECE_S))) == expected


@pytest.mark.usefixtures("without_plots")
def test_run_is_evaluated_with_the_truth_in_a_session(room_walk: Path, tmp_path: Path) -> None:
    session = converted(room_walk, tmp_path / "room.mcap", "--to", str(PIECE_S))
    figures = []
    for path, options in ((room_walk, ["--to", str(PIECE_S)]), (session, [])):
        out = tmp_path / f"result-{path.name}"
        done = CliRunner().invoke(app, ["run", str(path), "--out", str(out), *options])
        assert done.exit_code == 0, done.output
        figures.append(json.loads((out / "summary.json").read_text())["evaluation"]["ate_position_m"]["rmse"])
    assert figures[1] == pytest.approx(figures[0], rel=1e-6)


@pytest.mark.parametrize(
    ("name", "asked", "expected"),
    [("a.mcap", None, "mcap"), ("a.bag", None, "rosbag1"), ("a", "rosbag2", "rosbag2"), ("a.d", "euroc", "euroc")],
)
def test_format_goes_by_the_name(name: str, asked: str | None, expected: str) -> None:
    assert format_of(Path(name), asked) == expected


@pytest.mark.parametrize(
    ("name", "asked", "words"),
    [
        ("a", None, "shows no format; name a file .mcap or .bag, or give --format rosbag2 or --format euroc"),
        ("a.mcap", "avi", "give one of mcap, rosbag1, rosbag2, euroc"),
        ("a.bag", "mcap", "is not how mcap is named; name it .mcap"),
        ("a", "rosbag1", "is not how rosbag1 is named; name it .bag"),
        ("a.bag", "rosbag2", "is not how rosbag2 is named; name a folder without that ending"),
    ],
)
def test_format_with_another_name_is_refused(name: str, asked: str | None, words: str) -> None:
    with pytest.raises(SessionError, match=words):
        format_of(Path(name), asked)


@pytest.mark.parametrize("kind", ["mcap", "rosbag1", "rosbag2", "euroc"])
def test_convert_overwrites_nothing(kind: str, recording: Path, tmp_path: Path) -> None:
    out = converted(recording, out_of(kind, tmp_path), "--to", "0.1")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    given = ["--format", kind] if out.suffix == "" else []
    again = CliRunner().invoke(app, ["convert", str(recording), "--out", str(out), *given])
    assert isinstance(again.exception, SessionError)
    assert "never overwritten" in str(again.exception)
    assert before == {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    nowhere = CliRunner().invoke(app, ["convert", str(recording), "--out", f"/proc/none/{out.name}", *given])
    assert "cannot be written" in str(nowhere.exception)


def test_convert_on_a_full_disk_exits_with_3(recording: Path, tmp_path: Path) -> None:
    """A limit on the size of files is as good as a full disk."""
    code = f"""
import resource, signal
from typer.testing import CliRunner
from graphvio.cli import app
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
for limit, arguments in ((60_000, ["/x.mcap"]), (60_000, ["/x.bag"]), (60_000, ["/x", "--format", "rosbag2"]),
                         (3_072, ["/y", "--format", "euroc"])):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    name, *options = arguments
    done = CliRunner().invoke(app, ["convert", {str(recording)!r}, "--out", {str(tmp_path)!r} + name, *options])
    print(done.exit_code, done.stderr.strip().splitlines()[-1], flush=True)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    lines = done.stdout.splitlines()
    assert len(lines) == 4, (done.stdout, done.stderr)
    for line, can in zip(lines, ("can be read", "cannot be read", "cannot be read", "can be read"), strict=True):
        assert line.startswith("3 ")
        assert "stopped (" in line
        assert f"what was written until then {can}" in line


def test_record_of_a_bag_is_refused(recording: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["record", str(recording), "--out", str(tmp_path / "a.bag")])
    assert "name it .mcap" in str(done.exception)


def test_missing_or_invalid_truth_is_reported(recording: Path, tmp_path: Path) -> None:
    plain = write_euroc(tmp_path / "plain", frames=2)
    session = converted(plain, tmp_path / "plain.mcap")
    assert open_source(session).truth is None
    with pytest.raises(TrajectoryError, match="holds no trajectory"):
        load_trajectory(session)
    with pytest.raises(TrajectoryError, match="is no trajectory file, and no session"):
        load_trajectory(plain)
    write_rows(plain / "mav0/state_groundtruth_estimate0/data.csv", ["1,2,3"])
    done = CliRunner().invoke(app, ["convert", str(plain), "--out", str(tmp_path / "again.mcap")])
    assert done.exit_code == 0
    assert "the true trajectory is left out" in done.stderr


def test_bag_messages_are_read_in_any_order(recording: Path, tmp_path: Path) -> None:
    """The library alone would read all messages before the wanted one."""
    for path in (converted(recording, tmp_path / "walk.bag"), converted(recording, tmp_path / "rosbag2")):
        bag = open_store(path)
        places = bag.topics["/imu"].places
        forth = [bag.read(place) for place in places]
        assert [bag.read(place) for place in reversed(places)] == forth[::-1]
        assert len(set(forth)) == len(places)


@pytest.fixture(scope="module")
def trajectory_of_the_clip(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    if not CLIP.is_dir():
        pytest.skip("shared/data/euroc_mh01_clip is absent")
    return trajectory_of(half_size_clip(), tmp_path_factory.mktemp("clip") / "results", *CLIP_PIECE)


def trajectory_of(source: Path, out: Path, *options: str) -> bytes:
    with undrawn():
        done = CliRunner().invoke(app, ["run", str(source), "--out", str(out), *options])
    assert done.exit_code == 0, done.output
    return (out / "trajectory.txt").read_bytes()


@pytest.mark.parametrize("name", ["recorded.mcap", "clip.bag", "clip"])
def test_real_recording_gives_equal_results_from_all_formats(
    name: str, trajectory_of_the_clip: bytes, tmp_path: Path
) -> None:
    """From the MCAP file that ``record`` makes while the odometry runs, and from bags of ROS 1 and ROS 2."""
    verb = ["record"] if name == "recorded.mcap" else ["convert"]
    kind = ["--format", "rosbag2"] if name == "clip" else []
    made = CliRunner().invoke(app, [*verb, str(half_size_clip()), "--out", str(tmp_path / name), *kind, *CLIP_PIECE])
    assert made.exit_code == 0, made.output
    assert trajectory_of(tmp_path / name, tmp_path / "results") == trajectory_of_the_clip
