"""The transcript of a commissioning in the tutorial; `make pictures` writes it anew.

The wizard's own terminal asks, on a simulated cell of wrong hardware in virtual time; the hands are
those of the tests. Of a value that runs the last one is shown.
"""

import contextlib
import io
import re
import tempfile
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Engine, Finding, Question, Step, Write
from cell.commissioning.record import write_record
from cell.commissioning.walk import all_steps
from cell.interfaces.cli.dialog import TerminalDialog
from cell.interfaces.cli.terminal import print_line
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from simulator.world.taxels import NoiseModel
from tactile.layout import pinch_layout
from tests.cell.commissioning.hands import Person
from tests.cell.commissioning.script import SimulatedLines

TUTORIAL = Path(__file__).parents[1] / "tutorials" / "hardware.md"
_PLACE = re.compile(r"(<!-- transcript: commission -->\n).*?(<!-- end: commission -->)", flags=re.S)
_WRONG = (
    "servo1.factory",
    "servo2.factory",
    "servo2.turned",
    "servo1.horn=164",
    "unit.pads_swapped",
    "taxels.force_gain=0.8",
)
_WIDTH = 96
"""Characters of a line of the page."""
_BOOT_S = 1.0
"""Time in s after which the simulated servos have booted."""


class _Typing(TerminalDialog):
    """The terminal, with a person of the tests who answers."""

    def __init__(self, person: Person) -> None:
        super().__init__()
        self._script = person.script
        self._watched = ""

    def begin(self, step: Step, number: int, count: int) -> None:
        self._script.begin(step, number, count)
        super().begin(step, number, count)

    def found(self, step: Step, finding: Finding) -> None:
        self._script.found(step, finding)
        super().found(step, finding)

    def say(self, text: str) -> None:
        self._script.said.append(text)
        super().say(text)

    def live(self, name: str, value_text: str) -> None:
        self._watched = f"{name} {value_text}"
        self._script.live(name, value_text)

    def ask(self, question: Question, *, watch: Callable[[], str] | None = None) -> str | float:
        """Print what a terminal prints, and what the person types behind the prompt."""
        self.say(question.text)
        for number, choice in enumerate(question.choices or (), start=1):
            mark = " (Enter)" if choice.key == question.default else ""
            print_line(f"  {number}  {choice.text}{mark}")
        shown = self._script.watched
        answer = self._script.ask(question, watch=watch)
        if watch is not None:
            print_line(shown[-1])
        typed = "" if answer == question.default else f"{answer:.0f}" if question.number else answer
        keys = [choice.key for choice in question.choices or ()]
        if typed in keys:
            typed = keys.index(str(typed)) + 1
        unit = f" in {question.number.unit}" if question.number is not None else ""
        print_line(f"q leaves{unit}> {typed}".rstrip())
        return answer

    def approve(self, writes: Sequence[Write]) -> None:
        """Approve."""
        self._script.approve(writes)
        super().approve(writes)

    def _typed(self, prompt: str, _watch: Callable[[], str] | None = None) -> str:
        print_line(f"{prompt}y")
        return "y"


def transcript() -> str:
    """Return what the terminal shows from the box to the gauge object."""
    settings = SimulatorSettings(
        layout=pinch_layout(), noise=NoiseModel(level=0.4), faults=_WRONG, aperture_m=0.03
    )
    printed = io.StringIO()
    with (
        SimulatedCell(settings) as cell,
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(printed),
    ):
        cell.clock.sleep(_BOOT_S)
        home = Path(folder) / "my-cell"
        given = {"tactile.interface": "socketcan", "tactile.channel": "can0"}
        engine = Engine(
            all_steps(), Bench(home, SimulatedLines(cell), given=given), finish=write_record
        )
        files = engine.run(_Typing(Person(cell)))
        print_line(f"commissioned: {', '.join(map(str, files))}")
        text = printed.getvalue().replace(f"{folder}/", "")
    return text


def _wrapped(line: str) -> str:
    indent = " " * (len(line) - len(line.lstrip()))
    return textwrap.fill(
        line, _WIDTH, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False
    )


def main() -> None:
    """Write the transcript into the tutorial."""
    page = TUTORIAL.read_text(encoding="utf-8")
    shown = "\n".join(_wrapped(line) for line in transcript().strip().splitlines())
    block = f"```text\n$ tactile-cell commission my-cell --can socketcan:can0\n{shown}\n```\n"
    TUTORIAL.write_text(_PLACE.sub(lambda m: f"{m[1]}\n{block}\n{m[2]}", page), encoding="utf-8")


if __name__ == "__main__":
    main()
