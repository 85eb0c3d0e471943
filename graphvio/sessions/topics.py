"""Topics of sessions and bags: their names, their messages, and the choice among several."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import numpy as np

from graphvio.arrays import Int
from graphvio.rig import CameraGroup, StereoPair

ImageFormat = Literal["raw", "png"]
RIG_ATTACHMENT = "rig.yaml"
RIG_TOPIC = "/graphvio/rig"
"""Topic with the text of ``rig.yaml`` in files without attachments."""
IMU_TOPIC, TRANSFORMS_TOPIC, ODOMETRY_TOPIC, LOG_TOPIC = "/imu", "/tf_static", "/odometry", "/rosout"
TRUTH_TOPIC = "/ground_truth"
_MASK = "mask"


class Place(NamedTuple):
    """Position of a message in a file."""

    chunk: int  # byte of the file at which the message's chunk begins, -1 if it is in none; for bags, the connection
    offset: int  # byte of the message in the unpacked chunk, or in the file; for bags, its row or time
    channel: int = -1  # number of the message's channel, -1 if unknown
    logged_ns: int = -1  # time of its recording, -1 if unknown


@dataclass
class Topic:
    """Messages of one topic, in the order of the file."""

    name: str  # name of the topic, such as ``/imu``
    type_name: str  # type of its messages, such as ``sensor_msgs/msg/Imu``
    logged_ns: list[int] = field(default_factory=list)  # time of recording of each message
    places: list[Place] = field(default_factory=list)  # position of each message
    # stamps of the messages' headers if the reader decodes them, otherwise empty
    header_ns: list[int] = field(default_factory=list)

    @property
    def logged_stamps_ns(self) -> Int:
        """(N,) `logged_ns` as an array."""
        return np.array(self.logged_ns, dtype=np.int64)


class MessageReader(Protocol):
    """Interface to messages by topic, of a file or of a running system."""

    path: Path  # path of the file, or a name for error messages
    topics: dict[str, Topic]

    def read(self, place: Place) -> bytes:
        """Return a message as CDR.

        Raises:
            SessionError: if it is damaged.
        """


def sides_of(group: CameraGroup) -> tuple[str, ...]:
    """Return the parts of topic names that stand for a group's cameras: left and right, or mono."""
    return ("left", "right") if isinstance(group, StereoPair) else ("mono",)


def image_topic(pair: str, side: str, image_format: ImageFormat) -> str:
    """Return the topic of a camera's images."""
    return f"/{pair}/{side}/image_raw" + ("/compressed" if image_format == "png" else "")


def mask_topic(pair: str, side: str, image_format: ImageFormat) -> str:
    """Return the topic of the masks of a camera's images."""
    return f"/{pair}/{side}/{_MASK}" + ("/compressed" if image_format == "png" else "")


def is_mask(topic: str) -> bool:
    """Return whether a topic has masks, judging by its name: ``mask`` is one of its last two parts."""
    return _MASK in topic.split("/")[-2:]


def of_type(topics: Mapping[str, Topic], *type_names: str) -> list[Topic]:
    """Return the topics of the given types that have messages, sorted by name."""
    return [topic for _, topic in sorted(topics.items()) if topic.type_name in type_names and topic.places]


def preference(topic: str) -> tuple[int, bool, str]:
    """Return a sort key that is smallest for the topic to use among several with one camera's images.

    Images that D and K of ``camera_info`` describe come first, then raw before compressed ones.
    """
    parts = topic.split("/")
    images = [part for part in parts if part.startswith("image")]
    if "image_raw" in images:
        rank = 0
    elif any(part.startswith("image_rect") and not part.endswith("_raw") for part in images):
        rank = 3
    else:
        rank = 1 if any(part.endswith("_raw") for part in images) else 2
    return rank, _is_compressed(parts), topic


def camera_of(topic: str, sides: tuple[str, ...]) -> str:
    """Return the common beginning of the topics with one camera's images: the parts before ``image_raw`` or similar.

    If a word of ``sides`` is in the last part, as in ``image_left``, that part is kept.
    """
    parts = topic.split("/")
    for number, part in enumerate(parts):
        if part.startswith("image") and not any(side in part for side in sides):
            return "/".join(parts[:number])
    return "/".join(parts[:-1] if _is_compressed(parts) else parts)


def _is_compressed(parts: list[str]) -> bool:
    return parts[-1] in ("compressed", "compressedDepth", "theora", "ffmpeg", "zstd")


class Store(ABC):
    """Base class of an open session or bag, for any number of threads; a `MessageReader`."""

    def __init__(self, path: Path) -> None:
        self.path = path  # path of the file, or of the folder of a ROS 2 bag
        self.topics: dict[str, Topic] = {}  # name -> topic
        self.library = ""  # name of the library that wrote it; empty for bags
        self.attachments: dict[str, bytes] = {}  # name -> content; none in bags
        self.is_whole = True  # whether its writing was finished
        self.damages: list[str] = []  # one line for each record that cannot be used
        self.has_damaged_attachment = False  # whether an attachment is among these

    @abstractmethod
    def read(self, place: Place) -> bytes:
        """Return a message as CDR.

        Raises:
            SessionError: if it is damaged.
        """

    @property
    def damaged_chunks(self) -> int:
        """Number of damaged chunks among those that have been read so far; bags have none."""
        return 0
