"""Baseline: how a gauge object feels in the new cell, and what has changed since then.

`tactile-cell doctor` compares with it. What differs names the steps that are to be done again.
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

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Finding, ProposedChange, Question, Step, StepFailed
from cell.commissioning.figures import pads as pads_figure
from cell.commissioning.motion import look_after, watched_hand
from cell.commissioning.pads import taxel_names
from cell.commissioning.servos import model_name
from cell.config.model import CellConfig
from cell.config.sequence import ramp_from_config
from cell.config.tactile import layout_from_config, make_calibration
from cell.hand.interface import Hand
from gripper.clock import Clock
from gripper.errors import GripperError
from gripper.values.outcome import GraspResult
from tactile.errors import TactileError
from tactile.layout import PadMount, TaxelLayout, taxel_order
from tactile.sensor.tare import assess_health
from tactile.sensor.taxel_forces import TaxelForces
from tactile.unit.search import read_unit

_HOLD_S = 0.5
"""Time in s for which the gauge object is held and measured."""
_OPENING_MM = 0.3
"""Difference of the opening in mm that placing a gauge object by hand does not make: a box that
stands askew by 1 degree over 15 mm is 0.26 mm wider."""
_FINGERS_SHARE = 0.15
"""Difference of both fingers' forces, as a share of the grip force, that is none in equilibrium."""
_CURRENT_SHARE = 0.3
"""Change of the motors' current at the same force: friction that grows by more wears something."""
_ZERO_SHARE = 0.03
"""Change of the zero of a pad, as a share of the full scale: drift of hours is a third of it."""
_NOISE_FACTOR = 2.0
"""Noise of a pad over that at commissioning from which it is worth a word."""
_LEAST_NOISE = 1.0
"""Noise in counts below which the factor means nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """Something that is not as it was at commissioning."""

    what: str
    was: str
    found: str
    """What it is, how it was, and how it was found."""
    step: str
    """Key of the step that is to be done again, with all that needs it."""

    def advice(self, folder: Path) -> str:
        """Return what to do with the commissioning in a folder."""
        place = "" if folder == Path() else f" {quote(str(folder))}"
        return f"`tactile-cell commission{place} --redo {self.step}` does what depends on it again"


def _change(
    what: str, step: str, was: Any, now: Any, text: str, *, differs: bool | None = None
) -> list[Change]:
    """Return the change of one value, none where it is equal, or ``differs`` denies it.

    ``text`` formats the value as it was and as it is.
    """
    if (was == now) if differs is None else not differs:
        return []
    return [Change(what=what, was=text.format(was), found=text.format(now), step=step)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Gauge:
    """How a gauge object felt."""

    gauge: str
    """Its name, as the person typed it."""
    force_n: float
    """Force asked for in N."""
    held_n: tuple[float, float]
    """Force on finger 0 and 1 while it was held, in N."""
    contact_mm: float
    held_mm: float
    """Opening at the contact and while it was held, in mm."""
    current_ma: float
    """Mean goal current of the motors while it was held, in mA."""
    patch_taxels: tuple[int, int]
    """Touched taxels of the inner pad of finger 0 and 1."""


def changed_unit(
    found: Mapping[str, Mapping[str, Any]],
    *,
    serial: int,
    revision: int,
    boards: tuple[int, int],
) -> list[Change]:
    """Return how a control unit and its pads differ from those that were commissioned.

    ``found`` has the values of the findings by the key of the step; the rest is of the unit that
    answers now.
    """
    unit, pads = found.get("unit", {}), found.get("pads_at_rest", {})
    was_serial, was_revision = unit.get("serial_number", serial), unit.get("revision", revision)
    firmware = "firmware of the control unit"
    changes = _change("control unit", "unit", was_serial, serial, "serial {}") or _change(
        firmware, "unit", was_revision, revision, "revision {:#x}"
    )
    step, was = "pads_at_rest", tuple(pads.get("board_serial_numbers", boards))
    if was == boards[::-1] != boards:
        both = f"serial {was[0]} on finger 0, {was[1]} on finger 1"
        return [*changes, Change(what="pads", was=both, found="exchanged", step=step)]
    for finger in (0, 1):
        changes += _change(
            f"pads of finger {finger}", step, was[finger], boards[finger], "serial {}"
        )
    return changes


def changed_servos(
    found: Mapping[str, Mapping[str, Any]], servos: Mapping[int, tuple[str, int]]
) -> list[Change]:
    """Return how servos differ from those that were commissioned; ``servos``: model, firmware."""
    changes = []
    for was in found.get("servos", {}).get("servos", ()):
        before = (was["model"], was["firmware"])
        now = servos.get(was["id"], before)
        changes += _change(f"servo {was['id']}", "servos", before, now, "{0[0]}, firmware {0[1]}")
    return changes


def changed_pads(
    found: Mapping[str, Mapping[str, Any]],
    layout: TaxelLayout,
    frames: NDArray[np.uint16],
    mounts: Sequence[PadMount] = (),
) -> list[Change]:
    """Return how pads at rest differ from those that were commissioned.

    Parameters
    ----------
    found
        Values of the findings by the key of the step.
    layout, frames
        The taxels, and frames (n, n_taxels) that nothing touched, at least 8.
    mounts
        How pads sit; what was found at rest is in the order in which the unit sends them.
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
        changes.append(Change(what="broken taxels", was=was_broken, found=broken, step=step))
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


