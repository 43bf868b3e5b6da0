"""Health of the servos: their settings, torque, hardware errors and bus watchdog."""

from gripper.dynamixel.bus import ServoBus, protocol_1_text
from gripper.dynamixel.control_table import (
    BUS_WATCHDOG,
    HARDWARE_ERROR_STATUS,
    MODEL_NUMBER,
    REGISTERS,
    SHUTDOWN,
    TORQUE_ENABLE,
    WATCHDOG_TRIPPED_RAW,
    RegisterBlock,
)
from gripper.dynamixel.models import MODELS
from gripper.errors import (
    AnswersOff,
    BusCorrupt,
    BusTimeout,
    ServoFault,
    ServoMissing,
    VerificationFailed,
)
from gripper.servos.verification import compare, requirements
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.servo_checks import (
    HardwareError,
    ServoCondition,
    VerificationReport,
    VerificationRow,
    overload_text,
)
from gripper.values.state import ServoFeedback

_TORQUE = RegisterBlock(TORQUE_ENABLE)
_FACTORY_ID = 1
"""ID of a new servo."""
_CHECKS = 3
"""Checks of each servo in turn: torque, a register of the start, bus watchdog."""
_CONDITION_TRIES = 3
"""Readings of a servo's condition until it counts as silent: one lost answer is not enough."""


