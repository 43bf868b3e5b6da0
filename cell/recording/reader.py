"""Reading recordings: all whole messages of an MCAP file, as arrays and grasps, and a new file.

No checksum or value in the file is trusted: what does not fit is left out and named.
"""

import os
import struct
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from pydantic import ValidationError
from pydantic_core import from_json

from cell.errors import RecordingError, raised_as, reason_text
from cell.files import DAMAGE, RECORDING, open_plain, write_atomically
from cell.recording import schema
from cell.recording.grasp_limits import check_times
from cell.recording.recorder import MessageWriter
from recognition.grasp import Grasp, GraspCommand, PadArray, SelfZero

MAX_FILE_BYTES = 1 << 30
"""Largest recording that is read, in bytes: 8 hours of grasping."""
MAX_CHUNK_BYTES = 32 << 20
"""Largest record and unpacked chunk that is read, in bytes. The recorder makes chunks of 64 KiB,
the tools of MCAP those of 8 MiB."""
_RECORD = struct.Struct("<BQ")
"""Head of a record: its type and its length (MCAP specification, "Records")."""
_IN_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
"""Types of the records of a chunk."""
_reader = partial(StreamReader, emit_chunks=True, record_size_limit=MAX_CHUNK_BYTES)
_DAMAGE = (*DAMAGE, McapError, zstandard.ZstdError, struct.error)


class RecordedMessage(NamedTuple):
    """A message that fits its model."""

    topic: str
    content: dict[str, Any]
    """Its fields in `schema`."""
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
        self.n_of = Counter[str]()
        """Messages of each topic so far, also those that are left out."""
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
        with (
            open_plain(self.path, error=RecordingError, what="recording") as file,
            raised_as(RecordingError, OSError, where=f"cannot read recording {self.path}"),
        ):
            if (size := os.fstat(file.fileno()).st_size) > MAX_FILE_BYTES:
                raise RecordingError(
                    f"{self.path}: {size} bytes, at most {MAX_FILE_BYTES} bytes are read"
                )
            self._describe(file)
            file.seek(0)
            yield from self._messages(file)

    def _describe(self, file: BinaryIO) -> None:
        """Read the metadata, wherever they are in the file."""
        try:
            metadata: dict[str, str] = next(
                record.metadata
                for record in _reader(file).records
                if isinstance(record, Metadata) and record.name == schema.METADATA
            )
        except (StopIteration, *_DAMAGE) as cause:
            raise RecordingError(
                f"{self.path} is not a recording of this program: its metadata are missing. "
                "Choose a recording.mcap"
            ) from cause
        RECORDING.check(metadata.get("format"), self.path, RecordingError)
        if metadata.get("crc32") != schema.metadata_crc32(metadata):
            raise RecordingError(f"{self.path}: its description of clocks and pads is damaged")
        with raised_as(RecordingError, *_DAMAGE, where=f"{self.path} does not fit {RECORDING}"):
            self.pads = PadArray(**from_json(metadata["pads"]))
            self.wall_clock_start_ns = int(metadata["wall_clock_start_ns"])
            self.metadata = metadata

    def _messages(self, file: BinaryIO) -> Iterator[RecordedMessage]:
        try:
            for record in _reader(file, validate_crcs=True).records:
                if isinstance(record, DataEnd):
                    return
                for part in self._parts(record) if isinstance(record, Chunk) else [record]:
                    if isinstance(part, Channel):
                        topic = part.topic if part.message_encoding == "json" else ""
                        self._topics.setdefault(part.id, topic)
                    elif isinstance(part, Message) and (message := self._message(part)):
                        yield message
            self.lose("its end is missing")
        except _DAMAGE as cause:
            self.lose(f"the file is cut off or damaged ({reason_text(cause)})")

    def _parts(self, chunk: Chunk) -> list[McapRecord]:
        try:
            return breakup_chunk(_unpacked(chunk), validate_crc=True)
        except _DAMAGE as cause:
            self.lose(f"a chunk is left out: {reason_text(cause)}")
            return []

    def _message(self, record: Message) -> RecordedMessage | None:
        """Return a message of a known topic that fits its model; another one is reported."""
        if record.channel_id not in self._topics:
            self.lose("a channel is not described")
        topic = self._topics.get(record.channel_id, "")
        if topic not in schema.MODELS:
            return None
        self.n_of[topic] += 1
        try:
            content = schema.MODELS[topic].validate_json(record.data, strict=True)
            if topic == schema.FRAME:
                self._check_frame(content["counts"], content.get("extra", []))
        except ValueError as cause:
            self.lose(f"message {self.n_of[topic]} of {topic} is left out: {_refusal(cause)}")
            return None
        return RecordedMessage(topic, content, record.data)

    def _check_frame(self, counts: list[int], extra: list[int]) -> None:
        """Raise ValueError if a frame does not fit the pads, or the frames before it."""
        n, most = self.pads.n_taxels, self.pads.adc_max
        if len(counts) != n or max(counts) > most:
            raise ValueError(
                f"it has {len(counts)} counts up to {max(counts, default=0)}, expected {n} up to "
                f"{most}"
            )
        if len(extra) % n or self._n_extra not in (None, len(extra)):
            raise ValueError(f"it has {len(extra)} further samples of {n} taxels")
        self._n_extra = len(extra)


