"""State of the grip, beside the state of the cell: one table for controller, page and tests.

Names and numbers are those of the grasping state of Weiss WSG grippers, which hosts know.
"""

from enum import StrEnum

from gripper.gripper import GraspResult, GripperPhase


class GraspState(StrEnum):
    """What the fingers do, and how the last grasp ended while they rest."""

    IDLE = "IDLE"
    GRIPPING = "GRIPPING"
    NO_PART_FOUND = "NO PART FOUND"
    PART_LOST = "PART LOST"
    HOLDING = "HOLDING"
    RELEASING = "RELEASING"
    POSITIONING = "POSITIONING"
    ERROR = "ERROR"

    @property
    def number(self) -> int:
        """Number of the state for hosts, 0 to 7."""
        return list(GraspState).index(self)


OF_PHASE = {
    GripperPhase.OFF: GraspState.IDLE,
    GripperPhase.IDLE: GraspState.IDLE,
    GripperPhase.OPENING: GraspState.POSITIONING,
    GripperPhase.APPROACHING: GraspState.GRIPPING,
    GripperPhase.RAMPING: GraspState.GRIPPING,
    GripperPhase.HOLDING: GraspState.HOLDING,
    GripperPhase.BACKING_OFF: GraspState.HOLDING,
    GripperPhase.RELEASING: GraspState.RELEASING,
    GripperPhase.HELD_AFTER_FAULT: GraspState.HOLDING,
}
"""Grasp state of each phase of the gripper, where no fault and no failed grasp says more."""

OF_RESULT = {
    GraspResult.NO_CONTACT: GraspState.NO_PART_FOUND,
    GraspResult.PART_LOST: GraspState.PART_LOST,
}
"""What is shown after a grasp that ended so, until the next command moves the fingers."""


def grasp_state(
    phase: GripperPhase, *, result: GraspResult | None, fault: bool, part_lost: bool
) -> GraspState:
    """Return the state of the grip.

    Parameters
    ----------
    phase
        Phase of the gripper.
    result
        How the last grasp ended; None before the first one and after a release.
    fault
        Whether a fault is latched.
    part_lost
        Whether that fault is the loss of the part.
    """
    if fault:
        return GraspState.PART_LOST if part_lost else GraspState.ERROR
    state = OF_PHASE[phase]
    if state is GraspState.IDLE and result in OF_RESULT:
        return OF_RESULT[result]
    return state
