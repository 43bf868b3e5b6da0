"""Takes all that is whole out of an MCAP file, without trusting a length or a checksum in it."""

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, DataEnd, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from cell.errors import RecordingError

MAX_FILE_BYTES = 1 << 30
"""Size of a recording that is read."""

MAX_CHUNK_BYTES = 16 << 20
"""Unpacked size of one chunk that is read; the recorder makes chunks of 64 KiB."""

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


@dataclass(slots=True, kw_only=True)
class RawRecording:
    """Messages of a recording, decoded from JSON, in the order of the file.

    Attributes
    ----------
    metadata
        Records of metadata by name.
    messages
        Topic and content of each message.
    lost_reason
        Why something is missing; empty for a whole file.
    """

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    lost_reason: str = ""

    def lose(self, reason: str) -> None:
        """Note that something is missing; the first reason stays."""
        self.lost_reason = self.lost_reason or reason


def read_raw(path: Path) -> RawRecording:
    """Read every whole record of an MCAP file of JSON messages.

    A file that was cut off gives all complete chunks; a damaged chunk is left out. Both are said
    in ``lost_reason``.

    Raises
    ------
    RecordingError
        If the file cannot be read at all, is too large, or is no MCAP file.
    """
    data = _bytes_of(path)
    if data[:8] != b"\x89MCAP0\r\n":
        raise RecordingError(f"{path} is no recording: it does not start as an MCAP file")
    raw = RawRecording()
    channels: dict[int, Channel] = {}
    messages: list[Message] = []
    ended = False
    for record in _records(data, raw):
        if isinstance(record, DataEnd):
            ended = True
        elif ended and isinstance(record, Chunk | Metadata):
            # The checksum of the data does not reach so far.
            raw.lose("a piece of it stands behind its end")
        elif isinstance(record, Metadata):
            raw.metadata.setdefault(record.name, record.metadata)
        elif isinstance(record, Channel):
            channels.setdefault(record.id, record)
        elif isinstance(record, Chunk):
            for inner in _unpack(record, raw):
                if isinstance(inner, Channel):
                    channels.setdefault(inner.id, inner)
                elif isinstance(inner, Message):
                    messages.append(inner)
    if not ended:
        raw.lose("its end is missing")
    _decode_all(messages, channels, raw)
    return raw


def _bytes_of(path: Path) -> bytes:
    try:
        if path.exists() and not path.is_file():
            raise RecordingError(f"cannot read recording {path}: not a plain file")
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise RecordingError(f"{path} has {size} bytes, at most {MAX_FILE_BYTES} are read")
        return path.read_bytes()
    except OSError as cause:
        raise RecordingError(
            f"cannot read recording {path}: {cause.strerror}; check the path"
        ) from cause


def _records(data: bytes, raw: RawRecording) -> Iterator[Any]:
    # From memory, so that a length in the file never asks for more than the file has.
    reader = StreamReader(
        BytesIO(data), emit_chunks=True, validate_crcs=True, record_size_limit=len(data)
    )
    try:
        yield from reader.records
    except _DAMAGE as cause:
        raw.lose(f"the file is cut off or damaged ({_brief(cause)})")


def _unpack(chunk: Chunk, raw: RawRecording) -> list[Any]:
    try:
        plain = _decompress(chunk)
        if chunk.uncompressed_crc and zlib.crc32(plain) != chunk.uncompressed_crc:
            raise ValueError("wrong checksum")
        whole = Chunk(
            compression="",
            data=plain,
            message_start_time=chunk.message_start_time,
            message_end_time=chunk.message_end_time,
            uncompressed_crc=0,
            uncompressed_size=len(plain),
        )
        return list(breakup_chunk(whole))
    except _DAMAGE as cause:
        raw.lose(f"a chunk is damaged ({_brief(cause)})")
        return []


def _decompress(chunk: Chunk) -> bytes:
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise ValueError(f"{chunk.uncompressed_size} bytes unpacked, limit {MAX_CHUNK_BYTES}")
    if chunk.compression == "":
        return chunk.data
    if chunk.compression != "zstd":
        raise ValueError(f"compression {chunk.compression!r}, only zstd is read")
    # The size in the zstd frame decides how much is allocated, whatever the chunk says.
    if zstandard.frame_content_size(chunk.data) not in (chunk.uncompressed_size, -1):
        raise ValueError("two sizes contradict each other")
    return zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES).decompress(
        chunk.data, max_output_size=chunk.uncompressed_size
    )


def _decode_all(messages: list[Message], channels: dict[int, Channel], raw: RawRecording) -> None:
    for message in messages:
        channel = channels.get(message.channel_id)
        if channel is None:
            raw.lose(f"channel {message.channel_id} is not described")
        elif channel.message_encoding == "json":
            _decode(channel.topic, message.data, raw)


def _decode(topic: str, data: bytes, raw: RawRecording) -> None:
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as cause:
        raw.lose(f"a message of {topic} is no JSON ({_brief(cause)})")
        return
    if isinstance(content, dict):
        raw.messages.append((topic, content))
    else:
        raw.lose(f"a message of {topic} is no object")


def _brief(cause: BaseException) -> str:
    return f"{type(cause).__name__}: {str(cause)[:120]}".rstrip(": ")
