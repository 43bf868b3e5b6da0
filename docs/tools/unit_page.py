"""The control unit's messages and objects, made from its EDS and from a start of the simulated one.

The bytes are those between this program and the simulated unit on the wire. A firmware can be
compared with them one by one.
"""

import struct
from collections.abc import Iterable, Iterator
from typing import Any

import canopen
import numpy as np

from simulator import simulated_cell
from simulator.can.scanner import BurstFormat, force_bytes
from tactile import open_sensor
from tactile.can.sdo_client import COB_SDO_REQUEST, COB_SDO_RESPONSE
from tactile.control_unit import object_dictionary as od
from tactile.layout import paper_layout
from tactile.source import ForceMessage, ScanStatus

_NODE = 5
"""Node-ID of the simulated unit."""
_REQUEST, _RESPONSE = COB_SDO_REQUEST + _NODE, COB_SDO_RESPONSE + _NODE
_FRAME, _FORCE = od.COB_TPDO3 + _NODE, od.COB_TPDO2 + _NODE
_NMT = {1: "start", 130: "reset communication"}
_STATES = {0: "boot-up", 5: "heartbeat: operational", 127: "heartbeat: pre-operational"}
_FRAME_MESSAGES_SHOWN = 2
_EXPEDITED = 0x02
"""Bit of an SDO initiate: its data stand in the same message."""
_MODES = {"ro": "read", "rw": "read, write", "wo": "write", "const": "read"}
_TYPES = {2: "i8", 3: "i16", 5: "u8", 6: "u16", 7: "u32", 9: "text", 15: "bytes", 26: "u56"}
"""Data types of CiA 301 (table 44) by their code."""

Message = tuple[int, bytes]


def start_log() -> str:
    """Return the messages of a start, one line each: host, unit, meaning; long ones shortened."""
    rows = _rows(_start(_captured()))
    return "".join(f"{host:28}  {unit:28}  {meaning}\n" for host, unit, meaning in rows)


def objects_page() -> str:
    """Return the unit's own objects as a table."""
    dictionary: Any = od.of_node(_NODE)
    rows = ["| object | name | type | the host may | value in the EDS |", "|" + " --- |" * 5]
    for index in sorted(index for index in dictionary if index >= 0x2100):
        entry = dictionary[index]
        plain = isinstance(entry, canopen.objectdictionary.ODVariable)
        for sub in (0,) if plain else range(1, len(entry)):
            one = entry if plain else entry[sub]
            value = "" if one.default is None else one.default
            rows.append(
                f"| {index:04X}h{'' if plain else f':{sub:02X}'} | {_name(index, sub)} "
                f"| {_TYPES[one.data_type]} | {_MODES[one.access_type]} | {value} |"
            )
    return "\n".join(rows)


def vectors_page() -> str:
    """Return frame and force messages with known content, to test a firmware with."""
    form = BurstFormat(paper_layout().n_taxels, sample_bytes=1)
    taxels = (np.arange(form.n_taxels) & 0xFF).astype(np.uint16)
    burst = form.burst(taxels, 0x1235, 0)
    force = ForceMessage(
        t_s=0.0, counter=3, status=ScanStatus.ZEROED, force_n=(1.5, 1.25), centre_taxels=(0.5, -2.0)
    )
    vectors = {
        f"frame of {form.n_taxels} taxels of 8 bit, taxel i = i modulo 256, counter 1235h, status "
        "0: messages 0, 1, 57 and 58": [burst[i] for i in (0, 1, 57, 58)],
        "all taxels 0, counter 0, status 0: message 58": [
            form.burst(np.zeros_like(taxels), 0, 0)[-1]
        ],
        "force message: counter 3, status 1, 1.5 N and 1.25 N, centre half a pitch along and two "
        "pitches back across": [force_bytes(force)],
    }
    rows = (
        f"| {text} | {'<br>'.join(f'`{_hex(one)}`' for one in messages)} |"
        for text, messages in vectors.items()
    )
    return "\n".join(("| content | bytes |", "| --- | --- |", *rows))


def _captured() -> list[Message]:
    with simulated_cell() as sim:
        messages: list[Message] = []
        sim.can_bus.capture.append(lambda _t_s, can_id, data: messages.append((can_id, data)))
        with open_sensor(sim.can_bus) as sensor:
            sensor.read()
    return messages


def _start(messages: Iterable[Message]) -> Iterator[Message]:
    """Yield the messages up to the first frame; of transfers in segments the first one only."""
    frames = segments = 0
    for can_id, data in messages:
        frames += can_id == _FRAME
        if frames > _FRAME_MESSAGES_SHOWN:
            return
        if can_id == _REQUEST:
            segments = segments + 1 if data[0] >> 5 in (0, 3) else 0
        if segments <= 1 or can_id not in (_REQUEST, _RESPONSE):
            yield can_id, data


def _rows(messages: Iterable[Message]) -> Iterator[tuple[str, str, str]]:
    asked, what = "", ""
    for can_id, data in messages:
        line = f"{can_id:03X}: {_hex(data)}"
        if can_id == _REQUEST:
            asked, what = line, _asked(data)
        elif can_id == _RESPONSE:
            yield asked, line, what + _answered(data)
        elif can_id == od.COB_NMT:
            yield line, "", f"NMT: {_NMT[data[0]]}, node {data[1]}"
        elif can_id == od.COB_SYNC:
            yield f"{can_id:03X}:", "", "SYNC"
        elif can_id == _FRAME:
            yield "", line, f"frame, message {data[0] & 0x3F}, phase {data[0] >> 6}"
        else:
            yield "", line, "force message" if can_id == _FORCE else _STATES[data[0]]


def _asked(data: bytes) -> str:
    command = data[0] >> 5
    if command in (0, 3):
        return "first segment of 7 bytes; bit 4 toggles from one to the next"
    index, sub = struct.unpack_from("<HB", data, 1)
    what = f"{index:04X}h:{sub:02X}, {_name(index, sub)}"
    if command == 2:
        return f"read {what}"
    value = int.from_bytes(data[4:], "little")
    return f"write {what}: {value if data[0] & _EXPEDITED else f'{value} bytes, in segments'}"


def _answered(data: bytes) -> str:
    """Return what a response to an upload has, empty for the others."""
    if data[0] >> 5 != 2:
        return ""
    unused = data[0] >> 2 & 3 if data[0] & _EXPEDITED else 0
    value = int.from_bytes(data[4 : 8 - unused], "little")
    return f": {value}" if data[0] & _EXPEDITED else f": {value} bytes, in segments"


def _name(index: int, sub: int) -> str:
    entry: Any = od.of_node(_NODE)[index]
    whole = isinstance(entry, canopen.objectdictionary.ODVariable) or sub not in entry
    return str(entry.name) if whole else f"{entry.name}: {entry[sub].name}"


def _hex(data: bytes) -> str:
    return data.hex(" ").upper()
