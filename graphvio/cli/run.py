"""``graphvio run``: runs the odometry on a recording, and writes a folder of results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options
from graphvio.cli.json_output import publish
from graphvio.cli.shared import (
    EXIT_INCOMPLETE,
    MIN_COMPLETION,
    TerminalDisplay,
    ends_at_interrupt,
    open_recording,
    warn,
)

if TYPE_CHECKING:
    from graphvio.pipeline import Progress
    from graphvio.results import Summary

_DOUBTFUL = ("vision_failed", "vision_weak", "vision_gated")
_MAX_DOUBTFUL_SHARE = 0.3  # of all framesets


def run(
    source: options.Source,
    reading: options.ReadingOptions,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results, new or empty.  [default: results/NAME-N]")
    ] = None,
    view: options.View = False,
    save_rrd: options.SaveRrd = None,
) -> None:
    """Estimate the trajectory of a recording.

    The exit code is 0; 2 if the input cannot be used; 3 if less than 90 % of the framesets since the initialisation
    have a pose (the results are written all the same).

    Examples:

        graphvio run MH_01_easy

        graphvio run walk --pairs 0 --no-imu --out front-only

        graphvio run walk --from 10 --to 40 --save-rrd walk.rrd
    """
    from contextlib import ExitStack
    from dataclasses import asdict

    from graphvio.cli.warming import warm_up_visibly
    from graphvio.config import Config
    from graphvio.odometry import Odometry
    from graphvio.pipeline import RunListener
    from graphvio.pipeline import run as run_pipeline
    from graphvio.results import ResultWriter
    from graphvio.runtime import set_up_threads
    from graphvio.viewer import Viewer

    settings = Config.load(reading.config)
    opened = open_recording(source, reading, settings)
    folder = out if out is not None else ResultWriter.new_folder(Path("results"), opened.name)
    with ExitStack() as stack:
        writer = stack.enter_context(ResultWriter(folder, opened.rig, settings.to_yaml()))
        listeners = []
        if view or save_rrd:
            viewer = stack.enter_context(Viewer(opened.rig, spawn=view, save=save_rrd))
            listeners.append(
                RunListener(on_estimate=viewer.show, on_event=viewer.show_event, on_calibration=viewer.show_calibration)
            )
        set_up_threads()
        warm_up_visibly(opened.rig, settings, wait_for_calibration=False)
        listeners.append(RunListener(on_progress=stack.enter_context(_ProgressLine()).show))
        with ends_at_interrupt(f"interrupted; what was estimated until then is in {folder}"):
            summary = run_pipeline(opened, Odometry(opened.rig, settings), writer, listeners)
    publish(asdict(summary) | {"results": str(folder)})
    _print_summary(summary, folder)
    if summary.completion < MIN_COMPLETION:
        warn(
            f"only {100 * summary.completion:.0f} % of the framesets have a pose; "
            f"{folder / 'events.jsonl'} says when and why"
        )
        raise typer.Exit(EXIT_INCOMPLETE)


class _ProgressLine(TerminalDisplay):
    """Display of the progress: one line that is refreshed in a terminal, or a new line every few seconds elsewhere."""

    _REFRESH_S = 0.1
    _PLAIN_S = 5.0

    def __init__(self) -> None:
        super().__init__()
        self._period_s = self._REFRESH_S if self._console.is_terminal else self._PLAIN_S

    def show(self, progress: Progress) -> None:
        """Show the progress, at most at the refresh rate."""
        if progress.wall_s < self._next_s and progress.framesets < progress.total:
            return
        self._next_s = progress.wall_s + self._period_s
        latest = progress.latest
        rate = progress.framesets / max(progress.wall_s, 1e-9)
        realtime = progress.recorded_s / max(progress.wall_s, 1e-9)
        features = " ".join(f"{report.inliers}/{report.points}" for _, report in sorted(latest.pairs.items()))
        text = (
            f"{progress.framesets}/{progress.total}  {progress.recorded_s:6.1f} s  {progress.distance_m:7.2f} m  "
            f"{rate:5.1f} framesets/s ({realtime:.2f} x real time)  {latest.status:<12}  points {features}"
        )
        if self._console.is_terminal:
            self._live.update(text, refresh=True)
        else:
            self._print(text)


def _print_summary(summary: Summary, folder: Path) -> None:
    from graphvio.measurements.events import CORRECTED

    evaluation = summary.evaluation
    refined = folder / "rig-refined.yaml"
    remedy = f"{refined} has it" if refined.exists() else "graphvio calibrate --what all finds by how much"
    typer.echo(
        f"{summary.estimated} of {summary.framesets} framesets estimated, {summary.path_length_m:.2f} m in "
        f"{summary.duration_s:.1f} s, {summary.realtime_factor:.2f} x real time"
    )
    if evaluation is not None:
        drift = evaluation["drift_percent"]
        typer.echo(
            f"against the recording's truth: ATE rmse {1e3 * evaluation['ate_position_m']['rmse']:.1f} mm"
            + (f", drift {drift:.2f} % of the path" if drift is not None else "")
        )
    if summary.evaluation_error is not None:
        warn(f"not compared with the recording's truth: {summary.evaluation_error}")
    faults = ", ".join(f"{kind} {count}" for kind, count in sorted(summary.input_faults.items()))
    if faults:
        typer.echo(f"faults of the recording: {faults}")
    for sentence in summary.calibration:
        typer.echo(sentence)
    for warning in summary.warnings:
        warn(f"{warning}; {remedy}" if warning.endswith(CORRECTED) else warning)
    doubtful = sum(summary.events.get(kind, 0) for kind in _DOUBTFUL)
    if doubtful > _MAX_DOUBTFUL_SHARE * summary.framesets:
        warn(
            f"vision failed, was weak, or contradicted the IMU in {min(doubtful, summary.framesets)} of "
            f"{summary.framesets} framesets: see "
            f"{folder / 'events.jsonl'}; check the calibration (graphvio rig), the IMU's units and axes, and compare "
            "with --no-imu"
        )
    if summary.resets:
        typer.echo(f"reinitialised {summary.resets} times: see {folder / 'events.jsonl'}")
    typer.echo(f"results: {folder}")
