"""Self-zeros of a cell: when one is due, when one is refused, and the file of the newest."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any, Literal

from cell.config.model import CellConfig
from cell.errors import CellError, PlanRefused
from cell.files import name_in_file
from cell.formats import SELF_ZERO, read_json, write_json
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.settings import ServoSettings
from gripper.values.outcome import GraspOutcome, GraspResult
from gripper.values.servo_checks import VerificationReport
from recognition.drift.self_zero import ZeroMeasurement
from recognition.grasp import ZERO_COLUMNS, SelfZero
from tactile.layout import TaxelLayout
from tactile.source import SourceIdentity

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
        servos={one.id: {"port": port, "model": one.model} for one in config.gripper.servos},
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
    def due(self) -> bool:
        """Whether a start measures it now."""
        if self.when == "daily":
            last, now = map(date.fromtimestamp, (self.measured_s, self.now_s()))
            return self._last is None or last != now or self.new_hand
        return self.when == "always"

    @property
    def wanted(self) -> bool:
        """Whether the config demands it at each start; a failure is then a fault."""
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
        self.unkept = self.refused = ""
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
        """Do not use the last one if it is of another hand."""
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
    lost = outcome.result is GraspResult.PART_LOST
    if not (outcome.ended_early or lost or (zeroed is not None and not zeroed.pads_met)):
        return ""
    return (
        f"the empty fingers did not meet: they stopped at {_mm(outcome.final_aperture_m)} mm, "
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
    """Return the dead taxels as a note; empty without any."""
    if not zeroed.dead:
        return ""
    places = ", ".join(
        f"{int(taxel) - layout.taxels_of(pad).start} of {layout.pads[pad].name}"
        for taxel in zeroed.dead[:8]
        for pad in (int(layout.taxel_pad[taxel]),)
    )
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
