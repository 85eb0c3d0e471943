"""Search for the recording that may be meant by a path that is not one: below the path, or around it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

from graphvio.sessions.store import SUFFIXES

_MAX_NAMED = 3
_LEVELS_BELOW = 2  # such as GROUP/SEQUENCE in a data set; more would take too long in a home folder
_LEVELS_ABOVE = 3  # such as mav0/cam0/data
_FILE_OF_BAG = re.compile(r".+_\d+\.(db3|mcap)")  # one of several files of a bag, as ROS 2 names them
_CALIBRATIONS = (".yaml", ".yml", ".json")
_RESULTS = ("summary.json", "report.html", "map.json")  # results of run and optimize, calibrate, slam


def recordings_below(path: Path, depth: int, is_recording: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield the recordings at or below a path, without searching inside of recordings.

    Args:
        path: path to begin at.
        depth: levels of folders to go down.
        is_recording: returns whether a path has a known layout.
    """
    if is_recording(path):
        yield path
    elif path.is_dir() and depth:
        for below in sorted(path.iterdir()):
            if (below.is_dir() and not below.name.startswith(".")) or below.suffix in SUFFIXES:
                yield from recordings_below(below, depth - 1, is_recording)


def meant_instead(path: Path, is_recording: Callable[[Path], bool]) -> str:
    """Return a hint on what to give instead of a path that is no recording.

    Args:
        path: an existing file or folder.
        is_recording: returns whether a path has a known layout.

    Returns:
        A clause of a message that ends with "; ", or an empty text if there is no hint.
    """
    if path.is_file() and path.suffix in _CALIBRATIONS:
        return f"if it is a calibration, graphvio rig {path} shows it; "
    if path.is_dir() and any((path / name).is_file() for name in _RESULTS):
        return "it holds results of graphvio; give the recording that they are of; "
    around = next(filter(is_recording, list(path.resolve().parents)[:_LEVELS_ABOVE]), None)
    if around is not None:
        return f"it is inside the recording {_shown(around.parent if around.name == 'mav0' else around)}; give that; "
    try:
        below = list(islice(recordings_below(path, _LEVELS_BELOW, is_recording), _MAX_NAMED + 1))
    except OSError:  # a folder without permission
        return ""
    if not below:
        return ""
    named = ", ".join(map(str, below[:_MAX_NAMED])) + (", and more" if len(below) > _MAX_NAMED else "")
    if len(below) == 1:
        return f"it holds the recording {named}; give that; "
    if all(each.parent == path and _FILE_OF_BAG.fullmatch(each.name) for each in below):
        return f"it holds {named}; if they are one ROS 2 bag, ros2 bag reindex {path} writes its metadata.yaml; "
    return f"it holds {named}; give one of them; "


def _shown(path: Path) -> str:
    """Return a path as short as it can be typed."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path != here and path.is_relative_to(here) else str(path)
