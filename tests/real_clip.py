"""The real recording that most tests on real images use, with images that are decoded in a tenth of the time."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path

import cv2
from recordings import REAL_DATA, half_size
from rendered import rendered_once

from graphvio.rig_files import load_rig, save_rig

CLIP = REAL_DATA / "euroc_mh01_clip"


@cache
def real_clip() -> Path:
    """Return the folder of a copy with the same pixels, into which nobody may write."""
    return rendered_once(CLIP.name, lambda folder: shutil.copytree(CLIP, folder), _files())


@cache
def half_size_clip() -> Path:
    """Return the folder of a copy with images of 376x240, for claims that need no more; nobody may write into it."""

    def write(folder: Path) -> None:
        shutil.copytree(CLIP, folder)
        for path in folder.rglob("*.png"):
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert image is not None
            assert cv2.imwrite(str(path), cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        save_rig(load_rig(CLIP).with_cameras(half_size), folder / "rig.yaml")

    return rendered_once(CLIP.name, write, "half size", _files())


def _files() -> list[tuple[str, int]]:
    """Return the names and sizes of the recording's files."""
    return sorted((str(path.relative_to(CLIP)), path.stat().st_size) for path in CLIP.rglob("*") if path.is_file())
