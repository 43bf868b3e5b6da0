"""Messages between a program and the process of its force loop: frozen values.

Both ends are this program, on a socket pair that no other program can reach; values are pickled.
Errors are sent as class, arguments and attributes.
"""

import io
import pickle
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from inspect import signature
from typing import Any

from cell.config.model import CellConfig
from cell.hand.interface import Hand, HandStatistics, LatestValues, OnPeriod
from gripper.values.state import Cycle, GripperPhase
from tactile.source import TactileFrame

# -- to the process ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Boot:
    """First message: the lines to open."""

    config: CellConfig
    partial: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class HandRequest:
    """A command of `Hand` that the process carries out; its answer has the number."""

    number: int
    method: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    """By name, without the callback ``watch``."""

    @property
    def watched(self) -> bool:
        """Whether it runs the force loop and sends each period as `HandPeriod`."""
        return "watch" in signature(getattr(Hand, self.method)).parameters

    def run(self, hand: Hand, watch: OnPeriod) -> Any:
        """Carry it out and return the result of the method."""
        watched = {"watch": watch} if self.watched else {}
        return getattr(hand, self.method)(**self.arguments, **watched)


@dataclass(frozen=True, slots=True, kw_only=True)
class EndRamp:
    """`Hand.end_ramp`, sent while a grasp runs; no answer follows."""

    number: int
    """Number of the grasp request; the message has no effect while another request runs."""


# -- from the process ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """The ports are open; its values are those of the `Hand`."""

    notes: tuple[str, ...]
    missing: tuple[str, ...] = ()
    statistics: HandStatistics


@dataclass(frozen=True, slots=True, kw_only=True)
class HandPeriod:
    """One period of a running command and its frames."""

    cycle: Cycle
    frames: tuple[TactileFrame, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class HandReply:
    """The end of a command, and the state of the hand after it."""

    number: int
    """Of the request."""
    value: Any
    """Result of the command."""
    error: BaseException | None
    """Error of the command, or None."""
    phase: GripperPhase
    statistics: HandStatistics
    """Of the hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HandFault:
    """A fault between two commands."""

    error: BaseException
    phase: GripperPhase


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveUpdate:
    """Sent between commands: a sign of life with the newest values for `Hand.latest`."""

    latest: LatestValues


HandMessage = Ready | HandPeriod | HandReply | HandFault | LiveUpdate


# -- how an event is sent --------------------------------------------------------------------------

_KNOWN = ("gripper.errors", "tactile.errors", "cell.errors", "builtins")
"""Modules whose errors the other end can import."""


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        """Send an error by its parts, those that cannot be sent as text.

        An error of another class becomes one of its nearest known class, or a RuntimeError.
        """
        if not isinstance(value, BaseException):
            return NotImplemented
        kind = type(value)
        if kind.__module__ not in _KNOWN:
            trace = "".join(traceback.format_exception(value))
            ancestor = next(base for base in kind.__mro__ if base.__module__ in _KNOWN)
            text = f"{kind.__module__}.{kind.__name__}: {value}"
            ancestor = RuntimeError if ancestor in (Exception, BaseException) else ancestor
            value = ancestor.__new__(ancestor, text)
            value.args = (text,)
            value.add_note(trace)
        args = value.args
        if isinstance(value, OSError) and value.filename is not None:
            # The file name is not among the arguments, but its position is fixed.
            args = (*args[:2], value.filename)
        state = {name: _sendable(item) for name, item in vars(value).items()}
        return _restored, (type(value), _sendable(args), _sendable(value.args)), state


def _restored(kind: type[BaseException], given: tuple[Any, ...], args: tuple[Any, ...]) -> Any:
    """Return an error; the class's own __init__ may have other arguments than it stores."""
    # Built-in classes have no other arguments, and set their fields in __init__.
    error = kind(*given) if kind.__module__ == "builtins" else kind.__new__(kind, *given)
    error.args = args
    return error


def _sendable(value: Any) -> Any:
    """Return a value that can be sent; of another one its text."""
    if isinstance(value, tuple):
        return tuple(map(_sendable, value))
    try:
        pickle.dumps(value)
    except Exception:
        return repr(value)
    return value


def packed(event: HandMessage) -> bytes:
    """Return an event as bytes."""
    data = io.BytesIO()
    _Pickler(data, pickle.HIGHEST_PROTOCOL).dump(event)
    return data.getvalue()
