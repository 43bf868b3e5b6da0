"""The status of a cell for a host program: its states, live values and the last answer."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cell.control.answer import Answer
from cell.control.states import CellStatus

if TYPE_CHECKING:
    from cell.control.live import LiveValues


@dataclass(frozen=True, slots=True, kw_only=True)
class HostStatus(CellStatus):
    """States of cell and grip, live values and the last answer, for a host."""

    live: "LiveValues" = field(compare=False)
    """Present force, opening, temperature and taxels."""
    recording_fault: str = ""
    """Why the recording has stopped; empty while it is written or without a recording."""
    last_answer: Answer | None
    """Answer of the last identification, also after other jobs. None from the start of the next
    identification or sort until an identification succeeds."""
