"""Reads MCAP files, also those whose writing was cut short: where each message is, and its bytes.

The end of a file that is whole has a summary; one that was cut has none. All that is needed stands before it, after
each chunk, so the file is read from the front, without the chunks' contents, and as far as it goes.
"""

from __future__ import annotations

import struct
import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from graphvio.arrays import Int
from graphvio.errors import MissingExtraError, SessionError

_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _ATTACHMENT, _HEADER, _DATA_END = 3, 4, 5, 6, 7, 9, 1, 15
_PREFIX = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_ENTRY = np.dtype([("stamp_ns", "<u8"), ("offset", "<u8")])
_KEPT_CHUNKS = 8


class Place(NamedTuple):
    """Where a message is: in the chunk at a position of the file, or at a position itself if the chunk is -1."""

    chunk: int
    offset: int


@dataclass
class Topic:
    """Messages of one topic, in the order of the file.

    Attributes:
        name: such as ``/imu``.
        type_name: such as ``sensor_msgs/msg/Imu``.
        encoding: of its messages, ``cdr`` for ROS 2.
        logged_ns: when each was recorded.
        places: where each is.
        header_ns: stamps of their headers, where the reader has seen them; else empty.
    """

    name: str
    type_name: str
    encoding: str
    logged_ns: list[int] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)
    header_ns: list[int] = field(default_factory=list)


class McapFile:
    """An MCAP file, for any number of threads.

    Args:
        path: of the file.

    Attributes:
        library: that wrote it.
        topics: name -> messages.
        attachments: name -> content.
        is_whole: whether its writing was finished.

    Raises:
        SessionError: if it cannot be read or is no MCAP file.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.library = ""
        self.topics: dict[str, Topic] = {}
        self.attachments: dict[str, bytes] = {}
        self.is_whole = False
        self._schemas: dict[int, str] = {}
        self._by_channel: dict[int, Topic] = {}
        self._chunks: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()
        try:
            self._file: BinaryIO = path.open("rb")
            self._size = path.stat().st_size
            self._scan()
        except OSError as error:
            raise SessionError(f"{path}: cannot be read ({error.strerror}); check the path") from None

    def read(self, place: Place) -> bytes:
        """A message.

        Raises:
            SessionError: if the chunk is damaged.
        """
        with self._lock:
            if place.chunk < 0:
                self._file.seek(place.offset)
                _, length = _PREFIX.unpack(self._file.read(_PREFIX.size))
                return self._file.read(length)[_MESSAGE_HEAD.size :]
            data = self._chunk(place.chunk)
        _, length = _PREFIX.unpack_from(data, place.offset)
        begin = place.offset + _PREFIX.size
        return data[begin + _MESSAGE_HEAD.size : begin + length]

    def _scan(self) -> None:
        if self._file.read(len(_MAGIC)) != _MAGIC:
            raise SessionError(f"{self.path}: is no MCAP file")
        chunk = -1
        at = len(_MAGIC)
        while at + _PREFIX.size <= self._size:
            self._file.seek(at)
            opcode, length = _PREFIX.unpack(self._file.read(_PREFIX.size))
            if at + _PREFIX.size + length > self._size:
                return  # cut short here
            if opcode == _DATA_END:
                self.is_whole = True
                return
            if opcode == _CHUNK:
                chunk = at
            elif opcode == _MESSAGE_INDEX:
                self._take_index(chunk, self._file.read(length))
            elif opcode == _MESSAGE:
                channel, _, logged_ns, _ = _MESSAGE_HEAD.unpack(self._file.read(_MESSAGE_HEAD.size))
                self._add(channel, logged_ns, Place(-1, at))
            elif opcode in (_HEADER, _SCHEMA, _CHANNEL, _ATTACHMENT):
                self._take(opcode, self._file.read(length))
            at += _PREFIX.size + length

    def _take_index(self, chunk: int, body: bytes) -> None:
        channel, size = struct.unpack_from("<HI", body)
        if channel not in self._by_channel:
            self._take_channels(self._chunk(chunk))
        for stamp, offset in np.frombuffer(body, _ENTRY, offset=6, count=size // _ENTRY.itemsize).tolist():
            self._add(channel, stamp, Place(chunk, offset))

    def _add(self, channel: int, logged_ns: int, place: Place) -> None:
        topic = self._by_channel.get(channel)
        if topic is not None:
            topic.logged_ns.append(logged_ns)
            topic.places.append(place)

    def _take_channels(self, data: bytes) -> None:
        """Schemas and channels of a chunk."""
        at = 0
        while at < len(data):
            opcode, length = _PREFIX.unpack_from(data, at)
            if opcode in (_SCHEMA, _CHANNEL):
                self._take(opcode, data[at + _PREFIX.size : at + _PREFIX.size + length])
            at += _PREFIX.size + length

    def _take(self, opcode: int, body: bytes) -> None:
        if opcode == _HEADER:
            _, rest = _text(body, 0)
            self.library, _ = _text(body, rest)
        elif opcode == _SCHEMA:
            (number,) = struct.unpack_from("<H", body)
            self._schemas[number], _ = _text(body, 2)
        elif opcode == _CHANNEL:
            number, schema = struct.unpack_from("<HH", body)
            name, at = _text(body, 4)
            encoding, _ = _text(body, at)
            topic = self.topics.setdefault(name, Topic(name, self._schemas.get(schema, ""), encoding))
            self._by_channel[number] = topic
        elif opcode == _ATTACHMENT:
            name, at = _text(body, 16)
            _, at = _text(body, at)
            (length,) = struct.unpack_from("<Q", body, at)
            self.attachments[name] = body[at + 8 : at + 8 + length]

    def _chunk(self, at: int) -> bytes:
        """A chunk's records, unpacked."""
        if at in self._chunks:
            self._chunks.move_to_end(at)
            return self._chunks[at]
        self._file.seek(at)
        _, length = _PREFIX.unpack(self._file.read(_PREFIX.size))
        body = self._file.read(length)
        _, _, size, _ = _CHUNK_HEAD.unpack_from(body)
        compression, begin = _text(body, _CHUNK_HEAD.size)
        try:
            data = _unpacked(body[begin + 8 :], compression, size)
        except (RuntimeError, ValueError) as error:
            raise SessionError(f"{self.path}: the chunk at byte {at} is damaged ({error})") from None
        self._chunks[at] = data
        if len(self._chunks) > _KEPT_CHUNKS:
            self._chunks.popitem(last=False)
        return data


def stamps_of(topic: Topic) -> Int:
    """When its messages were recorded (N,)."""
    return np.array(topic.logged_ns, dtype=np.int64)


def _text(body: bytes, at: int) -> tuple[str, int]:
    """A text, and where it ends."""
    (length,) = struct.unpack_from("<I", body, at)
    return body[at + 4 : at + 4 + length].decode("utf-8", "replace"), at + 4 + length


def _unpacked(data: bytes, compression: str, size: int) -> bytes:
    if not compression:
        return data
    try:
        if compression == "lz4":
            import lz4.frame

            return bytes(lz4.frame.decompress(data))
        if compression == "zstd":
            import zstandard

            return bytes(zstandard.ZstdDecompressor().decompress(data, max_output_size=size))
    except ImportError:
        raise MissingExtraError("mcap", "sessions", "reading or writing a session") from None
    raise ValueError(f"packed by {compression}, which is not known")