def changed_gauge(was: Gauge, now: Gauge) -> list[Change]:
    """Return how the gauge object feels otherwise than at commissioning."""
    changes = []
    for what, before, after in (
        ("opening at the contact", was.contact_mm, now.contact_mm),
        ("opening on the gauge object", was.held_mm, now.held_mm),
    ):
        moved = abs(after - before) > _OPENING_MM
        changes += _change(what, "fingers", before, after, "{:.2f} mm", differs=moved)
    ratio = [(one.held_n[0] - one.held_n[1]) / (0.5 * sum(one.held_n)) for one in (was, now)]
    changes += _change(
        "forces of both fingers",
        "pads_law",
        was.held_n,
        now.held_n,
        "{0[0]:.2f} and {0[1]:.2f} N",
        differs=abs(ratio[1] - ratio[0]) > _FINGERS_SHARE,
    )
    current = _change(
        "current of the motors at the same force",
        "pads_law",
        was.current_ma,
        now.current_ma,
        "{:.0f} mA",
        differs=abs(now.current_ma - was.current_ma) > _CURRENT_SHARE * was.current_ma,
    )
    cause = "friction, or another law of the pads"
    changes += [replace(one, found=f"{one.found}: {cause}") for one in current]
    return changes


def gauge_of(found: Mapping[str, Mapping[str, Any]]) -> Gauge | None:
    """Return the gauge object of the commissioning; None where there is none."""
    values = found.get("baseline", {}).get("gauge")
    return None if values is None else TypeAdapter(Gauge).validate_python(values)


def changed_hardware(bench: Bench) -> list[Change]:
    """Ask unit and servos of a bench who they are, and return who is not whom it was.

    A line that cannot be opened or is silent tells nothing here: its own step finds out why.
    """
    changes: list[Change] = []
    if "serial_number" in bench.found.get("unit", {}):
        with suppress(TactileError), bench.can_bus() as can_bus:
            identity = read_unit(can_bus, bench.tactile().node_id).identity
            changes += changed_unit(
                bench.found,
                serial=identity.serial,
                revision=identity.revision,
                boards=identity.boards,
            )
    if "servos" in bench.found:
        with suppress(GripperError), bench.servo_bus() as servo_bus:
            pings = [servo_bus.ping(servo.id) for servo in bench.gripper().servos]
            servos = {p.servo_id: (model_name(p.model_number), p.firmware) for p in pings}
            changes += changed_servos(bench.found, servos)
    return changes


class BaselineStep(Step):
    """Grasps a gauge object and keeps how it felt, for `tactile-cell doctor` to compare."""

    key = "baseline"
    title = "Gauge object"
    purpose = (
        "Grasps a stiff object that you keep for it, and notes opening, forces, current and "
        "patches: from then on `tactile-cell doctor --gauge` says whether the cell is as it was."
    )
    needs = ("first_force",)
    needs_pads = True
    undo = "nothing is written; the torque goes off at the end"

    def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
        """Grasp the gauge object, and keep how it felt."""
        gauge, force_on_taxels_n = measure_gauge(bench, bench.config, dialog)
        layout = layout_from_config(bench.config.tactile)
        notes.fact(
            f"{gauge.gauge} at {gauge.force_n:g} N: {gauge.held_n[0]:.2f} and "
            f"{gauge.held_n[1]:.2f} N, opening {gauge.held_mm:.2f} mm, {gauge.current_ma:.0f} mA, "
            f"{gauge.patch_taxels[0]} and {gauge.patch_taxels[1]} taxels touched. Keep this object "
            "with the cell."
        )
        notes.values["gauge"] = asdict(gauge)
        title = "The gauge object on the pads"
        notes.figures["patch"] = pads_figure(title, layout, force_on_taxels_n, unit="N")


def measure_gauge(
    bench: Bench, config: CellConfig, dialog: Dialog, gauge: str | None = None
) -> tuple[Gauge, NDArray[np.float64]]:
    """Grasp the gauge object once and let go; returns how it felt, and the force on each taxel.

    Without a name of the gauge it asks for it.

    Raises
    ------
    WizardAborted
        When the person leaves; a part that is held then stays held.
    StepFailed
        When nothing is held.
    CellError, GripperError, TactileError
        As the hand raises them.
    """
    if gauge is None:
        gauge = str(
            dialog.ask(
                Question(
                    key="baseline.name",
                    text="Take a stiff object with parallel faces, as a block of 10 to 20 mm, and "
                    "mark it as the gauge of this cell. What is its name?",
                    default="gauge block",
                )
            )
        )
    force_n = round(float(np.mean(config.sequence.forces_n)), 2)
    opening = f"{config.gripper.aperture_open_mm:g} mm open"
    dialog.approve(
        [
            ProposedChange(
                where="both fingers",
                what=f"open, then grasp {gauge}",
                before="where they stand",
                after=f"{opening}, then {force_n:g} N",
                undo="they open when you confirm it; the torque goes off at the end",
            )
        ]
    )
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
        outcome = hand.grasp(ramp_from_config(config.sequence.ramp, force_n), motion)
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
    layout = layout_from_config(config.tactile)
    forces = TaxelForces(layout, make_calibration(config.tactile, layout), zero)
    force_on_taxels_n = np.mean([forces.of(frame.counts) for frame in frames], axis=0)
    touched = [
        int(np.count_nonzero(force_on_taxels_n[layout.taxels_of(pad)] > 0.0))
        for pad in layout.gripping_pads
    ]
    samples = [one.force.force_n for one in held if one.force is not None and one.force.valid]
    felt = Gauge(
        gauge=gauge,
        force_n=force_n,
        held_n=(_mean(n for n, _ in samples), _mean(n for _, n in samples)),
        contact_mm=round(1e3 * (outcome.contact_aperture_m or 0.0), 3),
        held_mm=_mean(1e3 * one.state.aperture_m for one in held),
        current_ma=_mean(1e3 * one.goal_current_a for one in held),
        patch_taxels=(touched[0], touched[1]),
    )
    return felt, force_on_taxels_n


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
