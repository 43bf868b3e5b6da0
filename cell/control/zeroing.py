"""Zeros of the hand: of the taxels, and with empty fingers that of opening, gains and foam.

The second one is a self-zero. This module decides when one is due and when it is refused, and saves
the newest in a file.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any, Literal

from cell.config.model import CellConfig
from cell.control.journal import Journal
from cell.control.lifecycle import CellLifecycle
from cell.control.records import GraspCollector
from cell.control.states import Event
from cell.control.watch import MotionWatch
from cell.errors import CellError, PlanRefused, ZeroRefused
from cell.files import SELF_ZERO, name_in_file, read_json, write_json
from cell.hand.interface import Hand, OnPeriod
from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.errors import PartBetweenFingers
from gripper.force.ramp import ForceRamp
from gripper.settings import ServoSettings
from gripper.values.outcome import GraspOutcome, GraspResult
from gripper.values.servo_checks import VerificationReport
from gripper.values.state import Cycle, TimeSpan
from recognition.drift.self_zero import ZeroMeasurement, measure_zero, shows_part
from recognition.grasp import ZERO_COLUMNS, SelfZero
from tactile.errors import TareRefused
from tactile.layout import TaxelLayout
from tactile.sensor.tare import TareResult
from tactile.source import SourceIdentity, TactileFrame

SelfZeroWhen = Literal["always", "daily", "on_demand", "never"]

_MOST_TILT_RAD = math.radians(4.0)
"""Largest tilt in rad between pads in contact; beyond it a finger is bent or a pad is loose."""
_MOST_RATIO = 1.6
"""Largest ratio of the gains of both pads. Beyond it a grasp ends because the forces of both
fingers differ (`GripperSettings.imbalance_share`)."""
_LONGEST_S = 86_400.0
"""Age in s up to which a self-zero counts: a day."""
_FAR_M = 2e-3
"""Largest distance in m of a daily self-zero from the one before and from the config's zero. A flat
part that covers both pads looks like the pads, and nobody has checked for one."""
_HAND_KEYS = {
    "gripper": ("port", "servos", "linkage"),
    "tactile": (
        *("sensor", "interface", "channel", "node_id", "serial_number", "board_serial_numbers"),
        *("layout", "mounting", "pad_gains", "calibration"),
    ),
    "simulator": ("pads",),
}
"""Keys of the config, by section, that identify the hand."""
_SERVO_KEYS = ("id", "model", "direction", "zero_pulse")
"""Keys of a servo that identify the hand; the others describe its drive."""
_ANOTHER_DAY_SD = 0.2
"""Uncertainty of a friction measured at an earlier start: temperature, rest. [assumed]"""


def zero_file(directory: Path, cell_name: str) -> Path:
    """Return the file of a cell's self-zero, beside the folders of its jobs."""
    return directory / f"self-zero-{name_in_file(cell_name)}.json"


def stored_zeros(
    config: CellConfig, directory: Path | None, *, new_hand: bool | None = None
) -> "SelfZeros":
    """Return the self-zeros of a cell, saved in a folder; None: in this program alone.

    ``new_hand``: values of earlier programs are of another hand, for example a simulated one.
    """
    port = config.gripper.port
    return SelfZeros(
        config.self_zero,
        pads_meet=config.gripper.pads_meet,
        path=None if directory is None else zero_file(directory, config.name),
        hand=_hand_of(config),
        new_hand=config.simulated if new_hand is None else new_hand,
        servos={servo.id: {"port": port, "model": servo.model} for servo in config.gripper.servos},
    )


def _hand_of(config: CellConfig) -> dict[str, Any]:
    """Return the config values that identify the hand of a self-zero, by dotted keys."""
    values = config.model_dump(mode="json")
    hand = {
        f"{section}.{key}": values[section][key]
        for section, keys in _HAND_KEYS.items()
        for key in keys
    }
    hand["gripper.servos"] = [
        {key: servo[key] for key in _SERVO_KEYS} for servo in hand["gripper.servos"]
    ]
    return hand | ({"seed": config.seed} if config.simulated else {})


