"""The control table of a simulated servo: bytes, access rules and ranges.

Addresses of the X series come from `gripper.dynamixel.control_table`; minima and maxima are from
the tables of the ROBOTIS e-Manual. A servo with another table (`simulator.servo.rh_p12`) has the
memory of the X series, and addresses of its own on the wire. Bytes between the items read as 0, as
on the servo. Indirect addresses are left out: no program here uses them.
"""

import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from typing import NamedTuple

from gripper.dynamixel.control_table import REGISTERS, TORQUE_ENABLE, Register
from gripper.dynamixel.models import OperatingMode, ServoModel
from simulator.errors import SimulatorSettingsError
from simulator.servo import rh_p12
from simulator.servo.protocol2 import StatusError

TABLE_SIZE = 700
"""Size in bytes; the last items of the X series end at 661."""
EEPROM_END = TORQUE_ENABLE.address
"""First byte after the EEPROM items."""
RAM_END = 168
"""First byte after the RAM items, which a boot resets."""
GAINS = (
    "velocity_i_gain",
    "velocity_p_gain",
    "position_d_gain",
    "position_i_gain",
    "position_p_gain",
    "feedforward_2nd_gain",
    "feedforward_1st_gain",
)
"""Items that a change of Operating Mode sets to their defaults."""
_X330_MODELS = frozenset({1190, 1200, 1210, 1220, 1230, 1240})
"""Model numbers of XL330-M077, XL330-M288, XC330-M181, -T181, -M288 and -T288."""
_FACTORY_GAINS = {"XL330-M288": (1600, 180, 0, 0, 400), "XC330-M288": (1600, 50, 500, 0, 1100)}
"""Gains of the models that differ from the XM430's (e-Manual), in the order of `GAINS`."""
_X430_GAINS = (1920, 100, 0, 0, 800)
_X430_D_GAIN_IN_MODE_5 = 4000
"""Position D Gain that an X430 sets itself with current-based position mode, as reported for an
XM430-W210 (forum.robotis.com/t/1735)."""
_RECENT_FIRMWARE, _RECENT_FIRMWARE_X330 = 48, 53
"""Firmware versions of present servos: X430, X330."""
_MODES = frozenset(OperatingMode)
_RANGES: dict[str, tuple[int, int]] = {
    "id": (0, 252),
    "baud_rate": (0, 7),
    "return_delay_time": (0, 254),
    "drive_mode": (0, 13),
    "secondary_id": (0, 255),
    "protocol_type": (1, 2),
    "homing_offset": (-1_044_479, 1_044_479),
    "moving_threshold": (0, 1023),
    "temperature_limit": (0, 100),
    "pwm_limit": (0, 885),
    "max_position_limit": (0, 4095),
    "min_position_limit": (0, 4095),
    "startup_configuration": (0, 3),
    "pwm_slope": (1, 255),
    "torque_enable": (0, 1),
    "led": (0, 1),
    "status_return_level": (0, 2),
    **dict.fromkeys(GAINS, (0, 16383)),
    "bus_watchdog": (0, 127),
    "profile_acceleration": (0, 32767),
    "profile_velocity": (0, 32767),
}
"""Smallest and largest raw value of items with a limited range (e-Manual, control tables). Items
that differ between models are added for the model."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Item(Register):
    """One item with its rules."""

    values: range | frozenset[int]
    """Accepted raw values; anything else is a Data Range Error."""


class WritePlan(NamedTuple):
    """The items that a write covers completely, and the places of their raw values."""

    items: tuple[Item, ...]
    layout: struct.Struct


def is_x330(model: ServoModel) -> bool:
    """Return whether the model is of the 330 size, whose table differs in a few places."""
    return model.number in _X330_MODELS


@cache
def _items(model: ServoModel) -> Mapping[int, Item]:
    """Return the items of a model by their address on the wire."""
    if model.number == rh_p12.NUMBER:
        return {row.address: _rh_p12_item(row) for row in rh_p12.ROWS}
    ranges = dict(_RANGES)
    ranges["current_limit"] = (0, model.current_limit_raw)
    ranges["velocity_limit"] = (0, 2047 if is_x330(model) else 1023)
    for name in ("max_voltage_limit", "min_voltage_limit"):
        ranges[name] = (model.min_voltage_raw, model.max_voltage_raw)
    if is_x330(model):
        ranges["baud_rate"], ranges["protocol_type"] = (0, 6), (2, 2)
    return {
        register.address: _item(register, ranges.get(register.name, register.bounds), _MODES)
        for register in REGISTERS.values()
        if register.name not in model.absent
    }


def _rh_p12_item(row: rh_p12.Row) -> Item:
    alike = REGISTERS.get(row.name)
    register = Register(
        name=row.name,
        address=rh_p12.OTHER_PLACES[row.name] if alike is None else alike.address,
        size=row.size,
        signed=row.name in rh_p12.SIGNED,
        writable=row.access == "RW",
        eeprom=row.address < rh_p12.EEPROM_END,
    )
    bounds = register.bounds if row.low is None or row.high is None else (row.low, row.high)
    return _item(register, bounds, rh_p12.MODES)


def _item(register: Register, bounds: tuple[int, int], modes: frozenset[int]) -> Item:
    low, high = bounds
    values = modes if register.name == "operating_mode" else range(low, high + 1)
    return Item(**asdict(register), values=values)


class ServoRegisters:
    """Control table of one servo: bytes, access rules, and values by the names of the items.

    Parameters
    ----------
    settings
        Raw values of EEPROM items by register name, over the factory's; SimulatorSettingsError for
        an unknown name or a value out of range.
    """

    def __init__(self, model: ServoModel, settings: Mapping[str, int]) -> None:
        self.model = model
        self.data = bytearray(TABLE_SIZE)
        self.keeps_limits = model.number == rh_p12.NUMBER
        """Whether position limits and Goal Velocity act in current-based position mode."""
        self._items = _items(model)
        self._size = rh_p12.TABLE_SIZE if self.keeps_limits else TABLE_SIZE
        self._defined = bytearray(self._size)
        self._place: dict[int, int] | None = {} if self.keeps_limits else None
        for wire, item in self._items.items():
            self._defined[wire : wire + item.size] = b"\x01" * item.size
            if self._place is not None:
                self._place |= {wire + n: item.address + n for n in range(item.size)}
        self._plans: dict[tuple[int, int], WritePlan | StatusError] = {}
        firmware = _RECENT_FIRMWARE_X330 if is_x330(model) else _RECENT_FIRMWARE
        gains = zip(GAINS, _FACTORY_GAINS.get(model.name, _X430_GAINS), strict=False)
        self._factory = {**model.factory_defaults, **dict(gains), "firmware_version": firmware}
        if self.keeps_limits:
            self._factory = {row.name: row.initial for row in rh_p12.ROWS}
        self.load_factory()
        for name, value in settings.items():
            self.configure(name, value)

    def place(self, wire: int) -> int:
        """Return where in the memory a byte is; -1 where the servo has none."""
        return wire if self._place is None else self._place.get(wire, -1)

    def read(self, address: int, size: int) -> bytes | StatusError:
        """Return ``size`` bytes from ``address`` as a Read instruction does.

        Undefined bytes after a defined start read as 0; an undefined start or a range beyond the
        end of the table is an Access Error.
        """
        if size == 0 or address + size > self._size or not self._defined[address]:
            return StatusError.ACCESS
        if self._place is None:
            return bytes(self.data[address : address + size])
        places = (self.place(wire) for wire in range(address, address + size))
        return bytes(0 if place < 0 else self.data[place] for place in places)

    def plan(self, address: int, size: int) -> WritePlan | StatusError:
        """Return the items that a write covers completely, or the error of the write."""
        key = (address, size)
        plan = self._plans.get(key)
        if plan is None:
            plan = self._plans[key] = self._make_plan(address, size)
        return plan

    def _make_plan(self, address: int, size: int) -> WritePlan | StatusError:
        items = []
        position, end = address, address + size
        while position < end:
            item = self._items.get(position)
            if item is None:
                inside = position < self._size and self._defined[position]
                return StatusError.DATA_LENGTH if inside else StatusError.ACCESS
            if not item.writable:
                return StatusError.ACCESS
            if position + item.size > end:
                return StatusError.DATA_LENGTH
            items.append(item)
            position += item.size
        if not items:
            return StatusError.DATA_LENGTH
        layout = struct.Struct("<" + "".join(item.code for item in items))
        return WritePlan(tuple(items), layout)

    def configure(self, name: str, value: int) -> None:
        """Set an EEPROM item; SimulatorSettingsError for another item or a value out of range."""
        register = REGISTERS.get(name)
        if register is None or not register.eeprom:
            raise SimulatorSettingsError(f"{name!r} is not an EEPROM item of the control table")
        plan = self.plan(register.address, register.size)
        if isinstance(plan, StatusError) or value not in plan.items[0].values:
            raise SimulatorSettingsError(f"{name} = {value} is outside the range of the item")
        self.put(name, value)

    @property
    def limits_current(self) -> bool:
        """Whether Operating Mode is current-based position."""
        return self.get("operating_mode") == OperatingMode.CURRENT_BASED_POSITION

    def get(self, name: str) -> int:
        """Return the raw value of an item by its name."""
        register = REGISTERS[name]
        content = self.data[register.address : register.end]
        return int.from_bytes(content, "little", signed=register.signed)

    def put(self, name: str, value: int) -> None:
        """Set an item by its name, without access rules or side effects; wraps to its size."""
        self._set(REGISTERS[name], value)

    def _set(self, register: Register, value: int) -> None:
        value &= (1 << 8 * register.size) - 1
        self.data[register.address : register.end] = value.to_bytes(register.size, "little")

    def load_factory(self) -> None:
        """Set the EEPROM to the factory's values."""
        self.data[0:EEPROM_END] = bytes(EEPROM_END)
        for item in self._items.values():
            if item.address < EEPROM_END:
                self._set(item, self._factory.get(item.name, 0))

    def load_gains(self) -> None:
        """Set the gains to the defaults of the model and the mode."""
        for name in GAINS:
            self.put(name, self._factory.get(name, 0))
        if self.limits_current and not (self.keeps_limits or is_x330(self.model)):
            self.put("position_d_gain", _X430_D_GAIN_IN_MODE_5)

    def load_ram(self) -> None:
        """Set the RAM to its values after a boot."""
        self.data[EEPROM_END:RAM_END] = bytes(RAM_END - EEPROM_END)
        self.put("status_return_level", self._factory["status_return_level"])
        self.put("goal_pwm", self.get("pwm_limit"))
        self.put("goal_current", self.get("current_limit"))
        self.load_gains()

    def change_mode(self) -> None:
        """Carry out the side effects of a write of Operating Mode on other registers."""
        self.load_gains()
        self.put("profile_acceleration", 0)
        self.put("profile_velocity", 0)
        if self.limits_current:
            self.put("pwm_limit", self._factory["pwm_limit"])
        self.put("goal_pwm", self.get("pwm_limit"))
        self.put("goal_current", self.get("current_limit"))
