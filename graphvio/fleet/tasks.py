"""The stages of one session as tasks: each fetches its inputs, works in a folder of its own, and stores its results.

A task that is finished already, by an earlier run or by a worker that was taken for dead, returns the same marker.
Partial results of an interrupted task are overwritten when it is done again, or removed when the session is finished.
"""

from __future__ import annotations

import json
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from graphvio.config import Config
from graphvio.errors import FleetError, TrajectoryError
from graphvio.evaluation import evaluate
from graphvio.fleet.markers import Marker, finished, forget, refuse_others
from graphvio.fleet.storage import Storage, fetch_recording
from graphvio.optimization.loops.closures import load_closures
from graphvio.optimization.loops.database import FeatureDatabase
from graphvio.optimization.loops.features import extract_places, merge_places
from graphvio.optimization.pipeline import DATABASE, Session, Stages
from graphvio.optimization.record import SessionRecord
from graphvio.optimization.workspace import digest
from graphvio.rig import Rig
from graphvio.rig_files.native import to_text
from graphvio.sources import Source
from graphvio.sources.reading import Reading
from graphvio.trajectory_files import load_trajectory
from graphvio.version import __version__

ODOMETRY, LOOPS, GRAPH = "odometry", "loops", "graph"

_ONE_AT_A_TIME = threading.Lock()  # the odometry has threads of its own, and fetched recordings share a folder
_STATE = "stages.json"  # written by `Workspace` for a folder in which one process runs all stages; not stored


@dataclass(frozen=True, eq=False)
class Job:
    """A session to optimise."""

    name: str  # session name
    recording: str  # path or URL
    results: str  # path or URL of its folder of results
    config: Config  # configuration of all stages
    rig: Rig | None  # rig, or None for the recording's own
    with_loops: bool  # whether loop closures are searched
    places_per_task: int  # maximum number of places whose features one task extracts
    reading: Reading = field(default_factory=Reading)  # what is read of the recording
    calibrates: bool = False  # whether the graph has extrinsics and time offset as variables
    version: str = __version__  # version of graphvio

    @property
    def inputs(self) -> dict[str, str]:
        """Name -> value of everything that determines the results and is known without opening the recording."""
        return {
            "recording": self.recording,
            "config": self.config.sha256(),
            "graphvio": self.version,
            "rig": "" if self.rig is None else digest(to_text(self.rig, Path())),
            "loops": str(self.with_loops),
            "calibration": str(self.calibrates),
            "reading": str(self.reading),
        }


def features_stage(part: int, parts: int) -> str:
    """Return the name of the stage that extracts the features of one part of the places."""
    return f"features-{part}-of-{parts}"


