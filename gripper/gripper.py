"""The gripper: open, grasp under a force ramp, hold, carry, release, stop.

A part is let go by `Gripper.release` alone. Faults, exceptions, `keep_grip` and `close` leave
goals and torque as they are.
"""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Self

from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.dynamixel.serial_port import ByteStream, open_line
from gripper.errors import (
    FeedbackImplausible,
    GripperError,
    GripperStateError,
    LimitExceeded,
    ServoFault,
)
from gripper.fingers import Fingers
from gripper.force.approach.free_motion import StandStill
from gripper.force.by_current import assume_friction, cap_by_current_n
from gripper.force.control.grip_control import GripControl
from gripper.force.grasp import GraspRun
from gripper.force.loop import Running
from gripper.force.ramp import ForceRamp, check_ramp
from gripper.force.timing import LoopStatistics
from gripper.lifecycle import bus_is_lost
from gripper.mechanics.kinematics import Linkage, ParallelLinkage
from gripper.servos.watchdog_proof import prove_watchdog
from gripper.settings import GripperSettings
from gripper.values.force_sensor import ForceSensor
from gripper.values.outcome import GraspOutcome, GraspResult, ReleaseReport
from gripper.values.servo_checks import ServoCondition, VerificationReport
from gripper.values.state import Cycle, GripperPhase, Observer, ServoFeedback

