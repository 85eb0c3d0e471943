"""The measurements of a session's odometry as columns, in memory and on disk."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.errors import OptimizationError
from graphvio.measurements.estimate import Status
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.window_views import FirstWindow, WindowViews
from graphvio.odometry.step import NewKeyframe, Step
from graphvio.optimization.first_windows import FirstWindows
from graphvio.optimization.views import Views

_NO_STAMP = -(2**62) - 1  # stamp that no measurement has


class Inertial(NamedTuple):
    """The IMU measurements as N steps of constant angular velocity and specific force."""

    begins: Int  # (F + 1,) the steps from frameset i - 1 to i are rows ``begins[i]`` to ``begins[i + 1]``
    covers: Bool  # (F,) whether the steps to a frameset cover all of that time and can be trusted
    steps_s: Float  # (N,) durations of the steps
    values: Float  # (N, 6) angular velocity, rad/s, and specific force, m/s^2, in body


class Motions(NamedTuple):
    """M measured motions, ordered by the framesets in which they end."""

    reference: Int  # (M,) row of the frameset that each is measured from
    row: Int  # (M,) row of the frameset in which it ends
    reference_T_current: Float  # (M, 4, 4) motion of body
    covariance: Float  # (M, 6, 6) tangent ``[rotation, translation]`` in body at its end
    shared_covariance: Float  # (M, 6, 6) part of it that all motions from one reference share, same tangent
    inliers: Int  # (M,) number of inlier points
    is_partial: Bool  # (M,) whether there were too few points for a full motion: see `VisualResult.partial_motion`

    def at(self, k: int, stamps_ns: Int) -> RelativeMotion:
        """Return motion k."""
        return RelativeMotion(
            int(stamps_ns[self.reference[k]]),
            int(stamps_ns[self.row[k]]),
            self.reference_T_current[k],
            self.covariance[k],
            self.shared_covariance[k],
            int(self.inliers[k]),
        )


@dataclass(frozen=True, eq=False)
class SessionRecord:
    """Estimates and measurements of a session's odometry, for F framesets with a pose."""

    name: str  # name of the session
    stamps_ns: Int  # (F,) increasing
    epoch: Int  # (F,) number of the epoch; poses of different epochs do not share a nav frame
    online: Float  # (F, 4, 4) ``nav_T_body`` as emitted
    smoothed: Float  # (F, 4, 4) ``nav_T_body`` as it left the smoother's window
    covariance: Float  # (F, 6, 6) of ``online``, tangent ``[rotation, translation]`` in body
    velocity_nav: Float  # (F, 3) m/s
    gyro_bias: Float  # (F, 3) rad/s; zero without an IMU
    accel_bias: Float  # (F, 3) m/s^2; zero without an IMU
    is_stationary: Bool  # (F,) whether images and IMU show no motion
    is_keyframe: Bool  # (F,) whether later motions are measured from it
    with_imu: Bool  # (F,) whether the state has a velocity and biases
    is_start: Bool  # (F,) whether the state was initialised or reinitialised here
    # (F,) row of the previous keyframe, or -1 where this is no keyframe or the motion in between is not known
    keyframe_before: Int
    # (F, 6, 6) covariance of that motion, tangent ``[rotation, translation]`` in body; zero where there is none
    keyframe_covariance: Float
    motions: Motions  # motions measured by the whole rig
    own: Motions  # motions of body over whole keyframes, each measured by a single pair
    own_pair: Int  # the pair that measured each of these
    inertial: Inertial  # IMU samples
    views: Views  # views of landmarks, of a rig of single cameras only
    first_windows: FirstWindows  # costs from before the first pose of each epoch, of such a rig

    def to_bytes(self) -> bytes:
        """Return the record as a numpy archive; equal records give equal bytes."""
        columns: dict[str, Any] = {"name": np.array(self.name)}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, tuple):
                columns |= {f"{field.name}.{name}": part for name, part in value._asdict().items()}  # type: ignore[attr-defined]
            elif field.name != "name":
                columns[field.name] = value
        buffer = io.BytesIO()
        np.savez(buffer, **columns)
        return buffer.getvalue()

    @staticmethod
    def load(path: Path) -> SessionRecord:
        """Read a record that `to_bytes` made.

        Raises:
            OptimizationError: if it cannot be read.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                columns = {name: file[name] for name in file.files}
            groups = {
                kind: cls(*(columns.pop(f"{kind}.{name}") for name in cls._fields)) for kind, cls in _GROUPS.items()
            }
            return SessionRecord(**(columns | groups | {"name": str(columns["name"])}))
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
            raise OptimizationError(f"{path}: is no record of a session ({error}); remove the file") from None


_GROUPS: dict[str, Any] = {
    "motions": Motions, "own": Motions, "inertial": Inertial, "views": Views, "first_windows": FirstWindows
}  # fmt: skip


class Recorder:
    """Collects the steps of an odometry into a `SessionRecord`; its `add` is passed to `Odometry.subscribe`."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._steps: list[_Row] = []
        self._motions: list[RelativeMotion] = []
        self._own: list[tuple[int, RelativeMotion]] = []
        self._partial: set[int] = set()  # stamps of partial motions
        self._refused: list[RelativeMotion] = []  # refused ones since the last motion that was used
        self._references: set[int] = set()
        self._since: list[tuple[Float, Float]] = []  # IMU since the last step with a pose
        self._is_covered = True
        self._smoothed: dict[int, Float] = {}
        self._views: list[WindowViews | FirstWindow] = []
        self._used_at = 0  # row of the last step whose motion was used

    def add(self, step: Step) -> None:
        """Add a step."""
        estimate, motion = step.estimate, step.motion
        self._add_inertial(step)
        self._references |= step.references
        if motion is not None and not step.used:
            self._refused.append(motion)
        if estimate.nav_T_body is None or estimate.covariance is None or estimate.status is Status.LOST:
            return
        if step.initialised and motion is not None and step.used and self._steps:
            # Vision overrules the prediction: its refused motions are used as well, and the IMU since then is not.
            self._motions += [each for each in self._refused if each is not motion]
            if estimate.epoch == self._steps[-1].estimate.epoch:
                for row in self._steps[self._used_at + 1 :]:
                    row.covers = False
                self._is_covered = False
        if motion is not None and step.used:
            self._motions.append(motion)
            self._own += sorted(step.own.items())
        if step.partial_motion is not None:
            self._motions.append(step.partial_motion)
            self._partial.add(step.partial_motion.stamp_ns)
        intervals = self._since
        self._steps.append(
            _Row(
                step.estimate,
                np.concatenate([np.zeros(0), *(each[0] for each in intervals)]),
                np.concatenate([np.zeros((0, 6)), *(each[1] for each in intervals)]),
                self._is_covered and step.interval is not None,
                step.initialised,
                *_since_keyframe(step.keyframe),
            )
        )
        self._since, self._is_covered = [], True
        if step.used or step.initialised:
            self._refused.clear()
            self._used_at = len(self._steps) - 1

    def add_smoothed(self, poses: Iterable[tuple[int, Float]]) -> None:
        """Add stamps and poses ``nav_T_body`` (4, 4) that have left the smoother's window."""
        self._smoothed.update(poses)

    def add_views(self, views: WindowViews | FirstWindow) -> None:
        """Add views of landmarks or an epoch's first window, as `graphvio.Odometry.on_views` passes them on."""
        self._views.append(views)

    def record(self) -> SessionRecord:
        """Return everything that was added as a record.

        Raises:
            OptimizationError: if no frameset has a pose.
        """
        rows = self._steps
        if not rows:
            raise OptimizationError(f"{self._name}: the odometry estimated no pose; graphvio run reports why")
        estimates = [row.estimate for row in rows]
        motions = sorted(self._motions, key=lambda each: (each.stamp_ns, each.reference_stamp_ns))
        stamps = np.array([each.stamp_ns for each in estimates], dtype=np.int64)
        row_of = {int(stamp): k for k, stamp in enumerate(stamps)}
        online = np.array([each.nav_T_body for each in estimates])
        final = np.array([self._smoothed.get(each.stamp_ns, each.nav_T_body) for each in estimates])
        return SessionRecord(
            name=self._name,
            stamps_ns=stamps,
            epoch=np.array([each.epoch for each in estimates], dtype=np.int64),
            online=online,
            smoothed=final,
            covariance=np.array([each.covariance for each in estimates]),
            velocity_nav=np.array([_or_zero(each.velocity_nav) for each in estimates]),
            gyro_bias=np.array([_or_zero(each.gyro_bias) for each in estimates]),
            accel_bias=np.array([_or_zero(each.accel_bias) for each in estimates]),
            is_stationary=np.array([each.is_stationary for each in estimates]),
            is_keyframe=np.isin(stamps, sorted(self._references)),
            with_imu=np.array([each.gyro_bias is not None for each in estimates]),
            is_start=np.array([row.is_start for row in rows]),
            keyframe_before=np.array([row_of.get(row.keyframe_before_ns, -1) for row in rows], dtype=np.int64),
            keyframe_covariance=np.array([row.keyframe_covariance for row in rows]),
            motions=_joined([motion for motion in motions if _is_known(motion, row_of)], row_of, self._partial),
            own=_joined([motion for _, motion in self._own if _is_known(motion, row_of)], row_of, set()),
            own_pair=np.array([j for j, motion in self._own if _is_known(motion, row_of)], dtype=np.int64),
            inertial=_joined_inertial(rows),
            views=Views.of([each for each in self._views if isinstance(each, WindowViews)], row_of),
            first_windows=FirstWindows.of([each for each in self._views if isinstance(each, FirstWindow)], row_of),
        )

    def _add_inertial(self, step: Step) -> None:
        interval = step.interval
        if interval is None:
            self._is_covered = False
        else:
            values = np.hstack([interval.angular_velocity, interval.linear_acceleration])
            self._since.append((interval.steps_s, values))


