"""The recorder: writes everything that a sequence sees and does into one MCAP file."""

import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from mcap.writer import CompressionType, Writer

from cell.data import recording_schema as schema
from cell.data.recorder_sink import BackgroundFile, DirectFile
from cell.data.recording_values import (
    begin,
    cycle_values,
    grasp_values,
    metadata_values,
    to_json,
    to_ns,
)
from cell.errors import RecordingError
from gripper.clock import Clock
from recognition.grasp import Grasp, PadArray

if TYPE_CHECKING:
    from gripper.values.state import Cycle
    from tactile.source import TactileFrame

CHUNK_BYTES = 64 << 10
"""Size of a chunk before compression: what a killed program loses at most."""

_NEWEST_FRAMES = 65536
"""Frames that a grasp can name; 20 minutes at 50 frames a second."""
_TIME_TOLERANCE_S = 1e-6
"""Difference in s between a frame's time in the recording and in its grasp: rounding only."""


class Recorder:
    """Writes frames, cycles, poses, events, grasps and results of one sequence as they come.

    A disk that is full, gone or too slow never raises into the force loop: the recording stops for
    good, `fault` gives the reason and how many frames can be read, and `close` raises it. Raises
    RecordingError if the file cannot be made.

    Parameters
    ----------
    path
        The new file; an existing one is never overwritten.
    clock
        Stamps the messages of `now`; frames and cycles carry their own monotonic stamps.
    pads
        The pads whose counts are recorded.
    metadata
        Further facts to keep with the recording, for instance hashes of config and model.
    background
        Write from a thread of its own, for real time; in virtual time leave it off.
    vital
        Whether a grasp must not go on without its recording; `cell.control.journal` looks after
        that.
    wall_clock_ns
        Wall clock in ns since 1970, read at the start and with each change of state; it is kept
        for people and orders nothing.
    """

    def __init__(
        self,
        path: Path | str,
        clock: Clock,
        *,
        pads: PadArray,
        metadata: Mapping[str, str] | None = None,
        background: bool = False,
        vital: bool = False,
        wall_clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.path = Path(path)
        self.vital = vital
        self._clock = clock
        self._pads = pads
        self.wall_clock_ns = wall_clock_ns
        self._fault: RecordingError | None = None
        self._closed = False
        self._n_frames = 0
        self._sequence: dict[str, int] = {}
        self._marks: list[tuple[int, int]] = []
        self._newest: deque[tuple[float, int]] = deque(maxlen=_NEWEST_FRAMES)
        try:
            self._sink = (BackgroundFile if background else DirectFile)(self.path)
        except FileExistsError as cause:
            raise RecordingError(
                f"{path} is there already; recordings are never overwritten, choose another name"
            ) from cause
        except OSError as cause:
            raise RecordingError(
                f"cannot record to {path}: {cause.strerror}; check folder and rights"
            ) from cause
        self._writer = writer = Writer(
            _Marked(self._sink, self._mark),  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        started = metadata_values(pads, wall_clock_ns(), to_ns(clock.monotonic()))
        entries = dict(metadata or {}) | started
        self._channels: dict[str, int] = {}
        self._guarded(lambda: self._channels.update(begin(writer, entries)))
        if self._fault is None:
            self._marks.append((self._sink.tell(), 0))

    @property
    def fault(self) -> RecordingError | None:
        """Why the recording stopped before its end; None while all is well."""
        return self._fault

    def frame(self, frame: "TactileFrame") -> None:
        """Record a whole tactile frame of raw counts."""
        counts = frame.counts
        if counts.shape != (self._pads.n_taxels,):
            raise ValueError(f"frame of shape {counts.shape}, the pads have {self._pads.n_taxels}")
        self._n_frames += 1
        self._put(
            schema.FRAME,
            frame.t_s,
            {
                "number": self._n_frames - 1,
                "counter": int(frame.counter),
                "status": int(frame.status),
                "counts": counts.tolist(),
            },
        )
        self._newest.append((frame.t_s, schema.counts_crc32(counts)))

    def cycle(self, cycle: "Cycle") -> None:
        """Record one period of the force loop."""
        self._put(schema.CYCLE, cycle.t_s, cycle_values(cycle))

    def now(self, topic: str, values: Mapping[str, Any]) -> None:
        """Record a message of the present time; see `recording_schema` for its fields."""
        self._put(topic, self._clock.monotonic(), dict(values))

    def grasp(self, grasp: Grasp) -> None:
        """Record that the newest frames make up this grasp.

        The frames themselves are those given to `frame` before; ValueError if they are others.
        """
        if self._fault is not None:
            return
        newest = list(self._newest)[-grasp.n_frames :]
        stamps_s = np.array([t_s for t_s, _ in newest])
        if len(newest) < grasp.n_frames or np.any(
            np.abs(stamps_s - stamps_s[0] - grasp.t_s) > _TIME_TOLERANCE_S
        ):
            raise ValueError(
                f"the newest {len(newest)} recorded frames are not the {grasp.n_frames} of the "
                "grasp; record each of its frames, then the grasp"
            )
        if schema.counts_crc32(grasp.counts[-1]) != newest[-1][1]:
            raise ValueError("the counts of the grasp are not the raw counts that were recorded")
        values = grasp_values(grasp, first_frame=self._n_frames - grasp.n_frames)
        self._put(schema.GRASP, float(stamps_s[0]), values)

    def close(self) -> None:
        """Finish the file. Raises the RecordingError of a recording that stopped early."""
        if self._closed:
            return
        self._guarded(self._writer.finish)
        self._closed = True
        if self._fault is None:
            self._guarded(self._sink.close)
        else:
            with suppress(OSError):  # the fault is already known, and raised below
                self._sink.close()
        if self._fault is not None:
            raise self._fault

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except RecordingError as fault:
            if error is None:
                raise
            error.add_note(str(fault))

    def _put(self, topic: str, t_s: float, values: dict[str, Any]) -> None:
        if self._closed:
            raise RecordingError(f"{self.path} is closed; nothing more can be recorded")
        if self._fault is not None:
            return
        stamp_ns = to_ns(t_s)
        data = to_json({"t_s": round(float(t_s), 9), **values}).encode()
        number = self._sequence.get(topic, 0)
        self._sequence[topic] = number + 1
        channel = self._channels[topic]
        self._guarded(
            lambda: self._writer.add_message(channel, stamp_ns, data, stamp_ns, sequence=number)
        )

    def _mark(self) -> None:
        """Keep how long the file is with all frames so far, where a chunk has just been written.

        The first mark is the description of the recording, without which nothing can be read.
        """
        length = self._sink.tell()
        if self._marks and self._fault is None and length > self._marks[-1][0]:
            self._marks.append((length, self._n_frames))

    def _what_is_left(self) -> str:
        """Return what can be read of a recording that has stopped."""
        written = self._sink.written_bytes()
        frames = [n_frames for length, n_frames in self._marks if length <= written]
        if not frames:
            return "Nothing of it can be read"
        if not frames[-1]:
            return "No frame of it can be read"
        return f"{frames[-1]} frames of it can be read"

    def _guarded(self, act: Callable[[], object]) -> None:
        if self._fault is not None:
            return
        try:
            act()
        except OSError as cause:
            reason = cause.strerror or str(cause)
            self._fault = RecordingError(
                f"the recording {self.path} stopped after {self._n_frames} frames: {reason}. "
                f"{self._what_is_left()}; free space or choose another disk, then repeat"
            )
            self._fault.__cause__ = cause


class _Marked:
    """The file as its writer sees it; calls ``mark`` after each write.

    The index that follows a chunk is a write of its own: a chunk without it can be read.
    """

    def __init__(self, sink: DirectFile, mark: Callable[[], None]) -> None:
        self.tell, self.flush = sink.tell, sink.flush
        self._sink, self._mark = sink, mark

    def write(self, data: bytes, /) -> int:
        n_bytes = self._sink.write(data)
        self._mark()
        return n_bytes