HOLD_AT_RATE_N_S = 20.0
"""Rate in N/s at which a held force goes to that of the carry: a host waits for the answer."""


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
    force_sensor
        Asked once every period of the loop; None: force by current, see
        `gripper.force.by_current.ForceByCurrent`.
    """

    def __init__(
        self,
        bus: ServoBus,
        linkage: Linkage,
        settings: GripperSettings,
        *,
        clock: Clock,
        force_sensor: ForceSensor | None,
    ) -> None:
        if linkage.n_servos != len(settings.servos):
            raise LimitExceeded(
                f"the linkage is driven by {linkage.n_servos} servos, the settings name "
                f"{len(settings.servos)}"
            )
        if force_sensor is None:
            assume_friction(settings)
            settings = replace(settings, force_max_n=cap_by_current_n(settings, linkage))
        self._bus = bus
        self._linkage = linkage
        self._clock = clock
        self._settings = settings
        self._fingers = fingers = Fingers(bus, linkage, settings, clock, force_sensor)
        self._servos, self._health = fingers.servos, fingers.health
        self._runner, self._life = fingers.runner, fingers.life
        self._grasping = GraspRun(
            fingers.runner,
            fingers.servos,
            linkage,
            settings,
            set_phase=fingers.life.set_phase,
            free=fingers.free,
        )
        fingers.on_torque = self._grasping.start_proving
        self._watchdog_proven = False
        self._carried: Running | None = None

    def __enter__(self) -> Self:
        """Verify the servos, see `start`; where that raises the port is closed."""
        try:
            self.start()
        except BaseException:
            self._bus.close()
            raise
        return self

    def __exit__(self, *_error: object) -> None:
        """End the work with the servos, see `close`, and close the port: a held part stays held."""
        self.close()
        self._bus.close()

    @property
    def bus(self) -> ServoBus:
        """The servos' line."""
        return self._bus

    @property
    def phase(self) -> GripperPhase:
        """Phase of the gripper."""
        return self._life.phase

    @property
    def fault(self) -> BaseException | None:
        """The latched fault, None without one."""
        return self._life.fault

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
            When a servo is missing, or with its torque off does not match the settings.
        ServoFault
            When no servo has torque and one reports a hardware error: see `clear_fault`.
        LinkTooSlow
            When the answers come too late for the rate of the loop.
        GripperStateError
            While a fault is latched or a command runs.
        """
        self._life.check_ready("start")
        self._health.require_present()
        for servo_id, seen in self._servos.feedback.strayed.items():
            raise FeedbackImplausible(
                f"servo {servo_id}: {seen}, and it was not restarted since then: where its finger "
                f"is, is unknown, and nothing is moved. Check encoder, horn and linkage, then "
                f"clear the fault with a reboot"
            )
        report = self._fingers.verify()
        self._fingers.check_link([servo.servo_id for servo in self._settings.servos])
        return report

    def conditions(self) -> tuple[ServoCondition, ...]:
        """Read torque and errors of each servo, of those too that others hide; reads only."""
        return self._fingers.conditions()

    def inspect(self) -> VerificationReport:
        """Compare the servos, and where they stand, with the settings; reads only."""
        report = self._health.verify(correct=False)
        return replace(report, rows=report.rows + self._fingers.standing_rows())

    def read_feedback(self) -> ServoFeedback:
        """Read the feedback of all servos in one transaction."""
        return self._servos.read_patiently()

    def tick(self) -> Cycle | None:
        """Feed the bus watchdog and check the servos between commands.

        While a part is carried this is one period of the force loop. Returns the period; without a
        force where none is controlled, None where the servos were not asked or did not answer.

        Raises
        ------
        GripperError
            When the bus is lost or a servo at fault; the fault is latched, the grip kept.
        """
        if self._life.running or self._life.phase is GripperPhase.OFF:
            return None
        if not self._servos.goals_in_force:
            # Torque that was found on, or is lost: there is nothing here to be supervised.
            return None
        if self._life.fault is not None:
            with self._servos.in_loop():
                self._runner.read()
            return None
        with self._life.latching():
            if self._carried is not None:
                return self._runner.period(self._carried)
            with self._servos.in_loop():
                state = self._runner.read()
            if state is None:
                return None
            self._health.poll(state, watchdog=self._life.part_possible)
        return Cycle(
            t_s=state.t_s,
            phase=self._life.phase,
            state=state,
            goal_current_a=self._servos.goal_current_a,
        )

    def open(
        self, aperture_m: float | None = None, observer: Observer | None = None
    ) -> ServoFeedback:
        """Move the empty fingers to an opening in m, by default aperture_open_m.

        Where the torque comes on for it the motion proves direction, zero and linkage, see
        `gripper.force.approach.mechanics_proof`. Where a servo counts in another turn than that of
        its zero too, the fingers stand for 0.2 s first: one that does not is not where its servo
        reports it to be. In both cases the torque goes off.

        With the setting ``watchdog_self_test`` the first opening ends with that test: the fingers
        close by a few mm, stand until the watchdog has tripped, and open again.

        Raises
        ------
        VerificationFailed
            When a finger stands where the settings exclude it; nothing has moved.
        MechanicsContradicted
            When the fingers do not move as the settings have it; they have no torque then.
        WatchdogUnproven
            When the bus watchdog does not stop the motors.
        GripperStateError
            While a part may be held: then `release` is the command.
        """
        self._life.check_ready("open")
        target_m = self._settings.aperture_open_m if aperture_m is None else aperture_m
        if not self._settings.aperture_min_m <= target_m <= self._settings.aperture_open_m:
            raise LimitExceeded(
                f"aperture_m is {target_m}, must be from {self._settings.aperture_min_m} to "
                f"{self._settings.aperture_open_m}"
            )
        with self._life.command("open", observer):
            was_limp = self._fingers.make_ready()
            if was_limp and self._servos.feedback.off_by_turns:
                standing = StandStill(self._settings, self._servos.read_patiently())
                self._runner.run(standing.step, needs_force=False)
            state = self._fingers.move_to(target_m, first=was_limp)
            if self._settings.watchdog_self_test and not self._watchdog_proven:
                prove_watchdog(
                    self._servos, self._health, self._linkage, self._settings, self._clock
                )
                self._watchdog_proven = True
                state = self._fingers.move_to(target_m)
        return state

    def check_ramp(self, ramp: ForceRamp) -> None:
        """Raise LimitExceeded when `grasp` would refuse a ramp; the servos are not asked."""
        check_ramp(ramp, self._settings, self._linkage)

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
        return self._close(ramp, observer, self._grasping.run)

    def press_pads_together(
        self, ramp: ForceRamp, observer: Observer | None = None
    ) -> GraspOutcome:
        """Close the empty fingers onto each other, follow the ramp to its end, return holding.

        The way down is that of a grasp, and goes on below ``aperture_min_m`` until the pads meet.
        Where they touch something farther open than a zero that is off explains, the ramp ends at
        the contact: ``ended_early``. It is held, as whatever is between them after `end_ramp`.

        Raises
        ------
        MechanicsContradicted
            When nothing stops the fingers; they have no torque then.
        GripContradicted
            When they are stopped and the pads feel nothing.
        LimitExceeded, ForceSensorStale, GraspStopped, ServoFault, BusTimeout, BusCorrupt
            As `grasp`.
        """
        return self._close(ramp, observer, self._grasping.press_pads_together)

    def measure_load(self, observer: Observer | None = None) -> None:
        """Measure the current of each servo for its load, while the empty pads press on each other.

        One finger is locked by its friction, the other one moves slowly; then they change. Follows
        `press_pads_together`, where nothing is between the pads; they press on. The results are in
        the settings' ``drives``. A gripper with one servo has no other one to press against.

        Raises
        ------
        As `hold`.
        """
        control = self._held_control("hold")
        with self._life.command("hold", observer):
            self._fingers.make_ready()
            self._grasping.measure_load(control)

    def measure_friction(self, observer: Observer | None = None) -> None:
        """Measure the friction of each servo at several speeds; the empty fingers end open.

        They close to a gap without a look at the pads: nothing may be between them.
        """
        self._life.check_ready("open")
        with self._life.command("open", observer):
            self._fingers.make_ready()
            self._fingers.measure_friction()

    def read_drives(self) -> DriveReport:
        """Return the newest drive characteristic of each servo, and what was unusual since then."""
        free, drives = self._fingers.free, self._settings.drives.newest
        notes, free.notes = free.notes, []
        return DriveReport(drives, tuple(notes))

    def use_drives(self, drives: Mapping[int, DriveCharacteristic]) -> None:
        """Begin with drive characteristics that were kept, by the servos' IDs."""
        for servo_id, drive in drives.items():
            self._settings.drives.put(servo_id, drive)
        self._fingers.free.forget()

    def hold(self, duration_s: float, observer: Observer | None = None) -> ServoFeedback:
        """Control the force at its last set-point for a time in s.

        After ``taper_after_s`` the motor gives back current that friction makes superfluous.

        Raises
        ------
        PartLost
            When both pads become empty.
        PartSlipped
            When the force falls at once or the fingers close after the part.
        """
        control = self._held_control("hold")
        if not duration_s > 0.0:
            raise LimitExceeded(f"duration_s is {duration_s}, must be above 0")
        with self._life.command("hold", observer):
            self._fingers.make_ready()
            return self._grasping.hold(control, duration_s)

    def hold_at(
        self, force_n: float, duration_s: float = 0.0, observer: Observer | None = None
    ) -> ServoFeedback:
        """Bring the held force to ``force_n``, hold it for a time in s, and keep controlling it.

        From then on each `tick` is a period of the force loop, with all supervision of `hold`,
        until a release, a stop or a fault. The bus watchdog is disarmed meanwhile: the grip of a
        carried part must not end because a process does.

        Raises
        ------
        LimitExceeded
            When no ramp may end at that force.
        PartLost, PartSlipped
            As `hold`.
        """
        control = self._held_control("hold_at")
        ramp = ForceRamp.linear(force_n, HOLD_AT_RATE_N_S, start_n=control.grip.setpoint_n)
        self.check_ramp(ramp)
        self._carried = None
        with self._life.command("hold_at", observer):
            self._fingers.make_ready()
            if force_n != control.grip.setpoint_n:
                state = self._grasping.follow(control, ramp)
            self._life.phase = GripperPhase.HOLDING
            if duration_s > 0.0 or force_n == control.grip.setpoint_n:
                state = self._grasping.hold(control, max(duration_s, self.period_s))
            self._servos.disarm_watchdog()
        self._carried = self._grasping.hold_on(control, state.t_s)
        return state

    def squeeze(self, ramp: ForceRamp, observer: Observer | None = None) -> GraspOutcome:
        """Follow a further ramp up from the present set-point, in the same grip, and hold.

        Raises
        ------
        LimitExceeded
            When a limit is against the ramp, or the present set-point is not below its end.
        PartLost, PartSlipped
            As `hold`.
        """
        control = self._held_control("squeeze")
        self.check_ramp(ramp)
        held_n = control.grip.setpoint_n
        if not held_n < ramp.final_n:
            raise LimitExceeded(
                f"a further ramp to {ramp.final_n} N is not above the held {held_n} N: carry it "
                f"with less force first"
            )
        self._carried = None
        with self._life.command("squeeze", observer):
            self._fingers.make_ready()
            return self._grasping.squeeze(control, ramp)

    def release(self, observer: Observer | None = None) -> ReleaseReport:
        """Let go: open to aperture_open_m. The only command that lets a part go.

        Needs no start before it. Where this gripper has not given the torque itself, or has lost
        it, a servo that is silent, or that an error of its own keeps without torque, is left as it
        is and reported: the other finger opens alone. No finger closes, not even one that stands
        wider open. Stopped or at fault on the way the fingers stand still; a note on the error
        names where.

        Raises
        ------
        GripperStateError
            While a fault is latched: `clear_fault` comes first.
        VerificationFailed
            When no servo answers, or one does not match the settings; see the message for what
            became of the torque.
        ServoFault
            When no servo can be moved.
        """
        self._life.check_ready("release")
        self._carried = None
        return self._fingers.release(observer)

    def end_ramp(self) -> None:
        """Let the running ramp end at its present set-point, as if it had no more; from any thread.

        The force settles there without a further hold, and `grasp` returns as usual, with
        `GraspOutcome.ended_early`: the part is held, all supervision goes on. A set-point that
        could not hold a part yet grows to contact_force_n first. Asked while the fingers approach
        the ramp ends as it begins; asked when the ramp is over, or while nothing is grasped,
        nothing changes, for the next grasp neither. A stop, a fault and the loss of the part come
        first.
        """
        self._grasping.end_ramp()

    def request_stop(self) -> None:
        """Let the running command end with GraspStopped; safe from any thread.

        Goals of a grip are frozen, fingers on their way stop where they are.
        """
        self._fingers.request_stop()

    def keep_grip(self) -> None:
        """Freeze in any state: no new goals, torque as it is, bus watchdog disarmed.

        May be called again and again. Raises when the servos cannot be reached: then their
        watchdog may still trip. After the loss of the bus, and while a servo has not taken the goal
        to stand still, nothing is written any more. After any other fault a servo that is silent
        is not waited for: the report of the fault waits for this.
        """
        if self._life.phase is GripperPhase.OFF or bus_is_lost(self._life.fault):
            return
        if self._life.motion_unconfirmed:
            return
        self._freeze_carried()
        self._life.rest()
        with nullcontext() if self._life.fault is None else self._servos.in_loop():
            self._servos.disarm_watchdog(keep_trips=True)

    def clear_fault(self, *, reboot: bool = False) -> None:
        """Acknowledge a fault, one from before the start too; nothing moves, torque stays as it is.

        A servo that does not answer is no hindrance while another one does: `start` refuses it,
        and `release` opens the other finger.

        Parameters
        ----------
        reboot
            True to restart servos that report a hardware error, or whose position has leapt: the
            only way on after a servo has switched its torque off. A part that such a servo still
            held would be dropped.

        Raises
        ------
        ServoFault
            When a servo still reports a hardware error, and ``reboot`` is False.
        BusTimeout, BusCorrupt
            When no servo answers.
        """
        if self._life.running:
            raise GripperStateError("clear_fault is not possible while a command runs")
        conditions = self.conditions()
        if not any(condition.answers for condition in conditions):
            # Reading again raises what is wrong with the bus.
            self._health.torque_on()
        faulty = [condition for condition in conditions if condition.error_bits]
        if faulty and not reboot:
            raise ServoFault(
                faulty[0].servo_id,
                faulty[0].error_bits,
                "the error lasts: remedy its cause, then clear it with a reboot",
            )
        restart = [one.servo_id for one in conditions if one.error_bits or one.strayed]
        if restart and reboot:
            self._servos.reboot(restart)
            conditions = self.conditions()
        self._fingers.free.distrust()
        self._life.fault = None
        self._life.motion_unconfirmed = False
        self._runner.forget_stop()
        self._carried = None
        if self._servos.goals_in_force and all(condition.torque_on for condition in conditions):
            self._life.rest()
        elif any(condition.torque_on or not condition.answers for condition in conditions):
            # This gripper gave no goals, or not all of them are in force any more.
            self._servos.forget()
            self._life.found_held()
        else:
            self._life.switched_off()

    def close(self) -> None:
        """End the work with the servos; the bus stays open for its owner.

        With nothing held the torque goes off. With a part possibly held torque and goals stay as
        they are and the bus watchdog is disarmed, so that the grip does not end by a trip: the
        servos then hold on without supervision until somebody releases the part. The watchdog stays
        armed where it alone stops fingers on their way.
        """
        if self._life.phase is GripperPhase.OFF or self._life.motion_unconfirmed:
            return
        try:
            if self._life.phase is GripperPhase.IDLE and self._life.fault is None:
                self._servos.switch_off()
            else:
                self._freeze_carried()
                self._servos.disarm_watchdog()
        except GripperError:
            # Without a bus nothing can be changed any more; the grip stays as it is.
            return
        if self._life.phase is GripperPhase.IDLE and self._life.fault is None:
            self._life.phase = GripperPhase.OFF

    def _close(
        self,
        ramp: ForceRamp,
        observer: Observer | None,
        run: Callable[[ForceRamp], GraspOutcome],
    ) -> GraspOutcome:
        """Close with one of the runs of a grasp, and keep what is held after it."""
        self._life.check_ready("grasp")
        if self._settings.watchdog_self_test and not self._watchdog_proven:
            raise GripperStateError(
                "grasp is not possible before the bus watchdog has proven to stop the motors: "
                "open the gripper, its self-test follows (watchdog_self_test is on)"
            )
        self.check_ramp(ramp)
        with self._life.command("grasp", observer):
            self._fingers.make_ready()
            self._life.part_possible = True
            outcome = run(ramp)
        held = outcome.result in (GraspResult.FORCE_REACHED, GraspResult.FORCE_NOT_REACHED)
        self._life.part_possible = self._life.controlled = held
        self._life.phase = GripperPhase.HOLDING if held else GripperPhase.IDLE
        return outcome

    def _freeze_carried(self) -> None:
        """Freeze the goals of a carried part, whose force nobody controls any more."""
        if self._carried is not None:
            self._carried = None
            if self._life.fault is None:
                self._servos.freeze()

    def _held_control(self, command: str) -> GripControl:
        self._life.check_ready(command)
        control = self._grasping.control
        if control is None:
            raise GripperStateError(f"{command} needs a grasp before it")
        return control


