"""Step `servos`: finds the servos at any baud rate, numbers new ones, checks and sets each.

The control table of each servo is kept in a backup, which can be restored.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step, StepFailed
from cell.commissioning.findings import Notes, ProposedChange, commission_command
from cell.config.gripper import use_servo_models
from cell.errors import CellError
from cell.files import SERVO_BACKUP, free_name, read_json, write_json
from cell.plugins import SERVO_MODELS
from gripper.dynamixel.bus import ANSWERS_ALL, HIGHEST_ID, ServoBus, ServoIdentity
from gripper.dynamixel.control_table import (
    BAUD_CODES,
    BAUD_RATE,
    HARDWARE_ERROR_STATUS,
    MODEL_NUMBER,
    REGISTERS,
    SERVO_ID,
    STATUS_RETURN_LEVEL,
    TORQUE_ENABLE,
)
from gripper.dynamixel.latency import check_link
from gripper.dynamixel.models import MODELS, ServoModel, model_name
from gripper.errors import ServoRejected
from gripper.servos.verification import Requirement, requirements
from gripper.values.servo_checks import hardware_errors_text, overload_text

_FACTORY_RATE = 57600
"""Baud rate of a new servo."""
SCAN_RATES = tuple(sorted(BAUD_CODES, key=lambda rate: rate not in (_FACTORY_RATE, 1_000_000)))
"""Order in which baud rates are scanned: at first those of the factory and of this package."""
_BOOT_S = 1.0
"""Wait in s for new servos to boot."""
_MOST_FINGER_SERVOS = 2
"""Most servos of the fingers."""
_RATES = {code: rate for rate, code in BAUD_CODES.items()}
"""Baud rate in bit/s by its raw value."""
_ADDRESS = (BAUD_RATE.name, SERVO_ID.name)
"""Items that a restore leaves: new servos share an ID, and would disturb each other again."""
_LASTING = tuple(
    register.name
    for register in REGISTERS.values()
    if register.eeprom or register in (TORQUE_ENABLE, HARDWARE_ERROR_STATUS)
)
"""Items that stay the same while nothing is written to a servo."""
_READINGS = 4
"""Most readings of a control table, of which two in a row must agree."""
SETTLE_S = 0.1
"""Time in s between a change of ID or baud rate and the next request."""
_VOLTAGE_MARGIN = 1.05
"""Supply voltage that gets a warning, relative to the least of the model."""


class ServoAnswer(NamedTuple):
    """A servo that answered a scan."""

    baud_rate: int
    identity: ServoIdentity


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """Answers on a line, at all baud rates."""

    servos: tuple[ServoAnswer, ...] = ()
    """Servos with a unique ID."""
    shared: tuple[ServoAnswer, ...] = ()
    """IDs that several servos share."""
    damaged: tuple[int, ...] = ()
    """Baud rates in bit/s at which damaged bytes came."""

    @property
    def crowded(self) -> bool:
        """Whether answers collide, so that nothing may be written."""
        return bool(self.shared or self.damaged)


def scan_servos(bench: Bench, port: str, dialog: Dialog, rates: Sequence[int] = SCAN_RATES) -> Scan:
    """Ping all IDs at each baud rate; takes about 12 s for all of them."""
    servos: list[ServoAnswer] = []
    shared: list[ServoAnswer] = []
    damaged: list[int] = []
    for rate in rates:
        dialog.live("scan", f"{rate} bit/s")
        with bench.servo_bus(port, rate) as bus:
            identities, has_damaged = bus.scan_at_once()
            if has_damaged:
                # A single one may be chance.
                identities, has_damaged = bus.scan_at_once()
            for identity in identities:
                servo = ServoAnswer(rate, identity)
                (shared if bus.shares_id(identity.servo_id) else servos).append(servo)
            if has_damaged:
                damaged.append(rate)
    return Scan(servos=tuple(servos), shared=tuple(shared), damaged=tuple(damaged))


def lone_servo(bench: Bench, dialog: Dialog, port: str) -> tuple[int, int, ServoModel]:
    """Return baud rate, ID and model of the one servo on a line, found at any baud rate.

    Raises StepFailed unless one servo of a known model answers.
    """
    scan = scan_servos(bench, port, dialog)
    if scan.crowded or len(scan.servos) != 1:
        answer = "several servos answer" if scan.crowded or scan.servos else "no servo answers"
        raise StepFailed(f"{answer} on {port}: check supply and wires, connect one servo alone")
    ((rate, identity),) = scan.servos
    if (name := model_name(identity.model_number)) not in MODELS:
        raise StepFailed(f"this is a {name}; use one of {', '.join(MODELS)}")
    return rate, identity.servo_id, MODELS[name]


def find_servos(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Scan all baud rates, give new servos their IDs one at a time, and check each.

    Model, firmware, supply and registers are compared. The control table of each servo is kept in a
    backup before the first write; each write is shown before. Nothing moves.
    """
    port, rate = bench.gripper().port, bench.gripper().baud_rate
    use_servo_models(SERVO_MODELS.usable())
    fingers = _numbered(bench, dialog, port, rate)
    if len(fingers) > _MOST_FINGER_SERVOS:
        raise StepFailed(
            f"{len(fingers)} servos answer on {port}, a gripper has one or two: give each servo of "
            "an axis a port of its own"
        )
    configs, volts = list[dict[str, Any]](), set[float]()
    for identity in fingers:
        name = model_name(identity.model_number)
        configs.append({"id": identity.servo_id, "model": name})
        notes.fact(f"servo {identity.servo_id}: {name}, firmware {identity.firmware}")
        if name in MODELS:
            volts.add(MODELS[name].nominal_voltage_v)
        else:
            notes.fail(
                f"servo {identity.servo_id} is {name}, whose grip force cannot be bounded here. "
                f"Use one of {', '.join(MODELS)}"
            )
    firmware = [{"firmware": identity.firmware} for identity in fingers]
    notes.values["servos"] = [a | b for a, b in zip(configs, firmware, strict=True)]
    if len(volts) > 1:
        notes.fail(
            "the servos of the fingers need different supplies "
            f"({', '.join(f'{v:g} V' for v in sorted(volts))}): use two of one model"
        )
    if notes.failed:
        return
    notes.settings |= {"gripper.baud_rate": rate, "gripper.servos": configs}
    with bench.servo_bus(port, rate) as bus:
        _set_up(bench, bus, dialog, fingers, notes)
        for identity in fingers:
            for name, was, now in since_backup(bench.folder, bus, identity.servo_id):
                notes.fact(
                    f"servo {identity.servo_id}: {name} was {was}, is now {now}", corrected=True
                )
        period_s = 1.0 / bench.gripper().loop_rate_hz
        median_s = check_link(bus, [identity.servo_id for identity in fingers], period_s)
        notes.fact(f"round trip of a ping: {1e3 * median_s:.2f} ms (median)")


