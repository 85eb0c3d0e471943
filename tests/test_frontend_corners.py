import cv2
import numpy as np
import pytest

from graphvio.arrays import Bool, Float, Image
from graphvio.config.stages import CornerConfig
from graphvio.frontend.imaging.corners import find_corners, occupied_cells, thinned

SETTINGS = CornerConfig()
HEIGHT, WIDTH = 240, 320
CELL_PX = 40
NONE = np.zeros((0, 2))


def find(
    image: Image,
    *,
    allowed: Bool | None = None,
    tracked: Float = NONE,
    occupying: Bool | None = None,
    cell_px: int = CELL_PX,
) -> Float:
    everywhere = np.ones(image.shape, dtype=bool) if allowed is None else allowed
    good = np.ones(len(tracked), dtype=bool) if occupying is None else occupying
    return find_corners(image, everywhere, tracked, good, cell_px, SETTINGS.border_px, SETTINGS.min_response)


def crossing(x: float, y: float, angle_rad: float = 0.0) -> Image:
    """Four fields of a checkerboard that meet at (x, y), seen through a slightly blurred lens."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    a = (u - x) * np.cos(angle_rad) + (v - y) * np.sin(angle_rad)
    b = (v - y) * np.cos(angle_rad) - (u - x) * np.sin(angle_rad)
    return np.asarray(np.round(128.0 + 80.0 * np.tanh(a) * np.tanh(b)), dtype=np.uint8)


def texture(seed: int = 0) -> Image:
    """Blocks of random grey, 7 px wide: corners everywhere."""
    blocks = np.random.default_rng(seed).integers(20, 236, (HEIGHT // 7 + 1, WIDTH // 7 + 1))
    return np.kron(blocks, np.ones((7, 7)))[:HEIGHT, :WIDTH].astype(np.uint8)


@pytest.mark.parametrize(("angle_rad", "within_px"), [(0.0, 0.7), (0.4, 0.3), (0.8, 0.3)])  # level peak if aligned
def test_find_corners_returns_sub_pixel_positions(angle_rad: float, within_px: float) -> None:
    rng = np.random.default_rng(1)
    for x, y in rng.uniform([145.0, 85.0], [155.0, 95.0], (12, 2)):  # mid-cell
        found = find(crossing(x, y, angle_rad), cell_px=100)
        nearest = found[np.argmin(np.hypot(found[:, 0] - x, found[:, 1] - y))]
        assert np.hypot(*(nearest - [x, y])) < within_px


def test_find_corners_on_the_seam_of_cells_returns_one() -> None:
    for x, y in [(159.6, 100.0), (160.4, 100.0), (160.0, 120.0), (159.5, 119.5)]:
        found = find(crossing(x, y, 0.4))
        assert np.sum(np.hypot(found[:, 0] - x, found[:, 1] - y) < 2.0) == 1


def test_find_corners_without_texture_returns_none() -> None:
    flat = np.full((HEIGHT, WIDTH), 128.0)
    edge = flat + 60.0 * (np.arange(WIDTH) > 150)
    noise = np.random.default_rng(2).standard_normal((HEIGHT, WIDTH))
    ramp = np.arange(WIDTH) * 0.5 + np.arange(HEIGHT)[:, None] * 0.3
    for image in (flat, flat + 2.0 * noise, edge, edge + noise, ramp):
        assert len(find(np.round(image).astype(np.uint8))) == 0


def test_find_corners_returns_one_in_each_cell_and_none_at_the_border() -> None:
    found = find(texture())
    cells = {tuple(cell) for cell in (found // CELL_PX).astype(int)}
    assert len(cells) >= len(found) - 2  # half a pixel may carry one over a seam
    assert len(found) > 0.6 * (HEIGHT // 40) * (WIDTH // 40)
    assert found.min() >= SETTINGS.border_px - 0.5
    assert found[:, 0].max() <= WIDTH - SETTINGS.border_px - 0.5
    assert found[:, 1].max() <= HEIGHT - SETTINGS.border_px - 0.5


def test_find_corners_keep_their_distance_from_each_other() -> None:
    found = find(texture(1))
    distance = np.linalg.norm(found[:, None] - found[None], axis=2) + 1e9 * np.eye(len(found))
    assert distance.min() >= 0.5 * CELL_PX - 1.5


def test_find_corners_respects_the_mask() -> None:
    allowed = np.ones((HEIGHT, WIDTH), dtype=bool)
    allowed[:, 100:220] = False
    found = find(texture(), allowed=allowed)
    assert len(found) > 5
    assert not np.any((found[:, 0] > 100.5) & (found[:, 0] < 218.5))
    assert len(find(texture(), allowed=np.zeros_like(allowed))) == 0
    first = find(texture())
    whole = np.round(first).astype(int)
    for shift in (0, 2):
        dots = np.zeros_like(allowed)
        dots[whole[:, 1], whole[:, 0] + shift] = True
        again = find(texture(), allowed=dots)
        assert len(again) > 0.9 * len(first) if shift == 0 else len(again) < 0.2 * len(first)


def test_find_corners_adds_none_to_occupied_cells() -> None:
    first = find(texture())
    assert len(find(texture(), tracked=first)) < 0.3 * len(first)
    half = np.arange(len(first)) % 2 == 0
    again = find(texture(), tracked=first, occupying=half)
    occupied = occupied_cells(first[half], 40, HEIGHT // 40, WIDTH // 40)
    whole = np.round(again).astype(int)
    assert len(again) > 0
    assert not occupied[whole[:, 1] // 40, whole[:, 0] // 40].any()


def test_find_corners_keep_half_a_cell_from_every_track() -> None:
    tracked = np.random.default_rng(4).uniform([0.0, 0.0], [WIDTH, HEIGHT], (15, 2))
    found = find(texture(), tracked=tracked, occupying=np.zeros(15, dtype=bool))
    assert len(found) > 5
    assert np.linalg.norm(found[:, None] - tracked[None], axis=2).min() >= 0.5 * CELL_PX - 0.75


def test_occupied_cells_of_pixels_inside_and_outside() -> None:
    pixels = np.array([[0.0, 0.0], [39.9, 40.0], [319.0, 239.0], [-0.5, 0.0], [1e6, 0.0]])
    occupied = occupied_cells(pixels, 40, 6, 8)
    assert sorted(zip(*np.nonzero(occupied), strict=True)) == [(0, 0), (1, 0), (5, 7)]


def test_find_corners_in_small_images_returns_none() -> None:
    for shape in ((16, 16), (17, 40), (41, 81)):
        corners = find(np.random.default_rng(5).integers(0, 256, shape).astype(np.uint8))
        assert ((corners >= 0) & (corners < shape[::-1])).all()


def test_thinned_keeps_the_first_tracks_of_a_cell() -> None:
    pixels = np.array([[5.0, 5.0], [6.0, 30.0], [39.0, 39.0], [41.0, 5.0], [100.0, 90.0], [-1e9, 1e9]])
    found = np.array([True, True, True, True, True, False])
    assert thinned(pixels, found, 40, 2).tolist() == [True, True, False, True, True, False]
    assert thinned(pixels, ~found & (pixels[:, 0] > 0), 40, 2).tolist() == [False] * 6


def test_find_corners_response_matches_its_definition() -> None:
    image = np.asarray(cv2.GaussianBlur(texture(6), (0, 0), 1.0), dtype=np.uint8)
    gx, gy = np.zeros(image.shape), np.zeros(image.shape)
    grey = image.astype(np.float64)
    gx[:, 1:-1], gy[1:-1] = 0.5 * (grey[:, 2:] - grey[:, :-2]), 0.5 * (grey[2:] - grey[:-2])
    a, b, c = (cv2.blur(product, (7, 7)) for product in (gx * gx, gx * gy, gy * gy))
    smooth = np.array([1.0, 2.0, 1.0]) / 4.0
    response = cv2.sepFilter2D(a * c - b * b - 0.04 * (a + c) ** 2, -1, smooth, smooth)
    found = find(image)
    assert len(found) > 10
    for x, y in np.round(found).astype(int):
        around = response[y - 1 : y + 2, x - 1 : x + 2]
        assert around.max() >= 0.999 * response[y - 2 : y + 3, x - 2 : x + 3].max()
