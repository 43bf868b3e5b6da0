"""A person at a simulated cell: does and types what each question of the wizard asks for."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from cell.commissioning.bench import LineOpener
from cell.commissioning.engine import Answers, Dialog, Limits, Step, Watch, WizardAborted
from cell.commissioning.findings import Notes, ProposedChange
from cell.simulation import open_can_bus, open_servo_port
from gripper.dynamixel.serial_port import ByteStream
from gripper.errors import PortLost
from simulator.cell import SimulatedCell
from simulator.realtime.hands import Hands
from simulator.realtime.process import CellRequests
from tactile.can.bus import CanBus

Reply = str | float | Callable[[], object]
"""An answer, or the hands of the person: called, and the default is answered where None comes."""


class Question(NamedTuple):
    """A question of the wizard, with its choices or the range of its number."""

    key: str
    text: str
    choices: Answers | None
    limits: Limits | None
    default: str | float | None
    watch: Watch


@dataclass
class Script(Dialog):
    """Implements `Dialog`: answers by the keys of the questions, and keeps what was shown.

    A list of replies is used up one by one, its last one stays. A question without a reply takes
    that of ``otherwise``, or its default; one without a default fails the test. ``leave_at`` names
    a question, or ``approve``, at which the person leaves, once.
    """

    replies: Mapping[str, Reply | list[Reply]] = field(default_factory=dict)
    leave_at: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    questions: list[Question] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    writes: list[ProposedChange] = field(default_factory=list)
    findings: dict[str, Notes] = field(default_factory=dict)
    watched: list[str] = field(default_factory=list)
    otherwise: Callable[[Question], str | float | None] = lambda _question: None
    heard: Callable[[str], None] = lambda _text: None
    """Called with each text that is said, and is no question."""
    moment: Callable[[], None] = lambda: None
    """Called at each `live`: time that passes, hands that move."""

    def start_step(self, step: Step, number: int, count: int) -> None:
        assert 1 <= number <= count

    def show(self, step: Step, finding: Notes) -> None:
        self.findings[step.key] = finding

    def say(self, text: str) -> None:
        self.said.append(text)
        self.heard(text)

    def live(self, name: str, value_text: str) -> None:
        self.watched.append(f"{name} {value_text}")
        self.moment()

    def choose(
        self, key: str, text: str, answers: Answers, default: str | None = None, watch: Watch = None
    ) -> str:
        return str(self.ask(Question(key, text, answers, None, default, watch)))

    def number(
        self, key: str, text: str, limits: Limits, default: float | None = None, watch: Watch = None
    ) -> float:
        return float(self.ask(Question(key, text, None, limits, default, watch)))

    def ask(self, question: Question) -> str | float:
        watch = question.watch
        self.asked.append(question.key)
        assert self.asked.count(question.key) < 50, f"asked again and again: {question}"
        self.questions.append(question)
        self.said.append(question.text)
        if question.key in self.leave_at:
            self.leave_at.remove(question.key)
            raise WizardAborted("left")
        if watch is not None:
            self.watched.append(watch())
        reply = self.replies.get(question.key)
        if isinstance(reply, list):
            reply = reply.pop(0) if len(reply) > 1 else reply[0]
        if reply is None:
            reply = self.otherwise(question)
        done = reply() if callable(reply) else reply
        answer = done if isinstance(done, str | float | int) else None
        if watch is not None:
            self.watched.append(watch())
        answer = question.default if answer is None else answer
        assert answer is not None, f"no reply to {question}"
        if question.choices is not None:
            assert answer in question.choices, question
        if question.limits is not None:
            assert question.limits[0] <= float(answer) <= question.limits[1], question
        return answer

    def ask_consent(self, writes: Sequence[ProposedChange]) -> None:
        if "approve" in self.leave_at:
            self.leave_at.remove("approve")
            raise WizardAborted("refused")
        self.writes += writes

    @property
    def text(self) -> str:
        """All that was said."""
        return "\n".join(self.said)


class SimulatedLines(LineOpener):
    """The lines of a simulated cell in virtual time.

    Its serial port has a name, as an adapter that is plugged in; any CAN interface is its bus.
    """

    def __init__(self, cell: SimulatedCell, ports: tuple[str, ...] = ("/dev/ttyUSB0",)) -> None:
        self.cell = cell
        self.clock = cell.clock
        self.ports = ports
        self.opened: list[tuple[str, int]] = []

    def serial_ports(self) -> tuple[str, ...]:
        return self.ports

    def open_serial(self, port: str, baud_rate: int) -> ByteStream:
        if "ACM" in port or "by-path" in port:
            return self.cell.open_board(int(port[-1]))
        if port not in self.ports:
            raise PortLost(f"cannot open serial port {port}")
        self.opened.append((port, baud_rate))
        self.cell.devices.servo_bus.baudrate = baud_rate
        return open_servo_port(self.cell)

    def open_can(self, interface: str, channel: str, bitrate: int) -> CanBus:
        return open_can_bus(self.cell, bitrate)


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
    r"Press (\S+) with a fingertip near the tip and at the (\w+) edge": (r"press \1 tip \2", ""),
    r"Press (\S+) .* towards the other finger and on the (\w+)": (r"press \1 \2 inside", ""),
    r"!Lift the fingertip": ("lift", ""),
    r"!Take the load off": ("lift", ""),
    r"Nothing may touch the pads while": ("empty", ""),
    r"Load \d of \d on (\S+): about (\d+) g": (r"load \1 \2 g", r"\2"),
    r"With which force may it be": ("", "4"),
    r"Take hold of": ("", ""),
    r"Take everything out|Take the part and your hands away": ("empty", ""),
    r"Hold .*between the pads, and keep": ("part", ""),
}
"""The practice with two servos on parallel links."""


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
        self.pressed_n: list[float] = []
        """Force on the soft part in N at each look."""
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

    def typed(self, text: str, *, said: bool = False) -> str:
        """Do what the wizard asks for, or only says; return what is typed."""
        for pattern, (words, typed) in [*self.practice.items(), *PRACTICE.items()]:
            match = re.search(pattern.removeprefix("!"), text)
            if match and said == pattern.startswith("!"):
                self.does(*filter(None, match.expand(words).split("; ")))()
                return match.expand(typed)
        return ""

    def _answer(self, question: Question) -> str | float | None:
        typed = self.typed(question.text)
        if question.limits is not None and typed:
            return float(typed)
        if question.choices is not None and typed:
            return [*question.choices][int(typed) - 1]
        return typed or None

    def heard(self, text: str) -> None:
        """Do what the wizard says."""
        self.typed(text, said=True)

    def moment(self) -> None:
        """Feel the force on the soft part."""
        asked = self.script.asked
        if "first_force.part" in asked and "first_force.empty_again" not in asked:
            self.pressed_n.append(max(self._cell.world.contact_force_n()))
