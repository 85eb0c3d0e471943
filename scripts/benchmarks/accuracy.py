"""``scripts/benchmark accuracy``: accuracy on all scenes and the real clip, by profile, with all pairs and with one."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.bench import CLIP_TRUTH, Bench
from benchmarks.motions import BREAK_SIGMA, BREAK_STATISTIC
from benchmarks.picture import Panel, draw_trajectories
from benchmarks.recordings import SCENES_OF_TWO_PAIRS, add_data_option, simulated
from benchmarks.report import DOCS, IMAGES, Report, log_progress, machine
from benchmarks.runs import HEAD, Outcome, blinded, with_moved_pair
from benchmarks.walk import SCENE, draw_walk
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.sources import open_source

DEFAULT, PAPER = "default", "paper"
_FIRST_APPROACH = "paper, first approach"
_FROM_PREVIOUS = "default, from the frame before"
CLIP = DOCS.parents[1] / "shared" / "data" / "euroc_mh01_clip"
CLIP_NAME = "EuRoC MH_01 clip"
_PLOTTED = (("corridor", True), ("corridor", False), ("stairs", False), (CLIP_NAME, False))  # with the IMU or without
_WITH_IMU = (DEFAULT, PAPER)  # profiles that use the IMU: a smoother, and the filter that it ought to beat
AIM = 1.05
"""Aim for the ATE by all pairs over that by the better pair alone: together they are at least as good as either."""
_ANGLE_DEG, _SHIFT_M = 1.0, 0.03
_BLIND_SCENE, _BLIND_S, _BLIND_FROM_S = "room", 5.0, 10.0
_BLIND_FROM_SHARE, _BLIND_SHARE = 0.3, 0.4
"""Start and length of the blind interval as shares of a walk that is too short for the times above."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "accuracy",
        help="errors of every scene and the real clip by profile, with all pairs and with each alone",
        description="Runs every recording with each profile without the IMU, the default and the paper's with it, with "
        "all pairs and with each pair alone; then with an error in the second pair's extrinsics, and with a pair "
        f"that is blind for {_BLIND_S:g} s. Writes OUT/accuracy.md, OUT/figures.md and OUT/trajectories.png.",
        epilog="Example: scripts/benchmark accuracy --scenes room --duration 10",
    )
    parser.add_argument(
        "--clip",
        type=Path,
        default=CLIP,
        metavar="DIR",
        help="a real recording with truth, left out if it is not there (default: shared/data/euroc_mh01_clip next to "
        "the project)",
    )
    parser.add_argument(
        "--scenes", nargs="*", default=list(SCENES_OF_TWO_PAIRS), metavar="NAME", help="default: all of two pairs"
    )
    parser.add_argument("--duration", type=float, metavar="S", help="only so much of each simulated walk")
    parser.add_argument("--profiles", nargs="+", default=[PAPER, DEFAULT, "fast"], metavar="NAME")
    out = Path("results") / "benchmarks"
    parser.add_argument("--out", type=Path, default=out, metavar="DIR", help=f"default: {out}")
    parser.add_argument("--docs", action="store_true", help="put report, README's figures and pictures into docs")
    add_data_option(parser)
    parser.set_defaults(run=run_all)


