"""The transcript of a commissioning beside the tutorial; `make pictures` writes it.

The wizard's own terminal asks in virtual time, at the cell of the tutorial's commands. The hands
are those of `tactile-cell simulate --ask`, moved by the person of the tests.
`tests/cell/commissioning/test_wizard.py` compares the file with it.
"""

import contextlib
import io
import re
import shlex
import tempfile
import textwrap
from collections.abc import Callable
from pathlib import Path

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Engine
from cell.commissioning.walk import all_steps
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.interfaces.cli.commands.commission import TerminalDialog
from cell.interfaces.cli.terminal import print_line
from cell.runtime.simulate import client_config
from cell.simulation import simulation_of
from tests.cell.commissioning.hands import Person, SimulatedLines

TUTORIAL = Path(__file__).parents[1] / "tutorials" / "hardware.md"
TRANSCRIPT = Path(__file__).parents[1] / "examples" / "commissioning.txt"
_COMMANDS = re.compile(r"(?<=<!-- practice -->\n\n```sh\n).*?(?=```)", flags=re.S)
_FOUND = {
    "servo_port": ".../sim/servos",
    "can_interface": "slcan",
    "can_channel": ".../sim/can",
    "positioner_socket": ".../sim/positioner.sock",
    "axes_can_channel": None,
    "axes_ports": {},
}
"""What the simulated cell announces, as the transcript shows it."""
_WIDTH = 96
"""Characters of a line of the file."""
_BOOT_S = 1.0
"""Time in s after which the simulated servos have booted."""


class _Typing(TerminalDialog):
    """The terminal, with a person of the tests who types."""

    def __init__(self, person: Person) -> None:
        super().__init__()
        self._person = person
        self._asked = ""
        person.show = lambda words: print_line(f"hands> {words}")

    def say(self, text: str) -> None:
        """Print a text; the hands do it."""
        super().say(text)
        self._person.heard(text)
        self._asked = text

    def _typed(self, prompt: str, watch: Callable[[], str] | None = None) -> str:
        typed = "y" if prompt.startswith("Do this") else self._person.typed(self._asked)
        print_line(f"{prompt}{typed}".rstrip())
        if watch is not None:
            watch()
        return typed


def practice_commands() -> list[list[str]]:
    """Return the commands of the practice in the tutorial: the cell, the wizard, the hands."""
    match = _COMMANDS.search(TUTORIAL.read_text(encoding="utf-8"))
    assert match is not None
    return [shlex.split(line) for line in match[0].splitlines()]


def transcript() -> str:
    """Return the terminal's text from the first step to the first force."""
    simulate, *_ = practice_commands()
    faults = [simulate[at + 1] for at, word in enumerate(simulate) if word == "--fault"]
    config = changed_config(CellConfig(), {"simulator.faults": faults})
    base = client_config(config, _FOUND)
    given = {
        "gripper.port": base.gripper.port,
        "tactile.interface": base.tactile.interface,
        "tactile.channel": base.tactile.channel,
    }
    printed = io.StringIO()
    with (
        simulation_of(config) as cell,
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(printed),
    ):
        cell.clock.sleep(_BOOT_S)
        lines = SimulatedLines(cell, ports=(base.gripper.port,))
        bench = Bench(Path(folder) / "my-cell", lines, given=given, base=base)
        engine = Engine(all_steps(), bench)
        dialog = _Typing(Person(cell, {r"With which force may it be": ("", "")}))
        dialog.finished(engine, engine.run(dialog))
        text = printed.getvalue().replace(f"{folder}/", "")
    return text


def _wrapped(line: str) -> str:
    indent = " " * (len(line) - len(line.lstrip()))
    if len(line) <= _WIDTH:
        return line
    return textwrap.fill(
        line, _WIDTH, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False
    )


def main() -> None:
    """Write the file that the tutorial links to."""
    text = "\n".join(_wrapped(line) for line in transcript().strip().splitlines())
    command = shlex.join(practice_commands()[1])
    TRANSCRIPT.write_text(f"$ {command}\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
