"""Sampling by a cubic B-spline, against scipy's, and what it is for: alignment at any fraction of a pixel."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from graphvio.arrays import Float, Image
from graphvio.frontend.imaging.lucas_kanade import register
from graphvio.frontend.imaging.patches import lattice, room
from graphvio.frontend.imaging.sampling import pixel_words, sample, sample_affine, scratch_room

IMAGE: Image = np.random.default_rng(0).integers(0, 256, (60, 80)).astype(np.uint8)


def spline(x: Float, y: Float) -> Float:
    """Scipy's cubic B-spline with the pixels as its coefficients."""
    return np.asarray(map_coordinates(IMAGE.astype(np.float64), [y, x], order=3, prefilter=False))


@pytest.mark.parametrize("half", [4, 7, 8])
def test_sample_equals_a_cubic_spline(half: int) -> None:
    out, side = room(half), 2 * half + 1
    steps = np.arange(-half, half + 1.0)
    for x, y in ((41.3, 30.6), (40.0, 30.0), (half + 1.0, half + 1.0), (79.0 - half - 1.1, 59.0 - half - 1.1)):
        assert sample(IMAGE, x, y, half, out)
        np.testing.assert_allclose(out.rows[:, :side], spline(*np.meshgrid(x + steps, y + steps)), atol=1e-3)


@pytest.mark.parametrize("half", [4, 7, 8])
def test_sample_affine_equals_a_cubic_spline(half: int) -> None:
    warp, middle = np.array([[1.1, 0.2], [-0.15, 0.9]]), np.array([41.3, 30.6])
    grid, out, side = lattice(half), room(half), 2 * half + 1
    a, b, c, d = warp.ravel()
    assert sample_affine(pixel_words(IMAGE), middle[0], middle[1], a, b, c, d, grid, scratch_room(grid), out)
    steps = np.arange(-half, half + 1.0)
    x, y = np.moveaxis(middle + np.stack(np.meshgrid(steps, steps), axis=-1) @ warp.T, -1, 0)
    np.testing.assert_allclose(out.rows[:, :side], spline(x, y), atol=2e-3)  # places in single precision
    assert not out.rows[:, side:].any()


@pytest.mark.parametrize("edge", [(0, 1), (0, -1), (1, 1), (1, -1)])
def test_sample_beyond_the_edge_returns_false(edge: tuple[int, int]) -> None:
    """As near to each edge as all pixels are there, and a hundredth of a pixel nearer."""
    axis, side = edge
    half, size = 7, IMAGE.shape[1 - axis]
    out, grid = room(half), lattice(half)
    scratch = scratch_room(grid)
    for extra, expected in ((0.01, True), (-0.01, False)):
        place = np.array([40.0, 30.0])
        place[axis] = half + 1 + extra if side > 0 else size - half - 2 - extra
        assert sample(IMAGE, place[0], place[1], half, out) is expected
    for extra, expected in ((2.01, True), (-0.01, False)):  # a deformed patch has two pixels to spare
        place = np.array([40.0, 30.0])
        place[axis] = half + extra if side > 0 else size - 1 - half - extra
        found = sample_affine(pixel_words(IMAGE), place[0], place[1], 1.0, 0.0, 0.0, 1.0, grid, scratch, out)
        assert found is expected


def test_register_at_any_fraction_of_a_pixel_is_unbiased() -> None:
    """A sharp texture, shifted by fractions of a pixel; by bilinear interpolation the error would be 0.03 px."""
    rng = np.random.default_rng(1)
    waves = rng.uniform(-1.9, 1.9, (80, 2))  # radians per pixel: up to 0.3 cycles in each direction
    phases, x, y = rng.uniform(0.0, 2.0 * np.pi, 80), *np.meshgrid(np.arange(160.0), np.arange(120.0))

    def image(shift: Float) -> Image:
        total = sum(
            np.cos(a * (x - shift[0]) + b * (y - shift[1]) + c) for (a, b), c in zip(waves, phases, strict=True)
        )
        return np.asarray(np.clip(128.0 + 6.0 * total, 0.0, 255.0) + 0.5, dtype=np.uint8)

    errors = []
    for _ in range(20):
        shift, fraction = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.0, 1.0, 2)
        grid = np.stack(np.meshgrid(np.arange(20.0, 140.0, 12.0), np.arange(20.0, 100.0, 12.0)), axis=-1).reshape(-1, 2)
        pixels, everything = grid + fraction, np.ones(len(grid), dtype=bool)
        moved, found, _, _ = register(
            pixel_words(image(np.zeros(2))), image(shift), pixels, np.tile(np.eye(2), (len(grid), 1, 1)),
            np.zeros((len(grid), 2, 2)), pixels, everything, 7, 2.0, 1.0, False,
        )  # fmt: skip
        assert found.mean() > 0.9
        errors.append((moved - pixels - shift)[found])
    assert np.sqrt(np.mean(np.square(np.concatenate(errors)))) < 0.01
