"""Reflectance maps of outdoor surfaces: facades, roofs, roads, plants, hills and sky."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from graphvio.simulation.noise import SIDE, Map, Rng, noise


def _of_noise(mean: float, deviation: float, coarsest: int, octaves: int, gain: float) -> Callable[[Rng], Map]:
    """Return a painter of noise with a mean and a standard deviation; see `noise` for the other arguments."""

    def paint(rng: Rng) -> Map:
        return np.asarray(mean + deviation * noise(rng, coarsest, octaves, gain), dtype=np.float32)

    return paint


def _facade(wall: float, width: int, height: int) -> Callable[[Rng], Map]:
    """Return a painter of four storeys with eight windows each, of the given size in texels."""

    def paint(rng: Rng) -> Map:
        image = wall + 0.05 * noise(rng, 16, 6)
        for x in range((64 - width) // 2, SIDE, 64):
            for y in range((128 - height) // 2, SIDE, 128):
                corner = (x + width, y + height)
                cv2.rectangle(image, (x, y), corner, float(rng.choice([0.1, 0.2, 0.65])), -1)
                cv2.rectangle(image, (x, y), corner, 0.75, 3)
                cv2.line(image, (x, y + height // 3), (x + width, y + height // 3), 0.75, 2)
        return np.asarray(image, dtype=np.float32)

    return paint


def _roof(rng: Rng) -> Map:
    rows = np.sin(np.mgrid[0:SIDE, 0:SIDE][0] * (2 * np.pi * 24 / SIDE))
    return np.asarray(0.32 + 0.06 * rows + 0.03 * noise(rng, 8, 6, 0.8), dtype=np.float32)


def _car(rng: Rng) -> Map:
    """Paint one side of a car, with windows above and wheels below; it is scaled to the face of a box."""
    image = np.asarray(0.45 + 0.03 * noise(rng, 4, 4), dtype=np.float32)
    for x0, x1 in ((40, 150), (170, 330), (350, 460)):
        cv2.rectangle(image, (x0, 30), (x1, 200), float(rng.uniform(0.05, 0.2)), -1)
    for x in (160, 340):
        cv2.line(image, (x, 20), (x, 400), 0.2, 4)
    cv2.rectangle(image, (0, 400), (SIDE, SIDE), 0.08, -1)
    for x in (110, 400):
        cv2.ellipse(image, (x, 410), (56, 90), 0, 0, 360, 0.05, -1)
        cv2.ellipse(image, (x, 410), (26, 44), 0, 0, 360, 0.6, -1)
    return image


OUTDOOR_PAINTERS: dict[str, tuple[Callable[[Rng], Map], float]] = {
    "facade0": (_facade(0.5, 34, 70), 16.0),
    "facade1": (_facade(0.35, 46, 54), 14.0),
    "roof": (_roof, 8.0),
    "car": (_car, 4.0),
    "asphalt": (_of_noise(0.3, 0.035, 32, 5, 0.9), 8.0),
    "grass": (_of_noise(0.42, 0.08, 16, 6, 0.9), 40.0),
    "field": (_of_noise(0.45, 0.08, 8, 7, 0.85), 60.0),
    "soil": (_of_noise(0.3, 0.08, 16, 6, 0.9), 30.0),
    "leaves": (_of_noise(0.24, 0.11, 16, 6, 0.9), 6.0),
    "hills": (_of_noise(0.4, 0.12, 4, 7, 0.75), 200.0),
    "sky": (_of_noise(0.8, 0.03, 4, 3, 0.5), 400.0),
}
"""Name -> function that paints the texture, and metres that one repetition covers."""