@dataclass(eq=False)
class _Row:
    estimate: Any
    steps_s: Float
    values: Float
    covers: bool
    is_start: bool
    keyframe_before_ns: int
    keyframe_covariance: Float


def _since_keyframe(keyframe: NewKeyframe | None) -> tuple[int, Float]:
    """Return the stamp of the previous keyframe, or `_NO_STAMP`, and the covariance (6, 6) of the motion since."""
    if keyframe is None or keyframe.covariance is None or keyframe.previous_ns is None:
        return _NO_STAMP, np.zeros((6, 6))
    return keyframe.previous_ns, keyframe.covariance


def _or_zero(value: Float | None) -> Float:
    return np.zeros(3) if value is None else value


def _joined_inertial(rows: list[_Row]) -> Inertial:
    counts = [len(row.steps_s) for row in rows]
    return Inertial(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.array([row.covers for row in rows]),
        np.concatenate([row.steps_s for row in rows]),
        np.concatenate([row.values for row in rows]),
    )


def _is_known(motion: RelativeMotion, row_of: Mapping[int, int]) -> bool:
    return motion.stamp_ns in row_of and motion.reference_stamp_ns in row_of


def _joined(motions: Sequence[RelativeMotion], row_of: Mapping[int, int], partial: Set[int]) -> Motions:
    shape = (len(motions), 6, 6)
    return Motions(
        np.array([row_of[each.reference_stamp_ns] for each in motions], dtype=np.int64),
        np.array([row_of[each.stamp_ns] for each in motions], dtype=np.int64),
        np.array([each.reference_T_current for each in motions]).reshape(-1, 4, 4),
        np.array([each.covariance for each in motions]).reshape(shape),
        np.array([each.shared_covariance for each in motions]).reshape(shape),
        np.array([each.inliers for each in motions], dtype=np.int64),
        np.array([each.stamp_ns in partial for each in motions], dtype=bool),
    )
