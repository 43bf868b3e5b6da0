"""Counts, turns and offsets of a simulated servo, and what it shows of its motion."""

import math
import struct

from gripper.registers import (
    PULSES_PER_TURN,
    RAD_PER_PULSE,
    RAD_S_PER_VELOCITY_UNIT,
    TICK_MODULO,
)
from simulator.servo_plant import ServoPlant
from simulator.servo_registers import ServoRegisters

PRESENT_START, PRESENT_END = 120, 147
IN_POSITION_PULSES = 20
HOMING_OFFSET_MODE_3 = 1024
"""Largest Homing Offset in pulses that position mode obeys; a larger one is ignored there."""
_PRESENT = struct.Struct("<HBBhhiiiiHB")


class ServoPosition:
    """Angle of the motor against position in counts, and the present values.

    Parameters
    ----------
    registers
        The servo's registers.
    plant
        Its motor.
    """

    __slots__ = ("_plant", "_registers", "_turn_offset")

    def __init__(self, registers: ServoRegisters, plant: ServoPlant) -> None:
        self._registers = registers
        self._plant = plant
        self._turn_offset = 0

    @property
    def sign(self) -> int:
        """-1 in reverse mode (Drive Mode bit 0), else 1."""
        return -1 if self._registers.table.data[10] & 1 else 1

    def present_raw(self) -> int:
        """Return Present Position: sensed angle in counts, folded, with Homing Offset."""
        return self.to_raw(self._plant.sensed_rad)

    def fold_turns(self) -> None:
        """Fall back to one turn: actual position 0 to 4095 before Homing Offset."""
        actual = self.sign * _counts(self._plant.sensed_rad)
        self._turn_offset = -(actual // PULSES_PER_TURN) * PULSES_PER_TURN

    def to_raw(self, angle_rad: float) -> int:
        """Return the position in counts of a motor angle in rad."""
        return self.sign * _counts(angle_rad) + self._turn_offset + self._homing()

    def to_rad(self, raw: int) -> float:
        """Return the motor angle in rad of a position in counts."""
        return self.sign * (raw - self._homing() - self._turn_offset) * RAD_PER_PULSE

    def _homing(self) -> int:
        table = self._registers.table
        offset = table.get(20, 4, signed=True)
        return 0 if table.data[11] == 3 and abs(offset) > HOMING_OFFSET_MODE_3 else offset

    def refresh(self, uptime_s: float, *, following: bool) -> None:
        """Bring registers 120 to 146 up to date.

        Parameters
        ----------
        uptime_s
            Time since the boot in s.
        following
            Whether the motor follows Goal Position.
        """
        plant, sign, table = self._plant, self.sign, self._registers.table
        velocity_raw = round(sign * plant.sensed_velocity_rad_s / RAD_S_PER_VELOCITY_UNIT)
        position_raw = self.present_raw()
        trajectory_raw = self.to_raw(plant.reference_rad)
        goal_raw = table.get(116, 4, signed=True)
        status = 1 if abs(position_raw - goal_raw) <= IN_POSITION_PULSES else 0
        if following:
            status |= 2 if trajectory_raw != goal_raw else 0
            status |= 0x30 if table.get(112, 4) else 0
        _PRESENT.pack_into(
            table.data,
            PRESENT_START,
            math.floor(uptime_s * 1000.0 + 1e-6) % TICK_MODULO,
            abs(velocity_raw) > table.get(24, 4),
            status,
            round(sign * plant.duty * 885.0),
            round(sign * plant.current_a / self._registers.model.current_unit_a),
            velocity_raw,
            position_raw,
            round(sign * plant.reference_velocity_rad_s / RAD_S_PER_VELOCITY_UNIT),
            trajectory_raw,
            max(0, round(plant.voltage_v * 10.0)),
            min(max(round(plant.temperature_c), 0), 255),
        )


def _counts(angle_rad: float) -> int:
    return math.floor(angle_rad / RAD_PER_PULSE + 0.5)
