"""The unit's CAN traffic as a DBC file, for the tools of those who listen in.

A frame is one multiplexed message: the index in its header selects the samples that its data are. A
DBC signal cannot run on into another message, so a 16 bit sample that does (a message has 7 bytes
of data) is two signals: its low and its high byte. That a burst belongs together only if its phase,
counter and CRC agree stands in the comments, because a DBC has no other place for it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from tactile.frames.codec import MESSAGE_BYTES, TRAILER, FrameFormat
from tactile.frames.force_message import CENTRE_TAXELS, COUNTERS, FORCE_N, ForceStatus
from tactile.layout import TaxelLayout
from tactile.unit import object_dictionary as od
from tactile.unit.supervision import EMERGENCY_TEXTS, state_name

HOST, UNIT = "Host", "ControlUnit"
FRAME_MESSAGE = "TactileFrame"
_NMT_COMMANDS = {
    1: "start",
    2: "stop",
    128: "enter pre-operational",
    129: "reset node",
    130: "reset communication",
}
"""NMT commands by their names in CiA 301, 7.2.8.2.1; canopen has the names of the states only."""
_NMT_STATES = {state: state_name(state) for state in (0, 4, 5, 127)}
"""States that a heartbeat may have (CiA 301, 7.2.8.3.2)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Signal:
    """One signal of a message."""

    name: str
    """A C identifier."""
    start: int
    size: int
    """Bits; a little-endian signal starts at its lowest bit, a big-endian one at its highest."""
    multiplex: str = ""
    """``M`` for the multiplexer, ``m12`` for what is there only while it is 12, else empty."""
    big_endian: bool = False
    """Whether the high byte comes first."""
    signed: bool = False
    """Whether the raw value is a two's complement."""
    maximum: int | None = None
    """Largest raw value, None for what fits."""
    factor: str = "1"
    """Physical value of one count, as it is to be written."""
    unit: str = ""
    comment: str = ""
    """Text."""
    values: Mapping[int, str] | None = None
    """Names of raw values."""

    def text(self, receivers: str) -> str:
        """Return the signal's line, without a line end."""
        top = (1 << self.size - self.signed) - 1 if self.maximum is None else self.maximum
        bottom = -top - 1 if self.signed else 0
        span = "|".join(f"{raw * float(self.factor):.10g}" for raw in (bottom, top))
        sign = "-" if self.signed else "+"
        order = f"{self.start}|{self.size}@{0 if self.big_endian else 1}{sign}"
        name = f"{self.name} {self.multiplex}".rstrip()
        return f' SG_ {name} : {order} ({self.factor},0) [{span}] "{self.unit}" {receivers}'


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """One message and who sends it."""

    can_id: int
    """Identifier of 11 bits."""
    name: str
    """A C identifier."""
    size: int
    """Bytes of data."""
    sender: str
    """Name of the node."""
    signals: tuple[Signal, ...]
    """What is in it."""
    comment: str
    """Text."""
    period_ms: int = 0
    """Cycle time in ms, 0 where it has none."""


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


def dbc_text(
    layout: TaxelLayout,
    *,
    node_id: int,
    sync_period_ms: int = 0,
    heartbeat_ms: int = 0,
    force_period_ms: int = 0,
) -> str:
    """Return a DBC file of one control unit's traffic, ASCII.

    Parameters
    ----------
    layout
        The taxels; signal ``taxel_012`` is the sample ``counts[12]`` of a `TactileFrame`.
    node_id
        CANopen node-ID of the unit, 1 to 127.
    sync_period_ms, heartbeat_ms
        Periods in ms, written as cycle times; 0 where they are not known.
    force_period_ms
        Period of the force messages in ms, which the frames make room for; 0 for a unit without.
    """
    if not 1 <= node_id <= 127:
        raise ValueError(f"node-ID is {node_id}, must be 1 to 127")
    function = od.COB_TPDO3 if force_period_ms else od.COB_TPDO1
    frame_id = function + node_id
    messages = (
        *_network_messages(node_id, sync_period_ms, heartbeat_ms),
        *_sdo_messages(node_id),
        _frame_message(layout, frame_id),
        *([_force_message(node_id, force_period_ms)] if force_period_ms else []),
    )
    what = f"layout {layout.name}, {layout.n_taxels} taxels, layout hash {layout.layout_hash}"
    return file_text(messages, (HOST, UNIT), f"Tactile control unit: {what}")


