"""Fault knobs of simulated devices: attributes, each declared with the named fault that turns it.

`simulator.faults.vocabulary` collects them.
"""

import math
from dataclasses import dataclass, field
from typing import Any

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
        form = ".0f" if self.whole else "g"
        return (
            f"{self.unit}, {self.low:{form}} to {self.high:{form}}, default {self.default:{form}}"
        )

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


SHARE = Number("share", 0.0, 1.0, default=0.05)
"""Share of the traffic, or of the taxels, with the fault."""
FINGER = Number("finger", 0, 1, default=0, whole=True)
"""Finger of a board; its knob is the set of the fingers that have the fault."""


def knob(name: str, meaning: str, value: Number | None = None, *, off: float = 0.0) -> Any:
    """Return the field of a knob, which the fault ``name`` sets to its value, or to True.

    Without the fault it is ``off``, an empty set for `FINGER`, or False without a value.
    """
    default: object = False
    if value is FINGER:
        default = frozenset[int]()
    elif value is not None:
        default = int(off) if value.whole else off
    return field(default=default, metadata={"name": name, "meaning": meaning, "value": value})
