"""Estimation of a clock's offset and drift from the messages that were delayed least.

Delays have a minimum, and are often much longer at random. So the line of the minimum delay over time lies below all
points and as close to them as possible: it is the edge of their lower convex hull at the mean of their times. Zhang,
Liu, Xia: Clock synchronization algorithms for network measurements, INFOCOM 2002; Moon, Skelly, Towsley: Estimation and
removal of clock skew from network delay measurements, INFOCOM 1999.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

_WINDOW_NS = 1_000_000_000
_WINDOWS = 60  # number of windows, with one point each: a crystal's rate changes little in a minute
_MIN_WINDOWS = 3  # number of windows from which the drift is estimated
_MAX_DRIFT = 1e-3  # ten times that of any crystal
_STEP_NS = 5_000_000  # if points are farther below the line, repeatedly, the clock was set forward
_STEP_READINGS = 3

_Point = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Line:
    """Delay (ns) as a linear function of time (ns)."""

    at_zero_ns: float
    drift: float

    def at(self, time_ns: float) -> float:
        """Return the delay at a time."""
        return self.at_zero_ns + self.drift * time_ns


class Envelope:
    """Estimates the line of the least delay over time as points are added.

    The line has an offset from the first point on, and a drift, ns of delay per ns of time, after three windows of a
    second. If the least delay grows, as on a busy machine, the line does not change for half a minute; if it stays so,
    the line follows.

    Args:
        drift: the drift to use until there is an estimate.

    Attributes:
        line: the newest estimate.
    """

    def __init__(self, drift: float = 0.0) -> None:
        self.line = Line(0.0, drift)
        self._windows: deque[_Point] = deque(maxlen=_WINDOWS)
        self._least: _Point | None = None  # lowest point of the open window
        self._opened_ns = 0
        self._below: list[_Point] = []

    def add(self, time_ns: int, delay_ns: int) -> bool:
        """Add a point.

        Args:
            time_ns: time of the clock.
            delay_ns: delay of the message, up to a constant.

        Returns:
            Whether the clock was set forward: delays are now so much smaller that all previous points are forgotten.
        """
        point = (time_ns, delay_ns)
        if self._windows and delay_ns < self.line.at(time_ns) - _STEP_NS:
            return self._add_below(point)
        self._below.clear()
        if self._least is None:
            self._open(point)
        elif time_ns - self._opened_ns >= _WINDOW_NS:
            self._windows.append(self._least)
            while self._windows[0][0] < time_ns - _WINDOWS * _WINDOW_NS and len(self._windows) > 1:
                self._windows.popleft()
            self._fit()
            self._least, self._opened_ns = point, time_ns
        elif self._height(point) < self._height(self._least):
            self._least = point
            if not self._windows:
                self._lower_to(point)
        return False

    def _add_below(self, point: _Point) -> bool:
        """Add a point far below the line; a single one may be due to a damaged stamp, and is not used."""
        self._below.append(point)
        if len(self._below) < _STEP_READINGS:
            return False
        self._windows.clear()
        self._open(min(self._below, key=self._height))
        self._below.clear()
        return True

    def _open(self, point: _Point) -> None:
        self._least, self._opened_ns = point, point[0]
        self._lower_to(point)

    def _lower_to(self, point: _Point) -> None:
        self.line = Line(self._height(point), self.line.drift)

    def _height(self, point: _Point) -> float:
        """Return the delay at time zero on the line through a point that has the present drift."""
        return point[1] - self.line.drift * point[0]

    def _fit(self) -> None:
        points = sorted(self._windows)  # late messages may be out of order
        drift = self.line.drift
        if len(points) >= _MIN_WINDOWS:
            drift = min(max(_slope_of_middle(_lower_hull(points), points), -_MAX_DRIFT), _MAX_DRIFT)
        self.line = Line(min(delay - drift * time for time, delay in points), drift)


def _lower_hull(points: list[_Point]) -> list[_Point]:
    """Return the vertices of the lower convex hull, by time; computed in integers, so that nothing is rounded."""
    hull: list[_Point] = []
    for point in points:
        if hull and hull[-1][0] == point[0]:
            continue  # sorted: the lower one came first
        while len(hull) > 1:
            (t0, d0), (t1, d1) = hull[-2:]
            if (d1 - d0) * (point[0] - t0) < (point[1] - d0) * (t1 - t0):
                break
            hull.pop()
        hull.append(point)
    return hull


def _slope_of_middle(hull: list[_Point], points: list[_Point]) -> float:
    """Return the slope of the edge at the mean time of all points: no other line below them is as close to them."""
    total = sum(time for time, _ in points)
    for (t0, d0), (t1, d1) in pairwise(hull):
        if t1 * len(points) >= total:
            return (d1 - d0) / (t1 - t0)
    return 0.0
