"""The framesets that become states of a session's graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.errors import OptimizationError
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.optimization.record import SessionRecord


@dataclass(frozen=True, eq=False)
class Nodes:
    """The N states of a session's graph."""

    record: SessionRecord  # the session's record
    rows: Int  # (N,) rows of the states' framesets in the record, increasing
    motions: Int  # (M,) indices of the record's motions that begin and end at states

    @property
    def stamps_ns(self) -> Int:
        """(N,) stamps of the states."""
        return np.asarray(self.record.stamps_ns[self.rows])

    @property
    def epoch(self) -> Int:
        """(N,) epochs of the states."""
        return np.asarray(self.record.epoch[self.rows])

    def index_of_row(self, row: int) -> int:
        """Return the index of the state that belongs to a frameset's row.

        Raises:
            OptimizationError: if the frameset is no state.
        """
        index = int(np.searchsorted(self.rows, row))
        if index == len(self.rows) or self.rows[index] != row:
            raise OptimizationError(f"{self.record.name}: frameset {row} has a measurement but no state")
        return index

    def twist(self, n: int) -> Float:
        """Return angular rate (rad/s) and velocity (m/s) of body, in body (6,), at state ``n``; needs the IMU there."""
        record, row = self.record, int(self.rows[n])
        inertial = record.inertial
        around = inertial.values[max(int(inertial.begins[row + 1]) - 1, 0) : int(inertial.begins[row + 1]) + 1]
        rate = around[:, :3].mean(axis=0) - record.gyro_bias[row]
        return np.concatenate([rate, record.smoothed[row, :3, :3].T @ record.velocity_nav[row]])

    def interval(self, n: int) -> ImuInterval | None:
        """Return the IMU interval from state ``n - 1`` to ``n``; None if the IMU does not cover it."""
        inertial, first, last = self.record.inertial, self.rows[n - 1] + 1, self.rows[n] + 1
        if not inertial.covers[first:last].all() or not self.record.with_imu[[first - 1, last - 1]].all():
            return None
        steps = slice(int(inertial.begins[first]), int(inertial.begins[last]))
        values = inertial.values[steps]
        return ImuInterval(inertial.steps_s[steps], values[:, :3], values[:, 3:])


def choose_nodes(record: SessionRecord, interval_s: float) -> Nodes:
    """Choose the framesets that become states: those that motions refer to, first and last of each epoch, and others.

    The others lie in between, so that states are about ``interval_s`` apart where there are framesets: more motions
    from one keyframe add little.
    """
    stamps, motions = record.stamps_ns, record.motions
    wanted = record.is_keyframe.copy()
    wanted[motions.reference] = True
    ends = np.flatnonzero(np.diff(record.epoch))
    wanted[ends] = wanted[ends + 1] = True
    wanted[0] = wanted[-1] = True
    wanted[record.own.reference] = wanted[record.own.row] = True
    for of_kind in (motions.is_partial, ~motions.is_partial):
        last = dict(
            zip(motions.reference[of_kind].tolist(), motions.row[of_kind].tolist(), strict=True)
        )  # rows increase
        wanted[list(last.values())] = True
    latest = stamps[0]
    seen = np.zeros(len(stamps), dtype=bool)
    seen[motions.row[~motions.is_partial]] = True
    if len(record.views.row):
        wanted[record.views.row] = wanted[record.first_windows.row] = True
        seen |= record.is_stationary  # single cameras have no other measurement at a standstill
    for row in range(len(stamps)):
        due = row + 1 < len(stamps) and stamps[row + 1] - latest > interval_s * 1e9 and seen[row]
        if wanted[row] or due:
            wanted[row] = True
            latest = stamps[row]
    chosen = np.flatnonzero(wanted[motions.reference] & wanted[motions.row])
    return Nodes(record, np.flatnonzero(wanted), chosen)


def spread(nodes: Nodes, nav_T_body: Float) -> Float:
    """Interpolate the poses (F, 4, 4) of all framesets from those (N, 4, 4) of the states.

    Between two states, the shape of the smoothed trajectory is kept (that of the online one for a rig of single cameras
    only); its error at the second state is distributed linearly in time.
    """
    record, rows = nodes.record, nodes.rows
    # Of single cameras, only keyframes have smoothed poses: with online ones in between, two estimates would be mixed.
    chain = record.online if len(record.views.row) else record.smoothed
    poses = np.empty_like(chain)
    stamps = record.stamps_ns
    for n, row in enumerate(rows):
        poses[row] = nav_T_body[n]
        if n + 1 == len(rows) or record.epoch[row] != record.epoch[rows[n + 1]]:
            continue
        after = rows[n + 1]
        since = se3_inverse(chain[row])
        error = se3_log(se3_inverse(since @ chain[after]) @ se3_inverse(nav_T_body[n]) @ nav_T_body[n + 1])
        for k in range(row + 1, after):
            share = float(stamps[k] - stamps[row]) / float(stamps[after] - stamps[row])
            poses[k] = nav_T_body[n] @ since @ chain[k] @ se3_exp(share * error)
    return poses