SERVOS = Step(find_servos, "servos", "Servos", needs=("ports",))


# Finding and numbering


def _numbered(bench: Bench, dialog: Dialog, port: str, rate: int) -> list[ServoIdentity]:
    """Return the servos, each with an ID of its own at one baud rate."""
    scan = scan_servos(bench, port, dialog)
    n_wanted = 0
    while True:
        if scan.crowded:
            n_wanted = _MOST_FINGER_SERVOS
            _ask_for_one_alone(dialog, scan)
        elif not scan.servos:
            raise StepFailed(
                "no servo answers at any baud rate: check the supply (12 V; its LED flashes once "
                "at power-on), the wires to the adapter, and that it is half-duplex (U2D2)"
            )
        else:
            _demand_answers(bench, dialog, port, scan)
            placed = _placed(bench, dialog, port, rate, scan)
            scan = Scan(servos=tuple(ServoAnswer(rate, servo) for servo in placed))
            n_wanted = n_wanted or _count(bench, dialog, placed)
            if len(placed) >= n_wanted or not _connected(dialog, placed[-1]):
                return placed
        bench.clock.sleep(_BOOT_S)
        seen = {servo.baud_rate for servo in (*scan.servos, *scan.shared)}
        likely = {rate, _FACTORY_RATE, *seen, *scan.damaged}
        rates = [scanned for scanned in SCAN_RATES if scanned in likely]
        scan = scan_servos(bench, port, dialog, rates)
        if not scan.servos and not scan.crowded:
            scan = scan_servos(bench, port, dialog)


