"""True rigs that change while they are carried: slowly with temperature, or at once by a knock.

The files of a recording keep the calibration of its beginning.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import SourceError
from graphvio.geometry import se3, so3_exp
from graphvio.rig import Camera, Rig, StereoPair


class RigChange(Protocol):
    """A change of a rig, in stages that are constant, so that the rays of cameras are computed once for each."""

    def stage_at(self, time_s: float) -> int:
        """Return the number of the stage at a time in seconds since the start; 0 is the rig as its files say."""

    def rig_in(self, rig: Rig, stage: int) -> Rig:
        """Return a rig as it is in a stage."""


@dataclass(frozen=True)
class ThermalDrift:
    """Right cameras turn about their y axes and focal lengths grow, linearly, in steps of a second.

    Attributes:
        yaw_deg: turn of all right cameras, after `period_s`.
        focal_percent: growth of all focal lengths, after `period_s`.
        period_s: seconds.
    """

    yaw_deg: float = 0.05
    focal_percent: float = 0.05
    period_s: float = 300.0

    def stage_at(self, time_s: float) -> int:
        """Return the number of whole seconds: within one, pixels move by less than 0.002."""
        return int(time_s)

    def rig_in(self, rig: Rig, stage: int) -> Rig:
        """Return a rig as it is after so many seconds."""
        share = stage / self.period_s
        turn = se3(so3_exp(np.deg2rad(share * self.yaw_deg) * np.array([0.0, 1.0, 0.0])), np.zeros(3))
        scale = np.array([1.0 + 0.01 * share * self.focal_percent] * 2 + [1.0] * 2)

        def grown(camera: Camera, body_T_cam: Float) -> Camera:
            return replace(camera, intrinsics=scale * camera.intrinsics, body_T_cam=body_T_cam)

        pairs = [
            StereoPair(
                pair.name, grown(pair.left, pair.left.body_T_cam), grown(pair.right, pair.right.body_T_cam @ turn)
            )
            for pair in rig.pairs
        ]
        return replace(rig, pairs=tuple(pairs))


@dataclass(frozen=True)
class Knock:
    """At one instant the first pair moves, and its right camera turns against the left one.

    Attributes:
        time_s: of the instant, since the start.
        angle_deg: of the right camera's turn, about an axis that is oblique to all its own.
        shift_m: of the whole pair in body.
    """

    time_s: float
    angle_deg: float = 0.1
    shift_m: float = 0.005

    def stage_at(self, time_s: float) -> int:
        """Return 0 before the knock and 1 from it on."""
        return int(time_s >= self.time_s)

    def rig_in(self, rig: Rig, stage: int) -> Rig:
        """Return a rig before (0) or after (1) the knock."""
        if stage == 0:
            return rig
        oblique = np.ones(3) / np.sqrt(3.0)
        turn = se3(so3_exp(np.deg2rad(self.angle_deg) * oblique), np.zeros(3))
        shift = se3(np.eye(3), self.shift_m * oblique)
        pair = rig.pairs[0]
        left = replace(pair.left, body_T_cam=shift @ pair.left.body_T_cam)
        right = replace(pair.right, body_T_cam=shift @ pair.right.body_T_cam @ turn)
        return replace(rig, pairs=(StereoPair(pair.name, left, right), *rig.pairs[1:]))


RIG_CHANGES = ("thermal", "knock")
"""Names of `rig_change`."""


def rig_change(name: str, duration_s: float) -> RigChange:
    """Return a change by its name.

    Args:
        name: ``thermal`` or ``knock``, which comes in the middle.
        duration_s: of the recording.

    Raises:
        SourceError: if there is no such change.
    """
    if name == "thermal":
        return ThermalDrift()
    if name == "knock":
        return Knock(0.5 * duration_s)
    raise SourceError(f"there is no change {name!r} of the rig; choose from {', '.join(RIG_CHANGES)}")
