"""Optimisation of recordings, stage by stage: calibration, odometry, features, loop closures, graph, map."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

from graphvio.config import Config
from graphvio.config.stages import CalibrationConfig
from graphvio.errors import CalibrationError, TrajectoryError
from graphvio.odometry import Odometry
from graphvio.odometry.recorded_calibration import CalibrationWindows, calibrating
from graphvio.optimization.colmap_export import export
from graphvio.optimization.exchange import covariance_text, frames_text, model_points, ply, trajectory_text, write_g2o
from graphvio.optimization.loops.ahead import FeaturesAhead
from graphvio.optimization.loops.closures import LoopClosure, Place, closures_to_bytes, load_closures
from graphvio.optimization.loops.database import FeatureDatabase, colmap_model
from graphvio.optimization.loops.features import extract_places, is_stored, merge_places
from graphvio.optimization.loops.places import choose_places
from graphvio.optimization.loops.search import SessionInput, find_loops
from graphvio.optimization.measuring import measure
from graphvio.optimization.optimize import Optimization, optimize
from graphvio.optimization.record import Recorder, SessionRecord
from graphvio.optimization.report.write import write_plan, write_report
from graphvio.optimization.session_calibration import FINDINGS, calibrated_rig, cannot_be_calibrated
from graphvio.optimization.workspace import Workspace, digest
from graphvio.rig import Rig
from graphvio.rig_files import load_rig
from graphvio.rig_files.native import to_text
from graphvio.sources import Source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory
from graphvio.version import __version__

DATABASE = "database.db"
_REFINED = "rig-refined.yaml"
_AHEAD = "features-ahead.db"  # features of a session that are extracted while its odometry runs

Progress = Callable[[str, float, float], None]
"""Called with the name of the stage, the amount of work done in it, and the total amount."""


@dataclass(frozen=True, eq=False)
class Session:
    """A recording with a name that is unique in an optimisation."""

    name: str
    source: Source


def optimize_sessions(
    sources: Sequence[Source],
    out: str | Path,
    config: Config,
    *,
    with_loops: bool = True,
    calibrates: bool = False,
    on_progress: Progress | None = None,
) -> Optimization:
    """Run the odometry on recordings, find loop closures within and between them, and optimise all in one graph.

    Args:
        sources: one or several recordings.
        out: folder of the results: new, or that of an interrupted optimisation of the same inputs, which is continued.
        config: configuration of all stages.
        with_loops: whether to find loop closures and write a map, which needs the extra ``maps``.
        calibrates: whether the extrinsics of the pairs and the IMU's time offset are variables of the graph. Each rig
            is then first calibrated from its whole recording, as it also is where the configuration has
            ``calibration: {online: true}``.
        on_progress: called with the progress of each stage.

    Returns:
        The trajectories with their covariances, and all loop closures; the folder has them as files.

    Raises:
        GraphvioError: if a recording cannot be read or holds no pose, or the folder cannot be used.
    """
    sessions = _sessions(sources)
    stages = Stages(sessions, Path(out), config, with_loops=with_loops, calibrates=calibrates, on_progress=on_progress)
    with stages.locked():
        if stages.calibrates_first:
            for number in range(len(sessions)):
                stages.calibrate(number, with_features=with_loops)
        records = []
        for number in range(len(sessions)):
            records.append(stages.record(number, with_features=with_loops))
            if with_loops:
                stages.features(number, records[-1])
        return stages.result(records, stages.closures(records) if with_loops else None)


def _sessions(sources: Sequence[Source]) -> list[Session]:
    """Name sessions after their sources; a number is appended to a name that occurs before."""
    sessions: list[Session] = []
    for source in sources:
        name, number = source.name, 1
        while name in {each.name for each in sessions}:
            number += 1
            name = f"{source.name}-{number}"
        sessions.append(Session(name, source))
    return sessions


class Stages:
    """The stages of `optimize_sessions` (see there) as single steps, which may run on different machines.

    Attributes:
        inputs: name -> value of everything that determines the results.
        calibrates_first: whether each rig is to be calibrated before its session's odometry.

    Raises:
        OptimizationError: if the folder cannot be used, or COLMAP, which loop closures need, has no model for a lens.
    """

    def __init__(
        self,
        sessions: Sequence[Session],
        out: Path,
        config: Config,
        *,
        with_loops: bool = True,
        calibrates: bool = False,
        on_progress: Progress | None = None,
    ) -> None:
        if with_loops:
            for camera in (camera for each in sessions for camera in each.source.rig.cameras):
                colmap_model(camera)  # raises if there is none: now, and not after the odometry
        self._sessions = sessions
        self._calibrates = calibrates
        self.calibrates_first = calibrates or config.estimates_calibration
        self._config = config
        self._on_progress = on_progress or (lambda *_: None)
        self.inputs = {each.name: _identity(each.source) for each in sessions} | {
            "sessions": ", ".join(each.name for each in sessions),
            "config": config.sha256(),
            "loops": str(with_loops),
            "calibration": str(calibrates),
            "graphvio": __version__,
        }
        self._space = Workspace(out, self.inputs)
        self._rigs = [each.source.rig for each in sessions]

    def locked(self) -> AbstractContextManager[None]:
        """Keep other processes from continuing in the folder, see `Workspace.locked`."""
        return self._space.locked()

    def calibrate(self, number: int, *, with_features: bool = False) -> None:
        """Calibrate a session's rig from its whole recording for the later stages; if that fails, keep the rig file.

        Where the recording does not contradict the rig file, the odometry of this stage counts as the session's own,
        and `record` has nothing left to do.
        """
        session = self._sessions[number]
        stage, names = f"calibration of {session.name}", [f"{session.name}/{name}" for name in (_REFINED, FINDINGS)]
        if not self._space.has_finished(stage):
            self._space.forget(_odometry_of(session))  # its files are overwritten
            rig, sentences, is_recorded = self._calibrated(number, stage, with_features)
            self._space.write(names[0], to_text(rig, self._space.folder / session.name).encode())
            self._space.write(names[1], (json.dumps(sentences, indent=2) + "\n").encode())
            self._space.finish(stage, *names, *(self._recorded_files(session) if is_recorded else ()))
        self.use_calibrated(number)

    def _calibrated(self, number: int, stage: str, with_features: bool) -> tuple[Rig, list[str], bool]:
        """Return the calibrated rig, sentences on it, and whether all motions were measured with it, and recorded."""
        session, rig = self._sessions[number], self._sessions[number].source.rig
        try:
            odometry = Odometry(rig, calibrating(self._config))
        except CalibrationError as error:
            return rig, [cannot_be_calibrated(error)], False
        windows = CalibrationWindows(odometry)
        recorder, ahead = Recorder(session.name), self._features_ahead(number) if with_features else None
        is_as_given = self._measure(number, odometry, f"{stage}: odometry", recorder, ahead)

        def on_progress(part: str, done: int, total: int) -> None:
            self._on_progress(f"{stage}: {part}", done, total)

        found, sentences = calibrated_rig(rig, windows, session.source.end_ns, on_progress)
        if is_as_given and found is rig:
            self._keep(number, recorder)
            return rig, sentences, True
        self._features_ahead_of(session).unlink(missing_ok=True)  # extracted with another calibration
        return found, sentences, False

    def use_calibrated(self, number: int) -> None:
        """Use the rig file that `calibrate` wrote, in this folder or in another one from which it was copied here."""
        self._rigs[number] = load_rig(self._space.folder / self._sessions[number].name / _REFINED)

    def record(self, number: int, *, with_features: bool = False) -> SessionRecord:
        """Run the odometry on a session, write its results, and return what it measured.

        With ``with_features``, features are extracted at the same time, of the places that are known by then.
        """
        session = self._sessions[number]
        stage = _odometry_of(session)
        if not self._space.has_finished(stage):
            # All motions of a session must be measured with one calibration.
            config = replace(self._config, calibration=CalibrationConfig(online=False))
            recorder, ahead = Recorder(session.name), self._features_ahead(number) if with_features else None
            self._measure(number, Odometry(self._rigs[number], config), stage, recorder, ahead)
            self._keep(number, recorder)
        return SessionRecord.load(self._space.folder / self._recorded_files(session)[0])

    def _measure(
        self, number: int, odometry: Odometry, stage: str, recorder: Recorder, ahead: FeaturesAhead | None
    ) -> bool:
        session = self._sessions[number]
        folder = self._space.folder / session.name / "odometry"

        def on_progress(done: int, total: int) -> None:
            self._on_progress(stage, done, total)

        return measure(session.source, odometry, recorder, folder, on_progress, ahead)

    def _keep(self, number: int, recorder: Recorder) -> None:
        """Write the record of a session, and mark its odometry as finished."""
        session = self._sessions[number]
        files = self._recorded_files(session)
        self._space.write(files[0], recorder.record().to_bytes())
        self._space.finish(_odometry_of(session), *files)

    @staticmethod
    def _recorded_files(session: Session) -> tuple[str, str]:
        return f"{session.name}/record.npz", f"{session.name}/odometry/summary.json"

    def closures(self, records: Sequence[SessionRecord]) -> list[LoopClosure]:
        """Find loop closures within and between the sessions."""
        inputs = [self.places(number, record) for number, record in enumerate(records)]
        for number, record in enumerate(records):
            self.features(number, record)
        if not self._space.has_finished("loops"):
            with FeatureDatabase(self._space.folder / DATABASE) as database:
                found = find_loops(
                    inputs, database, self._config, lambda done, total: self._on_progress("loops", done, total)
                )
            self._space.write("loops.npz", closures_to_bytes(found))
            self._space.finish("loops", "loops.npz", DATABASE)
        return load_closures(self._space.folder / "loops.npz")

    def result(self, records: Sequence[SessionRecord], closures: Sequence[LoopClosure] | None) -> Optimization:
        """Optimise the sessions and write all results; without a map if closures are None."""
        imus = [rig.imu for rig in self._rigs]
        found = optimize(
            records,
            imus,
            closures or [],
            self._config,
            lambda name, number, _: self._on_progress(name, number, number),
            self._calibrates,
        )
        rigs = [
            rig if correction is None else correction.corrected(rig)
            for rig, correction in zip(self._rigs, found.corrections, strict=True)
        ]
        if self._calibrates:
            for session, rig in zip(self._sessions, rigs, strict=True):
                self._space.write(f"{session.name}/rig_optimized.yaml", to_text(rig, Path()).encode())
        for session, optimized in zip(self._sessions, found.sessions, strict=True):
            place = "" if len(self._sessions) == 1 else f"{session.name}/"
            self._space.write(f"{place}trajectory_optimized.txt", trajectory_text(optimized).encode())
            self._space.write(f"{place}covariance.csv", covariance_text(optimized).encode())
            self._space.write(f"{place}frames.csv", frames_text(optimized).encode())
        write_g2o(found, self._space.folder / "graph.g2o")
        truths = [_truth(each.source) for each in self._sessions]
        with ThreadPoolExecutor(1, thread_name_prefix="graphvio-report") as pool:
            report = pool.submit(write_report, found, self._space.folder, truths)
            if closures is not None and not self._space.has_finished("map"):
                self._export(found, records, rigs)
                self._space.finish("map", "colmap/sparse/0/points3D.bin")
            report.result()
        points = None
        if closures is not None:
            points = model_points(self._space.folder / "colmap/sparse/0")
            self._space.write("points.ply", ply(points))
        write_plan(found, self._space.folder, None if points is None else points.positions)
        return found

    def _export(self, found: Optimization, records: Sequence[SessionRecord], rigs: Sequence[Rig]) -> None:
        inputs = [
            replace(self.places(number, record), rig=rig)
            for number, (record, rig) in enumerate(zip(records, rigs, strict=True))
        ]

        def on_progress(what: str, done: int, total: int) -> None:
            self._on_progress(f"map: {what}", done, total)

        with FeatureDatabase(self._space.folder / DATABASE) as database:
            for each in inputs if self._calibrates else []:
                database.move_cameras(each.name, each.rig)
            export(found, inputs, database, self._space.folder / "colmap", self._config, on_progress)

    def places(self, number: int, record: SessionRecord) -> SessionInput:
        """Return a session with the places among which loop closures are searched."""
        session, settings = self._sessions[number], self._config.optimization
        rows = choose_places(record, settings.place_distance_m, settings.place_angle_deg)
        places = [Place(number, row, int(record.stamps_ns[row])) for row in rows.tolist()]
        return SessionInput(session.name, session.source, self._rigs[number], places, record)

    def features(self, number: int, record: SessionRecord) -> None:
        """Extract the features of a session's places."""
        session = self.places(number, record)
        stage, total = _features_of(session.name), len(session.places)
        if self._space.has_finished(stage):
            return
        stamps_ns = [place.stamp_ns for place in session.places]
        with FeatureDatabase(self._space.folder / DATABASE) as database:
            self._take_features_ahead(self._sessions[number], session.rig, stamps_ns, database)
            extract_places(
                session.source,
                session.rig,
                session.name,
                stamps_ns,
                database,
                self._config,
                lambda done: self._on_progress(stage, done, total),
            )
        self._space.finish(stage, DATABASE)
        self._features_ahead_of(self._sessions[number]).unlink(missing_ok=True)

    def _features_ahead(self, number: int) -> FeaturesAhead | None:
        session = self._sessions[number]
        if self._space.has_finished(_features_of(session.name)):
            return None
        database = self._features_ahead_of(session)
        return FeaturesAhead(session.source, self._rigs[number], session.name, database, self._config)

    def _features_ahead_of(self, session: Session) -> Path:
        """Return the path of the database of features that are extracted while the session's odometry runs."""
        return self._space.folder / session.name / _AHEAD

    def _take_features_ahead(
        self, session: Session, rig: Rig, stamps_ns: Sequence[int], whole: FeatureDatabase
    ) -> None:
        """Copy the features extracted ahead if they are of the session's first places, so that rows stay in order."""
        path = self._features_ahead_of(session)
        if not path.exists():
            return
        with FeatureDatabase(path) as part:
            stored = [stamp_ns for stamp_ns in stamps_ns if is_stored(part, rig, session.name, stamp_ns)]
            if stored == list(stamps_ns[: len(stored)]):
                merge_places(part, whole, session.name, rig, stored)


def _odometry_of(session: Session) -> str:
    """Return the name of a session's odometry stage."""
    return f"odometry of {session.name}"


def _features_of(name: str) -> str:
    """Return the name of a session's feature stage."""
    return f"features of {name}"


def _identity(source: Source) -> str:
    """Return a hash that identifies a recording without reading its measurements."""
    return digest(
        source.name, str(source.start_ns), str(source.end_ns), str(source.frameset_count), to_text(source.rig, Path())
    )


def _truth(source: Source) -> Trajectory | None:
    """Return the true trajectory of a recording if it holds a usable one."""
    try:
        return None if source.truth is None else load_trajectory(source.truth)
    except TrajectoryError:
        return None  # the odometry's summary states why
