"""The loop: each period feedback in, force in, one step of control, goals out, observer told."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gripper.clock import Clock
from gripper.errors import (
    BusCorrupt,
    BusTimeout,
    ForceSensorStale,
    GraspStopped,
    LimitExceeded,
)
from gripper.force import ForceSample, ForceSensor
from gripper.limits import ServoGoal
from gripper.missed import MissedReads
from gripper.servos import ServoGroup
from gripper.settings import GripperSettings
from gripper.state import Cycle, GripperPhase, GripperState
from gripper.timing import LoopStatistics, LoopTimer

_HEALTH_EVERY = 4

Observer = Callable[[Cycle], None]
"""Called once a period, after the goals were written; what it raises ends the command."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """What one step of control wants.

    Attributes
    ----------
    goals
        Goal of each servo; None writes nothing.
    setpoint_n
        Force that is asked for in N.
    level
        Level of the ramp that is held.
    done
        True when the command ends after this period.
    """

    goals: Sequence[ServoGoal] | None = None
    setpoint_n: float = 0.0
    level: int | None = None
    done: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """What one step of control sees.

    Attributes
    ----------
    now_s, dt_s
        Monotonic time of the feedback and time since the last step in s; a late step counts as
        two periods at most, so that nothing catches up.
    state, sample
        Feedback and newest force sample, checked for age where force matters.
    """

    now_s: float
    dt_s: float
    state: GripperState
    sample: ForceSample | None


class LoopRunner:
    """Runs one command at a time at the loop's rate, in the caller's thread.

    Parameters
    ----------
    servos, sensor, settings, clock
        Of the gripper.
    """

    def __init__(
        self,
        servos: ServoGroup,
        sensor: ForceSensor,
        settings: GripperSettings,
        clock: Clock,
    ) -> None:
        self._servos = servos
        self._sensor = sensor
        self._settings = settings
        self._clock = clock
        self._timer = LoopTimer(settings.period_s)
        self._stop = threading.Event()
        self._due_s = clock.monotonic()
        self._missed = MissedReads(servos, settings)
        self._cycles = 0

    @property
    def statistics(self) -> LoopStatistics:
        """Timing since the runner was made."""
        return self._timer.statistics()

    def request_stop(self) -> None:
        """Let the running command end with GraspStopped; safe from any thread."""
        self._stop.set()

    def forget_stop(self) -> None:
        """Begin a new command: earlier requests to stop no longer count."""
        self._stop.clear()

    def read(self) -> GripperState | None:
        """Read the feedback; None while a lost answer may still be passed over.

        Raises
        ------
        BusTimeout, BusCorrupt
            When there was no feedback for ``bus_loss_s``, or none of one servo for three periods.
        """
        asked_s = self._clock.monotonic()
        try:
            state = self._servos.feedback.read()
        except (BusTimeout, BusCorrupt) as error:
            self._timer.missed_reads += 1
            self._missed.missed(error, asked_s, self._clock.monotonic())
            return None
        self._timer.transaction(state.t_s - asked_s)
        self._missed.answered()
        return state

    def run(
        self,
        phase: GripperPhase,
        step: Callable[[Moment], Action],
        observer: Observer | None,
        *,
        needs_force: bool,
    ) -> GripperState:
        """Run steps until one is done and return the last feedback.

        Parameters
        ----------
        phase
            What the observer is told.
        step
            One step of control.
        observer
            Told of each period.
        needs_force
            True to insist on a fresh, valid force sample.

        Raises
        ------
        GraspStopped
            After `request_stop`.
        ForceSensorStale
            When the force is needed and its newest valid sample is too old.
        LimitExceeded
            When a limit stands against the goals, the force is above its cap, or the loop stalled.
        """
        period_s = self._settings.period_s
        deadline_s = self._clock.monotonic()
        if deadline_s < self._due_s:
            self._clock.sleep(self._due_s - deadline_s)
            deadline_s = self._due_s
        self._missed.answered()
        last_s = deadline_s - period_s
        fresh_s = deadline_s
        while True:
            if self._stop.is_set():
                raise GraspStopped("stopped on request")
            with self._servos.in_loop():
                state = self.read()
                if state is None:
                    self._missed.keep_still(phase)
            sample = self._sensor.latest_force()
            if state is not None:
                if needs_force and sample is not None:
                    self._timer.sensor_age(self._clock.monotonic() - sample.t_s)
                if sample is not None and sample.valid:
                    fresh_s = max(fresh_s, sample.t_s)
                    self._servos.goals.guard.note_force(sample)
                if needs_force:
                    self._check_force(state.t_s, fresh_s, sample)
                moment = Moment(
                    now_s=state.t_s,
                    dt_s=min(max(state.t_s - last_s, 0.0), 2.0 * period_s),
                    state=state,
                    sample=sample,
                )
                last_s = state.t_s
                action = step(moment)
                if action.goals is not None:
                    self._servos.goals.write(action.goals, state)
                if self._settings.derates(state.temperature_c):
                    self._timer.derated += 1
                self._look_after_health(state)
                if observer is not None:
                    observer(self._cycle(phase, moment, action))
                if action.done:
                    self._due_s = deadline_s + period_s
                    return state
            deadline_s = self._wait(deadline_s + period_s, answered=state is not None)

    def _check_force(self, now_s: float, fresh_s: float, sample: ForceSample | None) -> None:
        age_s = now_s - fresh_s
        if age_s > self._settings.force_stale_s:
            why = f" ({sample.reason})" if sample is not None and sample.reason else ""
            raise ForceSensorStale(
                f"no valid force sample for {age_s:.3f} s{why}, force_stale_s is "
                f"{self._settings.force_stale_s} s: the goals are frozen; check the tactile "
                f"sensor, then clear the fault"
            )
        self._servos.goals.guard.check_force()

    def _look_after_health(self, state: GripperState) -> None:
        self._cycles += 1
        if self._cycles % _HEALTH_EVERY == 0 or any(servo.alert for servo in state.servos):
            try:
                with self._servos.in_loop():
                    self._servos.health.poll(state)
            except (BusTimeout, BusCorrupt):
                # Feedback shows soon enough whether the bus is lost.
                self._timer.missed_reads += 1

    def _cycle(self, phase: GripperPhase, moment: Moment, action: Action) -> Cycle:
        goals = self._servos.goals.last
        return Cycle(
            t_s=moment.now_s,
            phase=phase,
            state=moment.state,
            force=moment.sample,
            setpoint_n=action.setpoint_n,
            goal_current_a=sum(goal.current_a for goal in goals) / max(1, len(goals)),
            level=action.level,
        )

    def _wait(self, deadline_s: float, *, answered: bool) -> float:
        """Wait for the next period and return its begin; a late one moves all that follow."""
        timer, settings = self._timer, self._settings
        now_s = self._clock.monotonic()
        late_s = max(0.0, now_s - deadline_s)
        timer.work_done(late_s, counts=answered)
        if late_s > settings.stall_max_s:
            timer.began(late_s)
            raise self._stalled(late_s)
        if timer.overruns_in_row >= settings.overruns_max:
            timer.began(late_s)
            raise LimitExceeded(
                f"the work of {timer.overruns_in_row} periods in a row took longer than "
                f"{1e3 * settings.period_s:.1f} ms, overruns_max is {settings.overruns_max}: the "
                f"loop does not keep its rate; lower loop_rate_hz, or free the processor"
            )
        if late_s > 0.0:
            timer.began(late_s)
            return now_s
        self._clock.sleep(deadline_s - now_s)
        late_s = max(0.0, self._clock.monotonic() - deadline_s)
        timer.began(late_s)
        if late_s > settings.stall_max_s:
            raise self._stalled(late_s)
        return deadline_s

    def _stalled(self, late_s: float) -> LimitExceeded:
        return LimitExceeded(
            f"the loop was {late_s:.3f} s late, stall_max_s is {self._settings.stall_max_s} s: the "
            f"goals are frozen, the grip is kept; find out what stopped its process, or take slow "
            f"work out of its observer and its process, then clear the fault"
        )
