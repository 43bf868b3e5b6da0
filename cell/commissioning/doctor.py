"""The system check: each finding passes, warns or fails, with a remedy."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from shlex import quote
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cell.build import Cell, build_cell
from cell.commissioning.findings import (
    STORE_NAME,
    Finding,
    Verdict,
    check_result,
    commission_command,
    read_commissioned,
)
from cell.commissioning.ports import check_port
from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config, make_calibration
from cell.control.zeroing import drive_text, stored_zeros
from cell.errors import CellError
from cell.hand.interface import FORCE_FROM_FRAMES
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import model_name
from gripper.errors import AnswersOff, GripperError, VerificationFailed
from gripper.force.approach.mechanics_proof import POSITION_ITEM
from gripper.servos.verification import CORRECTABLE
from gripper.values.servo_checks import VerificationRow, overload_text
from motion.errors import AxisMissing, AxisSilent, MotionError
from tactile.errors import IdentityMismatch, TactileError
from tactile.source import SourceIdentity

_AT_START = "the cell sets it at its start"
"""Advice for a register that a start corrects."""
_NEW_SERVO = "`tactile-cell commission FOLDER --redo servos` sets up a new servo"
"""Advice for an exchanged servo."""
_TORQUE = "servo torque"
"""Name of the check of the servos' torque."""
_PRESSED_SIGMAS = 6.0
"""Distance of a taxel's mean from the rest, in spreads of the counts, that shows pressure."""


