"""Images as the kernels trust them to be."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Image
from graphvio.errors import RigError
from graphvio.events import FrameSet
from graphvio.rig import Camera, Rig


def checked(frameset: FrameSet, rig: Rig) -> FrameSet:
    """The frameset with contiguous images.

    Raises:
        RigError: if an image is not of the type and size that the rig says.
    """
    images = {
        j: (_checked(left, rig.pairs[j].left), _checked(right, rig.pairs[j].right))
        for j, (left, right) in frameset.images.items()
    }
    return FrameSet(frameset.stamp_ns, images)


def _checked(image: Image, camera: Camera) -> Image:
    width, height = camera.size_px
    if image.dtype != np.uint8 or image.shape != (height, width):
        raise RigError(
            f"camera {camera.name}: image has shape {image.shape} and type {image.dtype}; the rig says grey, "
            f"({height}, {width}), uint8"
        )
    return np.ascontiguousarray(image)
