"""What a DBC file is made of: messages, signals, comments, value tables; and its text."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Signal:
    """One signal.

    Attributes
    ----------
    name
        A C identifier.
    start, size
        Bits; a little-endian signal starts at its lowest bit, a big-endian one at its highest.
    multiplex
        ``M`` for the multiplexer, ``m12`` for what is there only while it is 12, else empty.
    big_endian
        Whether the high byte comes first.
    maximum
        Largest raw value, None for what fits.
    factor
        Physical value of one count, as it is to be written.
    unit, comment
        Text.
    values
        Names of raw values.
    """

    name: str
    start: int
    size: int
    multiplex: str = ""
    big_endian: bool = False
    maximum: int | None = None
    factor: str = "1"
    unit: str = ""
    comment: str = ""
    values: Mapping[int, str] | None = None

    def text(self, receivers: str) -> str:
        """Return the signal's line, without a line end."""
        top = (1 << self.size) - 1 if self.maximum is None else self.maximum
        maximum = f"{top * float(self.factor):.10g}"
        order = f"{self.start}|{self.size}@{0 if self.big_endian else 1}+"
        name = f"{self.name} {self.multiplex}".rstrip()
        return f' SG_ {name} : {order} ({self.factor},0) [0|{maximum}] "{self.unit}" {receivers}'


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """One message and who sends it.

    Attributes
    ----------
    can_id
        Identifier of 11 bits.
    name
        A C identifier.
    size
        Bytes of data.
    sender
        Name of the node.
    signals
        What is in it.
    comment
        Text.
    period_ms
        Cycle time in ms, 0 where it has none.
    """

    can_id: int
    name: str
    size: int
    sender: str
    signals: tuple[Signal, ...]
    comment: str
    period_ms: int = 0


def file_text(messages: Sequence[Message], nodes: Sequence[str], comment: str) -> str:
    """Return the text of a DBC file; a message is received by the nodes that do not send it."""
    return "\n".join(_lines(messages, nodes, comment))


def _lines(messages: Sequence[Message], nodes: Sequence[str], comment: str) -> Iterator[str]:
    yield 'VERSION ""\n\nNS_ :\n\nBS_:\n'
    yield f"BU_: {' '.join(nodes)}\n"
    for message in messages:
        yield f"BO_ {message.can_id} {message.name}: {message.size} {message.sender}"
        receivers = ",".join(node for node in nodes if node != message.sender)
        yield from (signal.text(receivers) for signal in message.signals)
        yield ""
    yield f'CM_ "{_quoted(comment)}";'
    for message in messages:
        yield f'CM_ BO_ {message.can_id} "{_quoted(message.comment)}";'
        for signal in message.signals:
            if signal.comment:
                yield f'CM_ SG_ {message.can_id} {signal.name} "{_quoted(signal.comment)}";'
    yield 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;'
    yield 'BA_DEF_DEF_ "GenMsgCycleTime" 0;'
    for message in messages:
        if message.period_ms:
            yield f'BA_ "GenMsgCycleTime" BO_ {message.can_id} {message.period_ms};'
    for message in messages:
        for signal in message.signals:
            if signal.values:
                named = " ".join(f'{key} "{_quoted(v)}"' for key, v in signal.values.items())
                yield f"VAL_ {message.can_id} {signal.name} {named} ;"
    yield ""


def _quoted(text: str) -> str:
    """Return a text that can stand between quotes: ASCII, no quotes, no backslash."""
    plain = text.replace('"', "'").replace("\\", "/")
    return plain.encode("ascii", errors="replace").decode("ascii")
