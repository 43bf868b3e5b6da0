"""A DYNAMIXEL X servo as a Protocol 2.0 device: its firmware, and its answer to each instruction.

Written from the ROBOTIS e-Manual ("Protocol 2.0", control tables of the X series). It carries out
ping, read, write, group reads and writes, reboot. Other instructions (registered writes, fast
reads, factory reset, clear, backup) are refused, as by a firmware without them. Homing Offset and
Startup Configuration have no effect: the driver refuses both. `simulator.servo.bus` finds the
packets and orders the answers; `simulator.servo.motor` carries out the commands of the firmware.
"""

import math
import struct
from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple

from gripper.dynamixel import control_table as ct
from gripper.dynamixel.models import OperatingMode, ServoModel
from gripper.values.servo_checks import HardwareError
from simulator.servo.control_table import Item, ServoRegisters, is_x330
from simulator.servo.gearing import data_sheet
from simulator.servo.motor import (
    FOLLOWS_POSITION,
    OVERLOAD_BUDGET_S,
    DriveCommand,
    ServoMotor,
    whole_counts,
)
from simulator.servo.protocol2 import ALERT, Instruction, StatusError

BAUD_RATES = (
    *(9600, 57600, 115200, 1_000_000, 2_000_000),
    *(3_000_000, 4_000_000, 4_500_000, 6_000_000, 10_500_000),
)
"""Baud rate by the content of Baud Rate (8); the last two on the RH-P12-RN(A) only."""
_EXTENDED_POSITION = range(-1_048_575, 1_048_576)
"""Goal Position in the modes without position limits: 256 turns."""
_LIMITED_BY = {
    ct.GOAL_PWM.address: "pwm_limit",
    ct.GOAL_CURRENT.address: "current_limit",
    ct.GOAL_VELOCITY.address: "velocity_limit",
}
"""Address of a goal and the item that limits its magnitude."""
_GOAL_ADDRESSES = frozenset({*_LIMITED_BY, ct.GOAL_POSITION.address})
_GAINS_IN_USE = frozenset(
    {ct.POSITION_D_GAIN.address, ct.POSITION_I_GAIN.address, ct.POSITION_P_GAIN.address}
)
_ANSWERS_READS, _ANSWERS_ALL = 1, 2
"""Contents of Status Return Level (68)."""
_READS = frozenset({Instruction.READ, Instruction.SYNC_READ, Instruction.BULK_READ})
_PRESENT_START, _PRESENT_END = ct.REALTIME_TICK.address, ct.PRESENT_TEMPERATURE.end
"""Addresses of the items of the present state, 120 to 146."""
_GOAL_START, _GOAL_END = ct.GOAL_PWM.address, _PRESENT_START
"""Addresses of goals and profile, 100 to 119."""
_IN_POSITION_PULSES = 20
"""Distance to Goal Position in pulses at which Moving Status shows arrival (e-Manual, 123)."""
_REBOOT_S = 0.35
"""Time in s of a reboot, without reception and answers; an assumption."""
_REVERSE_MODE = 0x01
"""Bit of Drive Mode (e-Manual, 10); those of a time-based profile and of torque by goals have no
effect here."""
_TICKS_PER_S, _ROUNDING_TICKS = 1000.0, 1e-6
"""Rate of Realtime Tick (e-Manual, 120), and the allowance for rounding in ticks."""
_ARRIVED, _PROFILE_ONGOING, _TRAPEZOIDAL_PROFILE = 0x01, 0x02, 0x30
"""Bits of Moving Status (e-Manual, 123)."""
_PRESENT = struct.Struct("<HBBhhiiiiHB")
"""Registers 120 to 146: tick, moving, moving status, PWM, current, velocity, position, velocity and
position trajectory, voltage, temperature."""
_GOALS = struct.Struct("<hhiIIi")
"""Registers 100 to 119: PWM, current, velocity, profile acceleration and velocity, position."""
_THRESHOLD = struct.Struct("<I")
"""Registers 24 to 27: moving threshold."""
_LIMITS = struct.Struct("<HH4xI")
"""Registers 36 to 47: limits of PWM, current and velocity, with the 4 bytes before the last."""
_GAINS = struct.Struct("<HHH")
"""Registers 80 to 85: D, I and P gain of the position."""
_TORQUE = ct.TORQUE_ENABLE.address
_MODE = ct.OPERATING_MODE.address
_DRIVE = ct.DRIVE_MODE.address
_HARDWARE_ERROR = ct.HARDWARE_ERROR_STATUS.address
_TEMPERATURE_LIMIT, _VOLTAGE = ct.TEMPERATURE_LIMIT.address, ct.MAX_VOLTAGE_LIMIT.address
"""Addresses of items that each step of the motor reads; the lowest voltage follows the highest."""


