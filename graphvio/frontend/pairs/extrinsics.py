"""Poses of the cameras in body that motions are estimated with: the rig's, corrected by the cameras' own motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.frontend.motion.observations import RigArrays
from graphvio.frontend.motion.refinement import Refined
from graphvio.frontend.pairs.extrinsic_monitor import ExtrinsicError, ExtrinsicMonitor
from graphvio.geometry import se3_adjoint, se3_inverse
from graphvio.rig import Rig


class RigExtrinsics:
    """Extrinsics of the pairs and single cameras, with their uncertainty.

    If self-calibration is on, it finds errors of the extrinsics, and they are not monitored here.

    Args:
        rig: Stereo pairs and single cameras.
        config: Configuration of all stages.

    Attributes:
        arrays: Calibration of the rig, with the corrections that are in force.
        uncertain: Group index -> covariance (6, 6) of the error d of its extrinsics ``exp(d) body_T_left``, for groups
            whose extrinsics are corrected or estimated.
    """

    def __init__(self, rig: Rig, config: Config) -> None:
        monitored = [] if config.estimates_calibration else range(1, len(rig.groups))
        self._monitors = {j: ExtrinsicMonitor() for j in monitored}
        self.recalibrate(rig, {})

    @property
    def extrinsic_errors(self) -> Mapping[int, ExtrinsicError]:
        """Errors of the extrinsics relative to the first pair, by group index; motions are corrected for them."""
        return {j: monitor.in_force for j, monitor in self._monitors.items() if monitor.in_force is not None}

    def recalibrate(self, rig: Rig, uncertain: Mapping[int, Float]) -> None:
        """Use another calibration: the rig, and group index -> covariance (6, 6) relative to the first pair."""
        self._nominal = RigArrays.of(rig)
        self.arrays = self._nominal
        self.uncertain = uncertain
        for j, monitor in self._monitors.items():
            if monitor.in_force is not None:
                self._correct(j)

    def learn(self, own: Mapping[int, Refined]) -> None:
        """Compare the groups' own motions over a keyframe with the first pair's, and correct wrong extrinsics."""
        if 0 not in own:
            return
        for j, monitor in self._monitors.items():
            if j not in own:
                continue
            monitor.add(own[0], own[j])
            if monitor.learn():
                self._correct(j)

    def uncorrected(self, j: int, own: Refined) -> Refined:
        """Return a pair's own motion by the rig's extrinsics, without the correction in force."""
        back = se3_inverse(self._monitors[j].correction) if j in self._monitors else np.eye(4)
        adjoint = se3_adjoint(back)
        return replace(
            own,
            cur_T_ref=back @ own.cur_T_ref @ se3_inverse(back),
            covariance=adjoint @ own.covariance @ adjoint.T,
        )

    def _correct(self, j: int) -> None:
        """Apply the correction in force of one pair or single camera; remove it if there is none any more."""
        monitor = self._monitors[j]
        self.arrays = self.arrays.corrected(self._nominal, j, monitor.correction)
        others = {i: covariance for i, covariance in self.uncertain.items() if i != j}
        self.uncertain = others if monitor.in_force is None else {**others, j: monitor.in_force.covariance}
