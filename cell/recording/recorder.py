"""The recorder: writes all data and actions of a sequence into MCAP files."""

import functools
import itertools
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict
from errno import ENOENT, ENOSPC
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from cell.errors import RecordingError
from cell.files import RECORDING
from cell.recording import schema
from cell.recording.sink import LEFT_BYTES, RecordingSink, free_bytes
from gripper.clock import Clock
from recognition.grasp import Grasp, PadArray

if TYPE_CHECKING:
    from gripper.values.state import Cycle
    from tactile.source import TactileFrame

ROOM_BYTES = 4 * LEFT_BYTES
"""Free bytes of a disk at which a recording begins again: two minutes of grasping."""
LONG_BYTES = 256 << 20
"""Size of a file in bytes after which the recording continues in a new file: 2 h of grasping."""
CHUNK_BYTES = 64 << 10
"""Size of a chunk in bytes before compression: the largest loss of a killed program."""


@functools.cache
def _described(topic: str) -> tuple[str, str, bytes]:
    """Return name, encoding and content of the schema of a topic."""
    content = schema.json_schema(topic)
    return content["title"], "jsonschema", schema.to_json(content)


class MessageWriter:
    """Writes messages after a description of the recording and their schemas."""

    def __init__(self, file: "BinaryIO | RecordingSink", entries: Mapping[str, str]) -> None:
        self._writer = Writer(
            file,  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self._channels: dict[str, int] = {}
        self._writer.start(profile="", library="tactile-cell")
        described = {**entries, "crc32": schema.metadata_crc32(entries)}
        self._writer.add_metadata(schema.METADATA, described)
        for topic in schema.MODELS:
            number = self._writer.register_schema(*_described(topic))
            self._channels[topic] = self._writer.register_channel(topic, "json", number)

    def add(self, topic: str, t_s: float, data: bytes) -> None:
        """Write a message of a monotonic time in s."""
        stamp_ns = schema.to_ns(t_s)
        self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns)

    def finish(self) -> None:
        """Write the end of the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]


class Recorder:
    """Records one program: frames, cycles, poses, states, loop statistics, events, grasps, results.

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
    ) -> None:
        self.vital = vital
        self._first_path = Path(path)
        self._clock = clock
        self._pads = pads
        self._metadata = dict(metadata or {})
        self._background = background
        self._note = note
        self._closed = False
        self.fault: RecordingError | None = None
        """Why the recording has stopped; None while it is written."""
        self._newest_counts: NDArray[np.uint16] = np.zeros(0, dtype=np.uint16)
        self._start(self._new_sink(self._first_path))

    @property
    def path(self) -> Path:
        """The present or last file."""
        return self._sink.path

    def begin(self) -> bool:
        """Continue in a new file if the present one has stopped or is long; between two grasps.

        Return whether a new file begins. Without room on the disk the recording stays stopped.
        """
        fault = self.fault
        if fault is None and self._sink.tell() < LONG_BYTES:
            return False
        try:
            if self._sink.busy:
                return False
            # Not where a disk is gone: a folder in its place is on another one.
            if getattr(self._sink.error, "errno", ENOENT) in (ENOENT, ENOSPC):
                self._first_path.parent.mkdir(parents=True, exist_ok=True)
            if free_bytes(self._first_path.parent) < ROOM_BYTES:
                return False
            if fault is not None and not self._n_frames:
                self.path.unlink(missing_ok=True)
            sink = self._new_sink(self._free_path())
        except (OSError, RecordingError):
            return False
        if fault is None:
            self._finish()
        self._start(sink)
        if fault is not None:
            self.now(schema.EVENT, {"kind": "note", "text": str(fault)})
        return True

    def frame(self, frame: "TactileFrame") -> None:
        """Record a whole tactile frame of raw counts."""
        counts = frame.counts
        if counts.shape != (self._pads.n_taxels,):
            raise ValueError(f"frame of shape {counts.shape}, the pads have {self._pads.n_taxels}")
        values = {
            "number": self._n_frames,
            "counter": int(frame.counter),
            "status": int(frame.status),
            "counts": counts,
            "extra": None if frame.extra is None else frame.extra.ravel(),
        }
        self._put(schema.FRAME, frame.t_s, values)
        self._newest_counts = counts

    def cycle(self, cycle: "Cycle") -> None:
        """Record one period of the force loop."""
        state, force = cycle.state, cycle.force
        names = (
            *("aperture_m", "aperture_velocity_m_s", "current_a", "force_from_current_n"),
            *("temperature_c", "voltage_v", "servos"),
        )
        values = {
            "phase": cycle.phase.name,
            "setpoint_n": cycle.setpoint_n,
            "goal_current_a": cycle.goal_current_a,
            **{name: getattr(state, name) for name in names},
        }
        if force is not None:
            values |= {
                "force_t_s": force.t_s, "force_n": force.force_n, "force_valid": force.valid
            }  # fmt: skip
        self._put(schema.CYCLE, cycle.t_s, values)

    def now(self, topic: str, values: Mapping[str, Any]) -> None:
        """Record a message of the present time; see `schema` for its fields."""
        self._put(topic, self._clock.monotonic(), values)

    def grasp(self, grasp: Grasp) -> None:
        """Record that the newest frames belong to this grasp.

        A grasp during which the recording stopped is in no file. Raises ValueError if its frames
        are not those given to `frame` before.
        """
        first_frame = self._n_frames - grasp.n_frames
        if self.fault is not None:
            return
        if first_frame < 0 or not np.array_equal(self._newest_counts, grasp.counts[-1]):
            raise ValueError(
                f"{self._n_frames} frames are recorded, the grasp has {grasp.n_frames} others"
            )
        names = ("label", "shape", "source", "start_ms", "n_frames", "aperture_m", "force_n")
        values = {name: getattr(grasp, name) for name in names} | {
            "first_frame": first_frame,
            "command": grasp.command and grasp.command.values,
            "zero": grasp.zero and grasp.zero.values,
        }
        self.now(schema.GRASP, values)

    def check(self) -> None:
        """Check whether the disk has failed since the last message; call it now and then."""
        error = self._sink.error
        if self.fault is None and error is not None:
            fault = self._stopped(error.strerror or str(error))
            fault.__cause__ = error
            self._stop(fault)

    def close(self) -> None:
        """Finish the file. Raises RecordingError if the recording has stopped."""
        if self._closed:
            return
        self._closed = True
        self._finish()
        if self.fault is not None:
            raise self.fault

    def _put(self, topic: str, t_s: float, values: Mapping[str, Any]) -> None:
        """Add a message; does nothing after a fault.

        On a nearly full disk the file ends with an event of kind ``note``.
        """
        if self._closed:
            raise RecordingError(f"{self.path} is closed; nothing more can be recorded")
        if self.fault is not None:
            return
        self._writer.add(topic, t_s, schema.to_json({"t_s": t_s, **values}))
        self._n_frames += topic == schema.FRAME
        if self._sink.nearly_full and self._sink.error is None:
            fault = self._stopped("the disk is nearly full")
            note = {"t_s": t_s, "kind": "note", "text": str(fault)}
            self._writer.add(schema.EVENT, t_s, schema.to_json(note))
            self._writer.finish()
            if self._sink.error is None:
                self._stop(fault)
        self.check()

    def _stopped(self, reason: str) -> RecordingError:
        return RecordingError(
            f"the recording {self.path} stopped after {self._n_frames} frames: {reason}; the next "
            "job records again: before it free space on a full disk, or choose another one"
        )

    def _stop(self, fault: RecordingError) -> None:
        self.fault = fault
        self._sink.end()
        with suppress(Exception):  # of a host whose screen is gone: the grasp goes on
            self._note(str(fault))

    def _finish(self) -> None:
        """Finish the file, as far as its disk allows; wait for the disk."""
        if self.fault is None:
            self._writer.finish()
        self._sink.close()
        self.check()

    def _new_sink(self, path: Path) -> RecordingSink:
        try:
            return RecordingSink(path, background=self._background)
        except FileExistsError as cause:
            raise RecordingError(
                f"{path} exists; recordings are never overwritten, choose another name"
            ) from cause
        except OSError as cause:
            raise RecordingError(
                f"cannot record to {path}: {cause.strerror}; check folder and rights"
            ) from cause

    def _start(self, sink: RecordingSink) -> None:
        """Begin a file with its description."""
        self._sink = sink
        self.fault, self._n_frames = None, 0
        described = {
            "format": str(RECORDING),
            "wall_clock_start_ns": str(time.time_ns()),
            "monotonic_start_ns": str(schema.to_ns(self._clock.monotonic())),
            "pads": schema.to_json(asdict(self._pads)).decode(),
        }
        self._writer = MessageWriter(sink, self._metadata | described)
        self.check()

    def _free_path(self) -> Path:
        first = self._first_path
        later = (first.with_stem(f"{first.stem}-{number}") for number in itertools.count(2))
        return next(path for path in itertools.chain([first], later) if not path.exists())
