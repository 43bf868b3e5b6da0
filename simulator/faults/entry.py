"""One named fault: its value, its times, and how it is applied to a simulated cell."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from simulator.devices import CellDevices
from simulator.errors import SimulatorSettingsError


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
_EACH = ("servoN", "axisN")
"""First parts of names that stand for each servo, and for each axis, of the config."""


@dataclass(slots=True, kw_only=True, eq=False)
class Fault:
    """A fault with its checked value: not injected yet, waiting, active, or over."""

    text: str
    """The whole text."""
    entry: "FaultEntry"
    """Entry of the vocabulary."""
    index: int
    """Position of its servo or axis in the settings."""
    value: float
    """Its value if that is a number, else NaN."""
    setting: tuple[str, int]
    """Its value if that is a name and a number."""
    event: str
    """``contact`` or ``moving``; empty: the injection."""
    start_s: float
    end_s: float
    """Start and end in s after the first such event since the injection; end infinity: never."""
    devices: CellDevices = field(init=False)
    """The cell, once it is injected."""
    plugs: Mapping[str, Plug] = field(init=False)
    """The cables of the cell by name: ``can``, ``servos``, ``board0``, ``board1``."""
    now_s: float = field(init=False)
    """Time of the cell in s at the injection, then at its begin."""
    event_s: float = field(default=math.inf, init=False)
    """Time of the event in s; infinity before."""
    began_s: float | None = field(default=None, init=False)
    """Time of the cell in s at which it began; None before."""
    over: bool = field(default=False, init=False)
    """Whether it has ended; a momentary fault ends at once."""
    undo: Undo = field(default=lambda: None, init=False)
    """Ends its effect."""
    act: Callable[[float], None] = field(default=lambda _now_s: None, init=False)
    """Continues its effect at each step of the world, with the time in s."""

    def begin(self, now_s: float) -> None:
        """Apply the fault at ``now_s`` s."""
        self.now_s = self.began_s = now_s
        if self.entry.happens is not None:
            self.entry.happens(self)
            self.over = True
        else:
            self.undo = self.entry.apply(self)

    def clear(self) -> None:
        """End the fault, or cancel it before its start; a second call has no effect."""
        if not self.over:
            self.over = True
            self.undo()

    def meets(self, other: "Fault") -> bool:
        """Return whether both use one knob of one device; ``servos`` are each ``servoN``."""
        names = [fault.entry.name for fault in (self, other)]
        first, second = (name.partition(".")[0].rstrip("sN") for name in names)
        apart = self.index != other.index and all(name.startswith(_EACH) for name in names)
        knob = self.entry.knob
        return bool(knob) and (first, knob) == (second, other.entry.knob) and not apart


def turned(owner: object, name: str, value: object) -> Undo:
    """Set a knob and return the function that restores it."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    return lambda: setattr(owner, name, before)


@dataclass(frozen=True, slots=True)
class FaultEntry:
    """One fault of the vocabulary. Without a function of its own it sets a knob of its owner."""

    name: str
    """``component.fault``; ``servoN`` stands for servo1, servo2, ... in the order of the config,
    ``axisN`` for its axes."""
    meaning: str
    """Description, one line."""
    owner: Callable[[Fault], Any]
    """Returns the object with the knob. Refuses a cell that has none, with SimulatorSettingsError.
    """
    knob: str = ""
    """Name of the knob. Only one fault of a knob of a device can be injected at a time."""
    value: Number | Setting | None = None
    """Value after ``=``; None: no value."""
    position: Callable[[Fault], object] | None = None
    """Returns the position of the knob; None: the number of the value, else on."""
    effect: Callable[[Fault], Undo] | None = None
    """Begins the fault instead of the knob, and returns its `Undo`."""
    happens: Callable[[Fault], object] | None = None
    """Carries out a fault that is a moment, without an end."""
    check: Callable[[Fault], object] | None = None
    """Refuses values that do not fit the cell, with SimulatorSettingsError, before any change."""

    @property
    def moment(self) -> bool:
        """Whether the fault is momentary, without an end."""
        return self.happens is not None

    def apply(self, fault: Fault) -> Undo:
        """Begin a fault that has an end."""
        if self.effect is not None:
            return self.effect(fault)
        position: object = True
        if self.position is not None:
            position = self.position(fault)
        elif isinstance(self.value, Number):
            position = int(fault.value) if self.value.whole else fault.value
        return turned(self.owner(fault), self.knob, position)
