"""Reader of MCAP files, also of those whose writing was cut short: the place of each message, and its bytes.

A file that was cut short has no summary at its end. The same information also stands after each chunk, so a file is
scanned from the front, as far as it goes, without unpacking its chunks.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections import OrderedDict
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from graphvio.errors import SessionError, importing, reading
from graphvio.sessions.topics import Place, Store, Topic

with importing("mcap", "sessions", "reading a session"):
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.records import Attachment, Channel, Header, MessageIndex, Schema
    from mcap.stream_reader import StreamReader, get_chunk_data_stream
    from mcap.writer import MCAP0_MAGIC

_PREFIX = struct.Struct("<BQ")  # opcode and length of a record
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, times of recording and publishing
_COMPRESSIONS = ("", "lz4", "zstd")
_READ_RECORDS = (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX)
_MIN_PRIVATE = 128
_MAX_KEPT_CHUNKS = 8
_MAX_STAMP_NS = 2**62
_DAMAGE = (McapError, struct.error, ValueError, IndexError, OverflowError, MemoryError)


class McapFile(Store):
    """An MCAP file.

    Raises:
        SessionError: if it cannot be read or is no MCAP file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.is_whole = False  # until the file's end is found
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Topic] = {}
        self._pending: list[tuple[int, Any]] = []  # chunks and indexes of channels that are not known yet
        self._message_count = 0
        self._chunks: OrderedDict[int, bytes] = OrderedDict()
        self._damaged_chunks: dict[int, str] = {}
        self._lock = threading.Lock()
        with reading(path, SessionError, "check the path"):
            self._file: BinaryIO = path.open("rb")
            self._size = path.stat().st_size
            self._scan()

    def read(self, place: Place) -> bytes:
        """Return a message."""
        try:
            with self._lock:
                if place.chunk < 0:
                    opcode, record = _read_record(self._file, place.offset, self._size)
                else:
                    records = self._chunk(place.chunk)
                    opcode, record = _read_record(BytesIO(records), place.offset, len(records))
            channel, _, logged_ns, _ = _MESSAGE_HEAD.unpack_from(record, _PREFIX.size)
        except _DAMAGE as error:
            raise self._unreadable(place, str(error)) from None
        except OSError as error:
            raise self._unreadable(place, str(error.strerror)) from None
        if opcode != Opcode.MESSAGE:
            raise self._unreadable(place, "it is another record")
        if place.channel not in (-1, channel) or place.logged_ns not in (-1, logged_ns):
            raise self._unreadable(place, "it is not the one of the index")
        return record[_PREFIX.size + _MESSAGE_HEAD.size :]

    @property
    def damaged_chunks(self) -> int:
        """Number of damaged chunks among those that have been read so far."""
        return len(self._damaged_chunks)

    def _unreadable(self, place: Place, why: str) -> SessionError:
        where = f"byte {place.offset}" + (f" of the chunk at byte {place.chunk}" if place.chunk >= 0 else "")
        return SessionError(f"{self.path}: the message at {where} is damaged ({why}); copy the file again")

    def _scan(self) -> None:
        if self._file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise SessionError(f"{self.path}: is no MCAP file; check its name, or copy it again")
        chunk = -1
        at = len(MCAP0_MAGIC)
        while at + _PREFIX.size <= self._size:
            self._file.seek(at)
            opcode, length = _PREFIX.unpack(self._file.read(_PREFIX.size))
            if opcode == Opcode.FOOTER or at + _PREFIX.size + length > self._size:
                break  # the end, or cut short here
            if opcode == Opcode.DATA_END:
                self.is_whole = True
            elif opcode == Opcode.CHUNK:
                chunk = at
            try:
                self._scan_record(opcode, chunk, at)
            except _DAMAGE as error:
                self.damages.append(f"{self.path}: the record at byte {at} is damaged ({error}); it is left out")
                self.has_damaged_attachment |= opcode == Opcode.ATTACHMENT
            at += _PREFIX.size + length
        self._take_pending()

    def _scan_record(self, opcode: int, chunk: int, at: int) -> None:
        """Read a record outside of chunks; of the summary, only schemas and channels that were lost with a chunk."""
        if opcode < _MIN_PRIVATE:
            Opcode(opcode)  # raises a ValueError if there is no such record
        if not self.is_whole:
            if opcode == Opcode.MESSAGE:
                channel, _, logged_ns, _ = _MESSAGE_HEAD.unpack(self._file.read(_MESSAGE_HEAD.size))
                self._add(channel, logged_ns, -1, at)
            elif opcode in _READ_RECORDS:
                self._take(self._parsed(at), chunk)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and self._pending:
            self._take(self._parsed(at), chunk)
        elif opcode == Opcode.STATISTICS:
            expected = self._parsed(at).message_count
            found = self._message_count + sum(len(index.records) for _, index in self._pending)
            if found != expected:
                raise ValueError(f"it says that there are {expected} messages, {found} are there")

    def _take(self, record: Any, chunk: int) -> None:
        if isinstance(record, Header):
            self.library = record.library
        elif isinstance(record, Schema):
            self._schemas[record.id] = record.name
        elif isinstance(record, Channel):
            type_name = self._schemas.get(record.schema_id, "")
            topic = Topic(record.topic, type_name)
            self._channels[record.id] = self.topics.setdefault(record.topic, topic)
        elif isinstance(record, Attachment):
            self.attachments[record.name] = record.data
        elif isinstance(record, MessageIndex):
            self._take_index(chunk, record)

    def _take_index(self, chunk: int, index: Any) -> None:
        if index.channel_id not in self._channels:
            with suppress(SessionError, *_DAMAGE):  # raised again, and counted, where its samples and images are read
                for record in StreamReader(BytesIO(self._chunk(chunk)), skip_magic=True).records:
                    if isinstance(record, Schema | Channel):
                        self._take(record, chunk)
        if index.channel_id not in self._channels:
            self._pending.append((chunk, index))
            return
        for logged_ns, offset in index.records:
            self._add(index.channel_id, logged_ns, chunk, offset)

    def _take_pending(self) -> None:
        """Add the messages of damaged chunks whose channels are in another chunk or in the summary."""
        pending, self._pending = self._pending, []
        for chunk, index in pending:
            try:
                self._take_index(chunk, index)
            except _DAMAGE as error:
                self.damages.append(f"{self.path}: an index of the chunk at byte {chunk} is damaged ({error})")
        if self._pending:
            lost = len(self._pending)
            self.damages.append(f"{self.path}: {lost} indexes are of channels in damaged chunks; copy the file again")
        if pending:
            for topic in self.topics.values():
                topic.places.sort()
                topic.logged_ns = [place.logged_ns for place in topic.places]

    def _add(self, channel: int, logged_ns: int, chunk: int, offset: int) -> None:
        if logged_ns >= _MAX_STAMP_NS:
            raise ValueError(f"a message recorded at {logged_ns} ns")
        self._message_count += 1
        topic = self._channels.get(channel)
        if topic is not None:
            topic.logged_ns.append(logged_ns)
            topic.places.append(Place(chunk, offset, channel, logged_ns))

    def _parsed(self, at: int) -> Any:
        """Return the record at a position as an object of the library."""
        opcode, record = _read_record(self._file, at, self._size)
        if opcode == Opcode.ATTACHMENT:  # the library does not verify attachments
            crc = int.from_bytes(record[-4:], "little")
            if crc and crc != zlib.crc32(record[_PREFIX.size : -4]):
                raise ValueError("checksum of an attachment")
        return next(StreamReader(BytesIO(record), skip_magic=True, emit_chunks=True).records)

    def _chunk(self, at: int) -> bytes:
        """Return the records of a chunk, unpacked."""
        if at in self._chunks:
            self._chunks.move_to_end(at)
            return self._chunks[at]
        if at not in self._damaged_chunks:
            try:
                self._chunks[at] = _unpacked(self._parsed(at))
            except Exception as error:  # each compression has errors of its own
                self._damaged_chunks[at] = str(error) or type(error).__name__
        if at in self._damaged_chunks:
            why = self._damaged_chunks[at]
            raise SessionError(f"{self.path}: the chunk at byte {at} is damaged ({why}); copy the file again")
        if len(self._chunks) > _MAX_KEPT_CHUNKS:
            self._chunks.popitem(last=False)
        return self._chunks[at]


def _read_record(stream: BinaryIO, at: int, size: int) -> tuple[int, bytes]:
    """Return the opcode of a record and its bytes with the prefix, from a stream of ``size`` bytes."""
    stream.seek(at)
    opcode, length = _PREFIX.unpack(stream.read(_PREFIX.size))
    stream.seek(at)
    record = stream.read(min(_PREFIX.size + length, size))
    if len(record) != _PREFIX.size + length:
        raise ValueError("it is cut short")
    return opcode, record


def _unpacked(chunk: Any) -> bytes:
    if chunk.compression not in _COMPRESSIONS:
        raise ValueError(f"unknown compression {chunk.compression}")
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    if size != chunk.uncompressed_size:
        raise ValueError(f"{size} bytes, not {chunk.uncompressed_size}")
    return bytes(stream.read(size))
