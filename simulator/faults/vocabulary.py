"""All named faults: of the CAN link, the control unit, taxels, boards, servos, axes, the object."""

import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from gripper.dynamixel.control_table import REGISTERS
from simulator.boards.site import BoardFaults
from simulator.boards.uskin import UskinSettings
from simulator.can.drive import SimulatedDrive
from simulator.can.faults import ControlUnitFaults
from simulator.errors import SimulatorSettingsError
from simulator.faults.entry import Fault, FaultEntry, Number, Setting, Undo, turned
from simulator.servo.control_table import EEPROM_END
from simulator.servo.faults import Chatter, WireFaults
from simulator.servo.firmware import ServoCore, WatchdogStop
from simulator.servo.motor import ServoMotor
from simulator.servo.wrist import SimulatedWrist
from simulator.world.world import PhysicalWorld

SHARE = Number("share", 0.0, 1.0, default=0.05)
"""Share of the traffic, or of the taxels, with the fault."""
_FINGER = Number("finger", 0, 1, default=0, whole=True)
"""Finger of a board."""
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

# -- Owners of the knobs ---------------------------------------------------------------------------


def _can(fault: Fault) -> Any:
    return fault.devices.faults.can


def _unit(fault: Fault) -> ControlUnitFaults:
    return fault.devices.faults.unit


def _serial_boards(fault: Fault) -> BoardFaults:
    if not fault.devices.boards:
        raise SimulatorSettingsError("this cell has no sensor boards on serial lines")
    return fault.devices.faults.boards


def _uskin_boards(fault: Fault) -> BoardFaults:
    if not isinstance(fault.devices.settings.boards, UskinSettings):
        raise SimulatorSettingsError("this cell has no sensor boards on CAN")
    return fault.devices.faults.boards


def _line(fault: Fault) -> WireFaults:
    return fault.devices.faults.servo_wire


def _core(fault: Fault) -> ServoCore:
    return fault.devices.servo_bus.servos[fault.index].core


def _motor(fault: Fault) -> ServoMotor:
    return fault.devices.mechanics.motors[fault.index]


def _axis(fault: Fault) -> SimulatedDrive | SimulatedWrist:
    return list(fault.devices.axes.values())[fault.index]


def _drive(fault: Fault) -> SimulatedDrive:
    axis = _axis(fault)
    if isinstance(axis, SimulatedDrive):
        return axis
    raise SimulatorSettingsError("this fault is for drives, but the axis is a servo")


def _world(fault: Fault) -> PhysicalWorld:
    return fault.devices.world


# -- Effects other than one knob -------------------------------------------------------------------


def _lose_next(fault: Fault) -> None:
    fault.entry.owner(fault).drop_next += int(fault.value)


def _unplugged(fault: Fault) -> Undo:
    component = fault.entry.name.partition(".")[0]
    return fault.plugs[f"board{int(fault.value)}" if component == "board" else component]()


def _check_identity(fault: Fault) -> None:
    name, number = fault.setting
    if name not in _IDENTITY:
        raise SimulatorSettingsError(
            f"unit.wrong takes one of {', '.join(_IDENTITY)} and a number; got {name!r}"
        )
    if not 0 <= number < 2**32:
        raise SimulatorSettingsError(f"unit.wrong: {number} does not fit into 32 bits")


def _pretending(fault: Fault) -> Undo:
    """Replace the value of an object of the unit's dictionary."""
    dictionary, (name, number) = fault.devices.unit.dictionary, fault.setting
    before = dictionary.pretend(_IDENTITY[name], number)
    return lambda: dictionary.pretend(_IDENTITY[name], before)


def _stuck_taxels(fault: Fault, taxels: Iterable[int], counts: int) -> dict[int, int]:
    """Return the counts of all stuck taxels; taxels that are already stuck stay so."""
    return fault.devices.faults.unit.stuck_counts | dict.fromkeys(taxels, counts)


def _some_taxels(fault: Fault, counts: int) -> dict[int, int]:
    n_taxels = fault.devices.settings.layout.n_taxels
    order = np.random.default_rng(fault.devices.settings.seed).permutation(n_taxels)
    return _stuck_taxels(fault, order[: round(fault.value * n_taxels)].tolist(), counts)


