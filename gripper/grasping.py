"""One grasp: approach, contact, ramp, settling; then holding and backing off."""

from collections.abc import Callable

from gripper.contact import Approach, ApproachEvent, ContactRest
from gripper.errors import LimitExceeded, PartLost
from gripper.free_running import FreeRunning
from gripper.grip_control import GripControl, new_compliance
from gripper.kinematics import Linkage
from gripper.limits import ServoGoal
from gripper.motion_current import motion_current_a
from gripper.ramp import ForceRamp
from gripper.ramp_end import RampEnd
from gripper.runner import Action, LoopRunner, Moment, Observer
from gripper.servos import ServoGroup
from gripper.settings import GripperSettings
from gripper.slip import LevelSlip
from gripper.state import GraspOutcome, GraspResult, GripperPhase, GripperState

_CONTACT_SHARE = 0.97
"""Where in the friction band the drive is at the contact."""
_REST_S = 0.08
"""How long the fingers rest at the contact, so that the ramp begins at the force that is there."""


class GraspRun:
    """The phases of a grasp, and what is known of the part that is held.

    Parameters
    ----------
    runner, servos, linkage, settings
        Of the gripper.
    """

    def __init__(
        self,
        runner: LoopRunner,
        servos: ServoGroup,
        linkage: Linkage,
        settings: GripperSettings,
    ) -> None:
        self._runner = runner
        self._servos = servos
        self._linkage = linkage
        self._settings = settings
        self._setpoint_n = 0.0
        self._compliance = new_compliance(settings)
        self._free = FreeRunning()
        self._end = RampEnd()
        self.control: GripControl | None = None

    def forget(self) -> None:
        """Nothing is held any more."""
        self.control = None
        self._setpoint_n = 0.0

    def end_ramp(self) -> None:
        """End the running ramp at its present set-point; see `Gripper.end_ramp`."""
        self._end.request()

    def run(
        self,
        ramp: ForceRamp,
        observer: Observer | None,
        set_phase: Callable[[GripperPhase], None],
    ) -> GraspOutcome:
        """Approach, then follow the ramp to its end, or until it is ended on request."""
        self.forget()
        with self._end.counting():
            return self._run(ramp, observer, set_phase)

    def _run(
        self,
        ramp: ForceRamp,
        observer: Observer | None,
        set_phase: Callable[[GripperPhase], None],
    ) -> GraspOutcome:
        event, state = self._approach(observer)
        if event is not ApproachEvent.CONTACT:
            limit = event is ApproachEvent.LIMIT
            return GraspOutcome(
                result=GraspResult.NO_CONTACT if limit else GraspResult.OBSTRUCTED,
                contact_t_s=None,
                contact_aperture_m=None,
                final_aperture_m=state.aperture_m,
                final_force_n=0.0,
                overshoot_n=0.0,
            )
        set_phase(GripperPhase.RAMPING)
        return self._follow(ramp, state, observer)

    def hold(
        self, control: GripControl, duration_s: float, observer: Observer | None
    ) -> GripperState:
        """Control the force at its last set-point for a time in s."""
        elapsed_s = 0.0
        slip = LevelSlip(self._settings)

        def step(moment: Moment) -> Action:
            nonlocal elapsed_s
            elapsed_s += moment.dt_s
            self._check_part(control, moment)
            slip.check(moment, 0, setpoint_n=self._setpoint_n)
            goals = control.goals(
                moment,
                self._servos.feedback.transmissions(moment.state.servos),
                self._setpoint_n,
                taper=elapsed_s > self._settings.taper_after_s,
            )
            done = elapsed_s >= duration_s - 1e-9
            return Action(goals=goals, setpoint_n=self._setpoint_n, done=done)

        control.resume()
        return self._runner.run(GripperPhase.HOLDING, step, observer, needs_force=True)

    def back_off_ramp(self, force_n: float, rate_n_s: float) -> ForceRamp:
        """Return the way down from the present set-point; LimitExceeded where there is none."""
        if not self._settings.contact_force_n <= force_n <= self._setpoint_n:
            raise LimitExceeded(
                f"backing off to {force_n} N is not from contact_force_n = "
                f"{self._settings.contact_force_n} N to the present {self._setpoint_n} N; "
                f"letting go is done by release"
            )
        return ForceRamp.linear(force_n, rate_n_s, start_n=self._setpoint_n)

    def follow_down(
        self, control: GripControl, ramp: ForceRamp, observer: Observer | None
    ) -> GripperState:
        """Follow a falling ramp to its end and until the force has settled."""
        elapsed_s = 0.0

        def step(moment: Moment) -> Action:
            nonlocal elapsed_s
            elapsed_s += moment.dt_s
            self._check_part(control, moment)
            self._setpoint_n = ramp.setpoint_n(elapsed_s)
            goals = control.goals(
                moment,
                self._servos.feedback.transmissions(moment.state.servos),
                self._setpoint_n,
                arrival_n=ramp.arrival_n(elapsed_s),
            )
            done = self._settled(ramp, elapsed_s, control)
            return Action(goals=goals, setpoint_n=self._setpoint_n, done=done)

        control.resume()
        return self._runner.run(GripperPhase.BACKING_OFF, step, observer, needs_force=True)

    def _approach(self, observer: Observer | None) -> tuple[ApproachEvent, GripperState]:
        settings = self._settings
        start = self._servos.feedback.read_patiently()
        paths = self._servos.feedback.transmissions(start.servos)
        current_max_a = min(
            settings.current_max_a,
            *(path.loading_current_a(settings.force_max_n) for path in paths),
        )
        current_a = min(motion_current_a(settings, paths, settings.approach_force_n), current_max_a)
        approach = Approach(
            settings,
            self._linkage,
            start,
            now_s=start.t_s,
            current_a=current_a,
            current_max_a=current_max_a,
        )
        event = ApproachEvent.CLOSING

        self._compliance = new_compliance(settings)
        self._free = FreeRunning()

        def step(moment: Moment) -> Action:
            nonlocal event
            self._compliance.push(moment.now_s, moment.state.aperture_m, moment.sample)
            self._free.push(
                moment.now_s,
                moment.state,
                self._servos.feedback.transmissions(moment.state.servos),
                running=approach.runs_freely(moment.state),
            )
            event, angles_rad = approach.step(
                moment.now_s, moment.dt_s, moment.state, moment.sample
            )
            if event in (ApproachEvent.LIMIT, ApproachEvent.OBSTRUCTED):
                angles_rad = [servo.angle_rad for servo in moment.state.servos]
            goals = [ServoGoal(angle_rad=a, current_a=approach.current_a) for a in angles_rad]
            return Action(goals=goals, done=event is not ApproachEvent.CLOSING)

        state = self._runner.run(GripperPhase.APPROACHING, step, observer, needs_force=True)
        return event, state

    def _follow(
        self, ramp: ForceRamp, contact: GripperState, observer: Observer | None
    ) -> GraspOutcome:
        control: GripControl | None = None
        actual = ramp
        elapsed_s = 0.0
        peak_n = 0.0
        lost = ended = False
        slip = LevelSlip(self._settings)
        rest = ContactRest(contact.t_s + _REST_S)

        def step(moment: Moment) -> Action:
            nonlocal control, actual, elapsed_s, peak_n, lost, ended
            paths = self._servos.feedback.transmissions(moment.state.servos)
            self._compliance.push(moment.now_s, moment.state.aperture_m, moment.sample)
            if rest.goes_on(moment):
                return Action()
            if control is None:
                force_n = rest.force_n
                # The fingers are still closing: the drive is at the rising edge of the band.
                share = self._free.friction_share()
                friction_n = share * sum(path.friction_n for path in paths) / len(paths)
                control = GripControl(
                    self._settings,
                    contact,
                    force_n=force_n,
                    drive_n=force_n + _CONTACT_SHARE * friction_n,
                    now_s=moment.now_s,
                    compliance=self._compliance,
                    friction_share=share,
                )
                self.control = control
                actual = ramp.starting_from(force_n)
            elif not ended and self._ends_early(actual, elapsed_s):
                actual, elapsed_s, ended = actual.ended_at(elapsed_s), 0.0, True
            else:
                elapsed_s += moment.dt_s
            self._setpoint_n = actual.setpoint_n(elapsed_s)
            goals = control.goals(
                moment, paths, self._setpoint_n, arrival_n=actual.arrival_n(elapsed_s)
            )
            peak_n = max(peak_n, control.force_n)
            lost = control.part_lost(moment)
            if not lost:
                slip.check(moment, actual.level_at(elapsed_s), setpoint_n=self._setpoint_n)
            if lost:
                goals = tuple(
                    ServoGoal(angle_rad=servo.angle_rad, current_a=goal.current_a)
                    for servo, goal in zip(moment.state.servos, goals, strict=True)
                )
            return Action(
                goals=goals,
                setpoint_n=self._setpoint_n,
                level=actual.level_at(elapsed_s),
                done=lost or self._settled(actual, elapsed_s, control),
            )

        state = self._runner.run(GripperPhase.RAMPING, step, observer, needs_force=True)
        final_n = 0.0 if control is None else control.force_n
        tolerance_n = self._settings.settle_tolerance_at_n(actual.final_n)
        reached = abs(final_n - actual.final_n) <= tolerance_n
        if lost:
            self.forget()
            result = GraspResult.PART_LOST
        else:
            result = GraspResult.FORCE_REACHED if reached else GraspResult.FORCE_NOT_REACHED
        return GraspOutcome(
            result=result,
            contact_t_s=contact.t_s,
            contact_aperture_m=contact.aperture_m,
            final_aperture_m=state.aperture_m,
            final_force_n=final_n,
            overshoot_n=max(0.0, peak_n - actual.final_n),
            ended_early=ended,
        )

    def _ends_early(self, ramp: ForceRamp, elapsed_s: float) -> bool:
        """Say whether the ramp is to end now: wanted, not over, and enough to hold a part."""
        return (
            self._end.requested
            and ramp.duration_s - elapsed_s > 1e-9
            and ramp.setpoint_n(elapsed_s) >= self._settings.contact_force_n
        )

    def _settled(self, ramp: ForceRamp, elapsed_s: float, control: GripControl) -> bool:
        """Say whether a ramp is over and its force reached, or the time for that is up."""
        left_s = ramp.duration_s - elapsed_s
        if left_s > 1e-9:
            return False
        error_n = abs(control.force_n - ramp.final_n)
        return (
            error_n <= self._settings.settle_tolerance_at_n(ramp.final_n)
            or -left_s >= self._settings.settle_timeout_s
        )

    def _check_part(self, control: GripControl, moment: Moment) -> None:
        if control.part_lost(moment):
            raise PartLost(
                f"both pads are empty at an opening of {moment.state.aperture_m * 1e3:.1f} mm: "
                f"the part has slipped out or was taken; the fingers stand still"
            )
