"""One MCAP file of a recording during writing; a disk failure stops the file, not the caller."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from mcap.writer import CompressionType, Writer

from cell.data import recording_schema as schema
from cell.data.recorder_sink import BackgroundFile, DirectFile
from cell.data.recording_values import CHUNK_BYTES, start_recording
from cell.errors import RecordingError


class RecordingFile:
    """A new file with its description; later failures are kept in ``fault`` and never raised.

    Raises RecordingError if the file cannot be made; an existing one is never overwritten.

    Parameters
    ----------
    path
        The new file.
    entries
        Metadata that describe the recording.
    background
        Write in a separate thread.
    """

    def __init__(self, path: Path, entries: Mapping[str, str], *, background: bool) -> None:
        self.path = path
        self.fault: RecordingError | None = None
        """Why the file ended early; None while it is written."""
        self.n_frames = 0
        """Frames so far."""
        self._sequence: dict[str, int] = {}
        self._marks: list[tuple[int, int]] = []
        try:
            self._sink = (BackgroundFile if background else DirectFile)(path)
        except FileExistsError as cause:
            raise RecordingError(
                f"{path} exists; recordings are never overwritten, choose another name"
            ) from cause
        except OSError as cause:
            raise RecordingError(
                f"cannot record to {path}: {cause.strerror}; check folder and rights"
            ) from cause
        writer = self._writer = Writer(
            _Marked(self._sink, self._mark),  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self._channels: dict[str, int] = {}
        self._guarded(lambda: self._channels.update(start_recording(writer, entries)))
        if self.fault is None:
            self._marks.append((self._sink.tell(), 0))

    @property
    def n_bytes(self) -> int:
        """Bytes on the disk."""
        return self._sink.written_bytes()

    @property
    def n_readable(self) -> int:
        """Number of readable frames of a file that has stopped."""
        return max((n for length, n in self._marks if length <= self.n_bytes), default=0)

    def add(self, topic: str, stamp_ns: int, data: bytes) -> None:
        """Add a message: its topic, monotonic time in ns, and JSON; does nothing after a fault."""
        self.n_frames += topic == schema.FRAME
        number = self._sequence.get(topic, 0)
        self._sequence[topic] = number + 1
        self._guarded(
            lambda: self._writer.add_message(
                self._channels[topic], stamp_ns, data, stamp_ns, sequence=number
            )
        )

    def check(self) -> None:
        """Check whether the disk has failed since the last message."""
        self._guarded(self._sink.check)

    def stop(self, reason: str) -> None:
        """Finish the file early, with a fault that names the reason; its content can be read."""
        self._guarded(self._writer.finish)
        if self.fault is None:
            self.fault = RecordingError(
                f"the recording {self.path} stopped after {self.n_frames} frames: {reason}"
            )

    def close(self) -> None:
        """Finish the file, as far as its disk allows."""
        self._guarded(self._writer.finish)
        if self.fault is None:
            self._guarded(self._sink.close)
        else:
            with suppress(OSError):  # the fault is already known
                self._sink.close()

    def _guarded(self, act: Callable[[], object]) -> None:
        if self.fault is not None:
            return
        try:
            act()
        except OSError as cause:
            reason = cause.strerror or str(cause)
            self.fault = RecordingError(
                f"the recording {self.path} stopped after {self.n_frames} frames: {reason}. "
                f"{self._what_is_left()}; free space or choose another disk"
            )
            self.fault.__cause__ = cause

    def _mark(self) -> None:
        """Keep the length of the file with all frames so far, after a chunk was written.

        The first mark is after the description, without which nothing can be read.
        """
        length = self._sink.tell()
        if self._marks and self.fault is None and length > self._marks[-1][0]:
            self._marks.append((length, self.n_frames))

    def _what_is_left(self) -> str:
        """Return as text how much of a stopped file can be read."""
        if not self._marks or self._marks[0][0] > self.n_bytes:
            return "Nothing of it can be read"
        return f"{self.n_readable or 'No'} frames of it can be read"


class _Marked:
    """The file for the MCAP writer; calls ``mark`` after each write.

    The index after a chunk is a separate write: a chunk without its index can be read.
    """

    def __init__(self, sink: DirectFile, mark: Callable[[], None]) -> None:
        self.tell, self.flush = sink.tell, sink.flush
        self._sink, self._mark = sink, mark

    def write(self, data: bytes, /) -> int:
        n_bytes = self._sink.write(data)
        self._mark()
        return n_bytes
