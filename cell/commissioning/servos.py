"""Step `servos`: finds the servos at any baud rate, numbers new ones, checks and sets each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from cell.commissioning.backup import (
    SETTLE_S,
    Backup,
    keep,
    read_control_table,
    register_writes,
    since_backup,
)
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step, StepFailed
from cell.commissioning.findings import Notes
from cell.config.gripper import use_servo_models
from cell.plugins import SERVO_MODELS
from gripper.dynamixel.bus import ANSWERS_ALL, ServoBus, ServoIdentity
from gripper.dynamixel.control_table import (
    BAUD_CODES,
    BAUD_RATE,
    REGISTERS,
    SERVO_ID,
    STATUS_RETURN_LEVEL,
    TORQUE_ENABLE,
)
from gripper.dynamixel.latency import check_link
from gripper.dynamixel.models import MODELS, ServoModel, model_name
from gripper.dynamixel.transactions import protocol_1_text
from gripper.servos.verification import Requirement, compare, requirements
from gripper.values.servo_checks import hardware_error_names, overload_text

_USUAL_RATES = (57600, 1_000_000)
"""Baud rates of the factory and of this package."""
SCAN_RATES = (*_USUAL_RATES, *(rate for rate in BAUD_CODES if rate not in _USUAL_RATES))
"""Order in which baud rates are scanned."""
_BOOT_S = 1.0
"""Wait in s for new servos to boot."""
_MOST_FINGER_SERVOS = 2
"""Most servos of the fingers."""
_UNDO = "`tactile-cell commission --restore` writes the backups back"
"""How a person reverts the writes."""
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
            _look_for_protocol_1(bench, port)
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
        rates = [servo for servo in SCAN_RATES if servo in {rate, 57600, *seen, *scan.damaged}]
        scan = scan_servos(bench, port, dialog, rates)
        if not scan.servos and not scan.crowded:
            scan = scan_servos(bench, port, dialog)


def _look_for_protocol_1(bench: Bench, port: str) -> None:
    """Raise StepFailed where a servo answers in Protocol 1.0."""
    for rate in _USUAL_RATES:
        with bench.servo_bus(port, rate) as bus:
            if ids := bus.scan_protocol_1():
                raise StepFailed(f"{protocol_1_text(ids)} (at {rate} bit/s)")


def _demand_answers(bench: Bench, dialog: Dialog, port: str, scan: Scan) -> None:
    """Set Status Return Level to 2 where it is lower: such a servo confirms no other write."""
    for servo_id, rate in ((servo.identity.servo_id, servo.baud_rate) for servo in scan.servos):
        with bench.servo_bus(port, rate) as bus:
            bus.ping(servo_id)  # says which control table it has
            off = bus.answers_off(servo_id)
            level = 0 if off else bus.read(servo_id, STATUS_RETURN_LEVEL)
            if level != ANSWERS_ALL:
                change = {STATUS_RETURN_LEVEL.name: (level, ANSWERS_ALL)}
                undo = "nothing to undo: it is 2 after each power-on"
                dialog.approve(register_writes(f"servo {servo_id}", change, undo))
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
        where = f"servo {old_id} at {servo.baud_rate} bit/s"
        undo = "write the old values with the program of the servos' maker"
        dialog.approve(register_writes(where, changes, undo))
        keep(bench, dialog, Backup(servo_id=new_id, registers=table))
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
    dialog.approve(register_writes(f"servo {servo_id}", change, "release or start the cell"))
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
                f"servo {servo_id} reports {', '.join(hardware_error_names(error))}: remedy the "
                "cause, switch its supply off and on"
            )
        changes[servo_id] = wanted_changes(models[servo_id], bench, table)
        notes.fact(f"servo {servo_id}: {overload_text(table['shutdown'])}")
    if notes.failed:
        return
    writes = [
        write
        for servo_id, values in changes.items()
        for write in register_writes(f"servo {servo_id}", values, _UNDO)
    ]
    if not writes:
        notes.fact("all registers are as the cell needs them")
        return
    for servo_id, table in tables.items():
        torque_off(bus, dialog, servo_id, table[TORQUE_ENABLE.name])
    dialog.approve(writes)
    for servo_id, table in tables.items():
        keep(bench, dialog, Backup(servo_id=servo_id, registers=table))
        for name, (_, after) in changes[servo_id].items():
            bus.write(servo_id, REGISTERS[name], after)
        values = {name: bus.read(servo_id, REGISTERS[name]) for name in table}
        required = _required(models[servo_id], bench)
        for row in compare(servo_id, required, values, frozenset(changes[servo_id])):
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
