"""The servos of one gripper as a group: feedback, goals, torque, bus watchdog, health."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace

from gripper import errors
from gripper.clock import Clock
from gripper.dynamixel import control_table as ct
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import OperatingMode, ServoModel, model_name
from gripper.mechanics.transmission import Mechanics
from gripper.servos.feedback import Feedback
from gripper.servos.goal_limits import (
    GOAL_BLOCK,
    GoalWriter,
    ServoGoal,
    closing_margin_rad,
    standing,
)
from gripper.servos.verification import CORRECTABLE, Requirement, requirements
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.servo_checks import (
    HardwareError,
    ServoCondition,
    VerificationReport,
    VerificationRow,
    overload_text,
)
from gripper.values.state import ServoFeedback, ServoState

_TRIES = 3
"""Readings until a servo counts as silent, and writes of goals until it counts as not obeying: one
lost answer is not enough."""
_STALE_PERIODS = 2.0
"""Age of the feedback, in periods, above which moving fingers are read again before a stop."""
_FARTHEST_GOAL_RAD = 1.0
"""Largest plausible distance in rad of a servo under torque from its goal. Fingers of 60 mm move by
0.6 rad at most; goals of the force loop lie 0.1 rad beyond the contact."""
_BOOT_S = 0.5
"""Wait in s after a reboot before a request: a servo does not receive while it boots."""
_BOOT_TIMEOUT_S = 3.0
"""Longest time in s after that wait until a servo answers."""
_BOOT_RETRY_S = 0.1
"""Time in s between two requests to a servo that boots."""
_TORQUE = ct.RegisterBlock(ct.TORQUE_ENABLE)
_CHECKS = 3
"""Checks of each servo in turn: torque, a register of the start, bus watchdog."""


class Servos:
    """All servos of one gripper; the only object that writes to them in operation."""

    def __init__(self, bus: ServoBus, mechanics: Mechanics, clock: Clock) -> None:
        self._bus = bus
        self.mechanics = mechanics
        """Of the gripper."""
        self.settings = settings = mechanics.settings
        """Its settings."""
        self._clock = clock
        self._ids = [servo.servo_id for servo in settings.servos]
        self.goals = GoalWriter(bus, mechanics, clock)
        """Writer of the goals within their limits, with the last ones; the force is passed to it.
        """
        self.feedback = Feedback(bus, mechanics, clock, self.check_torque)
        """Reader of the feedback, with the last one."""
        self.watchdog_proven = False
        """Whether these servos have passed the self-test of their bus watchdog."""
        self.notes: list[str] = []
        """Warnings of servos that were not yet fetched."""
        self._polls = 0
        self._accepted: dict[int, int] = {}
        self._overloaded: set[int] = set()

    # Feedback

    def read(self) -> ServoFeedback:
        """Read the feedback of all servos in one transaction; errors as in `Feedback.read`."""
        sample = self.goals.fresh_force
        # A load that is unknown may be one.
        loaded = sample is None or max(sample.force_n) >= self.settings.contact_force_n
        return self.feedback.read(under_torque=bool(self.goals.last), loaded=loaded)

    def read_patiently(self) -> ServoFeedback:
        """Read as `read` does, again where an answer was lost or old; for use between commands."""
        for _ in range(_TRIES - 1):
            with suppress(errors.BusTimeout, errors.BusCorrupt):
                return self.read()
        return self.read()

    def silent_and_living(self) -> tuple[list[int], list[int]]:
        """Return the IDs of the servos without a last answer, and of those with one."""
        silent = [servo_id for servo_id in self._ids if self._bus.misses[servo_id]]
        return silent, [servo_id for servo_id in self._ids if servo_id not in silent]

    def in_loop(self) -> AbstractContextManager[None]:
        """Limit the wait of each transaction in the block to that of the loop; see `ServoBus`."""
        return self._bus.in_loop()

    def forget(self) -> None:
        """Discard goals, feedback and proof: the servos were restarted or switched off."""
        self.goals.forget()
        self.feedback.forget()
        # They may be others when their torque comes on again.
        self.watchdog_proven = False

    # Goals

    @property
    def goal_current_a(self) -> float:
        """Mean of the goal currents in A; 0 while no goal is in force."""
        goals = self.goals.last
        return sum(goal.current_a for goal in goals) / max(1, len(goals))

    # Stop goals; without a goal in force, or without any feedback, they are not written.

    @property
    def heats(self) -> bool:
        """Whether a servo has more current than it bears for hours."""
        pairs = zip(self.goals.last, self.settings.servos, strict=False)
        return any(goal.current_a > servo.servo_model.holding_a for goal, servo in pairs)

    def freeze(self, *, supervised: bool = False) -> None:
        """Keep the last goals, without a push on the drive.

        ``supervised``: the loop runs on and watches the heat. Else no servo keeps more current than
        it bears for hours.
        """
        self._read_after_stall()
        state, last = self.feedback.last, self.goals.last
        if state is not None and last:
            goals = frozen(last, state)
            if not supervised:
                goals = for_hours(goals, self.settings)
            self.goals.write(goals, state, final=True)

    def hold_position(self, share: float = 1.0) -> None:
        """Set the goals to the last read positions, with a share of the lasting currents."""
        state, last = self.feedback.last, self.goals.last
        if state is not None and last:
            self.goals.write(standing([goal.lasting for goal in last], state, share), state)

    def stop_motion(self, share: float = 1.0) -> list[int]:
        """End a motion at the present positions; return the IDs of servos not confirmed to obey.

        A share of the currents is left. No servo answers the write of all goals: they are read
        back.
        """
        if self.feedback.last is None or not self.goals.last:
            return []
        self._read_after_stall()
        unconfirmed: list[int] = []
        for _ in range(_TRIES):
            try:
                self.hold_position(share)
            except errors.GripperError:
                return list(self._ids)
            unconfirmed = [servo_id for servo_id in self._ids if not self._obeys(servo_id)]
            if not unconfirmed:
                break
        return unconfirmed

    def lower(self, first: Sequence[ServoGoal], share: float, state: ServoFeedback) -> None:
        """Write goals with a share of the first currents; below 0 they drive the fingers open.

        The last goals may brake: then their currents are less than the share, and they stay.
        """
        if share >= 0.0:
            goals = [
                goal._replace(current_a=min(share * goal.current_a, now.lasting.current_a))
                for goal, now in zip(first, self.goals.last, strict=True)
            ]
        else:
            models = (servo.servo_model for servo in self.settings.servos)
            goals = [
                goal._replace(
                    angle_rad=servo.angle_rad + closing_margin_rad(model, -share * goal.current_a),
                    current_a=-share * goal.current_a,
                )
                for goal, servo, model in zip(first, state.servos, models, strict=True)
            ]
        self.goals.write(goals, state)

    def _read_after_stall(self) -> None:
        """Read old feedback again: the fingers have moved, and goals by it are refused."""
        state = self.feedback.last
        if state is None or any(self._bus.misses[servo_id] for servo_id in self._ids):
            return
        if self._clock.monotonic() - state.t_s > _STALE_PERIODS * self.settings.period_s:
            with suppress(errors.GripperError):
                self.read()

    # Torque and bus watchdog

    def make_ready(
        self, *, part_possible: bool, releasing: bool, limp: ServoFeedback | None = None
    ) -> None:
        """Switch the torque on where it is off, arm or restart the watchdog, before a command.

        Goals are set to the present positions before the torque goes on and after a watchdog trip,
        so that nothing jumps. Raises ServoFault when the watchdog tripped, or a torque went off,
        while a part was held. Raises VerificationFailed when a servo to be released does not match
        the settings. Raises FeedbackImplausible when a servo under torque reports a position far
        from its goal.

        Parameters
        ----------
        part_possible
            True when a part may be held: then a tripped watchdog is a fault.
        releasing
            True when the part is to be released: then a trip is no fault. Torque that was already
            on may be switched off to correct the mode.
        limp
            Feedback just read, where no servo has torque.
        """
        self.feedback.check.letting_go = releasing
        in_force = bool(self.goals.last)
        if releasing and not in_force:
            self.make_releasable()
        off = limp is not None or not all(self.torques())
        if off and part_possible and in_force and not releasing:
            # Torque that came on again would hide that the part may have been dropped.
            self.check_torques()
        if off or not in_force or self._finds_trip():
            if part_possible and not (off or releasing):
                raise errors.ServoFault(
                    self._ids[0],
                    "its bus watchdog has tripped while a part was held: the program sent nothing "
                    f"to the servos for {1e3 * self.settings.watchdog_s:g} ms or more. The servos "
                    "have stopped, the part may still be gripped. Clear, then release",
                )
            state, force_n = limp or self.read_patiently(), self.settings.approach_force_n
            paths = self.mechanics.transmissions(state.angles_rad)
            current_a = max(self.mechanics.motion_currents_a(paths, force_n))
            self.restart_watchdog(current_a, switch_on=off)

    def restart_watchdog(self, current_a: float, *, switch_on: bool = False) -> None:
        """Clear a tripped watchdog, set the goals to the present positions and arm it again.

        With ``switch_on`` the torque comes on before the watchdog is armed.
        """
        self._check_mode()
        self.disarm_watchdog()
        self._hold_present_position(current_a)
        for servo_id in self._ids if switch_on else ():
            self._bus.write(servo_id, ct.TORQUE_ENABLE, 1)
        for servo_id in self._ids:
            self._bus.write(servo_id, ct.BUS_WATCHDOG, self.settings.watchdog_raw)

    def disarm_watchdog(self, *, but: Sequence[int] = (), keep_trips: bool = False) -> None:
        """Disarm, or clear after a trip, the bus watchdog of each servo (register 98) but some.

        An error is raised after all servos were tried: a silent servo does not hinder the other.

        Parameters
        ----------
        but
            IDs of the servos whose watchdog stays armed.
        keep_trips
            True to leave a tripped watchdog: its servo holds less, and the next command finds it.
        """
        failed: errors.GripperError | None = None
        for servo_id in (servo_id for servo_id in self._ids if servo_id not in but):
            try:
                if not (keep_trips and self.has_tripped(servo_id)):
                    self._bus.write(servo_id, ct.BUS_WATCHDOG, 0)
            except errors.GripperError as error:
                failed = failed or error
        if failed is not None:
            raise failed

    def switch_off(self) -> None:
        """Disarm the watchdog and switch the torque off."""
        self.disarm_watchdog()
        for servo_id in self._ids:
            self._bus.write(servo_id, ct.TORQUE_ENABLE, 0)
        self.goals.forget()

    def go_limp(self) -> None:
        """Switch off the torque of every servo that answers: position or force are unknown.

        The bus watchdog of the others stays armed.
        """
        self.goals.forget()
        unconfirmed = list(self._ids)
        for servo_id in [*self._ids] * _TRIES:
            if servo_id in unconfirmed:
                with suppress(errors.GripperError):
                    self._bus.write(servo_id, ct.TORQUE_ENABLE, 0)
                    unconfirmed.remove(servo_id)
        with suppress(errors.GripperError):
            self.disarm_watchdog(but=unconfirmed)

    def reboot(self, ids: Sequence[int]) -> None:
        """Reboot servos one after the other and wait until each answers; a held part is dropped.

        The servos come back with their torque off and their RAM at its defaults; the next
        `gripper.gripper.Gripper.start` verifies them. Raises BusTimeout or BusCorrupt when a servo
        does not answer within 3 s.
        """
        for servo_id in ids:
            # A late answer is lost in the restart.
            with suppress(errors.BusTimeout, errors.BusCorrupt):
                self._bus.reboot(servo_id)
            self.feedback.check.strayed.pop(servo_id, None)
            self._clock.sleep(_BOOT_S)
            deadline_s = self._clock.monotonic() + _BOOT_TIMEOUT_S
            while True:
                try:
                    self._bus.ping(servo_id)
                    break
                except (errors.BusTimeout, errors.BusCorrupt):
                    if self._clock.monotonic() >= deadline_s:
                        raise
                self._clock.sleep(_BOOT_RETRY_S)
        self.forget()

    # Checks that read the servos and, at the start, correct some of their registers

    def torques(self) -> list[int]:
        """Read Torque Enable (register 64) of each servo."""
        raws = self._bus.sync_read(self._ids, _TORQUE)
        return [raws[servo_id][ct.TORQUE_ENABLE.name] for servo_id in self._ids]

    def conditions(self) -> tuple[ServoCondition, ...]:
        """Read torque and errors of each servo; a silent servo is no error here."""
        return tuple(self._condition(servo_id) for servo_id in self._ids)

    def _condition(self, servo_id: int) -> ServoCondition:
        strayed = self.feedback.check.strayed.get(servo_id, "")
        silent = ServoCondition(servo_id=servo_id, answers=False, strayed=strayed)
        for _ in range(_TRIES):
            try:
                torque_on = self._bus.read(servo_id, ct.TORQUE_ENABLE) != 0
                bits = self._bus.read(servo_id, ct.HARDWARE_ERROR_STATUS)
                shutdown_bits = self._bus.read(servo_id, ct.SHUTDOWN) if bits else 0
            except errors.AnswersOff:
                return replace(silent, answers_off=True)
            except (errors.BusTimeout, errors.BusCorrupt):
                continue
            return ServoCondition(
                servo_id=servo_id,
                torque_on=torque_on,
                error_bits=bits,
                shut_down=not torque_on and bits & shutdown_bits != 0,
                strayed=strayed,
            )
        return silent

    def require_present(self) -> None:
        """Ping every servo. Raises ServoMissing, which names the IDs that answer instead."""
        silent: dict[int, errors.BusTimeout | errors.BusCorrupt] = {}
        for servo_id in self._ids:
            try:
                self._bus.ping(servo_id)
            except (errors.BusTimeout, errors.BusCorrupt) as error:
                silent[servo_id] = error
        if not silent:
            return
        answering, _ = self._bus.scan_at_once()
        others = [servo for servo in answering if servo.servo_id not in self._ids]
        ids = ", ".join(f"{servo.servo_id} ({model_name(servo.model_number)})" for servo in others)
        rows = tuple(
            VerificationRow(
                servo_id=servo_id,
                item="ping",
                expected=f"an answer at {self._bus.baudrate} baud",
                actual=("no right answer" if servo_id in silent else "an answer")
                + (f"; other IDs that answer: {ids}" if ids else ""),
                ok=servo_id not in silent,
            )
            for servo_id in self._ids
        )
        report = VerificationReport(rows=rows)
        advice = (
            "give the servo its ID, or name the right one in gripper.servos[].id"
            if others
            else "check supply, cable, gripper.baud_rate and gripper.servos[].id, and that no two "
            "servos share an ID"
        )
        raise errors.ServoMissing(report, advice) from next(iter(silent.values()))

    def verify(self, *, correct: bool, refuse: bool = False) -> VerificationReport:
        """Compare the registers of all servos with their requirements.

        Raises ServoFault when the only problems are errors that servos report: `clear` may remove
        them. Raises VerificationFailed when another row does not agree.

        Parameters
        ----------
        correct
            True to rewrite the correctable registers where they differ; the torque must be off.
        refuse
            True to raise when a row does not agree.
        """
        servos = self.settings.servos
        rows = [row for servo in servos for row in self._verify_one(servo, correct=correct)]
        report = VerificationReport(rows=tuple(rows))
        if correct:
            self._bus.port.return_delay_s = 0.0
        if refuse and not report.ok:
            reported = [row for row in report.failed if row.item == ct.HARDWARE_ERROR_STATUS.name]
            if len(reported) < len(report.failed):
                raise errors.VerificationFailed(report)
            raise errors.ServoFault(
                reported[0].servo_id,
                "it reports a hardware error from before the start and nothing has moved; remedy "
                "its cause, then clear it with a reboot",
                bits=int(reported[0].actual),
                torque_lost=True,
            )
        return report

    def make_releasable(self) -> None:
        """Correct the registers of servos before a release; switches their torque off for it.

        An error that a servo reports now blocks neither this nor `poll` until `end_release`. Raises
        VerificationFailed where another register does not agree and may not be corrected: the
        fingers have no torque then.
        """
        self._accepted = {
            condition.servo_id: condition.error_bits for condition in self.conditions()
        }
        report = self.verify(correct=False)
        if all(row.item == ct.HARDWARE_ERROR_STATUS.name for row in report.failed):
            return
        self.switch_off()
        report = self.verify(correct=True)
        if any(row.item != ct.HARDWARE_ERROR_STATUS.name for row in report.failed):
            raise errors.VerificationFailed(
                report, "the torque is off now and the fingers did not open"
            )

    def end_release(self) -> None:
        """End the acceptance of errors of servos, and of positions that a part let go explains."""
        self._accepted = {}
        self.feedback.check.letting_go = False
        for motor in self.feedback.check.motors.values():
            motor.pause()  # its limit is smaller again

    def _required(self, servo: ServoSettings) -> tuple[Requirement, ...]:
        settings = self.settings
        return requirements(servo.servo_model, settings.current_max_a, settings.temperature_max_c)

    def _verify_one(self, servo: ServoSettings, *, correct: bool) -> Iterator[VerificationRow]:
        servo_id = servo.servo_id
        self._bus.ping(servo_id)
        for required in self._required(servo):
            register = ct.REGISTERS[required.item]
            raw = self._bus.read(servo_id, register)
            allowed = correct and required.item in CORRECTABLE
            if corrects := allowed and not required.met_by(raw):
                self._bus.write(servo_id, register, required.low)
                raw = self._bus.read(servo_id, register)
            yield required.row(servo_id, raw, corrected=corrects)
            if register is ct.MODEL_NUMBER and not required.met_by(raw):
                # For another model the other items may have another meaning.
                return

    def poll(self, state: ServoFeedback, *, watchdog: bool = True) -> None:
        """Check one more item of one servo; called repeatedly while the torque is on.

        Raises ServoFault when a servo reports a hardware error, has lost its torque or its watchdog
        tripped. An overload that the servo only reports is a note.

        Parameters
        ----------
        state
            Newest feedback; an Alert in it is examined at once.
        watchdog
            False where a tripped watchdog does no harm.
        """
        for servo in state.servos:
            # A reported overload keeps the alert on: it is read again in turn only.
            if servo.alert and servo.servo_id not in self._overloaded:
                self._check_hardware(servo.servo_id)
        turn, check = divmod(self._polls, _CHECKS)
        n_rounds, index = divmod(turn, len(self._ids))
        self._polls += 1
        if check == 0:
            self.check_torque(self._ids[index])
            if self._ids[index] in self._overloaded:
                self._check_hardware(self._ids[index])
        elif check == 1:
            self._check_register(index, n_rounds)
        elif watchdog and self.has_tripped(self._ids[index]):
            raise errors.ServoFault(
                self._ids[index],
                "its bus watchdog has tripped because the loop fell silent; the servo has "
                "stopped, a part may still be gripped",
            )

    def _check_register(self, index: int, n_rounds: int) -> None:
        """Read the next register that was verified at the start; all of them in turn."""
        servo = self.settings.servos[index]
        required = self._required(servo)
        item = required[n_rounds % len(required)]
        if item.item == ct.HARDWARE_ERROR_STATUS.name:
            return
        register = ct.REGISTERS[item.item]
        raw = self._bus.read(servo.servo_id, register)
        if not item.met_by(raw):
            raw = self._bus.read(servo.servo_id, register)  # it may be an older answer again
        if not item.met_by(raw):
            raise errors.ServoFault(
                servo.servo_id,
                f"its register {item.item} has changed since the start: expected "
                f"{item.expected}, found {raw}. Somebody else writes to this servo, or it has "
                f"restarted; the goals are frozen",
            )

    def _check_hardware(self, servo_id: int) -> None:
        bits = self._bus.read(servo_id, ct.HARDWARE_ERROR_STATUS)
        if bits:
            lost = self._bus.read(servo_id, ct.TORQUE_ENABLE) == 0
            if not lost and bits == self._accepted.get(servo_id):
                return
            if not lost and bits == HardwareError.OVERLOAD:
                if servo_id in self._overloaded:
                    return
                shutdown_raw = self._bus.read(servo_id, ct.SHUTDOWN)
                if not shutdown_raw & bits:
                    self._overloaded.add(servo_id)
                    self.notes.append(f"servo {servo_id}: {overload_text(shutdown_raw)}")
                    return
            detail = (
                "it has switched its torque off; remedy the cause, then clear the fault with a "
                "reboot"
                if lost
                else "it reports a hardware error and still has its torque"
            )
            raise errors.ServoFault(servo_id, detail, bits=bits, torque_lost=lost)

    def check_torque(self, servo_id: int) -> None:
        """Raise ServoFault when a servo has lost its torque."""
        if self._bus.read(servo_id, ct.TORQUE_ENABLE) == 0:
            bits = self._bus.read(servo_id, ct.HARDWARE_ERROR_STATUS)
            raise errors.ServoFault(
                servo_id,
                "its torque is off although it was not switched off here: a reboot, a shutdown, "
                "or another program on the bus",
                bits=bits,
                torque_lost=True,
            )

    def check_torques(self) -> None:
        """Raise ServoFault when a servo has lost its torque; a lost answer decides nothing."""
        for servo_id in self._ids:
            with self.in_loop(), suppress(errors.BusTimeout, errors.BusCorrupt):
                self.check_torque(servo_id)

    def has_tripped(self, servo_id: int) -> bool:
        """Read the bus watchdog of a servo (register 98); return whether it has tripped."""
        return self._bus.read(servo_id, ct.BUS_WATCHDOG) == ct.WATCHDOG_TRIPPED_RAW

    # Parts

    def _finds_trip(self) -> bool:
        """Arm the bus watchdogs that are not armed; return whether one has tripped, which stays so.

        Arming a tripped one would clear it, and the next goals would make the force jump back.
        """
        tripped = False
        for servo_id in self._ids:
            raw = self._bus.read(servo_id, ct.BUS_WATCHDOG)
            if raw == ct.WATCHDOG_TRIPPED_RAW:
                tripped = True
            elif raw != self.settings.watchdog_raw:
                self._bus.write(servo_id, ct.BUS_WATCHDOG, self.settings.watchdog_raw)
        return tripped

    def _check_goal_is_near(self, servo: ServoState, model: ServoModel) -> None:
        """Raise FeedbackImplausible where a servo under torque is too far from its goal.

        A position farther from the goal than a gripping program sets one is not the position in the
        servo's control loop. A goal made of it would move the finger there.
        """
        servo_id, position_raw = servo.servo_id, servo.position_raw
        if self._bus.read(servo_id, ct.TORQUE_ENABLE) == 0:
            return
        goal_raw = self._bus.read(servo_id, ct.GOAL_POSITION)
        away_rad = abs(position_raw - goal_raw) * model.rad_per_pulse
        if away_rad > _FARTHEST_GOAL_RAD:
            raise errors.FeedbackImplausible(
                f"servo {servo_id}: it reports the position {position_raw} while it holds the goal "
                f"{goal_raw}, {away_rad:.2f} rad away, at most {_FARTHEST_GOAL_RAD} rad are "
                f"plausible: where its finger is, is unknown, so the torque is switched off and a "
                f"held part possibly dropped. Check who else writes to this servo, and its encoder"
            )

    def _check_mode(self) -> None:
        """Raise ServoFault where a servo is in another mode: the meaning of goals differs."""
        for servo_id in self._ids:
            if self._bus.read(servo_id, ct.OPERATING_MODE) != OperatingMode.CURRENT_BASED_POSITION:
                raise errors.ServoFault(
                    servo_id,
                    "its operating mode is no longer 5 (current-based position): it restarted, or "
                    "another program wrote to it. Clear the fault, then reset",
                )

    def _hold_present_position(self, current_a: float) -> None:
        """Write the present positions as goals and read them back; ServoFault where one differs.

        After its watchdog was cleared, a servo stands until the next write of any goal. Then it
        follows all its goals, also old ones: position and current come first, in one write.
        """
        for _ in range(_TRIES):
            state = self.read_patiently()
            for servo, settings in zip(state.servos, self.settings.servos, strict=True):
                self._check_goal_is_near(servo, settings.servo_model)
            self.goals.write(
                [ServoGoal(angle_rad=angle, current_a=current_a) for angle in state.angles_rad],
                state,
            )
            fault = self._not_taken()
            if fault is None:
                break
        if fault is not None:
            raise fault
        for servo_id in self._ids:
            # The goals of the other modes limit this mode too.
            self._bus.write(servo_id, ct.GOAL_PWM, self._bus.read(servo_id, ct.PWM_LIMIT))

    def _not_taken(self) -> errors.ServoFault | None:
        """Read the last goals back; return the fault of a servo that has another goal."""
        goals_raw = self._bus.sync_read(self._ids, GOAL_BLOCK)
        for servo_id, (current_raw, *_, position_raw) in self.goals.raws.items():
            wrote = {ct.GOAL_POSITION.name: position_raw, ct.GOAL_CURRENT.name: current_raw}
            for name, raw in wrote.items():
                if (read_raw := goals_raw[servo_id][name]) != raw:
                    return errors.ServoFault(
                        servo_id,
                        f"it did not take its {name}: wrote {raw}, read {read_raw}; check the "
                        f"servo line, then clear the fault",
                    )
        return None

    def _obeys(self, servo_id: int) -> bool:
        """Read whether a servo has its last goal; clear a watchdog that blocks it.

        There is no wait for a servo that did not answer last.
        """
        if self._bus.misses[servo_id]:
            return False
        with suppress(errors.GripperError):
            if self._bus.read(servo_id, ct.GOAL_POSITION) == self.goals.raws[servo_id][-1]:
                return True
            if self.has_tripped(servo_id):
                self._bus.write(servo_id, ct.BUS_WATCHDOG, 0)
        return False


def frozen(last: Sequence[ServoGoal], state: ServoFeedback) -> list[ServoGoal]:
    """Return the goals that keep the present force: the last ones without a push.

    A goal that opens would let the part go. That finger is held at its present position, and
    position control uses as much of the current as it needs.
    """
    return [
        goal.lasting._replace(angle_rad=min(goal.lasting.angle_rad, servo.angle_rad))
        for goal, servo in zip(last, state.servos, strict=True)
    ]


def for_hours(goals: Sequence[ServoGoal], settings: GripperSettings) -> list[ServoGoal]:
    """Return goals with at most the currents that the servos bear for hours."""
    return [
        goal._replace(current_a=min(goal.current_a, servo.servo_model.holding_a))
        for goal, servo in zip(goals, settings.servos, strict=True)
    ]
