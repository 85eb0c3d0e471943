"""Tolerant reading of tables of stamped rows, and cleaning of their stamps, which are never converted to floats."""

from __future__ import annotations

import warnings
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import compress
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.errors import SourceError, reading
from graphvio.measurements.events import EventKind
from graphvio.sources.faults import FaultLog

R = TypeVar("R")
V = TypeVar("V")

_MAX_STAMP_NS = 2**62  # the year 2116; offsets can be added without an overflow of int64
_HOUR_NS = 3_600_000_000_000
_MAX_OUTLIERS = 2
_MIN_STEPS_SHARE = 0.2  # minimum share of non-zero steps: stamps in seconds, read as nanoseconds, mostly repeat
_MIN_PERIOD_NS, _MIN_ROWS = 20_000, 10  # no camera or IMU is faster than 50 kHz
_SHOWN = 30  # characters that are shown of a line that is not understood
_FORCE_M_S2 = (5.0, 20.0)
"""Plausible range of the median magnitude of specific force: gravity, plus what a walk, a car or a drone adds."""


@dataclass(frozen=True, eq=False)
class ImuTable:
    """Samples of an IMU."""

    stamps_ns: Int  # (N,) stamps, increasing, IMU clock
    values: Float  # (N, 6) angular velocity, rad/s, then specific force, m/s^2; frame body


def read_imu_csv(path: Path, faults: FaultLog) -> ImuTable:
    """Read EuRoC's ``imu0/data.csv``; invalid, repeated and out-of-order rows are dropped and counted."""
    table = _read_fast(path)
    if table is None:
        table = _read_tolerant(path, faults)
    finite = np.isfinite(table.values).all(axis=1) & (table.stamps_ns >= 0) & (table.stamps_ns < _MAX_STAMP_NS)
    if not finite.all():
        bad = int(np.argmin(finite))
        faults.add(
            EventKind.IMU_GARBAGE,
            int(table.stamps_ns[bad]),
            f"{path}: the row of stamp {table.stamps_ns[bad]} holds NaN, infinity or an impossible stamp",
            int(np.sum(~finite)),
        )
    kept = finite.copy()
    _refuse_other_units(table.stamps_ns[finite], path)
    kept[finite] = clean_stamps(table.stamps_ns[finite], "imu", path, faults)
    samples = ImuTable(table.stamps_ns[kept], table.values[kept])
    if len(samples.stamps_ns) >= _MIN_ROWS:
        force = float(np.median(np.linalg.norm(samples.values[:, 3:], axis=1)))
        if not _FORCE_M_S2[0] <= force <= _FORCE_M_S2[1]:
            detail = f"{path}: the accelerometer's median is {force:.3g} m/s^2, far from gravity; is it in other units?"
            faults.add(EventKind.IMU_UNITS, int(samples.stamps_ns[0]), detail)
    return samples


def read_frame_csv(path: Path, faults: FaultLog) -> tuple[Int, list[str]]:
    """Read EuRoC's ``cam0/data.csv``; returns stamps (N,), increasing, and the names of the images.

    Raises:
        SourceError: if it has no stamps, or stamps in another unit.
    """

    def frame(cells: list[str]) -> tuple[int, str] | None:
        stamp = parse_stamp(cells[0])
        return None if stamp is None else (stamp, cells[1] if len(cells) > 1 and cells[1] else f"{stamp}.png")

    stamps_ns, names = read_rows(path, _rows(path), frame, EventKind.FRAME_GARBAGE, faults)
    if not names:
        first = next(rows_in_lines(path), None)
        fault = "holds no row" if first is None else f"cannot be read: line {first[0]} is {first[1][:_SHOWN]!r}"
        raise SourceError(
            f"{path}: {fault}; expected are lines of a stamp in nanoseconds and an image's name, such as "
            "1700000000000000000,1700000000000000000.png, as UTF-8 text; correct the file, or remove it to take the "
            "stamps from the images' names"
        )
    _refuse_other_units(stamps_ns, path)
    kept = clean_stamps(stamps_ns, "frame", path, faults)
    return stamps_ns[kept], list(compress(names, kept))


