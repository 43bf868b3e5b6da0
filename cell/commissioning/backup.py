"""Backup of the servos: the whole control table of each before its first write, and its return.

A file for each servo in the cell's folder: backup-servo1.json is of the servo that has ID 1 now.
The first backup stays: it holds the servo as it came.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Write
from cell.data.files import write_text
from cell.errors import CellError
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import (
    BAUD_CODES,
    BAUD_RATE,
    MODEL_NUMBER,
    REGISTERS,
    SERVO_ID,
    TORQUE_ENABLE,
)
from gripper.errors import GripperError, ServoRejected

_RATES = {code: rate for rate, code in BAUD_CODES.items()}
"""Baud rates in bit/s by the value of their register."""
_LAST = (SERVO_ID.name, BAUD_RATE.name)
"""Items that are written last: with each of them the servo is reached in another way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Backup:
    """Control table of a servo as it was found."""

    servo_id: int
    baud_rate: int
    """Where the servo is reached after its commissioning: ID, baud rate in bit/s."""
    found: Mapping[str, int]
    """Raw values by the name of the item, read before the first write."""


_BACKUP = TypeAdapter(Backup)


def register_writes(
    where: str, changes: Mapping[str, tuple[object, object]], undo: str
) -> list[Write]:
    """Return the writes of some items of a servo, by name with present and coming value."""
    return [
        Write(
            where=where,
            what=f"{name} ({REGISTERS[name].address})",
            before=str(before),
            after=str(after),
            undo=undo,
        )
        for name, (before, after) in changes.items()
    ]


def read_control_table(bus: ServoBus, servo_id: int) -> dict[str, int]:
    """Return the raw values of all items that a servo has, by name."""
    found = {}
    for register in REGISTERS.values():
        try:
            found[register.name] = bus.read(servo_id, register)
        except ServoRejected:
            # Not every model has every item.
            continue
    return found


def backup_file(folder: Path, servo_id: int) -> Path:
    """Return where the backup of a servo is."""
    return folder / f"backup-servo{servo_id}.json"


def keep(folder: Path, backup: Backup) -> Path | None:
    """Write a backup and return its file; None where one of the same model is there already.

    One of another model belongs to a servo that was exchanged, and is kept under another name.
    """
    path = backup_file(folder, backup.servo_id)
    if path.exists():
        earlier = _read(path)
        if earlier.found.get(MODEL_NUMBER.name) == backup.found.get(MODEL_NUMBER.name):
            return None
        number = 1
        while (aside := path.with_suffix(f".{number}.json")).exists():
            number += 1
        path.rename(aside)
    folder.mkdir(parents=True, exist_ok=True)
    text = _BACKUP.dump_json(backup, indent=2).decode() + "\n"
    write_text(path, text, error=CellError, what="backup")
    return path


def restore(bench: Bench, dialog: Dialog, port: str) -> tuple[str, ...]:
    """Write the EEPROM of each servo back as its backup has it; return what was done, in lines.

    Each servo is read back. ID and baud rate come last; servos that shared an ID do so again.
    Raises Left when the writes are refused; nothing is written then. Raises CellError if there is
    no backup, a servo does not answer where it should, is of another model, has its torque on, or
    does not keep a value.
    """
    backups = [_read(path) for path in sorted(bench.folder.glob("backup-servo[0-9]*.json"))]
    backups = [b for b in backups if backup_file(bench.folder, b.servo_id).exists()]
    if not backups:
        raise CellError(f"{bench.folder} holds no backup of a servo (backup-servo*.json)")
    changes = {}
    for backup in backups:
        if _is_back(bench, port, backup):
            continue
        with bench.servo_bus(port, backup.baud_rate) as bus:
            changes[backup.servo_id] = _differing(bus, backup)
    undo = "run `tactile-cell commission --redo servos`"
    writes = [
        write
        for servo_id, found in changes.items()
        for write in register_writes(f"servo {servo_id}", found, undo)
    ]
    if not writes:
        return ("all servos are as they were found",)
    dialog.approve(writes)
    lines = []
    for backup in (one for one in backups if one.servo_id in changes):
        _write_back(bench, port, backup, changes[backup.servo_id])
        lines.append(
            f"servo {backup.servo_id}: {len(changes[backup.servo_id])} items as they were found; "
            f"it is ID {backup.found[SERVO_ID.name]} at {_rate(backup.found)} bit/s"
        )
    return tuple(lines)


