"""Keyframes with their landmarks, and results of corrections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from graphvio.arrays import AnyArray, Float, Image, Int
from graphvio.measurements.estimate import Status
from graphvio.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """N points that stereo pairs and single cameras see at a keyframe.

    Attributes:
        pair: (N,) index in `graphvio.rig.Rig.groups` of the pair, or single camera, that sees each point.
        track_id: (N,) identity within that pair or camera: the same in all keyframes in which the corner is tracked.
        points_body: (N, 3) points in metres, in body at the keyframe.
        covariances: (N, 3, 3) covariances of ``points_body``, m^2.
        left_px: (N, 2) pixels in the pair's left image, or the single camera's image.
        right_px: (N, 2) pixels in the pair's right image; NaN for a single camera.
        descriptors: (N, D) uint8, of the left image; D is 32 for ORB, 128 for SIFT, 0 without descriptors.
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
        """Return zero landmarks."""
        whole, pixels = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        return Landmarks(
            whole, whole, np.zeros((0, 3)), np.zeros((0, 3, 3)), pixels, pixels, np.zeros((0, 0), dtype=np.uint8)
        )


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frameset from which later motions are measured, with its landmarks.

    Attributes:
        id: Number of the keyframe in its run, over all epochs.
        epoch: Its epoch; poses of different epochs do not share an odom frame.
        stamp_ns: Stamp of the frameset.
        status: What the pose is based on.
        odom_T_body: (4, 4) causal pose in the epoch's odom frame, as in this frameset's estimate.
        covariance: (6, 6) covariance of ``odom_T_body``, tangent ``[rotation, translation]`` in body.
        previous_id: Id of the previous keyframe in the epoch, or None for the first one.
        previous_T_body: (4, 4) motion of body since the previous keyframe, as estimated now: the smoother may have
            corrected the previous keyframe since it was reported. None for the first one.
        relative_covariance: (6, 6) covariance of ``previous_T_body``, tangent in body at this keyframe, or None.
        landmarks: Landmarks of all pairs and single cameras in the frameset.
        images: Index in `graphvio.rig.Rig.groups` -> (left, right) of a pair or (image,) of a single camera, uint8;
            empty unless requested.
        calibrated_rig: The rig with the self-calibration's estimate at the keyframe, which landmarks and body refer to;
            None while the front-end's own, that of the rig file, is in force. Where it differs from that of the
            previous keyframe, ``previous_T_body`` leads from body of the previous calibration to body of this one.
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
    images: Mapping[int, tuple[Image, ...]] = field(default_factory=dict)
    calibrated_rig: Rig | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionResult:
    """The outcome of a correction.

    Attributes:
        accepted: Whether ``map_T_odom`` was updated by the correction.
        reason: Why it was refused, or that the map moved; otherwise empty.
        statistic: Squared Mahalanobis distance from the expected correction, 6 degrees of freedom; None without one.
        threshold: Threshold of the innovation test.
        map_T_odom: (4, 4) ``map_T_odom`` in force afterwards, or None.
    """

    accepted: bool
    reason: str
    statistic: float | None
    threshold: float
    map_T_odom: Float | None
