"""Nuisance poses of reference states, which model the error that all motions from one reference share."""

from __future__ import annotations

from typing import Protocol

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.factors import r, x
from graphvio.backend.noise import gaussian, own_covariance
from graphvio.geometry import se3_adjoint, se3_inverse
from graphvio.measurements.motion import RelativeMotion


class Holder(Protocol):
    """A container of factors and values: a window, or the graph of a whole session."""

    values: gtsam.Values

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        """Insert a factor."""


class ReferenceViews:
    """Nuisance variables for the errors that motions from one reference share.

    All motions from one reference share the error of its triangulated points. The pose of the reference as vision sees
    it differs from its true pose by that error, and is one unknown for all of these motions.
    """

    def __init__(self) -> None:
        self._shared: dict[int, Float] = {}  # state -> covariance (6, 6) of its view about its pose, in body there
        self._own: tuple[RelativeMotion, Float] | None = None  # the motion asked for last, and its own covariance

    def add(self, k: int, motion: RelativeMotion, window: Holder) -> None:
        """Insert the nuisance variable of a motion's reference, state k, if it needs one and has none."""
        if k in self._shared or not motion.shared_covariance.any():
            return
        adjoint = se3_adjoint(motion.reference_T_current)  # takes the tangent from the current instant there
        self._shared[k] = adjoint @ motion.shared_covariance @ adjoint.T
        window.values.insert(r(k), window.values.atPose3(x(k)))
        window.add(gtsam.BetweenFactorPose3(x(k), r(k), gtsam.Pose3(), gaussian(self._shared[k])))

    def keys(self, k: int) -> list[int]:
        """Return the keys of the pose of state k, and of its nuisance variable if it has one."""
        return [x(k), r(k)] if k in self._shared else [x(k)]

    def seen(self, k: int, motion: RelativeMotion) -> tuple[int, Float]:
        """Return the key of the pose that a motion from state k is measured from, and its covariance (6, 6) there."""
        if k not in self._shared or not motion.shared_covariance.any():
            return x(k), motion.covariance
        if self._own is None or self._own[0] is not motion:  # the gate asks for it, and the insertion again
            adjoint = se3_adjoint(se3_inverse(motion.reference_T_current))
            self._own = motion, own_covariance(motion.covariance, np.asarray(adjoint @ self._shared[k] @ adjoint.T))
        return r(k), self._own[1]

    def forget(self, k: int) -> None:
        """Forget state k, which has left the window."""
        self._shared.pop(k, None)
