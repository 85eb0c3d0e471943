"""What flows through the system: IMU samples and framesets in, estimates out.

Stamps are int64 nanoseconds of one clock. A sample's time is the IMU's; a frameset's is the cameras', and the two
differ by the rig's ``time_offset_s``.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from graphvio.arrays import Float, Image, Int
from graphvio.errors import EventError

if TYPE_CHECKING:
    from graphvio.backend.gating import Verdict


_LARGEST_STAMP = 2**62  # differences of two stamps are int64, too


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """One reading of the IMU.

    Attributes:
        stamp_ns: IMU clock, nanoseconds.
        angular_velocity: (3,) rad/s, frame body.
        linear_acceleration: (3,) m/s^2, frame body: specific force, so at rest it points up with 9.81.
    """

    stamp_ns: int
    angular_velocity: Float
    linear_acceleration: Float


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """Images of one instant from any subset of the rig's pairs.

    Attributes:
        stamp_ns: camera clock, nanoseconds.
        images: pair index -> (left, right), each (height, width) uint8. A pair that delivered nothing is absent. They
            are kept until the pair's next ones have come, and not copied: a driver that fills the same buffer again
            has to hand over copies.
    """

    stamp_ns: int
    images: Mapping[int, tuple[Image, Image]]


Event = ImuSample | FrameSet


def checked_event(event: Event) -> Event:
    """The event with its stamp as an int and its vectors as float64 arrays.

    Raises:
        EventError: if it is of another type, its stamp is no whole number or no time, or a vector or pair is malformed.
    """
    if not isinstance(event, ImuSample | FrameSet):
        raise EventError(f"an event is an ImuSample or a FrameSet, not {type(event).__name__}")
    try:
        stamp_ns = operator.index(event.stamp_ns)
    except TypeError:
        raise EventError(f"stamp_ns is {event.stamp_ns!r}; give whole nanoseconds as an int") from None
    if abs(stamp_ns) > _LARGEST_STAMP:
        raise EventError(f"stamp_ns is {stamp_ns}, which is no time in nanoseconds; give at most {_LARGEST_STAMP}")
    if isinstance(event, ImuSample):
        try:
            vectors = [np.asarray(v, dtype=np.float64) for v in (event.angular_velocity, event.linear_acceleration)]
        except (TypeError, ValueError):
            vectors = []
        if not vectors or any(vector.shape != (3,) for vector in vectors):
            raise EventError(f"IMU sample at {stamp_ns}: both vectors must have three components, and all be numbers")
        return ImuSample(stamp_ns, *vectors)
    pairs: object = event.images  # what callers without a type checker give
    if not isinstance(pairs, Mapping):
        raise EventError(f"frameset at {stamp_ns}: images is a {type(pairs).__name__}; map pairs to (left, right)")
    for pair, images in pairs.items():
        if not isinstance(images, Sequence | np.ndarray) or len(images) != 2:
            raise EventError(f"frameset at {stamp_ns}: pair {pair} has not two images; give (left, right)")
        if not all(isinstance(image, np.ndarray) for image in images):
            raise EventError(f"frameset at {stamp_ns}: pair {pair} has something else than arrays; give two images")
    return FrameSet(stamp_ns, event.images)


class Status(StrEnum):
    """What an estimate rests on."""

    INITIALISING = "initialising"
    """Vision moves the pose; gravity, velocity or biases are not yet known well."""
    TRACKING = "tracking"
    """Vision constrains this frameset."""
    COASTING = "coasting"
    """Vision failed or was rejected; the pose is predicted and its covariance grows."""
    LOST = "lost"
    """There is no honest pose; the next one starts a new epoch."""


class Quality(StrEnum):
    """How far a measured motion can be trusted."""

    GOOD = "good"
    """Its covariance says all there is to say."""
    WEAK = "weak"
    """Pairs contradict each other, points are few, or a direction is hardly constrained; its covariance says so."""
    FAILED = "failed"
    """There is no motion."""


@dataclass(frozen=True, slots=True, eq=False)
class PairReport:
    """What one stereo pair contributed to a frameset.

    Attributes:
        points: points offered to the estimation.
        inliers: points that the chosen motion explains.
        pixels: (N, 2) left-image pixels of the tracked corners, for display.
        is_inlier: (N,) whether each of them is explained.
        ages: (N,) number of earlier frames that saw each of them.
        rejected: test of tracking or stereo matching -> how many corners it threw out.
        rms_px: rms reprojection error of these under the chosen motion, per direction and without the share of the
            points' own uncertainty; None where there are none.
        own_inliers: points that the pair's own motion explains, or None where there is but one pair or too few points.
        own_rms_px: their rms error under it, or None; much less than ``rms_px`` tells of a transfer between pairs that
            is wrong.
    """

    points: int
    inliers: int
    pixels: Float
    is_inlier: np.ndarray[tuple[int], np.dtype[np.bool_]]
    ages: Int | None = None
    rejected: Mapping[str, int] = field(default_factory=dict)
    rms_px: float | None = None
    own_inliers: int | None = None
    own_rms_px: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The state of the rig at a frameset's time, as known when that frameset arrived (causal).

    Attributes:
        stamp_ns: the frameset's stamp.
        status: what the pose rests on.
        nav_T_body: (4, 4) pose, or None when there is nothing honest to say.
        covariance: (6, 6) of the pose, tangent ``[rotation, translation]`` in frame body, or None with the pose.
        epoch: counts declared breaks; poses of different epochs do not share a nav frame.
        velocity_nav: (3,) m/s in nav, or None when not estimated.
        gyro_bias: (3,) rad/s, or None without an IMU.
        accel_bias: (3,) m/s^2, or None without an IMU.
        velocity_covariance: (3, 3) of ``velocity_nav``, in nav, or None where it is not estimated.
        gyro_bias_covariance: (3, 3), or None where the bias is not estimated.
        accel_bias_covariance: (3, 3), or None where the bias is not estimated.
        time_offset_s: how much later than the framesets' the IMU's stamp of an instant is, as estimated, or None where
            that is not estimated.
        time_offset_sigma_s: its standard deviation, or None.
        innovations: what was measured against what was expected, with the test's outcome: ``vision``, and ``rest``
            where the rig stood still; with the paper's filter ``vision``, ``gyro`` and ``accelerometer``.
        rates: angular rate of body (3,) rad/s by ``gyro``, ``vision`` and ``fused``, as far as known.
        vision: how far the motion that vision measured can be trusted.
        vision_reason: why that is not ``good``, or empty.
        vision_sigmas: how well the geometry conditions that motion: its standard deviations in the directions that are
            known least, of the rotation (radians) and the translation (metres); None without a motion.
        at_rest: images, and the IMU if there is one, show no motion.
        pairs: pair index -> what it contributed.
        stage_ms: processing time by stage, milliseconds: ``predict``; ``track``, with all pairs side by side; its parts
            ``pyramid``, ``register``, ``flow`` and ``stereo``, each of the pair that took longest; then ``motion``,
            ``judge``, ``renew`` (next to nothing unless the reference changes) and ``update``. A stage that was not
            reached is absent.
    """

    stamp_ns: int
    status: Status
    nav_T_body: Float | None
    covariance: Float | None
    epoch: int = 0
    velocity_nav: Float | None = None
    gyro_bias: Float | None = None
    accel_bias: Float | None = None
    velocity_covariance: Float | None = None
    gyro_bias_covariance: Float | None = None
    accel_bias_covariance: Float | None = None
    time_offset_s: float | None = None
    time_offset_sigma_s: float | None = None
    innovations: Mapping[str, Verdict] = field(default_factory=dict)
    rates: Mapping[str, Float] = field(default_factory=dict)
    vision: Quality = Quality.FAILED
    vision_reason: str = ""
    vision_sigmas: tuple[float, float] | None = None
    at_rest: bool = False
    pairs: Mapping[int, PairReport] = field(default_factory=dict)
    stage_ms: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The rig between framesets, or beyond the newest one, from the newest estimate and the IMU since then.

    Attributes:
        stamp_ns: on the framesets' clock.
        nav_T_body: (4, 4) pose.
        velocity_nav: (3,) m/s in nav.
        angular_velocity: (3,) rad/s in body, without the gyro's bias.
        epoch: of the estimate that it goes on from.
    """

    stamp_ns: int
    nav_T_body: Float
    velocity_nav: Float
    angular_velocity: Float
    epoch: int


@dataclass(frozen=True, slots=True)
class Incident:
    """Something that a person would want to know of: a gate, a reset, a fault of the input.

    Attributes:
        stamp_ns: when, on the clock of the data concerned.
        kind: short name that can be counted, such as ``vision_gated`` or ``imu_gap``.
        detail: one line for people, with the figures.
    """

    stamp_ns: int
    kind: str
    detail: str