def _demand_answers(bench: Bench, dialog: Dialog, port: str, scan: Scan) -> None:
    """Set Status Return Level to 2 where it is lower: such a servo confirms no other write."""
    for servo_id, rate in ((servo.identity.servo_id, servo.baud_rate) for servo in scan.servos):
        with bench.servo_bus(port, rate) as bus:
            bus.ping(servo_id)  # the bus keeps its control table
            off = bus.answers_off(servo_id)
            level = 0 if off else bus.read(servo_id, STATUS_RETURN_LEVEL)
            if level != ANSWERS_ALL:
                change = {STATUS_RETURN_LEVEL.name: (level, ANSWERS_ALL)}
                undo = "nothing to undo: it is 2 after each power-on"
                dialog.approve(register_writes({servo_id: change}, undo))
                bus.demand_answers((servo_id,))


def _connected(dialog: Dialog, last: ServoIdentity) -> bool:
    """Return whether the person has connected the next servo; False if there is no other."""
    answers = {"done": "it is connected", "none": "there is no other: one drives both fingers"}
    text = f"Servo {last.servo_id} has its number. Connect the next servo beside it, and switch its"
    return dialog.choose("servos.connect_next", f"{text} supply on.", answers, "done") == "done"


def _ask_for_one_alone(dialog: Dialog, scan: Scan) -> None:
    several = [f"ID {servo.identity.servo_id} at {servo.baud_rate} bit/s" for servo in scan.shared]
    several += [f"damaged bytes at {rate} bit/s" for rate in scan.damaged]
    dialog.confirm(
        "servos.connect_one",
        f"Several servos answer: {', '.join(several)}. New servos all have ID 1, and nothing can "
        "be written to one of them. Disconnect all servos but one.",
        "one servo is connected",
    )


def _count(bench: Bench, dialog: Dialog, placed: Sequence[ServoIdentity]) -> int:
    """Return the number of servos of the gripper; ask if one answers and the config has two."""
    if len(placed) > 1 or len(bench.base.gripper.servos) == 1:
        return len(placed)
    answer = dialog.choose(
        "servos.count",
        f"One servo answers: {model_name(placed[0].model_number)}. Does it drive both "
        "fingers, or does a second servo drive the other finger?",
        {"1": "one servo drives both fingers", "2": "there is a second one"},
    )
    return int(answer)


def _placed(bench: Bench, dialog: Dialog, port: str, rate: int, scan: Scan) -> list[ServoIdentity]:
    """Give each servo a unique ID and the baud rate; return all in the order of their IDs."""
    at_home = [servo.identity for servo in scan.servos if servo.baud_rate == rate]
    taken = {servo.servo_id for servo in at_home}
    for servo in (other for other in scan.servos if other.baud_rate != rate):
        identity = servo.identity
        used = taken | {other.identity.servo_id for other in scan.servos if other is not servo}
        new_id = identity.servo_id
        if new_id in used:
            new_id = next(number for number in range(1, 253) if number not in used)
        _renumber(bench, dialog, port, servo, new_id=new_id, rate=rate)
        taken.add(new_id)
        at_home.append(replace(identity, servo_id=new_id))
    return sorted(at_home, key=lambda servo: servo.servo_id)


def _renumber(
    bench: Bench, dialog: Dialog, port: str, servo: ServoAnswer, *, new_id: int, rate: int
) -> None:
    """Write ID and baud rate of one servo, after its backup and an approval; read them back."""
    old_id = servo.identity.servo_id
    with bench.servo_bus(port, servo.baud_rate) as bus:
        table = read_control_table(bus, old_id)
        torque_off(bus, dialog, old_id, table[TORQUE_ENABLE.name])
        changes: dict[str, tuple[object, object]] = {}
        if new_id != old_id:
            changes[SERVO_ID.name] = (old_id, new_id)
        changes[BAUD_RATE.name] = (f"{servo.baud_rate} bit/s", f"{rate} bit/s")
        undo = "write the old values with the program of the servos' maker"
        dialog.approve(register_writes({old_id: changes}, undo, f" at {servo.baud_rate} bit/s"))
        keep(bench, dialog, new_id, table)
        if new_id != old_id:
            bus.write(old_id, SERVO_ID, new_id)
            bench.clock.sleep(SETTLE_S)
        bus.write(new_id, BAUD_RATE, BAUD_CODES[rate])
    bench.clock.sleep(SETTLE_S)
    with bench.servo_bus(port, rate) as bus:
        bus.ping(new_id)


