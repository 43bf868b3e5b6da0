"""Baseline: measurement of a gauge object in the new cell, and changes since then.

`tactile-cell doctor` compares with it. Each difference names the steps to repeat.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict

import numpy as np

from cell.checks.changes import (
    CommissionedValues,
    Gauge,
    changed_gauge,
    changed_servos,
    changed_unit,
    gauge_of,
)
from cell.checks.findings import Finding, Notes, ProposedChange, kept_values
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Question, Step, StepFailed
from cell.commissioning.motion import look_after, watched_hand
from cell.config.model import CellConfig
from cell.config.sequence import ramp_from_config
from cell.config.tactile import layout_from_config, make_calibration
from cell.control.records import GraspCollector, pad_array
from cell.errors import CellError
from cell.hand.interface import Hand
from cell.learning.shape_reading import in_words, shape_reader
from gripper.clock import Clock
from gripper.dynamixel.models import model_name
from gripper.errors import GripperError
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle
from recognition.shape.answer import UNCLEAR
from tactile.control_unit.search import read_unit
from tactile.errors import TactileError
from tactile.sensor.taxel_forces import TaxelForces
from tactile.source import TactileFrame

_HOLD_S = 0.5
"""Time in s for which the gauge object is held and measured."""


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
    with watched_hand(bench, config, dialog) as (hand, motion):
        hand.start_sensor()
        hand.open(motion)
        zero = hand.tare(config.tactile.tare_frames)
        dialog.confirm(
            "baseline.place",
            f"Hold {gauge} in the middle between the pads, until the fingers hold it.",
            watch=lambda: look_after(hand, bench.clock),
        )
        collected = GraspCollector(pad_array(layout), source=gauge, start_ms=0)

        def watch(cycle: Cycle, frames: Sequence[TactileFrame] = ()) -> None:
            motion(cycle, frames)
            collected.add(cycle, frames)

        outcome = hand.grasp(ramp_from_config(config.sequence.ramp, force_n), watch)
        if outcome.result is not GraspResult.FORCE_REACHED:
            if outcome.result is GraspResult.FORCE_NOT_REACHED:
                _let_go(hand, bench.clock, dialog)
            raise StepFailed(
                f"{gauge} was not gripped ({outcome.result.value}): hold it in the middle between "
                "the pads, and run the step again"
            )
        since = len(motion.cycles), len(motion.frames)
        hand.hold_at(force_n, _HOLD_S, motion)
        held, frames = motion.cycles[since[0] :], motion.frames[since[1] :]
        _let_go(hand, bench.clock, dialog)
    read_shape = shape_reader(config)
    shape = read_shape(collected.grasp()) if read_shape else None
    if shape is not None and shape.kind not in ("flat", UNCLEAR):
        raise StepFailed(
            f"The pads show {in_words(shape)}, but the gauge needs parallel faces: take a block, "
            "hold it with two of its faces on the pads, and run the step again"
        )
    forces = TaxelForces(layout, make_calibration(config.tactile, layout), zero)
    taxel_force_n = np.mean([forces.of(frame.counts) for frame in frames], axis=0)
    first, second = (
        int(np.count_nonzero(taxel_force_n[layout.taxels_of(pad)] > 0.0))
        for pad in layout.gripping_pads
    )
    samples = [one.force.force_n for one in held if one.force is not None and one.force.valid]
    return Gauge(
        gauge=gauge,
        force_n=force_n,
        held_n=(_mean(n for n, _ in samples), _mean(n for _, n in samples)),
        contact_mm=round(1e3 * (outcome.contact_aperture_m or 0.0), 3),
        held_mm=_mean(1e3 * one.state.aperture_m for one in held),
        current_ma=_mean(1e3 * one.goal_current_a for one in held),
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
    kept = CommissionedValues(folder=bench.folder, found=kept_values(bench.folder))
    was = gauge_of(kept.found)
    if was is None:
        raise CellError(
            f"no gauge object was kept in {bench.folder}: finish `tactile-cell commission` first"
        )
    now = measure_gauge(bench, config, dialog, was.gauge)
    return kept.findings(f"gauge object {was.gauge}", changed_gauge(was, now))


def _let_go(hand: Hand, clock: Clock, dialog: Dialog) -> None:
    dialog.confirm(
        "baseline.release",
        "Take hold of the object; the fingers open then.",
        watch=lambda: look_after(hand, clock),
    )
    hand.release()


def _mean(values: Iterable[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return round(float(np.mean(known)), 4) if known else 0.0
