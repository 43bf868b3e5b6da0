"""One grasp of a sequence: move to its pose, grasp, record, then release or keep the part."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from cell.config.model import CellConfig
from cell.config.sequence import ramp_from_config
from cell.control.early_end import EarlyDecider
from cell.control.identification import Judge
from cell.control.journal import Journal
from cell.control.kept_part import KeptPart, open_counts
from cell.control.lifecycle import CellLifecycle
from cell.control.moves import Moves
from cell.control.plan import GraspStep, Pose
from cell.control.records import GraspRecord
from cell.control.watch import MotionWatch
from cell.control.zeroing import BORNE_SHARE, Zeroing
from cell.errors import NoPartFound, PlanRefused, raised_as
from cell.hand.interface import Hand
from cell.recording.grasp_limits import check_text
from gripper.force.ramp import ForceRamp
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle
from recognition.grasp import Grasp
from tactile.source import TactileFrame

NOTHING_HELD = {
    GraspResult.NO_CONTACT: "no contact",
    GraspResult.PART_LOST: "the part was lost while the fingers pressed",
}
"""Results of a grasp that holds nothing and cannot be used for recognition."""


BACK_OFF_SHARE = 0.3
"""Start of a further ramp in the same grip, as a share of its end: the lowest level of load at
which a recognizer takes footprints (`recognition.ramp.levels`)."""

LEAST_CONTACTS = 2.0
"""Least start of a further ramp, in contact forces. A part held with one contact force is sometimes
reported as lost (simulated cell, twice the noise)."""


@dataclass(kw_only=True)
class Grasper:
    """Carries out grasps with hand and positioner, and records them."""

    config: CellConfig
    hand: Hand
    life: CellLifecycle
    """Gets the result of each grasp."""
    journal: Journal
    watch: MotionWatch
    moves: Moves
    zeroing: Zeroing
    """Opens the fingers before a grasp; each grasp includes its newest self-zero."""
    kept_part: KeptPart

    def __post_init__(self) -> None:
        self._gripper, self._sequence = self.config.gripper, self.config.sequence
        self._catalogue_n, self._noted_n = self.config.largest_ramp_n, inf

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
        with raised_as(PlanRefused, ValueError):
            check_text("label", label)
        self.hand.check_ramp(self._ramp(self._borne(step)))

    def _ramp(self, step: GraspStep) -> ForceRamp:
        return ramp_from_config(self._sequence.ramp, step.force_n)

    def _borne(self, step: GraspStep) -> GraspStep:
        """Return a step with no more force than the servos, as measured, make of their current."""
        largest_n = self.hand.largest_ramp_n
        if not largest_n < step.force_n <= self._catalogue_n:
            return step
        borne_n = max(BORNE_SHARE * largest_n, self._gripper.contact_force_n)
        if borne_n < BORNE_SHARE * self._noted_n:
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
        record = self._close(step, self.moves.move_to(step.pose), label, early_checks)
        kept = False
        if judge is not None and record.outcome.result not in NOTHING_HELD:
            judge.start_answer(record)
            kept = judge.holds and self._judged(record, judge)
        if not kept:
            self.hand.release(self.watch.motion)
            self.zeroing.note_drives()
        return record, kept

    def grip(self, force_n: float, pose: Pose | None) -> GraspRecord:
        """Close, at a pose if one is given, and keep the part; open again if no part is found."""
        step = GraspStep(pose=pose or Pose(), force_n=force_n)
        reached = step.pose if pose is None else self.moves.move_to(pose)
        record = self._close(step, reached, "", None)
        if record.outcome.result in NOTHING_HELD:
            self.hand.release(self.watch.motion)
        else:
            self.kept_part.measure(open_counts(record.grasp))
        return record

    def _close(
        self, step: GraspStep, reached: Pose, label: str, early_checks: EarlyDecider | None
    ) -> GraspRecord:
        """Open, close and follow the ramp; record it, and return while the part is held."""
        self.zeroing.open()
        step = self._borne(step)
        collector, collect = self.watch.collecting(self.zeroing.zeros.newest)

        def watch(cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
            collect(cycle, frames)
            if early_checks is not None and frames:
                share = cycle.setpoint_n / step.force_n
                if early_checks.suffices(share, collector.grasp):
                    self.hand.end_ramp()

        outcome = self.hand.grasp(self._ramp(step), watch)
        self.life.result = outcome.result
        if outcome.result in NOTHING_HELD and not collector.n_frames:
            self.hand.release(self.watch.motion)
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
                self.kept_part.measure(zero)
            else:
                self.kept_part.hold()
            verdict = judge.decide()
            self.life.check_cancelled()
            if verdict.further is None:
                return verdict.keep
            record = self._squeeze(first, replace(verdict.further, pose=first.step.pose))
            judge.start_answer(record)

    def _squeeze(self, first: GraspRecord, step: GraspStep) -> GraspRecord:
        """Back off and follow a further ramp in the same grip; return its record."""
        from_n = min(BACK_OFF_SHARE * step.force_n, self.kept_part.force_n)
        from_n = max(from_n, LEAST_CONTACTS * self._gripper.contact_force_n)
        self.hand.hold_at(from_n, 0.0, self.watch.motion)
        collector, watch = self.watch.collecting(self.zeroing.zeros.newest)
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


def spliced(approach: Grasp, further: Grasp, from_n: float) -> Grasp:
    """Return a grasp made of the first approach and a further ramp in the same grip.

    A recognizer compares each taxel with its rest before the touch, but a further ramp begins with
    a loaded part. The frames of the first ramp below ``from_n``, the set-point in N at which the
    further ramp begins, are therefore put before it.
    """
    n = int(np.argmax(np.asarray(approach.force_n) >= from_n))
    gap_s = float(np.median(np.diff(further.t_s))) if further.n_frames > 1 else 0.0
    later_s = float(approach.t_s[n - 1]) + gap_s if n else 0.0
    return Grasp(
        pads=further.pads,
        counts=np.concatenate([approach.counts[:n], further.counts]),
        t_s=np.concatenate([approach.t_s[:n], further.t_s + later_s]),
        aperture_m=np.concatenate([approach.aperture_m[:n], further.aperture_m]),
        force_n=np.concatenate([approach.force_n[:n], further.force_n]),
        label=further.label,
        source=further.source,
        start_ms=further.start_ms,
        command=further.command,
    )
