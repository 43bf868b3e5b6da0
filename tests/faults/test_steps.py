"""The steps after each fault: those of the catalogue lead a faulted cell back to IDLE."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from typing import Any

import pytest

from cell.build import build_cell
from cell.control.plan import Pose
from cell.control.states import CellState
from cell.errors import CellStopped, PartInGrip
from cell.fault_catalogue import BY_NUMBER
from cell.pytest_plugin.virtual import VirtualCell
from tests.faults.campaign import COARSE_PADS, PRODUCT_ERRORS, campaign_config
from tests.faults.table import ROWS

_CHAIN = 3
"""Faults in a row whose steps are taken."""
SHORT = {
    "tactile.layout": COARSE_PADS,
    "gripper.aperture_open_mm": 11.0,
}
"""Few taxels and short ways."""
NUMBERS = {
    "servos.unplugged@contact+0.2s": 101,
    "servos.off@contact+0.2s": 102,
    "servo1.reboot@contact+0.2s": 103,
    "servos.truncated=1@contact+0.2s": 105,
    "servos.bursts=2.3ms@contact+0.2s": 106,
    "servo2.error=16@contact+0.2s": 109,
    "servo2.wrong=current_limit:100": 110,
    "servo2.wrong=id:7": 111,
    "servo1.turn": 112,
    "servo2.watchdog_off": 113,
    "taxels.offset=10@contact+0.1s": 200,
    "servo1.drift=0.3@contact+0.2s": 202,
    "taxels.saturated=1@contact+0.1s": 204,
    "unit.off": 303,
    "unit.wrong=serial:99": 304,
    "unit.heartbeat_off@contact+0.1s": 305,
    "unit.second_node": 306,
    "unit.forces_again@contact+0.1s": 307,
    "unit.second_node@contact+0.1s": 308,
    "unit.emergency=0x5000@contact+0.1s": 310,
    "can.off@contact+0.2s": 311,
    "can.passive@contact": 312,
    "can.loss=1@contact+0.1s": 401,
    "taxels.off=0.3": 405,
    "unit.force_gain=1.6": 407,
}
"""One fault of the simulator for each number that it can bring about, and the number."""
GRASPS = {row.injected: row for row in ROWS if row.scenario is None and not row.real_time}
"""The campaign's faults of one grasp."""
OTHERS = [
    text
    for text in GRASPS
    # An encoder that leapt needs a person who pushes the finger: nobody does so here.
    if text and text not in NUMBERS and ".jump=" not in text
]
"""Those of them that are not listed above."""


@pytest.fixture
def make() -> Iterator[Callable[..., VirtualCell]]:
    """Return the maker of small cells; takes changes of the config."""
    with ExitStack() as undo:

        def build(changes: Mapping[str, Any] | None = None) -> VirtualCell:
            config = campaign_config(SHORT | dict(changes or {}))
            cell = build_cell(config)
            undo.callback(cell.close)
            assert cell.simulated is not None
            return VirtualCell(config=config, cell=cell, simulated=cell.simulated)

        yield build


def take_steps(cell: VirtualCell, number: int) -> None:
    """Do what the catalogue says after a fault; the cause of a simulated one can be mended."""
    controller = cell.controller
    for step in BY_NUMBER[number].steps:
        match step:
            case "mend" | "free_pads":
                cell.simulated.injector.clear_all()
            case "clear" | "clear_reboot":
                controller.clear(reboot=step == "clear_reboot")
            case "release" if controller.state is CellState.RESETTING:
                controller.release_held()
            case "release":
                controller.release()
            case "reset":
                controller.reset()
                controller.start()


def faulted(cell: VirtualCell, injected: str) -> int:
    """Grasp a ball with a fault and return its number; 0 where none is latched."""
    for text in injected.split(", "):
        cell.inject(text)
    with suppress(*PRODUCT_ERRORS):
        cell.start("ball")
        cell.grasp(6.0)
    return cell.controller.status.fault_number


@pytest.mark.parametrize(("injected", "number"), NUMBERS.items(), ids=map(str, NUMBERS.values()))
def test_the_steps_of_a_fault_lead_back_to_idle(make: Any, injected: str, number: int) -> None:
    cell = make(GRASPS[injected].changes)
    assert faulted(cell, injected) == number
    take_steps(cell, number)
    assert cell.controller.state is CellState.IDLE


@pytest.mark.long
@pytest.mark.parametrize("injected", OTHERS)
def test_the_steps_of_each_further_fault_lead_back_to_idle(make: Any, injected: str) -> None:
    """What is mended may show the next fault, as an encoder that leaps: it has its own steps."""
    cell = make(GRASPS[injected].changes)
    number = faulted(cell, injected)
    for _ in range(_CHAIN):
        with suppress(*PRODUCT_ERRORS):
            if number:
                take_steps(cell, number)
        number = cell.controller.status.fault_number
    assert cell.controller.state is CellState.IDLE, cell.controller.fault


@pytest.mark.parametrize(
    ("injected", "number"),
    [
        pytest.param("object.slips=20", 206, marks=pytest.mark.long),
        pytest.param("object.gone", 205),
    ],
)
def test_the_steps_after_a_carry_lead_back_to_idle(make: Any, injected: str, number: int) -> None:
    cell = make()
    cell.start("ball")
    cell.controller.grip(3.0, Pose())
    cell.inject(injected)
    with suppress(*PRODUCT_ERRORS):
        cell.idle(1.0)
    assert cell.controller.status.fault_number == number
    take_steps(cell, number)
    assert cell.controller.state is CellState.IDLE


def test_the_steps_after_a_stop_and_after_a_part_that_was_left_lead_back_to_idle(make: Any) -> None:
    cell = make()
    cell.start("ball")
    cell.clock.on_advance.append(lambda _now_s: cell.grip_n > 1.0 and cell.controller.cancel())
    with pytest.raises(CellStopped):
        cell.grasp(6.0)
    cell.clock.on_advance.pop()
    take_steps(cell, 512)
    assert cell.controller.state is CellState.IDLE
    cell.controller.grip(3.0, Pose())
    cell.controller.shutdown()
    with pytest.raises(PartInGrip):
        cell.controller.start()
    take_steps(cell, 506)
    assert cell.controller.state is CellState.IDLE
