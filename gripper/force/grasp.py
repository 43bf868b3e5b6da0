"""One grasp: approach, contact, ramp, settling; then holding, backing off and further ramps."""

import threading
from collections.abc import Callable
from dataclasses import replace

from gripper.errors import GripContradicted, PartLost
from gripper.force.approach.approach import Approach, ApproachEvent, ContactRest
from gripper.force.approach.mechanics_proof import LARGEST_MIN_M, ZERO_RANGE_M, meeting, not_met
from gripper.force.certainty import RUN_STEPS, STEADY_S
from gripper.force.control.grip_control import GripControl
from gripper.force.estimates.free_motion import FreeMotion
from gripper.force.estimates.grip import SOFTEST_N_M
from gripper.force.loop import Action, LoopRunner, Moment
from gripper.force.ramp import ForceRamp
from gripper.force.supervision.part_watch import EmptyGrip
from gripper.mechanics.transmission import Mechanics
from gripper.servos.goal_limits import EQUAL, check_temperature, standing
from gripper.settings import GripperSettings
from gripper.values.outcome import GraspOutcome, GraspResult
from gripper.values.state import GripperPhase, ServoFeedback

_BEGINS_M, _SURPRISE_M = 0.0005, 0.0015
"""Margin in m by which the next part may be wider than all earlier ones: the first value, and the
second over the number of these parts, because each is equally likely to be the widest. [tuned]"""
_HARD = 2.0
"""Least force of a hard touch over the force of a contact. A usual touch must not rest longer: the
opening after it is the size of the part. [chosen]"""


