"""The graph of one or several sessions: motions, preintegrated IMU, zero-velocity updates and loop closures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from graphvio.arrays import Float, Int
from graphvio.backend.factors import b, constant_velocity, first_state, imu_without_samples, r, v, x, zero_velocity
from graphvio.backend.noise import gaussian, isotropic
from graphvio.backend.preintegration import preintegrate, preintegration_params
from graphvio.backend.reference_views import ReferenceViews
from graphvio.backend.states import InitialUncertainty, RigState, origin_covariance
from graphvio.config.stages import SmootherConfig
from graphvio.optimization.extrinsics import own_motion, unknowns
from graphvio.optimization.first_windows import first_window_factor
from graphvio.optimization.nodes import Nodes
from graphvio.optimization.record import SessionRecord
from graphvio.optimization.solver import Edge
from graphvio.optimization.views import views_factor
from graphvio.rig import Imu

_START_TILT_RAD = 0.2
_START_SPEED_M_S = 10.0
_START_GYRO_BIAS_RAD_S = 0.1
_START_ACCEL_BIAS_M_S2 = 0.5
_ORIGIN_SIGMA = 1e-4  # radians and metres: without an IMU, the first pose of an epoch defines its frame


@dataclass(frozen=True, eq=False)
class Fragment:
    """An epoch of a session, whose poses share a frame."""

    session: int  # number of the session
    epoch: int  # number of the epoch in its session
    states: range  # numbers of its states, consecutive across all sessions
    start: RigState  # the rig at the first state
    with_imu: bool  # whether the first state has a velocity and biases


class SessionGraph:
    """Factors and initial values of all sessions; states are numbered consecutively, session after session.

    Args:
        sessions: the states of each session.
        imus: the IMU of each session's rig, or None.
        config: the configuration of the odometry's back-end.
        calibrates: whether extrinsics and the IMU's time offset are variables; the factors are then the motions that
            single pairs measured over whole keyframes, where there are any.

    Attributes:
        values: initial values of all states, from the odometry.
        fragments: epochs of all sessions, in order.
        firsts: (S + 1,) number of the first state of each session, and the number of states.
    """

    def __init__(
        self, sessions: Sequence[Nodes], imus: Sequence[Imu | None], config: SmootherConfig, calibrates: bool = False
    ) -> None:
        self.values = gtsam.Values()
        self.fragments: list[Fragment] = []
        self.firsts = np.concatenate([[0], np.cumsum([len(nodes.rows) for nodes in sessions])]).astype(np.int64)
        self._graph = gtsam.NonlinearFactorGraph()
        self._kinds: dict[str, list[int]] = {}
        self._config = config
        self._kind = ""
        self._views = ReferenceViews()
        for number, (nodes, imu) in enumerate(zip(sessions, imus, strict=True)):
            first = int(self.firsts[number])
            self._add_states(first, nodes)
            self._add_fragments(number, first, nodes)
            self._add_inertial(first, nodes, imu)
            own = self._add_own_motions(number, first, nodes) if calibrates else np.zeros(0, dtype=np.int64)
            self._add_motions(first, nodes, own)
            self._add_views(first, nodes)

    def __len__(self) -> int:
        return int(self.firsts[-1])

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        """Insert a factor of the current kind; also called by `ReferenceViews`."""
        self._kinds.setdefault(self._kind, []).append(self._graph.size())
        self._graph.add(factor)

    def complete(
        self, roots: Iterable[int], edges: Iterable[Edge] = ()
    ) -> tuple[gtsam.NonlinearFactorGraph, dict[str, list[int]]]:
        """Return the graph with loop closures as ``edges``, and the indices of its factors by kind.

        The first pose of each fragment in ``roots`` gets a prior, and so defines a frame.
        """
        graph, kinds = gtsam.NonlinearFactorGraph(self._graph), dict(self._kinds)
        chosen = frozenset(roots)
        priors = [
            factor
            for number, each in enumerate(self.fragments)
            for factor in _initial_priors(each, is_root=number in chosen)
        ]
        for kind, factors in (("start", priors), ("loop", [edge.factor() for edge in edges])):
            if factors:
                kinds[kind] = list(range(graph.size(), graph.size() + len(factors)))
            for factor in factors:
                graph.add(factor)
        return graph, kinds

    def _add_states(self, first: int, nodes: Nodes) -> None:
        record = nodes.record
        for k, row in enumerate(nodes.rows.tolist(), start=first):
            self.values.insert(x(k), gtsam.Pose3(record.smoothed[row]))
            if record.with_imu[row]:
                self.values.insert(v(k), record.velocity_nav[row])
                bias = gtsam.imuBias.ConstantBias(record.accel_bias[row], record.gyro_bias[row])
                self.values.insert(b(k), bias)

    def _add_fragments(self, session: int, first: int, nodes: Nodes) -> None:
        record, epoch = nodes.record, nodes.epoch
        begins = np.concatenate([[0], np.flatnonzero(np.diff(epoch)) + 1, [len(epoch)]]).tolist()
        for begin, end in pairwise(begins):
            row = int(nodes.rows[begin])
            start = RigState(
                record.smoothed[row], record.velocity_nav[row], record.gyro_bias[row], record.accel_bias[row]
            )
            states = range(first + begin, first + end)
            self.fragments.append(Fragment(session, int(epoch[begin]), states, start, bool(record.with_imu[row])))

    def _add_inertial(self, first: int, nodes: Nodes, imu: Imu | None) -> None:
        record, config, epoch = nodes.record, self._config, nodes.epoch
        params = None if imu is None else preintegration_params(imu, config.imu_noise_scale)
        has_motion = np.zeros(len(nodes.rows), dtype=bool)
        full = nodes.motions[~record.motions.is_partial[nodes.motions]]
        has_motion[np.searchsorted(nodes.rows, record.motions.row[full])] = True
        has_motion[np.searchsorted(nodes.rows, record.views.row)] = True
        for n in range(1, len(nodes.rows)):
            if epoch[n] != epoch[n - 1]:
                continue
            before, row, k = int(nodes.rows[n - 1]), int(nodes.rows[n]), first + n
            dt = float(record.stamps_ns[row] - record.stamps_ns[before]) * 1e-9
            interval = nodes.interval(n)
            if params is not None and interval is not None:
                self._kind = "imu"
                bias = gtsam.imuBias.ConstantBias(record.accel_bias[row], record.gyro_bias[row])
                measurements = preintegrate(interval, params, bias)
                self.add(gtsam.CombinedImuFactor(x(k - 1), v(k - 1), x(k), v(k), b(k - 1), b(k), measurements))
            else:
                self._kind = "walk"
                if record.is_start[before + 1 : row + 1].any():
                    for factor in _reinitialised(k, record, row):
                        self.add(factor)
                elif record.with_imu[before] and record.with_imu[row] and imu is not None:
                    for factor in imu_without_samples(
                        k - 1, k, dt, config.motion_accel_sigma_m_s2, imu, config.imu_noise_scale
                    ):
                        self.add(factor)
                if not has_motion[n]:  # constant velocity, with the odometry's motion, eq. (11)
                    motion = np.linalg.inv(record.smoothed[before]) @ record.smoothed[row]
                    accels = np.array([config.motion_angular_accel_sigma_rad_s2, config.motion_accel_sigma_m_s2])
                    self.add(constant_velocity(k - 1, k, motion, dt, dt, np.zeros(2), accels))
            if record.is_stationary[row] and record.with_imu[row]:
                self._kind = "zero_velocity"
                self.add(zero_velocity(k))

    def _add_own_motions(self, session: int, first: int, nodes: Nodes) -> Int:
        """Add the motions that single pairs measured, and the calibration; return the rows (K,) where these end."""
        record = nodes.record
        own, with_imu = record.own, bool(record.with_imu.all())
        if not len(record.own_pair):
            return record.own_pair
        self._kind = "calibration"
        for key, value, prior in unknowns(session, int(record.own_pair.max()) + 1, with_imu):
            self.values.insert(key, value)
            self.add(prior)
        self._kind = "motion"
        for number, pair in enumerate(record.own_pair.tolist()):
            i, j = (nodes.index_of_row(int(rows[number])) for rows in (own.reference, own.row))
            motion = own.at(number, record.stamps_ns)
            twists = (nodes.twist(i), nodes.twist(j)) if with_imu else None
            self.add(own_motion(session, pair, first + i, first + j, motion, twists))
        return own.row

    def _add_motions(self, first: int, nodes: Nodes, left_out: Int) -> None:
        """Add the motions of the rig except those that end in the rows ``left_out``."""
        record = nodes.record
        for number in nodes.motions[~np.isin(record.motions.row[nodes.motions], left_out)].tolist():
            motion = record.motions.at(number, record.stamps_ns)
            i = first + nodes.index_of_row(int(record.motions.reference[number]))
            j = first + nodes.index_of_row(int(record.motions.row[number]))
            self._kind = "view"
            self._views.add(i, motion, self)
            self._kind = "motion"
            reference, covariance = self._views.seen(i, motion)
            self.add(
                gtsam.BetweenFactorPose3(reference, x(j), gtsam.Pose3(motion.reference_T_current), gaussian(covariance))
            )

    def _add_views(self, first: int, nodes: Nodes) -> None:
        """Add the costs of a rig of single cameras only: views of landmarks, and those from before the first pose."""
        views = nodes.record.views
        self._kind = "views"
        for number in range(len(views.begins) - 1):
            rows, *cost = views.at(number)
            self.add(views_factor([x(first + nodes.index_of_row(int(row))) for row in rows], *cost))
        self._kind = "before"
        for number in range(len(nodes.record.first_windows.begins) - 1):
            rows, *known = nodes.record.first_windows.at(number)
            self.add(first_window_factor(first + np.array([nodes.index_of_row(int(row)) for row in rows]), *known))


def _initial_priors(fragment: Fragment, is_root: bool) -> Iterator[gtsam.NonlinearFactor]:
    """Yield priors of a fragment's first state; the pose has one only in a root, where it defines the frame."""
    k, pose = fragment.states.start, fragment.start.nav_T_body
    if not fragment.with_imu:
        if is_root:
            yield gtsam.PriorFactorPose3(x(k), gtsam.Pose3(pose), isotropic(6, _ORIGIN_SIGMA))
        return
    uncertainty = InitialUncertainty(
        origin_covariance(pose[:3, :3], _START_TILT_RAD), _START_SPEED_M_S, _START_GYRO_BIAS_RAD_S
    )
    pose_prior, *others = first_state(k, fragment.start, uncertainty, True)
    if is_root:
        yield pose_prior
    yield from others


