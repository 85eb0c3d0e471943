"""Cameras whose images are tracked together: a stereo pair, or a single one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.rig.camera import Camera, axes_angle_deg

_MAX_READOUT_DIFFERENCE_NS = 1_000_000
MAX_AXES_ANGLE_DEG = 45.0
"""Largest angle between the optical axes of a stereo pair; at larger ones, patches look too different to be matched."""
MIN_BASELINE_M = 1e-3
"""Smallest distance between the optical centres of a stereo pair."""


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Left and right camera with overlapping views.

    Attributes:
        name: name of the pair, unique in the rig.
        left: the camera whose corners are tracked.
        right: the camera in whose images these corners are matched.

    Raises:
        RigError: if the baseline is below 1 mm, the optical axes are more than 45 degrees apart, or rolling shutters
            are read out in times that differ by more than 1 ms.
    """

    name: str
    left: Camera
    right: Camera

    def __post_init__(self) -> None:
        where = f"pair {self.name} ({self.left.name}, {self.right.name})"
        if self.baseline_m < MIN_BASELINE_M:
            raise RigError(
                f"{where}: baseline is {1e3 * self.baseline_m:.3f} mm; a stereo pair needs two cameras at "
                "different places: check body_T_cam of both"
            )
        axes_deg = axes_angle_deg(self.left, self.right)
        if axes_deg > MAX_AXES_ANGLE_DEG:
            raise RigError(
                f"{where}: optical axes are {axes_deg:.0f} degrees apart (at most "
                f"{MAX_AXES_ANGLE_DEG:.0f}); check which cameras form a pair and the direction of body_T_cam"
            )
        if abs(self.left.readout_ns - self.right.readout_ns) > _MAX_READOUT_DIFFERENCE_NS:
            raise RigError(
                f"{where}: its cameras read their lines out in {1e-6 * self.left.readout_ns:.1f} and "
                f"{1e-6 * self.right.readout_ns:.1f} ms; a pair needs the same line_time_us: make them single cameras"
            )

    @cached_property
    def right_T_left(self) -> Float:
        """Transform (4, 4) from left to right camera, ``P^s`` of the paper's eq. (2)."""
        return self.right.cam_T_body @ self.left.body_T_cam

    @property
    def baseline_m(self) -> float:
        """Distance between the optical centres, metres."""
        return float(np.linalg.norm(self.right_T_left[:3, 3]))

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Left and right camera."""
        return self.left, self.right


@dataclass(frozen=True, eq=False)
class SingleCamera:
    """A camera without a stereo partner; the depth of its points is estimated from motion.

    Attributes:
        left: the camera; its corners are tracked like those of a pair's left camera.
    """

    left: Camera

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self.left.name

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera."""
        return (self.left,)


CameraGroup = StereoPair | SingleCamera
"""Cameras whose images are tracked together: a stereo pair, or a single camera."""
