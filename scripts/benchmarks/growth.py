"""Growth of the front-end's time with features, hypotheses, pairs and pixels, next to that of the reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.recordings import Footage
from benchmarks.report import Report, log_progress
from benchmarks.timing import WARM_UP, FrontendContender, ReferenceContender, take_turns
from graphvio.config import Config
from graphvio.warmup import warm_up

TRACKS = (100, 200, 400, 1000)
HYPOTHESES = (100, 250, 500, 1000)
PAIRS = (1, 2, 3, 4)
SCALES = (0.5, 1.0, 2.0)
_REFERENCE_CORNERS = 300
_REFERENCE_DISTANCE_PX = 10.0
_TRIAL_FRAMESETS = WARM_UP + 5
_HEAD = ("tracks a pair", "points a pair", "median, ms", "p95, ms", "reference, ms", "ratio")


def add_growth(report: Report, footage: Footage, config: Config, framesets: int) -> None:
    """Measure and add all four tables.

    Args:
        report: report to which the tables are added.
        footage: the recording.
        config: configuration of the front-end; one value at a time is varied.
        framesets: number of framesets that are counted for each row.
    """
    short = footage.first(WARM_UP + framesets)
    report.add(
        f"Growth, {len(short.steps) - WARM_UP} framesets a row. A *track* is a corner followed in the left image, a "
        "*point* one with depth that is a candidate of the estimation; both are means. *Reference* is the median of "
        "the reference pipeline in the same turns, *ratio* that of the two medians."
    )
    _features(report, short, config)
    _hypotheses(report, short, config)
    _pairs(report, short, config)
    _sizes(report, short, config)


def _features(report: Report, footage: Footage, config: Config) -> None:
    rows = []
    for wanted in TRACKS:
        across = _cells_for(footage, config, wanted)
        dense = replace(config, corners=replace(config.corners, cells_across=across))
        corners = int(round(_mean_tracks(footage, dense), -1))
        distance_px = min(_REFERENCE_DISTANCE_PX, 0.5 * dense.corners.cell_px(footage.rig.pairs[0].left.size_px[0]))
        row = _row(footage, dense, ReferenceContender(footage, corners, distance_px))
        rows.append([f"{wanted}", f"{across}", *row])
    report.add("### Features", "The reference looks for as many corners as there are tracks.")
    report.table(["tracks wanted", "`corners.cells_across`", *_HEAD], rows)


def _hypotheses(report: Report, footage: Footage, config: Config) -> None:
    rows = []
    for count in HYPOTHESES:
        varied = replace(config, motion=replace(config.motion, hypotheses=count, confidence=1.0))
        rows.append([f"{count}", *_row(footage, varied, ReferenceContender(footage))])
    report.add(
        "### Hypotheses",
        "Here all hypotheses are sampled (`motion.confidence` 1); with the default, sampling ends once one is correct "
        "with this probability, mostly after a batch or two. The reference is the same in each row; it shows how much "
        "the load changed.",
    )
    report.table(["hypotheses a pair", *_HEAD], rows)


def _pairs(report: Report, footage: Footage, config: Config) -> None:
    rows = []
    for count in PAIRS:
        several = footage.with_pair_count(count)
        rows.append([f"{count}", *_row(several, config, ReferenceContender(several))])
    own = len(footage.rig.pairs)
    report.add("### Pairs", f"The recording has {own}; more are copies of them, images and calibration alike.")
    report.table(["pairs", *_HEAD], rows)


def _sizes(report: Report, footage: Footage, config: Config) -> None:
    rows = []
    for scale in SCALES:
        resized = footage.resized(scale)
        reference = ReferenceContender(resized, _REFERENCE_CORNERS, scale * _REFERENCE_DISTANCE_PX)
        width, height = resized.rig.pairs[0].left.size_px
        rows.append([f"{width}x{height}", *_row(resized, config, reference)])
    report.add("### Image size", "Images are resampled; cells keep their share of the image, windows their pixels.")
    report.table(["image, px", *_HEAD], rows)


def _row(footage: Footage, config: Config, reference: ReferenceContender) -> list[str]:
    """Measure one case, and return the cells below `_HEAD`."""
    warm_up(footage.rig, config)
    frontend = FrontendContender(footage, config)
    ours, theirs = take_turns([frontend, reference], len(footage.steps))
    log_progress(f"  {len(footage.rig.pairs)} pairs, {np.mean(frontend.tracks):.0f} tracks: {ours.median_ms:.1f} ms")
    return [
        f"{np.mean(frontend.tracks):.0f}",
        f"{np.mean(frontend.points):.0f}",
        f"{ours.median_ms:.1f}",
        f"{ours.p95_ms:.1f}",
        f"{theirs.median_ms:.1f}",
        f"{ours.median_ms / theirs.median_ms:.2f}",
    ]


def _cells_for(footage: Footage, config: Config, wanted: int) -> int:
    """Find the number of cells across with which a pair has about ``wanted`` tracks, which grow with its square."""
    width, height = footage.rig.pairs[0].left.size_px
    across = round(width / np.sqrt(width * height / wanted))
    tried: dict[int, float] = {}
    while across not in tried:
        dense = replace(config, corners=replace(config.corners, cells_across=across))
        tried[across] = _mean_tracks(footage, dense)
        across = max(round(across * np.sqrt(wanted / tried[across])), 1)
    return min(tried, key=lambda cells: abs(tried[cells] - wanted))


def _mean_tracks(footage: Footage, config: Config) -> float:
    trial = FrontendContender(footage, config)
    take_turns([trial], min(_TRIAL_FRAMESETS, len(footage.steps)))
    return float(np.mean(trial.tracks))
