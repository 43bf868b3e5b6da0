"""CellController: runs grasp-then-classify sequences, latches faults, owns the shutdown."""

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, TypeVar

from cell.collect import GraspCollector, GraspRecord, SensorTap, pad_array
from cell.config import SequenceConfig
from cell.errors import CellStateError, CellStopped, NoPartFound
from cell.pose import Pose
from cell.positioner import Positioner
from cell.ramps import force_ramp
from cell.recording import Recorder
from cell.sequence import GraspStep
from cell.states import CellState, Event, next_state
from gripper.clock import Clock
from gripper.errors import GraspStopped, GripperError
from gripper.gripper import Cycle, GraspResult, Gripper, GripperPhase
from recognition.fusion import Decision, DecisionKind, StopRule, decide, fuse
from recognition.grasp import PadArray
from recognition.recognizer import Posterior, Recognizer
from tactile.sensor import TactileSensor

_T = TypeVar("_T")
_HOLDING = (
    GripperPhase.APPROACHING,
    GripperPhase.RAMPING,
    GripperPhase.HOLDING,
    GripperPhase.BACKING_OFF,
    GripperPhase.HELD_AFTER_FAULT,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Identification:
    """The answer of one grasp-then-classify sequence.

    Attributes
    ----------
    label
        A taught label, or ``UNKNOWN``.
    probability
        Probability of the label after all grasps.
    decision
        Why the sequence ended.
    posteriors
        What each grasp told by itself, in order.
    fused
        What all grasps tell together.
    records
        The grasps.
    """

    label: str
    probability: float
    decision: Decision
    posteriors: tuple[Posterior, ...]
    fused: Posterior
    records: tuple[GraspRecord, ...]


class StepChooser(Protocol):
    """Says which grasp comes next, given what the grasps so far have told."""

    def next_step(self, posteriors: Sequence[Posterior], planned: GraspStep, /) -> GraspStep:
        """Return the step to take: the planned one, or another within the cell's limits."""
        ...


class CellController:
    """One cell: gripper, tactile sensor and positioner, driven from one thread.

    `cancel` may be called from any thread; everything else belongs to the thread that runs the
    sequences. A fault keeps the grip, latches, and needs `clear` and `reset`, two acts of a person
    or host. The part is let go by `release` and `release_held`, and at the end of each grasp of a
    sequence, whose purpose that is; never by a fault, by `cancel` or by `shutdown`.
    """

    def __init__(
        self,
        *,
        gripper: Gripper,
        sensor: TactileSensor,
        tap: SensorTap,
        positioner: Positioner,
        sequence: SequenceConfig,
        tare_frames: int,
        clock: Clock,
        recorder: Recorder | None = None,
        wall_ms: Callable[[], int] = lambda: time.time_ns() // 1_000_000,
    ) -> None:
        self._gripper = gripper
        self._sensor = sensor
        self._tap = tap
        self._positioner = positioner
        self._sequence = sequence
        self._tare_frames = tare_frames
        self._clock = clock
        self._recorder = recorder
        self._wall_ms = wall_ms
        self._state = CellState.STOPPED
        self._fault: str | None = None
        self._cancelled = False
        self.pads: PadArray = pad_array(sensor.layout)

    # -- state ---------------------------------------------------------------------------------

    @property
    def state(self) -> CellState:
        """The present state."""
        return self._state

    @property
    def fault(self) -> str | None:
        """What went wrong, while a fault is latched."""
        return self._fault

    @property
    def holding(self) -> bool:
        """Whether a part may be in the grip."""
        return self._gripper.state in _HOLDING

    @property
    def gripper(self) -> Gripper:
        """The gripper, for statistics; commands go through the controller."""
        return self._gripper

    @property
    def sensor(self) -> TactileSensor:
        """The tactile sensor, for statistics."""
        return self._sensor

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
        self._go(Event.START)
        with self._latching_faults():
            self._gripper.start()
            self._sensor.start()
            self._tap.running = True
            if self._gripper.state is GripperPhase.HELD_AFTER_FAULT:
                raise CellStateError(
                    "the servos hold torque from an earlier run, a part may be in the grip; "
                    "nothing was moved. Release it on purpose: `tactile-cell release`"
                )
            self._gripper.open(observer=self._watch)
            self._sensor.tare(self._tare_frames)
            self._check_cancelled()
            self._go(Event.STARTED)

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
        self._go(Event.CLEAR)
        try:
            self._gripper.clear_fault(reboot=reboot)
        except BaseException:
            self._go(Event.FAULT)
            self._go(Event.ABORTED)
            raise
        self._fault = None
        self._go(Event.CLEARED)

    def reset(self) -> None:
        """Leave the cleared fault behind; the next `start` verifies everything anew."""
        self._go(Event.RESET)
        self._close_sensor()

    def cancel(self) -> None:
        """Stop the running sequence, or else the next one, and keep the grip.

        Safe from any thread. It counts until it was obeyed: one that comes between two parts of a
        job is not lost.
        """
        self._cancelled = True
        self._gripper.request_stop()

    def forget_cancel(self) -> None:
        """Withdraw a `cancel` that nothing has obeyed: what it was meant for is over."""
        self._cancelled = False

    def release(self) -> None:
        """Let the part go: the only way to open the fingers of a started cell.

        Raises
        ------
        CellStateError
            If the cell is not started, or a fault is latched.
        CellStopped
            If it was cancelled on the way; the fingers stay where they are.
        """
        self._go(Event.RELEASE)
        self._cancelled = False
        self._note("release", "on request")
        with self._latching_faults():
            self._gripper.release(observer=self._watch)
            self._go(Event.DONE)

    def release_held(self) -> None:
        """Let go of a part that an earlier run or a cleared fault has left in the grip.

        For a cell that is not started; the control unit is not needed for it.

        Raises
        ------
        CellStateError
            If the cell is started, then `release` is the command; or a fault is latched.
        CellStopped
            If it was cancelled on the way; the fingers stay where they are.
        gripper.errors.GripperError
            If the servos do not answer.
        """
        if self._state not in (CellState.STOPPED, CellState.RESETTING):
            advice = "clear the fault first" if self._fault else "use release instead"
            raise CellStateError(f"the cell is {self._state.value}; {advice}")
        self._cancelled = False
        self._close_sensor()
        self._note("release", "on request, before the start")
        with self._latching_faults():
            self._gripper.start()
            self._gripper.release()

    def tick(self) -> None:
        """Keep both links alive and supervised while no sequence runs; call once a period."""
        if self._state in (CellState.IDLE, CellState.HELD):
            with self._latching_faults():
                self._supervise()

    def shutdown(self) -> None:
        """Leave the devices in a defined state: a held part stays held. Never raises twice."""
        self._gripper.close()
        self._close_sensor()
        if self._state in (CellState.IDLE, CellState.HELD):
            self._go(Event.STOP)

    # -- sequences -----------------------------------------------------------------------------

    def present(self, label: str | None) -> None:
        """Have the positioner bring an object; None: the one to be identified."""
        self._patiently(lambda: self._positioner.present(label), self.tick)

    def grasp(self, step: GraspStep, *, label: str = "") -> GraspRecord:
        """Run one grasp: pose, approach, contact, ramp, hold, release.

        Raises
        ------
        NoPartFound
            If the fingers closed to their limit and touched nothing. The fingers are open again.
        CellStopped
            If it was cancelled. The grip is kept.
        """
        return self._run_grasp(step, label)

    def collect(self, label: str, plan: Sequence[GraspStep]) -> Iterator[GraspRecord]:
        """Grasp a known object once for each step of the plan, yielding each record."""
        self.present(label)
        for step in plan:
            yield self._run_grasp(step, label)

    def identify(
        self,
        recognizer: Recognizer,
        plan: Sequence[GraspStep],
        *,
        chooser: StepChooser | None = None,
        on_grasp: Callable[[int, GraspRecord, Posterior], None] | None = None,
    ) -> Identification:
        """Grasp and classify until the stop rule is satisfied or the plan is at its end.

        With a ``chooser`` each step of the plan is a proposal that it may replace.

        Raises
        ------
        NoPartFound, CellStopped
            As `grasp`.
        """
        rule = StopRule(error_rate=self._sequence.error_rate, max_grasps=len(plan))
        posteriors: list[Posterior] = []
        records: list[GraspRecord] = []
        for number, step in enumerate(plan, start=1):
            chosen = step if chooser is None else chooser.next_step(posteriors, step)
            record = self._run_grasp(chosen, "")
            posterior = recognizer.posterior(record.grasp)
            records.append(record)
            posteriors.append(posterior)
            if on_grasp is not None:
                on_grasp(number, record, posterior)
            decision = decide(posteriors, rule)
            if decision.kind is not DecisionKind.CONTINUE:
                break
        result = Identification(
            label=decision.label,
            probability=decision.probability,
            decision=decision,
            posteriors=tuple(posteriors),
            fused=fuse(posteriors),
            records=tuple(records),
        )
        if self._recorder is not None:
            self._recorder.result(
                label=result.label,
                probability=result.probability,
                labels=result.fused.labels,
                probabilities=[float(p) for p in result.fused.probability],
                unknown=result.fused.unknown,
                n_grasps=len(records),
            )
        return result

    # -- inside --------------------------------------------------------------------------------

    def _run_grasp(self, step: GraspStep, label: str) -> GraspRecord:
        if self._cancelled and self._state is CellState.IDLE:
            self._cancelled = False
            raise CellStopped("stopped on request between two grasps; the fingers are open")
        self._go(Event.EXECUTE)
        with self._latching_faults():
            record = self._grasp(step, label)
            self._go(Event.DONE)
        if record.outcome.result is GraspResult.NO_CONTACT:
            raise NoPartFound(
                f"no contact at pose {step.pose} down to an opening of "
                f"{record.outcome.final_aperture_m * 1e3:.1f} mm; is the object in place?"
            )
        return record

    def _grasp(self, step: GraspStep, label: str) -> GraspRecord:
        reached = self._move_to(step.pose)
        collector = GraspCollector()

        def observe(cycle: Cycle) -> None:
            self._check_cancelled()
            readings = self._tap.take()
            collector.add(cycle, readings)
            if self._recorder is not None:
                self._recorder.cycle(cycle)
                for reading in readings:
                    self._recorder.frame(reading.frame)

        self._gripper.open(observer=self._watch)
        self._tap.take()
        start_ms = self._wall_ms()
        outcome = self._gripper.grasp(
            force_ramp(self._sequence.ramp, step.force_n), observer=observe
        )
        record = GraspRecord(
            grasp=collector.grasp(self.pads, label=label, source="tactile-cell", start_ms=start_ms),
            step=step,
            reached=reached,
            outcome=outcome,
            cycles=collector.cycles,
        )
        if outcome.result is GraspResult.NO_CONTACT:
            self._note("no part", f"nothing touched at {reached}")
        elif self._recorder is not None:
            self._recorder.grasp(record.grasp)
        self._gripper.release(observer=self._watch)
        return record

    def _check_cancelled(self) -> None:
        if self._cancelled:
            raise GraspStopped("stopped on request")

    def _move_to(self, pose: Pose) -> Pose:
        reached = self._patiently(lambda: self._positioner.move_to(pose), self._supervise)
        if self._recorder is not None:
            self._recorder.pose(reached)
        return reached

    def _supervise(self) -> None:
        self._gripper.tick()
        self._tap.latest_force()
        self._tap.take()

    def _close_sensor(self) -> None:
        self._tap.running = False
        self._sensor.close()

    def _patiently(self, call: Callable[[], _T], supervise: Callable[[], None]) -> _T:
        """Wait for a positioner that blocks while both links stay alive and supervised."""
        if not self._positioner.blocks:
            return call()
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="positioner") as pool:
            future = pool.submit(call)
            while not future.done():
                supervise()
                self._clock.sleep(self._gripper.period_s)
            return future.result()

    def _watch(self, cycle: Cycle) -> None:
        self._check_cancelled()
        self._tap.take()
        if self._recorder is not None:
            self._recorder.cycle(cycle)

    def _go(self, event: Event) -> None:
        try:
            following = next_state(self._state, event)
        except ValueError as error:
            hint = f"; fault: {self._fault}" if self._fault else ""
            raise CellStateError(f"{error}{hint}") from None
        self._state = following

    def _note(self, kind: str, text: str) -> None:
        if self._recorder is not None:
            self._recorder.event(kind, text)

    @contextmanager
    def _latching_faults(self) -> Iterator[None]:
        """Keep the grip on whatever goes wrong; a stop on request holds, all else is a fault."""
        try:
            try:
                yield
            except GraspStopped as stop:
                self._hold(stop)
                raise
        except GraspStopped as stop:
            self._cancelled = False
            raise CellStopped(
                "stopped on request; the grip is kept until it is released on purpose"
                if self.holding
                else "stopped on request; nothing is held"
            ) from stop
        except BaseException as error:
            self._fault = f"{type(error).__name__}: {error}"
            self._go(Event.FAULT)
            self._note("fault", self._fault)
            try:
                self._gripper.keep_grip()
            except GripperError as second:
                self._note("fault", f"the grip could not be confirmed: {second}")
            self._go(Event.ABORTED)
            raise

    def _hold(self, stop: GraspStopped) -> None:
        """Go where a stop on request leads from the present state."""
        self._gripper.keep_grip()
        if self._state is CellState.STARTING:
            self._close_sensor()
            self._go(Event.STOP)
        elif self._state is CellState.EXECUTE:
            self._go(Event.HOLD)
            self._note("held", str(stop))
            self._go(Event.HELD)
