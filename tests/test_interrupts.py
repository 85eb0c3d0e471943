"""Ctrl-C at any moment: a line that says what was saved, and exit code 130."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import pytest
from recordings import write_euroc
from typer.testing import CliRunner

from graphvio import FrameSet, open_source
from graphvio.cli import app, main
from graphvio.errors import MissingExtraError
from graphvio.runtime import HeldInterrupt, interruptible
from graphvio.sessions.store import open_store

pytest.importorskip("mcap")
pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("interrupts") / "walk", frames=6, pairs=1)


@pytest.fixture(autouse=True)
def cold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graphvio.warmup.warm_up", lambda *_, **__: None)


def interrupted_kernel(*_: Any, **__: Any) -> NoReturn:
    """Raise what numba does at Ctrl-C in a kernel, after an outer function has failed on that in turn."""
    try:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as cause:
            raise SystemError("CPUDispatcher(...) returned a result with an exception set") from cause
    except SystemError:
        raise SystemError("<method 'next'> returned a result with an exception set")  # noqa: B904


def interrupted_import(*_: Any, **__: Any) -> NoReturn:
    """Raise what pybind11 does at Ctrl-C while a library is loaded."""
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as cause:
        raise ImportError("initialization failed") from cause


def interrupted_extra(*_: Any, **__: Any) -> NoReturn:
    """Raise what an optional library does."""
    try:
        interrupted_import()
    except ImportError:
        raise MissingExtraError("pycolmap", "maps", "a map") from None


def missing(*_: Any, **__: Any) -> NoReturn:
    raise MissingExtraError("pycolmap", "maps", "a map")


def broken(*_: Any, **__: Any) -> NoReturn:
    raise SystemError("bad argument to internal function")


def test_interruptible_kernel_is_an_interrupt() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible():
        interrupted_kernel()
    with pytest.raises(SystemError, match="bad argument"), interruptible():
        broken()


@pytest.mark.parametrize("load", [interrupted_import, interrupted_extra])
def test_interruptible_import_is_an_interrupt(load: Callable[[], NoReturn]) -> None:
    with pytest.raises(KeyboardInterrupt), interruptible():
        load()
    with pytest.raises(MissingExtraError), interruptible():
        missing()


def test_record_interrupted_leaves_a_readable_session(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from graphvio.odometry import Odometry

    start_ns = open_source(recording).start_ns

    def interrupted(odometry: Odometry, measurement: Any) -> None:
        if isinstance(measurement, FrameSet) and measurement.stamp_ns > start_ns:
            interrupted_kernel()

    monkeypatch.setattr(Odometry, "process", interrupted)
    out = tmp_path / "walk.mcap"
    done = CliRunner().invoke(app, ["record", str(recording), "--out", str(out)])
    assert done.exit_code == 130
    assert (
        done.stderr.splitlines()[-1]
        == f"graphvio: interrupted; what was recorded until then is in {out}, which can be read"
    )
    assert open_store(out).is_whole
    assert len([measurement for measurement in open_source(out) if isinstance(measurement, FrameSet)]) == 2


@pytest.mark.parametrize(
    ("command", "stub"),
    [("run", "graphvio.pipeline.run"), ("optimize", "graphvio.optimization.pipeline.optimize_sessions")],
)
def test_run_interrupted_says_where_its_results_are(
    command: str, stub: str, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stub, interrupted_kernel)
    options = ["--no-loops"] if command == "optimize" else []
    done = CliRunner().invoke(app, [command, str(recording), "--out", str(tmp_path / "out"), *options])
    assert done.exit_code == 130
    assert "graphvio: interrupted; " in done.stderr
    assert str(tmp_path / "out") in done.stderr


def test_main_interrupted_has_no_traceback(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graphvio.sources.contents.describe_folder", interrupted_kernel)
    monkeypatch.setattr(sys, "argv", ["graphvio", "info", str(recording)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130


def test_held_interrupt_second_is_raised() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with HeldInterrupt() as held:
            held.check()
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                held.check()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


_RECORDER = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
import graphvio.warmup
from graphvio.cli import main
from graphvio.odometry import Odometry
def process(self, measurement):
    print(measurement.stamp_ns, flush=True)
    time.sleep(0.02)
graphvio.warmup.warm_up = lambda *_, **__: None
Odometry.process = process
sys.argv = ["graphvio", "record", {source!r}, "--out", {out!r}]
main()
"""


def test_record_real_interrupt_ends_the_process(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "walk.mcap"
    code = _RECORDER.format(source=str(recording), out=str(out))
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as recorder:
        assert recorder.stdout is not None
        for _ in range(5):
            recorder.stdout.readline()
        os.kill(recorder.pid, signal.SIGINT)
        _, printed = recorder.communicate(timeout=30)
    assert recorder.returncode == 130, printed
    assert f"interrupted; what was recorded until then is in {out}, which can be read" in printed
    assert "Traceback" not in printed
    file = open_store(out)
    assert file.is_whole
    assert 5 <= len(file.topics["/imu"].places) < 240
