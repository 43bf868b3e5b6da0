"""The fault catalogue: a stable number for each error that can reach a host.

Numbers never change their meaning and are never reused. 1xx servos and servo line, 2xx grip and
force, 3xx CAN and control unit, 4xx taxels and frames, 5xx cell, job and host, 6xx axes and wrist,
7xx recognition and models. The page ``docs/reference/faults.md``, the recording, JSON and
all links are made from this table.
"""

from dataclasses import dataclass
from typing import Literal, Self

from cell import errors as cell
from gripper import errors as gripper
from motion import errors as motion
from recognition import errors as recognition
from tactile import errors as tactile

EXPECTED_ERRORS = (cell.CellError, gripper.GripperError, tactile.TactileError)
"""Errors of the cell and its hand that are raised on purpose; any other one is a defect."""

HELD = "Kept: goals are frozen."
LIMP = "Without torque: where the fingers are is not known."
LESS = "Kept, with less current where it presses too much."
UNMOVED = "As it was; nothing has moved."
APART = "Not affected."
AXES_STOP = "As it was; all axes are stopped."

RecoveryStep = Literal[
    "look", "support_part", "free_pads", "mend", "correct", "clear", "clear_reboot", "release",
    "reset", "repeat", "restart", "wait",
]  # fmt: skip
"""Step of the operator after a fault. ``look``: at fingers and part; ``support_part``: it must not
fall; ``free_pads``: nothing may touch them; ``mend``: remove the cause in the text; ``correct``:
the request or the config; ``clear``, ``clear_reboot`` (clear with ``reboot``), ``release``,
``reset``: commands; ``repeat``: the job; ``restart``: the program; ``wait``: until another client
ends its hold."""

Steps = tuple[RecoveryStep, ...]

LET_GO: Steps = ("look", "clear", "support_part", "release", "reset")
MEND: Steps = ("look", "mend", "clear", "support_part", "release", "reset")
LET_GO_FIRST: Steps = ("look", "clear", "support_part", "release", "mend", "reset")
REBOOT: Steps = ("support_part", "look", "mend", "clear_reboot", "release", "reset")
START: Steps = ("mend", "clear", "reset")
CONFIG: Steps = ("look", "correct", "restart")
EMPTY: Steps = ("look", "clear", "release", "reset")
STOPPED: Steps = ("support_part", "release")
OPEN: Steps = ("mend", "restart")
FREE: Steps = ("free_pads", "clear", "reset")
ZERO: Steps = ("look", "clear", "support_part", "release", "free_pads", "reset")
REQUEST: Steps = ("correct", "repeat")
AGAIN: Steps = ("look", "repeat")
ON_HOLD: Steps = ("wait", "clear", "repeat")


@dataclass(frozen=True, slots=True)
class Fault:
    """One entry of the catalogue."""

    number: int
    """Stable number, 100 to 799; on all links 0 means no fault."""
    text: str
    """Short English text for displays, at most 64 ASCII characters."""
    cause: str
    remedy: str
    """Usual cause, and the remedy."""
    grip: str
    """State of the grip."""
    steps: Steps
    """Steps of the operator until the cell is ready again, in order."""


