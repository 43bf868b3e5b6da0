"""One named fault: its value, its times, and how it is applied to a simulated cell."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

from simulator.boards.uskin import UskinSettings
from simulator.devices import CellDevices
from simulator.errors import SimulatorSettingsError
from simulator.knobs import Number, Setting

Undo = Callable[[], object]
"""Undoes a fault."""
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
    value: Any
    """Its number, or name and number (`simulator.knobs.Setting`); None without a value."""
    event: str
    """``contact`` or ``moving``; empty: the injection."""
    start_s: float
    end_s: float
    """Start and end in s after the first such event since the injection; end infinity: never."""
    devices: CellDevices = field(init=False)
    """The cell, once it is injected."""
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
    last_s: float = field(init=False)
    """Time in s up to which `FaultEntry.act` has carried it out."""

    @property
    def owner(self) -> Any:
        """The object with its knob. Raises SimulatorSettingsError in a cell that has none."""
        return _OWNERS[self.entry.name.partition(".")[0]](self)

    def begin(self, now_s: float) -> None:
        """Apply the fault at ``now_s`` s."""
        self.now_s = self.began_s = self.last_s = now_s
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


def _serial_boards(fault: Fault) -> Any:
    if not fault.devices.boards:
        raise SimulatorSettingsError("this cell has no sensor boards on serial lines")
    return fault.devices.faults.boards


def _uskin_boards(fault: Fault) -> Any:
    if not isinstance(fault.devices.settings.boards, UskinSettings):
        raise SimulatorSettingsError("this cell has no sensor boards on CAN")
    return fault.devices.faults.boards


_OWNERS: dict[str, Callable[[Fault], Any]] = {
    "can": lambda fault: fault.devices.faults.can,
    "unit": lambda fault: fault.devices.faults.unit,
    "taxels": lambda fault: fault.devices.faults.unit,
    "board": _serial_boards,
    "uskin": _uskin_boards,
    "servos": lambda fault: fault.devices.faults.servo_wire,
    "servoN": lambda fault: fault.devices.servo_bus.servos[fault.index],
    "axisN": lambda fault: list(fault.devices.axes.values())[fault.index],
    "object": lambda fault: fault.devices.world,
}
"""Object with the knobs of each component."""
COMPONENTS = tuple(_OWNERS)
"""First parts of the names of faults."""


@dataclass(frozen=True, slots=True)
class FaultEntry:
    """One fault of the vocabulary. Without a function of its own it sets a knob of its owner."""

    name: str
    """``component.fault``; ``servoN`` stands for servo1, servo2, ... in the order of the config,
    ``axisN`` for its axes."""
    meaning: str
    """Description, one line."""
    knob: str = ""
    """Path of the knob from its owner. Only one fault of a knob of a device can be injected at a
    time."""
    value: Number | Setting | None = None
    """Value after ``=``; None: no value."""
    position: Callable[[Fault], object] | None = None
    """Returns the position of the knob; None: the number of the value, else on."""
    effect: Callable[[Fault], Undo] | None = None
    """Begins the fault instead of the knob, and returns its `Undo`."""
    act: Callable[[Fault, float], object] | None = None
    """Continues its effect at each step of the world, with the time in s."""
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
        path, _, knob = self.knob.rpartition(".")
        owner = attrgetter(path)(fault.owner) if path else fault.owner
        before = getattr(owner, knob)
        position: object = True
        if self.position is not None:
            position = self.position(fault)
        elif isinstance(before, frozenset):
            position = before | {int(fault.value)}
        elif isinstance(self.value, Number):
            position = int(fault.value) if self.value.whole else fault.value
        setattr(owner, knob, position)
        return lambda: setattr(owner, knob, before)
