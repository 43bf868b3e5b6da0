"""A recording in the place of a cell: doors show what was measured then, and commands are refused.

`Tape` returns what a recording shows at any of its times; `Replay` plays it against a clock, and is
to a service what `TactileCellPlugin` is for a cell.
"""

import threading
import time
from bisect import bisect_right
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config, layout_from_pads, make_calibration
from cell.control.live import FRESH_S, LiveValues
from cell.control.records import pad_array
from cell.control.states import CellState, GraspState, named_states
from cell.data.recording_reader import Recording, read_recording
from cell.errors import RecordingError, RequestRefused
from cell.fault_catalogue import BY_NUMBER
from cell.interfaces.plugin.answer import Answer, FeltShape, HostStatus
from cell.interfaces.plugin.part_report import OnPart, PartReport, thinned_curves
from cell.interfaces.plugin.plugin import cell_values
from cell.interfaces.service.shift import Shift
from gripper.clock import Clock
from recognition.recognizer import UNKNOWN
from tactile.errors import TactileError
from tactile.sensor.filters import Neighbourhood
from tactile.sensor.tare import LEAST_FRAMES, TareLimits, compute_tare
from tactile.sensor.taxel_forces import TaxelForces

UPLOAD_BYTES = 64 << 20
"""Largest recording in bytes that a client may send: half an hour of grasping; read, it takes three
times as much memory."""
SPEED_MAX = 100.0
"""Largest speed of a replay."""
_ZERO_FRAMES = 50
"""Frames before the first contact from which the zero of the taxels is taken, at most."""
_CONTACT_FRAMES = 10
"""Frames just before the first contact that are left out of it: the pads may touch already."""
_LATCHED = (CellState.ABORTING, CellState.ABORTED, CellState.CLEARING)
"""States in which a fault is latched."""
NOTHING_RUNS = "this is the replay of a recording, nothing moves: `tactile-cell serve` runs a cell"
"""Why a replay refuses what a cell would do."""


