"""The controller of a cell: runs grasp-then-classify sequences, latches faults, shuts down."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeVar

from cell.config.model import CellConfig
from cell.control.answer import Verification
from cell.control.grasping import NOTHING_HELD, Grasper
from cell.control.identification import (
    Identification,
    OnGrasp,
    ReadShape,
    grasp_and_classify,
)
from cell.control.journal import Journal
from cell.control.keeping import Judge, Keep
from cell.control.lifecycle import ON_REQUEST, CellLifecycle
from cell.control.live import FRESH_S, LiveValues, live_values
from cell.control.plan import GraspStep, Pose
from cell.control.positioner import Destination, Positioner, in_thread
from cell.control.records import GraspRecord
from cell.control.self_zero import SelfZeros, homing_offsets
from cell.control.states import CellState, CellStatus, Command, Event, GraspState, named_states
from cell.data.recorder import Recorder
from cell.errors import (
    CellStateError,
    CellStopped,
    NoPartFound,
    PartInGrip,
    PlanRefused,
    PositionerError,
)
from cell.hand.interface import FORCE_FROM_FRAMES, Hand, LatestValues
from cell.hand.local import LocalHand
from gripper.clock import Clock
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.gripper import Gripper
from gripper.values.outcome import GraspResult, ReleaseReport
from gripper.values.state import GripperPhase, shows_nothing
from recognition.drift.self_zero import ZeroMeasurement
from recognition.grasp import PadArray, SelfZero
from recognition.recognizer import Recognizer
from recognition.recognizers.early_classifiers import EarlyClassifiers, EarlyDecider
from tactile.sensor.sensor import TactileSensor
from tactile.sensor.tare import TareResult

_T = TypeVar("_T")
_UNSUPERVISED = (
    CellState.STOPPED,
    CellState.ABORTING,
    CellState.ABORTED,
    CellState.CLEARING,
    CellState.RESETTING,
)
"""States in which nothing reads the hand, so there are no measurements."""
MISSES_IN_A_ROW = 3
"""Grasps in a row without a part after which a known object counts as absent."""

_CLOSED_M = 0.0005
"""Margin in m above the smallest opening; beyond it the fingers did not close fully."""


class CellController:
    """One cell: gripper, tactile sensor and positioner, driven from one thread.

    Any thread may call `cancel` and read states; all else belongs to the thread that runs the
    sequences. A fault keeps the grip and latches; then a person or host calls `clear` and `reset`.
    Only `release`, `release_held` and the end of each grasp of a sequence let the part go. A
    fault, `cancel` and `shutdown` never do.
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
        self._zeros = zeros or SelfZeros()
        self._positioner = positioner
        self._clock = clock
        self._config = config
        self._journal = Journal(recorder)
        self.zero: TareResult | None = None
        """Zero of the taxels of the last start; None before the first one."""
        self._zero_refused = ""
        self.hand = hand
        """Gripper and sensor, for statistics; commands go through the controller."""
        self._life = CellLifecycle(
            hand=hand,
            journal=self._journal,
            shows_nothing=lambda: self.shows_nothing,
            clock=clock,
        )
        self._grasper = Grasper(
            config=config,
            hand=hand,
            positioner=positioner,
            life=self._life,
            journal=self._journal,
            zeros=self._zeros,
            clock=clock,
            take_zero=self._take_zero,
        )
        self.pads: PadArray = self._grasper.pads

    @property
    def state(self) -> CellState:
        """The present state."""
        return self._life.state

    @property
    def grasp_state(self) -> GraspState:
        """The present state of the grip."""
        return self._life.grasp_state

    @property
    def brought(self) -> str | None:
        """Label of the object that the positioner brought last; None if it has no name."""
        return self._journal.brought

    @property
    def fault(self) -> str | None:
        """The latched fault as text; None without a fault."""
        return self._life.fault

    @property
    def faults(self) -> dict[str, int]:
        """Faults since the cell was opened, by their numbers as text."""
        return {str(number): n for number, n in tuple(self._life.faults.items())}

    @property
    def holding(self) -> bool:
        """Whether a part may be in the grip."""
        return self._life.holding

    @property
    def status(self) -> CellStatus:
        """States of cell and grip with their numbers, and faults."""
        life = self._life
        return CellStatus(
            **named_states(life.state, life.grasp_state),
            holding=life.holding,
            fault=life.fault,
            fault_number=life.fault_number,
            since_s=life.state_since_s,
            fault_since_s=life.fault_since_s,
            n_faults=life.faults.total(),
        )

    @property
    def gripper(self) -> Gripper:
        """The gripper, as `local_hand`."""
        return self.local_hand.gripper

    @property
    def sensor(self) -> TactileSensor:
        """The tactile sensor, as `local_hand`."""
        return self.local_hand.sensor

    @property
    def local_hand(self) -> LocalHand:
        """The hand of a cell whose loop runs in this process, for tests; else CellStateError."""
        if not isinstance(self.hand, LocalHand):
            raise CellStateError("the force loop runs in a process of its own; see `hand`")
        return self.hand

    @property
    def now_s(self) -> float:
        """Monotonic time of the cell in s."""
        return self._clock.monotonic()

    @property
    def live(self) -> LiveValues:
        """The present measurements, for any thread."""
        return live_values(self.latest, self._clock.monotonic())

    @property
    def latest(self) -> LatestValues:
        """Newest values of the hand; empty while nothing reads it, for example after a fault."""
        return LatestValues() if self._life.state in _UNSUPERVISED else self.hand.latest

    @property
    def carry_force_n(self) -> float:
        """Force in N with which a kept part is held; it does not depend on the grip force."""
        return self._config.sequence.carry_force_n

    @property
    def shows_nothing(self) -> bool:
        """Whether the newest pad forces and current both show that nothing is held."""
        measured, since_s = self.hand.latest, self._clock.monotonic() - FRESH_S
        cycle, force = measured.cycle, measured.force
        if cycle is None or force is None or min(cycle.t_s, force.t_s) < since_s:
            return False
        return shows_nothing(cycle.state, force, self._config.gripper.contact_force_n)

    # -- commands ------------------------------------------------------------------------------

    def check(self, command: Command) -> None:
        """Raise CellStateError if a command is not allowed in the present state."""
        self._life.check(command)

    def start(self) -> None:
        """Verify servos and control unit, open the fingers, take the zero of the taxels.

        A self-zero follows if it is due, see `measure_zero`. If a daily one finds a part, the
        fingers open again, and `zero_note` has the reason.

        Raises
        ------
        CellStateError
            If the cell is not stopped; PartInGrip, if a part may be in the grip.
        CellStopped
            If it was cancelled. The cell is stopped again.
        gripper.errors.GripperError, tactile.errors.TactileError
            If a device is missing, differs from the config, or is touched while it is zeroed.
        """
        self._life.go(Event.START)
        with self._life.latching_faults():
            self._grasper.homing = homing_offsets(self.hand.start())
            self.hand.use_drives(self._zeros.kept_drives(self._grasper.homing))
            unit = self.hand.start_sensor()
            if not unit.sends_forces:
                self._journal.note("note", FORCE_FROM_FRAMES)
            self._zeros.of_unit(unit)
            if self.hand.phase is GripperPhase.HELD_AFTER_FAULT:
                found = "; ".join(map(str, self.hand.conditions()))
                raise PartInGrip(
                    f"servos have torque from an earlier run, a part may be in the grip; nothing "
                    f"was moved ({found}). Clear the fault, release the part, then start again"
                )
            self.hand.open(self._grasper.watch)
            self._take_zero(self._config.tactile.tare_frames)
            self._life.check_cancelled()
            self._zero_refused = ""
            if self._zeros.due and self._zeros.wanted:
                self._grasper.measure_zero()
            elif self._zeros.due:
                self._zero_refused = self._grasper.zero_unasked()
            self._life.complete()

    def _take_zero(self, n_frames: int) -> None:
        self.zero = self.hand.tare(n_frames)

    @property
    def self_zero(self) -> SelfZero | None:
        """The self-zero of the last 24 hours; None if it was not measured."""
        return self._zeros.newest

    @property
    def drives(self) -> dict[int, DriveCharacteristic]:
        """Newest measured drive characteristic of each servo that is there, by its ID."""
        return self._zeros.kept_drives(self._grasper.homing)

    @property
    def zero_note(self) -> str:
        """Why there is no self-zero, or why it was not saved for other programs; else empty."""
        return self._zero_refused or self._zeros.unkept or self._zeros.refused

    def check_zero(self) -> None:
        """Raise PlanRefused if the config allows no self-zero for these fingers."""
        self._zeros.check()

    def measure_zero(self) -> ZeroMeasurement:
        """Close the empty fingers on each other and measure the zero of the opening, gains, foam.

        The grasps that follow include it, so that changes since teaching are corrected.

        Raises
        ------
        PlanRefused
            If the config allows no self-zero for these fingers; nothing has moved.
        gripper.errors.PartBetweenFingers
            If something is between them; the grip is kept.
        ZeroRefused
            If a pad or a finger is out of bounds; the fingers are open.
        CellStopped
            If it was cancelled. The fingers press on each other until `release`.
        """
        self.check_zero()
        self._check_cancelled_between()
        with self._executing(Event.EXECUTE):
            found = self._grasper.measure_zero()
            self._zero_refused = ""
            self._life.complete()
        return found

    def clear(self, *, reboot: bool = False) -> None:
        """Acknowledge the fault, or before the start the torque left by an earlier run.

        The grip stays as it is. `reset` is the next step.

        Parameters
        ----------
        reboot
            True to restart servos that report a hardware error. This is needed after a servo has
            switched its torque off. If the servo still holds a part, the part drops.

        Raises
        ------
        gripper.errors.GripperError
            If a servo does not answer or is still at fault; the fault stays latched.
        """
        self._life.clear(reboot=reboot)

    def reset(self) -> None:
        """Leave the cleared fault behind; the next `start` verifies everything anew."""
        self._life.go(Event.RESET)
        self.hand.stop_sensor()

    def cancel(self, reason: str = ON_REQUEST) -> None:
        """Stop the running sequence, or else the next one, and keep the grip.

        Safe from any thread. It stays pending until a sequence obeys it, so that a cancel between
        two parts of a job is not lost. Its message has the ``reason``.
        """
        self._life.stop_reason = reason
        self._life.cancelled = True
        self.hand.request_stop()

    def forget_cancel(self) -> None:
        """Withdraw a pending `cancel`: the sequence that it was meant for is over."""
        self._life.cancelled = False

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
        self.check(Command.RELEASE)
        self._life.cancelled = False
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
        self.check(Command.VERIFY)
        self._check_cancelled_in_carry("before it was let go")
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
        self._life.go(Event.RELEASE_HELD)
        self._life.cancelled = False
        self.hand.stop_sensor()
        self._journal.note("release", "on request, before the start")
        with self._life.latching_faults():
            report = self.hand.release()
            self._life.complete()
        return report

    def tick(self) -> None:
        """Serve and supervise both links while no sequence runs; call once a period.

        The force of a kept part is controlled; its slip or loss is a fault.
        """
        if self._life.state in (CellState.IDLE, CellState.HELD, CellState.COMPLETE):
            with self._life.latching_faults():
                self.hand.tick()

    def shutdown(self) -> None:
        """Leave the devices in a defined state: a held part stays held, a fault latched.

        Raises
        ------
        CellStateError
            While a command runs: cancel it first.
        """
        self.check(Command.SHUTDOWN)
        stopping = self._life.allows(Event.STOP)
        if stopping:
            self._life.go(Event.STOP)
        try:
            if stopping:
                self._grasper.keep_drives()
            found = self.hand.shutdown()
            if found:
                self._journal.note("fault", found)
        finally:
            self._journal.loop(self.hand.statistics)
            if stopping:
                self._life.complete()

    # -- sequences -----------------------------------------------------------------------------

    def present(self, label: str | None) -> None:
        """Have the positioner bring an object; None: the one to be identified.

        Raises
        ------
        CellStopped
            If it was cancelled during the wait for the object.
        """

        def supervise() -> None:
            self._check_cancelled_between()
            self.tick()

        self._journal.brought = None
        self._grasper.patiently(lambda: self._positioner.present(label, supervise), supervise)
        self._journal.brought = label

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
        self._check_cancelled_between()
        self._grasper.check(step, label)
        return self._grasp(step, early_checks, label=label)[0]

    def grip(self, force_n: float, pose: Pose | None = None) -> GraspRecord:
        """Close with a force ramp and keep the part: COMPLETE, without a name.

        Without a ``pose`` the positioner does not move.

        Raises
        ------
        NoPartFound, CellStopped, PlanRefused, gripper.errors.LimitExceeded
            As `grasp`.
        """
        self._check_cancelled_between()
        self._grasper.check(GraspStep(pose=Pose(), force_n=force_n))
        with self._executing(Event.EXECUTE):
            record = self._grasper.grip(force_n, pose)
            if record.outcome.result in NOTHING_HELD:
                self._life.complete()
            else:
                self._life.keep(since="grip")
        self._check_found(record)
        return record

    def verify(self) -> Verification:
        """Measure whether the part in the grip is still the kept one; it stays there.

        Raises
        ------
        CellStateError
            If no part is kept.
        CellStopped
            If it was cancelled: the part is then HELD, without force control.
        gripper.errors.PartLost, gripper.errors.PartSlipped
            If the part is gone or slips; this is a fault at any time of a carry.
        """
        with self._executing(Event.VERIFY):
            check = self._grasper.verify()
            self._life.keep(since="answer")
        found = "; ".join(check.reasons) or "the same part"
        self._journal.note("verify", found)
        return check

    def carry_to(self, destination: Destination) -> None:
        """Have the positioner bring the kept part to a place; the part stays in the grip.

        Raises
        ------
        CellStateError
            If no part is kept.
        CellStopped
            If it was cancelled on the way. The part is still kept.
        PositionerError
            If the place was refused or cannot be reached. The part is still kept.
        PositionerFault
            If an axis is at fault; the cell is ABORTED, the part still kept.
        gripper.errors.PartLost, gripper.errors.PartSlipped
            If the part is gone or slips on the way.
        """
        self.check(Command.VERIFY)

        def supervise() -> None:
            self._check_cancelled_in_carry(f"on the way to {destination.place}")
            self.tick()

        supervise()
        try:
            self._grasper.patiently(
                lambda: self._positioner.carry_to(destination, supervise), supervise
            )
        except Exception as error:
            # Failing fingers have latched their fault; a refusal and a stop are no faults.
            refused = isinstance(error, PositionerError | CellStopped)
            if refused or self.state is not CellState.COMPLETE:
                raise
            with self._life.latching_faults():
                raise
        self._journal.note("place", f"{destination.label} at {destination.place}")
        supervise()

    def collect(
        self,
        label: str,
        plan: Sequence[GraspStep],
        *,
        present: str | None = None,
        on_missed: Callable[[NoPartFound], None] | None = None,
    ) -> Iterator[GraspRecord]:
        """Grasp a known object once for each step of the plan, yielding each record.

        ``present`` is the object to place if its name differs from the label (simulated cell).
        ``on_missed`` gets each grasp that finds no part; the next step follows.

        Raises
        ------
        PlanRefused, gripper.errors.LimitExceeded
            At once, if the plan is empty or one of its steps cannot be carried out.
        NoPartFound
            If a grasp finds no part; with ``on_missed`` after `MISSES_IN_A_ROW` in a row.
        """
        placed = present or label
        steps = self._checked(plan, placed)

        def grasps() -> Iterator[GraspRecord]:
            self.present(placed)
            misses = 0
            for step in steps:
                try:
                    record = self.grasp(step, label=label)
                except NoPartFound as error:
                    misses += 1
                    if on_missed is None or misses == MISSES_IN_A_ROW:
                        raise
                    on_missed(error)
                else:
                    misses = 0
                    yield record

        return grasps()

    def identify(
        self,
        recognizer: Recognizer,
        plan: Sequence[GraspStep],
        *,
        early: EarlyClassifiers | None = None,
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
        steps = self._checked(plan)

        def grasp(
            step: GraspStep, early_checks: EarlyDecider | None, judge: Judge
        ) -> tuple[GraspRecord, bool]:
            self._check_cancelled_between()
            self._grasper.check(step)
            return self._grasp(step, early_checks, judge)

        found = grasp_and_classify(
            grasp,
            recognizer,
            steps,
            error_rate=self._config.sequence.error_rate,
            keep=keep,
            regrasps=self._config.sequence.regrasp == "fixture",
            early=early,
            read_shape=read_shape,
            on_grasp=on_grasp,
            execute=self._start_answer,
        )
        found = replace(found, presented=self.brought or "")
        self._journal.result(found)
        return found

    def remark(self, kind: str, text: str) -> None:
        """Write a message for the operator into the recording."""
        self._journal.note(kind, text)

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
        with self._executing(Event.EXECUTE):
            record, kept = self._grasper.grasp(step, label, early_checks, judge)
            if kept:
                self._life.keep(since="answer")
            else:
                self._life.complete()
        self._check_found(record)
        return record, kept

    @contextmanager
    def _executing(self, event: Event) -> Iterator[None]:
        """Run a command of the hand; latch its faults and record the timing of the loop."""
        self._life.go(event)
        try:
            with self._life.latching_faults():
                yield
        finally:
            self._journal.loop(self.hand.statistics)

    def _check_found(self, record: GraspRecord) -> None:
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

    def _checked(self, plan: Sequence[GraspStep], label: str = "") -> tuple[GraspStep, ...]:
        """Return the steps of a plan. Raises if the plan or one of its steps is refused."""
        steps = tuple(plan)
        if not steps:
            raise PlanRefused("the plan is empty; give at least one step")
        for step in steps:
            self._grasper.check(step, label)
        return steps

    def _check_cancelled_between(self) -> None:
        if self._life.cancelled and self._life.state is CellState.IDLE:
            self._life.cancelled = False
            raise CellStopped(
                f"stopped {self._life.stop_reason} between two grasps; the fingers are open"
            )

    def _check_cancelled_in_carry(self, when: str) -> None:
        if self._life.cancelled:
            self._life.cancelled = False
            raise CellStopped(
                f"stopped {self._life.stop_reason} {when}; the part is kept until it is released "
                f"on purpose"
            )

    def _release(self, why: str) -> ReleaseReport:
        self._life.go(Event.RELEASE)
        self._journal.note("release", why)
        with self._life.latching_faults():
            report = self.hand.release(self._grasper.watch)
            self._life.result = None
            self._life.complete()
        return report
