"""Frames of a robot by REP 103, 105 and 145: ``base_link``, the IMU's frame and the cameras' optical frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any, Final

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3, se3_adjoint, se3_inverse
from graphvio.measurements.estimate import Estimate
from graphvio.rig import Rig
from graphvio.sessions.messages import BODY, angular_rate, covariance_of, pose_of, transform

IMU_LINK: Final = "imu_link"
_OPTICAL: Final = "_optical_frame"
_IMAGE_TOPICS: Final = ("/compressed", "/image_raw", "/image_rect", "/image")
_CAM_R_BASE: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation for a camera that looks ahead: its z axis is the x axis of ``base_link``."""


@dataclass(frozen=True)
class Frames:
    """Names of a robot's frames, and the pose of the rig's body in its base."""

    base_T_body: Float  # (4, 4) pose of body, which is the IMU's frame, in ``base``
    base: str = BODY  # name of the robot's frame: x forward, y left, z up
    imu: str = IMU_LINK  # name of the IMU's frame

    @staticmethod
    def of_rig(rig: Rig, base: str = BODY, imu: str = IMU_LINK) -> Frames:
        """Return frames with the origin of ``base`` at body, and its axes parallel to the IMU's.

        Of the 24 rotations that map axes to axes, the one is taken by which the left camera of the first pair, or the
        first single camera, is most nearly upright and looking ahead.
        """
        wanted = _CAM_R_BASE.T @ rig.groups[0].left.body_T_cam[:3, :3].T  # base_R_cam @ cam_R_body
        return Frames(se3(max(_axis_rotations(), key=lambda R: float(np.sum(R * wanted))), np.zeros(3)), base, imu)

    def static_transforms(self, stamp_ns: int, rig: Rig) -> list[Any]:
        """Return the ``geometry_msgs/TransformStamped`` of the IMU in base, and of each camera in the IMU's frame."""
        return [
            transform(stamp_ns, self.base, self.imu, self.base_T_body),
            *(transform(stamp_ns, self.imu, optical_frame(each.name), each.body_T_cam) for each in rig.cameras),
        ]

    def in_base(self, estimate: Estimate) -> Estimate:
        """Return an estimate, which must have a pose and a covariance, with those of ``base`` instead of body.

        The velocity is that of base's origin; it is computed with the angular rate of ROS's messages, and the
        covariance does not include the error of that rate.
        """
        assert estimate.nav_T_body is not None
        assert estimate.covariance is not None
        turned, R = se3_adjoint(self.base_T_body), self.base_T_body[:3, :3]
        rates = {kind: R @ rate for kind, rate in estimate.rates.items()}
        nav_T_base = estimate.nav_T_body @ se3_inverse(self.base_T_body)
        velocity = estimate.velocity_nav
        to_base = -self.base_T_body[:3, 3]  # from body's origin to base's, in base
        if velocity is not None and to_base.any():
            velocity = velocity + nav_T_base[:3, :3] @ np.cross(angular_rate(rates), to_base)
        return replace(
            estimate,
            nav_T_body=nav_T_base,
            covariance=turned @ estimate.covariance @ turned.T,
            rates=rates,
            velocity_nav=velocity,
        )

    def correction_of(self, message: Any) -> tuple[Float, Float]:
        """Return ``map_T_body`` (4, 4) and its covariance (6, 6) in body, from a message with those of base."""
        body_T_base = se3_inverse(self.base_T_body)
        turned = se3_adjoint(body_T_base)
        return pose_of(message) @ self.base_T_body, turned @ covariance_of(message) @ turned.T


def optical_frame(camera: str) -> str:
    """Return the name of a camera's optical frame (x right, y down, z forward) from its name or that of its topic.

    It never begins with a slash, since tf2 refuses such names.
    """
    name = camera.strip("/")
    for suffix in _IMAGE_TOPICS:
        name = name.removesuffix(suffix)
    return name if name.endswith("optical_frame") else name + _OPTICAL


def _axis_rotations() -> list[Float]:
    """Return the 24 rotations (3, 3) that map axes to axes."""
    signed = (
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    )
    return [each for each in signed if np.linalg.det(each) > 0.0]
