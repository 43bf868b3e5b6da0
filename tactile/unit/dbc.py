"""The unit's CAN traffic as a DBC file, for the tools of those who listen in.

A frame is one multiplexed message: the index in its header selects the samples that its data are. A
DBC signal cannot run on into another message, so a 16 bit sample that does (a message has 7 bytes
of data) is two signals: its low and its high byte. That a burst belongs together only if its phase,
counter and CRC agree stands in the comments, because a DBC has no other place for it.
"""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Any

from cantools.database.can import Database, Message, Node, Signal
from cantools.database.conversion import BaseConversion

from tactile.frames.codec import MESSAGE_BYTES, TRAILER, FrameFormat
from tactile.frames.force_message import CENTRE_TAXELS, COUNTERS, FORCE_N
from tactile.layout import TaxelLayout
from tactile.source import ForceStatus
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


def _signal(
    name: str,
    start: int,
    length: int,
    *,
    maximum: int | None = None,
    values: Mapping[int, str] | None = None,
    factor: float = 1.0,
    signed: bool = False,
    **options: Any,
) -> Signal:
    """Return a signal: little-endian from its lowest bit, with its range as physical values."""
    top = (1 << length - signed) - 1 if maximum is None else maximum
    return Signal(
        name,
        start,
        length,
        is_signed=signed,
        conversion=BaseConversion.factory(factor, 0, OrderedDict(values) if values else None),
        minimum=(-top - 1) * factor if signed else 0,
        maximum=top * factor,
        **options,
    )


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
    messages = [
        *_network_messages(node_id, sync_period_ms, heartbeat_ms),
        *_sdo_messages(node_id),
        _frame_message(layout, frame_id),
        *([_force_message(node_id, force_period_ms)] if force_period_ms else []),
    ]
    for message in messages:
        receiver = UNIT if message.senders == [HOST] else HOST
        for signal in message.signals:
            signal.receivers = [receiver]
    what = f"layout {layout.name}, {layout.n_taxels} taxels, layout hash {layout.layout_hash}"
    unit = Node(UNIT, comment=f"Tactile control unit: {what}")
    text = Database(messages, [Node(HOST), unit], version="").as_dbc_string()
    return text.encode("ascii", errors="replace").decode("ascii")


def _network_messages(node_id: int, sync_period_ms: int, heartbeat_ms: int) -> list[Message]:
    """Return the messages of CiA 301 beside SDO: NMT, SYNC, EMCY, heartbeat."""
    return [
        Message(
            od.COB_NMT,
            "NMT",
            2,
            [
                _signal("nmt_command", 0, 8, values=_NMT_COMMANDS),
                _signal("nmt_node", 8, 8, comment="node-ID, 0 for all"),
            ],
            senders=[HOST],
            comment="CANopen network management",
        ),
        Message(
            od.COB_SYNC,
            "SYNC",
            0,
            [],
            senders=[HOST],
            comment="the unit latches one scan of all taxels and sends it as a burst",
            cycle_time=sync_period_ms,
        ),
        Message(
            od.COB_EMCY + node_id,
            "EMCY",
            8,
            [
                _signal("emcy_code", 0, 16, values=EMERGENCY_TEXTS),
                _signal("emcy_register", 16, 8, comment="object 0x1001"),
                _signal("emcy_manufacturer", 24, 40),
            ],
            senders=[UNIT],
            comment="emergency; code 0: no error any more",
        ),
        Message(
            od.COB_HEARTBEAT + node_id,
            "Heartbeat",
            1,
            [_signal("nmt_state", 0, 8, values=_NMT_STATES)],
            senders=[UNIT],
            comment="a boot-up in operation means that the unit has restarted",
            cycle_time=heartbeat_ms,
        ),
    ]


def _sdo_messages(node_id: int) -> list[Message]:
    """Return the SDO channel as far as a DBC can describe it."""
    ways = (
        ("Response", od.COB_SDO_RESPONSE, UNIT),
        ("Request", od.COB_SDO_REQUEST, HOST),
    )
    return [
        Message(
            cob_id + node_id,
            f"Sdo{way}",
            8,
            [
                _signal(f"sdo_{way.lower()}_{name}", start, size, comment=comment)
                for name, start, size, comment in (
                    ("command", 0, 8, "command specifier and flags"),
                    ("index", 8, 16, None),
                    ("subindex", 24, 8, None),
                    ("data", 32, 32, "up to 4 bytes, or an abort code"),
                )
            ],
            senders=[sender],
            comment="index and data are those of an initiate; segments have 7 bytes of data "
            "instead",
        )
        for way, cob_id, sender in ways
    ]


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
    signals = [*_header_signals(form), *_sample_signals(layout, form), *_trailer_signals(form)]
    return Message(frame_id, FRAME_MESSAGE, MESSAGE_BYTES, signals, senders=[UNIT], comment=comment)


