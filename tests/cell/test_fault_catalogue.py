"""The fault catalogue: every error has a number, and none ever changes."""

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path

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


def test_every_class_but_the_bases_is_raised_somewhere() -> None:
    packages = (gripper, motion, tactile, recognition, cell)
    files = (file for one in packages for file in Path(one.__path__[0]).rglob("*.py"))
    made = set(re.findall(r"(?<!class )\b(\w+)\(", "".join(file.read_text() for file in files)))
    bases = {"GripperError", "TactileError", "MotionError", "RecognitionError", "Exception"}
    assert {kind.__name__ for kind in CATALOGUE} - made == bases


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
    error = CellError("the file is damaged")
    for error.__cause__, number in ((ValueError("x"), 500), (FingerSilent("x"), 103)):
        assert fault_number(error) == number


def test_an_error_that_reports_another_has_its_number() -> None:
    lost = PartLost("gone")
    job = Job(number=1, outcome=JobOutcome.ABORTED, error="x", exception=lost)
    failed = JobFailed(job)
    failed.__cause__ = lost
    assert (job.fault_number, failed.fault_number, fault_of(failed).number) == (205, 205, 205)
    assert Job(outcome=JobOutcome.CANCELED, exception=CellStopped("x")).fault_number == 512
    assert Job(outcome=JobOutcome.EXECUTING).fault_number == 0
