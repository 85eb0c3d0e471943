"""A page about an optimisation, for people who use trajectories: one file of HTML with its pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from graphvio.optimization.optimize import JudgedLoop, Optimization
from graphvio.optimization.report.calibration import SessionCalibration
from graphvio.optimization.report.document import size_of
from graphvio.optimization.report.measures import STAGES
from graphvio.optimization.report.numbers import Kind, Numbers, SessionNumbers, median_sigmas
from graphvio.optimization.report.words import (
    angle,
    cost,
    doubts,
    gate_result,
    length,
    medians,
    noise,
    pair_name,
    pairs_in_words,
    parts_in_words,
    plain,
)
from graphvio.reporting.page import bullets, html_page, picture, table

MOST_LOOPS = 200
"""Rows of the table of loop closures."""

_STAGES = ("online", "smoothed", "optimised")
_MEANINGS = {
    "imu": "preintegrated IMU between two states",
    "motion": "motion of the rig, from images",
    "view": "the error that a keyframe's motions share",
    "rest": "the rig stands still",
    "walk": "a segment without IMU or images: steady motion",
    "start": "what is known of a first state",
    "calibration": "what the rig file says of places and offset",
    "loop": "loop closures that are used",
}
_WHY_LARGE = (
    "The cost before may be large all the same: at the start of a session the odometry's poses are of different "
    "updates, and the few motions between those dominate the sum."
)
_MAP = (
    "Online poses on the left, optimised ones on the right; seen from above, and from the side below. Every loop "
    "closure ties two places by a line: where the odometry drifted, lines of those used are longer on the left. "
)
_CAPTIONS = {
    "residuals": "Squared Mahalanobis distance of each factor, divided by its dimension, before and after. Were "
    "all noise as it is assumed, and the states not fitted to it, the bars would follow the dashed line; to the left "
    "of it the noise is smaller than assumed, to the right larger. What lies beyond an end is counted in the last bar "
    "there. Before, loop closures are held against the odometry's smoothed poses.",
    "moved": "How far each optimised pose is from the one that was emitted online. Ticks at the bottom are ends of "
    "loop closures that are used.",
    "sigmas": "One standard deviation of a pose in its frame, x, y and z together (the root of the sum of three "
    "variances): as it is now, and thin and dashed as the odometry told it online.",
}


def page(found: Optimization, numbers: Numbers, maps: Mapping[int, bytes], pictures: Mapping[str, bytes]) -> str:
    """The page.

    Args:
        found: the optimisation.
        numbers: of it.
        maps: frame -> PNG; frames without one are told in words.
        pictures: name -> PNG: ``residuals``, ``moved`` and ``sigmas``.
    """
    title = ", ".join(each.name for each in numbers.sessions)
    doubtful = doubts(found, numbers)
    parts = [f"<h1>Optimised: {escape(title)}</h1>"]
    if doubtful:
        parts += ['<div class="doubt"><b>Read before use:</b>', bullets(doubtful), "</div>"]
    else:
        parts.append(
            '<p class="good"><b>All sessions lie in one frame, and no check here speaks against the result.</b></p>'
        )
    parts += [_head(found, numbers), _sessions(numbers.sessions), _accuracy(numbers.sessions), _loop_errors(numbers)]
    known = [each for each in numbers.calibrations if each is not None]
    if known:
        parts += ["<h2>Calibration</h2>", *(_calibration(each, len(numbers.sessions) > 1) for each in known)]
    parts += ["<h2>Trajectories</h2>", *_maps(numbers, maps)]
    parts += ["<h2>Where the trajectory moved</h2>", picture("moved", pictures["moved"], _CAPTIONS["moved"])]
    parts += ["<h2>Uncertainty</h2>", picture("sigmas", pictures["sigmas"], _CAPTIONS["sigmas"])]
    parts += ["<h2>Residuals</h2>", picture("residuals", pictures["residuals"], _CAPTIONS["residuals"])]
    parts.append(_residuals(numbers))
    if found.loops:
        parts += ["<h2>Loop closures</h2>", _loops(found)]
    return html_page(f"{title}: optimisation", parts)


def _head(found: Optimization, numbers: Numbers) -> str:
    told = medians(numbers)
    lead = f"<p>{escape(told)} {_WHY_LARGE}</p>" if told else ""
    count = len(numbers.sessions)
    framesets, states = (sum(getattr(each, name) for each in numbers.sessions) for name in ("framesets", "states"))
    return lead + table(
        [
            ("sessions", f"{count}, in {numbers.frames} {'frame' if numbers.frames == 1 else 'frames'}"),
            (
                "length",
                f"{length(sum(each.length_m for each in numbers.sessions))} in "
                f"{sum(each.duration_s for each in numbers.sessions):.1f} s",
            ),
            ("framesets with a pose", f"{framesets}, of which {states} are states of the graph"),
            ("loop closures", f"{len(found.loops)} found, {numbers.used} used, {numbers.refused} refused"),
            (
                "cost (half the sum of squared residuals, loop closures not counted)",
                cost(found),
            ),
        ]
    )


def _sessions(sessions: Sequence[SessionNumbers]) -> str:
    rows = [
        (
            each.name,
            length(each.length_m),
            f"{each.duration_s:.1f} s",
            str(each.framesets),
            str(each.states),
            f"{length(float(each.moved_m.max()))}, {angle(float(each.moved_deg.max()))}",
            f"{length(float(np.median(each.sigma_m)))}, {angle(float(np.median(each.sigma_deg)))}",
        )
        for each in sessions
    ]
    return table(rows, ("session", "length", "time", "framesets", "states", "moved by at most", "median sigma"))


def _accuracy(sessions: Sequence[SessionNumbers]) -> str:
    rows = [
        (
            each.name,
            *(
                f"{length(each.accuracy[stage].position_m)}, {angle(each.accuracy[stage].rotation_deg)}"
                for stage in STAGES
            ),
        )
        for each in sessions
        if each.accuracy is not None
    ]
    missing = [f"{each.name}: {each.no_accuracy}" for each in sessions if each.accuracy is None]
    if not rows:
        return f"<p>Not held against a truth ({escape('; '.join(missing))}).</p>"
    note = "<p>ATE: rmse after one alignment with the ground truth; a break between frames counts as error."
    if missing:
        note += f" Without: {escape('; '.join(missing))}."
    return table(rows, ("ATE", *_STAGES)) + note + "</p>"


def _loop_errors(numbers: Numbers) -> str:
    if not numbers.used:
        return ""
    rows = []
    for stage, name in zip(STAGES, _STAGES, strict=True):
        each = numbers.loop_errors[stage]
        if each.count:
            rows.append(
                (
                    name,
                    str(each.count),
                    f"{length(each.median_m)}, {angle(each.median_deg)}",
                    f"{length(each.max_m)}, {angle(each.max_deg)}",
                )
            )
    text = "<p>By how much the poses at both ends of a loop closure that is used contradict it"
    if numbers.loop_errors["online"].count < numbers.used:
        text += "; before, only those within one epoch can be told"
    return f"{text}:</p>" + table(rows, ("loop-closure error", "loops", "median", "largest"))


def _calibration(each: SessionCalibration, with_name: bool) -> str:
    rows = []
    for pair in each.pairs:
        if pair.is_held:
            rows.append((pair_name(pair), "", "", gate_result(pair)))
        else:
            rows.append(
                (
                    pair_name(pair),
                    f"{pair.angle_deg:.3f} degrees, sigma {pair.angle_sigma_deg:.3f}: {pair.angle_sigmas:.1f} sigmas",
                    f"{1e3 * pair.distance_m:.2f} mm, sigma {1e3 * pair.distance_sigma_m:.2f}: "
                    f"{pair.distance_sigmas:.1f} sigmas",
                    gate_result(pair),
                )
            )
    if each.offset is not None:
        offset = each.offset
        told = f"{1e3 * offset.offset_s:+.2f} ms, sigma {1e3 * offset.sigma_s:.2f}: {offset.sigmas:.1f} sigmas"
        rows.append(("time offset of the IMU", "", told, gate_result(offset)))
    name = f"{each.session}: " if with_name else ""
    all_in_all = (
        "<b>the rig file is borne out</b>: all of it is within three standard deviations of what is found."
        if each.is_borne_out
        else "<b>the rig file is refuted</b>: the result here is by the calibration that is found, which is in "
        f"<code>{escape(each.session)}/rig_optimized.yaml</code>."
    )
    is_known = bool(each.pairs) and each.pairs[0].of == "left camera"
    moved = "the left camera" if is_known else "body's origin, as if one piece with the pair"
    note = (
        f"<p>Between the rig file's place of each pair and the one that is found; what is moved is {moved}. Sigmas are "
        "the largest over all axes; what the motions do not tell keeps the sigma that was assumed before. A pair's "
        "place is refuted, too, where all axes together contradict it as surely.</p>"
    )
    return f"<p>{escape(name)}{all_in_all}</p>" + table(rows, ("", "turned by", "moved by", "")) + note


def _maps(numbers: Numbers, maps: Mapping[int, bytes]) -> list[str]:
    made = []
    for frame in range(numbers.frames):
        inside = parts_in_words(numbers, frame)
        if numbers.frames > 1:
            made.append(f"<p><b>Frame {frame}</b>, which nothing joins to the others:</p>{bullets(inside)}")
        if frame in maps:
            caption = _MAP if frame == 0 else "The same in this frame. "
            if len(inside) > 1:
                caption += "Online, an epoch or session is laid so that it begins where it begins now."
            made.append(picture(f"map of frame {frame}", maps[frame], caption))
    if numbers.frames == 1 and len(numbers.parts) > 1:
        made.append(f"<p>All in one frame:</p>{bullets(parts_in_words(numbers, 0))}")
    return made


def _residuals(numbers: Numbers) -> str:
    def mean(kind: Kind, when: str) -> str:
        residuals = kind.before if when == "before" else kind.after
        return plain(residuals.per_dimension) if residuals.dimensions else ""

    rows = [
        (
            kind.name,
            _MEANINGS.get(kind.name, ""),
            str(len(kind.after.distances)),
            str(kind.after.dimensions),
            plain(median_sigmas(kind.before)),
            plain(median_sigmas(kind.after)),
            mean(kind, "before"),
            mean(kind, "after"),
        )
        for kind in numbers.kinds
    ]
    rows.append(("all", "", "", str(numbers.dimensions), "", "", "", plain(numbers.per_dimension)))
    head = (
        "factors",
        "",
        "number",
        "dimensions",
        "median, sigmas per dimension, before",
        "after",
        "mean square per dimension, before",
        "after",
    )
    note = (
        f"<p>{numbers.unknowns} unknowns are fitted to {numbers.dimensions} dimensions: were all noise as assumed, the "
        f"mean over all after would be about {plain(numbers.expected_per_dimension)}."
    )
    note += (
        " It is smaller: the measurements are better than assumed, and sigmas rather too large."
        if noise(numbers) < 0
        else ""
    )
    return table(rows, head) + note + "</p>"


def _loops(found: Optimization) -> str:
    ordered = sorted(found.loops, key=_when)
    rows = [_loop(found, loop) for loop in ordered[:MOST_LOOPS]]
    head = ("first place", "second place", "pairs", "points", "between them", "chi-square", "")
    text = (
        "<p>Places are told by seconds since their session's first pose; pairs, numbered from 0, as the first place's "
        "and the second's that saw the same points; chi-square is the squared distance from the solution, of 6 "
        "degrees of freedom.</p>"
    )
    more = len(found.loops) - MOST_LOOPS
    note = f"<p>and {more} more; summary.json has all of them.</p>" if more > 0 else ""
    return text + table(rows, head, small=True) + note


def _when(loop: JudgedLoop) -> tuple[int, int, int, int]:
    first, second = loop.closure.reference, loop.closure.current
    return first.session, first.stamp_ns, second.session, second.stamp_ns


def _loop(found: Optimization, loop: JudgedLoop) -> tuple[str, ...]:
    closure = loop.closure
    places = []
    for place in (closure.reference, closure.current):
        record = found.sessions[place.session].record
        since_s = float(place.stamp_ns - record.stamps_ns[0]) * 1e-9
        places.append(f"{since_s:.2f} s" if len(found.sessions) == 1 else f"{record.name}, {since_s:.2f} s")
    metres, degrees = size_of(closure.reference_T_current)
    return (
        *places,
        pairs_in_words(closure.pairs),
        str(closure.inliers),
        f"{metres:.3f} m, {degrees:.1f} degrees",
        plain(loop.distance) if np.isfinite(loop.distance) else "",
        f"refused: {loop.refusal}" if loop.refusal else "used",
    )
