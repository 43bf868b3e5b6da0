"""The control table of a simulated servo: bytes, access rules and ranges.

Addresses come from `gripper.registers`; what else an item accepts (minimum, maximum) is stated here
after the tables of the ROBOTIS e-Manual. Bytes between the items read as 0, as on the servo.
"""

from typing import NamedTuple

from gripper.registers import REGISTERS, Register, ServoModel
from simulator.protocol2 import StatusError

TABLE_SIZE = 700
"""Bytes that can be addressed; the last items of the X series end at 661."""

_RANGES: dict[str, tuple[int, int]] = {
    "id": (0, 252),
    "baud_rate": (0, 7),
    "return_delay_time": (0, 254),
    "drive_mode": (0, 13),
    "secondary_id": (0, 255),
    "protocol_type": (2, 2),
    "homing_offset": (-1_044_479, 1_044_479),
    "moving_threshold": (0, 1023),
    "temperature_limit": (0, 100),
    "pwm_limit": (0, 885),
    "max_position_limit": (0, 4095),
    "min_position_limit": (0, 4095),
    "startup_configuration": (0, 3),
    "torque_enable": (0, 1),
    "led": (0, 1),
    "status_return_level": (0, 2),
    "velocity_i_gain": (0, 16383),
    "velocity_p_gain": (0, 16383),
    "position_d_gain": (0, 16383),
    "position_i_gain": (0, 16383),
    "position_p_gain": (0, 16383),
    "feedforward_2nd_gain": (0, 16383),
    "feedforward_1st_gain": (0, 16383),
    "bus_watchdog": (0, 127),
    "profile_acceleration": (0, 32767),
    "profile_velocity": (0, 32767),
}
_MODES = frozenset({0, 1, 3, 4, 5, 16})


class Item(NamedTuple):
    """One item with its rules.

    Attributes
    ----------
    name, address, size, signed, writable, eeprom
        As in `gripper.registers.Register`.
    minimum, maximum
        Accepted raw values; anything else is a Data Range Error.
    """

    name: str
    address: int
    size: int
    signed: bool
    writable: bool
    eeprom: bool
    minimum: int
    maximum: int


class IndirectArea(NamedTuple):
    """One block of indirect addresses and the data that they give access to.

    Attributes
    ----------
    address
        First indirect address (2 bytes each).
    data
        First byte of indirect data.
    entries
        Number of entries.
    """

    address: int
    data: int
    entries: int


def indirect_areas(model: ServoModel, firmware: int) -> tuple[IndirectArea, ...]:
    """Return the indirect blocks of a model: two of 28 on X430, one of 20 on X330."""
    if not is_x330(model):
        return (IndirectArea(168, 224, 28), IndirectArea(578, 634, 28))
    return (IndirectArea(168, 208 if firmware >= 52 else 224, 20),)


def is_x330(model: ServoModel) -> bool:
    """Return whether the model is of the 330 size, whose table differs in a few places."""
    return model.number in {1190, 1200, 1210, 1220, 1230, 1240}


def _whole_range(register: Register) -> tuple[int, int]:
    bits = 8 * register.size
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if register.signed else (0, (1 << bits) - 1)


def _items(model: ServoModel, firmware: int) -> dict[int, Item]:
    ranges = dict(_RANGES)
    ranges["current_limit"] = (0, model.current_limit_raw)
    ranges["velocity_limit"] = (0, 2047 if is_x330(model) else 1023)
    for name in ("max_voltage_limit", "min_voltage_limit"):
        ranges[name] = (model.min_voltage_raw, model.max_voltage_raw)
    registers = list(REGISTERS.values())
    if is_x330(model):
        ranges["baud_rate"] = (0, 6)
        registers.append(Register(name="pwm_slope", address=62, size=1, eeprom=True))
        ranges["pwm_slope"] = (1, 255)
    for area in indirect_areas(model, firmware):
        for i in range(area.entries):
            name = f"indirect_address_{area.address + 2 * i}"
            registers.append(Register(name=name, address=area.address + 2 * i, size=2))
            ranges[name] = (64, TABLE_SIZE - 1)
            registers.append(
                Register(name=f"indirect_data_{area.data + i}", address=area.data + i, size=1)
            )
    return {
        r.address: Item(
            r.name,
            r.address,
            r.size,
            r.signed,
            r.writable,
            r.eeprom,
            *ranges.get(r.name, _whole_range(r)),
        )
        for r in registers
    }


