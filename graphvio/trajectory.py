"""A sequence of stamped poses of body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.errors import TrajectoryError
from graphvio.geometry import interpolate
from graphvio.kernels import kernel, put

_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of body over time.

    Attributes:
        stamps_ns: (N,) int64 nanoseconds, strictly increasing.
        nav_T_body: (N, 4, 4), metres; nav may be any world frame.

    Raises:
        TrajectoryError: if the shapes differ, a value is not finite, or the stamps do not increase.
    """

    stamps_ns: Int
    nav_T_body: Float

    def __post_init__(self) -> None:
        stamps = np.array(self.stamps_ns, dtype=np.int64).reshape(-1)
        poses = np.ascontiguousarray(self.nav_T_body, dtype=np.float64).reshape(-1, 4, 4)
        if len(stamps) != len(poses):
            raise TrajectoryError(f"trajectory: {len(stamps)} stamps but {len(poses)} poses; give one stamp a pose")
        bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
        if len(bad):
            raise TrajectoryError(f"trajectory: pose {bad[0]} holds NaN or infinity; leave such poses out")
        back = np.flatnonzero(np.diff(stamps) <= 0)
        if len(back):
            raise TrajectoryError(
                f"trajectory: stamp {stamps[back[0] + 1]} ns of pose {back[0] + 1} does not come after "
                f"the one before it ({stamps[back[0]]} ns); sort the poses and keep one for each stamp"
            )
        object.__setattr__(self, "stamps_ns", stamps)
        object.__setattr__(self, "nav_T_body", poses)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> Float:
        """Positions (N, 3) in nav, metres."""
        return self.nav_T_body[:, :3, 3]

    @property
    def rotations(self) -> Float:
        """Rotations (N, 3, 3) ``nav_R_body``."""
        return self.nav_T_body[:, :3, :3]

    @property
    def distances(self) -> Float:
        """Path lengths (N,) from the first pose, metres."""
        return travelled(self.positions)

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last pose."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) / _NS_PER_S if len(self) else 0.0

    def select(self, which: Bool | Int | slice) -> Trajectory:
        """Select poses.

        Args:
            which: indices, a slice, or a mask (N,).

        Returns:
            The trajectory of these poses.
        """
        return Trajectory(self.stamps_ns[which], self.nav_T_body[which])

    def around(self, begin_ns: int, end_ns: int) -> Trajectory:
        """Select the poses within a period of time, with one more on either side for interpolation.

        Args:
            begin_ns: begin of the period, nanoseconds.
            end_ns: end of the period, nanoseconds.

        Returns:
            The trajectory of these poses.
        """
        first = int(np.searchsorted(self.stamps_ns, begin_ns, side="right")) - 1
        last = int(np.searchsorted(self.stamps_ns, end_ns)) + 1
        return self.select(slice(max(first, 0), last))

    def transformed(self, other_T_nav: Float) -> Trajectory:
        """Transform to another world frame.

        Args:
            other_T_nav: (4, 4) pose of the present world frame in the other.

        Returns:
            The trajectory in the other.
        """
        return Trajectory(self.stamps_ns, np.asarray(other_T_nav) @ self.nav_T_body)

    def at(self, stamps_ns: Int, max_gap_s: float) -> tuple[Trajectory, Bool]:
        """Interpolate poses, linearly in position and by slerp in rotation.

        Args:
            stamps_ns: (M,) strictly increasing.
            max_gap_s: longest interval between two poses that is bridged, seconds.

        Returns:
            Poses at the stamps that coincide with a pose or lie between two, and a mask (M,) of these stamps.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        if not len(self):
            return Trajectory(stamps[:0], np.empty((0, 4, 4))), np.zeros(len(stamps), dtype=np.bool_)
        after = np.searchsorted(self.stamps_ns, stamps)
        last = len(self) - 1
        equal = self.stamps_ns[np.minimum(after, last)] == stamps
        inside = (after > 0) & (after <= last)
        upper = np.clip(after, 1, max(last, 1)) if last else np.zeros_like(after)
        lower = np.maximum(upper - 1, 0)
        gap_ns = self.stamps_ns[upper] - self.stamps_ns[lower]
        known = equal | (inside & (gap_ns <= round(max_gap_s * _NS_PER_S)))
        poses = np.empty((len(stamps), 4, 4))
        poses[equal] = self.nav_T_body[after[equal]]
        between = known & ~equal
        lower, upper = lower[between], upper[between]
        fractions = (stamps[between] - self.stamps_ns[lower]) / gap_ns[between]
        poses[between] = _interpolated(self.nav_T_body, lower, upper, fractions)
        return Trajectory(stamps[known], poses[known]), known


@kernel
def _interpolated(nav_T_body: Float, lower: Int, upper: Int, fractions: Float) -> Float:
    """Interpolate (M, 4, 4) between rows ``lower`` and ``upper`` of poses (N, 4, 4)."""
    poses = np.empty((len(lower), 4, 4))
    for row in range(len(lower)):
        put(poses[row], interpolate(nav_T_body[lower[row]], nav_T_body[upper[row]], fractions[row]))
    return poses


def travelled(positions: Float) -> Float:
    """Compute path lengths (N,) along positions (N, 3), metres."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])[: len(positions)]
