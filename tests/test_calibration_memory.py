"""What live runs learn of the calibration is kept by device, and the next run begins with it."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.calibration_differences import calibration_differences
from typer.testing import CliRunner

from graphvio.calibration_sigmas import FACTORY
from graphvio.cli import app
from graphvio.errors import RigError
from graphvio.live.calibration_memory import CalibrationMemory, devices_of, widened
from graphvio.rig import Rig
from graphvio.rig_files import load_rig, save_rig
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.simulation.default_rig import default_rig

KEPT, LEARNT, OTHER = "kept for the next run of simulator-room", "as learnt by the run of ", "is of another rig file"


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The user's cache, empty, while kernels stay where they are."""
    monkeypatch.setattr("graphvio.live.calibration_memory.cache_root", lambda: tmp_path / "cache")
    monkeypatch.setattr("graphvio.warmup.warm_up", lambda *_, **__: None)
    return tmp_path / "cache/calibrations"


def wrong(path: Path, true: Rig, seed: int) -> Path:
    save_rig(draw(true, CalibrationErrorSizes.of_level(2), seed).written_rig, path)
    return path


def live(source: str, *arguments: object) -> Any:
    done = CliRunner().invoke(app, ["live", source, *map(str, arguments)])
    assert done.exit_code == 0, done.output
    return done.output


def test_live_begins_with_what_the_last_run_of_the_device_learnt(room_walk: Path, tmp_path: Path, folder: Path) -> None:
    simulator = f"simulator:room?recording={room_walk}&legs=1&speed=max"
    true = load_rig(room_walk)
    rig = wrong(tmp_path / "rig.yaml", true, 0)
    first = live(simulator, "--rig", rig)
    assert KEPT in first
    assert LEARNT not in first
    (memory,) = folder.iterdir()
    before, after = (calibration_differences(load_rig(path), true) for path in (rig, memory))
    for name in ("left_right_deg", "pair_transform_deg"):
        assert np.linalg.norm(after[name]) < 0.5 * np.linalg.norm(before[name]), name
    assert load_rig(memory).calibration_sigmas.stereo_rotation_deg < 0.5 * FACTORY.stereo_rotation_deg

    second = live(f"{simulator}&duration_s=1", "--rig", rig)
    assert second.count(LEARNT) == 1
    assert [path.name for path in folder.iterdir()] == [memory.name]

    hours_ago_s = time.time() - 4 * 3600.0
    os.utime(memory, (hours_ago_s, hours_ago_s))  # so that it is worth being confirmed
    confirmed = live(simulator, "--rig", rig)
    assert LEARNT in confirmed
    assert KEPT in confirmed
    assert memory.stat().st_mtime > hours_ago_s + 3600.0
    after = calibration_differences(load_rig(memory), true)
    assert np.linalg.norm(after["left_right_deg"]) < 0.5 * np.linalg.norm(before["left_right_deg"])

    other_rig = wrong(tmp_path / "other.yaml", true, 1)
    other = live(simulator, "--rig", other_rig)
    assert OTHER in other
    assert LEARNT not in other
    assert [path.name for path in folder.iterdir()] != [memory.name]  # of the newest rig file only

    assert LEARNT in live(f"{simulator}&duration_s=1", "--rig", other_rig)
    assert LEARNT not in live(f"{simulator}&duration_s=1", "--rig", other_rig, "--forget-calibration")


def test_live_of_one_camera_begins_with_what_its_last_run_learnt(vga_walk: Path, tmp_path: Path, folder: Path) -> None:
    simulator = f"simulator:room?recording={vga_walk}&legs=1&speed=max"
    rig = wrong(tmp_path / "rig.yaml", load_rig(vga_walk), 0)
    assert KEPT in live(simulator, "--rig", rig, "--cameras", "0")
    (memory,) = folder.iterdir()
    assert [single.name for single in load_rig(memory).singles] == ["cam0"]
    assert live(f"{simulator}&duration_s=1", "--rig", rig, "--cameras", "0").count(LEARNT) == 1


def test_live_keeps_nothing_of_recordings_and_where_the_calibration_is_not_estimated(
    room_walk: Path, tmp_path: Path, folder: Path
) -> None:
    rig = wrong(tmp_path / "rig.yaml", load_rig(room_walk), 0)
    assert "kept for the next run" not in live(f"replay:{room_walk}?speed=max&to_s=3", "--rig", rig)
    (tmp_path / "fixed.yaml").write_text("calibration: {online: false}\n")
    simulator = f"simulator:room?recording={room_walk}&duration_s=3&speed=max"
    assert KEPT not in live(simulator, "--rig", rig, "--config", tmp_path / "fixed.yaml")
    assert not folder.exists()


def test_memory_is_found_by_serial_number_or_by_rig() -> None:
    assert devices_of("realsense:0123,4567?rate_hz=30", "realsense-0123-4567") == "realsense-0123-4567"
    assert devices_of("v4l2:/dev/video0,/dev/video2", "v4l2") == ""
    assert devices_of("replay:walk.mcap", "walk") is None


def test_memory_of_a_rig_without_serial_number_is_of_that_rig_only(tmp_path: Path) -> None:
    rig, other = default_rig(), draw(default_rig(), CalibrationErrorSizes.of_level(1), 0).written_rig
    memory = CalibrationMemory("", rig, tmp_path)
    save_rig(rig, memory.path)
    assert memory.recall() is not None
    assert CalibrationMemory("", other, tmp_path).recall() is None
    CalibrationMemory("", other, tmp_path).forget()
    assert memory.path.exists()


def test_memory_that_is_damaged_is_refused(tmp_path: Path) -> None:
    memory = CalibrationMemory("oak-1", default_rig(), tmp_path)
    memory.path.write_text("graphvio_rig: 1\npairs: [")
    with pytest.raises(RigError, match="oak-1"):
        memory.recall()
    memory.forget()
    assert memory.recall() is None


def test_memory_is_less_certain_as_time_passes(tmp_path: Path) -> None:
    memory = CalibrationMemory("oak-1", default_rig(), tmp_path)
    save_rig(Rig(default_rig().pairs, default_rig().imu, "rig", FACTORY.scaled(0.1)), memory.path)
    sigmas = []
    for hours in (0.0, 0.5, 1000.0):
        saved_s = time.time() - 3600.0 * hours
        os.utime(memory.path, (saved_s, saved_s))
        remembered = memory.recall()
        assert remembered is not None
        sigmas.append(remembered.rig.calibration_sigmas.body_rotation_deg)
    assert sigmas[0] == pytest.approx(0.1 * FACTORY.body_rotation_deg, rel=0.01)
    assert 2.0 * sigmas[0] < sigmas[1] < sigmas[2]
    assert sigmas[2] == FACTORY.body_rotation_deg
    assert widened(FACTORY.scaled(2.0), FACTORY, 10.0) == FACTORY.scaled(2.0)
