"""Prior of a window by earlier measurements: of its first states, gravity, the biases and the calibration.

A prior stays as it was linearised, with errors in metres. Errors of views that were turned into metres get smaller with
the scale, while errors in pixels do not: each correction of a pose would make a smaller scale likelier, and a scale
that vision does not observe would shrink with time. States are therefore compared at the same size of the window, and
the logarithm of the size is compared separately, as differences in Sim(3) are (H. Strasdat, J. Montiel, A. Davison,
*Scale Drift-Aware Large Scale Monocular SLAM*, RSS 2010). To first order that is the plain difference; between windows
that differ in their scale only, it is exact.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import so3_log, so3_right_jacobian_inverse
from graphvio.kernels import kernel
from graphvio.linear_algebra import times, turn_rows
from graphvio.monocular.states import GRAVITY, States, add_block, columns_of

_STANDSTILL_M = 0.05  # rms size of a window that practically stands at a point, and has no scale


class Difference(NamedTuple):
    """Difference (N,) of states from those of a prior, and its derivative ``diag(scaled) - away by_size^T``.

    Attributes:
        off: (N,) the difference.
        scaled: (N,) derivative of each unknown with respect to its own perturbation, in the axes at the linearisation.
        away: (N,) difference of the states at the same size of the window.
        by_size: (N,) derivative of the logarithm of the size.
    """

    off: Float
    scaled: Float
    away: Float
    by_size: Float


class Prior(NamedTuple):
    """Quadratic cost of the first m states of a window, gravity, the biases and F parameters of the calibration.

    Attributes:
        at: the m states at which it was linearised.
        information: (9 m + 9 + F, 9 m + 9 + F), in the order of `columns_of`.
        gradient: (9 m + 9 + F,) gradient of the cost at these states.
    """

    at: States
    information: Float
    gradient: Float

    def turned(self, new_T_odom: Float) -> Prior:
        """Return the prior in another frame, given by ``new_T_odom`` (4, 4).

        Perturbations of poses are in the axes of body; only velocities and gravity have those of the frame.
        """
        m = len(self.at.poses)
        turn = np.eye(len(self.gradient))
        for at in range(6 * m, 9 * m + GRAVITY, 3):
            turn[at : at + 3, at : at + 3] = new_T_odom[:3, :3]
        return Prior(self.at.turned(new_T_odom), turn @ self.information @ turn.T, turn @ self.gradient)

    def after_change(self, covariance: Float) -> Prior:
        """Return the prior after a change of the calibration with a covariance (F, F), zero for what did not change."""
        changed = np.flatnonzero(np.diag(covariance))
        at = len(self.gradient) - len(covariance) + changed
        by_change = self.information[:, at]
        of_change = np.linalg.inv(covariance[np.ix_(changed, changed)]) + by_change[at]
        kept = by_change @ np.linalg.inv(of_change)
        return self._replace(
            information=self.information - kept @ by_change.T, gradient=self.gradient - kept @ self.gradient[at]
        )

    def difference(self, states: States) -> Difference:
        """Return the difference of the current values of the same states from those at the linearisation."""
        then, off = self.at, states.since(self.at)
        scaled, away, by_size = np.ones(len(off)), np.zeros(len(off)), np.zeros(len(off))
        _at_same_size(then.poses, then.velocities, states.poses, states.velocities, off, scaled, away, by_size)
        return Difference(off, scaled, away, by_size)


def first_prior(states: States, bias_sigmas: Float, biases: Float, pose_sigmas: Float) -> Prior:
    """Return the prior of a first window: of its first pose, which defines the frame, and of the biases."""
    first, calibration = replace(states.of(np.arange(1)), biases=biases), np.zeros(len(states.calibration))
    information = np.diag(np.concatenate([1.0 / pose_sigmas**2, np.zeros(6), 1.0 / bias_sigmas**2, calibration]))
    return Prior(first, information, np.zeros(len(information)))


def add_prior(prior: Prior, states: States, n_free: int, hessian: Float, gradient: Float) -> float:
    """Add the prior from before a window to its equations, and return its cost.

    Args:
        prior: prior of the first states.
        states: all states of the window, at which the equations are linearised.
        n_free: number of the calibration's parameters that are unknown, F or 0.
        hessian: is added to.
        gradient: is added to.
    """
    first = np.arange(len(prior.at.poses))
    difference = prior.difference(states.of(first))
    pull = times(prior.information, difference.off)
    information, total = _of_plain_differences(prior.information, prior.gradient + pull, difference)
    information, total = of_perturbations(information, total, states.poses[: len(first)], prior.at.poses)
    columns = columns_of(len(states.poses), first, n_free)
    add_block(hessian, columns, information)
    gradient[columns] += total[: len(columns)]
    return float((prior.gradient * difference.off + 0.5 * difference.off * pull).sum())


@kernel
def _at_same_size(
    then_poses: Float, then_velocities: Float, poses: Float, velocities: Float, off: Float, scaled: Float,
    away: Float, by_size: Float,
) -> None:  # fmt: skip
    """Fill the difference of positions and velocities at the same size of the window, and that of its size.

    A trajectory grows with its scale from the origin, where the epoch began.

    Args:
        then_poses: (K, 4, 4) poses of the prior.
        then_velocities: (K, 3) velocities of the prior.
        poses: (K, 4, 4) current poses.
        velocities: (K, 3) current velocities.
        off: output, see `Difference`, as the next ones.
        scaled: output.
        away: output.
        by_size: output.
    """
    n = len(poses)
    middle, then_middle = np.zeros(3), np.zeros(3)
    for k in range(n):
        for r in range(3):
            middle[r] += poses[k, r, 3] / n
            then_middle[r] += then_poses[k, r, 3] / n
    size2 = then_size2 = n * _STANDSTILL_M * _STANDSTILL_M
    for k in range(n):
        for r in range(3):
            size2 += (poses[k, r, 3] - middle[r]) ** 2
            then_size2 += (then_poses[k, r, 3] - then_middle[r]) ** 2
    larger = 0.5 * np.log(size2 / then_size2)
    shrink = np.exp(-larger)
    for k in range(n):
        for c in range(3):
            at, of_velocity = 6 * k + 3 + c, 6 * n + 3 * k + c
            off[at] = 0.0
            for r in range(3):
                moved = shrink * poses[k, r, 3] - then_poses[k, r, 3]
                away[at] += then_poses[k, r, c] * moved
                off[at] += then_poses[k, r, c] * (moved + larger * then_poses[k, r, 3])
                by_size[at] += then_poses[k, r, c] * (poses[k, r, 3] - middle[r]) / size2
            away[of_velocity] = shrink * velocities[k, c] - then_velocities[k, c]
            off[of_velocity] = away[of_velocity] + larger * then_velocities[k, c]
            scaled[at] = scaled[of_velocity] = shrink


@kernel
def _of_plain_differences(information: Float, gradient: Float, difference: Difference) -> tuple[Float, Float]:
    """Return information (N, N) and gradient (N,) of plain differences, from those of a `Difference`."""
    scaled, away, by_size = difference.scaled, difference.away, difference.by_size
    weighed = np.zeros(len(away))
    inner, along = 0.0, 0.0
    for r in range(len(away)):
        for c in range(len(away)):
            weighed[r] += information[r, c] * away[c]
        inner += away[r] * weighed[r]
        along += away[r] * gradient[r]
    changed, total = np.empty_like(information), np.empty_like(gradient)
    for r in range(len(away)):
        total[r] = scaled[r] * gradient[r] - along * by_size[r]
        for c in range(len(away)):
            both = scaled[r] * weighed[r] * by_size[c] + scaled[c] * weighed[c] * by_size[r]
            changed[r, c] = scaled[r] * information[r, c] * scaled[c] - both + inner * by_size[r] * by_size[c]
    return changed, total


@kernel
def of_perturbations(information: Float, gradient: Float, poses: Float, before: Float) -> tuple[Float, Float]:
    """Return the information and gradient of perturbed poses, from those of their differences as by `States.since`.

    A perturbation is in the current axes of body, and a difference in those at the linearisation. If the two were taken
    as the same, a prior would gain false information about the whole window's position and heading once poses have
    turned.

    Args:
        information: (N, N) information of all unknowns, the poses first.
        gradient: (N,) gradient, likewise.
        poses: (K, 4, 4) poses that are perturbed.
        before: (K, 4, 4) poses at the linearisation, from which the differences are.
    """
    changed, total = information.copy(), gradient.copy().reshape(-1, 1)
    for k in range(len(poses)):
        before_R_now = before[k, :3, :3].T.copy() @ poses[k, :3, :3].copy()
        by_rotation = so3_right_jacobian_inverse(so3_log(before_R_now))
        for at, by in ((6 * k, by_rotation), (6 * k + 3, before_R_now)):
            turn_rows(by, at, changed)
            turn_rows(by, at, changed.T)
            turn_rows(by, at, total)
    return changed, total[:, 0]
