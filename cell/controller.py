"""CellController: runs grasp-then-classify sequences, latches faults, owns the shutdown."""

import time
from collections.abc import Callable, Iterator, Sequence

from cell.collect import GraspRecord
from cell.config_sequence import SequenceConfig
from cell.errors import CellStateError, CellStopped, NoPartFound, PlanRefused
from cell.grasping import NOTHING_HELD, Grasper
from cell.hand import Hand
from cell.identification import Identification, OnGrasp, StepChooser, grasp_and_classify
from cell.journal import Journal
from cell.lifecycle import ON_REQUEST, CellLifecycle
from cell.positioner import Positioner
from cell.recording import Recorder
from cell.sequence import GraspStep
from cell.shapes import ReadShape
from cell.states import CellState, Event
from cell.view import CellView
from gripper.clock import Clock
from gripper.state import GripperPhase
from recognition.early import EarlyHeads, RampLooks
from recognition.grasp import PadArray
from recognition.recognizer import Recognizer


class CellController(CellView):
    """One cell: gripper, tactile sensor and positioner, driven from one thread.

    `cancel` may be called from any thread; everything else belongs to the thread that runs the
    sequences. A fault keeps the grip, latches, and needs `clear` and `reset`, two acts of a person
    or host. The part is let go by `release` and `release_held`, and at the end of each grasp of a
    sequence, whose purpose that is; never by a fault, by `cancel` or by `shutdown`.
    """

    def __init__(
        self,
        *,
        hand: Hand,
        positioner: Positioner,
        sequence: SequenceConfig,
        tare_frames: int,
        clock: Clock,
        recorder: Recorder | None = None,
        wall_ms: Callable[[], int] = lambda: time.time_ns() // 1_000_000,
    ) -> None:
        self._positioner = positioner
        self._sequence = sequence
        self._tare_frames = tare_frames
        self._journal = Journal(recorder)
        life = CellLifecycle(
            hand,
            note=self._journal.note,
            close_sensor=hand.close_sensor,
            changed=self._record_state,
        )
        super().__init__(hand, life)
        self._grasper = Grasper(
            hand,
            positioner,
            life=self._life,
            journal=self._journal,
            sequence=sequence,
            clock=clock,
            wall_ms=wall_ms,
        )
        self.pads: PadArray = self._grasper.pads

    # -- commands ------------------------------------------------------------------------------

    def start(self) -> None:
        """Verify servos and control unit, open the fingers, take the zero of the taxels.

        Raises
        ------
        CellStateError
            If the cell is not stopped, or a part is in the grip: release it on purpose first.
        CellStopped
            If it was cancelled. The cell is stopped again.
        gripper.errors.GripperError, tactile.errors.TactileError
            If a device is missing, is not what the config says, or is touched while it is zeroed.
        """
        self._life.go(Event.START)
        with self._life.latching_faults():
            self._hand.start()
            self._hand.start_sensor()
            if self._hand.phase is GripperPhase.HELD_AFTER_FAULT:
                raise CellStateError(
                    "the servos hold torque from an earlier run, a part may be in the grip; "
                    "nothing was moved. Release it on purpose: `tactile-cell release`"
                )
            self._hand.open(self._grasper.watch)
            self._hand.tare(self._tare_frames)
            self._life.check_cancelled()
            self._life.complete()

    def clear(self, *, reboot: bool = False) -> None:
        """Acknowledge the fault. The grip stays as it is.

        Parameters
        ----------
        reboot
            True to restart servos that report a hardware error, the only way on after one of them
            has switched its torque off. A part that such a servo still held would drop.

        Raises
        ------
        gripper.errors.GripperError
            If a servo does not answer or is still at fault; the fault stays latched.
        """
        self._life.clear(reboot=reboot)

    def reset(self) -> None:
        """Leave the cleared fault behind; the next `start` verifies everything anew."""
        self._life.go(Event.RESET)
        self._hand.close_sensor()

    def cancel(self, reason: str = ON_REQUEST) -> None:
        """Stop the running sequence, or else the next one, and keep the grip.

        Safe from any thread. It counts until it was obeyed: one that comes between two parts of a
        job is not lost. The ``reason`` is told with it.
        """
        self._life.stop_reason = reason
        self._life.cancelled = True
        self._hand.request_stop()

    def forget_cancel(self) -> None:
        """Withdraw a `cancel` that nothing has obeyed: what it was meant for is over."""
        self._life.cancelled = False

    def release(self) -> None:
        """Let the part go: the only way to open the fingers of a started cell.

        Raises
        ------
        CellStateError
            If the cell is not started, or a fault is latched.
        CellStopped
            If it was cancelled on the way; the fingers stand still, the message says where.
        """
        self._life.go(Event.RELEASE)
        self._life.cancelled = False
        self._journal.note("release", "on request")
        with self._life.latching_faults():
            self._hand.release(self._grasper.watch)
            self._life.result = None
            self._life.complete()

    def release_held(self) -> None:
        """Let go of a part that an earlier run or a cleared fault has left in the grip.

        For a cell that is not started; the control unit is not needed for it.

        Raises
        ------
        CellStateError
            If the cell is started, then `release` is the command; or a fault is latched.
        CellStopped
            If it was cancelled on the way; the fingers stand still, the message says where.
        gripper.errors.GripperError
            If the servos do not answer.
        """
        if not self._life.allows(Event.RELEASE_HELD):
            advice = "clear the fault first" if self._life.fault else "use release instead"
            raise CellStateError(f"the cell is {self._life.state.value}; {advice}")
        self._life.go(Event.RELEASE_HELD)
        self._life.cancelled = False
        self._hand.close_sensor()
        self._journal.note("release", "on request, before the start")
        with self._life.latching_faults():
            self._hand.start()
            self._hand.release()
            self._life.complete()

    def tick(self) -> None:
        """Keep both links alive and supervised while no sequence runs; call once a period."""
        if self._life.state in (CellState.IDLE, CellState.HELD):
            with self._life.latching_faults():
                self._hand.tick()

    def shutdown(self) -> None:
        """Leave the devices in a defined state: a held part stays held, a fault latched.

        Raises
        ------
        CellStateError
            While a command runs: cancel it first.
        """
        if self._life.state.acting:
            raise CellStateError(
                f"the cell is {self._life.state.value}; cancel what runs and wait for its end"
            )
        stopping = self._life.allows(Event.STOP)
        if stopping:
            self._life.go(Event.STOP)
        try:
            found = self._hand.shutdown()
            if found:
                self._journal.note("fault", found)
        finally:
            self._journal.loop(self._hand.statistics)
            if stopping:
                self._life.complete()

    # -- sequences -----------------------------------------------------------------------------

    def present(self, label: str | None) -> None:
        """Have the positioner bring an object; None: the one to be identified.

        Raises
        ------
        CellStopped
            If it was cancelled while somebody was asked to bring it.
        """

        def supervise() -> None:
            self._check_cancelled_between()
            self.tick()

        self._grasper.patiently(lambda: self._positioner.present(label), supervise)

    def grasp(
        self, step: GraspStep, looks: RampLooks | None = None, *, label: str = ""
    ) -> GraspRecord:
        """Run one grasp: pose, approach, contact, ramp, hold, release.

        With ``looks`` the ramp ends as soon as they decide.

        Raises
        ------
        NoPartFound
            If the fingers closed to their limit and touched nothing, did not get through, or lost
            the part while they pressed. The fingers are open again, and nothing is classified.
        CellStopped
            If it was cancelled. The grip is kept.
        PlanRefused, gripper.errors.LimitExceeded
            If the step cannot be carried out; nothing has moved, and no fault is latched.
        """
        self._check_cancelled_between()
        self._grasper.check(step, label)
        self._life.go(Event.EXECUTE)
        try:
            with self._life.latching_faults():
                record = self._grasper.grasp(step, label, looks)
                self._life.complete()
        finally:
            self._journal.loop(self._hand.statistics)
        missing = NOTHING_HELD.get(record.outcome.result)
        if missing is not None:
            raise NoPartFound(
                f"{missing} at pose {step.pose}, at an opening of "
                f"{record.outcome.final_aperture_m * 1e3:.1f} mm; is the object in place?"
            )
        return record

    def collect(self, label: str, plan: Sequence[GraspStep]) -> Iterator[GraspRecord]:
        """Grasp a known object once for each step of the plan, yielding each record.

        Raises
        ------
        PlanRefused, gripper.errors.LimitExceeded
            At once, if the plan is empty or one of its steps cannot be carried out.
        """
        steps = self._checked(plan, label)

        def grasps() -> Iterator[GraspRecord]:
            self.present(label)
            for step in steps:
                yield self.grasp(step, label=label)

        return grasps()

    def identify(
        self,
        recognizer: Recognizer,
        plan: Sequence[GraspStep],
        *,
        early: EarlyHeads | None = None,
        chooser: StepChooser | None = None,
        read_shape: ReadShape | None = None,
        on_grasp: OnGrasp | None = None,
    ) -> Identification:
        """Grasp and classify until the stop rule is satisfied or the plan is at its end.

        With ``early`` a ramp ends as soon as it satisfies the stop rule together with the grasps
        before it. With a ``chooser`` each step of the plan is a proposal that it may replace. With
        ``read_shape`` the answer has shape and size too.

        Raises
        ------
        NoPartFound, CellStopped
            As `grasp`.
        PlanRefused, gripper.errors.LimitExceeded
            If the plan is empty or one of its steps cannot be carried out; nothing has moved.
        """
        steps = self._checked(plan)
        result = grasp_and_classify(
            self.grasp,
            recognizer,
            steps,
            error_rate=self._sequence.error_rate,
            early=early,
            chooser=chooser,
            read_shape=read_shape,
            on_grasp=on_grasp,
        )
        self._journal.result(result)
        return result

    def remark(self, kind: str, text: str) -> None:
        """Put what an operator must know into the recording."""
        self._journal.note(kind, text)

    # -- inside --------------------------------------------------------------------------------

    def _checked(self, plan: Sequence[GraspStep], label: str = "") -> tuple[GraspStep, ...]:
        """Return the steps of a plan. Raises where one of them, or the plan, is refused."""
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

    def _record_state(self) -> None:
        self._journal.states(self._life.state, self._life.grasp_state)
