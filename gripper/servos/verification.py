"""Required register values of a servo before it may move, and their comparison."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from math import ceil

from gripper.dynamixel.control_table import (
    CURRENT_LIMIT,
    DRIVE_MODE,
    FIRMWARE_VERSION,
    HARDWARE_ERROR_STATUS,
    HOMING_OFFSET,
    MIN_VOLTAGE_LIMIT,
    MODEL_NUMBER,
    OPERATING_MODE,
    POSITION_D_GAIN,
    POSITION_I_GAIN,
    POSITION_P_GAIN,
    PROTOCOL_TYPE,
    PWM_LIMIT,
    PWM_SLOPE,
    RETURN_DELAY_TIME,
    SECONDARY_ID,
    SHUTDOWN,
    STARTUP_CONFIGURATION,
    STATUS_RETURN_LEVEL,
    TEMPERATURE_LIMIT,
    VELOCITY_LIMIT,
)
from gripper.dynamixel.models import PWM_SLOPE_RAW, OperatingMode, ServoModel
from gripper.dynamixel.transactions import HIGHEST_ID
from gripper.errors import LimitExceeded
from gripper.settings import CORRECTABLE
from gripper.values.servo_checks import HardwareError, VerificationRow

_DRIVE_MODE_MASK = 0b1101
"""Bits of Drive Mode (register 10) that must be 0: reverse, time-based profile, torque by goal."""
_STARTUP_MASK = 0b11
"""Bits of Startup Configuration (register 60) that must be 0: torque on, RAM restored."""
_POSITION_GAINS = (POSITION_D_GAIN, POSITION_I_GAIN, POSITION_P_GAIN)
"""Registers of `ServoModel.position_gains`."""
_PWM_RESERVE = 1.2
"""Reserve for motion, over the PWM share at rest: current over stall current."""


@dataclass(frozen=True, slots=True, kw_only=True)
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
    write_raw: int | None = None
    """Value to write when it does not agree; None where the user decides."""

    def met_by(self, raw: int) -> bool:
        """Return whether a raw value agrees."""
        return self.low <= raw & self.mask <= self.high


def _exactly(item: str, raw: int, *, mask: int = -1) -> Requirement:
    return Requirement(
        item=item,
        expected=str(raw),
        low=raw,
        high=raw,
        mask=mask,
        write_raw=raw if item in CORRECTABLE else None,
    )


def _between(item: str, low: int, high: int) -> Requirement:
    return Requirement(item=item, expected=f"{low} to {high}", low=low, high=high)


@cache
def requirements(
    model: ServoModel,
    current_max_a: float,
    temperature_max_c: float,
    corrected: frozenset[str] = CORRECTABLE,
) -> tuple[Requirement, ...]:
    """Return the requirements of the registers of a servo that this package may drive.

    Operating mode, return delay, status return level, PWM slope and position gains are corrected
    where ``corrected`` names them. Items that change the mechanics or the protection of the servo
    are only compared: the user decides on them.
    """
    found = _requirements(model, current_max_a, temperature_max_c)
    return tuple(
        r if r.item in corrected else replace(r, write_raw=None)
        for r in found
        if r.item not in model.absent
    )


def _requirements(
    model: ServoModel, current_max_a: float, temperature_max_c: float
) -> tuple[Requirement, ...]:
    most_a = model.winding_a(model.current_limit_raw)
    if current_max_a > most_a:
        raise LimitExceeded(
            f"current_max_a is {current_max_a} A, a {model.name} allows at most {most_a:.3f} A"
        )
    # The lowest supply needs most.
    lowest_v = model.min_voltage_raw * model.voltage_unit_v
    needed_raw = min(model.current_raw(current_max_a, lowest_v), model.current_limit_raw)
    whole_pwm = model.whole_pwm_raw
    share = _PWM_RESERVE * whole_pwm * current_max_a / model.stall_current_a
    needed_pwm = min(whole_pwm, ceil(share))
    protection = int(HardwareError.OVERHEATING)
    return (
        _exactly(MODEL_NUMBER.name, model.number),
        Requirement(item=FIRMWARE_VERSION.name, expected="1 or later", low=1, high=255),
        _exactly(PROTOCOL_TYPE.name, 2),
        _exactly(HARDWARE_ERROR_STATUS.name, 0),
        _exactly(DRIVE_MODE.name, 0, mask=_DRIVE_MODE_MASK),
        _exactly(HOMING_OFFSET.name, 0),
        _exactly(STARTUP_CONFIGURATION.name, 0, mask=_STARTUP_MASK),
        Requirement(
            item=SHUTDOWN.name,
            expected=f"bits {protection} set",
            low=protection,
            high=protection,
            mask=protection,
        ),
        _between(TEMPERATURE_LIMIT.name, round(temperature_max_c), model.temperature_limit_c),
        _between(CURRENT_LIMIT.name, needed_raw, model.current_limit_raw),
        *(
            [_between(VELOCITY_LIMIT.name, model.goal_velocity_raw, model.velocity_limit_raw)]
            if model.goal_velocity_raw
            else []
        ),
        Requirement(
            item=MIN_VOLTAGE_LIMIT.name,
            expected=f"{model.min_voltage_raw} or more",
            low=model.min_voltage_raw,
            high=model.max_voltage_raw,
        ),
        _between(PWM_LIMIT.name, needed_pwm, whole_pwm),
        # No servo listens to an ID above the highest one.
        _between(SECONDARY_ID.name, HIGHEST_ID + 1, 255),
        _exactly(RETURN_DELAY_TIME.name, 0),
        _exactly(OPERATING_MODE.name, int(OperatingMode.CURRENT_BASED_POSITION)),
        _exactly(STATUS_RETURN_LEVEL.name, 2),
        _exactly(PWM_SLOPE.name, PWM_SLOPE_RAW),
        # These follow the mode, which sets the gains to its defaults.
        *(
            _exactly(register.name, gain)
            for register, gain in zip(_POSITION_GAINS, model.position_gains, strict=True)
        ),
    )


def compare(
    servo_id: int,
    required: tuple[Requirement, ...],
    found: Mapping[str, int],
    corrected: frozenset[str] = frozenset(),
) -> tuple[VerificationRow, ...]:
    """Return one row for each requirement.

    Parameters
    ----------
    found
        Raw values by name of the register.
    corrected
        Names of the registers that were rewritten before ``found`` was read.
    """
    return tuple(
        VerificationRow(
            servo_id=servo_id,
            item=requirement.item,
            expected=requirement.expected,
            found=str(found[requirement.item]),
            ok=requirement.met_by(found[requirement.item]),
            corrected=requirement.item in corrected,
        )
        for requirement in required
    )
