"""``graphvio run``: a recording in, a folder of results out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options
from graphvio.cli.redrawn import Redrawn

if TYPE_CHECKING:
    from graphvio.config import Config
    from graphvio.pipeline import Progress
    from graphvio.results import Summary
    from graphvio.rig import Rig
    from graphvio.sources import Source

EXIT_INCOMPLETE = 3
EXIT_INTERRUPTED = 130
LEAST_COMPLETION = 0.9


def run(
    source: options.Source,
    rig: options.RigFile = None,
    topics: options.Topics = None,
    config: options.ConfigName = "default",
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results, new or empty.  [default: results/NAME-N]")
    ] = None,
    pairs: options.Pairs = None,
    no_imu: options.NoImu = False,
    from_s: options.FromS = None,
    to_s: options.ToS = None,
    view: Annotated[bool, typer.Option("--view", help="Watch it in the rerun viewer.")] = False,
    save_rrd: Annotated[
        Path | None, typer.Option("--save-rrd", help="Save what the viewer would show; needs no display.")
    ] = None,
    verbose: options.Verbose = False,
) -> None:
    """Estimate the trajectory of a recording.

    Ends with exit code 0; with 2 where the input cannot be used; with 3 where less than 90 % of the framesets
    have a pose (the results are written all the same).

    Examples:

        graphvio run MH_01_easy

        graphvio run walk --pairs 0 --no-imu --out front-only

        graphvio run walk --from 10 --to 40 --save-rrd walk.rrd
    """
    from contextlib import ExitStack

    from graphvio.config import Config
    from graphvio.pipeline import RunListener
    from graphvio.pipeline import run as run_pipeline
    from graphvio.results import ResultWriter
    from graphvio.runtime import interruptible, use_one_opencv_thread
    from graphvio.viewer import Viewer
    from graphvio.warmup import warm_up

    settings = Config.load(config)
    opened = open_recording(source, rig, settings, pairs=pairs, no_imu=no_imu, from_s=from_s, to_s=to_s, topics=topics)
    folder = out if out is not None else ResultWriter.new_folder(Path("results"), opened.name)
    with ExitStack() as stack:
        writer = stack.enter_context(ResultWriter(folder, opened.rig, settings.to_yaml()))
        listeners = []
        if view or save_rrd:
            viewer = stack.enter_context(Viewer(opened.rig, spawn=view, save=save_rrd))
            listeners.append(RunListener(on_estimate=viewer.show, on_event=viewer.show_event))
        use_one_opencv_thread()
        warm_up(opened.rig, settings)
        listeners.append(RunListener(on_progress=stack.enter_context(_ProgressLine()).show))
        try:
            with interruptible():
                summary = run_pipeline(opened, settings, writer, listeners)
        except KeyboardInterrupt:
            typer.echo(f"graphvio: interrupted; what was estimated until then is in {folder}", err=True)
            raise typer.Exit(EXIT_INTERRUPTED) from None
    _tell(summary, folder)
    if summary.completion < LEAST_COMPLETION:
        typer.echo(
            f"graphvio: only {100 * summary.completion:.0f} % of the framesets have a pose; "
            f"{folder / 'events.jsonl'} tells when and why",
            err=True,
        )
        raise typer.Exit(EXIT_INCOMPLETE)


def open_recording(
    source: Path,
    rig: Path | None,
    settings: Config,
    *,
    pairs: str | None,
    no_imu: bool,
    from_s: float | None,
    to_s: float | None,
    topics: str | None = None,
) -> Source:
    """A recording as the options of a command ask for it."""
    from graphvio.rig_files import load_rig
    from graphvio.sources import open_source

    tolerance_ms = settings.timing.simultaneous_ms
    loaded = None if rig is None else load_rig(rig)
    mapped = _topics(topics)
    opened = open_source(source, loaded, from_s=from_s, to_s=to_s, tolerance_ms=tolerance_ms, topics=mapped)
    chosen = _choose(opened.rig, pairs, no_imu)
    if chosen is opened.rig:
        return opened
    return open_source(source, chosen, from_s=from_s, to_s=to_s, tolerance_ms=tolerance_ms, topics=mapped)


def _topics(text: str | None) -> dict[str, str]:
    """Name of a camera or ``imu`` -> topic."""
    from graphvio.errors import SourceError

    pairs = [each.split("=") for each in (text or "").split(",") if each]
    if any(len(pair) != 2 or not all(pair) for pair in pairs):
        raise SourceError(f"--topics {text}: give NAME=TOPIC separated by commas, such as cam0=/left/image,imu=/imu")
    return {name.strip(): topic.strip() for name, topic in pairs}


def _choose(rig: Rig, pairs: str | None, no_imu: bool) -> Rig:
    from graphvio.errors import RigError

    if pairs is not None:
        try:
            indices = [int(text) for text in pairs.split(",")]
        except ValueError:
            raise RigError(f"--pairs {pairs}: give numbers separated by commas, such as 0,1") from None
        rig = rig.with_pairs(indices)
    return rig.without_imu() if no_imu else rig


class _ProgressLine(Redrawn):
    """One line that is drawn over on a terminal, and every few seconds a line of its own elsewhere."""

    _REFRESH_S = 0.1
    _PLAIN_S = 5.0

    def __init__(self) -> None:
        super().__init__()
        self._period_s = self._REFRESH_S if self._console.is_terminal else self._PLAIN_S

    def show(self, progress: Progress) -> None:
        """Draw the line, if it is time to."""
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
            self._console.print(text, soft_wrap=True, highlight=False)


def _tell(summary: Summary, folder: Path) -> None:
    evaluation = summary.evaluation
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
    faults = ", ".join(f"{kind} {count}" for kind, count in sorted(summary.input_faults.items()))
    if faults:
        typer.echo(f"faults of the recording: {faults}")
    for warning in summary.warnings:
        typer.echo(f"graphvio: {warning}; graphvio calibrate finds where it is", err=True)
    if summary.resets:
        typer.echo(f"started anew {summary.resets} times: see {folder / 'events.jsonl'}")
    typer.echo(f"results: {folder}")
