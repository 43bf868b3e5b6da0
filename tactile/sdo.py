"""Object dictionary access to the control unit: canopen's SDO client, waiting by our own clock."""

from collections.abc import Callable
from typing import Any

import can
import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from tactile.clock import Clock
from tactile.errors import NodeMissing
from tactile.receive import interface_failed

_ABORTED = 0x80
_SDO_BYTES = 8
_ABORT_OUT_OF_MEMORY = 0x0504_0005
_SEGMENT_BYTES = 7

MAX_OBJECT_BYTES = 1 << 15
"""Longest object that is read; a unit's longest is its last frame: 413 bytes for 408 taxels."""


class PolledSdoClient(SdoClient):
    """canopen's client without its queue's real-time wait: works in one thread, in any time.

    Parameters
    ----------
    node_id
        The server's node-ID.
    dictionary
        Its object dictionary.
    clock
        Measures the time-out.
    service
        Takes in what was received and calls `on_response` with the responses.
    wait
        Lets time pass, at most so many s.
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
            0x600 + node_id, 0x580 + node_id, dictionary
        )
        self._clock = clock
        self._service = service
        self._wait = wait
        self._timeout_s = timeout_s
        self._requests = self._answers = 0

    @property
    def surplus(self) -> int:
        """Answers that came beyond those that were asked for: of a second server, or client."""
        return self._answers - self._requests

    def send_request(self, request: bytes | bytearray) -> None:
        """Send a request."""
        self._requests += 1
        super().send_request(request)  # type: ignore[no-untyped-call]

    def upload(self, index: int, subindex: int) -> bytes:
        """Return an object's bytes; SdoCommunicationError for one that is endless or incomplete.

        canopen's own method reads segments for as long as the server says that there are more.
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
        # Units may fill up four bytes where the object has fewer.
        return bytes(data[: len(variable) // 8])

    def on_response(self, can_id: int, data: bytes | bytearray, timestamp: float) -> None:
        """Take a message of COB-ID 0x580 + node; one that is not of 8 bytes is no response."""
        if len(data) == _SDO_BYTES:
            self._answers += 1
            super().on_response(can_id, data, timestamp)  # type: ignore[no-untyped-call]

    def read_response(self) -> bytes:
        """Wait for a response; SdoCommunicationError after the time-out."""
        deadline_s = self._clock.monotonic() + self._timeout_s
        self._service()
        while self.responses.empty():
            left_s = deadline_s - self._clock.monotonic()
            if left_s <= 0.0:
                raise SdoCommunicationError(f"no SDO response within {self._timeout_s:g} s")
            self._wait(left_s)
            self._service()
        response: bytes = self.responses.get_nowait()
        if response[0] == _ABORTED:
            raise SdoAbortedError(int.from_bytes(response[4:8], "little"))
        return response


class ObjectAccess:
    """Reads and writes objects by index; repeats what got lost; errors name object and unit.

    Parameters
    ----------
    client
        The SDO client.
    name
        The unit in messages.
    attempts
        How often a transfer is tried when no response comes.
    """

    def __init__(self, client: PolledSdoClient, *, name: str, attempts: int = 3) -> None:
        self._client = client
        self._name = name
        self._attempts = attempts

    def read(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object."""
        data: bytes = self._transfer("read", index, subindex, self._client.upload, ())
        return data

    def read_unsigned(self, index: int, subindex: int = 0) -> int:
        """Return an unsigned integer."""
        return int.from_bytes(self.read(index, subindex), "little")

    def read_text(self, index: int, subindex: int = 0) -> str:
        """Return a visible string."""
        return self.read(index, subindex).rstrip(b"\0").decode("ascii", errors="replace")

    def write_unsigned(self, index: int, subindex: int, value: int, n_bytes: int) -> None:
        """Write an unsigned integer of ``n_bytes`` bytes."""
        data = value.to_bytes(n_bytes, "little")
        self._transfer("write", index, subindex, self._client.download, (data,))

    def _transfer(
        self,
        verb: str,
        index: int,
        subindex: int,
        transfer: Callable[..., Any],
        arguments: tuple[bytes, ...],
    ) -> Any:
        what = f"{verb} of object 0x{index:04X}:{subindex:02X} of {self._name}"
        failure: Exception | None = None
        for _ in range(self._attempts):
            try:
                return transfer(index, subindex, *arguments)
            except SdoCommunicationError as error:
                failure = error
            except SdoAbortedError as error:
                raise NodeMissing(
                    f"{what} was refused ({error}): the unit's firmware does not fit this "
                    "software's EDS"
                ) from error
            except (can.CanError, OSError) as error:
                raise interface_failed(error) from error
        raise NodeMissing(
            f"{what} failed {self._attempts} times: {failure}; check supply, CAN cable and node-ID"
        ) from failure