def _network_messages(node_id: int, sync_period_ms: int, heartbeat_ms: int) -> tuple[Message, ...]:
    """Return the messages of CiA 301 beside SDO: NMT, SYNC, EMCY, heartbeat."""
    return (
        Message(
            can_id=od.COB_NMT,
            name="NMT",
            size=2,
            sender=HOST,
            signals=(
                Signal(name="nmt_command", start=0, size=8, values=_NMT_COMMANDS),
                Signal(name="nmt_node", start=8, size=8, comment="node-ID, 0 for all"),
            ),
            comment="CANopen network management",
        ),
        Message(
            can_id=od.COB_SYNC,
            name="SYNC",
            size=0,
            sender=HOST,
            signals=(),
            comment="the unit latches one scan of all taxels and sends it as a burst",
            period_ms=sync_period_ms,
        ),
        Message(
            can_id=od.COB_EMCY + node_id,
            name="EMCY",
            size=8,
            sender=UNIT,
            signals=(
                Signal(name="emcy_code", start=0, size=16, values=EMERGENCY_TEXTS),
                Signal(name="emcy_register", start=16, size=8, comment="object 0x1001"),
                Signal(name="emcy_manufacturer", start=24, size=40),
            ),
            comment="emergency; code 0: no error any more",
        ),
        Message(
            can_id=od.COB_HEARTBEAT + node_id,
            name="Heartbeat",
            size=1,
            sender=UNIT,
            signals=(Signal(name="nmt_state", start=0, size=8, values=_NMT_STATES),),
            comment="a boot-up in operation means that the unit has restarted",
            period_ms=heartbeat_ms,
        ),
    )


def _sdo_messages(node_id: int) -> tuple[Message, ...]:
    """Return the SDO channel as far as a DBC can describe it."""
    sdo = (
        Signal(name="sdo_command", start=0, size=8, comment="command specifier and flags"),
        Signal(name="sdo_index", start=8, size=16),
        Signal(name="sdo_subindex", start=24, size=8),
        Signal(name="sdo_data", start=32, size=32, comment="up to 4 bytes, or an abort code"),
    )
    segments = "index and data are those of an initiate; segments have 7 bytes of data instead"
    return (
        Message(
            can_id=od.COB_SDO_RESPONSE + node_id,
            name="SdoResponse",
            size=8,
            sender=UNIT,
            signals=tuple(_renamed(signal, "response") for signal in sdo),
            comment=segments,
        ),
        Message(
            can_id=od.COB_SDO_REQUEST + node_id,
            name="SdoRequest",
            size=8,
            sender=HOST,
            signals=tuple(_renamed(signal, "request") for signal in sdo),
            comment=segments,
        ),
    )


def _renamed(signal: Signal, kind: str) -> Signal:
    return replace(signal, name=signal.name.replace("sdo_", f"sdo_{kind}_"))


def _frame_message(layout: TaxelLayout, frame_id: int) -> Message:
    """Return TPDO1: header with phase and index, samples, and the trailer in the last message."""
    form = FrameFormat.of(layout)
    comment = (
        f"{form.n_messages} messages after each SYNC. They are one frame only if all have the same "
        "phase, the phase is frame_counter modulo 4, and frame_crc is the CRC-16/CCITT-FALSE "
        "(0x1021, start 0xFFFF) of all data before it, headers left out"
    )
    if layout.sample_bits == 16:
        comment += ". A sample cut in two by the end of a message is taxel_N_low + 256 taxel_N_high"
    return Message(
        can_id=frame_id,
        name=FRAME_MESSAGE,
        size=MESSAGE_BYTES,
        sender=UNIT,
        signals=(
            *_header_signals(form, "frame"),
            *_sample_signals(layout, form),
            *_trailer_signals(form),
        ),
        comment=comment,
    )


