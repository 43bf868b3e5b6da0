"""A CANopen device in the time of the simulation: boot-up, heartbeat, EMCY, SDO, without a bus."""

import logging
import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import canopen
from canopen.nmt import NMT_COMMANDS
from canopen.objectdictionary import ODVariable
from canopen.sdo import constants as sdo
from canopen.sdo.server import SdoServer

_COB_NMT = 0x000
"""Identifier of NMT commands (CiA 301, 7.3.5)."""
_RESETS = ("RESET", "RESET COMMUNICATION")
_CHANGES_OF_STATE = ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL")
"""NMT commands that the node of canopen does not carry out, and those that it does."""
_COMMUNICATION_PROFILE = range(0x1000, 0x2000)
"""Objects that a reset of the communication sets to their defaults (CiA 301)."""

BOOT_S = 0.02
"""Time in s from power-on or reset to the boot-up message."""


_ABORT = struct.Struct("<BHBL")
"""An SDO abort: command, index, sub-index, code."""
_SDO_BYTES = 8
_SPECIFIER_BITS = 0xE0
"""Command specifier in the first byte of an SDO request (CiA 301)."""
_BLOCK_TRANSFERS = (sdo.REQUEST_BLOCK_UPLOAD, sdo.REQUEST_BLOCK_DOWNLOAD)
"""Specifiers of requests that these devices do not have."""
_UPLOADS = (sdo.REQUEST_UPLOAD, sdo.REQUEST_SEGMENT_UPLOAD)
"""Specifiers of requests that change no object."""
# A refusal of the server is an abort for the client, not an error of the simulator.
logging.getLogger(SdoServer.__module__).setLevel(logging.CRITICAL)

SendBurst = Callable[[float, int, list[bytes]], float]
"""Takes the time in s at which messages are ready, their identifier and their data. Sends them in
sequence and returns the end time of the last one in s."""


class DeviceNetwork(canopen.Network):
    """The network of one canopen LocalNode in the time of the simulation: no bus, no thread.

    Takes the messages of the node and keeps its periodic one, the heartbeat. The owner passes
    messages to the node by the rules of NMT.

    Parameters
    ----------
    send
        Takes time in s, identifier and data of each message.
    """

    def __init__(self, send: Callable[[float, int, bytes], None], now_s: float) -> None:
        super().__init__()
        self._send = send
        self._heartbeat, self._period_s = (0, b""), math.inf
        self.next_due_s = math.inf
        """Time in s at which the heartbeat is due, infinity without one."""
        self.now_s = now_s
        """Present time in s; set by the owner."""

    def send_message(self, can_id: int, data: Sequence[int], remote: bool = False) -> None:
        """Send a message now; this device sends no remote frames."""
        self._send(self.now_s, can_id, bytes(data))

    def send_periodic(
        self, can_id: int, data: Sequence[int], period: float, remote: bool = False
    ) -> Any:
        """Send a message every ``period`` s, for the first time after one period."""

        def update(data: Sequence[int]) -> None:
            self._heartbeat = can_id, bytes(data)

        def stop() -> None:
            self.next_due_s = math.inf

        update(data)
        self._period_s, self.next_due_s = period, self.now_s + period
        return SimpleNamespace(update=update, stop=stop)

    def run(self, now_s: float, *, mute: bool) -> None:
        """Send what is due until ``now_s`` s at its own times; ``mute`` skips the sending."""
        while self.next_due_s <= now_s:
            if not mute:
                self._send(self.next_due_s, *self._heartbeat)
            self.next_due_s += self._period_s


