"""The state of the paper's filter (section 5) and its error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3, so3_exp, so3_log

POSITION, ATTITUDE, VELOCITY, RATE, GYRO_BIAS = (slice(k, k + 3) for k in range(0, 15, 3))
"""Slices of the error vector (15,)."""
ERRORS = 15


@dataclass(frozen=True, eq=False)
class FilterState:
    """The 16 elements of the state: position, unit quaternion, velocity, rate, gyro bias.

    Attributes:
        position: (3,) ``X``, metres in nav.
        nav_R_body: (3, 3), the rotation of the quaternion ``q``; the paper's ``R(q)`` is its transpose.
        velocity_body: (3,) ``v``, m/s in body.
        rate_body: (3,) ``omega``, rad/s in body.
        gyro_bias: (3,) ``b``, rad/s.
    """

    position: Float
    nav_R_body: Float
    velocity_body: Float
    rate_body: Float
    gyro_bias: Float

    @property
    def nav_T_body(self) -> Float:
        """Pose (4, 4)."""
        return se3(self.nav_R_body, self.position)

    def plus(self, error: Float) -> FilterState:
        """Return this state with an error (15,) added; that of the attitude is a rotation vector in body."""
        return FilterState(
            self.position + error[POSITION],
            self.nav_R_body @ so3_exp(np.ascontiguousarray(error[ATTITUDE])),
            self.velocity_body + error[VELOCITY],
            self.rate_body + error[RATE],
            self.gyro_bias + error[GYRO_BIAS],
        )

    def minus(self, other: FilterState) -> Float:
        """Return the error (15,) of this state with respect to another: the inverse of `plus`."""
        return np.concatenate(
            [
                self.position - other.position,
                so3_log(np.ascontiguousarray(other.nav_R_body.T @ self.nav_R_body)),
                self.velocity_body - other.velocity_body,
                self.rate_body - other.rate_body,
                self.gyro_bias - other.gyro_bias,
            ]
        )
