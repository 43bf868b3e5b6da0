"""Object dictionary access to the control unit: reads and writes by index."""

from collections.abc import Callable
from typing import Any

import can
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from tactile.can.receiver import interface_failed
from tactile.can.sdo_client import PolledSdoClient, SdoNotAnswered
from tactile.errors import NodeMissing, ObjectRefused

_NO_OBJECT = 0x0602_0000
"""SDO abort code: the object does not exist (CiA 301, 7.2.4.3.17)."""
_ADVICE = dict.fromkeys(
    (0x0503, 0x0504, 0x060A),
    "another program may use the unit: end that program, then start the link again",
) | dict.fromkeys((0x0606, 0x0800), "restart the unit, then start the link again")
_UPDATE = "the unit's firmware does not fit this software's EDS; update the older one"
"""Next step by the upper half of an abort code, and that for the other codes."""
_ATTEMPTS = 3
"""Number of attempts of a transfer without a response."""


class ObjectAccess:
    """Reads and writes objects by index; repeats lost transfers; errors name object and unit."""

    def __init__(self, client: PolledSdoClient, *, name: str) -> None:
        self._client = client
        self._name = name

    def read(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object."""
        data: bytes = self._transfer(self._client.upload, "read", index, subindex)
        return data

    def read_unsigned(self, index: int, subindex: int = 0) -> int:
        """Return an unsigned integer."""
        return int.from_bytes(self.read(index, subindex), "little")

    def read_text(self, index: int, subindex: int = 0) -> str:
        """Return a visible string."""
        return self.read(index, subindex).rstrip(b"\0").decode("ascii", errors="replace")

    def find(self, index: int) -> bytes | None:
        """Return the bytes of an object, None if the unit does not have it."""
        try:
            return self.read(index)
        except ObjectRefused as error:
            if error.__cause__ != SdoAbortedError(_NO_OBJECT):
                raise
            return None

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write the bytes of an object."""
        self._transfer(self._client.download, "write", index, subindex, data)

    def write_unsigned(self, index: int, subindex: int, value: int, n_bytes: int) -> None:
        """Write an unsigned integer of ``n_bytes`` bytes."""
        self.write(index, subindex, value.to_bytes(n_bytes, "little"))

    def _transfer(
        self, transfer: Callable[..., Any], verb: str, index: int, subindex: int, *data: bytes
    ) -> Any:
        what = f"{verb} of object 0x{index:04X}:{subindex:02X} of {self._name}"
        failure: Exception | None = None
        for _ in range(_ATTEMPTS):
            try:
                return transfer(index, subindex, *data)
            except SdoCommunicationError as error:
                failure = error
            except SdoAbortedError as error:
                advice = _ADVICE.get(error.code >> 16, _UPDATE)
                raise ObjectRefused(f"{what} was refused ({error}): {advice}") from error
            except (can.CanError, OSError) as error:
                raise interface_failed(error) from error
        silent = isinstance(failure, SdoNotAnswered)
        advice = "check supply, CAN cable and node-ID" if silent else "update the unit's firmware"
        raise NodeMissing(f"{what} failed {_ATTEMPTS} times: {failure}; {advice}") from failure
