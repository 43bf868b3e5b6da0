"""The text of a fault, and the injector that begins and ends faults on a simulated cell.

A text such as ``can.loss=0.05@2s`` or ``servo1.reboot@contact+0.5s`` has the fault, its value and
its start: ``COMPONENT.FAULT[=VALUE][@START[..END]]``. Faults never reach real hardware.
"""

import math
import re
from contextlib import suppress
from difflib import get_close_matches

from simulator.clock import ROUNDING_S
from simulator.devices import CellDevices
from simulator.errors import SimulatorError, SimulatorSettingsError, SimulatorStateError
from simulator.faults.vocabulary import VOCABULARY, Fault, FaultEntry

CONTACT_N = 0.5
"""Force in N on both pads at the event ``contact``: a little below the contact force of grippers,
because the first touch may be much earlier."""
MOVING_RAD_S = 0.02
"""Speed of a servo in rad/s at the event ``moving``: about 1 mm/s at the pads."""
FORM = "COMPONENT.FAULT[=VALUE][@START[..END]]"
LONGEST_TEXT = 200
"""Most characters of a fault."""
_TIME = re.compile(r"(?:(contact|moving)\+)?(\d{1,7}(?:\.\d{1,9})?)(ms|s)|(contact|moving)")
_TEXT = re.compile(r"([a-z]+[0-9]*\.[a-z_]+)(?:=([^@]*))?(?:@(.*?)(?:\.\.(.*))?)?", re.DOTALL)
"""Name, value, start and end of a fault."""
_NUMBERED = re.compile(r"(servo|axis)([1-9][0-9]?)\.(.+)")


def check_fault(text: str, n_servos: int = 2, n_axes: int = 0) -> Fault:
    """Return the fault of a text.

    Raises SimulatorSettingsError if the form of the text, its name, value or moment is wrong.
    """
    if not isinstance(text, str) or len(text) > LONGEST_TEXT:
        raise SimulatorSettingsError(f"a fault is a text {FORM} of at most {LONGEST_TEXT} letters")
    form = _TEXT.fullmatch(text.strip())
    if form is None:
        raise SimulatorSettingsError(f"fault {text!r} is not of the form {FORM}")
    name, written, start, end = form.groups()
    if written == "":
        raise SimulatorSettingsError(f"fault {text!r} has no value after its '='")
    event, start_s = ("", 0.0) if start is None else _when(text, start)
    end_event, end_s = (event, math.inf) if end is None else _when(text, end)
    if event != end_event or end_s <= start_s:
        raise SimulatorSettingsError(
            f"fault {text!r} ends before it begins, or counts both from different events"
        )
    entry, index = _entry(name, n_servos, n_axes)
    if entry.moment and end_s < math.inf:
        raise SimulatorSettingsError(f"fault {name} is momentary: leave out its end")
    value = None
    if entry.value is not None:
        value = entry.value.read(name, written or str(entry.value.default))
    elif written is not None:
        raise SimulatorSettingsError(f"fault {name} takes no value: leave it out")
    return Fault(
        text=text.strip(),
        entry=entry,
        index=index,
        value=value,
        event=event,
        start_s=start_s,
        end_s=end_s,
    )


def _entry(name: str, n_servos: int, n_axes: int) -> tuple[FaultEntry, int]:
    """Return the entry of a name, and the position of its servo or axis."""
    match, general, index = _NUMBERED.fullmatch(name), name, 0
    if match:
        general, index = f"{match[1]}N.{match[3]}", int(match[2]) - 1
    entry = VOCABULARY.get(general)
    if entry is None:
        near = get_close_matches(general, VOCABULARY, n=1)
        meant = f"did you mean {near[0].replace('N.', f'{index + 1}.')}? " if near else ""
        raise SimulatorSettingsError(
            f"there is no fault {name!r}; {meant}`tactile-cell simulate --list-faults` lists all"
        )
    for each, number in (("servo", n_servos), ("axis", n_axes)):
        if general.startswith(f"{each}N") and index >= number:
            raise SimulatorSettingsError(
                f"fault {name}: this cell has no {each} {index + 1}, only {number}"
            )
    return entry, index


