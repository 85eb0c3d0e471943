"""Descriptors of tracked corners, by OpenCV; which way each is turned, by the centroid of its patch's grey levels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Float, Image
from graphvio.kernels import kernel

Describe = Callable[[Image, Float], AnyArray]
"""Takes an image and pixels (N, 2), and gives descriptors (N, D) uint8."""

_RADIUS = 15  # of the patch that ORB compares
_BORDER_PX = 40  # so that no corner is too near to the edge of the image
_SIFT_SIZE_PX = 7.0


def describer(kind: Literal["orb", "sift", "none"]) -> Describe | None:
    """What makes descriptors of a kind."""
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
    """Angles (N,), radians, from pixels (N, 2) to the centroids of the grey levels around them.

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
