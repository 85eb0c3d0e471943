"""Procedural reflectance maps of all surfaces, packed with their mipmaps into one array that the renderer samples.

Every texture is square with a side that is a power of two, and holds diffuse reflectance between 0 and 1. Textures that
are tiled repeat without a seam. Row 0 is the top. The maps are the same at every call.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from graphvio.arrays import Float, Int
from graphvio.simulation.noise import SIDE, Map, Rng, noise
from graphvio.simulation.outdoor_textures import OUTDOOR_PAINTERS

_WORLD_SEED = 20070613


@dataclass(frozen=True, eq=False)
class Atlas:
    """All textures with their mipmaps.

    Attributes:
        texels: (T,) float32 reflectance; level k of texture i begins at ``offsets[i, k]``, row by row.
        offsets: (n, levels) int64.
        sides: (n,) int64 texels of a side of level 0; level k has ``sides >> k``.
        tile_m: (n,) metres that one repetition covers.
        numbers: name -> index.
    """

    texels: Map
    offsets: Int
    sides: Int
    tile_m: Float
    numbers: dict[str, int]


def pack(maps: dict[str, tuple[Map, float]]) -> Atlas:
    """Pack named maps into an atlas; each is an array (side, side) and the metres that one repetition covers."""
    levels = max(int(m.shape[0]).bit_length() for m, _ in maps.values())
    offsets = np.zeros((len(maps), levels), dtype=np.int64)
    chunks: list[Map] = []
    end = 0
    for i, (texture, _) in enumerate(maps.values()):
        level = texture.astype(np.float32)
        for k in range(levels):
            if level.shape[0] > 0:
                offsets[i, k] = end
                chunks.append(level.ravel())
                end += level.size
            half = level.shape[0] // 2
            level = level.reshape(half, 2, half, 2).mean(axis=(1, 3)) if half else level[:0]
    return Atlas(
        texels=np.concatenate(chunks),
        offsets=offsets,
        sides=np.array([m.shape[0] for m, _ in maps.values()], dtype=np.int64),
        tile_m=np.array([tile for _, tile in maps.values()]),
        numbers={name: i for i, name in enumerate(maps)},
    )


@functools.cache
def standard_atlas() -> Atlas:
    """Return the textures that all scenes share."""
    maps: dict[str, tuple[Map, float]] = {}
    for i, (name, (paint, tile_m)) in enumerate(_PAINTERS.items()):
        texture = paint(np.random.default_rng([_WORLD_SEED, i]))
        maps[name] = (np.clip(texture, 0.02, 0.95).astype(np.float32), tile_m)
    return pack(maps)


def checkerboard(squares: int) -> Map:
    """Make a map (SIDE, SIDE) of ``squares`` by ``squares`` alternately dark and bright fields."""
    row = np.arange(SIDE) * squares // SIDE
    return np.where((row[:, None] + row[None, :]) % 2 == 0, 0.12, 0.85).astype(np.float32)


def _plaster(rng: Rng) -> Map:
    stains = noise(rng, 4, 6, 0.7)
    scratches = (noise(rng, 64, 3) > 2.0) * 0.22
    return np.asarray(0.58 + 0.055 * stains - scratches, dtype=np.float32)


def _blank(rng: Rng) -> Map:
    return np.asarray(0.62 + 0.0008 * noise(rng, 8, 5), dtype=np.float32)


def _concrete(rng: Rng) -> Map:
    base = 0.42 + 0.07 * noise(rng, 4, 7, 0.8)
    base[(noise(rng, 64, 2) > 1.9)] -= 0.2
    base[:3] -= 0.15
    base[:, :3] -= 0.15
    return base


def _cells(rng: Rng, rows: int, columns: int, joint: int, shift: bool, spread: float) -> tuple[Map, Map]:
    """Sample a map (SIDE, SIDE) of fields of random brightness, and the mask (SIDE, SIDE) of the joints between them.

    With ``shift`` every second row is displaced by half a field, as in a brick wall.
    """
    y, x = np.mgrid[0:SIDE, 0:SIDE]
    row = y * rows // SIDE
    offset = (row % 2) * (SIDE // columns // 2) if shift else 0
    along = (x + offset) % SIDE
    values = rng.normal(0.0, spread, (rows, columns)).astype(np.float32)
    height, width = SIDE / rows, SIDE / columns
    joints = ((y % height) < joint) | ((along % width) < joint)
    return values[row, along * columns // SIDE], joints.astype(np.float32)


def _brick(rng: Rng) -> Map:
    fields, joints = _cells(rng, 16, 8, 5, shift=True, spread=0.09)
    return np.asarray((0.33 + fields + 0.05 * noise(rng, 16, 5)) * (1 - joints) + 0.68 * joints, dtype=np.float32)


def _tiles(rng: Rng) -> Map:
    fields, joints = _cells(rng, 8, 8, 4, shift=False, spread=0.10)
    return np.asarray((0.5 + fields + 0.05 * noise(rng, 8, 6)) * (1 - joints) + 0.15 * joints, dtype=np.float32)


def _planks(rng: Rng) -> Map:
    fields, joints = _cells(rng, 12, 2, 2, shift=True, spread=0.08)
    fibres = cv2.GaussianBlur(noise(rng, 32, 5), (31, 1), 0, borderType=cv2.BORDER_REFLECT)
    knots = (noise(rng, 32, 2) > 2.1) * 0.15
    return np.asarray((0.42 + fields + 0.08 * fibres - knots) * (1 - 0.75 * joints), dtype=np.float32)


def _wood(rng: Rng) -> Map:
    y = np.mgrid[0:SIDE, 0:SIDE][0] / SIDE
    rings = np.sin(2 * np.pi * (14 * y + 0.5 * noise(rng, 4, 3)))
    return np.asarray(0.36 + 0.08 * rings + 0.05 * noise(rng, 32, 4), dtype=np.float32)


def _carpet(rng: Rng) -> Map:
    y, x = np.mgrid[0:SIDE, 0:SIDE] * (2 * np.pi / SIDE)
    pattern = np.sign(np.sin(8 * x) * np.sin(8 * y)) * (np.abs(np.sin(8 * x + 0.4) * np.sin(8 * y)) > 0.45)
    return np.asarray(0.35 + 0.13 * pattern + 0.09 * noise(rng, 16, 5, 0.9), dtype=np.float32)


def _ceiling(rng: Rng) -> Map:
    fields, joints = _cells(rng, 4, 4, 7, shift=False, spread=0.02)
    holes = (noise(rng, 128, 2, 0.8) > 1.7) * 0.28
    return np.asarray((0.74 + fields - holes) * (1 - 0.6 * joints), dtype=np.float32)


def _books(rng: Rng) -> Map:
    image = np.full((SIDE, SIDE), 0.06, dtype=np.float32)
    shelf = SIDE // 5
    for top in range(0, SIDE - shelf // 2, shelf):
        x = 6
        while x < SIDE - 14:
            width, height = int(rng.integers(8, 26)), int(rng.integers(shelf * 6 // 10, shelf - 12))
            tone = float(rng.uniform(0.08, 0.85))
            bottom = top + shelf - 6
            cv2.rectangle(image, (x, bottom - height), (min(x + width, SIDE - 6), bottom), tone, -1)
            band = bottom - int(height * rng.uniform(0.3, 0.8))
            label = 0.9 - 0.8 * tone
            end = (min(x + width - 2, SIDE - 8), band + int(rng.integers(4, 16)))
            cv2.rectangle(image, (x + 2, band), end, label, -1)
            x += width + int(rng.integers(1, 4))
        cv2.rectangle(image, (0, top + shelf - 6), (SIDE, top + shelf), 0.45, -1)
    return np.asarray(image + 0.015 * noise(rng, 64, 3), dtype=np.float32)


def _poster(rng: Rng) -> Map:
    paper = float(rng.uniform(0.55, 0.9))
    image = np.full((SIDE, SIDE), paper, dtype=np.float32)
    for _ in range(22):
        centre = (int(rng.integers(40, SIDE - 40)), int(rng.integers(40, SIDE * 6 // 10)))
        size, tone = int(rng.integers(15, 80)), float(rng.uniform(0.05, 0.95))
        if rng.random() < 0.5:
            cv2.circle(image, centre, size // 2, tone, -1, cv2.LINE_AA)
        else:
            corner = (centre[0] + size, centre[1] + int(size * rng.uniform(0.3, 1.2)))
            cv2.rectangle(image, centre, corner, tone, -1)
    for y in range(SIDE * 7 // 10, SIDE - 40, 24):  # lines of writing
        x = 36
        while x < SIDE - 60:
            width = int(rng.integers(8, 44))
            cv2.rectangle(image, (x, y), (x + width, y + 11), 0.1, -1)
            x += width + 10
    cv2.rectangle(image, (0, 0), (SIDE - 1, SIDE - 1), 0.08, 14)
    return np.asarray(image + 0.01 * noise(rng, 64, 3), dtype=np.float32)


def _notices(rng: Rng) -> Map:
    image = 0.36 + 0.05 * noise(rng, 64, 3, 0.9)
    for row in range(3):
        for column in range(4):
            if rng.random() < 0.12:
                continue
            x, y = column * 126 + int(rng.integers(8, 24)), row * 168 + int(rng.integers(8, 24))
            cv2.rectangle(image, (x, y), (x + 98, y + 136), float(rng.uniform(0.7, 0.92)), -1)
            for line in range(y + 14, y + 122, 12):
                cv2.line(image, (x + 10, line), (x + int(rng.integers(30, 90)), line), 0.15, 4)
            cv2.circle(image, (x + 49, y + 5), 5, 0.05, -1)
    return np.asarray(image, dtype=np.float32)


def _painting(rng: Rng) -> Map:
    hills = noise(rng, 4, 7, 0.75)
    image = 0.45 + 0.2 * hills + 0.12 * np.sign(noise(rng, 8, 4))
    cv2.rectangle(image, (0, 0), (SIDE - 1, SIDE - 1), 0.15, 60)
    cv2.rectangle(image, (6, 6), (SIDE - 7, SIDE - 7), 0.6, 8)
    return np.asarray(image, dtype=np.float32)


def _door(rng: Rng) -> Map:
    image = _wood(rng) + 0.14
    for x0, x1 in ((50, 236), (276, 462)):
        for y0, y1 in ((40, 150), (180, 300), (330, 480)):
            cv2.rectangle(image, (x0, y0), (x1, y1), 0.16, 6)
            cv2.rectangle(image, (x0 + 18, y0 + 12), (x1 - 18, y1 - 12), 0.7, 3)
    cv2.rectangle(image, (140, 60), (372, 130), 0.85, -1)
    for x in range(160, 350, 26):
        cv2.rectangle(image, (x, 80), (x + int(rng.integers(8, 20)), 112), 0.08, -1)
    cv2.circle(image, (478, 250), 14, 0.9, -1)
    cv2.rectangle(image, (0, 0), (SIDE - 1, SIDE - 1), 0.1, 10)
    return np.asarray(image, dtype=np.float32)


def _window(rng: Rng) -> Map:
    image = 0.82 + 0.05 * noise(rng, 4, 3)
    skyline = 300
    for x in range(0, SIDE, 32):  # houses across the street
        skyline = int(np.clip(skyline + rng.integers(-70, 71), 180, 420))
        cv2.rectangle(image, (x, skyline), (x + 31, SIDE), float(rng.uniform(0.35, 0.6)), -1)
        for y in range(skyline + 14, SIDE - 10, 26):
            cv2.rectangle(image, (x + 8, y), (x + 22, y + 12), float(rng.choice([0.2, 0.75])), -1)
    for position in (0, SIDE // 2, SIDE - 1):
        cv2.line(image, (position, 0), (position, SIDE), 0.25, 18)
        cv2.line(image, (0, position), (SIDE, position), 0.25, 18)
    return np.asarray(image, dtype=np.float32)


def _lockers(rng: Rng) -> Map:
    image = 0.4 + 0.02 * noise(rng, 16, 5)
    for x in range(0, SIDE, 128):
        cv2.rectangle(image, (x + 2, 4), (x + 125, SIDE - 5), 0.16, 4)
        for y in range(40, 120, 16):
            cv2.rectangle(image, (x + 34, y), (x + 94, y + 6), 0.1, -1)
        cv2.rectangle(image, (x + 44, 150), (x + 84, 176), 0.85, -1)
        for k in range(3):
            cv2.rectangle(image, (x + 48 + 12 * k, 156), (x + 53 + 12 * k + int(rng.integers(0, 4)), 170), 0.1, -1)
        cv2.rectangle(image, (x + 104, 240), (x + 114, 290), 0.7, -1)
    return np.asarray(image, dtype=np.float32)


def _fabric(rng: Rng) -> Map:
    y, x = np.mgrid[0:SIDE, 0:SIDE] * (2 * np.pi / SIDE)
    plaid = np.sign(np.sin(6 * x)) * 0.10 + np.sign(np.sin(6 * y + 1)) * 0.10 + np.sign(np.sin(18 * x)) * 0.05
    return np.asarray(0.4 + plaid + 0.04 * noise(rng, 64, 3), dtype=np.float32)


def _cloth(rng: Rng) -> Map:
    folds = noise(rng, 4, 3)
    return np.asarray(0.3 + 0.08 * folds + 0.03 * noise(rng, 64, 3), dtype=np.float32)


def _stripes(rng: Rng) -> Map:
    y = np.mgrid[0:SIDE, 0:SIDE][0] * (2 * np.pi / SIDE)
    return np.asarray(0.45 + 0.22 * np.sign(np.sin(9 * y)) + 0.05 * noise(rng, 8, 4), dtype=np.float32)


def _head(rng: Rng) -> Map:
    image = 0.5 + 0.03 * noise(rng, 8, 4)
    image[:170] = 0.12 + 0.03 * noise(rng, 64, 2)[:170]
    for x in (150, 362):
        cv2.ellipse(image, (x, 260), (44, 20), 0, 0, 360, 0.8, -1)
        cv2.circle(image, (x, 260), 16, 0.06, -1)
    cv2.ellipse(image, (256, 420), (80, 18), 0, 0, 360, 0.28, -1)
    return np.asarray(image, dtype=np.float32)


_PAINTERS: dict[str, tuple[Callable[[Rng], Map], float]] = {
    "plaster": (_plaster, 2.4),
    "blank": (_blank, 2.0),
    "concrete": (_concrete, 2.0),
    "brick": (_brick, 1.6),
    "tiles": (_tiles, 2.4),
    "planks": (_planks, 2.0),
    "wood": (_wood, 1.0),
    "carpet": (_carpet, 1.8),
    "ceiling": (_ceiling, 2.4),
    "books": (_books, 1.6),
    "poster0": (_poster, 1.0),
    "poster1": (_poster, 1.0),
    "poster2": (_poster, 1.0),
    "poster3": (_poster, 1.0),
    "poster4": (_poster, 1.0),
    "notices": (_notices, 1.2),
    "painting0": (_painting, 1.0),
    "painting1": (_painting, 1.0),
    "door": (_door, 1.0),
    "window": (_window, 1.5),
    "lockers": (_lockers, 1.6),
    "fabric": (_fabric, 0.8),
    "cloth": (_cloth, 0.8),
    "stripes": (_stripes, 0.8),
    "head": (_head, 0.3),
    "checkerboard": (lambda rng: checkerboard(8), 0.8),
    **OUTDOOR_PAINTERS,  # append new ones at the end: the position in this order is the seed of a texture
}
