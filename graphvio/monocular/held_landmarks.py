"""Landmarks that are not solved for between keyframes: their views stay as they were linearised."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.monocular.adjustment import Measurements
from graphvio.monocular.states import States, visual_columns
from graphvio.monocular.structure import Eliminated, landmarks_after
from graphvio.monocular.window import KeyframeWindow
from graphvio.monocular.window_prior import Prior


class HeldLandmarks(NamedTuple):
    """Landmarks that the newest keyframe does not see: until the next one, their views stay as they were linearised.

    They are three quarters of all, and their information on the keyframes hardly changes.

    Attributes:
        ids: (L,) identities of the landmarks.
        measured: measurements with these landmarks only.
        places: (L, 3) the landmarks at the linearisation.
        prior: prior of the keyframes by these views, and from before the window.
        eliminated: terms of the elimination that move them along with the keyframes.
    """

    ids: Int
    measured: Measurements
    places: Float
    prior: Prior
    eliminated: Eliminated

    def holds(self, window: KeyframeWindow) -> bool:
        """Return whether a window has the same keyframes, and a newest state that sees none of the landmarks."""
        are_same = np.array_equal(window.states.stamps_ns[:-1], self.prior.at.stamps_ns)
        return are_same and not np.isin(self.ids, window.views[-1].landmark).any()

    def moved_along(self, states: States) -> tuple[Float, Float]:
        """Return the landmarks' frames (L, 4, 4) and places (L, 3) for the current estimate of the states."""
        then, n_parameters = self.prior.at, self.eliminated.by_cameras.shape[2]
        now = states.of(np.arange(len(then.poses)))
        step = now.since(then)[visual_columns(len(then.poses), n_parameters, n_parameters)]
        places, frames = landmarks_after(
            self.places, self.measured.structure, then.cameras(self.measured.cameras), then.poses, now.poses,
            self.eliminated, step,
        )  # fmt: skip
        return frames, places
