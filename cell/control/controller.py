"""The controller of a cell: runs grasp-then-classify sequences, latches faults, shuts down."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from cell.config.model import CellConfig
from cell.control.early_end import EarlyDecider
from cell.control.grasping import NOTHING_HELD, Grasper
from cell.control.identification import Identification, Judge, OnGrasp, ReadShape
from cell.control.journal import Journal
from cell.control.kept_part import KeptPart
from cell.control.lifecycle import UNTIL_RELEASED, CellLifecycle
from cell.control.live import LiveValues, live_values
from cell.control.moves import Moves
from cell.control.plan import GraspStep, Keep, Pose
from cell.control.positioner import PatientCaller, Positioner, in_thread
from cell.control.records import GraspRecord, pad_array
from cell.control.self_zero import SelfZeros, homing_offsets
from cell.control.states import CellState, Command, Event
from cell.control.watch import MotionWatch
from cell.control.zeroing import Zeroing
from cell.errors import NoPartFound, PartInGrip, PlanRefused
from cell.hand.interface import FORCE_FROM_FRAMES, Hand, LatestValues
from cell.recording.recorder import Recorder
from gripper.clock import Clock
from gripper.values.outcome import GraspResult, ReleaseReport
from gripper.values.state import GripperPhase
from recognition.grasp import CELL_SOURCE
from recognition.recognizer import Recognizer

_T = TypeVar("_T")
_UNSUPERVISED = (
    CellState.STOPPED,
    CellState.ABORTING,
    CellState.ABORTED,
    CellState.CLEARING,
    CellState.RESETTING,
)
"""States in which nothing reads the hand, so there are no measurements."""

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
        """Messages for the operator in the recording."""
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
        self._grasper = Grasper(
            config=config,
            hand=hand,
            life=life,
            journal=journal,
            watch=watch,
            moves=self.moves,
            zeroing=self.zeroing,
            kept_part=self.kept_part,
        )

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
                    f"servos have torque from an earlier run, a part may be in the grip; nothing "
                    f"was moved ({conditions}). Clear the fault, release the part, then start again"
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
        self.hand.stop_sensor()
        self.journal.note("release", "on request, before the start")
        with self.life.latching_faults():
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
            self._grasper.check(step, label)

    def grasp(
        self, step: GraspStep, early_checks: EarlyDecider | None = None, *, label: str = ""
    ) -> GraspRecord:
        """Run one grasp: pose, approach, contact, ramp, hold, release.

        With ``early_checks`` the ramp ends as soon as they decide.

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
        return self._grasp(step, early_checks, label=label)[0]

    def grip(self, force_n: float, pose: Pose | None = None) -> GraspRecord:
        """Close with a force ramp and keep the part: COMPLETE, without a name.

        Without a ``pose`` the positioner does not move.

        Raises
        ------
        NoPartFound, CellStopped, PlanRefused, gripper.errors.LimitExceeded
            As `grasp`.
        """
        self.life.obey_cancel_between()
        self._grasper.check(GraspStep(pose=Pose(), force_n=force_n))
        self.journal.begin()
        with self.life.executing(Event.EXECUTE):
            record = self._grasper.grip(force_n, pose)
            if record.outcome.result in NOTHING_HELD:
                self.life.complete()
            else:
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
        self,
        step: GraspStep,
        early_checks: EarlyDecider | None,
        judge: Judge | None = None,
        *,
        label: str = "",
    ) -> tuple[GraspRecord, bool]:
        self.life.obey_cancel_between()
        self._grasper.check(step, label)
        with self.life.executing(Event.EXECUTE):
            record, kept = self._grasper.grasp(step, label, early_checks, judge)
            if kept:
                self.life.keep(since="answer")
            else:
                self.life.complete()
        self._check_record(record)
        return record, kept

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

    def _may_release(self, command: Command) -> None:
        """Let a release begin, also after a `cancel`, but not once the program ends.

        The first goal of a release lowers the grip, before a stop can end it.
        """
        self.life.check(command)
        self.life.forget_cancel()
        self.life.obey_cancel("before the fingers moved; the grip is kept")

    def _release(self, why: str) -> ReleaseReport:
        self.life.go(Event.RELEASE)
        self.journal.note("release", why)
        with self.life.latching_faults():
            report = self.hand.release(self._watch.motion)
            self.life.result = None
            self.life.complete()
        return report
