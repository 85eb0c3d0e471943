"""Trajectory files: TUM, EuRoC and KITTI text formats, and topics with poses in a session or bag.

TUM: ``stamp_s x y z q_x q_y q_z q_w``, separated by blanks, or by commas where stamps have a decimal point; ORB-SLAM3
writes it with stamps in nanoseconds, which are recognised as a Unix time would be absurdly large in seconds. EuRoC:
``stamp_ns,x,y,z,q_w,q_x,q_y,q_z,...``, separated by commas. UZH-FPV's ground truth is TUM's with a row number in front.
Stamps are converted exactly: float64 resolves only 0.2 microseconds of a Unix time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from decimal import Decimal, DecimalException
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import SessionError, TrajectoryError, writing
from graphvio.geometry import quat_wxyz_from_rotation, rotation_from_quat_wxyz, se3
from graphvio.sessions.store import SUFFIXES, is_store
from graphvio.sessions.truth import read_poses
from graphvio.trajectory import Trajectory

_NS_PER_S = 1_000_000_000
_COLUMNS = 8
_KITTI_COLUMNS = 12
_NORM_TOLERANCE = 0.05
_MAX_STAMP_NS = 2**62
_UNITS = {"milliseconds": 3, "microseconds": 6, "nanoseconds": 9}  # power of ten of a second
_UNIX_S = (10**9, 2 * 10**9)  # the years 2001 to 2033
_MAX_STEP_S, _MIN_STEP_NS = 3600.0, 20_000.0  # plausible medians of the time from pose to pose
_MIN_STEPS = 3
_ACCEPTED = "give a trajectory file (TUM, EuRoC or KITTI), or BAG:TOPIC"


def load_trajectory(path: str | Path, times: Path | None = None) -> Trajectory:
    """Read a trajectory file, or a trajectory in a session or bag.

    Args:
        path: file of TUM, EuRoC or KITTI poses, distinguished by separator and number of columns; stamps of KITTI poses
            are read from ``times.txt`` next to them or in ``../sequences/NAME``. Or a session or bag, of which the true
            trajectory or the only topic with poses is read; ``PATH:TOPIC`` names another topic.
        times: file with the stamps of KITTI poses, seconds, one a line, if it is elsewhere.

    Returns:
        The poses in the order of their stamps.

    Raises:
        TrajectoryError: if the file cannot be read, a line is no pose, or the stamps do not increase; or if a
            session has no truth.
    """
    path = Path(path)
    if not path.exists() and ":/" in str(path):
        store, _, topic = str(path).partition(":/")
        return _load_from_session(Path(store), f"/{topic}")
    if path.suffix in SUFFIXES or path.is_dir():
        return _load_from_session(path)
    return _load_text(path, times)


def save_trajectory(trajectory: Trajectory, path: str | Path) -> None:
    """Write a TUM file: nine decimals on the stamp, ``q_w >= 0``.

    Args:
        trajectory: trajectory of poses ``nav_T_body``.
        path: path of the file, which is replaced if it exists.

    Raises:
        TrajectoryError: if the file cannot be written.
    """
    text = "".join(f"{tum_line(int(s), p)}\n" for s, p in zip(trajectory.stamps_ns, trajectory.nav_T_body, strict=True))
    with writing(path, TrajectoryError, "choose another place"):
        Path(path).write_text(text, encoding="ascii")


def tum_line(stamp_ns: int, nav_T_body: Float) -> str:
    """Format a pose ``nav_T_body`` (4, 4) as a line of a TUM file, without line end."""
    sign = "-" if stamp_ns < 0 else ""
    seconds, nanoseconds = divmod(abs(stamp_ns), _NS_PER_S)
    w, x, y, z = quat_wxyz_from_rotation(np.ascontiguousarray(nav_T_body[:3, :3], dtype=np.float64))
    values = " ".join(_fixed(v) for v in (*nav_T_body[:3, 3], x, y, z, w))
    return f"{sign}{seconds}.{nanoseconds:09d} {values}"


def _fixed(value: float) -> str:
    """Format a value with nine decimals, without negative zero."""
    text = f"{value:.9f}"
    return text[1:] if text == "-0.000000000" else text


def stamp_ns_from_seconds(text: str) -> int:
    """Convert decimal seconds to nanoseconds exactly; digits beyond the ninth are rounded.

    Raises:
        ValueError: if the text is not a finite number within the range of stamps.
    """
    try:
        stamp = Decimal(text).scaleb(9)
        if not stamp.is_finite() or abs(stamp) > _MAX_STAMP_NS:
            raise ValueError(f"{text!r} is no time")
        return int(stamp.to_integral_value())
    except DecimalException:
        raise ValueError(f"{text!r} is no time") from None


def _unit_of(stamp_s: str) -> str:
    """Return the unit of a Unix time that is not in seconds; empty if it may be in seconds, or is no Unix time."""
    try:
        stamp = abs(Decimal(stamp_s))
        units = [unit for unit, power in _UNITS.items() if _UNIX_S[0] <= stamp.scaleb(-power) < _UNIX_S[1]]
    except DecimalException:
        return ""
    return units[0] if units else ""


def _in_other_unit(where: str, unit: str) -> TrajectoryError:
    return TrajectoryError(
        f"{where}: stamps appear to be in {unit}, and have to be in seconds: divide them by 1e{_UNITS[unit]} (only "
        "EuRoC files, with commas between the columns, have nanoseconds)"
    )


def _refuse_other_units(stamps_ns: Sequence[int], is_euroc: bool, path: Path) -> None:
    """Refuse stamps whose intervals show that they are in another unit.

    Raises:
        TrajectoryError: if they are in another unit.
    """
    if len(stamps_ns) <= _MIN_STEPS:
        return
    step_ns = float(np.median(np.diff(np.array(stamps_ns, dtype=np.int64))))
    if not is_euroc and step_ns > _MAX_STEP_S * _NS_PER_S:
        raise _in_other_unit(str(path), "microseconds" if step_ns < 1e6 * _NS_PER_S else "nanoseconds")
    if is_euroc and step_ns < _MIN_STEP_NS:
        raise TrajectoryError(
            f"{path}: poses are {step_ns:g} ns apart in the median; stamps of EuRoC files have to be whole "
            "nanoseconds, not seconds, milliseconds or microseconds"
        )


def _load_from_session(path: Path, topic: str | None = None) -> Trajectory:
    if not is_store(path):
        raise TrajectoryError(f"{path}: is no trajectory file, and no session; {_ACCEPTED}")
    try:
        return Trajectory(*read_poses(path, topic))
    except SessionError as error:
        raise TrajectoryError(str(error)) from None


def _load_text(path: Path, times: Path | None) -> Trajectory:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise TrajectoryError(f"{path}: cannot be read ({error.strerror}); {_ACCEPTED}") from None
    except UnicodeDecodeError:
        raise TrajectoryError(f"{path}: is not a text file; {_ACCEPTED}") from None
    rows = list(_rows(text))
    if rows and not rows[0][2] and len(rows[0][1]) == _KITTI_COLUMNS:
        return _load_kitti(path, rows, times)
    if rows and _is_numbered(rows[0][1]):
        rows = [(number, fields[1:], is_euroc) for number, fields, is_euroc in rows]
    stamps: list[int] = []
    poses: list[Float] = []
    for number, fields, is_euroc in rows:
        where = f"{path}, line {number}"
        stamp, pose = _pose(fields, is_euroc, where)
        if stamps and stamp == stamps[-1] and np.array_equal(pose, poses[-1]):
            continue  # loggers that poll an odometry write a pose twice
        if stamps and stamp <= stamps[-1]:
            raise TrajectoryError(f"{where}: its stamp does not come after the one before it; sort the file by time")
        stamps.append(stamp)
        poses.append(pose)
    if not poses:
        raise TrajectoryError(f"{path}: holds no pose; the run that wrote it estimated nothing, or it is another file")
    _refuse_other_units(stamps, rows[0][2], path)
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses))


def _load_kitti(path: Path, rows: Sequence[tuple[int, Sequence[str], bool]], times: Path | None) -> Trajectory:
    """Read KITTI odometry poses, upper 3x4 blocks by rows, with the stamps of the sequence's ``times.txt``."""
    places = (path.with_name("times.txt"), path.parent.parent / "sequences" / path.stem / "times.txt")
    times = times or next((place for place in places if place.is_file()), None)
    if times is None:
        raise TrajectoryError(f"{path}: KITTI poses carry no stamps; give --times FILE, or put times.txt next to them")
    for number, fields, _ in rows:
        if len(fields) != _KITTI_COLUMNS:
            raise TrajectoryError(
                f"{path}, line {number}: has {len(fields)} columns; KITTI poses have {_KITTI_COLUMNS}"
            )
    try:
        seconds = times.read_text(encoding="utf-8").split()
        unit = _unit_of(seconds[0]) if seconds else ""
        if unit:
            raise _in_other_unit(str(times), unit)
        stamps = [stamp_ns_from_seconds(each) for each in seconds]
        blocks = np.array([[float(field) for field in fields] for _, fields, _ in rows]).reshape(-1, 3, 4)
    except (ValueError, OSError) as error:
        raise TrajectoryError(f"{path}: with {times}: is not numeric ({error}); correct the line") from None
    if len(stamps) != len(blocks):
        raise TrajectoryError(f"{path}: has {len(blocks)} poses, and {times} {len(stamps)} stamps; give each pose one")
    poses = np.tile(np.eye(4), (len(blocks), 1, 1))
    poses[:, :3] = blocks
    return Trajectory(np.array(stamps, dtype=np.int64), poses)


