"""One grasp of a sequence: the move to its pose, the grasp, its record, the release."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from cell.config.sequence import (
    LinearRampConfig,
    SCurveRampConfig,
    SequenceConfig,
    StaircaseRampConfig,
)
from cell.control.journal import Journal
from cell.control.lifecycle import CellLifecycle
from cell.control.plan import GraspStep, Pose
from cell.control.positioner import PatientCaller, Positioner
from cell.control.records import GraspCollector, GraspRecord, pad_array
from cell.errors import PlanRefused
from cell.hand.interface import Hand
from gripper.force.ramp import ForceRamp
from gripper.state import Clock, Cycle, GraspResult
from recognition.grasp import Grasp, PadArray
from recognition.recognizers.early_classifiers import EarlyDecider
from tactile.frames.codec import TactileFrame


def force_ramp(
    config: LinearRampConfig | StaircaseRampConfig | SCurveRampConfig, force_n: float
) -> ForceRamp:
    """Return the ramp of the configured shape that ends at ``force_n`` N."""
    match config:
        case LinearRampConfig():
            return ForceRamp.linear(force_n, rate_n_s=config.rate_n_s, hold_s=config.hold_s)
        case StaircaseRampConfig():
            levels_n = tuple(force_n * (i + 1) / config.n_levels for i in range(config.n_levels))
            return ForceRamp.staircase(levels_n, rate_n_s=config.rate_n_s, hold_s=config.hold_s)
        case SCurveRampConfig():
            return ForceRamp.s_curve(force_n, duration_s=config.duration_s, hold_s=config.hold_s)


_T = TypeVar("_T")

NOTHING_HELD = {
    GraspResult.NO_CONTACT: "no contact",
    GraspResult.OBSTRUCTED: "the way of the fingers is obstructed, the pads felt nothing",
    GraspResult.PART_LOST: "the part was lost while the fingers pressed",
}
"""Results of a grasp after which nothing is held and nothing can be learnt."""


class Grasper:
    """Takes hand and positioner through one grasp after the other, and records them.

    Parameters
    ----------
    hand, positioner
        What grasps, and what moves the object in between.
    life
        Holds requested stops and the states to record.
    journal
        Gets what happens.
    sequence
        How the force grows.
    clock, wall_ms
        Monotonic time, and the time that people read in ms since 1970. Somebody may set the
        machine's clock back: the grasps of a run stay in order all the same.
    """

    def __init__(
        self,
        hand: Hand,
        positioner: Positioner,
        *,
        life: CellLifecycle,
        journal: Journal,
        sequence: SequenceConfig,
        clock: Clock,
        wall_ms: Callable[[], int],
    ) -> None:
        self._hand = hand
        self._positioner = positioner
        self._life = life
        self._journal = journal
        self._sequence = sequence
        self._wall_ms = wall_ms
        self._last_start_ms = 0
        self._patient = PatientCaller(clock, hand.period_s)
        self.pads: PadArray = pad_array(hand.layout)

    def check(self, step: GraspStep, label: str = "") -> None:
        """Refuse a step that cannot be carried out, before anything moves.

        Raises
        ------
        PlanRefused
            If it is no step, or the label no text.
        gripper.errors.LimitExceeded
            If its force is no number or beyond a limit.
        """
        if not (isinstance(step, GraspStep) and isinstance(step.pose, Pose)):
            raise PlanRefused(
                f"{step!r} is no step of a plan; give GraspStep(pose=..., force_n=...)"
            )
        if not isinstance(label, str):
            raise PlanRefused(f"{label!r} is no label; give a text")
        self._hand.check_ramp(self._ramp(step))

    def _ramp(self, step: GraspStep) -> ForceRamp:
        return force_ramp(self._sequence.ramp, step.force_n)

    def grasp(self, step: GraspStep, label: str, looks: EarlyDecider | None = None) -> GraspRecord:
        """Go to the pose, grasp, record, let go; with ``looks`` end the ramp where these decide."""
        reached = self._move_to(step.pose)
        collector = GraspCollector()

        def so_far() -> Grasp:
            return collector.grasp(self.pads, start_ms=start_ms)

        def watch(cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
            self._look(cycle, frames)
            collector.add(cycle, frames)
            if looks is not None and any(looks.add_frame(frame.counts, so_far) for frame in frames):
                self._hand.end_ramp()

        self._hand.open(self.watch)
        start_ms = self._last_start_ms = max(self._wall_ms(), self._last_start_ms + 1)
        outcome = self._hand.grasp(self._ramp(step), watch)
        self._life.result = outcome.result
        record = GraspRecord(
            grasp=collector.grasp(
                self.pads,
                label=label,
                source="tactile-cell",
                start_ms=start_ms,
                command=step.command,
            ),
            step=step,
            reached=reached,
            outcome=outcome,
            cycles=collector.cycles,
            early=looks.answer if looks is not None and outcome.ended_early else None,
        )
        missing = NOTHING_HELD.get(outcome.result)
        if missing is not None:
            self._journal.note("no part", f"{missing} at {reached}")
        else:
            self._journal.grasp(record.grasp)
            if record.ended:
                self._journal.note("ramp", record.ended)
        self._hand.release(self.watch)
        return record

    def watch(self, cycle: Cycle, _frames: Sequence[TactileFrame]) -> None:
        """Record one period of a motion, in which no frame matters; obey a stop."""
        self._look(cycle, ())

    def patiently(self, call: Callable[[], _T], supervise: Callable[[], None]) -> _T:
        """Wait for the positioner while both links stay alive and supervised."""
        if not self._positioner.blocks:
            return call()
        return self._patient.call(call, supervise)

    def _look(self, cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
        self._life.check_cancelled()
        self._journal.states(self._life.state, self._life.grasp_state)
        self._journal.cycle(cycle, frames)

    def _move_to(self, pose: Pose) -> Pose:
        def supervise() -> None:
            self._hand.tick()
            self._life.check_cancelled()

        reached = self.patiently(lambda: self._positioner.move_to(pose, supervise), supervise)
        self._journal.pose(reached)
        return reached
