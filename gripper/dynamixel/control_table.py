"""Control table of the DYNAMIXEL X series as data: address, size and sign.

Source: ROBOTIS e-Manual, pages of XM430-W350, XM430-W210, XL330-M288 and XC330-M288, section
"Control Table". The addresses are the same on all four. The RH-P12-RN(A) has its RAM items at
higher addresses; the bus adds the offset (`gripper.dynamixel.models.ram_shift`). Only this gripper
has Acceleration Limit and External Port Mode, only the 330 size has PWM Slope.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from types import MappingProxyType

from gripper.errors import LimitExceeded

RAM_START = 64
"""First address of the RAM items."""
WATCHDOG_UNIT_S = 0.02
"""Time in s of one count of Bus Watchdog (register 98)."""
RETURN_DELAY_UNIT_S = 2e-6
"""Time in s of one count of Return Delay Time (register 9)."""
WATCHDOG_TRIPPED_RAW = -1
"""Content of Bus Watchdog after a trip; writing 0 clears it."""
TICK_MODULO = 32768
"""Modulo of Realtime Tick (register 120), which counts ms."""

_BAUD_RATES = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
BAUD_CODES: Mapping[int, int] = MappingProxyType({r: code for code, r in enumerate(_BAUD_RATES)})
"""Baud rate in bit/s -> content of Baud Rate (register 8). The 330 size ends at 4 Mbit/s."""


@dataclass(frozen=True, slots=True)
class Register:
    """One item of the control table."""

    name: str
    """Name in snake_case from the e-Manual."""
    address: int
    size: int
    """First byte and number of bytes (1, 2 or 4), little endian."""
    signed: bool = False
    """True for two's complement."""
    writable: bool = True
    eeprom: bool = False
    """EEPROM items can be written only with torque off."""

    def __str__(self) -> str:
        return self.name

    @property
    def end(self) -> int:
        """Address of the first byte after the item."""
        return self.address + self.size

    @property
    def code(self) -> str:
        """Format code of the item for `struct`."""
        code = {1: "b", 2: "h", 4: "i"}[self.size]
        return code if self.signed else code.upper()

    @property
    def bounds(self) -> tuple[int, int]:
        """Least and largest raw value of the item."""
        span = 1 << 8 * self.size
        return (-span // 2, span // 2 - 1) if self.signed else (0, span - 1)

    def encode(self, raw: int) -> bytes:
        """Return the little-endian bytes of a raw value; LimitExceeded when it does not fit."""
        try:
            return raw.to_bytes(self.size, "little", signed=self.signed)
        except OverflowError as error:
            raise LimitExceeded(
                f"{self.name} = {raw} does not fit into {self.size} "
                f"{'signed' if self.signed else 'unsigned'} bytes"
            ) from error

    def decode(self, data: bytes) -> int:
        """Return the raw value of as many bytes as the item has, sign-extended."""
        return int.from_bytes(data, "little", signed=self.signed)


_eeprom = partial(Register, eeprom=True)
_ram = Register
_read_only = partial(Register, writable=False)

MODEL_NUMBER = _read_only("model_number", 0, 2)
MODEL_INFORMATION = _read_only("model_information", 2, 4)
FIRMWARE_VERSION = _read_only("firmware_version", 6, 1)
SERVO_ID = _eeprom("id", 7, 1)
BAUD_RATE = _eeprom("baud_rate", 8, 1)
RETURN_DELAY_TIME = _eeprom("return_delay_time", 9, 1)
DRIVE_MODE = _eeprom("drive_mode", 10, 1)
OPERATING_MODE = _eeprom("operating_mode", 11, 1)
SECONDARY_ID = _eeprom("secondary_id", 12, 1)
PROTOCOL_TYPE = _eeprom("protocol_type", 13, 1)
HOMING_OFFSET = _eeprom("homing_offset", 20, 4, signed=True)
MOVING_THRESHOLD = _eeprom("moving_threshold", 24, 4)
TEMPERATURE_LIMIT = _eeprom("temperature_limit", 31, 1)
MAX_VOLTAGE_LIMIT = _eeprom("max_voltage_limit", 32, 2)
MIN_VOLTAGE_LIMIT = _eeprom("min_voltage_limit", 34, 2)
PWM_LIMIT = _eeprom("pwm_limit", 36, 2)
CURRENT_LIMIT = _eeprom("current_limit", 38, 2)
ACCELERATION_LIMIT = _eeprom("acceleration_limit", 40, 4)
VELOCITY_LIMIT = _eeprom("velocity_limit", 44, 4)
MAX_POSITION_LIMIT = _eeprom("max_position_limit", 48, 4)
MIN_POSITION_LIMIT = _eeprom("min_position_limit", 52, 4)
EXTERNAL_PORT_MODE_1 = _eeprom("external_port_mode_1", 56, 1)
EXTERNAL_PORT_MODE_2 = _eeprom("external_port_mode_2", 57, 1)
EXTERNAL_PORT_MODE_3 = _eeprom("external_port_mode_3", 58, 1)
EXTERNAL_PORT_MODE_4 = _eeprom("external_port_mode_4", 59, 1)
STARTUP_CONFIGURATION = _eeprom("startup_configuration", 60, 1)
PWM_SLOPE = _eeprom("pwm_slope", 62, 1)
SHUTDOWN = _eeprom("shutdown", 63, 1)
TORQUE_ENABLE = _ram("torque_enable", 64, 1)
LED = _ram("led", 65, 1)
STATUS_RETURN_LEVEL = _ram("status_return_level", 68, 1)
REGISTERED_INSTRUCTION = _read_only("registered_instruction", 69, 1)
HARDWARE_ERROR_STATUS = _read_only("hardware_error_status", 70, 1)
VELOCITY_I_GAIN = _ram("velocity_i_gain", 76, 2)
VELOCITY_P_GAIN = _ram("velocity_p_gain", 78, 2)
POSITION_D_GAIN = _ram("position_d_gain", 80, 2)
POSITION_I_GAIN = _ram("position_i_gain", 82, 2)
POSITION_P_GAIN = _ram("position_p_gain", 84, 2)
FEEDFORWARD_2ND_GAIN = _ram("feedforward_2nd_gain", 88, 2)
FEEDFORWARD_1ST_GAIN = _ram("feedforward_1st_gain", 90, 2)
BUS_WATCHDOG = _ram("bus_watchdog", 98, 1, signed=True)
GOAL_PWM = _ram("goal_pwm", 100, 2, signed=True)
GOAL_CURRENT = _ram("goal_current", 102, 2, signed=True)
GOAL_VELOCITY = _ram("goal_velocity", 104, 4, signed=True)
PROFILE_ACCELERATION = _ram("profile_acceleration", 108, 4)
PROFILE_VELOCITY = _ram("profile_velocity", 112, 4)
GOAL_POSITION = _ram("goal_position", 116, 4, signed=True)
REALTIME_TICK = _read_only("realtime_tick", 120, 2)
MOVING = _read_only("moving", 122, 1)
MOVING_STATUS = _read_only("moving_status", 123, 1)
PRESENT_PWM = _read_only("present_pwm", 124, 2, signed=True)
PRESENT_CURRENT = _read_only("present_current", 126, 2, signed=True)
PRESENT_VELOCITY = _read_only("present_velocity", 128, 4, signed=True)
PRESENT_POSITION = _read_only("present_position", 132, 4, signed=True)
VELOCITY_TRAJECTORY = _read_only("velocity_trajectory", 136, 4, signed=True)
POSITION_TRAJECTORY = _read_only("position_trajectory", 140, 4, signed=True)
PRESENT_INPUT_VOLTAGE = _read_only("present_input_voltage", 144, 2)
PRESENT_TEMPERATURE = _read_only("present_temperature", 146, 1)
BACKUP_READY = _read_only("backup_ready", 147, 1)


REGISTERS: Mapping[str, Register] = MappingProxyType(
    {item.name: item for item in tuple(globals().values()) if isinstance(item, Register)}
)
"""All items by name, in the order of their addresses."""


class RegisterBlock:
    """Contiguous items, transferred over the bus as one block of bytes.

    Parameters
    ----------
    registers
        The items in the order of their addresses; LimitExceeded when bytes between are undefined.
        Undefined bytes are read without an error on the wire but have no meaning, so a block must
        not span them.
    """

    def __init__(self, *registers: Register) -> None:
        if not registers or any(a.end != b.address for a, b in pairwise(registers)):
            raise LimitExceeded(
                f"{', '.join(r.name for r in registers)}: not one contiguous block of the control "
                f"table"
            )
        self._registers = registers
        self._names = tuple(r.name for r in registers)
        self._text = self._names[0] + (f" to {self._names[-1]}" if len(registers) > 1 else "")
        self._layout = struct.Struct("<" + "".join(r.code for r in registers))
        self.address, self.size = registers[0].address, self._layout.size
        """Address of the first byte, and number of bytes."""

    def __str__(self) -> str:
        return self._text

    @classmethod
    def between(cls, first: Register, last: Register) -> "RegisterBlock":
        """Return all items from ``first`` to ``last``."""
        return cls(*(r for r in REGISTERS.values() if first.address <= r.address <= last.address))

    def decode(self, data: bytes) -> dict[str, int]:
        """Return the raw values by name, of as many bytes as the block has."""
        return dict(zip(self._names, self._layout.unpack(data), strict=True))

    def encode(self, raws: Sequence[int]) -> bytes:
        """Return the bytes of one raw value for each item; LimitExceeded when one does not fit."""
        try:
            return self._layout.pack(*raws)
        except struct.error:
            # The error of the item names it.
            return b"".join(r.encode(raw) for r, raw in zip(self._registers, raws, strict=True))


PRESENT_BLOCK = RegisterBlock.between(REALTIME_TICK, PRESENT_TEMPERATURE)
"""Registers 120 to 146: the present state of a servo."""
