"""Step of control for the loop: controlling the grip force, and seeing that the part is gone."""

from collections import deque
from collections.abc import Sequence

from gripper.compliance import Compliance
from gripper.errors import ForceImbalance
from gripper.force import ForceSample
from gripper.force_loop import ForceLoop
from gripper.kinematics import Transmission
from gripper.limits import ServoGoal, closing_margin_rad
from gripper.reference import Reference
from gripper.runner import Moment
from gripper.settings import GripperSettings
from gripper.state import GripperState, ServoState

_LOST_SHARE = 0.25
_LOST_TIME_S = 0.1
_SUDDEN_RATIO = 6.0
_RECENT_SAMPLES = 5
_MEAN_SAMPLES = 3
_GIVE_RAD = 0.03
_TORQUE_DOUBT = 0.02
"""Share of the cap of the force that the drive leaves free: torque of the servos, their inertia."""


def new_compliance(settings: GripperSettings) -> Compliance:
    """Return a learner of the part's stiffness that has seen nothing yet."""
    return Compliance(
        touch_n=0.3 * settings.contact_force_n,
        sensor_delay_s=settings.force_loop.sensor_delay_s,
    )


class GripControl:
    """Turns the set-point of the grip force into goals of the servos, for one grasp.

    Parameters
    ----------
    settings
        Of the gripper.
    state
        Feedback at the contact; the fingers are not driven open beyond it by more than a pad's
        thickness.
    force_n
        Grip force at the contact in N.
    drive_n
        Driving force at the contact in N.
    now_s
        Monotonic time in s.
    """

    def __init__(
        self,
        settings: GripperSettings,
        state: GripperState,
        *,
        force_n: float,
        drive_n: float,
        now_s: float,
        compliance: Compliance | None = None,
        friction_share: float = 1.0,
    ) -> None:
        tuning = settings.force_loop
        self._settings = settings
        self._friction_share = friction_share
        self._reference = Reference(force_n, tuning.end_time_s)
        self._compliance = compliance or new_compliance(settings)
        self._contact_rad = [servo.angle_rad for servo in state.servos]
        self._loop = ForceLoop(settings.force_loop, force_n=force_n, drive_n=drive_n, now_s=now_s)
        self._drive_n = drive_n
        self._samples: deque[ForceSample] = deque(maxlen=_MEAN_SAMPLES)
        self._empty_s = 0.0
        self._uneven_s = 0.0
        self._paused = False
        self._runaway_m: float | None = None
        self._recent_n: deque[float] = deque(maxlen=_RECENT_SAMPLES)

    @property
    def loop(self) -> ForceLoop:
        """The force loop."""
        return self._loop

    @property
    def force_n(self) -> float:
        """Mean of the last samples of the grip force in N."""
        if not self._samples:
            return self._loop.model_n
        return sum(sample.grip_n for sample in self._samples) / len(self._samples)

    def resume(self) -> None:
        """Begin again after a pause: what the pads said before it no longer counts."""
        self._samples.clear()
        self._paused = True

    def part_lost(self, moment: Moment) -> bool:
        """Say whether the part is gone.

        Both pads have said for some time that they are empty, or said so at once where much force
        was; or the fingers have closed fully, or run together as nothing holds them apart. Time in
        which the pads said nothing, as in a stall, shows nothing.
        """
        closed = moment.state.aperture_m < self._settings.aperture_min_m
        empty = self._empty_s > _LOST_TIME_S
        return closed or empty or self._suddenly_empty(moment) or self._runs_away(moment.state)

    def _suddenly_empty(self, moment: Moment) -> bool:
        """Say whether the newest sample shows next to nothing where much force was asked for."""
        sample = moment.sample
        if sample is None or not sample.valid or self._paused:
            return False
        empty_n = _LOST_SHARE * self._settings.contact_force_n
        recent_n = max((grip_n for grip_n in self._recent_n), default=0.0)
        much = min(self._reference.force_n, recent_n) > _SUDDEN_RATIO * empty_n
        return much and max(sample.force_n) < empty_n

    def _runs_away(self, state: GripperState) -> bool:
        stiffness_n_m = self._compliance.stiffness_n_m
        rate_n_s = self._reference.rate_n_s
        if stiffness_n_m is None and rate_n_s != 0.0:
            return False
        wanted_m_s = 0.0 if stiffness_n_m is None else max(0.0, rate_n_s / stiffness_n_m)
        closing_m_s = -state.aperture_velocity_m_s
        if closing_m_s <= self._settings.runaway_speed_m_s + 2.0 * wanted_m_s:
            self._runaway_m = None
            return False
        if self._runaway_m is None:
            self._runaway_m = state.aperture_m
        return self._runaway_m - state.aperture_m >= self._settings.runaway_travel_m

    def goals(
        self,
        moment: Moment,
        paths: Sequence[Transmission],
        setpoint_n: float,
        *,
        arrival_n: float | None = None,
        taper: bool = False,
    ) -> tuple[ServoGoal, ...]:
        """Return the goals of one period.

        Parameters
        ----------
        moment
            Feedback and a valid force sample.
        paths
            Transmission of each servo at its present angle.
        setpoint_n
            Grip force that is asked for in N.
        arrival_n
            Where the present change of force ends in N; None where it is not changing.
        taper
            True during a long hold.
        """
        sample = moment.sample
        if self._paused:
            self._paused = False
            self._empty_s = self._uneven_s = 0.0
        if sample is None or not sample.valid:
            # A sample that is young enough was there before: nothing new to go by.
            return self._drive(moment.state.servos, paths)
        self._note(moment.dt_s, sample)
        self._check_balance(moment.dt_s)
        reference_n = self._reference.step(
            moment.dt_s, setpoint_n, setpoint_n if arrival_n is None else arrival_n
        )
        tuning = self._settings.force_loop
        cap_a = self._settings.current_cap_a(moment.state.temperature_c)
        braking_n = self._braking_n(moment.state)
        self._drive_n = self._loop.step(
            moment.now_s,
            moment.dt_s,
            reference_n,
            sample,
            friction_n=self._friction_share * sum(path.friction_n for path in paths) / len(paths),
            braking_n=braking_n,
            motion_n=tuning.motion_doubt_n_s_m * 0.5 * abs(moment.state.aperture_velocity_m_s),
            # Whatever pushes the fingers open: the cap of the force is none to push on beyond.
            drive_max_n=min(
                min(
                    cap_a * path.kt_nm_a / path.radius_m,
                    self._settings.force_max_n * (1.0 - _TORQUE_DOUBT)
                    + min(1.0, self._friction_share) * path.friction_n,
                )
                for path in paths
            ),
            taper=taper,
        )
        return self._drive(moment.state.servos, paths)

    def _braking_n(self, state: GripperState) -> float:
        """Return what the drive is lowered by, in N, because the fingers run ahead."""
        stiffness_n_m = self._compliance.stiffness_n_m
        wanted_m_s = 0.0 if stiffness_n_m is None else self._reference.rate_n_s / stiffness_n_m
        ahead_m_s = -state.aperture_velocity_m_s - wanted_m_s
        return self._settings.force_loop.damping_n_s_m * 0.5 * ahead_m_s

    def _note(self, dt_s: float, sample: ForceSample) -> None:
        if not self._samples or sample.t_s > self._samples[-1].t_s:
            self._recent_n.append(sample.grip_n)
            self._samples.append(sample)
        empty_n = _LOST_SHARE * self._settings.contact_force_n
        empty = max(self._finger_means_n()) < empty_n
        self._empty_s = self._empty_s + dt_s if empty else 0.0

    def _check_balance(self, dt_s: float) -> None:
        settings = self._settings
        first_n, second_n = self._finger_means_n()
        allowed_n = max(settings.imbalance_n, settings.imbalance_share * 0.5 * (first_n + second_n))
        if abs(first_n - second_n) <= allowed_n:
            self._uneven_s = 0.0
            return
        self._uneven_s += dt_s
        if self._uneven_s > settings.imbalance_s:
            raise ForceImbalance(
                f"the fingers press with {first_n:.2f} and {second_n:.2f} N, a difference of "
                f"{allowed_n:.2f} N is allowed for {settings.imbalance_s} s: both are frozen; "
                f"check whether a finger is blocked or a pad is blind"
            )

    def _finger_means_n(self) -> tuple[float, float]:
        n = len(self._samples)
        return (
            sum(sample.force_n[0] for sample in self._samples) / n,
            sum(sample.force_n[1] for sample in self._samples) / n,
        )

    def _drive(
        self, servos: Sequence[ServoState], paths: Sequence[Transmission]
    ) -> tuple[ServoGoal, ...]:
        drive_n = self._drive_n
        goals = []
        for servo, path, settings, contact_rad in zip(
            servos, paths, self._settings.servos, self._contact_rad, strict=True
        ):
            current_a = min(
                abs(drive_n) * path.radius_m / path.kt_nm_a, self._settings.current_max_a
            )
            model = settings.servo_model
            margin_rad = closing_margin_rad(
                model.position_gains[2], current_a / model.stall_current_a
            )
            # In mode 5 the goal current is a magnitude: the side of the goal position is its sign.
            if drive_n >= 0.0:
                angle_rad = servo.angle_rad - margin_rad
            else:
                angle_rad = min(servo.angle_rad + margin_rad, contact_rad + _GIVE_RAD)
            goals.append(ServoGoal(angle_rad=angle_rad, current_a=current_a))
        return tuple(goals)
