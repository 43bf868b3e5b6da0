"""All named faults: of the CAN link, the control unit, taxels, boards, servos, axes, the object.

Faults that only set a knob to their value are declared at the knob.
"""

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from gripper.dynamixel.control_table import REGISTERS
from simulator.boards.site import BoardFaults
from simulator.boards.uskin import UskinSettings
from simulator.can.drive import SimulatedDrive
from simulator.can.faults import CanLinkFaults, ControlUnitFaults
from simulator.devices import CellDevices
from simulator.errors import SimulatorSettingsError
from simulator.knobs import SHARE, Number, Setting
from simulator.servo.control_table import EEPROM_END
from simulator.servo.device import WatchdogStop
from simulator.servo.faults import Chatter, WireFaults

Undo = Callable[[], object]
"""Undoes a fault."""
_EACH = ("servoN", "axisN")
"""First parts of names that stand for each servo, and for each axis, of the config."""


@dataclass(slots=True, kw_only=True, eq=False)
class Fault:
    """A fault with its checked value: not injected yet, waiting, active, or over."""

    text: str
    """The whole text."""
    entry: "FaultEntry"
    """Entry of the vocabulary."""
    index: int
    """Position of its servo or axis in the settings."""
    value: Any
    """Its number, or name and number (`simulator.knobs.Setting`); None without a value."""
    event: str
    """``contact`` or ``moving``; empty: the injection."""
    start_s: float
    end_s: float
    """Start and end in s after the first such event since the injection; end infinity: never."""
    devices: CellDevices = field(init=False)
    """The cell, once it is injected."""
    now_s: float = field(init=False)
    """Time of the cell in s at the injection, then at its begin."""
    event_s: float = field(default=math.inf, init=False)
    """Time of the event in s; infinity before."""
    began_s: float | None = field(default=None, init=False)
    """Time of the cell in s at which it began; None before."""
    over: bool = field(default=False, init=False)
    """Whether it has ended; a momentary fault ends at once."""
    undo: Undo = field(default=lambda: None, init=False)
    """Ends its effect."""
    last_s: float = field(init=False)
    """Time in s up to which `FaultEntry.act` has carried it out."""

    @property
    def owner(self) -> Any:
        """The object with its knob. Raises SimulatorSettingsError in a cell that has none."""
        return _OWNERS[self.entry.name.partition(".")[0]](self)

    def begin(self, now_s: float) -> None:
        """Apply the fault at ``now_s`` s."""
        self.now_s = self.began_s = self.last_s = now_s
        if self.entry.happens is not None:
            self.entry.happens(self)
            self.over = True
        else:
            self.undo = self.entry.apply(self)

    def clear(self) -> None:
        """End the fault, or cancel it before its start; a second call has no effect."""
        if not self.over:
            self.over = True
            self.undo()

    def meets(self, other: "Fault") -> bool:
        """Return whether both set the same knob of the same device; ``servos`` means each servo."""
        names = [fault.entry.name for fault in (self, other)]
        first, second = (name.partition(".")[0].rstrip("sN") for name in names)
        apart = self.index != other.index and all(name.startswith(_EACH) for name in names)
        knob = self.entry.knob
        return bool(knob) and (first, knob) == (second, other.entry.knob) and not apart


def _control_unit(fault: Fault) -> Any:
    if fault.devices.settings.boards is not None:
        raise SimulatorSettingsError("this cell has sensor boards, no control unit")
    return fault.devices.faults.unit


def _serial_boards(fault: Fault) -> Any:
    if not fault.devices.boards:
        raise SimulatorSettingsError("this cell has no sensor boards on serial lines")
    return fault.devices.faults.boards


def _uskin_boards(fault: Fault) -> Any:
    if not isinstance(fault.devices.settings.boards, UskinSettings):
        raise SimulatorSettingsError("this cell has no sensor boards on CAN")
    return fault.devices.faults.boards


