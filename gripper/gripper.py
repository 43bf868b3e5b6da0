"""The gripper: open, grasp under a force ramp, hold, back off, release, stop.

A part is let go by `Gripper.release` alone. Faults, exceptions, `keep_grip` and `close` leave
goals and torque as they are.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress

from gripper.bus import ServoBus
from gripper.clock import Clock
from gripper.errors import GraspStopped, GripperError, GripperStateError, LimitExceeded, ServoFault
from gripper.force import ForceSensor
from gripper.grasping import GraspRun
from gripper.kinematics import Linkage
from gripper.motion import GripControl, MoveTo, motion_current_a
from gripper.ramp import ForceRamp
from gripper.recovery import reboot_servos
from gripper.runner import LoopRunner, Observer
from gripper.servos import ServoGroup
from gripper.settings import GripperSettings, ServoSettings
from gripper.state import (
    Cycle,
    GraspOutcome,
    GraspResult,
    GripperPhase,
    GripperState,
    LoopStatistics,
    ServoState,
)
from gripper.verification import VerificationReport

__all__ = [
    "Cycle",
    "GraspOutcome",
    "GraspResult",
    "Gripper",
    "GripperPhase",
    "GripperSettings",
    "GripperState",
    "LoopStatistics",
    "Observer",
    "ServoSettings",
    "ServoState",
]

_MOVING = frozenset({GripperPhase.OPENING, GripperPhase.RELEASING})


class Gripper:
    """A two-finger gripper with force control; one thread commands it.

    While the torque is on the servos' bus watchdog is armed. A running command feeds it; between
    commands the owner calls `tick` at least every half ``watchdog_s``. A watchdog that tripped
    while nothing was held is cleared by the next command; while a part is held it is a fault.
    `keep_grip` and `close` disarm it, because what a servo does on a trip is not documented and a
    grip must not depend on it.

    Parameters
    ----------
    bus
        The servos; the caller opens and closes it.
    linkage
        Mechanics; its number of servos is that of the settings.
    settings
        Limits and tuning.
    clock
        Source of time.
    force_sensor
        Asked once every period of the loop.
    """

    def __init__(
        self,
        bus: ServoBus,
        linkage: Linkage,
        settings: GripperSettings,
        *,
        clock: Clock,
        force_sensor: ForceSensor,
    ) -> None:
        if linkage.n_servos != len(settings.servos):
            raise LimitExceeded(
                f"the linkage is driven by {linkage.n_servos} servos, the settings name "
                f"{len(settings.servos)}"
            )
        self._bus = bus
        self._linkage = linkage
        self._settings = settings
        self._clock = clock
        self._servos = ServoGroup(bus, linkage, settings, clock)
        self._runner = LoopRunner(self._servos, force_sensor, settings, clock)
        self._grasping = GraspRun(self._runner, self._servos, linkage, settings)
        self._phase = GripperPhase.OFF
        self._part_possible = False
        self._fault: BaseException | None = None
        self._running = False

    @property
    def state(self) -> GripperPhase:
        """What the gripper is doing."""
        return self._phase

    @property
    def fault(self) -> BaseException | None:
        """The latched fault, None without one."""
        return self._fault

    @property
    def period_s(self) -> float:
        """Period of the loop in s."""
        return self._settings.period_s

    @property
    def settings(self) -> GripperSettings:
        """Limits and tuning."""
        return self._settings

    @property
    def statistics(self) -> LoopStatistics:
        """Timing of the loop."""
        return self._runner.statistics

    def start(self) -> VerificationReport:
        """Verify the servos; nothing moves and no torque is switched.

        With the torque off, operating mode, return delay and status return level are corrected.
        With the torque found on a part may be held: nothing is changed, the state becomes
        HELD_AFTER_FAULT, and `release` is the way on.

        Raises
        ------
        VerificationFailed
            When a servo with its torque off is not what the settings say.
        GripperStateError
            While a fault is latched or a command runs.
        """
        self._check_ready("start")
        held_before = self._phase is not GripperPhase.IDLE
        if not self._servos.torque_on():
            self._servos.goals = ()
            self._phase = GripperPhase.OFF
            self._part_possible = False
            return self._servos.verify(correct=True, refuse=True)
        if held_before:
            self._phase = GripperPhase.HELD_AFTER_FAULT
            self._part_possible = True
        return self._servos.verify(correct=False, refuse=not held_before)

    def read_state(self) -> GripperState:
        """Read the feedback of all servos in one transaction."""
        return self._servos.read()

    def tick(self) -> None:
        """Feed the bus watchdog and look after the servos between commands.

        Raises
        ------
        GripperError
            When the bus is lost or a servo at fault; the fault is latched, the grip kept.
        """
        if self._running or self._phase is GripperPhase.OFF:
            return
        if self._fault is not None:
            self._runner.read()
            return
        with self._latching():
            state = self._runner.read()
            if state is not None:
                self._servos.poll_health(state, watchdog=self._part_possible)

    def open(
        self, aperture_m: float | None = None, observer: Observer | None = None
    ) -> GripperState:
        """Move the empty fingers to an opening in m, by default aperture_open_m.

        Raises
        ------
        GripperStateError
            While a part may be held: then `release` is the command.
        """
        self._check_ready("open", GripperPhase.OFF, GripperPhase.IDLE)
        target_m = self._settings.aperture_open_m if aperture_m is None else aperture_m
        if not self._settings.aperture_min_m <= target_m <= self._settings.aperture_open_m:
            raise LimitExceeded(
                f"aperture_m is {target_m}, must be from {self._settings.aperture_min_m} to "
                f"{self._settings.aperture_open_m}"
            )
        with self._command(GripperPhase.OPENING):
            self._make_ready()
            state = self._move_to(target_m, observer)
        self._phase = GripperPhase.IDLE
        return state

    def grasp(self, ramp: ForceRamp, observer: Observer | None = None) -> GraspOutcome:
        """Close until both pads touch, follow the ramp to its end, return while holding.

        The ramp begins at the force measured at the contact.

        Raises
        ------
        LimitExceeded
            When the ramp asks for more than a limit allows, before anything moves; or when the
            measured force exceeds its cap.
        ForceSensorStale, GraspStopped, ServoFault, BusTimeout, BusCorrupt
            With the grip kept.
        """
        self._check_ready("grasp", GripperPhase.OFF, GripperPhase.IDLE)
        state = self._servos.read()
        self._grasping.check(ramp, state)
        with self._command(GripperPhase.APPROACHING):
            self._make_ready()
            self._part_possible = True
            outcome = self._grasping.run(ramp, observer, self._set_phase)
        held = outcome.result in (GraspResult.FORCE_REACHED, GraspResult.FORCE_NOT_REACHED)
        self._part_possible = held
        self._phase = GripperPhase.HOLDING if held else GripperPhase.IDLE
        return outcome

    def hold(self, duration_s: float, observer: Observer | None = None) -> GripperState:
        """Control the force at its last set-point for a time in s.

        After a while the motor gives back current that friction makes superfluous.

        Raises
        ------
        PartLost
            When both pads become empty.
        """
        control = self._held_control("hold")
        if not duration_s > 0.0:
            raise LimitExceeded(f"duration_s is {duration_s}, must be above 0")
        with self._command(GripperPhase.HOLDING):
            self._make_ready()
            state = self._grasping.hold(control, duration_s, observer)
        self._phase = GripperPhase.HOLDING
        return state

    def back_off(
        self, force_n: float, observer: Observer | None = None, *, rate_n_s: float = 5.0
    ) -> GripperState:
        """Lower the force to ``force_n`` at ``rate_n_s`` without letting go.

        Raises
        ------
        LimitExceeded
            When the force is below the contact force or above the present set-point.
        PartLost
            When both pads become empty.
        """
        control = self._held_control("back_off")
        ramp = self._grasping.back_off_ramp(force_n, rate_n_s)
        with self._command(GripperPhase.BACKING_OFF):
            self._make_ready()
            state = self._grasping.follow_down(control, ramp, observer)
        self._phase = GripperPhase.HOLDING
        return state

    def release(self, observer: Observer | None = None) -> GripperState:
        """Let go: open to aperture_open_m. The only command that lets a part go.

        Raises
        ------
        GripperStateError
            While a fault is latched: `clear_fault` comes first.
        VerificationFailed
            When torque was found on at the start and a servo is not what the settings say.
        """
        self._check_ready("release")
        with self._command(GripperPhase.RELEASING):
            self._make_ready(releasing=True)
            state = self._move_to(self._settings.aperture_open_m, observer)
        self._grasping.forget()
        self._part_possible = False
        self._phase = GripperPhase.IDLE
        return state

    def request_stop(self) -> None:
        """Let the running command end with GraspStopped, goals frozen; safe from any thread."""
        self._runner.request_stop()

    def keep_grip(self) -> None:
        """Freeze in any state: no new goals, torque as it is, bus watchdog disarmed.

        May be called again and again. Raises when the servos cannot be reached: then their
        watchdog may still trip.
        """
        if self._phase is GripperPhase.OFF:
            return
        self._phase = self._resting_phase()
        self._servos.disarm_watchdog()

    def clear_fault(self, *, reboot: bool = False) -> None:
        """Acknowledge a latched fault; nothing moves, torque stays as it is.

        Parameters
        ----------
        reboot
            True to restart servos that report a hardware error: the only way on after a servo
            has switched its torque off. A part that such a servo still held would be dropped.

        Raises
        ------
        ServoFault
            When a servo still reports a hardware error.
        """
        if self._running:
            raise GripperStateError("clear_fault is not possible while a command runs")
        if self._fault is None:
            return
        faulty = self._servos.hardware_errors()
        if faulty and not reboot:
            servo_id, bits = next(iter(faulty.items()))
            raise ServoFault(
                servo_id, bits, "the error lasts: remove its cause, then clear it with reboot=True"
            )
        reboot_servos(self._bus, tuple(faulty), self._clock)
        self._fault = None
        self._runner.forget_stop()
        if not self._servos.torque_on():
            self._servos.goals = ()
            self._part_possible = False
            self._phase = GripperPhase.OFF
            return
        self._phase = self._resting_phase()

    def close(self) -> None:
        """End the work with the servos; the bus stays open for its owner.

        With nothing held the torque goes off. With a part possibly held torque and goals stay as
        they are and the bus watchdog is disarmed, so that the grip does not end by a trip: the
        servos then hold on without supervision until somebody releases the part.
        """
        if self._phase is GripperPhase.OFF:
            return
        try:
            if self._phase is GripperPhase.IDLE and self._fault is None:
                self._servos.switch_off()
            else:
                self._servos.disarm_watchdog()
        except GripperError:
            # Without a bus nothing can be changed any more; the grip stays as it is.
            return
        if self._phase is GripperPhase.IDLE and self._fault is None:
            self._phase = GripperPhase.OFF

    # Inside

    def _set_phase(self, phase: GripperPhase) -> None:
        self._phase = phase

    def _resting_phase(self) -> GripperPhase:
        if self._fault is not None:
            return GripperPhase.HELD_AFTER_FAULT
        if not self._part_possible:
            return GripperPhase.IDLE
        if self._grasping.control is None:
            return GripperPhase.HELD_AFTER_FAULT
        return GripperPhase.HOLDING

    def _check_ready(self, command: str, *phases: GripperPhase) -> None:
        if self._running:
            raise GripperStateError(f"{command} is not possible while another command runs")
        if self._fault is not None:
            raise GripperStateError(
                f"{command} is not possible while a fault is latched ({self._fault}): call "
                f"clear_fault first"
            )
        if phases and self._phase not in phases:
            hint = ": release the part first" if self._part_possible else ""
            raise GripperStateError(
                f"{command} is not possible in the state {self._phase.name}{hint}"
            )

    def _held_control(self, command: str) -> GripControl:
        self._check_ready(command, GripperPhase.HOLDING)
        control = self._grasping.control
        if control is None:
            raise GripperStateError(f"{command} needs a grasp before it")
        return control

    def _move_to(self, aperture_m: float, observer: Observer | None) -> GripperState:
        state = self._servos.read()
        move = MoveTo(
            self._settings,
            self._linkage,
            state,
            self._servos.transmissions(state.servos),
            aperture_m=aperture_m,
            now_s=state.t_s,
        )
        return self._runner.run(self._phase, move.step, observer, needs_force=False)

    def _make_ready(self, *, releasing: bool = False) -> None:
        """Bring torque and bus watchdog into the state that a command needs."""
        servos = self._servos
        known = bool(servos.goals)
        if releasing and not known and servos.torque_on() and not servos.verify(correct=False).ok:
            # The release was asked for: only with the torque off can the mode be corrected.
            servos.switch_off()
            servos.verify(correct=True, refuse=True)
        if not servos.torque_on():
            state = servos.read()
            servos.switch_on(self._motion_current_a(state))
        elif not known or servos.watchdog_tripped():
            if self._part_possible and not releasing:
                raise ServoFault(
                    self._settings.servos[0].servo_id,
                    0,
                    "the bus watchdog has tripped while a part was held, because nobody called "
                    "tick; the servos have stopped, the part may still be gripped",
                )
            servos.restart_watchdog(self._motion_current_a(servos.read()))
        else:
            servos.arm_watchdog()

    def _motion_current_a(self, state: GripperState) -> float:
        paths = self._servos.transmissions(state.servos)
        return motion_current_a(self._settings, paths, self._settings.approach_force_n)

    @contextmanager
    def _command(self, phase: GripperPhase) -> Iterator[None]:
        self._runner.forget_stop()
        self._phase = phase
        self._running = True
        try:
            with self._latching():
                yield
        except GraspStopped:
            self._phase = self._resting_phase()
            raise
        finally:
            self._running = False

    @contextmanager
    def _latching(self) -> Iterator[None]:
        """Latch whatever goes wrong as a fault and keep the grip; a stop on request is none."""
        try:
            yield
        except GraspStopped:
            raise
        except BaseException as error:
            self._fault = error
            self._phase = GripperPhase.HELD_AFTER_FAULT
            # The error that is on its way says what matters; a bus that fails again adds nothing.
            with suppress(GripperError):
                if self._servos.force_is_too_high():
                    self._servos.halve_currents()
                self._servos.disarm_watchdog()
            raise
