"""Writes a result folder during a run.

Configuration and rig are written at the beginning; summary, smoothed trajectory, refined rig and plots at the end. All
other files grow line by line and are flushed at each line, so that an interrupted run leaves its results up to there.
Equal input gives an equal ``trajectory.txt``, byte by byte.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
from array import array
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, fields
from itertools import combinations_with_replacement
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import GraphvioError, TrajectoryError, writing
from graphvio.evaluation import Evaluation, evaluate
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.motion import PairReport
from graphvio.reporting.files import replace_file
from graphvio.results.calibration_plot import CalibrationHistory
from graphvio.results.plotting import plot_run
from graphvio.results.summary import FinishedRun, PairMedians, Percentiles, Summary, epoch_intervals, path_length
from graphvio.rig import Rig
from graphvio.rig_files import save_rig
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.parameters import parameter_names
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory, tum_line
from graphvio.version import __version__

_TANGENT = ("rx", "ry", "rz", "tx", "ty", "tz")
COVARIANCE_HEADER = ",".join(["stamp_ns", *(f"{a}_{b}" for a, b in combinations_with_replacement(_TANGENT, 2))])
"""Header line for lines of `covariance_row`."""
_BIAS_HEADER = "stamp_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
_GRAVITY_HEADER = "stamp_ns,gravity_x,gravity_y,gravity_z,tilt_sigma"
_CALIBRATION_HEADER = "stamp_ns,parameter,difference,sigma"
_PAIRS_HEADER = "stamp_ns,pair,points,inliers,rms_px,own_inliers,own_rms_px"
_UPPER = np.triu_indices(6)
_NS_PER_S = 1e9
_REMEDY = "choose another place for results"


class _Comparison(NamedTuple):
    """Truth and evaluation of a trajectory, None if not requested or failed, and the reason of a failure, or None."""

    truth: Trajectory | None = None
    evaluation: Evaluation | None = None
    error: str | None = None


class ResultWriter:
    """Writes one result folder; a context manager that closes its files.

    Args:
        folder: result folder; created if absent.
        rig: rig of the run, written to ``rig.yaml``; reports of pairs refer to it by index.
        config_yaml: contents of ``config.yaml``.

    Raises:
        GraphvioError: if the folder is not empty or cannot be written.
    """

    @staticmethod
    def new_folder(base: Path, name: str) -> Path:
        """Create ``base/name-1``, or the folder with the next free number; simultaneous runs get different folders.

        Raises:
            GraphvioError: if the folder cannot be created.
        """
        with writing(base, GraphvioError, _REMEDY):
            base.mkdir(parents=True, exist_ok=True)
            number = 1
            while True:
                folder = base / f"{name}-{number}"
                try:
                    folder.mkdir()
                    return folder
                except FileExistsError:
                    number += 1

    def __init__(self, folder: Path, rig: Rig, config_yaml: str) -> None:
        self.folder = Path(folder)
        self._files: dict[str, IO[str]] = {}
        self._config_sha256 = hashlib.sha256(config_yaml.encode()).hexdigest()
        self._first_ns: int | None = None
        self._last_ns = 0
        self._is_calibrated = False
        self._calibrations = CalibrationHistory()
        self._time_offset: tuple[float | None, float | None] = (None, None)
        self._stage_ms: dict[str, array[float]] = {}
        self._pair_names = [group.name for group in rig.groups]
        self._pair_figures: dict[str, dict[str, array[float]]] = {
            name: {figure.name: array("d") for figure in fields(PairMedians)} for name in self._pair_names
        }
        self._pair_rejected: dict[str, Counter[str]] = {name: Counter() for name in self._pair_names}
        self._status: Counter[str] = Counter()
        self._events: Counter[str] = Counter()
        self._stamps, self._epochs, self._lost = array("q"), array("q"), array("q")
        self._poses = array("d")
        self._pose_status: list[str] = []
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if any(self.folder.iterdir()):
                raise GraphvioError(
                    f"{self.folder}: is not empty, and results are never overwritten; name another folder"
                )
            (self.folder / "config.yaml").write_text(config_yaml, encoding="utf-8")
            save_rig(rig, self.folder / "rig.yaml")
            for name, header in (
                ("trajectory.txt", ""),
                ("covariance.csv", COVARIANCE_HEADER),
                ("imu_bias.csv", _BIAS_HEADER),
                ("gravity.csv", _GRAVITY_HEADER),
                ("pairs.csv", _PAIRS_HEADER),
                ("events.jsonl", ""),
                ("calibration.csv", _CALIBRATION_HEADER),
            ):
                self._files[name] = (self.folder / name).open("x", encoding="utf-8", newline="\n")
                if header:
                    self._write(name, header)
        except OSError as error:
            self.close()
            raise GraphvioError(f"{self.folder}: cannot be written ({error.strerror or error}); {_REMEDY}") from None

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close()
        if kind is not None and self._first_ns is None:
            self._discard()

    def _discard(self) -> None:
        """Remove the files of a run that failed before its first estimate."""
        for name in ("config.yaml", "rig.yaml", *self._files):
            (self.folder / name).unlink(missing_ok=True)
        if not any(self.folder.iterdir()):
            self.folder.rmdir()

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            file.close()

    def add(self, estimate: Estimate) -> None:
        """Append one estimate; stamps must increase.

        Raises:
            GraphvioError: if a file cannot be written.
        """
        stamp = int(estimate.stamp_ns)
        self._first_ns = stamp if self._first_ns is None else self._first_ns
        self._last_ns = stamp
        self._time_offset = estimate.time_offset_s, estimate.time_offset_sigma_s
        self._status[str(estimate.status)] += 1
        for stage, spent_ms in estimate.stage_ms.items():
            self._stage_ms.setdefault(stage, array("d")).append(spent_ms)
        if estimate.gyro_bias is not None and estimate.accel_bias is not None:
            self._write("imu_bias.csv", _csv(stamp, [*estimate.gyro_bias, *estimate.accel_bias]))
        if estimate.gravity_nav is not None and estimate.tilt_covariance is not None:
            tilt_sigma = float(np.sqrt(np.linalg.eigvalsh(estimate.tilt_covariance)[-1]))
            self._write("gravity.csv", _csv(stamp, [*estimate.gravity_nav, tilt_sigma]))
        for index in sorted(estimate.pairs):
            self._add_report(stamp, self._pair_names[index], estimate.pairs[index])
        if estimate.nav_T_body is None:
            self._lost.append(stamp)
            return
        self._write("trajectory.txt", tum_line(stamp, estimate.nav_T_body))
        if estimate.covariance is not None:
            self._write("covariance.csv", covariance_row(stamp, estimate.covariance))
        self._stamps.append(stamp)
        self._epochs.append(estimate.epoch)
        self._pose_status.append(str(estimate.status))
        self._poses.extend(np.asarray(estimate.nav_T_body, dtype=np.float64).ravel())

    def add_calibration(self, stamp_ns: int, estimate: CalibrationEstimate) -> None:
        """Append a calibration that came into force at a stamp.

        Raises:
            GraphvioError: if a file cannot be written.
        """
        self._is_calibrated = True
        self._calibrations.add(stamp_ns, estimate)
        names = parameter_names(estimate.file_rig)
        rows = zip(names, estimate.difference, estimate.sigmas, strict=True)
        lines = [f"{stamp_ns},{name},{_number(value)},{_number(sigma)}" for name, value, sigma in rows]
        self._write("calibration.csv", "\n".join(lines))

    def add_event(self, event: Event) -> None:
        """Append one line to ``events.jsonl``.

        Raises:
            GraphvioError: if the file cannot be written.
        """
        self._events[event.kind] += 1
        self._write("events.jsonl", json.dumps(asdict(event), ensure_ascii=False))

    def finish(self, run: FinishedRun, truth: Path | None = None) -> Summary:
        """Write the smoothed trajectory, the refined rig, the summary and the plots.

        Args:
            run: data of the run; all its estimates, calibrations and events must have been added before.
            truth: trajectory file or session to evaluate against; if that fails, the summary has the reason.

        Raises:
            GraphvioError: if a file cannot be written.
        """
        self.close()
        trajectory = Trajectory(
            np.array(self._stamps, dtype=np.int64), np.array(self._poses, dtype=np.float64).reshape(-1, 4, 4)
        )
        comparison = _compare_if_possible(trajectory, truth)
        summary = self._summary(run, trajectory, comparison)
        self._write_at_end(run, summary)
        self._plot(trajectory, comparison)
        return summary

    def _summary(self, run: FinishedRun, trajectory: Trajectory, comparison: _Comparison) -> Summary:
        duration_s = (self._last_ns - (self._first_ns or 0)) / _NS_PER_S if self._first_ns is not None else 0.0
        epochs = np.array(self._epochs, dtype=np.int64)
        evaluation = comparison.evaluation
        return Summary(
            framesets=run.framesets,
            estimated=len(trajectory),
            completion=min(1.0, len(trajectory) / run.awaited) if run.awaited > 0 else 0.0,
            duration_s=duration_s,
            path_length_m=path_length(trajectory, epochs),
            wall_s=run.wall_s,
            realtime_factor=duration_s / run.wall_s if run.wall_s > 0 else 0.0,
            stage_ms={stage: Percentiles.of(spent) for stage, spent in self._stage_ms.items()},
            frameset_ms=Percentiles.of(run.frameset_ms),
            input_faults=dict(run.input_faults),
            resets=run.resets,
            events=dict(self._events),
            warnings=list(run.warnings),
            calibration=list(run.calibration),
            status=dict(self._status),
            pair_medians={name: PairMedians.of(figures) for name, figures in self._pair_figures.items()},
            pair_rejected={name: dict(sorted(counts.items())) for name, counts in self._pair_rejected.items()},
            epochs=epoch_intervals(trajectory, epochs),
            time_offset_s=self._time_offset[0],
            time_offset_sigma_s=self._time_offset[1],
            graphvio_version=__version__,
            config_sha256=self._config_sha256,
            evaluation=evaluation.as_dict() if evaluation else None,
            evaluation_error=comparison.error,
        )

    def _write_at_end(self, run: FinishedRun, summary: Summary) -> None:
        """Write the refined rig, the smoothed trajectory and the summary, which do not grow during a run."""
        if run.refined_rig is not None:
            save_rig(run.refined_rig, self.folder / "rig-refined.yaml")
        lines = (f"{tum_line(int(stamp), np.asarray(pose))}\n" for stamp, pose in run.smoothed)
        self._write_at_once("trajectory_smoothed.txt", "".join(lines))
        self._write_at_once("summary.json", json.dumps(asdict(summary), indent=2, allow_nan=False) + "\n")

    def _plot(self, trajectory: Trajectory, comparison: _Comparison) -> None:
        """Plot the trajectory, and the calibration where one was estimated."""
        name = os.fsencode(self.folder.name).decode(errors="replace")  # a name that is no UTF-8 cannot be plotted
        plot_run(
            self.folder / "trajectory.png",
            trajectory,
            status=self._pose_status,
            epochs=self._epochs,
            lost_ns=self._lost if len(trajectory) else (),
            truth=comparison.truth,
            evaluation=comparison.evaluation,
            name=name,
        )
        if self._is_calibrated:
            self._calibrations.plot(self.folder / "calibration.png", self._last_ns, name)

    def _add_report(self, stamp_ns: int, name: str, report: PairReport) -> None:
        self._write("pairs.csv", _report_line(stamp_ns, name, report))
        self._pair_rejected[name].update(report.rejected)
        for figure, values in self._pair_figures[name].items():
            value = getattr(report, figure)
            if value is not None:
                values.append(value)

    def _write(self, name: str, line: str) -> None:
        file = self._files[name]
        with writing(self.folder / name, GraphvioError, _REMEDY):
            file.write(line + "\n")
            file.flush()

    def _write_at_once(self, name: str, text: str) -> None:
        """Write a file in one step, so that it is either complete or absent."""
        with writing(self.folder / name, GraphvioError, _REMEDY):
            replace_file(self.folder / name, text)


def covariance_row(stamp_ns: int, covariance: Float) -> str:
    """Return the stamp and the upper triangle of a covariance (6, 6) as a CSV line; see `COVARIANCE_HEADER`."""
    return _csv(stamp_ns, np.asarray(covariance)[_UPPER])


def _csv(stamp_ns: int, values: Iterable[float]) -> str:
    return ",".join([str(stamp_ns), *(_number(value) for value in values)])


def _report_line(stamp_ns: int, name: str, report: PairReport) -> str:
    """Return a line of ``pairs.csv``; fields are empty where the report has None."""
    line = io.StringIO()
    rms, own_rms = (None if px is None else _number(px) for px in (report.rms_px, report.own_rms_px))
    csv.writer(line, lineterminator="").writerow(
        [stamp_ns, name, report.points, report.inliers, rms, report.own_inliers, own_rms]
    )
    return line.getvalue()


def _number(value: float) -> str:
    return f"{float(value):.9e}"


def _compare_if_possible(trajectory: Trajectory, truth: Path | None) -> _Comparison:
    """Evaluate a trajectory against the truth in a file, or return the reason why that failed."""
    if truth is None:
        return _Comparison()
    read = None
    try:
        read = load_trajectory(truth)
        return _Comparison(read, evaluate(trajectory, read))
    except TrajectoryError as error:
        return _Comparison(read, error=str(error))
