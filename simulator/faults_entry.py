"""What one named fault is: its kind, its value, and how it is applied to a simulated cell."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from simulator.errors import SimulatorSettingsError

if TYPE_CHECKING:
    from simulator.devices import CellDevices


class FaultKind(StrEnum):
    """What a fault does to its component."""

    OFF = "off"
    STUCK = "stuck"
    GARBAGE = "garbage"
    WRONG = "wrong"
    SLOW = "slow"
    DELAYED = "delayed"
    INTERMITTENT = "intermittent"
    REBOOT = "reboot"
    UNPLUGGED = "unplugged"


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """A value that is a number.

    Attributes
    ----------
    unit
        Its unit; ``share`` for a probability.
    low, high
        Its range.
    default
        What holds where the text names none.
    whole
        Whether it is an integer; it may be written as hexadecimal then.
    """

    unit: str
    low: float
    high: float
    default: float
    whole: bool = False

    @property
    def text(self) -> str:
        """The value as a column of the table says it."""
        if self.whole:
            return f"{self.unit}, {self.low:.0f} to {self.high:.0f}, default {self.default:.0f}"
        return f"{self.unit}, {self.low:g} to {self.high:g}, default {self.default:g}"

    def read(self, name: str, text: str) -> float:
        """Return the number that a text stands for. Raises SimulatorSettingsError."""
        value = math.nan
        try:
            if self.whole:
                value = float(int(text, 0))
            elif self.unit == "s" and text.endswith("s"):
                factor = 1e-3 if text.endswith("ms") else 1.0
                value = factor * float(text.removesuffix("ms").removesuffix("s"))
            else:
                value = float(text)
        except (ValueError, OverflowError):
            pass
        if not self.low <= value <= self.high:
            raise SimulatorSettingsError(f"fault {name} takes {self.text}; got {text!r:.40}")
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """A value that is a name and a whole number, as ``current_limit:100``.

    Attributes
    ----------
    unit
        What the name and the number are.
    default
        What holds where the text names none.
    """

    unit: str
    default: str

    @property
    def text(self) -> str:
        """The value as a column of the table says it."""
        return f"{self.unit}, default {self.default}"

    def read(self, name: str, text: str) -> tuple[str, int]:
        """Return name and number. Raises SimulatorSettingsError."""
        item, _, number = text.partition(":")
        try:
            return item, int(number, 0)
        except ValueError:
            raise SimulatorSettingsError(
                f"fault {name} takes {self.unit}, as {self.default}; got {text!r:.40}"
            ) from None


FaultValue = float | tuple[str, int] | None
Undo = Callable[[], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """What a fault has become on the cell.

    Attributes
    ----------
    undo
        Takes it back.
    act
        Called with the time in s as often as the world moves on, for faults that go on happening.
    """

    undo: Undo
    act: Callable[[float], None] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """Where a fault is applied.

    Attributes
    ----------
    devices
        The simulated cell.
    servo
        Position of the servo in the settings, for faults of one servo.
    value
        The value, checked.
    now_s
        Time in s.
    """

    devices: "CellDevices"
    servo: int
    value: FaultValue
    now_s: float

    @property
    def number(self) -> float:
        """The value of a fault whose value is a number."""
        if not isinstance(self.value, float):
            raise SimulatorSettingsError(f"the value {self.value!r} is no number")
        return self.value

    @property
    def setting(self) -> tuple[str, int]:
        """The value of a fault whose value is a setting."""
        if not isinstance(self.value, tuple):
            raise SimulatorSettingsError(f"the value {self.value!r} is no setting")
        return self.value


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultEntry:
    """One name of the vocabulary.

    Attributes
    ----------
    name
        ``component.fault``; ``servoN`` stands for servo1, servo2, ... in the order of the config.
    kind
        What it does to the component.
    meaning
        One line.
    apply
        Applies it.
    value
        What may stand behind ``=``; None for nothing.
    moment
        Whether it happens and is over, so that it has no end.
    check
        Refuses what does not fit the cell, with SimulatorSettingsError, before anything is changed.
    knob
        Faults of one knob (and one servo) exclude each other at the same time.
    """

    name: str
    kind: FaultKind
    meaning: str
    apply: Callable[[Target], Effect]
    value: Number | Setting | None = None
    moment: bool = False
    check: Callable[[Target], None] | None = None
    knob: str = ""


Apply = Callable[[Target], Effect]

SHARE = Number(unit="share", low=0.0, high=1.0, default=0.05)
"""How much of the traffic, or of the taxels, a fault meets."""


def turned(owner: object, name: str, value: object) -> Undo:
    """Turn one knob; return what turns it back to where it was."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    return lambda: setattr(owner, name, before)


def nothing() -> None:
    """Take nothing back."""


def turning(
    part: str, knob: str, value: Callable[[Target], object] = lambda target: target.number
) -> Apply:
    """Return what turns a knob of one part of the cell, to the number of the fault by default.

    Parameters
    ----------
    part
        ``can``, ``unit`` or ``servo_wire``.
    knob
        Name of the knob.
    value
        What to turn it to.
    """
    return lambda target: Effect(
        undo=turned(getattr(target.devices.faults, part), knob, value(target))
    )


def switching(part: str, knob: str) -> Apply:
    """Return what switches a knob of one part of the cell on."""
    return turning(part, knob, lambda target: True)


def unplugging(plug: str) -> Apply:
    """Return what pulls a plug: ``can`` or ``servos``."""

    def apply(target: Target) -> Effect:
        pull, plug_in = target.devices.plugs[plug]
        pull()
        return Effect(undo=plug_in)

    return apply


def share_fault(name: str, kind: FaultKind, meaning: str, knob: str, apply: Apply) -> FaultEntry:
    """Return a fault that meets a share of what passes."""
    return FaultEntry(name=name, kind=kind, meaning=meaning, value=SHARE, apply=apply, knob=knob)
