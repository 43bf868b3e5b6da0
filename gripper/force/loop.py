"""The force loop: each period feedback and force in, one step of control, goals out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gripper import errors
from gripper.clock import Clock
from gripper.force.certainty import YOUNG_S
from gripper.force.timing import LoopTimer
from gripper.lifecycle import Lifecycle
from gripper.servos.bus_loss import BusLossMonitor
from gripper.servos.goal_limits import ServoGoal
from gripper.servos.group import Servos
from gripper.values.force_sensor import ForceSample, ForceSensor
from gripper.values.state import Cycle, ServoFeedback

_HEALTH_EVERY = 4
"""Periods between two health checks: each takes a transaction of the period. [chosen]"""
_LONGEST_STEP = 2.0
"""Longest step of control in periods: after a late period nothing catches up. [chosen]"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """Result of one step of control."""

    goals: Sequence[ServoGoal] | None = None
    """Goal of each servo; None writes nothing."""
    setpoint_n: float = 0.0
    """Set-point of the force in N."""
    done: bool = False
    """True when the command ends after this period."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """Input of one step of control."""

    now_s: float
    dt_s: float
    """Monotonic time of the feedback and time since the last step in s; a late step counts as two
    periods at most, so that nothing catches up."""
    state: ServoFeedback
    sample: ForceSample | None
    """Feedback and newest force sample, with a checked age if the force is used."""
    stalled: bool = False
    """Whether the last goals were in force for longer than a step may last."""

    @property
    def young(self) -> bool:
        """Whether the sample is new enough for an immediate response of the drive."""
        return self.sample is not None and self.now_s - self.sample.measured_s <= YOUNG_S


Step = Callable[[Moment], Action]
"""One step of control: called once a period."""


@dataclass(slots=True, kw_only=True)
class Running:
    """State of the control step that runs now."""

    step: Step
    needs_force: bool
    """As in `LoopRunner.run`."""
    last_s: float
    """Monotonic time of the last feedback in s."""
    fresh_s: float
    """Monotonic time of the newest valid force sample in s; of the beginning before one came."""
    looked_s: float
    """Monotonic time in s at which the last period began."""
    done: bool = False
    """Whether the last step was the last one."""


class LoopRunner:
    """Runner of the steps of one command at the loop's rate, in the caller's thread.

    Parameters
    ----------
    servos, sensor, clock, life
        Of the gripper.
    """

    def __init__(self, servos: Servos, sensor: ForceSensor, clock: Clock, life: Lifecycle) -> None:
        self.servos = servos
        self._sensor = sensor
        self._settings = servos.settings
        self._clock = clock
        self._life = life
        self.timer = LoopTimer(self._settings.period_s)
        """Timing since the runner was made."""
        self._due_s = clock.monotonic()
        self._bus_loss = BusLossMonitor(servos)
        self._cycles = 0

    def read(self) -> ServoFeedback | None:
        """Read the feedback; None while a lost answer is still tolerated.

        Raises
        ------
        BusTimeout, BusCorrupt
            When no servo answered for ``bus_loss_s``, or one servo for three periods.
        BusUnreliable
            When too many periods had no feedback.
        """
        asked_s = self._clock.monotonic()
        try:
            state = self.servos.read()
        except (errors.BusTimeout, errors.BusCorrupt) as error:
            self.timer.missed_reads += 1
            self._bus_loss.missed(error, asked_s, self._clock.monotonic())
            return None
        self.timer.transaction.add(state.t_s - asked_s)
        self._bus_loss.answered()
        return state

    def run(self, step: Step, *, needs_force: bool = True) -> ServoFeedback:
        """Run steps until one is done and return the last feedback.

        Parameters
        ----------
        step
            One step of control.
        needs_force
            True to require a new, valid force sample.

        Raises
        ------
        GraspStopped
            When the command shall stop.
        ForceSensorStale
            When the force is needed and its newest valid sample is too old.
        LimitExceeded
            When the goals exceed a limit, the force is above its cap, or the loop stalled.
        """
        deadline_s = self._clock.monotonic()
        if deadline_s < self._due_s:
            self._clock.sleep(self._due_s - deadline_s)
            deadline_s = self._due_s
        running = self.start_command(step, needs_force=needs_force, now_s=deadline_s)
        while True:
            if self._life.stop_request.is_set():
                raise errors.GraspStopped("stopped on request")
            cycle = self.period(running)
            deadline_s += self._settings.period_s
            if cycle is not None and self._life.observer is not None:
                self._life.observer(cycle)
            if cycle is not None and running.done:
                self._due_s = deadline_s
                return cycle.state
            deadline_s = self._wait(deadline_s, answered=cycle is not None)

    def start_command(self, step: Step, *, needs_force: bool = True, now_s: float) -> Running:
        """Return steps whose periods the caller runs, each with `period`; arguments as in `run`.

        ``now_s``: monotonic time in s from which the age of the force counts.
        """
        self._bus_loss.start_counting()
        return Running(
            step=step,
            needs_force=needs_force,
            last_s=now_s - self._settings.period_s,
            fresh_s=now_s,
            looked_s=now_s - self._settings.period_s,
        )

    def period(self, running: Running) -> Cycle | None:
        """Run one period and return it; None if an answer was lost.

        Raises as `run`, except for a stop and for lateness: the caller keeps the time. Limits of
        silence of servos and pads are extended by the lateness of the period.
        """
        begin_s = self._clock.monotonic()
        late_s = max(0.0, begin_s - running.looked_s - self._settings.period_s)
        running.looked_s = begin_s
        running.fresh_s += late_s
        self._bus_loss.wait_longer(late_s)
        with self.servos.in_loop():
            state = self.read()
            if state is None:
                self._bus_loss.stop_fingers(self._life.phase)
        # Pads and CAN are supervised in each period, also without answers of the servos.
        sample = self._sensor.latest_force()
        self.servos.goals.note_force(sample)
        if sample is not None and sample.valid:
            running.fresh_s = max(running.fresh_s, sample.t_s)
        if running.needs_force:
            now_s = self._clock.monotonic() if state is None else state.t_s
            self._check_force(now_s, running.fresh_s, sample)
        if state is None:
            return None
        passed_s, period_s = max(state.t_s - running.last_s, 0.0), self._settings.period_s
        running.last_s = state.t_s
        moment = Moment(
            now_s=state.t_s,
            dt_s=min(passed_s, _LONGEST_STEP * period_s),
            state=state,
            sample=sample,
            stalled=passed_s > (_LONGEST_STEP + 0.5) * period_s,
        )
        try:
            action = running.step(moment)
        except errors.LimitExceeded:
            # A goal beyond a limit may be caused by a force above the cap. Report that fault first.
            self.servos.goals.check_force(noise_excluded=True)
            raise
        except (errors.PartLost, errors.PartSlipped):
            # A servo without torque lets the part go. Report this as the cause.
            self.servos.check_torques()
            raise
        if action.goals is not None:
            self.servos.goals.write(action.goals, state)
        self.timer.derated += any(
            servo.limit_a < self._settings.current_max_a for servo in state.servos
        )
        self._check_health(state)
        running.done = action.done
        return Cycle(
            t_s=state.t_s,
            phase=self._life.phase,
            state=state,
            force=sample,
            setpoint_n=action.setpoint_n,
            goal_current_a=self.servos.goal_current_a,
        )

    def _check_force(self, now_s: float, fresh_s: float, sample: ForceSample | None) -> None:
        if sample is not None:
            self.timer.sensor_age.add(self._clock.monotonic() - sample.t_s)
        age_s = now_s - fresh_s
        if age_s > self._settings.force_stale_s:
            why = f" ({sample.reason})" if sample is not None and sample.reason else ""
            raise errors.ForceSensorStale(
                f"no valid force sample for {age_s:.3f} s{why}, force_stale_s is "
                f"{self._settings.force_stale_s} s: the goals are frozen; check the tactile "
                f"sensor, then clear the fault"
            )
        self.servos.goals.check_force()

    def _check_health(self, state: ServoFeedback) -> None:
        self._cycles += 1
        if self._cycles % _HEALTH_EVERY == 0 or any(servo.alert for servo in state.servos):
            try:
                with self.servos.in_loop():
                    self.servos.poll(state)
            except (errors.BusTimeout, errors.BusCorrupt):
                # The feedback soon shows whether the bus is lost.
                self.timer.missed_reads += 1

    def _wait(self, deadline_s: float, *, answered: bool) -> float:
        """Wait for the next period and return its start; a late one delays all later ones."""
        timer, settings = self.timer, self._settings
        now_s = self._clock.monotonic()
        late_s = max(0.0, now_s - deadline_s)
        timer.work_done(late_s, counts=answered)
        in_time = late_s <= 0.0
        if in_time:
            self._clock.sleep(deadline_s - now_s)
            late_s = max(0.0, self._clock.monotonic() - deadline_s)
        timer.began(late_s)
        if late_s > settings.stall_max_s:
            raise errors.LimitExceeded(
                f"the loop was {late_s:.3f} s late, stall_max_s is {settings.stall_max_s} s: the "
                f"goals are frozen, the grip is kept; find what stopped its process, or remove "
                f"slow work from its observer and its process, then clear the fault"
            )
        if timer.overruns_in_row >= settings.overruns_max:
            raise errors.LimitExceeded(
                f"the work of {timer.overruns_in_row} periods in a row took longer than "
                f"{1e3 * settings.period_s:.1f} ms, overruns_max is {settings.overruns_max}: the "
                f"loop does not keep its rate; lower loop_rate_hz, or free the processor"
            )
        return deadline_s if in_time else now_s
