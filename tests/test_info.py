"""``graphvio info`` on recordings in folders, and on paths that are none."""

import json
from pathlib import Path

import pytest
from command_line import graphvio
from recordings import read_rows, write_euroc, write_kitti_odometry, write_rows

from graphvio.errors import SourceError
from graphvio.rig_files import load_rig, save_rig
from graphvio.sources import open_source


def refused(path: Path, folder: Path) -> str:
    ran = graphvio("info", path, folder=folder)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr.count("\n") == 1
    return ran.stderr


def test_folder_is_described(tmp_path: Path) -> None:
    write_euroc(tmp_path / "walk", pairs=2, frames=10)
    ran = graphvio("info", "walk", folder=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    lines = ran.stdout.splitlines()
    assert lines[0] == "walk: EuRoC/ASL and TUM-VI, 0.5 s, 10 framesets at 20.00 Hz"
    assert lines[1].startswith("rig: ")
    assert lines[1].endswith("with IMU")
    assert lines[2] == "cam0: 10 images of 64x48, 20.00 Hz, jitter 0.00 ms, 0 gaps, longest interval 50.0 ms"
    assert [line.partition(":")[0] for line in lines[2:]] == ["cam0", "cam1", "cam2", "cam3", "imu", "true trajectory"]


def test_faults_are_those_of_the_recording(tmp_path: Path) -> None:
    walk = write_euroc(tmp_path / "walk", pairs=1, frames=10)
    rows = read_rows(walk / "mav0/cam0/data.csv")
    write_rows(walk / "mav0/cam0/data.csv", [*rows[:4], *rows[6:]])
    (walk / "mav0/cam1/data" / rows[2].split(",")[1]).unlink()
    document = json.loads(graphvio("info", "walk", "--json", folder=tmp_path).stdout)
    assert document["faults"] == {"frame_gap": 1, "image_missing": 1, "unpaired_image": 2}
    cam0, cam1 = document["sensors"][:2]
    assert (cam0["count"], cam0["regularity"]["gaps"], cam0["size_px"]) == (8, 1, [64, 48])
    assert (cam1["count"], cam1["regularity"]["gaps"]) == (10, 0)


def test_calibration_is_the_given_one(tmp_path: Path) -> None:
    write_kitti_odometry(tmp_path / "walk")
    save_rig(load_rig(tmp_path / "walk"), tmp_path / "mine.yaml")
    (tmp_path / "walk/calib.txt").unlink()
    assert "carries no calibration; write a rig.yaml" in refused(tmp_path / "walk", tmp_path)
    ran = graphvio("info", "walk", "--rig", "mine.yaml", folder=tmp_path)
    assert ran.returncode == 0
    assert "KITTI odometry, 0.4 s, 5 framesets at 10.00 Hz" in ran.stdout
    assert "without IMU" in ran.stdout


def test_images_of_another_size_are_refused(tmp_path: Path) -> None:
    walk = write_euroc(tmp_path / "walk", pairs=1, frames=3)
    file = walk / "mav0/cam1/sensor.yaml"
    file.write_text(file.read_text().replace("resolution: [64, 48]", "resolution: [60, 48]"))
    assert "cam1: image is 64x48, the rig says 60x48; calibrate at" in refused(walk, tmp_path)


def test_recordings_near_the_path_are_named(tmp_path: Path) -> None:
    for name in ("a", "b", "c", "d"):
        write_euroc(tmp_path / "hall" / name, pairs=1, frames=2)
    hall = Path("hall")
    assert "known layouts; it holds hall/a, hall/b, hall/c, and more; give one of them" in refused(hall, tmp_path)
    assert "hall/a, hall/b" in refused(Path(), tmp_path)
    inside = f"it is inside the recording {hall / 'a'}; give that"
    assert inside in refused(hall / "a/mav0/cam0", tmp_path)
    assert inside in refused(hall / "a/mav0/cam0/data.csv", tmp_path)
    only = write_euroc(tmp_path / "only/one", pairs=1, frames=2)
    with pytest.raises(SourceError, match=f"it holds the recording {only}; give that"):
        open_source(tmp_path / "only")


def test_what_is_no_recording_at_all_is_said(tmp_path: Path) -> None:
    assert "does not exist" in refused(tmp_path / "none", tmp_path)
    assert "cannot be read" in refused(tmp_path / ("x" * 300), tmp_path)
    made_by = "the simulated walk of that name is made by  graphvio simulate room --out room\n"
    assert made_by in refused(Path("room"), tmp_path)
    assert made_by in graphvio("run", "room", folder=tmp_path).stderr
    (tmp_path / "other").mkdir()
    assert "is empty; looked for EuRoC/ASL" in refused(tmp_path / "other", tmp_path)
    (tmp_path / "other/rig.yaml").write_text("x: 1\n")
    assert "has none of the known layouts; looked for EuRoC/ASL" in refused(tmp_path / "other", tmp_path)
    assert "graphvio rig other/rig.yaml shows it" in refused(Path("other/rig.yaml"), tmp_path)
    (tmp_path / "other/summary.json").write_text("{}\n")
    assert "it holds results of graphvio; give the recording" in refused(tmp_path / "other", tmp_path)
