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
    """Default value."""
    whole: bool = False
    """Whether it is an integer, which may be hexadecimal."""

    @property
    def text(self) -> str:
        """The value as a column of the table shows it."""
        if self.whole:
            return f"{self.unit}, {self.low:.0f} to {self.high:.0f}, default {self.default:.0f}"
        return f"{self.unit}, {self.low:g} to {self.high:g}, default {self.default:g}"

    def read(self, name: str, text: str) -> float:
        """Return the number of a text. Raises SimulatorSettingsError."""
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
    """A value of a name and a whole number, for example ``current_limit:100``."""

    unit: str
    """Meaning of name and number."""
    default: str
    """Default value."""

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
                f"fault {name} takes {self.unit}, for example {self.default}; got {text!r:.40}"
            ) from None


FaultValue = float | tuple[str, int] | None
"""Number, name and number, or None, by the entry of the fault."""

Undo = Callable[[], object]
"""Undoes a fault."""


Plug = Callable[[], Undo]
"""Unplugs a cable and returns the function that plugs it in again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """Effect of an active fault."""

    undo: Undo
    """Undoes the fault."""
    act: Callable[[float], None] | None = None
    """Called with the time in s at each step of the world, for faults that change over time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """Cell, servo and value of a fault."""

    devices: CellDevices
    """The simulated cell."""
    plugs: Mapping[str, Plug]
    """Its cables by name: ``can`` and ``servos``."""
    servo: int
    """Position of the servo or axis in the settings, for its faults."""
    value: FaultValue
    """The checked value."""
    now_s: float

    @property
    def adc_max(self) -> int:
        """Full scale of the taxels in counts."""
        return self.devices.settings.layout.adc_max

    @property
    def number(self) -> float:
        """The value of a fault whose value is a number."""
        if not isinstance(self.value, float):
            raise SimulatorSettingsError(f"the value {self.value!r} is not a number")
        return self.value

    @property
    def setting(self) -> tuple[str, int]:
        """The value of a fault whose value is a setting."""
        if not isinstance(self.value, tuple):
            raise SimulatorSettingsError(f"the value {self.value!r} is not a name and a number")
        return self.value


@dataclass(frozen=True, slots=True)
class FaultEntry:
    """One fault of the vocabulary."""

    name: str
    """``component.fault``; ``servoN`` stands for servo1, servo2, ... in the order of the config,
    ``axisN`` for its axes."""
    kind: FaultKind
    """Effect on the component."""
    meaning: str
    """Description, one line."""
    apply: Callable[[Target], Effect]
    """Begins the fault on a target."""
    knob: str = ""
    """Only one fault of a knob of a device can be injected at a time; empty: any number."""
    value: Number | Setting | None = None
    """Value after ``=``; None: no value."""
    moment: bool = False
    """Whether the fault is momentary, without an end."""
    check: Callable[[Target], object] | None = None
    """Refuses values that do not fit the cell, with SimulatorSettingsError, before any change."""


Apply = Callable[[Target], Effect]

SHARE = Number("share", 0.0, 1.0, default=0.05)
"""Share of the traffic, or of the taxels, with the fault."""
_PARTS = {"can": "can", "unit": "unit", "taxels": "unit", "servos": "servo_wire"}
_PARTS |= {"board": "boards", "uskin": "uskin"}
"""Field of `simulator.devices.CellFaults` that has the knobs of each component."""


def turned(owner: object, name: str, value: object) -> Undo:
    """Set a knob and return the function that restores it."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    return lambda: setattr(owner, name, before)


def nothing() -> None:
    """Do nothing: the undo of a momentary fault."""


def lasting(begin: Callable[[Target], object], end: Callable[[Target], object]) -> Apply:
    """Return an effect with a function for its begin and one for its end."""

    def apply(target: Target) -> Effect:
        begin(target)
        return Effect(undo=lambda: end(target))

    return apply


def unplugging(plug: str) -> Apply:
    """Return an effect that unplugs a cable: ``can`` or ``servos``."""
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
    """Return a momentary fault."""

    def apply(target: Target) -> Effect:
        act(target)
        return Effect(undo=nothing)

    return FaultEntry(name, kind, meaning, apply, value=value, moment=True, check=check)


def knob_fault(
    name: str,
    kind: FaultKind,
    meaning: str,
    knob: str,
    value: Number | None = None,
    *,
    owner: Callable[[Target], object] | None = None,
    position: Callable[[Target], object] | None = None,
    check: Callable[[Target], object] | None = None,
) -> FaultEntry:
    """Return a fault that sets one knob: to a position, to its number, else to on.

    Parameters
    ----------
    owner
        Returns the object with the knob; None for the `CellFaults` of the fault's component.
    position
        Returns the position of the knob where it is not the number.
    """
    part = _PARTS.get(name.partition(".")[0], "")

    def apply(target: Target) -> Effect:
        on: object = True
        if position is not None:
            on = position(target)
        elif value is not None:
            on = int(target.number) if value.whole else target.number
        of = getattr(target.devices.faults, part) if owner is None else owner(target)
        return Effect(undo=turned(of, knob, on))

    return FaultEntry(name, kind, meaning, apply, knob, value, check=check)
