"""Conversion of measurements, rigs and estimates to ROS 2 messages and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from graphvio.arrays import Float, Image
from graphvio.cameras import COEFFICIENTS
from graphvio.errors import SessionError
from graphvio.geometry import quat_wxyz_from_rotation, rotation_from_quat_wxyz, se3
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import ImuSample
from graphvio.rig import Camera, Rig
from graphvio.sessions.cdr import make

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMU, CAMERA_INFO, TRANSFORMS = "sensor_msgs/msg/Imu", "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
LOG, TEXT = "rcl_interfaces/msg/Log", "std_msgs/msg/String"
STAMPED = (IMAGE, COMPRESSED, IMU, CAMERA_INFO, ODOMETRY, POSE)
"""Types of messages that begin with a header."""
ODOM, BODY = "odom", "base_link"
"""ROS names of the frames nav and body, as in REP 105."""
WORLD = "world"
"""Frame of the true trajectory."""

_NS_PER_S = 1_000_000_000
_STAMP_END_S = 2**31
_UNKNOWN = -1.0  # in the first element of a covariance: the quantity is not measured
ROS_DISTORTIONS = {"radial-tangential": "plumb_bob", "equidistant": "equidistant", "rational": "rational_polynomial"}
"""ROS's names of lens models; models for which ROS has no name are written with graphvio's."""
_WARN = 30


def header(stamp_ns: int, frame: str) -> Any:
    """Return a ``std_msgs/Header``."""
    return make("std_msgs/msg/Header", stamp=_time(stamp_ns), frame_id=frame)


def image(stamp_ns: int, frame: str, pixels: Image) -> Any:
    """Return the message of a grey image (height, width) uint8."""
    height, width = pixels.shape
    return make(
        IMAGE,
        header=header(stamp_ns, frame),
        height=height,
        width=width,
        encoding="mono8",
        is_bigendian=0,
        step=width,
        data=np.ascontiguousarray(pixels).reshape(-1),
    )


def compressed_image(stamp_ns: int, frame: str, png: bytes) -> Any:
    """Return the message of an image in a PNG."""
    return make(
        COMPRESSED, header=header(stamp_ns, frame), format="mono8; png compressed", data=np.frombuffer(png, np.uint8)
    )


def imu(sample: ImuSample) -> Any:
    """Return the message of a sample, without orientation."""
    unknown = np.zeros(9)
    unknown[0] = _UNKNOWN
    return make(
        IMU,
        header=header(sample.stamp_ns, BODY),
        orientation=_quaternion(np.eye(3)),
        orientation_covariance=unknown,
        angular_velocity=_vector(sample.angular_velocity),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector(sample.linear_acceleration),
        linear_acceleration_covariance=np.zeros(9),
    )


def imu_sample(message: Any) -> ImuSample:
    """Return the sample in a message."""
    rates, forces = message.angular_velocity, message.linear_acceleration
    return ImuSample(
        stamp_of(message.header),
        np.array([rates.x, rates.y, rates.z]),
        np.array([forces.x, forces.y, forces.z]),
    )


def camera_info(stamp_ns: int, camera: Camera) -> Any:
    """Return the ``CameraInfo`` of a camera: intrinsics and distortion."""
    fx, fy, cx, cy = camera.intrinsics
    return make(
        CAMERA_INFO,
        header=header(stamp_ns, camera.name),
        height=camera.size_px[1],
        width=camera.size_px[0],
        distortion_model=ROS_DISTORTIONS.get(camera.model, camera.model),
        d=camera.distortion[: len(COEFFICIENTS[camera.model])].copy(),
        k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        r=np.eye(3).reshape(-1),
        p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
        binning_x=0,
        binning_y=0,
        roi=make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def static_transforms(stamp_ns: int, rig: Rig) -> Any:
    """Return the transforms ``body_T_cam`` of all cameras."""
    return make(
        TRANSFORMS,
        transforms=[transform(stamp_ns, BODY, camera.name, camera.body_T_cam) for camera in rig.cameras],
    )


def transform(stamp_ns: int, parent: str, child: str, parent_T_child: Float) -> Any:
    """Return a ``geometry_msgs/TransformStamped``."""
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(stamp_ns, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=_vector(parent_T_child[:3, 3]),
            rotation=_quaternion(parent_T_child[:3, :3]),
        ),
    )


def odometry(estimate: Estimate) -> Any:
    """Return the message of an estimate that has a pose.

    ROS orders covariances ``[translation, rotation]``, and that of the pose is in the fixed axes. Angular rates are
    those of the newest interval: the fused ones, otherwise those of the gyro, otherwise those of vision. Values that
    are not estimated, such as the covariance of the rates, are NaN.
    """
    assert estimate.nav_T_body is not None
    assert estimate.covariance is not None
    R = estimate.nav_T_body[:3, :3]
    rate = angular_rate(estimate.rates)
    velocity, twist_covariance = np.full(3, np.nan), np.full((6, 6), np.nan)
    if estimate.velocity_nav is not None and estimate.velocity_covariance is not None:
        velocity = R.T @ estimate.velocity_nav
        twist_covariance[:3, :3] = R.T @ estimate.velocity_covariance @ R
    return make(
        ODOMETRY,
        header=header(estimate.stamp_ns, ODOM),
        child_frame_id=BODY,
        pose=pose_with_covariance(estimate.nav_T_body, estimate.covariance),
        twist=make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=make("geometry_msgs/msg/Twist", linear=_vector(velocity), angular=_vector(rate)),
            covariance=twist_covariance.reshape(-1),
        ),
    )


def angular_rate(rates: Mapping[str, Float]) -> Float:
    """Return the best of an estimate's angular rates (3,), NaN where there is none."""
    return next((rates[kind] for kind in ("fused", "gyro", "vision") if kind in rates), np.full(3, np.nan))


