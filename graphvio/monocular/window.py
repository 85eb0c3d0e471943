"""Window of keyframes with the landmarks that they see: the state of a rig of single cameras and an IMU."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.motion import CameraTracks
from graphvio.monocular.sightings import LandmarkIds, Landmarks, Views
from graphvio.monocular.states import States
from graphvio.monocular.window_prior import Prior

MAX_KEYFRAMES = 14
MAX_ERROR2 = 16.0  # squared whitened error of a view of a landmark that stands still
MAX_OFF = 0.3  # share of a landmark's views that may be farther off


@dataclass(eq=False)
class KeyframeWindow:
    """States of a window, with the views from them.

    Attributes:
        states: states, in time order.
        views: views from each state.
        stationary: whether the rig stood at each state.
        landmark_ids: associates tracks with landmarks.
        landmarks: positions of the landmarks.
        prior: prior of the states from before the window, or None.
        factors: (G,) by which the rig file's errors exceed its standard deviations.
    """

    states: States
    views: list[Views]
    stationary: list[bool]
    landmark_ids: LandmarkIds
    landmarks: Landmarks
    prior: Prior | None
    factors: Float

    def add_state(self, stamp_ns: int, pose: Float, velocity: Float, instead: bool) -> None:
        """Add a predicted state: after the newest one, or instead of it where that is no keyframe.

        Args:
            stamp_ns: stamp of its frameset.
            pose: ``nav_T_body`` (4, 4).
            velocity: (3,) m/s in nav.
            instead: whether it replaces the newest state.
        """
        states = self.states
        n = len(states.poses) - 1 if instead and len(states.poses) > 1 else len(states.poses)
        del self.views[n:], self.stationary[n:]
        self.states = replace(
            states,
            stamps_ns=np.append(states.stamps_ns[:n], stamp_ns),
            poses=np.concatenate([states.poses[:n], pose[None]]),
            velocities=np.concatenate([states.velocities[:n], velocity[None]]),
        )

    def add_views(self, camera_tracks: Mapping[int, CameraTracks], is_stationary: bool) -> None:
        """Add the views from the newest state: index of the camera -> tracks."""
        self.views.append(self.landmark_ids.join(camera_tracks))
        self.stationary.append(is_stationary)

    def turn(self, new_T_odom: Float) -> None:
        """Express the window in another frame, given by ``new_T_odom`` (4, 4)."""
        self.states = self.states.turned(new_T_odom)
        self.prior = None if self.prior is None else self.prior.turned(new_T_odom)
        self.landmarks.turn(new_T_odom)

    def without_newest(self) -> KeyframeWindow:
        """Return the window as it was before the newest state, with the same landmarks."""
        kept = self.states.of(np.arange(len(self.states.poses) - 1))
        return replace(self, states=kept, views=self.views[:-1], stationary=self.stationary[:-1])
