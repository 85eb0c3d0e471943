"""``graphvio calibrate`` and ``graphvio calibrate-trajectories``: calibration of rigs from their motion."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import completion, options
from graphvio.cli.json_output import publish
from graphvio.cli.shared import EXIT_INCOMPLETE, names_of, open_recording, warn

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from rich.table import Table

    from graphvio.calibration.nuisances import ScaleMode
    from graphvio.calibration.result import Calibration


def calibrate(
    source: options.Source,
    rig: options.RigFile = None,
    topics: options.Topics = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Write the corrected rig to this new file (.yaml), and all numbers next to it.",
            metavar="FILE",
        ),
    ] = None,
    report: options.ReportFolder = None,
    what: Annotated[
        str,
        typer.Option(
            "--what",
            help="What to calibrate: pairs, stereo, cameras, imu or all.",
            metavar="WHAT",
            autocompletion=completion.calibration_part,
        ),
    ] = "pairs",
    correct_imu: Annotated[
        bool, typer.Option("--correct-imu", help="Also correct the rotation against the IMU and the time offset.")
    ] = False,
    guide: Annotated[
        bool,
        typer.Option("--guide", help="Print while reading which motions are still needed."),
    ] = False,
    scale: options.Scale = "auto",
    config: options.ConfigName = "default",
    pairs: options.Pairs = None,
    cameras: options.Cameras = None,
    no_pairs: options.NoPairs = False,
    from_s: options.FromS = None,
    to_s: options.ToS = None,
    seed: options.Seed = 0,
) -> None:
    """Calibrate a rig from a recording of its motion: the poses of its stereo pairs, or all of its parameters.

    For the recording, turn the rig about two axes while you walk, in a place with texture; half a minute is enough.

    --what pairs estimates the poses of the stereo pairs relative to each other; their views need not overlap. The rig
    file must be right about the two cameras within each pair; its poses of the pairs may be wrong. Each pair is also
    compared with the IMU, if there is one.

    --what all estimates everything, from a rig file that is approximately right: cameras (focal lengths, principal
    points, distortion), stereo (the extrinsics left to right), imu (cameras to IMU, time offset, scale), and pairs.
    With cameras, stereo or imu only these parameters are calibrated; the others are kept as in the rig file, which must
    be right about them. With an IMU, rigs of single cameras can be calibrated like this, too.

    The exit code is 0; 2 if nothing can be determined; 3 if the motions determine only a part.

    Examples:

        graphvio calibrate walk --out rig-calibrated.yaml --report calibration

        graphvio calibrate walk --rig rig.yaml --guide

        graphvio calibrate walk --what all --out rig-calibrated.yaml --report calibration
    """
    from graphvio.calibration.calibrate import calibrate_pairs
    from graphvio.calibration.report.document import write_document
    from graphvio.cli.calibrate_rig import calibrate_rig
    from graphvio.cli.calibration_progress import CalibrationProgress
    from graphvio.cli.warming import warm_up_visibly
    from graphvio.config import Config
    from graphvio.errors import CalibrationError
    from graphvio.rig_files import save_rig
    from graphvio.runtime import set_up_threads

    _check_outputs(out, report, [] if rig is None else [rig])
    is_of_pairs = _is_of_pairs(what, {"--correct-imu": correct_imu, "--guide": guide, "--scale": scale != "auto"})
    settings = Config.load(config)
    reading = options.ReadingOptions(
        rig=rig, topics=topics, pairs=pairs, cameras=cameras, no_pairs=no_pairs, from_s=from_s, to_s=to_s
    )
    opened = open_recording(source, reading, settings)
    if not is_of_pairs:
        calibrate_rig(opened, settings, what, out, report)
        return
    opened.rig.need_pairs("graphvio calibrate --what pairs")
    if correct_imu and (out is None or opened.rig.imu is None):
        raise CalibrationError("--correct-imu wants --out FILE to write the rig to, and a recording with an IMU")
    mode = _scale_mode(scale)
    set_up_threads()
    warm_up_visibly(opened.rig.with_pairs([0]).without_imu(), settings)
    names = [pair.name for pair in opened.rig.pairs]
    with CalibrationProgress(opened.frameset_count, names if guide else None) as progress:
        found = calibrate_pairs(opened, config=settings, seed=seed, scale_mode=mode, on_frameset=progress.on_frameset)
    _print_result(found)
    if out is not None:
        numbers = out.with_suffix(".calibration.yaml")
        write_document(found, numbers)
        if found.is_complete:
            save_rig(found.calibrated_rig(correct_imu), out)
            typer.echo(f"wrote {out}, and all numbers to {numbers}")
        else:
            warn(f"{out} is not written, only {numbers}: the motions determine a part only")
    _finish(found, report, opened.name, progress.framesets)


def calibrate_trajectories(
    trajectories: Annotated[list[Path], typer.Argument(help="Two or more: TUM, EuRoC, or csv with TUM's columns.")],
    same_clock: Annotated[
        bool, typer.Option("--same-clock", help="All stamps are from one clock; no offset is estimated.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write all numbers to this new file (.yaml).", metavar="FILE")
    ] = None,
    report: options.ReportFolder = None,
    scale: options.Scale = "auto",
    seed: options.Seed = 0,
) -> None:
    """Estimate the poses of cameras relative to each other from their trajectories, made by any odometry.

    Each trajectory may have its own world frame and its own clock: the offsets between clocks are found from the
    angular speeds, and drifts are estimated, too. The exit codes are those of `graphvio calibrate`.

    Examples:

        graphvio calibrate-trajectories front.txt back.txt

        graphvio calibrate-trajectories a.csv b.csv c.csv --report calibration
    """
    from graphvio.calibration.calibrate import calibrate_trajectories as calibrate_all
    from graphvio.calibration.report.document import write_document
    from graphvio.trajectory_files import load_trajectory

    mode = _scale_mode(scale)
    _check_outputs(out, report, trajectories)
    read = [load_trajectory(path) for path in trajectories]
    names = names_of(trajectories)
    with _working("calibrating clocks and cameras"):
        found = calibrate_all(read, names, same_clock=same_clock, seed=seed, scale_mode=mode)
    _print_result(found)
    if out is not None:
        write_document(found, out)
        typer.echo(f"wrote {out}")
    _finish(found, report, ", ".join(names), len(read[0]))


def _is_of_pairs(what: str, given: Mapping[str, bool]) -> bool:
    """Return whether ``--what`` is ``pairs``; if not, refuse the options that are only for calibrating pairs.

    Args:
        what: the value of ``--what``.
        given: name of each of these options -> whether it was given.
    """
    from graphvio.errors import CalibrationError, ConfigError
    from graphvio.odometry.recorded_calibration import GROUPS

    if what == "pairs":
        return True
    if what not in GROUPS:
        raise ConfigError(f"--what {what}: give one of pairs, {', '.join(GROUPS)}")
    for name, is_given in given.items():
        if is_given:
            raise CalibrationError(f"{name} is for --what pairs; leave it out with --what {what}")
    return False


def _working(text: str) -> AbstractContextManager[object]:
    """Return a context manager that shows in a terminal, with a text, that work is in progress."""
    from contextlib import nullcontext

    from rich.console import Console

    console = Console(stderr=True)
    return console.status(text) if console.is_terminal else nullcontext()


def _scale_mode(text: str) -> ScaleMode:
    from typing import cast, get_args

    from graphvio.calibration.nuisances import ScaleMode
    from graphvio.errors import ConfigError

    if text not in get_args(ScaleMode):
        raise ConfigError(f"--scale {text}: give one of {', '.join(get_args(ScaleMode))}")
    return cast(ScaleMode, text)


def _check_outputs(out: Path | None, report: Path | None, inputs: list[Path]) -> None:
    """Refuse output paths that cannot or must not be written, before a calibration of minutes begins."""
    import os

    from graphvio.errors import CalibrationError

    if out is not None:
        if out.suffix not in (".yaml", ".yml"):
            raise CalibrationError(f"--out {out}: is YAML; end its name in .yaml")
        if out.resolve() in [path.resolve() for path in inputs]:
            raise CalibrationError(f"--out {out}: is what is read; name another file")
        if out.is_file():
            raise CalibrationError(f"--out {out}: exists already; remove it, or choose another name")
        if out.is_dir() or not out.absolute().parent.is_dir() or not os.access(out.absolute().parent, os.W_OK):
            raise CalibrationError(f"--out {out}: cannot be written; name a file in a folder that exists")
    if report is not None:
        there = next(path for path in (report.absolute(), *report.absolute().parents) if path.exists())
        if not there.is_dir() or not os.access(there, os.W_OK):
            raise CalibrationError(f"--report {report}: cannot be made; name a folder elsewhere")


def _print_result(found: Calibration) -> None:
    from rich.console import Console

    from graphvio.calibration.pair_calibration import size_in_words

    Console(soft_wrap=True).print(_table(found))
    for (i, j), each in found.places.pairwise.items():
        errors = each.frame_errors_m if len(each.frames) else each.alignment_errors_m
        fits = each.frame_inlier if len(each.frames) else each.inlier
        typer.echo(
            f"{found.names[i]}, {found.names[j]}: {int(fits.sum())} of {len(fits)} motions fit, mean alignment error "
            f"{1e3 * errors[fits].mean():.2f} mm"
        )
    for j in range(1, len(found.names)):
        in_file = found.compare_rig(j)
        if in_file is not None and not in_file.is_off:
            typer.echo(f"the rig file has {found.names[j]} {size_in_words(in_file.tangent)} away{in_file.reliability}")
    for loop in found.places.loops:
        around = ", ".join(found.names[k] for k in loop.cameras)
        typer.echo(f"around {around}: two at a time miss by {size_in_words(loop.error)}")
    for (i, j), clock in (found.clocks or {}).items():
        typer.echo(
            f"{found.names[i]} to {found.names[j]}: add {1e-9 * clock.relation.offset_ns:.6f} s to a stamp of "
            f"{found.names[i]} (+- {1e3 * clock.offset_sigma_s:.2f} ms); drift {1e6 * clock.relation.drift:.0f} (+- "
            f"{1e6 * clock.drift_sigma:.0f}) microseconds per second"
        )
    for warning in found.warnings:
        warn(warning)


def _table(found: Calibration) -> Table:
    import numpy as np
    from rich.table import Table

    which = "" if found.rig is None else " (its left camera)"
    table = Table(title=f"Where {found.names[0]} is{which}, seen from", title_justify="left")
    for column in ("", "x", "y", "z"):
        table.add_column(column, justify="right" if column else "left", no_wrap=bool(column))
    for j in range(1, len(found.names)):
        summary = found.pose_summary(j)
        place = map(_with_sigma, 1e3 * summary.offset_m, 1e3 * summary.offset_sigmas_m, summary.offset_known)
        turn = map(_with_sigma, np.rad2deg(summary.turn_rad), np.rad2deg(summary.turn_sigmas_rad), summary.turn_known)
        table.add_row(f"{found.names[j]}, mm", *place)
        table.add_row("rotation vector, deg", *turn, end_section=True)
    return table


def _with_sigma(value: float, sigma: float, known: bool) -> str:
    digits = 2 if sigma > 0.05 else 3
    return f"{value:.{digits}f} ± {sigma:.{digits}f}" if known else "unknown"


def _finish(found: Calibration, report: Path | None, source: str, count: int) -> None:
    """Publish the calibration, write a report if asked for, and end with exit code 3 if the calibration is partial."""
    from graphvio.calibration.report.document import document

    publish(document(found))
    if report is not None:
        from graphvio.calibration.report.page import write_report

        with _working("writing the report"):
            page = write_report(found, report, source, count)
        typer.echo(f"report: {page}")
    if not found.is_complete:
        raise typer.Exit(EXIT_INCOMPLETE)