def odometry(job: Job) -> Marker:
    """Run the odometry; the marker's figures are from the summary, and ``parts``, the number of feature tasks."""

    def work(task: _Task) -> dict[str, Any]:
        """Calibrate if it is wanted, record the odometry, and return the figures of its summary."""
        if task.stages.calibrates_first:
            task.stages.calibrate(0)
        record = task.stages.record(0)
        summary = json.loads((task.folder / job.name / "odometry" / "summary.json").read_text(encoding="utf-8"))
        places = len(task.stages.places(0, record).places)
        truth = summary["evaluation"]
        return {
            "parts": max(1, -(-places // job.places_per_task)),
            "framesets": summary["framesets"],
            "duration_s": summary["duration_s"],
            "path_length_m": summary["path_length_m"],
            "completion": summary["completion"],
            "epochs": len(summary["epochs"]),
            "resets": summary["resets"],
            "ate_odometry_m": None if truth is None else truth["ate_position_m"]["rmse"],
        }

    return _perform(job, ODOMETRY, work)


def features(job: Job, part: int, parts: int) -> Marker:
    """Extract the features of one part of the places into a separate database."""

    def work(task: _Task) -> dict[str, Any]:
        """Write the features of this part's places; there are no figures."""
        task.fetch(ODOMETRY)
        session = task.stages.places(0, task.record())
        stamps = [place.stamp_ns for place in session.places]
        first, last = part * len(stamps) // parts, (part + 1) * len(stamps) // parts
        path = task.folder / _part_name(part, parts)
        path.parent.mkdir()
        with FeatureDatabase(path) as database:
            extract_places(session.source, session.rig, session.name, stamps[first:last], database, job.config)
        return {}

    return _perform(job, features_stage(part, parts), work)


def loops(job: Job, parts: int) -> Marker:
    """Join the databases of all parts, and find loop closures."""

    def work(task: _Task) -> dict[str, Any]:
        """Merge the parts' features, and return the number of loop closures found."""
        task.fetch(ODOMETRY, *(features_stage(part, parts) for part in range(parts)))
        record = task.record()
        session = task.stages.places(0, record)
        stamps = [place.stamp_ns for place in session.places]
        with FeatureDatabase(task.folder / DATABASE) as whole:
            for part in range(parts):
                with FeatureDatabase(task.folder / _part_name(part, parts)) as database:
                    merge_places(database, whole, session.name, session.rig, stamps)
        forget(task.storage, GRAPH)  # as that stage adds to the database
        return {"loops_found": len(task.stages.closures([record]))}

    marker = _perform(job, LOOPS, work)
    for part in range(parts):
        Storage(job.results).remove(_part_name(part, parts))
    return marker


def graph(job: Job) -> Marker:
    """Optimise the session as one graph, and write the results."""

    def work(task: _Task) -> dict[str, Any]:
        """Solve the graph, and return the figures of its result."""
        task.fetch(ODOMETRY, *([LOOPS] if job.with_loops else []))
        closures = load_closures(task.folder / "loops.npz") if job.with_loops else None
        found = task.stages.result([task.record()], closures)
        return {
            "loops_found": len(found.loops),
            "loops_used": sum(not loop.refusal for loop in found.loops),
            "cost_before": found.cost_before,
            "cost_after": found.cost_after,
            "frames": len(set(found.frames)),
            "ate_m": _ate_m(task.folder / "trajectory_optimized.txt", task.source.truth),
        }

    marker = _perform(job, GRAPH, work, changed=(DATABASE,))
    Storage(job.results).remove_unfinished()
    return marker


@dataclass(eq=False)
class _Task:
    """A stage while it runs, in a folder of its own."""

    job: Job
    folder: Path
    source: Source
    stages: Stages
    storage: Storage
    done: Mapping[str, Marker]
    fetched: set[str] = field(default_factory=set)

    def fetch(self, *stages: str) -> None:
        """Fetch the files of earlier stages into the task's folder.

        Raises:
            FleetError: if the files of a stage do not exist any more.
        """
        for stage in stages:
            if stage not in self.done:
                raise FleetError(f"{self.job.results}: the files of {stage} are gone; run it again")
            for name in self.done[stage].files:
                self.fetched.add(name)
                self.storage.fetch(name, self.folder / name)
        if ODOMETRY in stages and self.stages.calibrates_first:
            self.stages.use_calibrated(0)

    def record(self) -> SessionRecord:
        """Load the odometry's record, which has been fetched."""
        return SessionRecord.load(self.folder / self.job.name / "record.npz")


def _perform(job: Job, stage: str, work: Callable[[_Task], dict[str, Any]], changed: Sequence[str] = ()) -> Marker:
    """Do the work, unless it is done already, and store its new files and the fetched ones in ``changed``."""
    begun = perf_counter()
    if job.version != __version__:
        raise FleetError(f"this worker has graphvio {__version__}, and was asked by {job.version}; install one version")
    storage = Storage(job.results)
    with _ONE_AT_A_TIME, _scratch() as (kept, scratch):
        done = finished(storage, job.inputs)
        if stage in done:
            return done[stage]
        recording = fetch_recording(job.recording, kept)
        source = job.reading.open(recording, job.rig, job.config.timing.simultaneous_ms)
        stages = Stages(
            [Session(job.name, source)], scratch, job.config, with_loops=job.with_loops, calibrates=job.calibrates
        )
        inputs = stages.inputs | job.inputs
        refuse_others(storage, done.values(), inputs)
        task = _Task(job, scratch, source, stages, storage, done)
        figures = work(task)
        there = {str(path.relative_to(scratch)) for path in scratch.rglob("*") if path.is_file()}
        made = sorted(there - task.fetched - {_STATE})
        for name in [*made, *sorted(task.fetched.intersection(changed))]:
            storage.put(scratch / name, name)
        marker = Marker(stage, inputs, made, perf_counter() - begun, figures)
        marker.write(storage)
        return marker


@contextmanager
def _scratch() -> Iterator[tuple[Path, Path]]:
    """Yield a folder that exists as long as the worker, if there is one, and a folder of this task alone."""
    try:
        with tempfile.TemporaryDirectory(prefix="graphvio-", dir=_worker_folder()) as own:
            scratch = Path(own) / "session"
            scratch.mkdir()
            yield Path(_worker_folder() or own), scratch
    except OSError as error:
        raise FleetError(f"{error.filename or tempfile.gettempdir()}: {error.strerror or error}") from None


def _worker_folder() -> str | None:
    from distributed import get_worker

    try:
        return str(get_worker().local_directory)
    except ValueError:
        return None


def _part_name(part: int, parts: int) -> str:
    return f"parts/features-{part}-of-{parts}.db"


def _ate_m(trajectory: Path, truth: Path | None) -> float | None:
    """Compute the ATE rmse of the optimised trajectory; None without a true trajectory that matches."""
    if truth is None:
        return None
    try:
        return evaluate(load_trajectory(trajectory), load_trajectory(truth)).ate_position_m.rmse
    except TrajectoryError:
        return None