def run_all(args: argparse.Namespace) -> None:
    """Run all cases, and write the reports and the picture."""
    for scene in args.scenes:
        if scene not in SCENES_OF_TWO_PAIRS:
            raise GraphvioError(
                f"there is no scene {scene!r} of two pairs; choose from {', '.join(SCENES_OF_TWO_PAIRS)}"
            )
    configs = {name: Config.load(name) for name in dict.fromkeys((DEFAULT, PAPER, *args.profiles))}
    configs[_FIRST_APPROACH] = replace(configs[PAPER], filter=replace(configs[PAPER].filter, bias="none"))
    configs[_FROM_PREVIOUS] = replace(configs[DEFAULT], motion=replace(configs[DEFAULT].motion, reference="previous"))
    recordings = {name: simulated(args.data, name, args.duration) for name in args.scenes}
    report = Report()
    report.add(machine())
    if args.clip.is_dir():
        recordings[CLIP_NAME if args.clip == CLIP else args.clip.name] = args.clip
    else:
        report.add(f"The real clip is left out: the folder {args.clip.name} is not there.")
    if not recordings:
        raise GraphvioError("nothing to run: no scene is named and the clip is not there")
    bench = Bench(recordings, configs)
    cases = _cases(args.profiles)
    _main_table(report, bench, cases)
    _together_table(report, bench, cases)
    _reference_table(report, bench)
    _filters_table(report, bench)
    _moved_table(report, bench)
    if _BLIND_SCENE in recordings:
        _blind_table(report, bench, args.duration)
    picture = args.out / "trajectories.png"
    panels = [_panel(bench, name, imu) for name, imu in (*_PLOTTED, (args.clip.name, False)) if name in recordings]
    panels = [panel for panel in panels if panel.lines]
    link = ""
    if panels:
        draw_trajectories(picture, panels)
        link = "![Trajectories by all pairs and by each alone, seen from above](../../images/trajectories.png)"
    report.save(args.out / "accuracy.md")
    figures = _figures(bench)
    figures.save(args.out / "figures.md")
    if args.docs:
        report.save_to_docs("accuracy", link)
        figures.save_to_docs("figures")
        if panels:
            (IMAGES / "trajectories.png").write_bytes(picture.read_bytes())
        if SCENE in recordings and args.duration is None:
            draw_walk(bench, IMAGES)
    log_progress(f"written to {args.out}")


def _cases(profiles: list[str]) -> list[tuple[str, bool]]:
    """Return the cases of each recording: profile, and whether the IMU is used."""
    return [(profile, imu) for profile in profiles for imu in (False, True) if not imu or profile in _WITH_IMU]


def _main_table(report: Report, bench: Bench, cases: list[tuple[str, bool]]) -> None:
    rows = [
        [name, profile, bench.pair_names(name, pairs), _yes_or_no(imu), *outcome.cells()]
        for name in bench.recordings
        for profile, imu in cases
        for pairs in bench.choices(name)
        for outcome in [bench.outcome(name, profile, pairs, imu)]
    ]
    lengths = ", ".join(_length(bench, name) for name in bench.recordings)
    report.add("### Profiles and pairs", f"Recordings: {lengths}.")
    report.table(["recording", "profile", "pairs", "IMU", *HEAD], rows)
    report.add(
        f"A break is a motion that was used though its squared Mahalanobis distance to the truth is beyond "
        f"{BREAK_STATISTIC:.1f} ({BREAK_SIGMA:.0f} sigma). The truth of simulated recordings is exact; that of a "
        f"real one is taken to be good to {1e3 * CLIP_TRUTH.position_m:g} mm and {1e3 * CLIP_TRUTH.angle_rad:g} mrad."
    )


def _figures(bench: Bench) -> Report:
    """Return the table for the README: the default profile, with all pairs and each alone, with and without the IMU."""
    names = list(dict.fromkeys(pair.name for name in bench.with_several_pairs for pair in bench.rig(name).pairs))
    rows = []
    for name in bench.recordings:
        first = bench.outcome(name, DEFAULT, bench.choices(name)[0], True)
        # The path's length is summed between framesets, if there are poses: a truth at the IMU's rate would add up its
        # noise.
        path_m = first.truth.distances[-1] if first.evaluation is None else first.evaluation.path_length_m
        label = f"{name if name == CLIP_NAME else f'simulated {name}'}, {path_m:.0f} m"
        pairs = {p: bench.pair_names(name, p) for p in bench.choices(name)}
        for imu in (False, True):
            errors = {pairs[p]: _figure(bench.outcome(name, DEFAULT, p, imu)) for p in pairs}
            all_pairs = pairs[bench.choices(name)[0]]
            rows.append([label, _yes_or_no(imu), errors[all_pairs], *(errors.get(each, "") for each in names)])
    report = Report()
    report.table(["recording", "IMU", "all pairs", *(f"{each} alone" for each in names)], rows)
    return report


