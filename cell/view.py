"""What a host may look at in a cell: states, fault, grip, and the hand for its statistics."""

from cell.errors import CellStateError
from cell.grasp_states import GraspState
from cell.hand import Hand
from cell.hand_local import LocalHand
from cell.lifecycle import CellLifecycle
from cell.states import CellState
from gripper.gripper import Gripper
from tactile.sensor import TactileSensor


class CellView:
    """A cell as it can be looked at, from any thread; nothing here commands it.

    Parameters
    ----------
    hand, life
        Of the cell.
    """

    def __init__(self, hand: Hand, life: CellLifecycle) -> None:
        self._hand = hand
        self._life = life

    @property
    def state(self) -> CellState:
        """The present state."""
        return self._life.state

    @property
    def grasp_state(self) -> GraspState:
        """The state of the grip, beside that of the cell."""
        return self._life.grasp_state

    @property
    def fault(self) -> str | None:
        """What went wrong, while a fault is latched."""
        return self._life.fault

    @property
    def holding(self) -> bool:
        """Whether a part may be in the grip."""
        return self._life.holding

    @property
    def hand(self) -> Hand:
        """Gripper and sensor, for statistics; commands go through the controller."""
        return self._hand

    @property
    def gripper(self) -> Gripper:
        """The gripper, as `local_hand`."""
        return self.local_hand.gripper

    @property
    def sensor(self) -> TactileSensor:
        """The tactile sensor, as `local_hand`."""
        return self.local_hand.sensor

    @property
    def local_hand(self) -> LocalHand:
        """The hand of a cell whose loop runs in this process, for tests; else CellStateError."""
        if not isinstance(self._hand, LocalHand):
            raise CellStateError("the force loop runs in a process of its own; see `hand`")
        return self._hand
