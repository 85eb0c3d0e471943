"""``graphvio live`` as it is typed: results, ends of runs, and refusals in one line."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import command_line
import pytest
from recordings import write_euroc
from rich.console import Console
from typer.testing import CliRunner

from graphvio import FrameSet, open_source
from graphvio.cli import app
from graphvio.cli.dashboard import Dashboard, line_of, summary_of
from graphvio.errors import GraphvioError, RigError
from graphvio.live import sources
from graphvio.measurements.events import Event
from graphvio.measurements.readings import DeviceHealth
from graphvio.queues import Broadcast
from graphvio.runtime import StopSignals
from graphvio.sessions.store import open_store

pytest.importorskip("mcap")
pytest.importorskip("prometheus_client")

SOON_S = 100.0  # only a test that fails takes so long
MAIN = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from graphvio.cli import main
main()
"""


def graphvio(*arguments: object) -> list[str]:
    return [sys.executable, "-c", MAIN, *map(str, arguments)]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of noise at a standstill."""
    return write_euroc(tmp_path_factory.mktemp("cli_live") / "walk", frames=400, pairs=1)


@pytest.fixture
def cold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graphvio.warmup.warm_up", lambda *_, **__: None)


def live(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["live", *map(str, arguments)])


def refused(*arguments: object) -> str:
    """Return the one line that `graphvio.cli.main` prints with exit code 2."""
    done = command_line.graphvio("live", *arguments)
    assert done.returncode == 2, (done.stdout, done.stderr)
    (line,) = done.stderr.splitlines()
    assert line.startswith("graphvio: ")
    return line


def wait_until(is_so: Callable[[], Any], process: subprocess.Popen[Any]) -> None:
    end_s = time.monotonic() + SOON_S
    while not is_so():
        assert process.poll() is None
        assert time.monotonic() < end_s
        time.sleep(0.02)


# ---------------------------------------------------------------- real processes


def recording_process(recording: Path, out: Path, *options: object) -> subprocess.Popen[str]:
    """Start a process that records, and wait until it has begun to."""
    process = subprocess.Popen(
        graphvio("live", f"replay:{recording}", "--record", out, *options),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_until(lambda: out.exists() and out.stat().st_size > 200_000, process)
    return process


def framesets_in(session: Path) -> int:
    return sum(isinstance(measurement, FrameSet) for measurement in open_source(session))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "Ctrl-C"])
def test_live_at_a_signal_saves_everything(recording: Path, tmp_path: Path, number: signal.Signals) -> None:
    out = tmp_path / "walk.mcap"
    process = recording_process(recording, out)
    process.send_signal(number)
    output, errors = process.communicate(timeout=SOON_S)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert open_store(out).is_whole
    framesets = framesets_in(out)
    assert 0 < framesets < 400
    assert f"{out}: " in output.splitlines()[-1]
    assert output.splitlines()[-1].endswith(f" {framesets} framesets")
    assert f" of {framesets} framesets, latency p99 " in output.splitlines()[-2]


def test_live_killed_leaves_a_readable_recording(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "walk.mcap"
    process = recording_process(recording, out)
    process.kill()
    process.communicate(timeout=SOON_S)
    assert process.returncode == -signal.SIGKILL
    assert not open_store(out).is_whole
    assert framesets_in(out) > 5


_LIMITED = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
import graphvio.warmup
graphvio.warmup.warm_up = lambda *_, **__: None
from graphvio.sessions import mcap_storage
mcap_storage._CHUNK_BYTES = 20_000  # so that the size on the disk does not depend on speed
from graphvio.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))
main()
"""


def test_live_full_disk_ends_only_the_recording(recording: Path, tmp_path: Path) -> None:
    """A limit on the size of files stands for a full disk."""
    out = tmp_path / "full.mcap"
    done = subprocess.run(
        [sys.executable, "-c", _LIMITED, "live", f"replay:{recording}?speed=max&to_s=5", "--record", str(out)],
        capture_output=True,
        text=True,
        timeout=SOON_S,
    )
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    stopped = re.search(r"recording stopped .*: (\d+) framesets of 101$", done.stderr.splitlines()[-1])
    assert stopped is not None, done.stderr
    assert int(stopped[1]) == framesets_in(out)
    assert "101 estimates of 101 framesets" in done.stdout
    assert 5 < framesets_in(out) < 101


