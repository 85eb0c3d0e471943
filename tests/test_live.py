"""The live system: threads that come to the same as the plain odometry, and that end whatever happens."""

from __future__ import annotations

import gc
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_runs import SOON_S, Figures, Scripted, Stalling, assert_same, plain, run, run_spec, small_readings
from recordings import noise_image, small_rig

from graphvio import FrameSet, open_source
from graphvio.arrays import Image
from graphvio.config import Config
from graphvio.config.stages import LiveConfig
from graphvio.errors import GraphvioError, RigError, ServiceError, SourceError
from graphvio.live import running as running_module
from graphvio.live import session_recorder
from graphvio.live.health import HealthServer
from graphvio.live.outputs import Output
from graphvio.live.running import LiveOdometry
from graphvio.live.session_recorder import SessionRecorder
from graphvio.live.stages import Stage
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.readings import Notice, Reading
from graphvio.measurements.sensors import ImuSample, Measurement
from graphvio.sessions.store import open_store


def until(is_so: Callable[[], Any]) -> None:
    """Wait; only a test that fails waits long."""
    end_s = time.monotonic() + SOON_S
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def threads_of_a_run() -> list[str]:
    names = ("capture", "decode", "odometry", "output", "watchdog", "record")
    return [t.name for t in threading.enumerate() if t.name in {f"graphvio-{name}" for name in names}]


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    gc.collect()
    until(lambda: not threads_of_a_run())


# ---------------------------------------------------------------- the same estimates


