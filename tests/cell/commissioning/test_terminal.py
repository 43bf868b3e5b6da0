"""The wizard as a person types it, on a pseudo-terminal, with a simulated cell as a process."""

import contextlib
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.commissioning.law import GRAVITY_N_KG
from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.pytest_plugin.process import CellProcess
from tactile.layout import pinch_layout
from tests.cell.commissioning.hands import WIDE_M, Hands
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
    """Return what a person types and does."""
    layout = pinch_layout()
    pads = [pad.name for pad in layout.pads]

    def load(match: re.Match[str]) -> str:
        hands.load(pads.index(match[1]), int(match[2]) * 1e-3 * GRAVITY_N_KG)
        time.sleep(0.3)
        return match[2]

    def fail(_match: object) -> None:
        raise AssertionError("a step failed")

    return {
        "Disconnect all servos but one": lambda _: hands.connect(1),
        "Connect the next servo": lambda _: hands.connect(1, 2),
        "Does it drive both": "2",
        "Do this\\? y": "y",
        "close them by hand": lambda _: hands.close(),
        "Open one finger by hand": lambda _: hands.move(servo1=WIDE_M),
        "open the other one": lambda _: hands.move(servo2=WIDE_M),
        "best about (10|30) mm thick": lambda match: match[1],
        "Hold the block of (\\d+) mm": lambda match: hands.close_on(float(match[1]))(),
        "How do the fingers move\\?": "",
        "Take the block out": lambda _: hands.free(),
        "Did each finger open": "1",
        "!Press (\\S+) with a fingertip": lambda match: hands.press(layout, pads.index(match[1])),
        "!Lift the fingertip|Take the load off": lambda _: hands.ask(lift=True),
        "Do you have weights": "1",
        "Load \\d of \\d on (\\S+): about (\\d+) g": load,
        "With which force may it": "4",
        "Take everything out|Take the part away": lambda _: hands.empty(),
        "Hold .*between the pads, (and keep|until)": lambda _: hands.ask(place="ball"),
        "Take hold of the": "",
        "What is its name": "ball",
        "failed\\. Mend it": fail,
    }


def findings(folder: Path) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = json.loads((folder / "commissioning.json").read_text())[
        "steps"
    ]
    return found


@pytest.mark.real_time
def test_a_cell_of_wrong_hardware_is_brought_up_with_three_interruptions(
    cell: CellProcess, tmp_path: Path
) -> None:
    hands = Hands(cell)
    # The config of a simulated cell names its ports, and allows for the stalls of its process.
    command = ["commission", "box", "--config", str(cell.config_path)]

    def end(_match: object) -> None:
        raise StopIteration

    # A person who presses q, then Ctrl-C, then closes the window, then goes on.
    leaves: list[dict[str, Answer]] = [
        {"Do this\\? y": "q"},
        {"best about (10|30) mm thick": "\x03"},
        {"Load \\d of \\d on (\\S+): about (\\d+) g": end},
    ]
    for leaving in leaves:
        with contextlib.closing(Person(command, tmp_path)) as person:
            code = person.meet(typed(hands) | leaving)
            code = person.hang_up() if code == -1 else code
            assert code == 1, person.text
    hands.empty()
    with contextlib.closing(Person(command, tmp_path)) as person:
        assert person.meet(typed(hands), timeout_s=120.0) == 0, person.text[-6000:]
    steps = findings(tmp_path / "box")
    assert not [key for key, step in steps.items() if step["status"] == "fail"]
    said = json.dumps(steps)
    assert "servo 1: its zero is +16" in said
    assert "The pads of the two fingers are exchanged" in said
    config = load_config(tmp_path / "box" / "tactile-cell.yaml")
    assert [servo.direction for servo in config.gripper.servos] == [1, -1]
    one, four = steps["first_force"]["values"]["asked_held_peak_n"]  # type: ignore[index]
    assert one[1] == pytest.approx(1.0, abs=0.2)
    assert four[1] == pytest.approx(4.0, abs=0.3)
    check = ["config", "check", "tactile-cell.yaml"]
    with contextlib.closing(Person(check, tmp_path / "box")) as person:
        assert person.meet({}) == 0, person.text


def test_a_person_without_hardware_moves_the_fingers_from_a_second_terminal(
    cell: CellProcess, tmp_path: Path
) -> None:
    folder = Path(cell.positioner_socket).parent
    ask = ["simulate", "--out", str(folder), "--ask"]
    for request, replied in (
        ('{"hand": {"1": 0.02}}', '{"moving": true}'),
        ('{"remove": true}', '{"removed": true}'),
        ('{"hand": {"7": 0.02}}', "there is no servo 7"),
        ("hand", "is no JSON"),
    ):
        with contextlib.closing(Person([*ask, request], tmp_path)) as person:
            person.meet({})
            assert replied in person.text
