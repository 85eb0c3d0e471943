"""Views of landmarks by single cameras as factors between the poses of a session's graph.

The odometry passes on the views of each landmark once, with the landmark eliminated: a quadratic cost of the poses from
which it was seen. Here, this is a cost of these poses relative to the first of them, so that loop closures may move all
of them together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from graphvio.arrays import Float, Int
from graphvio.geometry import se3_adjoint, se3_compose, se3_inverse, se3_log
from graphvio.measurements.window_views import WindowViews

_MIN_SHARE = 1e-12  # of the largest eigenvalue: smaller eigenvalues are due to rounding
_MIN_STATES = 2
_MIN_DIAGONAL = 1e-12


class Views(NamedTuple):
    """V costs of poses as columns; the states of cost i are rows ``begins[i]`` to ``begins[i + 1]`` of the others."""

    begins: Int  # (V + 1,)
    row: Int  # (S,) rows of the framesets
    poses: Float  # (S, 4, 4) ``nav_T_body`` at which the cost was linearised
    gradient: Float  # (S, 6)
    information: Float  # concatenated, (6 K)^2 numbers for a cost of K states

    def at(self, number: int) -> tuple[Int, Float, Float, Float]:
        """Return rows (K,), poses (K, 4, 4), information (6 K, 6 K) and gradient (6 K,) of a cost."""
        states = slice(int(self.begins[number]), int(self.begins[number + 1]))
        sizes = (6 * np.diff(self.begins)) ** 2
        begin, size = int(sizes[:number].sum()), int(sizes[number])
        information = self.information[begin : begin + size].reshape(2 * [6 * (states.stop - states.start)])
        return self.row[states], self.poses[states], information, self.gradient[states].ravel()

    @staticmethod
    def of(given: Iterable[WindowViews], row_of: Mapping[int, int]) -> Views:
        """Collect costs; ``row_of`` gives the row of a stamp, and poses of framesets without one are eliminated."""
        kept = [each.of(np.array([int(ns) in row_of for ns in each.stamps_ns])) for each in given]
        kept = [each for each in kept if len(each.stamps_ns) >= _MIN_STATES]
        return Views(
            np.cumsum([0, *(len(each.stamps_ns) for each in kept)], dtype=np.int64),
            np.array([row_of[int(ns)] for each in kept for ns in each.stamps_ns], dtype=np.int64),
            np.concatenate([np.zeros((0, 4, 4)), *(each.poses for each in kept)]),
            np.concatenate([np.zeros((0, 6)), *(each.gradient.reshape(-1, 6) for each in kept)]),
            np.concatenate([np.zeros(0), *(each.information.ravel() for each in kept)]),
        )


def views_factor(keys: Sequence[int], poses: Float, information: Float, gradient: Float) -> gtsam.CustomFactor:
    """Return the factor of a cost between the poses of K states.

    Args:
        keys: keys (K,) of the poses.
        poses: poses (K, 4, 4) at which the cost was linearised.
        information: information (6 K, 6 K) of the cost.
        gradient: gradient (6 K,) of the cost.
    """
    root, offset = root_of(information[6:, 6:], gradient[6:])
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(root)), list(keys), _error(root, offset, poses))


def root_of(information: Float, gradient: Float) -> tuple[Float, Float]:
    """Return A (M, N) and c (M,) with ``A^T A`` the information (N, N), and ``A^T c`` the gradient (N,).

    Directions without information are left out.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), _MIN_DIAGONAL))  # units differ
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    known = values > _MIN_SHARE * values[-1]
    sizes = np.sqrt(values[known])
    root = sizes[:, None] * vectors[:, known].T / scale
    return np.ascontiguousarray(root), (vectors[:, known].T @ (scale * gradient)) / sizes


class RelativePoses:
    """Changes of poses relative to the first of them, as a part of d in an error ``root d + offset``.

    Args:
        root: matrix (M, N) whose first 6 (K - 1) columns multiply these changes.
        poses: poses (K, 4, 4) from which the changes are counted.
    """

    def __init__(self, root: Float, poses: Float) -> None:
        self._known = [se3_inverse(np.ascontiguousarray(se3_inverse(poses[0]) @ pose)) for pose in poses[1:]]
        self._columns = [np.ascontiguousarray(root[:, 6 * k : 6 * k + 6]) for k in range(len(self._known))]

    def add_to(self, residual: Float, poses: Sequence[Float], derivatives: list[Float] | None) -> Float:
        """Add the changes of K poses (4, 4) to a residual (M,).

        Args:
            residual: changed in place.
            poses: ``nav_T_body`` as they are now.
            derivatives: list of the derivatives with respect to each pose, in which all but the first are filled in;
                None where not needed.

        Returns:
            Derivative (M, 6) with respect to the first pose; zero without derivatives.
        """
        inverse, by_first = se3_inverse(poses[0]), np.zeros((len(residual), 6))
        for k, (pose, then_T_first) in enumerate(zip(poses[1:], self._known, strict=True)):
            first_T_pose = se3_compose(inverse, pose)
            change = se3_log(se3_compose(then_T_first, first_T_pose))
            residual += self._columns[k] @ change
            if derivatives is not None:
                by_pose = self._columns[k] @ gtsam.Pose3.LogmapDerivative(change)
                by_first -= by_pose @ se3_adjoint(se3_inverse(first_T_pose))
                derivatives[k + 1] = np.asfortranarray(by_pose)
        return by_first


def _error(
    root: Float, offset: Float, poses: Float
) -> Callable[[gtsam.CustomFactor, gtsam.Values, list[Float] | None], Float]:
    """Return the error ``root d + offset`` with its derivatives; d is the change of the poses relative to the first."""
    relative = RelativePoses(root, poses)

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, derivatives: list[Float] | None) -> Float:
        keys, residual = factor.keys(), offset.copy()
        by_first = relative.add_to(residual, [values.atPose3(key).matrix() for key in keys], derivatives)
        if derivatives is not None:
            derivatives[0] = np.asfortranarray(by_first)
        return residual

    return error