def since_backup(folder: Path, bus: ServoBus, servo_id: int) -> list[tuple[str, str, str]]:
    """Return the items of a servo's EEPROM that differ from its backup: name, value then and now.

    None without a backup. Raises CellError as `restore`.
    """
    path = backup_file(folder, servo_id)
    if not path.exists():
        return []

    def text(name: str, raw: int) -> str:
        return f"{_RATES.get(raw, raw)} bit/s" if name == BAUD_RATE.name else str(raw)

    differing = _differing(bus, _read(path))
    return [(name, text(name, was), text(name, now)) for name, (now, was) in differing.items()]


def _read(path: Path) -> Backup:
    try:
        return _BACKUP.validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise CellError(f"{path} is no backup of a servo: {error}") from error


def _rate(found: Mapping[str, int]) -> int:
    return _RATES[found[BAUD_RATE.name]]


def _is_back(bench: Bench, port: str, backup: Backup) -> bool:
    """Return whether a servo is no longer where the wizard put it, but where it was found.

    So is one after a restore that was interrupted.
    """
    if (backup.servo_id, backup.baud_rate) == (backup.found[SERVO_ID.name], _rate(backup.found)):
        return False
    with bench.servo_bus(port, backup.baud_rate) as bus:
        if bus.scan([backup.servo_id]):
            return False
    with bench.servo_bus(port, _rate(backup.found)) as bus:
        return bool(bus.scan([backup.found[SERVO_ID.name]]))


def _differing(bus: ServoBus, backup: Backup) -> dict[str, tuple[int, int]]:
    """Return the items of the EEPROM that differ from a backup: present and wanted value.

    Those come last with which a servo is reached otherwise.
    """
    servo_id = backup.servo_id
    try:
        now = read_control_table(bus, servo_id)
    except GripperError as error:
        raise CellError(
            f"servo {servo_id} does not answer at {bus.baudrate} bit/s, nothing was written: "
            f"{error}"
        ) from error
    if now[MODEL_NUMBER.name] != backup.found[MODEL_NUMBER.name]:
        raise CellError(
            f"servo {servo_id} is of model number {now[MODEL_NUMBER.name]}, its backup of "
            f"{backup.found[MODEL_NUMBER.name]}: this is another servo, nothing was written"
        )
    if now[TORQUE_ENABLE.name]:
        raise CellError(
            f"servo {servo_id} has its torque on and may hold a part, nothing was written: release "
            "it first"
        )
    items = [r.name for r in REGISTERS.values() if r.eeprom and r.name not in _LAST]
    both = [name for name in (*items, *_LAST) if name in now and name in backup.found]
    return {
        name: (now[name], backup.found[name]) for name in both if now[name] != backup.found[name]
    }


def _write_back(
    bench: Bench, port: str, backup: Backup, changes: Mapping[str, tuple[int, int]]
) -> None:
    servo_id = backup.servo_id
    with bench.servo_bus(port, backup.baud_rate) as bus:
        for name, (_, wanted) in changes.items():
            if name == BAUD_RATE.name:
                continue
            bus.write(servo_id, REGISTERS[name], wanted)
            servo_id = wanted if name == SERVO_ID.name else servo_id
            if (found := bus.read(servo_id, REGISTERS[name])) != wanted:
                raise CellError(f"servo {servo_id} did not keep {name}: wrote {wanted}, is {found}")
        if BAUD_RATE.name in changes:
            bus.write(servo_id, BAUD_RATE, changes[BAUD_RATE.name][1])