@dataclass
class SelfZeros:
    """The newest self-zero of a cell, and when the next one is due.

    A self-zero older than a day is not used: the hand may have changed.
    """

    when: SelfZeroWhen = "on_demand"
    """At which starts it is due: ``self_zero`` of the config. Before a daily one nobody has checked
    that the fingers are empty."""
    _: KW_ONLY
    pads_meet: bool = True
    """Whether the pads of these fingers can press flat on each other."""
    path: Path | None = None
    """File that saves it for other programs; None: this program alone has it. An unreadable file,
    or one of another hand, is not used: `refused` has the reason."""
    hand: Mapping[str, Any] = field(default_factory=dict)
    """Values that identify the hand, by name."""
    servos: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    """Port and model of each servo, by its ID; with the homing offset they identify the servo."""
    new_hand: bool = False
    """Whether each program has a new simulated hand. Its first start is then the first of a day, so
    that a program does the same at any time."""
    now_s: Callable[[], float] = time.time
    """Returns the unix time in s."""
    measured_s: float = field(default=0.0, init=False)
    """Unix time in s of the last one of any age; 0 without one."""
    unkept: str = field(default="", init=False)
    """Why the newest one was not saved to its file; else empty."""
    refused: str = field(default="", init=False)
    """Why the self-zero in the file is not used, until another one is measured; else empty."""
    drives: dict[int, dict[str, Any]] = field(default_factory=dict, init=False)
    """Drive characteristic of each servo and the identity of the servo, plain data by its ID."""
    _last: SelfZero | None = field(default=None, init=False)
    _saved_hand: Mapping[str, Any] = field(default_factory=dict, init=False)
    """The hand of the self-zero in the file."""

    def __post_init__(self) -> None:
        if self.path is not None:
            self._read(self.path)

    @property
    def newest(self) -> SelfZero | None:
        """The newest self-zero of the last 24 hours, or None."""
        young = abs(self.now_s() - self.measured_s) <= _LONGEST_S
        return self._last if young and self.when != "never" else None

    @property
    def expired(self) -> str:
        """Why the last one is no longer used, as text; else empty."""
        if self._last is None or self.when == "never" or self.newest is not None:
            return ""
        return (
            "the self-zero is older than a day by this machine's clock: answers allow for any "
            f"drift. Take everything out of the grip, then {_MEASURE}"
        )

    @property
    def due(self) -> bool:
        """Whether a start measures it now."""
        if self.when == "daily":
            last, now = map(date.fromtimestamp, (self.measured_s, self.now_s()))
            return self._last is None or last != now or self.new_hand
        return self.when == "always"

    def of_unit(self, unit: SourceIdentity) -> None:
        """Add the serial numbers of the connected control unit to the identity of the hand."""
        self.hand = {**self.hand, "unit.serial": unit.serial, "unit.boards": list(unit.boards)}
        self._refuse_other_hand()

    def far_off(self, zero: SelfZero) -> str:
        """Return as text that a self-zero is far from the config's or from the last one, else "".

        The distance from the config's zero limits the sum of all daily changes.
        """
        places_m = {"the zero of the config is": 0.0}
        if self._last is not None:
            places_m["they met last"] = self._last.opening_m
        for where, place_m in places_m.items():
            if abs(zero.opening_m - place_m) > _FAR_M:
                return (
                    f"the fingers meet at {_mm(zero.opening_m)} mm; {where} at {_mm(place_m)} mm: "
                    f"a flat part may be between them, or the zero has moved"
                )
        return ""

    def check(self) -> None:
        """Raise PlanRefused if the config allows no self-zero for these fingers."""
        if not self.pads_meet:
            raise PlanRefused(
                "gripper.pads_meet is false: these fingers cannot meet. Gauge them with a taught "
                "object in a holder: `tactile-cell model calibrate --gauge`"
            )
        if self.when == "never":
            raise PlanRefused("self_zero is never: write on_demand, daily or always in the config")

    def keep(self, zero: SelfZero) -> None:
        """Save a new self-zero; `unkept` has the reason if its file cannot be written."""
        self._last, self.measured_s = zero, self.now_s()
        self._saved_hand, self.new_hand = self.hand, False
        self.refused = ""
        self._write()

    def keep_drives(
        self, drives: Mapping[int, DriveCharacteristic], homing: Mapping[int, int]
    ) -> None:
        """Save the drive characteristics of servos with these homing offsets, by their IDs."""
        measured = {
            servo_id: {
                "servo": self._servo(servo_id, homing),
                "drive": asdict(replace(drive, measured_s=self.now_s())),
            }
            for servo_id, drive in drives.items()
            if drive.measured
        }
        self.drives = self.drives | measured  # a new one: health reads it in other threads
        # An unused file belongs to another hand, or a person must inspect it.
        if measured and not self.refused:
            self._write()

    def stored_drives(self, homing: Mapping[int, int]) -> dict[int, DriveCharacteristic]:
        """Return the saved drive characteristics of the present servos, as of another day."""
        drives = {}
        for servo_id, saved in self.drives.items():
            if saved["servo"] == self._servo(servo_id, homing):
                drive = DriveCharacteristic.from_stored(saved["drive"])
                sd = max(drive.friction_sd, _ANOTHER_DAY_SD)
                drives[servo_id] = replace(drive, friction_sd=sd)
        return drives

    def measured_servo(self, servo_id: int) -> bool:
        """Return whether the saved drive is of the servo of the config; ignores homing offsets."""
        saved = self.drives.get(servo_id, {"servo": {}})["servo"]
        return {**saved, "homing_offset": 0} == self._servo(servo_id, {})

    def _servo(self, servo_id: int, homing: Mapping[int, int]) -> dict[str, Any]:
        return {**self.servos.get(servo_id, {}), "homing_offset": homing.get(servo_id, 0)}

    def _write(self) -> None:
        if self.path is None:
            return
        content = {
            "measured_s": self.measured_s,
            "hand": self._saved_hand,
            "zero": None if self._last is None else asdict(self._last),
            "drives": {str(servo_id): drive for servo_id, drive in self.drives.items()},
        }
        self.unkept = ""
        try:
            write_json(self.path, SELF_ZERO, content, error=CellError)
        except CellError as error:
            self.unkept = f"today's self-zero could not be saved for other programs: {error}"

    def _read(self, path: Path) -> None:
        try:
            values = read_json(path, SELF_ZERO, error=CellError)
            if values is None:
                return
            zero = values["zero"]
            last = zero and SelfZero.from_values([zero[name] for name in ZERO_COLUMNS])
            drives = {int(name): dict(saved) for name, saved in values["drives"].items()}
            for saved in drives.values():
                DriveCharacteristic.from_stored(saved["drive"])
            measured_s, self._saved_hand = float(values["measured_s"]), dict(values["hand"])
            date.fromtimestamp(measured_s)
        except CellError as error:
            self._refuse(str(error))
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, OSError):
            self._refuse(f"{path} has no self-zero; {SELF_ZERO.remedy}")
        else:
            self._last, self.measured_s = last, measured_s
            # Each program has a new simulated hand.
            self.drives = {} if self.new_hand else drives
            self._refuse_other_hand()

    def _refuse_other_hand(self) -> None:
        """Discard the saved self-zero if it was measured on another hand."""
        others = [key for key, value in self.hand.items() if self._saved_hand.get(key) != value]
        if self._last is not None and others:
            self._refuse(
                f"{self.path or 'it'} is of another cell or hand, with other {', '.join(others)}. "
                f"Give each cell a name of its own in its config; {SELF_ZERO.remedy}"
            )

    def _refuse(self, why: str) -> None:
        self._last, self.measured_s = None, 0.0
        self.refused = f"the saved self-zero is not used: {why}"


