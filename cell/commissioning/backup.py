"""Backup of the servos: the whole control table of each before its first write, and its restore.

The cell's folder has a file for each servo: backup-servo1.json is of the servo that has ID 1 now.
The first backup stays: it has the original state of the servo.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog
from cell.commissioning.findings import ProposedChange
from cell.errors import CellError
from cell.files import free_name
from cell.formats import SERVO_BACKUP, read_json, write_json
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import (
    BAUD_CODES,
    BAUD_RATE,
    MODEL_NUMBER,
    REGISTERS,
    SERVO_ID,
    TORQUE_ENABLE,
)
from gripper.dynamixel.transactions import HIGHEST_ID
from gripper.errors import ServoRejected

_RATES = {code: rate for rate, code in BAUD_CODES.items()}
"""Baud rate in bit/s by its raw value."""
_ADDRESS = (BAUD_RATE.name, SERVO_ID.name)
"""Items that a restore leaves: new servos share an ID, and would disturb each other again."""
SETTLE_S = 0.1
"""Time in s between a change of ID or baud rate and the next request."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Backup:
    """Original control table of a servo."""

    servo_id: int
    """ID of the servo after its commissioning."""
    registers: dict[str, int]
    """Raw values by the name of the item, read before the first write."""


def register_writes(
    where: str, changes: Mapping[str, tuple[object, object]], undo: str
) -> list[ProposedChange]:
    """Return the writes of some items of a servo, given by name with present and new value."""
    return [
        ProposedChange(where, f"{name} ({REGISTERS[name].address})", str(before), str(after), undo)
        for name, (before, after) in changes.items()
    ]


def read_control_table(bus: ServoBus, servo_id: int) -> dict[str, int]:
    """Return the raw values of all items that a servo has, by name."""
    table = {}
    bus.ping(servo_id)  # says which control table it has
    for register in REGISTERS.values():
        try:
            table[register.name] = bus.read(servo_id, register)
        except ServoRejected:
            # Not every model has every item.
            continue
    return table


def backup_file(folder: Path, servo_id: int) -> Path:
    """Return the path of the backup of a servo."""
    return folder / f"backup-servo{servo_id}.json"


def keep(bench: Bench, dialog: Dialog, backup: Backup) -> None:
    """Write a backup, and name its file; a backup of the same model stays.

    A backup of another model belongs to an exchanged servo, and is kept under another name.
    """
    path = backup_file(bench.folder, backup.servo_id)
    if earlier := _read(path):
        if earlier.registers[MODEL_NUMBER.name] == backup.registers[MODEL_NUMBER.name]:
            return
        path.rename(free_name(path))
    bench.folder.mkdir(parents=True, exist_ok=True)
    write_json(path, SERVO_BACKUP, asdict(backup), error=CellError)
    dialog.say(f"backup of servo {backup.servo_id}: {path}")


def restore(
    bench: Bench, dialog: Dialog, port: str, begin: Callable[[], object] = lambda: None
) -> tuple[str, ...]:
    """Write the EEPROM of each servo back from its backup; return the results as lines.

    Each item is read back. ID and baud rate stay. ``begin`` is called before the first write, which
    ends the commissioned state of the servos. Raises WizardAborted when the changes are refused;
    nothing is written then. Raises CellError if there is no backup or one of its values is invalid.
    Raises it if a servo is of another model, has its torque on, or does not keep a value. Raises
    GripperError if a servo does not answer.
    """
    files = (backup_file(bench.folder, number) for number in range(HIGHEST_ID + 1))
    backups = [backup for path in files if (backup := _read(path)) is not None]
    if not backups:
        raise CellError(f"{bench.folder} has no backup of a servo (backup-servo*.json)")
    undo = "run `tactile-cell commission --redo servos`"
    with bench.servo_bus(port) as bus:
        changes = {}
        for backup in backups:
            differing = _differing(bus, backup)
            changes[backup.servo_id] = {n: c for n, c in differing.items() if n not in _ADDRESS}
        writes = [
            write
            for servo_id, items in changes.items()
            for write in register_writes(f"servo {servo_id}", items, undo)
        ]
        if not writes:
            return ("all servos are as they were found",)
        dialog.approve(writes)
        begin()
        for servo_id, items in changes.items():
            bus.demand_answers((servo_id,))
            for name, (_, wanted) in items.items():
                bus.write(servo_id, REGISTERS[name], wanted)
                if (now := bus.read(servo_id, REGISTERS[name])) != wanted:
                    raise CellError(
                        f"servo {servo_id} did not keep {name}: wrote {wanted}, is {now}"
                    )
    return tuple(
        f"servo {number}: {len(items)} items restored" for number, items in changes.items()
    )


def since_backup(folder: Path, bus: ServoBus, servo_id: int) -> list[tuple[str, str, str]]:
    """Return the items of a servo's EEPROM that differ from its backup: name, old and new value.

    Empty without a backup. Raises CellError as `restore`.
    """

    def text(name: str, raw: int) -> str:
        return f"{_RATES.get(raw, raw)} bit/s" if name == BAUD_RATE.name else str(raw)

    backup = _read(backup_file(folder, servo_id))
    differing = {} if backup is None else _differing(bus, backup)
    return [(name, text(name, was), text(name, now)) for name, (now, was) in differing.items()]


def _read(path: Path) -> Backup | None:
    """Return the backup in a file; None without the file."""
    content = read_json(path, SERVO_BACKUP, error=CellError)
    if content is None:
        return None
    backup = Backup(**content)
    if backup_file(path.parent, backup.servo_id) != path:
        raise CellError(
            f"{path} is of servo {backup.servo_id}, nothing was written; {SERVO_BACKUP.remedy}"
        )
    return backup


def _differing(bus: ServoBus, backup: Backup) -> dict[str, tuple[int, int]]:
    """Return the items of the EEPROM that differ from a backup: present and wanted value."""
    servo_id = backup.servo_id
    now, before = read_control_table(bus, servo_id), backup.registers
    if now[MODEL_NUMBER.name] != before[MODEL_NUMBER.name]:
        raise CellError(
            f"servo {servo_id} has model number {now[MODEL_NUMBER.name]}, its backup has "
            f"{before[MODEL_NUMBER.name]}: this is another servo, so nothing was written; "
            "choose the backup of this servo"
        )
    if now[TORQUE_ENABLE.name]:
        raise CellError(
            f"servo {servo_id} has its torque on and may hold a part, so nothing was written: "
            "release the part first"
        )
    items = [r.name for r in REGISTERS.values() if r.eeprom and r.name in now and r.name in before]
    return {name: (now[name], before[name]) for name in items if now[name] != before[name]}
