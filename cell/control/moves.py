"""Moves of the positioner: the cell is supervised meanwhile, and a stop is obeyed."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from cell.control.journal import Journal
from cell.control.lifecycle import UNTIL_RELEASED, CellLifecycle
from cell.control.plan import Pose
from cell.control.positioner import Destination, PatientCaller, Positioner
from cell.control.states import CellState, Command
from cell.errors import CellStopped, PositionerError

_T = TypeVar("_T")


@dataclass
class Moves:
    """Moves the object, or the gripper around it, with a positioner."""

    life: CellLifecycle
    journal: Journal
    positioner: Positioner
    patient: PatientCaller
    """Makes the calls of a positioner that blocks."""

    def present(self, label: str | None) -> None:
        """Have the positioner bring an object; None: the one to be identified.

        Raises
        ------
        CellStopped
            If it was cancelled during the wait for the object.
        """

        def supervise() -> None:
            self.life.obey_cancel_between()
            self.life.tick()

        self.journal.brought = None
        self._patiently(lambda: self.positioner.present(label, supervise), supervise)
        self.journal.brought = label

    def move_to(self, pose: Pose) -> Pose:
        """Go to a pose with open fingers, as a part of a grasp; return the reached pose."""

        def supervise() -> None:
            self.life.hand.tick()
            self.life.check_cancelled()

        reached = self._patiently(lambda: self.positioner.move_to(pose, supervise), supervise)
        self.journal.pose(reached)
        return reached

    def carry_to(self, destination: Destination) -> None:
        """Have the positioner bring the kept part to a place; the part stays in the grip.

        Raises
        ------
        CellStateError
            If no part is kept.
        CellStopped
            If it was cancelled on the way. The part is still kept.
        PositionerError
            If the place was refused or cannot be reached. The part is still kept.
        PositionerFault
            If an axis is at fault; the cell is ABORTED, the part still kept.
        gripper.errors.PartLost, gripper.errors.PartSlipped
            If the part is gone or slips on the way.
        """
        self.life.check(Command.VERIFY)

        def supervise() -> None:
            self.life.obey_cancel(
                f"on the way to {destination.place}; the part is kept {UNTIL_RELEASED}"
            )
            self.life.tick()

        supervise()
        try:
            self._patiently(lambda: self.positioner.carry_to(destination, supervise), supervise)
        except Exception as error:
            # Failing fingers have latched their fault; a refusal and a stop are no faults.
            refused = isinstance(error, PositionerError | CellStopped)
            if refused or self.life.state is not CellState.COMPLETE:
                raise
            with self.life.latching_faults():
                raise
        self.journal.note("place", f"{destination.label} at {destination.place}")
        supervise()

    def _patiently(self, call: Callable[[], _T], supervise: Callable[[], None]) -> _T:
        made = self.patient.call(call, supervise) if self.positioner.blocks else call()
        self.life.progressed_s = time.monotonic()
        return made