_OWNERS: dict[str, Callable[[Fault], Any]] = {
    "can": lambda fault: fault.devices.faults.can,
    "unit": _control_unit,
    "taxels": lambda fault: fault.devices.faults.unit,
    "board": _serial_boards,
    "uskin": _uskin_boards,
    "servos": lambda fault: fault.devices.faults.servo_wire,
    "servoN": lambda fault: fault.devices.servo_bus.servos[fault.index],
    "axisN": lambda fault: list(fault.devices.axes.values())[fault.index],
    "object": lambda fault: fault.devices.world,
}
"""Object with the knobs of each component."""
COMPONENTS = tuple(_OWNERS)
"""First parts of the names of faults."""


@dataclass(frozen=True, slots=True)
class FaultEntry:
    """One fault of the vocabulary. Without a function of its own it sets a knob of its owner."""

    name: str
    """``component.fault``; ``servoN`` stands for servo1, servo2, ... in the order of the config,
    ``axisN`` for its axes."""
    meaning: str
    """Description, one line."""
    knob: str = ""
    """Path of the knob from its owner. Only one fault of a knob of a device can be injected at a
    time."""
    value: Number | Setting | None = None
    """Value after ``=``; None: no value."""
    position: Callable[[Fault], object] | None = None
    """Returns the position of the knob; None: the number of the value, else on."""
    effect: Callable[[Fault], Undo] | None = None
    """Begins the fault instead of the knob, and returns its `Undo`."""
    act: Callable[[Fault, float], object] | None = None
    """Continues its effect at each step of the world, with the time in s."""
    happens: Callable[[Fault], object] | None = None
    """Carries out a fault that is a moment, without an end."""
    check: Callable[[Fault], object] | None = None
    """Refuses values that do not fit the cell, with SimulatorSettingsError, before any change."""

    @property
    def moment(self) -> bool:
        """Whether the fault is momentary, without an end."""
        return self.happens is not None

    def apply(self, fault: Fault) -> Undo:
        """Begin a fault that has an end."""
        if self.effect is not None:
            return self.effect(fault)
        path, _, knob = self.knob.rpartition(".")
        owner = attrgetter(path)(fault.owner) if path else fault.owner
        before = getattr(owner, knob)
        position: object = True
        if self.position is not None:
            position = self.position(fault)
        elif isinstance(before, frozenset):
            position = before | {int(fault.value)}
        elif isinstance(self.value, Number):
            position = int(fault.value) if self.value.whole else fault.value
        setattr(owner, knob, position)
        return lambda: setattr(owner, knob, before)


_PAD = Number("pad", 0, 1000, default=0, whole=True)
"""Number of a pad in the layout."""
_IDENTITY = {
    "vendor": "Identity object.Vendor-ID",
    "product": "Identity object.Product code",
    "revision": "Identity object.Revision number",
    "serial": "Identity object.Serial number",
    "taxels": "Taxel layout.Number of taxels",
    "pads": "Taxel layout.Number of pads",
}
"""Names for ``unit.wrong``, and the name of each object in the unit's EDS."""
_TAXELS = re.compile(r"(\d{1,6})(?:-(\d{1,6}))?")
"""One taxel or a range of them, first and last."""
_REPORT = "reported_offset_raw"
"""Knob of a servo: counts added to the reported position, but not to that of its control loop."""
_BOOT_APART_S = 0.003
"""Time in s between the boots of servos on one supply; an assumption."""
_SLIDE_M = 1e-4
"""Step in m of a sliding part: its forces are computed again for each step."""
_SWELLING_M_S = 0.02
"""Growth of a trapped object in m/s: slower than the approach of the fingers."""


def _lose_next(fault: Fault) -> None:
    fault.owner.drop_next += int(fault.value)


def _jump(fault: Fault) -> Undo:
    plant = fault.owner.plant

    def turn(by_rad: float) -> None:
        plant.encoder_offset_rad += by_rad

    turn(fault.value)
    return partial(turn, -fault.value)


def _check_identity(fault: Fault) -> None:
    name, number = fault.value
    if name not in _IDENTITY:
        raise SimulatorSettingsError(
            f"unit.wrong takes one of {', '.join(_IDENTITY)} and a number; got {name!r}"
        )
    if not 0 <= number < 2**32:
        raise SimulatorSettingsError(f"unit.wrong: {number} does not fit into 32 bits")


