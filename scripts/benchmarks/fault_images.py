"""Faults of light, sensors and lenses, as alterations of the images of framesets.

A fault is a function of a `Moment` that returns the images that the rig would have delivered. It keeps no state: random
values that hold for the length of a fault come from `Moment.fixed`, those of a single image from `Moment.noise`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Float, Image
from graphvio.rig import Rig

Images = Mapping[int, tuple[Image, Image]]
"""Pair index -> left and right image, each (height, width) uint8."""

_SHOT_VARIANCE = 0.02  # shot noise of the simulator's film: grey levels squared for every grey level of light
READ_NOISE = 0.7  # standard deviation, grey levels at gain 1
_SUDDEN_S = 0.3  # time between jumps of the exposure


@dataclass(frozen=True, eq=False)
class Moment:
    """A frameset that a fault alters.

    Attributes:
        images: images without the fault.
        before: images of the previous framesets without the fault, the newest last, for longer than any fault lasts.
        rig: rig of the recording.
        world_T_body: (4, 4) the true pose.
        world_T_body_then: (4, 4) the true pose when the fault began.
        velocity_then: (3,) m/s in world, the true velocity when the fault began.
        number: number of framesets since the fault began, 0 for the first.
        period_s: time between framesets.
        seed: seed of the fault, the same for all its moments.
    """

    images: Images
    before: Sequence[Images]
    rig: Rig
    world_T_body: Float
    world_T_body_then: Float
    velocity_then: Float
    number: int
    period_s: float
    seed: tuple[int, ...]

    @property
    def since_s(self) -> float:
        """Seconds since the fault began."""
        return self.number * self.period_s

    @property
    def frozen(self) -> Images:
        """The last images before the fault began."""
        return self.before[-1 - self.number]

    def fixed(self, *key: int) -> np.random.Generator:
        """Return a generator of random numbers that are the same at all moments of a fault."""
        return np.random.default_rng([*self.seed, 1, *key])

    def noise(self, *key: int) -> np.random.Generator:
        """Return a generator of random numbers for this moment only."""
        return np.random.default_rng([*self.seed, 2, self.number, *key])

    def one_pair(self) -> list[int]:
        """Return the index of one pair, chosen at random for the whole fault, in a list."""
        return [int(self.fixed(0).choice(sorted(self.images)))]

    def all_pairs(self) -> list[int]:
        """Return the indices of all pairs."""
        return sorted(self.images)

    def altered(self, pairs: Sequence[int], change: Callable[[int, int, Image], Image]) -> Images:
        """Return the images, with ``change(pair, side, image)`` applied to both images of the given pairs."""
        changed = dict(self.images)
        for pair in pairs:
            left, right = self.images[pair]
            changed[pair] = change(pair, 0, left), change(pair, 1, right)
        return changed


Fault = Callable[[Moment], Images]


def quantised(values: AnyArray) -> Image:
    """Return grey values as 8 bit, saturated."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def darkness(moment: Moment) -> Images:
    """Failing lamps: 0.5 to 4 % of the light; the gain compensates for half of the loss, and amplifies the noise."""
    light = float(np.exp(moment.fixed().uniform(np.log(0.005), np.log(0.04))))
    gain = light**-0.5

    def change(pair: int, side: int, image: Image) -> Image:
        signal = gain * light * image.astype(np.float32)
        sigma = np.sqrt(gain * _SHOT_VARIANCE * signal + (gain * READ_NOISE) ** 2)
        return quantised(signal + sigma * moment.noise(pair, side).standard_normal(image.shape, dtype=np.float32))

    return moment.altered(moment.all_pairs(), change)


def over_exposure(moment: Moment) -> Images:
    """Three to twelve times too much light: most of the image is white."""
    gain = float(moment.fixed().uniform(3.0, 12.0))
    return moment.altered(moment.all_pairs(), lambda pair, side, image: quantised(gain * image.astype(np.float32)))


def exposure_jumps(moment: Moment) -> Images:
    """An exposure that changes every 0.3 s, in each camera differently: from a quarter to three times as bright."""
    step = int(moment.since_s / _SUDDEN_S)

    def change(pair: int, side: int, image: Image) -> Image:
        gain = float(np.exp(moment.fixed(step, pair, side).uniform(np.log(0.25), np.log(3.0))))
        sigma = gain * READ_NOISE if gain > 1.0 else READ_NOISE
        noise = moment.noise(pair, side).standard_normal(image.shape, dtype=np.float32)
        return quantised(gain * image.astype(np.float32) + sigma * noise)

    return moment.altered(moment.all_pairs(), change)


def motion_blur(moment: Moment) -> Images:
    """A long exposure: 15 to 45 pixels of blur along the image's motion, the same in both images of a pair."""
    length = float(moment.fixed().uniform(15.0, 45.0))
    directions = {pair: _image_motion(moment, pair) for pair in moment.images}

    def change(pair: int, side: int, image: Image) -> Image:
        return np.asarray(cv2.filter2D(image, -1, _line_kernel(length, directions[pair])), dtype=np.uint8)

    return moment.altered(moment.all_pairs(), change)