def _figure(outcome: Outcome) -> str:
    """Return ATE and drift of a run as text, or that there is no pose or more than one epoch."""
    if outcome.evaluation is None:
        return "no pose"
    epochs = len(np.unique(outcome.epochs))
    if epochs > 1:
        return f"lost, {epochs} epochs"
    drift = outcome.evaluation.drift_percent
    return f"{1e3 * outcome.ate_m:.1f} mm" + ("" if drift is None else f", {drift:.2f} %")


def _together_table(report: Report, bench: Bench, cases: list[tuple[str, bool]]) -> None:
    """Add the table that compares all pairs with the better pair alone, from the runs of the main table."""
    rows = []
    for name in bench.with_several_pairs:
        together = bench.choices(name)[0]
        for profile, imu in cases:
            everyone = bench.outcome(name, profile, together, imu)
            all_m = everyone.epoch_ate_m
            which, single = bench.better_single(name, profile, imu)
            single_m = single.epoch_ate_m
            result = "met" if all_m <= AIM * single_m and np.isfinite(all_m) else "missed"
            errors = [_cm(all_m), _cm(single_m), which, _ratio(all_m, single_m)]
            errors.append(_ratio(everyone.ate_m, bench.least_ate_m(name, profile, imu)))
            seen = [f"{run.by_vision_percent:.0f}" for run in (everyone, single)]
            rows.append([name, profile, _yes_or_no(imu), *errors, *seen, result])
    if not rows:
        return
    report.add(
        "### All pairs and the better one",
        f"The same runs: ATE in cm by all pairs and by the better pair alone, each epoch aligned by itself and "
        "without poses in which vision takes no part, of which there may be more or fewer (by vision, %). The aim "
        f"is a ratio of at most {AIM:g} everywhere; in a rich room, all pairs ought to be several times better (a "
        "ratio of 0.33 is three times). *In one piece* is the ratio of the ATE of the first table, all epochs aligned "
        "together. It differs where an epoch ends: how the next one goes on from there is a guess, which no pair makes "
        "better than another. (Without IMU, the corridor's blind bend is such a place.)",
    )
    head = ["recording", "profile", "IMU", "all pairs", "better single", "which", "all / single", "in one piece"]
    report.table([*head, "all by vision, %", "single by vision, %", "aim"], rows)


def _reference_table(report: Report, bench: Bench) -> None:
    rows = []
    for name in bench.recordings:
        pairs = bench.choices(name)[0]
        kept, previous = (
            bench.outcome(name, profile, pairs, False).epoch_ate_m for profile in (DEFAULT, _FROM_PREVIOUS)
        )
        rows.append([name, _cm(kept), _cm(previous), _ratio(kept, previous)])
    report.add(
        "### Keyframe and previous frame",
        "All pairs by vision alone, motion measured from a keyframe (`motion.reference: keyframe`, the default) and "
        "from the frame before (`previous`); ATE in cm, each epoch aligned by itself.",
    )
    report.table(["recording", "keyframe", "previous", "keyframe / previous"], rows)


def _filters_table(report: Report, bench: Bench) -> None:
    rows = []
    for name in bench.recordings:
        pairs = bench.choices(name)[0]
        first, full, smoother = (
            bench.outcome(name, profile, pairs, True).epoch_ate_m for profile in (_FIRST_APPROACH, PAPER, DEFAULT)
        )
        rows.append([name, _cm(first), _cm(full), _cm(smoother), _ratio(first, full), _ratio(smoother, full)])
    report.add(
        "### The paper's filters and the smoother",
        "All pairs with the IMU: the paper's first approach (`filter.bias: none`), its filter with the gyro's bias "
        f"(profile `{PAPER}`), and the default; ATE in cm, each epoch aligned by itself.",
    )
    report.table(
        ["recording", "first approach", "filter", "smoother", "first approach / filter", "smoother / filter"], rows
    )


