"""Faults of cables, drivers and buffers: images that are missing, exchanged, old, torn or garbage."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.fault_images import READ_NOISE, Images, Moment, quantised
from graphvio.arrays import Image


def black(moment: Moment) -> Images:
    """Images of one pair that are black except for the sensor's noise."""

    def change(pair: int, side: int, image: Image) -> Image:
        return quantised(READ_NOISE * moment.noise(pair, side).standard_normal(image.shape, dtype=np.float32) + 1.0)

    return moment.altered(moment.one_pair(), change)


def no_pair(moment: Moment) -> Images:
    """A pulled cable: one pair delivers nothing."""
    gone = moment.one_pair()[0]
    return {pair: images for pair, images in moment.images.items() if pair != gone}


def nothing(moment: Moment) -> Images:
    """All cables pulled: no frameset arrives."""
    return {}


def swapped(moment: Moment) -> Images:
    """Left and right of one pair exchanged."""
    return _with_pairs(moment, moment.one_pair(), lambda pair: moment.images[pair][::-1])


def all_swapped(moment: Moment) -> Images:
    """Left and right exchanged in all pairs."""
    return _with_pairs(moment, moment.all_pairs(), lambda pair: moment.images[pair][::-1])


def pairs_exchanged(moment: Moment) -> Images:
    """The cables of each pair are plugged into the sockets of the next pair."""
    pairs = moment.all_pairs()
    return {pair: moment.images[pairs[(k + 1) % len(pairs)]] for k, pair in enumerate(pairs)}


def frozen_camera(moment: Moment) -> Images:
    """One camera of one pair goes on delivering the same image."""
    side = int(moment.fixed(1).integers(2))
    return moment.altered(
        moment.one_pair(), lambda pair, which, image: moment.frozen[pair][which] if which == side else image
    )


def frozen_pair(moment: Moment) -> Images:
    """Both cameras of one pair go on delivering the same images."""
    return _with_pairs(moment, moment.one_pair(), lambda pair: moment.frozen[pair])


def frozen_all(moment: Moment) -> Images:
    """All cameras go on delivering the same images."""
    return dict(moment.frozen)


def late_camera(moment: Moment) -> Images:
    """The right camera of one pair is late by one frameset."""
    return _with_pairs(moment, moment.one_pair(), lambda pair: (moment.images[pair][0], moment.before[-1][pair][1]))


def late_pair(moment: Moment) -> Images:
    """One pair is late by two framesets, but has the stamps of the current ones."""
    return _with_pairs(moment, moment.one_pair(), lambda pair: moment.before[-2][pair])


def torn(moment: Moment) -> Images:
    """Every other image is torn: below a row that differs from image to image, it still shows the previous frameset."""

    def change(pair: int, side: int, image: Image) -> Image:
        draw = moment.noise(pair, side)
        row = int(draw.integers(100, 400))
        whole = draw.random() < 0.5
        return image if whole else np.vstack([image[:row], moment.before[-1][pair][side][row:]])

    return moment.altered(moment.all_pairs(), change)


def torn_pair(moment: Moment) -> Images:
    """One pair is torn throughout: the lower 60 % of both images are three framesets old."""
    row = int(0.4 * next(iter(moment.images.values()))[0].shape[0])
    return moment.altered(
        moment.one_pair(),
        lambda pair, side, image: np.vstack([image[:row], moment.before[-3][pair][side][row:]]),
    )


def garbage_bands(moment: Moment) -> Images:
    """Bands of garbage: rows of noise, and rows that are shifted sideways."""

    def change(pair: int, side: int, image: Image) -> Image:
        draw, changed = moment.noise(pair, side), image.copy()
        for _ in range(int(draw.integers(1, 5))):
            top, height = int(draw.integers(0, 440)), int(draw.integers(8, 90))
            band = changed[top : top + height]
            if draw.random() < 0.5:
                band[:] = draw.integers(0, 256, band.shape, dtype=np.uint8)
            else:
                band[:] = np.roll(band, int(draw.integers(-60, 61)), axis=1)
        return changed

    return moment.altered(moment.all_pairs(), change)


def _with_pairs(moment: Moment, pairs: Sequence[int], images: Callable[[int], tuple[Image, Image]]) -> Images:
    return {**moment.images, **{pair: images(pair) for pair in pairs}}
