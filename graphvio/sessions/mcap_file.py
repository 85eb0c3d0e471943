"""Reads MCAP files, also those whose writing was cut short: where each message is, and its bytes.

The end of a file that is whole has a summary; one that was cut has none. All that is needed stands before it, after
each chunk, so the file is read from the front, without the chunks' contents, and as far as it goes.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from graphvio.errors import MissingExtraError, SessionError
from graphvio.sessions.topics import Place, Topic

_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _ATTACHMENT, _HEADER, _DATA_END = 3, 4, 5, 6, 7, 9, 1, 15
_FOOTER, _STATISTICS = 2, 11
_LAST_KNOWN, _FIRST_PRIVATE = 15, 128
_PREFIX = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_ENTRY = np.dtype([("stamp_ns", "<u8"), ("offset", "<u8")])
_KEPT_CHUNKS = 8
_STAMP_END_NS = 2**62
_DAMAGE = (struct.error, ValueError, IndexError, OverflowError, MemoryError)


class McapFile:
    """An MCAP file, for any number of threads.

    Args:
        path: of the file.

    Attributes:
        library: that wrote it.
        topics: name -> messages.
        attachments: name -> content.
        is_whole: whether its writing was finished.
        damages: one line for each record that cannot be used, but for chunks, which are looked at as they are read.
        has_damaged_attachment: whether one of the attachments is left out for that.

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
        self.damages: list[str] = []
        self.has_damaged_attachment = False
        self._messages = 0
        self._broken: dict[int, str] = {}
        self._waiting: list[tuple[int, bytes]] = []  # chunks and indexes of channels that are not known yet
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
            SessionError: if it, or the chunk, is damaged.
        """
        try:
            with self._lock:
                if place.chunk < 0:
                    self._file.seek(place.offset)
                    opcode, length = _PREFIX.unpack(self._file.read(_PREFIX.size))
                    record = self._file.read(min(length, self._size))
                else:
                    data = self._chunk(place.chunk)
                    opcode, length = _PREFIX.unpack_from(data, place.offset)
                    begin = place.offset + _PREFIX.size
                    record = data[begin : begin + length]
            channel, _, logged_ns, _ = _MESSAGE_HEAD.unpack_from(record)
        except _DAMAGE as error:
            raise self._unreadable(place, str(error)) from None
        except OSError as error:
            raise self._unreadable(place, str(error.strerror)) from None
        if opcode != _MESSAGE or len(record) != length:
            raise self._unreadable(place, "it is none")
        if place.channel not in (-1, channel) or place.logged_ns not in (-1, logged_ns):
            raise self._unreadable(place, "it is not the one that the index tells")
        return record[_MESSAGE_HEAD.size :]

    @property
    def damaged_chunks(self) -> int:
        """How many of the chunks that have been read so far are damaged."""
        return len(self._broken)

    def _unreadable(self, place: Place, why: str) -> SessionError:
        where = f"byte {place.offset}" + (f" of the chunk at byte {place.chunk}" if place.chunk >= 0 else "")
        return SessionError(f"{self.path}: the message at {where} is damaged ({why}); copy the file anew")

    def _scan(self) -> None:
        if self._file.read(len(_MAGIC)) != _MAGIC:
            raise SessionError(f"{self.path}: is no MCAP file; check its name, or copy it anew")
        chunk = -1
        at = len(_MAGIC)
        while at + _PREFIX.size <= self._size:
            self._file.seek(at)
            opcode, length = _PREFIX.unpack(self._file.read(_PREFIX.size))
            if opcode == _FOOTER or at + _PREFIX.size + length > self._size:
                break  # the end, or cut short here
            if opcode == _DATA_END:
                self.is_whole = True
            elif opcode == _CHUNK:
                chunk = at
            elif opcode == 0 or _LAST_KNOWN < opcode < _FIRST_PRIVATE:
                self._note(at, f"no record is of kind {opcode}")
            else:
                try:
                    self._take_record(opcode, length, chunk, at)
                except _DAMAGE as error:
                    self._note(at, str(error))
            at += _PREFIX.size + length
        self._take_waiting()

    def _take_record(self, opcode: int, length: int, chunk: int, at: int) -> None:
        """A record outside of chunks; of those after the data, only what may have been lost with a chunk."""
        if self.is_whole:
            if opcode == _STATISTICS:
                self._take_statistics(at, self._file.read(length))
            elif opcode in (_SCHEMA, _CHANNEL) and self._waiting:
                self._take(opcode, self._file.read(length))
        elif opcode == _MESSAGE_INDEX:
            self._take_index(chunk, self._file.read(length))
        elif opcode == _MESSAGE:
            channel, _, logged_ns, _ = _MESSAGE_HEAD.unpack(self._file.read(_MESSAGE_HEAD.size))
            self._add(channel, logged_ns, -1, at)
        elif opcode in (_HEADER, _SCHEMA, _CHANNEL, _ATTACHMENT):
            self._take(opcode, self._file.read(length))

    def _note(self, at: int, why: str) -> None:
        self.damages.append(f"{self.path}: the record at byte {at} is damaged ({why}); it is left out")

    def _take_index(self, chunk: int, body: bytes) -> None:
        channel, size = struct.unpack_from("<HI", body)
        if channel not in self._by_channel:
            with suppress(SessionError, *_DAMAGE):  # its samples and images are missed where they are read
                self._take_channels(self._chunk(chunk))
            if channel not in self._by_channel:
                self._waiting.append((chunk, body))
                return
        if size % _ENTRY.itemsize:
            raise ValueError(f"an index of {size} bytes")
        for stamp, offset in np.frombuffer(body, _ENTRY, offset=6, count=size // _ENTRY.itemsize).tolist():
            self._add(channel, stamp, chunk, offset)

    def _take_waiting(self) -> None:
        """Indexes of damaged chunks whose channels another chunk, or the summary, tells."""
        lost = 0
        for chunk, body in self._waiting:
            (channel,) = struct.unpack_from("<H", body)
            if channel not in self._by_channel:
                lost += 1
                continue
            try:
                self._take_index(chunk, body)
            except _DAMAGE as error:
                self.damages.append(f"{self.path}: an index of the chunk at byte {chunk} is damaged ({error})")
        if lost:
            self.damages.append(f"{self.path}: {lost} indexes are of channels that damaged chunks had; copy it anew")
        if self._waiting:
            for topic in self.topics.values():
                topic.places.sort()
                topic.logged_ns = [place.logged_ns for place in topic.places]

    def _take_statistics(self, at: int, body: bytes) -> None:
        (told,) = struct.unpack_from("<Q", body)
        waiting = sum((len(index) - 6) // _ENTRY.itemsize for _, index in self._waiting)
        if told != self._messages + waiting:
            found = self._messages + waiting
            self._note(at, f"it tells of {told} messages, {found} are there")

    def _add(self, channel: int, logged_ns: int, chunk: int, offset: int) -> None:
        if logged_ns >= _STAMP_END_NS:
            raise ValueError(f"a message recorded at {logged_ns} ns")
        self._messages += 1
        topic = self._by_channel.get(channel)
        if topic is not None:
            topic.logged_ns.append(logged_ns)
            topic.places.append(Place(chunk, offset, channel, logged_ns))

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
            (crc,) = struct.unpack_from("<I", body, len(body) - 4)
            if crc and crc != zlib.crc32(body[:-4]):
                self.has_damaged_attachment = True
                raise ValueError("checksum of an attachment")
            name, at = _text(body, 16)
            _, at = _text(body, at)
            (length,) = struct.unpack_from("<Q", body, at)
            self.attachments[name] = body[at + 8 : at + 8 + length]

    def _chunk(self, at: int) -> bytes:
        """A chunk's records, unpacked."""
        if at in self._chunks:
            self._chunks.move_to_end(at)
            return self._chunks[at]
        if at not in self._broken:
            try:
                data = self._unpacked_chunk(at)
            except MissingExtraError:
                raise
            except Exception as error:  # each way of packing has errors of its own
                self._broken[at] = str(error) or type(error).__name__
        if at in self._broken:
            raise SessionError(
                f"{self.path}: the chunk at byte {at} is damaged ({self._broken[at]}); copy the file anew"
            )
        self._chunks[at] = data
        if len(self._chunks) > _KEPT_CHUNKS:
            self._chunks.popitem(last=False)
        return data

    def _unpacked_chunk(self, at: int) -> bytes:
        if at < 0:
            raise ValueError("there is none")
        self._file.seek(at)
        _, length = _PREFIX.unpack(self._file.read(_PREFIX.size))
        body = self._file.read(min(length, self._size))
        _, _, size, crc = _CHUNK_HEAD.unpack_from(body)
        compression, begin = _text(body, _CHUNK_HEAD.size)
        (packed,) = struct.unpack_from("<Q", body, begin)
        data = _unpacked(body[begin + 8 : begin + 8 + packed], compression, size)
        if len(data) != size:
            raise ValueError(f"{len(data)} bytes, not {size}")
        if crc and crc != zlib.crc32(data):
            raise ValueError("checksum")
        return data


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