def test_live_replay_and_its_recording_equal_plain_odometry(room_walk: Path, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    rig, expected = open_source(room_walk).rig, plain(room_walk)
    recorder = SessionRecorder(tmp_path / "live.mcap", rig, waits=True)
    estimates, _, figures = run_spec(f"replay:{room_walk}?speed=max", [recorder])
    recorder.close()
    assert_same(estimates, expected)
    assert figures["framesets"] == figures["estimates"] == recorder.status()["recorded_framesets"] == len(expected)
    assert figures["health"] == "ok"
    assert recorder.status()["recorded_poses"] == sum(each.nav_T_body is not None for each in expected)
    assert open_store(tmp_path / "live.mcap").is_whole
    assert_same(plain(tmp_path / "live.mcap"), expected)


@pytest.mark.parametrize("speed", ["4", "40"])
def test_live_realtime_run_estimates_or_counts_every_frameset(room_walk: Path, speed: str) -> None:
    """At forty times its speed there is no time for all of it on any machine."""
    source = open_source(room_walk)
    samples = sum(isinstance(measurement, ImuSample) for measurement in source)
    estimates, _, figures = run_spec(f"replay:{room_walk}?speed={speed}")
    skipped = int(figures["skipped_late"] or 0) + int(figures["skipped_no_room"] or 0)
    assert figures["estimates"] == len(estimates) > 5
    assert len(estimates) + skipped == figures["framesets"]
    assert figures["imu_samples"] == samples
    assert figures["imu_lost"] == 0
    given_up = skipped + int(figures.get("images_not_decoded") or 0)
    assert figures["framesets"] == 100 or given_up
    if speed == "40":
        assert given_up
    stamps = [each.stamp_ns for each in estimates]
    assert stamps == sorted(stamps)


def test_live_silent_imu_is_not_awaited_beyond_limit(room_walk: Path) -> None:
    estimates, events, figures = run_spec(f"simulator:room?recording={room_walk}&legs=1&unplug=imu@3-4")
    assert int(figures["imu_not_awaited"] or 0) >= 1
    assert "imu_not_covering" in {event.kind for event in events}
    assert {each.epoch for each in estimates} == {0}
    assert estimates[-1].status == "tracking"


def test_live_cameras_back_while_imu_runs_continue_epoch(room_walk: Path) -> None:
    simulator = f"simulator:room?recording={room_walk}&speed=max&legs=1"
    estimates, events, figures = run_spec(f"{simulator}&unplug=front@2-3,back@2-3")
    assert {each.epoch for each in estimates} == {0}
    assert estimates[-1].status == "tracking"
    assert figures["framesets"] == 80
    kinds = [event.kind for event in events]
    assert kinds.count("device_lost") == kinds.count("device_back") == 2


def test_live_one_lost_pair_leaves_other_tracking(room_walk: Path) -> None:
    estimates, _, figures = run_spec(f"simulator:room?recording={room_walk}&speed=max&legs=1&unplug=back@2-3")
    assert {(each.epoch, each.status) for each in estimates[-60:]} == {(0, "tracking")}
    assert sum(set(each.pairs) == {0} for each in estimates) >= 20
    assert set(estimates[-1].pairs) == {0, 1}
    assert figures["framesets"] == 100


def test_live_long_outage_of_all_begins_a_new_epoch(room_walk: Path) -> None:
    gone = "@1.5-4.7"
    estimates, events, _ = run_spec(
        f"simulator:room?recording={room_walk}&speed=max&legs=1&unplug=front{gone},back{gone},imu{gone}"
    )
    assert sorted({each.epoch for each in estimates}) == [0, 1]
    assert "time_jump" in {event.kind for event in events}


def test_live_drifting_clocks_and_late_readings_are_corrected(room_walk: Path) -> None:
    """With the times of arrival that a host would have noted, whatever this machine has to do meanwhile."""
    from graphvio.live.sources.replay import Pace, paced
    from graphvio.live.sources.simulated_faults import DeviceFaults, with_faults
    from graphvio.trajectory_files import load_trajectory

    source = open_source(room_walk)
    rig = source.rig
    host_start_ns = source.start_ns + 3_600_000_000_000

    def readings() -> Iterator[Reading]:
        rng = np.random.default_rng(0)
        for reading in with_faults(
            paced(source, rig, Pace(None)), rig, DeviceFaults(drift_ppm=200.0), source.start_ns, seed=0
        ):
            assert not isinstance(reading, Notice)
            stamp_ns = reading.stamp_ns % 7_000_000_000_000
            late_ns = 1_000_000 + round(rng.exponential(2e6))
            yield replace(reading, arrival_ns=host_start_ns + stamp_ns + late_ns)

    estimates, events, figures = run(Scripted(rig, readings))
    assert [each.kind for each in events if each.kind.startswith(("clock", "stamp", "image", "late", "imu"))] == []
    assert figures["framesets"] == len(estimates)
    assert figures["imu_samples"] == 1001
    second = [each for each in estimates if each.stamp_ns - estimates[0].stamp_ns > 1_000_000_000]
    assert all(set(each.pairs) == {0, 1} for each in second)  # at first the delays of both are not known
    assert 78 <= len(second) <= 80
    assert {each.epoch for each in estimates} == {0}
    assert source.truth is not None
    truth = load_trajectory(source.truth)
    true_m = truth.around(source.start_ns, source.end_ns).nav_T_body[[0, -1], :3, 3]  # stationary in the first second
    found_m = np.array([e.nav_T_body[:3, 3] for e in estimates if e.nav_T_body is not None])[[0, -1]]
    walked_m = [np.linalg.norm(at[1] - at[0]) for at in (true_m, found_m)]
    assert walked_m[0] > 1.0
    assert walked_m[1] == pytest.approx(walked_m[0], abs=0.03)


# ---------------------------------------------------------------- what ends a run


def damaged_at(frame: int, error: Exception) -> Callable[[int, Image], Image]:
    def decode(i: int, image: Image) -> Image:
        if i >= frame * 10:
            raise error
        return image

    return decode


def wrong_size_at(frame: int) -> Callable[[int, Image], Image]:
    return lambda i, image: image if i < frame * 10 else noise_image(0, (32, 24))


def broken_source() -> Iterator[Reading]:
    yield from small_readings(small_rig(1), 20)
    raise SourceError("the driver is gone")


class Failing(Output):
    """Fails at its third result, and from then on at everything that happens."""

    def __init__(self) -> None:
        self._results = 0

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        self._results += 1
        if self._results == 3:
            raise GraphvioError("the window was closed")

    def add_event(self, event: Event) -> None:
        if self._results >= 3:
            raise GraphvioError("nothing can be shown")


@pytest.mark.parametrize("is_realtime", [False, True], ids=["waits", "realtime"])
@pytest.mark.parametrize(
    ("make", "outputs", "error", "message", "stage"),
    [
        (broken_source, [], SourceError, "the driver is gone", "capture"),
        (
            lambda: small_readings(small_rig(1), 400, damaged_at(10, ValueError("no image"))),
            [],
            ValueError,
            "no image",
            "decode",
        ),
        (lambda: small_readings(small_rig(1), 400, wrong_size_at(40)), [], RigError, "32", "odometry"),
        (lambda: small_readings(small_rig(1), 400), [Failing()], GraphvioError, "the window was closed", "output"),
    ],
    ids=["capture", "decode", "odometry", "output"],
)
def test_live_failing_stage_ends_run(
    make: Callable[[], Iterator[Reading]],
    outputs: list[Output],
    error: type[Exception],
    message: str,
    stage: str,
    is_realtime: bool,
) -> None:
    """More readings follow than fit into all the queues."""
    outputs = [Failing()] if outputs else []
    source = Scripted(small_rig(1), make, is_realtime, interval_s=0.0005 if is_realtime else 0.0)
    running = LiveOdometry(source, source.open(), Config(), outputs)
    events, estimates = running.events.subscribe(1000), running.estimates.subscribe(1)
    running.start()
    with pytest.raises(error, match=message):
        running.wait(SOON_S)
    assert running.status()["health"] == "failing"
    assert stage in str(running.status()["stuck"])
    for _ in range(2):
        with pytest.raises(error, match=message):
            running.stop()
    assert threads_of_a_run() == []
    assert events.is_closed
    assert estimates.is_closed
    assert running.keyframe_log.is_closed
    kinds, failed = [], []
    while (event := events.get()) is not None:
        kinds.append(event.kind)
        failed += [event.detail] if event.kind == "stage_failed" else []
    assert failed[0].startswith(f"{stage}: ")  # an output that fails at everything takes others along
    assert "stage_stuck" not in kinds


@pytest.mark.parametrize("is_realtime", [False, True], ids=["waits", "realtime"])
def test_live_failing_decoder_releases_waiting_capture(is_realtime: bool) -> None:
    runs: list[LiveOdometry] = []
    most = 63 if is_realtime else 8  # of 64: in real time all may have come before the first one is taken

    def decode(i: int, image: Image) -> Image:
        until(lambda: int(runs[0].status()["waiting_images"] or 0) >= most)
        raise ValueError("no image")

    source = Scripted(small_rig(1), lambda: small_readings(small_rig(1), 400, decode), is_realtime)
    runs.append(LiveOdometry(source, source.open(), Config()))
    runs[0].start()
    with pytest.raises(ValueError, match="no image"):
        runs[0].wait(SOON_S)
    with pytest.raises(ValueError, match="no image"):
        runs[0].stop()
    assert threads_of_a_run() == []
    assert "event_stage_stuck" not in runs[0].status()


def test_live_failure_keeps_earlier_results() -> None:
    """A recording that breaks off has all estimates until then."""
    put_out: list[int] = []

    class Noting(Output):
        def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
            put_out.append(estimate.stamp_ns)
            assert frameset is not None
            assert frameset.stamp_ns == estimate.stamp_ns

    source = Scripted(small_rig(1), broken_source)
    running = LiveOdometry(source, source.open(), Config(), [Noting()])
    running.start()
    with pytest.raises(SourceError):
        running.wait(SOON_S)
    with pytest.raises(SourceError):
        running.stop()
    assert len(put_out) == 20
    assert put_out == sorted(put_out)


def test_live_damaged_image_is_reported_and_run_continues() -> None:
    def decode(i: int, image: Image) -> Image:
        if i == 50:
            raise SourceError("half a JPEG")
        return image

    estimates, events, figures = run(Scripted(small_rig(1), lambda: small_readings(small_rig(1), 20, decode)))
    assert len(estimates) == 19
    assert figures["event_image_damaged"] == 2
    assert [each.detail for each in events if each.kind == "image_damaged"] == ["half a JPEG"] * 2


def test_live_stop_processes_pending_measurements() -> None:
    source = Scripted(small_rig(1), lambda: small_readings(small_rig(1), 100_000))
    running = LiveOdometry(source, source.open(), Config())
    estimates = running.estimates.subscribe(100_000)
    running.start()
    assert estimates.get(SOON_S) is not None
    running.stop()
    running.stop()
    figures = running.status()
    assert figures["estimates"] == figures["framesets"]
    assert figures["health"] == "ok"
    assert running.wait(0.0)
    assert threads_of_a_run() == []


def test_live_stop_before_start_closes_broadcasts() -> None:
    source = Scripted(small_rig(1), lambda: small_readings(small_rig(1)))
    running = LiveOdometry(source, source.open(), Config())
    listener = running.estimates.subscribe(1)
    running.stop()
    assert listener.is_closed


@pytest.mark.parametrize("is_realtime", [False, True], ids=["waits", "realtime"])
def test_live_stop_leaves_stuck_output_behind(is_realtime: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running_module, "_END_S", 0.5)
    stalling = Stalling()
    source = Scripted(small_rig(1), lambda: small_readings(small_rig(1), 2000), is_realtime, 0.001 * is_realtime)
    running = LiveOdometry(source, source.open(), Config(), [stalling])
    events = running.events.subscribe(1000)
    running.start()
    assert stalling.is_held.wait(SOON_S)
    running.stop()
    assert events.is_closed
    reported = []
    while (event := events.get()) is not None:
        reported.append(event)
    assert "output does not end; left behind" in [each.detail for each in reported if each.kind == "stage_stuck"]
    stalling.may_go_on.set()  # and is gone when it does go on, see `no_thread_is_left`


def test_live_stop_leaves_stuck_source_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running_module, "_END_S", 0.5)
    is_hanging, goes_on = threading.Event(), threading.Event()

    def hanging() -> Iterator[Reading]:
        yield from small_readings(small_rig(1), 10)
        is_hanging.set()
        goes_on.wait(SOON_S)

    source = Scripted(small_rig(1), hanging, is_realtime=True)
    running = LiveOdometry(source, source.open(), Config())
    estimates = running.estimates.subscribe(100)
    running.start()
    assert is_hanging.wait(SOON_S)
    running.stop()
    assert running.status()["event_stage_stuck"] == 1
    goes_on.set()
    figures = running.status()
    assert int(figures["estimates"] or 0) + int(figures["skipped_no_room"] or 0) == figures["framesets"] == 10
    assert estimates.is_closed


