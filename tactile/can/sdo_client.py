"""SDO client of canopen that waits by the injected clock; its errors name object and node."""

import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import canopen
from canopen.sdo import constants as sdo
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from tactile.clock import Clock
from tactile.errors import NodeMissing, ObjectRefused

_SDO_BYTES = 8

_ADVICE = dict.fromkeys(
    (0x0503, 0x0504, 0x060A),
    "another program may use the unit: end that program, then start the link again",
) | dict.fromkeys((0x0606, 0x0800), "restart the unit, then start the link again")
_UPDATE = "the unit's firmware does not fit this software's EDS; update the older one"
"""Next step by the upper half of an abort code, and that for the other codes."""
_ATTEMPTS = 3
"""Number of attempts of a transfer without a response."""
_MOST_RESPONSES = 5000
"""More than any transfer needs. The longest object, the table of a control unit, takes 75. A server
that never ends a transfer sends more."""
COB_SDO_RESPONSE = 0x580
COB_SDO_REQUEST = 0x600
"""Identifiers of the pre-defined connection set (CiA 301, 7.3.5), without the node-ID."""

# Each request that is repeated because its answer was lost is an error there.
logging.getLogger(SdoClient.__module__).setLevel(logging.CRITICAL)


class SdoNotAnswered(SdoCommunicationError):
    """There was no response in time."""


class PolledSdoClient(SdoClient):
    """canopen's client without the real-time wait of its queue: one thread, real or virtual time.

    ``client["Identity object.Vendor-ID"].raw`` reads an object by its name in the EDS, and an
    assignment writes it. Lost transfers are repeated. Raises NodeMissing without a usable answer,
    ObjectRefused for an abort, and what `send_message` of its ``network`` raises.

    Parameters
    ----------
    name
        The node in words.
    service
        Processes received messages and calls `on_response` with the responses.
    wait
        Waits for at most a time in s.
    timeout_s
        Longest wait for one response.
    """

    def __init__(
        self,
        node_id: int,
        dictionary: canopen.ObjectDictionary,
        *,
        name: str,
        clock: Clock,
        service: Callable[[], None],
        wait: Callable[[float], None],
        timeout_s: float,
    ) -> None:
        super().__init__(  # type: ignore[no-untyped-call]
            COB_SDO_REQUEST + node_id, COB_SDO_RESPONSE + node_id, dictionary
        )
        self.name = name
        self._clock = clock
        self._service = service
        self._wait = wait
        self._timeout_s = timeout_s
        self._responses = 0
        self.surplus = 0
        """Number of answers over requests: from a second server, or to another client."""

    def __getitem__(self, index: int | str) -> Any:
        """Return an object of the node, by its name in the EDS."""
        return super().__getitem__(index)

    def find(self, name: str) -> Any:
        """Return the value of an object, None if the node does not have it."""
        try:
            return self[name].raw
        except ObjectRefused as error:
            if error.__cause__ != SdoAbortedError(sdo.ABORT_NOT_IN_OD):
                raise
            return None

    def label(self, name: str) -> str:
        """Return the name of an object for people: ``Vendor-ID (1018h:01)``."""
        variable = self[name].od
        return f"{variable.name} ({variable.index:04X}h:{variable.subindex:02X})"

    def defaults(self, record: str) -> dict[str, int]:
        """Return the values that the EDS has for the objects of a record, by their names."""
        return {variable.qualname: variable.default for variable in self[record].od.values()}

    def send_request(self, request: bytes | bytearray) -> None:
        """Send a request, or an abort, which has no answer."""
        self.surplus -= request[0] != sdo.REQUEST_ABORTED
        super().send_request(request)  # type: ignore[no-untyped-call]

    def upload(self, index: int, subindex: int) -> bytes:
        """Return the bytes of an object."""
        read = partial(self._upload, index, subindex)
        data: bytes = self._repeated("read", index, subindex, read)
        return data

    def download(self, index: int, subindex: int, data: bytes, force_segment: bool = False) -> None:
        """Write the bytes of an object."""
        write = partial(super().download, index, subindex, data, force_segment)
        self._repeated("write", index, subindex, write)

    def _upload(self, index: int, subindex: int) -> bytes:
        """Return an object's bytes; SdoCommunicationError if it is incomplete."""
        data: bytes = super().upload(index, subindex)
        variable = self.od.get_variable(index, subindex)
        length = len(variable) // 8 if variable is not None and variable.fixed_size else 0
        if len(data) < length:
            raise SdoCommunicationError(f"{len(data)} bytes came, the object has {length}")
        return data

    def on_response(self, can_id: int, data: bytes | bytearray, timestamp: float) -> None:
        """Process a message of the SDO server."""
        self.surplus += 1
        super().on_response(can_id, data, timestamp)  # type: ignore[no-untyped-call]

    def until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Process messages until a condition holds; return whether it holds within a time in s."""
        deadline_s = self._clock.monotonic() + timeout_s
        self._service()
        while not condition():
            left_s = deadline_s - self._clock.monotonic()
            if left_s <= 0.0:
                return False
            self._wait(left_s)
            self._service()
        return True

    def read_response(self) -> bytes:
        """Wait for a response; SdoNotAnswered after the time-out; a short one is refused."""
        if not self.until(lambda: not self.responses.empty(), self._timeout_s):
            raise SdoNotAnswered(f"no SDO response within {self._timeout_s:g} s")
        self._responses += 1
        if self._responses > _MOST_RESPONSES:
            raise SdoCommunicationError(f"it does not end after {_MOST_RESPONSES} responses")
        response: bytes = self.responses.get_nowait()
        if len(response) != _SDO_BYTES:
            raise SdoCommunicationError(
                f"the answer [{response.hex(' ')}] has {len(response)} bytes, expected 8"
            )
        if response[0] == sdo.RESPONSE_ABORTED:
            raise SdoAbortedError(int.from_bytes(response[4:8], "little"))
        return response

    def _repeated(self, verb: str, index: int, subindex: int, transfer: Callable[[], Any]) -> Any:
        what = f"{verb} of object 0x{index:04X}:{subindex:02X} of {self.name}"
        failure: Exception | None = None
        for _ in range(_ATTEMPTS):
            self._responses = 0
            try:
                return transfer()
            except SdoCommunicationError as error:
                failure = error
            except SdoAbortedError as error:
                if isinstance(error.__context__, SdoCommunicationError):
                    failure = error.__context__  # after a lost answer canopen ends a write too soon
                    continue
                advice = _ADVICE.get(error.code >> 16, _UPDATE)
                raise ObjectRefused(f"{what} was refused ({error}): {advice}") from error
        silent = isinstance(failure, SdoNotAnswered)
        advice = "check supply, CAN cable and node-ID" if silent else "update the unit's firmware"
        raise NodeMissing(f"{what} failed {_ATTEMPTS} times: {failure}; {advice}") from failure
