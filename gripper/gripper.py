"""The gripper: open, grasp under a force ramp, hold, carry, release, stop.

Only `Gripper.release` lets a part go. Faults, exceptions, `keep_grip` and `close` do not change
goals and torque.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from math import inf
from typing import Self

from gripper import errors
from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import PRESENT_POSITION
from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.dynamixel.latency import check_link
from gripper.dynamixel.serial_port import ByteStream, open_line
from gripper.force.approach.empty_motion import FirstMotion, MoveTo, StandStill
from gripper.force.approach.mechanics_proof import standing_rows
from gripper.force.certainty import RECOVERED_S
from gripper.force.control.grip_control import GripControl
from gripper.force.estimates.free_motion import FreeMotion
from gripper.force.grasp import GraspRun, GripStep, HoldStep
from gripper.force.load_trial import LoadTrial
from gripper.force.loop import LoopRunner, Running
from gripper.force.ramp import ForceRamp, check_ramp
from gripper.force.timing import LoopStatistics
from gripper.lifecycle import Lifecycle, bus_is_lost
from gripper.mechanics.identification import fit_load
from gripper.mechanics.kinematics import Linkage, ParallelLinkage
from gripper.mechanics.transmission import Mechanics
from gripper.servos.goal_limits import OPENING_MARGIN_RAD, check_temperature
from gripper.servos.group import Servos
from gripper.servos.watchdog_proof import prove_watchdog
from gripper.settings import GripperSettings
from gripper.values.force_sensor import ForceSensor
from gripper.values.outcome import GraspOutcome, GraspResult, ReleaseReport
from gripper.values.servo_checks import ServoCondition, VerificationReport, VerificationRow
from gripper.values.state import Cycle, GripperPhase, Observer, ServoFeedback, TimeSpan

HOLD_AT_RATE_N_S = 20.0
"""Rate in N/s from a held force to the carry force: a host waits for the answer."""
_CLEAR_M = 0.002
"""Way in m after which nothing touches fingers that open. [chosen]"""

_FREE_RAD_S = (0.15, 0.25, 0.4, 0.65)
"""Speeds in rad/s at which friction is measured: slow enough for its part at rest, and far enough
apart for the rest of it. [chosen]"""
_FREE_S = 0.5
"""Longest time in s of each of these motions. [tuned]"""
_LOW_CONTACTS, _HIGH_SHARE, _LEAST_SPAN_N = 2.5, 0.9, 2.0
"""Forces between which a drive is measured: the least in contact forces, the largest as a share of
the held force, and the least difference of both in N. [chosen]"""
_CURRENT_SHARE = 0.9
"""Largest share of the current limit in this measurement. [chosen]"""


class Gripper:
    """A two-finger gripper with force control; one thread commands it.

    While the torque is on, the servos' bus watchdog is armed. A running command feeds it; between
    commands the owner calls `tick` at least every half ``watchdog_s``. The next command clears a
    watchdog that tripped while nothing was held; while a part is held a trip is a fault.
    `keep_grip` and `close` disarm it, because the reaction of a servo to a trip is not documented
    and a grip must not depend on it.

    Parameters
    ----------
    bus
        The servos; the caller opens and closes it.
    mechanics
        Settings, linkage and drives.
    force_sensor
        Read once every period of the loop.
    """

    def __init__(
        self, bus: ServoBus, mechanics: Mechanics, *, clock: Clock, force_sensor: ForceSensor
    ) -> None:
        self.bus = bus
        """The servos' line."""
        self.mechanics = mechanics
        """Settings, linkage, and what the motions have measured of the drives."""
        self._linkage, self._clock = mechanics.linkage, clock
        self.settings = settings = mechanics.settings
        """Limits and tuning."""
        self._ids = [servo.servo_id for servo in settings.servos]
        self._servos = servos = Servos(bus, mechanics, clock)
        self._sensor = force_sensor
        self._life = life = Lifecycle(servos, force_sensor, clock)
        self._runner = runner = LoopRunner(servos, force_sensor, clock, life)
        self._free = FreeMotion(runner)
        self._grasping = GraspRun(runner, life.set_phase, self._free)
        self._link_checked = False
        self._carried: Running | None = None
        self._finger: Gripper | None = None

    def __enter__(self) -> Self:
        """Verify the servos, see `start`; an error closes the port."""
        try:
            self.start()
        except BaseException:
            self.bus.close()
            raise
        return self

    def __exit__(self, *_error: object) -> None:
        """End the work with the servos, see `close`, and close the port: a held part stays held."""
        self.close()
        self.bus.close()

    @property
    def phase(self) -> GripperPhase:
        """Phase of the gripper."""
        return self._life.phase

    @property
    def fault(self) -> BaseException | None:
        """The latched fault, None without one."""
        return self._life.fault

    @property
    def statistics(self) -> LoopStatistics:
        """Timing of the loop."""
        return self._runner.timer.statistics()

    def start(self) -> VerificationReport:
        """Verify the servos; nothing moves and no torque is switched.

        With the torque off, operating mode, return delay and status return level are corrected.
        With the torque on, a part may be held: only the status return level is corrected, the state
        becomes HELD_AFTER_FAULT, and `release` is the next step.

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
        self._servos.require_present()
        self.bus.demand_answers(self._ids)
        for servo_id, seen in self._servos.feedback.check.strayed.items():
            raise errors.FeedbackImplausible(
                f"servo {servo_id}: {seen}, and it was not restarted since then: the position of "
                f"its finger is unknown, and nothing is moved. Check encoder, horn and linkage, "
                f"then clear the fault with a reboot"
            )
        held_before = self._life.phase is not GripperPhase.IDLE
        if not any(self._servos.torques()):
            self._life.switched_off()
            report = self._servos.verify(correct=True, refuse=True)
            _check_standing(self._standing_rows())
        else:
            if held_before:
                self._carried = None
                self._life.torque_from_before()
            report = self._servos.verify(correct=False, refuse=not held_before)
        self._check_link(self._ids)
        return report

    def conditions(self) -> tuple[ServoCondition, ...]:
        """Read torque and errors of each servo, also after the failure of another; reads only."""
        return self._servos.conditions()

    def inspect(self) -> VerificationReport:
        """Compare the servos and their positions with the settings; reads only."""
        report = self._servos.verify(correct=False)
        return replace(report, rows=report.rows + self._standing_rows())

    def tick(self) -> Cycle | None:
        """Feed the bus watchdog and check the servos between commands.

        While a part is carried this is one period of the force loop. Returns the period, without a
        force if no force is controlled; None if the servos were not asked or did not answer.

        Raises
        ------
        GripperError
            When the bus is lost or a servo at fault; the fault is latched, the grip kept.
        """
        if self._life.running or not self._servos.goals.last:
            # Torque from before the start, or no torque: nothing to supervise.
            return None
        if self._life.fault is not None:
            with self._servos.in_loop():
                self._runner.read()
            return None
        try:
            if self._carried is not None:
                return self._runner.period(self._carried)
            with self._servos.in_loop():
                state = self._runner.read()
            if state is None:
                return None
            self._servos.poll(state, watchdog=self._life.part_possible)
            if self._life.part_possible:
                check_temperature(self.settings, state)
        except BaseException as error:
            self._life.latch(error)
            raise
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

        If the torque comes on for it, the motion proves direction, zero and linkage, see
        `gripper.force.approach.mechanics_proof`. If a servo also counts in another turn than that
        of its zero, the fingers must first stand for 0.2 s: a finger that moves is not at the
        reported position. After a failure the torque goes off.

        With the setting ``watchdog_self_test`` the first opening ends with that test: the fingers
        close by a few mm, stand until the watchdog has tripped, and open again.

        Raises
        ------
        VerificationFailed
            When the settings exclude the position of a finger; nothing has moved.
        MechanicsContradicted
            When the settings exclude the motion of the fingers; they have no torque then.
        WatchdogUnproven
            When the bus watchdog does not stop the motors.
        FingerBlocked
            When a finger does not arrive. What stops it may be held: `release` is the next step.
        GripperStateError
            While a part may be held: call `release`.
        """
        self._life.check_ready("open")
        target_m = self.settings.aperture_open_m if aperture_m is None else aperture_m
        if not self.settings.aperture_min_m <= target_m <= self.settings.aperture_open_m:
            raise errors.LimitExceeded(
                f"aperture_m is {target_m}, must be from {self.settings.aperture_min_m} to "
                f"{self.settings.aperture_open_m}"
            )
        with self._command("open", observer) as was_limp:
            state = self._move_to(target_m, first=was_limp)
            if self.settings.watchdog_self_test and not self._servos.watchdog_proven:
                state = self._prove_watchdog(target_m)
        return state

    def _prove_watchdog(self, target_m: float) -> ServoFeedback:
        """Close the fingers for the self-test of the watchdog, and open them again."""
        # What stops them, or lies between them at a stop, may be held.
        self._life.part_possible = True
        try:
            prove_watchdog(self._servos, self._clock)
            self._servos.watchdog_proven = True
            state = self._move_to(target_m)
        except errors.WatchdogUnproven:
            self._life.part_possible = False
            raise
        self._life.part_possible = False
        return state

    def check_ramp(self, ramp: ForceRamp) -> None:
        """Raise LimitExceeded when `grasp` would refuse a ramp; does not use the servos."""
        check_ramp(ramp, self.mechanics)

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
        return self._close("grasp", self._grasping.run, ramp, observer)

    def press_pads_together(
        self, ramp: ForceRamp, observer: Observer | None = None
    ) -> GraspOutcome:
        """Close the empty fingers onto each other, follow the ramp to its end, return holding.

        The fingers close as in a grasp, and also below ``aperture_min_m``, until the pads meet. If
        they touch something farther open than a wrong zero can explain, the ramp ends at the
        contact: ``ended_early``. The part is then held, as after `end_ramp`.

        Raises
        ------
        MechanicsContradicted
            When nothing stops the fingers; they have no torque then.
        GripContradicted
            When they are stopped although the pads show no contact.
        LimitExceeded, ForceSensorStale, GraspStopped, ServoFault, BusTimeout, BusCorrupt
            As `grasp`.
        """
        press = self._grasping.press_pads_together
        return self._close("press_pads_together", press, ramp, observer)

    def hold(self, duration_s: float, observer: Observer | None = None) -> ServoFeedback:
        """Control the force at its last set-point for a time in s.

        The driving force stays in the middle of the friction band: the current needs no friction.

        Raises
        ------
        PartLost
            When both pads become empty.
        PartSlipped
            When the force drops or the fingers close.
        """
        control = self._held_control("hold")
        if not duration_s > 0.0:
            raise errors.LimitExceeded(f"duration_s is {duration_s}, must be above 0")
        with self._command("hold", observer):
            try:
                return self._runner.run(HoldStep(self.settings, control, duration_s).step)
            finally:
                if self._carried is not None:
                    with suppress(errors.GripperError):
                        self._servos.disarm_watchdog()

    def hold_at(
        self, force_n: float, duration_s: float = 0.0, observer: Observer | None = None
    ) -> ServoFeedback:
        """Bring the held force to ``force_n``, hold it for a time in s, and keep controlling it.

        Each later `tick` is a period of the force loop, with all supervision of `hold`, until a
        release, a stop or a fault. The bus watchdog is disarmed meanwhile: the end of a process
        must not end the grip of a carried part.

        Raises
        ------
        LimitExceeded
            When a ramp must not end at this force.
        PartLost, PartSlipped
            As `hold`.
        """
        control = self._held_control("hold_at")
        if not duration_s >= 0.0:
            raise errors.LimitExceeded(f"duration_s is {duration_s}, must be at least 0")
        ramp = ForceRamp.linear(force_n, HOLD_AT_RATE_N_S, start_n=control.grip.setpoint_n)
        self.check_ramp(ForceRamp.linear(force_n, HOLD_AT_RATE_N_S))
        self._carried = None
        with self._command("hold_at", observer):
            if force_n != control.grip.setpoint_n:
                control.resume(force_n)
                state = self._runner.run(GripStep(self.settings, control, ramp).step)
            self._life.phase = GripperPhase.HOLDING
            if duration_s > 0.0 or force_n == control.grip.setpoint_n:
                hold_s = max(duration_s, self.settings.period_s)
                state = self._runner.run(HoldStep(self.settings, control, hold_s).step)
            self._servos.disarm_watchdog()
        carrying = HoldStep(self.settings, control, inf)
        control.grip.carried_s = min(control.grip.carried_s, state.t_s + RECOVERED_S)
        self._carried = self._runner.start_command(carrying.step, now_s=state.t_s)
        return state

    def squeeze(self, ramp: ForceRamp, observer: Observer | None = None) -> GraspOutcome:
        """Follow a further ramp up from the present set-point, in the same grip, and hold.

        Raises
        ------
        LimitExceeded
            When a limit does not allow the ramp, or its end is not above the present set-point.
        PartLost, PartSlipped
            As `hold`.
        """
        control = self._held_control("squeeze")
        self.check_ramp(ramp)
        held_n = control.grip.setpoint_n
        if not held_n < ramp.final_n:
            raise errors.LimitExceeded(
                f"the further ramp ends at {ramp.final_n} N, it must end above the held {held_n} "
                f"N: ask for more force, or carry the part with less force first"
            )
        self._carried = None
        with self._command("squeeze", observer):
            return self._grasping.squeeze(control, ramp)

    def read_drives(self) -> DriveReport:
        """Return the newest drive of each servo, and notes since the last call."""
        free, servos = self._free, self._servos
        notes, free.notes = free.notes, []
        warnings, servos.notes = servos.notes, []
        return DriveReport(dict(self.mechanics.drives.newest), (*notes, *warnings))

    def use_drives(self, drives: Mapping[int, DriveCharacteristic]) -> None:
        """Use saved drive characteristics, by the servos' IDs."""
        for servo_id, drive in drives.items():
            self.mechanics.drives.put(servo_id, drive)
        self._free.forget()

    def measure_load(self, observer: Observer | None = None) -> tuple[TimeSpan, ...]:
        """Measure the current of each servo under load, while the empty pads press on each other.

        Friction locks one finger while the other one moves slowly, then vice versa: the force rises
        and falls. Call it after `Gripper.press_pads_together` with nothing between the pads; they
        still press afterwards. If the current, or the held force, leaves too small a range, the
        drives do not change. Not for a gripper with one servo.

        Returns
        -------
        When each finger moved alone; empty if the drives did not change.

        Raises
        ------
        As `Gripper.hold`.
        """
        settings, mechanics = self.settings, self.mechanics
        control = self._held_control("measure_load")
        with self._command("measure_load", observer):
            low_n = _LOW_CONTACTS * settings.contact_force_n
            state = self._servos.read_patiently()
            paths = mechanics.transmissions(state.angles_rad)
            most_a = _CURRENT_SHARE * settings.current_max_a
            bearable_n = min(path.loaded_n(most_a) for path in paths)
            high_n = min(_HIGH_SHARE * control.grip.setpoint_n, bearable_n)
            if high_n - low_n < _LEAST_SPAN_N or len(paths) < 2:
                return ()
            spans = []
            try:
                for finger, servo in enumerate(settings.servos):
                    trial = LoadTrial(control, finger, (low_n, high_n))
                    since_s = state.t_s
                    for rises in (False, True):
                        trial.start(rises=rises)
                        state = self._runner.run(trial.step)
                    spans.append(TimeSpan(since_s, state.t_s))
                    before = mechanics.drives.of(servo)
                    drive = fit_load(trial.rising, trial.falling, before)
                    mechanics.drives.put(servo.servo_id, drive)
            finally:
                control.begin_again(state)
            self._free.compare()
            return tuple(spans)

    def measure_friction(self, observer: Observer | None = None) -> None:
        """Measure the friction of each servo at several speeds; the empty fingers end open.

        They close to a gap without a check of the pads: nothing may be between them.
        """
        settings, linkage = self.settings, self._linkage
        wide_m = settings.aperture_open_m
        near_m = max(settings.aperture_min_m, 0.0) + _CLEAR_M
        self._life.check_ready("measure_friction")
        with self._command("measure_friction", observer):
            for speed_rad_s in _FREE_RAD_S:
                for closes in (True, False):
                    state = self._servos.read_patiently()
                    reach_m = sum(map(linkage.opening_per_rad_m, state.angles_rad))
                    speed_m_s = speed_rad_s * reach_m
                    end_m = max(near_m, wide_m - _FREE_S * speed_m_s) if closes else wide_m
                    move = MoveTo(self.mechanics, state, aperture_m=end_m, speed_m_s=speed_m_s)
                    self._run_free(move, state)

    def release(self, observer: Observer | None = None) -> ReleaseReport:
        """Let go: open to aperture_open_m. The only command that lets a part go.

        It needs no start. The torque may be from an earlier program, or lost. Then a servo that is
        silent or in an error is reported and not changed: the other finger opens alone. No finger
        closes, even if it is open wider. After a stop or fault the fingers stand still; a note on
        the error names the opening.

        Raises
        ------
        GripperStateError
            While a fault is latched: `clear_fault` comes first.
        VerificationFailed
            When no servo answers, or one does not match the settings; the message names the state
            of the torque.
        ServoFault
            When no servo can be moved.
        FeedbackImplausible
            When a finger whose torque comes on does not stand, a turn off; it has no torque then.
        PositionContradicted
            When a finger runs on although its encoder stands, after the pads are free.
        """
        self._life.check_ready("release")
        self._carried = None
        if not self._servos.goals.last:
            self.bus.demand_answers(self._ids)
            left = self._not_able()
            if left:
                return self._open_finger(left[0], observer)
        with self._life.command("release", observer):
            try:
                was_limp = self._make_ready(releasing=True)
                # The force of a part that a stop leaves half held cannot be controlled.
                self._life.controlled = False
                wider = self._wider_open()
                state = self._move_to(self.settings.aperture_open_m, only_open=True, first=was_limp)
            finally:
                self._servos.end_release()
            self._life.part_possible = False
        return ReleaseReport(state=state, opened=tuple(self._ids), wider=wider)

    def end_ramp(self) -> None:
        """End the running ramp at its present set-point, from any thread.

        The force settles there without a further hold, and `grasp` returns as usual, with
        `GraspOutcome.ended_early`: the part is held and supervised. A set-point too small to hold a
        part first grows to contact_force_n. During the approach a call ends the ramp at its start.
        After the ramp, or without a grasp, a call changes nothing, also for the next grasp. A stop,
        a fault and the loss of the part have priority.
        """
        self._grasping.end.set()

    def request_stop(self) -> None:
        """Stop the running command with GraspStopped; safe from any thread.

        The goals of a grip are frozen; moving fingers stop.
        """
        self._life.stop_request.set()
        if (finger := self._finger) is not None:
            finger.request_stop()

    def keep_grip(self) -> None:
        """Freeze in any state: no new goals, torque unchanged, bus watchdog disarmed.

        May be called repeatedly. Raises when the servos cannot be reached: then their watchdog may
        still trip. After the loss of the bus, or of the goal to stand still, nothing is written.
        After any other fault it does not wait for a silent servo, so that the fault is reported
        without delay.
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
        """Acknowledge a fault, also one from before the start; nothing moves, the torque stays.

        One silent servo is accepted: `start` refuses it, and `release` opens the other finger.

        Parameters
        ----------
        reboot
            True to restart servos that report a hardware error, or whose position has jumped. This
            is needed after a servo has switched its torque off. If the servo still holds a part,
            the part drops.

        Raises
        ------
        ServoFault
            When a servo still reports a hardware error, and ``reboot`` is False.
        BusTimeout, BusCorrupt
            When no servo answers.
        """
        if self._life.running:
            raise errors.GripperStateError("clear_fault is not possible while a command runs")
        self.bus.demand_answers(self._ids)
        conditions = self.conditions()
        if not any(condition.answers for condition in conditions):
            # Reading again raises the fault of the bus.
            self._servos.torques()
        for _ in range(2 if reboot else 0):  # a request may be lost
            restart = [servo.servo_id for servo in conditions if servo.error_bits or servo.strayed]
            if restart:
                self._servos.reboot(restart)
                conditions = self.conditions()
        for condition in conditions:
            if condition.error_bits:
                raise errors.ServoFault(
                    condition.servo_id,
                    "the error lasts after a reboot: remedy its cause, then clear it again"
                    if reboot
                    else "the error lasts: remedy its cause, then clear it with a reboot",
                    bits=condition.error_bits,
                )
        under_torque = all(condition.torque_on for condition in conditions)
        if not under_torque or isinstance(self._life.fault, errors.ServoFault):
            self._free.distrust()
        self._life.fault = None
        self._life.motion_unconfirmed = False
        self._carried = None
        if self._servos.goals.last and under_torque:
            self._life.rest()
        elif any(condition.torque_on or not condition.answers for condition in conditions):
            # This gripper gave no goals, or some are no longer in force.
            self._servos.forget()
            self._life.torque_from_before()
        else:
            self._life.switched_off()

    def close(self) -> None:
        """End the work with the servos; the bus stays open for its owner.

        With nothing held the torque goes off. If a part may be held, torque and goals do not
        change: the servos hold without supervision until a release. The bus watchdog is disarmed,
        so that a trip does not end the grip. The watchdog stays armed if only it stops moving
        fingers.
        """
        if self._life.phase is GripperPhase.OFF or self._life.motion_unconfirmed:
            return
        # Without a bus nothing can be changed; the grip stays as it is.
        with suppress(errors.GripperError):
            if self._life.phase is GripperPhase.IDLE and self._life.fault is None:
                self._servos.switch_off()
                self._life.switched_off()
            else:
                self._freeze_carried()
                self._servos.disarm_watchdog()

    def _close(
        self,
        command: str,
        run: Callable[[ForceRamp], GraspOutcome],
        ramp: ForceRamp,
        observer: Observer | None,
    ) -> GraspOutcome:
        """Close and follow a ramp as `grasp`, and keep what is held."""
        self._life.check_ready(command)
        if self.settings.watchdog_self_test and not self._servos.watchdog_proven:
            raise errors.GripperStateError(
                f"{command} needs the self-test of the bus watchdog first (watchdog_self_test is "
                f"on): open the gripper, the test follows"
            )
        self.check_ramp(ramp)
        with self._command(command, observer):
            self._life.part_possible = True
            try:
                outcome = run(ramp)
            except BaseException:
                # A stop before the ramp leaves a part whose force nothing can control.
                self._life.controlled &= self._grasping.control is not None
                raise
            held = outcome.result in (GraspResult.FORCE_REACHED, GraspResult.FORCE_NOT_REACHED)
            self._life.part_possible = self._life.controlled = held
        return outcome

    def _freeze_carried(self) -> None:
        """Freeze the goals of a part whose force, or whose heat, is not watched from now on."""
        carried, self._carried = self._carried, None
        if self._life.fault is not None:
            return
        if carried is not None or self._servos.heats:
            try:
                # A push must not last as long as lost answers are awaited.
                with self._servos.in_loop():
                    self._servos.freeze()
            except errors.BusUnreliable:  # the feedback is old
                with suppress(errors.BusTimeout, errors.BusCorrupt):
                    self._servos.read_patiently()
                    self._servos.freeze()

    @contextmanager
    def _command(self, name: str, observer: Observer | None) -> Iterator[bool]:
        """Run a command on ready servos; yields whether all of them were without torque."""
        with self._life.command(name, observer):
            yield self._make_ready()

    def _held_control(self, command: str) -> GripControl:
        """Return the control of the held part. Raises GripperStateError without a part."""
        self._life.check_ready(command)
        if self._grasping.control is None:
            raise errors.GripperStateError(f"{command} needs a grasp before it")
        return self._grasping.control

    def _check_link(self, ids: Sequence[int]) -> None:
        check_link(self.bus, ids, self.settings.period_s)
        self._link_checked = True

    def _standing_rows(self) -> tuple[VerificationRow, ...]:
        """Read the positions of the fingers, and compare them with the settings."""
        positions_raw = [self.bus.read(servo_id, PRESENT_POSITION) for servo_id in self._ids]
        return standing_rows(self.mechanics, positions_raw)

    def _make_ready(self, *, releasing: bool = False) -> bool:
        """Prepare the servos for a command; return whether all of them were without torque."""
        limp: ServoFeedback | None = None
        if not self._servos.goals.last:
            if not any(self._servos.torques()):
                limp = self._servos.read_patiently()
                positions_raw = [servo.position_raw for servo in limp.servos]
                _check_standing(standing_rows(self.mechanics, positions_raw))
                self._grasping.start_proving()
            elif not (releasing or self._life.part_possible):
                raise errors.GripperStateError(
                    "a servo has torque from before this program, so a part may be held: it is "
                    "kept. Clear the fault, then release, or call start first"
                )
        self._servos.make_ready(
            part_possible=self._life.part_possible, releasing=releasing, limp=limp
        )
        if limp is not None and any(self._servos.feedback.turns.values()):
            standing = StandStill(self.settings, self._servos.read_patiently())
            self._runner.run(standing.step, needs_force=False)
        return limp is not None

    def _move_to(
        self, aperture_m: float, *, only_open: bool = False, first: bool = False
    ) -> ServoFeedback:
        """Move empty fingers to an opening in m; ``first`` where their torque has just come on."""
        kind = FirstMotion if first else MoveTo
        state = self._servos.read_patiently()
        move = kind(self.mechanics, state, aperture_m=aperture_m, only_open=only_open)
        return self._run_free(move, state)

    def _run_free(self, move: FirstMotion | MoveTo, state: ServoFeedback) -> ServoFeedback:
        """Run a motion of empty fingers from a state, and measure their friction."""

        def is_free(now: ServoFeedback) -> bool:
            # A part that is let go, and foam, push the fingers open at first.
            return abs(now.aperture_m - state.aperture_m) >= _CLEAR_M

        return self._free.run(move.step, is_free, needs_force=False)

    def _open_finger(self, left: ServoCondition, observer: Observer | None) -> ReleaseReport:
        """Open one finger alone; do not touch the servo of the other one."""
        (movable,) = (servo for servo in self.settings.servos if servo.servo_id != left.servo_id)
        settings, linkage = replace(self.settings, servos=(movable,)), self._linkage.of_one_finger()
        self._finger = finger = Gripper(
            self.bus,
            Mechanics(settings, linkage, self.mechanics.drives),
            clock=self._clock,
            force_sensor=self._sensor,
        )
        finger._link_checked = self._link_checked
        self._servos.forget()
        self._life.phase, self._life.running = GripperPhase.RELEASING, True
        try:
            state = finger.release(observer).state
            with suppress(errors.GripperError):
                finger._servos.switch_off()
        finally:
            self._finger, self._life.running = None, False
            self._life.take_over(finger._life)
        self._life.part_possible = False
        self._life.switched_off()
        return ReleaseReport(state=state, opened=(movable.servo_id,), left=(left,))

    def _not_able(self) -> list[ServoCondition]:
        """Return the servos that cannot be moved; raises if no servo can be moved."""
        conditions = self.conditions()
        if not any(condition.answers for condition in conditions):
            self._servos.require_present()
            raise errors.BusTimeout(
                "the servos answer only sometimes, and nothing was moved: check cable and "
                "supply, then release again"
            )
        able = [condition.servo_id for condition in conditions if condition.able]
        if not able:
            limp = next(condition for condition in conditions if condition.answers)
            raise errors.ServoFault(
                limp.servo_id,
                f"no finger can be opened: {'; '.join(map(str, conditions))}. Take the part out "
                f"by hand, or remedy the cause, clear the error with a reboot and release again",
                bits=limp.error_bits,
            )
        if not self._link_checked:
            self._check_link(able)
        self._life.part_possible |= any(c.torque_on or not c.answers for c in conditions)
        return [condition for condition in conditions if not condition.able]

    def _wider_open(self) -> tuple[int, ...]:
        """Return the IDs of the servos whose fingers stand wider open than the gripper opens."""
        widest_rad = self._linkage.angles_rad(self.settings.aperture_open_m)
        servos = self._servos.read_patiently().servos
        return tuple(
            servo.servo_id
            for servo, open_rad in zip(servos, widest_rad, strict=True)
            if servo.angle_rad > open_rad + OPENING_MARGIN_RAD
        )


def _check_standing(rows: tuple[VerificationRow, ...]) -> None:
    """Raise VerificationFailed where a finger stands where the settings exclude it."""
    report = VerificationReport(rows=rows)
    if not report.ok:
        raise errors.VerificationFailed(report)


def open_gripper(
    port: str | ByteStream,
    settings: GripperSettings | None = None,
    linkage: Linkage | None = None,
    *,
    baud_rate: int = 1_000_000,
    force_sensor: ForceSensor,
) -> Gripper:
    """Open the servos' port and return their gripper; ``with`` verifies the servos.

    The end of the block closes the port and lets no part go: a held part stays held, with torque
    but without supervision, until a release; with nothing held the torque goes off.

    One thread commands the gripper. Between two commands the servos' bus watchdog trips after
    ``watchdog_s``: with a part in the grip call `Gripper.tick` or `Gripper.hold` meanwhile, or
    `Gripper.keep_grip` before longer work.

    Parameters
    ----------
    port
        Serial port, e.g. /dev/ttyUSB0; or an open line, e.g. of a simulated cell.
    settings
        Servos, limits and tuning; by default two XM430-W350 with the IDs 1 and 2.
    linkage
        Mechanics; by default fingers on parallelograms with links of 60 mm.
    baud_rate
        Of the servos, in bit/s.
    force_sensor
        Read once every period of the loop, e.g. a `tactile.GripForce`.

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
            ram_shifts={servo.servo_id: servo.servo_model.ram_shift for servo in settings.servos},
        )
        mechanics = Mechanics(settings, linkage)
        return Gripper(bus, mechanics, clock=clock, force_sensor=force_sensor)
    except BaseException:
        stream.close()
        raise