def _unpacked(chunk: Chunk) -> Chunk:
    """Return a chunk without compression; ValueError if it is too large or has other records.

    mcap unpacks whatever length the data have, and reads records of unknown types one by one.
    """
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"it unpacks to more than {MAX_CHUNK_BYTES} bytes")
    data = chunk.data
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    if len(data) != size:
        raise ValueError(f"it states {size} bytes, and unpacks to another length")
    at = 0
    while at < size:
        kind, length = _RECORD.unpack_from(data, at)
        if kind not in _IN_CHUNKS:
            raise ValueError(f"it has a record of the type {kind}")
        at += _RECORD.size + length
    return replace(chunk, compression="", data=data)


def _refusal(cause: ValueError) -> str:
    if not isinstance(cause, ValidationError):
        return str(cause)
    first = cause.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"])) or "it"
    value = "" if first["type"] in ("missing", "json_invalid") else f" is {first['input']!r:.40}"
    return f"{where}{value}: {first['msg']}"


Rows = np.recarray[Any, Any]
"""(n,) records in the order of time; each field is an array: ``rows.t_s``."""
_CYCLE_NUMBERS = (
    "t_s", "setpoint_n", "goal_current_a", "aperture_m", "current_a", "temperature_c",
)  # fmt: skip
_CYCLE = np.dtype(
    [("phase", "U16"), *((name, "f8") for name in _CYCLE_NUMBERS), ("force_n", "f8", 2)], align=True
)


def between(rows: Rows, begin_s: float, end_s: float) -> Rows:
    """Return the rows of a span of time in s, both ends included."""
    part = slice(bisect_left(rows.t_s, begin_s), bisect_right(rows.t_s, end_s))
    return rows[part].view(np.recarray)


