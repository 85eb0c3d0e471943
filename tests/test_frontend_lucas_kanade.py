"""Lucas-Kanade against shifts that are known, and against OpenCV's."""

import cv2
import numpy as np
import pytest

from graphvio.arrays import Float, Image
from graphvio.frontend.lucas_kanade import build_pyramid, track

LEVELS = 4


def texture(shift: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> Image:
    """Smooth random texture whose content is moved by (x, y) pixels, exactly: a sum of waves."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:240, :320].astype(np.float64)
    image = np.zeros_like(x)
    for _ in range(80):
        kx, ky = rng.normal(0.0, 0.25, 2)
        image += np.cos(kx * (x - shift[0]) + ky * (y - shift[1]) + rng.uniform(0.0, 2.0 * np.pi))
    return np.asarray(np.clip(np.round(128.0 + 12.0 * image), 0, 255), dtype=np.uint8)


def grid() -> Float:
    x, y = np.meshgrid(np.arange(50.0, 271.0, 20.0), np.arange(50.0, 191.0, 20.0))
    return np.column_stack([x.ravel(), y.ravel()]) + 0.3


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, -0.21), (6.5, 3.25), (-14.2, 9.9)])
def test_a_known_shift_is_found(shift: tuple[float, float]) -> None:
    source, target = build_pyramid(texture(), LEVELS), build_pyramid(texture(shift), LEVELS)
    moved, found = track(source, target, grid(), grid(), window_px=15, levels=LEVELS, max_return_px=0.5)
    assert found.mean() > 0.85  # the rest sees the edge
    error = np.linalg.norm(moved - grid() - shift, axis=1)[found]
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.95) < 0.1


@pytest.mark.parametrize(("gain", "offset", "within_px"), [(1.0, -20.0, 0.03), (0.9, -10.0, 0.12)])
def test_a_change_of_exposure_hardly_moves_a_point(gain: float, offset: float, within_px: float) -> None:
    darker = (texture((1.3, 0.6)) * gain + offset).clip(0, 255).astype(np.uint8)
    source, target = build_pyramid(texture(), LEVELS), build_pyramid(darker, LEVELS)
    moved, found = track(source, target, grid(), grid(), window_px=15, levels=LEVELS, max_return_px=0.5)
    assert found.mean() > 0.9
    assert np.median(np.linalg.norm(moved - grid() - (1.3, 0.6), axis=1)[found]) < within_px


def test_it_agrees_with_opencv() -> None:
    first, second = texture(), texture((4.2, -2.7))
    ours, found = track(
        build_pyramid(first, LEVELS), build_pyramid(second, LEVELS), grid(), grid(),
        window_px=15, levels=LEVELS, max_return_px=0.5,
    )  # fmt: skip
    points = grid().astype(np.float32)
    theirs, status, _ = cv2.calcOpticalFlowPyrLK(
        first, second, points, points.copy(), winSize=(15, 15), maxLevel=LEVELS - 1
    )
    both = found & (status.ravel() == 1)
    assert both.mean() > 0.95
    assert np.median(np.linalg.norm(ours - theirs, axis=1)[both]) < 0.02


def test_what_cannot_be_localised_is_not_found() -> None:
    flat = np.full((240, 320), 120, dtype=np.uint8)
    edge = flat.copy()
    edge[:, 160:] = 200
    for image in (flat, edge):
        pyramid = build_pyramid(image, LEVELS)
        points = np.array([[160.0, 120.0], [100.0, 60.0]])
        _, found = track(pyramid, pyramid, points, points, window_px=15, levels=LEVELS, max_return_px=0.5)
        assert not found.any()


def test_points_at_the_edge_and_no_points() -> None:
    pyramid = build_pyramid(texture(), LEVELS)
    edge = np.array([[2.0, 2.0], [318.0, 100.0], [-5.0, 20.0], [1e6, 1e6]])
    _, found = track(pyramid, pyramid, edge, edge, window_px=15, levels=LEVELS, max_return_px=0.5)
    assert not found.any()
    none = np.zeros((0, 2))
    moved, found = track(pyramid, pyramid, none, none, window_px=15, levels=LEVELS, max_return_px=0.5)
    assert moved.shape == (0, 2)
    assert found.shape == (0,)


def test_another_scene_fails_the_way_back() -> None:
    source, target = build_pyramid(texture(seed=1), LEVELS), build_pyramid(texture(seed=2), LEVELS)
    _, found = track(source, target, grid(), grid(), window_px=15, levels=LEVELS, max_return_px=0.5)
    assert found.mean() < 0.2
