"""Baseline: measurement of a gauge object in the new cell, and changes since then.

`tactile-cell doctor` compares with it. Each difference names the steps to repeat.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from cell.checks.findings import (
    Finding,
    Notes,
    ProposedChange,
    Verdict,
    check_result,
    kept_values,
)
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Question, Step, StepFailed
from cell.commissioning.motion import WatchedHand, watched_hand
from cell.commissioning.pads import taxel_names
from cell.config.model import CellConfig
from cell.config.sequence import ramp_from_config
from cell.config.tactile import layout_from_config, make_calibration
from cell.control.records import GraspCollector, pad_array
from cell.errors import CellError
from cell.learning.shape_reading import in_words, shape_reader
from gripper.dynamixel.models import model_name
from gripper.errors import GripperError
from gripper.values.outcome import GraspResult
from recognition.shape.answer import UNCLEAR
from tactile.control_unit.search import read_unit
from tactile.errors import TactileError
from tactile.layout import PadMount, TaxelLayout, taxel_order
from tactile.sensor.tare import assess_health
from tactile.sensor.taxel_forces import TaxelForces
from tactile.source import SourceIdentity

_HOLD_S = 0.5
"""Time in s for which the gauge object is held and measured."""
_OPENING_MM = 0.3
"""Reported difference of the opening in mm. Placing the object by hand gives less: a box tilted by
1 degree over 15 mm is 0.26 mm wider."""
_FINGERS_SHARE = 0.15
"""Reported change of the difference of both fingers' forces, as a share of the grip force."""
_CURRENT_SHARE = 0.3
"""Reported change of the motors' current at the same force, as a share; more means wear."""
_ZERO_SHARE = 0.03
"""Reported change of a pad's zero, as a share of the full scale; drift of hours is a third of it.
"""
_NOISE_FACTOR = 2.0
"""Reported noise of a pad, as a multiple of its noise at commissioning."""
_LEAST_NOISE = 1.0
"""Noise in counts; smaller values are raised to it before the factor applies."""

Found = Mapping[str, Mapping[str, Any]]
"""Values of the findings by the key of the step."""


