"""The part that is kept in the grip: its force, and whether it is still the same part."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cell.control.journal import Journal
from cell.control.keeping import HELD_LOOK_S, HeldPart, compared, measure_held_part
from cell.control.lifecycle import CellLifecycle
from cell.control.part import Verification
from cell.control.states import Event
from cell.control.watch import MotionWatch
from cell.control.zeroing import BORNE_SHARE
from cell.hand.interface import Hand

_LOSS_DECIDED_S = 0.5
"""Time in s within which the supervision of a hold decides whether a part is lost."""


@dataclass
class KeptPart:
    """Holds a part with the carry force, and measures it."""

    hand: Hand
    life: CellLifecycle
    journal: Journal
    watch: MotionWatch
    wanted_force_n: float
    """``carry_force_n`` of the config; it does not depend on the grip force."""
    _zero: NDArray[np.float64] = field(init=False)
    _then: HeldPart = field(init=False)

    @property
    def force_n(self) -> float:
        """Force in N of a carry, as far as the servos bear it."""
        return min(self.wanted_force_n, BORNE_SHARE * self.hand.largest_ramp_n)

    def hold(self) -> None:
        """Hold the part with the carry force."""
        self.hand.hold_at(self.force_n, 0.0, self.watch.motion)

    def measure(self, zero: NDArray[np.float64]) -> None:
        """Hold the part, and measure it for later comparisons.

        ``zero``: counts of the open fingers, (n_taxels,) float64.
        """
        self._zero = zero
        self._then = self._measure()

    def verify(self) -> Verification:
        """Measure whether the part in the grip is still the kept one; it stays there.

        Raises
        ------
        CellStateError
            If no part is kept.
        CellStopped
            If it was cancelled: the part is then HELD, without force control.
        gripper.errors.PartLost, gripper.errors.PartSlipped
            If the part is gone or slips; this is a fault at any time of a carry.
        """
        with self.life.executing(Event.VERIFY):
            check = compared(self._measure(), self._then)
            if not check.held:
                # A part that has just gone may need longer than the measurement to count as lost.
                self.hand.hold_at(self.force_n, _LOSS_DECIDED_S, self.watch.motion)
                check = compared(self._measure(), self._then)
            self.life.keep(since="answer")
        self.journal.note("verify", "; ".join(check.reasons) or "the same part")
        return check

    def _measure(self) -> HeldPart:
        self.hold()
        collector, watch = self.watch.collecting()
        self.hand.hold_at(self.force_n, HELD_LOOK_S, watch)
        return measure_held_part(collector, self._zero)
