"""The messages of a recording, one after the other: the whole ones in an MCAP file.

No checksum or value in the file is trusted: what does not fit is left out and named.
"""

import os
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from pydantic import ValidationError
from pydantic_core import from_json

from cell.data import recording_schema as schema
from cell.data.files import DAMAGE, open_plain
from cell.data.formats import RECORDING
from cell.errors import RecordingError, reason_text
from recognition.grasp import PadArray

MAX_FILE_BYTES = 1 << 30
"""Largest recording that is read, in bytes: 8 hours of grasping."""
MAX_CHUNK_BYTES = 32 << 20
"""Largest record and unpacked chunk that is read, in bytes. The recorder makes chunks of 64 KiB,
the tools of MCAP those of 8 MiB."""
MAX_EXTRA = 8
"""Most further samples of a taxel in a frame."""

_PACKINGS = ("", "zstd", "lz4")
_DAMAGE = (*DAMAGE, McapError, zstandard.ZstdError, struct.error)


class RecordedMessage(NamedTuple):
    """A message that fits its model."""

    topic: str
    content: dict[str, Any]
    """Its fields in `recording_schema`."""
    data: bytes
    """Its JSON."""


class RecordedMessages:
    """Yields the messages of a recording in the order of the file; iterate once.

    Raises RecordingError if the file cannot be read, is too large, or is not a recording of this
    package.
    """

    metadata: dict[str, str]
    pads: PadArray
    """Its metadata, and the pads of its frames; there from the first message on."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._first_loss, self._n_lost = "", 0
        self._topics: dict[int, str] = {}
        self._numbers = Counter[str]()
        self._chunks: set[tuple[int, int, int]] = set()
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
            if os.fstat(file.fileno()).st_size > MAX_FILE_BYTES:
                raise RecordingError(
                    f"{self.path}: too long; at most {MAX_FILE_BYTES} bytes are read"
                )
            try:
                self._describe(file)
                file.seek(0)
                yield from self._messages(file)
            except OSError as cause:
                raise RecordingError(
                    f"cannot read recording {self.path}: {cause.strerror}"
                ) from cause

    def _describe(self, file: BinaryIO) -> None:
        """Read the metadata, wherever they are in the file."""
        found, why = dict[str, str](), ""
        try:
            for record in _records(file):
                if isinstance(record, Metadata) and record.name == schema.METADATA:
                    found = dict(record.metadata)
                    break
        except _DAMAGE as cause:
            why = f" ({reason_text(cause)})"
        if not found:
            raise RecordingError(
                f"{self.path} is not a recording: it has no description, as {RECORDING} has{why}"
            )
        RECORDING.check(found.get("format"), self.path, RecordingError)
        if found.get("crc32") != schema.metadata_crc32(found):
            raise RecordingError(f"{self.path}: its description of clocks and pads is damaged")
        try:
            self.pads = PadArray(**from_json(found["pads"]))
            self.wall_clock_start_ns = int(found["wall_clock_start_ns"])
            self.monotonic_start_ns = int(found["monotonic_start_ns"])
            self.metadata = found
        except _DAMAGE as cause:
            raise RecordingError(
                f"{self.path}: its description does not fit {RECORDING} ({reason_text(cause)}); "
                "another program wrote it"
            ) from cause

    def _messages(self, file: BinaryIO) -> Iterator[RecordedMessage]:
        n_read, ended = 0, False
        try:
            for record in _records(file, validate_crcs=True):
                if isinstance(record, DataEnd):
                    ended = True
                elif isinstance(record, Statistics):
                    if n_read < record.message_count and not self._n_lost:
                        self.lose(f"{n_read} of its {record.message_count} messages are there")
                elif ended and isinstance(record, Chunk | Message):
                    # The checksum of the data does not include this part.
                    self.lose("data follow its end")
                elif not ended:
                    for part in self._parts(record):
                        n_read += isinstance(part, Message)
                        if (message := self._message(part)) is not None:
                            yield message
            if not ended:
                self.lose("its end is missing")
        except _DAMAGE as cause:
            self.lose(f"the file is cut off or damaged ({reason_text(cause)})")

    def _parts(self, record: McapRecord) -> list[McapRecord]:
        """Return the records of a chunk, or the record itself."""
        if not isinstance(record, Chunk):
            return [record]
        identity = (record.message_start_time, record.uncompressed_size, record.uncompressed_crc)
        try:
            if identity in self._chunks:
                # Its frames and grasps would count twice.
                raise ValueError("it repeats an earlier chunk")
            if record.compression not in _PACKINGS:
                raise ValueError(f"its compression {record.compression!r} is not read")
            if record.uncompressed_size > MAX_CHUNK_BYTES:
                raise ValueError(f"it unpacks to more than {MAX_CHUNK_BYTES} bytes")
            parts = breakup_chunk(record, validate_crc=True)
        except _DAMAGE as cause:
            self.lose(f"a chunk is left out: {reason_text(cause)}")
            return []
        self._chunks.add(identity)
        return parts

    def _message(self, record: McapRecord) -> RecordedMessage | None:
        """Return a message of a known topic that fits its model; another one is reported."""
        if isinstance(record, Channel):
            topic = record.topic if record.message_encoding == "json" else ""
            self._topics.setdefault(record.id, topic)
        if not isinstance(record, Message):
            return None
        if record.channel_id not in self._topics:
            self.lose("a channel is not described")
            return None
        topic = self._topics[record.channel_id]
        if topic not in schema.MODELS:
            return None
        self._numbers[topic] += 1
        try:
            content = schema.MODELS[topic].validate_json(record.data, strict=True)
            if topic == schema.FRAME:
                self._check_frame(content["counts"], content.get("extra", []))
        except ValueError as cause:
            self.lose(f"message {self._numbers[topic]} of {topic} is left out: {_refusal(cause)}")
            return None
        return RecordedMessage(topic, content, record.data)

    def _check_frame(self, counts: list[int], extra: list[int]) -> None:
        """Raise ValueError if a frame does not fit the pads, or the frames before it."""
        pads = self.pads
        if len(counts) != pads.n_taxels or max(counts) > pads.adc_max:
            raise ValueError(
                f"it has {len(counts)} counts up to {max(counts, default=0)}, expected "
                f"{pads.n_taxels} up to {pads.adc_max}"
            )
        if len(extra) % pads.n_taxels or len(extra) > MAX_EXTRA * pads.n_taxels:
            raise ValueError(
                f"it has {len(extra)} further samples, allowed are 0 to {MAX_EXTRA} for each taxel"
            )
        if self._n_extra not in (None, len(extra)):
            raise ValueError(
                f"it has {len(extra)} further samples, the frames before it have {self._n_extra}"
            )
        self._n_extra = len(extra)


def _records(file: BinaryIO, *, validate_crcs: bool = False) -> Iterator[McapRecord]:
    return StreamReader(
        file,
        emit_chunks=True,
        validate_crcs=validate_crcs,
        record_size_limit=MAX_CHUNK_BYTES,
    ).records


def _refusal(cause: ValueError) -> str:
    if not isinstance(cause, ValidationError):
        return str(cause)
    first = cause.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"])) or "it"
    value = "" if first["type"] in ("missing", "json_invalid") else f" is {first['input']!r:.40}"
    return f"{where}{value}: {first['msg']}"
