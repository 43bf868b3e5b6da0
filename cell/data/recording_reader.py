"""Reading recordings: all valid data of an MCAP file, as arrays and grasps."""

import sys
from array import array
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cell.data import recording_schema as schema
from cell.data.grasp_limits import beyond_range, text_refused, times_refused
from cell.data.recording_messages import RecordedMessages
from cell.errors import RecordingError
from recognition.grasp import Grasp, GraspCommand, PadArray, SelfZero

_TIME_TOLERANCE_S = 1e-5
"""Difference in s between the times of a grasp and those of its frames: rounding only."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedFrames:
    """Tactile frames in the order of time."""

    t_s: NDArray[np.float64]
    """(n,) float64: monotonic time in s."""
    number: NDArray[np.int64]
    """(n,) int64: number of the frame in the recording; a gap is a lost chunk."""
    counter: NDArray[np.int64]
    status: NDArray[np.int64]
    """(n,) int64: values of the control unit."""
    counts: NDArray[np.uint16]
    """(n, n_taxels) uint16: raw counts."""
    extra: NDArray[np.uint16]
    """(n, n_taxels, k) uint16: further samples of each taxel; k is 0 without any."""

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
    """Content of a recording."""

    path: Path
    metadata: dict[str, str]
    pads: PadArray
    """Its path, its metadata, the pads of its frames."""
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
    """The grasps with all their frames."""
    grasp_numbers: tuple[int, ...] = ()
    """Their numbers among all grasps in the file, from 0."""
    grasp_t_s: tuple[float, ...] = ()
    """Monotonic time in s of the first frame of each grasp."""
    n_broken_grasps: int = 0
    """Number of grasps that are damaged or lack frames; they are not in ``grasps``."""
    complete: bool = True
    """Whether the file was closed and nothing in it is damaged."""
    lost_reason: str = ""
    """Why it is not complete, or empty."""

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


def read_recording(path: Path | str) -> Recording:
    """Read a recording; from a damaged or truncated file all valid data.

    Raises RecordingError if it is not a recording of this package, or so short that its description
    is missing.
    """
    messages = RecordedMessages(Path(path))
    frames, cycles = _Columns(_FRAME_COLUMNS), _Columns(_CYCLE_COLUMNS)
    counts, extra, forces_n = array("H"), array("H"), array("d")
    phases: list[str] = []
    rows: defaultdict[str, list[dict[str, Any]]] = defaultdict(list)
    for topic, content, _ in messages:
        if topic == schema.FRAME:
            frames.add(content)
            counts.extend(content["counts"])
            extra.extend(content.get("extra", ()))
        elif topic == schema.CYCLE:
            cycles.add(content)
            phases.append(sys.intern(content["phase"]))
            both_n = content.get("force_n", ())
            forces_n.extend(both_n if len(both_n) == 2 else (np.nan, np.nan))
        else:
            rows[topic].append(content)
    samples = _read_only(counts).reshape(-1, messages.pads.n_taxels)
    recorded = RecordedFrames(
        t_s=frames["t_s"],
        **{name: frames[name].astype(np.int64) for name in _FRAME_COLUMNS[1:]},
        counts=samples,
        extra=_read_only(extra).reshape(*samples.shape, len(extra) // max(1, len(counts))),
    )
    grasps = _grasps(rows[schema.GRASP], recorded, messages)
    n_frames = len(recorded)
    if (
        not messages.lost_reason
        and schema.RECOVERED not in messages.metadata
        and np.any(recorded.number != np.arange(n_frames))
    ):
        messages.lose(f"its {n_frames} frames are not all that were recorded")
    return Recording(
        path=messages.path,
        metadata=messages.metadata,
        pads=messages.pads,
        wall_clock_start_ns=messages.wall_clock_start_ns,
        monotonic_start_ns=messages.monotonic_start_ns,
        frames=recorded,
        cycles=RecordedCycles(
            **{name: cycles[name] for name in _CYCLE_COLUMNS},
            phase=tuple(phases),
            force_n=_read_only(forces_n).reshape(-1, 2),
        ),
        poses=tuple(rows[schema.POSE]),
        events=tuple(rows[schema.EVENT]),
        results=tuple(rows[schema.RESULT]),
        states=tuple(rows[schema.STATE]),
        statistics=tuple(rows[schema.LOOP]),
        grasps=tuple(grasp for _, grasp, _ in grasps),
        grasp_numbers=tuple(number for number, _, _ in grasps),
        grasp_t_s=tuple(begin_s for _, _, begin_s in grasps),
        n_broken_grasps=len(rows[schema.GRASP]) - len(grasps),
        complete=not messages.lost_reason,
        lost_reason=messages.lost_reason,
    )


def recording_grasps(path: Path | str) -> tuple[Grasp, ...]:
    """Return the grasps of a recording.

    Raises RecordingError if it cannot be read, is not complete, or has no whole grasp.
    """
    recording = read_recording(path)
    if not recording.complete:
        raise RecordingError(
            f"{path} is not complete: {recording.lost_reason}. "
            f"`tactile-cell recover` saves its {len(recording.grasps)} whole grasps"
        )
    if not recording.grasps:
        raise RecordingError(f"{path} has no whole grasp ({len(recording.frames)} frames)")
    return recording.grasps


_FRAME_COLUMNS = ("t_s", "number", "counter", "status")
_CYCLE_COLUMNS = (
    "t_s", "setpoint_n", "goal_current_a", "aperture_m", "current_a", "temperature_c",
)  # fmt: skip
"""Columns of `RecordedFrames` and `RecordedCycles` with one number each."""


class _Columns:
    """Numbers of messages as columns, which take far less memory than the messages."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._columns = {name: array("d") for name in names}

    def add(self, content: dict[str, Any]) -> None:
        """Add a message; an unknown number is NaN."""
        for name, column in self._columns.items():
            column.append(content.get(name, np.nan))

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        return _read_only(self._columns[name])


