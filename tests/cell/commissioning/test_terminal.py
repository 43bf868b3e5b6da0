"""The wizard as a person types it, on a pseudo-terminal, with a simulated cell as a process."""

import contextlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.pytest_plugin.process import CellProcess
from simulator.realtime.hands import Hands
from tests.cell.commissioning.hands import PRACTICE, done, hands_at
from tests.cell.commissioning.terminal import Answer, Person

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]

WRONG = (
    "servo1.factory", "servo2.factory", "servo2.turned", "servo1.horn=164", "unit.pads_swapped",
)  # fmt: skip


@pytest.fixture
def cell() -> Iterator[CellProcess]:
    changes = {
        "simulator.faults": list(WRONG),
        "simulator.noise_level": 0.4,
        "tactile.layout": "pinch",
        "gripper.aperture_open_mm": 30.0,
    }
    process = CellProcess(changed_config(CellConfig(), changes))
    yield process
    process.end()


def typed(hands: Hands) -> dict[str, Answer]:
    """Return what a person does and types."""

    def fail(_match: object) -> None:
        raise AssertionError("a step failed")

    def answer(practice: tuple[str, str], match: re.Match[str]) -> str:
        words, answer = done(match, *practice)
        for one in words:
            hands.do(one)
        return answer

    return {
        "Do this\\? y": "y",
        "What is its name": "ball",
        "failed\\. Mend it": fail,
        **{pattern: partial(answer, practice) for pattern, practice in PRACTICE.items()},
    }


def findings(folder: Path) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = json.loads((folder / "commissioning.json").read_text())[
        "steps"
    ]
    return found


@pytest.mark.real_time
def test_a_cell_of_wrong_hardware_is_brought_up_with_three_interruptions(cell, tmp_path) -> None:
    hands = hands_at(cell)
    # The config of a simulated cell names its ports, and allows for the stalls of its process.
    command = ["commission", "box", "--config", str(cell.config_path)]

    def end(_match: object) -> None:
        raise StopIteration

    # A person who presses q, then Ctrl-C, then closes the window, then goes on.
    leaves: list[dict[str, Answer]] = [
        {"Do this\\? y": "q"},
        {"best about (\\d+) mm thick": "\x03"},
        {"Load \\d of \\d on (\\S+): about (\\d+) g": end},
    ]
    for leaving in leaves:
        with contextlib.closing(Person(command, tmp_path)) as person:
            code = person.meet(typed(hands) | leaving)
            code = person.hang_up() if code == -1 else code
            assert code == 1, person.text
    hands.do("empty")
    with contextlib.closing(Person(command, tmp_path)) as person:
        assert person.meet(typed(hands), timeout_s=120.0) == 0, person.text[-6000:]
    steps = findings(tmp_path / "box")
    assert not [key for key, step in steps.items() if step["status"] == "fail"]
    said = json.dumps(steps)
    assert "servo 1: its horn sits +14" in said
    assert "The pads of the two fingers are exchanged" in said
    config = load_config(tmp_path / "box" / "tactile-cell.yaml")
    assert [servo.direction for servo in config.gripper.servos] == [1, -1]
    check = ["config", "check", "tactile-cell.yaml"]
    with contextlib.closing(Person(check, tmp_path / "box")) as person:
        assert person.meet({}) == 0, person.text


def test_a_person_without_hardware_moves_the_fingers_from_a_second_terminal(cell, tmp_path) -> None:
    folder = Path(cell.positioner_socket).parent
    ask = ["simulate", "--out", str(folder), "--ask"]
    for request, replied in (
        ("open finger 0", "finger 0 59.1 mm from the middle, finger 1 15.0 mm"),
        ('{"remove": true}', '{"removed": true}'),
        ("help", "disconnect servo N"),
        ("open finger 7", "`help` lists all commands"),
        ("press finger0.tip", "there is no pad 'finger0.tip'; there are finger0.inner"),
        ("{hand", "is not valid JSON"),
    ):
        with contextlib.closing(Person([*ask, request], tmp_path)) as person:
            person.meet({})
            assert replied in person.text
    program = "from cell.interfaces.cli import main; main()"
    command = [sys.executable, "-P", "-c", program, *ask, "-"]
    shown = subprocess.run(
        command, input="dance\nclose\n", capture_output=True, text=True, check=True
    )
    assert "'dance' is not a command" in shown.stderr
    assert shown.stdout.startswith("hands> hands> finger 0 0.0 mm from the middle")
