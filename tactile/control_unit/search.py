"""Search for a control unit: nodes that send, nodes that answer, and identity of a unit.

For commissioning, while the unit is still unknown. Nothing is written to it.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import dataclass

import can
from canopen.network import NodeScanner

from tactile.can.bus import message_source, of_another_kind
from tactile.can.sdo_client import COB_SDO_REQUEST, COB_SDO_RESPONSE, PolledSdoClient
from tactile.control_unit import object_dictionary as od
from tactile.control_unit.node import TactileLink
from tactile.control_unit.settings import LinkSettings, NodeIdentity
from tactile.control_unit.setup import read_identity, written
from tactile.errors import BusOff, NodeMissing
from tactile.layout import paper_layout

_NODES = range(1, 128)
"""Node-IDs that there are (CiA 301, 7.1.1)."""
_READ_DEVICE_TYPE = bytes.fromhex("40 00 10 00 00 00 00 00")
"""SDO request for object 1000h, the device type, which each CANopen node has."""
_ANSWER_S = 0.1
"""Time in s that the last node has for its answer."""
_UNITS = {
    "Synchronous window length": " in us",
    "Communication cycle period": " in us",
    "Producer heartbeat time": " in ms",
    od.FORCES_TIMER: " in ms",
}
"""Units of objects that a start writes (CiA 301, 7.5.2); an EDS has none."""
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


def listen(bus: can.BusABC, duration_s: float) -> BusTraffic:
    """Listen to a bus for ``duration_s`` s; nothing is sent. Raises BusOff as the receiver."""
    return _traffic(bus, duration_s, requests=())


def scan_nodes(bus: can.BusABC) -> BusTraffic:
    """Ask each of the 127 node-IDs for its device type (object 1000h); nothing is written.

    At a wrong bit rate no node acknowledges. An adapter that then refuses to send means: no nodes.
    """
    requests = [
        can.Message(0.0, COB_SDO_REQUEST + node, False, data=_READ_DEVICE_TYPE) for node in _NODES
    ]
    with suppress(BusOff):
        return _traffic(bus, _ANSWER_S, requests)
    return BusTraffic(messages=0, errors=0, nodes=())


def _traffic(bus: can.BusABC, duration_s: float, requests: Sequence[can.Message]) -> BusTraffic:
    """Return what is received while requests are sent, and in a time in s after them."""
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
        messages=len(whole),
        errors=len(received) - len(whole),
        nodes=tuple(sorted(scanner.nodes)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundUnit:
    """Identity and registers that a control unit reports."""

    node_id: int
    """CANopen node-ID."""
    identity: NodeIdentity
    """Identity object, name, and boards of the pads."""
    layout_hash: str
    """Of its taxels; see `tactile.layout.TaxelLayout`."""
    n_taxels: int
    adc_max: int
    """Number of taxels, and full scale of the counts."""
    pad_shapes: tuple[tuple[int, int], ...]
    """Rows and columns of each pad in the order in which it is sent."""
    sends_forces: bool
    """Whether it has force messages."""
    registers: Mapping[str, tuple[str, int]]
    """What a start of the link will write over, by name in the EDS: text, and present value."""


def read_unit(bus: can.BusABC, node_id: int) -> FoundUnit:
    """Read identity and registers of a control unit; nothing is written.

    Raises NodeMissing if the node does not answer, ObjectRefused if it lacks the objects of a
    control unit, and BusOff if the CAN interface fails.
    """
    with _objects_of(bus, node_id) as objects:
        identity = read_identity(objects)
        n_taxels = objects["Taxel layout.Number of taxels"].raw
        shapes = objects["Rows and columns of each pad"].raw
        if len(shapes) % 2:
            raise NodeMissing(
                f"object 2102h of node {node_id} has {len(shapes)} bytes, two for each pad are "
                "expected: the unit's firmware does not fit this software's EDS"
            )
        sends_forces = objects.find(od.FORCE_MESSAGE) is not None
        names = written(LinkSettings(), node_id, forces=sends_forces)
        return FoundUnit(
            node_id=node_id,
            identity=identity,
            layout_hash=objects["Taxel layout.Layout hash"].raw,
            n_taxels=n_taxels,
            adc_max=objects["Taxel layout.Full scale of the counts"].raw,
            pad_shapes=tuple(zip(shapes[::2], shapes[1::2], strict=True)),
            sends_forces=sends_forces,
            registers={
                name: (objects.label(name) + _UNITS.get(name, ""), objects[name].raw)
                for name in names
            },
        )


def read_vendor(bus: can.BusABC, node_id: int) -> tuple[int, int]:
    """Return vendor-ID and product code of a node, which distinguish a control unit from a drive.

    Raises NodeMissing if the node does not answer.
    """
    with _objects_of(bus, node_id) as objects:
        identity = objects["Identity object"]
        return identity["Vendor-ID"].raw, identity["Product code"].raw


def _objects_of(bus: can.BusABC, node_id: int) -> AbstractContextManager[PolledSdoClient]:
    """Return access to the objects of a node, whatever it is; its frames are not looked at."""
    return TactileLink(bus, node_id=node_id, layout=paper_layout()).reading()
