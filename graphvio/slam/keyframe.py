"""What a SLAM system gets from the odometry, and what it is told of its corrections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from graphvio.arrays import AnyArray, Float, Image, Int
from graphvio.measurements.estimate import Status


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """N points that the pairs see at a keyframe.

    Attributes:
        pair: (N,) index of the pair that sees each.
        track_id: (N,) identity within the pair: the same in every keyframe in which the corner is still followed.
        points_body: (N, 3) metres, in body at the keyframe.
        covariances: (N, 3, 3) m^2 of ``points_body``.
        left_px: (N, 2) pixels in the pair's left image.
        right_px: (N, 2) pixels in its right image.
        descriptors: (N, D) uint8 of the left image: ORB has D = 32, SIFT 128, and 0 is none.
    """

    pair: Int
    track_id: Int
    points_body: Float
    covariances: Float
    left_px: Float
    right_px: Float
    descriptors: AnyArray

    def __len__(self) -> int:
        return len(self.pair)

    @staticmethod
    def none() -> Landmarks:
        """No points."""
        whole, pixels = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        return Landmarks(
            whole, whole, np.zeros((0, 3)), np.zeros((0, 3, 3)), pixels, pixels, np.zeros((0, 0), dtype=np.uint8)
        )


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frameset that later motions are measured from, with what was seen there.

    Attributes:
        id: counts the keyframes of an odometry, over all epochs.
        epoch: poses of different epochs do not share an odom frame.
        stamp_ns: of the frameset.
        status: what the pose rests on.
        odom_T_body: (4, 4) causal pose in the epoch's odom frame, as the estimate of this frameset has it.
        covariance: (6, 6) of ``odom_T_body``, tangent ``[rotation, translation]`` in body.
        previous_id: the keyframe before this one in the epoch, or None for the first one.
        previous_T_body: (4, 4) of body there to body here, as known now: the smoother may have corrected the keyframe
            before since it came. None for the first one.
        relative_covariance: (6, 6) of ``previous_T_body``, tangent in body here, or None.
        landmarks: of all pairs that are in the frameset.
        images: pair index -> (left, right) uint8; empty unless they are asked for.
    """

    id: int
    epoch: int
    stamp_ns: int
    status: Status
    odom_T_body: Float
    covariance: Float
    previous_id: int | None
    previous_T_body: Float | None
    relative_covariance: Float | None
    landmarks: Landmarks
    images: Mapping[int, tuple[Image, Image]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionResult:
    """What became of a correction.

    Attributes:
        accepted: whether ``map_T_odom`` took it in.
        reason: why not, or empty.
        statistic: squared Mahalanobis distance from what was expected, 6 degrees of freedom; None where nothing was.
        threshold: the gate's.
        map_T_odom: (4, 4) in force afterwards, or None.
    """

    accepted: bool
    reason: str
    statistic: float | None
    threshold: float
    map_T_odom: Float | None