def test_stage_failure_is_reported_before_cleanup() -> None:
    happened: list[str] = []

    def body(stage: Stage) -> None:
        with stage.working():
            assert stage.busy_s >= 0.0
            stage.progress()
            with stage.waiting():
                assert stage.busy_s == 0.0
        with stage.waiting():
            pass
        assert (stage.busy_s, stage.done) == (0.0, 2)
        raise SourceError("gone")

    stage = Stage("test", body, lambda s, error: happened.append(f"{s.name} {error}"), lambda: happened.append("end"))
    stage.start()
    assert stage.join(SOON_S)
    assert happened == ["test gone", "end"]
    assert isinstance(stage.failure, SourceError)
    assert not stage.is_alive


# ---------------------------------------------------------------- health


def asked(address: str, path: str) -> tuple[int, str]:
    connection = HTTPConnection(address, timeout=SOON_S)
    connection.request("GET", path)
    response = connection.getresponse()
    text = response.read().decode()
    connection.close()
    return response.status, text


def test_watchdog_stalled_output_is_stuck_until_it_recovers() -> None:
    pytest.importorskip("prometheus_client")
    stalling = Stalling()
    config = Config(live=LiveConfig(stuck_s=0.3))
    source = Scripted(small_rig(1), lambda: small_readings(small_rig(1), 100_000), is_realtime=True, interval_s=0.005)
    running = LiveOdometry(source, source.open(), config, [stalling])
    events = running.events.subscribe(1000)
    health = HealthServer(running.status)
    running.start()
    assert stalling.is_held.wait(SOON_S)
    until(lambda: asked(health.address, "/healthz")[0] == 503)
    status, text = asked(health.address, "/healthz")
    until(lambda: "event_stage_stuck" in running.status())
    if status == 503:
        assert "output" in json.loads(text)["stuck"]
    stalling.may_go_on.set()
    until(lambda: asked(health.address, "/healthz")[0] == 200)
    until(lambda: "event_stage_recovered" in running.status())
    running.stop()
    health.close()
    reported = []
    while (event := events.get()) is not None:
        reported.append((event.kind, event.detail.split()[0]))
    assert reported.index(("stage_stuck", "output")) < reported.index(("stage_recovered", "output"))


