"""A person of the commissioning wizard, scripted; and the lines of a simulated cell."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from cell.checks.findings import Finding, ProposedChange
from cell.commissioning.bench import LineOpener
from cell.commissioning.engine import Dialog, Question, Step, WizardAborted
from cell.simulation import open_can_bus, open_servo_port
from gripper.dynamixel.serial_port import ByteStream
from gripper.errors import PortLost
from simulator.cell import SimulatedCell
from tactile.can.bus import CanBus

Reply = str | float | Callable[[], object]
"""An answer, or the hands of the person: called, and the default is answered where None comes."""


@dataclass
class Script(Dialog):
    """Implements `Dialog`: answers by the keys of the questions, and keeps what was shown.

    A list of replies is used up one by one, its last one stays. A question without a reply takes
    that of ``otherwise``, or its default; one without a default fails the test. ``leave_at`` names
    a question, or ``approve`` or ``approve.STEP``, at which the person leaves, once.
    """

    replies: Mapping[str, Reply | list[Reply]] = field(default_factory=dict)
    leave_at: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    questions: list[Question] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    writes: list[ProposedChange] = field(default_factory=list)
    findings: dict[str, Finding] = field(default_factory=dict)
    watched: list[str] = field(default_factory=list)
    began: list[str] = field(default_factory=list)
    otherwise: Callable[[Question], str | float | None] = lambda _question: None
    heard: Callable[[str], None] = lambda _text: None
    """Called with each text that is said, and is no question."""
    moment: Callable[[], None] = lambda: None
    """Called at each `live`: time that passes, hands that move."""

    def start_step(self, step: Step, number: int, count: int) -> None:
        assert 1 <= number <= count
        self.began.append(step.key)

    def found(self, step: Step, finding: Finding) -> None:
        self.findings[step.key] = finding

    def say(self, text: str) -> None:
        self.said.append(text)
        self.heard(text)

    def live(self, name: str, value_text: str) -> None:
        self.watched.append(f"{name} {value_text}")
        self.moment()

    def ask(self, question: Question, *, watch: Callable[[], str] | None = None) -> str | float:
        self.asked.append(question.key)
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
            assert answer in [choice.key for choice in question.choices], question
        if question.number is not None:
            assert question.number.lowest <= float(answer) <= question.number.highest, question
        return answer

    def approve(self, writes: Sequence[ProposedChange]) -> None:
        for name in ("approve", f"approve.{self.began[-1]}" if self.began else ""):
            if name in self.leave_at:
                self.leave_at.remove(name)
                raise WizardAborted("refused")
        self.writes += writes

    @property
    def text(self) -> str:
        """All that was said and found."""
        return "\n".join([*self.said, *(line for f in self.findings.values() for line in f.lines)])


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

    def open_servos(self, port: str, baud_rate: int) -> ByteStream:
        if port not in self.ports:
            raise PortLost(f"cannot open serial port {port}")
        self.opened.append((port, baud_rate))
        self.cell.devices.servo_bus.baudrate = baud_rate
        return open_servo_port(self.cell)

    def open_board(self, port: str, _baud_rate: int) -> ByteStream:
        return self.cell.open_board(int(port[-1]))

    def open_can(self, interface: str, channel: str, bitrate: int) -> CanBus:
        return open_can_bus(self.cell, bitrate)