def salt_and_pepper(moment: Moment) -> Images:
    """Between 2 and 25 % of the pixels black or white, different ones in every image."""
    share = float(moment.fixed().uniform(0.02, 0.25))

    def change(pair: int, side: int, image: Image) -> Image:
        chance = moment.noise(pair, side).random(image.shape, dtype=np.float32)
        return np.where(chance < 0.5 * share, 0, np.where(chance > 1.0 - 0.5 * share, 255, image)).astype(np.uint8)

    return moment.altered(moment.all_pairs(), change)


def covered_half(moment: Moment) -> Images:
    """A hand over one half of each lens of one pair: dark, its edge out of focus."""
    draw = moment.fixed(2)
    angle, soft = float(draw.uniform(0.0, 2.0 * np.pi)), float(draw.uniform(6.0, 40.0))

    def change(pair: int, side: int, image: Image) -> Image:
        height, width = image.shape
        y, x = np.mgrid[0:height, 0:width]
        across = (x - 0.5 * width) * np.cos(angle) + (y - 0.5 * height) * np.sin(angle)
        share = 1.0 / (1.0 + np.exp(np.clip(across / soft, -30.0, 30.0)))
        return quantised(12.0 * share + (1.0 - share) * image)

    return moment.altered(moment.one_pair(), change)


def dirty_lenses(moment: Moment) -> Images:
    """Spots of dirt, sharp enough to be corners, that stay where they are in all images."""

    def change(pair: int, side: int, image: Image) -> Image:
        draw, changed = moment.fixed(pair), image.copy()
        for _ in range(45):  # the same places in both images, a few pixels apart: as near as a stereo pair can see
            x, y, size = int(draw.integers(30, 610)), int(draw.integers(20, 460)), int(draw.integers(3, 12))
            shift, tone = int(draw.integers(5, 60)), int(draw.integers(10, 240))
            cv2.ellipse(changed, (x - side * shift, y), (size, max(size // 2, 2)), 30.0 * size, 0, 360, tone, -1)
        return changed

    return moment.altered(moment.all_pairs(), change)


def glass(moment: Moment) -> Images:
    """A glass pane in front of one pair: a third to two thirds of the light is the mirror image of another moment.

    Left and right are exchanged with the mirroring, so that the reflection has the disparities of a mirrored world.
    """
    share = float(moment.fixed(1).uniform(0.35, 0.65))
    other = moment.before[-20]

    def change(pair: int, side: int, image: Image) -> Image:
        return np.asarray(cv2.addWeighted(image, 1.0 - share, other[pair][1 - side][:, ::-1], share, 0.0), np.uint8)

    return moment.altered(moment.one_pair(), change)


def water(moment: Moment) -> Images:
    """Water in the lower half of all images: it reflects the upper half upside down, in travelling waves."""
    draw = moment.fixed()
    speed, length = float(draw.uniform(4.0, 10.0)), float(draw.uniform(30.0, 70.0))

    def change(pair: int, side: int, image: Image) -> Image:
        height, width = image.shape
        half = height // 2
        y, x = np.mgrid[0 : height - half, 0:width].astype(np.float32)
        phase = (2.0 * np.pi / length) * y + speed * moment.since_s
        dx, dy = 4.0 * np.sin(phase + 0.01 * x), 3.0 * np.cos(1.3 * phase + 0.02 * x)
        mirrored = cv2.remap(image, x + dx, half - 1 - y + dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.vstack([image[:half], (0.85 * mirrored).astype(np.uint8)])

    return moment.altered(moment.all_pairs(), change)


def _image_motion(moment: Moment, pair: int) -> float:
    """Return the direction, radians, in which a pair's left image has moved since the previous frameset."""
    small = [
        cv2.resize(images[pair][0], (160, 120), interpolation=cv2.INTER_AREA).astype(np.float32)
        for images in (moment.before[-1], moment.images)
    ]
    (dx, dy), _ = cv2.phaseCorrelate(small[0], small[1], cv2.createHanningWindow((160, 120), cv2.CV_32F))
    return float(np.arctan2(dy, dx)) if np.hypot(dx, dy) > 0.05 else 0.0


def _line_kernel(length: float, direction: float) -> Float:
    """Return a kernel (n, n) whose weights are a line through the middle, with the given length in pixels."""
    side = 2 * int(np.ceil(0.5 * length)) + 1
    kernel = np.zeros((side, side))
    along = np.linspace(-0.5, 0.5, 8 * side) * length
    columns = np.rint(0.5 * (side - 1) + along * np.cos(direction)).astype(int)
    rows = np.rint(0.5 * (side - 1) + along * np.sin(direction)).astype(int)
    np.add.at(kernel, (np.clip(rows, 0, side - 1), np.clip(columns, 0, side - 1)), 1.0)
    return np.asarray(kernel / kernel.sum())
