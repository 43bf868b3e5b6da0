"""The recorder: writes all data and actions of a sequence into MCAP files."""

import itertools
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cell.data import recording_schema as schema
from cell.data.recorder_sink import LEFT_BYTES, free_bytes
from cell.data.recording_file import RecordingFile
from cell.data.recording_values import cycle_values, grasp_values, metadata_values, to_ns
from cell.errors import RecordingError
from gripper.clock import Clock
from recognition.grasp import Grasp, PadArray

if TYPE_CHECKING:
    from gripper.values.state import Cycle
    from tactile.source import TactileFrame

ROOM_BYTES = 4 * LEFT_BYTES
"""Free bytes of a disk at which a recording begins again: two minutes of grasping."""
LONG_BYTES = 256 << 20
"""Size of a file in bytes after which the recording continues in a new file: 2 h of grasping."""

_NEWEST_FRAMES = 65536
"""Most frames of a grasp; 20 minutes at 50 frames a second."""
_TIME_TOLERANCE_S = 1e-6
"""Difference in s between a frame's time in the recording and in its grasp: rounding only."""


class Recorder:
    """Writes frames, cycles, poses, events, grasps and results of one sequence as they come.

    A full, missing or slow disk never raises into the force loop: the recording stops, and `fault`
    has the reason. `begin` continues it in a new file. Raises RecordingError if the first file
    cannot be made.

    Parameters
    ----------
    path
        The new file; an existing one is never overwritten. Further files have ``-2`` and so on
        after its name.
    clock
        Stamps the messages of `now`; frames and cycles have their own monotonic stamps.
    pads
        The pads whose counts are recorded.
    metadata
        Further facts to keep with the recording, for instance hashes of config and model.
    background
        Write in a separate thread, for real time; in virtual time leave it off.
    vital
        Whether a grasp must stop when its recording stops; see `cell.control.journal`.
    note
        Gets a message for the operator when the recording stops.
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
        self.wall_clock_ns = wall_clock_ns
        self._first_path = Path(path)
        self._clock = clock
        self._pads = pads
        self._metadata = dict(metadata or {})
        self._background = background
        self._note = note
        self._closed = False
        self._newest: deque[tuple[float, int]] = deque(maxlen=_NEWEST_FRAMES)
        self._file = self._new_file(self._first_path)

    @property
    def path(self) -> Path:
        """The present or last file."""
        return self._file.path

    @property
    def fault(self) -> RecordingError | None:
        """Why the recording has stopped; None while it is written."""
        return self._file.fault

    def begin(self) -> bool:
        """Continue in a new file if the present one has stopped or is long; between two grasps.

        Return whether a new file begins. Without room on the disk the recording stays stopped.
        """
        before = self._file
        if before.fault is None and before.n_bytes < LONG_BYTES:
            return False
        folder = self._first_path.parent
        try:
            if before.busy or free_bytes(folder) < ROOM_BYTES:
                return False
            if before.fault is not None and not before.n_frames:
                before.path.unlink(missing_ok=True)
            self._file = self._new_file(self._free_path())
        except (OSError, RecordingError):
            return False
        self._newest.clear()
        if before.fault is None:
            before.close()
        else:
            self.now(schema.EVENT, {"kind": "note", "text": str(before.fault)})
        return True

    def frame(self, frame: "TactileFrame") -> None:
        """Record a whole tactile frame of raw counts."""
        counts = frame.counts
        if counts.shape != (self._pads.n_taxels,):
            raise ValueError(f"frame of shape {counts.shape}, the pads have {self._pads.n_taxels}")
        values = {
            "number": self._file.n_frames,
            "counter": int(frame.counter),
            "status": int(frame.status),
            "counts": counts.tolist(),
        }
        if frame.extra is not None:
            values["extra"] = frame.extra.ravel().tolist()
        self._put(schema.FRAME, frame.t_s, values)
        self._newest.append((frame.t_s, schema.counts_crc32(counts)))

    def cycle(self, cycle: "Cycle") -> None:
        """Record one period of the force loop."""
        self._put(schema.CYCLE, cycle.t_s, cycle_values(cycle))

    def now(self, topic: str, values: Mapping[str, Any]) -> None:
        """Record a message of the present time; see `recording_schema` for its fields."""
        self._put(topic, self._clock.monotonic(), values)

    def grasp(self, grasp: Grasp) -> None:
        """Record that the newest frames belong to this grasp.

        They must be the frames given to `frame` before; else raises ValueError. A grasp during
        which the recording stopped is in no file.
        """
        if self.fault is not None:
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
        values = grasp_values(grasp, first_frame=self._file.n_frames - grasp.n_frames)
        self._put(schema.GRASP, float(stamps_s[0]), values)

    def check(self) -> None:
        """Check the file while nothing is recorded; call it now and then."""
        self._file.check()

    def close(self) -> None:
        """Finish the file. Raises RecordingError if the recording has stopped."""
        if self._closed:
            return
        self._closed = True
        self._file.close()
        if self._file.fault is not None:
            raise self._file.fault

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

    def _put(self, topic: str, t_s: float, values: Mapping[str, Any]) -> None:
        if self._closed:
            raise RecordingError(f"{self.path} is closed; nothing more can be recorded")
        self._file.add(topic, t_s, values)

    def _new_file(self, path: Path) -> RecordingFile:
        clocks_and_pads = metadata_values(
            self._pads, self.wall_clock_ns(), to_ns(self._clock.monotonic())
        )
        described = self._metadata | clocks_and_pads
        return RecordingFile(path, described, background=self._background, note=self._note)

    def _free_path(self) -> Path:
        first = self._first_path
        later = (first.with_stem(f"{first.stem}-{number}") for number in itertools.count(2))
        return next(path for path in itertools.chain([first], later) if not path.exists())