class ControlTable:
    """Bytes of one servo with the access rules of its items.

    Parameters
    ----------
    model
        The servo model.
    firmware
        Firmware version (register 6).
    """

    __slots__ = (
        "_defined",
        "_indirect",
        "_indirect_end",
        "_indirect_start",
        "_items",
        "_plans",
        "data",
    )

    def __init__(self, model: ServoModel, firmware: int) -> None:
        self.data = bytearray(TABLE_SIZE)
        self._items = _items(model, firmware)
        self._defined = bytearray(TABLE_SIZE)
        for item in self._items.values():
            self._defined[item.address : item.address + item.size] = b"\x01" * item.size
        self._plans: dict[tuple[int, int], tuple[Item, ...] | StatusError] = {}
        self._indirect: dict[int, int] = {}
        for area in indirect_areas(model, firmware):
            for i in range(area.entries):
                self._indirect[area.data + i] = area.address + 2 * i
                self.set(area.address + 2 * i, 2, area.data + i)
        self._indirect_start = min(self._indirect)
        self._indirect_end = max(self._indirect) + 1

    @property
    def items(self) -> tuple[Item, ...]:
        """All items in the order of their addresses."""
        return tuple(self._items[address] for address in sorted(self._items))

    def get(self, address: int, size: int, *, signed: bool = False) -> int:
        """Return the raw value of ``size`` bytes at ``address``."""
        return int.from_bytes(self.data[address : address + size], "little", signed=signed)

    def set(self, address: int, size: int, value: int) -> None:
        """Set ``size`` bytes at ``address`` without any check; wraps to the size."""
        value &= (1 << 8 * size) - 1
        self.data[address : address + size] = value.to_bytes(size, "little")

    def read(self, address: int, size: int) -> bytes | StatusError:
        """Return ``size`` bytes from ``address`` as a Read instruction does.

        Undefined bytes after a defined start read as 0; an undefined start or a range beyond the
        end of the table is an Access Error.
        """
        if size == 0 or address + size > TABLE_SIZE or not self._defined[address]:
            return StatusError.ACCESS
        if address + size <= self._indirect_start or address >= self._indirect_end:
            return bytes(self.data[address : address + size])
        return bytes(self.data[self._target(a)] for a in range(address, address + size))

    def plan(self, address: int, size: int) -> tuple[Item, ...] | StatusError:
        """Return the items that a write covers whole, or why it cannot be done."""
        key = (address, size)
        plan = self._plans.get(key)
        if plan is None:
            plan = self._plans[key] = self._make_plan(address, size)
        return plan

    def redirect(self, address: int, data: bytes) -> list[tuple[int, bytes]]:
        """Split a write into contiguous pieces behind the indirect addresses.

        A write that touches no indirect data comes back as one piece as it is.
        """
        end = address + len(data)
        if end <= self._indirect_start or address >= self._indirect_end:
            return [(address, data)]
        pieces: list[tuple[int, bytes]] = []
        for i, byte in enumerate(data):
            target = self._target(address + i)
            if pieces and pieces[-1][0] + len(pieces[-1][1]) == target:
                pieces[-1] = (pieces[-1][0], pieces[-1][1] + bytes((byte,)))
            else:
                pieces.append((target, bytes((byte,))))
        return pieces

    def reads_through(self, address: int, size: int) -> bool:
        """Return whether a read touches indirect data, which may lead anywhere."""
        return address < self._indirect_end and address + size > self._indirect_start

    def _target(self, address: int) -> int:
        pointer = self._indirect.get(address)
        return address if pointer is None else self.data[pointer] | self.data[pointer + 1] << 8

    def _make_plan(self, address: int, size: int) -> tuple[Item, ...] | StatusError:
        items = []
        position, end = address, address + size
        while position < end:
            item = self._items.get(position)
            if item is None:
                inside = position < TABLE_SIZE and self._defined[position]
                return StatusError.DATA_LENGTH if inside else StatusError.ACCESS
            if not item.writable:
                return StatusError.ACCESS
            if position + item.size > end:
                return StatusError.DATA_LENGTH
            items.append(item)
            position += item.size
        return tuple(items) if items else StatusError.DATA_LENGTH


def in_range(item: Item, value: int) -> bool:
    """Return whether an item accepts a raw value, limits set in other items left aside."""
    if item.name == "operating_mode":
        return value in _MODES
    return item.minimum <= value <= item.maximum
