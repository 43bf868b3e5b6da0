"""The wizard as a person types it, on a pseudo-terminal, with a simulated cell as a process."""

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.pytest_plugin.process import CellProcess
from gripper.dynamixel.serial_port import SerialStream
from tests.cell.commissioning.terminal import Act, Person

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]

WRONG = ("servo1.factory", "servo2.factory", "servo2.turned", "servo1.horn=164")


@pytest.fixture
def cell() -> Iterator[CellProcess]:
    process = CellProcess(changed_config(CellConfig(), {"simulator.faults": list(WRONG)}))
    yield process
    process.end()


class RealHands:
    """Hands at a simulated cell in another process."""

    def __init__(self, cell: CellProcess) -> None:
        self.cell = cell

    def move(self, **half_openings_m: float) -> None:
        self.cell.ask(hand={k.removeprefix("servo"): v for k, v in half_openings_m.items()})
        while self.cell.ask(state=True)["moved_by_hand"]:
            time.sleep(0.05)

    def both(self, half_opening_m: float) -> Act:
        return lambda: self.move(servo1=half_opening_m, servo2=half_opening_m)

    def on_block(self, block_mm: float) -> Act:
        def act() -> None:
            self.both(0.05)()
            self.cell.ask(place=f"box:length=20mm,width=12mm,height={block_mm}mm")
            self.both(0.0)()

        return act

    def close(self) -> None:
        self.cell.ask(remove=True)
        self.both(0.0)()

    def free(self) -> None:
        self.cell.ask(remove=True)
        self.both(0.02)()

    def answers(self) -> dict[str, str | Act]:
        return {
            "Disconnect all servos but one": lambda: self.cell.inject("servo2.off"),
            "Connect the next servo": lambda: self.cell.ask(clear="servo2.off"),
            "Does it drive both": "2",
            "Do this? y": "y",
            "close them by hand": self.close,
            "Open one finger by hand": lambda: self.move(servo1=0.05),
            "open the other one": lambda: self.move(servo2=0.05),
            "about 10 mm": "10",
            "Hold the block of 10 mm": self.on_block(10.0),
            "about 30 mm": "30",
            "Hold the block of 30 mm": self.on_block(30.0),
            "How do the fingers move?": "",
            "Take the block out": self.free,
            "Did each finger open": "1",
        }


def findings(folder: Path) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = json.loads((folder / "commissioning.json").read_text())[
        "steps"
    ]
    return found


def test_new_and_badly_mounted_servos_are_brought_up_with_three_interruptions(
    cell: CellProcess, tmp_path: Path
) -> None:
    hands = RealHands(cell)
    command = ["commission", "box", "--servo-port", cell.servo_port]

    def end() -> None:
        raise StopIteration

    # A person who presses q, then Ctrl-C, then closes the window, then goes on.
    leaves = [{"Do this? y": "q"}, {"about 10 mm": "\x03"}, {"How do the fingers move?": end}]
    for leaving in leaves:
        person = Person(command, tmp_path)
        with contextlib.closing(person):
            code = person.meet(hands.answers() | leaving)
            if code == -1:
                code = person.hang_up()
            assert code == 1, person.text
    person = Person(command, tmp_path)
    with contextlib.closing(person):
        person.meet(hands.answers() | {"CAN": end, "control unit": end})
        text = person.text
    steps = findings(tmp_path / "box")
    assert [steps[key]["status"] for key in ("ports", "servos", "fingers")] == ["pass"] * 3, text
    assert "servo 1: its zero is +16" in text
    assert steps["fingers"]["settings"]["gripper.servos"][1]["direction"] == -1  # type: ignore[index]


def test_a_port_that_another_program_holds_is_named(cell: CellProcess, tmp_path: Path) -> None:
    held = SerialStream(cell.servo_port, 57600)
    person = Person(["commission", "box", "--servo-port", cell.servo_port], tmp_path)
    with contextlib.closing(person):
        assert person.meet({"Ports failed": "2"}) == 1
    held.close()
    assert "is used by another program" in person.text
    assert findings(tmp_path / "box")["ports"]["status"] == "fail"


def test_the_help_names_what_a_person_types(tmp_path: Path) -> None:
    person = Person(["commission", "--help"], tmp_path)
    with contextlib.closing(person):
        assert person.meet({}) == 0
    assert "--restore" in person.text