def _when(text: str, when: str) -> tuple[str, float]:
    match = _TIME.fullmatch(when)
    if match is None:
        raise SimulatorSettingsError(
            f"fault {text!r}: {when!r} is not a time; write 2s, 250ms, contact, contact+0.5s, "
            "moving or moving+20ms"
        )
    event, number, unit, alone = match.groups()
    return event or alone or "", float(number or 0.0) * (1e-3 if unit == "ms" else 1.0)


class FaultInjector:
    """Begins and ends faults at their times; each step of the world calls `advance`."""

    def __init__(self, devices: CellDevices, start_s: float) -> None:
        self.devices = devices
        self._injected: list[Fault] = []
        self.now_s = start_s

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Active and waiting faults."""
        return tuple([fault for fault in self._injected if not fault.over])

    def inject(self, text: str) -> Fault:
        """Inject a fault; without a start it begins at once.

        Raises SimulatorSettingsError if the text is wrong or does not fit the cell, and
        SimulatorStateError if another fault uses the same knob.
        """
        fault = self._checked(text)
        for other in self.faults:
            if fault.meets(other):
                raise SimulatorStateError(
                    f"{other.text} is injected and uses the same knob as {fault.text}: "
                    "clear it first"
                )
        if not fault.event:
            fault.event_s = self.now_s
        if not fault.event and fault.start_s == 0.0:
            fault.begin(self.now_s)
        self._injected.append(fault)
        return fault

    def kinds(self) -> dict[str, FaultEntry]:
        """Return the possible faults of this cell by name, for each servo and axis."""
        devices, kinds = self.devices, {}
        for entry in VOCABULARY.values():
            each = {"servoN": len(devices.settings.servos), "axisN": len(devices.axes)}
            for number in range(each.get(entry.name.partition(".")[0], 1)):
                name = entry.name.replace("N.", f"{number + 1}.")
                with suppress(SimulatorError):
                    kinds[name] = self._checked(name).entry
        return kinds

    def _checked(self, text: str) -> Fault:
        devices = self.devices
        fault = check_fault(text, len(devices.settings.servos), len(devices.axes))
        fault.devices, fault.now_s = devices, self.now_s
        if fault.owner is not None and fault.entry.check is not None:
            fault.entry.check(fault)
        return fault

    def clear(self, text: str) -> int:
        """End the faults with this text or name; returns their number.

        Raises SimulatorStateError if no fault matches.
        """
        wanted = text.strip()
        matching = [
            fault
            for fault in self.faults
            if wanted in (fault.text, re.split("[=@]", fault.text, maxsplit=1)[0])
        ]
        if not matching:
            there = ", ".join(fault.text for fault in self.faults) or "none"
            raise SimulatorStateError(f"no fault {wanted!r} is injected; injected faults: {there}")
        for fault in matching:
            fault.clear()
        return len(matching)

    def clear_all(self) -> None:
        """End every fault."""
        for fault in self.faults:
            fault.clear()

    def advance(self, now_s: float) -> None:
        """Begin, continue and end the due faults at ``now_s`` s."""
        self.now_s = now_s
        if not self._injected:
            return
        for fault in self.faults:
            if math.isinf(fault.event_s) and self._happens(fault):
                fault.event_s = now_s
            since_s = now_s - fault.event_s + ROUNDING_S
            if fault.began_s is not None:
                if fault.entry.act is not None:
                    fault.entry.act(fault, now_s)
            elif fault.start_s <= since_s:
                fault.begin(now_s)
            if fault.began_s is not None and fault.end_s <= since_s:
                fault.clear()
        self._injected = [fault for fault in self._injected if not fault.over]

    def _happens(self, fault: Fault) -> bool:
        devices = self.devices
        if fault.event == "contact":
            return min(devices.world.contact_force_n()) > CONTACT_N
        if fault.entry.name.startswith("axisN"):
            return bool(fault.owner.moving)
        return any(abs(motor.velocity_rad_s) > MOVING_RAD_S for motor in devices.mechanics.motors)