@dataclass(frozen=True, slots=True)
class Commissioning:
    """Findings of a commissioning, for comparison with the hardware of today."""

    values: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Values by the key of the step; empty without a commissioning."""
    command: str = commission_command(Path())
    """Command that repeats a step."""

    @classmethod
    def in_folder(cls, folder: Path) -> Self:
        """Read the findings in a folder. Raises CellError if commissioning.json cannot be read."""
        steps = read_commissioned(folder / STORE_NAME).steps
        values = {key: notes.values for key, notes in steps.items()}
        return cls(values, commission_command(folder))

    def changed_unit(self, now: SourceIdentity) -> list[Finding]:
        """Return the differences of a control unit and its pads."""
        unit, pads = self.values.get("unit", {}), self.values.get("pads_at_rest", {})
        serial, revision = unit.get("serial_number", now.serial), unit.get("revision", now.revision)
        changes = self._change("control unit", "unit", serial, now.serial, "serial {}") or (
            self._change("firmware of the unit", "unit", revision, now.revision, "revision {:#x}")
        )
        was = tuple(pads.get("board_serial_numbers", now.boards))
        text = "serial {0[0]} on finger 0, {0[1]} on finger 1"
        return changes + self._change("pads", "pads_at_rest", was, now.boards, text)

    def changed_servos(self, servos: Mapping[int, tuple[str, int]]) -> list[Finding]:
        """Return the differences of servos; ``servos`` are model and firmware by ID."""
        changes = []
        for was in self.values.get("servos", {}).get("servos", ()):
            before = (was["model"], was["firmware"])
            now, text = servos.get(was["id"], before), "{0[0]}, firmware {0[1]}"
            changes += self._change(f"servo {was['id']}", "servos", before, now, text)
        return changes

    def _change(self, what: str, step: str, was: Any, now: Any, text: str = "{}") -> list[Finding]:
        """Return the change of one value, which ``text`` formats; ``step`` is to be repeated."""
        difference = f"{text.format(now)}, at commissioning {text.format(was)}"
        advice = f"`{self.command} --redo {step}` repeats the steps it affects"
        return [check_result(what, difference, advice)] * (was != now)


def examine(config: CellConfig, config_file: Path | None = None) -> Iterator[Finding]:
    """Check the ports, then each device of the cell, yielding results as they come.

    It only reads and verifies: no torque is switched on and nothing moves. The advised commands
    name ``config_file``.
    """
    for _, key, port in config.serial_ports:
        yield from check_port(key, port)
    named = "" if config_file is None else f" --config {quote(str(config_file))}"
    yield _self_zero(config, named)
    try:
        earlier = Commissioning.in_folder(config_file.parent) if config_file else Commissioning()
    except CellError as error:
        earlier = Commissioning()
        yield check_result("commissioning", str(error), "its values are not compared")
    yield _drives(config, named, earlier)
    yield from _devices(config, named, earlier)


def _self_zero(config: CellConfig, named: str) -> Finding:
    """Return the date and values of the last self-zero."""
    if not config.gripper.pads_meet or config.self_zero == "never":
        off = config.self_zero == "never"
        reason = "switched off" if off else "none: gripper.pads_meet is false"
        return check_result("self-zero", reason, ok=True)
    zeros = stored_zeros(config, Path(config.recording.directory))
    at = datetime.fromtimestamp(zeros.measured_s)
    if zeros.newest is None:
        none = f"none of today, the last is of {at.date()}" if zeros.measured_s else "not measured"
        return check_result(
            "self-zero",
            zeros.refused or none,
            f"take everything out of the grip, then `tactile-cell hand zero{named}`: at teaching, "
            "at the start of a session and after each change of pads or servos",
        )
    ratio = float(np.exp(zeros.newest.log_gain_ratio))
    return check_result(
        "self-zero",
        f"of {at:%Y-%m-%d %H:%M}: pads meet at {1e3 * zeros.newest.opening_m:+.2f} mm, finger 0 "
        f"measures {ratio:.2f} times finger 1",
        ok=True,
    )


def _drives(config: CellConfig, named: str, earlier: Commissioning) -> Finding:
    """Return the measured characteristics of the servos' drives, beside the catalogue."""
    zeros = stored_zeros(config, Path(config.recording.directory), new_hand=False)
    texts, advice, disagrees = list[str](), "", False
    for servo in config.gripper_settings.servos:
        if not zeros.measured_servo(servo.servo_id):
            texts.append(f"servo {servo.servo_id}: not measured, catalogue values within 30 %")
            advice = f"`tactile-cell hand zero{named}` measures them, with nothing in the grip"
            continue
        drive = DriveCharacteristic.from_stored(zeros.drives[servo.servo_id]["drive"])
        at = datetime.fromtimestamp(drive.measured_s)
        where = "" if drive.temperature_c is None else f" at {drive.temperature_c:.0f} C"
        texts.append(f"{drive_text(servo, drive)}, {at:%Y-%m-%d}{where}")
        disagrees |= drive.disagreement(servo.servo_model) != 1.0
    advice *= config.gripper.pads_meet
    if disagrees:
        advice = (
            "pads and motor constant disagree: press a known weight on the pads with "
            f"`{earlier.command} --redo pads_law`"
        )
    return check_result("servo drives", "; ".join(texts), advice, ok=not advice)


def _devices(config: CellConfig, named: str, earlier: Commissioning) -> Iterator[Finding]:
    """Check the devices; ``named`` is the option that names the cell in advised commands."""
    try:
        cell = build_cell(config, mover=lambda _pose: False, ask=str, partial=True)
    except (CellError, GripperError, TactileError) as error:
        advice = "check cabling, power and the names in the config"
        if config.positioner.socket:
            advice += "; `tactile-cell simulate` must run for a positioner with a socket"
        yield check_result("links", str(error), advice, bad=Verdict.FAIL)
        return
    yield from _loop(cell)
    try:
        yield from _guarded(_TORQUE, lambda: _torque(cell, named))
        yield from _guarded("servos", lambda: _servos(cell, named, earlier))
        yield from _guarded("control unit", lambda: _control_unit(cell, config, named, earlier))
        yield from _axes(cell)
    finally:
        cell.close()