class Tape:
    """What a recording shows at any of its times.

    Raises RecordingError if nothing was measured in it, or a message has values that no cell has,
    and ConfigError if its pads are not those of two fingers.
    """

    def __init__(self, recording: Recording) -> None:
        frames, cycles = recording.frames, recording.cycles
        if not len(frames) or not len(cycles):
            raise RecordingError(f"{recording.path} has nothing to show: no frames, or no periods")
        self.recording = recording
        self.config = _config(recording)
        layout = layout_from_config(self.config.tactile)
        if not pad_array(layout).same_as(recording.pads):
            layout = layout_from_pads(recording.pads)
        self.layout = layout
        try:
            self._stamps = {
                name: [float(row["t_s"]) for row in rows]
                for name, rows in (("states", recording.states), ("results", recording.results))
            }
            self._faults = [row for row in recording.events if row.get("fault_number") in BY_NUMBER]
            self._fault_stamps = [float(row["t_s"]) for row in self._faults]
            self.begin_s = float(min(frames.t_s[0], cycles.t_s[0]))
            last = [stamps[-1] for stamps in self._stamps.values() if stamps]
            self.end_s = float(max(frames.t_s[-1], cycles.t_s[-1], *last))
            self._forces = self._zeroed()
            for t_s in (*self._stamps["states"], *self._fault_stamps):
                self.status_at(t_s)
            for number in range(1, len(recording.results) + 1):
                self.report(number)
        except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as cause:
            raise RecordingError(
                f"{recording.path}: a message has values that no cell has "
                f"({type(cause).__name__}: {cause})"
            ) from cause

    def grasp_at(self, t_s: float) -> int:
        """Return the number of the grasp that began last, from 1; 0 before the first one."""
        return bisect_right(self.recording.grasp_t_s, t_s)

    def results_until(self, t_s: float) -> int:
        """Return how many answers there were by then."""
        return bisect_right(self._stamps["results"], t_s)

    def wall_s(self, t_s: float) -> float:
        """Return a time of the recording as unix time in s."""
        since_s = t_s - 1e-9 * self.recording.monotonic_start_ns
        return 1e-9 * self.recording.wall_clock_start_ns + since_s

    @property
    def labels(self) -> tuple[str, ...]:
        """The objects that could be named, or whose grasps were taught."""
        named = [label for row in self.recording.results for label in row["labels"]]
        taught = [grasp.label for grasp in self.recording.grasps if grasp.label]
        return tuple(dict.fromkeys(map(str, named or taught)))

    def info(self) -> dict[str, Any]:
        """Return what `TactileCellPlugin.info` returned when it was recorded."""
        return cell_values(self.config, self.layout) | {"labels": self.labels, "places": ()}

    def status_at(self, t_s: float) -> HostStatus:
        """Return states, live values, fault and last answer at a time."""
        n_states = bisect_right(self._stamps["states"], t_s)
        row = self.recording.states[n_states - 1] if n_states else {}
        state = CellState(row.get("state", CellState.STOPPED))
        grasp = GraspState(row.get("grasp", GraspState.IDLE))
        n_faults = bisect_right(self._fault_stamps, t_s)
        fault = self._faults[n_faults - 1] if n_faults and state in _LATCHED else None
        n_results = self.results_until(t_s)
        return HostStatus(
            **named_states(state, grasp),
            holding=grasp in (GraspState.GRIPPING, GraspState.HOLDING, GraspState.ERROR),
            fault=None if fault is None else str(fault["text"]),
            fault_number=0 if fault is None else int(fault["fault_number"]),
            live=self._live_at(t_s),
            since_s=self.wall_s(float(row.get("t_s", self.begin_s))),
            fault_since_s=None if fault is None else self.wall_s(float(fault["t_s"])),
            n_faults=n_faults,
            last_answer=self.answer(n_results) if n_results else None,
        )

    def answer(self, number: int) -> Answer:
        """Return an answer by its number from 1."""
        row = self.recording.results[number - 1]
        unknown, shape = float(row["unknown"]), row.get("shape")
        likely = zip(row["labels"], row["probabilities"], strict=True)
        return Answer(
            label=str(row["label"]),
            probabilities={str(label): (1.0 - unknown) * float(p) for label, p in likely}
            | {UNKNOWN: unknown},
            n_grasps=int(row["n_grasps"]),
            n_ended_early=int(row.get("n_ended_early", 0)),
            shape=_felt(shape) if shape else None,
        )

    def report(self, number: int) -> PartReport:
        """Return the report of the part of an answer by its number from 1, with its last grasp."""
        until_s = self._stamps["results"][number - 1]
        before_s = self._stamps["results"][number - 2] if number > 1 else self.begin_s
        answer = self.answer(number)
        return PartReport(
            task="identify",
            answer=answer,
            rejected=answer.label == UNKNOWN,
            seconds=until_s - before_s,
            curves=self._curves(self.grasp_at(until_s)),
        )

    def newtons(self, counts: NDArray[np.uint16]) -> NDArray[np.float32] | None:
        """Return the force in N on each taxel; None where the recording shows no zero."""
        return None if self._forces is None else self._forces.of(counts)

    def _zeroed(self) -> TaxelForces | None:
        """Return the taxels with the zero that they show before the first contact, if they do."""
        phase = np.array(self.recording.cycles.phase)
        pressed = self.recording.cycles.t_s[phase == "RAMPING"]
        frames = self.recording.frames
        n_free = len(frames) if not len(pressed) else int(np.searchsorted(frames.t_s, pressed[0]))
        free = frames.counts[: max(n_free - _CONTACT_FRAMES, 0)][:_ZERO_FRAMES]
        if len(free) < LEAST_FRAMES:
            return None
        try:
            zero = compute_tare(Neighbourhood(self.layout), free, TareLimits(), self.begin_s)
        except TactileError:
            return None
        return TaxelForces(self.layout, make_calibration(self.config.tactile, self.layout), zero)

    def _live_at(self, t_s: float) -> LiveValues:
        """Return the newest values by then, as `cell.control.live` shows them."""
        cycles, frames = self.recording.cycles, self.recording.frames
        cycle = int(np.searchsorted(cycles.t_s, t_s, side="right")) - 1
        frame = int(np.searchsorted(frames.t_s, t_s, side="right")) - 1
        shown = cycle >= 0 and t_s - cycles.t_s[cycle] <= FRESH_S
        frame_age_s = float(t_s - frames.t_s[frame]) if frame >= 0 else None

        def known(value: float) -> float | None:
            return float(value) if shown and np.isfinite(value) else None

        force_n = known(cycles.force_n[cycle].mean())
        return LiveValues(
            force_n=force_n,
            force_age_s=None if force_n is None else float(t_s - cycles.t_s[cycle]),
            setpoint_n=known(cycles.setpoint_n[cycle]),
            opening_mm=known(1e3 * cycles.aperture_m[cycle]),
            temperature_c=known(cycles.temperature_c[cycle]),
            counts=frames.counts[frame]
            if frame_age_s is not None and frame_age_s <= FRESH_S
            else None,
            frame_age_s=frame_age_s,
        )

    def _curves(self, number: int) -> dict[str, Any] | None:
        """Return the curves of a grasp by its number from 1, as `PartReport.curves`."""
        if not number:
            return None
        grasp, cycles = self.recording.grasps[number - 1], self.recording.cycles
        begin_s = self.recording.grasp_t_s[number - 1]
        first, last = np.searchsorted(cycles.t_s, [begin_s, begin_s + grasp.t_s[-1]])
        if first == last:
            return None
        of_grasp = slice(first, last)
        return thinned_curves(
            grasp,
            self.newtons,
            t_s=cycles.t_s[of_grasp] - begin_s,
            force_n=cycles.force_n[of_grasp].mean(axis=1),
            setpoint_n=cycles.setpoint_n[of_grasp],
            aperture_m=cycles.aperture_m[of_grasp],
        )