def part_between(outcome: GraspOutcome, zeroed: ZeroMeasurement | None = None) -> str:
    """Return as text that something other than the pads has stopped the fingers, else "".

    `Hand.press_pads_together` ends early if the opening or the first footprints show a part;
    ``zeroed`` is the measurement at its end.
    """
    at_mm = _mm(outcome.final_aperture_m)
    if outcome.result is GraspResult.PART_LOST:
        return (
            f"the fingers pressed on each other no longer, at {at_mm} mm: something has slipped "
            f"out of them, or a pad failed for a moment"
        )
    if not (outcome.ended_early or (zeroed is not None and not zeroed.pads_met)):
        return ""
    return (
        f"the empty fingers did not meet: they stopped at {at_mm} mm, "
        f"something is between them. If nothing is, a pad is damaged or the zero is wrong, for "
        f"example by a tooth of a horn"
    )


def unsound(zeroed: ZeroMeasurement) -> str:
    """Return as text that a finger is bent, or one pad measures far less than the other, or ""."""
    tilt_deg = [math.degrees(tilt) for tilt in zeroed.tilt_rad]
    if max(map(abs, zeroed.tilt_rad)) > _MOST_TILT_RAD:
        return (
            f"the pads meet at {tilt_deg[0]:+.1f} degrees along the fingers and "
            f"{tilt_deg[1]:+.1f} across, {math.degrees(_MOST_TILT_RAD):.0f} are allowed: a finger "
            f"is bent or a pad is loose; repair it, then measure again"
        )
    ratio = math.exp(zeroed.zero.log_gain_ratio)
    if 1.0 / _MOST_RATIO <= ratio <= _MOST_RATIO:
        return ""
    weak = 0 if ratio < 1.0 else 1
    return (
        f"at the same force the pad of finger 0 measures {ratio:.2f} times the force of finger 1, "
        f"{_MOST_RATIO:g} or its inverse are allowed: the pad of finger {weak} is worn, "
        f"or its cable damaged; replace it, then measure again"
    )


