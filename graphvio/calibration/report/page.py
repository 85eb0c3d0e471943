"""A page about a calibration, for a person who does not know the algorithm: one file of HTML with its pictures."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.calibration.pair_calibration import PairCalibration, size_in_words
from graphvio.calibration.result import Calibration
from graphvio.reporting.page import bullets, html_page, picture, table

_CAPTIONS = {
    "alignment_errors": "Both cameras tell where the second one went. This is how far apart their answers are, for "
    "every single motion: a narrow heap near zero is good. (Figure 4 of Oskiper et al., CVPR 2007, is the same; theirs "
    "has a mean of 3.29 mm.)",
    "residuals": "The same over time, weighed by what each motion can be expected to be wrong by. Points should lie "
    "around 1 or somewhat below from beginning to end. Crosses were left out; many at one time mean that a camera was "
    "disturbed there.",
    "turning": "About which axes the rig was turned, as directions seen from the first left camera, and how fast. "
    "Turning about one axis only leaves the offset along it unknown: there should be points in two regions that "
    "are not opposite to each other.",
    "growth": "The result as the recording grew, against the result of all of it. The lines should settle within "
    "their bands, and the bands shrink; where they no longer do, a longer recording would not help.",
}


def page(found: Calibration, pictures: Mapping[tuple[int, int], Mapping[str, bytes]], source: str) -> str:
    """The page.

    Args:
        found: the calibration.
        pictures: (first, second) -> name -> PNG.
        source: what was calibrated from, for the title.
    """
    parts = [
        f"<h1>Where the cameras are: {escape(source)}</h1>",
        _gate_result(found),
        "<h2>Result</h2>",
        _places(found),
    ]
    if found.warnings:
        parts += ["<h2>What to know before using it</h2>", bullets(found.warnings)]
    for (i, j), each in found.places.pairwise.items():
        parts.append(f"<h2>{escape(found.names[i])} and {escape(found.names[j])}</h2>")
        parts += [picture(name, png, _CAPTIONS[name]) for name, png in pictures[i, j].items()]
        parts.append(_details(each))
    if found.places.loops:
        parts += ["<h2>All cameras together</h2>", _together(found)]
    if found.imu:
        parts += ["<h2>Cameras and IMU</h2>", _imu(found)]
    if found.clocks:
        parts += ["<h2>Clocks</h2>", _clocks(found)]
    if found.is_complete:
        parts += ["<h2>Numbers</h2>", _numbers(found)]
    return html_page(f"{source}: calibration", parts)


def _gate_result(found: Calibration) -> str:
    if not found.is_complete:
        return (
            '<p class="doubt"><b>Part of the answer only.</b> The rig did not move in a way that tells everything; '
            "what is missing, and how to record it, is below.</p>"
        )
    if found.warnings:
        return '<p class="doubt"><b>A result with reservations.</b> Read below what they are.</p>'
    return '<p class="good"><b>A sound result.</b> All checks below were passed.</p>'


def _places(found: Calibration) -> str:
    rows = []
    for j in range(1, len(found.names)):
        shown = found.shown(j)
        rows.append(
            (
                f"{found.names[0]}, seen from {found.names[j]}",
                _vector(1e3 * shown.offset_m, 1e3 * shown.offset_sigmas_m, shown.offset_known, "mm", 2),
                _vector(np.rad2deg(shown.turn_rad), np.rad2deg(shown.turn_sigmas_rad), shown.turn_known, "degrees", 3),
                _present(found, j),
            )
        )
    head = (
        "left cameras" if found.rig is not None else "",
        "offset x, y, z",
        "rotation vector",
        "in the rig file" if found.rig is not None else "",
    )
    note = "<p>Camera axes: x right, y down, z forward. After +- stands one standard deviation.</p>"
    return table(rows, head) + note


def _present(found: Calibration, j: int) -> str:
    present = found.present(j)
    if present is None:
        return ""
    gate_result = "agrees" if not present.is_off else "is off"
    return f"{gate_result}: {size_in_words(present.tangent)} away{present.doubt}"


def _details(each: PairCalibration) -> str:
    told = np.sqrt(np.diag(each.covariance))
    bootstrap = np.sqrt(np.diag(each.resampled_covariance))
    paper = np.sqrt(np.diag(each.comparison.paper_covariance))
    comparison, halves = each.comparison, each.halves
    frames = f"{len(each.frames)}, of which {int(each.frame_inlier.sum())} fit"
    turning = [
        (
            "turning about principal axes",
            f"{_degrees(each.observability.turning_rad)} rms in a motion (singular values of the rotation's problem)",
        ),
        (
            "lever of the turning on the offset",
            f"{_degrees(each.observability.translation_singular_values)} rms in a motion (singular values of the "
            "offset's problem; two must be well above nothing)",
        ),
    ]
    if not each.observability.is_complete:
        return table(turning)
    rows = [
        *([("motions from frame to frame", frames)] if len(each.frames) else []),
        ("motions used", f"{len(each.pairs)}, of which {int(each.inlier.sum())} fit"),
        (
            "the paper's method and the graph",
            f"{size_in_words(comparison.difference)} apart: {_chance(comparison.agrees)} (chi-square "
            f"{comparison.statistic:.1f}, limit {comparison.limit:.1f})",
        ),
        (
            "first half of the recording against the second",
            "one of them does not tell enough"
            if halves is None
            else f"{size_in_words(halves.difference)} apart: {_chance(halves.agree)}; mean alignment error "
            f"{1e3 * halves.own_m[0]:.2f} and {1e3 * halves.own_m[1]:.2f} mm by its own result, "
            f"{1e3 * halves.crossed_m[0]:.2f} and {1e3 * halves.crossed_m[1]:.2f} mm by the other half's",
        ),
        (
            "sigmas: told, with what no recording makes smaller; by resampling the recording; of the paper's method",
            f"{_largest(np.rad2deg([told[:3], bootstrap[:3], paper[:3]]), 4)} degrees, "
            f"{_largest(1e3 * np.array([told[3:], bootstrap[3:], paper[3:]]), 2)} mm (largest of three directions)",
        ),
        ("errors that last, factor on the variance", f"{each.dispersion:.2f}"),
        (
            "lengths of the second over those of the first",
            f"{np.exp(each.scale.log_ratio):.5f} +- {each.scale.sigma:.5f}"
            + (" (estimated and corrected)" if each.scale_estimated else ""),
        ),
        *turning,
    ]
    return table(rows)


def _degrees(radians: Float) -> str:
    return ", ".join(f"{value:.2f}" for value in np.rad2deg(radians)) + " degrees"


def _largest(sigmas: Float, digits: int) -> str:
    return "; ".join(f"{value:.{digits}f}" for value in sigmas.max(axis=1))


def _together(found: Calibration) -> str:
    loops = [
        (" - ".join(found.names[k] for k in loop.cameras), size_in_words(loop.error), f"{loop.statistic:.1f} of 6")
        for loop in found.places.loops
    ]
    apart = [
        (f"{found.names[i]} and {found.names[j]}", f"{distance:.1f} of 6")
        for (i, j), distance in found.places.distances.items()
    ]
    return (
        "<p>Results for two at a time, one after the other around three cameras, should lead back to the beginning.</p>"
        + table(loops, ("around", "misses by", "chi-square"))
        + "<p>The result above is for all motions at once. How far it is from results for two at a time:</p>"
        + table(apart, ("", "chi-square"))
    )


def _imu(found: Calibration) -> str:
    rows = [
        (
            found.names[j],
            f"{np.rad2deg(np.linalg.norm(each.misrotation)):.3f} +- "
            f"{np.rad2deg(np.sqrt(np.linalg.eigvalsh(each.covariance)[-1])):.3f} degrees",
            f"{1e3 * each.time_offset_s:.2f} +- {1e3 * each.time_offset_sigma_s:.2f} ms "
            f"(rig: {1e3 * each.rig_time_offset_s:.2f})",
        )
        for j, each in (found.imu or {}).items()
    ]
    return table(rows, ("", "turned from where the rig has it", "time offset, camera to IMU"))


def _clocks(found: Calibration) -> str:
    rows = [
        (
            f"{found.names[i]} to {found.names[j]}",
            f"{1e-9 * clock.relation.offset_ns:.6f} +- {clock.offset_sigma_s:.6f} s",
            f"{1e6 * clock.relation.drift:.0f} +- {1e6 * clock.drift_sigma:.0f} microseconds a second",
        )
        for (i, j), clock in (found.clocks or {}).items()
    ]
    return table(rows, ("", "add to a stamp", "drift"))


def _numbers(found: Calibration) -> str:
    blocks = []
    for j in range(1, len(found.names)):
        name = f"{found.names[j]}_T_{found.names[0]} (left cameras)"
        blocks.append(f"{name}\n{_matrix(found.places.left_T_left1[j])}")
        by_paper = found.places.pairwise[0, j].paper_left2_T_left1
        blocks.append(f"{name}, by the paper's method\n{_matrix(by_paper)}")
    return "".join(f"<pre>{escape(block)}</pre>" for block in blocks)


def _matrix(values: Float) -> str:
    return "\n".join("  ".join(f"{value: .12f}" for value in row) for row in values)


def _vector(values: Float, sigmas: Float, known: Bool, unit: str, digits: int) -> str:
    told = ", ".join(
        f"{value:.{digits}f} +- {sigma:.{digits}f}" if is_known else "unknown"
        for value, sigma, is_known in zip(values, sigmas, known, strict=True)
    )
    return f"{told} {unit}"


def _chance(agrees: bool) -> str:
    return "agree" if agrees else "more than chance explains"
