"""Backup of the servos: the whole control table of each before its first write, and its restore.

The cell's folder has a file for each servo: backup-servo1.json is of the servo that has ID 1 now.
The first backup stays: it has the original state of the servo.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

from pydantic import BaseModel, Field, ValidationError, model_validator

from cell.checks.findings import ProposedChange
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog
from cell.config.file import problem_text
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
from gripper.errors import BusCorrupt, BusTimeout, ServoRejected

_RATES = {code: rate for rate, code in BAUD_CODES.items()}
"""Baud rate in bit/s by its raw value."""
_LAST = (BAUD_RATE.name, SERVO_ID.name)
"""Items that are written last, because each of them changes the address of the servo. Between the
two writes it has an ID that no other servo has had."""
SETTLE_S = 0.1
"""Time in s between a change of ID or baud rate and the next request."""


class Place(NamedTuple):
    """Address of a servo: ID and baud rate in bit/s."""

    servo_id: int
    baud_rate: int
    """In bit/s."""

    def __str__(self) -> str:
        return f"ID {self.servo_id} at {self.baud_rate} bit/s"


class Backup(BaseModel, frozen=True):
    """Original control table of a servo."""

    servo_id: int = Field(ge=0, le=HIGHEST_ID)
    baud_rate: int
    """Address of the servo after its commissioning: ID, baud rate in bit/s."""
    found: dict[str, int]
    """Raw values by the name of the item, read before the first write."""

    @property
    def set_at(self) -> Place:
        """Its address after its commissioning."""
        return Place(self.servo_id, self.baud_rate)

    @property
    def found_at(self) -> Place:
        """Its address before."""
        return Place(self.found[SERVO_ID.name], _RATES[self.found[BAUD_RATE.name]])

    @model_validator(mode="after")
    def _usable(self) -> Self:
        """Refuse a missing or impossible value."""
        for name in (MODEL_NUMBER.name, *_LAST):
            if name not in self.found:
                raise ValueError(f"{name} is missing")
        for name, value in self.found.items():
            low, high = REGISTERS[name].bounds if name in REGISTERS else (value, value)
            high = HIGHEST_ID if name == SERVO_ID.name else high
            if not low <= value <= high:
                raise ValueError(f"{name} is {value}, must be from {low} to {high}")
        code = self.found[BAUD_RATE.name]
        if code not in _RATES or self.baud_rate not in BAUD_CODES:
            rates = f"{code} (raw) and {self.baud_rate} bit/s"
            raise ValueError(f"baud rates are {rates}, which no servo has")
        return self


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
    found = {}
    bus.ping(servo_id)  # says which control table it has
    for register in REGISTERS.values():
        try:
            found[register.name] = bus.read(servo_id, register)
        except ServoRejected:
            # Not every model has every item.
            continue
    return found


def backup_file(folder: Path, servo_id: int) -> Path:
    """Return the path of the backup of a servo."""
    return folder / f"backup-servo{servo_id}.json"


def keep(bench: Bench, dialog: Dialog, backup: Backup) -> None:
    """Write a backup, and name its file; a backup of the same model stays.

    A backup of another model belongs to an exchanged servo, and is kept under another name.
    """
    path = backup_file(bench.folder, backup.servo_id)
    if earlier := _read(path):
        if earlier.found[MODEL_NUMBER.name] == backup.found[MODEL_NUMBER.name]:
            return
        path.rename(free_name(path))
    bench.folder.mkdir(parents=True, exist_ok=True)
    write_json(path, SERVO_BACKUP, backup.model_dump(), error=CellError)
    dialog.say(f"backup of servo {backup.servo_id}: {path}")


def restore(
    bench: Bench, dialog: Dialog, port: str, begin: Callable[[], object] = lambda: None
) -> tuple[str, ...]:
    """Write the EEPROM of each servo back from its backup; return the results as lines.

    Each servo is read back. Baud rate and ID come last; servos that shared an ID do so again.
    ``begin`` is called before the first write, which ends the commissioned state of the servos.
    Raises WizardAborted when the changes are refused; nothing is written then. Raises CellError if
    there is no backup or one of its values is invalid. Raises it if a servo does not answer, is of
    another model, has its torque on, or does not keep a value.
    """
    files = (backup_file(bench.folder, number) for number in range(HIGHEST_ID + 1))
    backups = [backup for path in files if (backup := _read(path)) is not None]
    if not backups:
        raise CellError(f"{bench.folder} has no backup of a servo (backup-servo*.json)")
    places, changes = _places(bench, port, backups), {}
    for backup in backups:
        place = places[backup.servo_id]
        if place != backup.found_at or place == backup.set_at:
            # Else it is back; other servos may have this address, too.
            with bench.servo_bus(port, place.baud_rate) as bus:
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
    begin()
    lines = []
    for backup in (one for one in backups if changes.get(one.servo_id)):
        found = changes[backup.servo_id]
        _write_back(bench, port, places[backup.servo_id], backup, found)
        lines.append(
            f"servo {backup.servo_id}: {len(found)} items restored; it is {backup.found_at}"
        )
    return tuple(lines)


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
    kept = read_json(path, SERVO_BACKUP, error=CellError)
    if kept is None:
        return None
    try:
        backup = Backup.model_validate(kept)
        wrong = f"it is of servo {backup.servo_id}"
        if backup_file(path.parent, backup.servo_id) == path:
            return backup
    except ValidationError as error:
        wrong = problem_text(error)
    raise CellError(f"{path} is damaged, nothing was written: {wrong}; {SERVO_BACKUP.remedy}")


def _places(bench: Bench, port: str, backups: Sequence[Backup]) -> dict[int, Place]:
    """Return the present address of each servo: that of the wizard, the original one, or half way.

    Half way, at the new ID and old baud rate, writes were interrupted. Servos may have shared their
    original address, but not one half way: the highest ID, written back last, is searched first.
    """
    places: dict[int, Place] = {}
    for backup in sorted(backups, key=lambda one: one.servo_id, reverse=True):
        half_way = Place(backup.servo_id, backup.found_at.baud_rate)
        own = [place for place in (backup.set_at, half_way) if place not in places.values()]
        for place in dict.fromkeys((*own, backup.found_at)):
            if _answers(bench, port, place):
                places[backup.servo_id] = place
                break
        else:
            raise CellError(
                f"servo {backup.servo_id} answers neither as {backup.set_at} nor at its original "
                f"{backup.found_at}; nothing was written: check its supply and cable, or find it "
                "with `tactile-cell commission`"
            )
    return places


def _answers(bench: Bench, port: str, place: Place) -> bool:
    """Return whether one servo, or several with colliding answers, answer at an address."""
    with bench.servo_bus(port, place.baud_rate) as bus, suppress(BusCorrupt):
        try:
            bus.ping(place.servo_id)
        except BusTimeout:
            return False
    return True


def _differing(bus: ServoBus, backup: Backup) -> dict[str, tuple[int, int]]:
    """Return the items of the EEPROM that differ from a backup: present and wanted value.

    Items that change the address of the servo come last.
    """
    servo_id = backup.servo_id
    now = read_control_table(bus, servo_id)
    if now[MODEL_NUMBER.name] != backup.found[MODEL_NUMBER.name]:
        raise CellError(
            f"servo {servo_id} has model number {now[MODEL_NUMBER.name]}, its backup has "
            f"{backup.found[MODEL_NUMBER.name]}: this is another servo, so nothing was written; "
            "choose the backup of this servo"
        )
    if now[TORQUE_ENABLE.name]:
        raise CellError(
            f"servo {servo_id} has its torque on and may hold a part, so nothing was written: "
            "release the part first"
        )
    items = [r.name for r in REGISTERS.values() if r.eeprom and r.name not in _LAST]
    both = [name for name in (*items, *_LAST) if name in now and name in backup.found]
    return {
        name: (now[name], backup.found[name]) for name in both if now[name] != backup.found[name]
    }


def _write_back(
    bench: Bench, port: str, place: Place, backup: Backup, changes: Mapping[str, tuple[int, int]]
) -> None:
    servo_id = place.servo_id
    with bench.servo_bus(port, place.baud_rate) as bus:
        bus.demand_answers((servo_id,))
        for name, (_, wanted) in changes.items():
            if name in _LAST:
                continue
            bus.write(servo_id, REGISTERS[name], wanted)
            if (found := bus.read(servo_id, REGISTERS[name])) != wanted:
                raise CellError(f"servo {servo_id} did not keep {name}: wrote {wanted}, is {found}")
        if BAUD_RATE.name in changes:
            bus.write(servo_id, BAUD_RATE, changes[BAUD_RATE.name][1])
            bench.clock.sleep(SETTLE_S)
    if SERVO_ID.name in changes:
        with bench.servo_bus(port, backup.found_at.baud_rate) as bus:
            bus.write(servo_id, SERVO_ID, backup.found_at.servo_id)
