"""The fault catalogue: every error has a number, and none ever changes."""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator

import pytest

import cell
import gripper
import motion
import recognition
import tactile
from cell.errors import CellError, CellStopped
from cell.fault_catalogue import CATALOGUE, Fault, error_text, fault_number, fault_of
from cell.runtime.worker import Job, JobFailed, JobOutcome
from gripper.errors import BusTimeout, FingerSilent, GripperError, PartLost
from motion.errors import MotionError
from recognition.errors import RecognitionError
from tactile.errors import TactileError

FROZEN = {
    "GripperError": 100, "PortLost": 101, "BusTimeout": 102, "FingerSilent": 103,
    "LinkTooSlow": 104, "BusCorrupt": 105, "BusUnreliable": 106, "BusBusy": 107,
    "ServoRejected": 108, "ServoFault": 109, "VerificationFailed": 110, "ServoMissing": 111,
    "FeedbackImplausible": 112, "WatchdogUnproven": 113, "MechanicsContradicted": 114,
    "AnswersOff": 115,
    "LimitExceeded": 200, "ForceAboveCap": 201, "PositionContradicted": 202,
    "GripperStateError": 203, "ForceSensorStale": 204, "PartLost": 205, "PartSlipped": 206,
    "ForceImbalance": 207, "GraspStopped": 208, "GripContradicted": 209,
    "TactileError": 300, "LinkStateError": 301, "LinkFault": 302, "NodeMissing": 303,
    "IdentityMismatch": 304, "HeartbeatLost": 305, "DuplicateNode": 306, "BusDisturbed": 307,
    "NodeRebooted": 308, "NodeStateChanged": 309, "NodeEmergency": 310, "BusOff": 311,
    "BusErrorPassive": 312, "ReceiveLoopDead": 313, "BusNotOpened": 314, "PluginFault": 315,
    "ObjectRefused": 316,
    "FrameTimeout": 401, "FrameError": 402, "LayoutError": 403, "CalibrationError": 404,
    "TareRefused": 405, "ZeroDrifted": 406, "ForceContradicted": 407,
    "CellError": 500, "ConfigError": 501, "DatasetError": 502, "RecordingError": 503,
    "ReportError": 504, "CellStateError": 505, "PartInGrip": 506, "PlanRefused": 507,
    "HandLost": 508, "HostSilent": 509, "PositionerError": 510, "NoPartFound": 511,
    "PartBetweenFingers": 210, "ZeroRefused": 518,
    "CellStopped": 512, "RequestRefused": 513, "NotInCommand": 514, "HeldByClient": 515,
    "TrainingSetMissing": 517,
    "TooFewGrasps": 519, "ArchiveError": 520,
    "NotMeasured": 516, "OSError": 598,
    "Exception": 599,
    "MotionError": 600, "AxisLimitExceeded": 601, "PositionNotReached": 602, "AxisMissing": 603,
    "AxisSilent": 604, "AxisRestarted": 605, "AxisFault": 606, "LimitSwitchReached": 607,
    "HomingFailed": 608, "PositionerFault": 609, "AxisNotOperational": 610,
    "AxisDuplicated": 611, "AxisAnswerWrong": 612, "PositionImplausible": 613,
    "RecognitionError": 700, "ContactError": 701, "QuadricError": 702, "TransformError": 703,
    "TrajectoryError": 704, "MissingExtraError": 705, "ModelError": 706,
}  # fmt: skip
"""Numbers that hosts rely on: add to this list, never change it."""

REPORTS_ANOTHER = {"JobFailed", "NotThere"}
"""Errors with the number of their cause, or of their base class."""
NOT_FOR_HOSTS = "cell.commissioning"


def error_classes() -> Iterator[type[BaseException]]:
    """Every subclass of the packages' base errors, wherever it is defined."""
    for package in (gripper, motion, tactile, recognition, cell):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            if module.name.startswith(NOT_FOR_HOSTS):
                continue
            imported = importlib.import_module(module.name)
            for _, kind in inspect.getmembers(imported, inspect.isclass):
                bases = (GripperError, MotionError, TactileError, RecognitionError, CellError)
                if issubclass(kind, bases) and kind.__module__ == module.name:
                    yield kind


@pytest.mark.slow  # it loads each module that no test before it has loaded
def test_every_error_class_has_a_number_of_its_own() -> None:
    missing = {kind.__name__ for kind in error_classes()} - {kind.__name__ for kind in CATALOGUE}
    assert missing == REPORTS_ANOTHER


def test_numbers_do_not_change() -> None:
    assert {kind.__name__: fault.number for kind, fault in CATALOGUE.items()} == FROZEN
    assert len(set(FROZEN.values())) == len(FROZEN)


@pytest.mark.parametrize("fault", CATALOGUE.values(), ids=lambda fault: str(fault.number))
def test_texts_fit_a_display(fault: Fault) -> None:
    assert 0 < len(fault.text) <= 64
    assert fault.text.isascii()
    assert fault.text.isprintable()
    assert 100 <= fault.number <= 799
    assert all((fault.cause, fault.remedy, fault.grip))
    # A display shows the remedy alone: it refers to nothing else.
    assert len(fault.remedy.replace("`", "")) <= 64
    assert "text" not in fault.remedy


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda kind: kind.__name__)
def test_people_read_no_class_names(kind: type[BaseException]) -> None:
    error = kind.__new__(kind, "the cause")
    error.args = ("the cause",)  # past the arguments that some take
    error.add_note(note := "the fingers stopped while closing")
    text = {"OSError": "the cause", "Exception": "unexpected error (Exception): the cause"}
    assert error_text(error) == text.get(kind.__name__, "the cause") + f"; {note}"
    assert error_text(OSError(28, "No space left", "x.npz")) == "No space left: x.npz"
    assert error_text(KeyboardInterrupt()) == "the program was interrupted"


def test_a_subclass_has_the_most_specific_entry() -> None:
    assert fault_number(BusTimeout("x")) == 102
    assert fault_number(type("WarmerSilence", (FingerSilent,), {})("x")) == 103
    assert fault_number(PermissionError("x")) == 598
    assert fault_number(ZeroDivisionError("x")) == 599
    assert fault_number(KeyboardInterrupt()) == 599
    assert fault_number(None) == 0


def test_an_error_that_reports_another_has_its_number() -> None:
    lost = PartLost("gone")
    job = Job(number=1, outcome=JobOutcome.ABORTED, error="x", exception=lost)
    failed = JobFailed(job)
    failed.__cause__ = lost
    assert (job.fault_number, failed.fault_number, fault_of(failed).number) == (205, 205, 205)
    assert Job(outcome=JobOutcome.CANCELED, exception=CellStopped("x")).fault_number == 512
    assert Job(outcome=JobOutcome.EXECUTING).fault_number == 0
