"""Front-end of single cameras: keyframes where images fail for a while."""

from dataclasses import replace

import cv2
import numpy as np

from graphvio.arrays import Image
from graphvio.config import Config
from graphvio.frontend.singles import SinglesFrontend
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.measurements.sensors import FrameSet
from graphvio.simulation.named_rigs import stereo_and_back

WIDTH, HEIGHT, SHIFT_PX = 640, 480, 3


def textured(k: int) -> Image:
    """A texture that moves by some pixels from image to image."""
    rng = np.random.default_rng(1)
    noise = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (HEIGHT, 2 * WIDTH)).astype(np.float32), (0, 0), 2.0)
    image = np.clip(128.0 + 6.0 * (noise - noise.mean()), 0.0, 255.0).astype(np.uint8)
    return np.ascontiguousarray(image[:, SHIFT_PX * k : SHIFT_PX * k + WIDTH])


def test_tracks_after_the_dark_are_those_of_a_new_keyframe() -> None:
    rig = stereo_and_back()
    alone = replace(rig, pairs=())
    frontend = SinglesFrontend(alone, Config())
    dark, results = np.zeros((HEIGHT, WIDTH), dtype=np.uint8), list[VisualResult]()
    for k in range(20):
        image = dark + np.uint8(k % 2) if 6 <= k < 12 else textured(k)  # an image that repeats would be a frozen one
        results.append(frontend.process(FrameSet(k * 50_000_000, {0: (image,)}), lambda _: None))
    frontend.close()
    assert all(result.quality is Quality.FAILED for result in results[7:12])
    assert all(result.quality is Quality.GOOD for result in results[14:])
    assert min(frontend.reference_stamps_ns) >= 12 * 50_000_000
