"""The recorder: writes all data and actions of a sequence into MCAP files."""

import itertools
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cell.data import recording_schema as schema
from cell.data.recorder_sink import ROOM_BYTES, has_room
from cell.data.recording_file import RecordingFile
from cell.data.recording_values import (
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

CONTINUES = "continues"
"""Entry of the metadata: the previous file of the recording."""
PART_BYTES = 256 << 20
"""Size of a file in bytes after which the recording continues in a new file: 2 h of grasping."""
PART_S = 86_400.0
"""Age of a file in s after which the recording continues in a new file."""

_NEWEST_FRAMES = 65536
"""Most frames of a grasp; 20 minutes at 50 frames a second."""
_TIME_TOLERANCE_S = 1e-6
"""Difference in s between a frame's time in the recording and in its grasp: rounding only."""
_LOOK_S = 1.0
"""Time in s between two checks of a full disk, in real time."""
_LONGEST_RETRY_S = 600.0
"""Longest time in s between two new files that stop at once; the time doubles up to it."""
_CLOSE_TIMEOUT_S = 10.0
"""Longest wait in s for a blocked disk at the end."""


class Recorder:
    """Writes frames, cycles, poses, events, grasps and results of one sequence as they come.

    A full, missing or slow disk never raises into the force loop: the recording stops, and `fault`
    has the reason and the number of readable frames. It continues in a new file beside the first,
    with ``-2`` after its name, as soon as the disk has `ROOM_BYTES` free. After `PART_BYTES` or
    `PART_S` it continues in a new file without a gap, between two jobs or answers. Raises
    RecordingError if the first file cannot be made.

    Parameters
    ----------
    path
        The new file; an existing one is never overwritten.
    clock
        Stamps the messages of `now`; frames and cycles have their own monotonic stamps.
    pads
        The pads whose counts are recorded.
    metadata
        Further facts to keep with the recording, for instance hashes of config and model.
    background
        Write, and check a full disk, in separate threads, for real time; in virtual time leave it
        off.
    vital
        Whether a grasp must stop when its recording stops; see `cell.control.journal`.
    note
        Gets a message for the operator when the recording stops, and when it continues.
    wall_clock_ns
        Wall clock in ns since 1970, read at the start and with each change of state; only for
        people, not for the order of messages.
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
        note: Callable[[str], None] = lambda _text: None,
        wall_clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.vital = vital
        self._first_path = Path(path)
        self._clock = clock
        self._pads = pads
        self._metadata = dict(metadata or {})
        self._background = background
        self._note = note
        self.wall_clock_ns = wall_clock_ns
        self._over = threading.Event()
        self._n_frames = self._n_lost = 0
        self._newest: deque[tuple[float, int]] = deque(maxlen=_NEWEST_FRAMES)
        self._state: tuple[int, bytes] | None = None
        self.gap = ""
        """The gap of a recording that stopped and continued; empty without a gap."""
        self._next: RecordingFile | None = None
        self._retry_s, self._retry_at_s = 0.0, 0.0
        self._waiter: threading.Thread | None = None
        self.stop_reason = ""
        """Why the present file must end, e.g. a nearly full disk; set by any thread, empty after
        the end of the file."""
        self._earlier_bytes = 0
        self._part: RecordingFile | None = None
        self._part_at_s = clock.monotonic() + PART_S
        self._parting = threading.Thread()
        self._file = self._new_file(self._first_path)
        self._notice(self._file)

    @property
    def path(self) -> Path:
        """The present or last file."""
        return (self._next or self._file).path

    @property
    def n_bytes(self) -> int:
        """Bytes on the disk, of all files."""
        return self._earlier_bytes + self._file.n_bytes

    @property
    def fault(self) -> RecordingError | None:
        """Why the recording has stopped; None while it is written."""
        return None if self._next is not None else self._file.fault

    def frame(self, frame: "TactileFrame") -> None:
        """Record a whole tactile frame of raw counts."""
        counts = frame.counts
        if counts.shape != (self._pads.n_taxels,):
            raise ValueError(f"frame of shape {counts.shape}, the pads have {self._pads.n_taxels}")
        self._go_on()
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
        if topic == schema.RESULT:
            self._go_on_in_part()

    def grasp(self, grasp: Grasp) -> None:
        """Record that the newest frames belong to this grasp.

        They must be the frames given to `frame` before; else raises ValueError. A grasp across a
        gap of the recording is in no file.
        """
        self._go_on()
        if self.fault is not None or (self.gap and self._n_frames < grasp.n_frames):
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

    def check(self) -> None:
        """Check the file while nothing is recorded; call it now and then."""
        if self._file.fault is None:
            self._file.check()
            self._notice(self._file)
        self._go_on()
        self._go_on_in_part()

    def close(self) -> None:
        """Finish the file. Raises RecordingError if the recording has stopped, or has a gap."""
        if self._over.is_set():
            return
        self._over.set()
        for thread in (self._waiter, self._parting):
            if thread is not None and thread.ident is not None:
                thread.join(_CLOSE_TIMEOUT_S)
        if self._part is not None:
            self._discard(self._part)
        self._retry_at_s = math.inf  # a new file would come too late
        self._go_on()
        self._file.close()
        if self._file.fault is not None:
            raise self._file.fault
        if self.gap:
            raise RecordingError(self.gap)

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
        if self._over.is_set():
            raise RecordingError(f"{self.path} is closed; nothing more can be recorded")
        self._go_on()
        stopped = self._file.fault is not None
        if stopped and topic != schema.STATE:
            return
        message = (to_ns(t_s), _json(t_s, values))
        if topic == schema.STATE:
            self._state = message
        if not stopped:
            self._file.add(topic, *message)
            self._notice(self._file)

    # -- a disk that fails, and has room again -------------------------------------------------

    def _new_file(self, path: Path, **entries: str) -> RecordingFile:
        clocks_and_pads = metadata_values(
            self._pads, self.wall_clock_ns(), to_ns(self._clock.monotonic())
        )
        described = self._metadata | entries | clocks_and_pads
        return RecordingFile(path, described, background=self._background)

    def _notice(self, file: RecordingFile) -> None:
        """Wait for room on the disk of a file that has just stopped."""
        if file.fault is None and self.stop_reason:
            file.stop(self.stop_reason)
        self.stop_reason = ""
        if file.fault is None:
            return
        if file.n_bytes >= ROOM_BYTES:
            self._retry_s = 0.0
        self._retry_at_s = self._clock.monotonic() + self._retry_s
        if self._background:
            self._waiter = threading.Thread(
                target=self._wait_for_room, args=(file,), name="recording-room", daemon=True
            )
            self._waiter.start()
        else:
            self._give_up(file)

    def _give_up(self, file: RecordingFile) -> None:
        needed = f"as soon as {ROOM_BYTES >> 20} MB are free there"
        self._note(f"{file.fault}; it continues in a new file {needed}")
        file.close()

    def _wait_for_room(self, file: RecordingFile) -> None:
        self._give_up(file)
        while self._next is None and not self._over.wait(max(_LOOK_S, self._retry_s)):
            self._retry(file)

    def _following(self, before: RecordingFile) -> RecordingFile | None:
        """Return the file after another one; None if its disk has no room or is gone."""
        first = self._first_path
        names = (first.with_stem(f"{first.stem}-{number}") for number in itertools.count(2))
        try:
            if not has_room(first.parent):
                return None
            path = next(path for path in names if not path.exists())
            return self._new_file(path, **{CONTINUES: before.path.name})
        except (OSError, RecordingError):
            return None

    def _discard(self, file: RecordingFile) -> None:
        file.close()
        with suppress(OSError):
            file.path.unlink()

    def _retry(self, stopped: RecordingFile) -> None:
        """Make the next file if the disk has room again."""
        if (file := self._following(stopped)) is None:
            return
        self._retry_s = min(max(_LOOK_S, 2.0 * self._retry_s), _LONGEST_RETRY_S)
        self._retry_at_s = self._clock.monotonic() + self._retry_s
        if file.fault is None:
            self._note(f"the recording continues in {file.path}")
            self._next = file
        else:
            self._discard(file)

    def _go_on(self) -> None:
        """Write to the next file, if the present one has stopped and there is a next one."""
        stopped = self._file
        if stopped.fault is None:
            return
        if not self._background and self._clock.monotonic() >= self._retry_at_s:
            self._retry(stopped)
        if (file := self._next) is None:
            return
        self._n_lost += self._n_frames - stopped.n_readable
        names = f"{stopped.path.name} stopped, {file.path} goes on"
        self.gap = f"the recording has a gap of {self._n_lost} frames: {names}"
        now_s = self._clock.monotonic()
        self._begin(file)
        file.add(schema.EVENT, to_ns(now_s), _json(now_s, {"kind": "recording", "text": self.gap}))
        # In this order: other threads ask for the fault.
        self._file = file
        self._next = None
        self._notice(file)

    def _begin(self, file: RecordingFile) -> None:
        """Start to write frames and grasps to a new file."""
        self._earlier_bytes += self._file.n_bytes
        self._part_at_s = self._clock.monotonic() + PART_S
        self._n_frames = 0
        self._newest.clear()
        if self._state is not None:
            file.add(schema.STATE, *self._state)

    # -- the next file of a long recording ------------------------------------------------------

    def _go_on_in_part(self) -> None:
        """Continue in a new file if the present one is long; between two grasps.

        A separate thread makes the new file and closes the old one, so that a blocked disk delays
        nothing.
        """
        file, now_s = self._file, self._clock.monotonic()
        if file.fault is not None or self._over.is_set() or self._parting.is_alive():
            return
        if (part := self._part) is not None:
            self._begin(part)
            self._file, self._part = part, None
            self._beside(self._end_part, file)
        elif file.n_bytes >= PART_BYTES or now_s >= self._part_at_s:
            self._part_at_s = now_s + _LONGEST_RETRY_S
            self._beside(self._make_part, file)

    def _beside(self, act: Callable[[RecordingFile], None], file: RecordingFile) -> None:
        if not self._background:
            act(file)
            return
        self._parting = threading.Thread(
            target=act, args=(file,), name="recording-part", daemon=True
        )
        self._parting.start()

    def _make_part(self, file: RecordingFile) -> None:
        part = self._following(file)
        if part is not None and part.fault is not None:
            self._discard(part)
        else:
            self._part = part

    def _end_part(self, file: RecordingFile) -> None:
        file.close()
        if file.fault is not None:
            self.gap = str(file.fault)
            self._note(self.gap)


def _json(t_s: float, values: Mapping[str, Any]) -> bytes:
    return to_json({"t_s": round(float(t_s), 9), **values}).encode()