def pose_with_covariance(a_T_body: Float, covariance: Float) -> Any:
    """Return a ``geometry_msgs/PoseWithCovariance``.

    Args:
        a_T_body: pose (4, 4) of body.
        covariance: its covariance (6, 6), tangent ``[rotation, translation]`` in body.
    """
    turned = _fixed_axes(a_T_body)
    return make(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=_pose(a_T_body),
        covariance=(turned @ covariance @ turned.T).reshape(-1),
    )


def covariance_of(message: Any) -> Float:
    """Return the covariance (6, 6) in a message with pose, tangent ``[rotation, translation]`` in body."""
    turned = _fixed_axes(pose_of(message))
    return np.asarray(turned.T @ np.asarray(message.pose.covariance, dtype=np.float64).reshape(6, 6) @ turned)


def pose_stamped(stamp_ns: int, frame: str, frame_T_body: Float) -> Any:
    """Return a ``geometry_msgs/PoseStamped``."""
    return make(POSE, header=header(stamp_ns, frame), pose=_pose(frame_T_body))


def pose_of(message: Any) -> Float:
    """Return the pose (4, 4) in a message of a pose, of a pose with covariance, of an odometry or of a transform."""
    if hasattr(message, "transform"):
        q, t = message.transform.rotation, message.transform.translation
    else:
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        q, t = pose.orientation, pose.position
    return se3(rotation_from_quat_wxyz(np.array([q.w, q.x, q.y, q.z])), np.array([t.x, t.y, t.z]))


def text(content: str) -> Any:
    """Return the message of a text."""
    return make(TEXT, data=content)


def log(event: Event) -> Any:
    """Return an event as a line of ``/rosout``."""
    return make(
        LOG,
        stamp=_time(event.stamp_ns),
        level=_WARN,
        name=event.kind,
        msg=event.detail,
        file="",
        function="",
        line=0,
    )


def stamp_of(message_header: Any) -> int:
    """Return the nanoseconds of a header's stamp."""
    return int(message_header.stamp.sec) * _NS_PER_S + int(message_header.stamp.nanosec)


def _time(stamp_ns: int) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, _NS_PER_S)
    if not 0 <= seconds < _STAMP_END_S:
        raise SessionError(f"stamp {stamp_ns} ns is not within 1970 to 2038, which ROS messages can hold")
    return make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def _fixed_axes(a_T_body: Float) -> Float:
    """Return the (6, 6) map from ``[rotation, translation]`` in body to ROS's ``[translation, rotation]`` in a."""
    turned = np.zeros((6, 6))
    turned[:3, 3:] = turned[3:, :3] = a_T_body[:3, :3]
    return turned


def _pose(a_T_body: Float) -> Any:
    position, orientation = _vector(a_T_body[:3, 3], "Point"), _quaternion(a_T_body[:3, :3])
    return make("geometry_msgs/msg/Pose", position=position, orientation=orientation)


def _vector(values: Float, kind: str = "Vector3") -> Any:
    x, y, z = map(float, values)
    return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _quaternion(rotation: Float) -> Any:
    w, x, y, z = map(float, quat_wxyz_from_rotation(np.ascontiguousarray(rotation)))
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
