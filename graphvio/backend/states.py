"""The state of the rig at one instant, and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.initialisation import level
from graphvio.geometry import skew
from graphvio.measurements.sensors import GRAVITY_M_S2

_POSITION_SIGMA_M = 1e-3
_ATTITUDE_SIGMA_RAD = 1e-3


def level_gravity() -> Float:
    """Return gravity (3,) m/s^2 in a nav frame whose z axis points exactly up."""
    return np.array([0.0, 0.0, -GRAVITY_M_S2])


@dataclass(frozen=True, eq=False)
class RigState:
    """The rig at one instant.

    Attributes:
        nav_T_body: (4, 4) pose.
        velocity_nav: (3,) velocity in nav, m/s.
        gyro_bias: (3,) rad/s.
        accel_bias: (3,) m/s^2.
        gravity_nav: (3,) gravity in nav, m/s^2, downwards.
    """

    nav_T_body: Float
    velocity_nav: Float
    gyro_bias: Float
    accel_bias: Float
    gravity_nav: Float = field(default_factory=level_gravity)


@dataclass(frozen=True, eq=False)
class InitialUncertainty:
    """Uncertainty of a first state.

    Attributes:
        pose: (6, 6) covariance of the pose, tangent ``[rotation, translation]`` in body.
        velocity_m_s: standard deviation of each component.
        gyro_bias_rad_s: standard deviation of each component.
        nav_covariance: (6, 6) additional covariance of the pose that is reported but not estimated, such as the
            uncertainty of where an epoch begins: no later measurement can reduce it.
        gravity: (3, 3) covariance of gravity's direction in nav, (m/s^2)^2; zero where nav is level by definition, so
            that measurements turn the poses.
        inertial: (12, 12) joint covariance of velocity in nav, biases of accelerometer and gyro, and gravity in nav,
            or None; it replaces their separate uncertainties.
    """

    pose: Float
    velocity_m_s: float
    gyro_bias_rad_s: float
    nav_covariance: Float = field(default_factory=lambda: np.zeros((6, 6)))
    gravity: Float = field(default_factory=lambda: np.zeros((3, 3)))
    inertial: Float | None = None


@dataclass(frozen=True, eq=False)
class StateCovariance:
    """Covariance of the newest state; None for what is not estimated.

    Attributes:
        pose: (6, 6), tangent ``[rotation, translation]`` in body.
        velocity: (3, 3) in nav.
        gyro_bias: (3, 3).
        accel_bias: (3, 3).
        gravity: (3, 3) of gravity in nav, (m/s^2)^2.
        tilt: (2, 2) of roll and pitch against gravity, about the horizontal axes of nav turned level.
    """

    pose: Float
    velocity: Float | None = None
    gyro_bias: Float | None = None
    accel_bias: Float | None = None
    gravity: Float | None = None
    tilt: Float | None = None


def origin_covariance(nav_R_body: Float, tilt_sigma_rad: float) -> Float:
    """Return the prior covariance (6, 6) of a first pose, tangent ``[rotation, translation]`` in body.

    Position and heading are certain, as they define nav; roll and pitch have ``tilt_sigma_rad``.
    """
    return _origin_covariance(nav_R_body, np.eye(2) * tilt_sigma_rad**2)


def gravity_by_tilt(nav_R_body: Float, of_pose: Float, gravity_nav: Float) -> Float:
    """Convert a pose's attitude covariance into that of gravity's direction in nav, where the pose itself defines nav.

    Args:
        nav_R_body: (3, 3) attitude of the pose.
        of_pose: (6, 6) covariance of the pose, tangent ``[rotation, translation]`` in body.
        gravity_nav: (3,) gravity in nav, m/s^2.

    Returns:
        (3, 3) covariance of gravity in nav, (m/s^2)^2.
    """
    turned = skew(gravity_nav) @ nav_R_body
    return np.asarray(turned @ of_pose[:3, :3] @ turned.T)


def certain_origin() -> Float:
    """Return the prior covariance (6, 6) of a first pose that defines all of nav: nearly zero, in any frame."""
    return np.diag(np.repeat([_ATTITUDE_SIGMA_RAD, _POSITION_SIGMA_M], 3) ** 2)


def as_origin(nav_R_body: Float, covariance: Float) -> tuple[Float, Float]:
    """Split a pose's covariance into the prior of a first pose, and the part that becomes uncertainty of nav.

    Args:
        nav_R_body: (3, 3) attitude of the pose.
        covariance: (6, 6) of the pose, tangent ``[rotation, translation]`` in body.

    Returns:
        (6, 6) of roll and pitch, with a heading and position that are certain, as of `origin_covariance`; and (6, 6) of
        heading and position. Correlations between the two are left out.
    """
    about_nav = nav_R_body @ covariance[:3, :3] @ nav_R_body.T
    nav_covariance = np.zeros((6, 6))
    nav_covariance[:3, :3] = about_nav[2, 2] * np.outer(nav_R_body[2], nav_R_body[2])
    nav_covariance[3:, 3:] = covariance[3:, 3:]
    return _origin_covariance(nav_R_body, about_nav[:2, :2]), nav_covariance


def _origin_covariance(nav_R_body: Float, tilt: Float) -> Float:
    """Return the covariance (6, 6) in body for a covariance (2, 2) of tilt about nav's horizontal axes."""
    about_nav = np.eye(3) * _ATTITUDE_SIGMA_RAD**2
    about_nav[:2, :2] = tilt
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = nav_R_body.T @ about_nav @ nav_R_body
    covariance[3:, 3:] = np.eye(3) * _POSITION_SIGMA_M**2
    return covariance


def level_R_nav(gravity_nav: Float) -> Float:
    """Return the rotation (3, 3) from nav to a level frame, for gravity (3,) in nav; nav's x axis keeps its heading."""
    return level(-gravity_nav)


def tilt_covariance(state: RigState, covariance: Float) -> Float:
    """Return the covariance (2, 2) of roll and pitch about the horizontal axes of nav turned level.

    Args:
        state: State of the rig.
        covariance: (9, 9) joint covariance of its pose, tangent in body, and of gravity in nav.
    """
    turn = level_R_nav(state.gravity_nav)
    across = np.array([[0.0, -1.0], [1.0, 0.0]]) / np.linalg.norm(state.gravity_nav)
    jacobian = np.hstack([(turn @ state.nav_T_body[:3, :3])[:2], np.zeros((2, 3)), across @ turn[:2]])
    return np.asarray(jacobian @ covariance @ jacobian.T)
