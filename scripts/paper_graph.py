"""The paper's filter as a factor graph: with a lag of one step and one Gauss-Newton iteration the two are equal.

A state is three variables: position, attitude, and all others together. The process, eq. (11) and (12), is one factor
between consecutive states. The noise that changes the velocities is the noise of what is moved: position and attitude
follow from the velocities without any noise of their own, so six of the factor's rows are constraints.

It shows what a longer lag and more iterations would gain; the odometry does not use it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.ekf.measurements import Measurement
from graphvio.backend.ekf.process import propagated
from graphvio.backend.ekf.state import ERRORS, FilterState
from graphvio.backend.noise import gaussian
from graphvio.geometry import skew, so3_exp, so3_log, so3_right_jacobian, so3_right_jacobian_inverse

Expectation = Callable[[FilterState], Measurement]
"""Returns the linearised measurement at a state."""

_PARTS = (slice(0, 3), slice(3, 6), slice(6, ERRORS))  # of the error: position, attitude, all others


class PaperGraph:
    """A window of the filter's states.

    Args:
        state: the first one.
        covariance: (15, 15) of its error.
        lag: how many states an update leaves in the window, at least one: the newest.
        iterations: of Gauss-Newton in each update.
    """

    def __init__(self, state: FilterState, covariance: Float, lag: int = 1, iterations: int = 1) -> None:
        self._lag, self._iterations = lag, iterations
        self._oldest = self._newest = 0
        self._values = gtsam.Values()
        self._insert(0, state)
        self._factors: list[gtsam.NonlinearFactor] = [_prior(_keys(0), state, covariance)]

    @property
    def state(self) -> FilterState:
        """The newest state."""
        return _state(self._values, _keys(self._newest))

    @property
    def oldest(self) -> FilterState:
        """The oldest state of the window, which `lag` - 1 later updates have improved."""
        return _state(self._values, _keys(self._oldest))

    def predict(self, dt: float, sigmas: Float) -> None:
        """Append a state a time step later, seconds, with a process noise of standard deviations (9,)."""
        before, after = _keys(self._newest), _keys(self._newest + 1)
        self._insert(self._newest + 1, propagated(self.state, dt))
        self._newest += 1
        self._factors.append(_process(before, after, dt, sigmas))

    def covariance(self) -> Float:
        """Covariance (15, 15) of the newest state's error."""
        keys, linear = _keys(self._newest), self._linearised()
        older = gtsam.Ordering(self._keys_before(self._newest))
        if older.size():
            _, linear = linear.eliminatePartialMultifrontal(older, gtsam.EliminateQR)
        jacobian, _ = linear.jacobian(gtsam.Ordering(keys))
        inverse = np.linalg.inv(np.linalg.qr(jacobian, mode="r"))
        return np.asarray(inverse @ inverse.T)

    def add(self, expectation: Expectation) -> None:
        """Insert a measurement of the newest state."""
        self._factors.append(_measurement(_keys(self._newest), expectation, self.state))

    def update(self) -> None:
        """Gauss-Newton from the prediction; then the oldest states are marginalised where they were linearised."""
        ordering = gtsam.Ordering([*self._keys_before(self._newest), *_keys(self._newest)])
        for _ in range(self._iterations):
            at, linear = self._values, self._linearised()
            self._values = at.retract(linear.eliminateMultifrontal(ordering, gtsam.EliminateQR).optimize())
        leaving = self._keys_before(self._newest - self._lag + 1)
        if leaving:
            self._marginalise(leaving, linear, at)

    def _marginalise(self, leaving: Sequence[int], linear: gtsam.GaussianFactorGraph, at: gtsam.Values) -> None:
        involved = gtsam.GaussianFactorGraph()
        staying = []
        # The newest state's measurements are linear from here on if nothing older stays: the filter's way.
        freeze = self._lag == 1
        for i, factor in enumerate(self._factors):
            if freeze or not set(leaving).isdisjoint(factor.keys()):
                involved.push_back(linear.at(i))
            else:
                staying.append(factor)
        _, remaining = involved.eliminatePartialMultifrontal(gtsam.Ordering(leaving), gtsam.EliminateQR)
        for i in range(remaining.size()):
            if remaining.at(i) is not None and len(remaining.at(i).keys()):
                staying.append(gtsam.LinearContainerFactor(remaining.at(i), at))
        for key in leaving:
            self._values.erase(key)
        self._factors = staying
        self._oldest = self._newest - self._lag + 1

    def _linearised(self) -> gtsam.GaussianFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for factor in self._factors:
            graph.push_back(factor)
        return graph.linearize(self._values)

    def _keys_before(self, k: int) -> list[int]:
        return [key for i in range(self._oldest, k) for key in _keys(i)]

    def _insert(self, k: int, state: FilterState) -> None:
        x, q, u = _keys(k)
        self._values.insert(x, state.position)
        self._values.insert(q, gtsam.Rot3(state.nav_R_body))
        self._values.insert(u, np.concatenate([state.velocity_body, state.rate_body, state.gyro_bias]))


