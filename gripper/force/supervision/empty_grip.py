"""Confirmation that nothing is held, before an opening without a request."""

from gripper.errors import GripContradicted
from gripper.force.approach.approach import Approach, ApproachEvent
from gripper.force.certainty import PRESENT_SHARE, RUN_STEPS, STALLED_S
from gripper.force.loop import Action, Moment
from gripper.force.supervision.part_watch import ADVICE, BREAKAWAY_SHARE, FrameMean
from gripper.mechanics.transmission import Mechanics
from gripper.servos.goal_limits import standing
from gripper.servos.group import frozen
from gripper.values.force_sensor import LEAST_SAMPLES, RecentForce
from gripper.values.state import ServoFeedback

_CLOSED_ADVICE = (
    "The fingers are closed (gripper.aperture_min_mm): a part is too small to be held, or the pads "
    "press on each other because gripper.approach_speed_mm_s is high. The grip is kept: look, then "
    "clear the fault and release"
)


class EmptyGrip:
    """Step of control that confirms that nothing is held, before an opening without a request.

    Fingers that have not run yet close, as in an approach, by more than any part would yield. Then
    they stand until the pads have shown once more that they are empty.

    Parameters
    ----------
    mechanics
        Of the gripper.
    state
        Feedback at the end of the grasp.
    stiffness_n_m
        Stiffness in N/m of the part that may yield to the current of an approach. None where an
        approach has just ended, so that nothing yields; the current may then grow while the fingers
        stand.
    ran
        Whether the fingers have already closed, unlike on any part.
    """

    def __init__(
        self, mechanics: Mechanics, state: ServoFeedback, *, stiffness_n_m: float | None, ran: bool
    ) -> None:
        self._settings = settings = mechanics.settings
        self._approach = Approach(mechanics, state, may_boost=stiffness_n_m is None)
        self._step_m = self._approach.stiffness.step_m
        self._run_m = RUN_STEPS * self._step_m
        if stiffness_n_m is not None:
            paths = mechanics.transmissions(state.angles_rad)
            friction_n = max(path.friction_n for path in paths)
            pressed_n = settings.approach_force_n + BREAKAWAY_SHARE * friction_n
            self._run_m += pressed_n / stiffness_n_m
        self._loaded_n = PRESENT_SHARE * settings.contact_force_n
        self._begun_m = state.aperture_m
        self._late_s = state.t_s + self._run_m / settings.approach_speed_m_s + STALLED_S
        self._ran = ran
        self._watch_from(state.t_s)

    def _watch_from(self, now_s: float) -> None:
        self._since_s = now_s
        self._frames = FrameMean(now_s)
        self._samples = RecentForce()

    def step(self, moment: Moment) -> Action:
        """Return the goals of a period. Raises GripContradicted when anything shows a part."""
        if self._ran:
            return self._pads(moment)
        state, approach = moment.state, self._approach
        # A finger that is ahead waits: none opens.
        goals = frozen(approach.step(moment).goals or (), state)
        travel_m = self._begun_m - state.aperture_m
        if travel_m >= self._run_m or approach.event is ApproachEvent.LIMIT:
            self._ran = True
            self._watch_from(moment.now_s)
            return Action(goals=standing(goals, state))
        self._pads(moment)
        if moment.now_s >= self._late_s or approach.event is not ApproachEvent.CLOSING:
            raise GripContradicted(
                f"the force samples show empty pads, but the fingers stand at an opening of "
                f"{1e3 * state.aperture_m:.1f} mm: with {max(approach.currents_a):.2f} A, which "
                f"moves free ones, they have closed by {1e3 * travel_m:.1f} of "
                f"{1e3 * self._run_m:.1f} mm. {ADVICE}"
            )
        return Action(goals=goals)

    def _pads(self, moment: Moment) -> Action:
        """Return no goals; the last step where frames and samples show empty pads."""
        sample = moment.sample
        if sample is None or not sample.valid:
            return Action()
        self._frames.push(sample)
        after = sample.t_s - 2.0 * sample.lag_s > self._since_s
        if after:
            self._samples.push(sample)
        few = sample.frame_s is not None and len(self._frames) < LEAST_SAMPLES
        if few or (not after and max(sample.force_n) > self._loaded_n):
            return Action()
        means_n = self._samples.finger_means_n if self._samples else sample.force_n
        frames_n = self._frames.finger_means_n
        if min(means_n) > self._loaded_n >= min(frames_n) and not self._samples.complete:
            # The noise of one sample sometimes loads both pads.
            return Action()
        if min(means_n) > self._loaded_n or min(frames_n) > self._loaded_n:
            frames = "the frames {:.2f} and {:.2f} N, ".format(*frames_n)
            if sample.frame_s is None:
                frames = ""
            opening_m, least_m = moment.state.aperture_m, self._settings.aperture_min_m
            closed = opening_m - least_m <= RUN_STEPS * self._step_m
            advice = _CLOSED_ADVICE if closed else ADVICE
            raise GripContradicted(
                f"the grasp has ended without a part at an opening of "
                f"{1e3 * opening_m:.1f} mm, but the force samples show "
                f"{means_n[0]:.2f} and {means_n[1]:.2f} N, {frames}more than "
                f"{self._loaded_n:.2f} N on both pads: something may be held, or the zero of the "
                f"pads has drifted. {advice}"
            )
        return Action(done=True)
