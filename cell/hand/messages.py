"""Messages between a program and the process of its force loop: frozen values, nothing else.

Both ends are this program, on a socket pair that no other can reach; values are pickled. Errors
cross as what they are: class, arguments and attributes.
"""

import builtins
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from cell import errors as cell_errors
from cell.config.model import CellConfig
from cell.hand.interface import Hand, HandStatistics, Measured, Watch
from gripper import errors as gripper_errors
from gripper.state import Cycle, GripperPhase
from tactile import errors as tactile_errors
from tactile.frames.codec import TactileFrame

# -- to the process ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Boot:
    """First message: what to open."""

    config: CellConfig
    partial: bool = False


WATCHED = frozenset({"open", "grasp", "meet", "carry", "squeeze", "release"})
"""Methods of `Hand` that run the force loop; each period of it is sent as `Progress`."""
UNWATCHED = frozenset(
    {"start", "start_sensor", "close_sensor", "tare", "conditions", "inspect", "read_sensor"}
    | {"keep_grip", "clear_fault", "shutdown"}
)
"""The other methods of `Hand` that the process carries out."""


@dataclass(frozen=True, slots=True)
class Command:
    """A method of `Hand` and its arguments; ValueError for a name that is no such method."""

    name: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    """By name, without the callback ``watch``."""

    def __post_init__(self) -> None:
        if self.name not in WATCHED | UNWATCHED:
            raise ValueError(f"{self.name!r} is no command of the hand")

    def run(self, hand: Hand, watch: Watch) -> Any:
        """Carry it out and return what the method returns."""
        watched = {"watch": watch} if self.name in WATCHED else {}
        return getattr(hand, self.name)(**self.arguments, **watched)


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A command and its number; answers name the number."""

    number: int
    command: Command


@dataclass(frozen=True, slots=True, kw_only=True)
class EndRamp:
    """`Hand.end_ramp`, sent while a grasp runs; no answer follows."""

    number: int
    """Of the request to grasp that it is meant for: while another one runs it counts no more."""


# -- from the process ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """The ports are open; `notes` are messages for the operator."""

    notes: tuple[str, ...]
    statistics: HandStatistics


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """One period of a running command and the frames that came in it."""

    cycle: Cycle
    frames: tuple[TactileFrame, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SentError:
    """An error on its way to the other process."""

    tree: str
    name: str
    """Module and class."""
    args: tuple[Any, ...]
    attributes: dict[str, Any]
    """What makes it up."""
    trace: str = ""
    """Where it came from, for a class that cannot be sent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """How a command ended, and how the hand stands then."""

    number: int
    """Of the request."""
    value: Any
    """What the command returned."""
    error: SentError | None
    """What it raised, None where it returned."""
    phase: GripperPhase
    statistics: HandStatistics
    """Of the hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """A fault between two commands."""

    error: SentError
    phase: GripperPhase


@dataclass(frozen=True, slots=True, kw_only=True)
class Alive:
    """Sent between commands: the process is alive, and `Hand.measured` is this."""

    measured: Measured


Event = Ready | Progress | Answer | Fault | Alive


# -- errors --------------------------------------------------------------------------------------


def _tree(module: Any) -> Iterator[type[BaseException]]:
    for value in vars(module).values():
        if isinstance(value, type) and issubclass(value, BaseException):
            yield value


_CLASSES: dict[tuple[str, str], type[BaseException]] = {
    (kind.__module__, kind.__name__): kind
    for module in (gripper_errors, tactile_errors, cell_errors, builtins)
    for kind in _tree(module)
}


def send_error(error: BaseException) -> SentError:
    """Return an error as a message."""
    kind = type(error)
    known = (kind.__module__, kind.__name__) in _CLASSES
    args = tuple(error.args)
    if isinstance(error, OSError) and error.filename is not None:
        # The file is no argument any more, but its place is known.
        args = (*args[:2], error.filename)
    return SentError(
        tree=kind.__module__,
        name=kind.__name__,
        args=args if known else (str(error),),
        attributes=dict(vars(error)) if known else {},
        trace="" if known else "".join(traceback.format_exception(error)),
    )


def received_error(sent: SentError) -> BaseException:
    """Return the error of a message; a RuntimeError that names the class where that is foreign."""
    kind = _CLASSES.get((sent.tree, sent.name))
    if kind is None:
        unknown = RuntimeError(f"{sent.tree}.{sent.name}: {' '.join(map(str, sent.args))}")
        unknown.add_note(sent.trace)
        return unknown
    # The class's own __init__ makes a text of other arguments than those that the error holds.
    error = kind.__new__(kind, *sent.args)
    if not (isinstance(error, OSError) and error.filename is not None):
        error.args = sent.args
    for name, value in sent.attributes.items():
        setattr(error, name, value)
    return error