def _chosen_taxels(fault: Fault) -> dict[int, int]:
    name, counts = fault.setting
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


def _jump(fault: Fault) -> None:
    _motor(fault).encoder_offset_rad += fault.value


def _turns(fault: Fault) -> Undo:
    report_raw = int(fault.value) * _motor(fault).model.pulses_per_turn
    return turned(_core(fault).position, _REPORT, report_raw)


def _drift(fault: Fault) -> Undo:
    position, pulse_rad = _core(fault).position, _motor(fault).model.rad_per_pulse

    def act(now_s: float) -> None:
        drifted_rad = fault.value * (now_s - fault.now_s)
        position.reported_offset_raw = round(drifted_rad / pulse_rad)

    fault.act = act
    return turned(position, _REPORT, 0)


def _remount(fault: Fault) -> Undo:
    """Mount the horn of a servo farther open by the value in pulses."""
    mechanics, off_rad = fault.devices.mechanics, fault.value * _motor(fault).model.rad_per_pulse
    mechanics.remount(fault.index, off_rad=off_rad)
    return lambda: mechanics.remount(fault.index, off_rad=-off_rad)


def _turn_round(fault: Fault) -> Undo:
    mechanics = fault.devices.mechanics
    mechanics.remount(fault.index, turned=True)
    return lambda: mechanics.remount(fault.index, turned=True)


def _factory(fault: Fault) -> None:
    core = _core(fault)
    core.registers.load_factory()
    core.boot(fault.now_s + _BOOT_APART_S * fault.index)


def _check_register(fault: Fault) -> None:
    name, number = fault.setting
    register = REGISTERS.get(name)
    if register is None or register.address >= EEPROM_END:
        raise SimulatorSettingsError(f"{name!r} is not an EEPROM register such as current_limit")
    if register.writable:
        registers = _core(fault).registers
        before = registers.get(name)
        registers.configure(name, number)
        registers.put(name, before)
    elif not 0 <= number < 256**register.size:
        raise SimulatorSettingsError(f"{name} = {number} does not fit into {register.size} bytes")


def _wrong(fault: Fault) -> Undo:
    name, number = fault.setting
    registers = _core(fault).registers
    before = registers.get(name)
    registers.put(name, number)
    return lambda: registers.put(name, before)


def _slips(fault: Fault) -> Undo:
    world, speed_m_s, last_s = _world(fault), 1e-3 * fault.value, fault.now_s

    def act(now_s: float) -> None:
        nonlocal last_s
        way_m = (now_s - last_s) * speed_m_s
        if way_m >= _SLIDE_M:
            world.slide(way_m)
            last_s = now_s

    fault.act = act
    return lambda: None


def _trapped(fault: Fault) -> Undo:
    world = _world(fault)

    def act(now_s: float) -> None:
        grown_m = (now_s - fault.now_s) * _SWELLING_M_S
        world.swell(min(grown_m, 1e-3 * fault.value))

    fault.act = act
    return lambda: world.swell(0.0)


def _of_finger(name: str, meaning: str, knob: str, owner: Any) -> FaultEntry:
    """Return a fault of one board: its knob is the set of the fingers that have it."""
    return FaultEntry(
        name,
        meaning,
        owner,
        knob,
        _FINGER,
        position=lambda fault: getattr(owner(fault), knob) | {int(fault.value)},
    )


# -- The vocabulary --------------------------------------------------------------------------------