def test_watchdog_silent_sensors_are_reported_as_healthy_run() -> None:
    may_go_on = threading.Event()

    def readings() -> Iterator[Reading]:
        yield from small_readings(small_rig(1), 5)
        may_go_on.wait(SOON_S)
        yield from small_readings(small_rig(1), 100_000)

    source = Scripted(small_rig(1), readings, is_realtime=True, interval_s=0.002)
    running = LiveOdometry(source, source.open(), Config(live=LiveConfig(stuck_s=0.3)))
    running.start()
    until(lambda: {"event_cameras_silent", "event_imu_silent"} <= running.status().keys())
    assert running.is_healthy
    may_go_on.set()
    until(lambda: {"event_cameras_back", "event_imu_back"} <= running.status().keys())
    running.stop()


FIGURES: Figures = {
    "health": "ok", "status": "tracking", "stuck": "", "estimates": 12, "skipped_late": 3, "event_device_lost": 2,
    "status_tracking": 10, "recorded_framesets": 7, "latency_p99_ms": 41.5, "temperature_c": None, "epoch": 1,
}  # fmt: skip


def test_health_metrics_are_valid_for_prometheus() -> None:
    pytest.importorskip("prometheus_client")
    from prometheus_client.parser import text_string_to_metric_families

    health = HealthServer(lambda: FIGURES)
    code, text = asked(health.address, "/metrics")
    health.close()
    assert code == 200
    families = {family.name: family for family in text_string_to_metric_families(text)}
    values = {each.name: each.value for family in families.values() for each in family.samples}
    assert values["graphvio_up"] == 1.0
    assert values["graphvio_estimates_total"] == 12.0
    assert values["graphvio_latency_p99_ms"] == 41.5
    counters = {name for name, family in families.items() if family.type == "counter"}
    assert counters == {f"graphvio_{name}" for name in (
        "estimates", "skipped_late", "event_device_lost", "status_tracking", "recorded_framesets"
    )}  # fmt: skip
    states = {each.labels["status"]: each.value for each in families["graphvio_status"].samples}
    assert states == {"initialising": 0.0, "tracking": 1.0, "coasting": 0.0, "lost": 0.0, "stale": 0.0}
    assert "graphvio_temperature_c" not in values