# fmt: off
CATALOGUE: dict[type[BaseException], Fault] = {
    # -- 1xx: servos and servo line ------------------------------------------------------------
    gripper.GripperError: Fault(100, "Gripper fault",
        "An error without its own number.", "Remove the cause, then clear and reset.", HELD, MEND),
    gripper.PortLost: Fault(101, "Servo port cannot be opened or is gone",
        "USB adapter unplugged, another program on the port, missing rights.",
        "Check adapter and `gripper.port`; stop the service, run `doctor`.",
        "The servos' bus watchdog triggers; a part may be held.", MEND),
    gripper.BusTimeout: Fault(102, "Servos do not answer",
        "Supply, cable, baud rate, ID.",
        "Check supply and cable; stop the service, then run `doctor`.",
        "The servos' bus watchdog triggers; a part may be held.", MEND),
    gripper.FingerSilent: Fault(103, "One servo is silent",
        "Its supply, its cable, or a restart.", "Check supply and cable of the silent servo.",
        "The other finger stands still.", REBOOT),
    gripper.LinkTooSlow: Fault(104, "Servo line too slow for the loop rate",
        "Latency timer of the USB adapter, baud rate.",
        "Latency timer 1 ms, a higher baud rate or a lower loop rate.", UNMOVED, START),
    gripper.BusCorrupt: Fault(105, "Damaged answers on the servo line",
        "Noise, ground, termination, two servos with one ID.", "Check cable, ground and IDs.",
        HELD, REBOOT),
    gripper.BusUnreliable: Fault(106, "Too many periods without servo feedback",
        "Noise or another device on the servo line.",
        "Check cable, ground and `gripper.feedback_loss_max_share`.", HELD, MEND),
    gripper.BusBusy: Fault(107, "Servo bus held by another thread",
        "The machine is too busy.", "Give the loop its own process and priority.", HELD, MEND),
    gripper.ServoRejected: Fault(108, "A servo refused an instruction",
        "A value or state that the servo does not allow.",
        "Stop the service, run `doctor`; correct the errors that it lists.", HELD, MEND),
    gripper.ServoFault: Fault(109, "A servo reports a hardware error or lost its torque",
        "Overload, heat, supply, shock; a restart.",
        "Support the part and remove the cause.",
        "The other finger stands still; a servo without torque does not hold.", REBOOT),
    gripper.VerificationFailed: Fault(110, "Servos do not match the config",
        "Another servo, or changed settings.", "Correct the servo or the config.", UNMOVED, START),
    gripper.ServoMissing: Fault(111, "A configured servo does not answer at the start",
        "Supply, cable, ID or baud rate.",
        "Check supply, cable, ID; stop the service, then run `doctor`.", UNMOVED, START),
    gripper.FeedbackImplausible: Fault(112, "A servo reports an impossible position",
        "Encoder, horn, a second servo or program on the bus.",
        "Take the part out, restart the servo, check horn and encoder.", LIMP, REBOOT),
    gripper.WatchdogUnproven: Fault(113, "Servo bus watchdog failed its self-test",
        "Firmware without a working bus watchdog.", "Update the firmware or exchange the servo.",
        UNMOVED, START),
    gripper.MechanicsContradicted: Fault(114, "Fingers do not move as in the config",
        "Wrong `gripper.servos[].direction`, `zero_pulse` or `gripper.linkage`; a blocked finger.",
        "Look where the fingers stand, correct the key, clear and reset.", LIMP, START),
    gripper.AnswersOff: Fault(115, "A servo answers pings only or confirms no write",
        "Its Status Return Level (register 68) is below 2.",
        "Clear, then start or release: both set the register to 2.",
        "The servos' bus watchdog triggers; a part may be held.", MEND),
    gripper.FingerBlocked: Fault(116, "A finger is blocked",
        "A part or a cable between the fingers, high friction, or a wrong `gripper.linkage`.",
        "Take out what lies between the fingers; move them by hand.", HELD, REBOOT),
    # -- 2xx: grip and force -------------------------------------------------------------------
    gripper.LimitExceeded: Fault(200, "Command or measured value outside a limit",
        "A request beyond the config, or heat.", "Request less, or let the hot part cool down.",
        "Kept; a refused command moves nothing.", MEND),
    gripper.ForceAboveCap: Fault(201, "Grip force above its cap",
        "The part was pushed, or pads or force control are wrong.",
        "Look at the part; assess the risk; check cap, zero, gain.", LESS, MEND),
    gripper.PositionContradicted: Fault(202, "Pads or motor contradict the finger position",
        "An encoder is stuck or drifts, or something pushes a finger.",
        "Look, release, then check encoder and linkage.", HELD,
        LET_GO_FIRST),
    gripper.GripperStateError: Fault(203, "Gripper command not allowed in its state",
        "A command out of order.", "Give another command first: clear, release or reset.",
        UNMOVED, LET_GO),
    gripper.ForceSensorStale: Fault(204, "No valid tactile force for too long",
        "CAN load, control unit, a busy machine.",
        "Check the CAN link; `gripper.force_stale_ms` is the limit.", HELD, MEND),
    gripper.PartLost: Fault(205, "Part lost: both pads are empty",
        "The part slipped out, broke or was taken.", "Look for the part; clear, release, reset.",
        "The fingers stand still; nothing is held.", EMPTY),
    gripper.PartSlipped: Fault(206, "The held part slips",
        "Too little force, a smooth or heavy part, a push, drifting pads.",
        "Look; clear, then release it; take more force next time.", HELD, LET_GO),
    gripper.ForceImbalance: Fault(207, "Fingers press with different forces",
        "One finger is blocked, or the part is held from outside.", "Free the finger or the part.",
        HELD, LET_GO),
    gripper.PartBetweenFingers: Fault(210, "A part is between fingers that should be empty",
        "A part was left there before a self-zero; or a horn slipped.",
        "Look; clear, release, take the part out, reset.", HELD, LET_GO),
    gripper.GripContradicted: Fault(209, "Pads and motors disagree on a part in the grip",
        "Wrong force messages, pads without signal or with a drifted zero, contact beside taxels.",
        "Look between the fingers; check unit and pads; then release.", HELD, MEND),
    gripper.GraspStopped: Fault(208, "Motion stopped on request",
        "A stop was requested.", "Release or go on.", HELD, STOPPED),
    # -- 3xx: CAN and control unit -------------------------------------------------------------
    tactile.TactileError: Fault(300, "Tactile sensor fault",
        "An error without its own number.", "Remove the cause, then clear and reset.", HELD, MEND),
    tactile.LinkStateError: Fault(301, "Sensor link call not allowed in its state",
        "A command out of order.", "Clear and reset.", UNMOVED, LET_GO),
    tactile.LinkFault: Fault(302, "Sensor link has failed",
        "An error without its own number.", "Check the line of the sensor.", HELD, MEND),
    tactile.NodeMissing: Fault(303, "Control unit or sensor board does not answer",
        "Supply, cable, node-ID, bit rate.",
        "Check supply and cable; stop the service, then run `doctor`.", UNMOVED, START),
    tactile.IdentityMismatch: Fault(304, "Another control unit than configured",
        "Exchanged unit or firmware.",
        "Correct `tactile` in the config, or connect the right unit.", UNMOVED, START),
    tactile.HeartbeatLost: Fault(305, "Heartbeat of the control unit lost",
        "Its supply or cable; a crash of its firmware.",
        "Check supply and cable, restart the unit.", HELD, MEND),
    tactile.DuplicateNode: Fault(306, "Two control units with one node-ID",
        "The same node-ID twice.", "Change the node-ID of one unit.", HELD, MEND),
    tactile.BusDisturbed: Fault(307, "Too many foreign or damaged CAN messages",
        "Noise, or another device on the CAN bus.", "Check termination and other senders.", HELD,
        MEND),
    tactile.NodeRebooted: Fault(308, "Control unit restarted in operation",
        "A dip of its supply, or a second unit with its node-ID.",
        "Check supply, node-IDs; clear and reset measure the zero again.", HELD, MEND),
    tactile.NodeStateChanged: Fault(309, "Control unit left the operational state",
        "Another CANopen master, or an error of the unit.",
        "Look for the other master; read the unit's error register.", HELD, MEND),
    tactile.NodeEmergency: Fault(310, "Control unit sent an emergency message",
        "An error of the unit; its code stands in the text.",
        "Remove the cause that the code names, clear and reset.", HELD, MEND),
    tactile.BusOff: Fault(311, "CAN controller is off the bus",
        "Short circuit, wrong bit rate, adapter unplugged.",
        "Check cable, termination, bit rate and adapter.", HELD, MEND),
    tactile.BusErrorPassive: Fault(312, "CAN controller is error-passive",
        "Termination, cable, a missing partner.", "Check cable and termination.", HELD, MEND),
    tactile.ReceiveLoopDead: Fault(313, "CAN receiver ended, hangs or was overrun",
        "Driver or adapter; a busy machine.", "Restart the program; check the adapter.", HELD,
        MEND),
    tactile.BusNotOpened: Fault(314, "CAN bus could not be opened",
        "Missing interface, wrong channel, missing rights.",
        "Check `tactile.interface`, `channel`; stop the service, run `doctor`.", UNMOVED, OPEN),
    tactile.PluginFault: Fault(315, "Code of a sensor package failed",
        "A defect of the package that brings `tactile.sensor.kind`.",
        "Update that package; report the defect to its authors.", HELD, MEND),
    tactile.ObjectRefused: Fault(316, "Control unit refuses to read or write an object",
        "Other firmware, another CANopen master, or an error of the unit.",
        "Restart the unit; update its firmware if this returns.", UNMOVED, START),
    # -- 4xx: taxels and frames ----------------------------------------------------------------
    tactile.FrameTimeout: Fault(401, "No whole tactile frames, or frozen values",
        "Supply, cable, CAN load, a hanging unit.",
        "Check the sensor's line; `tactile.loss_max_share` is the limit.", HELD, MEND),
    tactile.FrameError: Fault(402, "The law of the pads gives forces that are not finite",
        "A damaged table of the calibration.", "Calibrate again.", UNMOVED, CONFIG),
    tactile.LayoutError: Fault(403, "Pad layout impossible or not that of the unit",
        "Config and unit differ.", "Correct `tactile.layout` or the unit.", UNMOVED, CONFIG),
    tactile.CalibrationError: Fault(404, "Calibration does not fit the sensor",
        "A calibration of other pads.", "Calibrate again.", UNMOVED, CONFIG),
    tactile.TareRefused: Fault(405, "Zero not taken: pads touched, noisy or drifting",
        "Something touches the pads, or taxels are defective.", "Free the pads; replace bad pads.",
        UNMOVED, FREE),
    tactile.ZeroDrifted: Fault(406, "Zero of the taxels has moved",
        "Temperature, or wear of the foam.",
        "Free the pads; clear and reset measure the zero again.", HELD, ZERO),
    tactile.ForceContradicted: Fault(407, "Force messages and frames show different forces",
        "Another table or zero in the control unit, or a failing pad.",
        "Check pads and calibration; a restart writes table and zero.", HELD, MEND),
    # -- 5xx: cell, job and host ---------------------------------------------------------------
    cell.CellError: Fault(500, "Cell error",
        "An error without its own number.", "Remove the cause, then clear and reset.", HELD, MEND),
    cell.ConfigError: Fault(501, "Config or request value refused",
        "Unknown key, wrong type or out of range.", "Correct this value.",
        UNMOVED, REQUEST),
    cell.DatasetError: Fault(502, "Data set cannot be read or written",
        "File or disk.", "Check the path.", APART, REQUEST),
    cell.RecordingError: Fault(503, "Recording cannot be read or has stopped",
        "Full disk, or a damaged file.",
        "Free space: the next job records. `recording recover` saves data.",
        "Kept if `recording.when_lost` is `hold`; else not affected.", MEND),
    cell.ReportError: Fault(504, "Report cannot be made",
        "File or disk.", "Check folder and disk.", APART, REQUEST),
    cell.ArchiveError: Fault(520, "Archive cannot be read or written",
        "Wrong place, missing rights or a damaged file.", "Check the place of the archive.",
        APART, REQUEST),
    cell.CellStateError: Fault(505, "Command not allowed in the state of the cell",
        "A command out of order, or a job that runs.",
        "Give another command first, or wait for the job's end.", UNMOVED, REQUEST),
    cell.PartInGrip: Fault(506, "A part may be in the grip at the start",
        "An earlier run or a fault left it there.", "Clear, release on purpose, reset.", UNMOVED,
        LET_GO),
    cell.PlanRefused: Fault(507, "Grasp or plan cannot be carried out",
        "A wrong plan.", "Correct the plan.", UNMOVED, REQUEST),
    cell.HandLost: Fault(508, "Process of the force loop is gone",
        "The process was killed or hangs.", "Look at the part; clear starts the process again.",
        "The servos' bus watchdog triggers; a part may be held.", LET_GO),
    cell.HostSilent: Fault(509, "Program too slow for its force loop",
        "A busy machine.", "Reduce the load of the machine.", HELD, MEND),
    cell.PositionerError: Fault(510, "A pose was not reached or was refused",
        "The host or the operator refused, or the positioner failed.",
        "Correct pose or positioner, start again.",
        "Open and empty between two grasps; else kept.", MEND),
    cell.NoPartFound: Fault(511, "No part found",
        "The part is missing, too thin, or was lost while pressed.",
        "Put the part in place, start again.", "Open and empty.", AGAIN),
    cell.ZeroRefused: Fault(518, "Self-zero out of bounds: a pad or a finger",
        "A bent finger, a loose or worn pad, a horn that slipped.",
        "Repair pad or finger, then measure the zero again.", "Open and empty.", START),
    cell.CellStopped: Fault(512, "Job stopped on request",
        "Hold, or a silent host.", "Release, then go on.", HELD, STOPPED),
    cell.RequestRefused: Fault(513, "Request refused: unknown, incomplete or wrong key",
        "A wrong command, value or key of the host.", "Correct the request.", UNMOVED, REQUEST),
    cell.NotInCommand: Fault(514, "This client has no lease to command",
        "Another client has the lease, or the lease has expired.",
        "Acquire the lease and send life signs.", UNMOVED, REQUEST),
    cell.NotMeasured: Fault(516, "Value is not measured at the moment",
        "A fault, a shutdown, or no motion yet.", "Read the state of the cell.",
        UNMOVED, REQUEST),
    cell.TooFewGrasps: Fault(519, "Too few grasps for a training",
        "Too few grasps.", "Teach more grasps.", UNMOVED, REQUEST),
    cell.HeldByClient: Fault(515, "A client keeps the cell on hold",
        "A pressed button of a panel; the text names it.",
        "Release the button; `clear` ends a hold whose client is gone.", UNMOVED, ON_HOLD),
    OSError: Fault(598, "The operating system refused a file or device",
        "Rights, disk, memory, too many open files.", "Check rights, disk and device, then repeat.",
        HELD, MEND),
    Exception: Fault(599, "Unexpected error of the program",
        "A defect of this program or of a callback.", "Report this message; clear and reset.", HELD,
        LET_GO),
    # -- 6xx: axes and wrist -------------------------------------------------------------------
    motion.MotionError: Fault(600, "Axis fault",
        "An error without its own number.", "Remove the cause, then clear and reset.",
        AXES_STOP, MEND),
    motion.AxisLimitExceeded: Fault(601, "Position outside the limits of an axis",
        "A pose of the sequence, of a place or of the host.",
        "Ask for another pose, or set `positioner.axes[].low` and `high`.", UNMOVED, MEND),
    motion.PositionNotReached: Fault(602, "Axis has not reached its position in time",
        "Obstacle, load, or a velocity that is set too low.",
        "Free the axis; look at its velocity and load.", AXES_STOP, MEND),
    motion.AxisMissing: Fault(603, "Axis missing, or another device than configured",
        "Supply, cable, node-ID or ID of the axis.",
        "Check supply, cable, ID; stop the service, then run `doctor`.", UNMOVED, MEND),
    motion.AxisSilent: Fault(604, "Axis no longer answers",
        "Supply or cable of the drive or servo.", "Check supply and cable of the axis.", AXES_STOP,
        MEND),
    motion.AxisRestarted: Fault(605, "Axis has restarted and lost its position",
        "Its supply was interrupted.",
        "Check the supply, then clear and reset: the axis homes again.", AXES_STOP, MEND),
    motion.AxisFault: Fault(606, "Axis reports a fault and has stopped",
        "Overload, following error, temperature: the text names it.",
        "Remove the cause, then clear and reset.", AXES_STOP, MEND),
    motion.LimitSwitchReached: Fault(607, "Limit switch has stopped an axis",
        "A wrong home position, or limits beyond the switch.",
        "Move it off the switch, check home and limits, clear and reset.", AXES_STOP, MEND),
    motion.HomingFailed: Fault(608, "Axis has not found its home",
        "Home switch, homing method, or an obstacle.", "Check them, then clear and reset.",
        AXES_STOP, MEND),
    motion.AxisNotOperational: Fault(610, "Drive of an axis left the state operational",
        "Another CANopen master has stopped it.",
        "Remove that master, then clear and reset.", AXES_STOP, MEND),
    motion.AxisDuplicated: Fault(611, "Two drives of axes with one node-ID",
        "The same node-ID twice.", "Change one node-ID or remove one drive, then clear and reset.",
        AXES_STOP, MEND),
    motion.AxisAnswerWrong: Fault(612, "Drive of an axis answers wrongly",
        "Another drive or firmware, or a second sender with its node-ID.",
        "Check drive, firmware and node-IDs, then clear and reset.", AXES_STOP, MEND),
    motion.PositionImplausible: Fault(613, "Axis reads a position beyond its limits",
        "Encoder or homing; an axis that was moved by hand.",
        "Check encoder and homing, move the axis back; clear and reset.", AXES_STOP, MEND),
    cell.PositionerFault: Fault(609, "Axis of the positioner at fault",
        "The text names axis and cause.", "Remove the cause, then clear and reset.",
        AXES_STOP, MEND),
    # -- 7xx: recognition and models -----------------------------------------------------------
    recognition.RecognitionError: Fault(700, "Recognition failed",
        "An error without its own number.", "Grasp again, or teach again.", APART, REQUEST),
    recognition.ContactError: Fault(701, "No usable contact in a grasp",
        "A grasp beside the pads, or with too little force.", "Check pose and force.",
        APART, AGAIN),
    recognition.QuadricError: Fault(702, "No surface fits the contact",
        "Too few points.", "Grasp again.", APART, AGAIN),
    recognition.TransformError: Fault(703, "Transformation cannot be inverted",
        "Wrong poses.", "Check the poses.", APART, REQUEST),
    recognition.TrajectoryError: Fault(704, "No thresholds from this sweep",
        "The bands of the objects overlap.", "Teach more grasps.", APART, REQUEST),
    cell.MissingExtraError: Fault(705, "A library is not installed",
        "A missing extra of this program.", "Install the missing extra.", UNMOVED, CONFIG),
    cell.ModelError: Fault(706, "Taught model cannot be read, written or used",
        "Damaged file, or a model of other pads.", "Name another model or teach again.", APART,
        REQUEST),
}
# fmt: on
"""Entry of each error class; a class that is not listed has the entry of its base class."""

