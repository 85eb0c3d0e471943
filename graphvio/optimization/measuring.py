"""Run of a session's odometry that writes results to files and records the measurements for the graph."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

from graphvio.odometry import Odometry
from graphvio.optimization.loops.ahead import FeaturesAhead
from graphvio.optimization.record import Recorder
from graphvio.pipeline import RunListener, run
from graphvio.results import ResultWriter
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.sources import Source


def measure(
    source: Source,
    odometry: Odometry,
    recorder: Recorder,
    folder: Path,
    on_progress: Callable[[int, int], None],
    ahead: FeaturesAhead | None = None,
) -> bool:
    """Run an odometry on a session, write its results and record its measurements.

    Args:
        source: the session's recording.
        odometry: an odometry that has processed nothing yet.
        recorder: records what the odometry measures.
        folder: the folder of the odometry's results; those of an interrupted run are removed.
        on_progress: called with the number of estimated framesets and of all framesets.
        ahead: extracts the features of those places that are known while the odometry runs. It stops where the
            calibration is corrected, as all features have to be matched in stereo with the same calibration.

    Returns:
        Whether the calibration was not corrected and the odometry has no warning on the rig. Also False if there were
        several epochs, as single cameras may then have corrected a calibration without having reported it yet.
    """
    is_as_given = True

    def note_calibration(_: int, estimate: CalibrationEstimate) -> None:
        nonlocal is_as_given
        is_as_given &= estimate.is_file_exact
        if ahead is not None and not is_as_given:
            ahead.stop()

    listeners = [
        RunListener(
            on_step=recorder.add,
            on_calibration=note_calibration,
            on_smoothed=recorder.add_smoothed,
            on_views=recorder.add_views,
            on_progress=lambda progress: on_progress(progress.framesets, progress.total),
        ),
    ]
    if ahead is not None:
        listeners.append(RunListener(on_step=ahead.add, on_smoothed=ahead.add_smoothed))
    shutil.rmtree(folder, ignore_errors=True)
    with ResultWriter(folder, odometry.rig, odometry.config.to_yaml()) as writer, ahead or nullcontext():
        summary = run(source, odometry, writer, listeners)
    return is_as_given and len(summary.epochs) <= 1 and not odometry.rig_warnings
