"""Grip force from the motors' current, for a gripper without a force sensor."""

from dataclasses import replace

from gripper.errors import LimitExceeded
from gripper.mechanics.identification import LEAST_FRICTION_SD
from gripper.mechanics.kinematics import Linkage, Transmission, transmissions
from gripper.servos.group import Servos
from gripper.settings import GripperSettings, largest_setpoint_n
from gripper.values.force_sensor import ForceSample
from gripper.values.state import STANDING_M_S, ServoFeedback

_ASSUMED_FRICTION_SD = 0.25
"""Uncertainty of a friction that was never measured: 0.6 to 1.6 times the catalogue's. [assumed]"""
_CAP_SIGMAS = 2.0
"""Margin below the cap of the force, in standard deviations of the force. [chosen]"""
_AT_REST = 1.25
"""Largest ratio of friction at rest to that in motion: only more current shows a part. [assumed]"""
_RUNNING = 2.0
"""Rate of the opening over ``runaway_speed_m_s`` at which no part stops the fingers: a ramp of 20
N/s on a part of 1 N/mm reaches 1.3. [tuned]"""
_STILL_M_S = 1.5 * STANDING_M_S
"""Rate of the opening in m/s below which fingers may press on something: that of servos at rest."""


def assume_friction(settings: GripperSettings) -> None:
    """Limit the friction of servos that were never measured, without pads that show a contact.

    A finger that stands at more current presses on something.
    """
    for servo in settings.servos:
        drive = settings.drives.of(servo.servo_id, servo.drive)
        sd = min(drive.friction_sd, _ASSUMED_FRICTION_SD)
        settings.drives.put(servo.servo_id, replace(drive, friction_sd=sd))


def cap_by_current_n(settings: GripperSettings, linkage: Linkage) -> float:
    """Return the cap in N for a force by current with which the true force keeps ``force_max_n``.

    Raises LimitExceeded if no force is left, or where a servo measures the current of its supply.
    """
    for servo in settings.servos:
        if servo.servo_model.supply_current:
            raise LimitExceeded(
                f"servo {servo.servo_id} is a {servo.model}, which measures the current of its "
                f"supply: no test shows that its grip force follows. Give the gripper a force "
                f"sensor, or take XM430 servos"
            )
    paths = transmissions(settings, linkage, linkage.angles_rad(settings.aperture_min_m))
    error_n = 0.0
    for path in paths:
        # The friction is measured on each approach.
        sd = min(path.drive.friction_sd, LEAST_FRICTION_SD)
        known = Transmission(replace(path.drive, friction_sd=sd), path.radius_m)
        error_n = max(error_n, _CAP_SIGMAS * known.force_sd_n(settings.force_max_n))
    cap_n = round(settings.force_max_n - error_n, 1)
    if not largest_setpoint_n(cap_n) > settings.contact_force_n:
        raise LimitExceeded(
            f"without a force sensor the grip force is exact to {error_n:.1f} N, which leaves "
            f"{max(cap_n, 0.0):.1f} N of force_max_n = {settings.force_max_n} N: give the "
            "gripper a force sensor, or write a cap that parts and risk assessment allow"
        )
    return cap_n


class ForceByCurrent:
    """Force sensor by the servos' present current: a `gripper.values.force_sensor.ForceSensor`.

    The gearing holds a load by friction: at a driving force u the grip force may be anywhere from
    u - phi to u + phi. While it rises it is u - phi, while it falls u + phi; phi is measured on the
    approach, by the current that closes the empty fingers. ``noise_n`` of the samples is the
    remaining uncertainty: 0.3 N at 5 N with two XM430-W350 on links of 60 mm, with phi 1.5 N and a
    torque that is known to 5 %. In
    the simulated cell a set-point of 5 N gives 4.9 to 5.0 N; 4.5 and 5.5 N with an error of the
    torque constant of 10 %; and 4.6 to 5.1 N on a soft part of 1 N/mm.

    A contact is found when the fingers stand still although the motor makes more than friction at
    rest can hold: later, and with more force, than with taxels. The force of the impact stays in
    the grip, and the current does not show it: 2.8 N at an approach of 20 mm/s, 1.3 N at 8 mm/s. A
    smaller set-point is not reached. A part that does not stop a finger is found only by its force;
    a stuck finger is taken for a part.

    Checks that compare sensor and current have no second measurement here. They do not detect a
    changed torque constant, a part beside the pad, or a force of the part itself within the band.
    Position still shows that the part is lost, slips or runs away. Current shows that a servo does
    not reach its goal, or that one finger presses less.

    Parameters
    ----------
    servos, linkage, settings
        Of the gripper.
    """

    def __init__(self, servos: Servos, linkage: Linkage, settings: GripperSettings) -> None:
        self._servos = servos
        self._linkage = linkage
        self._settings = settings
        self._held_n: tuple[float, ...] | None = None
        self._drive_n: tuple[float, ...] = ()
        self._sample: ForceSample | None = None

    def latest_force(self) -> ForceSample | None:
        """Return the force at the last feedback of the servos, None before one."""
        state = self._servos.feedback.last
        if state is not None and (self._sample is None or state.t_s > self._sample.t_s):
            self._sample = self._by_current(state)
        return self._sample

    def _by_current(self, state: ServoFeedback) -> ForceSample:
        paths = transmissions(self._settings, self._linkage, state.angles_rad)
        now_n = tuple(
            -servo.current_a * path.n_per_a for servo, path in zip(state.servos, paths, strict=True)
        )
        # The mean of two periods has less noise.
        drive_n = tuple(0.5 * sum(two) for two in zip(now_n, self._drive_n or now_n, strict=True))
        self._drive_n = now_n
        closing_m_s = -state.aperture_velocity_m_s
        friction_n = tuple(path.friction_n for path in paths)
        if self._held_n is None and abs(closing_m_s) < _STILL_M_S:
            pressing = (
                drive
                >= self._settings.contact_force_n
                + _AT_REST * path.drive.most_breakaway_a * path.n_per_a
                for drive, path in zip(drive_n, paths, strict=True)
            )
            if all(pressing):
                self._held_n = (0.0,) * len(drive_n)
        elif closing_m_s > _RUNNING * self._settings.runaway_speed_m_s:
            self._held_n = None
        if self._held_n is not None:
            self._held_n = tuple(
                max(0.0, drive - friction, min(held, drive + friction))
                for held, drive, friction in zip(self._held_n, drive_n, friction_n, strict=True)
            )
            if not any(self._held_n):
                self._held_n = None
        forces_n = self._held_n or (0.0,) * len(drive_n)
        return ForceSample(
            t_s=state.t_s,
            force_n=(forces_n[0], forces_n[-1]),
            lag_s=0.5 * self._settings.period_s,
            noise_n=max(
                path.force_sd_n(force) for path, force in zip(paths, forces_n, strict=False)
            ),
            by_current=True,
        )
