"""One grasp of a sequence: move to its pose, grasp, record, then release or keep the part."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from statistics import fmean
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cell.config.gripper import GripperConfig
from cell.config.model import CellConfig
from cell.config.sequence import ramp_from_config
from cell.control.answer import Verification
from cell.control.journal import Journal
from cell.control.keeping import (
    HELD_LOOK_S,
    HeldPart,
    Judge,
    compared,
    measure_held_part,
    open_counts,
    spliced,
)
from cell.control.lifecycle import CellLifecycle
from cell.control.plan import GraspStep, Pose
from cell.control.positioner import PatientCaller, Positioner
from cell.control.records import GraspCollector, GraspRecord, pad_array
from cell.control.self_zero import (
    SelfZeros,
    dead_taxels_text,
    drive_text,
    part_between,
    unsound,
    zero_text,
)
from cell.data.grasp_limits import text_refused
from cell.errors import CellStateError, NoPartFound, PlanRefused, ZeroRefused
from cell.hand.interface import Hand, OnPeriod
from gripper.clock import Clock
from gripper.dynamixel.drive import DriveReport, pad_gain
from gripper.dynamixel.models import MODELS
from gripper.errors import PartBetweenFingers
from gripper.force.ramp import ForceRamp
from gripper.mechanics.kinematics import Linkage
from gripper.values.outcome import GraspOutcome, GraspResult
from gripper.values.state import Cycle
from recognition.drift.self_zero import ZeroMeasurement, anchored, measure_zero, shows_part
from recognition.grasp import CELL_SOURCE, PadArray, SelfZero
from recognition.recognizers.early_classifiers import EarlyDecider
from tactile.source import TactileFrame

_T = TypeVar("_T")

NOTHING_HELD = {
    GraspResult.NO_CONTACT: "no contact",
    GraspResult.PART_LOST: "the part was lost while the fingers pressed",
}
"""Results of a grasp that holds nothing and cannot be used for recognition."""


BACK_OFF_SHARE = 0.3
"""Start of a further ramp in the same grip, as a share of its end: the lowest level of load at
which a recogniser takes footprints (`recognition.ramp.levels`)."""

LEAST_CONTACTS = 2.0
"""Least start of a further ramp, in contact forces. A part held with one contact force is sometimes
reported as lost (simulated cell, twice the noise)."""

_ZERO_FORCE_N, _ZERO_RATE_N_S = 10.0, 5.0
"""Force in N with which the empty fingers press on each other, and its rate in N/s. Two pads of 55
x 20 mm yield 0.36 mm together, and a ramp of two seconds shows this on each taxel."""
_BORNE_SHARE = 0.9
"""Share of the force of the whole current that grasps go to: the rest is for control."""
_LOOK_FRAMES, _LOOKS_UP_TO_N = 3, 5.0
"""Frames between two checks for a part between the fingers, up to that set-point in N."""


@dataclass(kw_only=True)
class Grasper:
    """Carries out grasps with hand and positioner, and records them."""

    config: CellConfig
    hand: Hand
    positioner: Positioner
    life: CellLifecycle
    """Has requested stops and the states to record."""
    journal: Journal
    zeros: SelfZeros
    """The newest self-zero, which each grasp includes."""
    clock: Clock
    take_zero: Callable[[int], object]
    """Takes the zero of the taxels from a number of frames."""

    def __post_init__(self) -> None:
        self.homing: dict[int, int] = {}
        """Homing offset of each servo, by its ID, as of the last start."""
        self._source = CELL_SOURCE + self.config.name
        self._gripper, self._sequence = self.config.gripper, self.config.sequence
        self._held: tuple[NDArray[np.float64], HeldPart] | None = None
        self._last_start_ms = 0
        self._opening_step_m = _opening_step_m(self.config.linkage, self._gripper)
        self._catalogue_n_a = _catalogue_n_a(self.config.linkage, self._gripper)
        self._catalogue_n, self._noted_n = self.config.largest_ramp_n, inf
        self._patient = PatientCaller(self.clock, self.hand.period_s)
        self.pads: PadArray = pad_array(self.hand.layout)

    def check(self, step: GraspStep, label: str = "") -> None:
        """Refuse a step that cannot be carried out, before anything moves.

        Raises PlanRefused if it is not a step or the label is invalid. Raises
        gripper.errors.LimitExceeded if its force is not a number or beyond a limit.
        """
        if not (isinstance(step, GraspStep) and isinstance(step.pose, Pose)):
            raise PlanRefused(
                f"{step!r} is not a step of a plan; give GraspStep(pose=..., force_n=...)"
            )
        if not isinstance(label, str):
            raise PlanRefused(f"{label!r} is not a label; give a text")
        if wrong := text_refused("label", label):
            raise PlanRefused(f"the label {wrong}")
        self.hand.check_ramp(self._ramp(self._borne(step)))

    def _ramp(self, step: GraspStep) -> ForceRamp:
        return ramp_from_config(self._sequence.ramp, step.force_n)

    def _borne(self, step: GraspStep) -> GraspStep:
        """Return a step with no more force than the servos, as measured, make of their current."""
        largest_n = self.hand.largest_ramp_n
        if not largest_n < step.force_n <= self._catalogue_n:
            return step
        borne_n = max(_BORNE_SHARE * largest_n, self._gripper.contact_force_n)
        if borne_n < _BORNE_SHARE * self._noted_n:
            self._noted_n = borne_n
            self.journal.note(
                "note",
                f"grasps end at {borne_n:.1f} N, {step.force_n:.1f} N were asked for: the servos, "
                f"as measured, need more than gripper.current_max_a "
                f"{self._gripper.current_max_a:g} A for more. Raise it where servo and part bear "
                f"it, or ask for less force",
            )
        return replace(step, force_n=borne_n)

    def grasp(
        self,
        step: GraspStep,
        label: str,
        early_checks: EarlyDecider | None = None,
        judge: Judge | None = None,
    ) -> tuple[GraspRecord, bool]:
        """Go to the pose, grasp, record, release; ``early_checks`` may end the ramp.

        If ``judge.holds``, the part is held with the carry force until ``judge`` decides: release,
        squeeze once more, or keep. Returns the record of the grasp and whether the part was kept.
        """
        record = self._close(step, self._move_to(step.pose), label, early_checks)
        kept = False
        if judge is not None and record.outcome.result not in NOTHING_HELD:
            judge.start_answer(record)
            kept = judge.holds and self._judged(record, judge)
        if not kept:
            self.hand.release(self.watch)
            self.note_drives()
        return record, kept

    def grip(self, force_n: float, pose: Pose | None) -> GraspRecord:
        """Close, at a pose if one is given, and keep the part; open again if no part is found."""
        step = GraspStep(pose=pose or Pose(), force_n=force_n)
        reached = step.pose if pose is None else self._move_to(pose)
        record = self._close(step, reached, "", None)
        if record.outcome.result in NOTHING_HELD:
            self.hand.release(self.watch)
        else:
            zero = open_counts(record.grasp)
            self._held = (zero, self._look_at_held(zero))
        return record

    def verify(self) -> Verification:
        """Measure the held part once more and compare it with what was kept."""
        if self._held is None:
            raise CellStateError("no part is kept: identify with `keep` first")
        zero, then = self._held
        return compared(self._look_at_held(zero), then)

    def measure_zero(self) -> ZeroMeasurement:
        """Close the empty fingers on each other, measure the self-zero, open them again.

        Raises gripper.errors.PartBetweenFingers if something is between them; the grip is kept.
        Raises ZeroRefused if a finger or pad is out of bounds; the fingers are open.
        """
        outcome, found, refused = self._meet()
        sound = found is not None and not (part_between(outcome, found) or unsound(found))
        if sound:
            self.hand.measure_load(self.watch)
        if between := part_between(outcome, found):
            raise PartBetweenFingers(
                f"{between}. The grip is kept. Look at the fingers; clear the fault and release"
            )
        self.hand.release(self.watch)
        if found is None or (refused := unsound(found)):
            raise ZeroRefused(refused)
        self._measure_friction()
        return self._kept_zero(found)

    def _measure_friction(self) -> None:
        """Measure the servos' friction; only after the pads have met with nothing between them."""
        self.hand.measure_friction(self.watch)
        self._note_each_drive()

    def note_drives(self) -> DriveReport:
        """Note unusual drive characteristics; return all of them."""
        report = self.hand.read_drives()
        for text in report.notes:
            self.journal.note("note", text)
        return report

    def keep_drives(self) -> DriveReport:
        """Save the measured drive characteristics; return them."""
        report = self.note_drives()
        self.zeros.keep_drives(report.drives, self.homing)
        return report

    def _note_each_drive(self) -> None:
        """Save and note the drive characteristic of each servo after a start or a self-zero."""
        report = self.keep_drives()
        for servo in self._gripper.servos:
            drive = report.drives.get(servo.id)
            if drive is not None:
                text = drive_text(servo.id, drive, MODELS[servo.model])
                self.journal.note("servo drive", text)

    def zero_unasked(self) -> str:
        """Measure as `measure_zero`, when nobody has checked that the fingers are empty.

        A part between them is released, and the cell works without a self-zero. Returns why there
        is no self-zero; empty if there is one.
        """
        outcome, found, refused = self._meet()
        why = part_between(outcome, found) or refused
        if found is not None:
            why = why or unsound(found) or self.zeros.far_off(found.zero)
        if not why:
            self.hand.measure_load(self.watch)
        self.hand.release(self.watch)
        if found is not None and not why:
            self._measure_friction()
            self._kept_zero(found)
            return ""
        self._note_each_drive()
        why = (
            f"no self-zero today, answers allow for any drift: {why}. The fingers are open. Take "
            f"everything out of the grip, then `tactile-cell zero`; with `self_zero: on_demand` "
            f"no start closes the fingers"
        )
        self.journal.note("note", why)
        return why

    def _meet(self) -> tuple[GraspOutcome, ZeroMeasurement | None, str]:
        """Press the empty fingers on each other; stop if the pads show a part.

        Returns while they press: the outcome, the measurement or None, and why it is None.
        """
        self._held = None
        self._open_and_zero()
        collector, collect = self._collecting(None)
        layout, n_seen = self.hand.layout, 0

        def watch(cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
            nonlocal n_seen
            collect(cycle, frames)
            if frames and 0.0 < cycle.setpoint_n < _LOOKS_UP_TO_N:
                n_seen += 1
                if n_seen % _LOOK_FRAMES == 0 and shows_part(
                    collector.grasp(), layout.gripping_pads
                ):
                    self.hand.end_ramp()

        most_n = min(_ZERO_FORCE_N, _BORNE_SHARE * self.hand.largest_ramp_n)
        outcome = self.hand.press_pads_together(
            ForceRamp.linear(most_n, rate_n_s=_ZERO_RATE_N_S), watch
        )
        if part_between(outcome):
            return outcome, None, ""
        try:
            found = measure_zero(
                collector.grasp(),
                collector.pads_n,
                layout.gripping_pads,
                step_m=self._opening_step_m,
            )
        except ValueError as error:
            return outcome, None, f"{error}; measure again"
        return outcome, found, ""

    def _open_and_zero(self) -> None:
        """Open the fingers; take the zero of a drifting sensor before each approach."""
        self.hand.open(self.watch)
        if n_frames := self.config.tactile.sensor.fresh_zero_frames:
            self.take_zero(n_frames)

    def _kept_zero(self, found: ZeroMeasurement) -> ZeroMeasurement:
        gain = pad_gain(list(self.note_drives().drives.values()))
        found = anchored(found, self._catalogue_n_a, gain.log_gain, gain.log_sd)
        self.zeros.keep(found.zero)
        self.journal.note("self_zero", zero_text(found))
        if self.zeros.unkept:
            self.journal.note("note", self.zeros.unkept)
        if dead := dead_taxels_text(found, self.hand.layout):
            self.journal.note("taxels", dead)
        return found

    def _close(
        self, step: GraspStep, reached: Pose, label: str, early_checks: EarlyDecider | None
    ) -> GraspRecord:
        """Open, close and follow the ramp; record it, and return while the part is held."""
        self._held = None
        self._open_and_zero()
        step = self._borne(step)
        collector, collect = self._collecting(self.zeros.newest)

        def watch(cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
            collect(cycle, frames)
            if early_checks is not None and any(
                early_checks.add_frame(frame.counts, collector.grasp) for frame in frames
            ):
                self.hand.end_ramp()

        outcome = self.hand.grasp(self._ramp(step), watch)
        self.life.result = outcome.result
        if outcome.result in NOTHING_HELD and not collector.n_frames:
            self.hand.release(self.watch)
            raise NoPartFound(
                f"{NOTHING_HELD[outcome.result]} at {reached}, and the fingers had closed before a "
                f"frame of the taxels came: open wider, or close more slowly"
            )
        record = GraspRecord(
            grasp=collector.grasp(label, step.command),
            step=step,
            reached=reached,
            outcome=outcome,
            cycles=tuple(collector.cycles),
            early=early_checks.answer if early_checks is not None and outcome.ended_early else None,
        )
        missing = NOTHING_HELD.get(outcome.result)
        if missing is not None:
            self.journal.note("no part", f"{missing} at {reached}")
        else:
            self.journal.grasp(record.grasp)
            if record.ended:
                self.journal.note("ramp", record.ended)
        return record

    def _judged(self, record: GraspRecord, judge: Judge) -> bool:
        """Hold the part until it is judged; return whether it was kept."""
        first, zero = record, open_counts(record.grasp)
        while True:
            if judge.keeps:
                held = (zero, self._look_at_held(zero))
            else:
                self.hand.hold_at(self._carry_n, 0.0, self.watch)
            verdict = judge.decide()
            self.life.check_cancelled()
            if verdict.further is None:
                break
            record = self._squeeze(first, replace(verdict.further, pose=first.step.pose))
            judge.start_answer(record)
        if verdict.keep:
            self._held = held
        return verdict.keep

    def _squeeze(self, first: GraspRecord, step: GraspStep) -> GraspRecord:
        """Back off and follow a further ramp in the same grip; return its record."""
        from_n = min(BACK_OFF_SHARE * step.force_n, self._carry_n)
        from_n = max(from_n, LEAST_CONTACTS * self._gripper.contact_force_n)
        self.hand.hold_at(from_n, 0.0, self.watch)
        collector, watch = self._collecting(self.zeros.newest)
        step = self._borne(step)
        outcome = self.hand.squeeze(self._ramp(step), watch)
        self.journal.note("ramp", f"further ramp to {step.force_n:.1f} N in the same grip")
        if outcome.short:
            self.journal.note("ramp", outcome.short)
        return GraspRecord(
            grasp=spliced(first.grasp, collector.grasp(command=step.command), from_n),
            step=step,
            reached=first.reached,
            outcome=outcome,
            cycles=tuple(collector.cycles),
            same_grip=True,
        )

    @property
    def _carry_n(self) -> float:
        """Force in N of a carry."""
        return min(self._sequence.carry_force_n, _BORNE_SHARE * self.hand.largest_ramp_n)

    def _look_at_held(self, zero: NDArray[np.float64]) -> HeldPart:
        """Hold the part with the carry force, and measure it for a comparison."""
        self.hand.hold_at(self._carry_n, 0.0, self.watch)
        collector, watch = self._collecting(None)
        self.hand.hold_at(self._carry_n, HELD_LOOK_S, watch)
        return measure_held_part(collector, zero)

    def watch(self, cycle: Cycle, _frames: Sequence[TactileFrame]) -> None:
        """Record one period of a motion without its frames; obey a stop."""
        self._look(cycle, ())

    def patiently(self, call: Callable[[], _T], supervise: Callable[[], None]) -> _T:
        """Wait for the positioner and supervise both links meanwhile."""
        if not self.positioner.blocks:
            return call()
        return self._patient.call(call, supervise)

    def _collecting(self, zero: SelfZero | None) -> tuple[GraspCollector, OnPeriod]:
        """Return a collector for a motion that begins now, and the callback that fills it."""
        # The grasps of a run stay in order even if the machine's clock is set back.
        self._last_start_ms = max(time.time_ns() // 1_000_000, self._last_start_ms + 1)
        collector = GraspCollector(
            self.pads, source=self._source, start_ms=self._last_start_ms, zero=zero
        )

        def watch(cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
            self._look(cycle, frames)
            collector.add(cycle, frames)

        return collector, watch

    def _look(self, cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
        self.life.check_cancelled()
        self.journal.states(self.life.state, self.life.grasp_state)
        self.journal.cycle(cycle, frames)

    def _move_to(self, pose: Pose) -> Pose:
        def supervise() -> None:
            self.hand.tick()
            self.life.check_cancelled()

        reached = self.patiently(lambda: self.positioner.move_to(pose, supervise), supervise)
        self.journal.pose(reached)
        return reached


def _opening_step_m(linkage: Linkage, gripper: GripperConfig) -> float:
    """Return the step in m in which the servos read the opening of closed fingers."""
    return sum(
        linkage.opening_per_rad_m(closed_rad) * MODELS[servo.model].rad_per_pulse
        for closed_rad, servo in zip(linkage.angles_rad(0.0), gripper.servos, strict=True)
    )


def _catalogue_n_a(linkage: Linkage, gripper: GripperConfig) -> float:
    """Return the grip force in N of closed fingers for each A, by the catalogue's constants."""
    radii_m = map(linkage.effective_radius_m, linkage.angles_rad(0.0))
    return fmean(
        MODELS[servo.model].kt_nm_a / radius_m
        for servo, radius_m in zip(gripper.servos, radii_m, strict=True)
    )
