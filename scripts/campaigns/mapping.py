"""``scripts/campaign mapping``: the reference SLAM by itself, on rendered images and poses with synthetic drift.

The errors are those of the mapping and not of an odometry: the keyframes have true poses plus a random walk, with
consistent covariances. Then other sessions begin in a saved map.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from synthetic_front_end import SyntheticFrontEnd

from graphvio.arrays import Float, Int
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.geometry import se3_inverse, se3_log
from graphvio.mapping.mapper import Mapper
from graphvio.sources import Source, open_source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

_SCENE = "loop"
_STEP = 5  # framesets from keyframe to keyframe: four a second
_SIGMAS = (np.deg2rad(0.02), 0.01)  # sigmas of the drift after a metre, rad and m
_SESSION_BEGINS_S = (3.0, 35.0, 66.5)
_SESSION_S = 5.0
_GAP_S = 0.1
_WRONG_M, _WRONG_RAD = 0.5, 0.1  # closures with larger errors are taken to join different places
_DRIFT_HEAD = ("draw", "error at the end, mm", "after mapping, mm", "rmse, mm", "after mapping, mm", "places",
               "closures found", "wrong among them", "used", "wrong among them")  # fmt: skip
_CORRECTIONS_HEAD = ("draw", "corrections", "squared error by covariance: median", "greatest", "expected")
_SESSION_HEAD = ("begins at, s", "keyframes until found", "metres until found", "first correction off by, mm",
                 "degrees", "reported sigma, mm", "last correction off by, mm")  # fmt: skip
_STAGES = ("features", "keep", "description", "retrieval", "verification", "graph", "vocabulary")


def add_parser(subparsers: Subparsers) -> None:
    """Add ``mapping``."""
    parser = add_command(subparsers, "mapping", "the reference SLAM on synthetic drift, and in its map", __doc__, main)
    parser.add_argument("--draws", type=int, default=3, help="walks with another drift (default: 3)")
    add_report_options(parser)
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Run and report."""
    if args.draws < 1:
        raise GraphvioError("--draws must be 1 or more")
    source = open_source(simulated(args.data, _SCENE))
    report = Report()
    report.add(machine(), "", f"`--draws {args.draws}`: keyframes four a second, drift 10 mm and 0.02 deg after 1 m.")
    with tempfile.TemporaryDirectory() as made:
        runs = []
        for draw in range(args.draws):
            keep = Path(made) / "map" if draw == 0 else None
            runs.append(_run(source, draw, np.arange(0, source.frameset_count, _STEP), None, keep))
            log_progress(f"draw {draw}")
        report.table(_DRIFT_HEAD, [_drift_row(draw, run) for draw, run in enumerate(runs)])
        report.add("Corrections that the odometry received, compared with the truth:")
        report.table(_CORRECTIONS_HEAD, [_corrections_row(draw, run) for draw, run in enumerate(runs)])
        rows = []
        for start_s in _SESSION_BEGINS_S:
            first, last = (round(20 * at_s) for at_s in (start_s, start_s + _SESSION_S))
            indices = np.arange(first, min(last, source.frameset_count), 3)
            rows.append(_session_row(start_s, _run(source, 100, indices, Path(made) / "map", None)))
            log_progress(f"from {start_s:g} s")
    report.add(f"In the saved map of draw 0, from {len(_SESSION_BEGINS_S)} places of the walk, {_SESSION_S:g} s each:")
    report.table(_SESSION_HEAD, rows)
    report.add("Milliseconds by the clock, where they were needed; a place has up to three candidates:")
    report.table(("stage", "ms"), _stage_rows([run.summary for run in runs]))
    report.write(args, "mapping")


@dataclass(frozen=True)
class _Run:
    """Result of one run.

    Attributes:
        truth: (N, 4, 4) true poses of the keyframes, in the map's frame.
        drifted: (N, 4, 4) poses of the front-end, with drift.
        mapped: trajectory of the mapper at the end.
        corrections: corrections that the front-end received.
        closures: for each loop closure the estimated motion, the true motion, and whether it is used.
        summary: summary of the mapper.
    """

    truth: Float
    drifted: Float
    mapped: Trajectory
    corrections: Sequence[tuple[int, Float, Float]]
    closures: Sequence[tuple[Float, Float, bool]]
    summary: Mapping[str, float | int | str | None]


