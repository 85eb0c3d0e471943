"""Detection of a standstill from the places of points in the images."""

from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.tracking.standstill import Standstill

PERIOD_NS = 50_000_000
PLACES = np.random.default_rng(0).uniform(0.0, 400.0, (60, 2))


def detected(shifts_px: Float, noise_px: float = 0.05, explained: int = 60) -> list[bool]:
    """Detections on frames whose points have moved by so much (K,) along x."""
    standstill, rng, detections = Standstill(), np.random.default_rng(1), []
    for k, shift in enumerate(shifts_px):
        pixels = PLACES + [shift, 0.0] + noise_px * rng.standard_normal((60, 2))
        pixels[explained:] += 40.0 * k  # somebody walks by, whom the rig's motion does not explain
        frame = replace(TrackedFrame.empty(k * PERIOD_NS), ids=np.arange(60), pixels=pixels)
        detections.append(standstill.update({0: frame}, {0: np.arange(explained)}))
    return detections


def test_standstill_is_detected_after_a_quarter_of_a_second() -> None:
    assert detected(np.zeros(12)) == [False] * 5 + [True] * 7
    assert detected(np.zeros(12), explained=40) == [False] * 5 + [True] * 7


def test_standstill_with_slow_motion_is_not_detected() -> None:
    assert not any(detected(np.linspace(0.0, 4.7, 60)))


def test_standstill_ends_at_once_and_is_detected_again() -> None:
    detections = detected(np.concatenate([np.zeros(10), np.arange(1.0, 6.0), np.full(10, 5.0)]))
    assert detections[5:10] == [True] * 5
    assert not any(detections[10:19])
    assert all(detections[20:])


def test_standstill_with_few_points_is_not_detected() -> None:
    assert not any(detected(np.zeros(12), explained=20))
    assert not Standstill().update({}, {})
