"""Control of the grip force of one grasp: one period, from the set-point to the servos' goals."""

from gripper.force.approach.approach import Approach
from gripper.force.control.drive_goals import GIVE_RAD, DriveGoals
from gripper.force.control.law import ForceLaw, Period
from gripper.force.estimates.grip import KNOWN_N, Grip, History
from gripper.force.loop import Moment
from gripper.force.supervision.part_watch import PartWatch
from gripper.mechanics.kinematics import Linkage, mean_friction_n, transmissions
from gripper.servos.goal_limits import ServoGoal
from gripper.values.state import ServoFeedback


class GripControl:
    """Step of control from the set-point of the grip force to the goals of the servos.

    Parameters
    ----------
    linkage
        Of the gripper.
    reached
        End of the approach, at the contact.
    force_n
        Grip force after the rest in N.
    moment
        First period after the rest at the contact: the fingers may have moved in it.
    """

    def __init__(
        self, linkage: Linkage, reached: Approach, *, force_n: float, moment: Moment
    ) -> None:
        settings, state = reached.settings, moment.state
        self._settings = settings
        self._linkage = linkage
        touch_m = reached.touch_m
        self.grip = grip = Grip(
            settings=settings,
            linkage=linkage,
            stiffness=reached.stiffness,
            touch_m=touch_m,
            apertures=History(),
            setpoint_n=force_n,
            planned_n=force_n,
            force_n=force_n,
            balance_n=force_n,
            drive_n=force_n,
        )
        grip.apertures.add(moment.now_s, state.aperture_m)
        # A high load at the first touch: stiff, or no part at all.
        yielded_m = max(touch_m - state.aperture_m, grip.stiffness.step_m)
        contact_n_m = force_n / yielded_m if force_n > KNOWN_N else None
        given_m = GIVE_RAD * sum(map(linkage.opening_per_rad_m, state.angles_rad))
        # A hard touch has compressed the part already.
        self.watch = PartWatch(grip, contact_n_m, widest_m=max(touch_m, state.aperture_m) + given_m)
        """Decides whether the part is gone; called before `goals` in each period."""
        self._law = ForceLaw(grip, moment.now_s)
        self._goals = DriveGoals(grip, state)

    @property
    def force_n(self) -> float:
        """Mean of the last samples of the grip force in N."""
        samples = self.watch.pads.recent
        return samples.grip_n if samples else self.grip.force_n

    def resume(self) -> None:
        """Begin again after a pause: samples from before it are discarded."""
        self.watch.resume()
        self._law.resume()

    def begin_again(self, state: ServoFeedback) -> None:
        """Begin the law at the present force and opening: others have moved the fingers."""
        self.grip.apertures.add(state.t_s, state.aperture_m)
        self.grip.force_n = self.grip.balance_n = self.grip.drive_n = self.force_n
        self._law.begin(state.t_s)

    def goals(
        self, moment: Moment, setpoint_n: float, *, arrival_n: float | None = None
    ) -> tuple[ServoGoal, ...]:
        """Return the goals of one period.

        Parameters
        ----------
        moment
            Feedback and a valid force sample.
        setpoint_n
            Set-point of the grip force in N.
        arrival_n
            End of the present change of force in N; None without a change.

        Raises
        ------
        ForceImbalance, PositionContradicted
            As `PartWatch.check_pads`.
        LimitExceeded
            When the pads jump or contradict the currents, see `ForceLaw`.
        """
        grip, state, sample = self.grip, moment.state, moment.sample
        if sample is not None and (not sample.valid or self.watch.suspicious):
            sample = None
        rises_n = setpoint_n - grip.setpoint_n
        grip.setpoint_n = setpoint_n
        grip.apertures.add(moment.now_s, state.aperture_m)
        if sample is not None:
            self.watch.pads.take(sample)
            self.watch.check_pads(moment, rises=rises_n > 0.0)
        paths = transmissions(self._settings, self._linkage, state.angles_rad)
        period = Period(
            moment=moment,
            sample=sample,
            setpoint_n=setpoint_n,
            end_n=setpoint_n if arrival_n is None else arrival_n,
            paths=paths,
            friction_n=mean_friction_n(paths),
            may_open=self._goals.may_open,
        )
        grip.drive_n = self._law.step(period)
        return self._goals.goals(state)

    def quiet_goals(self, moment: Moment) -> tuple[ServoGoal, ...]:
        """Return the last goals of a grip: without a push."""
        self.grip.drive_n = self.grip.balance_n
        return self._goals.goals(moment.state)