class CanopenDevice(ABC):
    """A device on canopen's LocalNode, which serves SDO and makes heartbeat, boot-up and EMCY.

    This class adds services by NMT state, resets, sub-indices of plain variables and values that
    other parts of the device hold. It has no clock, the time is an argument.
    """

    def __init__(self, node_id: int, dictionary: canopen.ObjectDictionary, start_s: float) -> None:
        self.send: SendBurst
        """Sends its messages; set when it is plugged into a bus."""
        self._node_id = node_id
        self._boot_due_s = math.inf
        make: Any = canopen.LocalNode  # most of its interface has no types
        self._node = make(node_id, dictionary)
        self._node.add_read_callback(self._read)
        self._node.add_write_callback(self._write)
        self._network = DeviceNetwork(self._emit, start_s)
        self._node.associate_network(self._network)
        self._values: dict[str, Any] = {}
        """Values that the node does not store, by the name of a variable or of its object in the
        EDS: a value, or a function of the sub-index that returns it."""

    @property
    def nmt_state(self) -> str:
        """NMT state by the names of CiA 301: INITIALISING, PRE-OPERATIONAL, ..."""
        return str(self._node.nmt.state)

    def number(self, name: str | int) -> int:
        """Return the value of an object that is a number."""
        variable = self._node.object_dictionary[name]
        return int(variable.decode_raw(self._node.get_data(variable.index, variable.subindex)))

    def next_event_s(self) -> float:
        """Return when the device next sends something by itself, in s; infinity for never."""
        return min(self._boot_due_s, self._network.next_due_s)

    def receive(self, can_id: int, data: bytes, now_s: float) -> None:
        """Take one message from the bus at ``now_s`` s and answer it."""
        self.advance(now_s)
        if self._silenced() or math.isfinite(self._boot_due_s):
            return
        if can_id == _COB_NMT:
            self._nmt(data)
        elif can_id != self._node.sdo.rx_cobid:
            self._take(can_id, data)
        elif self.nmt_state != "STOPPED" and len(data) == _SDO_BYTES:
            self._serve(data)

    def command(self, name: str, now_s: float) -> None:
        """Carry out the NMT command with a name in ``canopen.nmt.NMT_COMMANDS``."""
        self.receive(_COB_NMT, bytes((NMT_COMMANDS[name], self._node_id)), now_s)

    def _nmt(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in (0, self._node_id):
            return
        if data[0] in map(NMT_COMMANDS.get, _RESETS):
            self._reset(everything=data[0] == NMT_COMMANDS["RESET"])
        elif data[0] in map(NMT_COMMANDS.get, _CHANGES_OF_STATE):
            self._node.nmt.on_command(0, data, self._network.now_s)
            self._changed()

    def _serve(self, request: bytes) -> None:
        """Answer one SDO request."""
        server = self._node.sdo
        known = request[0] & _SPECIFIER_BITS not in _BLOCK_TRANSFERS
        try:
            if known:
                server.on_request(server.rx_cobid, bytearray(request), self._network.now_s)
        except struct.error:
            known = False
        if not known:
            # Its own abort has the object of the last transfer, but there was no transfer.
            _, index, subindex = sdo.SDO_STRUCT.unpack_from(request)
            code = sdo.ABORT_INVALID_COMMAND_SPECIFIER
            abort = _ABORT.pack(sdo.RESPONSE_ABORTED, index, subindex, code)
            self._network.send_message(server.tx_cobid, abort)
        if request[0] & _SPECIFIER_BITS not in _UPLOADS:
            self._changed()

    @abstractmethod
    def _take(self, can_id: int, data: bytes) -> None:
        """Take a message that is neither an NMT command nor an SDO request."""

    @abstractmethod
    def _changed(self) -> None:
        """Carry out the effects of an SDO request or of a change of the NMT state."""

    def power_cycle(self) -> None:
        """Switch the power off and on: all values are defaults; boot-up after the boot."""
        self._reset(everything=True)

    def _reset(self, *, everything: bool) -> None:
        """Restart the communication, or all; the objects of that part go back to their defaults."""
        self._node.nmt.stop_heartbeat()
        for index in list(self._node.data_store):
            if everything or index in _COMMUNICATION_PROFILE:
                del self._node.data_store[index]
        self._boot_due_s = self._network.now_s + BOOT_S

    def advance(self, now_s: float) -> None:
        """Let the time pass until ``now_s`` s: boot-up, heartbeat."""
        if self._boot_due_s <= now_s:
            self._network.now_s = self._boot_due_s
            self._boot_due_s = math.inf
            # canopen sends the boot-up on entering, starts the heartbeat on leaving this state.
            self._node.nmt.state = "INITIALISING"
            self._node.nmt.state = "PRE-OPERATIONAL"
        if self._network.next_due_s <= now_s:
            self._network.run(now_s, mute=self._heartbeat_silenced())
        self._network.now_s = now_s

    def _read(self, *, index: int, subindex: int, od: ODVariable) -> Any:
        del index
        self._check_there(od, subindex)
        value = self._values.get(od.qualname, self._values.get(object_name(od)))
        return value(subindex) if callable(value) else value

    def _write(self, *, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        del index
        self._check_there(od, subindex)
        self._written(od, od.decode_raw(data))

    def _check_there(self, od: ODVariable, subindex: int) -> None:
        if subindex != od.subindex:
            raise canopen.SdoAbortedError(sdo.ABORT_NO_SUBINDEX)

    @abstractmethod
    def _written(self, od: ODVariable, value: Any) -> None:
        """Check a value that the host writes and carry out its effects, before it is stored.

        Raises canopen.SdoAbortedError if it is refused.
        """

    def _heartbeat_silenced(self) -> bool:
        """Return whether a fault keeps the device from sending its heartbeat."""
        return self._silenced()

    @abstractmethod
    def _silenced(self) -> bool:
        """Return whether a fault keeps the device from sending anything."""

    def _emit(self, t_s: float, can_id: int, data: bytes) -> None:
        if not self._silenced():
            self.send(t_s, can_id, [data])


def object_name(od: ODVariable) -> str:
    """Return the name of a variable's object in the EDS, without that of the sub-index."""
    name: str = od.qualname.partition(".")[0]
    return name
