"""The vocabulary of faults, and the injector that begins and ends them on a simulated cell.

A text such as ``can.loss=0.05@2s`` or ``servo1.reboot@contact+0.5s`` has the fault, its value and
its start; `simulator.faults.text` has the form. Faults never reach real hardware.
"""

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from difflib import get_close_matches
from functools import partial

from simulator.clock import ROUNDING_S
from simulator.devices import CellDevices
from simulator.errors import SimulatorError, SimulatorSettingsError, SimulatorStateError
from simulator.faults.axes import AXIS
from simulator.faults.boards import BOARD
from simulator.faults.can import CAN, TAXELS, UNIT
from simulator.faults.entry import Effect, FaultEntry, FaultValue, Plug, Target, turned
from simulator.faults.object import OBJECT
from simulator.faults.servos import SERVO, SERVOS
from simulator.faults.text import FaultText, parse_fault

VOCABULARY: dict[str, FaultEntry] = {
    entry.name: entry for entry in (*CAN, *UNIT, *TAXELS, *BOARD, *SERVOS, *SERVO, *AXIS, *OBJECT)
}
"""All faults by name; ``servoN`` and ``axisN`` stand for each servo and axis of the config."""

CONTACT_N = 0.5
"""Force in N on both pads at the event ``contact``: a little below the contact force of grippers,
because the first touch may be much earlier."""
MOVING_RAD_S = 0.02
"""Speed of a servo in rad/s at the event ``moving``: about 1 mm/s at the pads."""
_NUMBERED = re.compile(r"(servo|axis)([1-9][0-9]?)\.(.+)")
_EACH = ("servoN", "axisN")
"""First parts of names that stand for each servo, and for each axis, of the config."""


def check_fault(
    text: str, n_servos: int = 2, n_axes: int = 0
) -> tuple[FaultText, FaultEntry, int, FaultValue]:
    """Return the parts of a text, its entry, the position of its device, and its value.

    Raises SimulatorSettingsError if the form of the text, its name, value or moment is wrong.
    """
    parsed = parse_fault(text)
    name, servo = parsed.name, 0
    match = _NUMBERED.fullmatch(name)
    if match:
        servo = int(match[2]) - 1
        name = f"{match[1]}N.{match[3]}"
    entry = VOCABULARY.get(name)
    if entry is None:
        near = get_close_matches(name, VOCABULARY, n=1)
        meant = f"did you mean {near[0].replace('N.', f'{servo + 1}.')}? " if near else ""
        raise SimulatorSettingsError(
            f"there is no fault {parsed.name!r}; {meant}`tactile-cell simulate --list-faults` "
            "lists all"
        )
    if name.startswith("axisN") and servo >= n_axes:
        raise SimulatorSettingsError(f"fault {parsed.name}: this cell has {n_axes} axes")
    if name.startswith("servoN") and servo >= n_servos:
        raise SimulatorSettingsError(f"fault {parsed.name}: this cell has {n_servos} servos")
    if entry.moment and parsed.end_s < math.inf:
        raise SimulatorSettingsError(f"fault {parsed.name} is momentary: leave out its end")
    if entry.value is None:
        if parsed.value is not None:
            raise SimulatorSettingsError(f"fault {parsed.name} takes no value: leave it out")
        return parsed, entry, servo, None
    written = str(entry.value.default) if parsed.value is None else parsed.value
    return parsed, entry, servo, entry.value.read(parsed.name, written)


class InjectedFault:
    """An injected fault: waiting, active, or over."""

    def __init__(self, injector: "FaultInjector", text: str, injected_s: float) -> None:
        self._injector = injector
        devices = injector.devices
        parsed, self.entry, self.servo, self._value = check_fault(
            text, len(devices.settings.servos), len(devices.axes)
        )
        """Entry of the vocabulary, and position of the servo or axis."""
        self.text = parsed.text
        """Text of the injection."""
        self.began_s: float | None = None
        self.ended_s: float | None = None
        """Time of the cell in s at which it began and ended; None before."""
        self.event, self.start_s, self.end_s = parsed.event, parsed.start_s, parsed.end_s
        """Start and end in s after an event; see `simulator.faults.text.FaultText`."""
        self.event_s = math.inf if parsed.event else injected_s
        """Time of the event in s; infinity before."""

    @property
    def value(self) -> float:
        """Its value if that is a number, else NaN."""
        return self._value if isinstance(self._value, float) else math.nan

    @property
    def over(self) -> bool:
        """Whether it has ended; a momentary fault ends at once."""
        return self.ended_s is not None

    def clear(self) -> None:
        """End the fault, or cancel it before its start; a second call has no effect."""
        self._injector.end(self)

    def target(self, devices: CellDevices, plugs: Mapping[str, Plug], now_s: float) -> Target:
        """Return cell, device and value for the fault."""
        return Target(
            devices=devices, plugs=plugs, servo=self.servo, value=self._value, now_s=now_s
        )

    def meets(self, other: "InjectedFault") -> bool:
        """Return whether both use one knob of one device; ``servos`` are each ``servoN``."""
        names = [fault.entry.name for fault in (self, other)]
        one, two = (name.partition(".")[0].rstrip("sN") for name in names)
        apart = self.servo != other.servo and all(name.startswith(_EACH) for name in names)
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
        self._effects: dict[InjectedFault, Effect] = {}
        self.now_s = start_s

    @property
    def faults(self) -> tuple[InjectedFault, ...]:
        """Active and waiting faults."""
        return (*self._effects, *self._pending)

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
        if not fault.event and fault.start_s == 0.0:
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
        fault = InjectedFault(self, text, self.now_s)
        if fault.entry.name.startswith("object."):
            _ = self.devices.physical
        if fault.entry.check is not None:
            fault.entry.check(fault.target(self.devices, self._plugs, self.now_s))
        return fault

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
        effect = self._effects.pop(fault, None)
        if effect is not None:
            effect.undo()
        else:
            self._pending.remove(fault)
        fault.ended_s = self.now_s

    def advance(self, now_s: float) -> None:
        """Begin, continue and end the due faults at ``now_s`` s."""
        self.now_s = now_s
        if not self._pending and not self._effects:
            return
        for fault in self.faults:
            if math.isinf(fault.event_s) and self._happens(fault.event):
                fault.event_s = now_s
            since_s = now_s - fault.event_s + ROUNDING_S
            if fault in self._effects:
                act = self._effects[fault].act
                if act is not None:
                    act(now_s)
            elif fault.start_s <= since_s:
                self._begin(fault, now_s)
            if fault in self._effects and fault.end_s <= since_s:
                self.end(fault)

    def _begin(self, fault: InjectedFault, now_s: float) -> None:
        effect = fault.entry.apply(fault.target(self.devices, self._plugs, now_s))
        fault.began_s = now_s
        if fault in self._pending:
            self._pending.remove(fault)
        if fault.entry.moment:
            fault.ended_s = now_s
        else:
            self._effects[fault] = effect

    def _happens(self, event: str) -> bool:
        devices = self.devices
        if event == "contact":
            return min(devices.world.contact_force_n()) > CONTACT_N
        return any(abs(motor.velocity_rad_s) > MOVING_RAD_S for motor in devices.mechanics.motors)
