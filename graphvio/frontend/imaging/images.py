"""Checks of images, which the kernels rely on, and their masks."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Bool, Image
from graphvio.errors import RigError
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Camera, Rig


def checked(frameset: FrameSet, rig: Rig) -> FrameSet:
    """Check the images and masks of a frameset, and return it with contiguous images.

    Raises:
        RigError: if an image or its mask is not of the type and size that the rig says, or a group has another number
            of them than of cameras.
    """
    checked_images, masks = {}, {}
    for j, images in frameset.images.items():
        cameras = rig.groups[j].cameras
        if len(images) != len(cameras):
            raise RigError(f"{rig.groups[j].name}: has {len(images)} images; the rig says {len(cameras)}")
        checked_images[j] = tuple(_checked(image, camera) for image, camera in zip(images, cameras, strict=True))
        given = frameset.masks.get(j)
        if given is not None:
            if len(given) != len(cameras):
                raise RigError(
                    f"{rig.groups[j].name}: has {len(given)} masks; give one for each of its images, or None"
                )
            masks[j] = tuple(_checked_mask(mask, camera) for mask, camera in zip(given, cameras, strict=True))
    return FrameSet(frameset.stamp_ns, checked_images, masks)


def _checked(image: Image, camera: Camera) -> Image:
    width, height = camera.size_px
    if image.dtype != np.uint8 or image.shape != (height, width):
        raise RigError(
            f"camera {camera.name}: image has shape {image.shape} and type {image.dtype}; the rig says grey, "
            f"({height}, {width}), uint8"
        )
    return np.require(image, requirements=("C", "W"))  # kernels are compiled for one type of array


def _checked_mask(mask: AnyArray | None, camera: Camera) -> Image | None:
    """Return a mask as an image whose zeros are not used."""
    if mask is None:
        return None
    mask, (width, height) = np.asarray(mask), camera.size_px
    if mask.shape != (height, width):
        raise RigError(
            f"camera {camera.name}: the mask of an image has shape {mask.shape}; it must be ({height}, {width}), the "
            "size of the camera's images: make it of images of that size"
        )
    return np.asarray(mask != 0, dtype=np.uint8)


def pixels_with_ray(camera: Camera) -> Bool:
    """Return which pixels (height, width) have a ray: not those beyond the domain of the lens model.

    With most lenses, all pixels have one; it is then enough to check the pixels at the image's edge.
    """
    width, height = camera.size_px
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    at_edge = (x == 0) | (y == 0) | (x == width - 1) | (y == height - 1)
    if camera.unproject(np.column_stack([x[at_edge], y[at_edge]]))[1].all():
        return np.ones((height, width), dtype=bool)
    return camera.unproject(np.column_stack([x.ravel(), y.ravel()]))[1].reshape(height, width)


ImageMask = Callable[[str, Image], AnyArray | None]
"""Takes a camera's name and its image (height, width), and returns a mask (height, width), whose zeros (or False) are
not used, or None to use all of the image. It is called from several threads."""


class UsablePixels:
    """Pixels at which points of a camera may be: where all pixels of their patch have a ray, and none is masked.

    Args:
        camera: the camera, with a mask that is the same for all images, or without.
        window_px: side of the patches.
        image_mask: function that makes a mask for each image, or None.

    Attributes:
        always: (height, width) where points may be by the camera's lens and its own mask.

    Raises:
        RigError: if the camera's mask is no image of its size.
    """

    def __init__(self, camera: Camera, window_px: int, image_mask: ImageMask | None = None) -> None:
        self._camera = camera
        self._reach = 2 * (window_px // 2 + 1) + 1  # a patch at any sub-pixel place
        self._image_mask = image_mask
        width, height = camera.size_px
        self.always = np.ones((height, width), dtype=bool)
        if camera.mask is not None:
            mask = cv2.imread(str(camera.mask), cv2.IMREAD_GRAYSCALE)
            if mask is None or mask.shape != (height, width):
                is_ = "no image" if mask is None else f"{mask.shape[1]}x{mask.shape[0]} pixels large"
                raise RigError(
                    f"camera {camera.name}: mask {camera.mask} is {is_}; give an image of {width}x{height} pixels, the "
                    "camera's size, or remove the mask from the rig"
                )
            self.always = self._shrunk(mask)
        has_ray = pixels_with_ray(camera)
        if not has_ray.all():
            self.always &= self._shrunk(has_ray.astype(np.uint8))

    def of(self, image: Image, mask: Image | None = None) -> Bool:
        """Return where (height, width) points of an image may be.

        Args:
            image: (height, width) the image.
            mask: (height, width) mask that came with it, whose zeros are not used, or None.

        Raises:
            RigError: if the mask that the function makes has another size.
        """
        made = None if self._image_mask is None else self._image_mask(self._camera.name, image)
        masks = [each for each in (mask, _checked_mask(made, self._camera)) if each is not None]
        return np.logical_and.reduce([self.always, *map(self._shrunk, masks)]) if masks else self.always

    def _shrunk(self, mask: AnyArray) -> Bool:
        kernel = np.ones((self._reach, self._reach), dtype=np.uint8)
        return np.asarray(cv2.erode(mask, kernel, borderValue=(255,)) > 0)