class GraspRun:
    """Runner of the phases of a grasp; keeps the control of the held part.

    Parameters
    ----------
    runner
        Of the gripper.
    set_phase
        Gets each new phase of a grasp.
    free
        Gets the free motion of each approach.
    """

    def __init__(
        self, runner: LoopRunner, set_phase: Callable[[GripperPhase], None], free: FreeMotion
    ) -> None:
        self._runner = runner
        self._set_phase = set_phase
        self._free = free
        self._mechanics, self._settings = runner.servos.mechanics, runner.servos.settings
        self.end = threading.Event()
        """Request to end the running ramp; each grasp discards earlier requests."""
        self._ramp_step: ContactStep | None = None
        self.start_proving()

    @property
    def control(self) -> GripControl | None:
        """Control of the grip force; None while nothing is held."""
        return None if self._ramp_step is None else self._ramp_step.control

    def start_proving(self) -> None:
        """Repeat the proof of the closed position and the learning, after the torque comes on."""
        self._closed_is_proven = False
        self._widest_m, self._touched = 0.0, 0

    def run(self, ramp: ForceRamp) -> GraspOutcome:
        """Approach, then follow the ramp to its end, or until it is ended on request."""
        reached = self._approach(self._mechanics)
        contact = reached.state
        if reached.event is ApproachEvent.OBSTRUCTED:
            raise _obstructed(reached)
        if reached.event is not ApproachEvent.CONTACT:
            # Fingers that are slow stick and slip: their last way counts, not their speed.
            apertures = reached.stiffness.apertures
            closed_m = apertures.at(contact.t_s - STEADY_S) - contact.aperture_m
            closing = closed_m > RUN_STEPS * reached.stiffness.step_m
            closed = contact.aperture_m <= self._settings.aperture_min_m
            self._confirm_empty(contact, ran=closed or closing, stiffness_n_m=None)
            self._set_phase(GripperPhase.APPROACHING)
            # Checked once, after a grasp without a part: the pads must stop each other.
            farther = closed and self._settings.aperture_min_m <= LARGEST_MIN_M
            if farther and not self._closed_is_proven:
                self._closed()
            return GraspOutcome(result=GraspResult.NO_CONTACT, final_aperture_m=contact.aperture_m)
        self._widest_m = max(self._widest_m, reached.touch_m)
        self._touched += 1
        return self._press(ramp, reached, slips=True)

    def press_pads_together(self, ramp: ForceRamp) -> GraspOutcome:
        """Close the empty fingers onto each other and follow a ramp, see `Gripper`."""
        reached = self._closed()
        if reached.event is ApproachEvent.OBSTRUCTED:
            raise _obstructed(reached)
        if reached.state.aperture_m > ZERO_RANGE_M:
            self.end.set()
        return self._press(ramp, reached, slips=False)

    def _press(self, ramp: ForceRamp, reached: Approach, *, slips: bool) -> GraspOutcome:
        """Rest at the contact, follow a ramp; forget a part that is lost on the ramp."""
        self._set_phase(GripperPhase.RAMPING)
        contact = reached.state
        rest = ContactRest(contact.t_s, hard_n=_HARD * self._settings.contact_force_n)

        def rest_then_press(moment: Moment) -> Action:
            reached.stiffness.push(moment)
            if self._ramp_step is not None:
                return self._ramp_step.step(moment)
            if rest.goes_on(moment):
                return Action()
            control = GripControl(reached, force_n=rest.force_n, moment=moment)
            begun = ramp.starting_from(rest.force_n)
            settings = reached.settings
            self._ramp_step = ContactStep(settings, control, begun, self.end, slips=slips)
            return self._ramp_step.press(moment)

        final, step = self._runner.run(rest_then_press), self._ramp_step
        assert step is not None
        if step.lost:
            stiffness_n_m = reached.stiffness.stiffness_n_m or SOFTEST_N_M
            ran = step.control.watch.ran
            self._confirm_empty(final, ran=ran, stiffness_n_m=stiffness_n_m)
            self._ramp_step = None
        outcome = step.outcome(final)
        return replace(outcome, contact_t_s=contact.t_s, contact_aperture_m=contact.aperture_m)

    def _confirm_empty(
        self, state: ServoFeedback, *, ran: bool, stiffness_n_m: float | None
    ) -> None:
        """Return when no measurement shows a part; else raise GripContradicted."""
        self._set_phase(GripperPhase.HOLDING)
        step = EmptyGrip(self._mechanics, state, stiffness_n_m=stiffness_n_m, ran=ran)
        self._runner.run(step.step)

    def squeeze(self, control: GripControl, ramp: ForceRamp) -> GraspOutcome:
        """Follow a further ramp in the same grip; see `Gripper.squeeze`."""
        begun = ramp.starting_from(control.grip.setpoint_n)
        control.resume(ramp.final_n)
        step = GripStep(self._settings, control, begun)
        return step.outcome(self._runner.run(step.step))

    def _approach(self, mechanics: Mechanics) -> Approach:
        """Close until the contact, or the end of the travel, and update the estimates.

        The last grip, and earlier requests to end a ramp, are discarded.
        """
        self._ramp_step = None
        self.end.clear()
        # Fingers that shall meet find no part.
        widest_m = None
        if mechanics is self._mechanics and self._touched > 0:
            widest_m = self._widest_m + _BEGINS_M + _SURPRISE_M / self._touched
        approach = Approach(mechanics, self._runner.servos.read_patiently(), widest_m=widest_m)
        self._free.run(approach.step, approach.runs_freely)
        return approach

    def _closed(self) -> Approach:
        """Close until the pads meet; raise MechanicsContradicted if nothing stops the fingers."""
        reached = self._approach(meeting(self._mechanics))
        if reached.event is ApproachEvent.LIMIT:
            raise not_met(reached.mechanics, reached.state, reached.friction_advice)
        self._closed_is_proven = True
        return reached


