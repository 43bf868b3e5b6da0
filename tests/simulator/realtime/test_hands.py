"""Hands at the simulated cell, by words: each of its help does what it says."""

import re
from typing import Any

import pytest

from simulator.cell import SimulatedCell
from simulator.errors import SimulatorError, SimulatorSettingsError
from simulator.realtime.hands import HELP, Hands
from simulator.realtime.requests import CellRequests


class At:
    """Hands at a cell in virtual time."""

    def __init__(self) -> None:
        self.cell = SimulatedCell()
        self._requests = CellRequests(self.cell.devices, self.cell.injector)
        self.do = Hands(self._requests, self.cell.clock.sleep).do

    @property
    def state(self) -> dict[str, Any]:
        return self._requests({"state": True})

    @property
    def fingers_mm(self) -> list[float]:
        return [round(1e3 * half_m) for half_m in self.state["fingers_m"]]


@pytest.fixture
def at() -> At:
    return At()


def test_fingers_are_moved_and_left(at: At) -> None:
    for words, fingers_mm in (
        ("close", [0, 0]),
        ("open finger 1", [0, 59]),
        ("open", [59, 59]),
        ("half", [30, 30]),
        ("block 12 mm", [6, 6]),
    ):
        assert at.do(words).startswith("finger 0 ")
        assert at.fingers_mm == fingers_mm, words
        assert not at.state["moved_by_hand"]


def test_what_is_between_the_fingers_and_on_the_pads(at: At) -> None:
    assert "between them: ball" in at.do("part")
    assert "between them: box;" in at.do("part box")
    assert "pressed: finger0.inner" in at.do("load finger0.inner 500 g")
    assert at.cell.world.taxel_force_n().sum() == pytest.approx(4.9, abs=0.01)
    assert at.do("lift").endswith("between them: box; pressed: no pad")
    assert at.cell.world.taxel_force_n().sum() == 0.0
    at.do("press finger1.tip")
    assert at.do("empty").endswith("between them: nothing; pressed: no pad")
    assert at.do("disconnect servo 2").endswith("disconnected: servo2")
    assert at.state["faults"].keys() == {"servo2.off"}
    at.do("connect 2")
    assert at.state["faults"] == {}
    assert at.do("help").endswith("finger1.side_b, finger1.tip")


@pytest.mark.parametrize(
    ("where", "row", "column"),
    [
        ("finger0.inner", 8, 2.0),
        ("finger0.inner tip left", 13.5, 3.5),
        ("finger1.inner near tip and right edge", 13.5, 3.5),
        ("finger0.inner base right", 2.5, 0.5),
        ("finger0.outer tip left", 13.5, 3.5),
        ("finger1.side_a tip right", 13.5, 1.5),
        ("finger0.side_b base left", 2.5, 1.5),
        ("finger0.tip left inside", 5, 1.5),
        ("finger1.tip left outside", 1, 0.5),
    ],
)
def test_a_fingertip_is_where_the_words_say(at: At, where: str, row: float, column: float) -> None:
    at.do(f"press {where}")
    layout = at.cell.settings.layout
    force_n = at.cell.world.taxel_force_n()
    number = [pad.name for pad in layout.pads].index(where.split(maxsplit=1)[0])
    pad = layout.pads[number]
    assert set(layout.taxel_pad[force_n > 1e-6]) == {number}
    of_pad = force_n[layout.taxels_of(number)].reshape(pad.rows, pad.columns) / force_n.sum()
    rows, columns = of_pad.sum(1) @ range(pad.rows), of_pad.sum(0) @ range(pad.columns)
    # Middle of a taxel: its number and a half.
    assert (rows + 0.5, columns + 0.5) == pytest.approx((row, column), abs=0.55)


def test_the_help_has_each_word_and_what_is_none_is_refused(at: At) -> None:
    words = re.findall(r"^([a-z]+) ", HELP, re.MULTILINE)
    assert at.do("") == at.do("help")
    for word in words:
        at.do("empty")
        at.do("open")
        plain = {"block": "block 9", "press": "press finger0.tip", "load": "load finger0.tip 9"}
        at.do(plain.get(word, f"{word} 1" if "connect" in word else word))
    for wrong in (
        "dance",
        "block",
        "block ten",
        "open 7",
        "block -3",
        "press finger0.inner up",
        "press 3",
    ):
        with pytest.raises(SimulatorError):
            at.do(wrong)
    with pytest.raises(SimulatorSettingsError, match="`help` lists all commands"):
        at.do("disconnect two")
