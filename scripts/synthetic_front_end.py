"""A front-end whose keyframes are true poses with random drift, and whose images are real or rendered.

It measures mapping alone: the errors of the result do not depend on an odometry.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.gating import chi_square_quantile
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.mapping.places import composed
from graphvio.measurements.estimate import Status
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig
from graphvio.slam.keyframe import CorrectionResult, Keyframe, Landmarks

_MIN_STEP_M = 0.05  # shorter motions have the sigmas of this length
_FIRST_SIGMAS = np.repeat([1.5e-2, 1e-3], 3)  # of an odometry at standstill: gravity is as uncertain as the IMU's bias
_PATIENCE_S = 0.001


class SyntheticFrontEnd:
    """A SLAM front-end that yields keyframes one after another, each as soon as there is room for it.

    Args:
        rig: of the images.
        stamps_ns: of the keyframes.
        world_T_body: (N, 4, 4) true poses; the first epoch's odom frame is this world, a later one's its first pose.
        frameset_at: the images of a stamp.
        sigmas: of the drift: radians and metres after a metre; it is a random walk.
        seed: of the drift.
        breaks: keyframes with which a new epoch begins.

    Attributes:
        corrections: (keyframe's id, map_T_body, covariance) in the order in which they came.
        has_room: polled before each keyframe.
    """

    def __init__(
        self,
        rig: Rig,
        stamps_ns: Sequence[int],
        world_T_body: Float,
        frameset_at: Callable[[int], FrameSet],
        sigmas: tuple[float, float],
        seed: int,
        breaks: Collection[int] = (),
    ) -> None:
        self._rig = rig
        self._frameset_at = frameset_at
        self._keyframes = _with_drift(stamps_ns, world_T_body, sigmas, seed, breaks)
        self.corrections: list[tuple[int, Float, Float]] = []
        self.has_room: Callable[[], bool] = lambda: True

    @property
    def rig(self) -> Rig:
        """See `graphvio.slam.interface.SlamFrontEnd`."""
        return self._rig

    @property
    def odom_T_body(self) -> Float:
        """Poses (N, 4, 4) with their drift."""
        return np.array([each.odom_T_body for each in self._keyframes])

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        """See `graphvio.slam.interface.SlamFrontEnd`."""
        for each in self._keyframes[from_id:]:
            while not self.has_room():
                time.sleep(_PATIENCE_S)
            yield Keyframe(
                each.id, each.epoch, each.stamp_ns, each.status, each.odom_T_body, each.covariance, each.previous_id,
                each.previous_T_body, each.relative_covariance, each.landmarks,
                self._frameset_at(each.stamp_ns).images,
            )  # fmt: skip

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """Accept every correction and store it."""
        self.corrections.append((keyframe_id, map_T_body, covariance))
        map_T_odom = map_T_body @ se3_inverse(self._keyframes[keyframe_id].odom_T_body)
        return CorrectionResult(True, "", None, chi_square_quantile(0.999, 6), map_T_odom)


def _with_drift(
    stamps_ns: Sequence[int], world_T_body: Float, sigmas: tuple[float, float], seed: int, breaks: Collection[int]
) -> list[Keyframe]:
    rng = np.random.default_rng([seed, 11])
    made: list[Keyframe] = []
    epoch = 0
    for k, stamp_ns in enumerate(stamps_ns):
        motion, relative, previous = None, None, None
        pose, covariance = np.eye(4), np.diag(_FIRST_SIGMAS**2)
        if k in breaks:
            epoch += 1
        elif made:
            true = se3_inverse(world_T_body[k - 1]) @ world_T_body[k]
            steps = np.sqrt(max(float(np.linalg.norm(true[:3, 3])), _MIN_STEP_M)) * np.repeat(sigmas, 3)
            previous, motion, relative = k - 1, true @ se3_exp(steps * rng.standard_normal(6)), np.diag(steps**2)
            pose, covariance = composed(made[-1].odom_T_body, made[-1].covariance, motion, relative)
        else:
            pose = world_T_body[0]
        made.append(
            Keyframe(
                k, epoch, int(stamp_ns), Status.TRACKING, pose, covariance, previous, motion, relative, Landmarks.none()
            )
        )
    return made
