"""Windows that have found the reverse of the true motion: how they are recognised, and adjusted again.

Views alone cannot distinguish the two: with all landmarks behind the cameras, the optical flow is the same. Where the
velocity is uncertain by more than its size, as after a long gap, a window may find the reverse motion. Later windows
then keep it with great confidence, as accelerations hardly contradict a velocity that is wrong by a constant.
"""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.monocular.adjustment import Adjusted, Measurements, adjust
from graphvio.monocular.states import States
from graphvio.monocular.structure import PRIOR_INVERSE_DEPTH
from graphvio.monocular.window_prior import Prior
from graphvio.self_calibration.evidence import Gaussian

_MIN_LANDMARKS = 5  # landmarks that the newest state sees
_BEHIND = -0.03  # 1/m, a median inverse depth that is not the noise of far landmarks
_HELD_INFORMATION = 100.0  # of the prior inverse depth: sigma 0.1 / m
_STEPS = 10


def is_reversed(adjusted: Adjusted, is_seen: Bool) -> bool:
    """Return whether most of the landmarks (L,) that are seen by the newest state are behind their cameras."""
    inverse_depths = adjusted.landmarks[is_seen, 2]
    return len(inverse_depths) >= _MIN_LANDMARKS and bool(np.median(inverse_depths) < _BEHIND)


def adjust_forwards(
    measured: Measurements,
    states: States,
    landmarks: Float,
    prior: Prior | None,
    file: Gaussian | None,
    converged: float,
) -> Adjusted:
    """Adjust a window first with its landmarks held in front of their cameras, and then with free ones.

    For arguments see `graphvio.monocular.adjustment.adjust`; states and landmarks are those from before it found the
    reverse motion.
    """
    is_behind = landmarks[:, 2] < 0.0
    places = np.column_stack([landmarks[:, :2], np.where(is_behind, PRIOR_INVERSE_DEPTH, landmarks[:, 2])])
    held = measured._replace(depth_information=_HELD_INFORMATION)
    first = adjust(held, states, places, prior, _STEPS, file, converged)
    free = first.measured._replace(depth_information=measured.depth_information)
    return adjust(free, first.states, first.landmarks, prior, _STEPS, file, converged)
