"""A DYNAMIXEL X servo as a Protocol 2.0 device: its answer to each instruction.

Written from the ROBOTIS e-Manual ("Protocol 2.0", control tables of the X series). It carries out
ping, read, write, group reads and writes, reboot. Other instructions (registered writes, fast
reads, factory reset, clear, backup) are refused, as by a firmware without them. One object is one
servo; `simulator.servo.bus` finds the packets and orders the answers.
"""

import struct
from collections.abc import Mapping
from typing import NamedTuple

from gripper.dynamixel import control_table as ct
from gripper.dynamixel.models import OperatingMode, ServoModel
from simulator.servo.control_table import Item
from simulator.servo.firmware import (
    GOAL_END,
    GOAL_START,
    PRESENT_END,
    PRESENT_START,
    ServoCore,
)
from simulator.servo.motor import ServoMotor
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
_GOALS = frozenset({*_LIMITED_BY, ct.GOAL_POSITION.address})
_GAINS_IN_USE = frozenset(
    {ct.POSITION_D_GAIN.address, ct.POSITION_I_GAIN.address, ct.POSITION_P_GAIN.address}
)
_ANSWERS_READS, _ANSWERS_ALL = 1, 2
"""Contents of Status Return Level (68)."""
_READS = frozenset({Instruction.READ, Instruction.SYNC_READ, Instruction.BULK_READ})


class StatusBody(NamedTuple):
    """Answer of a servo to an instruction, before it is put into a packet."""

    error: int
    """Error byte, Alert bit included."""
    data: bytes = b""
    """Parameters after the error byte."""


class SimulatedServo(ServoCore):
    """One servo on the bus.

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
        super().__init__(servo_id, model, plant, settings)
        self.made_as = servo_id
        """Initial ID, which faults use even if the ID changes."""

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
        if place < PRESENT_END and place + size > PRESENT_START:
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
            if item.address in _GOALS:
                goals = True
            elif GOAL_START <= item.address < GOAL_END:
                profile = True
            else:
                self._side_effect(item.address, raw, now_s)
        if goals:
            self.goal_written()
        elif profile:
            self.apply_goals()
        return StatusError.NONE

    def _check(self, item: Item, raw: int) -> StatusError:
        if item.eeprom and self.torque_on:
            return StatusError.ACCESS
        if item.address == ct.TORQUE_ENABLE.address and raw and self.latched:
            return StatusError.RESULT_FAIL
        if item.address not in _GOALS:
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
            self.change_mode()
        elif address == ct.BUS_WATCHDOG.address:
            self.set_watchdog(raw, now_s)
        elif address in _GAINS_IN_USE:
            self.apply_goals()