def test_health_of_whole_run_is_metrics_and_json() -> None:
    pytest.importorskip("prometheus_client")
    from prometheus_client.parser import text_string_to_metric_families

    source = Scripted(small_rig(1), lambda: small_readings(small_rig(1), 30))
    running = LiveOdometry(source, source.open(), Config())
    health = HealthServer(running.status)
    running.start()
    running.wait(SOON_S)
    running.stop()
    values = {
        each.name: each.value
        for family in text_string_to_metric_families(asked(health.address, "/metrics")[1])
        for each in family.samples
    }
    status = json.loads(asked(health.address, "/healthz")[1])
    health.close()
    assert values["graphvio_framesets_total"] == status["framesets"] == 30
    assert values["graphvio_imu_samples_total"] == status["imu_samples"] == 300
    assert values["graphvio_corner_share"] == 1.0
    assert status["latency_p99_all_ms"] is None or status["latency_p99_all_ms"] > 0.0


def test_health_failing_run_and_unknown_path_return_error_codes() -> None:
    pytest.importorskip("prometheus_client")
    health = HealthServer(lambda: {"health": "failing", "stuck": "odometry"})
    assert asked(health.address, "/healthz")[0] == 503
    assert "graphvio_up 0.0" in asked(health.address, "/metrics")[1]
    assert asked(health.address, "/")[0] == 404
    assert health.address.startswith("127.0.0.1:")
    health.close()


