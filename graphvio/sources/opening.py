"""Opens recordings, whatever their layout."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

from graphvio.errors import RigError, SourceError
from graphvio.rig import Rig
from graphvio.rig_files import find_rig
from graphvio.sessions.store import open_store
from graphvio.sources import euroc, kitti_odometry, kitti_raw, session
from graphvio.sources.base import Source
from graphvio.sources.faults import FaultLog
from graphvio.sources.matching import TOLERANCE_NS
from graphvio.sources.recording import Recording

_FORMATS: tuple[ModuleType, ...] = (euroc, kitti_odometry, kitti_raw)
_MAX_TOLERANCE_MS = 10.0


def is_recording(path: Path) -> bool:
    """Whether a path is of a known layout, so that `open_source` would try to read it."""
    return session.matches(path) or (path.is_dir() and any(known.matches(path) for known in _FORMATS))


def open_source(
    path: str | Path,
    rig: Rig | None = None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    tolerance_ms: float = 1e-6 * TOLERANCE_NS,
    topics: Mapping[str, str] | None = None,
) -> Source:
    """Open a recording, whatever its layout.

    Args:
        path: folder of the recording, or file of a session or bag.
        rig: decides which pairs are read, and whether the IMU is; None takes the recording's own.
        from_s: where to begin, seconds after the recording's first frameset.
        to_s: where to end (inclusive), on the same scale.
        tolerance_ms: images whose stamps differ by no more are of one instant. Left and right images further apart
            are no pair, and pairs further apart make framesets of their own.
        topics: name of a camera, or ``imu`` -> topic, for sessions and bags whose topics' names do not tell.

    Raises:
        SourceError: if the folder cannot be read, has no known layout, or holds nothing in the given time.
        RigError: if no rig is given and the recording carries none that is usable.
    """
    for name, value in (("from_s", from_s), ("to_s", to_s)):
        if value is not None and not math.isfinite(value):
            raise SourceError(f"{name} is {value}; give seconds after the first frameset")
    if not 0.0 <= tolerance_ms <= _MAX_TOLERANCE_MS:
        raise SourceError(
            f"tolerance_ms is {tolerance_ms}; give 0 to {_MAX_TOLERANCE_MS:g}: what is triggered together"
        )
    try:
        return _open(Path(path), rig, from_s, to_s, round(1e6 * tolerance_ms), topics or {})
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None


def _open(
    path: Path,
    rig: Rig | None,
    from_s: float | None,
    to_s: float | None,
    tolerance_ns: int,
    topics: Mapping[str, str],
) -> Recording:
    if not path.exists():
        raise SourceError(f"{path}: does not exist; give the folder of a recording")
    resolved = path.resolve()
    faults = FaultLog(resolved.parent.name if resolved.name == "mav0" else _name_of(resolved))
    if session.matches(path):
        store = open_store(path)
        rig = _required(rig if rig is not None else session.rig_in(store), path)
        index = session.read_index(store, rig, faults, topics)
    else:
        layout = _layout_of(path)
        if topics:
            raise SourceError(f"{path}: has no topics to be mapped; that is for sessions and bags")
        rig = _required(rig if rig is not None else find_rig(path), path)
        index = layout.read_index(path, rig, faults)
    return Recording(index, rig, faults, from_s, to_s, tolerance_ns)


def _name_of(path: Path) -> str:
    return path.name if path.is_dir() else path.stem


def _layout_of(path: Path) -> ModuleType:
    """The module that reads a folder."""
    if not path.is_dir():
        raise SourceError(f"{path}: is no recording that graphvio knows; {session.LAYOUT}, or a folder ({_known()})")
    if next(path.iterdir(), None) is None:
        raise SourceError(f"{path}: is empty; looked for {_known()}")
    layout = next((known for known in _FORMATS if known.matches(path)), None)
    if layout is None:
        raise SourceError(f"{path}: has none of the known layouts; looked for {_known()}")
    return layout


def _required(rig: Rig | None, path: Path) -> Rig:
    if rig is None:
        raise RigError(f"{path}: carries no calibration; write a rig.yaml into it, or give a rig of your own")
    return rig


def _known() -> str:
    return "; ".join(known.LAYOUT for known in _FORMATS)
