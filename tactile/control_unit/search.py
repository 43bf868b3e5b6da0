"""Search for a control unit: nodes that send, nodes that answer, and identity of a unit.

For commissioning, while the unit is still unknown. Nothing is written to it.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import dataclass

import can
from canopen.network import NodeScanner

from tactile.can.bus import message_source, of_another_kind
from tactile.can.sdo_client import COB_SDO_REQUEST, COB_SDO_RESPONSE, PolledSdoClient
from tactile.control_unit.node import TactileLink
from tactile.errors import BusOff
from tactile.layout import paper_layout

_NODES = range(1, 128)
"""Node-IDs that there are (CiA 301, 7.1.1)."""
_READ_DEVICE_TYPE = bytes.fromhex("40 00 10 00 00 00 00 00")
"""SDO request for object 1000h, the device type, which each CANopen node has."""
_ANSWER_S = 0.1
"""Time in s that the last node has for its answer."""
_GAP_S = 0.001
"""Pause in s between two requests: more than both messages take at 125 kbit/s and one node."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusTraffic:
    """Messages received on a bus."""

    messages: int
    """Whole messages of any kind: the bit rate is right where there is one."""
    errors: int
    """Error frames of the host's controller: the bit rate may be wrong."""
    nodes: tuple[int, ...]
    """Node-IDs of heartbeats, boot-up messages and answers."""


def scan_nodes(bus: can.BusABC) -> BusTraffic:
    """Ask each of the 127 node-IDs for its device type (object 1000h); nothing is written.

    At a wrong bit rate no node acknowledges. An adapter that then refuses to send means: no nodes.
    """
    requests = [
        can.Message(0.0, COB_SDO_REQUEST + node, False, data=_READ_DEVICE_TYPE) for node in _NODES
    ]
    with suppress(BusOff):
        return listen(bus, _ANSWER_S, requests)
    return BusTraffic(messages=0, errors=0, nodes=())


def listen(bus: can.BusABC, duration_s: float, requests: Sequence[can.Message] = ()) -> BusTraffic:
    """Return what is received while requests are sent, and for ``duration_s`` s after them.

    Raises BusOff as the receiver.
    """
    source, scanner = message_source(bus), NodeScanner()
    source.start()
    with closing(source):
        with suppress(can.CanError, OSError):
            for request in requests:
                bus.send(request)
                source.clock.sleep(_GAP_S)
        source.clock.sleep(duration_s)
        received = [message for _, message in source.drain()]
    whole = [message for message in received if not message.is_error_frame]
    for message in whole:
        # Other devices may have the lower identifiers, of PDOs and emergencies.
        if message.arbitration_id >= COB_SDO_RESPONSE and not of_another_kind(message):
            scanner.on_message_received(message.arbitration_id)
    return BusTraffic(
        messages=len(whole), errors=len(received) - len(whole), nodes=tuple(sorted(scanner.nodes))
    )


def objects_of(bus: can.BusABC, node_id: int) -> AbstractContextManager[PolledSdoClient]:
    """Return access to the objects of a node, whatever it is; its frames are not looked at.

    An access raises NodeMissing if the node does not answer, ObjectRefused if it lacks the object,
    and BusOff if the CAN interface fails.
    """
    return TactileLink(bus, node_id=node_id, layout=paper_layout()).reading()
