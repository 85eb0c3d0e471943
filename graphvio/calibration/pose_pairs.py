"""Pose pairs: motions of two rigidly joined cameras over the same time."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_inverse, se3_log

MIN_PAIRS = 3
"""Number of pose pairs that the paper's method needs."""


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Pose pairs ``(P_1, P_2)`` of section 4, as motions of the cameras.

    A motion is the pose of the left camera at the end in its frame at the start, the inverse of the paper's
    ``P_j(t_k, t_k+1)``, which maps points.

    Raises:
        CalibrationError: if the shapes disagree, or a value is not finite.
    """

    start_ns: Int  # (N,) int64
    end_ns: Int  # (N,) int64
    motion_1: Float  # (N, 4, 4) of the first pair's left camera
    covariance_1: Float  # (N, 6, 6) of motion_1, tangent ``[rotation, translation]`` in the frame at its end
    motion_2: Float  # (N, 4, 4) of the second pair's left camera
    covariance_2: Float  # (N, 6, 6) of motion_2, in the same way

    def __post_init__(self) -> None:
        count = len(self.start_ns)
        shapes = {
            "end_ns": (count,),
            "motion_1": (count, 4, 4),
            "covariance_1": (count, 6, 6),
            "motion_2": (count, 4, 4),
            "covariance_2": (count, 6, 6),
        }
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape:
                raise CalibrationError(f"pose pairs: {name} is {values.shape} for {count} pairs; it must be {shape}")
            bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
            if len(bad):
                raise CalibrationError(f"pose pairs: {name} of pair {bad[0]} holds NaN or infinity; leave it out")

    def __len__(self) -> int:
        return len(self.start_ns)

    def select(self, rows: Bool | Int) -> PosePairs:
        """Return some of the pose pairs, by mask or indices."""
        return PosePairs(*(getattr(self, field.name)[rows] for field in fields(self)))

    @property
    def rotations_rad(self) -> Float:
        """Rotation vectors (N, 3) of the first camera, in its frame at the start (and at the end)."""
        return np.array([se3_log(motion)[:3] for motion in self.motion_1]).reshape(-1, 3)


def inverses(poses: Float) -> Float:
    """Invert poses (N, 4, 4)."""
    return np.array([se3_inverse(pose) for pose in poses]).reshape(-1, 4, 4)
