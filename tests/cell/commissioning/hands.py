"""A person at a simulated cell: hands at fingers, blocks and plugs, and answers in virtual time."""

import re
import time
from collections.abc import Callable
from typing import Any

from cell.commissioning.law import GRAVITY_N_KG
from cell.pytest_plugin.process import CellProcess
from simulator.cell import SimulatedCell
from simulator.realtime.requests import CellRequests
from tactile.layout import TaxelLayout
from tests.cell.commissioning.script import Reply, Script

WIDE_M = 0.05
"""Half opening in m to which a person opens a finger."""


class Hands:
    """Does what the wizard asks a person for, at a simulated cell of this or another process.

    Parameters
    ----------
    cell
        The cell.
    first
        Number of the servo whose finger is opened first: finger 0.
    """

    def __init__(self, cell: SimulatedCell | CellProcess, first: int = 1) -> None:
        self.first = first
        self._off: set[int] = set()
        self.ask: Callable[..., Any]
        if isinstance(cell, CellProcess):
            self.ask, self._sleep = cell.ask, time.sleep
            self.servos = range(1, 1 + len(cell.servo_ids))
        else:
            requests = CellRequests(cell.devices, cell.injector)
            self.ask, self._sleep = lambda **one: requests(one), cell.clock.sleep
            self.servos = range(1, 1 + len(cell.settings.servos))

    def move(self, **half_openings_m: float) -> None:
        """Move fingers, as ``servo1=0.02``, and wait until they are left."""
        self.ask(hand={name.removeprefix("servo"): m for name, m in half_openings_m.items()})
        while self.ask(state=True)["moved_by_hand"]:
            self._sleep(0.01)

    def all_to(self, half_opening_m: float) -> None:
        self.move(**{f"servo{i}": half_opening_m for i in self.servos})

    def close_on(self, block_mm: float) -> Callable[[], None]:
        def act() -> None:
            self.all_to(WIDE_M)
            self.ask(place=f"box:length=20mm,width=12mm,height={block_mm}mm")
            self.all_to(0.0)

        return act

    def close(self) -> None:
        self.ask(remove=True)
        self.all_to(0.0)

    def free(self) -> None:
        self.ask(remove=True)
        self.all_to(0.02)

    def empty(self) -> None:
        """Take everything out of the fingers, and a fingertip off the pads."""
        self.ask(remove=True)
        self.ask(lift=True)

    def press(self, layout: TaxelLayout, pad: int) -> None:
        """Press a pad near its last row and column."""
        one = layout.pads[pad]
        x_m, y_m = 0.4 * one.rows * one.pitch_x_m, 0.3 * one.columns * one.pitch_y_m
        self.ask(press=pad, x_m=x_m, y_m=y_m, force_n=2.0)

    def load(self, pad: int, force_n: float) -> None:
        """Load the middle of a pad."""
        self.ask(press=pad, x_m=0.0, y_m=0.0, force_n=force_n)

    def connect(self, *numbers: int) -> None:
        """Connect these servos, and no other one."""
        off = set(self.servos) - set(numbers)
        for number in self._off - off:
            self.ask(clear=f"servo{number}.off")
        for number in off - self._off:
            self.ask(inject=f"servo{number}.off")
        self._off = off

    def replies(self) -> dict[str, Reply | list[Reply]]:
        """Return the answers of a person who does all that is asked for."""
        second = 3 - self.first
        return {
            "servos.connect_one": lambda: self.connect(self.first),
            "servos.connect_next": lambda: self.connect(*self.servos),
            "fingers.close": self.close,
            "fingers.open_first": lambda: self.move(**{f"servo{self.first}": WIDE_M}),
            "fingers.open_second": lambda: self.move(**{f"servo{second}": WIDE_M}),
            "fingers.block1": 10.0,
            "fingers.block2": 30.0,
            "fingers.on_block1": self.close_on(10.0),
            "fingers.on_block2": self.close_on(30.0),
            "fingers.free": self.free,
            "fingers.opened": "yes",
        }


class Person:
    """Answers and hands of a person who does all that the wizard asks for.

    Parameters
    ----------
    cell
        The cell.
    presses
        Returns the pad that a fingertip presses for the one that is asked for, None for no press.
    replies
        Other answers, by the keys of the questions, ``__`` for the point.
    """

    def __init__(
        self,
        cell: SimulatedCell,
        *,
        presses: Callable[[int], int | None] = lambda pad: pad,
        **replies: Any,
    ) -> None:
        self._cell = cell
        self._layout = cell.settings.layout
        self.pressed_n = 0.0
        """Largest force on the soft part in N."""
        self._presses = presses
        self.hands = Hands(cell)
        told: dict[str, Any] = {
            f"pads_law.{finger}.{number}": self._load(finger, force_n)
            for finger in (0, 1)
            for number, force_n in enumerate((2.0, 5.0, 8.0), start=1)
        }
        told |= {
            "pads_law.with": self.hands.empty,
            "first_force.most": 4.0,
            "first_force.empty": self.hands.empty,
            "first_force.part": lambda: cell.place("ball") and None,
            "first_force.empty_again": self.hands.empty,
            "baseline.empty": self.hands.empty,
            "baseline.place": lambda: cell.place("ball") and None,
        }
        told |= self.hands.replies()
        told |= {key.replace("__", "."): reply for key, reply in replies.items()}
        self.script = Script(told, moment=self.moment)

    def _load(self, finger: int, force_n: float) -> Callable[[], float]:
        # Whose finger it is, whatever the control unit calls it.
        def reply() -> float:
            pad = self._layout.gripping_pads[finger]
            self.hands.load(pad, force_n)
            return force_n / GRAVITY_N_KG * 1e3

        return reply

    def moment(self) -> None:
        """Press the pad near the corner that was asked for last, or lift the fingertip."""
        asked = self.script.asked
        if "first_force.part" in asked and "first_force.empty_again" not in asked:
            self.pressed_n = max(self.pressed_n, *self._cell.world.contact_force_n())
        last = next((t for t in reversed(self.script.said) if "fingertip" in t), "")
        press = re.match(r"Press (\S+) with", last)
        names = [pad.name for pad in self._layout.pads]
        pad = self._presses(names.index(press[1])) if press else None
        if pad is None:
            self.hands.ask(lift=True)
        else:
            self.hands.press(self._layout, pad)
