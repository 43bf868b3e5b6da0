"""Recovery: from a truncated or damaged recording to a whole one with all valid data."""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from cell.data import recording_schema as schema
from cell.data.files import write_atomically
from cell.data.recording_messages import RecordedMessages
from cell.data.recording_reader import Recording, read_recording
from cell.data.recording_values import CHUNK_BYTES, start_recording, to_ns
from cell.errors import RecordingError


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovered:
    """Result of a recovery."""

    recording: Path
    """The new recording."""
    n_frames: int
    n_cycles: int
    n_grasps: int
    """Number of whole frames, periods of the loop, and grasps in it."""
    n_broken_grasps: int
    """Number of omitted grasps with missing or damaged frames."""
    lost_reason: str
    """Why the old recording is not complete, or empty."""


def recover_recording(path: Path | str, target: Path | str) -> Recovered:
    """Write all valid data of a recording to a new one; the old one does not change.

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
    return Recovered(
        recording=target,
        n_frames=len(recording.frames),
        n_cycles=len(recording.cycles),
        n_grasps=len(recording.grasps),
        n_broken_grasps=recording.n_broken_grasps,
        lost_reason=recording.lost_reason,
    )


def _write(file: BinaryIO, recording: Recording) -> None:
    entries = {key: value for key, value in recording.metadata.items() if key != "crc32"}
    if recording.lost_reason:
        entries[schema.RECOVERED] = f"from {recording.path.name}: {recording.lost_reason}"
    writer = Writer(
        file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
    )
    channels, n_written = start_recording(writer, entries), 0
    whole, n_grasps = set(recording.grasp_numbers), itertools.count()
    for topic, content, data in RecordedMessages(recording.path):
        if topic != schema.GRASP or next(n_grasps) in whole:
            stamp_ns = to_ns(content["t_s"])
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns)
            n_written += 1
    if recording.lost_reason and not n_written:
        raise RecordingError(
            f"nothing of {recording.path} can be recovered: {recording.lost_reason}"
        )
    writer.finish()  # type: ignore[no-untyped-call]
