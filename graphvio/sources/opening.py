"""Opening of recordings of any known layout."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from graphvio.errors import RigError, SourceError, reading
from graphvio.rig import Rig
from graphvio.rig_files import find_rig
from graphvio.sessions.store import is_store, open_store
from graphvio.sources import euroc, kitti_odometry, kitti_raw, session, uzh_fpv
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import Index
from graphvio.sources.plug_ins import Layout, plug_ins
from graphvio.sources.recording import Source
from graphvio.sources.surroundings import meant_instead

_MAX_TOLERANCE_MS = 10.0
_LAYOUTS: tuple[Layout, ...] = (euroc, kitti_odometry, kitti_raw, uzh_fpv)


def is_recording(path: Path) -> bool:
    """Return whether a path has a known layout, so that `open_source` would try to read it."""
    return is_store(path) or (path.is_dir() and _matching(path) is not None)


def open_source(
    path: str | Path,
    rig: Rig | None = None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    tolerance_ms: float | None = None,
    topics: Mapping[str, str] | None = None,
) -> Source:
    """Open a recording of any known layout.

    Args:
        path: folder of the recording, or file of a session or bag.
        rig: rig that decides which pairs are read, and whether the IMU is; None takes the recording's own.
        from_s: time to begin at, seconds after the recording's first frameset.
        to_s: time to end at (inclusive), on the same scale.
        tolerance_ms: images whose stamps differ by no more than this are of one instant. Left and right images farther
            apart are no pair, and pairs farther apart make separate framesets. None takes a third of the left camera's
            median period for left and right, whose stamps may be those of arrival, and 2 ms for pairs.
        topics: name of a camera, or ``imu`` -> topic, for sessions and bags whose topics have other names.

    Returns:
        The recording, which can be iterated any number of times; images are decoded during the iteration.

    Raises:
        SourceError: if the folder cannot be read, has no known layout, or holds nothing in the given time.
        RigError: if no rig is given and the recording has none that is usable.
        SessionError: if a session or bag cannot be read.
        MissingExtraError: if it is a session or bag, and the extra ``sessions`` is not installed.
    """
    for name, value in (("from_s", from_s), ("to_s", to_s)):
        if value is not None and not 0.0 <= value < math.inf:
            raise SourceError(f"{name} is {value:g}; give seconds after the first frameset, 0 or more")
    if tolerance_ms is not None and not 0.0 <= tolerance_ms <= _MAX_TOLERANCE_MS:
        raise SourceError(
            f"tolerance_ms is {tolerance_ms}; give 0 to {_MAX_TOLERANCE_MS:g}: images that are triggered together"
        )
    path = Path(path)
    with reading(path, SourceError, "check its permissions"):
        index, rig, faults = read_index(path, rig, topics or {})
        tolerance_ns = None if tolerance_ms is None else round(1e6 * tolerance_ms)
        return Source(index, rig, faults, from_s, to_s, tolerance_ns)


def read_index(path: Path, rig: Rig | None, topics: Mapping[str, str]) -> tuple[Index, Rig, FaultLog]:
    """Index a recording; arguments and errors are those of `open_source`.

    Returns:
        The index of all images and samples, the rig, and the faults of single files or lines so far.
    """
    _check_exists(path)
    resolved = path.resolve()
    resolved = resolved.parent if resolved.name == "mav0" else resolved
    faults = FaultLog(resolved.name if resolved.is_dir() else resolved.stem)
    if is_store(path):
        store = open_store(path)
        rig = _required(rig if rig is not None else session.rig_in(store), path)
        return session.read_index(store, rig, faults, topics), rig, faults
    layout = layout_of(path)
    if topics:
        raise SourceError(f"{path}: has no topics to be mapped; that is for sessions and bags")
    rig = _required(rig if rig is not None else find_rig(path), path)
    return layout.read_index(path, rig, faults), rig, faults


def recorded_rig(path: Path) -> Rig:
    """Read the rig that a recording contains, whether or not it has images of all of the rig's cameras.

    Raises:
        SourceError: if the recording cannot be read or has no known layout.
        RigError: if it has no usable rig.
        SessionError: if a session or bag cannot be read.
        MissingExtraError: if it is a session or bag, and the extra ``sessions`` is not installed.
    """
    _check_exists(path)
    with reading(path, SourceError, "check its permissions"):
        if is_store(path):
            return _required(session.rig_in(open_store(path)), path)
        layout_of(path)
        return _required(find_rig(path), path)


def _check_exists(path: Path) -> None:
    if not path.exists():
        raise SourceError(f"{path}: does not exist; give the folder of a recording")


def layout_of(path: Path) -> Layout:
    """Return the layout of a folder.

    Raises:
        SourceError: if the path is no folder, or has no known layout; the message names recordings that may be meant.
    """
    if not path.is_dir():
        instead = meant_instead(path, is_recording)
        names = ", ".join(layout.LAYOUT.partition(":")[0] for layout in _layouts())
        raise SourceError(
            f"{path}: is no recording that graphvio knows; {instead}give a session or bag (.mcap, .bag, .db3), or a "
            f"folder ({names})"
        )
    if next(path.iterdir(), None) is None:
        raise SourceError(f"{path}: is empty; looked for {_known()}")
    layout = _matching(path)
    if layout is None:
        failures = "".join(f"; {failure}" for failure in plug_ins().failures)
        instead = meant_instead(path, is_recording)
        raise SourceError(f"{path}: has none of the known layouts; {instead}looked for {_known()}{failures}")
    return layout


def _layouts() -> Iterator[Layout]:
    """Yield all layouts, built-in ones first, so that plug-ins are loaded only if none of these matches."""
    yield from _LAYOUTS
    yield from plug_ins().layouts


def _matching(path: Path) -> Layout | None:
    return next((layout for layout in _layouts() if layout.matches(path)), None)


def _known() -> str:
    return "; ".join(layout.LAYOUT for layout in _layouts())


def _required(rig: Rig | None, path: Path) -> Rig:
    if rig is None:
        raise RigError(
            f"{path}: carries no calibration; write a rig.yaml into it (graphvio rig FILE.. --out rig.yaml makes it of "
            "Kalibr's and other files), or give a calibration by --rig"
        )
    return rig
