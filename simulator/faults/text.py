"""The text form of a fault: ``COMPONENT.FAULT[=VALUE][@START[..END]]``."""

import math
import re
from dataclasses import dataclass

from simulator.errors import SimulatorSettingsError

FORM = "COMPONENT.FAULT[=VALUE][@START[..END]]"
LONGEST_TEXT = 200
"""Most characters of a fault."""
_TIME = re.compile(r"(?:(contact|moving)\+)?(\d{1,7}(?:\.\d{1,9})?)(ms|s)|(contact|moving)")
_NAME = re.compile(r"[a-z]+[0-9]*\.[a-z_]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultText:
    """A fault as it was written."""

    text: str
    """The whole text."""
    name: str
    """``component.fault``."""
    value: str | None
    """Text after ``=``; None without a value."""
    event: str
    """``contact`` or ``moving``; empty: the injection."""
    start_s: float
    end_s: float
    """Start and end in s after the first such event since the injection; end infinity: never."""


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
    if equals and not value:
        raise SimulatorSettingsError(f"fault {text!r} has no value after its '='")
    start, dots, end = window.partition("..")
    event, start_s = _when(text, start) if at else ("", 0.0)
    end_event, end_s = _when(text, end) if dots else (event, math.inf)
    if event != end_event or end_s <= start_s:
        raise SimulatorSettingsError(
            f"fault {text!r} ends before it begins, or counts both from different events"
        )
    return FaultText(
        text=stripped,
        name=name,
        value=value if equals else None,
        event=event,
        start_s=start_s,
        end_s=end_s,
    )


def _when(text: str, when: str) -> tuple[str, float]:
    match = _TIME.fullmatch(when)
    if match is None:
        raise SimulatorSettingsError(
            f"fault {text!r}: {when!r} is not a time; write 2s, 250ms, contact, contact+0.5s, "
            "moving or moving+20ms"
        )
    event, number, unit, alone = match.groups()
    return event or alone or "", float(number or 0.0) * (1e-3 if unit == "ms" else 1.0)
