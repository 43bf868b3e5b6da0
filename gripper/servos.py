"""The servos of one gripper as a group: feedback, torque, watchdog and goals."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from math import pi, tau

from gripper.bus import ServoBus
from gripper.clock import Clock
from gripper.errors import BusCorrupt, BusTimeout, GripperError, ServoFault
from gripper.force import ForceSample
from gripper.freshness import TickWatch
from gripper.health import ServoHealth
from gripper.kinematics import Linkage, Transmission
from gripper.limits import GoalGuard, ServoGoal
from gripper.motion_current import motion_current_a
from gripper.plausibility import FeedbackCheck
from gripper.registers import (
    BUS_WATCHDOG,
    GOAL_CURRENT,
    GOAL_POSITION,
    GOAL_PWM,
    GOAL_VELOCITY,
    OPERATING_MODE,
    PRESENT_TEMPERATURE,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    PWM_LIMIT,
    RAD_PER_PULSE,
    RAD_S_PER_VELOCITY_UNIT,
    REALTIME_TICK,
    TORQUE_ENABLE,
    OperatingMode,
)
from gripper.settings import GripperSettings, ServoSettings
from gripper.state import GripperState, ServoState

_PATIENT_READS = 3
_HALT_TRIES = 3


class ServoGroup:
    """Conversion between registers and SI, and all writing to the servos that makes them move.

    Parameters
    ----------
    bus, linkage, settings, clock
        Of the gripper.
    """

    def __init__(
        self, bus: ServoBus, linkage: Linkage, settings: GripperSettings, clock: Clock
    ) -> None:
        self.guard = GoalGuard(settings, linkage)
        self._bus = bus
        self._linkage = linkage
        self._settings = settings
        self._clock = clock
        self._ids = [servo.servo_id for servo in settings.servos]
        self._ticks = TickWatch()
        self._feedback = FeedbackCheck(settings, linkage)
        self.health = ServoHealth(bus, settings)
        self._last: GripperState | None = None
        self.goals: tuple[ServoGoal, ...] = ()
        self._earlier: tuple[ServoGoal, ...] = ()

    # Feedback

    def in_loop(self) -> AbstractContextManager[None]:
        """Let no transaction within the block wait longer than the loop may; see `ServoBus`."""
        return self._bus.in_loop()

    def read(self) -> GripperState:
        """Read the feedback of all servos in one transaction.

        Raises
        ------
        BusTimeout, BusCorrupt
            When an answer is missing, damaged or older than the request.
        ServoFault
            When a servo has restarted under torque.
        FeedbackImplausible
            When a servo under torque reports what cannot be.
        """
        sent_s = self._clock.monotonic()
        raws = self._bus.sync_read(self._ids, REALTIME_TICK, PRESENT_TEMPERATURE)
        now_s = self._clock.monotonic()
        for servo_id, raw in raws.items():
            problem = self._ticks.check(servo_id, raw[REALTIME_TICK.name], sent_s, now_s)
            if problem is not None:
                try:
                    # An old answer has another length: it cannot pass for this one.
                    if self.goals:
                        self.health.check_torque(servo_id)
                finally:
                    self._bus.distrust()
                raise problem
        servos = tuple(self._servo_state(s, raws[s.servo_id]) for s in self._settings.servos)
        if self.goals:
            self._feedback.check(servos, now_s)
        angles = [servo.angle_rad for servo in servos]
        current_a = sum(abs(servo.current_a) for servo in servos) / len(servos)
        forces_n = [
            path.force_band_n(abs(servo.current_a))[0]
            for path, servo in zip(self.transmissions(servos), servos, strict=True)
        ]
        self._last = GripperState(
            t_s=now_s,
            aperture_m=self._linkage.aperture_m(angles),
            aperture_velocity_m_s=sum(
                self._linkage.opening_per_rad_m(servo.angle_rad) * servo.velocity_rad_s
                for servo in servos
            ),
            current_a=current_a,
            force_from_current_n=sum(forces_n) / len(forces_n),
            temperature_c=max(servo.temperature_c for servo in servos),
            voltage_v=min(servo.voltage_v for servo in servos),
            servos=servos,
        )
        return self._last

    def read_patiently(self) -> GripperState:
        """Read as `read` does, again where an answer was lost or old; for use between commands."""
        for _ in range(_PATIENT_READS - 1):
            try:
                return self.read()
            except (BusTimeout, BusCorrupt):
                continue
        return self.read()

    def _servo_state(self, servo: ServoSettings, raw: dict[str, int]) -> ServoState:
        turned = (raw["present_position"] - servo.zero_raw) * RAD_PER_PULSE * servo.direction
        return ServoState(
            servo_id=servo.servo_id,
            # A multi-turn count may be off by whole turns; fingers move by less than half a turn.
            angle_rad=(turned + pi) % tau - pi,
            velocity_rad_s=raw["present_velocity"] * RAD_S_PER_VELOCITY_UNIT * servo.direction,
            current_a=servo.servo_model.current_a(raw["present_current"]) * servo.direction,
            position_raw=raw["present_position"],
            temperature_c=float(raw["present_temperature"]),
            voltage_v=raw["present_input_voltage"] * 0.1,
            tick_ms=raw[REALTIME_TICK.name],
            alert=self._bus.alert(servo.servo_id),
        )

    def transmissions(self, servos: Sequence[ServoState]) -> tuple[Transmission, ...]:
        """Return the transmission of each servo at its present angle."""
        return tuple(
            Transmission.at(settings.servo_model, self._linkage, servo.angle_rad)
            for settings, servo in zip(self._settings.servos, servos, strict=True)
        )

    def lower_currents(self) -> None:
        """Write the last goals again with ``over_force_share`` of their currents, in one step.

        The way out of too much force.
        """
        if self._last is not None and self.goals:
            share = self._settings.over_force_share
            goals = [
                ServoGoal(angle_rad=goal.angle_rad, current_a=share * goal.current_a)
                for goal in self.goals
            ]
            self.write_goals(goals, self._last)

    def calm(self) -> None:
        """Write the last goals again, with the lower current of the last two periods.

        While the force changes a square wave is on the drive: its crest must not stay.
        """
        if self._last is not None and len(self._earlier) == len(self.goals) > 0:
            goals = [
                ServoGoal(
                    angle_rad=goal.angle_rad, current_a=min(goal.current_a, earlier.current_a)
                )
                for goal, earlier in zip(self.goals, self._earlier, strict=True)
            ]
            self.write_goals(goals, self._last)

    @property
    def aperture_m(self) -> float | None:
        """The opening in m as it was read last; None before the first reading."""
        return None if self._last is None else self._last.aperture_m

    def halt(self) -> list[int]:
        """End a motion where the fingers are now; return the servos not known to obey.

        No servo answers to the write of all goals at once, so that they are read back.
        """
        age_s = 0.0 if self._last is None else self._clock.monotonic() - self._last.t_s
        if age_s > 2.0 * self._settings.period_s and not any(map(self._bus.misses, self._ids)):
            # They have gone on since the last reading: the loop has stalled.
            with suppress(GripperError):
                self.read()
        left: list[int] = []
        for _ in range(_HALT_TRIES):
            try:
                self.stand_still()
            except GripperError:
                return list(self._ids)
            left = [servo_id for servo_id in self._ids if not self._obeys(servo_id)]
            if not left:
                break
        return left

    def _obeys(self, servo_id: int) -> bool:
        """Read whether a servo has its last goal; clear a watchdog that keeps it from taking one.

        One that has just not answered is not waited for.
        """
        if self._last is None or not self.goals:
            return True
        if self._bus.misses(servo_id):
            return False
        with suppress(GripperError):
            wanted_raw = self._last.servos[self._ids.index(servo_id)].position_raw
            if self._bus.read(servo_id, GOAL_POSITION) == wanted_raw:
                return True
            if self._bus.read(servo_id, BUS_WATCHDOG) < 0:
                self._bus.write(servo_id, BUS_WATCHDOG, 0)
        return False

    def stand_still(self) -> None:
        """Set the goals to the last known positions: the fingers hold where they are.

        None pushes on, and none yields by more than the servos' position control does.
        """
        if self._last is not None and self.goals:
            earlier = self._earlier if len(self._earlier) == len(self.goals) else self.goals
            goals = [
                ServoGoal(
                    angle_rad=servo.angle_rad, current_a=min(goal.current_a, before.current_a)
                )
                for goal, before, servo in zip(self.goals, earlier, self._last.servos, strict=True)
            ]
            self.write_goals(goals, self._last)

    def open_a_step(self) -> None:
        """Open by ``over_force_open_m`` from where the fingers are, once."""
        if self._last is None or not self.goals:
            return
        paths = self.transmissions(self._last.servos)
        step_m = self._settings.over_force_open_m
        current_a = motion_current_a(self._settings, paths, self._settings.approach_force_n)
        goals = [
            ServoGoal(
                angle_rad=servo.angle_rad
                + step_m / (len(self._ids) * self._linkage.opening_per_rad_m(servo.angle_rad)),
                current_a=current_a,
            )
            for servo in self._last.servos
        ]
        self.write_goals(goals, self._last)

    def silent_and_living(self) -> tuple[list[int], list[int]]:
        """Return the IDs of the servos that did not answer last, and of those that did."""
        silent = [servo_id for servo_id in self._ids if self._bus.misses(servo_id)]
        return silent, [servo_id for servo_id in self._ids if servo_id not in silent]

    # Torque, watchdog, goals

    def switch_on(self, current_a: float) -> GripperState:
        """Set the goals to the present positions, switch the torque on, arm the watchdog."""
        self.disarm_watchdog()
        state = self._freeze_at_present(current_a)
        for servo_id in self._ids:
            self._bus.write(servo_id, TORQUE_ENABLE, 1)
        self.arm_watchdog()
        return state

    def restart_watchdog(self, current_a: float) -> GripperState:
        """Clear a tripped watchdog, set the goals to the present positions and arm it again."""
        self.disarm_watchdog()
        state = self._freeze_at_present(current_a)
        self.arm_watchdog()
        return state

    def switch_off(self) -> None:
        """Disarm the watchdog and switch the torque off."""
        self.disarm_watchdog()
        for servo_id in self._ids:
            self._bus.write(servo_id, TORQUE_ENABLE, 0)
        self.goals = ()

    def go_limp(self) -> None:
        """Switch the torque of every servo off that answers: position or force are unknown."""
        self.goals = ()
        for servo_id in self._ids:
            with suppress(GripperError):
                self._bus.write(servo_id, TORQUE_ENABLE, 0)
        self.disarm_each()

    def forget(self) -> None:
        """Take nothing for granted any more that was written or read before."""
        self.goals = ()
        self._ticks.forget()
        self._feedback.forget()

    def arm_watchdog(self) -> None:
        """Arm the bus watchdog of each servo (register 98)."""
        for servo_id in self._ids:
            self._bus.write(servo_id, BUS_WATCHDOG, self._settings.watchdog_raw)

    def disarm_watchdog(self) -> None:
        """Disarm, or clear after a trip, the bus watchdog of each servo."""
        for servo_id in self._ids:
            self._bus.write(servo_id, BUS_WATCHDOG, 0)

    def disarm_each(self, *, but: Sequence[int] = ()) -> None:
        """Disarm the bus watchdog of every servo that answers, with exceptions."""
        for servo_id in self._ids:
            if servo_id not in but:
                with suppress(GripperError):
                    self._bus.write(servo_id, BUS_WATCHDOG, 0)

    def force_is_too_high(self) -> bool:
        """Say whether the last force samples are above the cap."""
        return self.guard.force_is_too_high()

    def _freeze_at_present(self, current_a: float) -> GripperState:
        for servo_id in self._ids:
            if self._bus.read(servo_id, OPERATING_MODE) != OperatingMode.CURRENT_BASED_POSITION:
                raise ServoFault(
                    servo_id, 0, "its operating mode is no longer 5 (current-based position)"
                )
            # The goals of the other modes limit this one too.
            self._bus.write(servo_id, GOAL_PWM, self._bus.read(servo_id, PWM_LIMIT))
        state = self.read_patiently()
        goals = [ServoGoal(angle_rad=s.angle_rad, current_a=current_a) for s in state.servos]
        self.write_goals(goals, state)
        for servo in state.servos:
            found = self._bus.read(servo.servo_id, GOAL_POSITION)
            if found != servo.position_raw:
                raise ServoFault(
                    servo.servo_id,
                    0,
                    f"it did not take its goal position: wrote {servo.position_raw}, read {found}",
                )
        return state

    def note_force(self, sample: ForceSample) -> None:
        """Let the guard of the goals know the newest force."""
        self.guard.note_force(sample)

    def write_goals(
        self, goals: Sequence[ServoGoal], state: GripperState, *, profile_velocity_raw: int = 0
    ) -> None:
        """Write goal current and goal position of all servos at once, if no limit is against it.

        The only place that writes goals.

        Parameters
        ----------
        goals
            One for each servo.
        state
            Newest feedback: the goals are reached from there.
        profile_velocity_raw
            Profile Velocity (register 112) in raw units; 0 is no limit.
        """
        self.guard.check(goals, state, self._clock.monotonic())
        values: dict[int, list[int]] = {}
        for goal, servo, settings in zip(goals, state.servos, self._settings.servos, strict=True):
            # Relative to the present position: whole turns of the count do not matter.
            delta_rad = (goal.angle_rad - servo.angle_rad) * settings.direction
            values[servo.servo_id] = [
                settings.servo_model.current_raw(goal.current_a),
                0,
                0,
                profile_velocity_raw,
                servo.position_raw + round(delta_rad / RAD_PER_PULSE),
            ]
        self._bus.sync_write(
            values,
            GOAL_CURRENT,
            GOAL_VELOCITY,
            PROFILE_ACCELERATION,
            PROFILE_VELOCITY,
            GOAL_POSITION,
        )
        self._earlier, self.goals = self.goals, tuple(goals)
