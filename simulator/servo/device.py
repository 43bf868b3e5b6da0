"""A DYNAMIXEL X servo as a Protocol 2.0 device: its answer to each instruction.

Written from the ROBOTIS e-Manual ("Protocol 2.0", control tables of the X series). One object is
one servo; `simulator.servo.bus` finds the packets and decides who speaks when.
"""

from collections.abc import Mapping
from typing import NamedTuple

from gripper.dynamixel.control_table import (
    BAUD_RATE,
    BUS_WATCHDOG,
    DRIVE_MODE,
    FIRMWARE_VERSION,
    GOAL_CURRENT,
    GOAL_POSITION,
    GOAL_PWM,
    GOAL_VELOCITY,
    HARDWARE_ERROR_STATUS,
    OPERATING_MODE,
    POSITION_D_GAIN,
    POSITION_P_GAIN,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    REGISTERED_INSTRUCTION,
    RETURN_DELAY_TIME,
    RETURN_DELAY_UNIT_S,
    SECONDARY_ID,
    SERVO_ID,
    STATUS_RETURN_LEVEL,
    TORQUE_ENABLE,
)
from gripper.dynamixel.models import OperatingMode, ServoModel
from simulator.servo.control_table import Item, in_range, is_x330
from simulator.servo.firmware import (
    GOAL_END,
    GOAL_START,
    PRESENT_END,
    PRESENT_START,
    TIME_BASED_PROFILE,
    ServoCore,
    WatchdogStop,
)
from simulator.servo.motor import ServoMotor
from simulator.servo.protocol2 import ALERT, MAX_ID, Instruction, StatusError, words