def _header_signals(form: FrameFormat, kind: str) -> tuple[Signal, ...]:
    phase = Signal(name=f"{kind}_phase", start=6, size=2, comment="frame_counter modulo 4")
    if form.header_bytes == 1:
        index = Signal(name=f"{kind}_index", start=0, size=6, multiplex="M")
    else:
        # High byte first, as the header has it; a DBC counts from the top bit then.
        index = Signal(name=f"{kind}_index", start=5, size=14, multiplex="M", big_endian=True)
    return phase, index


def _sample_signals(layout: TaxelLayout, form: FrameFormat) -> Iterator[Signal]:
    digits = len(str(layout.n_taxels - 1))  # names of one length sort in the order of the taxels
    for pad_index, pad in enumerate(layout.pads):
        first = layout.taxels_of(pad_index).start
        for place in range(pad.n_taxels):
            row, column = divmod(place, pad.columns)
            whole = Signal(
                name=f"taxel_{first + place:0{digits}}",
                start=0,
                size=8 * form.sample_bytes,
                maximum=layout.adc_max,
                unit="count",
                comment=f"{pad.name}, row {row}, column {column}",
            )
            yield from _placed(whole, form, (first + place) * form.sample_bytes)


def _placed(whole: Signal, form: FrameFormat, byte: int) -> Iterator[Signal]:
    """Put a sample at its byte of the burst's data, as two signals where a message ends in it."""
    message, start = _place(form, byte)
    if message == _place(form, byte + form.sample_bytes - 1)[0]:
        yield replace(whole, start=start, multiplex=f"m{message}")
        return
    for part, part_byte in (("low", byte), ("high", byte + 1)):
        message, start = _place(form, part_byte)
        yield Signal(
            name=f"{whole.name}_{part}",
            start=start,
            size=8,
            multiplex=f"m{message}",
            comment=f"{whole.comment}, {part} byte",
        )


def _place(form: FrameFormat, byte: int) -> tuple[int, int]:
    """Return message and start bit of a byte of the burst's data."""
    message, offset = divmod(byte, form.data_bytes)
    return message, 8 * (form.header_bytes + offset)


def _trailer_signals(form: FrameFormat) -> Iterator[Signal]:
    first = form.payload_bytes - TRAILER.size
    parts = (
        ("frame_counter", 0, 16, "number of the scan"),
        ("frame_status", 2, 8, "1 zeroed by the unit, 2 saturated, 4 converter fault, 8 overrun"),
        ("frame_crc", 3, 16, "over all samples, padding, counter and status"),
    )
    for name, offset, size, comment in parts:
        message, start = _place(form, first + offset)
        yield Signal(name=name, start=start, size=size, multiplex=f"m{message}", comment=comment)


def _force_message(node_id: int, period_ms: int) -> Message:
    """Return TPDO2: the force on both gripping pads, on its event timer."""
    pitch = f"{CENTRE_TAXELS:.10g}"
    return Message(
        can_id=od.COB_TPDO2 + node_id,
        name="PadForces",
        size=8,
        sender=UNIT,
        signals=(
            Signal(name="force_counter", start=0, size=4, comment=f"modulo {COUNTERS}"),
            Signal(
                name="force_status",
                start=4,
                size=4,
                comment=", ".join(f"{one.value} {_words(one)}" for one in ForceStatus),
            ),
            *(
                Signal(
                    name=f"force_finger{finger}",
                    start=8 + 16 * finger,
                    size=16,
                    signed=True,
                    factor=f"{FORCE_N:.10g}",
                    unit="N",
                )
                for finger in (0, 1)
            ),
            *(
                Signal(
                    name=f"centre_{way}",
                    start=start,
                    size=8,
                    signed=True,
                    factor=pitch,
                    unit="taxel",
                    comment=f"{way} the fingers from the middle of the pads; -8: nothing touches",
                )
                for way, start in (("along", 40), ("across", 48))
            ),
            Signal(name="force_crc", start=56, size=8, comment="CRC-8 SAE J1850 over bytes 0 to 6"),
        ),
        comment="force on the gripping pads in one scan of them, by the host's table and zero",
        period_ms=period_ms,
    )


def _words(status: ForceStatus) -> str:
    return str(status.name).lower().replace("_", " ")