def _loop(cell: Cell) -> Iterator[Finding]:
    """List the real-time settings that the system refused to the force loop."""
    notes = cell.controller.hand.notes
    if cell.realtime and not notes:
        yield check_result("force loop", "real time as configured", ok=True)
    yield from (check_result("force loop", *note.split(": ", 1)) for note in notes)


def _guarded(what: str, check: Callable[[], list[Finding]]) -> Iterator[Finding]:
    try:
        yield from check()
    except VerificationFailed as error:
        for line in str(error).splitlines():
            yield check_result(what, line, "see the expected value", bad=Verdict.FAIL)
    except AnswersOff as error:
        yield check_result(what, str(error), _AT_START)
    except (GripperError, TactileError) as error:
        keys = "gripper.servos[].id and gripper.baud_rate"
        if what not in (_TORQUE, "servos"):
            keys = "tactile.node_id, tactile.bitrate and tactile.sensor"
        advice = f"check power, cable, {keys}"
        if what == "servos":
            advice += f"; {_NEW_SERVO}"
        if what == _TORQUE:
            advice += "; it is unknown whether a part is held: the servos keep their last goals"
        yield check_result(what, str(error), advice, bad=Verdict.FAIL)


def _torque(cell: Cell, named: str) -> list[Finding]:
    """Check that all servos or no servo has torque; one servo alone may press on a part."""
    conditions = cell.controller.hand.conditions()
    texts = "; ".join(map(str, conditions))
    if any(condition.answers_off for condition in conditions):
        return [check_result(_TORQUE, texts, f"{_AT_START}; a part may be in the grip")]
    limp = [condition for condition in conditions if condition.answers and not condition.torque_on]
    clear = f"`tactile-cell hand clear{named} --reboot`"
    if not any(condition.torque_on for condition in conditions):
        ok = not any(condition.shut_down for condition in conditions)
        advice = f"remedy the cause of the error, then {clear}"
        return [check_result(_TORQUE, texts, advice, ok=ok, bad=Verdict.FAIL)]
    release = f"`tactile-cell hand release{named} --confirm`"
    advice = f"a part may be in the grip: release it with {release}"
    if any(condition.shut_down for condition in limp):
        advice += f", then clear the error with {clear}"
    return [check_result(_TORQUE, texts, advice, bad=Verdict.FAIL if limp else Verdict.WARN)]


def _servos(cell: Cell, named: str, earlier: Commissioning) -> list[Finding]:
    rows = cell.controller.hand.inspect().rows
    read = {(row.servo_id, row.item): row.actual for row in rows}
    # Of another model only the number is read: that is a finding below.
    servos = {
        servo_id: (model_name(int(read[servo_id, "model_number"])), int(firmware))
        for (servo_id, item), firmware in read.items()
        if item == "firmware_version"
    }
    findings = earlier.changed_servos(servos)
    for row in rows:
        value = f"{row.actual} (expected {row.expected})"
        if row.item == "shutdown":
            value += f", {overload_text(int(row.actual))}"
        bad = Verdict.WARN if row.item in CORRECTABLE else Verdict.FAIL
        what = f"servo {row.servo_id} {row.item}"
        findings.append(check_result(what, value, _advice(row, named), ok=row.ok, bad=bad))
    return findings


def _advice(row: VerificationRow, named: str) -> str:
    if row.item == "hardware_error_status":
        return f"remedy its cause, then `tactile-cell hand clear{named} --reboot`"
    if row.item == POSITION_ITEM:
        return (
            "look at the finger: if it is on its own side of the middle, one of these keys is "
            "wrong; else push it there by hand"
        )
    if row.item in CORRECTABLE:
        return _AT_START
    if row.item == "model_number":
        return f"correct the config; {_NEW_SERVO}"
    return "correct it with the servo maker's wizard, or correct the config"


