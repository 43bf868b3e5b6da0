"""State of cell and grip at one moment, for hosts that show or forward it."""

from dataclasses import dataclass
from typing import Self

from cell.view import CellView


@dataclass(frozen=True, slots=True, kw_only=True)
class CellStatus:
    """State of cell and grip, at one moment; see docs/states.md.

    Attributes
    ----------
    state, state_number
        PackML name, and number in OPC 30060, StateEnumeration.
    grasp, grasp_number
        State of the grip, and its number.
    holding
        Whether a part may be in the grip.
    fault
        What is wrong, while a fault is latched.
    """

    state: str
    state_number: int
    grasp: str
    grasp_number: int
    holding: bool
    fault: str | None

    @classmethod
    def of(cls, cell: CellView) -> Self:
        """Return how a cell is now."""
        state, grasp = cell.state, cell.grasp_state
        return cls(
            state=state.value,
            state_number=state.number,
            grasp=grasp.value,
            grasp_number=grasp.number,
            holding=cell.holding,
            fault=cell.fault,
        )
