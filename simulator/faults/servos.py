"""Named faults of the servo bus and of single servos."""

from gripper.dynamixel.control_table import REGISTERS
from simulator.errors import SimulatorSettingsError
from simulator.faults.entry import (
    SHARE,
    FaultEntry,
    FaultKind,
    Number,
    Setting,
    Target,
    Undo,
    knob_fault,
    turned,
    unplugging,
)
from simulator.servo.control_table import EEPROM_END
from simulator.servo.faults import Chatter
from simulator.servo.firmware import ServoCore, WatchdogStop
from simulator.servo.motor import ServoMotor

_REPORT = "reported_offset_raw"
"""Knob of a servo: counts added to the reported position, but not to that of its control loop."""
_BOOT_APART_S = 0.003
"""Time in s between the boots of servos on one supply; an assumption."""


def _silence(target: Target, servo_ids: list[int]) -> Undo:
    silent = target.devices.faults.servo_wire.silent
    added = [servo_id for servo_id in servo_ids if servo_id not in silent]
    silent.update(added)
    return lambda: silent.difference_update(added)


def _all_silent(target: Target) -> Undo:
    return _silence(target, [servo.servo_id for servo in target.devices.settings.servos])


def _id(target: Target) -> int:
    return target.devices.settings.servos[target.servo].servo_id


def _core(target: Target) -> ServoCore:
    return target.devices.servo_bus.servos[target.servo].core


def _motor(target: Target) -> ServoMotor:
    return target.devices.mechanics.motors[target.servo]


def _stuck(target: Target) -> Undo:
    motor = _motor(target)
    return turned(motor, "stuck_at_rad", motor.angle_rad)


def _jump(target: Target) -> None:
    _motor(target).encoder_offset_rad += target.number


def _turns(target: Target) -> Undo:
    report_raw = int(target.number) * _motor(target).model.pulses_per_turn
    return turned(_core(target).position, _REPORT, report_raw)


def _remount(target: Target) -> Undo:
    """Mount the horn of a servo farther open by the value in pulses."""
    off_rad = target.number * _motor(target).model.rad_per_pulse
    target.devices.mechanics.remount(target.servo, off_rad=off_rad)
    return lambda: target.devices.mechanics.remount(target.servo, off_rad=-off_rad)


def _turn_round(target: Target) -> Undo:
    target.devices.mechanics.remount(target.servo, turned=True)
    return lambda: target.devices.mechanics.remount(target.servo, turned=True)


def _factory(target: Target) -> None:
    core = _core(target)
    core.registers.load_factory()
    core.boot(target.now_s + _BOOT_APART_S * target.servo)


def _drift(target: Target) -> Undo:
    position, pulse_rad = _core(target).position, _motor(target).model.rad_per_pulse

    def act(now_s: float) -> None:
        drifted_rad = target.number * (now_s - target.now_s)
        position.reported_offset_raw = round(drifted_rad / pulse_rad)

    target.act = act
    return turned(position, _REPORT, 0)


def _check_register(target: Target) -> None:
    name, number = target.setting
    register = REGISTERS.get(name)
    if register is None or register.address >= EEPROM_END:
        raise SimulatorSettingsError(f"{name!r} is not an EEPROM register such as current_limit")
    if register.writable:
        registers = _core(target).registers
        before = registers.get(name)
        registers.configure(name, number)
        registers.put(name, before)
    elif not 0 <= number < 256**register.size:
        raise SimulatorSettingsError(f"{name} = {number} does not fit into {register.size} bytes")


def _wrong(target: Target) -> Undo:
    name, number = target.setting
    registers = _core(target).registers
    before = registers.get(name)
    registers.put(name, number)
    return lambda: registers.put(name, before)


def _lose_next(target: Target) -> None:
    target.devices.faults.servo_wire.drop_next += int(target.number)


