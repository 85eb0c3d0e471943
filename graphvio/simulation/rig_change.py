"""True rigs that change while they are carried: slowly with temperature, or at once by a knock.

The files of a recording know nothing of it: they describe the rig at the beginning.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3, so3_exp
from graphvio.rig import Camera, Rig, SingleCamera, StereoPair


class RigChange(Protocol):
    """A change of a rig in stages that are constant, so that the rays of cameras are computed once for each."""

    def stage_at(self, time_s: float, duration_s: float) -> int:
        """Return the number of the stage at a time since the start of a walk of known duration; 0 is no change."""

    def rig_in(self, rig: Rig, stage: int) -> Rig:
        """Return a rig as it is in a stage."""


@dataclass(frozen=True)
class ThermalDrift:
    """Right cameras turn about their y axes and focal lengths grow, linearly, in steps of a second.

    Attributes:
        yaw_deg: turn of all right cameras in a period.
        focal_percent: growth of all focal lengths in a period.
        period_s: seconds.
    """

    yaw_deg: float = 0.05
    focal_percent: float = 0.05
    period_s: float = 300.0

    def stage_at(self, time_s: float, duration_s: float) -> int:
        """Return the number of whole seconds; from one to the next, pixels move by less than 0.002."""
        return int(time_s)

    def rig_in(self, rig: Rig, stage: int) -> Rig:
        """Return a rig as it is after so many seconds."""
        share = stage / self.period_s
        right_T_turned = se3(so3_exp(np.deg2rad(share * self.yaw_deg) * np.array([0.0, 1.0, 0.0])), np.zeros(3))
        growth = 1.0 + 0.01 * share * self.focal_percent
        scale = np.array([growth, growth, 1.0, 1.0])

        def grown(camera: Camera, body_T_cam: Float) -> Camera:
            return replace(camera, intrinsics=scale * camera.intrinsics, body_T_cam=body_T_cam)

        pairs = [
            StereoPair(
                pair.name,
                grown(pair.left, pair.left.body_T_cam),
                grown(pair.right, pair.right.body_T_cam @ right_T_turned),
            )
            for pair in rig.pairs
        ]
        singles = [SingleCamera(grown(single.left, single.left.body_T_cam)) for single in rig.singles]
        return replace(rig, pairs=tuple(pairs), singles=tuple(singles))


@dataclass(frozen=True)
class Knock:
    """In the middle of the walk the first pair moves, and its right camera turns against the left one.

    Attributes:
        angle_deg: of the right camera's turn, about an axis that is oblique to all its own.
        shift_m: of the whole pair in body, also oblique.
    """

    angle_deg: float = 0.1
    shift_m: float = 0.005

    def stage_at(self, time_s: float, duration_s: float) -> int:
        """Return 0 before the knock and 1 from it on."""
        return int(time_s >= 0.5 * duration_s)

    def rig_in(self, rig: Rig, stage: int) -> Rig:
        """Return a rig before (0) or after (1) the knock."""
        if stage == 0:
            return rig
        oblique = np.ones(3) / np.sqrt(3.0)
        right_T_turned = se3(so3_exp(np.deg2rad(self.angle_deg) * oblique), np.zeros(3))
        shift = se3(np.eye(3), self.shift_m * oblique)
        pair = rig.pairs[0]
        left = replace(pair.left, body_T_cam=shift @ pair.left.body_T_cam)
        right = replace(pair.right, body_T_cam=shift @ pair.right.body_T_cam @ right_T_turned)
        return replace(rig, pairs=(StereoPair(pair.name, left, right), *rig.pairs[1:]))


RIG_CHANGES: dict[str, RigChange] = {"thermal": ThermalDrift(), "knock": Knock()}
"""Changes by their names."""
