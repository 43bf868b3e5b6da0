"""Control of the grip force of one grasp: one period, from the set-point to the servos' goals."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

from gripper.dynamixel.models import ServoModel
from gripper.force.approach.approach import Approach
from gripper.force.certainty import RECOVERED_S
from gripper.force.control.law import LOCKED_SHARE, ForceLaw
from gripper.force.estimates.grip import KNOWN_N, Grip, History
from gripper.force.loop import Moment
from gripper.force.supervision.part_watch import PartWatch
from gripper.force.supervision.slip import SlipWatch
from gripper.mechanics.transmission import Transmission, mean_friction_n
from gripper.servos.goal_limits import (
    ServoGoal,
    closing_margin_rad,
    most_closed_rad,
    running_lead_rad,
)
from gripper.servos.winding import LOWERING_S
from gripper.values.force_sensor import LOOK_BACK_S
from gripper.values.state import ServoFeedback

GIVE_RAD = 0.03
"""Largest opening of a goal beyond the contact in rad: pads and part are not deeper. [assumed]"""

_OPENS_SHARE = 0.8
"""Share of the force that an opening goal can take after the first ramp: without another goal the
part stays held. At 0.9 a pause of 30 ms drops a box from an RH-P12-RN. [tuned]"""


class DriveGoals:
    """Goals of the servos of one grip.

    Parameters
    ----------
    grip
        Estimates and set-point of the grip.
    contact
        Feedback at the contact; the fingers are not driven open beyond it by more than a pad's
        thickness.
    """

    def __init__(self, grip: Grip, contact: ServoFeedback) -> None:
        self._grip = grip
        self._contact_rad = self._deepest_rad = contact.angles_rad
        self._least_rad = most_closed_rad(grip.mechanics)
        self._stop_rad: tuple[float, ...] | None = None
        self._balances_n = History()
        self.keeps = False
        """Whether one opening goal must not let the part go. A heavy gripper corrects the overshoot
        of its first ramp with all of its drive."""

    @property
    def may_open(self) -> bool:
        """Whether the fingers may open farther."""
        return self._stop_rad is None

    def goals(self, state: ServoFeedback, *, blind: bool = False) -> tuple[ServoGoal, ...]:
        """Return the goals that make the driving force of the grip.

        ``blind``: the pads report no valid force, and may have been wrong just before.
        """
        grip = self._grip
        paths = grip.mechanics.transmissions(state.angles_rad)
        friction_n = mean_friction_n(paths)
        if blind and self._balances_n:
            before_n = self._balances_n.most(since_s=state.t_s - LOOK_BACK_S)
            grip.drive_n = grip.balance_n = max(grip.balance_n, before_n)
        self._limit(state, paths, friction_n)
        goals = []
        self._deepest_rad = tuple(map(min, self._deepest_rad, state.angles_rad))
        if state.aperture_m < grip.touch_m:
            self._stop_rad = None
        elif self._stop_rad is None:
            self._stop_rad = state.angles_rad
        stop_rad = self._stop_rad or (inf,) * len(paths)
        balance_n, push_n = grip.balance_n, grip.drive_n - grip.balance_n
        # The newest samples may be those of a fault that is not detected yet.
        self._balances_n.add(state.t_s, max(balance_n, 0.0))
        most_n = self._balances_n.most(since_s=state.t_s - LOOK_BACK_S)
        # Where the set-point has fallen, an earlier drive would make the force grow again.
        missing_n = max(balance_n - grip.force_n, 0.0)
        most_n = min(most_n, max(balance_n, grip.setpoint_n + missing_n))
        for index, (servo, path) in enumerate(zip(state.servos, paths, strict=True)):
            model, deepest_rad = grip.settings.servos[index].servo_model, self._deepest_rad[index]
            # A position that drifts open must not move a closing goal to the open side.
            closed_rad = min(self._least_rad[index], servo.angle_rad)
            held_n = most_n + LOCKED_SHARE * path.friction_n
            held_a = min(held_n / path.n_per_a, grip.settings.current_max_a)
            rest = self._closing(model, held_a, deepest_rad, closed_rad)
            # Each servo drives with the same share of its own friction.
            own_n = balance_n + push_n * path.friction_n / friction_n
            current_a = abs(own_n) / path.n_per_a
            # In mode 5 the goal current is a magnitude: the side of the goal position is its sign.
            if own_n >= 0.0:
                goal = self._closing(model, current_a, deepest_rad, closed_rad)
            else:
                # Without a further goal the finger opens by no more than this.
                lead_rad = min(running_lead_rad(model, current_a, 0.0), self._opens_rad(state))
                widest_rad = min(self._contact_rad[index] + GIVE_RAD, stop_rad[index])
                goal = ServoGoal(
                    angle_rad=min(servo.angle_rad + lead_rad + model.rad_per_pulse, widest_rad),
                    current_a=current_a,
                    setpoint_n=grip.setpoint_n,
                )
            goals.append(goal._replace(rest=rest))
        return tuple(goals)

    def _opens_rad(self, state: ServoFeedback) -> float:
        """Return the largest opening of each finger in rad by one goal."""
        grip, stiffness_n_m = self._grip, self._grip.stiffness.stiffness_n_m
        if not self.keeps or stiffness_n_m is None:
            return inf
        reach_m = sum(map(grip.mechanics.linkage.opening_per_rad_m, state.angles_rad))
        return _OPENS_SHARE * grip.force_n / (stiffness_n_m * reach_m)

    def _limit(
        self, state: ServoFeedback, paths: Sequence[Transmission], friction_n: float
    ) -> None:
        """Limit balance and drive of the grip by the caps of current and force.

        The servo that reaches its cap first limits all: else one finger pushes the other aside.
        """
        grip, settings = self._grip, self._grip.settings
        most_a = min(settings.current_max_a, *(servo.limit_a for servo in state.servos))
        caps_n = [
            min(most_a, path.pressing_current_a(settings.force_max_n)) * path.n_per_a
            for path in paths
        ]
        push_n = grip.drive_n - grip.balance_n
        grip.balance_n = balance_n = max(-min(caps_n), min(grip.balance_n, *caps_n))
        for cap_n, path in zip(caps_n, paths, strict=True):
            share = friction_n / path.friction_n
            push_n = min(max(push_n, (-cap_n - balance_n) * share), (cap_n - balance_n) * share)
        grip.drive_n = balance_n + push_n

    def _closing(
        self, model: ServoModel, current_a: float, deepest_rad: float, closed_rad: float
    ) -> ServoGoal:
        """Return the goal that closes with a current in A, at most to an angle in rad."""
        return ServoGoal(
            angle_rad=max(deepest_rad - closing_margin_rad(model, current_a), closed_rad),
            current_a=current_a,
            setpoint_n=self._grip.setpoint_n,
        )


class GripControl:
    """Step of control from the set-point of the grip force to the goals of the servos.

    Parameters
    ----------
    reached
        End of the approach, at the contact.
    force_n
        Grip force after the rest in N.
    moment
        First period after the rest at the contact: the fingers may have moved in it.
    """

    def __init__(self, reached: Approach, *, force_n: float, moment: Moment) -> None:
        state, touch_m = moment.state, reached.touch_m
        self.grip = grip = Grip(
            mechanics=reached.mechanics,
            stiffness=reached.stiffness,
            touch_m=touch_m,
            force_n=force_n,
        )
        # A high load at the first touch: stiff, or no part at all.
        yielded_m = max(touch_m - state.aperture_m, grip.stiffness.step_m)
        contact_n_m = force_n / yielded_m if force_n > KNOWN_N else None
        given_m = GIVE_RAD * sum(map(grip.mechanics.linkage.opening_per_rad_m, state.angles_rad))
        # A hard touch has compressed the part already.
        self.watch = PartWatch(grip, contact_n_m, widest_m=max(touch_m, state.aperture_m) + given_m)
        """Decides whether the part is gone; called before `goals` in each period."""
        self.slip = SlipWatch(grip.settings)
        """Detects a slip while the set-point is steady."""
        self._law = ForceLaw(grip, moment.now_s)
        self._stalled_s: float | None = None
        self._most_n = 0.0
        self._goals = DriveGoals(grip, state)

    @property
    def force_n(self) -> float:
        """Mean of the last samples of the grip force in N."""
        samples = self.watch.pads.recent
        return samples.grip_n if samples else self.grip.force_n

    def resume(self, end_n: float) -> None:
        """Begin a change of the force to ``end_n`` N, or a hold; earlier samples are discarded."""
        self.watch.resume()
        self.grip.stiffness.end()
        if end_n > self._most_n:
            self.grip.stiffness.allow_harder()
        self._law.resume()
        self._goals.keeps = True

    def begin_again(self, state: ServoFeedback) -> None:
        """Begin the law at the present force and opening: others have moved the fingers."""
        self.grip.stiffness.apertures.add(state.t_s, state.aperture_m)
        self.grip.force_n = self.grip.balance_n = self.grip.drive_n = self.force_n
        self._law.begin(state.t_s)

    def goals(
        self, moment: Moment, setpoint_n: float, *, arrival_n: float
    ) -> tuple[ServoGoal, ...]:
        """Return the goals of one period.

        Parameters
        ----------
        moment
            Feedback and a valid force sample.
        setpoint_n
            Set-point of the grip force in N. It falls with the current that a hot winding bears:
            the part would else push the fingers open at once when friction gives way.
        arrival_n
            End of the present change of force in N; without a change the set-point.

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
        paths = grip.mechanics.transmissions(state.angles_rad)
        pairs = zip(state.servos, paths, strict=True)
        borne_n = max(
            min([servo.limit_a * path.n_per_a for servo, path in pairs]),
            grip.setpoint_n * (1.0 - moment.dt_s / LOWERING_S),
        )
        end_n = min(arrival_n, borne_n)
        setpoint_n = min(setpoint_n, borne_n)
        rises_n = setpoint_n - grip.setpoint_n
        grip.setpoint_n, self._most_n = setpoint_n, max(self._most_n, setpoint_n)
        if rises_n != 0.0:
            grip.carried_s = max(grip.carried_s, moment.now_s + RECOVERED_S)
        grip.stiffness.apertures.add(moment.now_s, state.aperture_m)
        if sample is not None:
            self.watch.pads.take(sample)
            self.watch.check_pads(moment, rises=rises_n > 0.0)
            # Fingers are pressed evenly: the mean of uneven pads is no force.
            if self.watch.force_falls() or self.watch.uneven:
                sample = None
        # After a stall the estimates do not have what the last goals have done meanwhile.
        if moment.stalled:
            self._stalled_s = moment.now_s
        if self._stalled_s is not None:
            if sample is None or sample.measured_s < self._stalled_s:
                return self.quiet_goals(moment)
            self._stalled_s, grip.force_n = None, sample.grip_n
            self._law.begin(moment.now_s)
        trusted = replace(moment, sample=sample)
        grip.drive_n = self._law.step(trusted, end_n, may_open=self._goals.may_open)
        blind = moment.sample is not None and not moment.sample.valid
        return self._goals.goals(state, blind=blind)

    def quiet_goals(self, moment: Moment) -> tuple[ServoGoal, ...]:
        """Return goals that keep the last balancing drive, without a push."""
        self.grip.drive_n = self.grip.balance_n
        return self._goals.goals(moment.state)
