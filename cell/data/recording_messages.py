"""The messages of a recording, one after the other: what is whole in an MCAP file, within limits.

No length, checksum or value in the file is trusted: what does not fit is left out and named. The
limits bound time and memory by the size of the file, which packs far more than a recorder does
where it was made to harm.
"""

import os
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Metadata
from mcap.stream_reader import StreamReader
from pydantic_core import from_json

from cell.data import recording_schema as schema
from cell.data.files import open_plain
from cell.data.formats import RECORDING
from cell.errors import RecordingError, reason_text
from recognition.grasp import PadArray

MAX_FILE_BYTES = 1 << 30
"""Size of a recording that is read: 8 hours of grasping."""
MAX_CHUNK_BYTES = 8 << 20
"""Unpacked size of one chunk that is read; the recorder makes chunks of 64 KiB."""
FREE_BYTES = 4 << 20
"""Bytes that a file of any size may unpack to, and its content take."""
MAX_PACKING = 64
"""Bytes that a file may unpack to, and its content take, for each byte of it. Recordings of a cell
have 5; of a simulated one without noise, on which nothing happens, 26."""
MAX_KEPT_BYTES = 2 << 30
"""Bytes that the content of any file may take; 8 hours of grasping take 1.7 GB."""
FREE_MESSAGES, MESSAGE_BYTES = 1000, 16
"""Messages of a file of any size, and bytes of a file for each further one: its entry in the
index."""
MAX_MESSAGES = 10_000_000
"""Messages of any file: 10 hours of grasping."""
MAX_BRACKETS = 10_000
"""Lists and objects in a message: they cost most; those of a cell have 100 at most."""
MAX_TIME_S = 1e9
"""Latest monotonic time in s: a machine that has run for 30 years."""

_ROW_BYTES = 100
"""Memory of a period of the loop, and of a frame beside its counts: numbers in arrays."""
_MESSAGE_SHARE = 20
"""Memory of a message that is kept as it is, for each byte of its JSON, at most."""
_RECORD = struct.Struct("<BQ")
"""Code and length before each record of MCAP."""
_HEAD_BYTES = 22
"""Channel, number and times before the content of a message."""
_LARGEST = {"integer": (1 << 63) - 1, "number": 1e15}
"""Largest magnitude of a number of a message: integers become arrays of 64 bits, and a factor of
1000 overflows no float."""
_KINDS: Mapping[str, tuple[type, ...]] = {
    "number": (float, int),
    "integer": (int,),
    "string": (str,),
    "boolean": (bool,),
    "array": (list,),
    "object": (dict,),
}
"""Python's types of the types of a JSON schema."""
_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    ArithmeticError,
    MemoryError,
    EOFError,
)