class Recording(RecordedMessages):
    """Content of a recording; of a damaged or truncated file all valid data.

    Raises RecordingError if it is not a recording of this package, or so short that its description
    is missing.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        frames, frame_kind, cycles = bytearray(), np.dtype([]), bytearray()
        rows: defaultdict[str, list[dict[str, Any]]] = defaultdict(list)
        for topic, content, _ in self:
            if topic == schema.FRAME:
                extra = np.reshape(content.get("extra", ()), (self.pads.n_taxels, -1))
                frame_kind = frame_kind if frames else _frame_kind(*extra.shape)
                values = (content["t_s"], content["number"], content["counts"], extra)
                frames += np.array(values, frame_kind).tobytes()
            elif topic == schema.CYCLE:
                force_n = content.get("force_n", ())
                numbers = (content.get(name, np.nan) for name in _CYCLE_NUMBERS)
                both_n = force_n if len(force_n) == 2 else (np.nan, np.nan)
                cycles += np.array((content["phase"], *numbers, both_n), _CYCLE).tobytes()
            else:
                rows[topic].append(content)
        self.frames = _rows(frames, frame_kind if frames else _frame_kind(self.pads.n_taxels, 0))
        """Tactile frames: ``t_s`` is monotonic time in s, ``number`` counts all frames, a gap is a
        lost chunk; ``counts`` (n, n_taxels) uint16 are raw, ``extra`` (n, n_taxels, k) uint16
        further samples, k is 0 without any."""
        self.cycles = _rows(cycles, _CYCLE)
        """Periods of the force loop: ``phase`` of the gripper, its numbers as in `schema.Cycle`,
        among them ``force_n`` (n, 2) of both fingers; NaN where a value was not known."""
        self.poses, self.events, self.results, self.states, self.statistics = (
            tuple(rows[topic])
            for topic in (schema.POSE, schema.EVENT, schema.RESULT, schema.STATE, schema.LOOP)
        )
        """Messages as plain objects, fields as in `schema`."""
        grasps = self._whole_grasps(rows[schema.GRASP])
        self.grasps = tuple(grasp for grasp, _ in grasps.values())
        """The grasps with all their frames."""
        self.grasp_numbers = tuple(grasps)
        """Their numbers among all grasps in the file, from 0."""
        self.grasp_t_s = tuple(t_s for _, t_s in grasps.values())
        """Monotonic time in s of the first frame of each grasp."""
        self.n_broken_grasps = self.n_of[schema.GRASP] - len(grasps)
        """Number of grasps that are damaged or lack frames; they are not in ``grasps``."""
        if (
            not self.lost_reason
            and schema.RECOVERED not in self.metadata
            and np.any(self.frames.number != np.arange(len(self.frames)))
        ):
            self.lose(f"its {len(self.frames)} frames are not all that were recorded")

    @property
    def complete(self) -> bool:
        """Whether the file was closed and nothing in it is damaged."""
        return not self.lost_reason

    @property
    def incomplete(self) -> str:
        """What is lost, and how to save the whole grasps, if there are any, as text."""
        n_grasps = len(self.grasps)
        saves = f"; `tactile-cell recording recover` saves its {n_grasps} whole grasps"
        return f"not complete: {self.lost_reason}{saves if n_grasps else ''}"

    @property
    def identified(self) -> Iterator[tuple[dict[str, Any], list[int]]]:
        """Each result with the indices of its grasps, the newest unlabelled ones before it."""
        begin_s = -np.inf
        for row in self.results:
            end_s = float(row["t_s"])
            met = [i for i, t_s in enumerate(self.grasp_t_s) if begin_s < t_s <= end_s]
            begin_s = end_s
            n_grasps = max(1, int(row["n_grasps"]))
            yield row, [i for i in met if not self.grasps[i].label][-n_grasps:]

    def _whole_grasps(self, rows: list[dict[str, Any]]) -> dict[int, tuple[Grasp, float]]:
        """Return each whole grasp by its number, with the time of its first frame in s."""
        grasps, n_used, frames = dict[int, tuple[Grasp, float]](), 0, self.frames
        for number, row in enumerate(rows):
            first_frame, n_frames = row["first_frame"], row["n_frames"]
            first = bisect_left(frames.number, first_frame)
            part = slice(first, first + n_frames)
            try:
                numbers = frames.number[part]
                if not 0 < n_frames == len(numbers) or np.any(
                    np.diff(numbers, prepend=first_frame - 1) != 1
                ):
                    raise ValueError("frames of it are missing")
                if first_frame < n_used:
                    raise ValueError("its frames belong to other grasps")
                n_used = first_frame + n_frames
                grasp = _grasp(row, self.pads, frames, part)
                grasps[number] = (grasp, float(frames.t_s[first]))
            except (ValueError, OverflowError) as cause:
                self.lose(f"grasp {number + 1} is left out: {cause}")
        return grasps


def read_recording(path: Path | str) -> Recording:
    """Read a recording. Raises RecordingError as `Recording`."""
    return Recording(Path(path))


def recording_grasps(path: Path | str) -> tuple[Grasp, ...]:
    """Return the grasps of a recording.

    Raises RecordingError if it cannot be read, is not complete, or has no whole grasp.
    """
    recording = read_recording(path)
    if not recording.complete:
        raise RecordingError(f"{path} is {recording.incomplete}")
    if not recording.grasps:
        raise RecordingError(f"{path} has no whole grasp ({len(recording.frames)} frames)")
    return recording.grasps


def _frame_kind(n_taxels: int, n_extra: int) -> np.dtype[Any]:
    counts, extra = ("counts", "u2", (n_taxels,)), ("extra", "u2", (n_taxels, n_extra))
    return np.dtype([("t_s", "f8"), ("number", "i8"), counts, extra], align=True)


def _rows(data: bytearray, kind: np.dtype[Any]) -> Rows:
    rows = np.frombuffer(data, kind).view(np.recarray)
    rows.setflags(write=False)
    return rows


def _grasp(row: dict[str, Any], pads: PadArray, frames: Rows, part: slice) -> Grasp:
    """Return a grasp of these frames. Raises ValueError if it is refused."""
    names = ("label", "shape", "source", "start_ms", "aperture_m", "force_n")
    t_s = frames.t_s[part] - frames.t_s[part.start]
    check_times(t_s, np.array([0, len(t_s)]))
    return Grasp(
        pads=pads,
        counts=frames.counts[part].copy(),
        t_s=t_s,
        **{name: row[name] for name in names if name in row},
        command=GraspCommand.from_values(row["command"]) if "command" in row else None,
        zero=SelfZero.from_values(row["zero"]) if "zero" in row else None,
    )


def recover_recording(path: Path | str, target: Path | str) -> Recording:
    """Write all valid data of a recording to a new one; return what the old one has.

    Raises RecordingError if the old file is not a recording or has lost every message, or if the
    new file exists or cannot be written.
    """
    path, target = Path(path), Path(target)
    if target.exists():
        raise RecordingError(f"{target} exists; recordings are never overwritten, choose another")
    recording = read_recording(path)
    write_atomically(
        target, lambda file: _write(file, recording), error=RecordingError, what="recording"
    )
    return recording


def _write(file: BinaryIO, recording: Recording) -> None:
    entries = {key: value for key, value in recording.metadata.items() if key != "crc32"}
    if recording.lost_reason:
        entries[schema.RECOVERED] = f"from {recording.path.name}: {recording.lost_reason}"
    writer = MessageWriter(file, entries)
    n_written = n_grasps = 0
    for topic, content, data in RecordedMessages(recording.path):
        n_grasps += topic == schema.GRASP
        if topic != schema.GRASP or n_grasps - 1 in recording.grasp_numbers:
            writer.add(topic, content["t_s"], data)
            n_written += 1
    if recording.lost_reason and not n_written:
        raise RecordingError(
            f"nothing of {recording.path} can be recovered: {recording.lost_reason}"
        )
    writer.finish()