class RampTime:
    """Time on a ramp: it stops at the start of the hold until the force has risen to it.

    So the end of the ramp is held for the whole time, also after a fast change.

    Parameters
    ----------
    settings
        Of the gripper.
    ramp
        The ramp.
    """

    def __init__(self, settings: GripperSettings, ramp: ForceRamp) -> None:
        self._settings = settings
        self.requested_n = ramp.final_n
        """Planned force in N at the end of the ramp."""
        self._begin(ramp)

    def _begin(self, ramp: ForceRamp) -> None:
        self.ramp, self.elapsed_s, self._waited_s = ramp, 0.0, 0.0
        self.holds = ramp.change_s == 0.0
        """Whether the hold has begun."""

    @property
    def setpoint_n(self) -> float:
        """Present set-point in N."""
        return self.ramp.setpoint_n(self.elapsed_s)

    def advance(self, dt_s: float, force_n: float, aperture_m: float) -> None:
        """Advance by ``dt_s`` s, at a force of ``force_n`` N and an opening in m.

        A rise ends with closed fingers: part and foam yield without more force.
        """
        settings, ramp, least_n = self._settings, self.ramp, self._settings.contact_force_n
        closed = aperture_m <= settings.least_pressed_m
        if closed and least_n <= self.setpoint_n < ramp.final_n:
            self._begin(ForceRamp.steady(min(self.setpoint_n, max(force_n, least_n))))
            return
        if self.holds or self.elapsed_s < ramp.change_s:
            self.elapsed_s += dt_s
        if not self.holds and self.elapsed_s >= ramp.change_s:
            self._waited_s += dt_s
            least_n = ramp.final_n - settings.settle_tolerance_at_n(ramp.final_n)
            self.holds = force_n >= least_n or self._waited_s > settings.settle_timeout_s

    def settled(self, force_n: float) -> bool:
        """Return whether the ramp is over and its force reached, or its time is over."""
        left_s = self.ramp.duration_s - self.elapsed_s
        if left_s > EQUAL or not self.holds:
            return False
        final_n = self.ramp.final_n
        return (
            abs(force_n - final_n) <= self._settings.settle_tolerance_at_n(final_n)
            or -left_s >= self._settings.settle_timeout_s
        )


class GripStep:
    """Step of control of a grip along a ramp, from its present set-point until it has settled.

    Parameters
    ----------
    settings
        Of the gripper, which end a rise of closed fingers.
    control
        Control of the held part; the caller resumes it for the change.
    ramp
        The change of force.
    """

    def __init__(self, settings: GripperSettings, control: GripControl, ramp: ForceRamp) -> None:
        self.control = control
        """Control of the grip force."""
        self.lost = False
        """True when the part was lost; then the fingers hold their positions."""
        self._settings = settings
        self._time = RampTime(settings, ramp)
        self._slips, self._peak_n, self._ended = True, 0.0, False

    def step(self, moment: Moment) -> Action:
        """Return the action of one period; PartLost, PartSlipped when the part goes."""
        if self.control.watch.update(moment):
            raise PartLost(
                f"the part has slipped out or was taken: the pads are empty, or nothing holds the "
                f"fingers apart, at an opening of {moment.state.aperture_m * 1e3:.1f} mm; the "
                f"fingers stand still"
            )
        self._time.advance(moment.dt_s, self.control.grip.force_n, moment.state.aperture_m)
        return self._action(moment)

    def _action(self, moment: Moment) -> Action:
        """Return the action of one period at the present time on the ramp."""
        control, time = self.control, self._time
        goals = control.goals(moment, time.setpoint_n, arrival_n=time.ramp.final_n)
        setpoint_n = control.grip.setpoint_n
        self._peak_n = max(self._peak_n, control.force_n)
        if self.lost:
            goals = standing(goals, moment.state)
        elif self._slips and time.holds and not control.watch.suspicious:
            opens = control.grip.opened_s == moment.now_s
            control.slip.check(moment, setpoint_n=setpoint_n, opens=opens)
        done = self.lost or self._over(control.force_n)
        if done and not self.lost:
            # The last goals stay in force: a push would go on.
            goals = control.quiet_goals(moment)
        return Action(goals=goals, setpoint_n=setpoint_n, done=done)

    def _over(self, force_n: float) -> bool:
        """Return whether the step is the last one, at a force in N."""
        return self._time.settled(force_n)

    def outcome(self, final: ServoFeedback) -> GraspOutcome:
        """Return the outcome of the ramp; ``final`` is its last feedback."""
        final_n = self.control.force_n
        requested_n, ended_n = self._time.requested_n, self._time.ramp.final_n
        reached = abs(final_n - requested_n) <= self._settings.settle_tolerance_at_n(requested_n)
        held = GraspResult.FORCE_REACHED if reached else GraspResult.FORCE_NOT_REACHED
        unreached = ""
        if not (reached or self.lost):
            unreached = f"the ramp ended with {final_n:.1f} N; {requested_n:.1f} N were asked for"
            if ended_n < requested_n:
                least_mm = 1e3 * self._settings.least_pressed_m
                unreached += (
                    f": the part is too small or soft at {1e3 * final.aperture_m:.1f} mm "
                    f"(gripper.aperture_min_mm is {least_mm:g}). Ask for less, or lower it as far "
                    f"as the foam yields"
                )
        return GraspOutcome(
            result=GraspResult.PART_LOST if self.lost else held,
            final_aperture_m=final.aperture_m,
            final_force_n=final_n,
            overshoot_n=max(0.0, self._peak_n - ended_n),
            ended_early=self._ended,
            unreached=unreached,
        )


