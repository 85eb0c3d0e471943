"""Landmarks of a keyframe: tracked corners as points in body, with ORB or SIFT descriptors by OpenCV."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Float, Image, Int
from graphvio.frontend.depth.tracks import TrackedFrame, common_rows
from graphvio.kernels import kernel
from graphvio.measurements.motion import LocatedPoints
from graphvio.odometry.step import NewKeyframe
from graphvio.rig import Rig, StereoPair
from graphvio.slam.keyframe import Landmarks

Describe = Callable[[Image, Float], AnyArray]
"""Computes the descriptors (N, D), uint8, of an image at pixels (N, 2)."""

_MIN_DEPTH_SIGMAS = 3.0  # a more uncertain inverse depth has no meaningful covariance in metres
_RADIUS = 15  # radius of ORB's patch, pixels
_BORDER_PX = 40  # border added to images, so that no corner is too near to the edge
_SIFT_SIZE_PX = 7.0
_NOWHERE = LocatedPoints(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


def landmarks_of(rig: Rig, keyframe: NewKeyframe, pixel_sigma_px: float, describe: Describe | None) -> Landmarks:
    """Return landmarks of the tracks whose inverse depth exceeds three standard deviations.

    In a rig without pairs, landmarks are instead the points that the state of single cameras has located.

    Args:
        rig: The rig, with the calibration that is in force.
        keyframe: Tracks and images.
        pixel_sigma_px: Standard deviation of a tracked corner in one image.
        describe: Computes descriptors in a left image, or None for no descriptors.
    """
    located, parts = keyframe.located_points() if not rig.pairs else {}, []
    for j, frame in sorted(keyframe.frames.items()):
        if rig.pairs:
            frame, points, covariances = _located(frame, keyframe.body_T_left[j], pixel_sigma_px)
        else:
            _, points, covariances = of_state = located.get(j, _NOWHERE)
            in_frame, in_state = common_rows(frame.ids, of_state.ids)
            frame, points, covariances = _rows(frame, in_frame), points[in_state], covariances[in_state]
        group, n = rig.groups[j], len(frame.ids)
        right_px = np.full((n, 2), np.nan)
        if isinstance(group, StereoPair):
            right_px, _ = group.right.project(np.column_stack([frame.right_rays, np.ones(n)]))
        image = keyframe.images[j][0]
        descriptors = np.zeros((n, 0), dtype=np.uint8) if describe is None else describe(image, frame.pixels)
        which = np.full(n, j, dtype=np.int64)
        parts.append((which, frame.ids, points, covariances, frame.pixels_at_stamp, right_px, descriptors))
    if not parts:
        return Landmarks.none()
    return Landmarks(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _located(frame: TrackedFrame, body_T_left: Float, pixel_sigma_px: float) -> tuple[TrackedFrame, Float, Float]:
    """Return the tracks of known depth, and the front-end's points (N, 3) in body with covariances (N, 3, 3)."""
    sigma_w = pixel_sigma_px * np.sqrt(frame.covariances[:, 2, 2])
    frame = frame.keep(frame.has_depth & (frame.points[:, 2] > _MIN_DEPTH_SIGMAS * sigma_w))
    n = len(frame.ids)
    x, y, w = frame.points.T
    in_left = np.column_stack([x, y, np.ones(n)]) / w[:, None]
    by_point = np.zeros((n, 3, 3))  # derivative of the point with respect to [x, y, 1/Z]
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / w
    by_point[:, :, 2] = -in_left / w[:, None]
    turned = body_T_left[:3, :3] @ by_point
    covariances = turned @ (pixel_sigma_px**2 * frame.covariances) @ turned.transpose(0, 2, 1)
    return frame, in_left @ body_T_left[:3, :3].T + body_T_left[:3, 3], covariances


def _rows(frame: TrackedFrame, rows: Int) -> TrackedFrame:
    chosen = np.zeros(len(frame.ids), dtype=bool)
    chosen[rows] = True
    return frame.keep(chosen)


def describer(kind: Literal["orb", "sift", "none"]) -> Describe | None:
    """Return the function that computes descriptors of a kind, or None for no descriptors."""
    if kind == "none":
        return None
    if kind == "orb":
        orb = cv2.ORB.create(nlevels=1, edgeThreshold=_BORDER_PX - 1)
        return lambda image, pixels: _described(orb, 32, 2.0 * _RADIUS + 1.0, image, pixels)
    sift = cv2.SIFT.create(0, 3, 0.04, 10.0, 1.6, cv2.CV_8U)
    return lambda image, pixels: _described(sift, 128, _SIFT_SIZE_PX, image, pixels)


def _described(extractor: cv2.Feature2D, width: int, size_px: float, image: Image, pixels: Float) -> AnyArray:
    made = np.zeros((len(pixels), width), dtype=np.uint8)
    if not len(pixels):
        return made
    angles = np.rad2deg(orientations(np.ascontiguousarray(image), np.ascontiguousarray(pixels)))
    padded = cv2.copyMakeBorder(image, *(_BORDER_PX,) * 4, cv2.BORDER_REFLECT_101)
    keypoints = [
        cv2.KeyPoint(float(x) + _BORDER_PX, float(y) + _BORDER_PX, size_px, float(angle % 360.0), class_id=k)
        for k, ((x, y), angle) in enumerate(zip(pixels, angles, strict=True))
    ]
    kept, rows = extractor.compute(padded, keypoints)
    made[[keypoint.class_id for keypoint in kept]] = rows
    return made


@kernel
def orientations(image: Image, pixels: Float) -> Float:
    """Return the orientations (N,), radians, of the patches at pixels (N, 2): towards their intensity centroids.

    Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV 2011, section 3.2.
    """
    height, width = image.shape
    angles = np.empty(len(pixels))
    for i in range(len(pixels)):
        x0, y0 = int(np.rint(pixels[i, 0])), int(np.rint(pixels[i, 1]))
        along, down = 0.0, 0.0
        for v in range(-_RADIUS, _RADIUS + 1):
            y = min(max(y0 + v, 0), height - 1)
            for u in range(-_RADIUS, _RADIUS + 1):
                if u * u + v * v <= _RADIUS * _RADIUS:
                    grey = float(image[y, min(max(x0 + u, 0), width - 1)])
                    along += u * grey
                    down += v * grey
        angles[i] = np.arctan2(down, along)
    return angles
