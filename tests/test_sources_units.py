"""Stamps and samples in other units than the layout's are noticed before they are taken for nanoseconds and m/s^2."""

from pathlib import Path

import pytest
from command_line import graphvio
from dataset_layouts import rendered_walk
from test_rig_files_joining import write_kalibr

from graphvio.errors import SourceError
from graphvio.measurements.events import EventKind
from graphvio.rig_files import find_rig, load_rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.tables import read_frame_csv, read_imu_csv

BEGIN_NS, PERIOD_NS, ROWS = 1_700_000_000_000_000_000, 5_000_000, 40


def imu_csv(folder: Path, stamp: str = "{ns}", force: float = 9.81) -> Path:
    rows = [f"{stamp.format(ns=ns, s=ns / 1e9, us=ns // 1000)},0.1,0,0,0,0,{force}" for ns in stamps()]
    (folder / "data.csv").write_text("\n".join(["#timestamp,wx,wy,wz,ax,ay,az", *rows]) + "\n")
    return folder / "data.csv"


def stamps() -> list[int]:
    return [BEGIN_NS + PERIOD_NS * k for k in range(ROWS)]


@pytest.mark.parametrize("unit", ["{s:.6f}", "{us}"])
def test_stamps_in_other_units_are_refused(unit: str, tmp_path: Path) -> None:
    path = imu_csv(tmp_path, unit)
    with pytest.raises(SourceError, match=r"data\.csv: rows are .* have to be whole nanoseconds"):
        read_imu_csv(path, FaultLog("walk"))
    with pytest.raises(SourceError, match="have to be whole nanoseconds"):
        read_frame_csv(path, FaultLog("walk"))


def test_rows_that_are_there_twice_are_counted(tmp_path: Path) -> None:
    path, faults = imu_csv(tmp_path), FaultLog("walk")
    first, *rows = path.read_text().splitlines()
    path.write_text("\n".join([first, *(row for row in rows for _ in range(2))]) + "\n")
    assert read_imu_csv(path, faults).stamps_ns.tolist() == stamps()
    assert faults.counts == {"imu_duplicate": ROWS}


def test_rows_in_reverse_are_refused(tmp_path: Path) -> None:
    path = imu_csv(tmp_path)
    first, *rows = path.read_text().splitlines()
    path.write_text("\n".join([first, *reversed(rows)]) + "\n")
    with pytest.raises(SourceError, match=r"data\.csv: stamps decrease from row to row"):
        read_imu_csv(path, FaultLog("walk"))


@pytest.mark.parametrize(("force", "faults"), [(1.0, 1), (9.7, 0), (14.0, 0), (981.0, 1)])
def test_accelerometer_in_other_units_is_reported(force: float, faults: int, tmp_path: Path) -> None:
    log = FaultLog("walk")
    assert len(read_imu_csv(imu_csv(tmp_path, force=force), log).stamps_ns) == ROWS
    assert log.counts.get(EventKind.IMU_UNITS, 0) == faults


@pytest.mark.usefixtures("without_plots")
def test_run_says_what_to_check_where_the_imu_contradicts_vision(tmp_path: Path) -> None:
    walk = rendered_walk()
    (tmp_path / "own").mkdir()
    for entry in walk.iterdir():
        if entry.name != "mav0":
            (tmp_path / "own" / entry.name).symlink_to(entry)
    (tmp_path / "own/mav0/imu0").mkdir(parents=True)
    for entry in (walk / "mav0").iterdir():
        if entry.name != "imu0":
            (tmp_path / "own/mav0" / entry.name).symlink_to(entry)
    rows = [line.split(",") for line in (walk / "mav0/imu0/data.csv").read_text().splitlines() if line[0] != "#"]
    degrees = [[row[0], *(f"{57.3 * float(x):.9f}" for x in row[1:4]), *row[4:]] for row in rows]
    (tmp_path / "own/mav0/imu0/data.csv").write_text("\n".join(",".join(row) for row in degrees) + "\n")
    done = graphvio("run", tmp_path / "own", "--out", tmp_path / "results")
    assert done.returncode in (0, 3), done.stderr
    assert "check the calibration (graphvio rig), the IMU's units" in done.stderr


def test_camera_chain_next_to_mav0_is_found(tmp_path: Path) -> None:
    rig = load_rig(rendered_walk())
    for k in range(2):
        (tmp_path / f"mav0/cam{k}").mkdir(parents=True)
    assert find_rig(tmp_path) is None
    write_kalibr(rig.pairs[0], tmp_path / "camchain-imucam.yaml", rig.imu)
    found = find_rig(tmp_path)
    assert found is not None
    assert [camera.name for camera in found.cameras] == ["cam0", "cam1"]