def _change(
    what: str, step: str, was: Any, now: Any, text: str = "{}", *, differs: bool | None = None
) -> list[Finding]:
    """Return the change of one value; empty if it is equal, or if ``differs`` is false.

    ``text`` formats both values; ``step`` is the step to repeat.
    """
    if (was == now) if differs is None else not differs:
        return []
    found = f"{text.format(now)}, at commissioning {text.format(was)}"
    return [Finding(what=what, verdict=Verdict.WARN, found=found, step=step)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Gauge:
    """Measured values of a gauge object."""

    gauge: str
    """Name of the object."""
    force_n: float
    """Requested force in N."""
    held_n: tuple[float, float]
    """Force on finger 0 and 1 during the hold, in N."""
    contact_mm: float
    held_mm: float
    """Opening at the contact and during the hold, in mm."""
    current_ma: float
    """Mean goal current of the motors during the hold, in mA."""
    patch_taxels: tuple[int, int]
    """Touched taxels of the inner pad of finger 0 and 1."""


def changed_unit(found: Found, now: SourceIdentity) -> list[Finding]:
    """Return the differences of a control unit and its pads from the commissioning."""
    unit, pads = found.get("unit", {}), found.get("pads_at_rest", {})
    serial, revision = unit.get("serial_number", now.serial), unit.get("revision", now.revision)
    firmware = "firmware of the control unit"
    changes = _change("control unit", "unit", serial, now.serial, "serial {}")
    changes = changes or _change(firmware, "unit", revision, now.revision, "revision {:#x}")
    was = tuple(pads.get("board_serial_numbers", now.boards))
    if was == now.boards[::-1] != now.boards:
        both = f"serial {was[0]} on finger 0, {was[1]} on finger 1"
        return changes + _change("pads", "pads_at_rest", both, "exchanged")
    for finger in (0, 1):
        what, number = f"pads of finger {finger}", now.boards[finger]
        changes += _change(what, "pads_at_rest", was[finger], number, "serial {}")
    return changes


def changed_servos(found: Found, servos: Mapping[int, tuple[str, int]]) -> list[Finding]:
    """Return the differences of servos from the commissioning; ``servos``: model, firmware."""
    changes = []
    for was in found.get("servos", {}).get("servos", ()):
        before = (was["model"], was["firmware"])
        now = servos.get(was["id"], before)
        changes += _change(f"servo {was['id']}", "servos", before, now, "{0[0]}, firmware {0[1]}")
    return changes


def changed_pads(
    found: Found,
    layout: TaxelLayout,
    frames: NDArray[np.uint16],
    mounts: Sequence[PadMount] = (),
) -> list[Finding]:
    """Return the differences of pads at rest from the commissioning.

    Parameters
    ----------
    found
        Values of the findings by the key of the step.
    layout, frames
        The taxels, and at least 8 frames (n, n_taxels) without contact.
    mounts
        Mounting of the pads; the findings at rest are in the order of the unit's samples.
    """
    was = found.get("pads_at_rest", {})
    if len(was.get("zero_counts", ())) != layout.n_pads:
        return []
    zero, noise = frames.mean(axis=0), frames.std(axis=0)
    sent_as = {mount.pad: mount.sent_as for mount in mounts}
    known = np.isin(taxel_order(layout, mounts), was["bad_taxels"])
    bad = assess_health(frames, layout.adc_max).bad
    new = np.flatnonzero(bad & ~known).tolist()
    step, changes = "pads_at_rest", []
    if new:
        broken = f"{np.count_nonzero(bad)}, new: {taxel_names(layout, new)}"
        was_broken = str(len(was["bad_taxels"]))
        changes += _change("broken taxels", step, was_broken, broken)
    for number, pad in enumerate(layout.pads):
        taxels, place = layout.taxels_of(number), sent_as.get(number, number)
        before, now = was["zero_counts"][place], float(np.median(zero[taxels]))
        drifted = abs(now - before) > _ZERO_SHARE * layout.adc_max
        text = "{:.1f} counts"
        changes += _change(f"zero of {pad.name}", step, before, now, text, differs=drifted)
        before, now = was["noise_counts"][place], float(np.median(noise[taxels]))
        noisy = now > _NOISE_FACTOR * max(before, _LEAST_NOISE)
        changes += _change(f"noise of {pad.name}", step, before, now, text, differs=noisy)
    return changes


def changed_gauge(was: Gauge, now: Gauge) -> list[Finding]:
    """Return the differences of the gauge object from the commissioning."""
    ratio = [(one.held_n[0] - one.held_n[1]) / (0.5 * sum(one.held_n)) for one in (was, now)]
    text = "{:.2f} mm"
    forces, other = "{0[0]:.2f} and {0[1]:.2f} N", abs(ratio[1] - ratio[0]) > _FINGERS_SHARE
    worn = abs(now.current_ma - was.current_ma) > _CURRENT_SHARE * was.current_ma
    changes = []
    for what, name in (("at the contact", "contact_mm"), ("on the gauge object", "held_mm")):
        before, after = getattr(was, name), getattr(now, name)
        moved = abs(after - before) > _OPENING_MM
        changes += _change(f"opening {what}", "fingers", before, after, text, differs=moved)
    what = "forces of both fingers"
    changes += _change(what, "pads_law", was.held_n, now.held_n, forces, differs=other)
    what = "current of the motors at the same force (friction, or another law of the pads)"
    text = "{:.0f} mA"
    changes += _change(what, "pads_law", was.current_ma, now.current_ma, text, differs=worn)
    return changes


def since_commissioning(
    folder: Path, found: Found, what: str, changes: Sequence[Finding]
) -> list[Finding]:
    """Return the changes with advice, or one finding without any; empty without ``found``."""
    if not found:
        return []
    place = "" if folder == Path() else f" {quote(str(folder))}"
    command = f"`tactile-cell commission{place} --redo"
    return [
        replace(change, advice=f"{command} {change.step}` repeats the steps it affects")
        for change in changes
    ] or [check_result(what, "as at commissioning", ok=True)]


def changed_hardware(bench: Bench) -> list[Finding]:
    """Read the identity of unit and servos of a bench, and return the changes.

    A line that cannot be opened or is silent is skipped: its own step finds the cause.
    """
    changes: list[Finding] = []
    if "serial_number" in bench.found.get("unit", {}):
        with suppress(TactileError), bench.can_bus() as can_bus:
            unit = read_unit(can_bus, bench.tactile().node_id)
            changes += changed_unit(bench.found, unit.identity)
    if "servos" in bench.found:
        with suppress(GripperError), bench.servo_bus() as servo_bus:
            pings = [servo_bus.ping(servo.id) for servo in bench.gripper().servos]
            servos = {p.servo_id: (model_name(p.model_number), p.firmware) for p in pings}
            changes += changed_servos(bench.found, servos)
    return changes


def keep_gauge(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Grasp a stiff object that you keep for it, and store opening, forces, current and patches.

    `tactile-cell doctor --gauge` later shows what has changed.
    """
    text = (
        "Take a stiff object with parallel faces, as a block of 10 to 20 mm, and mark it as the "
        "gauge of this cell. What is its name?"
    )
    name = dialog.ask(Question(key="baseline.name", text=text, default="gauge block"))
    gauge = measure_gauge(bench, bench.config, dialog, str(name))
    notes.fact(
        f"{gauge.gauge} at {gauge.force_n:g} N: {gauge.held_n[0]:.2f} and {gauge.held_n[1]:.2f} N, "
        f"opening {gauge.held_mm:.2f} mm, {gauge.current_ma:.0f} mA, {gauge.patch_taxels[0]} and "
        f"{gauge.patch_taxels[1]} taxels touched. Keep this object with the cell."
    )
    notes.values["gauge"] = asdict(gauge)


BASELINE = Step(keep_gauge, "baseline", "Gauge object", needs=("first_force",), needs_pads=True)


def measure_gauge(bench: Bench, config: CellConfig, dialog: Dialog, gauge: str) -> Gauge:
    """Grasp the gauge object of this name once and release it; return its measurement.

    Raises
    ------
    WizardAborted
        When the person leaves; a held part stays held.
    StepFailed
        When nothing is held, or a part without parallel faces.
    CellError, GripperError, TactileError
        As the hand raises them.
    """
    layout = layout_from_config(config.tactile)
    force_n = round(float(np.mean(config.sequence.forces_n)), 2)
    after = f"{config.gripper.aperture_open_mm:g} mm open, then {force_n:g} N"
    what, undo = f"open, then grasp {gauge}", "they open when you confirm it, then have no torque"
    dialog.approve([ProposedChange("both fingers", what, "where they stand", after, undo)])
    dialog.confirm("baseline.empty", "Take everything out of the fingers, and your hands away.")
    with watched_hand(bench, config, dialog) as motion:
        hand = motion.hand
        hand.start_sensor()
        hand.open(motion)
        zero = hand.tare(config.tactile.tare_frames)
        motion.ask(
            "baseline.place",
            f"Hold {gauge} in the middle between the pads, until the fingers hold it.",
        )
        motion.periods.clear()
        outcome = hand.grasp(ramp_from_config(config.sequence.ramp, force_n), motion)
        collected = GraspCollector(pad_array(layout), source=gauge, start_ms=0)
        for cycle, frames in motion.periods:
            collected.add(cycle, frames)
        if outcome.result is not GraspResult.FORCE_REACHED:
            if outcome.result is GraspResult.FORCE_NOT_REACHED:
                _let_go(motion)
            raise StepFailed(
                f"{gauge} was not gripped ({outcome.result.value}): hold it in the middle between "
                "the pads, and run the step again"
            )
        held = motion.hold(force_n, _HOLD_S)
        _let_go(motion)
    read_shape = shape_reader(config)
    shape = read_shape(collected.grasp()) if read_shape else None
    if shape is not None and shape.kind not in ("flat", UNCLEAR):
        raise StepFailed(
            f"The pads show {in_words(shape)}, but the gauge needs parallel faces: take a block, "
            "hold it with two of its faces on the pads, and run the step again"
        )
    forces = TaxelForces(layout, make_calibration(config.tactile, layout), zero)
    shown_n = [forces.of(frame.counts) for _, frames in held for frame in frames]
    taxel_force_n = np.mean(shown_n, axis=0)
    first, second = (
        int(np.count_nonzero(taxel_force_n[layout.taxels_of(pad)] > 0.0))
        for pad in layout.gripping_pads
    )
    cycles = [cycle for cycle, _ in held]
    samples = [one.force.force_n for one in cycles if one.force is not None and one.force.valid]
    return Gauge(
        gauge=gauge,
        force_n=force_n,
        held_n=(_mean(n for n, _ in samples), _mean(n for _, n in samples)),
        contact_mm=round(1e3 * (outcome.contact_aperture_m or 0.0), 3),
        held_mm=_mean(1e3 * one.state.aperture_m for one in cycles),
        current_ma=_mean(1e3 * one.goal_current_a for one in cycles),
        patch_taxels=(first, second),
    )


def gauge_again(bench: Bench, config: CellConfig, dialog: Dialog) -> list[Finding]:
    """Grasp the gauge object of the commissioning again, and return the differences.

    The bench is that of the commissioning. The dialog shows each motion before it starts, and asks
    for the object.

    Raises
    ------
    CellError
        If there is no gauge object, or it was not gripped; `WizardAborted` when the person leaves.
    GripperError, TactileError
        As the hand raises them.
    """
    found = kept_values(bench.folder)
    if (kept := found.get("baseline", {}).get("gauge")) is None:
        raise CellError(
            f"no gauge object was kept in {bench.folder}: finish `tactile-cell commission` first"
        )
    was = TypeAdapter(Gauge).validate_python(kept)
    changes = changed_gauge(was, measure_gauge(bench, config, dialog, was.gauge))
    return since_commissioning(bench.folder, found, f"gauge object {was.gauge}", changes)


def _let_go(motion: WatchedHand) -> None:
    motion.ask("baseline.release", "Take hold of the object; the fingers open then.")
    motion.hand.release()


def _mean(values: Iterable[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return round(float(np.mean(known)), 4) if known else 0.0