# fmt: off
_FAULTS = (
    FaultEntry("can.loss", "messages to the host are lost", _can, "drop_rate", SHARE),
    FaultEntry("can.lose_next", "this number of messages to the host is lost", _can,
               value=Number("messages", 1, 100_000, default=1, whole=True), happens=_lose_next),
    FaultEntry("can.duplicate", "messages come twice", _can, "duplicate_rate", SHARE),
    FaultEntry("can.swapped", "messages come after their successor", _can, "swap_rate", SHARE),
    FaultEntry("can.garbage", "one bit flips after the CRC check", _can, "corrupt_rate", SHARE),
    FaultEntry("can.short", "fewer bytes than the length code", _can, "truncate_rate", SHARE),
    FaultEntry("can.wrong_dlc", "messages of another length", _can, "wrong_dlc_rate", SHARE),
    FaultEntry("can.delayed", "messages to the host come late", _can, "delay_s",
               Number("s", 0.0, 60.0, default=0.1)),
    FaultEntry("can.flood",
               "messages of an unknown identifier with random content come at this rate", _can,
               "flood_hz", Number("Hz", 0.1, 20_000.0, default=8000.0)),
    FaultEntry("can.passive", "the host's controller is error-passive", _can, "error_passive"),
    FaultEntry("can.off", "the host's controller is bus-off: nothing passes", _can, "bus_off"),
    FaultEntry("can.unplugged", "the host's adapter is unplugged", _can, "can_plug",
               effect=_unplugged),

    FaultEntry("unit.off", "the control unit receives and sends nothing", _unit, "dead"),
    FaultEntry("unit.heartbeat_off", "the heartbeat stops, all else goes on", _unit,
               "heartbeat_off"),
    FaultEntry("unit.stuck", "valid frames, always with the counts of the last scan", _unit,
               "frozen"),
    FaultEntry("unit.reboot", "the unit loses its supply and reboots", _unit,
               happens=lambda fault: fault.devices.unit.power_cycle()),
    FaultEntry("unit.emergency", "the unit reports an error (EMCY)", _unit,
               value=Number("code", 0, 0xFFFF, default=0x5000, whole=True),
               happens=lambda fault: fault.devices.unit.emergency(int(fault.value))),
    FaultEntry("unit.pre_operational",
               "the unit changes to pre-operational, as by a command of another master", _unit,
               happens=lambda fault: fault.devices.unit.command("PRE-OPERATIONAL", fault.now_s)),
    FaultEntry("unit.wrong", "the unit differs (vendor, product, revision, serial, taxels, pads)",
               _unit, "identity", Setting(unit="name:number", default="serial:99"),
               effect=_pretending, check=_check_identity),
    FaultEntry("unit.second_node", "another unit with the same node id joins the bus", _unit,
               "second_node",
               effect=lambda fault: fault.devices.can.add(
                   fault.devices.second_unit(fault.now_s))),
    FaultEntry("unit.pads_swapped", "the pads of the two fingers are exchanged at the unit",
               _unit, "pads_swapped"),
    FaultEntry("unit.forces_off", "no force messages any more; frames go on", _unit, "forces_off"),
    FaultEntry("unit.forces_lost", "force messages are lost, evenly", _unit, "forces_lost", SHARE),
    FaultEntry("unit.forces_late", "force messages come late", _unit, "forces_late_s",
               Number("s", 0.0, 1.0, default=0.02)),
    FaultEntry("unit.forces_each", "only each n-th force message is made; the counter shows no gap",
               _unit, "forces_each", Number("messages", 1, 100, default=15, whole=True)),
    FaultEntry("unit.force_gain",
               "factor on the force in force messages, as by a table of other pads", _unit,
               "force_gain", Number("factor", -100.0, 100.0, default=1.6)),
    FaultEntry("unit.force_offset", "offset of the force messages", _unit, "force_offset_n",
               Number("N", -60.0, 60.0, default=-2.0)),
    FaultEntry("unit.pads_empty", "force messages repeat those of empty pads", _unit,
               "pads_empty"),
    FaultEntry("unit.centres_stuck", "the centre of force in the messages does not move", _unit,
               "centres_stuck"),
    FaultEntry("unit.centres_off", "force messages without a centre of force", _unit,
               "centres_off"),
    FaultEntry("unit.centre_shift",
               "the centre of force in the messages is shifted along the fingers", _unit,
               "centre_shift_taxels", Number("pitches", -8.0, 8.0, default=1.0)),

    FaultEntry("taxels.stuck", "this share of the taxels reads full scale", _unit, "stuck_counts",
               SHARE, lambda fault: _some_taxels(fault, fault.devices.settings.layout.adc_max)),
    FaultEntry("taxels.stuck_at", "one taxel, or a range, reads these counts (0: dead)", _unit,
               "stuck_counts", Setting(unit="taxel:counts", default="0:0"), _chosen_taxels,
               check=_chosen_taxels),
    FaultEntry("taxels.off", "this share of the taxels reads 0", _unit, "stuck_counts", SHARE,
               lambda fault: _some_taxels(fault, 0)),
    FaultEntry("taxels.saturated", "all taxels of this pad read full scale", _unit, "stuck_counts",
               _PAD, _saturated_pad, check=_saturated_pad),
    FaultEntry("taxels.force_gain", "factor on the force of each taxel: the law of other foam",
               _world, "force_gain", Number("factor", 0.0, 100.0, default=0.8)),
    FaultEntry("taxels.offset", "counts added to each taxel", _unit, "offset_counts",
               Number("counts", -65_535.0, 65_535.0, default=20.0)),
    FaultEntry("taxels.gain", "factor on the counts of each taxel", _unit, "gain",
               Number("factor", 0.0, 100.0, default=0.5)),

    FaultEntry("board.unplugged", "this finger's board is unplugged", _serial_boards, "board_plug",
               _FINGER, effect=_unplugged),
    _of_finger("board.off", "the board of this finger sends nothing", "silent", _serial_boards),
    _of_finger("board.frozen", "the board of this finger always sends one frame", "frozen",
               _serial_boards),
    _of_finger("board.marked",
               "the samples of this finger's board always contain a header at one place", "marked",
               _serial_boards),
    FaultEntry("board.repeated", "frames of both boards repeat the one before", _serial_boards,
               "repeated", SHARE),
    FaultEntry("board.lost_byte", "frames of both boards lack one byte", _serial_boards,
               "lost_byte", SHARE),
    FaultEntry("board.torn", "frames of both boards end in the middle", _serial_boards, "torn",
               SHARE),
    FaultEntry("board.late", "frames of both boards come late", _serial_boards, "late_s",
               Number("s", 0.0, 1.0, default=0.05)),
    FaultEntry("board.rows", "both boards send this number of rows: another profile",
               _serial_boards, "rows", Number("rows", 1, 64, default=16, whole=True)),
    _of_finger("uskin.off", "this finger's board is unplugged", "silent", _uskin_boards),
    _of_finger("uskin.low_supply",
               "this finger's board restarts at low supply and waits for its start", "low_supply",
               _uskin_boards),
    _of_finger("uskin.doubled", "another board has the address of this finger's board", "doubled",
               _uskin_boards),
    FaultEntry("uskin.drift", "z of all taxels drifts", _uskin_boards, "drift_counts_s",
               Number("counts/s", -1e5, 1e5, default=1000.0)),

    FaultEntry("servos.loss", "answers are lost", _line, "drop", SHARE),
    FaultEntry("servos.lose_next", "this number of answers is lost", _line,
               value=Number("answers", 1, 100_000, default=1, whole=True), happens=_lose_next),
    FaultEntry("servos.lost_requests", "requests are lost", _line, "lose_request", SHARE),
    FaultEntry("servos.corrupt", "one bit of an answer flips", _line, "bit_flip", SHARE),
    FaultEntry("servos.garbage", "noise comes before an answer", _line, "garbage", SHARE),
    FaultEntry("servos.truncated", "answers lack their end", _line, "truncate", SHARE),
    FaultEntry("servos.wrong_id", "answers name another servo", _line, "wrong_id", SHARE),
    FaultEntry("servos.delayed", "all answers come late", _line, "delay_s",
               Number("s", 0.0, 1.0, default=0.04)),
    FaultEntry("servos.repeated", "each answer comes again after this time", _line, "repeat_s",
               Number("s", 1e-4, 1.0, default=0.0095)),
    FaultEntry("servos.lagging", "each answer belongs to the previous request of its kind", _line,
               "lag"),
    FaultEntry("servos.chatter",
               "another device sends a byte with this period, also into answers", _line, "chatter",
               Number("s", 1e-4, 10.0, default=0.001),
               lambda fault: Chatter(data=b"\xa5", every_s=fault.value)),
    FaultEntry("servos.off", "all servos are silent", _line, "silent", effect=_silence),
    FaultEntry("servos.echo", "the host receives its own bytes", _line, "echo"),
    FaultEntry("servos.unplugged", "the adapter of the servo bus is gone", _line, "servo_plug",
               effect=_unplugged),

    FaultEntry("servoN.off", "the servo receives and answers nothing; its torque stays", _core,
               "silent", effect=_silence),
    FaultEntry("servoN.reboot", "it reboots by itself: torque off, RAM at its defaults", _core,
               happens=lambda fault: _core(fault).boot(fault.now_s)),
    FaultEntry("servoN.factory",
               "it has its factory settings: ID 1, 57600 bit/s, position mode, return delay of "
               "500 us; two of these servos answer at the same time", _core, happens=_factory),
    FaultEntry("servoN.overload", "its overload protection latches and switches the torque off",
               _motor, happens=lambda fault: _motor(fault).overload()),
    FaultEntry("servoN.overheat", "its internal temperature has this value, and falls slowly",
               _motor, "temperature_c", Number("degC", -20.0, 150.0, default=90.0)),
    FaultEntry("servoN.supply", "its supply has this voltage", _motor, "voltage_v",
               Number("V", 0.0, 30.0, default=6.0)),
    FaultEntry("servoN.error", "these bits of Hardware Error Status (16 shock, 8 encoder)", _core,
               "injected_error", Number("bits", 1, 63, default=16, whole=True)),
    FaultEntry("servoN.stuck", "its encoder always reports the same angle", _motor, "stuck_at_rad",
               position=lambda fault: _motor(fault).angle_rad),
    FaultEntry("servoN.jump", "the angle of its encoder suddenly grows by this value", _motor,
               value=Number("rad", -6.3, 6.3, default=0.5), happens=_jump),
    FaultEntry("servoN.turn",
               "its reported position is off by this number of turns; it still follows its goals",
               _core, "report", Number("turns", -10, 10, default=1, whole=True), effect=_turns),
    FaultEntry("servoN.drift",
               "its reported position drifts at this rate; it still follows its goals", _core,
               "report", Number("rad/s", -6.3, 6.3, default=0.1), effect=_drift),
    FaultEntry("servoN.turned",
               "it is mounted in the opposite direction of gripper.servos[].direction", _motor,
               "turned", effect=_turn_round),
    FaultEntry("servoN.horn",
               "its horn is this number of pulses farther open than gripper.servos[].zero_pulse",
               _motor, "horn", Number("pulses", -1000, 1000, default=100, whole=True),
               effect=_remount),
    FaultEntry("servoN.watchdog_off", "its bus watchdog trips, but the motor goes on (330 size)",
               _core, "watchdog_stop", position=lambda _fault: WatchdogStop.KEEPS_TURNING),
    FaultEntry("servoN.wrong", "an EEPROM register differs from the config", _core, "eeprom",
               Setting(unit="register:number", default="current_limit:100"), effect=_wrong,
               check=_check_register),

    FaultEntry("axisN.following_error",
               "the axis is blocked: it does not follow its set-point, a servo stalls", _axis,
               "blocked"),
    FaultEntry("axisN.silence",
               "its drive or servo receives and sends nothing; its motion goes on", _axis, "dead"),
    FaultEntry("axisN.limit_switch",
               "the negative (-1) or positive (1) limit switch of its drive is active", _drive,
               "forced_switch", Number("end", -1, 1, default=1, whole=True)),
    FaultEntry("axisN.fault",
               "its drive goes to fault with this error code (603Fh); a servo is overloaded", _axis,
               value=Number("code", 1, 0xFFFF, default=0x2310, whole=True),
               happens=lambda fault: _axis(fault).fail(int(fault.value))),
    FaultEntry("axisN.reboot",
               "its drive or servo restarts: torque off, set-up and position lost", _axis,
               happens=lambda fault: _axis(fault).power_cycle()),

    FaultEntry("object.gone", "the part is removed from the fingers", _world,
               happens=lambda fault: _world(fault).remove()),
    FaultEntry("object.slips", "the part slides along the pads until it has left them", _world,
               "slips", Number("mm/s", 0.1, 1000.0, default=20.0), effect=_slips),
    FaultEntry("object.trapped",
               "a trapped object beside the part grows by this value at 20 mm/s and pushes back",
               _world, "trapped", Number("mm", 0.0, 10.0, default=3.0), effect=_trapped),
)
# fmt: on
VOCABULARY: dict[str, FaultEntry] = {entry.name: entry for entry in _FAULTS}
"""All faults by name; ``servoN`` and ``axisN`` stand for each servo and axis of the config."""