def _run(source: Source, draw: int, indices: Int, begin: Path | None, keep: Path | None) -> _Run:
    """Map the framesets with the given indices as keyframes, in a saved map (``begin``) or a new one.

    The frame of the map is the first pose of the walk. The map is saved to ``keep``, unless it is None.
    """
    assert source.truth is not None
    truth = load_trajectory(source.truth)
    first_T_world = se3_inverse(np.ascontiguousarray(truth.at(source.stamps_ns[:1], _GAP_S)[0].nav_T_body[0]))
    all_true = first_T_world @ truth.at(source.stamps_ns, _GAP_S)[0].nav_T_body
    stamps, true = source.stamps_ns[indices], all_true[indices]
    pose_of = dict(zip(source.stamps_ns.tolist(), all_true, strict=True))
    front_end = SyntheticFrontEnd(
        source.rig, stamps.tolist(), se3_inverse(true[0]) @ true, source.frameset_at, _SIGMAS, draw
    )
    with Mapper(front_end, Config(), begin) as mapper:
        front_end.has_room = lambda: mapper.summary()["places_waiting"] in (0, 1)
        mapper.run()
        if keep is not None:
            mapper.save(keep)
        closures = [
            (
                each.reference_T_current,
                se3_inverse(pose_of[each.reference.stamp_ns]) @ pose_of[each.current.stamp_ns],
                is_used,
            )
            for each, is_used in mapper.closures
        ]
        return _Run(true, front_end.odom_T_body, mapper.trajectory, front_end.corrections, closures, mapper.summary())


def _drift_row(draw: int, run: _Run) -> list[str]:
    before, after = (
        1e3 * np.linalg.norm(poses[:, :3, 3] - run.truth[:, :3, 3], axis=1)
        for poses in (run.drifted, run.mapped.nav_T_body)
    )
    wrong = [_is_wrong(found, true) for found, true, _ in run.closures]
    used = [is_used for _, _, is_used in run.closures]
    return [
        str(draw),
        f"{before[-1]:.0f}",
        f"{after[-1]:.0f}",
        f"{np.sqrt((before**2).mean()):.0f}",
        f"{np.sqrt((after**2).mean()):.0f}",
        str(run.summary["places"]),
        str(len(wrong)),
        str(sum(wrong)),
        str(sum(used)),
        str(sum(is_wrong and is_used for is_wrong, is_used in zip(wrong, used, strict=True))),
    ]


def _is_wrong(found: Float, true: Float) -> bool:
    error = se3_log(se3_inverse(true) @ found)
    return bool(np.linalg.norm(error[3:]) > _WRONG_M or np.linalg.norm(error[:3]) > _WRONG_RAD)


def _corrections_row(draw: int, run: _Run) -> list[str]:
    squares = []
    for number, pose, covariance in run.corrections:
        error = se3_log(se3_inverse(pose) @ run.truth[number])
        squares.append(float(error @ np.linalg.solve(covariance, error)))
    return [str(draw), str(len(squares)), f"{np.median(squares):.1f}", f"{max(squares):.1f}", "6"]


def _session_row(start_s: float, run: _Run) -> list[str]:
    if not run.corrections:
        return [f"{start_s:g}", "never", *["-"] * 5]
    number, pose, covariance = run.corrections[0]
    error = se3_log(se3_inverse(pose) @ run.truth[number])
    last, newest, _ = run.corrections[-1]
    return [
        f"{start_s:g}",
        str(number + 1),
        f"{np.linalg.norm(np.diff(run.truth[: number + 1, :3, 3], axis=0), axis=1).sum():.2f}",
        f"{1e3 * np.linalg.norm(error[3:]):.1f}",
        f"{np.rad2deg(np.linalg.norm(error[:3])):.2f}",
        f"{1e3 * np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]):.1f}",
        f"{1e3 * np.linalg.norm(newest[:3, 3] - run.truth[last, :3, 3]):.1f}",
    ]


def _stage_rows(summaries: Sequence[Mapping[str, float | int | str | None]]) -> list[list[str]]:
    return [[stage, f"{np.mean([each[f'{stage}_ms'] for each in summaries]):.0f}"] for stage in _STAGES]