_UNEXPECTED = CATALOGUE[Exception].number

BY_NUMBER = {fault.number: fault for fault in CATALOGUE.values()}
"""Every entry by its number."""


def fault_of(error: BaseException) -> Fault:
    """Return the most specific entry for an error.

    An error that only reports another one, as `JobFailed`, has the entry of its cause. So has an
    error of the positioner that an axis caused.
    """
    kind = next((kind for kind in type(error).__mro__ if kind in CATALOGUE), Exception)
    cause = error.__cause__
    by_axis = isinstance(cause, motion.MotionError) and not isinstance(error, motion.MotionError)
    if cause is not None and (by_axis or kind is cell.CellError):
        reported = fault_of(cause)
        # A plain CellError names a damaged file; then its cause is an error of Python.
        if type(error) is not cell.CellError or reported.number != _UNEXPECTED:
            return reported
    return CATALOGUE[kind]


def fault_number(error: BaseException | None) -> int:
    """Return the number of an error; 0 for none."""
    return 0 if error is None else fault_of(error).number


def error_text(error: BaseException) -> str:
    """Return an error as text for hosts and operators: its message, and where the fingers stand.

    Only unexpected errors show their class: operators report these as defects.
    """
    text, number = str(error), fault_number(error)
    if not isinstance(error, Exception):
        text = "the program was interrupted"
    elif number == _UNEXPECTED:
        text = f"unexpected error ({type(error).__name__}): {text}"
    elif isinstance(error, OSError) and number == CATALOGUE[OSError].number:
        text = ": ".join(str(part) for part in (error.strerror or text, error.filename) if part)
    left = gripper.fingers_left(error)
    return f"{text}; {left}" if left else text


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """Why a request was refused, as every interface shows it."""

    number: int = 0
    """Fault number; 0: no refusal yet."""
    text: str = ""
    """Cause, value, limit and next step."""
    remedy: str = ""
    """Remedy from the catalogue."""

    @classmethod
    def of(cls, error: BaseException) -> Self:
        """Return an error as a refusal."""
        fault = fault_of(error)
        return cls(number=fault.number, text=error_text(error), remedy=fault.remedy)

    def __str__(self) -> str:
        if not self.number:
            return ""
        return f"{self.number}: {self.text}. {self.remedy}".replace("`", "")


def for_display(number: int, text: str) -> str:
    """Return a text with the remedy first, for displays that show only its beginning.

    Number 0 is no fault. ``text`` comes from `error_text`.
    """
    return f"{BY_NUMBER[number].remedy.replace('`', '')} {text}" if number else text
