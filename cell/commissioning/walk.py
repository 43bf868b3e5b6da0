"""Walk through a commissioning: its steps in their order."""

from cell.commissioning.axes import AxesStep
from cell.commissioning.baseline import BaselineStep
from cell.commissioning.engine import Step
from cell.commissioning.fingers import FingersStep
from cell.commissioning.first_force import FirstForceStep
from cell.commissioning.law import LawStep
from cell.commissioning.link_quality import LinkQualityStep
from cell.commissioning.pads import PadsAtRestStep, PadsPressedStep
from cell.commissioning.ports import PortsStep
from cell.commissioning.servos import ServosStep
from cell.commissioning.unit import UnitStep


def all_steps() -> tuple[Step, ...]:
    """Return the steps from the box to the first grasp; each comes after the steps it needs."""
    return (
        PortsStep(),
        ServosStep(),
        FingersStep(),
        UnitStep(),
        AxesStep(),
        PadsAtRestStep(),
        PadsPressedStep(),
        LawStep(),
        LinkQualityStep(),
        FirstForceStep(),
        BaselineStep(),
    )