def _grasps(
    rows: list[dict[str, Any]], frames: RecordedFrames, messages: RecordedMessages
) -> list[tuple[int, Grasp, float]]:
    """Return number, grasp and time in s of the first frame, for each whole grasp."""
    grasps, n_used = list[tuple[int, Grasp, float]](), 0
    for number, row in enumerate(rows):
        first_frame, n_frames = row["first_frame"], row["n_frames"]
        first = int(np.searchsorted(frames.number, first_frame))
        part = slice(first, first + n_frames)
        try:
            numbers = frames.number[part]
            if len(numbers) < n_frames or np.any(numbers != first_frame + np.arange(n_frames)):
                raise ValueError("frames of it are missing")
            if first_frame < n_used:
                raise ValueError("its frames belong to other grasps")
            n_used = first_frame + n_frames
            grasp = _grasp(row, messages.pads, frames, part)
        except (ValueError, OverflowError) as cause:
            messages.lose(f"grasp {number + 1} is left out: {cause}")
            continue
        grasps.append((number, grasp, float(frames.t_s[first])))
    return grasps


def _grasp(row: dict[str, Any], pads: PadArray, frames: RecordedFrames, part: slice) -> Grasp:
    """Return a grasp of these frames. Raises ValueError if it is refused."""
    n_frames = row["n_frames"]
    if not 0 < n_frames == len(row["frame_t_s"]):
        raise ValueError(f"it has {len(row['frame_t_s'])} times for {n_frames} frames")
    unknown = [np.nan] * n_frames
    grasp = Grasp(
        pads=pads,
        counts=frames.counts[part].copy(),
        t_s=np.array(row["frame_t_s"]),
        aperture_m=np.array(row.get("aperture_m", unknown)),
        force_n=np.array(row.get("force_n", unknown)),
        label=row["label"],
        shape=row["shape"],
        source=row["source"],
        start_ms=row["start_ms"],
        command=GraspCommand.from_values(row["asked"]) if "asked" in row else None,
        zero=SelfZero.from_values(row["self_zero"]) if "self_zero" in row else None,
    )
    if schema.counts_crc32(grasp.counts) != row["counts_crc32"]:
        raise ValueError("the checksum of its counts is wrong")
    since_first_s = frames.t_s[part] - frames.t_s[part.start]
    if np.any(np.abs(since_first_s - grasp.t_s) > _TIME_TOLERANCE_S):
        raise ValueError("its times differ from those of its frames")
    refusals = {
        "times": times_refused(grasp.t_s, np.array([0, n_frames])),
        "opening": beyond_range("aperture_mm", 1e3 * grasp.aperture_m),
        "force": beyond_range("force_n", grasp.force_n),
        "start": beyond_range("start_ms", np.array([grasp.start_ms])),
        "pose": grasp.command and beyond_range("pose", np.array(grasp.command.values[:2])),
    } | {name: text_refused(name, row[name]) for name in ("label", "shape", "source")}
    for name, wrong in refusals.items():
        if wrong:
            raise ValueError(f"its {name} {wrong}")
    return grasp


def _read_only(values: "array[float] | array[int]") -> NDArray[Any]:
    found = np.asarray(values)
    found.setflags(write=False)
    return found
