"""The text form of a fault: ``COMPONENT.FAULT[=VALUE][@START[..END]]``."""

import re
from dataclasses import dataclass
from enum import StrEnum

from simulator.errors import SimulatorSettingsError

FORM = "COMPONENT.FAULT[=VALUE][@START[..END]]"
LONGEST_TEXT = 200
"""Most characters of a fault."""
_LATEST_S = 86_400.0
"""Longest time in s before a start or an end: a day."""
_TIME = re.compile(r"(?:(contact|moving)\+)?(\d{1,7}(?:\.\d{1,9})?)(ms|s)|(contact|moving)")
_NAME = re.compile(r"[a-z]+[0-9]*\.[a-z_]+")


class FaultEvent(StrEnum):
    """Event that a fault may wait for instead of a time."""

    INJECTED = "injected"
    CONTACT = "contact"
    MOVING = "moving"


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultMoment:
    """A moment: a time after the first event of this kind since the injection."""

    event: FaultEvent
    """The event; INJECTED is the injection itself."""
    offset_s: float
    """Time after it in s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultText:
    """A fault as it was written."""

    text: str
    """The whole text."""
    name: str
    """``component.fault``."""
    value: str | None
    """Text after ``=``; None without a value."""
    start: FaultMoment | None
    end: FaultMoment | None
    """Start and end; None: at once, and never."""


def parse_fault(text: str) -> FaultText:
    """Split a text into its parts; name and value are not checked.

    Raises SimulatorSettingsError if it does not have the form of a fault.
    """
    if not isinstance(text, str) or len(text) > LONGEST_TEXT:
        raise SimulatorSettingsError(f"a fault is a text {FORM} of at most {LONGEST_TEXT} letters")
    stripped = text.strip()
    what, at, window = stripped.partition("@")
    name, equals, value = what.partition("=")
    if not _NAME.fullmatch(name):
        raise SimulatorSettingsError(f"fault {text!r} is not of the form {FORM}")
    start_text, dots, end_text = window.partition("..")
    start = _when(text, start_text) if at else None
    end = _when(text, end_text) if dots else None
    if start and end and start.event is end.event and end.offset_s <= start.offset_s:
        raise SimulatorSettingsError(f"fault {text!r} ends before it begins")
    if equals and not value:
        raise SimulatorSettingsError(f"fault {text!r} has no value after its '='")
    return FaultText(
        text=stripped, name=name, value=value if equals else None, start=start, end=end
    )


def _when(text: str, when: str) -> FaultMoment:
    match = _TIME.fullmatch(when)
    if match is None:
        raise SimulatorSettingsError(
            f"fault {text!r}: {when!r} is not a time; write 2s, 250ms, contact, contact+0.5s, "
            "moving or moving+20ms"
        )
    event, number, unit, alone = match.groups()
    if alone:
        return FaultMoment(event=FaultEvent(alone), offset_s=0.0)
    offset_s = float(number) * (1e-3 if unit == "ms" else 1.0)
    if offset_s > _LATEST_S:
        raise SimulatorSettingsError(f"fault {text!r}: {when} is later than {_LATEST_S:.0f} s")
    return FaultMoment(event=FaultEvent(event) if event else FaultEvent.INJECTED, offset_s=offset_s)
