"""The practice of the tutorial, typed as it is printed, at real processes."""

import os
import re
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from docs.tools.transcript import TUTORIAL, practice_commands

PROGRAM = (sys.executable, "-P", "-c", "from cell.interfaces.cli import main; main()")
PROMPT = re.compile(r"(q leaves.*>|Do this\? y, or n to leave:)(.*)")
ANCHOR = 120
"""Signs of the text before an event by which it is known."""
WAIT_S = 240.0
"""Longest wait in s for what the wizard says next: a minute of link quality on a busy machine."""
ATTEMPTS = 5
"""Runs of one step: a busy machine makes lines late, and the wizard then has it run again."""


def normal(text: str) -> str:
    """Return a text without blanks and line ends, its figures and folders left out."""
    text = re.sub(r"\S*/sim/", "sim/", text)
    return re.sub(r"[-+]?\d[\d.,]*(?<=\d)", "#", re.sub(r"\s", "", text))


AGAIN = normal(
    "failed. Correct the cause, then run the step again. 1 run the step again (Enter) 2 leave; the "
    "findings are kept q leaves>"
)
ELSEWHERE = (
    # A further serial port of this machine, and fingers that a failed step left with torque.
    normal("no, or another device: leave it alone (Enter) 2 yes, scan it q leaves>"),
    normal("the fingers open when you confirm. 1 done (Enter) q leaves>"),
)
"""Questions beyond the practice, which Enter answers, as they end."""


@dataclass
class Event:
    """What hands do, and what is typed, once the wizard has said something."""

    step: str
    anchor: str
    hands: list[str] = field(default_factory=list)
    typed: str | None = None


def events(transcript: str) -> Iterator[Event]:
    """Yield the events of a transcript in turn."""
    said, hands, step = "", [], ""
    for line in [*transcript.splitlines(), ""]:
        if prompt := PROMPT.fullmatch(line):
            anchor = normal(said + prompt[1])[-ANCHOR:]
            yield Event(step, anchor, hands, prompt[2].strip())
            said, hands = "", []
            continue
        if line.startswith("hands> "):
            hands.append(line.removeprefix("hands> "))
            continue
        if hands:
            yield Event(step, normal(said)[-ANCHOR:], hands)
            said, hands = "", []
        if re.match(r"\d+/\d+ ", line):
            step = line
        said += line


class Process:
    """A command of the tutorial behind pipes."""

    def __init__(self, command: list[str], folder: Path) -> None:
        assert command[0] == "tactile-cell"
        self.process = subprocess.Popen(
            [*PROGRAM, *command[1:]],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=folder,
        )
        self.text = ""

    def type(self, line: str) -> None:
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()

    def read(self, timeout_s: float = 0.2) -> bool:
        """Read what is printed; False at its end."""
        if not select.select([self.process.stdout], [], [], timeout_s)[0]:
            return True
        data = os.read(self.process.stdout.fileno(), 65536)
        self.text += data.decode(errors="replace")
        return bool(data)

    def until(self, end: str) -> str:
        """Return what is printed up to a text, and forget it."""
        end_s = time.monotonic() + WAIT_S
        while not self.text.endswith(end):
            assert self.read(), self.text
            assert time.monotonic() < end_s, self.text
        text, self.text = self.text, ""
        return text

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(20.0)
        for pipe in (self.process.stdin, self.process.stdout):
            pipe.close()


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_practice_of_the_tutorial_is_typed_as_it_is_printed() -> None:
    page = TUTORIAL.read_text("utf-8")
    transcript = re.search(r"<!-- transcript: commission -->\n\n```text\n(.*?)```", page, re.DOTALL)
    told = list(events(transcript[1]))
    simulate, commission, ask = practice_commands()
    with ExitStack() as undo:
        # The path of a socket is short.
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="cell-")))

        def started(command: list[str], end: str = "") -> Process:
            one = Process(command, folder)
            undo.callback(one.close)
            one.until(end)
            return one

        started(simulate, "}\n")
        hands = started(ask, "hands> ")
        wizard = started(commission)
        attempts: dict[str, int] = {}
        done = seen = 0
        end_s = time.monotonic() + WAIT_S
        while wizard.read():
            assert time.monotonic() < end_s, f"{told[done]}\n{wizard.text[-3000:]}"
            printed = normal(wizard.text)
            step = told[min(done, len(told) - 1)].step
            # Once a step has failed, its questions come again.
            again = [at for at, one in enumerate(told) if one.step == step and step in attempts]
            for at in [*range(done, min(done + 1, len(told))), *again]:
                event = told[at]
                found = printed.find(event.anchor, seen)
                if found >= 0 and (event.typed is None or printed.endswith(event.anchor)):
                    break
            else:
                if printed[seen:].endswith(AGAIN):
                    attempts[step] = attempts.get(step, 0) + 1
                    assert attempts[step] < ATTEMPTS, wizard.text[-3000:]
                elif not printed[seen:].endswith(ELSEWHERE):
                    continue
                event, at, found = Event(step, "", typed=""), done - 1, len(printed)
            for words in event.hands:
                hands.type(words)
                answer = hands.until("hands> ")
                assert "error" not in answer, f"{words}: {answer}"
            if event.typed is not None:
                wizard.type(event.typed)
            done, seen = at + 1, found + len(event.anchor)
            end_s = time.monotonic() + WAIT_S
        assert wizard.process.wait(20.0) == 0, wizard.text[-3000:]
    assert done == len(told), told[done]
    end = "Errors found and corrected:"
    assert normal(wizard.text.partition(end)[2]) == normal(transcript[1].partition(end)[2])
