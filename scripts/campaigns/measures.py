"""NEES and NIS of many runs: their means, and the 95 % bands of a consistent estimator."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from scipy.stats import chi2

from graphvio.arrays import Float
from graphvio.backend.states import level_R_nav

CONFIDENCE = 0.95


class Squares:
    """A collection of squared Mahalanobis distances by quantity, run and time."""

    def __init__(self) -> None:
        self._of: dict[str, dict[int, dict[float, float]]] = defaultdict(lambda: defaultdict(dict))
        self.dimensions: dict[str, int] = {}

    def add(self, name: str, run: int, time_s: float, error: Float, covariance: Float) -> None:
        """Add the squared Mahalanobis distance of an error (M,) with the reported covariance (M, M)."""
        self.add_square(name, run, time_s, float(error @ np.linalg.solve(covariance, error)), len(error))

    def add_square(self, name: str, run: int, time_s: float, square: float, dimensions: int) -> None:
        """Add a squared distance and its number of dimensions."""
        self.dimensions[name] = dimensions
        self._of[name][run][round(time_s, 3)] = square

    def over_time(self, name: str) -> tuple[Float, Float]:
        """Return the times (T,) that all runs have, and the means (T,) over the runs at these times."""
        runs = list(self._of[name].values())
        times = sorted(frozenset.intersection(*(frozenset(run) for run in runs)))
        return np.array(times), np.array([np.mean([run[t] for run in runs]) for t in times])

    def mean(self, name: str) -> float:
        """Return the mean over all runs and times."""
        return float(np.mean([square for run in self._of[name].values() for square in run.values()]))

    def runs(self, name: str) -> int:
        """Return the number of runs."""
        return len(self._of[name])

    def band(self, name: str) -> tuple[float, float]:
        """Return the 95 % band of the mean over the runs at one time, for a consistent estimator."""
        return band(self.dimensions[name], self.runs(name))

    def share_in_band(self, name: str) -> float:
        """Return the share of the times whose mean is in the band."""
        low, high = self.band(name)
        _, means = self.over_time(name)
        return float(np.mean((means >= low) & (means <= high)))


def band(dimensions: int, runs: int) -> tuple[float, float]:
    """Return the 95 % band of the mean of so many independent chi-square variables."""
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = chi2.ppf([tail, 1.0 - tail], dimensions * runs) / runs
    return float(low), float(high)


def rows(squares: Squares, names: Mapping[str, str]) -> list[list[str]]:
    """Return rows of a table: quantity, dimensions, mean, band, share of the times in it."""
    made = []
    for name, words in names.items():
        low, high = squares.band(name)
        made.append([
            words, str(squares.dimensions[name]), f"{squares.mean(name):.2f}", f"{low:.2f} to {high:.2f}",
            f"{100 * squares.share_in_band(name):.0f} %",
        ])  # fmt: skip
    return made


HEAD = ("what", "dimensions", "mean", f"{100 * CONFIDENCE:.0f} % band", "times in band")


def tilt_error(nav_T_body: Float, gravity_nav: Float, true: Float) -> Float:
    """Return the error (2,) of roll and pitch against gravity, about the horizontal axes of nav turned level.

    Args:
        nav_T_body: (4, 4) estimated pose.
        gravity_nav: (3,) estimated gravity.
        true: (4, 4) true pose of body in a level frame.
    """
    level_R_body = level_R_nav(gravity_nav) @ nav_T_body[:3, :3]
    true_up = level_R_body @ true[2, :3]
    return np.array([true_up[1], -true_up[0]])
