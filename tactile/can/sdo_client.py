"""SDO client of canopen that waits by the injected clock, not in real time."""

import logging
from collections.abc import Callable

import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from tactile.clock import Clock

_ABORTED = 0x80
"""First byte of an abort, by client or server (CiA 301, 7.2.4.3.17)."""
_SDO_BYTES = 8
_SEGMENT, _SEGMENT_DONE, _UPLOAD, _DONE = range(4)
"""Answers by the top three bits of their first byte (CiA 301, 7.2.4.3)."""
_ABORT_OUT_OF_MEMORY = 0x0504_0005
"""Abort code of a client that accepts no more data."""
_SEGMENT_BYTES = 7
"""Data bytes of a segment."""

MAX_OBJECT_BYTES = 1 << 15
"""Longest allowed object; the longest one is the last frame of a control unit: 413 bytes for 408
taxels."""
COB_SDO_RESPONSE = 0x580
COB_SDO_REQUEST = 0x600
"""Identifiers of the pre-defined connection set (CiA 301, 7.3.5), without the node-ID."""

# Each request that is repeated because its answer was lost is an error there.
logging.getLogger(SdoClient.__module__).setLevel(logging.CRITICAL)


def _used_bytes(first: int) -> int:
    """Return the length of an answer without its unused bytes, by its first byte."""
    kind = first >> 5
    if kind == _SEGMENT:
        return _SDO_BYTES - (first >> 1 & 7)
    if kind == _UPLOAD and first & 3 == 3:  # expedited, with its size
        return _SDO_BYTES - (first >> 2 & 3)
    return {_SEGMENT_DONE: 1, _DONE: 4}.get(kind, _SDO_BYTES)


class SdoNotAnswered(SdoCommunicationError):
    """There was no response in time."""


class PolledSdoClient(SdoClient):
    """canopen's client without the real-time wait of its queue: one thread, real or virtual time.

    Parameters
    ----------
    service
        Processes received messages and calls `on_response` with the responses.
    wait
        Waits for at most a time in s.
    timeout_s
        Longest wait for one response.
    """

    def __init__(
        self,
        *,
        node_id: int,
        dictionary: canopen.ObjectDictionary,
        clock: Clock,
        service: Callable[[], None],
        wait: Callable[[float], None],
        timeout_s: float,
    ) -> None:
        super().__init__(  # type: ignore[no-untyped-call]
            COB_SDO_REQUEST + node_id,
            COB_SDO_RESPONSE + node_id,
            dictionary,
        )
        self._clock = clock
        self._service = service
        self._wait = wait
        self._timeout_s = timeout_s
        self._requests = self._answers = 0

    @property
    def surplus(self) -> int:
        """Number of answers over requests: from a second server, or to another client."""
        return self._answers - self._requests

    def send_request(self, request: bytes | bytearray) -> None:
        """Send a request, or an abort, which has no answer."""
        self._requests += request[0] != _ABORTED
        super().send_request(request)  # type: ignore[no-untyped-call]

    def upload(self, index: int, subindex: int) -> bytes:
        """Return an object's bytes; SdoCommunicationError if it is too long or incomplete.

        canopen's own method reads segments as long as the server announces more of them.
        """
        with self.open(index, subindex, buffering=0) as stream:  # type: ignore[no-untyped-call]
            size: int | None = stream.size
            data = bytearray()
            while piece := stream.read(_SEGMENT_BYTES):
                data += piece
                if len(data) > MAX_OBJECT_BYTES:
                    self.abort(_ABORT_OUT_OF_MEMORY)  # type: ignore[no-untyped-call]
                    raise SdoCommunicationError(f"more than {MAX_OBJECT_BYTES} bytes")
        if size is not None and len(data) != size:
            raise SdoCommunicationError(f"{len(data)} bytes came, {size} were announced")
        variable = self.od.get_variable(index, subindex)
        if variable is None or not variable.fixed_size:
            return bytes(data)
        # Units may send four bytes for a shorter object.
        return bytes(data[: len(variable) // 8])

    def on_response(self, can_id: int, data: bytes | bytearray, timestamp: float) -> None:
        """Process a message of the SDO server; some servers leave out the unused bytes."""
        self._answers += 1
        if data and len(data) >= _used_bytes(data[0]):
            data = bytes(data).ljust(_SDO_BYTES, b"\0")
        super().on_response(can_id, data, timestamp)  # type: ignore[no-untyped-call]

    def read_response(self) -> bytes:
        """Wait for a response; SdoNotAnswered after the time-out; a short one is refused."""
        deadline_s = self._clock.monotonic() + self._timeout_s
        self._service()
        while self.responses.empty():
            left_s = deadline_s - self._clock.monotonic()
            if left_s <= 0.0:
                raise SdoNotAnswered(f"no SDO response within {self._timeout_s:g} s")
            self._wait(left_s)
            self._service()
        response: bytes = self.responses.get_nowait()
        if len(response) != _SDO_BYTES:
            raise SdoCommunicationError(
                f"the answer [{response.hex(' ')}] has {len(response)} bytes, expected 8"
            )
        if response[0] == _ABORTED:
            raise SdoAbortedError(int.from_bytes(response[4:8], "little"))
        return response