def torque_off(bus: ServoBus, dialog: Dialog, servo_id: int, torque: int) -> None:
    """Switch the torque of a servo off after an approval: a held part falls."""
    if not torque:
        return
    dialog.say(
        f"Servo {servo_id} has its torque on: it may hold a part. Its registers can be written "
        "without torque only. Take the part out, or hold it: otherwise it falls."
    )
    change = {TORQUE_ENABLE.name: ("on", "off")}
    dialog.approve(register_writes({servo_id: change}, "release or start the cell"))
    bus.write(servo_id, TORQUE_ENABLE, 0)


# Registers


def _set_up(
    bench: Bench, bus: ServoBus, dialog: Dialog, fingers: Sequence[ServoIdentity], notes: Notes
) -> None:
    """Compare the registers of the servos and set the different ones.

    Nothing is set while a supply is too low or an error is latched.
    """
    tables = {identity.servo_id: read_control_table(bus, identity.servo_id) for identity in fingers}
    models = {identity.servo_id: MODELS[model_name(identity.model_number)] for identity in fingers}
    changes = {}
    for servo_id, table in tables.items():
        check_supply(servo_id, models[servo_id], table, notes)
        if error := table["hardware_error_status"]:
            notes.fail(
                f"servo {servo_id} reports {hardware_errors_text(error)}: remedy the "
                "cause, switch its supply off and on"
            )
        changes[servo_id] = wanted_changes(models[servo_id], bench, table)
        notes.fact(f"servo {servo_id}: {overload_text(table['shutdown'])}")
    if notes.failed:
        return
    undo = f"`{commission_command(bench.folder)} --restore` writes the backups back"
    if not (writes := register_writes(changes, undo)):
        notes.fact("all registers are as the cell needs them")
        return
    for servo_id, table in tables.items():
        torque_off(bus, dialog, servo_id, table[TORQUE_ENABLE.name])
    dialog.approve(writes)
    for servo_id, table in tables.items():
        keep(bench, dialog, servo_id, table)
        for name, (_, after) in changes[servo_id].items():
            bus.write(servo_id, REGISTERS[name], after)
        values = {name: bus.read(servo_id, REGISTERS[name]) for name in table}
        for required in _required(models[servo_id], bench):
            row = required.row(servo_id, values[required.item])
            if not row.ok:
                notes.fail(f"{row}, after it was written")
    notes.fact(f"{len(writes)} registers set and read back")


def _required(model: ServoModel, bench: Bench) -> tuple[Requirement, ...]:
    gripper = bench.gripper()
    current_a = min(gripper.current_max_a, model.winding_a(model.current_limit_raw))
    return requirements(model, current_a, min(gripper.temperature_max_c, model.temperature_limit_c))


def wanted_changes(
    model: ServoModel, bench: Bench, table: Mapping[str, int]
) -> dict[str, tuple[int, int]]:
    """Return the registers to set, present and wanted value: the factory's if allowed.

    Read-only items (model, firmware, latched errors) are omitted.
    """
    changes = {}
    for required in _required(model, bench):
        register, present = REGISTERS[required.item], table[required.item]
        if required.met_by(present) or not register.writable:
            continue
        factory = model.factory_defaults.get(required.item, 0)
        wanted = present & ~required.mask | required.low if required.mask != -1 else factory
        if not required.met_by(wanted):
            wanted = required.low
        changes[required.item] = (present, wanted)
    return changes


def check_supply(servo_id: int, model: ServoModel, table: Mapping[str, int], notes: Notes) -> None:
    """Note a wrong supply voltage of a servo."""
    unit_v = model.voltage_unit_v
    supply_v = table["present_input_voltage"] * unit_v
    least_v, most_v = model.min_voltage_raw * unit_v, model.max_voltage_raw * unit_v
    text = (
        f"servo {servo_id} has {supply_v:.1f} V, a {model.name} takes {least_v:.1f} to "
        f"{most_v:.1f} V"
    )
    if not least_v <= supply_v <= most_v:
        notes.fail(f"{text}: check the power supply and the wires to the servo")
    elif supply_v < _VOLTAGE_MARGIN * least_v:
        notes.warn(f"{text}: too little under load; use {model.nominal_voltage_v:g} V")


