"""Checks of images, which the kernels rely on."""

from __future__ import annotations

import cv2
import numpy as np

from graphvio.arrays import Bool, Image
from graphvio.errors import RigError
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Camera, Rig


def checked(frameset: FrameSet, rig: Rig) -> FrameSet:
    """Return the frameset with contiguous images.

    Raises:
        RigError: if an image is not of the type and size that the rig says, or a group has another number of images.
    """
    checked_images = {}
    for j, images in frameset.images.items():
        cameras = rig.groups[j].cameras
        if len(images) != len(cameras):
            raise RigError(f"{rig.groups[j].name}: has {len(images)} images; the rig says {len(cameras)}")
        checked_images[j] = tuple(_checked(image, camera) for image, camera in zip(images, cameras, strict=True))
    return FrameSet(frameset.stamp_ns, checked_images)


def _checked(image: Image, camera: Camera) -> Image:
    width, height = camera.size_px
    if image.dtype != np.uint8 or image.shape != (height, width):
        raise RigError(
            f"camera {camera.name}: image has shape {image.shape} and type {image.dtype}; the rig says grey, "
            f"({height}, {width}), uint8"
        )
    return np.ascontiguousarray(image)


def allowed_pixels(camera: Camera, window_px: int) -> Bool:
    """Return where (height, width) points of an image may be: where no pixel of their patch is masked.

    Raises:
        RigError: if the camera's mask is no image of its size.
    """
    width, height = camera.size_px
    if camera.mask is None:
        return np.ones((height, width), dtype=bool)
    mask = cv2.imread(str(camera.mask), cv2.IMREAD_GRAYSCALE)
    if mask is None or mask.shape != (height, width):
        raise RigError(f"camera {camera.name}: mask {camera.mask} is no image of {width}x{height} pixels")
    reach = 2 * (window_px // 2 + 1) + 1  # a patch at any sub-pixel place
    return np.asarray(cv2.erode(mask, np.ones((reach, reach), dtype=np.uint8), borderValue=(255,)) > 0)
