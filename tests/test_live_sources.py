"""Live sources without devices: what is written on the command line, replays, and the simulated rig."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from live_runs import SOON_S
from recordings import write_euroc
from rendered import rendered_once

from graphvio import FrameSet, open_source
from graphvio.errors import SourceError
from graphvio.geometry import so3_exp
from graphvio.live.sources import SourceSpec, open_live_source
from graphvio.live.sources.replay import Pace, paced, speed_of
from graphvio.live.sources.simulated_faults import DeviceFaults, Outage, devices_of, with_faults
from graphvio.live.sources.simulator import _leg
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import CameraFrame, ImuReading, Notice, Reading, host_ns
from graphvio.measurements.sensors import ImuSample, Measurement
from graphvio.simulation import simulate
from graphvio.simulation.simulator import make_simulator


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("replays") / "walk", frames=20)


@pytest.fixture(scope="module")
def stationary() -> Path:
    """Half a second of the room, stationary."""
    return rendered_once("room", lambda folder: simulate("room", folder, duration_s=0.5, seed=3), "640x480", 0.5)


def all_of(spec: str) -> list[Reading]:
    source = open_live_source(spec)
    source.open()
    return list(source.readings())


def images_and_samples(readings: list[Reading]) -> tuple[list[CameraFrame], list[ImuReading]]:
    return [r for r in readings if isinstance(r, CameraFrame)], [r for r in readings if isinstance(r, ImuReading)]


def test_replay_samples_before_first_image_come_at_once(recording: Path) -> None:
    """They begin a second before it."""
    source = open_live_source(f"replay:{recording}")
    source.open()
    begun_ns = host_ns()
    samples = 0
    for reading in source.readings():
        if isinstance(reading, CameraFrame):
            break
        samples += 1
    source.close()
    assert samples > 150
    assert host_ns() - begun_ns < 0.7e9


# ---------------------------------------------------------------- what is written


def test_spec_is_parsed() -> None:
    spec = SourceSpec.parse("realsense:0123,4567?rate_hz=30&width=640")
    assert spec == SourceSpec("realsense", "0123,4567", {"rate_hz": "30", "width": "640"})
    assert SourceSpec.parse("simulator") == SourceSpec("simulator")
    assert SourceSpec.parse("replay:/data/a:b=c.mcap").what == "/data/a:b=c.mcap"


def test_the_path_of_a_recording_is_a_replay_of_it(tmp_path: Path) -> None:
    (tmp_path / "a:walk").mkdir()
    spec = SourceSpec.parse(f"{tmp_path}/a:walk?speed=2")
    assert spec == SourceSpec("replay", f"{tmp_path}/a:walk", {"speed": "2"})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("simulater", "there is no live source 'simulater'.*simulator"),
        ("walk.mcap", "there is no live source 'walk.mcap'.*replay"),
        ("", "there is no live source ''"),
        (
            "room",
            "no recording at that path; the simulated scene of that name is simulator:room, or made by  graphvio sim",
        ),
        ("stairs?seed=2", "is simulator:stairs.seed=2, or.*replay:PATH"),
        ("simulator:room?speed", "option 'speed' has no value; write KEY=VALUE"),
        ("simulator:room?=3", "has no value"),
        ("simulator:room?speed=1&speed=2", "option speed is given twice"),
        ("simulator:room?sped=2", "simulator has no option 'sped'.*speed"),
        ("simulator:rom", "there is no scene 'rom'; there are .*room"),
        ("simulator:room?speed=fast", "speed is 'fast'"),
        ("simulator:room?legs=1.5", "a whole number"),
        ("simulator:room?legs=0", "from 1"),
        ("simulator:room?duration_s=nan", "duration_s is 'nan'"),
        ("simulator:room?speed=1000", "number from 0.01 to 100"),
        ("replay:walk?speed=fast", "replay: speed is 'fast'; write a number from 0.01 to 100, or max$"),
        ("simulator:room?speed=2&drift_ppm=10", "drift_ppm needs speed=1"),
        ("replay", "names no recording"),
        ("replay:nowhere", "nowhere"),
        ("replay:nowhere?legs=2", "replay has no option 'legs'"),
    ],
)
def test_open_live_source_bad_spec_is_refused(text: str, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        open_live_source(text)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("unplug=left@1-2", "there is no device 'left'; there are front, back, imu"),
        ("unplug=back@1", "a fault's value is not a number"),
        ("unplug=back@8-5", "for no time"),
        ("jitter_ms=nan", "jitter_ms is not from 0"),
        ("drift_ppm=nan", "drift_ppm not from"),
        ("jitter_ms=-1", "jitter_ms is not from 0"),
        ("drift_ppm=5000", "drift_ppm not from"),
        ("seed=-1&legs=1", "seed is '-1'"),
        ("rate_hz=0&legs=1", "rate_hz is '0'"),
    ],
)
def test_simulator_bad_option_is_refused(stationary: Path, option: str, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        open_live_source(f"simulator:room?recording={stationary}&{option}").open()


# ---------------------------------------------------------------- replays


def test_replay_yields_whole_recording(recording: Path) -> None:
    source = open_source(recording)
    expected = list(source)
    frames, samples = images_and_samples(all_of(f"replay:{recording}?speed=max"))
    assert [(s.stamp_ns, s.clock) for s in samples] == [
        (e.stamp_ns, None) for e in expected if isinstance(e, ImuSample)
    ]
    framesets = [e for e in expected if isinstance(e, FrameSet)]
    assert [f.stamp_ns for f in frames] == [e.stamp_ns for e in framesets for _ in range(4)]
    assert [f.camera for f in frames[:4]] == ["cam0", "cam1", "cam2", "cam3"]
    np.testing.assert_array_equal(frames[6].decode(), framesets[1].images[1][0])


def test_replay_reports_faults_of_recording(recording: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    broken.symlink_to(write_euroc(tmp_path / "walk", frames=4, pairs=1))
    next((broken / "mav0/cam1/data").glob("*.png")).write_bytes(b"no image")
    notices = [r for r in all_of(f"replay:{broken}?speed=max") if isinstance(r, Notice)]
    assert notices
    source = open_live_source(f"replay:{broken}?speed=max")
    source.open()
    list(source.readings())
    (health,) = source.health()
    assert sum(health.counts.values()) == len(notices)


def test_replay_keeps_pace_of_recording(recording: Path) -> None:
    """Never faster, however busy the machine is: one second of images at five times the pace."""
    begun_s = time.monotonic()
    readings = all_of(f"replay:{recording}?speed=5")
    assert time.monotonic() - begun_s > 0.18
    assert open_live_source(f"replay:{recording}?speed=10").is_realtime
    assert not open_live_source(f"replay:{recording}?speed=max").is_realtime
    frames, _ = images_and_samples(readings)
    apart_ns = frames[-1].arrival_ns - frames[0].arrival_ns
    assert apart_ns > 0.8 * (frames[-1].stamp_ns - frames[0].stamp_ns) / 10


def test_replay_close_ends_wait(recording: Path) -> None:
    source = open_live_source(f"replay:{recording}?speed=0.01")
    source.open()
    thread = threading.Thread(target=lambda: list(source.readings()), daemon=True)
    thread.start()
    source.close()
    source.close()
    thread.join(SOON_S)
    assert not thread.is_alive()


def test_pace_skips_lost_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [10_000_000_000]
    monkeypatch.setattr("graphvio.live.sources.replay.host_ns", lambda: now[0])
    pace = Pace(1.0)
    waits: list[float] = []
    monkeypatch.setattr(pace._stop, "wait", waits.append)
    pace.wait_for(0)
    now[0] += 5_000_000_000  # the machine slept
    pace.wait_for(1_000_000_000)
    pace.wait_for(1_500_000_000)
    assert waits == pytest.approx([0.5])


@pytest.mark.parametrize("text", ["0", "-1", "101", "nan", "x"])
def test_speed_of_bad_value_is_refused(text: str) -> None:
    with pytest.raises(SourceError, match=r"speed is .*; write a number from 0\.01 to 100"):
        speed_of(SourceSpec("replay", "walk", {"speed": text}))


def test_speed_of_values() -> None:
    given = [{}, {"speed": "max"}, {"speed": "2.5"}]
    assert [speed_of(SourceSpec("replay", "walk", options)) for options in given] == [1.0, None, 2.5]


# ---------------------------------------------------------------- the simulated rig, to and fro


def test_simulator_way_back_reverses_way_there(room_walk: Path) -> None:
    """Rotations by the gyro cancel, accelerations and images come in the other order."""
    source = open_source(room_walk)
    track = make_simulator("room").imu_track
    there, back = ([*_leg(source, track, leg)] for leg in (0, 1))

    def samples(measurements: list[Measurement]) -> list[ImuSample]:
        return [e for e in measurements if isinstance(e, ImuSample)]

    def framesets(measurements: list[Measurement]) -> list[FrameSet]:
        return [e for e in measurements if isinstance(e, FrameSet)]

    stamps = [e.stamp_ns for e in (*samples(there), *samples(back))]
    assert np.ptp(np.diff(stamps)) <= 1
    image_stamps = [e.stamp_ns for e in (*framesets(there), *framesets(back))]
    assert set(np.diff(image_stamps).tolist()) == {50_000_000}
    assert len(framesets(there)) == len(framesets(back)) + 1 == 100
    for going, coming in zip(framesets(there)[:-1], framesets(back)[::-1], strict=True):
        for j in (0, 1):
            for one, other in zip(going.images[j], coming.images[j], strict=True):
                np.testing.assert_array_equal(one, other)
    begin_R_now = np.eye(3)
    farthest_rad = 0.0
    ways = [*samples(there), *samples(back)]
    for k in range(len(ways) - 1):
        mean = 0.5 * (ways[k].angular_velocity + ways[k + 1].angular_velocity)
        bias = track.gyro_bias[min(k, 2 * (len(samples(there)) - 1) - k)]
        begin_R_now = begin_R_now @ so3_exp((mean - bias) * 0.005)
        farthest_rad = max(farthest_rad, float(np.arccos(np.clip((np.trace(begin_R_now) - 1) / 2, -1, 1))))
    left_rad = float(np.arccos(np.clip((np.trace(begin_R_now) - 1) / 2, -1, 1)))
    assert farthest_rad > 0.2
    assert left_rad < 0.01  # at the turn, where this walk does not stop, the rate jumps
    for one_way, other_way in zip(samples(there)[:-1], samples(back)[::-1], strict=True):
        np.testing.assert_array_equal(one_way.linear_acceleration, other_way.linear_acceleration)


def test_simulator_walk_ending_in_motion_is_not_reversed(room_walk: Path) -> None:
    spec = f"simulator:room?recording={room_walk}"
    with pytest.raises(SourceError, match="does not end stationary, so that it cannot be walked back"):
        open_live_source(spec).open()
    open_live_source(f"{spec}&legs=1").open()
    open_live_source(f"{spec}&duration_s=4").open()


def test_simulator_lasts_legs_or_duration(stationary: Path) -> None:
    spec = f"simulator:room?recording={stationary}&seed=3&speed=max"
    frames, samples = images_and_samples(all_of(f"{spec}&legs=3"))
    assert len(frames) == 4 * (10 + 9 + 9)
    assert np.ptp(np.diff([s.stamp_ns for s in samples])) <= 1
    frames, _ = images_and_samples(all_of(f"{spec}&duration_s=2"))
    assert frames[-1].stamp_ns - frames[0].stamp_ns == 2_000_000_000
    source = open_live_source(spec)
    source.open()
    count = 0
    for _ in source.readings():
        count += 1
        if count == 2000:
            source.close()
    assert count == 2000


# ---------------------------------------------------------------- faults


def test_device_faults_are_parsed() -> None:
    faults = DeviceFaults.parse({"unplug": "back@5-8,imu@20-21.5", "jitter_ms": "2"}, ("front", "back", "imu"))
    assert faults == DeviceFaults(None, 2.0, (Outage("back", 5.0, 8.0), Outage("imu", 20.0, 21.5)))


def faulty(recording: Path, faults: DeviceFaults) -> Iterator[Reading]:
    source = open_source(recording)
    readings = paced(source, source.rig, Pace(None))
    return with_faults(readings, source.rig, faults, source.start_ns, seed=1)


def test_outage_drops_readings_and_is_reported_once(recording: Path) -> None:
    start_ns = open_source(recording).start_ns
    outages = (Outage("pair1", 0.2, 0.6), Outage("imu", 0.3, 0.4))
    readings = list(faulty(recording, DeviceFaults(outages=outages)))
    notices = [(r.kind, r.clock) for r in readings if isinstance(r, Notice)]
    assert notices == [
        (EventKind.DEVICE_LOST, "pair1"),
        (EventKind.DEVICE_LOST, "imu"),
        (EventKind.DEVICE_BACK, "imu"),
        (EventKind.DEVICE_BACK, "pair1"),
    ]
    frames, samples = images_and_samples(readings)
    gone = {f.stamp_ns - start_ns for f in frames if f.camera == "cam0"} - {
        f.stamp_ns - start_ns for f in frames if f.camera == "cam2"
    }
    assert sorted(gone) == [50_000_000 * i for i in range(4, 12)]
    assert max(np.diff([s.stamp_ns for s in samples])) == 105_000_000


def test_drift_gives_each_device_a_clock(recording: Path) -> None:
    source = open_source(recording)
    assert devices_of(source.rig) == ("pair0", "pair1", "imu")
    readings = list(faulty(recording, DeviceFaults(drift_ppm=100.0)))
    frames, samples = images_and_samples(readings)
    intervals = {}
    for device in ("pair0", "pair1", "imu"):
        of_device: list[CameraFrame | ImuReading] = [*frames, *samples]
        stamps = [r.stamp_ns for r in of_device if r.clock == device]
        intervals[device] = (stamps[-1] - stamps[0]) / 1e9
    assert intervals["pair0"] == pytest.approx(0.95 * (1 + 1e-4), abs=1e-8)
    assert intervals["pair1"] == pytest.approx(0.95 * (1 - 1e-4), abs=1e-8)
    assert {f.clock for f in frames if f.camera in ("cam2", "cam3")} == {"pair1"}


def test_jitter_keeps_order_per_device_and_loses_none(recording: Path) -> None:
    expected_frames, expected_samples = images_and_samples(list(faulty(recording, DeviceFaults())))
    begun_ns = host_ns()
    frames, samples = images_and_samples(list(faulty(recording, DeviceFaults(jitter_ms=5.0))))
    assert [s.stamp_ns for s in samples] == [s.stamp_ns for s in expected_samples]
    for camera in ("cam0", "cam1", "cam2", "cam3"):
        assert [f.stamp_ns for f in frames if f.camera == camera] == [
            f.stamp_ns for f in expected_frames if f.camera == camera
        ]
    assert [(f.camera, f.stamp_ns) for f in frames] != [(f.camera, f.stamp_ns) for f in expected_frames]
    arrivals = [s.arrival_ns for s in samples]
    assert arrivals == sorted(arrivals)
    assert arrivals[0] > begun_ns