def read_times(path: Path, parse: Callable[[str], int | None], faults: FaultLog) -> tuple[Int, list[int]]:
    """Read a file with the time of a frame in each line; returns stamps (N,), increasing, and line numbers from 0.

    ``parse`` returns the nanoseconds of a line, or None if the line is no time.
    """

    def frame(row: tuple[int, str]) -> tuple[int, int] | None:
        stamp = parse(row[1])
        return None if stamp is None else (stamp, row[0] - 1)

    rows = ((number, (number, line)) for number, line in rows_in_lines(path))
    stamps_ns, lines = read_rows(path, rows, frame, EventKind.FRAME_GARBAGE, faults)
    kept = clean_stamps(stamps_ns, "frame", path, faults)
    return stamps_ns[kept], list(compress(lines, kept))


def read_rows(
    path: Path,
    rows: Iterable[tuple[int, R]],
    parse: Callable[[R], tuple[int, V] | None],
    kind: EventKind,
    faults: FaultLog,
) -> tuple[Int, list[V]]:
    """Return stamps (N,) and values of numbered rows; rows for which ``parse`` returns None are dropped and counted."""
    stamps: list[int] = []
    values: list[V] = []
    for number, row in rows:
        parsed = parse(row)
        if parsed is None:
            detail = f"{path}: line {number} is no row of this table; it is dropped"
            faults.add(kind, stamps[-1] if stamps else 0, detail)
            continue
        stamps.append(parsed[0])
        values.append(parsed[1])
    return np.array(stamps, dtype=np.int64), values


def imu_row(stamp_ns: int | None, cells: Sequence[str]) -> tuple[int, list[float]] | None:
    """Return stamp and values (6,) of a sample; None if one of them is missing."""
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        return None
    return None if stamp_ns is None or len(values) != 6 else (stamp_ns, values)


def parse_stamp(text: str) -> int | None:
    """Return the exact whole nanoseconds of a text, which may be like ``1.4e18``; None if it is no stamp."""
    try:
        stamp = int(text)
    except ValueError:
        return decimal_ns(text, 1)
    return stamp if 0 <= stamp < _MAX_STAMP_NS else None


def decimal_ns(text: str, unit_ns: int) -> int | None:
    """Return the whole nanoseconds of a decimal number in units of ``unit_ns``; None if the text is no such number."""
    try:
        value = Decimal(text.strip()) * unit_ns
    except InvalidOperation:
        return None
    if not value.is_finite() or not 0 <= value < _MAX_STAMP_NS:
        return None
    return int(value.to_integral_value())


def _refuse_other_units(stamps_ns: Int, path: Path) -> None:
    """Raise a `SourceError` if a table's stamps can only be in seconds, milliseconds or microseconds, or decrease."""
    if len(stamps_ns) < _MIN_ROWS:
        return
    steps_ns = np.diff(stamps_ns)
    if np.count_nonzero(steps_ns) > _MIN_STEPS_SHARE * len(steps_ns):
        steps_ns = steps_ns[steps_ns != 0]  # repeated rows are counted later
    period_ns = float(np.median(steps_ns))
    if period_ns < _MIN_PERIOD_NS:
        if period_ns < 0.0:
            raise SourceError(f"{path}: stamps decrease from row to row; sort the rows by their stamps")
        raise SourceError(
            f"{path}: rows are {period_ns:g} ns apart in the median; stamps have to be whole nanoseconds, "
            "not seconds, milliseconds or microseconds"
        )


def clean_stamps(stamps_ns: Int, sensor: Literal["imu", "frame"], path: Path, faults: FaultLog) -> Bool:
    """Return which rows (N,) to keep so that stamps increase and the fewest rows are dropped; dropped ones are counted.

    The longest increasing subsequence is kept, so that one stamp far in the future costs one row, not all that follow
    it; of equal stamps the first is kept. From these, one or two rows that lie hours from all others are also dropped,
    such as the stamp 0 of a driver that has no time yet.
    """
    increasing = np.ones(len(stamps_ns), dtype=np.bool_)
    if (np.diff(stamps_ns) <= 0).any():
        increasing[:] = False
        increasing[_longest_increasing(stamps_ns.tolist())] = True
    kept = increasing.copy()
    kept[increasing] = ~_far_from_all(stamps_ns[increasing])
    dropped = ~increasing
    duplicate = dropped & np.isin(stamps_ns, stamps_ns[increasing])
    backward = dropped & ~duplicate
    for kind, rows, reason in (
        ("duplicate", duplicate, "repeats an earlier row's; the first is kept"),
        ("backward", backward, f"is out of order; the row is dropped{_clock_set_back(stamps_ns, backward)}"),
        ("outlier", increasing & ~kept, "lies hours from all others; the row is dropped"),
    ):
        if rows.any():
            row = int(np.argmax(rows))
            detail = f"{path}: stamp {stamps_ns[row]} of data row {row + 1} {reason}"
            faults.add(EventKind(f"{sensor}_{kind}"), int(stamps_ns[row]), detail, int(np.sum(rows)))
    return kept