class RecordedMessage(NamedTuple):
    """A message that fits its schema."""

    topic: str
    content: dict[str, Any]
    """Its fields in `recording_schema`; the counts of a frame as ``array("H")``."""
    data: bytes
    """Its JSON."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Description:
    """What stands at the begin of a recording."""

    metadata: dict[str, str]
    pads: PadArray
    """The pads of its frames."""
    wall_clock_start_ns: int
    monotonic_start_ns: int
    """Both clocks at the start in ns."""


class RecordedMessages:
    """Yields the messages of a recording in the order of the file; to be iterated once.

    Raises RecordingError if the file cannot be read, is too large, or is no recording of ours:
    its description comes first.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._metadata: dict[str, str] = {}
        self._first_loss, self._n_lost, self._cut_off = "", 0, False
        self._channels: dict[int, str] = {}
        self._chunks: set[tuple[int, int, int]] = set()
        self._numbers: Counter[str] = Counter()
        self._left_bytes = self._left_messages = 0

    @property
    def lost_reason(self) -> str:
        """Why something is missing, and how much more is; empty where all is whole."""
        return self._first_loss + (f" ({self._n_lost} losses)" if self._n_lost > 1 else "")

    def lose(self, reason: str) -> None:
        """Note that something is left out."""
        self._first_loss = self._first_loss or reason
        self._n_lost += 1

    def __iter__(self) -> Iterator[RecordedMessage]:
        with open_plain(self.path, error=RecordingError, what="recording") as file:
            yield from self._messages(file, os.fstat(file.fileno()).st_size)

    def _messages(self, file: BinaryIO, n_bytes: int) -> Iterator[RecordedMessage]:
        if n_bytes > MAX_FILE_BYTES:
            raise RecordingError(f"{self.path}: too long; at most {MAX_FILE_BYTES} bytes are read")
        if file.read(8) != b"\x89MCAP0\r\n":
            raise RecordingError(f"{self.path} is no recording: it does not start as an MCAP file")
        file.seek(0)
        left_bytes, ended = FREE_BYTES + MAX_PACKING * n_bytes, False
        self._left_bytes = min(MAX_KEPT_BYTES, left_bytes)
        self._left_messages = min(MAX_MESSAGES, FREE_MESSAGES + n_bytes // MESSAGE_BYTES)
        for record in self._records(file):
            if isinstance(record, Metadata) and record.name == schema.METADATA:
                self._metadata = self._metadata or record.metadata
            elif isinstance(record, DataEnd):
                ended = True
            elif isinstance(record, Chunk) and ended:
                # The checksum of the data does not reach so far.
                self.lose("a piece of it stands behind its end")
            elif isinstance(record, Chunk):
                pads = self.description.pads  # before anything is unpacked
                try:
                    if (left_bytes := left_bytes - record.uncompressed_size) < 0:
                        raise _Full(f"it unpacks to more than {MAX_PACKING} times its size")
                    yield from self._unpacked(record, pads)
                except _Full as full:
                    self.lose(f"{full}: the rest of it is left out")
                    return
                except _DAMAGE as cause:
                    self.lose(f"a chunk is damaged ({_brief(cause)})")
        if not ended and not self._cut_off:
            self.lose("its end is missing")

    def _records(self, file: BinaryIO) -> Iterator[Any]:
        # A length in the file never asks for more than a chunk may have.
        longest = MAX_CHUNK_BYTES + FREE_BYTES
        try:
            yield from StreamReader(
                file, emit_chunks=True, validate_crcs=True, record_size_limit=longest
            ).records
        except OSError as cause:
            raise RecordingError(f"cannot read recording {self.path}: {cause.strerror}") from cause
        except _DAMAGE as cause:
            self._cut_off = True
            self.lose(f"the file is cut off or damaged ({_brief(cause)})")

    @cached_property
    def description(self) -> Description:
        """The description. Raises RecordingError where it is missing, or none of ours."""
        found = self._metadata
        if not found:
            why = f" ({self.lost_reason})" if self._n_lost else ""
            raise RecordingError(f"{self.path} has no description, as {RECORDING} has{why}")
        RECORDING.check(found.get("format"), self.path, RecordingError)
        if found.get("crc32") != schema.metadata_crc32(found):
            raise RecordingError(f"{self.path}: its description of clocks and pads is damaged")
        try:
            return Description(
                metadata=dict(found),
                pads=PadArray(**from_json(found["pads"])),
                wall_clock_start_ns=int(found["wall_clock_start_ns"]),
                monotonic_start_ns=int(found["monotonic_start_ns"]),
            )
        except _DAMAGE as cause:
            raise RecordingError(
                f"{self.path}: its description does not fit {RECORDING} ({_brief(cause)}); it "
                "was written by something else"
            ) from cause

    def _unpacked(self, chunk: Chunk, pads: PadArray) -> Iterator[RecordedMessage]:
        """Yield the messages of a chunk, those that are whole and fit."""
        identity = (chunk.message_start_time, chunk.uncompressed_size, chunk.uncompressed_crc)
        if identity in self._chunks:
            # Its frames and grasps would count twice.
            raise ValueError("the same chunk stands before it")
        plain = _decompress(chunk)
        if chunk.uncompressed_crc and zlib.crc32(plain) != chunk.uncompressed_crc:
            raise ValueError("wrong checksum")
        self._chunks.add(identity)
        for code, content in _records_in(plain):
            if code == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(content)))
                topic = channel.topic if channel.message_encoding == "json" else ""
                self._channels.setdefault(channel.id, topic)
            elif code == Opcode.MESSAGE:
                found = self._message(content, pads)
                if found is not None:
                    yield found

    def _message(self, record: bytes, pads: PadArray) -> RecordedMessage | None:
        """Return a message where it fits its schema; None for one of a topic that is none of ours.

        One that does not fit is None, too, and named.
        """
        topic = self._channels.get(int.from_bytes(record[:2], "little"))
        if topic is None:
            self.lose("a channel is not described")
            return None
        if topic not in schema.SCHEMAS:
            return None
        self._numbers[topic] += 1
        self._left_messages -= 1
        if self._left_messages < 0:
            raise _Full("it has more messages than a file of its size can have")
        data = record[_HEAD_BYTES:]
        try:
            if data.count(b"[") + data.count(b"{") > MAX_BRACKETS:
                raise ValueError(f"it has more than {MAX_BRACKETS} lists and objects")
            content = _checked(topic, from_json(data), pads)
        except _DAMAGE as cause:
            self.lose(f"message {self._numbers[topic]} of {topic} is left out: {_brief(cause)}")
            return None
        as_array = {schema.FRAME: _ROW_BYTES + 2 * pads.n_taxels, schema.CYCLE: _ROW_BYTES}
        self._left_bytes -= as_array.get(topic, _MESSAGE_SHARE * len(data))
        if self._left_bytes < 0:
            raise _Full("its content takes more memory than a file of its size can")
        return RecordedMessage(topic, content, data)


