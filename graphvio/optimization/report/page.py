"""The HTML page of an optimisation's report: rendering of ``page.html``, and the numbers in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.gating import chi_square_quantile
from graphvio.optimization.optimize import JudgedLoop, Optimization
from graphvio.optimization.report.numbers import Numbers, median_sigmas
from graphvio.reporting.html import render

MAX_LOOPS = 200
"""Maximum number of rows in the table of loop closures."""

_MAX_PARTS = 40
_FACTOR = 2.0  # of squared residuals to the expected ones, beyond which the noise is reported as different
_PROBABILITY = 0.999
_MAX_LOOP_SQUARES = 1.0  # mean square per dimension of used loop closures above which they contradict the solution
_MIN_COMPLETION = 0.9


def page(found: Optimization, numbers: Numbers, maps: Mapping[int, bytes], pictures: Mapping[str, bytes]) -> str:
    """Render the page with its PNGs: maps of the largest frames, by frame, and ``residuals``, ``moved``, ``sigmas``."""
    return render(
        "optimization/report/page.html",
        found=found,
        numbers=numbers,
        maps=maps,
        pictures=pictures,
        doubts=list(_doubts(found, numbers)),
        medians=list(_medians(numbers)),
        noise=_noise(numbers),
        parts=[_parts(numbers, frame) for frame in range(numbers.frames)],
        loops=[_loop(found, loop) for loop in sorted(found.loops, key=_order)[:MAX_LOOPS]],
        length=length,
        angle=angle,
        plain=plain,
        count=_count,
        median=np.median,
        median_sigmas=median_sigmas,
    )


def length(metres: float) -> str:
    """Format a length with its unit: millimetres below a decimetre."""
    return f"{1e3 * metres:.2f} mm" if metres < 0.1 else f"{metres:.3f} m" if metres < 10.0 else f"{metres:.1f} m"


def angle(degrees: float) -> str:
    """Format an angle with its unit."""
    return f"{degrees:.4f} degrees" if degrees < 0.1 else f"{degrees:.2f} degrees"


def plain(value: float | None) -> str:
    """Format a number without a unit, to three digits or all before the point; empty for None."""
    if value is None:
        return ""
    if abs(value) < 1e-9:
        return "0"
    if abs(value) >= 1e6:
        return f"{value:.1e}"
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def size_of(transform: Float) -> tuple[float, float]:
    """Compute translation (m) and angle (degrees) of a relative pose (4, 4)."""
    chord = float(np.linalg.norm(transform[:3, :3] - np.eye(3)))
    return float(np.linalg.norm(transform[:3, 3])), math.degrees(2.0 * math.asin(min(chord / math.sqrt(8.0), 1.0)))


def _doubts(found: Optimization, numbers: Numbers) -> Iterator[str]:
    """Yield the warnings that a reader has to know before using the result, one sentence or more each."""
    if numbers.frames > 1:
        yield (
            f"Loop closures do not join all parts: there are {numbers.frames} frames, and positions in different ones "
            "cannot be compared."
        )
    if not numbers.used:
        which = f"None of {len(found.loops)} loop closures" if found.loops else "No loop closure"
        yield f"{which} is used: the drift of odometry and IMU remains."
    if numbers.used and 2 * numbers.refused > len(found.loops):
        yield (
            f"{numbers.refused} of {len(found.loops)} loop closures that were found are refused: places look alike "
            "here. Those used agree with the odometry, so they do not confirm it independently."
        )
    kinds = {kind.name: kind.after for kind in numbers.kinds}
    if "loop" in kinds and kinds["loop"].per_dimension > _MAX_LOOP_SQUARES:
        motions = f", that of motions {plain(kinds['motion'].per_dimension)}" if "motion" in kinds else ""
        yield (
            "The loop closures that are used contradict the solution: their mean square per dimension is "
            f"{plain(kinds['loop'].per_dimension)}{motions}. A wrong one may be among them."
        )
    if _noise(numbers) > 0:
        yield (
            f"Residuals are larger than the assumed noise (mean square {plain(numbers.per_dimension)} per dimension, "
            f"{plain(numbers.expected_per_dimension)} expected): sigmas are too small."
        )
    for each in numbers.sessions:
        if each.completion is not None and each.completion < _MIN_COMPLETION:
            yield (
                f"Only {100.0 * each.completion:.0f} % of the framesets of {each.name} have a pose; its odometry's "
                "results state why."
            )
        if each.accuracy is not None and each.accuracy["optimized"].position_m > each.accuracy["online"].position_m:
            yield f"The optimised trajectory of {each.name} is farther from the ground truth than the online one."


def _medians(numbers: Numbers) -> Iterator[str]:
    """Yield the median errors of motions, IMU and loop closures, before and after the optimisation."""
    kinds = {kind.name: kind for kind in numbers.kinds}
    for kind, name in (("motion", "motions from images"), ("imu", "IMU"), ("loop", "loop closures that are used")):
        after = median_sigmas(kinds[kind].after) if kind in kinds else None
        if after is not None:
            before = median_sigmas(kinds[kind].before)
            yield f"{name} {'unknown' if before is None else plain(before)} before, {plain(after)} after"


def _noise(numbers: Numbers) -> int:
    """Compare residuals with the assumed noise: -1 if significantly and much smaller, 1 if larger, else 0."""
    degrees = numbers.dimensions - numbers.unknowns
    if degrees <= 0:
        return 0
    squares = numbers.per_dimension * numbers.dimensions
    if squares > max(_FACTOR * degrees, chi_square_quantile(_PROBABILITY, degrees)):
        return 1
    return -1 if squares < min(degrees / _FACTOR, chi_square_quantile(1.0 - _PROBABILITY, degrees)) else 0


def _parts(numbers: Numbers, frame: int) -> list[str]:
    """Describe the epochs in a frame."""
    inside = [part for part in numbers.parts if part.frame == frame]
    lines = [
        f"{numbers.sessions[part.session].name}, epoch {part.epoch}: {part.begin_s:.1f} to {part.end_s:.1f} s, "
        f"{_count(part.framesets, 'frameset')}"
        for part in inside[:_MAX_PARTS]
    ]
    return lines + ([f"and {len(inside) - _MAX_PARTS} more"] if len(inside) > _MAX_PARTS else [])


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _order(loop: JudgedLoop) -> tuple[int, int, int, int]:
    first, second = loop.closure.reference, loop.closure.current
    return first.session, first.stamp_ns, second.session, second.stamp_ns


def _loop(found: Optimization, loop: JudgedLoop) -> tuple[str, ...]:
    """Return a row of the table of loop closures."""
    closure = loop.closure
    places = []
    for place in (closure.reference, closure.current):
        record = found.sessions[place.session].record
        since_s = float(place.stamp_ns - record.stamps_ns[0]) * 1e-9
        places.append(f"{since_s:.2f} s" if len(found.sessions) == 1 else f"{record.name}, {since_s:.2f} s")
    metres, degrees = size_of(closure.reference_T_current)
    return (
        *places,
        "; ".join(f"{first} by {second}" for first, second in closure.pairs),
        str(closure.inliers),
        f"{metres:.3f} m, {degrees:.1f} degrees",
        plain(loop.distance) if np.isfinite(loop.distance) else "",
        f"refused: {loop.refusal}" if loop.refusal else "used",
    )
