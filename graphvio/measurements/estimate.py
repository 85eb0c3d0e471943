"""Estimates of the rig's state by the odometry, and predictions from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from graphvio.arrays import Float
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.motion import PairReport, Quality


class Status(StrEnum):
    """Status of an estimate: what it is based on."""

    INITIALISING = "initialising"
    """There is no pose yet, or vision constrains it while attitude or velocity are not known well."""
    TRACKING = "tracking"
    """Vision constrains this frameset."""
    COASTING = "coasting"
    """Vision failed or was rejected by the gate; the pose is predicted and its covariance grows."""
    LOST = "lost"
    """The position is too uncertain to be reported; the next pose begins a new epoch."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The state of the rig at a frameset's time, as known when that frameset arrived (causal).

    Attributes:
        stamp_ns: Stamp of the frameset.
        status: What the pose is based on.
        nav_T_body: (4, 4) pose, or None while initialising without a state and while lost. Within an epoch its position
            is continuous; its attitude changes at once where that of the cameras in body is corrected.
        covariance: (6, 6) of the pose, tangent ``[rotation, translation]`` in frame body, or None without a pose. Where
            the calibration is estimated, the effect of the cameras' errors is included.
        epoch: Number of declared breaks; poses of different epochs do not share a nav frame.
        velocity_nav: (3,) m/s in nav, or None when not estimated.
        gyro_bias: (3,) rad/s, or None without an IMU.
        accel_bias: (3,) m/s^2, or None without an IMU.
        velocity_covariance: (3, 3) of ``velocity_nav``, in nav, or None where it is not estimated.
        gravity_nav: (3,) m/s^2 in nav, downwards, or None without an IMU. Its direction at the beginning of an epoch is
            uncertain and becomes known later; poses are not turned then, so that nav may be tilted, as
            ``gravity_nav`` shows.
        gravity_covariance: (3, 3) of ``gravity_nav``, in nav, or None without an IMU.
        tilt_covariance: (2, 2) of roll and pitch against gravity, rad^2, about the horizontal axes of nav turned level;
            None without an IMU.
        gyro_bias_covariance: (3, 3), or None where the bias is not estimated.
        accel_bias_covariance: (3, 3), or None where the bias is not estimated.
        time_offset_s: The IMU's stamp less the framesets' stamp of the same instant, as estimated, or None.
        time_offset_sigma_s: Standard deviation of the time offset, or None.
        innovations: Outcomes of the innovation tests by name: ``vision``, and ``zero_velocity`` at a standstill; with
            the paper's filter ``vision``, ``gyro`` and ``accelerometer``.
        rates: Angular rate of body (3,) rad/s by ``gyro``, ``vision`` and ``fused``, as far as known.
        vision: Quality of the motion that vision measured.
        vision_reason: Why that is not ``good``, or empty.
        vision_sigmas: Standard deviations of that motion in the directions that are known least, of the rotation
            (radians) and the translation (metres); None without a motion.
        is_stationary: Whether images, and the IMU if there is one, show a standstill.
        pairs: Pair index -> report of the pair.
        stage_ms: Processing time by stage, milliseconds: ``predict``; ``track``, with all pairs side by side; its parts
            ``pyramid``, ``register``, ``flow`` and ``stereo``, each of the pair that took longest; then ``motion``,
            ``quality``, ``replenish`` (next to nothing unless the reference changes) and ``update``. A stage that was
            not reached is absent.
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
    gravity_nav: Float | None = None
    gravity_covariance: Float | None = None
    tilt_covariance: Float | None = None
    time_offset_s: float | None = None
    time_offset_sigma_s: float | None = None
    innovations: Mapping[str, GateResult] = field(default_factory=dict)
    rates: Mapping[str, Float] = field(default_factory=dict)
    vision: Quality = Quality.FAILED
    vision_reason: str = ""
    vision_sigmas: tuple[float, float] | None = None
    is_stationary: bool = False
    pairs: Mapping[int, PairReport] = field(default_factory=dict)
    stage_ms: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The predicted state of the rig between framesets or beyond the newest one.

    Attributes:
        stamp_ns: Instant on the framesets' clock.
        nav_T_body: (4, 4) pose.
        velocity_nav: (3,) m/s in nav.
        angular_velocity: (3,) rad/s in body, without the gyro's bias.
        epoch: Epoch of the estimate that it is predicted from.
    """

    stamp_ns: int
    nav_T_body: Float
    velocity_nav: Float
    angular_velocity: Float
    epoch: int
