"""Errors of the gripper: one small tree, each message names cause, value, limit and remedy."""

from gripper.values.servo_checks import VerificationReport, hardware_errors_text

_RESULT_CODES = {
    1: "Result Fail: the command was not carried out",
    2: "Instruction: the servo has no such instruction",
    3: "CRC: the servo received a damaged packet",
    4: "Data Range: the value is outside the range of the item, or the bus watchdog has tripped",
    5: "Data Length: the data is shorter than the item",
    6: "Data Limit: the value is outside a configured limit",
    7: "Access: read-only or undefined address, or EEPROM written with torque on",
}
"""Error numbers of a status packet (e-Manual, Protocol 2.0, "Error")."""

_FINGERS = "the fingers "
"""Start of each note about the fingers, by which it is found."""


class GripperError(Exception):
    """Base of all errors that the package ``gripper`` raises on purpose."""


class PortLost(GripperError):
    """The serial port cannot be opened, is used by another program or was lost."""


class BusTimeout(GripperError, TimeoutError):
    """A servo did not answer in time, nor to the retry."""


class AnswersOff(BusTimeout):
    """A servo answers pings, but not a request: its Status Return Level (register 68) is low."""


class FingerSilent(BusTimeout):
    """One servo is silent while the other one answers; the other finger stands still."""


class LinkTooSlow(GripperError):
    """Servos answer, but too late for the rate of the loop; nothing has moved."""


class BusCorrupt(GripperError):
    """Answers arrived damaged, of the wrong length or from the wrong servo."""


class BusUnreliable(GripperError):
    """Too many periods had no feedback of the servos; the grip is kept."""


class BusBusy(GripperError):
    """Another thread holds the bus for longer than a transaction may take."""


class ServoRejected(GripperError):
    """A servo refused an instruction."""

    def __init__(self, servo_id: int, code: int, action: str) -> None:
        reason = _RESULT_CODES.get(code, "undefined error number")
        super().__init__(f"servo {servo_id} refused {action}: error {code} ({reason})")
        self.servo_id = servo_id
        self.code = code
        """Error number of the status packet, 1 to 7 (Protocol 2.0, status packet, error field)."""


class ServoFault(GripperError):
    """A servo reports a hardware error, has rebooted or lost its torque."""

    def __init__(
        self, servo_id: int, detail: str, *, bits: int = 0, torque_lost: bool = False
    ) -> None:
        names = hardware_errors_text(bits) or "no hardware error bit"
        super().__init__(
            f"servo {servo_id}: {detail} (Hardware Error Status 0x{bits:02X}: {names})"
        )
        self.servo_id = servo_id
        self.bits = bits
        """Hardware Error Status (register 70); 0 where the fault is not one of its bits."""
        self.torque_lost = torque_lost
        """True when the servo has lost its torque: the other finger must not push alone."""


class VerificationFailed(GripperError):
    """The servos do not match the settings; nothing has moved."""

    def __init__(self, report: VerificationReport, *notes: str) -> None:
        failed = "; ".join([*map(str, report.failed), *notes])
        super().__init__(
            f"the servos do not match the settings: {failed}. Correct the settings or the servo, "
            f"then start again"
        )
        self.report = report
        """Expected against found, row by row."""


class ServoMissing(VerificationFailed, BusTimeout):
    """A servo of the settings does not answer at the start; the report names the servos that do."""


class LimitExceeded(GripperError, ValueError):
    """A command or a measured value is outside a limit of the settings."""


class ForceAboveCap(LimitExceeded):
    """The measured grip force is above its cap: the currents are lowered."""


class FeedbackImplausible(GripperError):
    """A servo reports an impossible value, so its position is unknown; the torque goes off."""


class MechanicsContradicted(FeedbackImplausible):
    """Empty fingers move or stop where direction, zero and linkage exclude it; the torque goes off.

    Raised when nothing can be held: while the torque comes on, and after the pads found nothing.
    """


class PositionContradicted(GripperError):
    """Pads or motor contradict the position that a servo reports; the grip is kept."""


class GripContradicted(GripperError):
    """Measurements contradict each other about a gripped part; the grip is kept.

    They are force samples, whole frames, and motors that press while the fingers stand.
    """


class GripperStateError(GripperError):
    """The command is not allowed in the present state."""


class ForceSensorStale(GripperError):
    """The force sensor gave no valid sample for too long; the grip is kept."""


class PartBetweenFingers(GripperError):
    """Something is between fingers that should meet empty; the grip is kept."""


class PartLost(GripperError):
    """Both pads are empty although a part was held; the fingers stand still."""


class PartSlipped(GripperError):
    """A held part slips; the goals are frozen, nothing grips again by itself."""


class ForceImbalance(GripperError):
    """The forces of both fingers differ for too long: one of them pushes alone."""


class WatchdogUnproven(GripperError):
    """The self-test of the bus watchdog failed: it does not stop a motor."""


class FingerBlocked(GripperError):
    """A finger without a part in its grip does not arrive: what stops it may now be held."""

    def __init__(self, text: str, *, opens: bool = False) -> None:
        super().__init__(text)
        self.opens = opens
        """True when it was to open: then it holds nothing, or its position is wrong."""


class GraspStopped(GripperError):
    """The running command was stopped by ``request_stop``; the fingers stand still."""


def note_fingers(error: BaseException, left: str) -> None:
    """Add a note about the fingers to an error; it passes with the error between processes."""
    error.add_note(_FINGERS + left)


def fingers_left(error: BaseException) -> str:
    """Return the note about the fingers, or an empty text."""
    notes: list[str] = getattr(error, "__notes__", [])
    return next((note for note in notes if note.startswith(_FINGERS)), "")


def copy_fingers(source: BaseException, target: BaseException) -> None:
    """Copy the note about the fingers from one error to another, if there is one."""
    left = fingers_left(source)
    if left and not fingers_left(target):
        target.add_note(left)