def test_live_in_a_terminal_shows_a_panel(recording: Path) -> None:
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        graphvio("live", f"replay:{recording}", "--health-port", 0),
        stdout=theirs,
        stderr=theirs,
        env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "120", "LINES": "40"},
    )
    os.close(theirs)
    shown = bytearray()

    def read() -> None:
        try:
            while part := os.read(ours, 4096):
                shown.extend(part)
        except OSError:  # the other end is closed
            return

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    wait_until(lambda: shown.count(b"latency") >= 2 and b"given up" in shown, process)
    process.send_signal(signal.SIGINT)
    assert process.wait(SOON_S) == 0
    reader.join(SOON_S)
    os.close(ours)
    text = shown.decode()
    for name in ("status", "rate", "points", "bias", "memory", "framesets/s", "connected"):
        assert name in text
    assert "health: http://127.0.0.1:" in text
    assert "Traceback" not in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["simulater"], "there is no live source 'simulater'"),
        (["replay:nowhere"], "nowhere"),
        ([], "give a SOURCE, or --list"),
    ],
)
def test_live_wrong_source_is_one_line(arguments: list[str], message: str) -> None:
    assert message in refused(*arguments)


# ---------------------------------------------------------------- in this process


@pytest.mark.usefixtures("cold")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["replay:{recording}?sped=2"], "replay has no option 'sped'"),
        (["replay:{recording}", "--record", "walk.bag"], "name it .mcap"),
        (["replay:{recording}", "--record", "nowhere/walk.mcap"], "nowhere"),
        (["replay:{recording}", "--config", "nothing"], "nothing"),
        (["replay:{recording}", "--rig", "nothing.yaml"], "nothing.yaml"),
    ],
)
def test_live_wrong_option_is_an_error(recording: Path, arguments: list[str], message: str) -> None:
    done = live(*(each.format(recording=recording) for each in arguments))
    assert isinstance(done.exception, GraphvioError)
    assert message in str(done.exception)


def test_live_existing_recording_is_refused_before_the_source_opens(tmp_path: Path) -> None:
    out = tmp_path / "walk.mcap"
    out.touch()
    done = live("replay:no-recording", "--record", out)
    assert str(done.exception).startswith(f"{out}: exists")
    assert not out.stat().st_size


