"""Walk through a commissioning: its steps in their order."""

from cell.commissioning.engine import Step
from cell.commissioning.fingers import FINGERS
from cell.commissioning.first_force import FIRST_FORCE
from cell.commissioning.pads import LAW, PADS_AT_REST, PADS_PRESSED
from cell.commissioning.ports import PORTS
from cell.commissioning.servos import SERVOS
from cell.commissioning.unit import UNIT


def all_steps() -> tuple[Step, ...]:
    """Return the steps from the box to the first grasp; each comes after the steps it needs."""
    pads = (PADS_AT_REST, PADS_PRESSED, LAW)
    return (PORTS, SERVOS, FINGERS, UNIT, *pads, FIRST_FORCE)
