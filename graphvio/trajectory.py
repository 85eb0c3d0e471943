"""A sequence of stamped poses, and the text formats in which they are exchanged.

TUM: ``stamp_s x y z q_x q_y q_z q_w``, separated by blanks, or by commas where stamps have a decimal point. EuRoC:
``stamp_ns,x,y,z,q_w,q_x,q_y,q_z,...``, separated by commas. Stamps are converted exactly: float64 keeps only 0.2
microseconds of a Unix time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, DecimalException
from pathlib import Path

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.errors import SessionError, TrajectoryError
from graphvio.geometry import interpolate, quat_wxyz_from_rotation, rotation_from_quat_wxyz, se3

_NS_PER_S = 1_000_000_000
_COLUMNS = 8
_KITTI_COLUMNS = 12
_NORM_TOLERANCE = 0.05
_STAMP_MAX_NS = 2**62
_SESSIONS = (".mcap", ".bag")


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of body over time.

    Attributes:
        stamps_ns: (N,) int64 nanoseconds, strictly increasing.
        nav_T_body: (N, 4, 4), metres; "nav" stands for whatever world frame the file is in.

    Raises:
        TrajectoryError: if the shapes disagree, a value is not finite, or the stamps do not increase.
    """

    stamps_ns: Int
    nav_T_body: Float

    def __post_init__(self) -> None:
        stamps = np.array(self.stamps_ns, dtype=np.int64).reshape(-1)
        poses = np.ascontiguousarray(self.nav_T_body, dtype=np.float64).reshape(-1, 4, 4)
        if len(stamps) != len(poses):
            raise TrajectoryError(f"trajectory: {len(stamps)} stamps but {len(poses)} poses; give one stamp a pose")
        bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
        if len(bad):
            raise TrajectoryError(f"trajectory: pose {bad[0]} holds NaN or infinity; leave such poses out")
        back = np.flatnonzero(np.diff(stamps) <= 0)
        if len(back):
            raise TrajectoryError(
                f"trajectory: stamp {stamps[back[0] + 1]} ns of pose {back[0] + 1} does not come after "
                f"the one before it ({stamps[back[0]]} ns); sort the poses and keep one for each stamp"
            )
        object.__setattr__(self, "stamps_ns", stamps)
        object.__setattr__(self, "nav_T_body", poses)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> Float:
        """(N, 3) metres in nav."""
        return self.nav_T_body[:, :3, 3]

    @property
    def rotations(self) -> Float:
        """(N, 3, 3) ``nav_R_body``."""
        return self.nav_T_body[:, :3, :3]

    @property
    def distances(self) -> Float:
        """(N,) metres travelled since the first pose: sums of straight lines from pose to pose."""
        return travelled(self.positions)

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last pose."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) / _NS_PER_S if len(self) else 0.0

    def select(self, which: Bool | Int | slice) -> Trajectory:
        """The poses at some indices, or where a mask (N,) is true."""
        return Trajectory(self.stamps_ns[which], self.nav_T_body[which])

    def around(self, begin_ns: int, end_ns: int) -> Trajectory:
        """The poses from ``begin_ns`` to ``end_ns``, and the nearest one before and after, to interpolate with."""
        first = int(np.searchsorted(self.stamps_ns, begin_ns, side="right")) - 1
        last = int(np.searchsorted(self.stamps_ns, end_ns)) + 1
        return self.select(slice(max(first, 0), last))

    def transformed(self, other_T_nav: Float) -> Trajectory:
        """The same motion seen from another frame: ``other_T_body`` for ``other_T_nav`` (4, 4)."""
        return Trajectory(self.stamps_ns, np.asarray(other_T_nav) @ self.nav_T_body)

    def at(self, stamps_ns: Int, max_gap_s: float) -> tuple[Trajectory, Bool]:
        """Poses at other stamps: position on the chord, rotation at constant rate (slerp).

        Args:
            stamps_ns: (M,) strictly increasing.
            max_gap_s: greatest interval between two poses that is bridged.

        Returns:
            The poses at those stamps that coincide with a pose or lie between two of them, and a mask (M,)
            that tells which stamps these are.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        if not len(self):
            return Trajectory(stamps[:0], np.empty((0, 4, 4))), np.zeros(len(stamps), dtype=np.bool_)
        after = np.searchsorted(self.stamps_ns, stamps)
        last = len(self) - 1
        equal = self.stamps_ns[np.minimum(after, last)] == stamps
        inside = (after > 0) & (after <= last)
        upper = np.clip(after, 1, max(last, 1)) if last else np.zeros_like(after)
        lower = np.maximum(upper - 1, 0)
        gap_ns = self.stamps_ns[upper] - self.stamps_ns[lower]
        known = equal | (inside & (gap_ns <= round(max_gap_s * _NS_PER_S)))
        poses = np.empty((int(known.sum()), 4, 4))
        for row, k in enumerate(np.flatnonzero(known)):
            if equal[k]:
                poses[row] = self.nav_T_body[after[k]]
                continue
            fraction = float(stamps[k] - self.stamps_ns[lower[k]]) / float(gap_ns[k])
            poses[row] = interpolate(self.nav_T_body[lower[k]], self.nav_T_body[upper[k]], fraction)
        return Trajectory(stamps[known], poses), known

    @staticmethod
    def read(path: str | Path) -> Trajectory:
        """Read a TUM, EuRoC or KITTI file, told apart by commas or blanks and the number of columns.

        KITTI's poses take their stamps from ``times.txt`` beside them, or in ``../sequences/NAME``. Of a session or
        bag, the true trajectory in it is read.

        Raises:
            TrajectoryError: if the file cannot be read, a line is no pose, or the stamps do not increase; or if a
                session has no truth.
        """
        path = Path(path)
        if path.suffix in _SESSIONS or path.is_dir():
            return _read_session(path)
        return _read(path)

    def write(self, path: str | Path) -> None:
        """Write a TUM file: nine decimals on the stamp, ``q_w >= 0``.

        Raises:
            TrajectoryError: if the file cannot be written.
        """
        text = "".join(f"{tum_line(int(s), p)}\n" for s, p in zip(self.stamps_ns, self.nav_T_body, strict=True))
        try:
            Path(path).write_text(text, encoding="ascii")
        except OSError as error:
            raise TrajectoryError(f"{path}: cannot be written ({error.strerror}); choose another place") from None


def tum_line(stamp_ns: int, nav_T_body: Float) -> str:
    """One line of a TUM file without its end: equal poses always give equal bytes."""
    sign = "-" if stamp_ns < 0 else ""
    seconds, rest = divmod(abs(stamp_ns), _NS_PER_S)
    w, x, y, z = quat_wxyz_from_rotation(np.ascontiguousarray(nav_T_body[:3, :3], dtype=np.float64))
    values = " ".join(fixed(v) for v in (*nav_T_body[:3, 3], x, y, z, w))
    return f"{sign}{seconds}.{rest:09d} {values}"


def fixed(value: float) -> str:
    """Nine decimals, and never a negative zero."""
    text = f"{value:.9f}"
    return text[1:] if text == "-0.000000000" else text


def travelled(positions: Float) -> Float:
    """Metres (N,) along the line through positions (N, 3)."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])[: len(positions)]


