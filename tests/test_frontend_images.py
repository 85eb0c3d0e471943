"""What the kernels may trust of an image."""

import numpy as np
import pytest
from synthetic import two_pair_rig

from graphvio.arrays import AnyArray
from graphvio.errors import RigError
from graphvio.frontend.imaging.images import checked
from graphvio.measurements.sensors import FrameSet

RIG = two_pair_rig()
IMAGE = np.zeros((480, 640), dtype=np.uint8)


@pytest.mark.parametrize(
    "wrong", [IMAGE[:-1], IMAGE.T, IMAGE.astype(np.float64), np.zeros((480, 640, 3), dtype=np.uint8)]
)
def test_images_must_fit_the_rig(wrong: AnyArray) -> None:
    for pair, images in ((0, (IMAGE, wrong)), (1, (wrong, IMAGE))):
        name = (RIG.pairs[0].right, RIG.pairs[1].left)[pair].name
        with pytest.raises(RigError, match=f"{name}: image has shape"):
            checked(FrameSet(0, {0: (IMAGE, IMAGE), pair: images}), RIG)


def test_images_of_a_buffer_are_made_writable() -> None:
    """Kernels are compiled for one type of array, and to numba one that is only to be read is another."""
    read_only = np.frombuffer(IMAGE.tobytes(), dtype=np.uint8).reshape(480, 640)
    for image in checked(FrameSet(7, {0: (read_only, IMAGE)}), RIG).images[0]:
        assert image.flags.writeable
        np.testing.assert_array_equal(image, IMAGE)


def test_images_are_made_contiguous() -> None:
    wide = np.arange(480 * 1280, dtype=np.uint32).astype(np.uint8).reshape(480, 1280)
    left, right = wide[:, :640], wide[:, 640:]
    images = checked(FrameSet(7, {1: (left, right)}), RIG).images
    assert set(images) == {1}
    for image, before in zip(images[1], (left, right), strict=True):
        assert image.flags.c_contiguous
        np.testing.assert_array_equal(image, before)
