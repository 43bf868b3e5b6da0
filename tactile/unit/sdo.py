"""Object dictionary access to the control unit: canopen's SDO client, waiting by our own clock."""

from collections.abc import Callable
from typing import Any

import can
import canopen
import numpy as np
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError
from numpy.typing import NDArray

from tactile.can.receiver import interface_failed
from tactile.clock import Clock
from tactile.errors import FrameError, NodeMissing, TareRefused
from tactile.layout import TaxelLayout
from tactile.unit import object_dictionary

_ABORTED = 0x80
"""First byte of a response that aborts the transfer (CiA 301, 7.2.4.3.17)."""
_SDO_BYTES = 8
_ABORT_OUT_OF_MEMORY = 0x0504_0005
"""Abort code of a client that takes no more."""
_SEGMENT_BYTES = 7
"""Data bytes of a segment."""

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
            object_dictionary.COB_SDO_REQUEST + node_id,
            object_dictionary.COB_SDO_RESPONSE + node_id,
            dictionary,
        )
        self._clock = clock
        self._service = service
        self._wait = wait
        self._timeout_s = timeout_s
        self._requests = self._answers = 0

    @property
    def surplus(self) -> int:
        """Answers beyond the number of requests: those of a second server, or to another client."""
        return self._answers - self._requests

    def send_request(self, request: bytes | bytearray) -> None:
        """Send a request."""
        self._requests += 1
        super().send_request(request)  # type: ignore[no-untyped-call]

    def upload(self, index: int, subindex: int) -> bytes:
        """Return an object's bytes; SdoCommunicationError for one that is endless or incomplete.

        canopen's own method reads segments for as long as the server announces more of them.
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
        """Take a message of the SDO server; one that is not of 8 bytes is no response."""
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


_REFUSALS = {
    int(object_dictionary.TareResult.REFUSED_TOUCHED): "a taxel was touched",
    int(object_dictionary.TareResult.REFUSED_SPREAD): "the counts moved while the zero was taken",
}
"""Results of the unit's own tare in words."""


def take_unit_tare(
    objects: ObjectAccess, *, clock: Clock, pump: Callable[[], None], timeout_s: float
) -> None:
    """Let the unit take its own zero and wait for the result.

    Parameters
    ----------
    objects
        The unit's objects.
    clock
        Measures the time-out.
    pump
        Called between two looks at the result; lets time pass and frames run.
    timeout_s
        Longest wait in s.

    Raises
    ------
    TareRefused
        When the unit refuses, or does not come to an end.
    """
    deadline_s = clock.monotonic() + timeout_s
    objects.write_unsigned(
        object_dictionary.TARE, object_dictionary.TARE_COMMAND, object_dictionary.TARE_SIGNATURE, 4
    )
    while (
        result := objects.read_unsigned(object_dictionary.TARE, object_dictionary.TARE_RESULT)
    ) == object_dictionary.TareResult.RUNNING:
        if clock.monotonic() >= deadline_s:
            raise TareRefused(
                f"the unit did not finish its tare within {timeout_s:g} s: check that frames run"
            )
        pump()
    if result != object_dictionary.TareResult.DONE:
        largest = objects.read_unsigned(object_dictionary.TARE, object_dictionary.TARE_LARGEST)
        raise TareRefused(
            f"the unit refused its tare: {_REFUSALS.get(result, f'result {result}')}, largest "
            f"sample {largest} counts; clear the pads and try again"
        )


def read_last_frame(objects: ObjectAccess, layout: TaxelLayout) -> tuple[int, NDArray[np.uint16]]:
    """Return counter and counts of the unit's last complete frame; FrameError if of wrong size."""
    data = objects.read(object_dictionary.LAST_FRAME)
    counter = objects.read_unsigned(object_dictionary.LAST_FRAME_COUNTER)
    expected = layout.n_taxels * layout.sample_bytes
    if len(data) != expected:
        raise FrameError(f"the unit gave a last frame of {len(data)} bytes, expected {expected}")
    counts = np.frombuffer(data, dtype="<u1" if layout.sample_bytes == 1 else "<u2")
    return counter, counts.astype(np.uint16)
