"""The motions that the gate has refused since the last one that passed."""

from __future__ import annotations

from collections.abc import Callable

from graphvio.arrays import Float
from graphvio.measurements.motion import RelativeMotion


class RefusedMotions:
    """A chain of refused motions with the poses that it leads to, until one passes the gate.

    Attributes:
        nav_T_body: Stamp -> pose (4, 4) at which a motion ends.
        is_after_gap: Whether the chain begins at a state that was predicted by the IMU alone.
        has_imu_failed: Whether IMU samples were missing after the first refused motion.
        is_distrusted: Whether the calibration of the IMU, or the initial state, proved to be wrong meanwhile.
    """

    def __init__(self) -> None:
        self.nav_T_body: dict[int, Float] = {}
        self.is_after_gap = self.has_imu_failed = self.is_distrusted = False

    def __len__(self) -> int:
        return len(self.nav_T_body)

    @property
    def first_ns(self) -> int:
        """Stamp at which the first motion ends."""
        return min(self.nav_T_body)

    def add(self, motion: RelativeMotion, pose: Callable[[int], Float], tracked_ns: int) -> None:
        """Add a motion from a state of the window, or from the pose at which an earlier motion of the chain ends.

        Args:
            motion: The refused motion; its reference is in the window or in the chain.
            pose: Returns ``nav_T_body`` (4, 4) of a state of the window.
            tracked_ns: Stamp of the last state that vision constrains.
        """
        reference_ns = motion.reference_stamp_ns
        if not self.nav_T_body:
            self.is_after_gap = reference_ns > tracked_ns
        nav_T_reference = self.nav_T_body.get(reference_ns)
        if nav_T_reference is None:
            nav_T_reference = pose(reference_ns)
        self.nav_T_body[motion.stamp_ns] = nav_T_reference @ motion.reference_T_current

    def note_missing_imu(self) -> None:
        """Record that IMU samples are missing, if a motion has been refused."""
        self.has_imu_failed |= bool(self.nav_T_body)

    def distrust_prediction(self) -> None:
        """Mark the prediction as wrong, if it has refused a motion."""
        self.is_distrusted = bool(self.nav_T_body)

    def clear(self) -> None:
        """Forget all: a motion has passed the gate, or the state has been reinitialised."""
        self.nav_T_body.clear()
        self.is_after_gap = self.has_imu_failed = self.is_distrusted = False
