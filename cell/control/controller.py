"""The controller of a cell: runs grasp-then-classify sequences, latches faults, shuts down."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import TypeVar

from cell.config.model import CellConfig
from cell.control.identification import EarlyDecider, Identification, Judge, OnGrasp, ReadShape
from cell.control.journal import Journal
from cell.control.kept_part import KeptPart
from cell.control.lifecycle import UNTIL_RELEASED, CellLifecycle
from cell.control.moves import Moves
from cell.control.plan import GraspStep, Keep, Pose
from cell.control.positioner import PatientCaller, Positioner, in_thread
from cell.control.records import GraspRecord, pad_array, spliced
from cell.control.states import CellState, Command, Event
from cell.control.watch import MotionWatch
from cell.control.zeroing import BORNE_SHARE, SelfZeros, Zeroing, homing_offsets
from cell.errors import NoPartFound, PartInGrip, PlanRefused, raised_as
from cell.files import check_text
from cell.hand.interface import FORCE_FROM_FRAMES, Hand, LatestValues, LiveValues, live_values
from cell.recording.recorder import Recorder
from gripper.clock import Clock
from gripper.force.ramp import ForceRamp
from gripper.values.outcome import GraspResult, ReleaseReport
from gripper.values.state import Cycle, GripperPhase
from recognition.grasp import CELL_SOURCE
from recognition.recognizer import Recognizer
from tactile.source import TactileFrame

_T = TypeVar("_T")
_UNSUPERVISED = (
    CellState.STOPPED,
    CellState.ABORTING,
    CellState.ABORTED,
    CellState.CLEARING,
    CellState.RESETTING,
)
"""States in which nothing reads the hand, so there are no measurements."""

NOTHING_HELD = {
    GraspResult.NO_CONTACT: "no contact",
    GraspResult.PART_LOST: "the part was lost while the fingers pressed",
}
"""Results of a grasp that holds nothing and cannot be used for recognition."""


BACK_OFF_SHARE = 0.3
"""Start of a further ramp in the same grip, as a share of its end: the lowest level of load at
which a recognizer takes footprints (`recognition.ramp.ramp`)."""

LEAST_CONTACTS = 2.0
"""Least start of a further ramp, in contact forces. A part held with one contact force is sometimes
reported as lost (simulated cell, twice the noise)."""

_CLOSED_M = 0.0005
"""Margin in m above the smallest opening; beyond it the fingers did not close fully."""


class CellController:
    """Runs the sequences of one cell: gripper, tactile sensor and positioner, from one thread.

    Its parts have the other commands: `life` those of a fault and a stop, `moves` those of the
    positioner, `zeroing` the self-zero, `kept_part` the check of a kept part. Only `release`,
    `release_held`, `put_down` and the end of each grasp of a sequence let the part go. A fault, a
    stop and `shutdown` never do.
    """

    def __init__(
        self,
        config: CellConfig,
        hand: Hand,
        positioner: Positioner,
        *,
        clock: Clock,
        recorder: Recorder | None = None,
        zeros: SelfZeros | None = None,
    ) -> None:
        self.clock = clock
        self._config = config
        self.hand = hand
        """Gripper and sensor, for statistics; commands go through the controller."""
        self.journal = journal = Journal(recorder)
        """Messages in the recording; the report shows the important ones."""
        self.life = life = CellLifecycle(hand, journal, clock, config.gripper.contact_force_n)
        """State, fault and requested stop."""
        self._watch = watch = MotionWatch(
            life, journal, pad_array(hand.layout), CELL_SOURCE + config.name
        )
        self.moves = Moves(life, journal, positioner, PatientCaller(clock, hand.period_s))
        """Moves of the positioner."""
        self.zeros = zeros or SelfZeros()
        """The newest self-zero, and when the next one is due."""
        self.zeroing = Zeroing(config, hand, life, journal, watch, self.zeros)
        """Takes the zeros of taxels and fingers, and measures the drives of the servos."""
        self.kept_part = KeptPart(hand, life, journal, watch, config.sequence.carry_force_n)
        """The part that stays in the grip."""
        self._catalogue_n, self._noted_n = config.largest_ramp_n, inf

    @property
    def live(self) -> LiveValues:
        """The present measurements, for any thread."""
        return live_values(self.latest, self.clock.monotonic())

    @property
    def latest(self) -> LatestValues:
        """Newest values of the hand; empty while nothing reads it, for example after a fault."""
        return LatestValues() if self.life.state in _UNSUPERVISED else self.hand.latest

    # -- commands ------------------------------------------------------------------------------

    def start(self) -> None:
        """Verify servos and control unit, open the fingers, take the zero of the taxels.

        A self-zero follows if it is due, see `cell.control.zeroing.Zeroing.start`.

        Raises
        ------
        CellStateError
            If the cell is not stopped; PartInGrip, if a part may be in the grip.
        CellStopped
            If it was cancelled. The cell is stopped again.
        gripper.errors.GripperError, tactile.errors.TactileError
            If a device is missing, differs from the config, or is touched while it is zeroed.
        """
        self.journal.begin()
        self.life.go(Event.START)
        with self.life.latching_faults():
            self.zeroing.homing = homing_offsets(self.hand.start())
            self.hand.use_drives(self.zeroing.drives)
            unit = self.hand.start_sensor()
            if not unit.sends_forces:
                self.journal.note("note", FORCE_FROM_FRAMES)
            self.zeros.of_unit(unit)
            if self.hand.phase is GripperPhase.HELD_AFTER_FAULT:
                conditions = "; ".join(map(str, self.hand.conditions()))
                raise PartInGrip(
                    f"a part may be in the grip, from an earlier run or a fault; nothing was "
                    f"moved ({conditions}). Clear the fault, release the part, then start again"
                )
            self.zeroing.start()
            self.life.complete()

    def release(self) -> ReleaseReport:
        """Let the part go: the only way to open the fingers of a started cell.

        Returns what was opened: a servo that is silent or at fault is left as it is.

        Raises
        ------
        CellStateError
            If the cell is not started, or a fault is latched.
        CellStopped
            If it was cancelled meanwhile; the fingers stand still, the message names the opening.
        """
        self._may_release(Command.RELEASE)
        return self._release("on request")

    def put_down(self) -> ReleaseReport:
        """Let a kept part go as a step of a job, unless a `cancel` is pending.

        Raises
        ------
        CellStopped
            If it was cancelled. The part is still kept.
        CellStateError
            As `release`.
        """
        self.life.check(Command.VERIFY)
        self.life.obey_cancel(f"before it was let go; the part is kept {UNTIL_RELEASED}")
        return self._release("at its place")

    def release_held(self) -> ReleaseReport:
        """Let go of a part that an earlier run or a cleared fault left in the grip.

        For a cell that is not started; the control unit is not needed for it. Returns what was
        opened: a servo that is silent or at fault is left as it is.

        Raises
        ------
        CellStateError
            If the cell is started (use `release`), or a fault is latched.
        CellStopped
            If it was cancelled meanwhile; the fingers stand still, the message names the opening.
        gripper.errors.GripperError
            If no servo answers, or no servo that answers can be moved.
        """
        self._may_release(Command.RELEASE_HELD)
        self.life.go(Event.RELEASE_HELD)
        self.journal.note("release", "on request, before the start")
        with self.life.latching_faults():
            self.hand.stop_sensor()
            # Not recorded: a recording that has failed must not keep the part.
            report = self.hand.release(lambda *_period: self.life.check_cancelled())
            self.life.complete()
        return report

    def shutdown(self) -> None:
        """Leave the devices in a defined state: a held part stays held, a fault latched.

        Raises
        ------
        CellStateError
            While a command runs: stop it first.
        """
        self.life.check(Command.SHUTDOWN)
        stopping = self.life.allows(Event.STOP)
        if stopping:
            self.life.go(Event.STOP)
        try:
            if stopping:
                self.zeroing.keep_drives()
            fault = self.hand.shutdown()
            if fault:
                self.journal.note("fault", fault)
        finally:
            self.journal.loop(self.hand.statistics)
            if stopping:
                self.life.complete()

    # -- sequences -----------------------------------------------------------------------------

    def check_plan(self, plan: Sequence[GraspStep], label: str = "") -> None:
        """Refuse a plan, before anything moves.

        Raises
        ------
        PlanRefused, gripper.errors.LimitExceeded
            If it is empty, or one of its steps or the label of their grasps is refused.
        """
        if not plan:
            raise PlanRefused("the plan is empty; give at least one step")
        for step in plan:
            self._check_step(step, label)

    def grasp(self, step: GraspStep, *, label: str = "") -> GraspRecord:
        """Run one grasp: pose, approach, contact, ramp, hold, release.

        Raises
        ------
        NoPartFound
            If the fingers closed to their limit and touched nothing, were blocked on the way, or
            lost the part during the ramp. The fingers are open again; nothing is classified.
        CellStopped
            If it was cancelled. The grip is kept.
        PlanRefused, gripper.errors.LimitExceeded
            If the step cannot be carried out; nothing has moved, and no fault is latched.
        """
        self.journal.begin()
        return self._grasp(step, label=label)[0]

    def grip(self, force_n: float, pose: Pose | None = None) -> GraspRecord:
        """Close with a force ramp and keep the part: COMPLETE, without a name.

        It is kept with the carry force, but at most with ``force_n``. Without a ``pose`` the
        positioner does not move.

        Raises
        ------
        NoPartFound, CellStopped, PlanRefused, gripper.errors.LimitExceeded
            As `grasp`.
        """
        self.life.obey_cancel_between()
        step = GraspStep(pose=pose or Pose(), force_n=force_n)
        self._check_step(step)
        self.journal.begin()
        with self.life.executing(Event.EXECUTE):
            self.kept_part.wanted_force_n = min(force_n, self._config.sequence.carry_force_n)
            reached = step.pose if pose is None else self.moves.move_to(pose)
            record = self._close(step, reached, "", None)
            if record.outcome.result in NOTHING_HELD:
                self.hand.release(self._watch.motion)
                self.life.complete()
            else:
                self.kept_part.measure(record.grasp.rest_counts)
                self.life.keep(since="grip")
        self._check_record(record)
        return record

    def identify(
        self,
        recognizer: Recognizer,
        plan: Sequence[GraspStep],
        *,
        early: bool = False,
        read_shape: ReadShape | None = None,
        on_grasp: OnGrasp | None = None,
        keep: Keep = Keep.NEVER,
    ) -> Identification:
        """Grasp and classify until the stop rule is satisfied or the plan ends.

        A part that may be kept is held while its grasp is classified. A kept part stays in the
        grip after the last grasp, and the cell is COMPLETE until `release`. Other parts are
        released while their grasp is classified.

        With ``early`` a ramp ends as soon as it and the grasps before it satisfy the stop rule.
        With ``read_shape`` the answer includes shape and size.

        Raises
        ------
        NoPartFound, CellStopped
            As `grasp`.
        PlanRefused, gripper.errors.LimitExceeded
            If the plan is empty or one of its steps cannot be carried out; nothing has moved.
        """
        self.check_plan(plan)
        self.journal.begin()
        judge = Judge(
            recognizer=recognizer,
            plan=plan,
            error_rate=self._config.sequence.error_rate,
            keep=keep,
            regrasps=self._config.sequence.regrasp == "fixture",
            early=early,
            read_shape=read_shape,
            on_grasp=on_grasp,
            compute=self._start_answer,
        )
        answer = judge.identify(self._grasp)
        self.journal.result(answer)
        return answer

    # -- inside --------------------------------------------------------------------------------

    def _start_answer(self, answer: Callable[[], _T]) -> Callable[[], _T]:
        """Compute during the motions if no force loop is delayed by it; else when it is needed."""
        return in_thread(answer, "answer").result if self.hand.own_process else answer

    def _grasp(
        self, step: GraspStep, judge: Judge | None = None, *, label: str = ""
    ) -> tuple[GraspRecord, bool]:
        """Go to the pose, grasp, record, release; ``judge.early_checks`` may end the ramp.

        If ``judge.holds``, the part is held with the carry force until ``judge`` decides: release,
        squeeze once more, or keep. Returns the record of the grasp and whether the part was kept.
        """
        self.life.obey_cancel_between()
        self._check_step(step, label)
        early_checks, holds = None if judge is None else judge.early_checks, False
        with self.life.executing(Event.EXECUTE):
            record = self._close(step, self.moves.move_to(step.pose), label, early_checks)
            if judge is not None and record.outcome.result not in NOTHING_HELD:
                judge.start_answer(record)
                holds = judge.holds and self._judged(record, judge)
            if holds:
                self.life.keep(since="answer")
            else:
                self.hand.release(self._watch.motion)
                self.zeroing.note_drives()
                self.life.complete()
        self._check_record(record)
        return record, holds

    def _check_record(self, record: GraspRecord) -> None:
        """Raise NoPartFound if a grasp found no part."""
        missing = NOTHING_HELD.get(record.outcome.result)
        if missing is not None:
            gripper, opening_m = self._config.gripper_settings, record.outcome.final_aperture_m
            left_m = opening_m - gripper.aperture_min_m
            why = "is the object in place?"
            if record.outcome.result is GraspResult.NO_CONTACT and left_m > _CLOSED_M:
                limit_s = gripper.contact_timeout_s
                why = f"the fingers came no farther in gripper.contact_timeout_s = {limit_s:g} s"
            raise NoPartFound(
                f"{missing} at pose {record.step.pose}, at an opening of {1e3 * opening_m:.1f} mm; "
                f"{why}"
            )

    # -- one grasp -----------------------------------------------------------------------------

    def _check_step(self, step: GraspStep, label: str = "") -> None:
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
        return self._config.sequence.ramp.to(step.force_n)

    def _borne(self, step: GraspStep) -> GraspStep:
        """Return a step with no more force than the servos, as measured, make of their current."""
        largest_n, gripper = self.hand.largest_ramp_n, self._config.gripper
        if not largest_n < step.force_n <= self._catalogue_n:
            return step
        borne_n = max(BORNE_SHARE * largest_n, gripper.contact_force_n)
        if borne_n < BORNE_SHARE * self._noted_n:
            self._noted_n = borne_n
            self.journal.note(
                "note",
                f"grasps end at {borne_n:.1f} N, {step.force_n:.1f} N were asked for: the servos, "
                f"as measured, need more than gripper.current_max_a {gripper.current_max_a:g} A "
                "for more. Raise it where servo and part bear it, or ask for less force",
            )
        return replace(step, force_n=borne_n)

    def _close(
        self, step: GraspStep, reached: Pose, label: str, early_checks: EarlyDecider | None
    ) -> GraspRecord:
        """Open, close and follow the ramp; record it, and return while the part is held."""
        self.zeroing.open()
        step = self._borne(step)
        collector, collect = self._watch.collecting(self.zeroing.zeros.newest)

        def watch(cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
            collect(cycle, frames)
            if early_checks is not None and frames:
                share = cycle.setpoint_n / step.force_n
                if early_checks.suffices(share, collector.grasp):
                    self.hand.end_ramp()

        outcome = self.hand.grasp(self._ramp(step), watch)
        self.life.result = outcome.result
        if outcome.result in NOTHING_HELD and not collector.n_frames:
            self.hand.release(self._watch.motion)
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
        first, zero = record, record.grasp.rest_counts
        self.kept_part.wanted_force_n = self._config.sequence.carry_force_n
        while True:
            if judge.keeps:
                self.kept_part.measure(zero)
            else:
                self.kept_part.hold()
            further = judge.decide()
            self.life.check_cancelled()
            if further is None:
                return judge.keeps_part
            record = self._squeeze(first, replace(further, pose=first.step.pose))
            judge.start_answer(record)

    def _squeeze(self, first: GraspRecord, step: GraspStep) -> GraspRecord:
        """Back off and follow a further ramp in the same grip; return its record."""
        from_n = min(BACK_OFF_SHARE * step.force_n, self.kept_part.force_n)
        from_n = max(from_n, LEAST_CONTACTS * self._config.gripper.contact_force_n)
        self.hand.hold_at(from_n, 0.0, self._watch.motion)
        collector, watch = self._watch.collecting(self.zeroing.zeros.newest)
        step = self._borne(step)
        outcome = self.hand.squeeze(self._ramp(step), watch)
        self.journal.note("ramp", f"further ramp to {step.force_n:.1f} N in the same grip")
        record = GraspRecord(
            grasp=spliced(first.grasp, collector.grasp(command=step.command), from_n),
            step=step,
            reached=first.reached,
            outcome=outcome,
            cycles=tuple(collector.cycles),
            same_grip=True,
        )
        if record.ended:
            self.journal.note("ramp", record.ended)
        return record

    # -- release -------------------------------------------------------------------------------

    def _may_release(self, command: Command) -> None:
        """Let a release begin unless a `cancel` is pending: its first goal lowers the grip."""
        self.life.check(command)
        self.life.obey_cancel("before the fingers moved; the grip is kept")

    def _release(self, why: str) -> ReleaseReport:
        self.life.go(Event.RELEASE)
        self.journal.note("release", why)
        with self.life.latching_faults():
            report = self.hand.release(self._watch.motion)
            self.life.result = None
            self.life.complete()
        return report
