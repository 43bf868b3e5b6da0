"""The messages of a recording, one after the other: the whole ones in an MCAP file, within limits.

No length, checksum or value in the file is trusted: invalid messages are omitted and reported. The
limits bound time and memory by the size of the file: a hostile file can unpack to far more data
than a recorder's.
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
from cell.data.files import DAMAGE, open_plain
from cell.data.formats import RECORDING
from cell.errors import RecordingError, reason_text
from recognition.grasp import PadArray

MAX_FILE_BYTES = 1 << 30
"""Largest recording that is read, in bytes: 8 hours of grasping."""
MAX_CHUNK_BYTES = 8 << 20
"""Largest unpacked chunk that is read, in bytes; the recorder makes chunks of 64 KiB."""
FREE_BYTES = 4 << 20
"""Unpacked bytes, and memory of the content, that a file of any size may have."""
MAX_PACKING = 64
"""Unpacked bytes, and memory of the content, for each byte of a file. Recordings of a cell have 5;
recordings of an idle simulated cell without noise 26."""
MAX_KEPT_BYTES = 2 << 30
"""Most memory in bytes for the content of any file; 8 hours of grasping take 1.7 GB."""
FREE_MESSAGES, MESSAGE_BYTES = 1000, 16
"""Messages of a file of any size, and bytes of a file for each further message: its entry in the
index."""
MAX_MESSAGES = 10_000_000
"""Most messages of any file: 10 hours of grasping."""
MAX_BRACKETS = 10_000
"""Most lists and objects in a message, which cost most; messages of a cell have at most 100."""
MAX_TIME_S = 1e9
"""Latest monotonic time in s: a machine that has run for 30 years."""

MAX_EXTRA = 8
"""Most further samples of a taxel in a frame."""
_ROW_BYTES = 100
"""Memory in bytes of a period of the loop, and of a frame without its samples: numbers in
arrays."""
_MESSAGE_SHARE = 20
"""Most memory in bytes of a message kept unchanged, for each byte of its JSON."""
_RECORD = struct.Struct("<BQ")
"""Code and length before each record of MCAP."""
_HEAD_BYTES = 22
"""Channel, number and times before the content of a message."""
_LARGEST = {"integer": (1 << 63) - 1, "number": 1e15}
"""Largest magnitude of a number of a message: integers fit arrays of 64 bits, and a factor of 1000
overflows no float."""
_KINDS: Mapping[str, tuple[type, ...]] = {
    "number": (float, int),
    "integer": (int,),
    "string": (str,),
    "boolean": (bool,),
    "array": (list,),
    "object": (dict,),
}
"""Python types of the types of a JSON schema."""
_DAMAGE = (*DAMAGE, McapError, zstandard.ZstdError, struct.error)


class RecordedMessage(NamedTuple):
    """A message that fits its schema."""

    topic: str
    content: dict[str, Any]
    """Its fields in `recording_schema`; the samples of a frame as ``array("H")``."""
    data: bytes
    """Its JSON."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Description:
    """Description at the start of a recording."""

    metadata: dict[str, str]
    pads: PadArray
    """The pads of its frames."""
    wall_clock_start_ns: int
    monotonic_start_ns: int
    """Both clocks at the start in ns."""