def _moved_table(report: Report, bench: Bench) -> None:
    """Add the table of runs with an error in the extrinsics of the second pair."""
    rows = []
    for name in bench.with_several_pairs:
        moved = with_moved_pair(bench.rig(name), 1, _ANGLE_DEG, _SHIFT_M)
        for imu in (False, True):
            off = bench.special(name, DEFAULT, moved, imu)
            exact_m = bench.outcome(name, DEFAULT, bench.choices(name)[0], imu).epoch_ate_m
            which, single = bench.better_single(name, DEFAULT, imu)
            single_m = single.epoch_ate_m
            errors = [_cm(exact_m), _cm(off.epoch_ate_m), _cm(single_m), which]
            ratios = [_ratio(exact_m, single_m), _ratio(off.epoch_ate_m, single_m)]
            counts = [f"{off.breaks} / {off.motions}", f"{off.refused}"]
            rows.append([name, _yes_or_no(imu), *errors, *ratios, *counts])
    if not rows:
        return
    report.add(
        "### Error in P_12",
        f"All pairs with the default profile, the second pair's extrinsics off by {_ANGLE_DEG:g} degree and "
        f"{100 * _SHIFT_M:g} cm; ATE in cm, next to those of the exact rig and of the better pair alone.",
    )
    errors_head = ["exact", "off", "better single", "which", "exact / single", "off / single"]
    report.table(["recording", "IMU", *errors_head, "breaks / motions", "refused"], rows)


def _blind_table(report: Report, bench: Bench, duration_s: float | None) -> None:
    rig = bench.rig(_BLIND_SCENE)
    if len(rig.pairs) < 2:
        return
    begin_s, end_s = _blind_interval(duration_s)
    start_ns = open_source(bench.recordings[_BLIND_SCENE]).start_ns
    from_ns, to_ns = (start_ns + round(1e9 * s) for s in (begin_s, end_s))
    together = bench.choices(_BLIND_SCENE)[0]
    rows = []
    for imu in (False, True):
        rows.append(["none", _imu(imu), *bench.outcome(_BLIND_SCENE, DEFAULT, together, imu).cells()])
        for j in together:
            outcome = bench.special(_BLIND_SCENE, DEFAULT, rig, imu, blinded(j, from_ns, to_ns))
            rows.append([rig.pairs[j].name, _imu(imu), *outcome.cells()])
    report.add(
        "### A blind pair",
        f"The {_BLIND_SCENE} with both pairs and the default profile; one pair's images are black from {begin_s:g} to "
        f"{end_s:g} s.",
    )
    report.table(["blind", "IMU", *HEAD], rows)


def _blind_interval(duration_s: float | None) -> tuple[float, float]:
    """Return the interval in which a pair is blind, seconds; in a short walk it is a share of its length."""
    if duration_s is None:
        return _BLIND_FROM_S, _BLIND_FROM_S + _BLIND_S
    begin_s = min(_BLIND_FROM_S, _BLIND_FROM_SHARE * duration_s)
    return begin_s, begin_s + min(_BLIND_S, _BLIND_SHARE * duration_s)


def _panel(bench: Bench, name: str, imu: bool) -> Panel:
    runs = {bench.pair_names(name, pairs): bench.outcome(name, DEFAULT, pairs, imu) for pairs in bench.choices(name)}
    lines = {pairs: outcome for pairs, outcome in runs.items() if outcome.evaluation is not None}
    title = f"{_length(bench, name)}: default profile, {'with IMU' if imu else 'vision only'}"
    return Panel(title, lines)


def _length(bench: Bench, name: str) -> str:
    evaluation = bench.outcome(name, DEFAULT, bench.choices(name)[0], False).evaluation
    return name if evaluation is None else f"{name} {evaluation.path_length_m:.0f} m, {evaluation.duration_s:.0f} s"


def _cm(metres: float) -> str:
    return f"{100 * metres:.2f}" if np.isfinite(metres) else "-"


def _ratio(a: float, b: float) -> str:
    return f"{a / b:.2f}" if np.isfinite(a) and np.isfinite(b) else "-"


def _yes_or_no(imu: bool) -> str:
    return "yes" if imu else "no"


def _imu(imu: bool) -> str:
    return "with" if imu else "without"