def _clock_set_back(stamps_ns: Int, dropped: Bool) -> str:
    """Describe where a clock was set back, and the remedy; empty unless all rows before or after that are dropped."""
    rows, steps = np.flatnonzero(dropped), np.flatnonzero(np.diff(stamps_ns) < 0) + 1
    if len(steps) != 1 or len(rows) < _MIN_ROWS or rows[-1] - rows[0] >= len(rows):
        return ""
    row, by_s = int(steps[0]), 1e-9 * (stamps_ns[steps[0] - 1] - stamps_ns[steps[0]])
    return f", as are {len(rows)}: at data row {row + 1} the clock goes back by {by_s:.1f} s; to use all, split there"


def _far_from_all(stamps_ns: Int) -> Bool:
    """Return which increasing stamps (N,) are too few, and too far from all others, to be part of the recording."""
    runs = np.split(np.arange(len(stamps_ns)), np.flatnonzero(np.diff(stamps_ns) > _HOUR_NS) + 1)
    far = np.zeros(len(stamps_ns), dtype=np.bool_)
    if max(len(run) for run in runs) > _MAX_OUTLIERS:
        for run in runs:
            far[run] = len(run) <= _MAX_OUTLIERS
    return far


def _longest_increasing(values: list[int]) -> list[int]:
    tails: list[int] = []  # the smallest value that ends an increasing run of each length
    tail_rows: list[int] = []
    before: list[int] = []
    for row, value in enumerate(values):
        at = bisect_left(tails, value)
        before.append(tail_rows[at - 1] if at else -1)
        if at == len(tails):
            tails.append(value)
            tail_rows.append(row)
        elif value < tails[at]:
            tails[at] = value
            tail_rows[at] = row
    chosen = []
    row = tail_rows[-1] if tail_rows else -1
    while row >= 0:
        chosen.append(row)
        row = before[row]
    return chosen[::-1]


def _read_fast(path: Path) -> ImuTable | None:
    row = np.dtype([("stamp", np.int64), ("values", np.float64, (6,))])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # numpy only warns when it cuts a stamp that is written as a float
            table = np.loadtxt(path, dtype=row, delimiter=",", comments="#", ndmin=1, encoding="utf-8")
    except (ValueError, OverflowError, OSError, Warning):  # the tolerant reader finds the row that is wrong
        return None
    return ImuTable(np.ascontiguousarray(table["stamp"]), np.ascontiguousarray(table["values"]))


def _read_tolerant(path: Path, faults: FaultLog) -> ImuTable:
    def sample(cells: list[str]) -> tuple[int, list[float]] | None:
        return imu_row(parse_stamp(cells[0]), cells[1:7])

    stamps_ns, values = read_rows(path, _rows(path), sample, EventKind.IMU_GARBAGE, faults)
    return ImuTable(stamps_ns, np.array(values, dtype=np.float64).reshape(-1, 6))


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of each row, except for a first row without a number, which is a header."""
    for count, (number, line) in enumerate(rows_in_lines(path)):
        cells = _cells(line)
        if count or any(_is_number(cell) for cell in cells):
            yield number, cells


def rows_in_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number, from 1, and the text of each line that is neither blank nor a comment."""
    for number, line in enumerate(read_lines(path), start=1):
        line = line.strip()
        if line and not line.startswith("#"):
            yield number, line


def _cells(line: str) -> list[str]:
    """Return the cells of a row, separated by commas, spaces or semicolons; with semicolons, commas are decimal."""
    if ";" in line:
        return [cell.strip().replace(",", ".") for cell in line.split(";")]
    return [cell.strip() for cell in line.split(",")] if "," in line else line.split()


def read_lines(path: Path) -> list[str]:
    """Read the lines of a text file with any line ends; bytes that are no valid text affect only their line."""
    with reading(path, SourceError, "check the recording"):
        return path.read_text(encoding="utf-8-sig", errors="replace").split("\n")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
