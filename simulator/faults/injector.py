"""The vocabulary of faults, and the injector that begins and ends them on a simulated cell.

A text such as ``can.loss=0.05@2s`` or ``servo1.reboot@contact+0.5s`` has the fault, its value and
its start: ``COMPONENT.FAULT[=VALUE][@START[..END]]``. Faults never reach real hardware.
"""

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial

from simulator.clock import ROUNDING_S
from simulator.devices import CellDevices
from simulator.errors import SimulatorError, SimulatorSettingsError, SimulatorStateError
from simulator.faults.axes import AXIS
from simulator.faults.boards import BOARD
from simulator.faults.can import CAN, TAXELS, UNIT
from simulator.faults.entry import FaultEntry, Plug, Target, Undo, turned
from simulator.faults.object import OBJECT
from simulator.faults.servos import SERVO, SERVOS

VOCABULARY: dict[str, FaultEntry] = {
    entry.name: entry for entry in (*CAN, *UNIT, *TAXELS, *BOARD, *SERVOS, *SERVO, *AXIS, *OBJECT)
}
"""All faults by name; ``servoN`` and ``axisN`` stand for each servo and axis of the config."""

CONTACT_N = 0.5
"""Force in N on both pads at the event ``contact``: a little below the contact force of grippers,
because the first touch may be much earlier."""
MOVING_RAD_S = 0.02
"""Speed of a servo in rad/s at the event ``moving``: about 1 mm/s at the pads."""
FORM = "COMPONENT.FAULT[=VALUE][@START[..END]]"
LONGEST_TEXT = 200
"""Most characters of a fault."""
_TIME = re.compile(r"(?:(contact|moving)\+)?(\d{1,7}(?:\.\d{1,9})?)(ms|s)|(contact|moving)")
_NAME = re.compile(r"[a-z]+[0-9]*\.[a-z_]+")
_NUMBERED = re.compile(r"(servo|axis)([1-9][0-9]?)\.(.+)")
_EACH = ("servoN", "axisN")
"""First parts of names that stand for each servo, and for each axis, of the config."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """A fault as it was written, with its checked value."""

    text: str
    """The whole text."""
    entry: FaultEntry
    """Entry of the vocabulary."""
    servo: int
    """Position of the servo or axis in the settings."""
    value: float | tuple[str, int] | None
    """Number, name and number, or None, by the entry."""
    event: str
    """``contact`` or ``moving``; empty: the injection."""
    start_s: float
    end_s: float
    """Start and end in s after the first such event since the injection; end infinity: never."""


def check_fault(text: str, n_servos: int = 2, n_axes: int = 0) -> Fault:
    """Return the fault of a text.

    Raises SimulatorSettingsError if the form of the text, its name, value or moment is wrong.
    """
    if not isinstance(text, str) or len(text) > LONGEST_TEXT:
        raise SimulatorSettingsError(f"a fault is a text {FORM} of at most {LONGEST_TEXT} letters")
    what, at, window = text.strip().partition("@")
    name, equals, written = what.partition("=")
    if not _NAME.fullmatch(name):
        raise SimulatorSettingsError(f"fault {text!r} is not of the form {FORM}")
    if equals and not written:
        raise SimulatorSettingsError(f"fault {text!r} has no value after its '='")
    start, dots, end = window.partition("..")
    event, start_s = _when(text, start) if at else ("", 0.0)
    end_event, end_s = _when(text, end) if dots else (event, math.inf)
    if event != end_event or end_s <= start_s:
        raise SimulatorSettingsError(
            f"fault {text!r} ends before it begins, or counts both from different events"
        )
    entry, servo = _entry(name, n_servos, n_axes)
    if entry.moment and end_s < math.inf:
        raise SimulatorSettingsError(f"fault {name} is momentary: leave out its end")
    value: float | tuple[str, int] | None = None
    if entry.value is not None:
        value = entry.value.read(name, written or str(entry.value.default))
    elif equals:
        raise SimulatorSettingsError(f"fault {name} takes no value: leave it out")
    return Fault(
        text=text.strip(),
        entry=entry,
        servo=servo,
        value=value,
        event=event,
        start_s=start_s,
        end_s=end_s,
    )


def _entry(name: str, n_servos: int, n_axes: int) -> tuple[FaultEntry, int]:
    """Return the entry of a name, and the position of its servo or axis."""
    match, general, servo = _NUMBERED.fullmatch(name), name, 0
    if match:
        general, servo = f"{match[1]}N.{match[3]}", int(match[2]) - 1
    entry = VOCABULARY.get(general)
    if entry is None:
        near = get_close_matches(general, VOCABULARY, n=1)
        meant = f"did you mean {near[0].replace('N.', f'{servo + 1}.')}? " if near else ""
        raise SimulatorSettingsError(
            f"there is no fault {name!r}; {meant}`tactile-cell simulate --list-faults` lists all"
        )
    if general.startswith("axisN") and servo >= n_axes:
        raise SimulatorSettingsError(f"fault {name}: this cell has {n_axes} axes")
    if general.startswith("servoN") and servo >= n_servos:
        raise SimulatorSettingsError(f"fault {name}: this cell has {n_servos} servos")
    return entry, servo


def _when(text: str, when: str) -> tuple[str, float]:
    match = _TIME.fullmatch(when)
    if match is None:
        raise SimulatorSettingsError(
            f"fault {text!r}: {when!r} is not a time; write 2s, 250ms, contact, contact+0.5s, "
            "moving or moving+20ms"
        )
    event, number, unit, alone = match.groups()
    return event or alone or "", float(number or 0.0) * (1e-3 if unit == "ms" else 1.0)


class InjectedFault:
    """An injected fault: waiting, active, or over."""

    def __init__(self, injector: "FaultInjector", fault: Fault, injected_s: float) -> None:
        self._injector = injector
        self.fault, self.text, self.entry = fault, fault.text, fault.entry
        """The fault, its text, and its entry of the vocabulary."""
        self.began_s: float | None = None
        self.ended_s: float | None = None
        """Time of the cell in s at which it began and ended; None before."""
        self.event_s = math.inf if fault.event else injected_s
        """Time of the event in s; infinity before."""

    @property
    def value(self) -> float:
        """Its value if that is a number, else NaN."""
        return self.fault.value if isinstance(self.fault.value, float) else math.nan

    @property
    def over(self) -> bool:
        """Whether it has ended; a momentary fault ends at once."""
        return self.ended_s is not None

    def clear(self) -> None:
        """End the fault, or cancel it before its start; a second call has no effect."""
        self._injector.end(self)

    def meets(self, other: "InjectedFault") -> bool:
        """Return whether both use one knob of one device; ``servos`` are each ``servoN``."""
        names = [fault.entry.name for fault in (self, other)]
        one, two = (name.partition(".")[0].rstrip("sN") for name in names)
        apart = self.fault.servo != other.fault.servo
        apart = apart and all(name.startswith(_EACH) for name in names)
        knob = self.entry.knob
        return bool(knob) and (one, knob) == (two, other.entry.knob) and not apart


class FaultInjector:
    """Begins and ends faults at their times; each step of the world calls `advance`.

    Parameters
    ----------
    plugs
        Cables of the cell: ``can``, ``servos``, ``board0``, ``board1``; by default knobs of the
        devices, for buses in memory.
    """

    def __init__(
        self, devices: CellDevices, start_s: float, *, plugs: Mapping[str, Plug] | None = None
    ) -> None:
        self.devices = devices
        self._plugs = plugs or {
            "can": partial(turned, devices.faults.can, "unplugged", True),
            "servos": partial(turned, devices.faults.servo_wire, "unplugged", True),
            "board0": partial(turned, devices.faults.boards, "unplugged", {0}),
            "board1": partial(turned, devices.faults.boards, "unplugged", {1}),
        }
        self._pending: list[InjectedFault] = []
        self._active: dict[InjectedFault, tuple[Undo, Target]] = {}
        self.now_s = start_s

    @property
    def faults(self) -> tuple[InjectedFault, ...]:
        """Active and waiting faults."""
        return (*self._active, *self._pending)

    def inject(self, text: str) -> InjectedFault:
        """Inject a fault; without a start it begins at once.

        Raises SimulatorSettingsError if the fault is unknown, or its value does not fit this cell.
        Raises SimulatorStateError if another fault uses the same knob.
        """
        fault = self._checked(text)
        for other in self.faults:
            if fault.meets(other):
                raise SimulatorStateError(
                    f"{other.text} is injected and uses the same knob as {fault.text}: "
                    "clear it first"
                )
        if not fault.fault.event and fault.fault.start_s == 0.0:
            self._begin(fault, self.now_s)
        else:
            self._pending.append(fault)
        return fault

    def kinds(self) -> dict[str, FaultEntry]:
        """Return the possible faults of this cell by name, for each servo and axis."""
        devices, found = self.devices, {}
        for entry in VOCABULARY.values():
            each = {"servoN": len(devices.settings.servos), "axisN": len(devices.axes)}
            for number in range(each.get(entry.name.partition(".")[0], 1)):
                name = entry.name.replace("N.", f"{number + 1}.")
                with suppress(SimulatorError):
                    found[name] = self._checked(name).entry
        return found

    def _checked(self, text: str) -> InjectedFault:
        devices = self.devices
        fault = check_fault(text, len(devices.settings.servos), len(devices.axes))
        if fault.entry.name.startswith("object."):
            _ = devices.physical
        fault.entry.check(self._target(fault, self.now_s))
        return InjectedFault(self, fault, self.now_s)

    def _target(self, fault: Fault, now_s: float) -> Target:
        value = fault.value
        return Target(
            devices=self.devices,
            plugs=self._plugs,
            servo=fault.servo,
            number=value if isinstance(value, float) else math.nan,
            setting=value if isinstance(value, tuple) else ("", 0),
            now_s=now_s,
        )

    def clear(self, text: str) -> int:
        """End the faults with this text or name; returns their number.

        Raises SimulatorStateError if no fault matches.
        """
        wanted = text.strip()
        found = [
            fault
            for fault in self.faults
            if wanted in (fault.text, re.split("[=@]", fault.text, maxsplit=1)[0])
        ]
        if not found:
            there = ", ".join(fault.text for fault in self.faults) or "none"
            raise SimulatorStateError(f"no fault {wanted!r} is injected; injected faults: {there}")
        for fault in found:
            self.end(fault)
        return len(found)

    def clear_all(self) -> None:
        """End every fault."""
        for fault in self.faults:
            self.end(fault)

    def end(self, fault: InjectedFault) -> None:
        """End a fault, or cancel it before its start; no effect if it is over."""
        if fault.over:
            return
        if fault in self._active:
            undo, _ = self._active.pop(fault)
            undo()
        else:
            self._pending.remove(fault)
        fault.ended_s = self.now_s

    def advance(self, now_s: float) -> None:
        """Begin, continue and end the due faults at ``now_s`` s."""
        self.now_s = now_s
        if not self._pending and not self._active:
            return
        for injected in self.faults:
            fault = injected.fault
            if math.isinf(injected.event_s) and self._happens(fault.event):
                injected.event_s = now_s
            since_s = now_s - injected.event_s + ROUNDING_S
            if injected in self._active:
                _, target = self._active[injected]
                target.act(now_s)
            elif fault.start_s <= since_s:
                self._begin(injected, now_s)
            if injected in self._active and fault.end_s <= since_s:
                self.end(injected)

    def _begin(self, injected: InjectedFault, now_s: float) -> None:
        target = self._target(injected.fault, now_s)
        undo = injected.entry.apply(target)
        injected.began_s = now_s
        if injected in self._pending:
            self._pending.remove(injected)
        if injected.entry.moment:
            injected.ended_s = now_s
        else:
            self._active[injected] = undo, target

    def _happens(self, event: str) -> bool:
        devices = self.devices
        if event == "contact":
            return min(devices.world.contact_force_n()) > CONTACT_N
        return any(abs(motor.velocity_rad_s) > MOVING_RAD_S for motor in devices.mechanics.motors)
