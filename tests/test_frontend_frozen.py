"""Images that are delivered twice."""

import numpy as np

from graphvio.arrays import Image
from graphvio.frontend.imaging.frozen import FrozenImages
from graphvio.measurements.sensors import FrameSet

RNG = np.random.default_rng(0)


def image() -> Image:
    return RNG.integers(0, 256, (48, 64), dtype=np.uint8)


def frameset(stamp_ns: int, **images: tuple[Image, Image]) -> FrameSet:
    return FrameSet(stamp_ns, {int(name[1:]): pair for name, pair in images.items()})


def test_new_images_are_no_matter() -> None:
    frozen = FrozenImages()
    for k in range(3):
        gate_result = frozen.update(frameset(k, p0=(image(), image()), p1=(image(), image())))
        assert gate_result.pairs == frozenset()
        assert gate_result.all_since_ns is None
        assert gate_result.reason == ""


def test_a_stuck_pair_is_named_while_another_lives() -> None:
    frozen = FrozenImages()
    stuck = (image(), image())
    frozen.update(frameset(0, p0=(image(), image()), p1=stuck))
    for k in range(1, 4):
        copies = (stuck[0].copy(), stuck[1].copy())
        gate_result = frozen.update(frameset(k, p0=(image(), image()), p1=copies))
        assert gate_result.pairs == {1}
        assert "[1]" in gate_result.reason
    assert frozen.update(frameset(4, p0=(image(), image()), p1=(image(), image()))).pairs == frozenset()


def test_one_stuck_camera_takes_its_pair_along() -> None:
    frozen = FrozenImages()
    left = image()
    frozen.update(frameset(0, p0=(left, image())))
    assert frozen.update(frameset(1, p0=(left, image()))).pairs == {0}


def test_when_all_repeat_no_camera_is_accused() -> None:
    frozen = FrozenImages()
    first, second = (image(), image()), (image(), image())
    frozen.update(frameset(10, p0=first, p1=second))
    for k in (11, 12):
        gate_result = frozen.update(frameset(k, p0=first, p1=second))
        assert gate_result.pairs == frozenset()
        assert gate_result.all_since_ns == 10
