"""Walk through a commissioning: its steps in their order."""

from cell.commissioning.engine import Step
from cell.commissioning.fingers import FingersStep
from cell.commissioning.ports import PortsStep
from cell.commissioning.servos import ServosStep


def all_steps() -> tuple[Step, ...]:
    """Return the steps from the box to the first grasp; each stands behind those that it needs."""
    return (PortsStep(), ServosStep(), FingersStep())
