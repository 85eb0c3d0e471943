"""How numbers are told on the page."""

from __future__ import annotations

from collections.abc import Sequence

from graphvio.backend.gating import chi_square_quantile
from graphvio.optimization.optimize import Optimization
from graphvio.optimization.report.calibration import OffsetCorrection, PairCorrection, SessionCalibration
from graphvio.optimization.report.numbers import Numbers, median_sigmas

_FAR_OFF = 2.0  # times the expected squares
_SURELY = 0.999
_NO_COST = 1e-6
_MOST_PARTS = 40
_LOOPS_DOUBTFUL = 1.0  # mean square per dimension
_LEAST_COMPLETION = 0.9


def length(metres: float | None) -> str:
    """With its unit: millimetres below a decimetre."""
    if metres is None:
        return "unknown"
    return f"{1e3 * metres:.2f} mm" if metres < 0.1 else f"{metres:.3f} m" if metres < 10.0 else f"{metres:.1f} m"


def angle(degrees: float | None) -> str:
    """With its unit."""
    return "unknown" if degrees is None else f"{degrees:.4f} degrees" if degrees < 0.1 else f"{degrees:.2f} degrees"


def plain(value: float | None) -> str:
    """A number without a unit, to three digits, or all before the point."""
    if value is None:
        return ""
    if abs(value) < 1e-9:
        return "0"
    if abs(value) >= 1e6:
        return f"{value:.1e}"
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def medians(numbers: Numbers) -> str:
    """What the medians of motions, of the IMU and of loop closures were and are; empty if there is nothing to tell."""
    kinds = {kind.name: kind for kind in numbers.kinds}
    told = []
    for kind, name in (("motion", "motions from images"), ("imu", "IMU"), ("loop", "loop closures that are used")):
        each = kinds.get(kind)
        before, after = (None, None) if each is None else (median_sigmas(each.before), median_sigmas(each.after))
        if after is not None:
            known = "not told" if before is None else plain(before)
            told.append(f"{name} {known} before, {plain(after)} after")
    return f"Median errors, standard deviations per dimension: {'; '.join(told)}." if told else ""


def cost(found: Optimization) -> str:
    """The sum of all, and why it may mislead. It may rise where the odometry's smoother left little to gain."""
    text = f"{plain(found.cost_before)} before, {plain(found.cost_after)} after"
    if found.cost_after > max(found.cost_before, _NO_COST):
        return text + ": it rose, as loop closures move the states"
    return text


def noise(numbers: Numbers) -> int:
    """Whether residuals are smaller (-1) or larger (1) than the assumed noise makes them, by far and not by chance."""
    degrees = numbers.dimensions - numbers.unknowns
    if degrees <= 0:
        return 0
    squares = numbers.per_dimension * numbers.dimensions
    if squares > max(_FAR_OFF * degrees, chi_square_quantile(_SURELY, degrees)):
        return 1
    return -1 if squares < min(degrees / _FAR_OFF, chi_square_quantile(1.0 - _SURELY, degrees)) else 0


def doubts(found: Optimization, numbers: Numbers) -> list[str]:
    """What a reader must know before using the result."""
    made = []
    if numbers.frames > 1:
        made.append(
            f"No loop closures join all parts: there are {numbers.frames} frames, and positions in different ones "
            "cannot be compared."
        )
    if not numbers.used:
        which = f"None of {len(found.loops)} loop closures" if found.loops else "No loop closure"
        made.append(f"{which} is used: drift is what the odometry and the IMU leave of it.")
    if numbers.used and 2 * numbers.refused > len(found.loops):
        made.append(
            f"{numbers.refused} of {len(found.loops)} loop closures that were found are refused: places look alike "
            "here. What is used agrees with the odometry, so it does not prove the odometry right."
        )
    kinds = {kind.name: kind.after for kind in numbers.kinds}
    if "loop" in kinds and kinds["loop"].per_dimension > _LOOPS_DOUBTFUL:
        motions = f", that of motions {plain(kinds['motion'].per_dimension)}" if "motion" in kinds else ""
        made.append(
            "The loop closures that are used contradict the solution: their mean square per dimension is "
            f"{plain(kinds['loop'].per_dimension)}{motions}. A wrong one may be among them."
        )
    if noise(numbers) > 0:
        made.append(
            f"Residuals are larger than the noise that was assumed (mean square {plain(numbers.per_dimension)} per "
            f"dimension, {plain(numbers.expected_per_dimension)} expected): sigmas are too small."
        )
    for each in numbers.sessions:
        if each.completion is not None and each.completion < _LEAST_COMPLETION:
            made.append(
                f"Only {100.0 * each.completion:.0f} % of the framesets of {each.name} have a pose; its odometry's "
                "results tell why."
            )
        if each.accuracy is not None and each.accuracy["optimized"].position_m > each.accuracy["online"].position_m:
            made.append(f"{each.name} is farther from the truth than the online trajectory was.")
    return made


def calibration_in_words(each: SessionCalibration) -> list[str]:
    """What is found of a session's rig file: a line for each pair, and one for the time offset."""
    made = [f"{_pair_in_words(pair)}: {gate_result(pair)}" for pair in each.pairs]
    if each.offset is not None:
        found = each.offset
        made.append(
            f"time offset {1e3 * found.offset_s:+.2f} ms (sigma {1e3 * found.sigma_s:.2f} ms: {found.sigmas:.1f} "
            f"sigmas): {gate_result(found)}"
        )
    return made


def pair_name(pair: PairCorrection) -> str:
    """Its number, and its name where that is known."""
    return f"pair {pair.pair} ({pair.name})" if pair.name else f"pair {pair.pair}"


def gate_result(found: PairCorrection | OffsetCorrection) -> str:
    """Whether the rig file's value may stay."""
    if isinstance(found, PairCorrection) and found.is_held:
        return "held where the rig file has it"
    return "the rig file is borne out" if found.is_borne_out else "the rig file is refuted"


def _pair_in_words(pair: PairCorrection) -> str:
    if pair.is_held:
        return pair_name(pair)
    return (
        f"{pair_name(pair)}: turned by {pair.angle_deg:.3f} degrees (sigma {pair.angle_sigma_deg:.3f}: "
        f"{pair.angle_sigmas:.1f} sigmas), {pair.of} moved by {1e3 * pair.distance_m:.2f} mm (sigma "
        f"{1e3 * pair.distance_sigma_m:.2f}: {pair.distance_sigmas:.1f} sigmas)"
    )


def parts_in_words(numbers: Numbers, frame: int) -> list[str]:
    """The epochs that are in a frame."""
    inside = [part for part in numbers.parts if part.frame == frame]
    made = [
        f"{numbers.sessions[part.session].name}, epoch {part.epoch}: {part.begin_s:.1f} to {part.end_s:.1f} s, "
        f"{part.framesets} {'frameset' if part.framesets == 1 else 'framesets'}"
        for part in inside[:_MOST_PARTS]
    ]
    return made + ([f"and {len(inside) - _MOST_PARTS} more"] if len(inside) > _MOST_PARTS else [])


def pairs_in_words(pairs: Sequence[tuple[int, int]]) -> str:
    """Which pair saw at the second place what which pair saw at the first."""
    return "; ".join(f"{first} by {second}" for first, second in pairs)