def _bounded(raw: int, limit: int) -> int:
    return -limit if raw < -limit else limit if raw > limit else raw


class WatchdogStop(Enum):
    """Reaction of the motor when the bus watchdog trips; the e-Manual only states that it stops.

    HOLD keeps the present position within the present current limit. ZERO_CURRENT switches the
    winding current off. KEEPS_TURNING is the fault of the 330 size: register 98 reads -1, but the
    motor goes on.
    """

    HOLD = "hold"
    ZERO_CURRENT = "zero_current"
    KEEPS_TURNING = "keeps_turning"


class StatusBody(NamedTuple):
    """Answer of a servo to an instruction, before it is put into a packet."""

    error: int
    """Error byte, Alert bit included."""
    data: bytes = b""
    """Parameters after the error byte."""


class SimulatedServo:
    """One servo on the bus: its registers and their effects.

    Parameters
    ----------
    settings
        Raw values of EEPROM items by register name, over the factory's; the factory leaves the
        servo at 57600 baud with a return delay of 500 us.
    """

    def __init__(
        self,
        servo_id: int,
        model: ServoModel,
        plant: ServoMotor,
        *,
        settings: Mapping[str, int] | None = None,
    ) -> None:
        self.made_as = servo_id
        """Initial ID, which faults use even if the ID changes."""
        self.registers = ServoRegisters(model, {**(settings or {}), "id": servo_id})
        self.plant = plant
        self.model = model
        self._to_raw = whole_counts(model)
        self.watchdog_stop = WatchdogStop.HOLD
        """Effect of a tripped bus watchdog on the motor."""
        self.injected_error = 0
        """Bits of Hardware Error Status set by a fault knob."""
        self.silent_until_s = -math.inf
        """End of the silence after a reboot in s."""
        self.reported_offset_raw = 0
        """Fault: counts added to the reported position; the control loop of the servo does not use
        them."""
        self.fed_s = 0.0
        """Time in s of the last instruction packet on the bus, for the watchdog."""
        self._turn_offset = 0
        self._watchdog_s = math.inf
        self._stopped = False  # by the watchdog, until the next goal
        self._booted_s = 0.0
        self.boot(0.0, blackout_s=0.0)

    @property
    def servo_id(self) -> int:
        """Content of ID (7)."""
        return self.registers.data[ct.SERVO_ID.address]

    @property
    def baudrate(self) -> int:
        """Line rate in baud after Baud Rate (8)."""
        return BAUD_RATES[self.registers.data[ct.BAUD_RATE.address]]

    @property
    def return_delay_s(self) -> float:
        """Pause in s between an instruction and the answer, after Return Delay Time (9)."""
        return self.registers.data[ct.RETURN_DELAY_TIME.address] * ct.RETURN_DELAY_UNIT_S

    @property
    def torque_on(self) -> bool:
        """Whether Torque Enable is 1."""
        return self.registers.data[_TORQUE] != 0

    @property
    def watchdog_tripped(self) -> bool:
        """Whether Bus Watchdog reads -1."""
        return self.registers.data[ct.BUS_WATCHDOG.address] == ct.WATCHDOG_TRIPPED_RAW & 0xFF

    @property
    def latched(self) -> bool:
        """Whether a hardware error keeps the torque off until a reboot."""
        return bool(self.registers.data[_HARDWARE_ERROR] & self.registers.data[ct.SHUTDOWN.address])

    def boot(self, now_s: float, *, blackout_s: float = _REBOOT_S) -> None:
        """Restart the firmware: RAM at its defaults, one turn, torque off."""
        self.registers.load_ram()
        self.silent_until_s = now_s + blackout_s
        self._booted_s = now_s
        self.fed_s = now_s
        self._watchdog_s = math.inf
        self._stopped = False
        self.plant.load_excess_s = 0.0
        self._fold_turns()
        self.registers.put("goal_position", self.present_raw())
        self.registers.data[_TORQUE] = 0
        self._apply_goals()

    @property
    def _sign(self) -> int:
        """-1 in reverse mode (Drive Mode bit 0), else 1."""
        return -1 if self.registers.data[_DRIVE] & _REVERSE_MODE else 1

    def present_raw(self) -> int:
        """Return Present Position: sensed angle in counts, folded."""
        return self._sign * self._counts(self.plant.sensed_rad) + self._turn_offset

    def _fold_turns(self) -> None:
        """Reduce the position to one turn: 0 to 4095."""
        actual, turn = self._sign * self.plant.sensed_count, self.model.pulses_per_turn
        self._turn_offset = -(actual // turn) * turn

    def _counts(self, angle_rad: float) -> int:
        return math.floor(angle_rad / self.model.rad_per_pulse + 0.5)

    def refresh(self, now_s: float) -> None:
        """Bring registers 120 to 146 up to date."""
        plant, model, sign, offset = self.plant, self.model, self._sign, self._turn_offset
        data = self.registers.data
        velocity_raw = sign * plant.velocity_register.raw
        position_raw = sign * plant.sensed_count + offset
        trajectory_raw = sign * self._counts(plant.reference_rad) + offset
        _, _, _, _, profile, goal_raw = _GOALS.unpack_from(data, _GOAL_START)
        status = _ARRIVED if abs(position_raw - goal_raw) <= _IN_POSITION_PULSES else 0
        if self.torque_on and not self._stopped and data[_MODE] in FOLLOWS_POSITION:
            status |= _PROFILE_ONGOING if trajectory_raw != goal_raw else 0
            status |= _TRAPEZOIDAL_PROFILE if profile else 0
        (threshold,) = _THRESHOLD.unpack_from(data, ct.MOVING_THRESHOLD.address)
        ticks = math.floor((now_s - self._booted_s) * _TICKS_PER_S + _ROUNDING_TICKS)
        _PRESENT.pack_into(
            data,
            _PRESENT_START,
            ticks % ct.TICK_MODULO,
            abs(velocity_raw) > threshold,
            status,
            round(sign * plant.duty * model.whole_pwm_raw),
            self._to_raw(sign * plant.measured_a() / model.current_unit_a),
            velocity_raw,
            position_raw + self.reported_offset_raw,
            round(sign * plant.reference_velocity_rad_s / model.velocity_unit_rad_s),
            trajectory_raw,
            max(0, round(plant.measured_v() / model.voltage_unit_v)),
            min(max(round(plant.temperature_c), 0), 255),
        )

    def _apply_goals(self) -> None:
        """Compute the command for the motor from mode, goals, limits and gains."""
        if self._stopped:
            return
        self.plant.drive(self._goal_command() if self.torque_on else DriveCommand())

    def _goal_command(self) -> DriveCommand:
        """Return the command to the motor by Operating Mode, goals, limits and gains."""
        data, model = self.registers.data, self.model
        mode, sign = data[_MODE], self._sign
        pwm, current, velocity, acceleration, profile, goal = _GOALS.unpack_from(data, _GOAL_START)
        # A limit that was lowered after the write of the goal still applies.
        pwm_limit, current_limit, velocity_limit = _LIMITS.unpack_from(data, ct.PWM_LIMIT.address)
        duty = sign * _bounded(pwm, pwm_limit) / model.whole_pwm_raw
        velocity_rad_s = sign * _bounded(velocity, velocity_limit) * model.velocity_unit_rad_s
        if mode == OperatingMode.CURRENT_BASED_POSITION:
            if self.registers.keeps_limits:
                duty *= min(1.0, abs(velocity_rad_s) / data_sheet(model).no_load_rad_s)
            if is_x330(model):
                profile = acceleration = 0  # the 330 size has no profile in this mode
        d_gain, i_gain, p_gain = _GAINS.unpack_from(data, ct.POSITION_D_GAIN.address)
        return DriveCommand(
            mode,
            current_a=sign * _bounded(current, current_limit) * model.current_unit_a,
            position_rad=sign * (goal - self._turn_offset) * model.rad_per_pulse,
            velocity_rad_s=velocity_rad_s,
            duty=duty,
            p_gain=p_gain,
            i_gain=i_gain,
            d_gain=d_gain,
            slope_raw=data[ct.PWM_SLOPE.address],
            profile_velocity_rad_s=profile * model.velocity_unit_rad_s,
            profile_acceleration_rad_s2=acceleration * model.acceleration_unit_rad_s2,
        )

    def set_torque(self, *, on: bool) -> None:
        """Switch the torque; switching it on in position mode reduces the position to one turn."""
        one_turn = self.registers.data[_MODE] == OperatingMode.POSITION
        if on and not self.torque_on and one_turn:
            self._fold_turns()
        self.registers.data[_TORQUE] = 1 if on else 0
        self._stopped = self._stopped and on
        self._apply_goals()

    def set_watchdog(self, raw: int, now_s: float) -> None:
        """Arm, disarm or clear the bus watchdog; a stopped motor waits for the next goal."""
        self._watchdog_s = raw * ct.WATCHDOG_UNIT_S if raw > 0 else math.inf
        self.fed_s = now_s

    def supervise(self, now_s: float) -> None:
        """Run watchdog and protections; call it at least once for each motor step."""
        data = self.registers.data
        if data[_TORQUE] == 0:
            self.fed_s = now_s
        elif now_s - self.fed_s > self._watchdog_s:
            self._trip()
        plant = self.plant
        bits = self.injected_error
        if plant.temperature_c > data[_TEMPERATURE_LIMIT]:
            bits |= HardwareError.OVERHEATING
        if plant.load_excess_s > OVERLOAD_BUDGET_S:
            bits |= HardwareError.OVERLOAD
        highest_raw = data[_VOLTAGE] | data[_VOLTAGE + 1] << 8
        lowest_raw = data[_VOLTAGE + 2] | data[_VOLTAGE + 3] << 8
        supply_raw = plant.voltage_v / plant.model.voltage_unit_v
        if not lowest_raw <= supply_raw <= highest_raw:
            bits |= HardwareError.INPUT_VOLTAGE
        if bits and bits & ~data[_HARDWARE_ERROR]:
            data[_HARDWARE_ERROR] |= bits
            if self.latched and self.torque_on:
                self.set_torque(on=False)

    def _trip(self) -> None:
        self._watchdog_s = math.inf
        self.registers.put("bus_watchdog", ct.WATCHDOG_TRIPPED_RAW)
        self.registers.put("profile_acceleration", 0)
        self.registers.put("profile_velocity", 0)
        if self.watchdog_stop is WatchdogStop.KEEPS_TURNING:
            return
        self._stopped = True
        stop = DriveCommand(OperatingMode.CURRENT)
        if self.watchdog_stop is WatchdogStop.HOLD:
            stop = self._goal_command()._replace(
                mode=OperatingMode.CURRENT_BASED_POSITION,
                position_rad=self.plant.sensed_rad,
                i_gain=0.0,
            )
        self.plant.drive(stop)

    # -- instructions --------------------------------------------------------------------------

    def answers(self, instruction: int) -> bool:
        """Return whether Status Return Level (68) lets the servo answer this instruction."""
        level = self.registers.data[ct.STATUS_RETURN_LEVEL.address]
        if instruction == Instruction.PING or level >= _ANSWERS_ALL:
            return True
        return level == _ANSWERS_READS and instruction in _READS

    def status(self, error: int, data: bytes = b"") -> StatusBody:
        """Return an answer with the Alert bit as Hardware Error Status (70) asks for it."""
        alert = self.registers.data[ct.HARDWARE_ERROR_STATUS.address]
        return StatusBody(error | ALERT if alert else error, data)

    def execute(self, instruction: int, parameters: bytes, now_s: float) -> StatusBody:
        """Carry out an instruction that was sent to this servo or to all of them."""
        if instruction == Instruction.READ and len(parameters) == 4:
            address, size = struct.unpack("<HH", parameters)
            return self.read(address, size, now_s)
        if instruction == Instruction.WRITE and len(parameters) >= 3:
            address = int.from_bytes(parameters[:2], "little")
            return self.status(self.write(address, parameters[2:], now_s))
        if instruction == Instruction.PING:
            version = self.registers.data[ct.FIRMWARE_VERSION.address]
            number = self.registers.get("model_number").to_bytes(2, "little")
            return self.status(StatusError.NONE, number + bytes((version,)))
        if instruction == Instruction.REBOOT:
            # A servo answers before it reboots, with the Alert bit that the reboot clears.
            before = self.status(StatusError.NONE)
            self.boot(now_s)
            return before
        cut_off = instruction in (Instruction.READ, Instruction.WRITE)
        return self.status(StatusError.DATA_LENGTH if cut_off else StatusError.INSTRUCTION)

    def read(self, address: int, size: int, now_s: float) -> StatusBody:
        """Return ``size`` bytes from ``address``, present values brought up to date."""
        place = self.registers.place(address)
        if place < _PRESENT_END and place + size > _PRESENT_START:
            self.refresh(now_s)
        content = self.registers.read(address, size)
        if isinstance(content, StatusError):
            return self.status(content)
        return self.status(StatusError.NONE, content)

    def write(self, address: int, data: bytes, now_s: float) -> StatusError:
        """Write one or more whole items; nothing is written when one of them is refused."""
        plan = self.registers.plan(address, len(data))
        if isinstance(plan, StatusError):
            return plan
        values = list(zip(plan.items, plan.layout.unpack(data), strict=True))
        for item, raw in values:
            if refused := self._check(item, raw):
                return refused
        goals = profile = False
        table, at = self.registers.data, 0
        for item, raw in values:
            at += item.size
            if item.address == ct.TORQUE_ENABLE.address:
                self.set_torque(on=bool(raw))
                continue
            table[item.address : item.address + item.size] = data[at - item.size : at]
            if item.address in _GOAL_ADDRESSES:
                goals = True
            elif _GOAL_START <= item.address < _GOAL_END:
                profile = True
            else:
                self._side_effect(item.address, raw, now_s)
        # A motor that the watchdog stopped follows goals again.
        self._stopped = self._stopped and not goals
        if goals or profile:
            self._apply_goals()
        return StatusError.NONE

    def _check(self, item: Item, raw: int) -> StatusError:
        if item.eeprom and self.torque_on:
            return StatusError.ACCESS
        if item.address == ct.TORQUE_ENABLE.address and raw and self.latched:
            return StatusError.RESULT_FAIL
        if item.address not in _GOAL_ADDRESSES:
            return StatusError.NONE if raw in item.values else StatusError.DATA_RANGE
        if self.watchdog_tripped:
            return StatusError.DATA_RANGE
        registers, limit = self.registers, _LIMITED_BY.get(item.address)
        mode = registers.data[ct.OPERATING_MODE.address]
        if limit is not None:
            within = abs(raw) <= registers.get(limit)
        elif registers.keeps_limits or mode == OperatingMode.POSITION:
            first, last = (registers.get(f"{end}_position_limit") for end in ("min", "max"))
            within = first <= raw <= last
        else:
            return StatusError.NONE if raw in _EXTENDED_POSITION else StatusError.DATA_RANGE
        return StatusError.NONE if within else StatusError.DATA_LIMIT

    def _side_effect(self, address: int, raw: int, now_s: float) -> None:
        if address == ct.OPERATING_MODE.address:
            self.registers.change_mode()
            if raw == OperatingMode.POSITION:
                self._fold_turns()
        elif address == ct.BUS_WATCHDOG.address:
            self.set_watchdog(raw, now_s)
        elif address in _GAINS_IN_USE:
            self._apply_goals()