def _rows(text: str) -> Iterator[tuple[int, Sequence[str], bool]]:
    first = True
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        has_commas = "," in line
        fields = [field.strip() for field in line.split(",")] if has_commas else line.split()
        is_euroc = has_commas and "." not in fields[0]
        if first and fields[0][:1].isalpha() and fields[0].lower() not in ("nan", "inf"):
            first = False
            continue  # a header without a comment sign
        first = False
        yield number, fields, is_euroc


def _is_numbered(fields: Sequence[str]) -> bool:
    """Return whether a row has a row number before the pose: then only its last four columns are a unit quaternion."""
    if len(fields) != _COLUMNS + 1 or not fields[0].isdecimal():
        return False
    try:
        norms = [float(np.linalg.norm([float(field) for field in fields[first : first + 4]])) for first in (4, 5)]
    except ValueError:
        return False
    return abs(norms[0] - 1.0) > _NORM_TOLERANCE >= abs(norms[1] - 1.0)


def _pose(fields: Sequence[str], is_euroc: bool, where: str) -> tuple[int, Float]:
    if len(fields) < _COLUMNS:
        layout = "stamp_ns,x,y,z,qw,qx,qy,qz" if is_euroc else "stamp_s x y z qx qy qz qw"
        raise TrajectoryError(f"{where}: has {len(fields)} columns; a pose needs {_COLUMNS}: {layout}")
    unit = "" if is_euroc else _unit_of(fields[0])
    if unit and unit != "nanoseconds":
        raise _in_other_unit(where, unit)
    try:
        if unit:
            stamp = int(Decimal(fields[0]).to_integral_value())
        else:
            stamp = int(fields[0]) if is_euroc else stamp_ns_from_seconds(fields[0])
        values = np.array([float(field) for field in fields[1:_COLUMNS]])
    except ValueError as error:
        raise TrajectoryError(f"{where}: is not numeric ({error}); correct or remove the line") from None
    if not np.isfinite(values).all():
        raise TrajectoryError(f"{where}: holds NaN or infinity; remove the line")
    if abs(stamp) > _MAX_STAMP_NS:
        raise TrajectoryError(f"{where}: stamp {fields[0]} is no time in nanoseconds; correct or remove the line")
    quat_wxyz = values[3:] if is_euroc else np.array([values[6], values[3], values[4], values[5]])
    norm = float(np.linalg.norm(quat_wxyz))
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise TrajectoryError(f"{where}: its quaternion has norm {norm:.3g}, not 1; check the order of the columns")
    return stamp, se3(rotation_from_quat_wxyz(quat_wxyz), values[:3])