@pytest.mark.usefixtures("cold")
def test_live_error_in_a_thread_is_raised_and_the_recording_saved(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from graphvio.odometry import Odometry

    process = Odometry.process
    count = 0

    def wrong(odometry: Odometry, measurement: Any) -> Any:
        nonlocal count
        count += isinstance(measurement, FrameSet)
        if count == 20:
            raise RigError("camera cam0: images are 32 x 24 px, the rig says 64 x 48; give the right rig")
        return process(odometry, measurement)

    monkeypatch.setattr(Odometry, "process", wrong)
    out = tmp_path / "walk.mcap"
    done = live(f"{recording}?speed=max", "--record", out)
    assert isinstance(done.exception, RigError)
    assert open_store(out).is_whole
    assert framesets_in(out) >= 20


@pytest.mark.usefixtures("cold")
def test_live_ends_after_the_given_duration(recording: Path) -> None:
    done = live(f"replay:{recording}?speed=0.1", "--for", "0.5")
    assert done.exit_code == 0, done.exception
    assert "estimates of" in done.stdout


@pytest.mark.usefixtures("cold")
def test_live_port_in_use_leaves_no_thread_and_no_recording(recording: Path, tmp_path: Path) -> None:
    from graphvio.live.health import HealthServer

    taken, out = HealthServer(dict), tmp_path / "walk.mcap"
    done = live(f"replay:{recording}", "--health-port", taken.address.split(":")[1], "--record", out)
    taken.close()
    assert "cannot be listened on" in str(done.exception)
    assert not out.exists()
    assert not [t.name for t in threading.enumerate() if t.name in ("graphvio-capture", "graphvio-odometry")]


def test_list_names_all_kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(str(sources.__file__)).parent
    there = tuple(kind for kind in sources.KINDS if (folder / f"{kind}.py").exists())
    assert {"replay", "simulator"} <= set(there)
    monkeypatch.setattr(sources, "KINDS", there)
    done = live("--list")
    assert done.exit_code == 0, done.exception
    assert {line.split()[0] for line in done.stdout.splitlines()} == set(there)
    assert "simulator  simulator:room   simulated rig, scene room" in done.stdout


def test_list_names_a_missing_library(monkeypatch: pytest.MonkeyPatch) -> None:
    from graphvio.errors import MissingExtraError
    from graphvio.live.sources import replay, simulator

    def missing() -> Any:
        raise MissingExtraError("pyrealsense2", "realsense", "a RealSense camera")

    monkeypatch.setattr(sources, "KINDS", ("replay", "simulator"))
    monkeypatch.setattr(replay, "list_devices", missing)
    monkeypatch.setattr(simulator, "list_devices", list)
    done = live("--list")
    assert done.exit_code == 0
    assert done.stdout.splitlines() == [
        "replay     a RealSense camera needs pyrealsense2: install it with  pip install 'graphvio[realsense]'",
        "simulator  nothing is connected",
    ]


# ---------------------------------------------------------------- signals


def test_stop_signals_second_interrupt_is_raised() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with StopSignals() as signals:
            signal.raise_signal(signal.SIGINT)
            assert signals.came
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_stop_signals_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with StopSignals() as signals:
            signal.raise_signal(signal.SIGINT)
            came = [signals.came]
            signal.raise_signal(signal.SIGTERM)
            came.append(signals.came)
        assert came == [False, True]
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


# ---------------------------------------------------------------- display

FIGURES: dict[str, float | int | str | None] = {
    "status": "tracking", "epoch": 1, "estimate_hz": 19.5, "frameset_hz": 20.0, "imu_hz": 200.0, "latency_p50_ms": 31.2,
    "latency_p99_ms": 55.0, "latency_p99_all_ms": 60.5, "latency_max_ms": 70.0, "skipped_late": 2, "skipped_no_room": 1,
    "corner_share": 0.7, "pair0_points": 150, "pair0_inliers": 140, "pair1_points": 90, "pair1_inliers": 80,
    "gyro_bias_rad_s": 0.0123, "accel_bias_m_s2": 0.05, "memory_mb": 700.0, "temperature_c": 41.25,
    "recorded_framesets": 12, "disk_free_gb": 3.5, "recording_stopped": "", "stuck": "output", "framesets": 43,
    "estimates": 40, "imu_lost": 0,
}  # fmt: skip


def test_line_of_has_all_figures() -> None:
    line = line_of(FIGURES)
    assert "\n" not in line
    for part in (
        "tracking ", "19.5 of 20.0 framesets/s", "IMU 200 Hz", "p50 31.2 ms, p99 55.0 ms, longest 70 ms",
        "2 framesets late, 1 without room; corners 70 %", "140/150  80/90", "gyro 0.0123 rad/s", "700 MB", "41.2 C",
        "12 framesets, 3.5 GB free", "stuck output",
    ):  # fmt: skip
        assert part in line
    assert summary_of(FIGURES) == (
        "40 estimates of 43 framesets, latency p99 60.5 ms, skipped_late 2, skipped_no_room 1, imu_lost 0"
    )


def test_line_of_without_figures_has_no_none() -> None:
    assert line_of({}).startswith("waiting ")
    assert "None" not in line_of({"temperature_c": None, "latency_p50_ms": None, "corner_share": 1.0})
    assert summary_of({}) == "0 estimates of 0 framesets, latency p99 - ms"


def test_line_of_stopped_recording_says_why() -> None:
    line = line_of({**FIGURES, "recording_stopped": "walk.mcap: recording stopped (No space left on device)"})
    assert "No space left on device" in line
    assert "GB free" not in line


def test_dashboard_repeated_events_are_shown_once() -> None:
    events: Broadcast[Event] = Broadcast()
    dashboard = Dashboard("walk", events.subscribe(64))
    shown = Console(record=True, file=open(os.devnull, "w"), width=200)  # noqa: PTH123, SIM115
    dashboard._console = shown
    for i in range(20):
        events.publish(Event(i, "vision_gated", f"[{i}]"))
    events.publish(Event(20, "device_lost", "front was unplugged"))
    dashboard.show(FIGURES, [])
    lines = shown.export_text().splitlines()
    assert lines[:2] == ["vision_gated: [0]", "device_lost: front was unplugged"]
    assert lines[2].startswith("tracking")
    assert len(lines) == 3


def test_dashboard_panel_has_devices_and_events() -> None:
    dashboard = Dashboard("walk", Broadcast[Event]().subscribe(1))
    dashboard._show_event(Event(0, "stage_stuck", "output has worked on one item"), 100.0)
    console = Console(record=True, file=open(os.devnull, "w"), width=150)  # noqa: PTH123, SIM115
    console.print(dashboard._panel(FIGURES, [DeviceHealth("front", False, "unplugged", {"dropped": 3})]))
    text = console.export_text()
    for part in ("walk", "tracking, epoch 1", "lost  unplugged, dropped 3", "stage_stuck: output has worked"):
        assert part in text