def _keys(k: int) -> list[int]:
    return [gtsam.symbol(part, k) for part in "xqu"]


def _state(values: gtsam.Values, keys: Sequence[int]) -> FilterState:
    x, q, u = keys
    velocities = values.atVector(u)
    return FilterState(values.atVector(x), values.atRot3(q).matrix(), velocities[0:3], velocities[3:6], velocities[6:9])


def _prior(keys: Sequence[int], state: FilterState, covariance: Float) -> gtsam.CustomFactor:
    def _error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        if jacobians is not None:
            for i, part in enumerate(_PARTS):
                jacobians[i] = np.asfortranarray(np.eye(ERRORS)[:, part])
        return _state(values, keys).minus(state)

    return gtsam.CustomFactor(gaussian(covariance), keys, _error)


def _measurement(keys: Sequence[int], expectation: Expectation, state: FilterState) -> gtsam.CustomFactor:
    def _error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        at = expectation(_state(values, keys))
        if jacobians is not None:
            for i, part in enumerate(_PARTS):
                jacobians[i] = np.asfortranarray(at.by_error[:, part])
        return -at.innovation

    return gtsam.CustomFactor(gaussian(expectation(state).covariance), keys, _error)


def _process(before: Sequence[int], after: Sequence[int], dt: float, sigmas: Float) -> gtsam.CustomFactor:
    """Eq. (11) and (12), solved for the noise: the motion beyond the velocities, which must be zero, and the changes of
    the velocities and the bias."""
    noise = gtsam.noiseModel.Constrained.MixedSigmas(1.0, np.concatenate([np.zeros(6), sigmas]))

    def _error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        then, now = _state(values, before), _state(values, after)
        body_R_nav = then.nav_R_body.T
        moved = body_R_nav @ (now.position - then.position)
        turned = body_R_nav @ now.nav_R_body
        turn = now.rate_body * dt
        unlike = so3_exp(-turn) @ turned
        off = so3_log(unlike)
        if jacobians is not None:
            by_then, by_now = np.zeros((ERRORS, ERRORS)), np.zeros((ERRORS, ERRORS))
            by_then[0:3, 0:3], by_then[0:3, 3:6] = -body_R_nav, skew(moved)
            by_now[0:3, 0:3], by_now[0:3, 6:9] = body_R_nav, -dt * np.eye(3)
            by_off = so3_right_jacobian_inverse(off)
            by_then[3:6, 3:6], by_now[3:6, 3:6] = -by_off @ turned.T, by_off
            by_now[3:6, 9:12] = -dt * by_off @ unlike.T @ so3_right_jacobian(turn)
            by_then[6:, 6:], by_now[6:, 6:] = -np.eye(9), np.eye(9)
            for i, part in enumerate(_PARTS):
                jacobians[i] = np.asfortranarray(by_then[:, part])
                jacobians[i + 3] = np.asfortranarray(by_now[:, part])
        change = now.minus(then)[6:]
        return np.concatenate([moved - now.velocity_body * dt, off, change])

    return gtsam.CustomFactor(noise, [*before, *after], _error)
