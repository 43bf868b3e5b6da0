"""Errors of the cell, in one tree; each message names cause, value, limit and next step."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def raised_as(kind: type[Exception], *caught: type[Exception], where: str = "") -> Iterator[None]:
    """Raise errors of some kinds as one of another kind, with their text after ``where``."""
    try:
        yield
    except caught as error:
        raise kind(f"{where}: {error}" if where else str(error)) from error


def reason_text(cause: Exception) -> str:
    """Return the reason of an error of Python or numpy in a file, as text."""
    if isinstance(cause, KeyError):
        return f"{cause} is missing"
    return str(cause) or ("too little memory" if isinstance(cause, MemoryError) else "cut off")


class CellError(Exception):
    """Base of all errors that the package raises on purpose."""


class ConfigError(CellError):
    """A config file or value is refused; nothing has moved."""


class MissingExtraError(ConfigError):
    """A package of an optional extra is not installed; nothing has moved."""


class DatasetError(CellError):
    """A grasp data set cannot be read or written."""


class ModelError(CellError):
    """A taught model cannot be read, written or used on these pads."""


class RecordingError(CellError):
    """A recording cannot be read, or stopped while it was being written."""


class ArchiveError(CellError):
    """An archive of grasps cannot be read or written."""


class ReportError(CellError):
    """The report page cannot be created."""


class CellStateError(CellError):
    """The command is not allowed in the present state of the cell."""


class PartInGrip(CellStateError):
    """The cell cannot start: a part may still be in the grip, and only a release lets it go."""


class TooFewGrasps(CellError):
    """There are too few taught grasps for a training; they are kept."""


class PlanRefused(CellError, ValueError):
    """The requested grasp or plan cannot be carried out; nothing has moved."""


class HandLost(CellError):
    """The process of the force loop is gone or does not answer; a part may still be gripped."""


class HostSilent(CellError):
    """The program read nothing from its force loop for too long; the grip is kept."""


class PositionerError(CellError):
    """A pose was not reached, or an object is not available."""


class PositionerFault(CellError):
    """An axis of the positioner has a fault or is silent; all axes were stopped."""


class ZeroRefused(CellError):
    """A self-zero found a deviation of pads or fingers beyond its limits; the fingers are open."""


class NoPartFound(CellError):
    """The fingers closed to their limit and touched nothing."""


class RequestRefused(CellError):
    """A request over a link is unknown, incomplete or has a wrong key; nothing has moved."""


class NotInCommand(CellError):
    """A client commands without the lease: another client has it, or it has expired."""


class NotMeasured(CellError):
    """The requested value is not measured at the moment."""


class HeldByClient(CellError):
    """A client keeps the cell on hold: no motion starts until the client ends its hold."""


class CellStopped(CellError):
    """The sequence was stopped on request; the grip is kept until a release."""