def dead_taxels_text(zeroed: ZeroMeasurement, layout: TaxelLayout) -> str:
    """Return the dead taxels as a note."""
    places = ", ".join(layout.place(taxel) for taxel in zeroed.dead[:8])
    return f"{len(zeroed.dead)} taxels measure nothing although their neighbours do: {places}"


def _mm(opening_m: float) -> str:
    return f"{opening_m * 1e3:+.2f}"


def homing_offsets(report: VerificationReport) -> dict[int, int]:
    """Return the homing offset of each servo, by its ID, from the report of a start."""
    return {row.servo_id: int(row.actual) for row in report.rows if row.item == "homing_offset"}


def drive_text(servo: ServoSettings, drive: DriveCharacteristic) -> str:
    """Return a drive characteristic beside that of the catalogue, as text for people."""
    model, usual = servo.servo_model, DriveCharacteristic.catalogue(servo.servo_model)
    torque = f"{1.0 / drive.rising_a_nm:.2f} Nm/A (±{100 * drive.load_sd:.0f} %)"
    return (
        f"servo {servo.servo_id}: friction {drive.breakaway_a:.3f} A "
        f"(±{100 * drive.friction_sd:.0f} %, catalogue {usual.breakaway_a:.3f}), {torque}, "
        f"falling {1.0 / drive.falling_a_nm:.2f} (catalogue {model.kt_nm_a:.2f})"
    )


def zero_text(zeroed: ZeroMeasurement) -> str:
    """Return a self-zero as text for people: zero, gains, foam, how the pads stand."""
    zero = zeroed.zero
    along_deg, across_deg = (math.degrees(tilt) for tilt in zeroed.tilt_rad)
    return (
        f"pads meet at {_mm(zero.opening_m)} mm (±{zero.opening_sd_m * 1e3:.2f}), finger 0 "
        f"measures {math.exp(zero.log_gain_ratio):.2f} times finger 1 "
        f"(±{zero.log_gain_ratio_sd:.2f}), tilt {along_deg:+.1f} and {across_deg:+.1f} degrees"
    )