# fmt: off
SERVOS = (
    knob_fault("servos.loss", FaultKind.INTERMITTENT, "answers are lost", "drop", SHARE),
    FaultEntry("servos.lose_next", FaultKind.INTERMITTENT, "this number of answers is lost",
               _lose_next, value=Number("answers", 1, 100_000, default=1, whole=True), moment=True),
    knob_fault("servos.lost_requests", FaultKind.INTERMITTENT, "requests are lost", "lose_request",
               SHARE),
    knob_fault("servos.corrupt", FaultKind.GARBAGE, "one bit of an answer flips", "bit_flip",
               SHARE),
    knob_fault("servos.garbage", FaultKind.GARBAGE, "noise comes before an answer", "garbage",
               SHARE),
    knob_fault("servos.truncated", FaultKind.GARBAGE, "answers lack their end", "truncate", SHARE),
    knob_fault("servos.wrong_id", FaultKind.WRONG, "answers name another servo", "wrong_id", SHARE),
    knob_fault("servos.delayed", FaultKind.DELAYED, "all answers come late", "delay_s",
               Number("s", 0.0, 1.0, default=0.04)),
    knob_fault("servos.repeated", FaultKind.WRONG, "each answer comes again after this time",
               "repeat_s", Number("s", 1e-4, 1.0, default=0.0095)),
    knob_fault("servos.lagging", FaultKind.WRONG,
               "each answer belongs to the previous request of its kind", "lag"),
    knob_fault("servos.chatter", FaultKind.GARBAGE,
               "another device sends a byte with this period, also into answers", "chatter",
               Number("s", 1e-4, 10.0, default=0.001),
               position=lambda target: Chatter(data=b"\xa5", every_s=target.number)),
    FaultEntry("servos.off", FaultKind.OFF, "all servos are silent", _all_silent, "silent"),
    knob_fault("servos.echo", FaultKind.WRONG, "the host receives its own bytes", "echo"),
    FaultEntry("servos.unplugged", FaultKind.UNPLUGGED, "the adapter of the servo bus is gone",
               unplugging("servos"), "servo_plug"),
)

SERVO = (
    FaultEntry("servoN.off", FaultKind.OFF,
               "the servo receives and answers nothing; its torque stays",
               lambda target: _silence(target, [_id(target)]), "silent"),
    FaultEntry("servoN.reboot", FaultKind.REBOOT,
               "it reboots by itself: torque off, RAM at its defaults",
               lambda target: _core(target).boot(target.now_s), moment=True),
    FaultEntry("servoN.factory", FaultKind.WRONG,
               "it has its factory settings: ID 1, 57600 bit/s, position mode, return delay of "
               "500 us; two of these servos answer at the same time", _factory, moment=True),
    FaultEntry("servoN.overload", FaultKind.OFF,
               "its overload protection latches and switches the torque off",
               lambda target: _motor(target).overload(), moment=True),
    knob_fault("servoN.overheat", FaultKind.WRONG,
               "its internal temperature has this value, and falls slowly", "temperature_c",
               Number("degC", -20.0, 150.0, default=90.0), owner=_motor),
    knob_fault("servoN.supply", FaultKind.WRONG, "its supply has this voltage", "voltage_v",
               Number("V", 0.0, 30.0, default=6.0), owner=_motor),
    knob_fault("servoN.error", FaultKind.WRONG,
               "these bits of Hardware Error Status (16 shock, 8 encoder)", "injected_error",
               Number("bits", 1, 63, default=16, whole=True), owner=_core),
    FaultEntry("servoN.stuck", FaultKind.STUCK, "its encoder always reports the same angle",
               _stuck, "stuck"),
    FaultEntry("servoN.jump", FaultKind.WRONG,
               "the angle of its encoder suddenly grows by this value",
               _jump, value=Number("rad", -6.3, 6.3, default=0.5), moment=True),
    FaultEntry("servoN.turn", FaultKind.WRONG,
               "its reported position is off by this number of turns; it still follows its goals",
               _turns, "report", Number("turns", -10, 10, default=1, whole=True)),
    FaultEntry("servoN.drift", FaultKind.WRONG,
               "its reported position drifts at this rate; it still follows its goals",
               _drift, "report", Number("rad/s", -6.3, 6.3, default=0.1)),
    FaultEntry("servoN.turned", FaultKind.WRONG,
               "it is mounted in the opposite direction of gripper.servos[].direction",
               _turn_round, "turned"),
    FaultEntry("servoN.horn", FaultKind.WRONG,
               "its horn is this number of pulses farther open than gripper.servos[].zero_pulse",
               _remount, "horn", Number("pulses", -1000, 1000, default=100, whole=True)),
    knob_fault("servoN.watchdog_off", FaultKind.WRONG,
               "its bus watchdog trips, but the motor goes on (330 size)", "watchdog_stop",
               owner=_core, position=lambda _: WatchdogStop.KEEPS_TURNING),
    FaultEntry("servoN.wrong", FaultKind.WRONG,
               "an EEPROM register differs from the config", _wrong, "eeprom",
               Setting(unit="register:number", default="current_limit:100"), check=_check_register),
)
# fmt: on