def _pretending(fault: Fault) -> Undo:
    """Replace the value of an object of the unit's dictionary."""
    unit, (name, number) = fault.devices.unit, fault.value
    before = unit.pretend(_IDENTITY[name], number)
    return lambda: unit.pretend(_IDENTITY[name], before)


def _stuck_taxels(fault: Fault, taxels: Iterable[int], counts: int) -> dict[int, int]:
    """Return the counts of all stuck taxels; taxels that are already stuck stay so."""
    return fault.devices.faults.unit.stuck_counts | dict.fromkeys(taxels, counts)


def _some_taxels(fault: Fault, counts: int) -> dict[int, int]:
    n_taxels = fault.devices.settings.layout.n_taxels
    order = np.random.default_rng(fault.devices.settings.seed).permutation(n_taxels)
    return _stuck_taxels(fault, order[: round(fault.value * n_taxels)].tolist(), counts)


def _chosen_taxels(fault: Fault) -> dict[int, int]:
    name, counts = fault.value
    layout = fault.devices.settings.layout
    match = _TAXELS.fullmatch(name)
    if match is None:
        raise SimulatorSettingsError(
            "taxels.stuck_at takes one taxel or a range, for example 3:200 or 3-5:200; got "
            f"{name!r:.40}"
        )
    first, last = int(match[1]), int(match[2] or match[1])
    if not (first <= last < layout.n_taxels and 0 <= counts <= layout.adc_max):
        raise SimulatorSettingsError(
            f"taxels.stuck_at: taxels are 0 to {layout.n_taxels - 1}, counts 0 to {layout.adc_max}"
        )
    return _stuck_taxels(fault, range(first, last + 1), counts)


def _saturated_pad(fault: Fault) -> dict[int, int]:
    layout = fault.devices.settings.layout
    if fault.value >= layout.n_pads:
        raise SimulatorSettingsError(f"pad {fault.value:g}: pads are 0 to {layout.n_pads - 1}")
    taxels = range(layout.n_taxels)[layout.taxels_of(int(fault.value))]
    return _stuck_taxels(fault, taxels, layout.adc_max)


def _silence(fault: Fault) -> Undo:
    """Silence one servo, or all of them."""
    servos = fault.devices.settings.servos
    if fault.entry.name == "servoN.off":
        servos = servos[fault.index : fault.index + 1]
    silent = fault.devices.faults.servo_wire.silent
    added = {servo.servo_id for servo in servos} - silent
    silent |= added
    return lambda: silent.difference_update(added)


def _drift(fault: Fault, now_s: float) -> None:
    core, drifted_rad = fault.owner, fault.value * (now_s - fault.now_s)
    core.reported_offset_raw = round(drifted_rad / core.model.rad_per_pulse)


def _remount(fault: Fault) -> Undo:
    """Mount the horn of a servo farther open by the value in pulses."""
    mechanics, off_rad = fault.devices.mechanics, fault.value * fault.owner.model.rad_per_pulse
    mechanics.remount(fault.index, off_rad=off_rad)
    return lambda: mechanics.remount(fault.index, off_rad=-off_rad)


def _turn_round(fault: Fault) -> Undo:
    mechanics = fault.devices.mechanics
    mechanics.remount(fault.index, turned=True)
    return lambda: mechanics.remount(fault.index, turned=True)


def _factory(fault: Fault) -> Undo:
    table = fault.owner.registers.data
    before = table[:EEPROM_END]
    fault.owner.registers.load_factory()
    fault.owner.boot(fault.now_s + _BOOT_APART_S * fault.index)
    return partial(table.__setitem__, slice(EEPROM_END), before)


def _check_register(fault: Fault) -> None:
    name, number = fault.value
    register = REGISTERS.get(name)
    if register is None or register.address >= EEPROM_END:
        raise SimulatorSettingsError(f"{name!r} is not an EEPROM register such as current_limit")
    if register.writable:
        registers = fault.owner.registers
        before = registers.get(name)
        registers.configure(name, number)
        registers.put(name, before)
    elif not 0 <= number < 256**register.size:
        raise SimulatorSettingsError(f"{name} = {number} does not fit into {register.size} bytes")


