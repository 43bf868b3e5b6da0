"""The firmware of a simulated servo: boot, torque, goals, bus watchdog, protections.

`simulator.servo.device` uses it to answer instructions; `simulator.servo.motor` carries out its
commands. Homing Offset and Startup Configuration have no effect: the driver refuses both.
"""

import math
import struct
from collections.abc import Mapping
from enum import Enum

from gripper.dynamixel import control_table as ct
from gripper.dynamixel.models import OperatingMode, ServoModel
from gripper.values.servo_checks import HardwareError
from simulator.servo.control_table import ServoRegisters, is_x330
from simulator.servo.gearing import data_sheet
from simulator.servo.motor import (
    FOLLOWS_POSITION,
    OVERLOAD_BUDGET_S,
    DriveCommand,
    ServoMotor,
)

PRESENT_START, PRESENT_END = ct.REALTIME_TICK.address, ct.PRESENT_TEMPERATURE.end
"""Addresses of the items of the present state, 120 to 146."""
GOAL_START, GOAL_END = ct.GOAL_PWM.address, PRESENT_START
"""Addresses of goals and profile, 100 to 119."""
IN_POSITION_PULSES = 20
"""Distance to Goal Position in pulses at which Moving Status shows arrival (e-Manual, 123)."""
REBOOT_S = 0.35
"""Time in s of a reboot, without reception and answers; an assumption."""
REVERSE_MODE = 0x01
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


class ServoCore:
    """Firmware of one servo: its registers and their effects."""

    def __init__(
        self,
        servo_id: int,
        model: ServoModel,
        plant: ServoMotor,
        settings: Mapping[str, int] | None = None,
    ) -> None:
        self.registers = ServoRegisters(model, {**(settings or {}), "id": servo_id})
        self.plant = plant
        self.model = model
        self.watchdog_stop = WatchdogStop.HOLD
        """Effect of a tripped bus watchdog on the motor."""
        self.injected_error = 0
        """Bits of Hardware Error Status set by a fault knob."""
        self.silent_until_s = -math.inf
        """End of the silence after a reboot in s."""
        self.reported_offset_raw = 0
        """Fault: counts added to the reported position; the control loop of the servo does not use
        them."""
        self._turn_offset = 0
        self._fed_s = 0.0
        self._watchdog_s = math.inf
        self._stopped = False  # by the watchdog, until the next goal
        self._booted_s = 0.0
        self.boot(0.0, blackout_s=0.0)

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

    def boot(self, now_s: float, *, blackout_s: float = REBOOT_S) -> None:
        """Restart the firmware: RAM at its defaults, one turn, torque off."""
        self.registers.load_ram()
        self.silent_until_s = now_s + blackout_s
        self._booted_s = now_s
        self._fed_s = now_s
        self._watchdog_s = math.inf
        self._stopped = False
        self.plant.load_excess_s = 0.0
        self._fold_turns()
        self.registers.put("goal_position", self.present_raw())
        self.registers.data[_TORQUE] = 0
        self.apply_goals()

    @property
    def _sign(self) -> int:
        """-1 in reverse mode (Drive Mode bit 0), else 1."""
        return -1 if self.registers.data[_DRIVE] & REVERSE_MODE else 1

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
        velocity_raw = sign * plant.sensed_velocity_raw
        position_raw = sign * plant.sensed_count + offset
        trajectory_raw = sign * self._counts(plant.reference_rad) + offset
        _, _, _, _, profile, goal_raw = _GOALS.unpack_from(data, GOAL_START)
        status = _ARRIVED if abs(position_raw - goal_raw) <= IN_POSITION_PULSES else 0
        if self.torque_on and not self._stopped and data[_MODE] in FOLLOWS_POSITION:
            status |= _PROFILE_ONGOING if trajectory_raw != goal_raw else 0
            status |= _TRAPEZOIDAL_PROFILE if profile else 0
        (threshold,) = _THRESHOLD.unpack_from(data, ct.MOVING_THRESHOLD.address)
        ticks = math.floor((now_s - self._booted_s) * _TICKS_PER_S + _ROUNDING_TICKS)
        _PRESENT.pack_into(
            data,
            PRESENT_START,
            ticks % ct.TICK_MODULO,
            abs(velocity_raw) > threshold,
            status,
            round(sign * plant.duty * model.whole_pwm_raw),
            round(sign * plant.measured_a() / model.current_unit_a),
            velocity_raw,
            position_raw + self.reported_offset_raw,
            round(sign * plant.reference_velocity_rad_s / model.velocity_unit_rad_s),
            trajectory_raw,
            max(0, round(plant.measured_v() / model.voltage_unit_v)),
            min(max(round(plant.temperature_c), 0), 255),
        )

    def goal_written(self) -> None:
        """Carry out new goals; a motor that the watchdog stopped follows goals again."""
        self._stopped = False
        self.apply_goals()

    def apply_goals(self) -> None:
        """Compute the command for the motor from mode, goals, limits and gains."""
        if self._stopped:
            return
        command = self._goal_command() if self.torque_on else DriveCommand()
        self.plant.drive(command)

    def _goal_command(self) -> DriveCommand:
        """Return the command to the motor by Operating Mode, goals, limits and gains."""
        data, model = self.registers.data, self.model
        mode, sign = data[_MODE], self._sign
        pwm, current, velocity, acceleration, profile, goal = _GOALS.unpack_from(data, GOAL_START)
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

    def change_mode(self) -> None:
        """Carry out the side effects of writing Operating Mode."""
        self.registers.change_mode()
        if self.registers.data[_MODE] == OperatingMode.POSITION:
            self._fold_turns()

    def set_torque(self, *, on: bool) -> None:
        """Switch the torque; switching it on in position mode reduces the position to one turn."""
        one_turn = self.registers.data[_MODE] == OperatingMode.POSITION
        if on and not self.torque_on and one_turn:
            self._fold_turns()
        self.registers.data[_TORQUE] = 1 if on else 0
        self._stopped = self._stopped and on
        self.apply_goals()

    def set_watchdog(self, raw: int, now_s: float) -> None:
        """Arm, disarm or clear the bus watchdog; a stopped motor waits for the next goal."""
        self._watchdog_s = raw * ct.WATCHDOG_UNIT_S if raw > 0 else math.inf
        self._fed_s = now_s

    def feed(self, now_s: float) -> None:
        """Restart the watchdog time: an instruction packet was on the bus."""
        self._fed_s = now_s

    def supervise(self, now_s: float) -> None:
        """Run watchdog and protections; call it at least once for each motor step."""
        data = self.registers.data
        if data[_TORQUE] == 0:
            self._fed_s = now_s
        elif now_s - self._fed_s > self._watchdog_s:
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
