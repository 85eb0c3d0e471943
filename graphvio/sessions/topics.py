"""Names of a session's topics and attachments, for those who write and those who read them."""

from __future__ import annotations

from typing import Literal

ImageFormat = Literal["raw", "png"]
RIG_ATTACHMENT = "rig.yaml"
RIG_TOPIC = "/graphvio/rig"
"""The text of ``rig.yaml``, in files that have no attachments."""
IMU_TOPIC, TRANSFORMS_TOPIC, ODOMETRY_TOPIC, LOG_TOPIC = "/imu", "/tf_static", "/odometry", "/rosout"
TRUTH_TOPIC = "/ground_truth"


def image_topic(pair: str, side: str, image_format: ImageFormat) -> str:
    """Topic of a camera's images."""
    return f"/{pair}/{side}/image_raw" + ("/compressed" if image_format == "png" else "")