def test_health_idle_client_blocks_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("prometheus_client")
    monkeypatch.setattr("graphvio.live.health._QuietHandler.timeout", 10.0 * SOON_S)
    health = HealthServer(lambda: FIGURES)
    host, port = health.address.split(":")
    with socket.create_connection((host, int(port))):
        assert asked(health.address, "/healthz")[0] == 200
        closing = threading.Thread(target=health.close, daemon=True)
        closing.start()
        closing.join(SOON_S)
        assert not closing.is_alive()


def test_health_taken_port_raises() -> None:
    pytest.importorskip("prometheus_client")
    health = HealthServer(lambda: FIGURES)
    port = int(health.address.split(":")[1])
    with pytest.raises(ServiceError, match=f"127.0.0.1:{port}: cannot be listened on"):
        HealthServer(lambda: FIGURES, port=port)
    health.close()


# ---------------------------------------------------------------- recording


class SlowDisk:
    """The writer is blocked by its first measurement until it may go on."""

    def __init__(self, recorder: SessionRecorder) -> None:
        self.may_go_on = threading.Event()
        self.is_held = threading.Event()
        write = recorder._writer.add

        def add(measurement: Measurement) -> None:
            self.is_held.set()
            assert self.may_go_on.wait(SOON_S)
            write(measurement)

        recorder._writer.add = add  # type: ignore[method-assign]


def measurements(framesets: int) -> Iterator[Measurement]:
    rig = small_rig(1)
    image = noise_image(0)
    for i in range(framesets):
        yield ImuSample(i * 50_000_000, np.zeros(3), np.zeros(3))
        yield FrameSet(i * 50_000_000, {0: (image, image)})
    assert len(rig.pairs) == 1


def test_recorder_slow_disk_drops_framesets_only(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    recorder = SessionRecorder(tmp_path / "slow.mcap", small_rig(1))
    disk = SlowDisk(recorder)
    for measurement in measurements(200):
        recorder.add_measurement(measurement)
    assert disk.is_held.wait(SOON_S)
    assert recorder.status()["framesets_not_recorded"] == 80
    disk.may_go_on.set()
    recorder.close()
    status = recorder.status()
    assert (status["recorded_framesets"], status["messages_not_recorded"], status["recording_stopped"]) == (120, 0, "")
    recorded = list(open_source(tmp_path / "slow.mcap"))
    assert sum(isinstance(measurement, ImuSample) for measurement in recorded) == 200
    assert sum(isinstance(measurement, FrameSet) for measurement in recorded) == 120


def test_recorder_stuck_disk_drops_and_counts_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mcap")
    monkeypatch.setattr(session_recorder, "_WAITING", 50)
    recorder = SessionRecorder(tmp_path / "still.mcap", small_rig(1))
    disk = SlowDisk(recorder)
    recorder.add_measurement(ImuSample(0, np.zeros(3), np.zeros(3)))
    assert disk.is_held.wait(SOON_S)
    for i in range(1, 101):
        recorder.add_measurement(ImuSample(i, np.zeros(3), np.zeros(3)))
    assert recorder.status()["messages_not_recorded"] == 50
    disk.may_go_on.set()
    recorder.close()


def test_recorder_that_waits_records_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mcap")
    monkeypatch.setattr(session_recorder, "_WAITING", 5)
    recorder = SessionRecorder(tmp_path / "all.mcap", small_rig(1), waits=True)
    for measurement in measurements(200):
        recorder.add_measurement(measurement)
    recorder.close()
    status = recorder.status()
    assert (status["recorded_framesets"], status["framesets_not_recorded"], status["messages_not_recorded"]) == (
        200,
        0,
        0,
    )


def test_recorder_unwritable_message_does_not_stop_others(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    recorder = SessionRecorder(tmp_path / "odd.mcap", small_rig(1))
    recorder.add_measurement(ImuSample(-1, np.zeros(3), np.zeros(3)))
    for measurement in measurements(3):
        recorder.add_measurement(measurement)
    recorder.close()
    assert recorder.status()["recorded_framesets"] == 3
    assert "-1" in str(recorder.status()["recording_stopped"])


def test_recorder_removed_disk_is_no_failure(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    folder = tmp_path / "stick"
    folder.mkdir()
    recorder = SessionRecorder(folder / "walk.mcap", small_rig(1))
    folder.rename(tmp_path / "gone")
    assert recorder.status()["disk_free_gb"] is None
    recorder.close()