class Replay:
    """Plays a recording in the place of a cell; every method from any thread.

    Raises RecordingError or ConfigError if it cannot be read, or shows nothing.
    """

    def __init__(self, path: Path, *, clock: Clock = time) -> None:
        self._clock = clock
        self._lock = threading.RLock()
        self._speed, self._paused = 1.0, False
        self.shift: Shift = _ReplayedShift(self)
        self.load(path, path.name)

    def load(self, path: Path, name: str) -> None:
        """Play another recording from its beginning; the one before goes on where this fails.

        Raises RecordingError or ConfigError as `Replay`.
        """
        tape = Tape(read_recording(path))
        with self._lock:
            self._tape, self._name = tape, name
            self._at_s, self._since_s = tape.begin_s, self._clock.monotonic()
            self._paused = False

    def control(
        self, *, pause: bool | None = None, speed: float | None = None, grasp: int | None = None
    ) -> None:
        """Pause or go on, set the speed, or go to the beginning of a grasp.

        Raises RequestRefused if a value is out of its range; nothing changes.

        Parameters
        ----------
        pause
            True to pause; False to go on, at the end from the beginning.
        speed
            Seconds of the recording in a real one, above 0 and at most `SPEED_MAX`.
        grasp
            Number of the grasp, from 1.
        """
        with self._lock:
            tape = self._tape
            if speed is not None and not 0.0 < speed <= SPEED_MAX:
                raise RequestRefused(f"speed is {speed:g}: give one above 0, at most {SPEED_MAX:g}")
            n_grasps = len(tape.recording.grasps)
            if grasp is not None and not 1 <= grasp <= n_grasps:
                raise RequestRefused(f"grasp is {grasp}: the recording has 1 to {n_grasps}")
            at_s = self._now()
            if grasp is not None:
                at_s = tape.recording.grasp_t_s[grasp - 1]
            elif pause is False and at_s >= tape.end_s:
                at_s = tape.begin_s
            self._at_s, self._since_s = at_s, self._clock.monotonic()
            self._speed = self._speed if speed is None else speed
            self._paused = self._paused if pause is None else pause

    def values(self) -> dict[str, Any]:
        """Return where the replay stands: times in s from the beginning, grasps from 1.

        ``time_s`` is the unix time in s at which that was recorded.
        """
        with self._lock:
            tape, at_s = self._tape, self._now()
            return {
                "paused": self._paused or at_s >= tape.end_s,
                "speed": self._speed,
                "grasp": tape.grasp_at(at_s),
                "of": len(tape.recording.grasps),
                "t_s": at_s - tape.begin_s,
                "time_s": tape.wall_s(at_s),
                "duration_s": tape.end_s - tape.begin_s,
                "name": self._name,
                "lost_reason": tape.recording.lost_reason,
            }

    def moment(self) -> tuple[Tape, float]:
        """Return what is played and its present time in s."""
        with self._lock:
            return self._tape, self._now()

    def _now(self) -> float:
        if self._paused:
            return self._at_s
        past_s = self._speed * (self._clock.monotonic() - self._since_s)
        return min(self._at_s + past_s, self._tape.end_s)

    # -- what a service asks of a cell ---------------------------------------------------------

    @property
    def labels(self) -> tuple[str, ...]:
        """The objects that could be named."""
        return self.moment()[0].labels

    @property
    def recording_path(self) -> Path | None:
        """Name of the recording."""
        return Path(self._name)

    def info(self) -> dict[str, Any]:
        """Return what stays as it is, of the cell that was recorded."""
        return self.moment()[0].info()

    def status(self) -> HostStatus:
        """Return states, live values and last answer of the present time."""
        tape, at_s = self.moment()
        return tape.status_at(at_s)

    def newtons(self, counts: NDArray[np.uint16]) -> NDArray[np.float32] | None:
        """Return the force in N on each taxel; None where the recording shows no zero."""
        return self.moment()[0].newtons(counts)

    def health(self) -> dict[str, Any]:
        """Return no figures: no device is there. Only whether the recording is whole."""
        reason = self.moment()[0].recording.lost_reason
        recording = {"level": "watch" if reason else "ok", "path": self._name, "text": reason}
        nothing = dict.fromkeys(("servos", "can", "loop", "drift"))
        return {**nothing, "recording": recording}

    def watch_parts(self, on_part: OnPart) -> None:
        """Report no parts: `shift` has those until the present time."""

    def check(self, task: str) -> NoReturn:
        """Refuse every task and command. Raises RequestRefused."""
        raise RequestRefused(f"{task}: {NOTHING_RUNS}")

    @property
    def taught_revision(self) -> int:
        """A number that stays as it is."""
        return 0

    def taught(self) -> list[dict[str, Any]]:
        """Return the objects that could be named, without what was taught of them."""
        unknown = {"n_grasps": 0, "shape": None, "size_mm": None}
        return [{"label": label} | unknown for label in self.labels]

    def remark(self, kind: str, text: str) -> None:
        """Write nothing: a recording stays as it is."""

    def close(self, timeout_s: float) -> None:
        """Do nothing: no device is open."""


