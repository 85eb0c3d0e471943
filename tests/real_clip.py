"""The real recording that most tests on real images use, with images that are decoded in a tenth of the time."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path

from recordings import REAL_DATA
from rendered import rendered_once

CLIP = REAL_DATA / "euroc_mh01_clip"


@cache
def real_clip() -> Path:
    """Return the folder of a copy with the same pixels, into which nobody may write."""
    files = sorted((str(path.relative_to(CLIP)), path.stat().st_size) for path in CLIP.rglob("*") if path.is_file())
    return rendered_once(CLIP.name, lambda folder: shutil.copytree(CLIP, folder), files)
