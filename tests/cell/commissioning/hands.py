"""A person at a simulated cell: does and types what each question of the wizard asks for."""

import re
from collections.abc import Callable, Mapping
from typing import Any

from cell.commissioning.engine import Question
from simulator.cell import SimulatedCell
from simulator.realtime.hands import Hands
from simulator.realtime.requests import CellRequests
from tests.cell.commissioning.script import Script

Practice = Mapping[str, tuple[str, str]]
"""What hands do, their words parted by ``;``, and what is typed, by a pattern of what the wizard
says: a question, or with ``!`` before it a sentence behind which nothing is typed."""
PRACTICE: Practice = {
    r"Disconnect all servos but one": ("disconnect servo 2", ""),
    r"Connect the next servo": ("connect servo 2", ""),
    r"Does it drive both fingers": ("", "2"),
    r"close them by hand": ("empty; close", ""),
    r"Open the fingers by hand": ("open", ""),
    r"Open one finger by hand": ("open finger 0", ""),
    r"open the other one": ("open finger 1", ""),
    r"best about (\d+) mm thick": ("", r"\1"),
    r"Hold the block of (\d+) mm": (r"block \1 mm", ""),
    r"How do the fingers move\?": ("", "1"),
    r"Take the block out": ("empty; half", ""),
    r"Did each finger open": ("", "1"),
    r"!Press (\S+) with a fingertip (.+); hold": (r"press \1 \2", ""),
    r"!Lift the fingertip": ("lift", ""),
    r"!Take the load off": ("lift", ""),
    r"Nothing may touch the pads while": ("empty", ""),
    r"Load \d of \d on (\S+): about (\d+) g": (r"load \1 \2 g", r"\2"),
    r"With which force may it be": ("", "4"),
    r"Take hold of": ("", ""),
    r"Take everything out|Take the part and your hands away": ("empty", ""),
    r"Hold .*between the pads, and keep": ("part", ""),
    r"Hold .*between the pads, until": ("part box", ""),
}
"""The practice with two servos on parallel links."""
_PLACES = {"the tip and": "tip", "left": "left", "right": "right", "the other finger": "inside"}
"""Words of the hands for those by which the wizard names a corner of a pad."""


def practised(text: str, *, said: bool, otherwise: Practice) -> tuple[list[str], str]:
    """Return what hands do and what is typed where the wizard asks a text, or only says it."""
    for pattern, (words, typed) in [*otherwise.items(), *PRACTICE.items()]:
        match = re.search(pattern.removeprefix("!"), text)
        if match and said == pattern.startswith("!"):
            hands = match.expand(words)
            if hands.startswith("press "):
                corner = [word for corner, word in _PLACES.items() if corner in hands]
                hands = " ".join([*hands.split()[:2], *corner])
            return [one for one in hands.split("; ") if one], match.expand(typed)
    return [], ""


class Person:
    """Answers and hands of a person who does all that the wizard asks for.

    Parameters
    ----------
    cell
        The cell.
    practice
        What the person does and types otherwise, as `PRACTICE` has it.
    replies
        Other answers, by the keys of the questions, ``__`` for the point.
    """

    def __init__(
        self, cell: SimulatedCell, practice: Practice | None = None, **replies: Any
    ) -> None:
        self._cell = cell
        self.ask = CellRequests(cell.devices, cell.injector)
        self._hands = Hands(self.ask, cell.clock.sleep)
        self.pressed_n = 0.0
        """Largest force on the soft part in N."""
        self.practice = dict(practice or {})
        named = {key.replace("__", "."): reply for key, reply in replies.items()}
        self.script = Script(named, heard=self.heard, moment=self.moment, otherwise=self._answer)
        self.show: Callable[[str], object] = lambda _words: None
        """Called with the words of the hands before they act."""

    def does(self, *words: str) -> Callable[[], None]:
        """Return hands that do something, as a reply."""

        def act() -> None:
            for one in words:
                self.show(one)
                self._hands.do(one)

        return act

    def typed(self, text: str) -> str:
        """Do what the wizard asks for; return what is typed."""
        words, typed = practised(text, said=False, otherwise=self.practice)
        self.does(*words)()
        return typed

    def _answer(self, question: Question) -> str | float | None:
        typed = self.typed(question.text)
        if question.number is not None and typed:
            return float(typed)
        if question.choices is not None and typed:
            return question.choices[int(typed) - 1].key
        return typed or None

    def heard(self, text: str) -> None:
        """Do what the wizard says."""
        words, _ = practised(text, said=True, otherwise=self.practice)
        self.does(*words)()

    def moment(self) -> None:
        """Feel the force on the soft part."""
        asked = self.script.asked
        if "first_force.part" in asked and "first_force.empty_again" not in asked:
            self.pressed_n = max(self.pressed_n, *self._cell.world.contact_force_n())
