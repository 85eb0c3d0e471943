"""``scripts/benchmark optimize``: optimisation of whole sessions.

Synthetic sessions without images show how time and memory grow with the length of a session, and the effect of false
loop closures. Recordings show the gain in accuracy, which pairs close loops, and how well places are recognised.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from benchmarks.accuracy import CLIP, CLIP_NAME
from benchmarks.command_line import Subparsers, add_command
from benchmarks.optimize_recorded import AIMED_AT, Optimized, add_pairs, add_recordings, optimized
from benchmarks.optimize_retrieval import add_retrieval
from benchmarks.optimize_synthetic import add_false_closures, add_hour
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from graphvio.errors import GraphvioError
from graphvio.simulation import SCENE_NAMES
from graphvio.sources import open_source

HOUR, FALSE, RECORDED = "hour", "false", "recordings"
_PARTS = (HOUR, FALSE, RECORDED)
_SCENES = (AIMED_AT, "room", "corridor", "stairs")
_RETRIEVED = (AIMED_AT, "room")


def add_parser(subparsers: Subparsers) -> None:
    """Add ``optimize``."""
    parser = add_command(subparsers, "optimize", "sessions as a whole: time, accuracy, false closures", __doc__, main)
    parser.add_argument("--parts", nargs="+", choices=_PARTS, default=_PARTS, help="default: all")
    parser.add_argument("--minutes", type=float, nargs="+", default=[15.0, 30.0, 60.0], metavar="M",
                        help="lengths of the synthetic sessions (default: 15 30 60)")  # fmt: skip
    parser.add_argument("--seeds", type=int, default=5, help="walks with false closures, of each kind (default: 5)")
    parser.add_argument("--jobs", type=int, default=2, help="of these, run side by side (default: 2)")
    parser.add_argument("--scenes", nargs="*", default=list(_SCENES), choices=SCENE_NAMES, metavar="NAME",
                        help=f"simulated recordings (default: {' '.join(_SCENES)})")  # fmt: skip
    parser.add_argument("--clip", type=Path, default=CLIP, metavar="DIR",
                        help="a real recording with truth, left out if it is not there (default: "
                        "shared/data/euroc_mh01_clip next to the project)")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="DIR", help="write a report of each part to this folder")
    parser.add_argument("--docs", action="store_true", help="put the reports into docs/explanation/benchmarks")
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Measure all parts, and report."""
    if args.seeds < 1 or args.jobs < 1 or min(args.minutes) <= 3.0:
        raise GraphvioError("--seeds and --jobs must be positive, and --minutes more than 3: loops close between laps")
    for part, measure in ((HOUR, _hour), (FALSE, _false), (RECORDED, _recorded)):
        if part not in args.parts:
            continue
        report = Report()
        report.add(machine())
        measure(report, args)
        if args.out is not None:
            report.save(args.out / f"optimize-{part}.md")
        if args.docs:
            report.save_to_docs(f"optimize-{part}")


def _hour(report: Report, args: argparse.Namespace) -> None:
    log_progress("synthetic sessions, each in a process of its own")
    add_hour(report, args.minutes)


def _false(report: Report, args: argparse.Namespace) -> None:
    log_progress("false closures")
    add_false_closures(report, args.seeds, args.jobs)


def _recorded(report: Report, args: argparse.Namespace) -> None:
    recordings = {scene: simulated(args.data, scene) for scene in args.scenes}
    if args.clip.is_dir():
        recordings[CLIP_NAME if args.clip == CLIP else args.clip.name] = args.clip
    else:
        report.add(f"The real clip is left out: the folder {args.clip.name} is not there.")
    if not recordings:
        raise GraphvioError("nothing to run: no scene is named and the clip is not there")
    with tempfile.TemporaryDirectory() as folder:
        space = Path(folder)
        log_progress("recordings, optimised as a whole")
        runs = {name: optimized(path, name, space / name) for name, path in recordings.items()}
        add_recordings(report, runs)
        if AIMED_AT in runs:
            add_pairs(report, _by_pairs(recordings[AIMED_AT], runs[AIMED_AT], space))
        log_progress("retrieval")
        add_retrieval(report, {name: run for name, run in runs.items() if name in _RETRIEVED})


def _by_pairs(recording: Path, both: Optimized, space: Path) -> dict[str, Optimized]:
    """Optimise with each pair alone; return these runs and the given one with all pairs, by the pairs' names."""
    pairs = open_source(recording).rig.pairs
    log_progress(f"the {AIMED_AT} with each pair alone")
    runs = {
        pair.name: optimized(recording, f"{AIMED_AT}-{pair.name}", space / f"pair-{j}", (j,))
        for j, pair in enumerate(pairs)
    }
    return runs | {" + ".join(pair.name for pair in pairs): both}