def _wrong(fault: Fault) -> Undo:
    name, number = fault.value
    registers = fault.owner.registers
    before = registers.get(name)
    registers.put(name, number)
    return lambda: registers.put(name, before)


def _slip(fault: Fault, now_s: float) -> None:
    way_m = (now_s - fault.last_s) * (1e-3 * fault.value)
    if way_m >= _SLIDE_M:
        fault.owner.slide(way_m)
        fault.last_s = now_s


def _swell(fault: Fault, now_s: float) -> None:
    grown_m = (now_s - fault.now_s) * _SWELLING_M_S
    fault.owner.swell(min(grown_m, 1e-3 * fault.value))


def _check_drive(fault: Fault) -> None:
    if not isinstance(fault.owner, SimulatedDrive):
        raise SimulatorSettingsError("this fault is for drives, but the axis is a servo")


def _force_gain(fault: Fault) -> Undo:
    fault.devices.world.force_gain = fault.value
    return partial(setattr, fault.devices.world, "force_gain", 1.0)


# fmt: off
_FAULTS = (
    *(
        FaultEntry(knob=knob.name, **knob.metadata)
        for owner in (CanLinkFaults, ControlUnitFaults, BoardFaults, WireFaults)
        for knob in fields(owner)
        if knob.metadata
    ),
    FaultEntry("can.lose_next", "this number of messages to the host is lost",
               value=Number("messages", 1, 100_000, default=1, whole=True), happens=_lose_next),

    FaultEntry("unit.reboot", "the unit loses its supply and reboots",
               happens=lambda fault: fault.devices.unit.power_cycle()),
    FaultEntry("unit.emergency", "the unit reports an error (EMCY)",
               value=Number("code", 0, 0xFFFF, default=0x5000, whole=True),
               happens=lambda fault: fault.devices.unit.emergency(int(fault.value))),
    FaultEntry("unit.pre_operational",
               "the unit changes to pre-operational, as by a command of another master",
               happens=lambda fault: fault.devices.unit.command("PRE-OPERATIONAL", fault.now_s)),
    FaultEntry("unit.wrong", "the unit differs (vendor, product, revision, serial, taxels, pads)",
               "identity", Setting(unit="name:number", default="serial:99"), effect=_pretending,
               check=_check_identity),
    FaultEntry("unit.second_node", "another unit with the same node id joins the bus",
               "second_node",
               effect=lambda fault: fault.devices.can.add(
                   fault.devices.second_unit(fault.now_s))),

    FaultEntry("taxels.stuck", "this share of the taxels reads full scale", "stuck_counts", SHARE,
               lambda fault: _some_taxels(fault, fault.devices.settings.layout.adc_max)),
    FaultEntry("taxels.stuck_at", "one taxel, or a range, reads these counts (0: dead)",
               "stuck_counts", Setting(unit="taxel:counts", default="0:0"), _chosen_taxels,
               check=_chosen_taxels),
    FaultEntry("taxels.off", "this share of the taxels reads 0", "stuck_counts", SHARE,
               lambda fault: _some_taxels(fault, 0)),
    FaultEntry("taxels.saturated", "all taxels of this pad read full scale", "stuck_counts", _PAD,
               _saturated_pad, check=_saturated_pad),
    FaultEntry("taxels.force_gain", "factor on the force of each taxel: the law of other foam",
               "force_gain", Number("factor", 0.0, 100.0, default=0.8), effect=_force_gain),

    FaultEntry("servos.lose_next", "this number of answers is lost",
               value=Number("answers", 1, 100_000, default=1, whole=True), happens=_lose_next),
    FaultEntry("servos.chatter",
               "another device sends a byte with this period, also into answers", "chatter",
               Number("s", 1e-4, 10.0, default=0.001),
               lambda fault: Chatter(data=b"\xa5", every_s=fault.value)),
    FaultEntry("servos.off", "all servos are silent", "silent", effect=_silence),

    FaultEntry("servoN.off", "the servo receives and answers nothing; its torque stays", "silent",
               effect=_silence),
    FaultEntry("servoN.reboot", "it reboots by itself: torque off, RAM at its defaults",
               happens=lambda fault: fault.owner.boot(fault.now_s)),
    FaultEntry("servoN.factory",
               "it has its factory settings: ID 1, 57600 bit/s, position mode, return delay of "
               "500 us; two of these servos answer at the same time", effect=_factory),
    FaultEntry("servoN.overload", "its overload protection latches and switches the torque off",
               happens=lambda fault: fault.owner.plant.overload()),
    FaultEntry("servoN.overheat", "its internal temperature has this value, and falls slowly",
               "plant.temperature_c", Number("degC", -20.0, 150.0, default=90.0)),
    FaultEntry("servoN.supply", "its supply has this voltage", "plant.voltage_v",
               Number("V", 5.0, 30.0, default=6.0)),
    FaultEntry("servoN.error", "these bits of Hardware Error Status (16 shock, 8 encoder)",
               "injected_error", Number("bits", 1, 63, default=16, whole=True)),
    FaultEntry("servoN.stuck", "its encoder always reports the same angle", "plant.stuck_at_rad",
               position=lambda fault: fault.owner.plant.angle_rad),
    FaultEntry("servoN.jump", "the angle of its encoder suddenly grows by this value",
               value=Number("rad", -6.3, 6.3, default=0.5), effect=_jump),
    FaultEntry("servoN.turn",
               "its reported position is off by this number of turns; it still follows its goals",
               _REPORT, Number("turns", -10, 10, default=1, whole=True),
               lambda fault: int(fault.value) * fault.owner.model.pulses_per_turn),
    FaultEntry("servoN.drift",
               "its reported position drifts at this rate; it still follows its goals", _REPORT,
               Number("rad/s", -6.3, 6.3, default=0.1), lambda _fault: 0, act=_drift),
    FaultEntry("servoN.turned",
               "it is mounted in the opposite direction of gripper.servos[].direction", "turned",
               effect=_turn_round),
    FaultEntry("servoN.horn",
               "its horn is this number of pulses farther open than gripper.servos[].zero_pulse",
               "horn", Number("pulses", -1000, 1000, default=100, whole=True), effect=_remount),
    FaultEntry("servoN.watchdog_off", "its bus watchdog trips, but the motor goes on (330 size)",
               "watchdog_stop", position=lambda _fault: WatchdogStop.KEEPS_TURNING),
    FaultEntry("servoN.wrong", "an EEPROM register differs from the config", "eeprom",
               Setting(unit="register:number", default="current_limit:100"), effect=_wrong,
               check=_check_register),

    FaultEntry("axisN.following_error",
               "the axis is blocked: it does not follow its set-point, a servo stalls", "blocked"),
    FaultEntry("axisN.silence",
               "its drive or servo receives and sends nothing; its motion goes on", "dead"),
    FaultEntry("axisN.limit_switch",
               "the negative (-1) or positive (1) limit switch of its drive is active",
               "forced_switch", Number("end", -1, 1, default=1, whole=True), check=_check_drive),
    FaultEntry("axisN.fault",
               "its drive goes to fault with this error code (603Fh); a servo is overloaded",
               value=Number("code", 1, 0xFFFF, default=0x2310, whole=True),
               happens=lambda fault: fault.owner.fail(int(fault.value))),
    FaultEntry("axisN.reboot",
               "its drive or servo restarts: torque off, set-up and position lost",
               happens=lambda fault: fault.owner.power_cycle()),

    FaultEntry("object.gone", "the part is removed from the fingers",
               happens=lambda fault: fault.owner.remove()),
    FaultEntry("object.slips", "the part slides along the pads until it has left them", "slips",
               Number("mm/s", 0.1, 1000.0, default=20.0), effect=lambda _fault: lambda: None,
               act=_slip),
    FaultEntry("object.trapped",
               "a trapped object beside the part grows by this value at 20 mm/s and pushes back",
               "trapped", Number("mm", 0.0, 10.0, default=3.0),
               effect=lambda fault: partial(fault.owner.swell, 0.0), act=_swell),
)
# fmt: on
VOCABULARY: dict[str, FaultEntry] = {
    entry.name: entry
    for entry in sorted(_FAULTS, key=lambda e: COMPONENTS.index(e.name.partition(".")[0]))
}
"""All faults by name; ``servoN`` and ``axisN`` stand for each servo and axis of the config."""
