"""Changes of the true rig while it is carried: slowly with temperature, or suddenly by a knock.

The files of a recording do not contain the change: they describe the rig at the beginning.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3, so3_exp
from graphvio.rig import Camera, Rig, SingleCamera, StereoPair


class RigChange(Protocol):
    """A change of a rig in stages; within a stage the rig is constant, so that camera rays are computed once for it."""

    def stage_at(self, time_s: float, duration_s: float) -> int:
        """Return the number of the stage at a time since the start of a walk of known duration; 0 is no change."""

    def rig_in(self, rig: Rig, stage: int) -> Rig:
        """Return the changed rig in a stage; ``rig`` is the unchanged one."""


@dataclass(frozen=True)
class ThermalDrift:
    """Drift in which right cameras turn about their y axes and focal lengths grow, linearly, in steps of a second.

    Attributes:
        yaw_deg: rotation of all right cameras in a period.
        focal_percent: growth of all focal lengths in a period.
        period_s: length of the period, seconds.
    """

    yaw_deg: float = 0.05
    focal_percent: float = 0.05
    period_s: float = 300.0

    def stage_at(self, time_s: float, duration_s: float) -> int:
        """Return the number of whole seconds; from one to the next, image points move by less than 0.002 px."""
        return int(time_s)

    def rig_in(self, rig: Rig, stage: int) -> Rig:
        """Return the rig after ``stage`` seconds."""
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
    """Knock in the middle of the walk, which displaces the first pair and turns its right camera relative to the left.

    In a rig without pairs, it displaces and turns the first camera.

    Attributes:
        angle_deg: angle by which the camera turns, about the diagonal of its axes.
        shift_m: displacement of the pair or camera in body, along the diagonal of body's axes.
    """

    angle_deg: float = 0.1
    shift_m: float = 0.005

    def stage_at(self, time_s: float, duration_s: float) -> int:
        """Return 0 before the knock and 1 from it on."""
        return int(time_s >= 0.5 * duration_s)

    def rig_in(self, rig: Rig, stage: int) -> Rig:
        """Return the rig before (stage 0) or after (stage 1) the knock."""
        if stage == 0:
            return rig
        oblique = np.ones(3) / np.sqrt(3.0)
        cam_T_turned = se3(so3_exp(np.deg2rad(self.angle_deg) * oblique), np.zeros(3))
        shift = se3(np.eye(3), self.shift_m * oblique)
        if not rig.pairs:
            first = rig.singles[0].left
            moved = replace(first, body_T_cam=shift @ first.body_T_cam @ cam_T_turned)
            return replace(rig, singles=(SingleCamera(moved), *rig.singles[1:]))
        pair = rig.pairs[0]
        left = replace(pair.left, body_T_cam=shift @ pair.left.body_T_cam)
        right = replace(pair.right, body_T_cam=shift @ pair.right.body_T_cam @ cam_T_turned)
        return replace(rig, pairs=(StereoPair(pair.name, left, right), *rig.pairs[1:]))


RIG_CHANGES: dict[str, RigChange] = {"thermal": ThermalDrift(), "knock": Knock()}
"""Changes of a rig by name."""