BORNE_SHARE = 0.9
"""Share of the force of the whole current that the fingers press with: the rest is for control."""
_MEASURE = "run the task `zero`, or without a service `tactile-cell hand zero`"
_ATTEMPTS = 3
"""Attempts to meet softly enough: a gearing that sticks and slips meets hard by chance."""
_ZERO_FORCE_N, _ZERO_RATE_N_S = 10.0, 5.0
"""Force in N with which the empty fingers press on each other, and its rate in N/s. Two pads of 55
x 20 mm yield 0.36 mm together, and a ramp of two seconds shows this on each taxel."""
_ZERO_AGE_S = 1800.0
"""Age of the zero of the taxels in s from which the next approach takes a new one: sensors drift
with their temperature, and one count of drift makes taught parts UNKNOWN. [chosen]"""
_LOOK_FRAMES, _LOOKS_UP_TO_N = 3, 5.0
"""Frames between two checks for a part between the fingers, up to that set-point in N."""


@dataclass
class Zeroing:
    """Takes the zeros of the hand, and measures the drives of its servos with the self-zero."""

    config: CellConfig
    hand: Hand
    life: CellLifecycle
    journal: Journal
    watch: MotionWatch
    zeros: SelfZeros
    """The newest self-zero."""
    taxels: TareResult | None = None
    """Newest zero of the taxels; None before the first start."""
    homing: dict[int, int] = field(default_factory=dict)
    """Homing offset of each servo, by its ID, as of the last start."""
    missed: str = ""
    """Why the last start measured no self-zero; else empty."""
    _asked_s: float = 0.0

    @property
    def note(self) -> str:
        """Why there is no self-zero, or why it was not saved for other programs; else empty."""
        before_it = self.taxels is None and self.zeros.due  # the first start measures it
        expired = "" if before_it else self.zeros.expired
        return self.missed or self.zeros.unkept or self.zeros.refused or expired

    @property
    def drives(self) -> dict[int, DriveCharacteristic]:
        """Newest measured drive characteristic of each servo that is there, by its ID."""
        return self.zeros.stored_drives(self.homing)

    def open(self) -> None:
        """Open the fingers; take a new zero of a drifting sensor, or where the last one is old."""
        self.hand.open(self.watch.motion)
        if n_frames := self.config.tactile.sensor.fresh_zero_frames:
            self.taxels = self.hand.tare(n_frames)
            return
        now_s = self.life.clock.monotonic()
        if self.taxels and now_s - max(self.taxels.t_s, self._asked_s) > _ZERO_AGE_S:
            self._asked_s = now_s
            try:
                self.taxels = self.hand.tare(self.config.tactile.tare_frames)
            except TareRefused as refusal:
                self.journal.note("note", f"the taxels keep their zero: {refusal}")

    def start(self) -> None:
        """Open the fingers and take the zero of the taxels; a self-zero follows if it is due.

        If a daily one finds a part, the fingers open again, and `missed` has the reason.
        """
        self.hand.open(self.watch.motion)
        self.taxels = self.hand.tare(self.config.tactile.tare_frames)
        self.life.check_cancelled()
        self.missed = ""
        if not self.zeros.due:
            return
        always = self.zeros.when == "always"  # a failure is then a fault
        try:
            self._measure(asked=always)
        except ZeroRefused as error:
            if always:
                raise
            self._note_each_drive()
            self.missed = (
                f"no self-zero today, answers allow for any drift: {error}. The fingers are open. "
                f"Take everything out of the grip, then {_MEASURE}; with `self_zero: on_demand` no "
                "start closes the fingers"
            )
            self.journal.note("note", self.missed)

    def measure(self) -> ZeroMeasurement:
        """Close the empty fingers on each other and measure the zero of the opening, gains, foam.

        The taxels get a new zero first. The grasps that follow include the measurement, so that
        changes since teaching are corrected.

        Raises
        ------
        PlanRefused
            If the config allows no self-zero for these fingers; nothing has moved.
        gripper.errors.PartBetweenFingers
            If something is between them; the grip is kept.
        ZeroRefused
            If a pad or a finger is out of bounds; the fingers are open.
        CellStopped
            If it was cancelled. The fingers press on each other until a release.
        """
        self.zeros.check()
        self.life.obey_cancel_between()
        self.journal.begin()
        with self.life.executing(Event.EXECUTE):
            # The zero of the start may be days old, and its drift looks like a part.
            self.hand.open(self.watch.motion)
            self.taxels = self.hand.tare(self.config.tactile.tare_frames)
            zeroed = self._measure(asked=True)
            self.missed = ""
            self.life.complete()
        return zeroed

    def keep_drives(self) -> DriveReport:
        """Save the measured drive characteristics; return them."""
        report = self.note_drives()
        self.zeros.keep_drives(report.drives, self.homing)
        return report

    def note_drives(self) -> DriveReport:
        """Note unusual drive characteristics; return all of them."""
        report = self.hand.read_drives()
        for text in report.notes:
            self.journal.note("note", text)
        return report

    def _measure(self, *, asked: bool) -> ZeroMeasurement:
        """Close the empty fingers, measure, and open them again; else raise.

        ``asked``: somebody has checked that the fingers are empty. A part between them is then
        kept; else it is released, and a zero far off may be a flat part.
        """
        for attempt in range(1, _ATTEMPTS + 1):
            self.open()
            collector, collect = self.watch.collecting()
            outcome, zeroed, refused = self._meet(collector, collect)
            if zeroed is not None or part_between(outcome) or attempt == _ATTEMPTS:
                break
            self.hand.release(self.watch.motion)
        between = part_between(outcome, zeroed)
        if between and asked:
            raise PartBetweenFingers(
                f"{between}. The grip is kept. Look at the fingers; clear the fault and release"
            )
        if zeroed is not None:
            refused = unsound(zeroed) or ("" if asked else self.zeros.far_off(zeroed.zero))
        alone: Sequence[TimeSpan] = ()
        if not (between or refused):
            alone = self.hand.measure_load(collect)
        self.hand.release(self.watch.motion)
        if zeroed is None or between or refused:
            raise ZeroRefused(between or refused)
        if alone:
            zeroed = self._zeroed(collector, alone)
        self.hand.measure_friction(self.watch.motion)
        self._note_each_drive()
        self.zeros.keep(zeroed.zero)
        self.journal.note("self_zero", zero_text(zeroed))
        if self.zeros.unkept:
            self.journal.note("note", self.zeros.unkept)
        if zeroed.dead:
            self.journal.note("taxels", dead_taxels_text(zeroed, self.hand.layout))
        return zeroed

    def _meet(
        self, collector: GraspCollector, collect: OnPeriod
    ) -> tuple[GraspOutcome, ZeroMeasurement | None, str]:
        """Press the empty fingers on each other; stop if the pads show a part.

        Returns while they press: the outcome, the measurement or None, and why it is None.
        """
        layout, n_seen = self.hand.layout, 0

        def watch(cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
            nonlocal n_seen
            collect(cycle, frames)
            if frames and 0.0 < cycle.setpoint_n < _LOOKS_UP_TO_N:
                n_seen += 1
                if n_seen % _LOOK_FRAMES == 0 and shows_part(
                    collector.grasp(), layout.gripping_pads
                ):
                    self.hand.end_ramp()

        most_n = min(_ZERO_FORCE_N, BORNE_SHARE * self.hand.largest_ramp_n)
        outcome = self.hand.press_pads_together(
            ForceRamp.linear(most_n, rate_n_s=_ZERO_RATE_N_S), watch
        )
        if part_between(outcome):
            return outcome, None, ""
        try:
            return outcome, self._zeroed(collector), ""
        except ValueError as error:
            return outcome, None, f"{error}; measure again"

    def _zeroed(self, collector: GraspCollector, alone: Sequence[TimeSpan] = ()) -> ZeroMeasurement:
        """Return the measurement by the frames so far; ``alone``: when one finger moved alone."""
        return measure_zero(
            collector.grasp(),
            self.hand.layout.gripping_pads,
            step_m=sum(self.config.mechanics.opening_steps_m()),
            alone=collector.during(alone),
        )

    def _note_each_drive(self) -> None:
        """Save and note the drive characteristic of each servo after a start or a self-zero."""
        report = self.keep_drives()
        for servo in self.config.gripper_settings.servos:
            drive = report.drives.get(servo.servo_id)
            if drive is not None:
                self.journal.note("servo drive", drive_text(servo, drive))
