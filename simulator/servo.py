"""A DYNAMIXEL X servo as a Protocol 2.0 device: what it answers to each instruction.

Written from the ROBOTIS e-Manual ("Protocol 2.0", control tables of the X series). One object is
one servo; `simulator.servo_bus` finds the packets and decides who speaks when.
"""

from collections.abc import Mapping
from typing import NamedTuple

from gripper.registers import RETURN_DELAY_UNIT_S, ServoModel
from simulator.control_table import Item, in_range, is_x330
from simulator.protocol2 import ALERT, Instruction, StatusError
from simulator.servo_core import ServoCore, WatchdogStop
from simulator.servo_goals import GOAL_END, GOAL_START
from simulator.servo_plant import ServoPlant
from simulator.servo_position import PRESENT_END, PRESENT_START
from simulator.servo_service import service

BAUD_RATES = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Baud rate by the content of register 8."""
_EXTENDED_LIMIT = 1_048_575
_LIMITED_BY = {100: 36, 102: 38, 104: 44}
"""Goal item -> item that limits its magnitude."""
_GOALS = frozenset({100, 102, 104, 116})
_PROFILE = frozenset({108, 112})
_PROFILE_TIME_LIMIT = 32737
_GAINS_IN_USE = frozenset({80, 84})


class Answer(NamedTuple):
    """What a servo says to an instruction, before it is put into a packet.

    Attributes
    ----------
    error
        Error byte, Alert bit included.
    data
        Parameters after the error byte.
    """

    error: int
    data: bytes = b""


class SimulatedServo:
    """One servo on the bus.

    Parameters
    ----------
    servo_id
        ID, 0 to 252.
    model
        The servo model.
    plant
        Its motor.
    firmware
        Firmware version; None takes a recent one (48 on X430, 53 on X330) that knows the fast
        reads and the backup.
    settings
        Raw values of EEPROM items by register name, over the factory's; the factory leaves the
        servo at 57600 baud with a return delay of 500 us.
    watchdog_stop
        What a tripped bus watchdog does to the motor.

    Attributes
    ----------
    core
        Registers and their effects.
    """

    def __init__(
        self,
        servo_id: int,
        model: ServoModel,
        plant: ServoPlant,
        *,
        firmware: int | None = None,
        settings: Mapping[str, int] | None = None,
        watchdog_stop: WatchdogStop = WatchdogStop.HOLD,
    ) -> None:
        if firmware is None:
            firmware = 53 if is_x330(model) else 48
        self.core = ServoCore(
            servo_id,
            model,
            plant,
            firmware=firmware,
            settings=settings,
            watchdog_stop=watchdog_stop,
        )
        self._registered: tuple[int, bytes] | None = None

    @property
    def servo_id(self) -> int:
        """Content of register 7."""
        return self.core.table.data[7]

    @property
    def secondary_id(self) -> int | None:
        """Second ID to which the servo listens without answering; None when off."""
        value = self.core.table.data[12]
        return value if value <= 252 else None

    @property
    def baudrate(self) -> int:
        """Line rate in baud after register 8."""
        return BAUD_RATES[self.core.table.data[8]]

    @property
    def return_delay_s(self) -> float:
        """Pause in s between an instruction and the answer, after register 9."""
        return self.core.table.data[9] * RETURN_DELAY_UNIT_S

    @property
    def knows_fast_reads(self) -> bool:
        """Whether the firmware answers Fast Sync Read and Fast Bulk Read."""
        return self.core.firmware >= (46 if is_x330(self.core.model) else 45)

    def answers(self, instruction: int) -> bool:
        """Return whether Status Return Level (68) lets the servo answer this instruction."""
        level = self.core.table.data[68]
        if instruction == Instruction.PING:
            return True
        if level >= 2:
            return True
        return level == 1 and instruction in {
            Instruction.READ,
            Instruction.SYNC_READ,
            Instruction.BULK_READ,
            Instruction.FAST_SYNC_READ,
            Instruction.FAST_BULK_READ,
        }

    def supervise(self, now_s: float) -> None:
        """Let bus watchdog and protections act at the time ``now_s``."""
        self.core.supervise(now_s)

    def status(self, error: int, data: bytes = b"") -> Answer:
        """Return an answer with the Alert bit as Hardware Error Status (70) asks for it."""
        return Answer(error | ALERT if self.core.table.data[70] else error, data)

    def execute(self, instruction: int, parameters: bytes, now_s: float) -> Answer:
        """Carry out an instruction that was sent to this servo or to all of them."""
        if instruction == Instruction.READ:
            if len(parameters) != 4:
                return self.status(StatusError.DATA_LENGTH)
            address = parameters[0] | parameters[1] << 8
            return self.read(address, parameters[2] | parameters[3] << 8, now_s)
        if instruction == Instruction.WRITE:
            if len(parameters) < 3:
                return self.status(StatusError.DATA_LENGTH)
            address = parameters[0] | parameters[1] << 8
            return self.status(self.write(address, parameters[2:], now_s))
        if instruction == Instruction.PING:
            data = self.core.table.data
            return self.status(StatusError.NONE, bytes((data[0], data[1], data[6])))
        before = self.status(StatusError.NONE)
        error = self._execute_rare(instruction, parameters, now_s)
        # A servo that reboots has answered before, with the Alert bit that the reboot clears.
        return self.status(error) if error else before

    def read(self, address: int, size: int, now_s: float) -> Answer:
        """Return ``size`` bytes from ``address``, present values brought up to date."""
        core = self.core
        if (address < PRESENT_END and address + size > PRESENT_START) or core.table.reads_through(
            address, size
        ):
            core.refresh(now_s)
        found = core.table.read(address, size)
        if isinstance(found, StatusError):
            return self.status(found)
        return self.status(StatusError.NONE, found)

    def write(self, address: int, data: bytes, now_s: float) -> StatusError:
        """Write one or more whole items; nothing is written when one of them is refused."""
        values: list[tuple[Item, int]] = []
        for start, piece in self.core.table.redirect(address, data):
            plan = self.core.table.plan(start, len(piece))
            if isinstance(plan, StatusError):
                return plan
            for item in plan:
                at = item.address - start
                raw = int.from_bytes(piece[at : at + item.size], "little", signed=item.signed)
                refused = self._check(item, raw)
                if refused:
                    return refused
                values.append((item, raw))
        goals = profile = False
        for item, raw in values:
            if item.address in _GOALS:
                goals = True
            elif GOAL_START <= item.address < GOAL_END:
                profile = True
            elif item.address == 64:
                self.core.set_torque(on=bool(raw))
                continue
            self.core.table.set(item.address, item.size, raw)
            self._side_effect(item.address, raw, now_s)
        if goals:
            self.core.goal_written()
        elif profile:
            self.core.apply_goals()
        return StatusError.NONE

    def _check(self, item: Item, raw: int) -> StatusError:
        core = self.core
        if item.eeprom and core.torque_on:
            return StatusError.ACCESS
        if item.address in _GOALS and core.watchdog_tripped:
            return StatusError.DATA_RANGE
        if item.address == 64 and raw and core.latched:
            return StatusError.RESULT_FAIL
        return self._check_value(item, raw)

    def _check_value(self, item: Item, raw: int) -> StatusError:
        table = self.core.table
        lower, upper, refusal = item.minimum, item.maximum, StatusError.DATA_RANGE
        limit_address = _LIMITED_BY.get(item.address)
        if limit_address is not None:
            upper = table.get(limit_address, 4 if limit_address == 44 else 2)
            lower, refusal = -upper, StatusError.DATA_LIMIT
        elif item.address == 116 and table.data[11] == 3:
            lower, upper, refusal = table.get(52, 4), table.get(48, 4), StatusError.DATA_LIMIT
        elif item.address == 116:
            lower, upper = -_EXTENDED_LIMIT, _EXTENDED_LIMIT
        elif item.address in _PROFILE and table.data[10] & 4:
            upper = _PROFILE_TIME_LIMIT
        elif not in_range(item, raw):
            return refusal
        return StatusError.NONE if lower <= raw <= upper else refusal

    def _side_effect(self, address: int, raw: int, now_s: float) -> None:
        core = self.core
        if address == 11:
            core.change_mode()
        elif address == 98:
            core.set_watchdog(raw, now_s)
        elif address in _GAINS_IN_USE:
            core.apply_goals()

    def _execute_rare(self, instruction: int, parameters: bytes, now_s: float) -> StatusError:
        if instruction == Instruction.REG_WRITE:
            return self._register(parameters)
        if instruction == Instruction.ACTION:
            if self._registered is None:
                return StatusError.INSTRUCTION
            address, data = self._registered
            self._forget_registered()
            return self.write(address, data, now_s)
        error = service(self.core, instruction, parameters, now_s)
        if self.core.table.data[69] == 0:
            self._registered = None
        return error

    def _register(self, parameters: bytes) -> StatusError:
        if len(parameters) < 3:
            return StatusError.DATA_LENGTH
        address, data = parameters[0] | parameters[1] << 8, parameters[2:]
        for start, piece in self.core.table.redirect(address, data):
            plan = self.core.table.plan(start, len(piece))
            if isinstance(plan, StatusError):
                return plan
        self._registered = (address, data)
        self.core.registers.put("registered_instruction", 1)
        return StatusError.NONE

    def _forget_registered(self) -> None:
        self._registered = None
        self.core.registers.put("registered_instruction", 0)