def stamp_ns_from_seconds(text: str) -> int:
    """Nanoseconds of decimal seconds, exactly; digits beyond the ninth are rounded.

    Raises:
        ValueError: if the text is no finite number that fits.
    """
    try:
        stamp = Decimal(text).scaleb(9)
        if not stamp.is_finite() or abs(stamp) > _STAMP_MAX_NS:
            raise ValueError(f"{text!r} is no time")
        return int(stamp.to_integral_value())
    except DecimalException:
        raise ValueError(f"{text!r} is no time") from None


def _read_session(path: Path) -> Trajectory:
    from graphvio.sessions.store import is_store
    from graphvio.sessions.truth import read_truth

    if not is_store(path):
        raise TrajectoryError(f"{path}: is no trajectory file, and no session; give a TUM or EuRoC trajectory file")
    try:
        return Trajectory(*read_truth(path))
    except SessionError as error:
        raise TrajectoryError(str(error)) from None


def _read(path: Path) -> Trajectory:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise TrajectoryError(
            f"{path}: cannot be read ({error.strerror}); give a TUM or EuRoC trajectory file"
        ) from None
    except UnicodeDecodeError:
        raise TrajectoryError(f"{path}: is not a text file; give a TUM or EuRoC trajectory file") from None
    rows = list(_rows(text))
    if rows and not rows[0][2] and len(rows[0][1]) == _KITTI_COLUMNS:
        return _read_kitti(path, rows)
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
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses))


def _read_kitti(path: Path, rows: Sequence[tuple[int, Sequence[str], bool]]) -> Trajectory:
    """KITTI odometry's poses, upper 3x4 blocks by rows, with the stamps of their sequence's ``times.txt``."""
    places = (path.with_name("times.txt"), path.parent.parent / "sequences" / path.stem / "times.txt")
    times = next((place for place in places if place.is_file()), None)
    if times is None:
        raise TrajectoryError(f"{path}: KITTI poses carry no stamps; put the sequence's times.txt beside them")
    try:
        stamps = [stamp_ns_from_seconds(line) for line in times.read_text(encoding="utf-8").split()]
        blocks = np.array([[float(field) for field in fields] for _, fields, _ in rows]).reshape(-1, 3, 4)
    except (ValueError, OSError) as error:
        raise TrajectoryError(f"{path}: with {times}: is not numeric ({error}); correct the line") from None
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


def _pose(fields: Sequence[str], is_euroc: bool, where: str) -> tuple[int, Float]:
    if len(fields) < _COLUMNS:
        layout = "stamp_ns,x,y,z,qw,qx,qy,qz" if is_euroc else "stamp_s x y z qx qy qz qw"
        raise TrajectoryError(f"{where}: has {len(fields)} columns; a pose needs {_COLUMNS}: {layout}")
    try:
        stamp = int(fields[0]) if is_euroc else stamp_ns_from_seconds(fields[0])
        values = np.array([float(field) for field in fields[1:_COLUMNS]])
    except ValueError as error:
        raise TrajectoryError(f"{where}: is not numeric ({error}); correct or remove the line") from None
    if not np.isfinite(values).all():
        raise TrajectoryError(f"{where}: holds NaN or infinity; remove the line")
    if abs(stamp) > _STAMP_MAX_NS:
        raise TrajectoryError(f"{where}: stamp {fields[0]} is no time in nanoseconds; correct or remove the line")
    quat_wxyz = values[3:] if is_euroc else np.array([values[6], values[3], values[4], values[5]])
    norm = float(np.linalg.norm(quat_wxyz))
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise TrajectoryError(f"{where}: its quaternion has norm {norm:.3g}, not 1; check the order of the columns")
    return stamp, se3(rotation_from_quat_wxyz(quat_wxyz), values[:3])
