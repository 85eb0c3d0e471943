"""Measurements of the sensors: IMU samples and framesets.

Stamps are int64 nanoseconds. A sample's time is the IMU's; a frameset's is the cameras', and the two differ by the
rig's ``time_offset_s``.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from graphvio.arrays import Float, Image
from graphvio.errors import MeasurementError
from graphvio.rig import Imu

GRAVITY_M_S2 = 9.81
"""Magnitude of gravity, taken as known; its direction is estimated."""
_LARGEST_STAMP = 2**62  # so that the difference of two stamps is an int64, too


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """One reading of the IMU.

    Attributes:
        stamp_ns: IMU clock, nanoseconds.
        angular_velocity: (3,) rad/s, frame body.
        linear_acceleration: (3,) m/s^2, frame body: specific force, so at a standstill it points up with 9.81.
    """

    stamp_ns: int
    angular_velocity: Float
    linear_acceleration: Float


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """Images of one instant from any subset of the rig's pairs and single cameras.

    Attributes:
        stamp_ns: the instant, camera clock, nanoseconds: ``stamp_offset_s`` of the cameras is added already.
        images: index in `graphvio.rig.Rig.groups` -> (left, right) of a pair, or (image,) of a single camera, each
            (height, width) uint8. A group that delivered nothing is absent. The arrays are referenced, not copied,
            until the same group's next images have come: a driver that fills the same buffer again has to hand over
            copies.
        masks: the same index -> a mask for each of its images, (height, width) uint8, whose zeros are not used, or
            None to use all of the image. A group without masks is absent.
    """

    stamp_ns: int
    images: Mapping[int, tuple[Image, ...]]
    masks: Mapping[int, tuple[Image | None, ...]] = field(default_factory=dict)

    @property
    def stereo(self) -> dict[int, tuple[Image, Image]]:
        """Pair index -> (left, right), without single cameras."""
        return {j: (images[0], images[1]) for j, images in self.images.items() if len(images) == 2}


Measurement = ImuSample | FrameSet


def calibrated_sample(sample: ImuSample, imu: Imu) -> ImuSample:
    """Return a sample multiplied by the IMU's matrices."""
    gyro, accel = imu.matrices
    return ImuSample(sample.stamp_ns, gyro @ sample.angular_velocity, accel @ sample.linear_acceleration)


def checked_measurement(measurement: Measurement) -> Measurement:
    """Return the measurement with its stamp as an int and its vectors as float64 arrays.

    Raises:
        MeasurementError: if its type, stamp, vectors or pairs are not valid.
    """
    if not isinstance(measurement, ImuSample | FrameSet):
        raise MeasurementError(f"a measurement is an ImuSample or a FrameSet, not {type(measurement).__name__}")
    try:
        stamp_ns = operator.index(measurement.stamp_ns)
    except TypeError:
        raise MeasurementError(f"stamp_ns is {measurement.stamp_ns!r}; give whole nanoseconds as an int") from None
    if abs(stamp_ns) > _LARGEST_STAMP:
        raise MeasurementError(
            f"stamp_ns is {stamp_ns}, which is no time in nanoseconds; give at most {_LARGEST_STAMP}"
        )
    if isinstance(measurement, ImuSample):
        try:
            vectors = [
                np.asarray(v, dtype=np.float64) for v in (measurement.angular_velocity, measurement.linear_acceleration)
            ]
        except (TypeError, ValueError):
            vectors = []
        if not vectors or any(vector.shape != (3,) for vector in vectors):
            raise MeasurementError(
                f"IMU sample at {stamp_ns}: both vectors must have three components, and all be numbers"
            )
        return ImuSample(stamp_ns, *vectors)
    pairs: object = measurement.images  # callers without a type checker may pass anything
    if not isinstance(pairs, Mapping):
        raise MeasurementError(
            f"frameset at {stamp_ns}: images is a {type(pairs).__name__}; map pairs to (left, right)"
        )
    for pair, images in pairs.items():
        if not isinstance(pair, int | np.integer):
            raise MeasurementError(
                f"frameset at {stamp_ns}: {pair!r} is no index of a pair or single camera; give a number"
            )
        if not isinstance(images, Sequence | np.ndarray) or len(images) not in (1, 2):
            raise MeasurementError(
                f"frameset at {stamp_ns}: group {pair} has not one or two images; give (left, right), or (image,)"
            )
        if not all(isinstance(image, np.ndarray) for image in images):
            raise MeasurementError(f"frameset at {stamp_ns}: group {pair} has something else than arrays; give images")
    masks: object = measurement.masks
    if not isinstance(masks, Mapping):
        raise MeasurementError(f"frameset at {stamp_ns}: masks is a {type(masks).__name__}; map pairs to (left, right)")
    return FrameSet(stamp_ns, measurement.images, measurement.masks)
