"""One MCAP file of a recording during writing; a disk failure stops the file, not the caller."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from cell.data import recording_schema as schema
from cell.data.recorder_sink import BackgroundFile, DirectFile
from cell.data.recording_values import CHUNK_BYTES, start_recording, to_json, to_ns
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
    note
        Gets the fault as a message for the operator.
    """

    def __init__(
        self,
        path: Path,
        entries: Mapping[str, str],
        *,
        background: bool,
        note: Callable[[str], None],
    ) -> None:
        self.path = path
        self.fault: RecordingError | None = None
        """Why the file ended early; None while it is written."""
        self.n_frames = 0
        """Frames so far."""
        self._note = note
        self._channels: dict[str, int] = {}
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
        self._writer = Writer(
            self._sink,  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self._guarded(lambda: self._channels.update(start_recording(self._writer, entries)))

    @property
    def n_bytes(self) -> int:
        """Bytes so far."""
        return self._sink.tell()

    @property
    def busy(self) -> bool:
        """Whether the disk has not taken all bytes yet."""
        return self._sink.busy

    def add(self, topic: str, t_s: float, values: Mapping[str, Any]) -> None:
        """Add a message of a monotonic time in s; does nothing after a fault.

        On a nearly full disk the file ends with a NOTE.
        """
        self._write(topic, t_s, values)
        if self.fault is None and self._sink.nearly_full:
            fault = self._stopped("the disk is nearly full")
            self._write(schema.EVENT, t_s, {"kind": "note", "text": str(fault)})
            self._guarded(self._writer.finish)
            self._stop(fault)

    def check(self) -> None:
        """Check whether the disk has failed since the last message."""
        self._guarded(self._sink.check)

    def close(self) -> None:
        """Finish the file, as far as its disk allows; wait for the disk."""
        self._guarded(self._writer.finish)
        if self.fault is None:
            self._guarded(self._sink.close)
        else:
            with suppress(OSError):  # the fault is already known
                self._sink.close()

    def _write(self, topic: str, t_s: float, values: Mapping[str, Any]) -> None:
        if self.fault is not None:
            return
        stamp_ns, data = to_ns(t_s), to_json({"t_s": round(float(t_s), 9), **values}).encode()
        self.n_frames += topic == schema.FRAME
        self._guarded(
            lambda: self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns)
        )

    def _guarded(self, act: Callable[[], object]) -> None:
        if self.fault is not None:
            return
        try:
            act()
        except OSError as cause:
            fault = self._stopped(cause.strerror or str(cause))
            fault.__cause__ = cause
            self._stop(fault)

    def _stopped(self, reason: str) -> RecordingError:
        return RecordingError(
            f"the recording {self.path} stopped after {self.n_frames} frames: {reason}; free "
            "space or choose another disk: the next job records again"
        )

    def _stop(self, fault: RecordingError) -> None:
        if self.fault is None:
            self.fault = fault
            self._note(str(fault))
            self._sink.end()
