"""What the pairs see at a keyframe, as points in body."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphvio.arrays import AnyArray, Float, Image
from graphvio.frontend.tracks import PairFrame
from graphvio.rig import Rig, StereoPair
from graphvio.slam.descriptors import Describe
from graphvio.slam.keyframe import Landmarks

_LEAST_DEPTH_SIGMAS = 3.0  # farther away a depth has no covariance in metres


def landmarks_of(
    rig: Rig,
    body_T_left: Float,
    frames: Mapping[int, PairFrame],
    images: Mapping[int, tuple[Image, Image]],
    pixel_sigma_px: float,
    describe: Describe | None,
) -> Landmarks:
    """The tracks whose depth is known to a third at least.

    Args:
        rig: of the pairs.
        body_T_left: (P, 4, 4) of the pairs' left cameras, with the corrections that are in force.
        frames: pair -> its tracks.
        images: pair -> (left, right).
        pixel_sigma_px: of a tracked corner, in one image.
        describe: makes descriptors of a left image's pixels, or None for none.
    """
    parts = [
        _of_pair(j, rig.pairs[j], body_T_left[j], frame, images[j][0], pixel_sigma_px, describe)
        for j, frame in sorted(frames.items())
    ]
    if not parts:
        return Landmarks.none()
    return Landmarks(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _of_pair(
    j: int,
    pair: StereoPair,
    body_T_left: Float,
    frame: PairFrame,
    left: Image,
    pixel_sigma_px: float,
    describe: Describe | None,
) -> tuple[AnyArray, ...]:
    sigma_w = pixel_sigma_px * np.sqrt(frame.covariances[:, 2, 2])
    frame = frame.keep(frame.has_depth & (frame.points[:, 2] > _LEAST_DEPTH_SIGMAS * sigma_w))
    n = len(frame.ids)
    x, y, w = frame.points.T
    in_left = np.column_stack([x, y, np.ones(n)]) / w[:, None]
    by_point = np.zeros((n, 3, 3))  # derivative of the point by [x, y, 1/Z]
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / w
    by_point[:, :, 2] = -in_left / w[:, None]
    turned = body_T_left[:3, :3] @ by_point
    covariances = turned @ (pixel_sigma_px**2 * frame.covariances) @ turned.transpose(0, 2, 1)
    right_px, _ = pair.right.project(np.column_stack([frame.right, np.ones(n)]))
    descriptors = np.zeros((n, 0), dtype=np.uint8) if describe is None else describe(left, frame.pixels)
    return (
        np.full(n, j, dtype=np.int64),
        frame.ids,
        in_left @ body_T_left[:3, :3].T + body_T_left[:3, 3],
        covariances,
        frame.pixels,
        right_px,
        descriptors,
    )