class _ReplayedShift(Shift):
    """The ledger of a shift as it stood at the present time of a replay."""

    def __init__(self, replay: Replay) -> None:
        super().__init__()
        self._replay = replay
        self._making = threading.Lock()
        self._made: tuple[Tape, int, Shift] | None = None
        self._wall_s = 0.0

    def values(self, *, n_faults: int) -> dict[str, Any]:
        """Return the ledger as plain data."""
        with self._making:
            return self._now().values(n_faults=n_faults)

    def grasp(self, number: int) -> dict[str, Any] | None:
        """Return the curves of an answer by its id."""
        with self._making:
            return self._now().grasp(number)

    def _now(self) -> Shift:
        """Return the ledger with all answers until now: the one before with those that came since.

        After a step back it begins anew.
        """
        tape, at_s = self._replay.moment()
        n_answers = tape.results_until(at_s)
        if self._made is None or self._made[0] is not tape or self._made[1] > n_answers:
            self._wall_s = tape.wall_s(tape.begin_s)
            self._made = (tape, 0, Shift(lambda: self._wall_s))
        _, n_known, shift = self._made
        for number in range(n_known + 1, n_answers + 1):
            self._wall_s = tape.wall_s(float(tape.recording.results[number - 1]["t_s"]))
            shift.add(tape.report(number))
        self._made = (tape, n_answers, shift)
        self._wall_s = tape.wall_s(at_s)
        return shift


def _config(recording: Recording) -> CellConfig:
    """Return the config of a recording; the built-in one where it has none that is valid now."""
    try:
        return CellConfig.model_validate_json(recording.metadata.get("config", "{}"))
    except ValidationError:
        return CellConfig(name=recording.metadata.get("cell", "recorded cell")[:80])


def _felt(shape: Mapping[str, Any]) -> FeltShape:
    """Return shape and size as a recording keeps them."""

    def mm(row: Mapping[str, Any], name: str) -> float:
        return 1e3 * float(row[name])

    kind, probability = str(shape["kind"]), float(shape["probability"])
    return FeltShape(
        kind=kind,
        probability=probability,
        probabilities={kind: probability},
        size_mm=mm(shape, "size_m"),
        interval_mm=(mm(shape, "low_m"), mm(shape, "high_m")),
        thicknesses_mm=tuple(
            (mm(one, "size_m"), mm(one, "low_m"), mm(one, "high_m"))
            for one in shape.get("thicknesses", ())
        ),
        dimensions_mm={name: 1e3 * value for name, value in shape.get("dimensions_m", {}).items()},
        n_grasps=int(shape.get("n_grasps", 1)),
    )