# Backup: the whole control table of each servo before its first write, and its restore. The cell's
# folder has a file for each: backup-servo1.json is of the servo that has ID 1 now. The first backup
# stays: it has the original state of the servo.


def register_writes(
    changes: Mapping[int, Mapping[str, tuple[object, object]]], undo: str, at: str = ""
) -> list[ProposedChange]:
    """Return the writes of some items of servos: present and new value by name and servo's ID."""
    return [
        ProposedChange(
            *(f"servo {servo_id}{at}", f"{name} ({REGISTERS[name].address})"),
            *(str(before), str(after), undo),
        )
        for servo_id, items in changes.items()
        for name, (before, after) in items.items()
    ]


def read_control_table(bus: ServoBus, servo_id: int) -> dict[str, int]:
    """Return the raw values of all items that a servo has, by name.

    Two readings in a row must agree in what lasts: where an answer comes twice, each later one is
    that to the request before. Raises CellError if no two do.
    """
    readings = (_read_once(bus, servo_id) for _ in range(_READINGS))
    for before, table in pairwise(readings):
        if all(before.get(name) == table.get(name) for name in _LASTING):
            return table
    raise CellError(
        f"servo {servo_id} reads otherwise each time: check cable and adapter, and that no other "
        "program uses the port"
    )


def _read_once(bus: ServoBus, servo_id: int) -> dict[str, int]:
    table = {}
    bus.ping(servo_id)  # the bus keeps its control table
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


def keep(bench: Bench, dialog: Dialog, servo_id: int, registers: Mapping[str, int]) -> None:
    """Write the backup of a servo, and name its file; the backup of the same servo stays.

    If the servo has another model, or the baud rate of the factory, the backup belongs to an
    exchanged servo, and is kept under another name.

    Parameters
    ----------
    servo_id
        ID of the servo after its commissioning.
    registers
        Raw values by the name of the item, read before the first write.
    """
    path = backup_file(bench.folder, servo_id)
    if earlier := read_backup(path):
        new = registers[BAUD_RATE.name] == BAUD_CODES[_FACTORY_RATE]
        if not new and earlier[MODEL_NUMBER.name] == registers[MODEL_NUMBER.name]:
            return
        path.rename(free_name(path))
    content = {"servo_id": servo_id, "registers": registers}
    write_json(path, SERVO_BACKUP, content, error=CellError)
    dialog.say(f"backup of servo {servo_id}: {path}")


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
    backups = {
        servo_id: registers
        for servo_id in range(HIGHEST_ID + 1)
        if (registers := read_backup(backup_file(bench.folder, servo_id))) is not None
    }
    if not backups:
        raise CellError(f"{bench.folder} has no backup of a servo (backup-servo*.json)")
    undo = f"run `{commission_command(bench.folder)} --redo servos`"
    with bench.servo_bus(port) as bus:
        changes = {}
        for servo_id, registers in backups.items():
            differing = _differing(bus, servo_id, registers)
            changes[servo_id] = {n: c for n, c in differing.items() if n not in _ADDRESS}
        if not (writes := register_writes(changes, undo)):
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

    registers = read_backup(backup_file(folder, servo_id))
    differing = {} if registers is None else _differing(bus, servo_id, registers)
    return [(name, text(name, was), text(name, now)) for name, (now, was) in differing.items()]


def read_backup(path: Path) -> dict[str, int] | None:
    """Return the registers in a backup by name; None without the file.

    Raises CellError if it is damaged, or of another servo than its name says.
    """
    content = read_json(path, SERVO_BACKUP, error=CellError)
    if content is None:
        return None
    registers: dict[str, int] = content["registers"]
    if backup_file(path.parent, content["servo_id"]) != path:
        raise CellError(
            f"{path} is of servo {content['servo_id']}, nothing was written; {SERVO_BACKUP.remedy}"
        )
    return registers


def _differing(
    bus: ServoBus, servo_id: int, before: Mapping[str, int]
) -> dict[str, tuple[int, int]]:
    """Return the items of the EEPROM that differ from a backup: present and wanted value."""
    now = read_control_table(bus, servo_id)
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
