"""Names of a session's topics and attachments, for those who write and those who read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from graphvio.sessions.mcap_file import Topic

ImageFormat = Literal["raw", "png"]
RIG_ATTACHMENT = "rig.yaml"
RIG_TOPIC = "/graphvio/rig"
"""The text of ``rig.yaml``, in files that have no attachments."""
IMU_TOPIC, TRANSFORMS_TOPIC, ODOMETRY_TOPIC, LOG_TOPIC = "/imu", "/tf_static", "/odometry", "/rosout"
TRUTH_TOPIC = "/ground_truth"


def image_topic(pair: str, side: str, image_format: ImageFormat) -> str:
    """Topic of a camera's images."""
    return f"/{pair}/{side}/image_raw" + ("/compressed" if image_format == "png" else "")


def of_type(topics: Mapping[str, Topic], *type_names: str) -> list[Topic]:
    """Topics that have messages, of the given types, by name."""
    return [topic for _, topic in sorted(topics.items()) if topic.type_name in type_names and topic.places]


def preference(topic: str) -> tuple[int, bool, str]:
    """Which of several topics with one camera's images to take: the least, as ``sorted`` has them.

    The images that D and K of its ``camera_info`` describe come first, then what is not packed.
    """
    parts = topic.split("/")
    images = [part for part in parts if part.startswith("image")]
    if "image_raw" in images:
        rank = 0
    elif any(part.startswith("image_rect") and not part.endswith("_raw") for part in images):
        rank = 3
    else:
        rank = 1 if any(part.endswith("_raw") for part in images) else 2
    return rank, _is_packed(parts), topic


def camera_of(topic: str, sides: tuple[str, ...]) -> str:
    """What the topics with one camera's images begin with: all before ``image_raw`` and the like.

    Args:
        topic: with images.
        sides: words that tell cameras apart; where one is in the last part, as in ``image_left``, that is kept.
    """
    parts = topic.split("/")
    for number, part in enumerate(parts):
        if part.startswith("image") and not any(side in part for side in sides):
            return "/".join(parts[:number])
    return "/".join(parts[:-1] if _is_packed(parts) else parts)


def _is_packed(parts: list[str]) -> bool:
    return parts[-1] in ("compressed", "compressedDepth", "theora", "ffmpeg", "zstd")
