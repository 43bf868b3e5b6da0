"""Health of the servos: their settings, torque, hardware errors and bus watchdog."""

from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import (
    BUS_WATCHDOG,
    HARDWARE_ERROR_STATUS,
    MODEL_NUMBER,
    REGISTERS,
    TORQUE_ENABLE,
    WATCHDOG_TRIPPED_RAW,
)
from gripper.dynamixel.models import MODELS
from gripper.errors import BusCorrupt, BusTimeout, ServoFault, ServoMissing, VerificationFailed
from gripper.servos.verification import compare, requirements
from gripper.settings import GripperSettings, ServoSettings
from gripper.state import GripperState, VerificationReport, VerificationRow

_CHECKS = 3
"""Checks that take turns on each servo: torque, a register of the start, bus watchdog."""


class ServoHealth:
    """Checks that read the servos and, at the start, correct some of their registers.

    Parameters
    ----------
    bus, settings
        Of the gripper.
    """

    def __init__(self, bus: ServoBus, settings: GripperSettings) -> None:
        self._bus = bus
        self._settings = settings
        self._ids = [servo.servo_id for servo in settings.servos]
        self._polls = 0
        self._kept = 0

    def torque_on(self) -> bool:
        """Read whether any servo has its torque on."""
        return any(self._bus.read(i, TORQUE_ENABLE) != 0 for i in self._ids)

    def torque_on_everywhere(self) -> bool:
        """Read whether all servos have their torque on."""
        return all(self._bus.read(i, TORQUE_ENABLE) != 0 for i in self._ids)

    def require_present(self) -> None:
        """Ping every servo. Raises ServoMissing that names which IDs answer instead."""
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
                found=("no right answer" if servo_id in silent else "an answer")
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
        raise ServoMissing(report, [*(str(row) for row in report.failed), advice]) from next(
            iter(silent.values())
        )

    def verify(self, *, correct: bool, refuse: bool = False) -> VerificationReport:
        """Compare the registers of all servos with their requirements.

        Parameters
        ----------
        correct
            True to rewrite the registers that may be corrected where they differ; needs the
            torque off.
        refuse
            True to raise VerificationFailed when a row does not agree.
        """
        rows: list[VerificationRow] = []
        for servo in self._settings.servos:
            rows += self._verify_one(servo, correct=correct)
        if correct:
            self._bus.return_delay_s = 0.0
        report = VerificationReport(rows=tuple(rows), torque_was_on=not correct)
        if refuse and not report.ok:
            raise VerificationFailed(report, [str(row) for row in report.failed])
        return report

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
        found: dict[str, int] = {}
        for item in required:
            register = REGISTERS[item.item]
            raw = self._bus.read(servo.servo_id, register)
            if correct and item.write_raw is not None and not item.met_by(raw):
                self._bus.write(servo.servo_id, register, item.write_raw)
                raw = self._bus.read(servo.servo_id, register)
                corrected.add(item.item)
            found[item.item] = raw
            if register is MODEL_NUMBER and not item.met_by(raw):
                # Another model: its other items may mean something else.
                return compare(servo.servo_id, required[:1], found)
        return compare(servo.servo_id, required, found, frozenset(corrected))

    def poll(self, state: GripperState, *, watchdog: bool = True) -> None:
        """Check one more item of one servo; called now and then while the torque is on.

        Parameters
        ----------
        state
            Newest feedback; an Alert in it is followed up at once.
        watchdog
            False where a tripped watchdog does no harm.

        Raises
        ------
        ServoFault
            When a servo reports a hardware error, has lost its torque or its watchdog tripped.
        """
        for servo in state.servos:
            if servo.alert:
                self._check_hardware(servo.servo_id)
        index, check = divmod(self._polls, _CHECKS)
        self._polls = (self._polls + 1) % (_CHECKS * len(self._ids))
        if check == 0:
            self.check_torque(self._ids[index])
        elif check == 1:
            self._check_kept(index)
        elif watchdog and self._bus.read(self._ids[index], BUS_WATCHDOG) == WATCHDOG_TRIPPED_RAW:
            raise ServoFault(
                self._ids[index],
                0,
                "its bus watchdog has tripped because the loop fell silent; the servo has "
                "stopped, a part may still be gripped",
            )

    def _check_kept(self, index: int) -> None:
        """Read the next register that the start has verified; all of them in turn."""
        servo, settings = self._settings.servos[index], self._settings
        required = requirements(
            servo.servo_model, settings.current_max_a, settings.temperature_max_c
        )
        item = required[self._kept // len(self._ids) % len(required)]
        self._kept += 1
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
            dropped = self._bus.read(servo_id, TORQUE_ENABLE) == 0
            detail = (
                "it has switched its torque off, the part has possibly been dropped; after a "
                "remedy clear the fault with a reboot"
                if dropped
                else "it reports a hardware error and still has its torque"
            )
            raise ServoFault(servo_id, bits, detail, torque_lost=dropped)

    def check_torque(self, servo_id: int) -> None:
        """Raise ServoFault when a servo has lost the torque that it was given."""
        if self._bus.read(servo_id, TORQUE_ENABLE) == 0:
            bits = self._bus.read(servo_id, HARDWARE_ERROR_STATUS)
            raise ServoFault(
                servo_id,
                bits,
                "its torque is off although nobody switched it off (a reboot or a shutdown); the "
                "part has possibly been dropped",
                torque_lost=True,
            )

    def hardware_errors(self) -> dict[int, int]:
        """Read Hardware Error Status (register 70) of all servos; those with an error, by ID."""
        bits = {servo_id: self._bus.read(servo_id, HARDWARE_ERROR_STATUS) for servo_id in self._ids}
        return {servo_id: found for servo_id, found in bits.items() if found}

    def watchdogs_tripped(self) -> frozenset[int]:
        """Read the bus watchdogs (register 98); the IDs of the servos whose one has tripped."""
        return frozenset(
            i for i in self._ids if self._bus.read(i, BUS_WATCHDOG) == WATCHDOG_TRIPPED_RAW
        )