def _header_signals(form: FrameFormat) -> Iterator[Signal]:
    yield _signal("frame_phase", 6, 2, comment="frame_counter modulo 4")
    if form.header_bytes == 1:
        yield _signal("frame_index", 0, 6, is_multiplexer=True)
    else:
        # High byte first, as the header has it; a DBC counts from the top bit then.
        yield _signal("frame_index", 5, 14, is_multiplexer=True, byte_order="big_endian")


def _sample_signals(layout: TaxelLayout, form: FrameFormat) -> Iterator[Signal]:
    digits = len(str(layout.n_taxels - 1))  # names of one length sort in the order of the taxels
    for pad_index, pad in enumerate(layout.pads):
        first = layout.taxels_of(pad_index).start
        for place in range(pad.n_taxels):
            row, column = divmod(place, pad.columns)
            name = f"taxel_{first + place:0{digits}}"
            comment = f"{pad.name}, row {row}, column {column}"
            byte = (first + place) * form.sample_bytes
            if _message_of(form, byte) == _message_of(form, byte + form.sample_bytes - 1):
                size, top = 8 * form.sample_bytes, layout.adc_max
                yield _multiplexed(form, name, byte, size, comment, maximum=top, unit="count")
                continue
            for part, part_byte in (("low", byte), ("high", byte + 1)):
                yield _multiplexed(form, f"{name}_{part}", part_byte, 8, f"{comment}, {part} byte")


def _message_of(form: FrameFormat, byte: int) -> int:
    return byte // form.data_bytes


def _multiplexed(
    form: FrameFormat, name: str, byte: int, size: int, comment: str, **options: Any
) -> Signal:
    """Return a signal at its byte of the burst's data."""
    message, offset = divmod(byte, form.data_bytes)
    return _signal(
        name,
        8 * (form.header_bytes + offset),
        size,
        multiplexer_ids=[message],
        multiplexer_signal="frame_index",
        comment=comment,
        **options,
    )


def _trailer_signals(form: FrameFormat) -> Iterator[Signal]:
    first = form.payload_bytes - TRAILER.size
    parts = (
        ("frame_counter", 0, 16, "number of the scan"),
        ("frame_status", 2, 8, "1 zeroed by the unit, 2 saturated, 4 converter fault, 8 overrun"),
        ("frame_crc", 3, 16, "over all samples, padding, counter and status"),
    )
    for name, offset, size, comment in parts:
        yield _multiplexed(form, name, first + offset, size, comment)


def _force_message(node_id: int, period_ms: int) -> Message:
    """Return TPDO2: the force on both gripping pads, on its event timer."""
    status = ", ".join(f"{one.value} {str(one.name).lower()}" for one in ForceStatus)
    centre = "the fingers from the middle of the pads; -8: nothing touches"
    return Message(
        od.COB_TPDO2 + node_id,
        "PadForces",
        8,
        [
            _signal("force_counter", 0, 4, comment=f"modulo {COUNTERS}"),
            _signal("force_status", 4, 4, comment=status.replace("_", " ")),
            *(
                _signal(f"force_finger{n}", 8 + 16 * n, 16, signed=True, factor=FORCE_N, unit="N")
                for n in (0, 1)
            ),
            *(
                _signal(
                    f"centre_{way}",
                    start,
                    8,
                    signed=True,
                    factor=CENTRE_TAXELS,
                    unit="taxel",
                    comment=f"{way} {centre}",
                )
                for way, start in (("along", 40), ("across", 48))
            ),
            _signal("force_crc", 56, 8, comment="CRC-8 SAE J1850 over bytes 0 to 6"),
        ],
        senders=[UNIT],
        comment="force on the gripping pads in one scan of them, by the host's table and zero",
        cycle_time=period_ms,
    )
