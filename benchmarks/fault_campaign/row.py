"""What one row of the campaign is, and what was seen of it."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """What the cell did about a fault.

    Attributes
    ----------
    reaction
        REJECT, NOTE, HOLD, LIMP, ABORT, UNKNOWN, or several as ``NOTE, then HOLD``; NOTHING where
        nobody was told.
    detected_after_s
        From the beginning of the fault until the cell knew, in s; None where no time applies.
    outcome
        One line: what the operator is told, and what became of the grip.
    """

    reaction: str
    detected_after_s: float | None
    outcome: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultRow:
    """One fault of the table, or a variant of one.

    Attributes
    ----------
    row
        Number in the table of faults, 1 to 42.
    variant
        What makes it differ from the other rows of this number; may be empty.
    fault
        The fault in plain words.
    injected
        Text of the vocabulary, or how else it is brought about.
    reaction
        What the cell has to do.
    limit_s
        Within which time in s it has to know; None where no time applies.
    run
        Brings the fault about and says what was seen.
    real_time
        Whether it runs real processes in real time.
    """

    row: int
    variant: str = ""
    fault: str
    injected: str
    reaction: str
    limit_s: float | None
    run: Callable[[], Observed]
    real_time: bool = False

    @property
    def name(self) -> str:
        """Number and variant, to find the row by."""
        return (
            f"{self.row:02d}-{self.variant.replace(' ', '-')}"
            if self.variant
            else f"{self.row:02d}"
        )
