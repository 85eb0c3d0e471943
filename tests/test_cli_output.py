"""Standard output that cannot be written: results are, and one line says why the output is not."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import pytest

from graphvio.cli import main
from graphvio.cli.output import LastingStream, lasting_streams
from graphvio.rig_files import save_rig
from graphvio.simulation import default_rig

FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="the system has no /dev/full")


@contextmanager
def left_pipe() -> Iterator[TextIO]:
    """A pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream:
        yield stream


def exit_code(*typed: object, stdout: TextIO, monkeypatch: pytest.MonkeyPatch) -> int | str | None:
    monkeypatch.setattr(sys, "argv", ["graphvio", *map(str, typed)])
    monkeypatch.setattr(sys, "stdout", stdout)
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


@needs_full
@pytest.mark.parametrize("typed", [["dump-config"], ["dump-config", "--json"], ["--version"], ["--help"]])
def test_command_full_disk_says_so_in_one_line(
    typed: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with FULL.open("w") as full:
        assert exit_code(*typed, stdout=full, monkeypatch=monkeypatch) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert "standard output" in printed


@needs_full
def test_command_full_disk_fails_otherwise_keeps_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with FULL.open("w") as full:
        assert exit_code("info", tmp_path / "none", stdout=full, monkeypatch=monkeypatch) == 2
    assert "does not exist" in capsys.readouterr().err


def test_command_reader_left_still_writes_its_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save_rig(default_rig(), tmp_path / "rig.yaml")
    out = tmp_path / "again.yaml"  # is written after the rig is printed
    with left_pipe() as pipe:
        assert exit_code("rig", tmp_path / "rig.yaml", "--out", out, stdout=pipe, monkeypatch=monkeypatch) == 0
    assert out.is_file()
    assert capsys.readouterr().err == ""


def test_lasting_streams_stderr_reader_left_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    with left_pipe() as pipe:
        monkeypatch.setattr(sys, "stderr", pipe)
        with lasting_streams():
            print("a warning", file=sys.stderr, flush=True)
            print("another one", file=sys.stderr, flush=True)
            assert isinstance(sys.stderr, LastingStream)
            assert isinstance(sys.stderr.error, BrokenPipeError)


def test_lasting_stream_failure_is_kept() -> None:
    with left_pipe() as pipe:
        stream = LastingStream(pipe)
        assert (stream.write("a line\n"), stream.error) == (7, None)
        stream.flush()
        assert isinstance(stream.error, BrokenPipeError)


def test_lasting_streams_none_there_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    with lasting_streams() as output:
        print("to nowhere")
        assert output is None