class _Full(Exception):
    """A limit of what is read of one file is reached."""


def _decompress(chunk: Chunk) -> bytes:
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise ValueError(f"{chunk.uncompressed_size} bytes unpacked, limit {MAX_CHUNK_BYTES}")
    if chunk.compression == "":
        return chunk.data
    if chunk.compression != "zstd":
        raise ValueError(f"compression {chunk.compression!r}, only zstd is read")
    # The size in the zstd frame decides how much is allocated, not the size in the chunk.
    if zstandard.frame_content_size(chunk.data) not in (chunk.uncompressed_size, -1):
        raise ValueError("two sizes contradict each other")
    return zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES).decompress(
        chunk.data, max_output_size=chunk.uncompressed_size
    )


def _records_in(plain: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield code and content of each record of an unpacked chunk."""
    at = 0
    while at < len(plain):
        code, size = _RECORD.unpack_from(plain, at)
        begin = at + _RECORD.size
        at = begin + size
        if at > len(plain):
            raise ValueError("a record of it is cut off")
        yield code, plain[begin:at]


def _checked(topic: str, content: Any, pads: PadArray) -> dict[str, Any]:
    """Return the content of a message. Raises ValueError where it does not fit its schema."""
    if not isinstance(content, dict):
        raise ValueError("it is no object")
    properties = schema.SCHEMAS[topic]["properties"]
    for name in schema.SCHEMAS[topic]["required"]:
        if name not in content:
            raise ValueError(f"{name} is missing")
    if topic == schema.FRAME:
        content["counts"] = _counts(content["counts"], pads)
    known = {name: value for name, value in content.items() if name in properties}
    for name, value in known.items():
        if name != "counts":
            _check(name, value, properties[name])
    if not 0.0 <= content["t_s"] <= MAX_TIME_S:
        raise ValueError(f"its time is {content['t_s']:g} s, must be 0 to {MAX_TIME_S:g} s")
    return known


def _counts(counts: Any, pads: PadArray) -> "array[int]":
    """Return the counts of a frame. Raises ValueError where the pads cannot have them."""
    try:
        found = array("H", counts)
    except (TypeError, OverflowError):
        raise ValueError("its counts are no list of numbers from 0 to 65535") from None
    if len(found) != pads.n_taxels or max(found) > pads.adc_max:
        raise ValueError(
            f"it has {len(found)} counts up to {max(found, default=0)}, expected {pads.n_taxels} "
            f"up to {pads.adc_max}"
        )
    return found


def _check(name: str, value: Any, described: Mapping[str, Any]) -> None:
    """Raise ValueError where a value is not of the type that the schema has for it."""
    kind = described["type"]
    fits = isinstance(value, _KINDS[kind]) and (kind == "boolean" or not isinstance(value, bool))
    if not fits:
        raise ValueError(f"{name} is {value!r:.40}, expected {kind}")
    if kind in _LARGEST:
        largest = _LARGEST[kind]
        if not described.get("minimum", -largest) <= value <= largest:
            raise ValueError(f"{name} is {value!s:.40}, out of its range")
    if kind == "array":
        for item in value:
            _check(f"an item of {name}", item, described["items"])
    if kind == "object":
        properties, others = described.get("properties", {}), described.get("additionalProperties")
        for key, item in value.items():
            if expected := properties.get(key, others):
                _check(f"{key} of {name}", item, expected)


def _brief(cause: Exception) -> str:
    return reason_text(cause)[:120]
