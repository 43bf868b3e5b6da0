"""Reading recordings: all that is whole in an MCAP file, as arrays and grasps.

No length and no checksum in the file is trusted: what does not fit is left out and named.
"""

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from io import BytesIO
from pathlib import Path
from typing import Any, Self

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, DataEnd, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from numpy.typing import NDArray

from cell.data import recording_schema as schema
from cell.data.dataset import text_refused
from cell.data.files import read_plain
from cell.data.formats import RECORDING
from cell.errors import RecordingError, reason_text
from recognition.grasp import Grasp, GraspCommand, PadArray, SelfZero

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
    """Messages of a recording, decoded from JSON, in the order of the file."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """Records of metadata by name."""
    messages: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    """Topic and content of each message."""
    lost_reason: str = ""
    """Why something is missing; empty for a whole file."""

    def lose(self, reason: str) -> None:
        """Note that something is missing; the first reason stays."""
        self.lost_reason = self.lost_reason or reason


def read_raw(path: Path) -> RawRecording:
    """Read every whole record of an MCAP file of JSON messages.

    A file that was cut off gives all complete chunks; a damaged chunk is left out; ``lost_reason``
    names both. Raises RecordingError if the file cannot be read at all, is too large, or is no MCAP
    file.
    """
    data = read_plain(path, error=RecordingError, what="recording", limit_bytes=MAX_FILE_BYTES)
    if data[:8] != b"\x89MCAP0\r\n":
        raise RecordingError(f"{path} is no recording: it does not start as an MCAP file")
    raw = RawRecording()
    channels: dict[int, Channel] = {}
    messages: list[Message] = []
    unpacked: set[tuple[int, int, int]] = set()
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
            for inner in _unpack(record, raw, unpacked):
                if isinstance(inner, Channel):
                    channels.setdefault(inner.id, inner)
                elif isinstance(inner, Message):
                    messages.append(inner)
    if not ended:
        raw.lose("its end is missing")
    _decode_all(messages, channels, raw)
    return raw


def _records(data: bytes, raw: RawRecording) -> Iterator[Any]:
    # From memory, so that a length in the file never asks for more than the file has.
    reader = StreamReader(
        BytesIO(data), emit_chunks=True, validate_crcs=True, record_size_limit=len(data)
    )
    try:
        yield from reader.records
    except _DAMAGE as cause:
        raw.lose(f"the file is cut off or damaged ({_brief(cause)})")


def _unpack(chunk: Chunk, raw: RawRecording, unpacked: set[tuple[int, int, int]]) -> list[Any]:
    identity = (chunk.message_start_time, chunk.uncompressed_size, chunk.uncompressed_crc)
    try:
        if identity in unpacked:
            # Its frames and grasps would count twice.
            raise ValueError("the same chunk stands before it")
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
        records = list(breakup_chunk(whole))
    except _DAMAGE as cause:
        raw.lose(f"a chunk is damaged ({_brief(cause)})")
        return []
    unpacked.add(identity)
    return records


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


def _brief(cause: Exception) -> str:
    return reason_text(cause)[:120]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedFrames:
    """Tactile frames in the order of time."""

    t_s: NDArray[np.float64]
    """(n,) float64: monotonic time in s."""
    number: NDArray[np.int64]
    """(n,) int64: number of the frame in the recording; a gap is a lost chunk."""
    counter: NDArray[np.int64]
    status: NDArray[np.int64]
    """(n,) int64: as the control unit sent them."""
    counts: NDArray[np.uint16]
    """(n, n_taxels) uint16: raw counts."""

    def __len__(self) -> int:
        return len(self.t_s)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedCycles:
    """Periods of the force loop in the order of time; NaN where a value was not known."""

    t_s: NDArray[np.float64]
    """(n,) float64: monotonic time in s."""
    phase: tuple[str, ...]
    """Phase of the gripper in each period."""
    setpoint_n: NDArray[np.float64]
    goal_current_a: NDArray[np.float64]
    aperture_m: NDArray[np.float64]
    current_a: NDArray[np.float64]
    temperature_c: NDArray[np.float64]
    """(n,) float64: set-point in N, goal current in A, opening in m, present current in A,
    temperature of the warmest servo in degrees Celsius."""
    force_n: NDArray[np.float64]
    """(n, 2) float64: tactile force on both fingers in N."""

    def __len__(self) -> int:
        return len(self.t_s)

    def between(self, begin_s: float, end_s: float) -> Self:
        """Return the periods of a span of time in s, both ends included."""
        part = slice(*np.searchsorted(self.t_s, [begin_s, np.nextafter(end_s, np.inf)]))
        return type(self)(**{one.name: getattr(self, one.name)[part] for one in fields(self)})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """What a recording holds."""

    path: Path
    metadata: dict[str, str]
    pads: PadArray
    """Where it lies, its metadata, the pads of its frames."""
    wall_clock_start_ns: int
    monotonic_start_ns: int
    """Both clocks at the start in ns."""
    frames: RecordedFrames
    cycles: RecordedCycles
    """As arrays."""
    poses: tuple[dict[str, Any], ...] = ()
    events: tuple[dict[str, Any], ...] = ()
    results: tuple[dict[str, Any], ...] = ()
    states: tuple[dict[str, Any], ...] = ()
    statistics: tuple[dict[str, Any], ...] = ()
    """Messages as plain objects, fields as in `recording_schema`."""
    grasps: tuple[Grasp, ...] = ()
    """The grasps of which every frame is there."""
    whole_grasps: tuple[dict[str, Any], ...] = ()
    """Their messages."""
    grasp_t_s: tuple[float, ...] = ()
    """Monotonic time in s of the first frame of each of them."""
    n_broken_grasps: int = 0
    """Grasps of which frames are missing or damaged; they are not in ``grasps``."""
    complete: bool = True
    """Whether the file was closed and nothing in it is damaged."""
    lost_reason: str = ""
    """Why not; empty where complete."""


def read_recording(path: Path | str) -> Recording:
    """Read a recording; of one that was cut off or damaged, all that is whole.

    Raises RecordingError if it is no recording of ours, or so short that its description is
    missing.
    """
    path = Path(path)
    raw = read_raw(path)
    try:
        return _Builder(path, raw).build()
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as cause:
        raise RecordingError(
            f"{path}: a message does not fit {RECORDING} ({reason_text(cause)}); "
            "it was written by something else"
        ) from cause


def recording_grasps(path: Path | str) -> tuple[Grasp, ...]:
    """Return the grasps of a recording.

    Raises RecordingError if it cannot be read, is not complete, or holds no whole grasp.
    """
    recording = read_recording(path)
    if not recording.complete:
        raise RecordingError(
            f"{path} is not complete: {recording.lost_reason}. "
            f"{len(recording.grasps)} whole grasps can be salvaged: `tactile-cell recover` does it"
        )
    if not recording.grasps:
        raise RecordingError(f"{path} holds no whole grasp ({len(recording.frames)} frames)")
    return recording.grasps


@dataclass(slots=True)
class _Builder:
    path: Path
    raw: RawRecording
    by_topic: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def build(self) -> Recording:
        metadata = self.raw.metadata.get(schema.METADATA)
        if metadata is None:
            why = f" ({self.raw.lost_reason})" if self.raw.lost_reason else ""
            raise RecordingError(f"{self.path} has no description, as {RECORDING} has{why}")
        RECORDING.check(metadata.get("format"), self.path, RecordingError)
        if metadata.get("crc32") != schema.metadata_crc32(metadata):
            raise RecordingError(f"{self.path}: its description of clocks and pads is damaged")
        for topic, content in self.raw.messages:
            self.by_topic.setdefault(topic, []).append(content)
        pads = PadArray(**json.loads(metadata["pads"]))
        frames = self._frames(pads)
        grasps = self._grasps(pads, frames)
        return Recording(
            path=self.path,
            metadata=dict(metadata),
            pads=pads,
            wall_clock_start_ns=int(metadata["wall_clock_start_ns"]),
            monotonic_start_ns=int(metadata["monotonic_start_ns"]),
            frames=frames,
            cycles=self._cycles(),
            poses=tuple(self.by_topic.get(schema.POSE, ())),
            events=tuple(self.by_topic.get(schema.EVENT, ())),
            results=tuple(self.by_topic.get(schema.RESULT, ())),
            states=tuple(self.by_topic.get(schema.STATE, ())),
            statistics=tuple(self.by_topic.get(schema.LOOP, ())),
            grasps=tuple(grasp for grasp, _, _ in grasps),
            whole_grasps=tuple(row for _, row, _ in grasps),
            grasp_t_s=tuple(begin_s for _, _, begin_s in grasps),
            n_broken_grasps=len(self.by_topic.get(schema.GRASP, ())) - len(grasps),
            complete=not self.raw.lost_reason,
            lost_reason=self.raw.lost_reason,
        )

    def _frames(self, pads: PadArray) -> RecordedFrames:
        rows = self.by_topic.get(schema.FRAME, [])
        counts = np.array([row["counts"] for row in rows], dtype=np.uint16)
        return RecordedFrames(
            t_s=_column(rows, "t_s"),
            number=np.array([row["number"] for row in rows], dtype=np.int64),
            counter=np.array([row["counter"] for row in rows], dtype=np.int64),
            status=np.array([row["status"] for row in rows], dtype=np.int64),
            counts=_read_only(counts.reshape(len(rows), pads.n_taxels)),
        )

    def _cycles(self) -> RecordedCycles:
        rows = self.by_topic.get(schema.CYCLE, [])
        unknown = [np.nan, np.nan]
        force_n = np.array([row.get("force_n", unknown) for row in rows], dtype=np.float64)
        return RecordedCycles(
            t_s=_column(rows, "t_s"),
            phase=tuple(str(row["phase"]) for row in rows),
            setpoint_n=_column(rows, "setpoint_n"),
            goal_current_a=_column(rows, "goal_current_a"),
            aperture_m=_column(rows, "aperture_m"),
            current_a=_column(rows, "current_a"),
            temperature_c=_column(rows, "temperature_c"),
            force_n=_read_only(force_n.reshape(len(rows), 2)),
        )

    def _grasps(
        self, pads: PadArray, frames: RecordedFrames
    ) -> list[tuple[Grasp, dict[str, Any], float]]:
        grasps: list[tuple[Grasp, dict[str, Any], float]] = []
        place_of = {int(number): place for place, number in enumerate(frames.number)}
        for row in self.by_topic.get(schema.GRASP, ()):
            first, n_frames = int(row["first_frame"]), int(row["n_frames"])
            if n_frames > len(frames):
                continue
            places = [place_of[n] for n in range(first, first + n_frames) if n in place_of]
            if len(places) < n_frames:
                continue
            counts = frames.counts[places]
            if schema.counts_crc32(counts) != row["counts_crc32"]:
                self.raw.lose("the counts of a grasp do not have its checksum")
                continue
            for name in ("label", "shape", "source"):
                if wrong := text_refused(name, str(row[name])):
                    raise ValueError(f"the {name} of a grasp {wrong}")
            unknown = [np.nan] * n_frames
            grasp = Grasp(
                pads=pads,
                counts=counts,
                t_s=np.array(row["frame_t_s"]),
                aperture_m=np.array(row.get("aperture_m", unknown)),
                force_n=np.array(row.get("force_n", unknown)),
                label=str(row["label"]),
                shape=str(row["shape"]),
                source=str(row["source"]),
                start_ms=int(row["start_ms"]),
                command=GraspCommand.from_values(row["asked"]) if "asked" in row else None,
                zero=SelfZero.from_values(row["self_zero"]) if "self_zero" in row else None,
            )
            grasps.append((grasp, row, float(frames.t_s[places[0]])))
        return grasps


def _column(rows: list[dict[str, Any]], name: str) -> NDArray[np.float64]:
    return _read_only(np.array([row.get(name, np.nan) for row in rows], dtype=np.float64))


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.setflags(write=False)
    return array