class RecordedMessages:
    """Yields the messages of a recording in the order of the file; iterate once.

    Raises RecordingError if the file cannot be read, is too large, or is not a recording of this
    package: its description comes first.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._metadata: dict[str, str] = {}
        self._first_loss, self._n_lost, self._cut_off = "", 0, False
        self._channels: dict[int, str] = {}
        self._chunks: set[tuple[int, int, int]] = set()
        self._numbers: Counter[str] = Counter()
        self._left_bytes = self._left_messages = 0
        self._n_extra: int | None = None

    @property
    def lost_reason(self) -> str:
        """Why data are missing, and how many more losses there are; empty if complete."""
        return self._first_loss + (f" ({self._n_lost} losses)" if self._n_lost > 1 else "")

    def lose(self, reason: str) -> None:
        """Note a loss."""
        self._first_loss = self._first_loss or reason
        self._n_lost += 1

    def __iter__(self) -> Iterator[RecordedMessage]:
        with open_plain(self.path, error=RecordingError, what="recording") as file:
            yield from self._messages(file, os.fstat(file.fileno()).st_size)

    def _messages(self, file: BinaryIO, n_bytes: int) -> Iterator[RecordedMessage]:
        if n_bytes > MAX_FILE_BYTES:
            raise RecordingError(f"{self.path}: too long; at most {MAX_FILE_BYTES} bytes are read")
        if file.read(8) != b"\x89MCAP0\r\n":
            raise RecordingError(f"{self.path} is not a recording: it is not an MCAP file")
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
                # The checksum of the data does not include this part.
                self.lose("data follow its end")
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
        # A length in the file never causes a read of more than a chunk.
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
        """The description. Raises RecordingError if it is missing, or of another program."""
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
                f"{self.path}: its description does not fit {RECORDING} ({_brief(cause)}); "
                "another program wrote it"
            ) from cause

    def _unpacked(self, chunk: Chunk, pads: PadArray) -> Iterator[RecordedMessage]:
        """Yield the valid messages of a chunk."""
        identity = (chunk.message_start_time, chunk.uncompressed_size, chunk.uncompressed_crc)
        if identity in self._chunks:
            # Its frames and grasps would count twice.
            raise ValueError("it repeats an earlier chunk")
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
        """Return a message if it fits its schema; None for an unknown topic.

        An invalid message is reported and gives None.
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
            if topic == schema.FRAME:
                self._check_extra(len(content.get("extra", ())), pads)
        except _DAMAGE as cause:
            self.lose(f"message {self._numbers[topic]} of {topic} is left out: {_brief(cause)}")
            return None
        n_samples = pads.n_taxels + (self._n_extra or 0)
        as_array = {schema.FRAME: _ROW_BYTES + 2 * n_samples, schema.CYCLE: _ROW_BYTES}
        self._left_bytes -= as_array.get(topic, _MESSAGE_SHARE * len(data))
        if self._left_bytes < 0:
            raise _Full("its content takes more memory than a file of its size can")
        return RecordedMessage(topic, content, data)

    def _check_extra(self, n_extra: int, pads: PadArray) -> None:
        """Raise ValueError unless all frames have equally many further samples of each taxel."""
        if n_extra % pads.n_taxels or n_extra > MAX_EXTRA * pads.n_taxels:
            raise ValueError(
                f"it has {n_extra} further samples, allowed are 0 to {MAX_EXTRA} for each taxel"
            )
        if self._n_extra not in (None, n_extra):
            raise ValueError(
                f"it has {n_extra} further samples, the frames before it have {self._n_extra}"
            )
        self._n_extra = n_extra


class _Full(Exception):
    """A limit of one file is reached."""


def _decompress(chunk: Chunk) -> bytes:
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise ValueError(f"{chunk.uncompressed_size} bytes unpacked, limit {MAX_CHUNK_BYTES}")
    if chunk.compression == "":
        return chunk.data
    if chunk.compression != "zstd":
        raise ValueError(f"compression {chunk.compression!r}, only zstd is read")
    # The size in the zstd frame sets the allocation, not the size in the chunk.
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
    """Return the content of a message. Raises ValueError if it does not fit its schema."""
    if not isinstance(content, dict):
        raise ValueError("it is not an object")
    properties = schema.SCHEMAS[topic]["properties"]
    for name in schema.SCHEMAS[topic]["required"]:
        if name not in content:
            raise ValueError(f"{name} is missing")
    if topic == schema.FRAME:
        content["counts"] = _counts(content["counts"], pads)
        if "extra" in content:
            content["extra"] = _samples(content["extra"])
    known = {name: value for name, value in content.items() if name in properties}
    for name, value in known.items():
        if not isinstance(value, array):
            _check(name, value, properties[name])
    if not 0.0 <= content["t_s"] <= MAX_TIME_S:
        raise ValueError(f"its time is {content['t_s']:g} s, must be 0 to {MAX_TIME_S:g} s")
    return known


def _counts(counts: Any, pads: PadArray) -> "array[int]":
    """Return the counts of a frame. Raises ValueError if they do not fit the pads."""
    found = _samples(counts)
    if len(found) != pads.n_taxels or max(found) > pads.adc_max:
        raise ValueError(
            f"it has {len(found)} counts up to {max(found, default=0)}, expected {pads.n_taxels} "
            f"up to {pads.adc_max}"
        )
    return found


def _samples(samples: Any) -> "array[int]":
    try:
        return array("H", samples)
    except (TypeError, OverflowError):
        raise ValueError("its counts are not a list of numbers from 0 to 65535") from None


def _check(name: str, value: Any, described: Mapping[str, Any]) -> None:
    """Raise ValueError if a value has another type than in the schema."""
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
