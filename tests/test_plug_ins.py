"""Layouts of recordings that installed packages add."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from graphvio.errors import SourceError
from graphvio.sources import is_recording, open_source
from graphvio.sources.plug_ins import plug_ins

_ROBOT = """
from graphvio.sources import ImageFiles, Index

import numpy as np

LAYOUT = "robot: robot.txt, imagers/NAME/*.png"


def matches(path):
    return (path / "robot.txt").is_file()


def read_index(path, rig, faults):
    images = {}
    for camera in rig.cameras:
        folder = path / "imagers" / camera.name
        files = sorted(folder.glob("*.png"), key=lambda file: int(file.stem))
        images[camera.name] = ImageFiles(folder, np.array([int(f.stem) for f in files]), [f.name for f in files])
    return Index(faults.name, images)
"""


@pytest.fixture(autouse=True)
def _loaded_once() -> Iterator[None]:
    plug_ins.cache_clear()
    yield
    plug_ins.cache_clear()


def _install(folder: Path, module: str, source: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a package into a folder as pip would, and the folder on the path."""
    (folder / f"{module}.py").write_text(source)
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[graphvio.sources]\n{module} = {module}\n")
    monkeypatch.syspath_prepend(str(folder))


@pytest.fixture
def robot_walk(room_walk: Path, tmp_path: Path) -> Path:
    """A recording in a layout that only the plug-in knows."""
    walk = tmp_path / "walk"
    for camera in sorted((room_walk / "mav0").glob("cam*")):
        (walk / "imagers").mkdir(parents=True, exist_ok=True)
        (walk / "imagers" / camera.name).symlink_to(camera / "data")
    (walk / "robot.txt").write_text("")
    (walk / "rig.yaml").write_text((room_walk / "rig.yaml").read_text())
    return walk


def test_a_plug_ins_layout_gives_the_images_of_the_recording(
    room_walk: Path, robot_walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _install(tmp_path, "robot_layout", _ROBOT, monkeypatch)
    assert is_recording(robot_walk)
    with_imu = open_source(room_walk)
    expected = [m for m in open_source(room_walk, with_imu.rig.without_imu(), to_s=0.5) if hasattr(m, "images")]
    given = [m for m in open_source(robot_walk, with_imu.rig.without_imu(), to_s=0.5) if hasattr(m, "images")]
    assert len(given) == len(expected) > 5
    for one, other in zip(given, expected, strict=True):
        assert one.stamp_ns == other.stamp_ns
        assert all((a == b).all() for j in one.images for a, b in zip(one.images[j], other.images[j], strict=True))


def test_without_the_plug_in_the_layout_is_unknown(robot_walk: Path) -> None:
    assert not is_recording(robot_walk)
    with pytest.raises(SourceError, match="none of the known layouts"):
        open_source(robot_walk)


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import a_module_that_is_absent", "robot_broken.*cannot be loaded: No module named"),
        ("LAYOUT = 'x'", "robot_broken.*has no matches, read_index"),
    ],
)
def test_a_plug_in_that_fails_is_named_and_harms_no_other_layout(
    source: str, reason: str, room_walk: Path, robot_walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "site").mkdir()
    monkeypatch.delitem(sys.modules, "robot_broken", raising=False)
    _install(tmp_path / "site", "robot_broken", source, monkeypatch)
    with pytest.raises(SourceError, match=reason):
        open_source(robot_walk)
    assert len(open_source(room_walk).rig.pairs) == 2
