"""One named fault: its kind, its value, and how it is applied to a simulated cell."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from simulator.devices import CellDevices
from simulator.errors import SimulatorSettingsError


class FaultKind(StrEnum):
    """Effect of a fault on its component."""

    OFF = "off"
    STUCK = "stuck"
    GARBAGE = "garbage"
    WRONG = "wrong"
    SLOW = "slow"
    DELAYED = "delayed"
    INTERMITTENT = "intermittent"
    REBOOT = "reboot"
    UNPLUGGED = "unplugged"


@dataclass(frozen=True, slots=True)
class Number:
    """A value that is a number."""

    unit: str
    """Its unit; ``share`` for a probability."""
    low: float
    high: float
    """Its range."""
    default: float
    """What holds where the text names none."""
    whole: bool = False
    """Whether it is an integer; it may be written as hexadecimal then."""

    @property
    def text(self) -> str:
        """The value as a column of the table shows it."""
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
                value = float(text.removesuffix(self.unit))
        except (ValueError, OverflowError):
            pass
        if not self.low <= value <= self.high:
            raise SimulatorSettingsError(f"fault {name} takes {self.text}; got {text!r:.40}")
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """A value that is a name and a whole number, as ``current_limit:100``."""

    unit: str
    """What the name and the number are."""
    default: str
    """What holds where the text names none."""

    @property
    def text(self) -> str:
        """The value as a column of the table shows it."""
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
"""Number, name and number, or nothing, as the entry of the fault wants it."""

Undo = Callable[[], object]
"""Takes back what a fault has done."""


Plug = Callable[[], Undo]
"""Pulls a cable and returns what plugs it in again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """A fault at work on a cell."""

    undo: Undo
    """Takes back what the fault has done."""
    act: Callable[[float], None] | None = None
    """Called with the time in s as often as the world moves on, for faults that go on happening."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """Cell, servo and value to which a fault is applied."""

    devices: CellDevices
    """The simulated cell."""
    plugs: Mapping[str, Plug]
    """Its cables by name: ``can`` and ``servos``."""
    servo: int
    """Position of the servo or axis in the settings, for faults of one of them."""
    value: FaultValue
    """The value, checked."""
    now_s: float

    @property
    def adc_max(self) -> int:
        """Full scale of the taxels in counts."""
        return self.devices.settings.layout.adc_max

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


@dataclass(frozen=True, slots=True)
class FaultEntry:
    """One fault of the vocabulary."""

    name: str
    """``component.fault``; ``servoN`` stands for servo1, servo2, ... in the order of the config,
    ``axisN`` for its axes."""
    kind: FaultKind
    """What it does to the component."""
    meaning: str
    """One line."""
    apply: Callable[[Target], Effect]
    """Begins the fault on a target."""
    knob: str = ""
    """Faults of one knob of a component (and of one servo) exclude each other at the same time."""
    value: Number | Setting | None = None
    """What may stand behind ``=``; None for nothing."""
    moment: bool = False
    """Whether it happens and is over, so that it has no end."""
    check: Callable[[Target], object] | None = None
    """Refuses what does not fit the cell, with SimulatorSettingsError, before anything is changed.
    """

    def turns_knob_of(self, other: "FaultEntry") -> bool:
        """Whether both turn the same knob; ``servos`` and ``servoN`` are one component."""
        one, two = (entry.name.partition(".")[0].rstrip("sN") for entry in (self, other))
        return bool(self.knob) and (one, self.knob) == (two, other.knob)


Apply = Callable[[Target], Effect]

SHARE = Number("share", 0.0, 1.0, default=0.05)
"""Share of the traffic, or of the taxels, that a fault meets."""


def turned(owner: object, name: str, value: object) -> Undo:
    """Turn one knob and return what turns it back."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    return lambda: setattr(owner, name, before)


def nothing() -> None:
    """Take nothing back: the undo of a fault that is over as it happens."""


def turning(part: str, knob: str, position: Callable[[Target], object]) -> Apply:
    """Return what turns a knob of one part of the cell to a position while a fault lasts."""
    return lambda target: Effect(
        undo=turned(getattr(target.devices.faults, part), knob, position(target))
    )


def lasting(begin: Callable[[Target], object], end: Callable[[Target], object]) -> Apply:
    """Return what begins something, and ends it again as it is undone."""

    def apply(target: Target) -> Effect:
        begin(target)
        return Effect(undo=lambda: end(target))

    return apply


def unplugging(plug: str) -> Apply:
    """Return what pulls a cable: ``can`` or ``servos``."""
    return lambda target: Effect(undo=target.plugs[plug]())


def moment_fault(
    name: str,
    kind: FaultKind,
    meaning: str,
    act: Callable[[Target], object],
    value: Number | None = None,
    *,
    check: Callable[[Target], object] | None = None,
) -> FaultEntry:
    """Return a fault that is over as it happens."""

    def apply(target: Target) -> Effect:
        act(target)
        return Effect(undo=nothing)

    return FaultEntry(name, kind, meaning, apply, value=value, moment=True, check=check)


def knob_fault(
    name: str,
    kind: FaultKind,
    meaning: str,
    part: str,
    knob: str,
    *,
    value: Number | None = None,
) -> FaultEntry:
    """Return a fault that turns one knob of a part of the cell: to its number, or on without one.

    Parameters
    ----------
    part
        ``can``, ``unit`` or ``servo_wire``: a field of `simulator.devices.CellFaults`.
    """

    def position(target: Target) -> object:
        return True if value is None else target.number

    apply = turning(part, knob, position)
    return FaultEntry(name, kind, meaning, apply, knob, value)
