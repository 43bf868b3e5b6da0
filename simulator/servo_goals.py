"""Goals, limits and gains of a simulated servo as a command to its motor."""

import struct

from gripper.registers import (
    RAD_S2_PER_ACCELERATION_UNIT,
    RAD_S_PER_VELOCITY_UNIT,
)
from simulator.control_table import is_x330
from simulator.motor import DriveCommand, DriveMode
from simulator.servo_position import ServoPosition
from simulator.servo_registers import ServoRegisters

GOAL_START, GOAL_END = 100, 120
_GOALS = struct.Struct("<hhiIIi")
_PWM_COUNTS = 885.0


def goal_command(
    registers: ServoRegisters, position: ServoPosition, reference_rad: float
) -> DriveCommand:
    """Return what Operating Mode and goals ask of the motor.

    Parameters
    ----------
    registers, position
        The servo's registers and counts.
    reference_rad
        Where the profile is now, rad; a time-based profile starts there.
    """
    data = registers.table.data
    mode, sign = data[11], position.sign
    pwm, current, velocity, acceleration, profile, goal = _GOALS.unpack_from(data, GOAL_START)
    # A limit that was lowered after the goal was written still holds.
    pwm = _bounded(pwm, data[36] | data[37] << 8)
    current = _bounded(current, data[38] | data[39] << 8)
    velocity = _bounded(velocity, registers.table.get(44, 4))
    duty = abs(pwm) / _PWM_COUNTS
    current_a = current * registers.model.current_unit_a
    if mode == 0:
        return DriveCommand(DriveMode.CURRENT, current_a=sign * current_a, duty=duty)
    if mode == 1:
        speed = sign * velocity * RAD_S_PER_VELOCITY_UNIT
        return DriveCommand(DriveMode.VELOCITY, velocity_rad_s=speed, duty=duty)
    if mode == 16:
        return DriveCommand(DriveMode.PWM, duty=sign * pwm / _PWM_COUNTS)
    goal_rad = position.to_rad(goal)
    speed, ramp = _profile(registers, abs(goal_rad - reference_rad), profile, acceleration)
    return DriveCommand(
        DriveMode.CURRENT_POSITION if mode == 5 else DriveMode.POSITION,
        current_a=abs(current_a),
        position_rad=goal_rad,
        duty=duty,
        p_gain=data[84] | data[85] << 8,
        d_gain=data[80] | data[81] << 8,
        profile_velocity_rad_s=speed,
        profile_acceleration_rad_s2=ramp,
    )


def hold_command(registers: ServoRegisters, angle_rad: float) -> DriveCommand:
    """Return the command that holds an angle in rad within the present current and PWM limits."""
    data = registers.table.data
    return DriveCommand(
        DriveMode.CURRENT_POSITION,
        current_a=abs(registers.get("goal_current")) * registers.model.current_unit_a,
        position_rad=angle_rad,
        duty=abs(registers.get("goal_pwm")) / _PWM_COUNTS,
        p_gain=data[84] | data[85] << 8,
        d_gain=data[80] | data[81] << 8,
    )


def _bounded(raw: int, limit: int) -> int:
    return min(max(raw, -limit), limit)


def _profile(
    registers: ServoRegisters, way_rad: float, profile: int, acceleration: int
) -> tuple[float, float]:
    """Return velocity and acceleration limits of the profile; 0 = none.

    The 330 size has no profile in current-based position mode.
    """
    data = registers.table.data
    if profile == 0 or (data[11] == 5 and is_x330(registers.model)):
        return 0.0, 0.0
    if data[10] & 4:
        return way_rad / (profile * 1e-3), 0.0
    return profile * RAD_S_PER_VELOCITY_UNIT, acceleration * RAD_S2_PER_ACCELERATION_UNIT