class ServoHealth:
    """Checks that read the servos and, at the start, correct some of their registers."""

    def __init__(self, bus: ServoBus, settings: GripperSettings) -> None:
        self._bus = bus
        self._settings = settings
        self._ids = [servo.servo_id for servo in settings.servos]
        self._polls = 0
        self._polled_items = 0
        self._accepted: dict[int, int] = {}
        self._overloaded: set[int] = set()
        self.notes: list[str] = []
        """Warnings of servos that were not yet fetched."""

    def torque_on(self) -> bool:
        """Read whether any servo has its torque on."""
        return any(self._torques())

    def torque_on_everywhere(self) -> bool:
        """Read whether all servos have their torque on."""
        return all(self._torques())

    def _torques(self) -> list[int]:
        raws = self._bus.sync_read(self._ids, _TORQUE)
        return [raws[servo_id][TORQUE_ENABLE.name] for servo_id in self._ids]

    def conditions(self) -> tuple[ServoCondition, ...]:
        """Read torque and errors of each servo; a silent servo is no error here."""
        return tuple(self._condition(servo_id) for servo_id in self._ids)

    def _condition(self, servo_id: int) -> ServoCondition:
        for _ in range(_CONDITION_TRIES):
            try:
                return self._read_condition(servo_id)
            except AnswersOff:
                return ServoCondition(servo_id=servo_id, answers=False, answers_off=True)
            except (BusTimeout, BusCorrupt):
                continue
        return ServoCondition(servo_id=servo_id, answers=False)

    def _read_condition(self, servo_id: int) -> ServoCondition:
        torque_on = self._bus.read(servo_id, TORQUE_ENABLE) != 0
        bits = self._bus.read(servo_id, HARDWARE_ERROR_STATUS)
        shutdown_bits = self._bus.read(servo_id, SHUTDOWN) if bits else 0
        return ServoCondition(
            servo_id=servo_id,
            torque_on=torque_on,
            error_bits=bits,
            shut_down=not torque_on and bits & shutdown_bits != 0,
        )

    def demand_answers(self) -> None:
        """Let all servos answer each request, see `ServoBus.demand_answers`; first of all."""
        self._bus.demand_answers(self._ids)

    def require_present(self) -> None:
        """Ping every servo. Raises ServoMissing, which names the IDs that answer instead."""
        silent: dict[int, BusTimeout | BusCorrupt] = {}
        for servo_id in self._ids:
            try:
                self._bus.ping(servo_id)
            except (BusTimeout, BusCorrupt) as error:
                silent[servo_id] = error
        if not silent:
            return
        others = [one for one in self._bus.scan() if one.servo_id not in self._ids]
        names = {model.number: model.name for model in MODELS.values()}
        listed = ", ".join(
            f"{one.servo_id} ({names.get(one.model_number, f'model {one.model_number}')})"
            for one in others
        )
        rows = tuple(
            VerificationRow(
                servo_id=servo_id,
                item="ping",
                expected=f"an answer at {self._bus.baudrate} baud",
                actual=("no right answer" if servo_id in silent else "an answer")
                + (f"; other IDs that answer: {listed}" if listed else ""),
                ok=servo_id not in silent,
            )
            for servo_id in self._ids
        )
        report = VerificationReport(rows=rows)
        advice = (
            "give the servo its ID, or name the right one in the settings"
            if others
            else "check supply, cable, baud rate and that no two servos share an ID"
        )
        if old := self._bus.scan_protocol_1(sorted({*silent, _FACTORY_ID})):
            advice = protocol_1_text(old)
        raise ServoMissing(report, [*(str(row) for row in report.failed), advice]) from next(
            iter(silent.values())
        )

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
        rows: list[VerificationRow] = []
        for servo in self._settings.servos:
            rows += self._verify_one(servo, correct=correct)
        if correct:
            self._bus.port.return_delay_s = 0.0
        report = VerificationReport(rows=tuple(rows))
        if refuse and not report.ok:
            errors = [row for row in report.failed if row.item == HARDWARE_ERROR_STATUS.name]
            if len(errors) < len(report.failed):
                raise VerificationFailed(report, [str(row) for row in report.failed])
            raise ServoFault(
                errors[0].servo_id,
                int(errors[0].actual),
                "it reports a hardware error from before the start and nothing has moved; remedy "
                "its cause, then clear it with a reboot",
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
        if all(row.item == HARDWARE_ERROR_STATUS.name for row in report.failed):
            return
        for servo_id in self._ids:
            self._bus.write(servo_id, BUS_WATCHDOG, 0)
            self._bus.write(servo_id, TORQUE_ENABLE, 0)
        report = self.verify(correct=True)
        wrong = [str(row) for row in report.failed if row.item != HARDWARE_ERROR_STATUS.name]
        if wrong:
            raise VerificationFailed(
                report, [*wrong, "the torque is off now and the fingers did not open"]
            )

    def end_release(self) -> None:
        """End the acceptance of errors of servos."""
        self._accepted = {}

    def _verify_one(self, servo: ServoSettings, *, correct: bool) -> tuple[VerificationRow, ...]:
        settings = self._settings
        required = requirements(
            servo.servo_model,
            settings.current_max_a,
            settings.temperature_max_c,
            settings.corrected_registers,
        )
        corrected: set[str] = set()
        self._bus.ping(servo.servo_id)
        raws: dict[str, int] = {}
        for item in required:
            register = REGISTERS[item.item]
            raw = self._bus.read(servo.servo_id, register)
            if correct and item.write_raw is not None and not item.met_by(raw):
                self._bus.write(servo.servo_id, register, item.write_raw)
                raw = self._bus.read(servo.servo_id, register)
                corrected.add(item.item)
            raws[item.item] = raw
            if register is MODEL_NUMBER and not item.met_by(raw):
                # For another model the other items may have another meaning.
                return compare(servo.servo_id, required[:1], raws)
        return compare(servo.servo_id, required, raws, frozenset(corrected))

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
        index, check = divmod(self._polls, _CHECKS)
        self._polls = (self._polls + 1) % (_CHECKS * len(self._ids))
        if check == 0:
            self.check_torque(self._ids[index])
            if self._ids[index] in self._overloaded:
                self._check_hardware(self._ids[index])
        elif check == 1:
            self._check_register(index)
        elif watchdog and self._bus.read(self._ids[index], BUS_WATCHDOG) == WATCHDOG_TRIPPED_RAW:
            raise ServoFault(
                self._ids[index],
                0,
                "its bus watchdog has tripped because the loop fell silent; the servo has "
                "stopped, a part may still be gripped",
            )

    def _check_register(self, index: int) -> None:
        """Read the next register that was verified at the start; all of them in turn."""
        servo, settings = self._settings.servos[index], self._settings
        required = requirements(
            servo.servo_model, settings.current_max_a, settings.temperature_max_c
        )
        item = required[self._polled_items // len(self._ids) % len(required)]
        self._polled_items += 1
        if item.item == HARDWARE_ERROR_STATUS.name:
            return
        raw = self._bus.read(servo.servo_id, REGISTERS[item.item])
        if not item.met_by(raw):
            raise ServoFault(
                servo.servo_id,
                0,
                f"its register {item.item} has changed since the start: expected "
                f"{item.expected}, found {raw}. Somebody else writes to this servo, or it has "
                f"restarted; the goals are frozen",
            )

    def _check_hardware(self, servo_id: int) -> None:
        bits = self._bus.read(servo_id, HARDWARE_ERROR_STATUS)
        if bits:
            lost = self._bus.read(servo_id, TORQUE_ENABLE) == 0
            if not lost and bits == self._accepted.get(servo_id):
                return
            if not lost and bits == HardwareError.OVERLOAD:
                if servo_id in self._overloaded:
                    return
                shutdown_raw = self._bus.read(servo_id, SHUTDOWN)
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
            raise ServoFault(servo_id, bits, detail, torque_lost=lost)

    def check_torque(self, servo_id: int) -> None:
        """Raise ServoFault when a servo has lost its torque."""
        if self._bus.read(servo_id, TORQUE_ENABLE) == 0:
            bits = self._bus.read(servo_id, HARDWARE_ERROR_STATUS)
            raise ServoFault(
                servo_id,
                bits,
                "its torque is off although it was not switched off here: a reboot, a shutdown, "
                "or another program on the bus",
                torque_lost=True,
            )

    def watchdogs_tripped(self) -> frozenset[int]:
        """Read the bus watchdogs (register 98); return the IDs of the servos with a tripped one."""
        return frozenset(
            i for i in self._ids if self._bus.read(i, BUS_WATCHDOG) == WATCHDOG_TRIPPED_RAW
        )
