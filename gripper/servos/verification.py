"""Required register values of a servo before it may move, and their comparison."""

from dataclasses import dataclass
from functools import cache
from math import ceil

from gripper.dynamixel.bus import HIGHEST_ID
from gripper.dynamixel.models import PWM_SLOPE_RAW, OperatingMode, ServoModel
from gripper.values.servo_checks import HardwareError, VerificationRow

CORRECTABLE = frozenset(
    (
        *("return_delay_time", "operating_mode", "status_return_level", "pwm_slope"),
        *("position_d_gain", "position_i_gain", "position_p_gain"),
    )
)
"""Registers that a start corrects while the torque is off: they do not change the mechanics or the
protection of a servo."""
_DRIVE_MODE_MASK = 0b1101
"""Bits of Drive Mode (register 10) that must be 0: reverse, time-based profile, torque by goal."""
_STARTUP_MASK = 0b11
"""Bits of Startup Configuration (register 60) that must be 0: torque on, RAM restored."""
_PWM_RESERVE = 1.2
"""Reserve for motion, over the PWM share at rest: current over stall current."""


@dataclass(frozen=True, slots=True)
class Requirement:
    """Requirement of one register."""

    item: str
    """Name of the register."""
    expected: str
    """Text for the report."""
    low: int
    high: int
    """Bounds of the raw value after the mask."""
    mask: int = -1
    """Bits that count."""

    def met_by(self, raw: int) -> bool:
        """Return whether a raw value agrees."""
        return self.low <= raw & self.mask <= self.high

    def row(self, servo_id: int, raw: int, *, corrected: bool = False) -> VerificationRow:
        """Return the comparison with the raw value of a servo."""
        return VerificationRow(
            servo_id=servo_id,
            item=self.item,
            expected=self.expected,
            actual=str(raw),
            ok=self.met_by(raw),
            corrected=corrected,
        )


def _of(
    item: str, low: int, high: int | None = None, expected: str = "", mask: int = -1
) -> Requirement:
    """Return the requirement of a register: a range, or one value."""
    if high is None:
        return Requirement(item, expected or str(low), low, low, mask)
    return Requirement(item, expected or f"{low} to {high}", low, high, mask)


@cache
def requirements(
    model: ServoModel, current_max_a: float, temperature_max_c: float
) -> tuple[Requirement, ...]:
    """Return the requirements of the registers of a servo that this package may drive.

    Those of `CORRECTABLE` have one right value. Items that change the mechanics or
    the protection of the servo are only compared: the user decides on them.
    """
    # The lowest supply needs most.
    lowest_v = model.min_voltage_raw * model.voltage_unit_v
    needed_raw = min(round(model.current_counts(current_max_a, lowest_v)), model.current_limit_raw)
    whole_pwm = model.whole_pwm_raw
    share = _PWM_RESERVE * whole_pwm * current_max_a / model.stall_current_a
    needed_pwm = min(whole_pwm, ceil(share))
    protection = int(HardwareError.OVERHEATING)
    d_gain, i_gain, p_gain = model.position_gains
    items = [
        _of("model_number", model.number),
        _of("firmware_version", 1, 255, "1 or later"),
        _of("protocol_type", 2),
        _of("hardware_error_status", 0),
        _of("drive_mode", 0, mask=_DRIVE_MODE_MASK),
        _of("homing_offset", 0),
        _of("startup_configuration", 0, mask=_STARTUP_MASK),
        _of("shutdown", protection, expected="bit 2 (overheating) set", mask=protection),
        _of("temperature_limit", round(temperature_max_c), model.temperature_limit_c),
        _of("current_limit", needed_raw, model.current_limit_raw),
        _of("velocity_limit", model.goal_velocity_raw, model.velocity_limit_raw),
        _of(
            "min_voltage_limit",
            model.min_voltage_raw,
            model.max_voltage_raw,
            f"{model.min_voltage_raw} or more",
        ),
        _of("pwm_limit", needed_pwm, whole_pwm),
        # No servo listens to an ID above the highest one.
        _of("secondary_id", HIGHEST_ID + 1, 255),
        _of("return_delay_time", 0),
        _of("operating_mode", int(OperatingMode.CURRENT_BASED_POSITION)),
        _of("status_return_level", 2),
        _of("pwm_slope", PWM_SLOPE_RAW),
        # These follow the mode, which sets the gains to its defaults.
        _of("position_d_gain", d_gain),
        _of("position_i_gain", i_gain),
        _of("position_p_gain", p_gain),
    ]
    unneeded = model.absent if model.goal_velocity_raw else model.absent | {"velocity_limit"}
    return tuple(requirement for requirement in items if requirement.item not in unneeded)
