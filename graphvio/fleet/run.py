"""Run of many sessions through all stages on Dask's workers; a failed session does not affect the others."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.fleet import tasks
from graphvio.fleet.cluster import RETRIES, compile_kernels, connected, distributed
from graphvio.fleet.listing import Listed
from graphvio.fleet.markers import Marker, finished
from graphvio.fleet.storage import Storage, local_path
from graphvio.fleet.table import Outcome, write_tables
from graphvio.optimization.loops.colmap_library import colmap
from graphvio.rig import Rig
from graphvio.sources.reading import Reading

PLACES_PER_TASK = 200
"""Places whose features one task extracts: about 80 m of a walk, and about ten seconds of work."""

_PRIORITY = {tasks.ODOMETRY: 0, "features": 1, tasks.LOOPS: 2, tasks.GRAPH: 3}  # sessions that were begun come first


@dataclass(frozen=True)
class FleetProgress:
    """Progress of a fleet run."""

    sessions: int  # number of sessions
    optimized: int  # sessions with results
    failed: int  # sessions that were given up
    tasks: int  # tasks that have ended in this run, including failed ones
    latest: str  # stage and session of the task that ended last; empty before the first has


Progress = Callable[[FleetProgress], None]


def optimize_fleet(
    sessions: Sequence[Listed],
    out: str,
    config: Config,
    *,
    rig: Rig | None = None,
    with_loops: bool = True,
    calibrates: bool = False,
    reading: Reading | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    places_per_task: int = PLACES_PER_TASK,
    on_progress: Progress | None = None,
) -> list[Outcome]:
    """Optimise each session by itself, and write a table of all sessions.

    A task that fails, or whose worker dies, is done again up to twice; then its session is given up. When called again
    with the same arguments, only missing stages are done.

    Args:
        sessions: sessions with unique names; each gets a folder of results.
        out: path or URL of the folder of all results.
        config: configuration of all stages.
        rig: rig of all sessions; None takes the recordings' own.
        with_loops: whether loop closures are searched, which needs the extra ``maps``.
        calibrates: whether the graphs have extrinsics and time offset as variables, see
            `graphvio.optimization.pipeline.optimize_sessions`.
        reading: which part of each recording is read; None for all of it.
        scheduler: address of a Dask scheduler; None takes workers on this machine.
        workers: processes on this machine; None takes `default_workers`.
        places_per_task: maximum number of places whose features one task extracts.
        on_progress: called at the beginning and whenever a task has ended.

    Returns:
        The outcome of each session, in the order of ``sessions``.

    Raises:
        FleetError: if the scheduler or the folder of results cannot be reached.
        MissingExtraError: if an extra is not installed.
    """
    if with_loops:
        colmap()
    distributed()
    where = local_path(out)
    out = out.rstrip("/") if where is None else str(where)
    jobs = [
        tasks.Job(
            each.name,
            each.recording,
            f"{out}/{each.name}",
            config,
            rig,
            with_loops,
            places_per_task,
            reading or Reading(),
            calibrates,
        )
        for each in sessions
    ]
    fleet = _Fleet([_Session(job) for job in jobs], on_progress)
    waiting = fleet.find_unfinished()
    if waiting:
        if scheduler is None:
            compile_kernels([session.job.recording for session in waiting], rig, config)
        with connected(scheduler, workers) as client:
            fleet.run(client, waiting)
    outcomes = [each.outcome() for each in fleet.sessions]
    write_tables(outcomes, Storage(out))
    return outcomes


@dataclass(eq=False)
class _Session:
    """Progress of one session."""

    job: tasks.Job  # the session to optimise
    markers: dict[str, Marker] = field(default_factory=dict)  # stage -> marker, of finished stages
    parts_left: int = 0  # number of feature tasks that have not ended
    failed_in: str = ""  # stage in which it was given up, or empty
    error: str = ""  # its error in one line, or empty

    @property
    def parts(self) -> int:
        return int(self.markers[tasks.ODOMETRY].figures["parts"])

    @property
    def is_optimized(self) -> bool:
        needed = {tasks.ODOMETRY, tasks.GRAPH} | ({tasks.LOOPS} if self.job.with_loops else set())
        return needed <= set(self.markers)

    def outcome(self) -> Outcome:
        figures: dict[str, Any] = {}
        wall_s = dict.fromkeys(("odometry", "features", "loops", "graph"), 0.0)
        for marker in self.markers.values():
            figures |= marker.figures
            wall_s[marker.stage.partition("-")[0]] += marker.wall_s
        return Outcome(self.job.name, self.job.recording, figures, wall_s, self.failed_in, self.error)


class _Fleet:
    """Submits the stages of all sessions as tasks, each when the stages before it have ended."""

    def __init__(self, sessions: Sequence[_Session], on_progress: Progress | None) -> None:
        self.sessions = sessions
        self._on_progress = on_progress
        self._ended = 0
        self._run = uuid.uuid4().hex[:8]
        self._of_future: dict[Any, tuple[_Session, str]] = {}

    def find_unfinished(self) -> list[_Session]:
        """Read the markers of earlier runs, and return the sessions that are not finished."""
        waiting = []
        for session in self.sessions:
            try:
                session.markers = finished(Storage(session.job.results), session.job.inputs)
            except GraphvioError as error:
                session.failed_in, session.error = tasks.ODOMETRY, _one_line(error)
            if not session.error and not session.is_optimized:
                session.markers.pop(tasks.GRAPH, None)  # its inputs will be made again
                waiting.append(session)
        self._report("")
        return waiting

    def run(self, client: Any, waiting: Sequence[_Session]) -> None:
        """Run the missing stages of the sessions."""
        first = [self._submit(client, session, tasks.ODOMETRY, tasks.odometry) for session in waiting]
        running = distributed().as_completed(first, loop=client.loop)
        try:
            for future in running:
                session, stage = self._of_future.pop(future)
                for following in self._after(client, session, stage, future):
                    running.add(following)
                self._ended += 1
                self._report(f"{stage} of {session.job.name}")
        except BaseException:
            client.cancel(list(self._of_future), force=True)
            raise

    def _after(self, client: Any, session: _Session, stage: str, future: Any) -> list[Any]:
        """Use the result of a task, and submit the tasks that can follow."""
        try:
            marker = future.result()
        except Exception as error:
            if not session.error:
                session.failed_in, session.error = stage, _one_line(error)
            return []
        session.markers[stage] = marker
        job = session.job
        if stage == tasks.ODOMETRY and job.with_loops and tasks.LOOPS not in session.markers:
            session.parts_left = session.parts
            return [
                self._submit(
                    client, session, tasks.features_stage(part, session.parts), tasks.features, part, session.parts
                )
                for part in range(session.parts)
            ]
        if stage.startswith("features"):
            session.parts_left -= 1
            if session.parts_left:
                return []
            return [self._submit(client, session, tasks.LOOPS, tasks.loops, session.parts)]
        if stage == tasks.GRAPH:
            return []
        return [self._submit(client, session, tasks.GRAPH, tasks.graph)]

    def _submit(
        self, client: Any, session: _Session, stage: str, function: Callable[..., Marker], *arguments: int
    ) -> Any:
        future = client.submit(
            function,
            session.job,
            *arguments,
            key=f"{stage}-{session.job.name}-{self._run}",
            priority=_PRIORITY[stage.partition("-")[0]],
            retries=RETRIES,
            pure=False,
        )
        self._of_future[future] = session, stage
        return future

    def _report(self, latest: str) -> None:
        if self._on_progress is not None:
            optimized = sum(session.is_optimized for session in self.sessions)
            failed = sum(bool(session.error) for session in self.sessions)
            self._on_progress(FleetProgress(len(self.sessions), optimized, failed, self._ended, latest))


def _one_line(error: BaseException) -> str:
    """Describe a task's error for the table."""
    library = distributed()
    if isinstance(error, library.KilledWorker):
        text = "its workers died each time: killed, or out of memory"
    elif isinstance(error, library.client.FutureCancelledError):
        text = "cancelled: the connection to the scheduler was lost, or the scheduler ended"
    elif isinstance(error, GraphvioError):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error}"
    return " ".join(text.split())