def _reinitialised(k: int, record: SessionRecord, row: int) -> Iterator[gtsam.NonlinearFactor]:
    """Yield weak priors of velocity and biases at a reinitialisation."""
    if record.with_imu[row]:
        yield gtsam.PriorFactorVector(v(k), record.velocity_nav[row], isotropic(3, _START_SPEED_M_S))
        sigmas = np.repeat([_START_ACCEL_BIAS_M_S2, _START_GYRO_BIAS_RAD_S], 3)
        bias = gtsam.imuBias.ConstantBias(record.accel_bias[row], record.gyro_bias[row])
        yield gtsam.PriorFactorConstantBias(b(k), bias, gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def poses_of(values: gtsam.Values, count: int) -> Float:
    """Return the poses (N, 4, 4) of the first ``count`` states."""
    return np.array([values.atPose3(x(k)).matrix() for k in range(count)]).reshape(-1, 4, 4)


def moved(values: gtsam.Values, frames: Sequence[tuple[range, Float]]) -> gtsam.Values:
    """Transform ranges of states to other frames by ``other_T_nav`` (4, 4) of each."""
    made = gtsam.Values(values)
    for states, other_T_nav in frames:
        frame, rotation = gtsam.Pose3(other_T_nav), other_T_nav[:3, :3]
        for k in states:
            made.update(x(k), frame.compose(values.atPose3(x(k))))
            if values.exists(r(k)):
                made.update(r(k), frame.compose(values.atPose3(r(k))))
            if values.exists(v(k)):
                made.update(v(k), rotation @ values.atVector(v(k)))
    return made