def open_gripper(
    port: str | ByteStream,
    settings: GripperSettings | None = None,
    linkage: Linkage | None = None,
    *,
    baud_rate: int = 1_000_000,
    force_sensor: ForceSensor | None = None,
) -> Gripper:
    """Open the servos' port and return their gripper; ``with`` verifies the servos.

    Leaving the block closes the port and lets no part go: what is held stays held, with its torque
    on and nothing supervised, until somebody releases it; with nothing held the torque goes off.

    One thread commands the gripper. Between two commands the servos' bus watchdog trips after
    ``watchdog_s``: with a part in the grip call `Gripper.tick` or `Gripper.hold` meanwhile, or
    `Gripper.keep_grip` before work that takes longer.

    Parameters
    ----------
    port
        Serial port, as /dev/ttyUSB0; or an open line, as a simulated cell has one in its place.
    settings
        Servos, limits and tuning; by default two XM430-W350 with the IDs 1 and 2.
    linkage
        Mechanics; by default fingers on parallelograms with links of 60 mm.
    baud_rate
        Of the servos, in bit/s.
    force_sensor
        Asked once every period of the loop. None: the force is controlled by the motors' current
        alone, which is less exact and sees less; see `gripper.force.by_current.ForceByCurrent`.

    Raises
    ------
    PortLost
        When the port cannot be opened.
    LimitExceeded
        When the settings contradict each other, the linkage or the port.
    """
    settings = settings or GripperSettings()
    linkage = linkage or ParallelLinkage(link_m=0.06, n_servos=len(settings.servos))
    stream, clock = open_line(port, baud_rate)
    try:
        bus = ServoBus(
            stream,
            baudrate=baud_rate,
            clock=clock,
            period_s=settings.period_s,
            name=f"the servo line ({port})",
            ram_shifts={one.servo_id: one.servo_model.ram_shift for one in settings.servos},
        )
        return Gripper(bus, linkage, settings, clock=clock, force_sensor=force_sensor)
    except BaseException:
        stream.close()
        raise
