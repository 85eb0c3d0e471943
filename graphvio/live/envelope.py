"""The line under delays: how a clock runs, from the messages that were delayed least.

Delays are never less than the least, and by chance much more. So the line lies below all points, and as close to them
as it can: the edge of their lower convex hull at the mean of their times. Zhang, Liu, Xia: Clock synchronization
algorithms for network measurements, INFOCOM 2002; Moon, Skelly, Towsley: Estimation and removal of clock skew from
network delay measurements, INFOCOM 1999.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

_WINDOW_NS = 1_000_000_000
_WINDOWS = 60  # one point of each: a crystal's rate wanders little in a minute
_LEAST_WINDOWS = 3  # for a drift
_MOST_DRIFT = 1e-3  # of any crystal, and ten times over
_STEP_NS = 5_000_000  # below the line by more, and again and again: the clock was set forward
_STEP_READINGS = 3

_Point = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Line:
    """Delay (ns) as a linear function of time (ns)."""

    at_zero_ns: float
    drift: float

    def at(self, time_ns: float) -> float:
        """Delay there."""
        return self.at_zero_ns + self.drift * time_ns


class Envelope:
    """Follows the least delay over time.

    It is known from the first point on; its drift, ns of delay by ns of time, once there are three windows of a second.
    Where the least delay grows, as on a busy machine, nothing changes for half a minute; if it stays, it is followed.

    Args:
        drift: until it is known.

    Attributes:
        line: as known now.
    """

    def __init__(self, drift: float = 0.0) -> None:
        self.line = Line(0.0, drift)
        self._windows: deque[_Point] = deque(maxlen=_WINDOWS)
        self._least: _Point | None = None  # of the window that is open
        self._opened_ns = 0
        self._below: list[_Point] = []

    def add(self, time_ns: int, delay_ns: int) -> str:
        """Take a point.

        Returns:
            Empty, or ``changed`` where the line is a new one, or ``stepped`` where delays are now so much less that all
            points before are forgotten.
        """
        point = (time_ns, delay_ns)
        if self._windows and delay_ns < self.line.at(time_ns) - _STEP_NS:
            return self._add_below(point)
        self._below.clear()
        if self._least is None:
            self._open(point)
            return "changed"
        if time_ns - self._opened_ns >= _WINDOW_NS:
            self._windows.append(self._least)
            while self._windows[0][0] < time_ns - _WINDOWS * _WINDOW_NS and len(self._windows) > 1:
                self._windows.popleft()
            self._fit()
            self._least, self._opened_ns = point, time_ns
            return "changed"
        if self._height(point) >= self._height(self._least):
            return ""
        self._least = point
        if self._windows:
            return ""
        self._lower_to(point)
        return "changed"

    def _add_below(self, point: _Point) -> str:
        """A point that no delay explains; one alone may be a damaged stamp, and is not used."""
        self._below.append(point)
        if len(self._below) < _STEP_READINGS:
            return ""
        self._windows.clear()
        self._open(min(self._below, key=self._height))
        self._below.clear()
        return "stepped"

    def _open(self, point: _Point) -> None:
        self._least, self._opened_ns = point, point[0]
        self._lower_to(point)

    def _lower_to(self, point: _Point) -> None:
        self.line = Line(self._height(point), self.line.drift)

    def _height(self, point: _Point) -> float:
        """Where a line through a point, parallel to the one that is known, is at time zero."""
        return point[1] - self.line.drift * point[0]

    def _fit(self) -> None:
        points = sorted(self._windows)  # late messages have come between
        drift = self.line.drift
        if len(points) >= _LEAST_WINDOWS:
            drift = min(max(_slope_of_middle(_lower_hull(points), points), -_MOST_DRIFT), _MOST_DRIFT)
        self.line = Line(min(delay - drift * time for time, delay in points), drift)


def _lower_hull(points: list[_Point]) -> list[_Point]:
    """Vertices of the lower convex hull, by time; whole numbers, so nothing is rounded."""
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
    """Slope of the edge under the mean time of all points: no other line below them is as close to them."""
    total = sum(time for time, _ in points)
    for (t0, d0), (t1, d1) in pairwise(hull):
        if t1 * len(points) >= total:
            return (d1 - d0) / (t1 - t0)
    return 0.0