class ContactStep(GripStep):
    """Step of control from a contact along a ramp, until it has settled or the part is lost.

    Parameters
    ----------
    settings
        Those of the approach.
    control
        Control of the part, just begun.
    ramp
        Set-point of the grip force, from the measured force at the contact.
    end
        Request to end the ramp early.
    slips
        Whether a part could slip.
    """

    def __init__(
        self,
        settings: GripperSettings,
        control: GripControl,
        ramp: ForceRamp,
        end: threading.Event,
        *,
        slips: bool,
    ) -> None:
        super().__init__(settings, control, ramp)
        self._end, self._slips = end, slips

    def step(self, moment: Moment) -> Action:
        """Return the action of one period. Raises PartSlipped when a held part slips."""
        if not self._ended and self._ends_early():
            self._time = RampTime(self._settings, ForceRamp.steady(self._time.setpoint_n))
            self._ended = True
        else:
            self._time.advance(moment.dt_s, self.control.grip.force_n, moment.state.aperture_m)
        return self.press(moment)

    def press(self, moment: Moment) -> Action:
        """Return the action of one period at the present time on the ramp."""
        self.lost = self.control.watch.update(moment)
        return self._action(moment)

    def _ends_early(self) -> bool:
        """Return whether to end the ramp now: requested, not over, and enough to hold a part."""
        return (
            self._end.is_set()
            and self._time.ramp.duration_s - self._time.elapsed_s > EQUAL
            and self._time.setpoint_n >= self._settings.contact_force_n
        )


class HoldStep(GripStep):
    """Step of control that holds the last set-point for a time in s; it may be without end."""

    def __init__(self, settings: GripperSettings, control: GripControl, duration_s: float) -> None:
        held_n = control.grip.setpoint_n
        control.resume(held_n)
        super().__init__(settings, control, ForceRamp.steady(held_n))
        self._left_s = duration_s

    def step(self, moment: Moment) -> Action:
        """Return the action of one period.

        Raises PartLost, PartSlipped when the part goes, LimitExceeded when a servo is too warm.
        """
        check_temperature(self._settings, moment.state)
        self._left_s -= moment.dt_s
        return super().step(moment)

    def _over(self, _force_n: float) -> bool:
        return self._left_s <= EQUAL


def _obstructed(reached: Approach) -> GripContradicted:
    (first_n, second_n), settings = reached.pads_n, reached.settings
    return GripContradicted(
        f"the fingers were stopped at an opening of {reached.state.aperture_m * 1e3:.1f} mm, "
        f"pressing with {max(reached.currents_a):.2f} A, but the pads show {first_n:.2f} and "
        f"{second_n:.2f} N, {settings.contact_force_n:g} N are a contact: something is between the "
        f"fingers beside the taxels, the pads are blind, or gripper.contact.approach_force_n = "
        f"{settings.approach_force_n:g} N is too low (where nothing blocks the fingers check "
        f"gripper.servos[].zero_pulse, direction and gripper.linkage){reached.friction_advice}. "
        f"Nothing opens by itself: look, check pads and control unit, then clear and release"
    )