def _control_unit(
    cell: Cell, config: CellConfig, named: str, earlier: Commissioning
) -> list[Finding]:
    hand = cell.controller.hand
    is_unit = config.tactile.sensor.canopen
    try:
        identity = hand.start_sensor()
    except IdentityMismatch as error:
        advice = f"check unit and pads; for new ones `{earlier.command} --redo unit`"
        return [check_result("control unit", str(error), advice, bad=Verdict.FAIL)]
    readings = [hand.read_sensor(timeout_s=1.0) for _ in range(10)]
    frames = np.stack([reading.frame.counts for reading in readings])
    n_saturated, n_taxels = int(readings[-1].saturated.sum()), frames.shape[1]
    n_moving = int(np.count_nonzero(np.ptp(frames, axis=0)))
    source = hand.statistics.source
    forces, statistics = source.forces, source.frames
    lost = statistics.lost + statistics.torn + statistics.corrupt
    number = ""
    if is_unit:
        number = f", serial {identity.serial}, revision {identity.revision:#x}, boards of the pads "
        number += " and ".join(map(str, identity.boards))
    from_frames = f"{identity.name} sends frames alone; the force comes from them"
    return [
        *earlier.changed_unit(identity),
        check_result("control unit" if is_unit else "sensor", f"{identity.name}{number}", ok=True),
        check_result(
            "tactile frames",
            f"{statistics.complete} whole, {lost} lost or damaged",
            "check the terminating resistors and the bus load" if is_unit else "check the cables",
            ok=lost == 0,
        ),
        check_result(
            "force messages",
            f"{forces.received} received, {forces.lost} lost"
            if identity.sends_forces
            else (FORCE_FROM_FRAMES if is_unit else from_frames),
            ok=(identity.sends_forces or not is_unit) and not forces.lost,
        ),
        check_result(
            "taxels at rest",
            f"{n_saturated} of {n_taxels} saturated",
            "is something touching the pads?",
            ok=not n_saturated,
        ),
        _load(frames, config, named),
        check_result(
            "noise of the taxels",
            f"{n_moving} of {n_taxels} change at rest",
            "without noise, frozen, dead and stuck taxels are detected only while the force "
            "changes: press each pad once and check that its force follows",
            ok=n_moving >= n_taxels // 2,
        ),
    ]


def _axes(cell: Cell) -> Iterator[Finding]:
    """Read the state of each drive and servo of the positioner, without setting it up or moving it.

    The first motion after an acknowledgement clears a fault.
    """
    for name, state in ({} if cell.axes is None else cell.axes.inspect()).items():
        lost = isinstance(state, MotionError)
        fault = lost or "FAULT" in str(state) or "hardware error" in str(state)
        advice = "remedy the cause; after clear and reset the next motion resets the device"
        if isinstance(state, AxisMissing | AxisSilent):
            advice = "check its supply, cable and node-ID or ID"
        yield check_result(name, str(state), advice, ok=not fault, bad=Verdict.FAIL)


def _load(frames: NDArray[np.uint16], config: CellConfig, named: str) -> Finding:
    """Check whether the pads are pressed, without a zero: compare with the most frequent counts.

    Half a contact force is already a part: taxels that are pressed a little are not in the sum.
    ``frames`` are (n, n_taxels) counts.
    """
    layout = layout_from_config(config.tactile)
    counts = frames.mean(axis=0)
    rest = float(np.median(counts))
    spread = 1.4826 * float(np.median(np.abs(counts - rest)))
    over = np.where(counts - rest > _PRESSED_SIGMAS * spread + 1.0, counts - rest, 0.0)
    first_n, second_n = layout.on_fingers(make_calibration(config.tactile, layout).force_n(over))
    return check_result(
        "pads' force",
        f"about {first_n:.1f} N on finger 0, {second_n:.1f} N on finger 1, without a zero",
        "a part may be held; look. If the servos answer, release it with "
        f"`tactile-cell hand release{named} --confirm`",
        ok=max(first_n, second_n) < config.gripper.contact_force_n / 2,
    )
