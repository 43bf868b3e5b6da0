"""Instructions of a simulated servo that are sent on rare occasions: reset, reboot, clear, backup.

Source: ROBOTIS e-Manual, "Protocol 2.0", sections of each instruction.
"""

from simulator.control_table import is_x330
from simulator.protocol2 import Instruction, StatusError
from simulator.servo_core import ServoCore

RESET_ALL, RESET_ALL_BUT_ID, RESET_ALL_BUT_ID_BAUD = 0xFF, 0x01, 0x02
BACKUP_STORE, BACKUP_RESTORE = 0x01, 0x02
FIRMWARE_WITH_CLEAR = 42
_CLEAR_KEY = bytes((0x01, 0x44, 0x58, 0x4C, 0x22))
_BACKUP_KEY = bytes((0x43, 0x54, 0x52, 0x4C))
_KEPT = {
    RESET_ALL: (),
    RESET_ALL_BUT_ID: ("id",),
    RESET_ALL_BUT_ID_BAUD: ("id", "baud_rate"),
}


def service(core: ServoCore, instruction: int, parameters: bytes, now_s: float) -> StatusError:
    """Carry out one of the rare instructions; an unknown one is an Instruction Error."""
    if instruction == Instruction.REBOOT:
        core.boot(now_s)
        return StatusError.NONE
    if instruction == Instruction.FACTORY_RESET:
        return _factory_reset(core, parameters, now_s)
    if instruction == Instruction.CLEAR and core.firmware >= FIRMWARE_WITH_CLEAR:
        return _clear(core, parameters)
    if instruction == Instruction.BACKUP and core.firmware >= (46 if is_x330(core.model) else 45):
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