RESET_ALL, RESET_ALL_BUT_ID, RESET_ALL_BUT_ID_BAUD = 0xFF, 0x01, 0x02
"""Parameter of Factory Reset."""
BACKUP_STORE, BACKUP_RESTORE = 0x01, 0x02
"""First parameter of Control Table Backup."""
FIRMWARE_WITH_CLEAR = 42
"""First firmware version of the X series that has the instruction Clear."""
RECENT_FIRMWARE, RECENT_FIRMWARE_X330 = 48, 53
"""Firmware versions of a servo of today: X430, X330."""
BAUD_RATES = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Baud rate by the content of Baud Rate (8)."""
_FIRMWARE_WITH_BACKUP, _FIRMWARE_WITH_BACKUP_X330 = 45, 46
"""First firmware versions with Control Table Backup and the fast reads: X430, X330."""
_CLEAR_KEY = b"\x01\x44\x58\x4c\x22"
"""Parameters of Clear: option 1 (turns), and the four bytes that guard it."""
_BACKUP_KEY = b"CTRL"
"""Parameters of Control Table Backup after the first: four bytes that guard it."""
_KEPT = {
    RESET_ALL: (),
    RESET_ALL_BUT_ID: ("id",),
    RESET_ALL_BUT_ID_BAUD: ("id", "baud_rate"),
}
"""Items that a Factory Reset leaves as they are."""
_EXTENDED_LIMIT = 1_048_575
"""Largest magnitude of Goal Position in the modes without position limits: 256 turns."""
_LIMITED_BY = {
    GOAL_PWM.address: "pwm_limit",
    GOAL_CURRENT.address: "current_limit",
    GOAL_VELOCITY.address: "velocity_limit",
}
"""Address of a goal and the item that limits its magnitude."""
_GOALS = frozenset({*_LIMITED_BY, GOAL_POSITION.address})
_PROFILE = frozenset({PROFILE_ACCELERATION.address, PROFILE_VELOCITY.address})
_PROFILE_TIME_LIMIT_MS = 32737
"""Largest profile value with a time-based profile in ms (e-Manual, Profile Velocity)."""
_GAINS_IN_USE = frozenset({POSITION_D_GAIN.address, POSITION_P_GAIN.address})
_ANSWERS_READS, _ANSWERS_ALL = 1, 2
"""Contents of Status Return Level (68)."""
_READS = frozenset(
    {
        Instruction.READ,
        Instruction.SYNC_READ,
        Instruction.BULK_READ,
        Instruction.FAST_SYNC_READ,
        Instruction.FAST_BULK_READ,
    }
)


def has_backup(core: ServoCore) -> bool:
    """Return whether the firmware has Control Table Backup and the fast reads."""
    first = _FIRMWARE_WITH_BACKUP_X330 if is_x330(core.model) else _FIRMWARE_WITH_BACKUP
    return core.firmware >= first


def service(core: ServoCore, instruction: int, parameters: bytes, now_s: float) -> StatusError:
    """Carry out a rare instruction (reset, reboot, clear, backup); others are refused."""
    if instruction == Instruction.REBOOT:
        core.boot(now_s)
        return StatusError.NONE
    if instruction == Instruction.FACTORY_RESET:
        return _factory_reset(core, parameters, now_s)
    if instruction == Instruction.CLEAR and core.firmware >= FIRMWARE_WITH_CLEAR:
        return _clear(core, parameters)
    if instruction == Instruction.BACKUP and has_backup(core):
        return _backup(core, parameters, now_s)
    return StatusError.INSTRUCTION


def _factory_reset(core: ServoCore, parameters: bytes, now_s: float) -> StatusError:
    if len(parameters) != 1:
        return StatusError.DATA_LENGTH
    kept = _KEPT.get(parameters[0])
    if kept is None:
        return StatusError.DATA_RANGE
    core.registers.load_factory(keep=kept)
    core.boot(now_s)
    return StatusError.NONE


def _clear(core: ServoCore, parameters: bytes) -> StatusError:
    if parameters != _CLEAR_KEY:
        return StatusError.DATA_RANGE
    if core.moving:
        return StatusError.RESULT_FAIL
    core.position.fold_turns()
    core.registers.put("goal_position", core.position.present_raw())
    core.apply_goals()
    return StatusError.NONE


def _backup(core: ServoCore, parameters: bytes, now_s: float) -> StatusError:
    if parameters[1:] != _BACKUP_KEY:
        return StatusError.DATA_RANGE
    if core.torque_on:
        return StatusError.RESULT_FAIL
    if parameters[0] == BACKUP_STORE:
        core.registers.store_backup()
        return StatusError.NONE
    if parameters[0] == BACKUP_RESTORE:
        return StatusError.NONE if core.restore_backup(now_s) else StatusError.RESULT_FAIL
    return StatusError.DATA_RANGE


class Answer(NamedTuple):
    """Answer of a servo to an instruction, before it is put into a packet."""

    error: int
    """Error byte, Alert bit included."""
    data: bytes = b""
    """Parameters after the error byte."""


class SimulatedServo:
    """One servo on the bus.

    Parameters
    ----------
    firmware
        Firmware version; None takes a recent one (48 on X430, 53 on X330) that has the fast
        reads and the backup.
    settings
        Raw values of EEPROM items by register name, over the factory's; the factory leaves the
        servo at 57600 baud with a return delay of 500 us.
    watchdog_stop
        What a tripped bus watchdog does to the motor.
    """

    def __init__(
        self,
        servo_id: int,
        model: ServoModel,
        plant: ServoMotor,
        *,
        firmware: int | None = None,
        settings: Mapping[str, int] | None = None,
        watchdog_stop: WatchdogStop = WatchdogStop.HOLD,
    ) -> None:
        if firmware is None:
            firmware = RECENT_FIRMWARE_X330 if is_x330(model) else RECENT_FIRMWARE
        self.core = ServoCore(
            servo_id,
            model,
            plant,
            firmware=firmware,
            settings=settings,
            watchdog_stop=watchdog_stop,
        )
        """Registers and their effects."""
        self.made_as = servo_id
        """ID that it was made with, by which faults name it whatever its ID is now."""
        self._registered: tuple[int, bytes] | None = None

    @property
    def servo_id(self) -> int:
        """Content of ID (7)."""
        return self.core.table.data[SERVO_ID.address]

    @property
    def secondary_id(self) -> int | None:
        """Second ID to which the servo listens without answering; None when off."""
        value = self.core.table.data[SECONDARY_ID.address]
        return value if value <= MAX_ID else None

    @property
    def baudrate(self) -> int:
        """Line rate in baud after Baud Rate (8)."""
        return BAUD_RATES[self.core.table.data[BAUD_RATE.address]]

    @property
    def return_delay_s(self) -> float:
        """Pause in s between an instruction and the answer, after Return Delay Time (9)."""
        return self.core.table.data[RETURN_DELAY_TIME.address] * RETURN_DELAY_UNIT_S

    @property
    def has_fast_reads(self) -> bool:
        """Whether the firmware answers Fast Sync Read and Fast Bulk Read."""
        return has_backup(self.core)

    def answers(self, instruction: int) -> bool:
        """Return whether Status Return Level (68) lets the servo answer this instruction."""
        level = self.core.table.data[STATUS_RETURN_LEVEL.address]
        if instruction == Instruction.PING or level >= _ANSWERS_ALL:
            return True
        return level == _ANSWERS_READS and instruction in _READS

    def status(self, error: int, data: bytes = b"") -> Answer:
        """Return an answer with the Alert bit as Hardware Error Status (70) asks for it."""
        alert = self.core.table.data[HARDWARE_ERROR_STATUS.address]
        return Answer(error | ALERT if alert else error, data)

    def execute(self, instruction: int, parameters: bytes, now_s: float) -> Answer:
        """Carry out an instruction that was sent to this servo or to all of them."""
        if instruction == Instruction.READ:
            if len(parameters) != 4:
                return self.status(StatusError.DATA_LENGTH)
            address, size = words(parameters)
            return self.read(address, size, now_s)
        if instruction == Instruction.WRITE:
            if len(parameters) < 3:
                return self.status(StatusError.DATA_LENGTH)
            (address,) = words(parameters[:2])
            return self.status(self.write(address, parameters[2:], now_s))
        if instruction == Instruction.PING:
            version = self.core.table.data[FIRMWARE_VERSION.address]
            number = self.core.registers.get("model_number").to_bytes(2, "little")
            return self.status(StatusError.NONE, number + bytes((version,)))
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
            for item, raw in zip(plan.items, plan.layout.unpack(piece), strict=True):
                refused = self._check(item, raw)
                if refused is not StatusError.NONE:
                    return refused
                values.append((item, raw))
        goals = profile = False
        for item, raw in values:
            if item.address == TORQUE_ENABLE.address:
                self.core.set_torque(on=bool(raw))
                continue
            self.core.table.set(item.address, item.size, raw)
            if item.address in _GOALS:
                goals = True
            elif GOAL_START <= item.address < GOAL_END:
                profile = True
            else:
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
        if item.address == TORQUE_ENABLE.address and raw and core.latched:
            return StatusError.RESULT_FAIL
        registers, data = core.registers, core.table.data
        lower, upper, refusal = item.minimum, item.maximum, StatusError.DATA_RANGE
        limit = _LIMITED_BY.get(item.address)
        if limit is not None:
            upper = registers.get(limit)
            lower, refusal = -upper, StatusError.DATA_LIMIT
        elif item.address == GOAL_POSITION.address:
            if data[OPERATING_MODE.address] == OperatingMode.POSITION:
                lower = registers.get("min_position_limit")
                upper = registers.get("max_position_limit")
                refusal = StatusError.DATA_LIMIT
            else:
                lower, upper = -_EXTENDED_LIMIT, _EXTENDED_LIMIT
        elif item.address in _PROFILE and data[DRIVE_MODE.address] & TIME_BASED_PROFILE:
            upper = _PROFILE_TIME_LIMIT_MS
        elif not in_range(item, raw):
            return refusal
        return StatusError.NONE if lower <= raw <= upper else refusal

    def _side_effect(self, address: int, raw: int, now_s: float) -> None:
        core = self.core
        if address == OPERATING_MODE.address:
            core.change_mode()
        elif address == BUS_WATCHDOG.address:
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
        if self.core.table.data[REGISTERED_INSTRUCTION.address] == 0:
            self._registered = None
        return error

    def _register(self, parameters: bytes) -> StatusError:
        if len(parameters) < 3:
            return StatusError.DATA_LENGTH
        (address,) = words(parameters[:2])
        data = parameters[2:]
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
