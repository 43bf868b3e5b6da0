"""One named fault: its kind, its value, and how it is applied to a simulated cell."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

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


Undo = Callable[[], object]
"""Undoes a fault."""
Plug = Callable[[], Undo]
"""Unplugs a cable and returns the function that plugs it in again."""


@dataclass(slots=True, kw_only=True)
class Target:
    """Cell, servo and value of a fault."""

    devices: CellDevices
    """The simulated cell."""
    plugs: Mapping[str, Plug]
    """Its cables by name: ``can`` and ``servos``."""
    servo: int
    """Position of the servo or axis in the settings, for its faults."""
    number: float
    """The checked value of a fault whose value is a number."""
    setting: tuple[str, int]
    """The checked value of a fault whose value is a setting."""
    now_s: float
    act: Callable[[float], None] = field(default=lambda _now_s: None, init=False)
    """Called with the time in s at each step of the world; faults that change over time set it."""

    @property
    def adc_max(self) -> int:
        """Full scale of the taxels in counts."""
        return self.devices.settings.layout.adc_max


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
    apply: Callable[[Target], Any]
    """Begins the fault on a target, and returns its `Undo`; that of a moment is not used."""
    knob: str = ""
    """Only one fault of a knob of a device can be injected at a time; empty: any number."""
    value: Number | Setting | None = None
    """Value after ``=``; None: no value."""
    moment: bool = field(default=False, kw_only=True)
    """Whether the fault is momentary, without an end."""
    check: Callable[[Target], object] = field(default=lambda _target: None, kw_only=True)
    """Refuses values that do not fit the cell, with SimulatorSettingsError, before any change."""


SHARE = Number("share", 0.0, 1.0, default=0.05)
"""Share of the traffic, or of the taxels, with the fault."""
_PARTS = {"can": "can", "unit": "unit", "taxels": "unit", "servos": "servo_wire"}
_PARTS |= {"board": "boards", "uskin": "boards"}
"""Field of `simulator.devices.CellFaults` that has the knobs of each component."""


def turned(owner: object, name: str, value: object) -> Undo:
    """Set a knob and return the function that restores it."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    return lambda: setattr(owner, name, before)


def unplugging(plug: str) -> Callable[[Target], Undo]:
    """Return a fault that unplugs a cable: ``can`` or ``servos``."""
    return lambda target: target.plugs[plug]()


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
        Returns the object with the knob, or refuses the cell; None for the `CellFaults` of the
        fault's component.
    position
        Returns the position of the knob where it is not the number.
    """
    part = _PARTS.get(name.partition(".")[0], "")

    def apply(target: Target) -> Undo:
        on: object = True
        if position is not None:
            on = position(target)
        elif value is not None:
            on = int(target.number) if value.whole else target.number
        of = getattr(target.devices.faults, part) if owner is None else owner(target)
        return turned(of, knob, on)

    fits = check or owner or (lambda _target: None)
    return FaultEntry(name, kind, meaning, apply, knob, value, check=fits)
